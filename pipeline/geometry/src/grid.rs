//! The grid of [D-1]: a cube of 2^22 steps over the data, and the way from world units to it.

/// Bits of a grid coordinate.
pub const GRID_BITS: u32 = 22;
/// The largest grid coordinate, 2^22 - 1.
pub const GRID_MAX: u32 = (1 << GRID_BITS) - 1;

/// A place on the grid: steps from the cube's minimum corner along x, y, z, each < 2^22.
pub type GridPoint = [u32; 3];

/// How far a world coordinate may be from a lattice step and still be taken as that step: queries
/// give X · scale + offset after rounding, and one part in 2^20 of a step is far above that error
/// and far below anything a scanner resolves.
const LATTICE_SNAP: f64 = 1.0 / (1 << 20) as f64;

/// From the coordinates of a scan to the grid, and back to world units. Source: DESIGN.md [D-1].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Frame {
    /// Sources on one integer lattice (LAS): world = X · scale + offset.
    Lattice {
        /// World units per lattice step, an axis each, > 0.
        scale: [f64; 3],
        /// World coordinate of lattice step 0.
        offset: [f64; 3],
        /// The least X over all points.
        min: [i64; 3],
        /// The side E of the cube in world units: max over axes of (Xmax - Xmin) · scale.
        extent: f64,
    },
    /// Sources with real coordinates (PLY, or LAS files of different lattices).
    World {
        /// The least coordinate over all points.
        min: [f64; 3],
        /// The side E of the cube in world units: max over axes of max - min.
        extent: f64,
    },
}

/// A world coordinate lies outside the cube of the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutsideCube;

impl Frame {
    /// Frames points on a lattice by their bounds (`max` ≥ `min` on every axis).
    pub fn of_lattice(scale: [f64; 3], offset: [f64; 3], min: [i64; 3], max: [i64; 3]) -> Frame {
        let side = |i: usize| (max[i] - min[i]) as f64 * scale[i];
        let extent = side(0).max(side(1)).max(side(2));
        Frame::Lattice { scale, offset, min, extent }
    }

    /// Frames points with real coordinates by their bounds (`max` ≥ `min` on every axis).
    pub fn of_world(min: [f64; 3], max: [f64; 3]) -> Frame {
        // Adding 0.0 turns -0.0 into 0.0, so that a cloud with signed zeros gets the same bytes.
        let min = min.map(|v| v + 0.0);
        let extent = (0..3).fold(0.0f64, |e, i| e.max(max[i] - min[i]));
        Frame::World { min, extent }
    }

    /// Gives the cube's side E in world units.
    pub fn extent(&self) -> f64 {
        match *self {
            Frame::Lattice { extent, .. } | Frame::World { extent, .. } => extent,
        }
    }

    /// Places a stored lattice point on the grid. The frame is `Lattice`, `x` ≥ its minimum.
    #[inline(always)]
    pub fn grid_of_lattice(&self, x: [i64; 3]) -> GridPoint {
        let Frame::Lattice { scale, min, extent, .. } = self else {
            unreachable!("lattice coordinates in a world frame")
        };
        // Written out: the compiler does not inline a closure over an array here. Saturating: a
        // damaged file can name any minimum.
        [
            step(x[0].saturating_sub(min[0]) as f64 * scale[0], *extent),
            step(x[1].saturating_sub(min[1]) as f64 * scale[1], *extent),
            step(x[2].saturating_sub(min[2]) as f64 * scale[2], *extent),
        ]
    }

    /// Places a stored world point on the grid. The frame is `World`, `x` ≥ its minimum.
    #[inline(always)]
    pub fn grid_of_world(&self, x: [f64; 3]) -> GridPoint {
        let Frame::World { min, extent } = self else {
            unreachable!("world coordinates in a lattice frame")
        };
        [step(x[0] - min[0], *extent), step(x[1] - min[1], *extent), step(x[2] - min[2], *extent)]
    }

    /// Places a query's world coordinates on the grid.
    ///
    /// On a lattice frame a coordinate within 2^-20 of a lattice step is that step, so that the
    /// world coordinates of a stored point lead to its own grid point.
    ///
    /// # Errors
    /// [`OutsideCube`] where a coordinate is not finite or outside the cube ([V-8]).
    pub fn grid_of_query(&self, x: [f64; 3]) -> Result<GridPoint, OutsideCube> {
        let mut g = [0; 3];
        for i in 0..3 {
            let delta = self.delta(x, i);
            if !(delta >= 0.0 && delta <= self.extent()) {
                return Err(OutsideCube);
            }
            g[i] = step(delta, self.extent());
        }
        Ok(g)
    }

