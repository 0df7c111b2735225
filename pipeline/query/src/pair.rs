//! Whether two places see each other, and by which link. Source: DESIGN.md [V-5], [V-6].

use pvmap_vmap::FormatError;
use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::tree::Nodes;

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
        let (low, high) = (a.node.min(b.node), a.node.max(b.node));
        let link = match self.link_over(low, high)? {
            None => None,
            Some((x, y)) => {
                let nodes = if a.node == low { (x, y) } else { (y, x) };
                let n_points = |id| self.view().node(id).map(|node| node.n_points);
                Some(Link { nodes, n_points: (n_points(nodes.0)?, n_points(nodes.1)?) })
            }
        };
        Ok(PairAnswer { visible: link.is_some(), link })
    }

    /// Finds the link that covers two leaves, a < b.
    ///
    /// All nodes on a's side come before all on b's, so lookups that go down rise.
    fn link_over(&self, a: u32, b: u32) -> Result<Option<(u32, u32)>, FormatError> {
        let (side_a, side_b) = (self.side_before(a, b)?, self.side_after(b, a)?);
        let mut lookup = Lookup::new(self.view(), &self.frames);
        if self.from_given_pairs() {
            // Any two nodes may have been given: no telling which above a meets which above b.
            for x in side_a.down() {
                for y in side_b.down() {
                    if lookup.contains((x, y))? {
                        return Ok(Some((x, y)));
                    }
                }
            }
            return Ok(None);
        }
        // From two siblings down, both sides at once; a leaf waits for the other: kids(A)×kids(B).
        let (leaf_a, leaf_b) = (side_a.down().chain(std::iter::repeat(a)), side_b.down());
        let leaf_b = leaf_b.chain(std::iter::repeat(b));
        for pair in leaf_a.zip(leaf_b).take(side_a.len.max(side_b.len)) {
            if lookup.contains(pair)? {
                return Ok(Some(pair));
            }
        }
        Ok(None)
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

    /// Walks down to the leaf.
    fn down(&self) -> impl Iterator<Item = u32> + '_ {
        self.up[..self.len].iter().rev().copied()
    }
}
