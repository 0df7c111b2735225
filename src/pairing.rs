//! Which map belongs to which octree.

use std::path::Path;

use pvmap_query::exact::check_pair;
use pvmap_vmap::{MapView, OctreeView};

use crate::Error;

/// Refuses a map that was not built from an octree.
///
/// # Errors
/// Where the points of the two are others, or elsewhere; both are named.
pub fn require_pair(
    map_path: &Path,
    map: &MapView<'_>,
    octree_path: &Path,
    octree: &OctreeView<'_>,
) -> Result<(), Error> {
    check_pair(map, octree).map_err(|_| {
        Error::Data(format!(
            "{}: not a map of {}, but of other points; give the octree it was built from, or \
             build a map of this one",
            map_path.display(),
            octree_path.display()
        ))
    })
}
