//! The half spacing of leaves, and what of a surfel waits for it.

use pvmap_geometry::Box3;
use pvmap_geometry::disc::Profile;
use pvmap_vmap::Surfel;

/// The fewest points that show a spacing of their own.
const MIN_POINTS: u64 = 4;

/// Gives h = max(1, isqrt(e1·e2/m) div 2) of a leaf of m ≥ 4 points, `None` for fewer; e1, e2 are
/// the two longest sides (+1) of their box.
///
/// Source: DESIGN.md §3.
pub(super) fn half_spacing(bounds: &Box3, n_points: u64) -> Option<u32> {
    if n_points < MIN_POINTS {
        return None;
    }
    let mut sides = [0, 1, 2].map(|i| u64::from(bounds.max[i].abs_diff(bounds.min[i])) + 1);
    sides.sort_unstable();
    let spacing = (sides[1] * sides[2] / n_points).isqrt();
    // Sides are at most 2^22, so h is at most 2^20.
    Some((spacing / 2).max(1) as u32)
}

/// Completes the surfels of a whole tree: leaves of few points get the lower median of the half
/// spacings (1 if there is none), patch boxes grow by them, `Patch` raises R² to h².
///
/// Source: DESIGN.md §3.
pub(super) fn fill(surfels: &mut [Surfel], profile: Profile) {
    let known = surfels.iter().filter(|s| s.n_points >= MIN_POINTS);
    let mut known: Vec<u32> = known.map(|s| s.half_spacing).collect();
    let middle = known.len().saturating_sub(1) / 2;
    let median = match known.is_empty() {
        true => 1,
        false => *known.select_nth_unstable(middle).1,
    };
    for surfel in surfels {
        if surfel.n_points < MIN_POINTS {
            surfel.half_spacing = median;
        }
        surfel.patch = surfel.patch.grown(surfel.half_spacing as i32);
        if profile == Profile::Patch {
            surfel.radius2 = surfel.radius2.max(u64::from(surfel.half_spacing).pow(2));
        }
    }
}
