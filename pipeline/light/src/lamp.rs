//! Lights that are no part of the scan.

use std::f64::consts::PI;

use crate::vector::{cross, norm, scale};

/// A light added to a scene. Places are in world units; colours are red, green and blue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lamp {
    /// Shines the same in all directions.
    Point {
        /// Where it is.
        position: [f64; 3],
        /// Flux a solid angle: its flux / 4π.
        intensity: [f64; 3],
    },
    /// Shines into a cone.
    Spot {
        /// Where it is.
        position: [f64; 3],
        /// The axis of the cone, of length 1.
        direction: [f64; 3],
        /// Between the axis of the cone and its side, radians, 0…π.
        angle: f64,
        /// Flux a solid angle, within the cone.
        intensity: [f64; 3],
    },
    /// A parallelogram that shines from its front by Lambert's law.
    Area {
        /// A corner.
        corner: [f64; 3],
        /// Its sides; u × v is the way that it shines.
        sides: [[f64; 3]; 2],
        /// Flux an area.
        exitance: [f64; 3],
    },
    /// So far away that its light is parallel.
    Sun {
        /// To it, of length 1.
        direction: [f64; 3],
        /// Flux that arrives an area square to its light.
        irradiance: [f64; 3],
    },
}

impl Lamp {
    /// Gives the numbers that its red, green and blue light are proportional to.
    pub fn color(&self) -> [f64; 3] {
        match *self {
            Lamp::Point { intensity, .. } | Lamp::Spot { intensity, .. } => intensity,
            Lamp::Area { exitance, .. } => exitance,
            Lamp::Sun { irradiance, .. } => irradiance,
        }
    }

    /// Gives its flux; none of the sun.
    pub fn flux(&self) -> Option<[f64; 3]> {
        match *self {
            Lamp::Point { intensity, .. } => Some(scale(intensity, 4.0 * PI)),
            Lamp::Spot { angle, intensity, .. } => {
                Some(scale(intensity, solid_angle_of_cone(angle)))
            }
            Lamp::Area { sides: [u, v], exitance, .. } => Some(scale(exitance, norm(cross(u, v)))),
            Lamp::Sun { .. } => None,
        }
    }
}

/// Gives the solid angle of a cone by the angle between its axis and its side, radians.
pub fn solid_angle_of_cone(angle: f64) -> f64 {
    // 2π(1 - cos a), without the difference, which loses narrow cones.
    4.0 * PI * (0.5 * angle).sin().powi(2)
}

/// A sky that shines alike from all directions above the horizon.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sky {
    /// Flux an area and a solid angle; an open level place gets π times as much an area.
    pub radiance: [f64; 3],
    /// To the zenith, of length 1.
    pub up: [f64; 3],
}
