//! Points placed on the grid and given their Morton codes, and normals quantised, many at a time.
//!
//! The same numbers as [`Frame::grid_of_lattice`], [`morton::encode`] and
//! [`quantise`](crate::normal::quantise) give one by one, in loops over an axis each that the
//! compiler turns into vector instructions: four times as fast.

use multiversion::multiversion;

use crate::grid::{Frame, GRID_MAX, GridPoint};
use crate::morton;
use crate::normal::{NORMAL_LENGTH, Normal};

/// Points of a block: its arrays stay in the level-1 cache.
pub const BLOCK_POINTS: usize = 64;

/// Numbers from 2^52 on are whole: adding it to a smaller one rounds that.
const TWO_52: f64 = (1u64 << 52) as f64;

/// Up to [`BLOCK_POINTS`] points: δ of [D-1] in, grid coordinates and Morton codes out.
///
/// Points that are not set keep what was there before, which is never read.
#[derive(Debug)]
pub struct GridBlock {
    delta: [[f64; BLOCK_POINTS]; 3],
    grid: [[u32; BLOCK_POINTS]; 3],
    codes: [u64; BLOCK_POINTS],
}

impl Default for GridBlock {
    fn default() -> GridBlock {
        GridBlock {
            delta: [[0.0; BLOCK_POINTS]; 3],
            grid: [[0; BLOCK_POINTS]; 3],
            codes: [0; BLOCK_POINTS],
        }
    }
}

impl GridBlock {
    /// Sets point `i` by its lattice steps. A point below the frame's minimum (a frame can be a
    /// guess) counts as on it.
    ///
    /// # Panics
    /// On a frame in world units.
    #[inline(always)]
    pub fn set_lattice(&mut self, i: usize, frame: &Frame, x: [i64; 3]) {
        let Frame::Lattice { scale, min, .. } = frame else {
            unreachable!("lattice coordinates in a world frame")
        };
        self.delta[0][i] = x[0].saturating_sub(min[0]) as f64 * scale[0];
        self.delta[1][i] = x[1].saturating_sub(min[1]) as f64 * scale[1];
        self.delta[2][i] = x[2].saturating_sub(min[2]) as f64 * scale[2];
    }

    /// Sets point `i` by its world coordinates; otherwise as [`GridBlock::set_lattice`].
    ///
    /// # Panics
    /// On a lattice frame.
    #[inline(always)]
    pub fn set_world(&mut self, i: usize, frame: &Frame, x: [f64; 3]) {
        let Frame::World { min, .. } = frame else {
            unreachable!("world coordinates in a lattice frame")
        };
        self.delta[0][i] = x[0] - min[0];
        self.delta[1][i] = x[1] - min[1];
        self.delta[2][i] = x[2] - min[2];
    }

    /// Computes the grid coordinates and the Morton codes of all points that were set.
    pub fn place(&mut self, frame: &Frame) {
        place(self, frame.extent());
    }

    /// Gives the place of point `i`.
    #[inline(always)]
    pub fn grid(&self, i: usize) -> GridPoint {
        [self.grid[0][i], self.grid[1][i], self.grid[2][i]]
    }

    /// Gives the Morton codes, a point each.
    pub fn codes(&self) -> &[u64; BLOCK_POINTS] {
        &self.codes
    }
}

#[multiversion(targets = "simd")]
fn place(block: &mut GridBlock, extent: f64) {
    for (grid, delta) in block.grid.iter_mut().zip(&block.delta) {
        for i in 0..BLOCK_POINTS {
            grid[i] = step(delta[i], extent);
        }
    }
    for i in 0..BLOCK_POINTS {
        block.codes[i] = morton::encode([block.grid[0][i], block.grid[1][i], block.grid[2][i]]);
    }
}

/// Turns δ into a coordinate as `grid::step` does, without the conversion of a float to an
/// integer, which is slow in vectors.
#[inline(always)]
fn step(delta: f64, extent: f64) -> u32 {
    let steps = delta / extent * f64::from(GRID_MAX);
    // NaN (0/0 when E = 0) is not above 0 and becomes 0.
    let steps = if steps > 0.0 { steps } else { 0.0 };
    let steps = if steps < f64::from(GRID_MAX) { steps } else { f64::from(GRID_MAX) };
    let shifted = steps + TWO_52;
    let is_rounded_up = shifted - TWO_52 > steps;
    // The lowest bits of the mantissa are the whole number; what was rounded up is at least 1, and
    // a check for that would keep the loop from becoming vectors.
    (shifted.to_bits() as u32 & GRID_MAX).wrapping_sub(u32::from(is_rounded_up))
}

/// Up to [`BLOCK_POINTS`] normals: directions in, quantised normals out.
///
/// Normals that are not set keep what was there before, which is never read.
#[derive(Debug)]
pub struct NormalBlock {
    given: [[f32; BLOCK_POINTS]; 3],
    quantised: [[i16; BLOCK_POINTS]; 3],
}

