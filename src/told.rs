//! Questions that take their time, told while they are answered.

use std::path::Path;

use pvmap_query::quality::{Quality, measure};
use pvmap_query::{Map, QueryError, VisibleSet, WideSurfels};
use pvmap_store::Watch;
use pvmap_vmap::OctreeView;

/// Counts for every surfel the others that it sees, as [`Map::sees_counts`] does.
///
/// # Errors
/// Where the map is damaged or the run was asked to stop.
pub fn sees_counts(map: &Map<'_>, watch: &dyn Watch) -> Result<Vec<u32>, QueryError> {
    watch.stage("links", Some(map.view().links().n_blocks()), "frames");
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

/// Finds the surfels that are far wider than what their points cover: [`Map::wide_surfels`].
///
/// # Errors
/// Where the map is damaged or the run was asked to stop.
pub fn wide_surfels(map: &Map<'_>, watch: &dyn Watch) -> Result<Option<WideSurfels>, QueryError> {
    watch.stage("surfels", Some(map.view().summary().n_surfels.into()), "surfels");
    map.wide_surfels(&|n| {
        watch.advance(n);
        !watch.is_stopped()
    })
}

/// Says what the points of an octree are like, at a sample of `n`, as [`measure`] does.
///
/// # Errors
/// Where the octree is damaged or the run was asked to stop.
pub fn quality(octree: &OctreeView<'_>, n: u64, watch: &dyn Watch) -> Result<Quality, QueryError> {
    watch.stage("quality", Some(n.min(octree.summary().n_points)), "points");
    measure(octree, n, &|n| {
        watch.advance(n);
        !watch.is_stopped()
    })
}

/// Says in a line that the normals of the file are not those of the points, where that is so.
pub fn contradiction(octree: &Path, quality: &Quality) -> Option<String> {
    let normals = &quality.normals;
    let median = normals.median_deg.filter(|_| normals.contradict_points())?;
    Some(format!(
        "{}: the normals of the scan contradict its points: half of them are {median:.0}° and more \
         from upright on the plane of their neighbours; ingest again with --normals estimate",
        octree.display()
    ))
}
