//! All that a point sees, surfel by surfel. Source: DESIGN.md [V-7].

use rayon::prelude::*;

use super::{Exact, StoredPoint};
use crate::error::QueryError;
use crate::locate::{Located, Target};
use crate::map::Map;
use crate::set::SurfelSet;

/// Surfels that a thread asks about before it says how far it is: some milliseconds.
const PIECE_SURFELS: u32 = 64;

impl Exact<'_, '_> {
    /// Decides for every surfel of a map whether the point that stands for it sees `eye`, and
    /// gives those whose point does, with that of the eye itself ([V-6]).
    ///
    /// The point of a surfel is the stored one nearest to its centroid, as [`Exact::nearest`]
    /// finds it for the surfel's normal. So a surfel half in shadow is seen or not by its middle,
    /// as in the map, but what hides it are points and not discs that stand over thin limbs.
    ///
    /// `tell` gets the number of surfels decided and says whether to go on. Threads are those of
    /// the current rayon pool.
    ///
    /// # Errors
    /// Where the map was not made from this octree, what is read of either is damaged, or `tell`
    /// says no.
    pub fn visible_from(
        &self,
        map: &Map<'_>,
        eye: &StoredPoint,
        own: &Located,
        tell: &(dyn Fn(u64) -> bool + Sync),
    ) -> Result<SurfelSet, QueryError> {
        self.require_map(map)?;
        let n_surfels = map.view().summary().n_surfels;
        let pieces: Vec<u32> = (0..n_surfels).step_by(PIECE_SURFELS as usize).collect();
        let decide = |first: u32| {
            let piece = first..n_surfels.min(first.saturating_add(PIECE_SURFELS));
            let n = u64::from(piece.end - piece.start);
            // After a no every piece ends before it begins.
            if !tell(0) {
                return Err(QueryError::Stopped);
            }
            let mut seen = Vec::new();
            for id in piece {
                if id == own.surfel || self.pair(eye, &self.point_of(map, id)?)?.visible {
                    seen.push(id..id + 1);
                }
            }
            if tell(n) { Ok(seen) } else { Err(QueryError::Stopped) }
        };
        let found: Result<Vec<_>, QueryError> = pieces.into_par_iter().map(decide).collect();
        Ok(SurfelSet::of(found?.into_iter().flatten().collect()))
    }

    /// Finds the point that stands for a surfel.
    fn point_of(&self, map: &Map<'_>, id: u32) -> Result<StoredPoint, QueryError> {
        let surfel = map.surfel(id)?;
        let normal = (surfel.normal != [0; 3]).then_some(surfel.normal);
        let target = Target { g: surfel.centroid, normal };
        self.nearest_to(&target).map(|(_, point)| point)
    }
}
