//! From an octree to its visibility map: joins the cut of `octree` to `visibility`.

use std::path::Path;

use pvmap_octree::cut::{CutMemory, CutOptions, cut};
use pvmap_store::output::require_own;
use pvmap_store::{Mapped, StoreError, Watch};
use pvmap_visibility::{BuildOptions, BuildReport, MapInput};
use pvmap_vmap::container::Kind;
use pvmap_vmap::octree::FILE_NAME;
use pvmap_vmap::{FormatError, OctreeView};

use crate::{BuildConfig, Error, Limits};

/// What a build did.
#[derive(Debug, Clone)]
pub struct Built {
    /// Counts and sizes.
    pub report: BuildReport,
    /// Leaf pairs in all, each once: N·(N-1)/2.
    pub n_leaf_pairs: u128,
}

/// Maps the points of an octree folder.
///
/// # Errors
/// Where the folder or the file in it cannot be opened.
pub fn open_octree(path: &Path) -> Result<Mapped, Error> {
    let points = path.join(FILE_NAME);
    let meta = std::fs::metadata(path).map_err(|e| StoreError::io(path, "open", e))?;
    match Mapped::open(&points) {
        Err(StoreError::NotFound { .. }) => Err(Error::Data(format!(
            "{}: not an octree (a folder without points); make one with pvmap ingest",
            path.display()
        ))),
        _ if !meta.is_dir() => Err(Error::Data(format!(
            "{}: not an octree (a file); make one with pvmap ingest",
            path.display()
        ))),
        opened => Ok(opened?),
    }
}

/// Cuts an octree as the configuration says and makes its visibility map.
///
/// It runs on [`Limits::threads`] threads of its own; called on a worker of another rayon pool it
/// nests jobs, see [Threads and memory](crate#threads-and-memory).
///
/// # Errors
/// Where the octree is damaged, the interaction list breaks a rule, the budget is too small, the
/// disk fails or the run is asked to stop; a map that was there before is then still there.
pub fn build(
    octree: &Path,
    output: &Path,
    config: &BuildConfig,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    let file = open_octree(octree)?;
    let points = octree.join(FILE_NAME);
    let view = OctreeView::open(&file).map_err(|e| Error::artifact(&points, e))?;
    let named = |e: Error| match e {
        Error::Octree(pvmap_octree::OctreeError::Format(e)) => Error::artifact(&points, e),
        e => e,
    };
    limits.run(|| run(&view, output, config, limits, watch))?.map_err(named)
}

fn run(
    view: &OctreeView<'_>,
    output: &Path,
    config: &BuildConfig,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    require_own(output, Kind::Map.start(), "a visibility map")?;
    let memory_bytes = limits.memory_bytes;
    let cut_options = CutOptions {
        max_level: config.max_level,
        leaf_capacity: config.leaf_capacity,
        shape: config.tree,
        profile: config.profile,
    };
    // The tree gets most: at worst 2.5 times its size, and what comes after needs 3.5 times.
    let points_bytes = memory_bytes / 16 * 5;
    let cut_memory = CutMemory { points_bytes, tree_bytes: memory_bytes - points_bytes };
    let tree = cut(view, &cut_options, cut_memory, watch)?;
    let options = BuildOptions {
        max_level: config.max_level,
        leaf_capacity: config.leaf_capacity,
        shape: config.tree,
        profile: config.profile,
        interaction: config.interaction.clone(),
        memory_bytes,
        output: output.to_path_buf(),
    };
    let (_, crs) = view.crs().map_err(|e: FormatError| Error::Octree(e.into()))?;
    let digest = view.summary().digest;
    let input = MapInput { tree: &tree, frame: view.frame(), crs, digest };
    let report = pvmap_visibility::build(&input, &options, watch)?;
    let n = u128::from(report.summary.n_surfels);
    Ok(Built { report, n_leaf_pairs: n * n.saturating_sub(1) / 2 })
}
