//! How much light two nodes can exchange at the most: what is below a least one is tried by a
//! sample. Source: FORMAT.md [F-26].

use std::f64::consts::PI;

use pvmap_vmap::{Spacing, Tree};

use crate::layers::{Extent, extents, nearest2};

/// Bounds of the exchange of all node pairs, and the least one that is looked into.
#[derive(Debug)]
pub struct Exchange {
    nodes: Vec<Outline>,
    /// π times the area of all leaves times the least exchange.
    least: f64,
}

/// What bounds the exchange of a node.
#[derive(Debug, Clone, Copy)]
struct Outline {
    extent: Extent,
    /// The area of all its leaves, grid steps².
    area: f64,
}

impl Exchange {
    /// Gives what making it for a tree takes of memory.
    pub fn bytes(tree: &Tree) -> u64 {
        (tree.nodes.len() * (size_of::<Outline>() + size_of::<Extent>())) as u64
    }

    /// Outlines every node of a tree; `least` is a share of what all leaves exchange, 0…1.
    pub fn new(tree: &Tree, spacing: Spacing, least: f64) -> Exchange {
        let outlined =
            extents(tree, spacing).into_iter().map(|extent| Outline { extent, area: 0.0 });
        let mut nodes: Vec<Outline> = outlined.collect();
        // Preorder backwards: children come before their parent.
        for (id, node) in tree.nodes.iter().enumerate().rev() {
            if node.is_leaf() {
                nodes[id].area = nodes[id].extent.largest_area();
            }
            if id > 0 {
                nodes[node.parent as usize].area += nodes[id].area;
            }
        }
        let all = nodes.first().map_or(0.0, |root| root.area);
        Exchange { nodes, least: PI * all * least }
    }

    /// Says whether two nodes exchange less than the least that is looked into: cos·cos·area·area
    /// over π·d²·(the area of all leaves), with the most that each of these can be.
    pub fn is_below(&self, a: u32, b: u32) -> bool {
        let [a, b] = [a, b].map(|id| &self.nodes[id as usize]);
        let near2 = nearest2(&a.extent.centroids, &b.extent.centroids);
        near2 > 0.0 && {
            let near = near2.sqrt();
            let cosines = a.extent.cosine(&b.extent, near) * b.extent.cosine(&a.extent, near);
            cosines * a.area * b.area < self.least * near2
        }
    }
}
