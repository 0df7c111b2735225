//! How far a light is off: by places whose irradiance is known, or by another light of the map.

use std::path::Path;

use pvmap_geometry::GridPoint;
use pvmap_query::{Map, Place, Snap};
use pvmap_vmap::{FormatError, LightView, MapView};

use crate::{Error, LitMap, require_light};

/// A place whose irradiance is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownPlace {
    /// In the scan's units.
    pub position: [f64; 3],
    /// Of length 1.
    pub normal: [f32; 3],
    /// Red, green, blue, flux an area; not all zero.
    pub irradiance: [f64; 3],
    /// Whether only the mean of the three is known, and stands for each.
    pub is_mean: bool,
}

/// How far a light is off, as shares of what is known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Off {
    /// Mean of the absolute differences.
    pub mean: f64,
    /// Mean of the differences: above 0 where it is too bright.
    pub bias: f64,
    /// The largest absolute difference.
    pub largest: f64,
    /// How many places, or surfels, it was looked at.
    pub n: u64,
    /// How many were left out: places on no surface of the map, or surfels without a normal, which
    /// have no light.
    pub n_left_out: u64,
}

/// What the lights of a map are held against.
#[derive(Debug)]
pub enum Yardstick {
    /// Places on its surfaces.
    Places {
        /// Each with the surfel that answers for it.
        spots: Vec<Spot>,
        /// Places on none of them.
        n_left_out: u64,
    },
    /// The irradiance of its surfels in another light, red, green and blue, each with its area;
    /// none of surfels without a normal.
    Surfels(Vec<Option<(f64, [f64; 3])>>),
}

/// A place on a surface.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    at: GridPoint,
    surfel: u32,
    known: KnownPlace,
}

impl Yardstick {
    /// Finds places on the surfaces of a map, as an export finds points: within four half spacings.
    ///
    /// # Errors
    /// Where the map is damaged or has no surfels.
    pub fn of_places(
        places: &[KnownPlace],
        map: &Map<'_>,
        path: &Path,
    ) -> Result<Yardstick, Error> {
        let frame = &map.view().frame().frame;
        let mut spots = Vec::new();
        for known in places {
            let KnownPlace { position, normal, .. } = *known;
            let place = Place { position, normal: Some(normal) };
            let found = map.surface_at(&place, Snap::FourHalfSpacings);
            let found = found.map_err(|e| Error::of_query(path, e))?;
            if let (Some(found), Ok(at)) = (found, frame.grid_of_query(position)) {
                spots.push(Spot { at, surfel: found.surfel, known: *known });
            }
        }
        let n_left_out = (places.len() - spots.len()) as u64;
        Ok(Yardstick::Places { spots, n_left_out })
    }

