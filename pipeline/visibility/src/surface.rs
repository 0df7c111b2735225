//! Curved surfaces that neighbouring surfels lie along.

use crate::lanes::WIDER;

/// Steepest slope of a surface and of its surfels.
const STEEPEST: f64 = 4.0;
/// Steps of a side of the grid.
const GRID: f64 = (1u32 << 22) as f64;

/// A surfel along the axes u, v and w of a sheet, from its middle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patch {
    pub(crate) centroid: [f64; 3],
    /// Of its plane, along u and v.
    pub(crate) slope: [f64; 2],
    pub(crate) radius: f64,
}

impl Patch {
    /// Makes a patch; of a plane that is too steep, none.
    pub(crate) fn new(centroid: [f64; 3], normal: [f64; 3], radius: f64) -> Option<Patch> {
        let slope = [-normal[0] / normal[2], -normal[1] / normal[2]];
        let is_flat = slope.iter().all(|v| v.abs() <= STEEPEST);
        is_flat.then_some(Patch { centroid, slope, radius })
    }
}

/// A surface that surfels lie along: x_w = o + p·x_u + q·x_v + A·x_u² + B·x_u·x_v + C·x_v².
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface {
    /// o.
    offset: f32,
    /// p and q.
    slope: [f32; 2],
    /// A, B and C.
    bend: [f32; 3],
    /// A place at which a surfel can block is at most so high over the surface or so deep under
    /// it, in steps, and what heights can be off by in f32 is added.
    pub(crate) reach: f32,
}

impl Surface {
    /// Fits a plane to surfels.
    pub(crate) fn plane(patches: &[Patch], side: f64) -> Option<Surface> {
        fit(patches, 3, side)
    }

    /// Fits a surface with all terms to surfels; `side` is about that of a surfel.
    pub(crate) fn curved(patches: &[Patch], side: f64) -> Option<Surface> {
        fit(patches, 6, side)
    }

    /// Gives the height of a place over it.
    #[inline(always)]
    pub(crate) fn height(&self, u: f32, v: f32, w: f32) -> f32 {
        let [p, q] = self.slope;
        w - self.offset - (p * u + q * v) - self.bent(u, v)
    }

    /// Gives A·u² + B·u·v + C·v².
    #[inline(always)]
    pub(crate) fn bent(&self, u: f32, v: f32) -> f32 {
        let [a, b, c] = self.bend;
        (a * u + b * v) * u + c * v * v
    }

    /// Measures how far from it its surfels can block.
    ///
    /// Over a disc of radius R around c, the height over the surface changes from that of c by at
    /// most R times the difference of the slopes at c, and R² times the greatest bend.
    ///
    /// Let G be 1 + |p| + |q| + (|A| + |B| + |C|)·2^22, so that all terms of a height are below
    /// G·2^22 and a step changes it by less than 2·G. A height in f32 takes a dozen roundings, one
    /// along a segment some hundred of a quarter step times G: less than 30·G steps. Spared radii
    /// are rounded inward by less than 2^-19 of at most 2^23 steps, which is 32·G. The 64·G that
    /// are added cover both.
    fn reaching(mut self, patches: &[Patch]) -> Surface {
        let [a, b, c] = self.bend.map(f64::from);
        let [p, q] = self.slope.map(f64::from);
        let bend = (a.abs() + b.abs() / 2.0).max(c.abs() + b.abs() / 2.0);
        let mut most = 0.0f64;
        for &Patch { centroid: [u, v, w], slope, radius } in patches {
            let over = f64::from(self.offset) + p * u + q * v + a * u * u + b * u * v + c * v * v;
            let tilt = [p + 2.0 * a * u + b * v - slope[0], q + b * u + 2.0 * c * v - slope[1]];
            let change = radius * tilt[0].hypot(tilt[1]) + radius * radius * bend;
            most = most.max((w - over).abs() + change);
        }
        let size = (1.0 + p.abs() + q.abs() + (a.abs() + b.abs() + c.abs()) * GRID) * GRID;
        self.reach = (most + 16.0 + size / f64::from(1 << 16)) as f32 * WIDER;
        self
    }
}

/// Fits 3 terms (a plane) or 6 to the centroids and the slopes of surfels by least squares; a slope
/// counts as much as the height that it makes over `side`.
fn fit(patches: &[Patch], n_terms: usize, side: f64) -> Option<Surface> {
    let mut sums = [[0.0; 7]; 6];
    let mut add = |row: [f64; 7]| {
        for i in 0..n_terms {
            for j in 0..n_terms {
                sums[i][j] += row[i] * row[j];
            }
            sums[i][6] += row[i] * row[6];
        }
    };
    for Patch { centroid, slope, .. } in patches {
        let [u, v, w] = centroid.map(|c| c / side);
        add([1.0, u, v, u * u, u * v, v * v, w]);
        add([0.0, 1.0, 0.0, 2.0 * u, v, 0.0, slope[0]]);
        add([0.0, 0.0, 1.0, 0.0, u, 2.0 * v, slope[1]]);
    }
    let [o, p, q, a, b, c] = solved(sums, n_terms)?;
    let surface = Surface {
        offset: (o * side) as f32,
        slope: [p as f32, q as f32],
        bend: [a, b, c].map(|v| (v / side) as f32),
        reach: 0.0,
    };
    let surface = surface.reaching(patches);
    let is_flat = surface.slope.iter().all(|v| f64::from(v.abs()) <= STEEPEST);
    (is_flat && surface.reach.is_finite()).then_some(surface)
}

/// Solves `n` equations by elimination; each row ends in its right side.
fn solved(mut rows: [[f64; 7]; 6], n: usize) -> Option<[f64; 6]> {
    for i in 0..n {
        let best = (i..n).max_by(|&j, &k| rows[j][i].abs().total_cmp(&rows[k][i].abs()))?;
        rows.swap(i, best);
        if rows[i][i].abs() < 1e-9 {
            return None;
        }
        for j in (0..n).filter(|&j| j != i) {
            let factor = rows[j][i] / rows[i][i];
            for k in i..7 {
                rows[j][k] -= factor * rows[i][k];
            }
        }
    }
    let mut solution = [0.0; 6];
    for i in 0..n {
        solution[i] = rows[i][6] / rows[i][i];
    }
    Some(solution)
}
