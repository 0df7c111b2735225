//! How much every surfel sees, told while it is counted.

use pvmap_query::{Map, QueryError};
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
