//! The shaft between two boxes: their convex hull, for throwing away what cannot be between them.
//!
//! The hull of two axis-aligned boxes is cut out by its bounding box and by up to twelve planes,
//! each parallel to an axis, that join a corner edge of one box to the like edge of the other
//! (Haines and Wallace's shaft). Every number is an integer below 2^50 held in an f64, so the
//! tests are exact although they are written in floats.

use crate::bounds::Box3;

/// The convex hull of two boxes.
#[derive(Debug, Clone)]
pub struct Shaft {
    around: Box3,
    sides: [Side; 12],
    n_sides: usize,
}

/// A half plane of one projection: p·x[u] + q·x[v] ≤ r holds inside the shaft.
#[derive(Debug, Clone, Copy, Default)]
struct Side {
    u: u8,
    v: u8,
    p: f64,
    q: f64,
    r: f64,
}

impl Shaft {
    /// Spans the shaft between two boxes, neither of them empty.
    pub fn new(a: &Box3, b: &Box3) -> Shaft {
        let mut shaft = Shaft { around: a.join(b), sides: [Side::default(); 12], n_sides: 0 };
        for (u, v) in [(0, 1), (1, 2), (2, 0)] {
            for (outer_u, outer_v) in [(-1, -1), (-1, 1), (1, -1), (1, 1)] {
                let (au, av) = (corner(a, u, outer_u), corner(a, v, outer_v));
                let (bu, bv) = (corner(b, u, outer_u), corner(b, v, outer_v));
                let (du, dv) = (outer_u * (bu - au), outer_v * (bv - av));
                // A corner edge is on the hull where one box reaches further along u and the
                // other along v; otherwise one corner hides behind the other.
                if (du > 0 && dv < 0) || (du < 0 && dv > 0) {
                    let p = f64::from(outer_u * dv.abs());
                    let q = f64::from(outer_v * du.abs());
                    let r = p * f64::from(au) + q * f64::from(av);
                    shaft.sides[shaft.n_sides] = Side { u: u as u8, v: v as u8, p, q, r };
                    shaft.n_sides += 1;
                }
            }
        }
        shaft
    }

    /// Proves that a box and the shaft have no place in common; `false` proves nothing.
    #[inline]
    pub fn misses(&self, other: &Box3) -> bool {
        for i in 0..3 {
            if other.min[i] > self.around.max[i] || other.max[i] < self.around.min[i] {
                return true;
            }
        }
        self.sides[..self.n_sides].iter().any(|side| {
            let (u, v) = (usize::from(side.u), usize::from(side.v));
            let x = if side.p > 0.0 { other.min[u] } else { other.max[u] };
            let y = if side.q > 0.0 { other.min[v] } else { other.max[v] };
            side.p * f64::from(x) + side.q * f64::from(y) > side.r
        })
    }
}

/// Gives the coordinate of a box's lower (-1) or upper (1) face along an axis.
fn corner(b: &Box3, axis: usize, outer: i32) -> i32 {
    if outer < 0 { b.min[axis] } else { b.max[axis] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::disc::segment_meets;
    use proptest::prelude::*;

    fn boxes(side: i32) -> impl Strategy<Value = Box3> {
        (prop::array::uniform3(0..100i32), prop::array::uniform3(0..side))
            .prop_map(|(min, size)| Box3 { min, max: [0, 1, 2].map(|i| min[i] + size[i]) })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn what_a_segment_meets_is_never_missed(
            a in boxes(20), b in boxes(20), k in boxes(20),
            s in prop::array::uniform3(0.0f64..=1.0), t in prop::array::uniform3(0.0f64..=1.0),
        ) {
            let inside = |b: &Box3, s: [f64; 3]| {
                [0, 1, 2].map(|i| b.min[i] + ((b.max[i] - b.min[i]) as f64 * s[i]).round() as i32)
            };
            if segment_meets(inside(&a, s), inside(&b, t), &k) {
                prop_assert!(!Shaft::new(&a, &b).misses(&k));
                prop_assert!(!Shaft::new(&b, &a).misses(&k));
            }
        }

        #[test]
        fn a_thin_shaft_misses_what_its_segment_misses(
            a in boxes(1), b in boxes(1), k in boxes(30),
        ) {
            // Between single places the shaft is the segment, and its planes are all the
            // separating axes of a segment and a box.
            let missed = Shaft::new(&a, &b).misses(&k);
            prop_assert_eq!(missed, !segment_meets(a.min, b.min, &k));
        }
    }
}
