//! What a sheet says of the segments of a block, sixteen at once: it surely leaves a segment alone,
//! it surely blocks it, or it does not know.
//!
//! Let F be the height over the sheet's surface. Every place x at which a surfel of the sheet can
//! block a segment a + t·d, t in 0…1, is in the sheet's box, at most ε from the surface (|F(x)| ≤
//! ε), and farther from both ends than their spared radii ([V-2] (iii)). So t is in an interval
//! t0…t1 that is found by clipping. Along the segment F is a polynomial F(a) + t·F1 + t²·F2; in
//! the interval it is off the chord between F(t0) and F(t1) by at most the sag |F2|·(t1 - t0)²/4.
//! - **Left alone** if the interval is empty, or if F stays over ε, or under -ε: the chord does, by
//!   the sag where that goes the wrong way.
//! - The chord crosses zero at t*. Where |F| ≤ ε, the chord is at most ε + sag, so |t - t*| ≤ τ :=
//!   (ε + sag)·(t1 - t0)/|F(t0) - F(t1)|, and x is off the place of t* by at most τ·|d_u| along
//!   u, τ·|d_v| along v. **Left alone** if the raster says that no surfel can block so near.
//! - **Blocked** if the raster says that around the place of t* all within that distance lies on
//!   one surfel, and the chord reaches ε + sag on both sides: from t* - τ to t* + τ the segment
//!   goes from over ε to under -ε or back, and so crosses the plane of that surfel, which over
//!   these (u, v) is within ε of the surface, between the ends and outside the spared radii. That
//!   surfel is neither end: an end's own disc lies within its spared radius, and for profile
//!   `paper` its plane meets the segment at t = 0 only, where F would have to be beyond ε.
//! - What is left is tried with the surfel that the raster names.
//!
//! **The bound of f32.** Places are exact: boxes end on half steps below 2^22. A share t is off by
//! less than 2^-21, so a place by less than `PLACE_SLACK` steps, by which boxes and distances are
//! on the safe side. What heights are off by is part of a surface's `reach`. Comparisons of
//! products carry factors of `WIDER`.

use multiversion::multiversion;
use pvmap_geometry::disc::{Disc, Profile};

use crate::ends::{Ends, MAX_ENDS};
use crate::lanes::{WIDER, bits, dot32, greater, less, union_of};
use crate::sheets::{
    Detail, MAX_SURFELS, MIDWAY, NOBODY, PLACE_SLACK, Plates, SIDE, SIDE_BITS, Sheet, UNITS,
};

/// Ends in a row that are asked together first.
const GROUP: usize = 4;
const N_GROUPS: usize = MAX_ENDS / GROUP;
/// Segments asked together: those between two groups.
const LANES: usize = GROUP * GROUP;
/// How far off the difference of two heights over a plane can be, in steps.
const ROUNDING: f32 = 64.0;

/// The ends of one side of a block as a sheet sees them.
#[derive(Debug, Clone)]
struct Seen {
    /// Along u, v and w, from the sheet's middle.
    place: [[f32; MAX_ENDS]; 3],
    /// Over the surface.
    height: [f32; MAX_ENDS],
    /// Over the plane.
    level: [f32; MAX_ENDS],
    /// Of each group: least and greatest places, levels, and the least spared radius.
    places: [[[f32; N_GROUPS]; 2]; 3],
    levels: [[f32; N_GROUPS]; 2],
    spared: [f32; N_GROUPS],
}

impl Seen {
    const NONE: Seen = Seen {
        place: [[0.0; MAX_ENDS]; 3],
        height: [0.0; MAX_ENDS],
        level: [0.0; MAX_ENDS],
        places: [[[0.0; N_GROUPS]; 2]; 3],
        levels: [[0.0; N_GROUPS]; 2],
        spared: [0.0; N_GROUPS],
    };

    #[inline(always)]
    fn load(&mut self, sheet: &Sheet, ends: &Ends) {
        for i in 0..3 {
            let from = &ends.centroid[sheet.axes[i]];
            for k in 0..MAX_ENDS {
                self.place[i][k] = from[k] - sheet.middle[i];
            }
        }
        let [u, v, w] = &self.place;
        for k in 0..MAX_ENDS {
            self.height[k] = sheet.surface.height(u[k], v[k], w[k]);
            self.level[k] = sheet.plane.height(u[k], v[k], w[k]);
        }
        for (g, from) in (0..ends.len()).step_by(GROUP).enumerate() {
            let n = GROUP.min(ends.len() - from);
            for i in 0..3 {
                (self.places[i][0][g], self.places[i][1][g]) = range(&self.place[i], from, n);
            }
            (self.levels[0][g], self.levels[1][g]) = range(&self.level, from, n);
            self.spared[g] = range(&ends.spared, from, n).0;
        }
    }
}

