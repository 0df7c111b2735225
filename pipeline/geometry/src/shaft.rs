//! The shaft between two boxes: their convex hull, for throwing away what cannot be between them.
//!
//! The hull of two axis-aligned boxes is cut out by its bounding box and by up to twelve planes,
//! each parallel to an axis, that join a corner edge of one box to the like edge of the other
//! (Haines and Wallace's shaft). Every number is an integer below 2^50 held in an f64, so the
//! tests are exact although they are written in floats.

use crate::bounds::Box3;

/// A box by the sum and the difference of its corners: twice its middle, twice its half sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubled {
    /// max + min, an axis each.
    pub sum: [f64; 3],
    /// max - min, an axis each.
    pub size: [f64; 3],
}

impl Doubled {
    /// Doubles a box. Its corners are below 2^24.
    #[inline(always)]
    pub fn new(b: &Box3) -> Doubled {
        let (low, high) = (b.min, b.max);
        Doubled {
            sum: [(high[0] + low[0]).into(), (high[1] + low[1]).into(), (high[2] + low[2]).into()],
            size: [(high[0] - low[0]).into(), (high[1] - low[1]).into(), (high[2] - low[2]).into()],
        }
    }
}

/// The convex hull of two boxes.
#[derive(Debug, Clone)]
pub struct Shaft {
    /// The box around both.
    around: Doubled,
    /// What cuts off the corners of the projections along z, x and y.
    cuts: [Cuts; 3],
}

/// The half planes that bound one projection of the hull beside its box: at most one a corner.
#[derive(Debug, Clone, Copy, Default)]
struct Cuts {
    sides: [Side; 4],
    n: usize,
}

/// p·u + q·v ≤ r holds inside, for twice the coordinates.
#[derive(Debug, Clone, Copy, Default)]
struct Side {
    p: f64,
    q: f64,
    r: f64,
}

impl Shaft {
    /// Spans the shaft between two boxes, neither of them empty.
    pub fn new(a: &Box3, b: &Box3) -> Shaft {
        let cuts = [Cuts::new(a, b, 0, 1), Cuts::new(a, b, 1, 2), Cuts::new(a, b, 2, 0)];
        Shaft { around: Doubled::new(&a.join(b)), cuts }
    }

    /// Proves that a box and the shaft have no place in common; `false` proves nothing.
    #[inline(always)]
    pub fn misses(&self, other: &Doubled) -> bool {
        let ([x, y, z], [dx, dy, dz]) = (other.sum, other.size);
        let (sum, size) = (&self.around.sum, &self.around.size);
        (x - sum[0]).abs() > dx + size[0]
            || (y - sum[1]).abs() > dy + size[1]
            || (z - sum[2]).abs() > dz + size[2]
            || self.cuts[0].cut_off(x, y, dx, dy)
            || self.cuts[1].cut_off(y, z, dy, dz)
            || self.cuts[2].cut_off(z, x, dz, dx)
    }
}

impl Cuts {
    fn new(a: &Box3, b: &Box3, u: usize, v: usize) -> Cuts {
        let mut cuts = Cuts::default();
        for (outer_u, outer_v) in [(-1, -1), (-1, 1), (1, -1), (1, 1)] {
            let (au, av) = (corner(a, u, outer_u), corner(a, v, outer_v));
            let (bu, bv) = (corner(b, u, outer_u), corner(b, v, outer_v));
            let (du, dv) = (outer_u * (bu - au), outer_v * (bv - av));
            // A corner edge is on the hull where one box reaches further along u and the other
            // along v; otherwise one corner hides behind the other.
            if (du > 0 && dv < 0) || (du < 0 && dv > 0) {
                let p = f64::from(outer_u * dv.abs());
                let q = f64::from(outer_v * du.abs());
                let r = 2.0 * (p * f64::from(au) + q * f64::from(av));
                cuts.sides[cuts.n] = Side { p, q, r };
                cuts.n += 1;
            }
        }
        cuts
    }

    /// Proves that a rectangle, given by twice its middle and twice its half sides, lies outside:
    /// by its corner farthest inside.
    #[inline(always)]
    fn cut_off(&self, u: f64, v: f64, du: f64, dv: f64) -> bool {
        self.sides
            .iter()
            .take(self.n)
            .any(|side| side.p * u + side.q * v - side.p.abs() * du - side.q.abs() * dv > side.r)
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
                prop_assert!(!Shaft::new(&a, &b).misses(&Doubled::new(&k)));
                prop_assert!(!Shaft::new(&b, &a).misses(&Doubled::new(&k)));
            }
        }

        #[test]
        fn a_thin_shaft_misses_what_its_segment_misses(
            a in boxes(1), b in boxes(1), k in boxes(30),
        ) {
            // Between single places the shaft is the segment, and its planes are all the
            // separating axes of a segment and a box.
            let missed = Shaft::new(&a, &b).misses(&Doubled::new(&k));
            prop_assert_eq!(missed, !segment_meets(a.min, b.min, &k));
        }
    }
}
