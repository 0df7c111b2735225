//! The plane through a neighbourhood: exact sums, exact rank test, direction of least spread.

use crate::normal::{Normal, quantise};

/// Squarings after which two least eigenvalues that differ by one part in 10^8 are told apart.
const MAX_SQUARINGS: usize = 32;

/// Share of the other directions below which a squared matrix counts as one direction: far below
/// the 2^-15 at which a quantised component rounds.
const ONE_DIRECTION: f64 = 1e-10;

/// Sums over at most 16 points of their offsets from one of them, in grid steps (< 2^22 each).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Moments {
    n: i64,
    sum: [i64; 3],
    /// Σ of xx, xy, xz, yy, yz, zz: below 16 · 2^44.
    products: [i64; 6],
}

/// The plane through some points, in the sense of least squares.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// Of length 1, with any sign.
    pub normal: [f64; 3],
    /// Σ of the squared distances of the points from it, grid steps².
    pub residual2: f64,
}

impl Moments {
    /// Adds `count` points at offset `d`.
    #[inline]
    pub fn add(&mut self, d: [i64; 3], count: i64) {
        let [x, y, z] = d.map(|v| v * count);
        self.n += count;
        self.sum = [self.sum[0] + x, self.sum[1] + y, self.sum[2] + z];
        for (p, v) in self.products.iter_mut().zip([
            x * d[0],
            x * d[1],
            x * d[2],
            y * d[1],
            y * d[2],
            z * d[2],
        ]) {
            *p += v;
        }
    }

    /// Gives the quantised normal with any sign; `None` when the points are collinear or
    /// coincident, exactly.
    ///
    /// The adjugate of the covariance has the same eigenvectors, and its largest eigenvalue is the
    /// product of the covariance's two largest: its dominant eigenvector is the normal. Its entries
    /// are exact integers, so a plane that is nearly a line loses nothing, and squaring it again
    /// and again leaves that eigenvector alone. Only + - × ÷ on f64: the same on every host.
    pub fn normal(&self) -> Option<Normal> {
        // The way through f32 costs 2^-24 of the length, far below what quantising rounds away.
        quantise(self.direction()?.map(|v| v as f32))
    }

    /// Gives the plane that [`Moments::normal`] is of, with what quantising would round away;
    /// `None` when the points are collinear or coincident, exactly.
    pub fn plane(&self) -> Option<Plane> {
        let n = self.direction()?;
        let length = n.iter().map(|v| v * v).sum::<f64>().sqrt();
        let normal = n.map(|v| v / length);
        let [xx, xy, xz, yy, yz, zz] = self.scatter().map(|v| v as f64);
        let turned = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
            .map(|row| (0..3).map(|i| row[i] * normal[i]).sum::<f64>());
        let sum = (0..3).map(|i| turned[i] * normal[i]).sum::<f64>() / self.n as f64;
        // Rounding may leave a plane without thickness a little less than none.
        Some(Plane { normal, residual2: sum.max(0.0) })
    }

    /// Gives the direction of least spread, of any length and sign.
    fn direction(&self) -> Option<[f64; 3]> {
        let adjugate = self.adjugate();
        let [xx, _, _, yy, _, zz] = adjugate;
        // The covariance has no negative eigenvalue, so the sum of its principal minors (each ≥ 0)
        // is zero exactly when at most one eigenvalue is not.
        let trace = xx + yy + zz;
        (trace > 0).then(|| dominant(adjugate.map(|v| v as f64 / trace as f64)))
    }

    /// Gives n·Σ g gᵀ - Σg Σgᵀ as xx, xy, xz, yy, yz, zz: below 16 · 16 · 2^44 = 2^52.
    fn scatter(&self) -> [i64; 6] {
        let [sx, sy, sz] = self.sum;
        let p = self.products.map(|v| v * self.n);
        let [xx, xy, xz] = [p[0] - sx * sx, p[1] - sx * sy, p[2] - sx * sz];
        [xx, xy, xz, p[3] - sy * sy, p[4] - sy * sz, p[5] - sz * sz]
    }

    /// Gives the adjugate of the scatter, in the same order: below 2^106.
    fn adjugate(&self) -> [i128; 6] {
        let [xx, xy, xz, yy, yz, zz] = self.scatter();
        let minor = |a: i64, b: i64, c: i64, d: i64| {
            i128::from(a) * i128::from(b) - i128::from(c) * i128::from(d)
        };
        [
            minor(yy, zz, yz, yz),
            minor(xz, yz, xy, zz),
            minor(xy, yz, xz, yy),
            minor(xx, zz, xz, xz),
            minor(xy, xz, xx, yz),
            minor(xx, yy, xy, xy),
        ]
    }
}

