//! From an octree to its visibility map: joins the cut of `octree` to `visibility`.

use std::path::Path;
use std::time::Duration;

use pvmap_octree::cut::{CutMemory, CutOptions, cut};
use pvmap_query::exact::ExactOptions;
use pvmap_store::output::require_own;
use pvmap_store::{Mapped, StoreError, Watch, WorkFolder};
use pvmap_visibility::{BuildOptions, BuildReport, MapInput};
use pvmap_vmap::container::Kind;
use pvmap_vmap::octree::FILE_NAME;
use pvmap_vmap::{FormatError, OctreeView, Tree};

use crate::{BuildConfig, Error, Limits};

/// What a build did.
#[derive(Debug, Clone)]
pub struct Built {
    /// Counts and sizes.
    pub report: BuildReport,
    /// Leaf pairs in all, each once: N·(N-1)/2.
    pub n_leaf_pairs: u128,
}

/// How a build is kept for the case that it ends before its time. It never decides content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Checkpoints {
    /// How long finished work may wait to be made durable, about. A build that is done sooner, and
    /// whose links fit in memory, writes nothing but its map.
    pub every: Duration,
    /// Discards what an earlier run left of a build instead of going on with it.
    pub restart: bool,
}

impl Default for Checkpoints {
    fn default() -> Checkpoints {
        Checkpoints { every: Duration::from_secs(10), restart: false }
    }
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

/// Cuts an octree as the configuration says and makes its visibility map, with the default
/// [`Checkpoints`].
///
/// It runs on [`Limits::threads`] threads of its own; called on a worker of another rayon pool it
/// nests jobs, see [Threads and memory](crate#threads-and-memory).
///
/// # Errors
/// Those of [`build_with`].
pub fn build(
    octree: &Path,
    output: &Path,
    config: &BuildConfig,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    build_with(octree, output, config, limits, &Checkpoints::default(), watch)
}

/// Does what [`build()`] does, and is told how to keep it for the case that it ends too early.
///
/// The build works in the folder `OUTPUT.build`, which is locked while it runs and gone when the
/// map is there. Whatever ends it before (a signal, a full disk, `kill -9`, a power cut), the next
/// call with the same arguments goes on with the chunk tasks that were done; the bytes of the map
/// are the same. Threads and memory may be others then.
///
/// # Errors
/// Where the octree is damaged, the interaction list breaks a rule, the budget is too small, the
/// disk fails, another build makes this map, an unfinished one was begun with another
/// configuration, or the run is asked to stop; a map that was there before is then still there.
pub fn build_with(
    octree: &Path,
    output: &Path,
    config: &BuildConfig,
    limits: &Limits,
    checkpoints: &Checkpoints,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    let file = open_octree(octree)?;
    let points = octree.join(FILE_NAME);
    let view = OctreeView::open(&file).map_err(|e| Error::artifact(&points, e))?;
    let named = |e: Error| match e {
        Error::Octree(pvmap_octree::OctreeError::Format(e)) => Error::artifact(&points, e),
        e => e,
    };
    require_own(output, Kind::Map.start(), "a visibility map")?;
    // First of all, so that an output that cannot be made, or is being made, costs no work.
    let work = pvmap_visibility::open_work(output)?;
    let options = BuildOptions {
        max_level: config.max_level,
        leaf_capacity: config.leaf_capacity,
        max_spread: config.max_spread,
        shape: config.tree,
        profile: config.profile,
        spacing: config.spacing,
        interaction: config.interaction.clone(),
        approximation: config.approximation,
        fractions: config.fractions,
        memory_bytes: limits.memory_bytes,
        checkpoint: checkpoints.every,
        restart: checkpoints.restart,
    };
    limits.run(|| run(&view, work, config, &options, watch))?.map_err(named)
}

fn run(
    view: &OctreeView<'_>,
    work: WorkFolder,
    config: &BuildConfig,
    options: &BuildOptions,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    let tree = cut_tree(view, config, options.memory_bytes, watch)?;
    let (_, crs) = view.crs().map_err(|e: FormatError| Error::Octree(e.into()))?;
    let digest = view.summary().digest;
    let input = MapInput { tree: &tree, frame: view.frame(), crs, digest };
    let report = pvmap_visibility::build(&input, options, work, watch)?;
    let n = u128::from(report.summary.n_surfels);
    Ok(Built { report, n_leaf_pairs: n * n.saturating_sub(1) / 2 })
}

/// Shares out the memory of a cut.
fn cut_memory(memory_bytes: u64) -> CutMemory {
    // The tree gets most; to fill in its spacing takes some of what the points had.
    let points_bytes = memory_bytes / 16 * 5;
    CutMemory { points_bytes, tree_bytes: memory_bytes - points_bytes }
}

/// Proposes Δ and K of [V-7] for the points of an octree: those that are usual with the map of a
/// default configuration, which need not be there. Runs on the current rayon pool.
///
/// # Errors
/// Where the octree is damaged, its tree outgrows the memory or the run is asked to stop.
pub(crate) fn usual_nearness(
    view: &OctreeView<'_>,
    memory_bytes: u64,
    watch: &dyn Watch,
) -> Result<ExactOptions, Error> {
    let tree = cut_tree(view, &BuildConfig::default(), memory_bytes, watch)?;
    let n_surfels = u32::try_from(tree.surfels.len()).expect("a tree has fewer than 2^32 nodes");
    let half_spacing = |id: u32| Ok(tree.surfels[id as usize].half_spacing);
    ExactOptions::usual_of(n_surfels, half_spacing)
}

/// Cuts an octree as a configuration says. Runs on the current rayon pool.
///
/// # Errors
/// Where the octree is damaged, its tree outgrows the memory or the run is asked to stop.
pub(crate) fn cut_tree(
    view: &OctreeView<'_>,
    config: &BuildConfig,
    memory_bytes: u64,
    watch: &dyn Watch,
) -> Result<Tree, Error> {
    let BuildConfig { max_level, leaf_capacity, max_spread, tree, profile, spacing, .. } = *config;
    let shape = tree;
    let options = CutOptions { max_level, leaf_capacity, max_spread, shape, profile, spacing };
    Ok(cut(view, &options, cut_memory(memory_bytes), watch)?)
}
