//! A disc and eight segments in f64: whether it surely blocks them, surely does not, or floats do
//! not know.
//!
//! Planes are exact in f64: n·c and its sums stay below 2^40. The crossing x = c_a + t·d has one
//! rounded division and, an axis, one product and one sum of numbers below 2^24; then it is taken
//! from a corner or a centroid, another sum. So each component is off by less than 2^-27 =: ε (five
//! roundings of at most 2^-30). For |x - c_k| near R the square is then off by less than 2·√3·ε·R +
//! 2^-50·R² < 2^-24·(R + 1) as R < 2^23; `margin` takes four times that. So it is with the way from
//! an end, t·|d| or (1 - t)·|d|, which is off by less than 2^-29: both shares have relative errors
//! of a few 2^-53 or absolute ones of 2^-53, and |d| < 2^24.
//!
//! An offset along an axis of a rectangle, u·(x - c_k), is off by less than 3·2^14·ε < 2^-11 from
//! its components, which are below 2^23, and 2^-14 from five roundings of sums below 2^39: `ALONG`
//! is more than four times that. The bounds it is held against are exact.

use pvmap_geometry::Rect;
use pvmap_geometry::disc::{Disc, Profile};
use pvmap_geometry::normal::NORMAL_LENGTH;

use crate::ends::{Ends, MAX_ENDS};
use crate::lanes::{all_bits, dot, less, mask_of};
use crate::packets::{Packet, WIDTH};

/// Segments that meet a disc together.
pub(crate) const HALF: usize = WIDTH / 2;

/// How far off an offset along an axis of a rectangle can be, which has length 2^14.
const ALONG: f64 = 1.0 / (1u64 << 8) as f64;

/// How far off a component of a crossing can be.
const EPSILON: f64 = 1.0 / (1u64 << 27) as f64;

/// How far off a squared distance near the square of a radius can be.
#[inline(always)]
fn margin(radius: f64) -> f64 {
    (radius + 1.0) / (1u64 << 22) as f64
}

/// A disc as segments meet it in f64.
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
    cut: Cut,
}

/// The rectangle of profile `oriented`; offsets are multiplied by 2^14.
#[derive(Clone, Copy)]
struct Cut {
    axes: [[f64; 3]; 2],
    low: [f64; 2],
    high: [f64; 2],
}

impl Cut {
    const NONE: Cut = Cut { axes: [[0.0; 3]; 2], low: [0.0; 2], high: [0.0; 2] };

    #[inline(always)]
    fn new(rect: &Rect) -> Cut {
        let scale = f64::from(NORMAL_LENGTH);
        let [u, v] = rect.axes;
        Cut {
            axes: [u.map(f64::from), v.map(f64::from)],
            low: rect.low.map(|steps| f64::from(steps) * scale),
            high: rect.high.map(|steps| f64::from(steps) * scale),
        }
    }

    /// Gives how far within the rectangle an offset is.
    #[inline(always)]
    fn within(&self, offset: [f64; 3]) -> f64 {
        let (u, v) = (dot(self.axes[0], offset), dot(self.axes[1], offset));
        let [from_low, from_high] =
            [less(u - self.low[0], v - self.low[1]), less(self.high[0] - u, self.high[1] - v)];
        less(from_low, from_high)
    }
}

impl Plate {
    #[inline(always)]
    pub(crate) fn new(profile: Profile, disc: &Disc) -> Plate {
        let normal = disc.normal.map(f64::from);
        let centroid = disc.centroid.map(f64::from);
        let radius2 = disc.radius2 as f64;
        Plate {
            normal,
            offset: dot(normal, centroid),
            centroid,
            radius2,
            margin: margin(radius2.sqrt()),
            low: disc.limit.min.map(f64::from),
            high: disc.limit.max.map(f64::from),
            cut: if profile == Profile::Oriented { Cut::new(&disc.rect) } else { Cut::NONE },
        }
    }
}

/// Gives the ends of eight segments, from a lane on.
#[inline(always)]
fn half_of(packet: &Packet, from: usize) -> ([[f64; HALF]; 3], [[f64; HALF]; 3]) {
    let (mut near, mut far) = ([[0.0; HALF]; 3], [[0.0; HALF]; 3]);
    for i in 0..3 {
        for k in 0..HALF {
            near[i][k] = f64::from(packet.near[i][from + k]);
            far[i][k] = f64::from(packet.far[i][from + k]);
        }
    }
    (near, far)
}

