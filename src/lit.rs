//! The light of a light file, on surfels and between them, as pictures and exports show it.

use std::path::Path;

use pvmap_geometry::GridPoint;
use pvmap_light::{Irradiance, LightError};
use pvmap_vmap::{FormatError, LightView, MapView};

use crate::Error;

/// How much light white stands for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Exposure {
    /// Such that of the area that reflects light, but does not shine by itself, 95 % stay below
    /// 0.8 of white.
    Auto,
    /// Radiosity is multiplied with this number, above 0.
    Times(f64),
}

/// Linear light of a picture that [`Exposure::Auto`] aims for.
const AUTO_LEVEL: f64 = 0.8;
/// The share of the area that stays below it.
const AUTO_SHARE: f64 = 0.95;

/// The light of a map's surfels, read from a light file.
#[derive(Debug)]
pub struct LitMap {
    surfels: Vec<LitSurfel>,
    irradiance: Irradiance,
    is_grey: bool,
}

/// Numbers of a surfel in red, green and blue.
#[derive(Debug, Clone, Copy)]
struct LitSurfel {
    emission: [f32; 3],
    albedo: [f32; 3],
    radiosity: [f32; 3],
    /// The mean of its points' colours, linear; zero where they have none.
    color: [f32; 3],
    /// In square grid steps.
    area: f64,
}

