//! The cells of all leaves in memory: which of them hold a place.
//!
//! The leaves of a bin, and those of a tree without bins, stand in Morton order. So the leaf that
//! holds a place is found by halving what begins in the same coarse cell, once a bin, where a walk
//! down the tree looks at hundreds of nodes.

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
    bins: Vec<Bin>,
    deepest: u8,
}

/// The leaves of a bin.
#[derive(Debug)]
struct Bin {
    leaves: Range<usize>,
    /// The first leaf that begins in each coarse cell or later; one more than there are cells.
    coarse: Vec<u32>,
    /// A code without so many bits is its coarse cell.
    shift: u32,
}

impl Bin {
    fn new(leaves: Range<usize>, first_codes: &[u64]) -> Bin {
        // Some four leaves begin in a cell, in those that are not empty more.
        let bits = (leaves.len().max(1).ilog2() + 1).saturating_sub(3);
        let shift = 63 - bits;
        let mut coarse = Vec::with_capacity((1 << bits) + 1);
        for leaf in leaves.clone() {
            let cell = (first_codes[leaf] >> shift) as usize;
            coarse.resize(coarse.len().max(cell + 1), leaf as u32);
        }
        coarse.resize((1 << bits) + 1, leaves.end as u32);
        Bin { leaves, coarse, shift }
    }

    /// Gives the last leaf that begins at a code or before.
    fn last_from(&self, code: u64, first_codes: &[u64]) -> Option<usize> {
        let cell = (code >> self.shift) as usize;
        let [from, to] = [self.coarse[cell] as usize, self.coarse[cell + 1] as usize];
        let end = from + first_codes[from..to].partition_point(|&first| first <= code);
        end.checked_sub(1).filter(|&last| last >= self.leaves.start)
    }
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
        let bins: Vec<Range<usize>> = match map.root()? {
            Some(root) if root.split == Split::Bins => map
                .children(0, root)
                .map(|child| child.map(|(_, bin)| span(bin.first_surfel, bin.end_surfel)))
                .collect::<Result<_, _>>()?,
            root => root.map(|root| span(root.first_surfel, root.end_surfel)).into_iter().collect(),
        };
        let first_codes: Vec<u64> = leaves.iter().map(|(_, leaf)| leaf.first_code).collect();
        let in_order = |bin: &Range<usize>| first_codes[bin.clone()].is_sorted();
        if let Some(bin) = bins.iter().find(|bin| !in_order(bin)) {
            return Err(map.broken_node(leaves[bin.start].0, "stands before an earlier cell"));
        }
        Ok(Leaves {
            bins: bins.into_iter().map(|bin| Bin::new(bin, &first_codes)).collect(),
            first_codes,
            levels: leaves.iter().map(|(_, leaf)| leaf.level).collect(),
            nodes: leaves.iter().map(|&(id, _)| id).collect(),
            deepest: leaves.iter().map(|(_, leaf)| leaf.level).max().unwrap_or(0),
        })
    }

    /// Gives the leaf of a surfel; none where there is no such surfel.
    #[inline]
    pub(crate) fn node_of(&self, surfel: u32) -> Option<u32> {
        self.nodes.get(surfel as usize).copied()
    }

    /// Calls `each` with surfel and node of every leaf whose closed cell holds a place, for some
    /// more than once.
    pub(crate) fn holding<E>(
        &self,
        g: GridPoint,
        mut each: impl FnMut(u32, u32) -> Result<(), E>,
    ) -> Result<(), E> {
        // A place on the lowest faces of a cell is on the highest of the cell before, too.
        let within = (1u32 << (22 - self.deepest)) - 1;
        let faces = (0..3).filter(|&i| g[i] > 0 && g[i] & within == 0);
        let on_faces = faces.fold(0u32, |on, i| on | 1 << i);
        for beside in (0..8).filter(|beside| beside & !on_faces == 0) {
            let code = morton::encode([0, 1, 2].map(|i| g[i] - (beside >> i & 1)));
            for last in self.bins.iter().filter_map(|bin| bin.last_from(code, &self.first_codes)) {
                let cell = (self.first_codes[last], self.levels[last]);
                if !morton::cell_range(cell.0, cell.1).contains(&code) {
                    continue;
                }
                // The quadrants of a cell stand side by side.
                let same = |&i: &usize| cell == (self.first_codes[i], self.levels[i]);
                for i in (0..=last).rev().take_while(same) {
                    each(i as u32, self.nodes[i])?;
                }
            }
        }
        Ok(())
    }
}
