//! Segments in packets of sixteen, and what discs do to them. What is here never decides alone: it
//! throws away what provably does not block, and says of a segment that a disc surely blocks it,
//! surely does not, or that floats do not know.
//!
//! A list of discs meets a packet in three steps, each of which sees less than the one before:
//! 1. `cull`, sixteen discs at a time: can the disc block anything between two boxes?
//! 2. `sift`, one disc and sixteen segments in f32: a test without division of what may block.
//! 3. `pierce`, one disc and eight segments in f64.
//!
//! **The bound of `cull`.** Normals are scaled to length 1; places are below 2^22, boxes below
//! 2^24, so all are exact in f32. A distance n·x - n·c is off by at most 3·√3·2^-2 from its
//! products, 2^-1 from the stored n·c and 1 from the difference, the spread of a box by 1: together
//! less than `SLACK` steps. The share t is then off by less than 5·2^-24 of its size and so is the
//! place of the cut, by 5·2^-2 steps, and by 2^-1 from its own product and sum: again less than
//! `SLACK`.
//!
//! **The bound of `sift`.** Let p and q be the ends and c the disc's centroid, n its normal scaled
//! to length 1, M the largest |p - c| or |q - c| along an axis in the packet. Differences of grid
//! coordinates are exact. With P = n·(p - c) and Q = n·(q - c), each a sum of three rounded
//! products, an error is at most 3·2^-24·√3·M < 2^-21·M =: δ. The segment meets the plane at x with
//! x - c = e/w, e = P·(q - c) - Q·(p - c), w = P - Q. An axis of e is off by 2·M·δ from P and Q and
//! by at most 7·2^-24·M² from its own roundings, so |e| by less than 2^-18·M²; w is off by less
//! than 4·δ. So a segment that the disc blocks passes all of:
//! - P·Q < 2·δ·M: it crosses the plane;
//! - |e| ≤ R·(|w| + 4·δ) + 2^-18·M²: it does so on the disc;
//! - R_a·(|w| - 4·δ) ≤ (|P| + δ)·D, with D at least the length of every segment: it does so beyond
//!   the disc of the near end; likewise with Q of the far end.
//!
//! Radii and D are rounded outward by 2^-20 of their size, which covers the roundings left.

use multiversion::multiversion;
use pvmap_geometry::Box3;
use pvmap_geometry::disc::{self, Disc, Profile};

use crate::ends::{Ends, MAX_ENDS};
use crate::kernel::Counts;
use crate::lanes::{OUTWARD, bits, dot32, greater, less, union_of};
use crate::pierce::{HALF, Plate, pierce};

/// Segments of a packet, and discs that are culled together.
pub const WIDTH: usize = 16;

/// How far off, in steps, a distance or a place can be where discs are culled.
const SLACK: f32 = 4.0;

/// What scales a normal to length 1.
pub(crate) const UNIT: f32 = 1.0 / (1u32 << 14) as f32;

/// Up to sixteen segments, a lane each. Lanes that are not used repeat the first.
#[derive(Debug, Clone)]
pub struct Packet {
    pub(crate) near: [[f32; WIDTH]; 3],
    pub(crate) far: [[f32; WIDTH]; 3],
    /// Around the near and the far ends, within which nothing blocks: rounded inward.
    pub(crate) spared: [[f32; WIDTH]; 2],
    /// The row and the column of each segment in its block.
    pub(crate) row: [u32; WIDTH],
    pub(crate) column: [u32; WIDTH],
    /// Segments that nothing has blocked yet, a bit each.
    open: u32,
    whereabouts: Whereabouts,
}

