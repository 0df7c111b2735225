//! All that a leaf sees. Source: DESIGN.md [V-5], [V-6].

use std::ops::Range;

use pvmap_geometry::Box3;
use pvmap_geometry::grid::GRID_BITS;
use pvmap_vmap::{Node, Surfel};
use rayon::prelude::*;

use crate::between::{Tally, Walk};
use crate::error::QueryError;
use crate::locate::Located;
use crate::map::Map;
use crate::part::Part;
use crate::region::Sight;
use crate::set::SurfelSet;
use crate::shadow::Light;

/// Surfels that a thread asks about before it says how far it is: some milliseconds.
const PIECE_SURFELS: u32 = 64;

/// What a located place sees.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VisibleSet {
    /// The surfels, that of the place among them. [V-6]
    pub surfels: SurfelSet,
    /// Points that the surfels stand for.
    pub n_points: u64,
    /// Links that cover them.
    pub n_links: u64,
    /// Nodes whose links were looked at.
    pub n_nodes: u64,
}

impl Map<'_> {
    /// Finds all surfels that the surfel of a located place sees, and that surfel. [V-6]
    ///
    /// Links to later surfels stand in the lists of the nodes over this one; links to earlier ones
    /// in lists all over the map, which are looked through where the surfel's front faces.
    ///
    /// # Errors
    /// Where what is read of the map is damaged, or `from` was located on another map and this one
    /// has no such leaf.
    pub fn visible_from(&self, from: &Located) -> Result<VisibleSet, QueryError> {
        let (leaf, surfel) = self.leaf_of(from)?;
        let (whole, own) = (Part::whole(self)?, Part::leaf(self, from.surfel)?);
        let walk = Walk { map: self, from: &own, to: &whole, skip: &|_| false };
        let Seen { ranges: mut seen, n_points, n_links, n_nodes } = walk.run::<Seen<true>>()?;
        let behind = |node: &Node| !self.is_coarse() && is_behind(&surfel, &node.cell());
        let walk = Walk { map: self, from: &whole, to: &own, skip: &behind };
        let earlier = walk.run::<Seen<false>>()?;
        seen.extend(earlier.ranges);
        seen.push(from.surfel..from.surfel + 1);
        Ok(VisibleSet {
            surfels: SurfelSet::of(seen),
            // A surfel is covered by one link. [V-5]
            n_points: n_points.saturating_add(earlier.n_points).saturating_add(leaf.n_points),
            n_links: n_links + earlier.n_links,
            n_nodes: n_nodes + earlier.n_nodes,
        })
    }

    /// Finds all surfels that are seen from a place in the air, where a scanner or a lamp may be:
    /// those that [`Map::shadow`] says are lit by [`Light::Air`]. No link says so; a segment to
    /// each surfel does.
    ///
    /// `tell` gets the number of surfels decided and says whether to go on. Threads are those of
    /// the current rayon pool.
    ///
    /// # Errors
    /// Where `eye` is farther outside the cube than its side is long, the map is damaged, or `tell`
    /// says no.
    pub fn visible_from_air(
        &self,
        eye: [f64; 3],
        tell: &(dyn Fn(u64) -> bool + Sync),
    ) -> Result<VisibleSet, QueryError> {
        let n_surfels = self.view().summary().n_surfels;
        let frame = &self.view().frame().frame;
        // Half a step of the grid must not decide what is seen, as it does from afar.
        let side = f64::from(1 << GRID_BITS);
        if !frame.steps_of_query(eye).iter().all(|v| (-side..=2.0 * side).contains(v)) {
            let [min, max] = [[-side; 3], [2.0 * side; 3]].map(|g| frame.world_of_real(g));
            return Err(QueryError::OutsideCube { place: eye, min, max });
        }
        let piece = |first: u32| {
            let end = n_surfels.min(first.saturating_add(PIECE_SURFELS));
            let mut seen: Seen<true> = Seen::default();
            // After a no every piece ends before it begins.
            if !tell(0) {
                return Err(QueryError::Stopped);
            }
            for id in first..end {
                let surfel = self.view().surfel(id)?;
                let place = Located { surfel: id, node: surfel.node, distance: 0.0 };
                let found = self.shadow(&place, &Light::Air(eye))?;
                seen.n_nodes += found.n_nodes;
                if found.reaches == Sight::All {
                    seen.ranges.push(id..id + 1);
                    seen.n_points = seen.n_points.saturating_add(surfel.n_points);
                }
            }
            if tell(u64::from(end - first)) { Ok(seen) } else { Err(QueryError::Stopped) }
        };
        let firsts = (0..n_surfels.div_ceil(PIECE_SURFELS)).into_par_iter();
        let pieces = firsts.map(|i| piece(i * PIECE_SURFELS)).collect::<Result<Vec<_>, _>>()?;
        let mut all: Seen<true> = Seen::default();
        pieces.into_iter().for_each(|piece| all.join(piece));
        let Seen { ranges, n_points, n_links, n_nodes } = all;
        Ok(VisibleSet { surfels: SurfelSet::of(ranges), n_points, n_links, n_nodes })
    }
}

/// The surfels on one side of links: the far side, or the near one.
#[derive(Default)]
struct Seen<const FAR: bool> {
    ranges: Vec<Range<u32>>,
    n_points: u64,
    n_links: u64,
    n_nodes: u64,
}

impl<const FAR: bool> Tally for Seen<FAR> {
    fn link(&mut self, _: &Walk<'_, '_>, from: &Node, to: &Node) {
        let side = if FAR { to } else { from };
        self.ranges.push(side.first_surfel..side.end_surfel);
        self.n_points = self.n_points.saturating_add(side.n_points);
        self.n_links += 1;
    }

    fn look(&mut self) {
        self.n_nodes += 1;
    }

    fn join(&mut self, later: Self) {
        self.ranges.extend(later.ranges);
        self.n_points = self.n_points.saturating_add(later.n_points);
        self.n_links += later.n_links;
        self.n_nodes += later.n_nodes;
    }
}

/// Decides whether a surfel faces no place of a box: [V-1]'s first half, for all centroids there.
pub(crate) fn is_behind(surfel: &Surfel, cell: &Box3) -> bool {
    let n = surfel.normal.map(i64::from);
    // The corner that lies farthest along the normal.
    let most: i64 = (0..3)
        .map(|i| {
            let corner = if n[i] > 0 { cell.max[i] } else { cell.min[i] };
            n[i] * (i64::from(corner) - i64::from(surfel.centroid[i]))
        })
        .sum();
    n != [0; 3] && !surfel.two_sided && most <= 0
}
