//! Candidate occluders of a node pair: the nodes that may hold a blocker, fewer and smaller as the
//! pair shrinks. What is dropped is proved not to block any segment of the pair.

use pvmap_geometry::Box3;
use pvmap_geometry::shaft::Shaft;
use pvmap_vmap::Tree;

use crate::bounds::Bounds;

/// The two ends of all segments of a pair, and what can lie between them.
#[derive(Debug)]
pub struct Corridor {
    a: Box3,
    b: Box3,
    shaft: Shaft,
}

impl Corridor {
    /// Spans the segments between the centroids of two nodes.
    pub fn new(a: &Bounds, b: &Bounds) -> Corridor {
        Corridor { a: a.centroids, b: b.centroids, shaft: Shaft::new(&a.centroids, &b.centroids) }
    }

    /// Proves that no surfel under a node blocks any segment.
    #[inline]
    fn excludes(&self, node: &Bounds) -> bool {
        self.shaft.misses(&node.blockers) || node.never_between(&self.a, &self.b)
    }
}

/// How far candidates are opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// To the cells of this level: about the size of the pair at hand.
    Level(u8),
    /// To leaves.
    Leaves,
}

/// Refines a list for a smaller pair: drops what cannot block, opens what is larger than `depth`
/// asks, and appends the rest to `list` (the old list is `list[from]`). Gives the nodes tested.
pub fn refine(
    tree: &Tree,
    bounds: &[Bounds],
    corridor: &Corridor,
    depth: Depth,
    list: &mut Vec<u32>,
    from: std::ops::Range<usize>,
) -> u64 {
    from.map(|i| open(tree, bounds, corridor, depth, list[i], list)).sum()
}

/// Recurses at most 24 deep: bins, 21 levels of octants, quadrants.
fn open(
    tree: &Tree,
    bounds: &[Bounds],
    corridor: &Corridor,
    depth: Depth,
    id: u32,
    list: &mut Vec<u32>,
) -> u64 {
    let found = &bounds[id as usize];
    if !found.can_block() || corridor.excludes(found) {
        return 1;
    }
    let node = &tree.nodes[id as usize];
    let small = match depth {
        Depth::Level(level) => node.level > level,
        Depth::Leaves => false,
    };
    if node.is_leaf() || small {
        list.push(id);
        return 1;
    }
    tree.children(id).map(|child| open(tree, bounds, corridor, depth, child, list)).sum::<u64>() + 1
}