impl Packet {
    /// Loads segments by their rows and columns, the first `n` of the lanes.
    #[inline(always)]
    fn new(block: [&Ends; 2], row: [u32; WIDTH], column: [u32; WIDTH], n: usize) -> Packet {
        let [rows, columns] = block;
        let (near, far) = (places_of(rows, &row), places_of(columns, &column));
        let spared = [picked(&rows.spared, &row), picked(&columns.spared, &column)];
        let whereabouts = Whereabouts::new(&Span::new(rows, &row), &Span::new(columns, &column));
        Packet {
            near,
            far,
            spared,
            row,
            column,
            open: u32::MAX >> (u32::BITS as usize - n),
            whereabouts,
        }
    }

    /// Counts the open segments.
    pub fn n_open(&self) -> u64 {
        self.open.count_ones().into()
    }

    /// Notes the open segments: for each row, a bit a column.
    pub fn note(&self, open: &mut [u64]) {
        for lane in bits(self.open.into()) {
            open[self.row[lane] as usize] |= 1 << self.column[lane];
        }
    }
}

/// Gives lanes by their numbers.
#[inline(always)]
fn picked<T: Copy + Default>(lanes: &[T; MAX_ENDS], numbers: &[u32; WIDTH]) -> [T; WIDTH] {
    let mut picked = [T::default(); WIDTH];
    for k in 0..WIDTH {
        picked[k] = lanes[numbers[k] as usize % MAX_ENDS];
    }
    picked
}

#[inline(always)]
fn places_of(ends: &Ends, numbers: &[u32; WIDTH]) -> [[f32; WIDTH]; 3] {
    let [x, y, z] = &ends.centroid;
    [picked(x, numbers), picked(y, numbers), picked(z, numbers)]
}

/// Makes packets of the open segments of a block: for each row, a bit a column.
#[multiversion(targets = "simd")]
pub(crate) fn pack(block: [&Ends; 2], open: &[u64], packets: &mut Vec<Packet>) {
    packets.clear();
    let (mut row, mut column) = ([0; WIDTH], [0; WIDTH]);
    let mut n = 0;
    for (i, &open) in open.iter().enumerate() {
        let mut left = open;
        while left != 0 {
            (row[n], column[n]) = (i as u32, left.trailing_zeros());
            left &= left - 1;
            n += 1;
            if n == WIDTH {
                packets.push(Packet::new(block, row, column, n));
                n = 0;
            }
        }
    }
    if n > 0 {
        let (first_row, first_column) = (row[0], column[0]);
        row[n..].fill(first_row);
        column[n..].fill(first_column);
        packets.push(Packet::new(block, row, column, n));
    }
}

/// What culling asks of sixteen discs, a lane each. A lane without a disc has a box in which
/// nothing is.
#[derive(Debug, Clone)]
pub(crate) struct DiscBatch {
    normal: [[f32; WIDTH]; 3],
    /// n·c.
    offset: [f32; WIDTH],
    /// The box of all places at which the disc can block, larger by [`SLACK`].
    low: [[f32; WIDTH]; 3],
    high: [[f32; WIDTH]; 3],
    centroid: [[f32; WIDTH]; 3],
    /// Rounded outward.
    radius: [f32; WIDTH],
}

impl DiscBatch {
    pub(crate) const EMPTY: DiscBatch = DiscBatch {
        centroid: [[0.0; WIDTH]; 3],
        radius: [0.0; WIDTH],
        normal: [[0.0; WIDTH]; 3],
        offset: [0.0; WIDTH],
        low: [[f32::INFINITY; WIDTH]; 3],
        high: [[f32::NEG_INFINITY; WIDTH]; 3],
    };

    /// Puts a disc into a lane, with the box of all places at which it can block.
    #[inline(always)]
    pub(crate) fn set(&mut self, k: usize, disc: &Disc, reach: &Box3) {
        let mut offset = 0.0;
        for i in 0..3 {
            self.normal[i][k] = f32::from(disc.normal[i]) * UNIT;
            self.low[i][k] = reach.min[i] as f32 - SLACK;
            self.high[i][k] = reach.max[i] as f32 + SLACK;
            self.centroid[i][k] = disc.centroid[i] as f32;
            offset += f64::from(disc.normal[i]) * f64::from(disc.centroid[i]);
        }
        self.offset[k] = (offset * f64::from(UNIT)) as f32;
        self.radius[k] = (disc.radius2 as f32).sqrt() * OUTWARD;
    }