/// Finds the least and the greatest of `n` lanes, at most four.
#[inline(always)]
fn range(lanes: &[f32; MAX_ENDS], from: usize, n: usize) -> (f32, f32) {
    let (mut least, mut greatest) = (lanes[from], lanes[from]);
    for k in 0..GROUP {
        let lane = lanes[from + if k < n { k } else { 0 }];
        (least, greatest) = (less(least, lane), greater(greatest, lane));
    }
    (least, greatest)
}

/// Asks sheets about segments; its buffers serve one sheet after another.
#[derive(Debug)]
pub struct Screen {
    seen: [Box<Seen>; 2],
    /// For each row, a bit for a column whose segment the last sheet may block and may not.
    pub unsure: Vec<u64>,
}

impl Default for Screen {
    fn default() -> Screen {
        Screen { seen: [Box::new(Seen::NONE), Box::new(Seen::NONE)], unsure: Vec::new() }
    }
}

impl Screen {
    /// Asks a sheet about the open segments of a block and closes those that it surely blocks.
    pub fn ask(
        &mut self,
        sheet: &Sheet,
        discs: &[Disc],
        profile: Profile,
        block: [&Ends; 2],
        open: &mut [u64],
    ) {
        self.unsure.clear();
        self.unsure.resize(open.len(), 0);
        ask(sheet, sheet.detail(discs, profile), &mut self.seen, block, open, &mut self.unsure);
    }
}

// Below there are no closures: they would not be compiled for the processor at hand.

#[multiversion(targets = "simd")]
fn ask(
    sheet: &Sheet,
    detail: &Detail,
    seen: &mut [Box<Seen>; 2],
    block: [&Ends; 2],
    open: &mut [u64],
    unsure: &mut [u64],
) {
    let [rows, columns] = seen;
    rows.load(sheet, block[0]);
    columns.load(sheet, block[1]);
    for g in 0..open.len().div_ceil(GROUP) {
        let mut any = 0;
        for row in g * GROUP..open.len().min((g + 1) * GROUP) {
            any |= open[row];
        }
        if any == 0 {
            continue;
        }
        let near = near_groups(sheet, detail, (rows, g), columns);
        for h in bits((near & u32::MAX >> (32 - block[1].len().div_ceil(GROUP))).into()) {
            let mut asked = 0;
            for i in 0..GROUP.min(open.len() - g * GROUP) {
                asked |= (open[g * GROUP + i] >> (h * GROUP) & 0xf) << (i * GROUP);
            }
            if asked == 0 {
                continue;
            }
            let segments = Segments::new((rows, g), (columns, h), block);
            let (near, blocked) = ask_lanes(sheet, detail, &segments, asked as u32);
            for i in 0..GROUP.min(open.len() - g * GROUP) {
                let row = g * GROUP + i;
                open[row] &= !(u64::from(blocked >> (i * GROUP) & 0xf) << (h * GROUP));
                unsure[row] |= u64::from((near & !blocked) >> (i * GROUP) & 0xf) << (h * GROUP);
            }
        }
    }
}

