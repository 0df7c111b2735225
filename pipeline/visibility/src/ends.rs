//! The ends of a block's segments, and who faces whom among them.

use std::ops::Range;

use multiversion::multiversion;
use pvmap_geometry::Box3;
use pvmap_geometry::disc::{Disc, Profile};

use crate::lanes::{OUTWARD, all_bits, bits, dot, greater, mask_of};

/// Leaves of a side of a block at most: the bits of a mask.
pub const MAX_ENDS: usize = u64::BITS as usize;

/// Ends that are asked at once whom they face.
const OCTET: usize = 8;

/// Up to 64 ends, a lane each: all near or all far ends of a block's segments. Each is a surfel at
/// its centroid or at another place.
#[derive(Debug, Clone)]
pub struct Ends {
    /// Surfel ids.
    surfels: [u32; MAX_ENDS],
    n: usize,
    pub(crate) centroid: [[f32; MAX_ENDS]; 3],
    /// Each centroid and its opposite: the greatest of some are the corners of their box.
    pub(crate) corners: [[f32; 8]; MAX_ENDS],
    /// Within which nothing blocks a segment of this end: rounded inward, and squared; 0 for
    /// profile `paper`.
    pub(crate) spared: [f32; MAX_ENDS],
    pub(crate) spared2: [f64; MAX_ENDS],
    normal: [[f64; MAX_ENDS]; 3],
    /// 1 if both faces count.
    two_sided: [f64; MAX_ENDS],
    /// 1 without a normal.
    free: [f64; MAX_ENDS],
}

impl Ends {
    /// No leaves.
    pub const NONE: Ends = Ends {
        surfels: [0; MAX_ENDS],
        n: 0,
        centroid: [[0.0; MAX_ENDS]; 3],
        corners: [[0.0; 8]; MAX_ENDS],
        spared: [0.0; MAX_ENDS],
        spared2: [0.0; MAX_ENDS],
        normal: [[0.0; MAX_ENDS]; 3],
        two_sided: [0.0; MAX_ENDS],
        free: [0.0; MAX_ENDS],
    };

    /// Loads consecutive surfels, 1 to 64. Lanes beyond them keep what they held.
    pub fn load(&mut self, discs: &[Disc], surfels: Range<u32>, profile: Profile) {
        let ends = surfels.map(|id| (id, discs[id as usize].centroid));
        self.load_at(discs, ends, profile);
    }

    /// Loads surfels, 1 to 64, each as if its centroid were at a place of the grid.
    pub fn load_at(
        &mut self,
        discs: &[Disc],
        ends: impl Iterator<Item = (u32, [i32; 3])>,
        profile: Profile,
    ) {
        self.n = 0;
        for (k, (id, place)) in ends.enumerate() {
            let disc = &discs[id as usize];
            self.surfels[k] = id;
            self.n = k + 1;
            for i in 0..3 {
                let c = place[i] as f32;
                self.centroid[i][k] = c;
                (self.corners[k][i], self.corners[k][i + 3]) = (c, -c);
                self.normal[i][k] = f64::from(disc.normal[i]);
            }
            self.two_sided[k] = f64::from(u8::from(disc.two_sided));
            self.free[k] = f64::from(u8::from(disc.normal == [0; 3]));
            self.spared2[k] = match profile {
                Profile::Patch | Profile::Oriented => disc.radius2 as f64,
                Profile::Paper => 0.0,
            };
            self.spared[k] = self.spared2[k].sqrt() as f32 / OUTWARD;
        }
    }

    /// Counts the leaves.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// Gives the box of the centroids of some lanes, a bit each, at least one.
    pub fn box_of(&self, lanes: u64) -> Box3 {
        let mut corners = [f32::NEG_INFINITY; 8];
        for lane in bits(lanes) {
            for (corner, of_lane) in corners.iter_mut().zip(&self.corners[lane]) {
                *corner = greater(*corner, *of_lane);
            }
        }
        let [x, y, z, low_x, low_y, low_z, ..] = corners.map(|v| v as i32);
        Box3 { min: [-low_x, -low_y, -low_z], max: [x, y, z] }
    }

    /// Gives the surfel of a lane.
    pub(crate) fn surfel(&self, k: usize) -> u32 {
        self.surfels[k]
    }

    /// Gives the disc of a lane, its centroid where the end is.
    pub(crate) fn disc(&self, k: usize, discs: &[Disc]) -> Disc {
        // Whole numbers below 2^24.
        let centroid = [0, 1, 2].map(|i| self.centroid[i][k] as i32);
        Disc { centroid, ..discs[self.surfels[k] as usize] }
    }

    /// Finds who faces whom among these ends, the rows, and others, the columns: for each row, a
    /// bit a column; both are loaded. Exact: every number is below 2^40. Source: DESIGN.md [V-1].
    pub fn faces(&self, columns: &Ends, open: &mut Vec<u64>) {
        open.clear();
        open.resize(self.n, 0);
        faces(self, columns, open);
    }
}

#[multiversion(targets = "simd")]
fn faces(rows: &Ends, columns: &Ends, open: &mut [u64]) {
    let [bx, by, bz] = &columns.centroid;
    let [nx, ny, nz] = &columns.normal;
    for from in (0..columns.n).step_by(OCTET) {
        let (bx, by, bz) = (octet(bx, from), octet(by, from), octet(bz, from));
        let (nx, ny, nz) = (octet(nx, from), octet(ny, from), octet(nz, from));
        let (two_sided, free) = (octet(&columns.two_sided, from), octet(&columns.free, from));
        for (row, open) in open.iter_mut().enumerate() {
            let a = [0, 1, 2].map(|i| f64::from(rows.centroid[i][row]));
            let n = [0, 1, 2].map(|i| rows.normal[i][row]);
            let mut facing = [0; OCTET];
            for k in 0..OCTET {
                let d = [f64::from(bx[k]) - a[0], f64::from(by[k]) - a[1], f64::from(bz[k]) - a[2]];
                let near = dot(n, d);
                let far = nx[k] * d[0] + ny[k] * d[1] + nz[k] * d[2];
                let looks = greater(near, rows.two_sided[row] * near.abs()) + rows.free[row] > 0.0;
                let back = greater(-far, two_sided[k] * far.abs()) + free[k] > 0.0;
                facing[k] = all_bits(looks & back & (dot(d, d) > 0.0));
            }
            *open |= mask_of(&facing) << from;
        }
    }
    let known = u64::MAX >> (MAX_ENDS - columns.n);
    for open in open {
        *open &= known;
    }
}

/// Gives eight lanes.
#[inline(always)]
fn octet<T: Copy + Default>(lanes: &[T; MAX_ENDS], from: usize) -> [T; OCTET] {
    let mut some = [T::default(); OCTET];
    some.copy_from_slice(&lanes[from..from + OCTET]);
    some
}
