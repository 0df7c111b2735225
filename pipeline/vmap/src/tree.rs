//! The tree of a map in memory, and the one function that routes a point to its leaf.

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_geometry::normal::{self, Normal};
use pvmap_geometry::{Box3, GridPoint, Rect, morton};

use crate::records::{NO_PARENT, Node, Split, Surfel};

/// Which of the two trees of DESIGN.md §3.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// The plain adaptive octree of the paper's §4.
    Paper,
    /// One octree a normal bin, leaves split by normal quadrants.
    Binned,
}

/// Where the half spacing of a leaf comes from, the margin of its patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spacing {
    /// The box of its own points. Source: DESIGN.md §3.
    Leaf,
    /// The boxes of the leaves around it, 16 points in all; it widens R, too. [F-21]
    Neighbors,
}

/// Nodes in preorder and surfels in leaf order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tree {
    /// All nodes; a subtree is a range of ids. Empty for a scan without points.
    pub nodes: Vec<Node>,
    /// All leaves.
    pub surfels: Vec<Surfel>,
    /// What each leaf is cut to with profile `oriented`; empty with others.
    pub rects: Vec<Rect>,
}

impl Tree {
    /// Walks the children of a node in slot order; a leaf has none.
    pub fn children(&self, node: u32) -> impl Iterator<Item = u32> + '_ {
        let end = self.nodes[node as usize].end;
        let mut next = node + 1;
        std::iter::from_fn(move || {
            let child = next;
            (child < end).then(|| {
                next = self.nodes[child as usize].end;
                child
            })
        })
    }

    /// Gives kids(A): the children, or the node itself if it is a leaf. Source: DESIGN.md [V-4].
    pub fn kids(&self, node: u32) -> impl Iterator<Item = u32> + '_ {
        let leaf = self.nodes[node as usize].is_leaf().then_some(node);
        leaf.into_iter().chain(self.children(node))
    }

    /// Gives a leaf's disc as a profile sees it.
    pub fn disc(&self, surfel: u32, profile: Profile) -> Disc {
        disc_of(&self.surfels[surfel as usize], self.rects.get(surfel as usize), profile)
    }
}

/// Fills in the overhangs of nodes, whose leaves have their patch boxes. [F-20]
pub fn fill_overhangs(tree: &mut Tree) {
    // The boxes of open nodes, each with the node they belong to: backwards in preorder the
    // children come before their parent, the last child first.
    let mut open: Vec<(u32, Box3)> = Vec::new();
    for id in (0..tree.nodes.len() as u32).rev() {
        let node = &mut tree.nodes[id as usize];
        let below = open.pop_if(|(parent, _)| *parent == id).map(|(_, around)| around);
        let around = below.unwrap_or_else(|| tree.surfels[node.first_surfel as usize].patch);
        node.overhang = overhang(&node.cell(), &around);
        match open.last_mut() {
            Some((parent, siblings)) if *parent == node.parent => {
                *siblings = siblings.join(&around);
            }
            _ => open.push((node.parent, around)),
        }
    }
}

/// Gives the grid steps by which a box leaves a cell at the most.
pub fn overhang(cell: &Box3, other: &Box3) -> u32 {
    let beyond = (0..3).map(|i| (cell.min[i] - other.min[i]).max(other.max[i] - cell.max[i]));
    beyond.fold(0, i32::max) as u32
}

/// Gives a surfel's disc as a profile sees it; its rectangle is that of profile `oriented`.
pub fn disc_of(surfel: &Surfel, rect: Option<&Rect>, profile: Profile) -> Disc {
    Disc {
        centroid: surfel.centroid.map(|v| v as i32),
        normal: surfel.normal,
        two_sided: surfel.two_sided,
        radius2: surfel.radius2,
        limit: match profile {
            Profile::Paper => surfel.cell(),
            Profile::Patch | Profile::Oriented => surfel.patch,
        },
        rect: rect.copied().unwrap_or(Rect::NONE),
    }
}

/// Nodes that can be walked: a tree in memory, or one in a mapped file.
pub trait Nodes {
    /// What reading a node can fail with.
    type Error;

    /// Counts the nodes.
    fn n_nodes(&self) -> u32;

    /// Reads a node.
    ///
    /// # Errors
    /// Where the file it is read from is damaged.
    fn node(&self, id: u32) -> Result<Node, Self::Error>;
}

impl Nodes for Tree {
    type Error = std::convert::Infallible;

    fn n_nodes(&self) -> u32 {
        self.nodes.len() as u32
    }

    fn node(&self, id: u32) -> Result<Node, Self::Error> {
        Ok(self.nodes[id as usize])
    }
}

/// What decides a point's leaf besides the tree. Source: DESIGN.md [D-3].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoutingKey {
    /// Grid position.
    pub g: GridPoint,
    /// Quantised normal, zero without one.
    pub normal: Normal,
    /// Whether the normal's side is known.
    pub oriented: bool,
}

impl RoutingKey {
    /// Gives the bin of the point in a `binned` tree.
    #[inline]
    pub fn bin(&self) -> u8 {
        normal::bin(self.normal, self.oriented)
    }

    /// Gives the normal with the sign the `binned` tree sees.
    #[inline]
    pub fn binned_normal(&self) -> Normal {
        if self.oriented { self.normal } else { normal::canonical_binned(self.normal) }
    }

    /// Gives the quadrant of the point among the quadrant leaves of `bin` (0…5).
    #[inline]
    pub fn quadrant(&self, bin: u8) -> u8 {
        normal::quadrant(self.binned_normal(), usize::from(bin / 2))
    }
}

/// Routes a point to its leaf: the deepest node whose cell, bin and quadrant hold it.
///
/// Every point of the octree reaches a leaf; other points may end at an inner node without the
/// child they would need, and get `None`.
///
/// # Errors
/// Those of reading a node.
pub fn route<N: Nodes>(nodes: &N, key: &RoutingKey) -> Result<Option<u32>, N::Error> {
    if nodes.n_nodes() == 0 {
        return Ok(None);
    }
    let code = morton::encode(key.g);
    let (mut id, mut node) = (0, nodes.node(0)?);
    loop {
        let slot = match node.split {
            Split::Leaf => return Ok(Some(id)),
            Split::Octants if node.level >= morton::MAX_LEVEL => return Ok(None),
            Split::Octants => morton::octant(code, node.level + 1),
            Split::Quadrants => key.quadrant(node.bin.clamp(0, 5) as u8),
            Split::Bins => key.bin(),
        };
        let mut next = id + 1;
        loop {
            if next >= node.end.min(nodes.n_nodes()) {
                return Ok(None);
            }
            let child = nodes.node(next)?;
            if child.slot == slot && child.parent == id {
                (id, node) = (next, child);
                break;
            }
            // A damaged subtree end must not send the walk backwards.
            next = child.end.max(next + 1);
        }
    }
}

/// Gives the root node of a tree of a shape over so many points.
pub fn root_node(shape: Shape, n_points: u64) -> Node {
    Node {
        parent: NO_PARENT,
        end: 1,
        first_surfel: 0,
        end_surfel: 0,
        n_points,
        first_code: 0,
        level: 0,
        bin: -1,
        split: if shape == Shape::Binned { Split::Bins } else { Split::Octants },
        slot: 0,
        overhang: 0,
    }
}