/// Asks about all segments from a group of rows to groups of columns, by the plane; gives the
/// groups of columns that the sheet does not surely leave alone, a bit each.
#[inline(always)]
fn near_groups(sheet: &Sheet, detail: &Detail, (rows, g): (&Seen, usize), columns: &Seen) -> u32 {
    let [u, v, w] = &rows.places;
    let (a_low, a_high) = ([u[0][g], v[0][g], w[0][g]], [u[1][g], v[1][g], w[1][g]]);
    let (fa_low, fa_high, r_a) = (rows.levels[0][g], rows.levels[1][g], rows.spared[g]);
    let slab = sheet.plane.reach;
    let mut at = [0; N_GROUPS];
    let (mut beyond, mut extent, mut width) = ([0.0; N_GROUPS], [0.0; N_GROUPS], [0.0; N_GROUPS]);
    for k in 0..N_GROUPS {
        let (fb_low, fb_high) = (columns.levels[0][k], columns.levels[1][k]);
        let (down, up) = (fa_low - fb_high, fb_low - fa_high);
        width[k] = greater(down, up);
        // The share at which F is zero grows with F(a) and F(b) falling, and shrinks rising.
        let (least, most) = if down > up {
            (fa_low / (fa_low - fb_low), fa_high / (fa_high - fb_high))
        } else {
            (fa_high / (fa_high - fb_high), fa_low / (fa_low - fb_low))
        };
        let (t0, t1) = (less(greater(least, 0.0), 1.0), less(greater(most, 0.0), 1.0));
        let mut middle = [0.0; 2];
        beyond[k] = f32::NEG_INFINITY;
        for i in 0..2 {
            let to_low = columns.places[i][0][k] - a_low[i];
            let to_high = columns.places[i][1][k] - a_high[i];
            let low = a_low[i] + less(t0 * to_low, t1 * to_low);
            let high = a_high[i] + greater(t0 * to_high, t1 * to_high);
            beyond[k] = greater(beyond[k], greater(sheet.low[i] - high, low - sheet.high[i]));
            middle[i] = (low + high) / 2.0 - sheet.low[i];
            extent[k] = greater(extent[k], (high - low) / 2.0);
        }
        at[k] = cell_at(middle[0], middle[1], sheet.cell);
    }
    let mut cell = [0; N_GROUPS];
    for k in 0..N_GROUPS {
        cell[k] = detail.raster[at[k] as usize % (SIDE * SIDE)];
    }
    let mut kept = [0; N_GROUPS];
    for k in 0..N_GROUPS {
        let (fb_low, fb_high) = (columns.levels[0][k], columns.levels[1][k]);
        let mut way = [0.0; 3];
        for i in 0..3 {
            let (b_low, b_high) = (columns.places[i][0][k], columns.places[i][1][k]);
            way[i] = greater(b_high - a_low[i], a_high[i] - b_low);
        }
        let away = greater(beyond[k], distance_of(cell[k]) * sheet.cell - extent[k]);
        let reach = slab * WIDER * greater(way[0], way[1]);
        let off = (width[k] > 0.0) & (width[k] * (away - 2.0 * PLACE_SLACK) > reach);
        let above = (fa_low > slab) & (fb_low > slab);
        let below = (fa_high < -slab) & (fb_high < -slab);
        let out_a = (fa_low > slab) | (fa_high < -slab);
        let out_b = (fb_low > slab) | (fb_high < -slab);
        // From the end that is in the slab, how far it is until the segment is out of it.
        let up_a = if fb_low > 0.0 { fa_low } else { -fa_high };
        let up_b = if fa_low > 0.0 { fb_low } else { -fb_high };
        let length = dot32(way, way).sqrt() * WIDER;
        let safe = width[k] - ROUNDING;
        let spared_a = out_b & ((slab - up_a) * length <= r_a * safe);
        let spared_b = out_a & ((slab - up_b) * length <= columns.spared[k] * safe);
        let spared = (safe > 0.0) & (spared_a | spared_b);
        kept[k] = if off | above | below | spared { 0 } else { 1 << k };
    }
    union_of(&kept)
}

/// The segments from a group of rows to a group of columns, as a sheet sees them: row by row.
struct Segments {
    a: [[f32; LANES]; 3],
    b: [[f32; LANES]; 3],
    height_a: [f32; LANES],
    height_b: [f32; LANES],
    spared_a: [f32; LANES],
    spared_b: [f32; LANES],
}

impl Segments {
    #[inline(always)]
    fn new((rows, g): (&Seen, usize), (columns, h): (&Seen, usize), block: [&Ends; 2]) -> Segments {
        let ([au, av, aw], [bu, bv, bw]) = (&rows.place, &columns.place);
        Segments {
            a: [each_row(au, g), each_row(av, g), each_row(aw, g)],
            b: [each_column(bu, h), each_column(bv, h), each_column(bw, h)],
            height_a: each_row(&rows.height, g),
            height_b: each_column(&columns.height, h),
            spared_a: each_row(&block[0].spared, g),
            spared_b: each_column(&block[1].spared, h),
        }
    }

    #[inline(always)]
    fn way(&self, k: usize) -> [f32; 3] {
        let ([au, av, aw], [bu, bv, bw]) = (&self.a, &self.b);
        [bu[k] - au[k], bv[k] - av[k], bw[k] - aw[k]]
    }
}

/// Gives each of a group four times in a row.
#[inline(always)]
fn each_row(ends: &[f32; MAX_ENDS], g: usize) -> [f32; LANES] {
    let group: &[f32; GROUP] = ends[g * GROUP..][..GROUP].try_into().expect("a group");
    let mut lanes = [0.0; LANES];
    for k in 0..LANES {
        lanes[k] = group[k / GROUP];
    }
    lanes
}

