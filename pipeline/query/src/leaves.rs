//! The cells of all leaves in memory: which of them hold a place.
//!
//! The leaves of a bin, and those of a tree without bins, stand in Morton order. So the leaf that
//! holds a place is found by halving what begins in the same coarse cell, once a bin, where a walk
//! down the tree looks at hundreds of nodes.

use std::ops::Range;

use pvmap_geometry::{GridPoint, morton};
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Node, Split};
use rayon::prelude::*;

use crate::map::Map;

/// The leaves, in the order of their surfels.
#[derive(Debug)]
pub(crate) struct Leaves {
    leaves: Vec<Leaf>,
    bins: Vec<Bin>,
    deepest: u8,
}

/// The cell of a leaf.
#[derive(Debug, Clone, Copy)]
struct Leaf {
    first_code: u64,
    node: u32,
    level: u8,
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
    fn new(leaves: Range<usize>, all: &[Leaf]) -> Bin {
        // Two cells or more a leaf: most are empty, as leaves lie along surfaces.
        let bits = leaves.len().max(1).ilog2() + 2;
        let shift = 63 - bits;
        let mut coarse = Vec::with_capacity((1 << bits) + 1);
        for leaf in leaves.clone() {
            let cell = (all[leaf].first_code >> shift) as usize;
            coarse.resize(coarse.len().max(cell + 1), leaf as u32);
        }
        coarse.resize((1 << bits) + 1, leaves.end as u32);
        Bin { leaves, coarse, shift }
    }

    /// Gives the last leaf that begins at a code or before.
    fn last_from(&self, code: u64, all: &[Leaf]) -> Option<usize> {
        let cell = (code >> self.shift) as usize;
        let [from, to] = [self.coarse[cell] as usize, self.coarse[cell + 1] as usize];
        let end = from + all[from..to].partition_point(|leaf| leaf.first_code <= code);
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
        let of = |(node, leaf): (u32, Node)| {
            let Node { first_code, level, .. } = leaf;
            Leaf { first_code, node, level }
        };
        let leaves: Vec<Leaf> = leaves.into_iter().map(of).collect();
        let in_order =
            |bin: &Range<usize>| leaves[bin.clone()].is_sorted_by_key(|leaf| leaf.first_code);
        if let Some(bin) = bins.iter().find(|bin| !in_order(bin)) {
            return Err(map.broken_node(leaves[bin.start].node, "stands before an earlier cell"));
        }
        let deepest = leaves.iter().map(|leaf| leaf.level).max().unwrap_or(0);
        let bins = bins.into_iter().map(|bin| Bin::new(bin, &leaves)).collect();
        Ok(Leaves { leaves, bins, deepest })
    }

    /// Gives the leaf of a surfel; none where there is no such surfel.
    #[inline]
    pub(crate) fn node_of(&self, surfel: u32) -> Option<u32> {
        self.leaves.get(surfel as usize).map(|leaf| leaf.node)
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
            for last in self.bins.iter().filter_map(|bin| bin.last_from(code, &self.leaves)) {
                let Leaf { first_code, level, .. } = self.leaves[last];
                if !morton::cell_range(first_code, level).contains(&code) {
                    continue;
                }
                // The quadrants of a cell stand side by side.
                let all = self.leaves[..=last].iter().enumerate().rev();
                let same = |leaf: &Leaf| (leaf.first_code, leaf.level) == (first_code, level);
                for (i, leaf) in all.take_while(|(_, leaf)| same(leaf)) {
                    each(i as u32, leaf.node)?;
                }
            }
        }
        Ok(())
    }
}
