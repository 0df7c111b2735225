//! Smooth noise in space, from hashes of a lattice.

use crate::random::{bits, unit_pair};
use crate::vector::Vector;

/// Value noise: a random number at each whole place, blended smoothly between them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Noise {
    key: u64,
}

impl Noise {
    /// Draws a noise by its key.
    pub(crate) fn new(key: u64) -> Noise {
        Noise { key }
    }

    /// Gives the noise at `p`, within (-1, 1); its blobs are about one unit wide. Its first two
    /// derivatives are continuous.
    pub(crate) fn at(&self, p: Vector) -> f64 {
        let floor = p.map(f64::floor);
        // Perlin's quintic, whose first two derivatives vanish at 0 and 1.
        let blend = [0, 1, 2].map(|i| {
            let t = p[i] - floor[i];
            t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
        });
        let cell = floor.map(|v| v as i64);
        let mix = |t: f64, a: f64, b: f64| a + t * (b - a);
        let row = |y, z| mix(blend[0], self.value(cell, [0, y, z]), self.value(cell, [1, y, z]));
        let sheet = |z| mix(blend[1], row(0, z), row(1, z));
        mix(blend[2], sheet(0), sheet(1))
    }

    /// Gives the sum of `n` noises, each half as wide and half as strong as the one before, scaled
    /// to stay within (-1, 1).
    pub(crate) fn octaves(&self, p: Vector, n: u32) -> f64 {
        let (mut sum, mut strength, mut total) = (0.0, 1.0, 0.0);
        let mut q = p;
        for _ in 0..n {
            sum += strength * self.at(q);
            total += strength;
            strength *= 0.5;
            // The shift keeps the octaves' lattices from meeting at the origin.
            q = q.map(|v| 2.0 * v + 0.37);
        }
        sum / total
    }

    /// Gives the random number at a corner of a cell, within (-1, 1).
    fn value(&self, cell: [i64; 3], corner: [i64; 3]) -> f64 {
        // 21 bits an axis: the noise repeats after two million units.
        let axis = |i: usize| (cell[i] + corner[i]) as u64 & 0x1f_ffff;
        2.0 * unit_pair(bits(self.key, axis(0) | axis(1) << 21 | axis(2) << 42))[0] - 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_bounded_and_its_own_by_key() {
        let (noise, other) = (Noise::new(1), Noise::new(2));
        let mut differ = 0;
        for i in 0..5000u64 {
            let p = [0, 1, 2].map(|a| 40.0 * unit_pair(bits(5 + a, i))[0] - 20.0);
            let value = noise.octaves(p, 3);
            assert!(value.abs() < 1.0);
            assert!((noise.octaves(p.map(|v| v + 1e-7), 3) - value).abs() < 1e-5);
            differ += u32::from((other.octaves(p, 3) - value).abs() > 0.05);
        }
        assert!(differ > 3500, "{differ}");
    }
}
