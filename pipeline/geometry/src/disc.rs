//! The leaf-pair test, exact: who faces whom [V-1], and who stands between [V-2].
//!
//! Every quantity is an integer of the grid and every comparison is free of division, so a verdict
//! is that of rational arithmetic on the stored integers. Sizes: |n| ≤ 2^14 + 1 (its components are
//! rounded), centroids in 0…2^22 - 1, so a difference of two is below 2^22 an axis and |d| < 2^23.
//! Then |s|, |h| < 2^37; the terms of `e` are below 2^59, those of the patch comparison, with boxes
//! below 2^24, below 2^61: they fit i64 and so do sums of two. |e|² is below 2^122, and with
//! R² < 2^46 the products beside it are below 2^120: they fit i128.

use crate::bounds::Box3;
use crate::normal::Normal;
use crate::rect::Rect;

/// Which shape a surfel blocks with, and near whom it does not. Source: DESIGN.md [V-2].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// §4.1 of the paper: the disc, where the segment meets the leaf's cell.
    Paper,
    /// The disc within the patch box, beyond the discs of the two ends.
    Patch,
    /// The same, within a rectangle in the disc's plane, too. [F-22]
    Oriented,
}

/// What decides visibility of one surfel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Disc {
    /// Mean point, grid steps.
    pub centroid: [i32; 3],
    /// Normal of length 2^14, or zero.
    pub normal: Normal,
    /// Whether both faces count.
    pub two_sided: bool,
    /// Squared radius as the profile uses it, grid steps².
    pub radius2: u64,
    /// The box that limits the disc: the patch box, or the closed cell (`paper`).
    pub limit: Box3,
    /// The rectangle that limits it (`oriented`); [`Rect::NONE`] for the others.
    pub rect: Rect,
}

/// What a disc's plane does to a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Crossing {
    /// Not strictly between the ends, or parallel.
    Never,
    /// At c_a + (h/s)·d with 0 < h < s.
    At { h: i64, s: i64 },
}

/// Decides whether `a` and `b` face each other. Source: DESIGN.md [V-1].
#[inline]
pub fn faces_both(a: &Disc, b: &Disc) -> bool {
    let d = difference(b.centroid, a.centroid);
    d != [0; 3] && looks_along(a, d) && looks_along(b, d.map(|v| -v))
}

/// Decides whether a surfel looks along a direction.
#[inline]
fn looks_along(a: &Disc, d: [i64; 3]) -> bool {
    let s = dot(a.normal, d);
    a.normal == [0; 3] || s > 0 || (a.two_sided && s != 0)
}

/// Decides whether `k` blocks the segment from `a` to `b` (k is neither). Source: DESIGN.md [V-2].
pub fn blocks(profile: Profile, a: &Disc, b: &Disc, k: &Disc) -> bool {
    let d = difference(b.centroid, a.centroid);
    let w = difference(k.centroid, a.centroid);
    let Crossing::At { h, s } = crossing(k.normal, d, w) else {
        return false;
    };
    let e = [0, 1, 2].map(|i| h * d[i] - s * w[i]);
    let s2 = square(s);
    if norm2(e) > i128::from(k.radius2) * s2 {
        return false;
    }
    match profile {
        Profile::Paper => segment_meets(a.centroid, b.centroid, &k.limit),
        Profile::Patch => is_on_patch([a, b, k], d, h, s),
        Profile::Oriented => is_on_patch([a, b, k], d, h, s) && k.rect.holds(e, s),
    }
}

/// Decides whether x = c_a + (h/s)·d is in k's patch box and beyond the discs of both ends.
#[inline(always)]
fn is_on_patch([a, b, k]: [&Disc; 3], d: [i64; 3], h: i64, s: i64) -> bool {
    let (d2, s2) = (norm2(d), square(s));
    (0..3).all(|i| {
        let x = i64::from(a.centroid[i]) * s + h * d[i];
        i64::from(k.limit.min[i]) * s <= x && x <= i64::from(k.limit.max[i]) * s
    }) && square(h) * d2 > i128::from(a.radius2) * s2
        && square(s - h) * d2 > i128::from(b.radius2) * s2
}

/// Finds where a plane through c_k with normal `n` crosses the open segment a + t·d, w = c_k - a.
#[inline]
fn crossing(n: Normal, d: [i64; 3], w: [i64; 3]) -> Crossing {
    let (mut s, mut h) = (dot(n, d), dot(n, w));
    if s < 0 {
        (s, h) = (-s, -h);
    }
    if 0 < h && h < s { Crossing::At { h, s } } else { Crossing::Never }
}

/// Decides whether a closed segment touches a closed box, by the six separating axes.
pub fn segment_meets(a: [i32; 3], b: [i32; 3], limit: &Box3) -> bool {
    let d = difference(b, a);
    // Twice the offset of the middles, and twice the half sides: no halves.
    let t = [0, 1, 2].map(|i| {
        i64::from(a[i]) + i64::from(b[i]) - i64::from(limit.min[i]) - i64::from(limit.max[i])
    });
    let e = [0, 1, 2].map(|i| i64::from(limit.max[i]) - i64::from(limit.min[i]));
    (0..3).all(|i| t[i].abs() <= e[i] + d[i].abs())
        && (0..3).all(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            (t[j] * d[k] - t[k] * d[j]).abs() <= e[j] * d[k].abs() + e[k] * d[j].abs()
        })
}

/// Gives the axis-aligned half sides of a disc, rounded up: |x_i - c_i| ≤ R·√(1 - n_i²/|n|²).
///
/// A disc without a normal never blocks; its half sides are 0.
pub fn half_sides(normal: Normal, radius2: u64) -> [i32; 3] {
    let n = normal.map(i64::from);
    let len2 = n.iter().map(|v| v * v).sum::<i64>();
    if len2 == 0 {
        return [0; 3];
    }
    [0, 1, 2].map(|i| {
        // The quotient R²·(|n|² - n_i²) / |n|² rounded up, then the least r whose square is no
        // less.
        let scaled = u128::from(radius2) * (len2 - n[i] * n[i]) as u128;
        let square = scaled.div_ceil(len2 as u128) as u64;
        let root = square.isqrt();
        (root + u64::from(root * root < square)) as i32
    })
}

#[inline(always)]
fn difference(a: [i32; 3], b: [i32; 3]) -> [i64; 3] {
    [0, 1, 2].map(|i| i64::from(a[i]) - i64::from(b[i]))
}

#[inline(always)]
fn dot(n: Normal, d: [i64; 3]) -> i64 {
    i64::from(n[0]) * d[0] + i64::from(n[1]) * d[1] + i64::from(n[2]) * d[2]
}

#[inline(always)]
fn square(v: i64) -> i128 {
    i128::from(v) * i128::from(v)
}

#[inline(always)]
fn norm2(v: [i64; 3]) -> i128 {
    square(v[0]) + square(v[1]) + square(v[2])
}
