//! Normals as integers of length 2^14: quantised, given a canonical sign, sorted into bins.

/// The nominal length of a quantised normal.
pub const NORMAL_LENGTH: i32 = 1 << 14;

/// A direction as three integers of length about 2^14 (each at most 2^14), or all zero.
pub type Normal = [i16; 3];

/// The bin of points without a normal.
pub const BIN_NONE: u8 = 6;

/// Quantises a direction of any length to length 2^14; zero or not finite is "no normal".
///
/// Each component is n / |n| · 2^14 rounded half away from zero. In f64 the square of no f32
/// overflows or vanishes, so lengths from 1e-38 to 1e38 count alike.
#[inline]
pub fn quantise(n: [f32; 3]) -> Option<Normal> {
    let [x, y, z] = [f64::from(n[0]), f64::from(n[1]), f64::from(n[2])];
    let norm2 = x * x + y * y + z * z;
    // For the same reason this is `is_direction`.
    if !(norm2 > 0.0 && norm2 < f64::INFINITY) {
        return None;
    }
    let length = norm2.sqrt();
    let scaled = |v: f64| round_half_away(v / length * f64::from(NORMAL_LENGTH));
    Some([scaled(x), scaled(y), scaled(z)])
}

/// Says whether a vector has a direction: it is finite and not zero.
#[inline]
pub fn is_direction(n: [f32; 3]) -> bool {
    n[0].is_finite() && n[1].is_finite() && n[2].is_finite() && n != [0.0; 3]
}

/// Rounds a number below 2^15 exactly as `f64::round`, which is a call on plain x86-64.
#[inline(always)]
fn round_half_away(v: f64) -> i16 {
    let whole = v as i32;
    let rest = v - f64::from(whole);
    (whole + i32::from(rest >= 0.5) - i32::from(rest <= -0.5)) as i16
}

/// Rescales an integer vector to length 2^14, each component rounded half away from zero,
/// exactly; zero stays zero. Components are below 2^48 (2^34 points of length 2^14).
pub fn rescale(sum: [i64; 3]) -> Normal {
    let norm2: i128 = sum.iter().map(|&v| i128::from(v) * i128::from(v)).sum();
    if norm2 == 0 {
        return [0; 3];
    }
    let length = (norm2 as f64).sqrt();
    sum.map(|v| {
        let size = i128::from(v.unsigned_abs());
        let guess = (v.unsigned_abs() as f64 / length * f64::from(NORMAL_LENGTH)).round() as i128;
        // q is right when (q - 1/2)·|s| ≤ |v|·2^14 < (q + 1/2)·|s|; both sides doubled and squared.
        let target = {
            let t = size << 15;
            t * t
        };
        let reaches = |q: i128| q <= 0 || (2 * q - 1) * (2 * q - 1) * norm2 <= target;
        let mut q = guess;
        while !reaches(q) {
            q -= 1;
        }
        while reaches(q + 1) {
            q += 1;
        }
        if v < 0 { -(q as i16) } else { q as i16 }
    })
}

/// Gives the axis of the largest |component|, the lowest axis on ties.
#[inline]
pub fn dominant_axis<T: Into<i64> + Copy>(v: [T; 3]) -> usize {
    let a = v.map(|c| c.into().unsigned_abs());
    let first = usize::from(a[1] > a[0]);
    if a[2] > a[first] { 2 } else { first }
}

/// Gives a normal of unknown orientation the sign that makes its component along `axis` positive;
/// where that is zero, its first component that is not.
#[inline]
pub fn canonical(n: Normal, axis: usize) -> Normal {
    let key = if n[axis] != 0 { n[axis] } else { n.into_iter().find(|&c| c != 0).unwrap_or(0) };
    if key < 0 { n.map(|c| -c) } else { n }
}

/// Gives the canonical sign used by the `binned` tree: the largest |component| is positive.
#[inline]
pub fn canonical_binned(n: Normal) -> Normal {
    canonical(n, dominant_axis(n))
}

/// Gives a point's bin: 0…5 = +x, -x, +y, -y, +z, -z; unoriented 0, 2, 4; [`BIN_NONE`] without.
#[inline]
pub fn bin(n: Normal, oriented: bool) -> u8 {
    if n == [0; 3] {
        return BIN_NONE;
    }
    let axis = dominant_axis(n);
    2 * axis as u8 + u8::from(oriented && n[axis] < 0)
}

/// Gives the quadrant (0…3) of a normal about `axis`: (n_u < 0) + 2·(n_v < 0), where u and v
/// follow the axis in cyclic order.
#[inline]
pub fn quadrant(n: Normal, axis: usize) -> u8 {
    u8::from(n[(axis + 1) % 3] < 0) + 2 * u8::from(n[(axis + 2) % 3] < 0)
}

