//! The points of a class as a light: maps hold no classes, so the octree is asked.

use std::path::Path;

use pvmap_query::Map;
use pvmap_vmap::octree::CODE_STRIDE;
use pvmap_vmap::tree::{Nodes, route};
use pvmap_vmap::{FormatError, OctreeView};

use crate::Error;

/// Counts the points of a class that each surfel of a map stands for: surfels that have some,
/// rising, for [`pvmap_query::Light::Points`].
///
/// `octree` are the bytes of the octree that the map was built from; all its points are gone
/// through once. Paths are those of messages.
///
/// # Errors
/// Where the octree is another one, has no classes or no point of this one, or a file is damaged.
pub fn class_points(
    map: &Map<'_>,
    map_path: &Path,
    octree: &[u8],
    octree_path: &Path,
    class: u8,
) -> Result<Vec<(u32, u64)>, Error> {
    let of_octree = |e: FormatError| Error::artifact(octree_path, e);
    let of_map = |e: FormatError| Error::artifact(map_path, e);
    let refuse = |what: String| Err(Error::Data(format!("{}: {what}", octree_path.display())));
    let octree = OctreeView::open(octree).map_err(of_octree)?;
    let n_points = octree.summary().n_points;
    let view = map.view();
    if octree.summary().digest != view.summary().digest {
        return refuse(format!("{} was built from another octree", map_path.display()));
    }
    let Some(column) = octree.schema().column("class") else {
        return refuse("its points have no classes".to_owned());
    };
    let mut counts = vec![0u64; view.summary().n_surfels as usize];
    let mut first = 0;
    while first < n_points {
        let n = CODE_STRIDE.min(n_points - first);
        for point in octree.points(first, n).map_err(of_octree)?.iter() {
            let point = point.map_err(of_octree)?;
            if point.record.get(column.offset) != Some(&class) {
                continue;
            }
            let Some(leaf) = route(view, &point.key).map_err(of_map)? else {
                return refuse(format!("a point has no leaf in {}", map_path.display()));
            };
            counts[view.node(leaf).map_err(of_map)?.first_surfel as usize] += 1;
        }
        first += n;
    }
    let lamps: Vec<(u32, u64)> = (0..).zip(counts).filter(|&(_, n)| n > 0).collect();
    if lamps.is_empty() {
        return refuse(format!("no point has class {class}"));
    }
    Ok(lamps)
}
