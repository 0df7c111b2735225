//! Candidate occluders of a node pair: the nodes that may hold a blocker, fewer and smaller as the
//! pair shrinks. What is dropped is proved not to block any segment of the pair.

use std::ops::Range;

use pvmap_geometry::Box3;
use pvmap_geometry::shaft::Shaft;
use pvmap_vmap::Tree;

use crate::bounds::Bounds;

/// What the culling asks of a node, in one cache line: it is asked some hundred million times.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub struct Occluder {
    /// Of every place at which a surfel under the node can block.
    blockers: Box3,
    /// Least and greatest of each component of the normals.
    normals: ([i16; 3], [i16; 3]),
    /// Bounds of n·c.
    offset: (i64, i64),
    /// One past the last node of the subtree.
    end: u32,
    level: u8,
    is_leaf: bool,
    can_block: bool,
}

/// Makes the occluders of all nodes, in node order.
pub fn occluders(tree: &Tree, bounds: &[Bounds]) -> Vec<Occluder> {
    tree.nodes
        .iter()
        .zip(bounds)
        .map(|(node, bound)| Occluder {
            blockers: bound.blockers,
            normals: bound.normals(),
            offset: bound.offsets(),
            end: node.end,
            level: node.level,
            is_leaf: node.is_leaf(),
            can_block: bound.can_block(),
        })
        .collect()
}

/// The two ends of all segments of a pair, and what can lie between them.
#[derive(Debug)]
pub struct Corridor {
    /// The box of each end.
    ends: [Doubled; 2],
    shaft: Shaft,
}

impl Corridor {
    /// Spans the segments between the centroids of two nodes.
    pub fn new(a: &Bounds, b: &Bounds) -> Corridor {
        let shaft = Shaft::new(&a.centroids, &b.centroids);
        Corridor { ends: [Doubled::new(&a.centroids), Doubled::new(&b.centroids)], shaft }
    }

    /// Proves that no surfel under a node blocks any segment.
    #[inline(always)]
    fn excludes(&self, node: &Occluder) -> bool {
        self.shaft.misses(&node.blockers) || self.never_between(node)
    }

    /// Proves that both ends lie on one side of every plane under a node. Every number is an
    /// integer below 2^44, so the f64 arithmetic is exact.
    #[inline(always)]
    fn never_between(&self, node: &Occluder) -> bool {
        let [a, b] = &self.ends;
        let ((low_a, high_a), (low_b, high_b)) = if node.normals.0 == node.normals.1 {
            (beside_plane(node, a), beside_plane(node, b))
        } else {
            let blockers = Doubled::new(&node.blockers);
            (beside_planes(node, &blockers, a), beside_planes(node, &blockers, b))
        };
        (low_a >= 0.0 && low_b >= 0.0) || (high_a <= 0.0 && high_b <= 0.0)
    }
}

/// Bounds n·x - n·c, four times over, where all planes under a node have one normal.
#[inline(always)]
fn beside_plane(node: &Occluder, end: &Doubled) -> (f64, f64) {
    let (middle, half) = along(node.normals, end);
    let (near, far) = node.offset;
    (middle - half - 4.0 * far as f64, middle + half - 4.0 * near as f64)
}

/// Bounds n·(x - c), four times over, by the directions from a node to the end.
#[inline(always)]
fn beside_planes(node: &Occluder, blockers: &Doubled, end: &Doubled) -> (f64, f64) {
    let mut away = *end;
    for i in 0..3 {
        away.sum[i] -= blockers.sum[i];
        away.size[i] += blockers.size[i];
    }
    let (middle, half) = along(node.normals, &away);
    (middle - half, middle + half)
}

