//! The tree over the elements, and the links between its nodes.

use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{Fraction, MapView};
use rayon::prelude::*;

use crate::error::LightError;

/// A range of elements: the first, and one past the last.
pub type Span = (u32, u32);

/// A node: where its subtree ends, and which elements are in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Subtree {
    /// Its parent, [`NO_PARENT`] at the root.
    pub parent: u32,
    /// One past the last node of the subtree.
    pub end: u32,
    /// Its elements.
    pub elements: Span,
}

/// Nodes in preorder; each leaf is one element, in leaf order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Hierarchy {
    nodes: Vec<Subtree>,
}

impl Hierarchy {
    /// Keeps nodes that are a tree.
    ///
    /// # Errors
    /// Where they are none: children do not follow their parent, or their elements are not, one
    /// after another, those of the parent.
    pub fn new(nodes: Vec<Subtree>) -> Result<Hierarchy, LightError> {
        let hierarchy = Hierarchy { nodes };
        for id in 0..hierarchy.n_nodes() {
            hierarchy.check(id)?;
        }
        Ok(hierarchy)
    }

    /// Makes a root with so many leaves, nodes 1…n.
    pub fn flat(n_elements: u32) -> Hierarchy {
        let root = Subtree { parent: NO_PARENT, end: n_elements + 1, elements: (0, n_elements) };
        let leaf = |i| Subtree { parent: 0, end: i + 2, elements: (i, i + 1) };
        let nodes = std::iter::once(root).chain((0..n_elements).map(leaf)).collect();
        Hierarchy { nodes }
    }

    /// Reads the nodes of a map.
    ///
    /// # Errors
    /// Where the map is damaged.
    pub fn of_map(map: &MapView<'_>) -> Result<Hierarchy, LightError> {
        let subtree = |id| {
            let node = map.node(id)?;
            let elements = (node.first_surfel, node.end_surfel);
            Ok::<_, LightError>(Subtree { parent: node.parent, end: node.end, elements })
        };
        let nodes = (0..map.n_nodes()).into_par_iter().map(subtree);
        Hierarchy::new(nodes.collect::<Result<_, _>>()?)
    }

    fn check(&self, id: u32) -> Result<(), LightError> {
        let node = self.node(id);
        let (first, end) = node.elements;
        let wrong = |what| Err(LightError::Tree { node: id, what });
        if id == 0 && (node.parent, node.end, first) != (NO_PARENT, self.n_nodes(), 0) {
            return wrong("is no root of them all");
        }
        if node.end <= id || node.end > self.n_nodes() || first >= end {
            return wrong("has an impossible subtree");
        }
        if self.is_leaf(id) {
            return if end - first == 1 { Ok(()) } else { wrong("is a leaf of several elements") };
        }
        // Every child is looked at from its parent, and each node is the child of one.
        let (mut child, mut next) = (id + 1, first);
        while child < node.end {
            let below = self.node(child);
            let fits = below.parent == id && below.elements.0 == next;
            if !fits || below.end <= child || below.end > node.end {
                return wrong("has a child out of place");
            }
            (child, next) = (below.end, below.elements.1);
        }
        if next == end { Ok(()) } else { wrong("has not the elements of its children") }
    }

    /// Checks that a link joins two nodes, neither below the other.
    pub(crate) fn check_link(&self, (a, b): (u32, u32)) -> Result<(), LightError> {
        let wrong = |node, what| Err(LightError::Tree { node, what });
        if a >= b || b >= self.n_nodes() {
            return wrong(b, "is linked, but is not there or does not come after its partner");
        }
        if b < self.node(a).end {
            return wrong(a, "is linked with a node below it");
        }
        Ok(())
    }

    /// Counts the nodes.
    pub fn n_nodes(&self) -> u32 {
        // A map has 32 bits for them.
        self.nodes.len() as u32
    }

    /// Counts the elements.
    pub fn n_elements(&self) -> usize {
        self.nodes.first().map_or(0, |root| root.elements.1 as usize)
    }

