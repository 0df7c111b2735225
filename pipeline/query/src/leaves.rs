//! All leaves in memory: which of them hold a place, and what says how well they answer for it.
//!
//! The cube is cut into coarse cells, about as many as there are leaves, and each of them lists the
//! leaves that reach into it, of whatever bin. So a place costs a look at one short list, where a
//! walk down the tree looks at hundreds of nodes.

use pvmap_geometry::{GridPoint, morton};
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Node};
use rayon::prelude::*;

use crate::locate::Answering;
use crate::map::Map;

/// Entries of the lists for each leaf, at the most: where leaves fill space instead of surfaces, or
/// are of very different sizes, cells are made coarser until that holds.
const MAX_ENTRIES_A_LEAF: usize = 4;

/// The leaves of a map.
#[derive(Debug)]
pub(crate) struct Leaves {
    /// In the order of their surfels.
    leaves: Vec<Leaf>,
    /// Where the list of each coarse cell starts; one more than there are cells.
    starts: Vec<u32>,
    /// The lists.
    reaching: Vec<Reaching>,
    /// A code without so many bits is its coarse cell.
    shift: u32,
    deepest: u8,
}

/// A leaf, in a line of a cache.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Leaf {
    answering: Answering,
    node: u32,
}

/// A leaf that reaches into a coarse cell.
#[derive(Debug, Clone, Copy, Default)]
struct Reaching {
    first_code: u64,
    surfel: u32,
    level: u8,
}

/// Makes the lists: where each starts, the lists, and how many bits of a code they do without.
fn lists_of(leaves: &[(u32, Node)]) -> (Vec<u32>, Vec<Reaching>, u32) {
    // One cell or two for each leaf: most of them are empty, as leaves lie along surfaces.
    let mut bits = leaves.len().max(1).ilog2() + 1;
    while bits > 0 && n_entries(leaves, 63 - bits) > MAX_ENTRIES_A_LEAF * leaves.len() {
        bits -= 1;
    }
    let (shift, n_cells) = (63 - bits, 1 << bits);
    let mut starts = vec![0u32; n_cells + 1];
    for cell in leaves.iter().flat_map(|(_, leaf)| cells_of(leaf, shift)) {
        starts[cell + 1] += 1;
    }
    let mut end = 0;
    for start in &mut starts {
        end += *start;
        *start = end;
    }
    let mut ends = starts.clone();
    let mut reaching = vec![Reaching::default(); end as usize];
    for (surfel, (_, leaf)) in (0..).zip(leaves) {
        let Node { first_code, level, .. } = *leaf;
        for cell in cells_of(leaf, shift) {
            reaching[ends[cell] as usize] = Reaching { first_code, surfel, level };
            ends[cell] += 1;
        }
    }
    (starts, reaching, shift)
}

/// Counts the entries that all lists would have.
fn n_entries(leaves: &[(u32, Node)], shift: u32) -> usize {
    leaves.iter().map(|(_, leaf)| cells_of(leaf, shift).count()).sum()
}

/// Gives the coarse cells that a leaf reaches into.
fn cells_of(leaf: &Node, shift: u32) -> std::ops::RangeInclusive<usize> {
    let codes = morton::cell_range(leaf.first_code, leaf.level);
    (codes.start >> shift) as usize..=((codes.end - 1) >> shift) as usize
}

impl Leaves {
    /// Reads all leaves.
    pub(crate) fn of(map: &Map<'_>) -> Result<Leaves, FormatError> {
        let view = map.view();
        let leaf = |id: u32| match view.node(id) {
            Ok(node) => node.is_leaf().then_some(Ok((id, node))),
            Err(e) => Some(Err(e)),
        };
        let found: Vec<(u32, Node)> =
            (0..view.n_nodes()).into_par_iter().filter_map(leaf).collect::<Result<_, _>>()?;
        let misplaced = (0..).zip(&found).find(|&(i, (_, leaf))| leaf.first_surfel != i);
        if let Some((_, &(id, _))) = misplaced {
            return Err(map.broken_node(id, "is not the leaf of its surfel"));
        }
        let answering = |&(node, leaf): &(u32, Node)| {
            let surfel = map.surfel_of(node, &leaf)?;
            Ok(Leaf { answering: Answering::of(&surfel, map.profile()), node })
        };
        let leaves = found.par_iter().map(answering).collect::<Result<_, FormatError>>()?;

        let (starts, reaching, shift) = lists_of(&found);
        let deepest = found.iter().map(|(_, leaf)| leaf.level).max().unwrap_or(0);
        Ok(Leaves { leaves, starts, reaching, shift, deepest })
    }

    /// Says how much memory a map of so many surfels takes here at the most.
    pub(crate) fn held_bytes(n_surfels: u64) -> u64 {
        let a_leaf = size_of::<Leaf>() + MAX_ENTRIES_A_LEAF * size_of::<Reaching>();
        // While they are made: all nodes of leaves, and the ends of the lists beside the starts.
        let making = size_of::<(u32, Node)>() + 4 * size_of::<u32>();
        n_surfels.saturating_mul((a_leaf + making) as u64)
    }

    /// Gives the leaf of a surfel; none where there is no such surfel.
    #[inline]
    pub(crate) fn node_of(&self, surfel: u32) -> Option<u32> {
        self.leaves.get(surfel as usize).map(|leaf| leaf.node)
    }

    /// Lists surfel and node of every leaf whose closed cell holds a place, and what says how well
    /// it answers; some more than once.
    pub(crate) fn holding(
        &self,
        g: GridPoint,
    ) -> impl Iterator<Item = (u32, u32, &Answering)> + '_ {
        // A place on the lowest faces of a cell is on the highest of the cell before, too.
        let within = (1u32 << (22 - self.deepest)) - 1;
        let faces = (0..3).filter(|&i| g[i] > 0 && g[i] & within == 0);
        let on_faces = faces.fold(0u32, |on, i| on | 1 << i);
        let codes = (0..8)
            .filter(move |beside| beside & !on_faces == 0)
            .map(move |beside| morton::encode([0, 1, 2].map(|i| g[i] - (beside >> i & 1))));
        codes.flat_map(move |code| {
            let cell = (code >> self.shift) as usize;
            let [from, to] = [self.starts[cell] as usize, self.starts[cell + 1] as usize];
            let holds = move |leaf: &&Reaching| {
                morton::cell_range(leaf.first_code, leaf.level).contains(&code)
            };
            self.reaching[from..to].iter().filter(holds).map(|reaching| {
                let Leaf { answering, node } = &self.leaves[reaching.surfel as usize];
                (reaching.surfel, *node, answering)
            })
        })
    }
}
