//! The shaft between two boxes: their convex hull, for throwing away what cannot be between them.
//!
//! At t of the way from one box to the other the hull's slice is a box whose faces move evenly from
//! those of the one to those of the other. A third box meets the hull exactly if for some t in 0…1
//! it overlaps that slice along every axis: six linear conditions on t.

use crate::bounds::Box3;

/// How much a box is grown before it is tested, in steps: more than rounding can shift a face, less
/// than what could tell two places of the grid apart. A face is off by at most 2^-27: t by 2^-51,
/// and the way it is multiplied with is below 2^24.
const SLACK: f64 = 1.0 / (1u64 << 20) as f64;

/// Instead of 1/0 for a face that stands still: times [`SLACK`] it leaves 0…1 by far.
const NEVER_MOVES: f64 = (1u64 << 60) as f64;

/// The convex hull of two boxes.
#[derive(Debug, Clone)]
pub struct Shaft {
    /// The lower and the upper faces, an axis each.
    lower: [Face; 3],
    upper: [Face; 3],
}

/// A face of the slice on its way.
#[derive(Debug, Clone, Copy)]
struct Face {
    /// Where it is at t = 0.
    from: f64,
    /// What t gains a step of its way.
    per_step: f64,
}

impl Face {
    fn new(from: i32, to: i32) -> Face {
        let way = f64::from(to) - f64::from(from);
        let per_step = if way == 0.0 { NEVER_MOVES } else { 1.0 / way };
        Face { from: f64::from(from), per_step }
    }

    /// Gives the t at which it is at a place.
    #[inline(always)]
    fn reaches(&self, place: f64) -> f64 {
        (place - self.from) * self.per_step
    }

    #[inline(always)]
    fn moves_up(&self) -> bool {
        self.per_step > 0.0
    }
}

impl Shaft {
    /// Spans the shaft between two boxes, neither of them empty.
    pub fn new(a: &Box3, b: &Box3) -> Shaft {
        Shaft {
            lower: [0, 1, 2].map(|i| Face::new(a.min[i], b.min[i])),
            upper: [0, 1, 2].map(|i| Face::new(a.max[i], b.max[i])),
        }
    }

    /// Proves that a box and the shaft have no place in common; `false` proves nothing. Corners are
    /// below 2^24.
    #[inline(always)]
    pub fn misses(&self, other: &Box3) -> bool {
        let (mut first, mut last) = (0.0, 1.0);
        for i in 0..3 {
            // The slice is not above the box, and not below it.
            let below = self.lower[i].reaches(f64::from(other.max[i]) + SLACK);
            let above = self.upper[i].reaches(f64::from(other.min[i]) - SLACK);
            let (up, down) = (f64::INFINITY, f64::NEG_INFINITY);
            let (rises, climbs) = (self.lower[i].moves_up(), self.upper[i].moves_up());
            last = less(last, if rises { below } else { up });
            first = greater(first, if rises { down } else { below });
            last = less(last, if climbs { up } else { above });
            first = greater(first, if climbs { above } else { down });
        }
        first > last
    }
}

#[inline(always)]
fn greater(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[inline(always)]
fn less(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
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

    /// What boxes of occluders are in: patch boxes leave the cube by up to 2^23.
    const ANYWHERE: std::ops::Range<i32> = -(1 << 23)..(1 << 22) + (1 << 23);
    /// What centroids are in.
    const IN_CUBE: std::ops::Range<i32> = 0..1 << 22;

    /// Boxes with corners in a range, of every order of size.
    fn boxes_in(range: std::ops::Range<i32>) -> impl Strategy<Value = Box3> {
        let last = range.end - 1;
        let size = (0..=22u32).prop_flat_map(|bits| prop::array::uniform3(0..1i32 << bits));
        (prop::array::uniform3(range), size).prop_map(move |(min, size)| Box3 {
            min,
            max: [0, 1, 2].map(|i| (min[i] + size[i]).min(last)),
        })
    }

    /// Scales a box and moves it; what it met or missed it still does if all are treated alike.
    fn carried(b: &Box3, scale: i32, by: [i32; 3]) -> Box3 {
        let carry = |v: [i32; 3]| [0, 1, 2].map(|i| v[i] * scale + by[i]);
        Box3 { min: carry(b.min), max: carry(b.max) }
    }

    /// Gives the place at these fractions of the way through a box.
    fn inside(b: &Box3, s: [f64; 3]) -> [i32; 3] {
        [0, 1, 2].map(|i| b.min[i] + ((b.max[i] - b.min[i]) as f64 * s[i]).round() as i32)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn what_a_segment_meets_is_never_missed(
            a in boxes(20), b in boxes(20), k in boxes(20),
            s in prop::array::uniform3(0.0f64..=1.0), t in prop::array::uniform3(0.0f64..=1.0),
        ) {
            if segment_meets(inside(&a, s), inside(&b, t), &k) {
                prop_assert!(!Shaft::new(&a, &b).misses(&k));
                prop_assert!(!Shaft::new(&b, &a).misses(&k));
            }
        }

        #[test]
        fn what_a_segment_of_the_whole_grid_meets_is_never_missed(
            a in boxes_in(IN_CUBE), b in boxes_in(IN_CUBE), far in boxes_in(ANYWHERE),
            s in prop::array::uniform3(0.0f64..=1.0), t in prop::array::uniform3(0.0f64..=1.0),
            way in 0.0f64..=1.0, corner in prop::array::uniform3(-1..=1i32),
            half in (0..=22u32).prop_flat_map(|bits| 0..1i32 << bits),
        ) {
            let (from, to) = (inside(&a, s), inside(&b, t));
            // A box that a segment touches with a corner or a face, to the step, and any other.
            let on = [0, 1, 2].map(|i| {
                from[i] + (f64::from(to[i] - from[i]) * way).round() as i32 + corner[i] * half
            });
            for k in [Box3::at(on).grown(half), far] {
                if segment_meets(from, to, &k) {
                    prop_assert!(!Shaft::new(&a, &b).misses(&k));
                    prop_assert!(!Shaft::new(&b, &a).misses(&k));
                    let [a, b] = [from, to].map(Box3::at);
                    prop_assert!(!Shaft::new(&a, &b).misses(&k));
                }
            }
        }

        #[test]
        fn a_thin_shaft_misses_what_its_segment_misses(
            a in boxes(1), b in boxes(1), k in boxes(30),
            scale_bits in 0..=15u32, is_far in prop::array::uniform3(any::<bool>()),
        ) {
            // Between single places the shaft is the segment, and its planes are all the
            // separating axes of a segment and a box. Corners are below 130.
            let scale = 1 << scale_bits;
            let by = is_far.map(|far| i32::from(far) * ((1 << 22) - 128 * scale));
            let [a, b, k] = [&a, &b, &k].map(|v| carried(v, scale, by));
            let missed = Shaft::new(&a, &b).misses(&k);
            prop_assert_eq!(missed, !segment_meets(a.min, b.min, &k));
        }
    }
}