/// Tests a disc against eight segments of a packet, from a lane on: which it surely blocks, and
/// which it blocks as far as floats know, a bit each. Source: DESIGN.md [V-2].
#[inline(always)]
pub(crate) fn pierce(
    profile: Profile,
    plate: &Plate,
    block: [&Ends; 2],
    packet: &Packet,
    from: usize,
) -> (u32, u32) {
    let (sure, maybe) = match profile {
        Profile::Patch => pierce_patch::<false>(plate, block, packet, from),
        Profile::Oriented => pierce_patch::<true>(plate, block, packet, from),
        Profile::Paper => pierce_paper(plate, packet, from),
    };
    (mask_of(&sure) as u32, mask_of(&maybe) as u32)
}

#[inline(always)]
fn pierce_patch<const IS_CUT: bool>(
    plate: &Plate,
    block: [&Ends; 2],
    packet: &Packet,
    from: usize,
) -> ([u64; HALF], [u64; HALF]) {
    let Plate { normal, offset, centroid: c, radius2, margin: margin_k, low, high, cut } = *plate;
    let ([ax, ay, az], [bx, by, bz]) = half_of(packet, from);
    let (mut sures, mut maybes) = ([0; HALF], [0; HALF]);
    for k in 0..HALF {
        let (a, b) = ([ax[k], ay[k], az[k]], [bx[k], by[k], bz[k]]);
        let d = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
        let d2 = dot(d, d);
        let (here, there) = (dot(normal, a) - offset, dot(normal, b) - offset);
        // Where the signs agree t is no share of the segment, or NaN, and never is.
        let t = here / (here - there);
        let x = [a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]];
        let v = [x[0] - c[0], x[1] - c[1], x[2] - c[2]];
        let inside = radius2 - dot(v, v);
        let boxed = less(
            less(less(x[0] - low[0], high[0] - x[0]), less(x[1] - low[1], high[1] - x[1])),
            less(x[2] - low[2], high[2] - x[2]),
        );
        let rest = 1.0 - t;
        let spared_a = block[0].spared2[packet.row[from + k] as usize % MAX_ENDS];
        let spared_b = block[1].spared2[packet.column[from + k] as usize % MAX_ENDS];
        let (from_a, from_b) = (t * t * d2 - spared_a, rest * rest * d2 - spared_b);
        let margin_a = margin(packet.spared[0][from + k].into());
        let margin_b = margin(packet.spared[1][from + k].into());
        let maybe = (here * there < 0.0)
            & (inside >= -margin_k)
            & (boxed >= -EPSILON)
            & (from_a >= -margin_a)
            & (from_b >= -margin_b);
        let sure = maybe
            & (inside > margin_k)
            & (boxed > EPSILON)
            & (from_a > margin_a)
            & (from_b > margin_b);
        // Nothing limits a patch here.
        let along = if IS_CUT { cut.within(v) } else { 1.0 };
        sures[k] = all_bits(sure & (along > ALONG));
        maybes[k] = all_bits(maybe & (along >= -ALONG));
    }
    (sures, maybes)
}

/// Whether a segment meets the cell is exact: its six separating axes stay below 2^50.
#[inline(always)]
fn pierce_paper(plate: &Plate, packet: &Packet, from: usize) -> ([u64; HALF], [u64; HALF]) {
    let Plate { normal, offset, centroid: c, radius2, margin, low, high, .. } = *plate;
    let side = [high[0] - low[0], high[1] - low[1], high[2] - low[2]];
    let ([ax, ay, az], [bx, by, bz]) = half_of(packet, from);
    let (mut sures, mut maybes) = ([0; HALF], [0; HALF]);
    for k in 0..HALF {
        let (a, b) = ([ax[k], ay[k], az[k]], [bx[k], by[k], bz[k]]);
        let d = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
        let (here, there) = (dot(normal, a) - offset, dot(normal, b) - offset);
        let t = here / (here - there);
        let v = [a[0] + t * d[0] - c[0], a[1] + t * d[1] - c[1], a[2] + t * d[2] - c[2]];
        let inside = radius2 - dot(v, v);
        let size = [d[0].abs(), d[1].abs(), d[2].abs()];
        // Twice the way from the cell's middle to the segment's.
        let u = [
            a[0] + b[0] - low[0] - high[0],
            a[1] + b[1] - low[1] - high[1],
            a[2] + b[2] - low[2] - high[2],
        ];
        let meets = (u[0].abs() <= side[0] + size[0])
            & (u[1].abs() <= side[1] + size[1])
            & (u[2].abs() <= side[2] + size[2])
            & ((u[1] * d[2] - u[2] * d[1]).abs() <= side[1] * size[2] + side[2] * size[1])
            & ((u[2] * d[0] - u[0] * d[2]).abs() <= side[2] * size[0] + side[0] * size[2])
            & ((u[0] * d[1] - u[1] * d[0]).abs() <= side[0] * size[1] + side[1] * size[0]);
        let crosses = (here * there < 0.0) & meets;
        sures[k] = all_bits(crosses & (inside > margin));
        maybes[k] = all_bits(crosses & (inside >= -margin));
    }
    (sures, maybes)
}