    /// Copies a lane of another batch.
    pub(crate) fn copy(&mut self, to: usize, other: &DiscBatch, from: usize) {
        for i in 0..3 {
            self.normal[i][to] = other.normal[i][from];
            self.low[i][to] = other.low[i][from];
            self.high[i][to] = other.high[i][from];
            self.centroid[i][to] = other.centroid[i][from];
        }
        self.offset[to] = other.offset[from];
        self.radius[to] = other.radius[from];
    }
}

/// What segments are shot in.
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// The surfels as the profile sees them.
    pub discs: &'a [Disc],
    /// How discs block.
    pub profile: Profile,
    /// The rows and the columns of the block.
    pub block: [&'a Ends; 2],
    /// Whether ends are off the centroids of their surfels, whose discs then may be in the way:
    /// they block nothing.
    pub is_tried: bool,
}

/// Closes the open segments of a packet that some disc of a list blocks; gives the position of the
/// disc that closed the most. Exact. Source: DESIGN.md [V-2].
#[multiversion(targets = "simd")]
pub(crate) fn fire(
    shot: &Shot<'_>,
    batches: &[DiscBatch],
    ids: &[u32],
    packet: &mut Packet,
    counts: &mut Counts,
) -> Option<usize> {
    let (mut best, mut most) = (None, 0);
    if packet.open == 0 {
        return best;
    }
    for (i, batch) in batches.iter().enumerate() {
        let kept = cull(&packet.whereabouts, batch);
        if kept == 0 {
            continue;
        }
        counts.n_tests += u64::from(kept.count_ones());
        let hits = sift(batch, kept, packet);
        for k in bits(union_of(&hits).into()) {
            let asked = lanes_with(&hits, k) & packet.open;
            if asked == 0 {
                continue;
            }
            let (before, position) = (packet.open, i * WIDTH + k);
            settle(shot, ids[position], asked, packet, counts);
            let n_closed = (before & !packet.open).count_ones();
            if n_closed > most {
                (best, most) = (Some(position), n_closed);
            }
        }
        if packet.open == 0 {
            break;
        }
    }
    best
}

/// Finds the lanes in which a bit is set, a bit each.
#[inline(always)]
fn lanes_with(lanes: &[u32; WIDTH], bit: usize) -> u32 {
    let mut with = [0; WIDTH];
    for k in 0..WIDTH {
        with[k] = (lanes[k] >> bit & 1) << k;
    }
    union_of(&with)
}

/// Closes those of some segments that the disc of a surfel blocks.
#[inline(always)]
fn settle(shot: &Shot<'_>, blocker: u32, hits: u32, packet: &mut Packet, counts: &mut Counts) {
    let Shot { discs, profile, block, is_tried } = *shot;
    let hits = if is_tried { hits & !of_surfel(block, blocker, packet) } else { hits };
    let blocker = &discs[blocker as usize];
    let plate = Plate::new(profile, blocker);
    for half in 0..2 {
        let asked = hits >> (half * HALF) & 0xff;
        if asked == 0 {
            continue;
        }
        let (sure, maybe) = pierce(profile, &plate, block, packet, half * HALF);
        packet.open &= !((sure & asked) << (half * HALF));
        for lane in bits((maybe & !sure & asked).into()).map(|k| half * HALF + k) {
            counts.n_exact += 1;
            let a = block[0].disc(packet.row[lane] as usize, discs);
            let b = block[1].disc(packet.column[lane] as usize, discs);
            if disc::blocks(profile, &a, &b, blocker) {
                packet.open &= !(1 << lane);
            }
        }
    }
}

