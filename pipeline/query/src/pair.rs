//! Whether two places see each other, and by which link. Source: DESIGN.md [V-5], [V-6].

use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Node};

use crate::error::QueryError;
use crate::frames::Lookup;
use crate::locate::Located;
use crate::map::{MAX_PATH, Map};

/// Whether two places see each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PairAnswer {
    /// Whether they do.
    pub visible: bool,
    /// The link that says so; none between places of one leaf, which always see each other.
    pub link: Option<Link>,
}

/// The link that settles a pair, seen from the two places in the order they were given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Link {
    /// The node on the first place's side, the node on the second's.
    pub nodes: (u32, u32),
    /// The points in each: so many pairs the link settles at once.
    pub n_points: (u64, u64),
    /// The surfels in each, the first and one past the last: all of these see each other.
    pub surfels: ((u32, u32), (u32, u32)),
}

impl Map<'_> {
    /// Decides whether two located places see each other.
    ///
    /// # Errors
    /// Where what is read of the map is damaged, or `a` or `b` was located on another map and
    /// this one has no such node.
    pub fn pair(&self, a: &Located, b: &Located) -> Result<PairAnswer, QueryError> {
        if a.node == b.node {
            return Ok(PairAnswer { visible: true, link: None });
        }
        let over = self.links_over(a, b)?;
        let mut lookup = Lookup::new(self.view(), &self.frames);
        for rank in 0..over.len() {
            let link = over.nth(rank);
            if lookup.contains(link)? {
                return self.seen_by(a, b, link);
            }
        }
        Ok(PairAnswer { visible: false, link: None })
    }

    /// Makes the answer of a pair that a link covers.
    pub(crate) fn seen_by(
        &self,
        a: &Located,
        b: &Located,
        (x, y): (u32, u32),
    ) -> Result<PairAnswer, QueryError> {
        let nodes = if a.node < b.node { (x, y) } else { (y, x) };
        let (a, b) = (self.view().node(nodes.0)?, self.view().node(nodes.1)?);
        let surfels = |node: &Node| (node.first_surfel, node.end_surfel);
        let link =
            Link { nodes, n_points: (a.n_points, b.n_points), surfels: (surfels(&a), surfels(&b)) };
        Ok(PairAnswer { visible: true, link: Some(link) })
    }

    /// Lists the links that can cover two leaves, in either order.
    pub(crate) fn links_over(&self, a: &Located, b: &Located) -> Result<LinksOver, FormatError> {
        let (low, high) = (a.node.min(b.node), a.node.max(b.node));
        Ok(LinksOver {
            sides: [self.side_before(low, high)?, self.side_after(high, low)?],
            is_given: self.from_given_pairs(),
        })
    }

    /// Lists the nodes over leaf a that end before b.
    fn side_before(&self, a: u32, b: u32) -> Result<Side, FormatError> {
        let mut side = Side::default();
        let mut id = a;
        loop {
            let node = self.view().node(id)?;
            if node.end > b {
                return Ok(side);
            }
            if node.parent == NO_PARENT || !side.push(id) {
                return Err(self.broken_node(id, "has no way up to the root"));
            }
            id = node.parent;
        }
    }

    /// Lists the nodes over leaf b that start after a.
    fn side_after(&self, b: u32, a: u32) -> Result<Side, FormatError> {
        let mut side = Side::default();
        let mut id = b;
        while id > a {
            if !side.push(id) {
                return Err(self.broken_node(id, "has no way up to the root"));
            }
            id = self.view().node(id)?.parent;
        }
        Ok(side)
    }
}

/// The nodes of one side of a pair: from the leaf up to, without, the common ancestor.
#[derive(Debug, Default)]
struct Side {
    up: [u32; MAX_PATH],
    len: usize,
}

impl Side {
    /// Adds the next node up; says no where no tree is that deep.
    fn push(&mut self, id: u32) -> bool {
        let room = self.len < MAX_PATH;
        if room {
            self.up[self.len] = id;
            self.len += 1;
        }
        room
    }

    /// Gives the node so many steps below the topmost; from the leaf on the leaf.
    fn nth_down(&self, steps: usize) -> u32 {
        self.up[self.len - 1 - steps.min(self.len - 1)]
    }
}

/// The links that can cover two different leaves, the highest first.
///
/// All nodes on the one side come before all on the other, so links that go down rise.
#[derive(Debug)]
pub(crate) struct LinksOver {
    sides: [Side; 2],
    is_given: bool,
}

impl LinksOver {
    /// Counts them.
    pub(crate) fn len(&self) -> usize {
        let [a, b] = &self.sides;
        if self.is_given { a.len * b.len } else { a.len.max(b.len) }
    }

    /// Gives the link of a rank below [`LinksOver::len`].
    pub(crate) fn nth(&self, rank: usize) -> (u32, u32) {
        let [a, b] = &self.sides;
        if self.is_given {
            // Any two nodes may have been given: no telling which on one side meets which.
            (a.nth_down(rank / b.len), b.nth_down(rank % b.len))
        } else {
            // From two siblings down, both sides at once; a leaf waits for the other.
            (a.nth_down(rank), b.nth_down(rank))
        }
    }
}
