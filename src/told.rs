//! Questions that take their time, told while they are answered.

use pvmap_query::{Map, QueryError, VisibleSet};
use pvmap_store::Watch;

/// Counts for every surfel the others that it sees, as [`Map::sees_counts`] does.
///
/// # Errors
/// Where the map is damaged or the run was asked to stop.
pub fn sees_counts(map: &Map<'_>, watch: &dyn Watch) -> Result<Vec<u32>, QueryError> {
    watch.stage("links", Some(map.view().n_link_blocks()), "frames");
    map.sees_counts(&|| {
        watch.advance(1);
        !watch.is_stopped()
    })
}

/// Finds all surfels that are seen from a place in the air, as [`Map::visible_from_air`] does.
///
/// # Errors
/// Where `eye` is no place, the map is damaged or the run was asked to stop.
pub fn visible_from_air(
    map: &Map<'_>,
    eye: [f64; 3],
    watch: &dyn Watch,
) -> Result<VisibleSet, QueryError> {
    watch.stage("air", Some(map.view().summary().n_surfels.into()), "surfels");
    map.visible_from_air(eye, &|n| {
        watch.advance(n);
        !watch.is_stopped()
    })
}