impl Default for NormalBlock {
    fn default() -> NormalBlock {
        NormalBlock { given: [[0.0; BLOCK_POINTS]; 3], quantised: [[0; BLOCK_POINTS]; 3] }
    }
}

impl NormalBlock {
    /// Sets normal `i`, a direction of any length.
    #[inline(always)]
    pub fn set(&mut self, i: usize, n: [f32; 3]) {
        self.given[0][i] = n[0];
        self.given[1][i] = n[1];
        self.given[2][i] = n[2];
    }

    /// Quantises all normals that were set.
    pub fn quantise(&mut self) {
        quantise(self);
    }

    /// Gives normal `i`: what [`quantise`](crate::normal::quantise) gives, zero for no normal.
    #[inline(always)]
    pub fn normal(&self, i: usize) -> Normal {
        [self.quantised[0][i], self.quantised[1][i], self.quantised[2][i]]
    }
}

#[multiversion(targets = "simd")]
fn quantise(block: &mut NormalBlock) {
    let mut lengths = [0.0; BLOCK_POINTS];
    for i in 0..BLOCK_POINTS {
        let [x, y, z] = [0, 1, 2].map(|axis| f64::from(block.given[axis][i]));
        let norm2 = x * x + y * y + z * z;
        // What has no direction is divided by infinity, or is NaN, and becomes 0.
        lengths[i] = if norm2 > 0.0 { norm2.sqrt() } else { f64::INFINITY };
    }
    for (quantised, given) in block.quantised.iter_mut().zip(&block.given) {
        for i in 0..BLOCK_POINTS {
            quantised[i] = component(f64::from(given[i]), lengths[i]);
        }
    }
}

/// Scales and rounds a component as [`quantise`](crate::normal::quantise) does, without the
/// conversion of a float to an integer, which is slow in vectors.
#[inline(always)]
fn component(v: f64, length: f64) -> i16 {
    let scaled = v / length * f64::from(NORMAL_LENGTH);
    let size = if scaled.abs() <= f64::from(NORMAL_LENGTH) { scaled.abs() } else { 0.0 };
    let near = size + TWO_52 - TWO_52;
    let whole = if near > size { near - 1.0 } else { near };
    let rounded = if size - whole >= 0.5 { whole + 1.0 } else { whole };
    // The lowest bits of the mantissa are the whole number.
    let number = (rounded + TWO_52).to_bits() as i16;
    if scaled < 0.0 { number.wrapping_neg() } else { number }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::normal;
    use proptest::prelude::*;

    fn any_component() -> impl Strategy<Value = f32> {
        let odd = [0.0, -0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 1e-45, -1.0];
        prop_oneof![-1.0..1.0f32, any::<f32>(), prop::sample::select(odd.to_vec())]
    }

    proptest! {
        #[test]
        fn a_block_quantises_normals_as_they_are_quantised_one_by_one(
            n in prop::array::uniform3(any_component()),
            // A leg of so many halves of a step, the other as long as makes them exact.
            halves in -32_768i16..=32_767,
            i in 0..BLOCK_POINTS,
        ) {
            let mut block = NormalBlock::default();
            let leg = f32::from(halves);
            let near_tie = [leg, 0.0, (32_768.0f32.powi(2) - leg.powi(2)).sqrt()];
            for n in [n, near_tie] {
                block.set(i, n);
                block.quantise();
                prop_assert_eq!(block.normal(i), normal::quantise(n).unwrap_or_default());
            }
        }

        #[test]
        fn a_block_places_points_as_they_are_placed_one_by_one(
            x in prop::array::uniform3(-5i64..1 << 22),
            world in prop::array::uniform3(prop_oneof![-1.0..3.0f64, Just(2.0), Just(0.0)]),
            scale in prop_oneof![Just(1.0), Just(0.001), 0.0001..10.0f64],
            side in prop_oneof![Just(0i64), Just(1 << 22), Just((1 << 22) - 1), 1i64..1 << 30],
            i in 0..BLOCK_POINTS,
        ) {
            let mut block = GridBlock::default();
            let frame = Frame::of_lattice([scale; 3], [0.0; 3], [0; 3], [side; 3]);
            block.set_lattice(i, &frame, x);
            block.place(&frame);
            prop_assert_eq!(block.grid(i), frame.grid_of_lattice(x));
            prop_assert_eq!(block.codes()[i], morton::encode(block.grid(i)));
            let frame = Frame::of_world([0.0; 3], [2.0; 3]);
            block.set_world(i, &frame, world);
            block.place(&frame);
            prop_assert_eq!(block.grid(i), frame.grid_of_world(world));
        }
    }
}
