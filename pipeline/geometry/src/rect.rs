//! The rectangle in its plane to which profile `oriented` cuts a disc, along the main axes of the
//! points it stands for. [F-22]
//!
//! All is in integers. Sizes: an offset from the centroid is below 2^22 an axis and an axis has
//! length 2^14, so a product of both is below 2^38, its square below 2^76 and the sum over 2^34
//! points below 2^110.

use crate::normal::{self, NORMAL_LENGTH, Normal};

/// What a disc is cut to: places whose offsets from the centroid, along two axes in the plane, lie
/// between two bounds each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rect {
    /// Two directions of length 2^14 in the plane; zero ones cut nothing.
    pub axes: [Normal; 2],
    /// The least offsets, grid steps.
    pub low: [i32; 2],
    /// The greatest.
    pub high: [i32; 2],
}

impl Rect {
    /// Cuts nothing off.
    pub const NONE: Rect = Rect { axes: [[0; 3]; 2], low: [0; 2], high: [0; 2] };

    /// Starts at the centroid; [`Self::hold`] makes room.
    pub fn along(axes: [Normal; 2]) -> Rect {
        Rect { axes, ..Rect::NONE }
    }

    /// Grows as far as a place needs, in whole steps; the place by its offset from the centroid.
    pub fn hold(&mut self, offset: [i64; 3]) {
        for i in 0..2 {
            // Below 2^38 before the division.
            let along = dot(self.axes[i], offset);
            let steps = along.div_euclid(NORMAL_LENGTH.into());
            let up = i64::from(along % i64::from(NORMAL_LENGTH) != 0);
            self.low[i] = self.low[i].min(steps as i32);
            self.high[i] = self.high[i].max((steps + up) as i32);
        }
    }

    /// Gives it with so many steps more on every side; one that cuts nothing stays as it is.
    pub fn grown(&self, steps: i32) -> Rect {
        if self.axes == Rect::NONE.axes {
            return *self;
        }
        Rect { low: self.low.map(|v| v - steps), high: self.high.map(|v| v + steps), ..*self }
    }

    /// Says whether the offset e/s from the centroid lies in it, s > 0.
    ///
    /// Exact: with |e| < 2^62 and s < 2^38 both sides stay below 2^80.
    #[inline]
    pub fn holds(&self, e: [i64; 3], s: i64) -> bool {
        let step = i128::from(s) * i128::from(NORMAL_LENGTH);
        (0..2).all(|i| {
            let along: i128 = (0..3).map(|j| i128::from(self.axes[i][j]) * i128::from(e[j])).sum();
            i128::from(self.low[i]) * step <= along && along <= i128::from(self.high[i]) * step
        })
    }
}

/// How places spread over a plane around a place in it.
#[derive(Debug, Clone)]
pub struct Moments {
    normal: Normal,
    /// Perpendicular directions in the plane, x and y.
    frame: [Normal; 2],
    /// Σx², Σy² and Σxy.
    xx: i128,
    yy: i128,
    xy: i128,
}

impl Moments {
    /// Starts without places in the plane of a normal that is not zero.
    pub fn new(normal: Normal) -> Moments {
        // The axis after the dominant one, made perpendicular to the normal: |n|²·a - n_a·n.
        let n = normal.map(i64::from);
        let a = (normal::dominant_axis(normal) + 1) % 3;
        let mut x = n.map(|v| -n[a] * v);
        x[a] += n.iter().map(|v| v * v).sum::<i64>();
        let x = normal::rescale(x);
        let frame = [x, normal::rescale(cross(normal, x))];
        Moments { normal, frame, xx: 0, yy: 0, xy: 0 }
    }

    /// Adds a place by its offset.
    pub fn add(&mut self, offset: [i64; 3]) {
        let [x, y] = self.frame.map(|axis| i128::from(dot(axis, offset)));
        self.xx += x * x;
        self.yy += y * y;
        self.xy += x * y;
    }

    /// Gives the direction in which they spread most and the one across, both in the plane and of
    /// length 2^14.
    ///
    /// The first has half the angle of (Σx² - Σy², 2·Σxy); where both are zero it is x.
    pub fn axes(&self) -> [Normal; 2] {
        let (p, q) = (self.xx - self.yy, 2 * self.xy);
        let n_bits = u128::BITS - p.unsigned_abs().max(q.unsigned_abs()).leading_zeros();
        // To 30 bits, so that what follows fits.
        let shift = n_bits.saturating_sub(30);
        let (p, q) = ((p >> shift) as i64, (q >> shift) as i64);
        let r = ((p * p + q * q) as u64).isqrt() as i64;
        let (c, s) = match (p, q) {
            (0, 0) => (1, 0),
            (0.., _) => (r + p, q),
            _ => (q, r - p),
        };
        let [x, y] = self.frame;
        // Below 2^32·2^14, twice.
        let most = [0, 1, 2].map(|i| c * i64::from(x[i]) + s * i64::from(y[i]));
        let most = normal::rescale(most);
        [most, normal::rescale(cross(self.normal, most))]
    }
}

fn dot(axis: Normal, offset: [i64; 3]) -> i64 {
    (0..3).map(|i| i64::from(axis[i]) * offset[i]).sum()
}

