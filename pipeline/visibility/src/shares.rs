//! How a build shares its memory out. [D-9]

use pvmap_geometry::Rect;
use pvmap_geometry::disc::Disc;
use pvmap_store::StoreError;
use pvmap_store::memory::require;
use pvmap_store::runs::Pair;
use pvmap_vmap::{Node, Surfel, Tree};

use crate::bounds::Bounds;
use crate::candidates::Family;
use crate::sheets::Sheets;
use crate::tasks::PlanLimits;

/// How the memory is shared that the tree leaves: a quarter is for the plan, three eighths for the
/// buffers of links, an eighth for finished runs of them, an eighth and what the buffers cannot use
/// for sheets; the rest is for deciders, merging and writing.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shares {
    pub(crate) plan: PlanLimits,
    pub(crate) runs_bytes: u64,
    pub(crate) sheets_bytes: u64,
    /// The tables, if they lie in mapped files, which is no part of the memory.
    pub(crate) mapped_bytes: u64,
}

/// Links above the tasks that are sorted at once: so many take 512 KiB.
pub(crate) const MAX_LINKS_ABOVE: usize = 1 << 16;

/// What each thread needs at the least.
const LEAST_THREAD_BYTES: u64 = 1 << 20;

/// A buffer gets all its room at once, which costs nothing until it is used.
const BUFFER_COST_BYTES: u64 = size_of::<Pair>() as u64;

/// More links than so many, 64 MiB, are not sorted at once.
const MAX_BUFFER_LINKS: u64 = 1 << 23;

impl Shares {
    /// Shares memory out for trees and `lists_bytes` of pairs to start from. Tables that would take
    /// more than half of the memory, with what is always there, lie in files.
    ///
    /// # Errors
    /// Where the memory does not even hold what is always there.
    pub(crate) fn new(
        trees: &[&Tree],
        lists_bytes: u64,
        memory_bytes: u64,
    ) -> Result<Shares, StoreError> {
        let n_threads = rayon::current_num_threads() as u64;
        let fixed_bytes = lists_bytes + trees.iter().map(|tree| fixed_bytes(tree)).sum::<u64>();
        let tables_bytes = trees.iter().map(|tree| tables_bytes(tree)).sum::<u64>();
        let are_mapped = fixed_bytes + tables_bytes > memory_bytes / 2;
        let mapped_bytes = if are_mapped { tables_bytes } else { 0 };
        let held_bytes = fixed_bytes + tables_bytes - mapped_bytes;
        let need_bytes = held_bytes + n_threads * LEAST_THREAD_BYTES;
        require("the surfels and nodes of this tree", need_bytes, memory_bytes)?;
        let spare_bytes = memory_bytes - held_bytes;
        let have_links = spare_bytes / 8 * 3 / n_threads / BUFFER_COST_BYTES;
        let buffer_links = have_links.min(MAX_BUFFER_LINKS);
        let unused_bytes = (have_links - buffer_links) * n_threads * BUFFER_COST_BYTES;
        // Half of a buffer may be full before a task that fills the other half.
        let plan = PlanLimits { task_links: buffer_links / 2, memory_bytes: spare_bytes / 4 };
        let (runs_bytes, sheets_bytes) = (spare_bytes / 8, spare_bytes / 8 + unused_bytes);
        Ok(Shares { plan, runs_bytes, sheets_bytes, mapped_bytes })
    }

    /// Makes sure that the buffers hold what tasks of at most so many leaf pairs may find.
    pub(crate) fn require_tasks(&self, target: u64) -> Result<u64, StoreError> {
        let need_links = 2 * target * rayon::current_num_threads() as u64;
        let have_links = self.plan.task_links.max(1) * 2 * rayon::current_num_threads() as u64;
        let bytes = |n_links: u64| 2 * BUFFER_COST_BYTES * n_links;
        require("the tasks of the build to go on with", bytes(need_links), bytes(have_links))?;
        Ok(target)
    }
}

/// What a build holds of a tree besides its tables, sheets, links and their plan.
pub(crate) fn fixed_bytes(tree: &Tree) -> u64 {
    let n_inner = tree.nodes.len().saturating_sub(tree.surfels.len());
    let of_surfels = tree.surfels.len() * size_of::<Surfel>();
    let of_nodes = tree.nodes.len() * size_of::<Node>() + n_inner * Sheets::A_FAMILY_BYTES;
    let of_rects = tree.rects.len() * size_of::<Rect>();
    (of_nodes + of_surfels + of_rects) as u64
}

/// What the tables of a build take.
fn tables_bytes(tree: &Tree) -> u64 {
    let n_inner = tree.nodes.len().saturating_sub(tree.surfels.len());
    // Families are found by a number for each node.
    let of_nodes = tree.nodes.len() * (size_of::<Bounds>() + size_of::<u32>());
    (of_nodes + n_inner * size_of::<Family>() + tree.surfels.len() * size_of::<Disc>()) as u64
}
