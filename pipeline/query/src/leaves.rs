//! The cells of all leaves in memory: which of them hold a place.
//!
//! The leaves of a bin, and those of a tree without bins, stand in Morton order. So the leaf that
//! holds a place is found by halving, once a bin, where a walk down the tree looks at hundreds of
//! nodes.

use std::ops::Range;

use pvmap_geometry::{GridPoint, morton};
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Split};
use rayon::prelude::*;

use crate::map::Map;

/// The cells of the leaves, in the order of their surfels.
#[derive(Debug)]
pub(crate) struct Leaves {
    first_codes: Vec<u64>,
    levels: Vec<u8>,
    nodes: Vec<u32>,
    /// The leaves of each bin.
    bins: Vec<Range<usize>>,
    deepest: u8,
}

impl Leaves {
    /// Reads all nodes.
    pub(crate) fn of(map: &Map<'_>) -> Result<Leaves, FormatError> {
        let view = map.view();
        let leaf = |id: u32| match view.node(id) {
            Ok(node) => node.is_leaf().then_some(Ok((id, node))),
            Err(e) => Some(Err(e)),
        };
        let leaves: Vec<_> =
            (0..view.n_nodes()).into_par_iter().filter_map(leaf).collect::<Result<_, _>>()?;
        let misplaced = (0..).zip(&leaves).find(|&(i, (_, leaf))| leaf.first_surfel != i);
        if let Some((_, &(id, _))) = misplaced {
            return Err(map.broken_node(id, "is not the leaf of its surfel"));
        }
        let span = |first: u32, end: u32| first as usize..end as usize;
        let bins = match map.root()? {
            Some(root) if root.split == Split::Bins => map
                .children(0, root)
                .map(|child| child.map(|(_, bin)| span(bin.first_surfel, bin.end_surfel)))
                .collect::<Result<_, _>>()?,
            root => root.map(|root| span(root.first_surfel, root.end_surfel)).into_iter().collect(),
        };
        Ok(Leaves {
            first_codes: leaves.iter().map(|(_, leaf)| leaf.first_code).collect(),
            levels: leaves.iter().map(|(_, leaf)| leaf.level).collect(),
            nodes: leaves.iter().map(|&(id, _)| id).collect(),
            bins,
            deepest: leaves.iter().map(|(_, leaf)| leaf.level).max().unwrap_or(0),
        })
    }

    /// Gives the leaf of a surfel; none where there is no such surfel.
    #[inline]
    pub(crate) fn node_of(&self, surfel: u32) -> Option<u32> {
        self.nodes.get(surfel as usize).copied()
    }

    /// Walks the leaves whose closed cells hold a place: their surfels and nodes. Some may come
    /// twice.
    pub(crate) fn holding(&self, g: GridPoint) -> impl Iterator<Item = (u32, u32)> + '_ {
        // A place on the lowest faces of a cell is on the highest of the cell before, too.
        let within = (1u32 << (22 - self.deepest)) - 1;
        let faces = (0..3).filter(|&i| g[i] > 0 && g[i] & within == 0);
        let on_faces = faces.fold(0usize, |on, i| on | 1 << i);
        let beside = (0..8usize).filter(move |cell| cell & !on_faces == 0);
        let codes = beside.map(move |cell| {
            morton::encode([0, 1, 2].map(|i| g[i] - u32::from(cell >> i & 1 == 1)))
        });
        codes.flat_map(move |code| self.bins.iter().flat_map(move |bin| self.of_bin(bin, code)))
    }

    /// Walks the leaves of a bin whose cells hold a code: one, or its quadrants.
    fn of_bin(&self, bin: &Range<usize>, code: u64) -> impl Iterator<Item = (u32, u32)> + '_ {
        let first_codes = &self.first_codes[bin.clone()];
        let end = bin.start + first_codes.partition_point(|&first| first <= code);
        let last = end.checked_sub(1).filter(|&last| last >= bin.start);
        let cell = last.map(|last| (self.first_codes[last], self.levels[last]));
        let holds = |&(first, level): &(u64, u8)| morton::cell_range(first, level).contains(&code);
        let cell = cell.filter(holds);
        let ids = (bin.start..end).rev();
        let same = move |&i: &usize| cell == Some((self.first_codes[i], self.levels[i]));
        ids.take_while(same).map(|i| (i as u32, self.nodes[i]))
    }
}
