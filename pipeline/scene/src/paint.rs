//! What colour a surface has where.

use crate::noise::Noise;
use crate::vector::Vector;

/// Lime in the light and wet clay in the hollows: what the cave's rock goes between.
const LIME: [f64; 3] = [206.0, 188.0, 156.0];
const CLAY: [f64; 3] = [112.0, 82.0, 60.0];

/// Blotches of the rock per metre.
const BLOTCHES_PER_M: f64 = 1.3;

/// The colour of a surface: red, green, blue, 0…255.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Paint {
    /// The same everywhere.
    Plain([u8; 3]),
    /// Mottled rock.
    Rock(Noise),
}

impl Paint {
    /// Gives the colour at a place of the surface.
    pub(crate) fn color(&self, place: Vector) -> [u8; 3] {
        match self {
            Paint::Plain(color) => *color,
            Paint::Rock(noise) => {
                let t = 0.5 + 0.5 * noise.octaves(place.map(|v| v * BLOTCHES_PER_M), 2);
                [0, 1, 2].map(|i| (CLAY[i] + t * (LIME[i] - CLAY[i])) as u8)
            }
        }
    }
}
