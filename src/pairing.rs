//! Which map belongs to which octree.

use std::path::Path;

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
    let (of, from) = (map.summary(), octree.summary());
    // Points that are alike but elsewhere have the same digest. [D-2]
    let is_of = (of.digest, of.n_points) == (from.digest, from.n_points)
        && map.frame().frame == octree.frame().frame;
    if is_of {
        return Ok(());
    }
    Err(Error::Data(format!(
        "{}: not a map of {}, but of other points; give the octree it was built from, or build a \
         map of this one",
        map_path.display(),
        octree_path.display()
    )))
}