    /// Gives a query's way from the cube's lowest corner in grid steps, not yet rounded down:
    /// where [`Frame::grid_of_query`] gives a place this is it or the fraction of a step beyond.
    /// Outside the cube, too; infinite there if the cube has no size.
    pub fn steps_of_query(&self, x: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|i| match self.delta(x, i) {
            0.0 => 0.0,
            delta => delta / self.extent() * f64::from(GRID_MAX),
        })
    }

    /// Gives how far a query's coordinate is from the cube's least.
    fn delta(&self, x: [f64; 3], i: usize) -> f64 {
        match *self {
            Frame::World { min, .. } => x[i] - min[i],
            Frame::Lattice { scale, offset, min, .. } => {
                let steps = (x[i] - offset[i]) / scale[i];
                let whole = steps.round();
                let near = (steps - whole).abs() <= LATTICE_SNAP;
                ((if near { whole } else { steps }) - min[i] as f64) * scale[i]
            }
        }
    }

    /// Gives the world coordinates of the middle of a grid step; of the last one, the cube's face.
    pub fn world_of(&self, g: GridPoint) -> [f64; 3] {
        self.world_of_real(g.map(|v| (f64::from(v) + 0.5).min(f64::from(GRID_MAX))))
    }

    /// Gives the world coordinates of a real place on the grid, in grid steps.
    pub fn world_of_real(&self, g: [f64; 3]) -> [f64; 3] {
        let unit = self.extent() / f64::from(GRID_MAX);
        [0, 1, 2].map(|i| match *self {
            Frame::World { min, .. } => min[i] + g[i] * unit,
            Frame::Lattice { scale, offset, min, .. } => {
                min[i] as f64 * scale[i] + offset[i] + g[i] * unit
            }
        })
    }

    /// Gives the world length of one grid step.
    pub fn unit(&self) -> f64 {
        self.extent() / f64::from(GRID_MAX)
    }
}

/// Turns δ in 0…E into a coordinate: min(2^22-1, floor(δ/E·(2^22-1))), 0 if E = 0.
///
/// Floor, never round: a point on the far face would get coordinate 2^22, lose that bit in the
/// interleave and land in the opposite corner.
#[inline(always)]
fn step(delta: f64, extent: f64) -> u32 {
    // `as` saturates and maps NaN (0/0 when E = 0) to 0, which is what [D-1] asks for.
    ((delta / extent * f64::from(GRID_MAX)) as u32).min(GRID_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn n11_far_face_is_the_last_cell() {
        let f = Frame::of_lattice([0.001; 3], [0.0; 3], [0; 3], [1 << 21; 3]);
        assert_eq!(f.grid_of_lattice([1 << 21; 3]), [GRID_MAX; 3]);
        assert_eq!(f.grid_of_lattice([0; 3]), [0; 3]);
    }

    #[test]
    fn n07_zero_extent_is_coordinate_zero() {
        let f = Frame::of_lattice([0.001; 3], [5.0; 3], [7; 3], [7; 3]);
        assert_eq!(f.grid_of_lattice([7; 3]), [0; 3]);
        assert_eq!(Frame::of_world([1.0; 3], [1.0; 3]).grid_of_world([1.0; 3]), [0; 3]);
    }

    #[test]
    fn a_query_outside_the_cube_is_refused() {
        let f = Frame::of_world([0.0; 3], [2.0, 1.0, 1.0]);
        assert_eq!(f.grid_of_query([2.0, 0.0, 1.5]), Ok([GRID_MAX, 0, GRID_MAX / 4 * 3 + 2]));
        for bad in [-1e-9, 2.0000001, f64::NAN, f64::INFINITY] {
            assert_eq!(f.grid_of_query([0.0, bad, 0.0]), Err(OutsideCube));
        }
        assert_eq!(f.steps_of_query([0.0, 2.0, -2.0]), [0.0, 4194303.0, -4194303.0]);
    }

    proptest! {
        #[test]
        fn d2_offset_and_power_of_two_scale_change_no_coordinate(
            x in prop::array::uniform3(-1_000_000i64..1_000_000),
            shift in prop::array::uniform3(-1_000_000_000i64..1_000_000_000),
            k in -30i32..30,
        ) {
            let (min, max) = ([-1_000_000; 3], [1_000_000; 3]);
            let f = Frame::of_lattice([0.001, 0.01, 0.001], [0.0; 3], min, max);
            let moved = Frame::of_lattice(
                [0.001, 0.01, 0.001].map(|s: f64| s * 2f64.powi(k)),
                [500_000.0, 4.6e6, 3.0],
                [0, 1, 2].map(|i| min[i] + shift[i]),
                [0, 1, 2].map(|i| max[i] + shift[i]),
            );
            let there = [0, 1, 2].map(|i| x[i] + shift[i]);
            prop_assert_eq!(f.grid_of_lattice(x), moved.grid_of_lattice(there));
        }

        #[test]
        fn the_world_place_of_a_stored_point_leads_back_to_it(
            x in prop::array::uniform3(-2_000_000i64..2_000_000),
        ) {
            let (scale, offset) = ([0.001; 3], [512_345.25, 4_600_000.5, -3.0]);
            let f = Frame::of_lattice(scale, offset, [-2_000_000; 3], [2_000_000; 3]);
            let world = [0, 1, 2].map(|i| x[i] as f64 * scale[i] + offset[i]);
            prop_assert_eq!(f.grid_of_query(world), Ok(f.grid_of_lattice(x)));
        }
    }
}
