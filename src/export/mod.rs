//! From a map back onto the user's own points: joins the tree of `vmap`, the answers of `query`,
//! the way back of `octree` and the writers of `scan`.

mod fields;
mod output;
mod seen;
mod surfels;

use std::path::{Path, PathBuf};

use pvmap_octree::OctreeError;
use pvmap_octree::by_source::{BySource, temporary_bytes};
use pvmap_query::{Map, Snap};
use pvmap_store::output::folder_of;
use pvmap_store::{Mapped, StoreError, Watch, memory};
use pvmap_vmap::octree::{FILE_NAME, Point};
use pvmap_vmap::{MapView, OctreeView, Router};

use crate::build::open_octree;
use crate::{Error, Limits, require_pair};
pub use fields::PointField;
use fields::Values;
use output::Output;
pub use surfels::export_surfels;

/// Which points to write where, and what to say of them.
#[derive(Debug, Clone)]
pub struct ExportRequest {
    /// The map.
    pub map: PathBuf,
    /// The octree it was built from.
    pub octree: PathBuf,
    /// The file to make; its ending (.las, .laz, .ply) says how.
    pub output: PathBuf,
    /// What each point gets beside what it has.
    pub fields: Vec<PointField>,
    /// How far from a surface the places of fields may be.
    pub snap: Snap,
}

/// What an export did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exported {
    /// Points written.
    pub n_points: u64,
    /// The names of the new fields, in the order they were asked for.
    pub names: Vec<String>,
    /// Bytes of the finished file.
    pub output_bytes: u64,
    /// Bytes written to a temporary file.
    pub temporary_bytes: u64,
}

/// Writes all points of an octree in the order of their sources and records, with what they had
/// and new fields from the map. The same points and fields give the same bytes, whatever threads
/// and memory.
///
/// # Errors
/// Where an artifact is damaged, the map is not one of the octree, a field's place is not on a
/// surface, the output has another ending or the name of a scan the octree was made from, the disk
/// fails or is too small, the budget is too small, or the run is asked to stop; nothing is left
/// behind then.
pub fn export_points(
    request: &ExportRequest,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Exported, Error> {
    let points = request.octree.join(FILE_NAME);
    let (map_bytes, octree_bytes) = (Mapped::open(&request.map)?, open_octree(&request.octree)?);
    let octree = OctreeView::open(&octree_bytes).map_err(|e| Error::artifact(&points, e))?;
    let map = Map::open(&map_bytes).map_err(|e| Error::of_query(&request.map, e))?;
    require_pair(&request.map, map.view(), &request.octree, &octree)?;
    check_name(request, &octree)?;
    let done = limits.run(|| run(request, &map, &octree, limits, watch))?;
    done.map_err(|e| match e {
        Error::Octree(OctreeError::Format(e)) => Error::artifact(&points, e),
        e => e,
    })
}

/// Refuses an output that would replace a scan.
fn check_name(request: &ExportRequest, octree: &OctreeView<'_>) -> Result<(), Error> {
    let name = request.output.file_name().unwrap_or_default();
    for source in octree.sources() {
        let of_scan = octree.source_name(source).map_err(OctreeError::from)?;
        if *name == *of_scan && request.output.exists() {
            return Err(Error::Usage(format!(
                "{}: a scan that the octree was made from has that name, and more in it than an \
                 export keeps; give another",
                request.output.display()
            )));
        }
    }
    Ok(())
}

fn run(
    request: &ExportRequest,
    map: &Map<'_>,
    octree: &OctreeView<'_>,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Exported, Error> {
    let output = Output::of(&request.output)?;
    let held_bytes = fields::held_bytes(&request.fields, map.view().summary().n_surfels);
    memory::require("what the surfels see", held_bytes, limits.memory_bytes / 2)?;
    let memory_bytes = limits.memory_bytes - held_bytes;
    let names = fields::columns(&request.fields);
    require_disk(request, octree, output.estimate_bytes(octree, &names), memory_bytes, watch)?;
    let located: Result<Vec<_>, _> =
        request.fields.iter().map(|f| f.locate(map, request.snap)).collect();
    let located = located.map_err(|e| Error::of_query(&request.map, e))?;
    let values = Values::of(&request.fields, &located, map, watch)
        .map_err(|e| Error::of_query(&request.map, e))?;
    let folder = folder_of(&request.output);
    let tagger = || tagger(&request.map, map.view());
    let all = BySource::gather::<Error, _>(octree, folder, memory_bytes, tagger, watch)?;
    let spilled_bytes = all.spilled_bytes();
    let mut writer = output.start(octree, &names, all.seen(), watch)?;
    all.each(|batch, surfels| {
        let columns = values.columns(surfels).map_err(|e| Error::artifact(&request.map, e))?;
        writer.write(batch, &columns)
    })?;
    writer.finish()?;
    let len = std::fs::metadata(&request.output).map(|m| m.len());
    Ok(Exported {
        n_points: octree.summary().n_points,
        names: names.into_iter().map(|f| f.name).collect(),
        output_bytes: len.map_err(|e| StoreError::io(&request.output, "look at", e))?,
        temporary_bytes: spilled_bytes,
    })
}

/// Makes what gives a point the surfel of the leaf it is routed to. [D-3]
fn tagger<'m>(
    path: &'m Path,
    map: &'m MapView<'_>,
) -> impl FnMut(&Point<'_>) -> Result<u32, Error> + use<'m> {
    let mut router = Router::new(map);
    move |point| match router.surfel_of(&point.key) {
        Ok(Some(surfel)) => Ok(surfel),
        Ok(None) => Err(Error::Data(format!(
            "{}: damaged: a point of its octree has no leaf in it; build it anew",
            path.display()
        ))),
        Err(e) => Err(Error::artifact(path, e)),
    }
}

/// Says how much disk the export takes, and refuses it where there is less. (F21)
fn require_disk(
    request: &ExportRequest,
    octree: &OctreeView<'_>,
    output_bytes: u64,
    memory_bytes: u64,
    watch: &dyn Watch,
) -> Result<(), Error> {
    let temporary = temporary_bytes(octree, memory_bytes);
    if temporary > 0 {
        watch.note(&format!(
            "needs about {} MiB of temporary disk in {}",
            (temporary >> 20) + 1,
            folder_of(&request.output).display()
        ));
    }
    Ok(memory::require_disk(&request.output, output_bytes.saturating_add(temporary))?)
}