/// Gives a group four times.
#[inline(always)]
fn each_column(ends: &[f32; MAX_ENDS], h: usize) -> [f32; LANES] {
    let group: &[f32; GROUP] = ends[h * GROUP..][..GROUP].try_into().expect("a group");
    let mut lanes = [0.0; LANES];
    for k in 0..LANES {
        lanes[k] = group[k % GROUP];
    }
    lanes
}

/// The part of each segment in which the sheet can block it.
struct Parts {
    /// t0, and t1 - t0.
    start: [f32; LANES],
    length: [f32; LANES],
    /// Heights at t0 and t1.
    here: [f32; LANES],
    there: [f32; LANES],
    sag: [f32; LANES],
    /// The segments that have such a part, a bit each.
    near: u32,
}

/// Asks about sixteen segments; gives those that the sheet does not surely leave alone and, of
/// these, those that it surely blocks.
#[inline(always)]
fn ask_lanes(sheet: &Sheet, detail: &Detail, segments: &Segments, asked: u32) -> (u32, u32) {
    let parts = clip(sheet, segments);
    let near = parts.near & asked;
    if near == 0 {
        return (0, 0);
    }
    let mut at = [0; LANES];
    for k in 0..LANES {
        let d = segments.way(k);
        let (here, there) = (parts.here[k], parts.there[k]);
        let share = less(greater(here / (here - there), 0.0), 1.0);
        let t = parts.start[k] + parts.length[k] * share;
        let (u, v) = (segments.a[0][k] + t * d[0], segments.a[1][k] + t * d[1]);
        at[k] = cell_at(u - sheet.low[0], v - sheet.low[1], sheet.cell);
    }
    let mut cell = [0; LANES];
    for k in 0..LANES {
        cell[k] = detail.raster[at[k] as usize % (SIDE * SIDE)];
    }
    let (mut off, mut within) = ([0; LANES], [0; LANES]);
    for k in 0..LANES {
        let (d, here, there) = (segments.way(k), parts.here[k], parts.there[k]);
        let away = distance_of(cell[k]) * sheet.cell;
        let fall = (here - there).abs();
        let slab = (sheet.surface.reach + parts.sag[k]) * WIDER;
        let reach = slab * parts.length[k] * greater(d[0].abs(), d[1].abs()) * WIDER;
        let through = (here * there < 0.0) & (here.abs() > slab) & (there.abs() > slab);
        off[k] = if fall * (away - PLACE_SLACK) > reach { 1 << k } else { 0 };
        within[k] = if through & (fall * (-away - PLACE_SLACK) > reach) { 1 << k } else { 0 };
    }
    let near = near & !union_of(&off);
    let blocked = near & union_of(&within);
    let left = near & !blocked;
    if left == 0 {
        return (near, blocked);
    }
    (near, blocked | left & pierced(&detail.plates, &cell, segments))
}

/// Finds the parts of segments in which the sheet can block them.
#[inline(always)]
fn clip(sheet: &Sheet, segments: &Segments) -> Parts {
    let none = [0.0; LANES];
    let (start, length, here, there, sag) = (none, none, none, none, none);
    let mut parts = Parts { start, length, here, there, sag, near: 0 };
    let mut near = [0; LANES];
    let reach = sheet.surface.reach;
    for k in 0..LANES {
        let d = segments.way(k);
        let (f_a, r_a) = (segments.height_a[k], segments.spared_a[k]);
        let (f_b, r_b) = (segments.height_b[k], segments.spared_b[k]);
        // Four roundings are less than 2^-22 of it.
        let per_length = 1.0 / (dot32(d, d).sqrt() * (1.0 + 1.0 / (1u32 << 21) as f32));
        let (mut t0, mut t1) = (r_a * per_length, 1.0 - r_b * per_length);
        for i in 0..3 {
            // No end is on a face of the box: where d is 0 both are infinite, and none NaN.
            let per = 1.0 / d[i];
            let to_low = (sheet.low[i] - segments.a[i][k]) * per;
            let to_high = (sheet.high[i] - segments.a[i][k]) * per;
            t0 = greater(less(to_low, to_high), t0);
            t1 = less(greater(to_low, to_high), t1);
        }
        let bend = -sheet.surface.bent(d[0], d[1]);
        let rise = f_b - f_a - bend;
        let (here, there) = (f_a + t0 * (rise + t0 * bend), f_a + t1 * (rise + t1 * bend));
        let length = t1 - t0;
        // Where F2 is positive, F sags under the chord, else it arches over it.
        let sag = bend * length * length * 0.25;
        let above = less(here, there) - greater(sag, 0.0) > reach;
        let below = greater(here, there) - less(sag, 0.0) < -reach;
        near[k] = if (t0 > t1) | above | below { 0 } else { 1 << k };
        (parts.start[k], parts.length[k], parts.sag[k]) = (t0, length, sag.abs());
        (parts.here[k], parts.there[k]) = (here, there);
    }
    parts.near = union_of(&near);
    parts
}

