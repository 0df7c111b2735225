//! Lights that are no part of the scan.

use std::f64::consts::PI;

use crate::incident::{GOLDEN, PLASTIC};
use crate::vector::{add, beside, cross, norm, scale};

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

    /// Gives the `k`-th of n rays that bring the same part of its light each: where it begins, and
    /// its direction, of length 1. They are spread evenly. None of the sun.
    pub(crate) fn ray(&self, k: usize, n: usize) -> Option<([f64; 3], [f64; 3])> {
        let height = (k as f64 + 0.5) / n as f64;
        let turn = GOLDEN * k as f64;
        // Round an axis, so far along it and so far from it.
        let round = |axis: [f64; 3], along: f64, away: f64| {
            let ([u, v], (sin, cos)) = (beside(axis), turn.sin_cos());
            add(scale(axis, along), scale(add(scale(u, cos), scale(v, sin)), away))
        };
        let in_cone = |axis: [f64; 3], angle: f64| {
            let from_axis = 2.0 * ((0.5 * angle).sin() * height.sqrt()).asin();
            round(axis, from_axis.cos(), from_axis.sin())
        };
        Some(match *self {
            Lamp::Point { position, .. } => (position, in_cone([0.0, 0.0, 1.0], PI)),
            Lamp::Spot { position, direction, angle, .. } => (position, in_cone(direction, angle)),
            Lamp::Area { corner, sides: [u, v], .. } => {
                let [a, b] = PLASTIC.map(|step| (k as f64 * step).fract());
                let front = cross(u, v);
                let axis = scale(front, 1.0 / norm(front));
                let place = add(corner, add(scale(u, a), scale(v, b)));
                (place, round(axis, (1.0 - height).sqrt(), height.sqrt()))
            }
            Lamp::Sun { .. } => return None,
        })
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
