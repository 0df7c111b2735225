//! The lanes of the kernel: loops of eight without branches, which let the compiler use what the
//! processor has. What is here never decides alone: it culls what provably cannot block, and says of
//! a segment that a disc surely blocks it, surely does not, or that floats do not know.
//!
//! The unit is a tile: eight rows, the near ends, times eight columns, the far ends. Discs that cannot
//! meet the tile are culled first, then for each row those that cannot meet its segments (`cull`);
//! each disc left meets the eight segments of the row at once (`pierce_patch`, `pierce_paper`).
//!
//! Planes are exact in f64: n·c and its sums stay below 2^40. The crossing x = c_a + t·d has one
//! rounded division and, an axis, one product and one sum of numbers below 2^24; then it is taken
//! from a corner or a centroid, another sum. So each component is off by less than 2^-27 =: ε (five
//! roundings of at most 2^-30). For |x - c_k| near R the square is then off by less than
//! 2·√3·ε·R + 2^-50·R² < 2^-24·(R + 1) as R < 2^23; `margin` takes four times that. So it is with
//! the way from an end, t·|d| or (1 - t)·|d|, which is off by less than 2^-29: both shares have
//! relative errors of a few 2^-53 or absolute ones of 2^-53, and |d| < 2^24.

use multiversion::multiversion;
use pvmap_geometry::Box3;
use pvmap_geometry::disc::{Disc, Profile};

use crate::kernel::Counts;

/// How far off a component of a crossing can be.
const EPSILON: f64 = 1.0 / (1u64 << 27) as f64;

/// Rows and columns of a tile, and discs that are culled together.
pub const WIDTH: usize = 8;

/// How far off a squared distance near `radius2` can be.
#[inline(always)]
fn margin(radius2: f64) -> f64 {
    (radius2.sqrt() + 1.0) / (1u64 << 22) as f64
}

/// Discs tested between two looks at whether anything is still open.
const BETWEEN_LOOKS: usize = 4;

/// Where one end of segments may be: a box by its middle and its half sides.
#[derive(Debug, Clone, Copy)]
struct Span {
    middle: [f64; 3],
    half: [f64; 3],
}

impl Span {
    /// Spans a box.
    fn new(low: [f64; 3], high: [f64; 3]) -> Span {
        let middle = [0, 1, 2].map(|i| (low[i] + high[i]) / 2.0);
        let half = [0, 1, 2].map(|i| (high[i] - low[i]) / 2.0);
        Span { middle, half }
    }

    /// Spans a single place.
    #[inline(always)]
    fn at(place: [f64; 3]) -> Span {
        Span { middle: place, half: [0.0; 3] }
    }
}

/// Up to eight leaves in a row: the near or the far ends of a tile's segments, a lane each.
#[derive(Debug, Clone)]
pub struct Ends {
    /// Surfel id of the first; the others follow.
    first: u32,
    n: usize,
    normal: [[f64; WIDTH]; 3],
    /// 1 if both faces count.
    two_sided: [f64; WIDTH],
    /// 1 without a normal.
    free: [f64; WIDTH],
    centroid: [[f64; WIDTH]; 3],
    radius2: [f64; WIDTH],
    margin: [f64; WIDTH],
    /// Where the centroids are.
    span: Span,
}

impl Ends {
    /// Loads at most eight consecutive surfels, at least one.
    pub fn new(discs: &[Disc], surfels: std::ops::Range<u32>) -> Ends {
        let mut ends = Ends {
            first: surfels.start,
            n: surfels.len(),
            normal: [[0.0; WIDTH]; 3],
            two_sided: [0.0; WIDTH],
            free: [0.0; WIDTH],
            centroid: [[0.0; WIDTH]; 3],
            radius2: [0.0; WIDTH],
            margin: [0.0; WIDTH],
            span: Span::at([0.0; 3]),
        };
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for (k, disc) in discs[surfels.start as usize..surfels.end as usize].iter().enumerate() {
            for i in 0..3 {
                let c = f64::from(disc.centroid[i]);
                (low[i], high[i]) = (less(low[i], c), greater(high[i], c));
                ends.normal[i][k] = f64::from(disc.normal[i]);
                ends.centroid[i][k] = c;
            }
            ends.two_sided[k] = f64::from(u8::from(disc.two_sided));
            ends.free[k] = f64::from(u8::from(disc.normal == [0; 3]));
            ends.radius2[k] = disc.radius2 as f64;
            ends.margin[k] = margin(ends.radius2[k]);
        }
        ends.span = Span::new(low, high);
        ends
    }

