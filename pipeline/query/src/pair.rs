//! Whether two places see each other, and by which link. Source: DESIGN.md [V-5], [V-6].

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
    /// this one has no such leaf.
    pub fn pair(&self, a: &Located, b: &Located) -> Result<PairAnswer, QueryError> {
        self.pair_with(&mut Lookup::new(self), a, b)
    }

    /// Does what [`Map::pair`] does; the lookup may have the right frame at hand.
    pub(crate) fn pair_with(
        &self,
        lookup: &mut Lookup<'_, '_>,
        a: &Located,
        b: &Located,
    ) -> Result<PairAnswer, QueryError> {
        self.check_leaf(a)?;
        self.check_leaf(b)?;
        if a.node == b.node {
            return Ok(PairAnswer { visible: true, link: None });
        }
        for link in self.links_over(lookup, a, b)?.iter() {
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
    pub(crate) fn links_over(
        &self,
        lookup: &Lookup<'_, '_>,
        a: &Located,
        b: &Located,
    ) -> Result<LinksOver, FormatError> {
        let (low, high) = (a.node.min(b.node), a.node.max(b.node));
        // Ids rise from a node to those below it and on to those beside it, so the first node over
        // the later leaf that is not after the earlier one is over both.
        let (after, ancestor) = self.climb(lookup, high, low)?;
        let (before, met) = self.climb(lookup, low, ancestor)?;
        if met != ancestor {
            return Err(self.broken_node(low, "has no way up to the root"));
        }
        Ok(LinksOver { sides: [before, after], is_slanted: self.is_slanted() })
    }

    /// Lists the nodes from `id` up that are after `bound`; gives the first that is not, too.
    fn climb(
        &self,
        lookup: &Lookup<'_, '_>,
        mut id: u32,
        bound: u32,
    ) -> Result<(Side, u32), FormatError> {
        let mut side = Side::default();
        while id > bound {
            if !side.push(id) {
                return Err(self.broken_node(id, "has no way up to the root"));
            }
            id = lookup.parent(id)?;
        }
        Ok((side, id))
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

    /// Gives the node so many steps below the topmost; from the leaf on the leaf. Of one at least.
    fn nth_down(&self, steps: usize) -> u32 {
        self.up[self.len - 1 - steps.min(self.len - 1)]
    }
}

/// The links that can cover two different leaves.
#[derive(Debug)]
pub(crate) struct LinksOver {
    sides: [Side; 2],
    is_slanted: bool,
}

impl LinksOver {
    /// Walks them, the highest first: their lists are short and many questions need them.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let [a, b] = &self.sides;
        let n = match (a.len.min(b.len), self.is_slanted) {
            (0, _) => 0,
            (_, true) => a.len * b.len,
            (_, false) => a.len.max(b.len),
        };
        (0..n).map(move |rank| match self.is_slanted {
            // Any two nodes may be joined: no telling which on one side meets which.
            true => (a.nth_down(rank / b.len), b.nth_down(rank % b.len)),
            // From two siblings down, both sides at once; a leaf waits for the other.
            false => (a.nth_down(rank), b.nth_down(rank)),
        })
    }
}