impl LitMap {
    /// Reads the light of a map. Paths are those of messages.
    ///
    /// # Errors
    /// Where the file is of another map, or one of the two is damaged.
    pub fn read(
        (light_path, light): (&Path, &LightView<'_>),
        (map_path, map): (&Path, &MapView<'_>),
    ) -> Result<LitMap, Error> {
        require_light((light_path, light), (map_path, map))?;
        let of_light = |e: FormatError| Error::artifact(light_path, e);
        let of_map = |e: FormatError| Error::artifact(map_path, e);
        let n = map.summary().n_surfels;
        let (mut surfels, mut areas, mut irradiance) = (Vec::new(), Vec::new(), Vec::new());
        for id in 0..n {
            let given = light.given(id).map_err(of_light)?;
            let found = light.found(id).map_err(of_light)?;
            let color = map.surfel(id).map_err(of_map)?.color.unwrap_or_default();
            let area = light.factors(id).map_err(of_light)?.area;
            areas.push(area);
            irradiance.push(found.map(|f| f.irradiance));
            surfels.push(LitSurfel {
                emission: given.map(|g| g.emission),
                albedo: given.map(|g| g.albedo),
                radiosity: found.map(|f| f.radiosity),
                color: color.map(|v| f32::from(v) / 65535.0),
                area,
            });
        }
        let irradiance = Irradiance::new(map, &areas, &irradiance).map_err(|e| match e {
            LightError::Format(e) => of_map(e),
            e => Error::Data(format!("{}: {e}", light_path.display())),
        })?;
        Ok(LitMap { surfels, irradiance, is_grey: light.summary().n_channels == 1 })
    }

    /// Gives the bytes that the light of so many surfels holds in memory, about.
    pub fn held_bytes(n_surfels: u32) -> u64 {
        // Beside each of them its place and normal, and up to eight cells that it reaches into.
        u64::from(n_surfels) * (size_of::<LitSurfel>() as u64 + 44 + 8 * 16)
    }

    /// Gives the area of each surfel in square grid steps.
    pub fn areas(&self) -> Vec<f64> {
        self.surfels.iter().map(|surfel| surfel.area).collect()
    }

    /// Says whether all light has one colour.
    pub fn is_grey(&self) -> bool {
        self.is_grey
    }

    /// Gives the radiosity B of a surfel, red, green and blue.
    pub fn of_surfel(&self, surfel: u32) -> [f64; 3] {
        self.surfels.get(surfel as usize).map_or([0.0; 3], |s| s.radiosity.map(f64::from))
    }

    /// Gives the irradiance H at a place of a surfel. The normal has length 1, or is zero.
    pub fn irradiance(&self, place: GridPoint, normal: [f32; 3], surfel: u32) -> [f64; 3] {
        self.irradiance.at(place, normal, surfel)
    }

    /// Gives the radiosity at a place of a surfel: E + ρ·H. The albedo of the surfel is that of
    /// its mean colour; where the place has a linear colour of its own, ρ is so many times lighter
    /// or darker, at most 1. So the texture of a scan stays as sharp as its points.
    pub fn radiosity(
        &self,
        place: GridPoint,
        normal: [f32; 3],
        surfel: u32,
        color: Option<[f32; 3]>,
    ) -> [f64; 3] {
        let irradiance = self.irradiance(place, normal, surfel);
        let Some(own) = self.surfels.get(surfel as usize) else { return [0.0; 3] };
        let ratio = color.map_or([1.0; 3], |color| self.ratio(color, own.color));
        [0, 1, 2].map(|i| {
            let albedo = (f64::from(own.albedo[i]) * ratio[i]).clamp(0.0, 1.0);
            f64::from(own.emission[i]) + albedo * irradiance[i]
        })
    }

    /// Gives how many times lighter a colour is than a mean; all alike in grey light.
    fn ratio(&self, color: [f32; 3], mean: [f32; 3]) -> [f64; 3] {
        // A colour amid black, by its rounding, says nothing.
        let of = |a: f32, b: f32| if b > 0.0 { f64::from(a) / f64::from(b) } else { 1.0 };
        match self.is_grey {
            true => [of(color.iter().sum(), mean.iter().sum()); 3],
            false => [0, 1, 2].map(|i| of(color[i], mean[i])),
        }
    }

    /// Gives the number that radiosity is multiplied with, in four digits, so that it can be told
    /// and given again.
    pub fn exposure(&self, exposure: Exposure) -> f64 {
        if let Exposure::Times(times) = exposure {
            return times;
        }
        let brightest = |values: [f32; 3]| values.into_iter().fold(0.0, f32::max);
        let level = |emits: bool| {
            let lit = self
                .surfels
                .iter()
                .filter(|s| (brightest(s.emission) > 0.0) == emits && brightest(s.radiosity) > 0.0);
            percentile(lit.map(|s| (brightest(s.radiosity), s.area)).collect())
        };
        // Where lamps alone can be seen they are.
        let level = level(false).or_else(|| level(true));
        level.map_or(1.0, |level| four_digits(AUTO_LEVEL / f64::from(level)))
    }
}

/// Gives the value up to which [`AUTO_SHARE`] of all weights are; none of no values.
fn percentile(mut values: Vec<(f32, f64)>) -> Option<f32> {
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let wanted = AUTO_SHARE * values.iter().map(|v| v.1).sum::<f64>();
    let mut sum = 0.0;
    let found = values.iter().find(|(_, weight)| {
        sum += weight;
        sum >= wanted
    });
    found.or(values.last()).map(|v| v.0)
}

/// Rounds to four digits.
fn four_digits(value: f64) -> f64 {
    // A decimal that is read back is the nearest number to it.
    format!("{value:.3e}").parse().unwrap_or(value)
}

/// Refuses a light file that was made for another map.
///
/// # Errors
/// Where it was; both are named.
pub fn require_light(
    (light_path, light): (&Path, &LightView<'_>),
    (map_path, map): (&Path, &MapView<'_>),
) -> Result<(), Error> {
    let (wanted, found) = (light.summary().map, map.file().root());
    if wanted == found && light.summary().n_surfels == map.summary().n_surfels {
        return Ok(());
    }
    Err(Error::Data(format!(
        "{}: the light of another map, {wanted:032x}, and {} is {found:032x}; give that map, or \
         run pvmap light on this one",
        light_path.display(),
        map_path.display()
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_by_area() {
        let even = (0..100).map(|i| (i as f32, 1.0)).collect();
        assert_eq!(percentile(even), Some(94.0));
        // A hundred small bright spots are 1 % of the area.
        let spots = (0..100).map(|i| (9.0 + i as f32, 0.1)).chain([(2.0, 990.0)]).collect();
        assert_eq!(percentile(spots), Some(2.0));
        assert_eq!(percentile(Vec::new()), None);
    }

    #[test]
    fn exposures_are_told_in_four_digits() {
        for (value, told) in [(0.123_456, "0.1235"), (2.0 / 3.0 * 1e-7, "0.00000006667")] {
            assert_eq!(four_digits(value).to_string(), told);
        }
        assert_eq!(four_digits(12_346.0), 12_350.0);
    }
}