fn cross(n: Normal, m: Normal) -> [i64; 3] {
    [0, 1, 2].map(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        i64::from(n[j]) * i64::from(m[k]) - i64::from(n[k]) * i64::from(m[j])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastrand::Rng;

    /// Makes places that spread over a plane, `ratio` times as far along one direction as across.
    fn places(rng: &mut Rng, normal: Normal, turn: f64, ratio: f64) -> Vec<[i64; 3]> {
        let [x, y] = Moments::new(normal).frame.map(|a| a.map(|v| f64::from(v) / 16384.0));
        let size = f64::from(1 << rng.u32(8..=20));
        let mut place = |_| {
            let (far, wide) = (rng.f64() * 2.0 - 1.0, (rng.f64() * 2.0 - 1.0) / ratio);
            let at = [far * turn.cos() - wide * turn.sin(), far * turn.sin() + wide * turn.cos()];
            [0, 1, 2].map(|i| (size * (at[0] * x[i] + at[1] * y[i])) as i64)
        };
        (0..400).map(&mut place).collect()
    }

    #[test]
    fn f22_the_first_axis_is_the_one_along_which_points_spread() {
        let mut rng = Rng::with_seed(22);
        for _ in 0..300 {
            let normal = normal::rescale([0; 3].map(|_| rng.i64(-99..=99)));
            if normal == [0; 3] {
                continue;
            }
            let turn = rng.f64() * std::f64::consts::TAU;
            let mut moments = Moments::new(normal);
            let places = places(&mut rng, normal, turn, 5.0);
            places.iter().for_each(|&place| moments.add(place));
            let axes = moments.axes();
            let [x, y] = moments.frame;
            for (axis, turn) in axes.into_iter().zip([turn, turn + std::f64::consts::FRAC_PI_2]) {
                let expected =
                    [0, 1, 2].map(|i| f64::from(x[i]) * turn.cos() + f64::from(y[i]) * turn.sin());
                let along: f64 = (0..3).map(|i| f64::from(axis[i]) * expected[i]).sum();
                assert!(along.abs() > 0.995 * f64::from(1 << 28), "{axes:?} {expected:?}");
                // In the plane, and of length 2^14, but for roundings.
                assert!(dot(axis, normal.map(i64::from)).abs() < 1 << 16, "{axes:?} {normal:?}");
                let length2 = dot(axis, axis.map(i64::from));
                assert!((length2 - (1 << 28)).abs() < 1 << 15, "{axes:?}");
            }
            assert!(dot(axes[0], axes[1].map(i64::from)).abs() < 1 << 16, "{axes:?}");
        }
    }

    #[test]
    fn f22_places_all_alike_spread_along_the_axis_after_the_dominant_one() {
        let mut moments = Moments::new([0, 0, 1 << 14]);
        assert_eq!(moments.axes(), [[1 << 14, 0, 0], [0, 1 << 14, 0]]);
        for [x, y] in [[5, 5], [-5, 5], [5, -5], [-5, -5]] {
            moments.add([x, y, 0]);
        }
        assert_eq!(moments.axes(), [[1 << 14, 0, 0], [0, 1 << 14, 0]]);
        moments.add([0, 7, 0]);
        assert_eq!(moments.axes(), [[0, 1 << 14, 0], [-(1 << 14), 0, 0]]);
    }

    #[test]
    fn f22_the_largest_sums_fit() {
        let far = (1 << 22) - 1;
        for sign in [-1, 1] {
            let mut moments = Moments::new([16384, 1, 1]);
            moments.add([far, sign * far, far]);
            // As many as a cube can hold, by the sums alone.
            for sum in [&mut moments.xx, &mut moments.yy, &mut moments.xy] {
                *sum <<= 34;
            }
            let [most, _] = moments.axes();
            assert!(dot(most, [0, sign, 1]).abs() > 23_000, "{most:?}");
        }
    }

    #[test]
    fn f22_held_places_are_inside_and_one_step_beyond_is_not() {
        let mut rng = Rng::with_seed(3);
        for _ in 0..300 {
            let normal = normal::rescale([rng.i64(1..99), rng.i64(-99..=99), rng.i64(-99..=99)]);
            let turn = rng.f64();
            let places = places(&mut rng, normal, turn, 2.0);
            let mut moments = Moments::new(normal);
            places.iter().for_each(|&place| moments.add(place));
            let mut rect = Rect::along(moments.axes());
            places.iter().for_each(|&place| rect.hold(place));
            let s = rng.i64(1..1 << 20);
            for place in &places {
                assert!(rect.holds(place.map(|v| v * s), s), "{place:?} {rect:?}");
            }
            // The bounds are those of the farthest places, and grow with the margin.
            for i in 0..2 {
                let axis = rect.axes[i];
                let last = places.iter().max_by_key(|&&p| dot(axis, p)).expect("places");
                assert!(i64::from(rect.high[i] - 1) << 14 < dot(axis, *last).max(1));
                let s = s << 14;
                let out = [0, 1, 2].map(|j| last[j] * s + 3 * (s >> 14) * i64::from(axis[j]));
                assert!(!rect.holds(out, s), "{out:?} {rect:?}");
                assert!(rect.grown(4).holds(out, s), "{out:?} {rect:?}");
            }
        }
        assert!(Rect::NONE.grown(9).holds([i64::MAX >> 2; 3], 1));
    }
}
