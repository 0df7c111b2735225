//! The leaves at a place, kept for the next place near it.
//!
//! To find the leaves whose cells hold a place the tree is walked from its root through up to seven
//! bins: microseconds. Places that are asked for lie close together, so the leaves that meet a
//! small cell are noted, with their surfels, and the next place in that cell only compares.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use pvmap_geometry::{Box3, GridPoint, morton};
use pvmap_vmap::{FormatError, Node, Surfel};

use crate::map::Map;

/// Sets of cells, and the cells kept of each. With the usual four leaves a cell all take some 40 MB,
/// at the most 160 MB.
const SET_BITS: u32 = 14;
const N_WAYS: usize = 4;
/// The most leaves noted for a cell; where more meet it, it is too large to be of use.
const MAX_LEAVES: usize = 16;

/// A leaf that meets a cell.
#[derive(Debug)]
pub(crate) struct NearLeaf {
    pub(crate) node: u32,
    pub(crate) id: u32,
    pub(crate) cell: Box3,
    pub(crate) surfel: Surfel,
}

/// A cell, and the leaves that meet it unless they are too many.
#[derive(Debug)]
struct Spot {
    key: u64,
    leaves: Option<Arc<[NearLeaf]>>,
}

/// The cells of one hash asked for last, the last first.
type SpotSet = Mutex<[Option<Spot>; N_WAYS]>;

/// The cells asked for last.
#[derive(Debug)]
pub(crate) struct Spots {
    /// Made when they are first needed: opening a map takes less time than that.
    sets: OnceLock<Box<[SpotSet]>>,
    level: u8,
}

impl Spots {
    /// Makes room for cells of a map with so many surfels.
    pub(crate) fn new(n_surfels: u32) -> Spots {
        // Surfels lie along surfaces: so many cells of level L hold some, 4^L of a plain one.
        let level = (n_surfels.max(1).ilog2() / 2).min(morton::MAX_LEVEL.into()) as u8;
        Spots { sets: OnceLock::new(), level }
    }
}

impl Map<'_> {
    /// Gives all leaves whose closed cells may hold a place; none where there are too many or the
    /// map is damaged near it: then a walk has to tell.
    pub(crate) fn near(&self, g: GridPoint) -> Option<Arc<[NearLeaf]>> {
        let level = self.spots.level;
        let key = morton::cell_range(morton::encode(g), level).start;
        // Fibonacci hashing: the upper bits of the product depend on all of the key.
        let hash = key.rotate_left(u32::from(level) * 3 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let sets = || (0..1 << SET_BITS).map(|_| SpotSet::default()).collect();
        let set = &self.spots.sets.get_or_init(sets)[(hash >> (64 - SET_BITS)) as usize];
        let kept = || set.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(spot) = kept().iter().flatten().find(|spot| spot.key == key) {
            return spot.leaves.clone();
        }
        let min = morton::decode(key).map(|v| v as i32);
        let side = 1 << (22 - level);
        // Not closed: places on its upper faces are in the next cell.
        let cell = Box3 { min, max: min.map(|v| v + side - 1) };
        let leaves = self.leaves_meeting(&cell).ok()?;
        let mut kept = kept();
        kept.rotate_right(1);
        kept[0] = Some(Spot { key, leaves: leaves.clone() });
        leaves
    }

    fn leaves_meeting(&self, cell: &Box3) -> Result<Option<Arc<[NearLeaf]>>, FormatError> {
        let meets = |node: &Node| !node.cell().meet(cell).is_empty();
        let mut leaves = Vec::new();
        let mut open: Vec<(u32, Node)> = self.root()?.map(|root| (0, root)).into_iter().collect();
        while let Some((id, node)) = open.pop() {
            if !meets(&node) {
                continue;
            }
            if node.is_leaf() {
                if leaves.len() == MAX_LEAVES {
                    return Ok(None);
                }
                let surfel = self.surfel_of(id, &node)?;
                let (id, cell) = (node.first_surfel, node.cell());
                leaves.push(NearLeaf { node: surfel.node, id, cell, surfel });
            }
            for child in self.children(id, node) {
                open.push(child?);
            }
        }
        Ok(Some(leaves.into()))
    }
}
