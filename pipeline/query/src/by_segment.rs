//! Whether two places see each other by the segment between themselves, where the leaf-pair test
//! takes that between the centroids of their surfels. Source: pipeline/README.md.

use pvmap_geometry::disc::{Disc, faces_both};
use pvmap_geometry::normal::{Normal, strays};
use pvmap_vmap::FormatError;

use crate::discs::Discs;
use crate::error::QueryError;
use crate::frames::Lookup;
use crate::locate::{Located, Place, Target, target_of};
use crate::map::Map;
use crate::pair::{Link, PairAnswer};

/// Surfels on both sides of a link from which on it answers for the segments, too.
///
/// With it at most 3 pairs more of 100 000 are wrong in the furnished room, the room of the bunny
/// and the cave (with links of any two inner nodes up to 18), and in the rooms nine of ten visible
/// pairs need no walk. Measured 2026-11.
const WIDE: u32 = 8;

/// A place on the grid, and the leaf that answers for it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    located: Located,
    g: [i32; 3],
    /// The normal given, quantised; zero where there is none.
    normal: Normal,
}

impl Spot {
    /// Gives the leaf that answers for it.
    pub fn located(&self) -> &Located {
        &self.located
    }
}

/// Whether two places see each other by the segment between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SegmentAnswer {
    /// Whether they do.
    pub visible: bool,
    /// What says so.
    pub settled_by: SettledBy,
    /// What [`Map::pair`] says of their leaves.
    pub by_leaves: PairAnswer,
}

/// What settles a pair that is asked by its segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SettledBy {
    /// Both places lie on one leaf: they see each other.
    Leaf,
    /// One looks away from the other, by their normals.
    Facing,
    /// The link of their leaves, of eight surfels or more on both sides: they see each other.
    Link,
    /// This surfel blocks, of all that do the one of the lowest id.
    Blocker(u32),
    /// No surfel blocks: they see each other.
    NoBlocker,
}

/// Says whether a normal may be that of one of a surfel's points: within 30° of the surfel's, on
/// either side where that has two.
fn fits(normal: Normal, disc: &Disc) -> bool {
    let is_near = |sign: i16| !strays(normal.map(|v| sign * v), disc.normal.map(i64::from));
    let are_there = normal != [0; 3] && disc.normal != [0; 3];
    are_there && (is_near(1) || disc.two_sided && is_near(-1))
}

/// Says whether a link has so many surfels on both sides that it settles segments, too.
fn is_wide(link: &Link) -> bool {
    let (a, b) = link.surfels;
    (a.1 - a.0).min(b.1 - b.0) >= WIDE
}

impl Map<'_> {
    /// Puts a place on the grid, with the leaf that [`Map::locate`] found for it.
    ///
    /// # Errors
    /// Where the place is outside the cube, or its normal is no direction.
    pub fn spot(&self, place: &Place, located: Located) -> Result<Spot, QueryError> {
        let Target { g, normal } = target_of(&self.view().frame().frame, place)?;
        Ok(Spot { located, g: g.map(|v| v as i32), normal: normal.unwrap_or_default() })
    }

    /// Decides whether two places see each other by the segment between themselves.
    ///
    /// Exact: the verdict of rational arithmetic on grid positions and stored surfels. It is the
    /// same in both orders.
    ///
    /// # Errors
    /// Where what is read of the map is damaged, or `a` or `b` was located on another map and
    /// this one has no such leaf.
    pub fn pair_by_segment(&self, a: &Spot, b: &Spot) -> Result<SegmentAnswer, QueryError> {
        self.segment_with(&mut Lookup::new(self), a, b)
    }

    /// Does what [`Map::pair_by_segment`] does; the lookup may have the right frame at hand.
    pub(crate) fn segment_with(
        &self,
        lookup: &mut Lookup<'_, '_>,
        a: &Spot,
        b: &Spot,
    ) -> Result<SegmentAnswer, QueryError> {
        let by_leaves = self.pair_with(lookup, &a.located, &b.located)?;
        // Nodes that a sample stands for may see each other in part.
        let is_wide = by_leaves.link.as_ref().is_some_and(is_wide)
            && !(self.is_coarse() && self.tried(lookup, &a.located, &b.located)?.is_some());
        let settled_by = self.settle(a, b, is_wide)?;
        let visible = !matches!(settled_by, SettledBy::Facing | SettledBy::Blocker(_));
        Ok(SegmentAnswer { visible, settled_by, by_leaves })
    }

    /// Finds what settles a pair, given whether its link does.
    fn settle(&self, a: &Spot, b: &Spot, is_wide: bool) -> Result<SettledBy, FormatError> {
        let (x, y) = (&a.located, &b.located);
        if x.node == y.node {
            return Ok(SettledBy::Leaf);
        }
        let ends = [self.end(a)?, self.end(b)?];
        if !faces_both(&ends[0], &ends[1]) {
            return Ok(SettledBy::Facing);
        }
        if is_wide {
            return Ok(SettledBy::Link);
        }
        let spared = [x.surfel, y.surfel];
        let found = match self.discs.get() {
            Some(discs) => discs.blocker([&ends[0], &ends[1]], spared),
            None => self.blocker(spared, &ends[0], &ends[1], &mut 0)?,
        };
        Ok(found.map_or(SettledBy::NoBlocker, SettledBy::Blocker))
    }

    /// Gives the disc of a leaf as it stands at a place, with the place's own normal where that
    /// may be one of the leaf's points.
    ///
    /// A place of the grid is in the cube as every centroid is, and a normal is as long as any:
    /// the bounds of [`pvmap_geometry::disc`] hold.
    fn end(&self, spot: &Spot) -> Result<Disc, FormatError> {
        let disc = match self.discs.get() {
            Some(discs) => *discs.disc(spot.located.surfel),
            None => {
                let id = spot.located.surfel;
                self.disc_of(id, &self.surfel(id)?)?
            }
        };
        let normal = if fits(spot.normal, &disc) { spot.normal } else { disc.normal };
        Ok(Disc { centroid: spot.g, normal, ..disc })
    }

    /// Does what [`Map::keep`] does, and keeps what [`Map::pair_by_segment`] asks: at the most 112
    /// bytes a surfel and 64 a node besides. Says whether all is in memory now.
    ///
    /// # Errors
    /// Where the map is damaged. Questions that need what is not damaged still have answers.
    pub fn keep_discs(&self, memory_bytes: u64) -> Result<bool, QueryError> {
        let of_discs = Discs::held_bytes(self.view());
        if of_discs > memory_bytes {
            return Ok(false);
        }
        if self.discs.get().is_none() {
            let discs = Discs::of(self)?;
            self.discs.get_or_init(|| discs);
        }
        self.keep(memory_bytes - of_discs)
    }
}
