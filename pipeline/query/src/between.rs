//! The links between two parts of the scan: top-down, reading only the frames they can be in.
//!
//! A link (a, b) is stored with its lower node, so the links between parts P and Q are those with a
//! over P and b over Q, and those with a over Q and b over P: two walks. A walk goes down the tree
//! over the one part; at a node it leaps through the node's list from one node of the other part
//! to the next. It goes no deeper once links have covered all of the other part that comes later
//! in the tree: a leaf pair is covered once [V-5]. So where all is open a walk ends at the top,
//! and where nothing is, it costs one look for each node over the one part.

use pvmap_vmap::{FormatError, Node};
use rayon::prelude::*;

use crate::frames::Lookup;
use crate::map::Map;
use crate::part::{Part, far_node};

/// Surfels of a subtree from which on its children are walked by threads of their own.
const WIDE: u32 = 1 << 12;

/// What is made of the links that a walk finds.
pub(crate) trait Tally: Default + Send {
    /// Takes a link: a node over the part that is walked, and a later one over the other.
    fn link(&mut self, walk: &Walk<'_, '_>, from: &Node, to: &Node);

    /// Notes that a node was looked at.
    fn look(&mut self) {}

    /// Takes what was found later in the tree.
    fn join(&mut self, later: Self);
}

/// A walk: all links (a, b), a < b, with a over `from` and b over `to`.
pub(crate) struct Walk<'q, 'a> {
    pub(crate) map: &'q Map<'a>,
    pub(crate) from: &'q Part,
    pub(crate) to: &'q Part,
    /// Says that nothing under a node sees anything of `to`.
    pub(crate) skip: &'q (dyn Fn(&Node) -> bool + Sync),
}

impl Walk<'_, '_> {
    /// Walks the whole tree.
    pub(crate) fn run<T: Tally>(&self) -> Result<T, FormatError> {
        let mut found = T::default();
        let mut lookup = Lookup::new(self.map);
        if let Some(root) = self.map.root()? {
            self.visit(0, root, 0, &mut lookup, &mut found)?;
        }
        Ok(found)
    }

    /// Walks a subtree; links of nodes above it cover `n_covered` surfels of the other part.
    fn visit<T: Tally>(
        &self,
        id: u32,
        node: Node,
        n_covered: u32,
        lookup: &mut Lookup<'_, '_>,
        found: &mut T,
    ) -> Result<(), FormatError> {
        // Links lead to what is later in the tree, and for nodes below that begins here.
        let n_later = self.to.n_surfels() - self.to.n_below(node.first_surfel);
        if self.from.n_under(&node) == 0 || n_covered >= n_later || (self.skip)(&node) {
            return Ok(());
        }
        found.look();
        let n_covered = n_covered.saturating_add(self.list(id, &node, lookup, found)?);
        if n_covered >= n_later {
            return Ok(());
        }
        if self.from.n_under(&node) < WIDE {
            for child in self.map.children(id, node) {
                let (child_id, child) = child?;
                self.visit(child_id, child, n_covered, lookup, found)?;
            }
            return Ok(());
        }
        let children: Vec<(u32, Node)> = self.map.children(id, node).collect::<Result<_, _>>()?;
        let walked = children.into_par_iter().map(|(child_id, child)| {
            let mut found = T::default();
            let mut lookup = Lookup::new(self.map);
            self.visit(child_id, child, n_covered, &mut lookup, &mut found).map(|()| found)
        });
        for later in walked.collect::<Vec<_>>() {
            found.join(later?);
        }
        Ok(())
    }

    /// Goes through a node's own links; gives how many surfels of the other part they cover.
    fn list<T: Tally>(
        &self,
        id: u32,
        node: &Node,
        lookup: &mut Lookup<'_, '_>,
        found: &mut T,
    ) -> Result<u32, FormatError> {
        let mut n_covered: u32 = 0;
        let mut wanted = self.to.node_from(node.end);
        while let Some(least) = wanted {
            let Some(partner) = lookup.partner_from(id, least)? else { break };
            wanted = self.to.node_from(partner);
            if wanted == Some(partner) {
                let far = far_node(self.map, node, partner)?;
                let n = self.to.n_under(&far);
                if n > 0 {
                    found.link(self, node, &far);
                    n_covered = n_covered.saturating_add(n);
                }
                // Node ids are below 2^32 - 1, the parent of the root.
                wanted = self.to.node_from(partner.saturating_add(1));
            }
        }
        Ok(n_covered)
    }
}
