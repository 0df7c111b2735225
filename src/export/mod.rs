//! From a map back onto the user's own points: joins the tree of `vmap`, the answers of `query`,
//! the way back of `octree` and the writers of `scan`.

mod begin;
mod columns;
mod fields;
mod lattice;
mod light;
mod onto;
mod output;
mod seen;
mod surfels;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use pvmap_octree::OctreeError;
use pvmap_octree::by_source::{BySource, Which, With, temporary_bytes};
use pvmap_query::{Map, Snap};
use pvmap_store::output::folder_of;
use pvmap_store::{ClosedFile, Mapped, StoreError, Watch, memory};
use pvmap_vmap::octree::{FILE_NAME, Point};
use pvmap_vmap::{MapView, OctreeView, Router};

use crate::build::open_octree;
use crate::{Error, Limits, require_pair};
pub use begin::{Made, begin_file, begin_table};
use fields::Values;
pub use fields::{PlaceAnswer, PointField};
pub use light::ExportLight;
use light::PointLight;
use onto::Scan;
pub use output::PointsFile;
pub use surfels::{export_surfels, write_surfels};

/// Which points to write where, and what to say of them.
#[derive(Debug, Clone)]
pub struct ExportRequest {
    /// The map.
    pub map: PathBuf,
    /// The octree it was built from.
    pub octree: PathBuf,
    /// The file to make; its ending (.las, .laz, .ply) says how.
    pub output: PathBuf,
    /// Whether a file of that name may be replaced that no export made.
    pub overwrite: bool,
    /// What each point gets beside what it has.
    pub fields: Vec<PointField>,
    /// How far from a surface the places of fields may be.
    pub snap: Snap,
    /// The scan file to write again with all that it has, one of those of the octree: its points
    /// alone. Without one all points are written with what the octree has of them.
    pub scan: Option<PathBuf>,
    /// The light of the map, for fields that show it.
    pub light: Option<ExportLight>,
}

/// What an export did.
#[derive(Debug, Clone, PartialEq)]
pub struct Exported {
    /// Points written.
    pub n_points: u64,
    /// The names of the new fields, in the order they were asked for.
    pub names: Vec<String>,
    /// What answered for the places of fields.
    pub places: Vec<PlaceAnswer>,
    /// Bytes of the finished file.
    pub output_bytes: u64,
    /// Bytes written to a temporary file.
    pub temporary_bytes: u64,
}