/// Gives the dominant eigenvector of a symmetric matrix (xx, xy, xz, yy, yz, zz) of trace 1 whose
/// eigenvalues are ≥ 0; some vector of the eigenspace where the largest is double.
fn dominant(mut m: [f64; 6]) -> [f64; 3] {
    for _ in 0..MAX_SQUARINGS {
        let [xx, xy, xz, yy, yz, zz] = m;
        let square = [
            xx * xx + xy * xy + xz * xz,
            xx * xy + xy * yy + xz * yz,
            xx * xz + xy * yz + xz * zz,
            xy * xy + yy * yy + yz * yz,
            xy * xz + yy * yz + yz * zz,
            xz * xz + yz * yz + zz * zz,
        ];
        let trace = square[0] + square[3] + square[5];
        let scale = 1.0 / trace;
        m = square.map(|v| v * scale);
        // The trace of the square is Σλ²: 1 when one eigenvalue has it all.
        if trace > 1.0 - ONE_DIRECTION {
            break;
        }
    }
    let [xx, xy, xz, yy, yz, zz] = m;
    // Every row is the eigenvector times one of its components: the largest is the best.
    if xx >= yy && xx >= zz {
        [xx, xy, xz]
    } else if yy >= zz {
        [xy, yy, yz]
    } else {
        [xz, yz, zz]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn normal(points: &[[i64; 3]]) -> Option<Normal> {
        let mut moments = Moments::default();
        points.iter().for_each(|&p| moments.add(p, 1));
        moments.normal()
    }

    /// Gives |n·(p - mean)| at its root mean square over |n|: what the least eigenvector minimises.
    fn spread(points: &[[i64; 3]], n: [f64; 3]) -> f64 {
        let count = points.len() as f64;
        let height = |p: &[i64; 3]| (0..3).map(|i| p[i] as f64 * n[i]).sum::<f64>();
        let mean = points.iter().map(height).sum::<f64>() / count;
        let sum: f64 = points.iter().map(|p| (height(p) - mean) * (height(p) - mean)).sum();
        (sum / count / n.iter().map(|v| v * v).sum::<f64>()).sqrt()
    }

    #[test]
    fn a_sliver_of_a_plane_keeps_its_normal() {
        // 3·10^6 steps long, one step wide: the eigenvalues differ by 10^13.
        let points: Vec<_> = (0..16).map(|i| [i * 200_000, i % 2, -(i % 2)]).collect();
        let n = normal(&points).expect("not a line");
        assert_eq!((n[0].abs(), n[1], n[1].abs()), (0, n[2], 11585));
    }

    #[test]
    fn the_residual_is_that_of_the_distances() {
        // Three above a floor, three below, a slope of 1 in 7: (7, 0, -1) across.
        let points: Vec<_> = (0..16i64)
            .map(|i| (i % 4 * 700, i / 4 * 500, [3, -3, 0, 0][(i % 4 + i / 4) as usize % 4]))
            .map(|(x, y, off)| [x - off, y, x / 7 + 7 * off])
            .collect();
        let mut moments = Moments::default();
        points.iter().for_each(|&p| moments.add(p, 1));
        let plane = moments.plane().expect("not a line");
        let n = plane.normal;
        assert!((n.iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 1e-12);
        let expected = spread(&points, n).powi(2) * 16.0;
        assert!((plane.residual2 / expected - 1.0).abs() < 1e-6, "{plane:?} {expected}");
        let flat: Vec<_> = (0..16i64).map(|i| [i % 4 * 9000, i / 4 * 9000, i % 4 * 3000]).collect();
        let mut moments = Moments::default();
        flat.iter().for_each(|&p| moments.add(p, 1));
        let plane = moments.plane().expect("not a line");
        assert!(plane.residual2 < 1e-3 && (plane.normal[2] / plane.normal[0] + 3.0).abs() < 1e-6);
        assert_eq!(Moments::default().plane(), None);
    }

    #[test]
    fn an_even_spread_has_some_normal() {
        let corners: Vec<_> = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2]).collect();
        assert!(normal(&corners).is_some());
        let wide: Vec<_> = (0..8).map(|i| [i & 1, i >> 1 & 1, 7 * (i >> 2)]).collect();
        assert_eq!(normal(&wide).expect("not a line")[2], 0, "across the long axis");
    }

    #[test]
    fn the_largest_sums_do_not_overflow() {
        let far = (1 << 22) - 1;
        let corner = |i: i64| [0, 1, 2].map(|a| if i >> a & 1 == 1 { far } else { -far });
        assert!(normal(&(0..16).map(corner).collect::<Vec<_>>()).is_some());
        assert_eq!(normal(&[[far; 3]; 16]), None);
    }

    proptest! {
        #[test]
        fn no_direction_near_the_normal_has_less_spread(
            points in prop::collection::vec(prop::array::uniform3(-4000i64..4000), 4..16),
            flat in 1i64..1000,
            turn in prop::array::uniform3(-1.0f64..1.0),
        ) {
            let points: Vec<_> = points.iter().map(|p| [p[0], p[1], p[2] / flat]).collect();
            if let Some(n) = normal(&points) {
                let n = n.map(f64::from);
                let turned = [0, 1, 2].map(|i| n[i] + 3000.0 * turn[i]);
                // Quantising turns the normal by up to 2^-14, over points that span 8000.
                prop_assert!(spread(&points, n) <= spread(&points, turned) + 0.5);
            }
        }

        #[test]
        fn points_on_a_line_have_no_normal(
            step in prop::array::uniform3(-1000i64..1000),
            at in prop::collection::vec(-1000i64..1000, 1..16),
        ) {
            let points: Vec<_> = at.iter().map(|t| step.map(|s| s * t)).collect();
            prop_assert_eq!(normal(&points), None);
        }
    }
}