    /// Takes the light of a file, of this map.
    ///
    /// # Errors
    /// Where the light is another map's, or one of the two is damaged.
    pub fn of_light(
        (light_path, light): (&Path, &LightView<'_>),
        (map_path, map): (&Path, &MapView<'_>),
    ) -> Result<Yardstick, Error> {
        require_light((light_path, light), (map_path, map))?;
        let of_light = |e| Error::artifact(light_path, e);
        let one = |id| {
            let surfel = map.surfel(id).map_err(|e| Error::artifact(map_path, e))?;
            if surfel.normal == [0; 3] {
                return Ok(None);
            }
            let area = light.factors(id).map_err(of_light)?.area;
            Ok(Some((area, irradiance(light, id).map_err(of_light)?)))
        };
        let surfels = (0..map.summary().n_surfels).map(one);
        Ok(Yardstick::Surfels(surfels.collect::<Result<_, Error>>()?))
    }

    /// Says whether there is nothing to look at.
    pub fn is_empty(&self) -> bool {
        match self {
            Yardstick::Places { spots, .. } => spots.is_empty(),
            Yardstick::Surfels(surfels) => surfels.iter().all(Option::is_none),
        }
    }

    /// Says how far a light of the map is off. At places each counts alike, its differences in red,
    /// green and blue added up, as a share of what is known there. Over surfels each counts by its
    /// area, and all is a share of the mean of the other light.
    ///
    /// # Errors
    /// Where the light is another map's, or damaged.
    pub fn off(
        &self,
        (light_path, light): (&Path, &LightView<'_>),
        (map_path, map): (&Path, &MapView<'_>),
    ) -> Result<Off, Error> {
        match self {
            Yardstick::Places { spots, n_left_out } => {
                let lit = LitMap::read((light_path, light), (map_path, map))?;
                let differences = spots.iter().map(|spot| {
                    let KnownPlace { normal, irradiance: known, is_mean, .. } = spot.known;
                    let mut found = lit.irradiance(spot.at, normal, spot.surfel);
                    if is_mean {
                        found = [found.iter().sum::<f64>() / 3.0; 3];
                    }
                    (1.0, difference(found, known, known.iter().sum()))
                });
                Ok(Off { n_left_out: *n_left_out, ..mean(differences) })
            }
            Yardstick::Surfels(surfels) => {
                require_light((light_path, light), (map_path, map))?;
                let known = || surfels.iter().flatten();
                let area: f64 = known().map(|(area, _)| area).sum();
                let flux: f64 = known().map(|(area, h)| area * h.iter().sum::<f64>()).sum();
                let mut differences = Vec::with_capacity(surfels.len());
                for (id, surfel) in (0..).zip(surfels) {
                    let Some((weight, known)) = *surfel else { continue };
                    let found =
                        irradiance(light, id).map_err(|e| Error::artifact(light_path, e))?;
                    differences.push((weight, difference(found, known, flux / area)));
                }
                let n_left_out = (surfels.len() - differences.len()) as u64;
                Ok(Off { n_left_out, ..mean(differences.into_iter()) })
            }
        }
    }
}

/// Gives the irradiance of a surfel, red, green and blue.
fn irradiance(light: &LightView<'_>, surfel: u32) -> Result<[f64; 3], FormatError> {
    Ok(light.found(surfel)?.map(|found| f64::from(found.irradiance)))
}

/// Adds up differences and their absolute values, as shares of a whole. In the dark nothing is off
/// that is dark.
fn difference(found: [f64; 3], known: [f64; 3], whole: f64) -> [f64; 2] {
    let differences = [0, 1, 2].map(|i| found[i] - known[i]);
    let sums = [differences.iter().map(|d| d.abs()).sum::<f64>(), differences.iter().sum()];
    sums.map(|sum| if sum == 0.0 { 0.0 } else { sum / whole })
}

/// Takes the means by weight of absolute and signed differences.
fn mean(differences: impl Iterator<Item = (f64, [f64; 2])>) -> Off {
    let (mut off, mut weights) = (Off::default(), 0.0);
    for (weight, [size, signed]) in differences {
        off.mean += weight * size;
        off.bias += weight * signed;
        off.largest = off.largest.max(size);
        off.n += 1;
        weights += weight;
    }
    if off.n > 0 {
        off.mean /= weights;
        off.bias /= weights;
    }
    off
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_shares_of_what_is_known() {
        let off = |found, known: [f64; 3]| difference(found, known, known.iter().sum());
        assert_eq!(off([2.0; 3], [4.0; 3]), [0.5, -0.5]);
        // Too red by as much as it is not green enough.
        assert_eq!(off([2.0, 0.0, 2.0], [1.0, 1.0, 2.0]), [0.5, 0.0]);
        assert_eq!(difference([0.0; 3], [0.0; 3], 0.0), [0.0, 0.0]);
    }

    #[test]
    fn means_are_by_weight() {
        let off = mean([(1.0, [0.5, -0.5]), (3.0, [0.1, 0.1])].into_iter());
        assert!((off.mean - 0.2).abs() < 1e-12 && (off.bias + 0.05).abs() < 1e-12, "{off:?}");
        assert_eq!((off.largest, off.n), (0.5, 2));
        assert_eq!(mean(std::iter::empty()), Off::default());
    }
}