/// Says whether `n` is more than 30° from the sum `m`: n·m < 0 or 4(n·m)² < 3|n|²|m|².
#[inline]
pub fn strays(n: Normal, m: [i64; 3]) -> bool {
    let dot: i128 = (0..3).map(|i| i128::from(n[i]) * i128::from(m[i])).sum();
    let n2: i128 = n.iter().map(|&v| i128::from(v) * i128::from(v)).sum();
    let m2: i128 = m.iter().map(|&v| i128::from(v) * i128::from(v)).sum();
    dot < 0 || 4 * dot * dot < 3 * n2 * m2
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn n28_lengths_from_tiny_to_huge_count_alike() {
        for k in [1e-38f32, 1e-20, 1.0, 1e20, 1e37] {
            assert_eq!(quantise([3.0 * k, 0.0, 4.0 * k]), Some([9830, 0, 13107]));
        }
        // Any direction, of any length that a float has: within one unit of the exact one. Of
        // floats squares and their sums are good to 2^-50 in doubles.
        let mut rng = fastrand::Rng::with_seed(28);
        for _ in 0..100_000 {
            let scale = 2f32.powi(rng.i32(-100..=100));
            let v = [0; 3].map(|_| (rng.f32() - 0.5) * scale);
            let wide = v.map(f64::from);
            let length = wide.iter().map(|c| c * c).sum::<f64>().sqrt();
            let found = quantise(v).expect("a direction");
            for i in 0..3 {
                let exact = wide[i] / length * f64::from(NORMAL_LENGTH);
                assert!((f64::from(found[i]) - exact).abs() <= 1.0, "{v:?} {found:?}");
            }
        }
    }

    #[test]
    fn n29_a_broken_normal_is_no_normal() {
        for bad in [[0.0; 3], [f32::NAN, 1.0, 0.0], [0.0, f32::INFINITY, 0.0], [-0.0; 3]] {
            assert_eq!(quantise(bad), None);
            assert!(!is_direction(bad));
        }
        assert!(is_direction([0.0, f32::from_bits(1), 0.0]));
        assert_eq!(quantise([0.0, f32::from_bits(1), 0.0]), Some([0, 1 << 14, 0]));
        assert_eq!(quantise([f32::MAX; 3]), Some([9459; 3]));
    }

    #[test]
    fn bins_follow_the_lowest_axis_on_ties() {
        assert_eq!(bin([5, 5, 0], true), 0);
        assert_eq!(bin([-5, 5, 0], true), 1);
        assert_eq!(bin([-5, 5, 0], false), 0);
        assert_eq!(bin([0, -5, 5], true), 3);
        assert_eq!(bin([0, 4, -5], true), 5);
        assert_eq!(bin([0, 4, -5], false), 4);
        assert_eq!(bin([0; 3], true), BIN_NONE);
        assert_eq!(canonical_binned([-5, 5, 1]), [5, -5, -1]);
        assert_eq!(quadrant([1, -1, 2], 2), 2);
        assert_eq!(quadrant([-1, 1, 2], 2), 1);
    }

    proptest! {
        #[test]
        fn rescaling_rounds_half_away(v in prop::array::uniform3(-(1i64 << 47)..1 << 47)) {
            let q = rescale(v);
            let norm2: i128 = v.iter().map(|&c| i128::from(c) * i128::from(c)).sum();
            for i in 0..3 {
                // (2|q| - 1)·|s| ≤ 2|v|·2^14 < (2|q| + 1)·|s|, squared.
                let t = i128::from(v[i].unsigned_abs()) << 15;
                let q = i128::from(q[i].unsigned_abs());
                prop_assert!(q == 0 || (2 * q - 1).pow(2) * norm2 <= t * t);
                prop_assert!((2 * q + 1).pow(2) * norm2 > t * t);
            }
        }

        #[test]
        fn a_flipped_unoriented_normal_is_the_same(n in prop::array::uniform3(-100i16..100)) {
            for axis in 0..3 {
                prop_assert_eq!(canonical(n, axis), canonical(n.map(|c| -c), axis));
            }
            prop_assert_eq!(bin(n, false), bin(n.map(|c| -c), false));
        }

        #[test]
        fn thirty_degrees_is_exact(a in 0.0f64..std::f64::consts::PI) {
            let m = [0, 0, 1i64 << 40];
            let n = [(a.sin() * 16384.0) as i16, 0, (a.cos() * 16384.0) as i16];
            let angle = f64::from(n[0]).atan2(f64::from(n[2])).to_degrees();
            prop_assume!((angle - 30.0).abs() > 1e-6);
            prop_assert_eq!(strays(n, m), angle > 30.0);
        }
    }
}
