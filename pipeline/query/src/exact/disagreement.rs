//! How often a map and the points it was made of answer differently.

use std::ops::AddAssign;

use rayon::prelude::*;

use super::{Exact, StoredPoint};
use crate::error::QueryError;
use crate::locate::Located;
use crate::map::Map;

/// Counts pairs by what the leaves and the points said of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Disagreement {
    /// Both said the same.
    pub n_agree: u64,
    /// Only the points see each other.
    pub n_exact_only: u64,
    /// Only the leaves see each other.
    pub n_leaf_only: u64,
}

impl Disagreement {
    /// Counts one pair by its two answers.
    pub fn count(&mut self, leaf_visible: bool, exact_visible: bool) {
        match (leaf_visible, exact_visible) {
            (false, true) => self.n_exact_only += 1,
            (true, false) => self.n_leaf_only += 1,
            _ => self.n_agree += 1,
        }
    }

    /// Counts the pairs.
    pub fn n_pairs(&self) -> u64 {
        self.n_agree + self.n_exact_only + self.n_leaf_only
    }

    /// Gives the share of the pairs, 0 to 1, of which both did not say the same; 0 of none.
    pub fn share(&self) -> f64 {
        (self.n_exact_only + self.n_leaf_only) as f64 / self.n_pairs().max(1) as f64
    }
}

impl AddAssign for Disagreement {
    fn add_assign(&mut self, other: Disagreement) {
        self.n_agree += other.n_agree;
        self.n_exact_only += other.n_exact_only;
        self.n_leaf_only += other.n_leaf_only;
    }
}

/// Two places, each as the leaf and as the point of the scan that stand for it.
pub type LocatedPair = [(Located, StoredPoint); 2];

/// Asks the map and the points about located pairs and counts how they answer. Threads are those
/// of the current rayon pool.
///
/// # Errors
/// Where the map was not made from this octree, or what is read of either is damaged.
pub fn compare(
    map: &Map<'_>,
    exact: &Exact<'_, '_>,
    pairs: &[LocatedPair],
) -> Result<Disagreement, QueryError> {
    exact.require_map(map)?;
    let leaves: Vec<_> = pairs.iter().map(|[(a, _), (b, _)]| (*a, *b)).collect();
    // A verdict may hold K occluders: only the yes or no of each is kept.
    let ask = |[(_, p), (_, q)]: &LocatedPair| exact.pair(p, q).map(|verdict| verdict.visible);
    let verdicts: Vec<_> = pairs.par_iter().map(ask).collect();
    let mut found = Disagreement::default();
    for (leaf, exact) in map.pairs(&leaves).into_iter().zip(verdicts) {
        found.count(leaf?.visible, exact?);
    }
    Ok(found)
}
