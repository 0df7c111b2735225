//! Which cells of few points are no leaves yet: their points are too far apart.
//!
//! A cell of a bin may hold a few points of one limb and a few of another, or a strip from corner
//! to corner. The surfel of such a leaf hides all that lies between them. So a cell is divided
//! further where the box that its points stretch over is many times larger than what they cover,
//! by their own spacing.

use std::ops::RangeInclusive;

use pvmap_geometry::GridPoint;

/// Cells of so many points are looked at. Fewer show no spacing of their own; more are no few, and
/// would have to be held to be looked at.
pub(super) const N_POINTS: RangeInclusive<u64> = 4..=4096;

/// Says whether the points of a cell are spread too thin for a leaf.
///
/// Of its distinct places let there be m ≥ 4, q the lower median of their squared distances to the
/// nearest other, s = isqrt(9q / 4), a spacing, and e1, e2 the two longest sides of their box. They
/// are spread where (e1 + s)(e2 + s) > `most`·m·s². (Of an even sample of any kind a place is 0.5
/// to 1 spacings from the nearest other, 0.66 in the scenes.)
pub(super) fn is_spread(mut places: Vec<GridPoint>, most: u16) -> bool {
    places.sort_unstable();
    places.dedup();
    if !N_POINTS.contains(&(places.len() as u64)) {
        return false;
    }
    let side = |i: usize| {
        let axis = || places.iter().map(|p| u64::from(p[i]));
        axis().max().unwrap_or(0) - axis().min().unwrap_or(0)
    };
    let mut sides = [0, 1, 2].map(side);
    let mut near2: Vec<u64> = (0..places.len()).map(|i| nearest2(&places, i)).collect();
    let middle = (near2.len() - 1) / 2;
    let q = *near2.select_nth_unstable(middle).1;
    // Sides are below 2^22 and s below 2^24: an area is below 2^50, 2^12 · 2^16 times it 2^78.
    let s = (9 * q / 4).isqrt();
    sides.sort_unstable();
    let covered = u128::from(s * s) * places.len() as u128;
    u128::from((sides[1] + s) * (sides[2] + s)) > u128::from(most) * covered
}

/// Gives the squared distance of place `i` to the nearest other; they are sorted and distinct.
fn nearest2(places: &[GridPoint], i: usize) -> u64 {
    let here = places[i];
    let along = |j: usize, axis: usize| u64::from(here[axis].abs_diff(places[j][axis])).pow(2);
    let nearer = |near2: u64, j: usize| {
        // Sorted by x, so those beyond are no nearer.
        let is_near = along(j, 0) < near2;
        is_near.then(|| near2.min(along(j, 0) + along(j, 1) + along(j, 2))).ok_or(near2)
    };
    let after = (i + 1..places.len()).try_fold(u64::MAX, nearer).unwrap_or_else(|near2| near2);
    (0..i).rev().try_fold(after, nearer).unwrap_or_else(|near2| near2)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Places of an even sample in a plane, n along each side, `step` apart.
    fn sheet(n: u32, step: u32) -> Vec<GridPoint> {
        (0..n * n).map(|i| [7 + i % n * step, 9, 5 + i / n * step]).collect()
    }

    #[test]
    fn an_even_sample_is_no_spread_at_any_spacing_and_a_strip_across_is() {
        for step in [1, 2, 1000, 40_000] {
            for n in [2, 3, 7, 40] {
                assert!(!is_spread(sheet(n, step), 1), "{n} {step}");
            }
            let across = |n: u32| (0..n).map(|i| [i * step, 3, i * step]).collect();
            assert!(!is_spread(across(4), 3) && is_spread(across(40), 3), "{step}");
            let along = (0..40).map(|i| [i * step, 3, 3]).collect();
            assert!(!is_spread(along, 1), "{step}");
            // Two patches with nothing between.
            let mut two = sheet(3, step);
            two.extend(sheet(3, step).iter().map(|p| [p[0] + 20 * step, p[1], p[2] + 20 * step]));
            assert!(is_spread(two, 3), "{step}");
        }
    }

    #[test]
    fn coincident_points_count_once() {
        let twice = [sheet(5, 3), sheet(5, 3)].concat();
        assert!(!is_spread(twice, 1));
        let four = vec![[0; 3], [0; 3], [0; 3], [(1 << 22) - 1; 3]];
        assert!(!is_spread(four, 1), "two places show no spacing");
    }

    #[test]
    fn the_largest_cube_overflows_nothing() {
        let far = (1 << 22) - 1;
        let corners: Vec<_> = (0..8).map(|i| [0, 1, 2].map(|a| far * (i >> a & 1))).collect();
        assert!(!is_spread(corners.clone(), 1) && !is_spread(corners, u16::MAX));
        let mut close: Vec<GridPoint> = (0..4000).map(|i| [i, i, 0]).collect();
        close.push([far; 3]);
        assert!(is_spread(close, u16::MAX));
    }

    #[test]
    fn the_nearest_is_that_of_all() {
        let mut rng = fastrand::Rng::with_seed(3);
        for side in [3, 30, 1 << 22] {
            let mut places: Vec<_> = (0..60).map(|_| [0; 3].map(|_| rng.u32(..side))).collect();
            places.sort_unstable();
            places.dedup();
            for (i, a) in places.iter().enumerate() {
                let d2 =
                    |b: &GridPoint| (0..3).map(|k| u64::from(a[k].abs_diff(b[k])).pow(2)).sum();
                let others = places.iter().filter(|b| *b != a).map(d2);
                assert_eq!(Some(nearest2(&places, i)), others.min());
            }
        }
    }
}
