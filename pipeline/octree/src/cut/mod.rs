//! From the sorted points to the tree of nodes and surfels, at the level and capacity of a build.
//!
//! One pass reads the points in windows (`points`) and hands them to one `cells` cutter a bin
//! (one in all for `paper`), which holds no more than the points of one unsettled cell; the points
//! of a settled leaf become a surfel (`leaf`), or several where their normals stray; where they are
//! spread thin (`spread`) they go on to smaller cells. What only
//! the whole tree knows is filled in at the end: the spacing of leaves (`spacing`), and how
//! far patches leave their cells.
//!
//! Start reading at [`cut`].

mod budget;
mod cells;
mod color;
mod leaf;
mod points;
mod spacing;
mod spread;
#[cfg(test)]
mod tests;

use pvmap_geometry::disc::Profile;
use pvmap_store::Watch;
use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::tree::{self, root_node};
use pvmap_vmap::{Node, OctreeView, Shape, Spacing, Tree};
use rayon::prelude::*;

use crate::OctreeError;
use budget::Budget;
use cells::{Cutter, Part, Rules};
pub use color::linear;
use points::{LeafPoint, Reader, Window};

/// What a build asks of the tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CutOptions {
    /// The level at which a cell is a leaf whatever it holds, 1…21.
    pub max_level: u8,
    /// The points up to which a cell is a leaf; 0 gives a full tree.
    pub leaf_capacity: u64,
    /// How many times the area that its points cover a leaf above `max_level` may stretch over;
    /// 0 asks for nothing.
    pub max_spread: u16,
    /// Which of the two trees.
    pub shape: Shape,
    /// Which radius the surfels get: all but `Paper` raise R² to h². `Oriented` has rectangles.
    pub profile: Profile,
    /// Where the half spacings come from; `Neighbors` widens R of all but `Paper` by them.
    pub spacing: Spacing,
}

/// The memory a cut may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CutMemory {
    /// For the points that are held. Less than they need costs time, not the cut.
    pub points_bytes: u64,
    /// For the tree, 40 bytes a node, 88 a surfel and 28 a rectangle, and its last blocks: less
    /// than 312 KiB a bin and as much when the bins are joined.
    pub tree_bytes: u64,
}

/// Cuts the points of an octree into leaves and makes their surfels.
///
/// Nodes come in preorder, surfels in leaf order; an octree without points gives an empty tree. The
/// tree depends on the points and the options alone. Runs on the current rayon pool: a window of
/// points is decoded in parallel, then the bins take their points in parallel.
///
/// A cell of more points than its share holds (1/5 of `points_bytes` among the bins) is read again
/// from the octree: up to six times if it is a leaf, once a level if it is cut further.
///
/// # Errors
/// Where the octree is damaged or its points are not in Morton order, the run was asked to stop,
/// the tree outgrows `tree_bytes`, or it has more nodes than ids.
///
/// Source: DESIGN.md §3, [D-3], [D-9].
pub fn cut(
    octree: &OctreeView<'_>,
    options: &CutOptions,
    memory: CutMemory,
    watch: &dyn Watch,
) -> Result<Tree, OctreeError> {
    let n_points = octree.summary().n_points;
    watch.stage("cut", Some(n_points), "points");
    if n_points == 0 {
        return Ok(Tree::default());
    }
    let reader = Reader::new(octree, options.shape, watch);
    let budget = Budget::new(memory.tree_bytes);
    let mut cutters = cutters(&reader, options, memory.points_bytes, &budget);
    // The cutters hold the other three fifths.
    let mut window = Window::new(memory.points_bytes / 5 * 2, n_points);
    while window.advance(&reader)? {
        let blocks = window.blocks();
        cutters
            .par_iter_mut()
            .try_for_each(|cutter| blocks.iter().try_for_each(|block| cutter.take(block)))?;
        watch.advance(window.n_points());
    }
    drop(window);
    let parts = cutters.into_par_iter().map(Cutter::finish);
    let mut tree = join(options.shape, n_points, parts.collect::<Result<_, _>>()?)?;
    spacing::fill(&mut tree, options.spacing, options.profile);
    tree::fill_overhangs(&mut tree);
    Ok(tree)
}

/// Makes the cutters of a shape, in the order of their subtrees.
fn cutters<'a>(
    reader: &'a Reader<'a>,
    options: &CutOptions,
    points_bytes: u64,
    budget: &'a Budget,
) -> Vec<Cutter<'a>> {
    let bins = match options.shape {
        Shape::Paper => -1..=-1,
        Shape::Binned => 0..=6,
    };
    // While a vector grows there are two, of the size and of twice the size: 3/5 at worst.
    let held_bytes = points_bytes / 5 / bins.clone().count() as u64;
    let rules = Rules {
        max_level: options.max_level,
        leaf_capacity: options.leaf_capacity,
        max_spread: options.max_spread,
        shape: options.shape,
        profile: options.profile,
        max_held: (held_bytes / size_of::<LeafPoint>() as u64) as usize,
    };
    bins.map(|bin| Cutter::new(reader, rules, budget, bin)).collect()
}

/// Joins the trees of the cutters: `paper` has but one, `binned` gets a root above them.
fn join(shape: Shape, n_points: u64, parts: Vec<Part>) -> Result<Tree, OctreeError> {
    let n_roots = usize::from(shape == Shape::Binned);
    let n_nodes = n_roots + parts.iter().map(|t| t.nodes.len()).sum::<usize>();
    let n_surfels = parts.iter().map(|t| t.surfels.len()).sum();
    let n_rects = parts.iter().map(|t| t.rects.len()).sum();
    let end = checked_id(n_nodes - 1)? + 1;
    // Room that is not used until the parts have given theirs back.
    let mut tree = Tree {
        nodes: Vec::with_capacity(n_nodes),
        surfels: Vec::with_capacity(n_surfels),
        rects: Vec::with_capacity(n_rects),
    };
    if shape == Shape::Binned {
        // There are at most as many surfels as nodes.
        let end_surfel = n_surfels as u32;
        tree.nodes.push(Node { end, end_surfel, ..root_node(shape, n_points) });
    }
    let parent_of_tops = if shape == Shape::Binned { 0 } else { NO_PARENT };
    for Part { nodes, surfels, rects } in parts {
        let (first, first_surfel) = (tree.nodes.len() as u32, tree.surfels.len() as u32);
        nodes.move_to(&mut tree.nodes, |mut node| {
            let is_top = node.parent == NO_PARENT;
            node.parent = if is_top { parent_of_tops } else { node.parent + first };
            node.end += first;
            node.first_surfel += first_surfel;
            node.end_surfel += first_surfel;
            node
        });
        surfels.move_to(&mut tree.surfels, |mut surfel| {
            surfel.node += first;
            surfel
        });
        rects.move_to(&mut tree.rects, |rect| rect);
    }
    Ok(tree)
}

/// Gives the id of the node after `n_nodes` others.
///
/// # Errors
/// Where ids run out: the ends of subtrees and [`NO_PARENT`] need the last two values.
fn checked_id(n_nodes: usize) -> Result<u32, OctreeError> {
    u32::try_from(n_nodes).ok().filter(|&id| id < NO_PARENT - 1).ok_or(OctreeError::TooManyNodes)
}
