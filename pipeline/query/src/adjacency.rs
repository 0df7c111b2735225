//! All links of a map in memory.

use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, MapView};
use rayon::prelude::*;

use crate::filter::Filter;

/// Frames decoded before their links are put away: some 10 MB.
const N_AT_ONCE: usize = 256;

/// Of each node its parent and the later nodes it is linked to.
#[derive(Debug)]
pub(crate) struct Adjacency {
    parents: Vec<u32>,
    /// Where each node's partners start; one more than there are nodes.
    starts: Vec<u32>,
    /// The partners, rising within a list.
    partners: Vec<u32>,
    filter: Filter,
}

impl Adjacency {
    /// Says how much memory it takes at the most.
    pub(crate) fn held_bytes(view: &MapView<'_>) -> u64 {
        // A parent and a start a node; a partner and a byte of the filter a link.
        let of_nodes = 8 * u64::from(view.n_nodes());
        view.summary().n_links.saturating_mul(5).saturating_add(of_nodes)
    }

    /// Reads them all.
    pub(crate) fn of(view: &MapView<'_>) -> Result<Adjacency, FormatError> {
        let (n_links, n_nodes) = (view.summary().n_links, view.n_nodes());
        let broken = |what: &str| Err(view.file().section("links", 0)?.broken(0, what));
        // Places in the lists are u32.
        if n_links > u64::from(u32::MAX) {
            return broken("more links than fit in memory");
        }
        let parents: Vec<u32> =
            (0..n_nodes).into_par_iter().map(|id| view.parent(id)).collect::<Result<_, _>>()?;
        let mut starts = vec![0; n_nodes as usize + 1];
        let mut partners = Vec::with_capacity(n_links as usize);
        let frames: Vec<u64> = (0..view.links().n_blocks()).collect();
        for some in frames.chunks(N_AT_ONCE) {
            let decoded: Vec<_> = some.par_iter().map(|&i| view.links().lists(i)).collect();
            for lists in decoded {
                for (a, list) in lists?.lists() {
                    // A list may go on in the next frame: then this is its end so far.
                    if let Some(end) = starts.get_mut(a as usize + 1) {
                        partners.extend_from_slice(list);
                        *end = partners.len() as u32;
                    }
                }
                if partners.len() as u64 > n_links {
                    return broken("more links than the summary says");
                }
            }
        }
        // Nodes without a list end where the one before them does.
        let mut end = 0;
        for start in &mut starts {
            end = end.max(*start);
            *start = end;
        }
        let filter = Filter::of(&starts, &partners);
        Ok(Adjacency { parents, starts, partners, filter })
    }

    /// Gives the parent of a node; none where there is no such node.
    #[inline]
    pub(crate) fn parent(&self, id: u32) -> Option<u32> {
        self.parents.get(id as usize).copied()
    }

    /// Gives the later nodes that a node is linked to, rising.
    #[inline]
    pub(crate) fn partners_of(&self, a: u32) -> &[u32] {
        match self.starts.get(a as usize..a as usize + 2) {
            Some(&[start, end]) => &self.partners[start as usize..end as usize],
            _ => &[],
        }
    }

    /// Says whether (a, b), a < b, is a link.
    #[inline]
    pub(crate) fn contains(&self, (a, b): (u32, u32)) -> bool {
        self.filter.may_hold(a, b) && self.partners_of(a).binary_search(&b).is_ok()
    }
}