    /// Gives the index of a leaf's surfel.
    pub(crate) fn surfel(&self, k: usize) -> usize {
        self.first as usize + k
    }

    /// Finds who faces whom among rows and columns: for each row, a bit a column. Exact.
    /// Source: DESIGN.md [V-1].
    pub fn faces(&self, columns: &Ends) -> [u64; WIDTH] {
        faces(self, columns)
    }
}

/// Rows times columns, and which segments are open: for each row, a bit a column.
#[derive(Debug)]
pub struct Tile<'a> {
    /// The near ends.
    pub rows: &'a Ends,
    /// The far ends.
    pub columns: &'a Ends,
    /// Segments that nothing has blocked yet.
    pub open: [u64; WIDTH],
}

impl Tile<'_> {
    /// Counts the open segments.
    pub fn n_open(&self) -> u64 {
        self.open.iter().map(|lanes| u64::from(lanes.count_ones())).sum()
    }
}

/// A disc as a row of segments meets it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plate {
    normal: [f64; 3],
    /// n·c_k.
    offset: f64,
    centroid: [f64; 3],
    radius2: f64,
    margin: f64,
    /// The patch box, or the cell for profile `paper`.
    low: [f64; 3],
    high: [f64; 3],
}

impl Plate {
    /// Loads a disc.
    pub(crate) fn new(disc: &Disc) -> Plate {
        let normal = disc.normal.map(f64::from);
        let centroid = disc.centroid.map(f64::from);
        let radius2 = disc.radius2 as f64;
        Plate {
            normal,
            offset: dot(normal, centroid),
            centroid,
            radius2,
            margin: margin(radius2),
            low: disc.limit.min.map(f64::from),
            high: disc.limit.max.map(f64::from),
        }
    }
}

/// What culling asks of eight discs, a lane each. A lane without a disc has a zero normal and is
/// always culled.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Chunk {
    normal: [[f64; WIDTH]; 3],
    offset: [f64; WIDTH],
    /// The box of all places at which the disc can block, a step larger than it is: more than the
    /// floats can be off by.
    low: [[f64; WIDTH]; 3],
    high: [[f64; WIDTH]; 3],
}

impl Chunk {
    pub(crate) const EMPTY: Chunk = Chunk {
        normal: [[0.0; WIDTH]; 3],
        offset: [0.0; WIDTH],
        low: [[0.0; WIDTH]; 3],
        high: [[0.0; WIDTH]; 3],
    };

    /// Puts a disc into a lane, with the box of all places at which it can block.
    pub(crate) fn set(&mut self, k: usize, plate: &Plate, reach: &Box3) {
        for i in 0..3 {
            self.normal[i][k] = plate.normal[i];
            self.low[i][k] = f64::from(reach.min[i]) - 1.0;
            self.high[i][k] = f64::from(reach.max[i]) + 1.0;
        }
        self.offset[k] = plate.offset;
    }

    /// Copies a lane of another chunk.
    #[inline(always)]
    fn copy(&mut self, to: usize, other: &Chunk, from: usize) {
        for i in 0..3 {
            self.normal[i][to] = other.normal[i][from];
            self.low[i][to] = other.low[i][from];
            self.high[i][to] = other.high[i][from];
        }
        self.offset[to] = other.offset[from];
    }
}

/// What a tile keeps of a list of discs.
#[derive(Debug, Default)]
pub(crate) struct Work {
    /// The discs that may block something of the tile, and their positions in the list.
    chunks: Vec<Chunk>,
    pub(crate) positions: Vec<u32>,
    /// Room for the positions of the discs that may block something of a row.
    near: Vec<u32>,
    pub(crate) doubts: Vec<Doubt>,
}