    /// Gives a node, `id` < [`Hierarchy::n_nodes`].
    #[inline]
    pub fn node(&self, id: u32) -> Subtree {
        self.nodes[id as usize]
    }

    /// Says whether a node is a leaf.
    #[inline]
    pub fn is_leaf(&self, id: u32) -> bool {
        self.node(id).end == id + 1
    }

    /// Walks the children of a node; a leaf has none.
    pub fn children(&self, id: u32) -> impl Iterator<Item = u32> + '_ {
        let end = self.node(id).end;
        let mut next = id + 1;
        std::iter::from_fn(move || {
            let child = next;
            (child < end).then(|| {
                next = self.node(child).end;
                child
            })
        })
    }

    /// Gives the first leaf of a node's subtree.
    pub(crate) fn first_leaf(&self, mut id: u32) -> u32 {
        while !self.is_leaf(id) {
            id += 1;
        }
        id
    }

    /// Finds the leaf of an element.
    pub(crate) fn leaf_of(&self, element: u32) -> u32 {
        let mut id = 0;
        while !self.is_leaf(id) {
            let holds = |child: &u32| element < self.node(*child).elements.1;
            id = self.children(id).find(holds).unwrap_or(id + 1);
        }
        id
    }

    /// Walks from a node up to the root, itself first.
    pub fn path(&self, id: u32) -> impl Iterator<Item = u32> + '_ {
        let up = |id: &u32| Some(self.node(*id).parent).filter(|&parent| parent != NO_PARENT);
        std::iter::successors(Some(id), up)
    }
}

/// Links between nodes, each unordered pair once, in blocks that can be read on their own.
pub trait Links: Sync {
    /// Counts the blocks.
    fn n_blocks(&self) -> u64;

    /// Reads a block: pairs (a, b), a < b.
    ///
    /// # Errors
    /// Where it is damaged.
    fn block(&self, index: u64) -> Result<Vec<(u32, u32)>, LightError>;

    /// Says whether all elements under the ends of every link face each other. Otherwise cosines
    /// are looked at for each pair of nodes.
    fn all_face(&self) -> bool;

    /// Reads the pairs of nodes that see a part of each other. At most one covers two elements;
    /// they exchange that part, whether a link covers them or not.
    ///
    /// # Errors
    /// Where they are damaged.
    fn fractions(&self) -> Result<Vec<Fraction>, LightError> {
        Ok(Vec::new())
    }
}

impl Links for [(u32, u32)] {
    fn n_blocks(&self) -> u64 {
        1
    }

    fn block(&self, _: u64) -> Result<Vec<(u32, u32)>, LightError> {
        Ok(self.to_vec())
    }

    fn all_face(&self) -> bool {
        false
    }
}

impl Links for MapView<'_> {
    fn n_blocks(&self) -> u64 {
        self.links().n_blocks()
    }

    fn block(&self, index: u64) -> Result<Vec<(u32, u32)>, LightError> {
        Ok(self.links().lists(index)?.iter().collect())
    }

    fn all_face(&self) -> bool {
        // With these, nodes stand for leaves, or some leaves for all. [F-14]
        let is_coarse = |line: &str| {
            ["opening_angle", "min_exchange"].contains(&line.split(" = ").next().unwrap_or(line))
        };
        self.config().is_ok_and(|config| !config.lines().any(is_coarse))
    }

    fn fractions(&self) -> Result<Vec<Fraction>, LightError> {
        let Some(pairs) = MapView::fractions(self) else { return Ok(Vec::new()) };
        let mut fractions = Vec::new();
        for index in 0..pairs.n_blocks() {
            for pair in pairs.lists(index)?.iter() {
                let what = "has more free segments than were tried";
                let wrong = LightError::Tree { node: pair.0, what };
                fractions.push(Fraction::of_pair(pair).ok_or(wrong)?);
            }
        }
        Ok(fractions)
    }
}
