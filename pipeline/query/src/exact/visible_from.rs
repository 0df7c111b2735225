//! All that a point sees: surfel by surfel, or point by point. Source: DESIGN.md [V-7].

use std::ops::Range;

use rayon::prelude::*;

use super::{Exact, StoredPoint};
use crate::error::QueryError;
use crate::locate::{Located, Target};
use crate::map::Map;
use crate::set::SurfelSet;

/// Points that a thread asks about before it says how far it is: some milliseconds, and the bits of
/// a word.
const PIECE_POINTS: u64 = 64;

/// Which points of an octree are in it, by their places in its order: a bit each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PointSet {
    words: Vec<u64>,
}

impl PointSet {
    /// Says how much memory the set takes of so many points.
    pub fn held_bytes(n_points: u64) -> u64 {
        n_points.div_ceil(PIECE_POINTS) * size_of::<u64>() as u64
    }

    /// Says whether a point is in the set.
    pub fn contains(&self, index: u64) -> bool {
        let word = self.words.get((index / PIECE_POINTS) as usize);
        word.is_some_and(|word| word >> (index % PIECE_POINTS) & 1 == 1)
    }

    /// Counts the points.
    pub fn len(&self) -> u64 {
        self.words.iter().map(|word| u64::from(word.count_ones())).sum()
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

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
        let seen_in = |piece: Range<u64>| {
            let mut seen = Vec::new();
            // Surfels are counted in 32 bits.
            for id in piece.start as u32..piece.end as u32 {
                if id == own.surfel || self.pair(eye, &self.point_of(map, id)?)?.visible {
                    seen.push(id..id + 1);
                }
            }
            Ok(seen)
        };
        let n_pieces = u64::from(n_surfels).div_ceil(PIECE_POINTS) as usize;
        let pieces = (0..n_pieces).into_par_iter();
        let pieces = pieces.map(|i| in_piece(i, n_surfels.into(), tell, seen_in));
        let pieces: Result<Vec<_>, QueryError> = pieces.collect();
        Ok(SurfelSet::of(pieces?.into_iter().flatten().collect()))
    }

    /// Decides for every point of the octree whether it sees `eye`, and gives those that do.
    ///
    /// `tell` gets the number of points decided and says whether to go on. Threads are those of
    /// the current rayon pool. Holds [`PointSet::held_bytes`].
    ///
    /// # Errors
    /// Where what is read of the octree is damaged, or `tell` says no.
    pub fn points_visible_from(
        &self,
        eye: &StoredPoint,
        tell: &(dyn Fn(u64) -> bool + Sync),
    ) -> Result<PointSet, QueryError> {
        let n_points = self.octree.summary().n_points;
        let mut words = vec![0u64; n_points.div_ceil(PIECE_POINTS) as usize];
        words.par_iter_mut().enumerate().try_for_each(|(i, word)| {
            *word = in_piece(i, n_points, tell, |piece| self.word_of(eye, piece))?;
            Ok::<_, QueryError>(())
        })?;
        Ok(PointSet { words })
    }

    /// Says which of some points see `eye`, a bit each.
    fn word_of(&self, eye: &StoredPoint, piece: Range<u64>) -> Result<u64, QueryError> {
        let (first, n) = (piece.start, piece.end - piece.start);
        let points = self.octree.points(first, n).map_err(QueryError::Octree)?;
        let mut word = 0;
        for (i, point) in points.iter().enumerate() {
            let key = point.map_err(QueryError::Octree)?.key;
            let (g, normal, oriented) = (key.g, key.normal, key.oriented);
            let point = StoredPoint { index: first + i as u64, g, normal, oriented };
            word |= u64::from(self.pair(eye, &point)?.visible) << i;
        }
        Ok(word)
    }

    /// Finds the point that stands for a surfel.
    fn point_of(&self, map: &Map<'_>, id: u32) -> Result<StoredPoint, QueryError> {
        let surfel = map.surfel(id)?;
        let normal = (surfel.normal != [0; 3]).then_some(surfel.normal);
        let target = Target { g: surfel.centroid, normal };
        self.nearest_to(&target).map(|(_, point)| point)
    }
}

/// Decides a piece of `n` things, telling afterwards how many it was of.
fn in_piece<T>(
    i: usize,
    n: u64,
    tell: &(dyn Fn(u64) -> bool + Sync),
    decide: impl Fn(Range<u64>) -> Result<T, QueryError>,
) -> Result<T, QueryError> {
    let first = i as u64 * PIECE_POINTS;
    let piece = first..n.min(first + PIECE_POINTS);
    let n_decided = piece.end - piece.start;
    // After a no every piece ends before it begins.
    if !tell(0) {
        return Err(QueryError::Stopped);
    }
    let decided = decide(piece)?;
    if tell(n_decided) { Ok(decided) } else { Err(QueryError::Stopped) }
}