/// Finds the segments that have an end on a surfel, a bit each.
#[inline(always)]
fn of_surfel(block: [&Ends; 2], surfel: u32, packet: &Packet) -> u32 {
    let is_of = |side: &Ends, lane: u32| side.surfel(lane as usize) == surfel;
    let mut found = 0;
    for k in 0..WIDTH {
        let is_end = is_of(block[0], packet.row[k]) | is_of(block[1], packet.column[k]);
        found |= u32::from(is_end) << k;
    }
    found
}

/// Where one end of segments may be: a box by its corners, its middle and its half sides.
#[derive(Debug, Clone, Copy)]
struct Span {
    low: [f32; 3],
    high: [f32; 3],
    middle: [f32; 3],
    half: [f32; 3],
}

impl Span {
    /// Spans some ends.
    #[inline(always)]
    fn new(ends: &Ends, numbers: &[u32; WIDTH]) -> Span {
        let mut corners = [f32::NEG_INFINITY; 8];
        for &number in numbers {
            let corner = &ends.corners[number as usize % MAX_ENDS];
            for i in 0..8 {
                corners[i] = greater(corners[i], corner[i]);
            }
        }
        let mut span = Span { low: [0.0; 3], high: [0.0; 3], middle: [0.0; 3], half: [0.0; 3] };
        for i in 0..3 {
            let (low, high) = (-corners[i + 3], corners[i]);
            (span.low[i], span.high[i]) = (low, high);
            span.middle[i] = (low + high) / 2.0;
            span.half[i] = (high - low) / 2.0;
        }
        span
    }
}

/// Where the ends of a packet's segments are.
#[derive(Debug, Clone, Copy)]
struct Whereabouts {
    near: Span,
    far: Span,
    /// The box of all.
    low: [f32; 3],
    high: [f32; 3],
    /// Length of the longest segment, rounded outward.
    longest: f32,
}

impl Whereabouts {
    #[inline(always)]
    fn new(near: &Span, far: &Span) -> Whereabouts {
        let (mut low, mut high, mut longest2) = ([0.0; 3], [0.0; 3], 0.0);
        for i in 0..3 {
            low[i] = less(near.low[i], far.low[i]);
            high[i] = greater(near.high[i], far.high[i]);
            let way = greater(far.high[i] - near.low[i], near.high[i] - far.low[i]);
            longest2 += way * way;
        }
        Whereabouts { near: *near, far: *far, low, high, longest: longest2.sqrt() * OUTWARD }
    }
}

/// Finds which discs of a batch may block a segment between two boxes, a bit each.
///
/// A disc's plane cuts such a segment at a share t that is bounded by how far the boxes are from
/// the plane, and so is the place of the cut, an axis at a time; it has to meet the disc's box.
#[inline(always)]
fn cull(whereabouts: &Whereabouts, batch: &DiscBatch) -> u32 {
    let Whereabouts { near: a, far: b, .. } = whereabouts;
    let [nx, ny, nz] = &batch.normal;
    let mut kept = [0; WIDTH];
    for k in 0..WIDTH {
        let n = [nx[k], ny[k], nz[k]];
        let size = [n[0].abs(), n[1].abs(), n[2].abs()];
        let (here, there) =
            (dot32(n, a.middle) - batch.offset[k], dot32(n, b.middle) - batch.offset[k]);
        let (spread_a, spread_b) = (dot32(size, a.half) + SLACK, dot32(size, b.half) + SLACK);
        // From above to below, or the other way; if both can be, either bounds t by 0 and 1.
        let down = (here + spread_a > 0.0) & (there - spread_b < 0.0);
        let up = (here - spread_a < 0.0) & (there + spread_b > 0.0);
        let (here, there) = if down { (here, there) } else { (-here, -there) };
        let (least, most) = (greater(here - spread_a, 0.0), here + spread_a);
        let t0 = least / (least - (there - spread_b));
        let t1 = most / (most - less(there + spread_b, 0.0));
        let mut meets = down | up;
        for i in 0..3 {
            let (to_low, to_high) = (b.low[i] - a.low[i], b.high[i] - a.high[i]);
            let (low0, low1) = (a.low[i] + t0 * to_low, a.low[i] + t1 * to_low);
            let (high0, high1) = (a.high[i] + t0 * to_high, a.high[i] + t1 * to_high);
            meets &=
                (less(low0, low1) <= batch.high[i][k]) & (greater(high0, high1) >= batch.low[i][k]);
        }
        kept[k] = if meets { 1 << k } else { 0 };
    }
    union_of(&kept)
}