/// Bounds n·v, four times over, for an interval of normals and a box of vectors; gives the middle
/// and the half range.
#[inline(always)]
fn along((least, greatest): ([i16; 3], [i16; 3]), v: &Doubled) -> (f64, f64) {
    let (mut middle, mut half) = (0.0, 0.0);
    for i in 0..3 {
        let (low, high) = (f64::from(least[i]), f64::from(greatest[i]));
        let (n, spread) = (high + low, high - low);
        middle += n * v.sum[i];
        half += n.abs() * v.size[i] + spread * (v.sum[i].abs() + v.size[i]);
    }
    (middle, half)
}

/// A box by the sum and the difference of its corners: twice its middle, twice its half sides.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Doubled {
    /// max + min, an axis each.
    sum: [f64; 3],
    /// max - min, an axis each.
    size: [f64; 3],
}

impl Doubled {
    /// Doubles a box. Its corners are below 2^24.
    #[inline(always)]
    fn new(b: &Box3) -> Doubled {
        let (low, high) = (b.min, b.max);
        Doubled {
            sum: [(high[0] + low[0]).into(), (high[1] + low[1]).into(), (high[2] + low[2]).into()],
            size: [(high[0] - low[0]).into(), (high[1] - low[1]).into(), (high[2] - low[2]).into()],
        }
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
    nodes: &[Occluder],
    corridor: &Corridor,
    depth: Depth,
    list: &mut Vec<u32>,
    from: Range<usize>,
) -> u64 {
    let mut n_tested = 0;
    for i in from {
        let root = list[i];
        // A subtree is a range of ids: walk it, leaping over what is dropped or kept whole.
        let (mut id, end) = (root, nodes[root as usize].end);
        while id < end {
            let node = &nodes[id as usize];
            n_tested += 1;
            if !node.can_block || corridor.excludes(node) {
                id = node.end;
                continue;
            }
            let small = match depth {
                Depth::Level(level) => node.level > level,
                Depth::Leaves => false,
            };
            if node.is_leaf || small {
                list.push(id);
                id = node.end;
            } else {
                id += 1;
            }
        }
    }
    n_tested
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds;
    use fastrand::Rng;
    use pvmap_geometry::disc::{self, Disc, Profile};

    /// A root over leaf nodes, one a disc: enough of a tree to make an occluder of a group.
    fn occluder(discs: &[Disc], profile: Profile) -> (Occluder, Bounds) {
        let bound = bounds::of_group(discs, profile);
        let node = pvmap_vmap::tree::root_node(pvmap_vmap::Shape::Paper, 1);
        let tree = Tree { nodes: vec![node], surfels: Vec::new() };
        (occluders(&tree, &[bound])[0], bound)
    }

    #[test]
    fn v2_what_a_corridor_excludes_never_blocks() {
        let mut rng = Rng::with_seed(4);
        let (mut n_proofs, mut n_blocked) = ([0; 2], [0; 2]);
        for i in 0..200_000 {
            let size = [16, 1 << 22][i % 2];
            let [a, b, k] = [0; 3].map(|_| bounds::tests::group(&mut rng, size));
            for profile in [Profile::Paper, Profile::Patch] {
                let [(_, bound_a), (_, bound_b)] = [&a, &b].map(|g| occluder(g, profile));
                let (node, _) = occluder(&k, profile);
                let is_excluded =
                    !node.can_block || Corridor::new(&bound_a, &bound_b).excludes(&node);
                let mut segments = a.iter().flat_map(|x| b.iter().map(move |y| (x, y)));
                let is_blocked =
                    segments.any(|(x, y)| k.iter().any(|k| disc::blocks(profile, x, y, k)));
                assert!(!(is_excluded && is_blocked), "{profile:?} {a:?} {b:?} {k:?}");
                n_proofs[i % 2] += usize::from(is_excluded);
                n_blocked[i % 2] += usize::from(is_blocked);
            }
        }
        let found = format!("{n_proofs:?} excluded, {n_blocked:?} blocked");
        assert!(n_proofs.into_iter().chain(n_blocked).all(|n| n > 5_000), "{found}");
    }
}
