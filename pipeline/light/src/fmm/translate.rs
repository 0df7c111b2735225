//! The field of some places at others.

use std::f64::consts::PI;

use multiversion::multiversion;

use crate::kernel::{LANES, eight};

/// Places, or vectors at them: an array for each coordinate.
pub(crate) type Triple<'a> = [&'a [f64]; 3];

/// Adds the field of vectors m at the sources to that at the targets:
/// f_i += sign Σ_j r (r·m_j) / (r² (π r² + c)), r = x_j - x_i (M2L, and what joins a grid with
/// elements).
///
/// `softening` is c times the areas of both ends, those of elements or the middle of those that a
/// grid stands for. r is never 0: what is far apart only comes here.
pub(crate) fn translate(
    to: Triple<'_>,
    from: (Triple<'_>, Triple<'_>),
    softening: f64,
    sign: f64,
    field: &mut [&mut [f64]; 3],
) {
    if to[0].len() >= LANES {
        by_targets(to, from, softening, sign, field);
    } else {
        by_sources(to, from, softening, sign, field);
    }
}

#[multiversion(targets = "simd")]
fn by_targets(
    to: Triple<'_>,
    from: (Triple<'_>, Triple<'_>),
    softening: f64,
    sign: f64,
    field: &mut [&mut [f64]; 3],
) {
    let ([x, y, z], [fx, fy, fz]) = (to, field);
    let n = x.len();
    let (x, y, z) = (&x[..n], &y[..n], &z[..n]);
    let (fx, fy, fz) = (&mut fx[..n], &mut fy[..n], &mut fz[..n]);
    let ([px, py, pz], [mx, my, mz]) = from;
    for j in 0..px.len() {
        let (s, m) = ([px[j], py[j], pz[j]], [sign * mx[j], sign * my[j], sign * mz[j]]);
        for i in 0..n {
            let r = [s[0] - x[i], s[1] - y[i], s[2] - z[i]];
            let k = factor(r, m, softening);
            fx[i] += k * r[0];
            fy[i] += k * r[1];
            fz[i] += k * r[2];
        }
    }
}

#[multiversion(targets = "simd")]
fn by_sources(
    to: Triple<'_>,
    from: (Triple<'_>, Triple<'_>),
    softening: f64,
    sign: f64,
    field: &mut [&mut [f64]; 3],
) {
    let ([x, y, z], [u, v, w]) = from;
    let n = x.len();
    let whole = n - n % LANES;
    for i in 0..to[0].len() {
        let t = [to[0][i], to[1][i], to[2][i]];
        let mut sums = [[0.0; LANES]; 3];
        let mut j = 0;
        while j < whole {
            let places = [eight(x, j), eight(y, j), eight(z, j)];
            add(t, places, [eight(u, j), eight(v, j), eight(w, j)], softening, &mut sums);
            j += LANES;
        }
        if whole < n {
            // Places without a vector, as far away as the first, fill up the last ones.
            let mut rest = [[x[0]; LANES], [y[0]; LANES], [z[0]; LANES]];
            let mut vectors = [[0.0; LANES]; 3];
            for j in whole..n {
                let lane = j - whole;
                (rest[0][lane], rest[1][lane], rest[2][lane]) = (x[j], y[j], z[j]);
                (vectors[0][lane], vectors[1][lane], vectors[2][lane]) = (u[j], v[j], w[j]);
            }
            let ([x, y, z], [u, v, w]) = (&rest, &vectors);
            add(t, [x, y, z], [u, v, w], softening, &mut sums);
        }
        for axis in 0..3 {
            let mut sum = 0.0;
            for lane in 0..LANES {
                sum += sums[axis][lane];
            }
            field[axis][i] += sign * sum;
        }
    }
}

/// Adds the field of eight sources at a target.
#[inline(always)]
fn add(
    t: [f64; 3],
    places: [&[f64; LANES]; 3],
    vectors: [&[f64; LANES]; 3],
    softening: f64,
    sums: &mut [[f64; LANES]; 3],
) {
    let ([x, y, z], [u, v, w]) = (places, vectors);
    for lane in 0..LANES {
        let r = [x[lane] - t[0], y[lane] - t[1], z[lane] - t[2]];
        let k = factor(r, [u[lane], v[lane], w[lane]], softening);
        sums[0][lane] += k * r[0];
        sums[1][lane] += k * r[1];
        sums[2][lane] += k * r[2];
    }
}

/// Gives (r·m) / (r² (π r² + c)).
#[inline(always)]
fn factor(r: [f64; 3], m: [f64; 3], softening: f64) -> f64 {
    let r2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
    (r[0] * m[0] + r[1] * m[1] + r[2] * m[2]) / (r2 * (PI * r2 + softening))
}