/// Tests each of sixteen segments against the disc that its cell names; gives those that are surely
/// blocked. The bound is that of `sift` in [`crate::packets`], turned around.
#[inline(always)]
fn pierced(plates: &Plates, cell: &[u32; LANES], segments: &Segments) -> u32 {
    let [nx, ny, nz] = gather3(&plates.normal, cell);
    let [cx, cy, cz] = gather3(&plates.centroid, cell);
    let (low, high) = (gather3(&plates.low, cell), gather3(&plates.high, cell));
    let radius = gather(&plates.radius, cell);
    let Segments { a, b, spared_a, spared_b, .. } = segments;
    let mut pierced = [0; LANES];
    for k in 0..LANES {
        let n = [nx[k], ny[k], nz[k]];
        let p = [a[0][k] - cx[k], a[1][k] - cy[k], a[2][k] - cz[k]];
        let q = [b[0][k] - cx[k], b[1][k] - cy[k], b[2][k] - cz[k]];
        let (here, there) = (dot32(n, p), dot32(n, q));
        let mut size = 1.0;
        for i in 0..3 {
            size = greater(size, greater(p[i].abs(), q[i].abs()));
        }
        let delta = size / (1u32 << 21) as f32;
        let slack = 2.0 * size * size / (1u32 << 18) as f32;
        let width = (here - there).abs();
        let (least, most) = (width - 4.0 * delta, (width + 4.0 * delta) * WIDER);
        let e =
            [here * q[0] - there * p[0], here * q[1] - there * p[1], here * q[2] - there * p[2]];
        let sign = if here > there { 1.0 } else { -1.0 };
        let mut inside = radius[k] * least - dot32(e, e).sqrt() * WIDER;
        for i in 0..3 {
            let out = sign * e[i];
            inside = less(inside, less(high[i][k] * least - out, out - low[i][k] * least));
        }
        let d = segments.way(k);
        let length = dot32(d, d).sqrt() / WIDER;
        let sure = (here * there < 0.0)
            & (here.abs() > delta)
            & (there.abs() > delta)
            & (inside > slack)
            // A factor undoes that spared radii are rounded inward; those of `most` and `length`
            // leave room for the roundings.
            & ((here.abs() - delta) * length > spared_a[k] * WIDER * most)
            & ((there.abs() - delta) * length > spared_b[k] * WIDER * most)
            & (cell[k] & NOBODY != NOBODY);
        pierced[k] = if sure { 1 << k } else { 0 };
    }
    union_of(&pierced)
}

#[inline(always)]
fn gather3(from: &[[f32; MAX_SURFELS]; 3], cell: &[u32; LANES]) -> [[f32; LANES]; 3] {
    [gather(&from[0], cell), gather(&from[1], cell), gather(&from[2], cell)]
}

/// Gives for each cell the lane of the surfel that it names.
#[inline(always)]
fn gather(from: &[f32; MAX_SURFELS], cell: &[u32; LANES]) -> [f32; LANES] {
    let mut to = [0.0; LANES];
    for k in 0..LANES {
        to[k] = from[cell[k] as usize % MAX_SURFELS];
    }
    to
}

/// 2^23: the last bits of a sum with it are a whole number.
const WHOLE: f32 = (1u32 << 23) as f32;

/// Gives the distance that a cell of a raster tells, in cells.
#[inline(always)]
fn distance_of(cell: u32) -> f32 {
    let units = f32::from_bits(cell >> 16 | WHOLE.to_bits()) - (WHOLE + MIDWAY as f32);
    units * (1.0 / UNITS)
}

/// Gives the number of the cell at a place from the raster's corner, or nearest to it.
#[inline(always)]
fn cell_at(u: f32, v: f32, cell: f32) -> u32 {
    (whole(v / cell) << SIDE_BITS) | whole(u / cell)
}

#[inline(always)]
fn whole(cells: f32) -> u32 {
    let held = less(greater(cells - 0.5, 0.0), (SIDE - 1) as f32);
    (held + WHOLE).to_bits() & (SIDE as u32 - 1)
}

#[cfg(test)]
mod tests;