impl Work {
    /// Lists the positions of the discs of the tile that may block a segment of a row; counts them.
    #[inline(always)]
    fn keep_for_row(&mut self, row: &Near, columns: &Ends) -> usize {
        let span = Span::at(row.a);
        let mut n = 0;
        self.near.resize(self.chunks.len() * WIDTH, 0);
        for (chunk, positions) in self.chunks.iter().zip(self.positions.chunks(WIDTH)) {
            let kept = cull(&span, &columns.span, chunk);
            for (&position, kept) in positions.iter().zip(kept) {
                self.near[n] = position;
                n += (kept & 1) as usize;
            }
        }
        n
    }

    /// Takes over the discs of a list that may block a segment between two boxes.
    #[inline(always)]
    fn keep(&mut self, list: &[Chunk], a: &Span, b: &Span) {
        self.chunks.clear();
        self.positions.clear();
        self.doubts.clear();
        for (i, chunk) in list.iter().enumerate() {
            for k in bits(mask_of(&cull(a, b, chunk))) {
                let to = self.positions.len() % WIDTH;
                if to == 0 {
                    self.chunks.push(Chunk::EMPTY);
                }
                if let Some(kept) = self.chunks.last_mut() {
                    kept.copy(to, chunk, k);
                }
                self.positions.push((i * WIDTH + k) as u32);
            }
        }
    }
}

/// A row of the tile, and the columns of which floats do not know whether a disc blocks them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Doubt {
    pub(crate) row: usize,
    pub(crate) lanes: u64,
}

/// Tests the open segments of a tile against a list of discs: culls the list for the tile, then for
/// each row. Gives the position of the disc that blocked last.
#[multiversion(targets = "simd")]
pub(crate) fn fire(
    list: &[Chunk],
    plates: &[Plate],
    profile: Profile,
    tile: &mut Tile<'_>,
    work: &mut Work,
    counts: &mut Counts,
) -> Option<u32> {
    let Tile { rows, columns, open } = tile;
    work.keep(list, &rows.span, &columns.span);
    let mut last = None;
    for (row, open) in open.iter_mut().enumerate() {
        if *open == 0 {
            continue;
        }
        let near_row = Near::new(rows, row, columns);
        let n_near = work.keep_for_row(&near_row, columns);
        let mut hits = Hits::default();
        for some in work.near[..n_near].chunks(BETWEEN_LOOKS) {
            for &position in some {
                let plate = &plates[position as usize];
                match profile {
                    Profile::Patch => pierce_patch(plate, position, &near_row, columns, &mut hits),
                    Profile::Paper => pierce_paper(plate, position, &near_row, columns, &mut hits),
                }
            }
            counts.n_tests += some.len() as u64;
            if *open & !mask_of(&hits.sure) == 0 {
                break;
            }
        }
        let (sure, maybe) = (mask_of(&hits.sure), mask_of(&hits.maybe));
        for k in bits(sure & *open).take(1) {
            last = Some(hits.blocker[k] as u32);
        }
        *open &= !sure;
        if maybe & *open != 0 {
            work.doubts.push(Doubt { row, lanes: maybe & *open });
        }
    }
    last
}

/// A row of a tile: its near end, and the directions to the columns.
struct Near {
    a: [f64; 3],
    radius2: f64,
    margin: f64,
    d: [[f64; WIDTH]; 3],
    /// |d|².
    d2: [f64; WIDTH],
}

impl Near {
    #[inline(always)]
    fn new(rows: &Ends, row: usize, columns: &Ends) -> Near {
        let a = at(&rows.centroid, row);
        let [bx, by, bz] = &columns.centroid;
        let (mut d, mut d2) = ([[0.0; WIDTH]; 3], [0.0; WIDTH]);
        let [dx, dy, dz] = &mut d;
        for k in 0..WIDTH {
            (dx[k], dy[k], dz[k]) = (bx[k] - a[0], by[k] - a[1], bz[k] - a[2]);
            d2[k] = dot([dx[k], dy[k], dz[k]], [dx[k], dy[k], dz[k]]);
        }
        Near { a, radius2: rows.radius2[row], margin: rows.margin[row], d, d2 }
    }
}

/// What discs did to the segments of a row, a lane each.
#[derive(Debug, Default)]
struct Hits {
    /// All bits set where a disc surely blocks.
    sure: [u64; WIDTH],
    /// All bits set where a disc blocks or floats do not know.
    maybe: [u64; WIDTH],
    /// Position of a disc that surely blocks.
    blocker: [u64; WIDTH],
}

