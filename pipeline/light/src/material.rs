//! What surfaces do with light: what they emit, and what becomes of what arrives.

use pvmap_vmap::light::Gloss;

use crate::element::Elements;
use crate::error::LightError;

/// One channel of a scene: all light, or its red, green or blue.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Channel {
    /// Exitance E of each element by itself, 0 or more: flux an area, π times the radiance.
    pub emission: Vec<f64>,
    /// Share of the light that arrives which each reflects in all directions, ρ or kd, 0…1.
    pub albedo: Vec<f64>,
}

/// The materials of all elements.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Materials {
    /// Red, green and blue.
    pub channels: [Channel; 3],
    /// What mirrors or lets light through; empty where nothing does.
    pub gloss: Vec<Gloss>,
}

impl Materials {
    /// Checks that there is a value for each element, and that none reflects more than arrives.
    ///
    /// # Errors
    /// Where counts differ, a value is out of range, or kd + ks + kt is above 1.
    pub fn check(&self, elements: &Elements) -> Result<(), LightError> {
        let n = elements.len();
        for channel in &self.channels {
            check_each(n, "emission", "0 or more", &channel.emission, |e| {
                e >= 0.0 && e.is_finite()
            })?;
            check_each(n, "albedo", "between 0 and 1", &channel.albedo, |rho| {
                (0.0..=1.0).contains(&rho)
            })?;
        }
        if self.gloss.is_empty() {
            return Ok(());
        }
        if self.gloss.len() != n {
            let found = self.gloss.len();
            return Err(LightError::Count { what: "gloss", found, expected: n });
        }
        for (index, gloss) in self.gloss.iter().enumerate() {
            let of_gloss = f64::from(gloss.specular) + f64::from(gloss.transmissive);
            let most = self.channels.iter().map(|c| c.albedo[index]).fold(0.0, f64::max);
            let (what, range) = ("kd + ks + kt", "at most 1");
            let value = most + of_gloss;
            let is_legal = gloss.specular >= 0.0 && gloss.transmissive >= 0.0;
            // A rounded third is not a share too many.
            if !is_legal || value.is_nan() || value > 1.0 + 1e-6 {
                return Err(LightError::Value { what, index, value, range });
            }
        }
        Ok(())
    }

    /// Says whether anything mirrors or lets light through.
    pub fn has_gloss(&self) -> bool {
        self.gloss.iter().any(Gloss::is_any)
    }
}

/// Checks that there are `expected` values, each of them legal.
pub(crate) fn check_each(
    expected: usize,
    what: &'static str,
    range: &'static str,
    values: &[f64],
    is_legal: impl Fn(f64) -> bool,
) -> Result<(), LightError> {
    let found = values.len();
    if found != expected {
        return Err(LightError::Count { what, found, expected });
    }
    match values.iter().position(|&v| !is_legal(v)) {
        Some(index) => Err(LightError::Value { what, index, value: values[index], range }),
        None => Ok(()),
    }
}