/// How far off the discs of a batch can be where they sift the segments of a packet, a lane each.
struct Margins {
    /// δ.
    delta: [f32; WIDTH],
    /// 2·δ·M.
    crossing: [f32; WIDTH],
    /// 4·δ·R + 2^-18·M².
    reach: [f32; WIDTH],
}

impl Margins {
    #[inline(always)]
    fn new(batch: &DiscBatch, whereabouts: &Whereabouts) -> Margins {
        let mut margins =
            Margins { delta: [0.0; WIDTH], crossing: [0.0; WIDTH], reach: [0.0; WIDTH] };
        for k in 0..WIDTH {
            let mut size = 1.0;
            for i in 0..3 {
                let c = batch.centroid[i][k];
                size = greater(size, greater(whereabouts.high[i] - c, c - whereabouts.low[i]));
            }
            let delta = size / (1u32 << 21) as f32;
            margins.delta[k] = delta;
            margins.crossing[k] = 2.0 * delta * size;
            margins.reach[k] = 4.0 * delta * batch.radius[k] + size * size / (1u32 << 18) as f32;
        }
        margins
    }
}

/// Finds the open segments of a packet that some discs of a batch may block: for each segment, a
/// bit a disc.
#[inline(always)]
fn sift(batch: &DiscBatch, discs: u32, packet: &Packet) -> [u32; WIDTH] {
    let Packet { near: [ax, ay, az], far: [bx, by, bz], whereabouts, .. } = packet;
    let [spared_a, spared_b] = &packet.spared;
    let margins = Margins::new(batch, whereabouts);
    let mut hits = [0; WIDTH];
    for disc in bits(discs.into()) {
        let (c, n) = (at(&batch.centroid, disc), at(&batch.normal, disc));
        let (radius, delta) = (batch.radius[disc], margins.delta[disc]);
        let (crossing, slack) = (margins.crossing[disc], margins.reach[disc]);
        for k in 0..WIDTH {
            let p = [ax[k] - c[0], ay[k] - c[1], az[k] - c[2]];
            let q = [bx[k] - c[0], by[k] - c[1], bz[k] - c[2]];
            let (here, there) = (dot32(n, p), dot32(n, q));
            let e = [
                here * q[0] - there * p[0],
                here * q[1] - there * p[1],
                here * q[2] - there * p[2],
            ];
            let width = (here - there).abs();
            let reach = radius * width + slack;
            let least = width - 4.0 * delta;
            let may = (here * there < crossing)
                & (dot32(e, e) <= reach * reach)
                & (spared_a[k] * least <= (here.abs() + delta) * whereabouts.longest)
                & (spared_b[k] * least <= (there.abs() + delta) * whereabouts.longest);
            hits[k] |= if may { 1 << disc } else { 0 };
        }
    }
    for (k, hits) in hits.iter_mut().enumerate() {
        *hits = if packet.open >> k & 1 == 1 { *hits } else { 0 };
    }
    hits
}

/// Gives a lane of a vector of lanes.
#[inline(always)]
fn at(v: &[[f32; WIDTH]; 3], k: usize) -> [f32; 3] {
    [v[0][k], v[1][k], v[2][k]]
}
