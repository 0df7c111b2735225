//! The points between two points. Source: Goradia et al. 2007 §3, its tests 2 and 3.

use std::ops::ControlFlow;

use pvmap_geometry::disc::{Disc, Profile, blocks, segment_meets};
use pvmap_geometry::normal::{Normal, strays};
use pvmap_geometry::{Box3, morton};
use pvmap_vmap::{FormatError, OctreeView};

use super::cells::{Cell, Cells, FEW_POINTS};
use super::{ExactOptions, StoredPoint, Work};

/// Lists the occluders between two ends, the first K in Morton order, and what finding them took.
///
/// The line is traversed through the cells of the octree, from the root down. The order is that
/// of the octree: whoever asks, from whichever end, reads the same points.
pub(super) fn find(
    octree: &OctreeView<'_>,
    ends: &[Disc; 2],
    options: ExactOptions,
) -> Result<(Vec<u64>, Work), FormatError> {
    let [p, q] = ends;
    let mut cells = Cells::new(octree);
    let mut open: Vec<Cell> = cells.root().into_iter().collect();
    let mut found = Occluders::new(options.k.get());
    while let Some(cell) = open.pop() {
        if is_worth_dividing(&cell, options.delta_grid) {
            cells.divide(&cell, &mut open, |part| is_near(ends, part, options.delta_grid))?;
            continue;
        }
        let is_met = |c: &StoredPoint| blocks(Profile::Patch, p, q, &c.disc(p.radius2));
        let test = |c: &StoredPoint| match is_met(c) && !is_of_an_end(ends, c, options.delta_grid) {
            true => found.note(c),
            false => ControlFlow::Continue(()),
        };
        if cells.each(&cell, test)?.is_break() {
            break;
        }
    }
    Ok((found.indices, cells.work()))
}

/// Says whether a cell is better divided than searched: in one no wider than Δ nearly every point
/// is as near to the segment as the cell is.
fn is_worth_dividing(cell: &Cell, delta_grid: u32) -> bool {
    cell.n_points() > FEW_POINTS && cell.level < morton::MAX_LEVEL && cell.side_grid() > delta_grid
}

/// Says whether a point in a closed box may be within Δ of a place of the segment: whether the
/// closed segment touches the box grown by Δ, decided in integers. No occluder is missed: it is
/// within Δ of some x on the segment, on each axis too, so its own box so grown holds x. Edges
/// and corners belong to every box that touches them.
fn is_near([p, q]: &[Disc; 2], part: &Box3, delta_grid: u32) -> bool {
    // Δ and the corners are below 2^23, so the sum fits.
    segment_meets(p.centroid, q.centroid, &part.grown(delta_grid as i32))
}

/// The length of a quantised normal, but for its rounding.
const NORMAL_LENGTH: i128 = 1 << 14;

/// Says whether a point whose tangent plane the segment crosses belongs to the surface of an end:
/// noise put it above the end, and the segment passes it from behind on its way out.
///
/// With x the crossing: both know their side, their normals are at most 30° apart, the segment goes
/// the way that c looks if one goes from the end to the other, x is no nearer to the other, and
/// within Δ of the end's tangent plane. A surface that hides an end from the other is entered
/// through its front before it is left.
fn is_of_an_end([p, q]: &[Disc; 2], c: &StoredPoint, delta_grid: u32) -> bool {
    let d = difference(q.centroid, p.centroid);
    let s = dot(c.normal, d);
    let h = dot(c.normal, difference(c.g.map(|v| v as i32), p.centroid));
    // x = p + (h/s)·d: so far from the end, of |s| from there to the other.
    let (end, along) = if s > 0 { (p, h) } else { (q, h - s) };
    let knows_side = c.oriented && !end.two_sided && end.normal != [0; 3];
    if !knows_side || 2 * along > s.abs() || strays(c.normal, end.normal.map(i64::from)) {
        return false;
    }
    // Dots are below 2^38, so both sides below 2^77.
    let off_plane = i128::from(along) * i128::from(dot(end.normal, d).abs());
    off_plane <= i128::from(s.abs()) * i128::from(delta_grid) * NORMAL_LENGTH
}

fn difference(a: [i32; 3], b: [i32; 3]) -> [i64; 3] {
    [0, 1, 2].map(|i| i64::from(a[i]) - i64::from(b[i]))
}

fn dot(n: Normal, d: [i64; 3]) -> i64 {
    (0..3).map(|i| i64::from(n[i]) * d[i]).sum()
}

/// Occluders met so far, a point of each place.
#[derive(Debug)]
struct Occluders {
    k: usize,
    indices: Vec<u64>,
    /// The Morton code of the last one, and which of its eight places have an occluder. Points of
    /// one code are met one after another, so that no place before them comes again.
    code: u64,
    places: u8,
}

impl Occluders {
    fn new(k: u32) -> Occluders {
        Occluders { k: k as usize, indices: Vec::new(), code: u64::MAX, places: 0 }
    }

    /// Notes an occluder unless one of its place is known; ends with the K-th.
    fn note(&mut self, c: &StoredPoint) -> ControlFlow<()> {
        let code = morton::encode(c.g);
        if code != self.code {
            (self.code, self.places) = (code, 0);
        }
        let place = 1 << (c.g[0] & 1 | (c.g[1] & 1) << 1 | (c.g[2] & 1) << 2);
        if self.places & place == 0 {
            self.places |= place;
            self.indices.push(c.index);
        }
        if self.indices.len() < self.k { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    }
}