#[multiversion(targets = "simd")]
fn faces(rows: &Ends, columns: &Ends) -> [u64; WIDTH] {
    let mut masks = [0; WIDTH];
    let [bx, by, bz] = &columns.centroid;
    let [nx, ny, nz] = &columns.normal;
    for (row, mask) in masks.iter_mut().enumerate().take(rows.n) {
        let (a, n) = (at(&rows.centroid, row), at(&rows.normal, row));
        let mut facing = [0; WIDTH];
        for k in 0..WIDTH {
            let d = [bx[k] - a[0], by[k] - a[1], bz[k] - a[2]];
            let near = dot(n, d);
            let far = nx[k] * d[0] + ny[k] * d[1] + nz[k] * d[2];
            let looks = greater(near, rows.two_sided[row] * near.abs()) + rows.free[row] > 0.0;
            let back = greater(-far, columns.two_sided[k] * far.abs()) + columns.free[k] > 0.0;
            facing[k] = all_bits(looks & back & (dot(d, d) > 0.0));
        }
        *mask = mask_of(&facing) & (u64::MAX >> (u64::BITS as usize - columns.n));
    }
    masks
}

/// Finds which discs of a chunk may block a segment between two boxes, a bit each.
///
/// A disc's plane cuts such a segment at a share t that is bounded by how far the boxes are from
/// the plane, and so is the place of the cut, an axis at a time; it has to meet the disc's box.
#[inline(always)]
fn cull(a: &Span, b: &Span, chunk: &Chunk) -> [u64; WIDTH] {
    let [nx, ny, nz] = &chunk.normal;
    let mut kept = [0; WIDTH];
    for k in 0..WIDTH {
        let n = [nx[k], ny[k], nz[k]];
        let size = [n[0].abs(), n[1].abs(), n[2].abs()];
        let (here, there) =
            (dot(n, a.middle) - chunk.offset[k], dot(n, b.middle) - chunk.offset[k]);
        let (spread_a, spread_b) = (dot(size, a.half), dot(size, b.half));
        // From above to below, or the other way; if both can be, either bounds t by 0 and 1.
        let down = (here + spread_a > 0.0) & (there - spread_b < 0.0);
        let up = (here - spread_a < 0.0) & (there + spread_b > 0.0);
        let (here, there) = if down { (here, there) } else { (-here, -there) };
        let (least, most) = (greater(here - spread_a, 0.0), here + spread_a);
        let t0 = least / (least - (there - spread_b));
        let t1 = most / (most - less(there + spread_b, 0.0));
        let mut meets = down | up;
        for i in 0..3 {
            let (low, high) = (a.middle[i] - a.half[i], a.middle[i] + a.half[i]);
            let (to_low, to_high) = (b.middle[i] - b.half[i] - low, b.middle[i] + b.half[i] - high);
            let (low0, low1) = (low + t0 * to_low, low + t1 * to_low);
            let (high0, high1) = (high + t0 * to_high, high + t1 * to_high);
            meets &=
                (less(low0, low1) <= chunk.high[i][k]) & (greater(high0, high1) >= chunk.low[i][k]);
        }
        kept[k] = all_bits(meets);
    }
    kept
}

/// Tests one patch against the segments of a row.
#[inline(always)]
fn pierce_patch(plate: &Plate, position: u32, row: &Near, columns: &Ends, hits: &mut Hits) {
    let Plate { normal, offset, centroid: c, radius2, margin, low, high } = *plate;
    let a = row.a;
    let here = dot(normal, a) - offset;
    let [bx, by, bz] = &columns.centroid;
    let [dx, dy, dz] = &row.d;
    for k in 0..WIDTH {
        let there = dot(normal, [bx[k], by[k], bz[k]]) - offset;
        // Where the signs agree t is no share of the segment, or NaN, and never is.
        let t = here / (here - there);
        let x = [a[0] + t * dx[k], a[1] + t * dy[k], a[2] + t * dz[k]];
        let v = [x[0] - c[0], x[1] - c[1], x[2] - c[2]];
        let inside = radius2 - dot(v, v);
        let boxed = less(
            less(less(x[0] - low[0], high[0] - x[0]), less(x[1] - low[1], high[1] - x[1])),
            less(x[2] - low[2], high[2] - x[2]),
        );
        let rest = 1.0 - t;
        let from_a = t * t * row.d2[k] - row.radius2;
        let from_b = rest * rest * row.d2[k] - columns.radius2[k];
        let margin_b = columns.margin[k];
        let crosses = here * there < 0.0;
        let maybe = crosses
            & (inside >= -margin)
            & (boxed >= -EPSILON)
            & (from_a >= -row.margin)
            & (from_b >= -margin_b);
        let sure = maybe
            & (inside > margin)
            & (boxed > EPSILON)
            & (from_a > row.margin)
            & (from_b > margin_b);
        hits.maybe[k] |= all_bits(maybe);
        hits.sure[k] |= all_bits(sure);
        hits.blocker[k] = if sure { position.into() } else { hits.blocker[k] };
    }
}