/// Writes all points of an octree, or all records of one of its scans, in the order of their
/// sources and records, with what they had and new fields from the map. The same points and fields
/// give the same bytes, whatever threads and memory.
///
/// # Errors
/// Where an artifact is damaged, the map is not one of the octree, a field's place is not on a
/// surface, the scan is none of the octree's, the output has another ending or would replace what
/// no export made, the disk fails or is too small, the budget is too small, or the run is asked to
/// stop; nothing is left behind then.
pub fn export_points(
    request: &ExportRequest,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Exported, Error> {
    let output = PointsFile::begin(&request.output, request.overwrite)?;
    let (done, file) = write_points(request, output, limits, watch)?;
    file.publish(false)?;
    Ok(done)
}

/// Does what [`export_points`] does in a file that was begun and gets its name later.
///
/// # Errors
/// Those of [`export_points`].
pub fn write_points(
    request: &ExportRequest,
    output: PointsFile,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<(Exported, ClosedFile), Error> {
    let points = request.octree.join(FILE_NAME);
    let (map_bytes, octree_bytes) = (Mapped::open(&request.map)?, open_octree(&request.octree)?);
    let octree = OctreeView::open(&octree_bytes).map_err(|e| Error::artifact(&points, e))?;
    let map = MapView::open(&map_bytes).map_err(|e| Error::artifact(&request.map, e))?;
    require_pair(&request.map, &map, &request.octree, &octree)?;
    let done = limits.run(|| run(request, output, (&map_bytes, &map), &octree, limits, watch))?;
    done.map_err(|e| match e {
        Error::Octree(OctreeError::Format(e)) => Error::artifact(&points, e),
        e => e,
    })
}

fn run(
    request: &ExportRequest,
    mut output: PointsFile,
    (map_bytes, map): (&[u8], &MapView<'_>),
    octree: &OctreeView<'_>,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<(Exported, ClosedFile), Error> {
    let fields = &request.fields;
    // Where the output is a link, the folder of what it points at.
    let beside = output.temp_path().to_path_buf();
    let folder = folder_of(&beside);
    let held_bytes = fields::held_bytes(fields, map.summary());
    memory::require("what the surfels see", held_bytes, limits.memory_bytes / 2)?;
    let memory_bytes = limits.memory_bytes - held_bytes;
    let has_normals = fields.iter().any(PointField::needs_normals);
    let with = if has_normals { With::Normals } else { With::Numbers };
    if fields.contains(&PointField::Radiosity) {
        output.colored_by_light();
    }
    let light = PointLight::of(request.light.as_ref(), fields, (&request.map, map), octree)?;
    let is_grey = light.as_ref().is_some_and(PointLight::is_grey);
    if let (Some(light), None) = (&light, &request.scan) {
        light.tell(request, watch);
    }
    let scan = request.scan.as_deref().map(|path| Scan::open(path, octree, output.kind(), watch));
    let scan = scan.transpose()?;
    let taken = scan.as_ref().map_or(Vec::new(), Scan::names);
    let names = fields::columns(fields, (octree.schema(), is_grey), &taken);
    let coder_bytes = scan.as_ref().map_or(0, |scan| scan.coder_bytes(output.kind(), &names));
    memory::require("such wide records of a LAZ", coder_bytes, memory_bytes / 2)?;
    let memory_bytes = memory_bytes - coder_bytes;
    let wanted = (scan.as_ref().map_or(Which::All, Scan::which), with);
    let temporary = temporary_bytes(octree, wanted, memory_bytes);
    let full_bytes = match &scan {
        Some(scan) => scan.rewritten_bytes(&names),
        None => output.file_bytes(octree, &names)?,
    };
    output.require_disk(full_bytes, temporary, watch)?;
    if temporary > 0 {
        let (mib, folder) = ((temporary >> 20) + 1, folder.display());
        watch.note(&format!("needs about {mib} MiB of temporary disk in {folder}"));
    }
    let (values, places) = {
        // It keeps what it decodes; all that is gone before the points come.
        let map = Map::open_within(map_bytes, memory_bytes / 4);
        let values = map.map_err(Error::from).and_then(|map| {
            Values::of((fields, &names), light.map(Arc::new), (&map, request.snap), watch)
        });
        values.map_err(|e| match e {
            Error::Query(e) => Error::of_query(&request.map, e),
            e => e,
        })?
    };
    let tagger = || tagger(&request.map, map);
    let all = BySource::gather::<Error, _>(octree, wanted, (folder, memory_bytes), tagger, watch)?;
    let temporary_bytes = all.spilled_bytes();
    let (n_points, file) = match &scan {
        Some(scan) => scan.write(output, (all, &values), &names, watch)?,
        None => {
            let kind = output.kind();
            let mut writer = output.start(octree, (fields, &names), all.seen(), watch)?;
            all.each(|batch, tags| {
                let columns = values.columns(batch, &tags.numbers, &tags.normals);
                let colors = values.colors(&columns, kind);
                writer.write(batch, columns, colors)
            })?;
            (octree.summary().n_points, writer.close()?)
        }
    };
    let len = std::fs::metadata(file.temp_path()).map(|m| m.len());
    let output_bytes = len.map_err(|e| StoreError::io(&request.output, "look at", e))?;
    let names = names.into_iter().map(|f| f.name).collect();
    Ok((Exported { n_points, names, places, output_bytes, temporary_bytes }, file))
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