/// Tests one disc of profile `paper` against the segments of a row. Whether a segment meets the
/// cell is exact: its six separating axes stay below 2^50.
#[inline(always)]
fn pierce_paper(plate: &Plate, position: u32, row: &Near, columns: &Ends, hits: &mut Hits) {
    let Plate { normal, offset, centroid: c, radius2, margin, low, high } = *plate;
    let a = row.a;
    let here = dot(normal, a) - offset;
    // Twice the way from the cell's middle to a, and the cell's sides.
    let m = [
        2.0 * a[0] - low[0] - high[0],
        2.0 * a[1] - low[1] - high[1],
        2.0 * a[2] - low[2] - high[2],
    ];
    let side = [high[0] - low[0], high[1] - low[1], high[2] - low[2]];
    let [bx, by, bz] = &columns.centroid;
    let [dx, dy, dz] = &row.d;
    for k in 0..WIDTH {
        let there = dot(normal, [bx[k], by[k], bz[k]]) - offset;
        let t = here / (here - there);
        let d = [dx[k], dy[k], dz[k]];
        let v = [a[0] + t * d[0] - c[0], a[1] + t * d[1] - c[1], a[2] + t * d[2] - c[2]];
        let inside = radius2 - dot(v, v);
        let size = [d[0].abs(), d[1].abs(), d[2].abs()];
        let u = [m[0] + d[0], m[1] + d[1], m[2] + d[2]];
        let meets = (u[0].abs() <= side[0] + size[0])
            & (u[1].abs() <= side[1] + size[1])
            & (u[2].abs() <= side[2] + size[2])
            & ((u[1] * d[2] - u[2] * d[1]).abs() <= side[1] * size[2] + side[2] * size[1])
            & ((u[2] * d[0] - u[0] * d[2]).abs() <= side[2] * size[0] + side[0] * size[2])
            & ((u[0] * d[1] - u[1] * d[0]).abs() <= side[0] * size[1] + side[1] * size[0]);
        let crosses = (here * there < 0.0) & meets;
        let maybe = crosses & (inside >= -margin);
        let sure = crosses & (inside > margin);
        hits.maybe[k] |= all_bits(maybe);
        hits.sure[k] |= all_bits(sure);
        hits.blocker[k] = if sure { position.into() } else { hits.blocker[k] };
    }
}

/// Walks the bits of a mask, lowest first.
pub(crate) fn bits(mut mask: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let k = mask.trailing_zeros() as usize;
        mask &= mask.wrapping_sub(1);
        (k < 64).then_some(k)
    })
}

#[inline(always)]
fn dot(u: [f64; 3], v: [f64; 3]) -> f64 {
    u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
}

#[inline(always)]
pub(crate) fn greater(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[inline(always)]
pub(crate) fn less(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// Packs lanes of all bits or none into a mask, the first lowest.
#[inline(always)]
pub(crate) fn mask_of(lanes: &[u64; WIDTH]) -> u64 {
    let mut mask = 0;
    for (k, lane) in lanes.iter().enumerate() {
        mask |= lane & (1 << k);
    }
    mask
}

/// Gives all bits set for true.
#[inline(always)]
pub(crate) fn all_bits(flag: bool) -> u64 {
    if flag { u64::MAX } else { 0 }
}

/// Gives a lane of a vector of lanes.
#[inline(always)]
fn at(v: &[[f64; WIDTH]; 3], k: usize) -> [f64; 3] {
    [v[0][k], v[1][k], v[2][k]]
}
