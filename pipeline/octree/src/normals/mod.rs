//! Normals from positions alone: the plane through the 16 nearest points of every point ([D-5]).
//!
//! The answer is exact and depends on nothing but the points: neighbours are settled by (squared
//! distance, g) in integers, the covariance and its rank are integers, and the eigenvector takes
//! only + - × ÷ on f64. Memory, tiling and threads decide how long it takes.
//!
//! One pass cuts the sorted cloud into *blocks*, cells of a few thousand points with a box each
//! (`blocks`). A *tile* is a run of blocks and the blocks around it, as distinct positions in
//! *buckets* of a few dozen (`tile`). The neighbourhoods of a bucket are searched together
//! (`search`); one that reaches a block that is not loaded is completed from disk (`beyond`).
//! A cloud that fits the budget is one block and one tile.
//!
//! Start reading at [`estimate`].

mod beyond;
mod blocks;
mod boxes;
mod budget;
mod neighbours;
mod search;
#[cfg(test)]
mod tests;
mod tile;
mod work;

use std::ops::Range;

use pvmap_geometry::GridPoint;
use pvmap_geometry::normal::Normal;
use pvmap_store::{StoreError, Watch};

use blocks::Blocks;
use budget::Budget;
use tile::Tile;
use work::{Found, Work};

/// Points in a neighbourhood, the point itself being one of them.
pub const K: usize = 16;

/// What estimation needs to know of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct KnownPoint {
    /// Its place.
    pub g: GridPoint,
    /// The quantised normal that the file gave, if it did.
    pub normal: Option<Normal>,
}

/// The sorted cloud, readable in any range, from any thread.
pub trait SortedPoints: Sync {
    /// Counts the points.
    fn len(&self) -> u64;

    /// Says whether there is no point.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Replaces what is in `out` by the points of `range`, in the order of their Morton codes (of
    /// g >> 1). Points of one code may come in any order, but every read gives the same.
    ///
    /// # Errors
    /// Where the disk fails.
    fn read(&self, range: Range<u64>, out: &mut Vec<KnownPoint>) -> Result<(), StoreError>;
}

/// Whose normals are estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// All points'; normals of the file are ignored.
    All,
    /// Those of points without one; the others keep theirs and vote about signs.
    Missing,
}

impl Wanted {
    /// Says whether a point's normal is to be estimated.
    #[inline]
    fn wants(self, point: &KnownPoint) -> bool {
        self == Wanted::All || point.normal.is_none()
    }
}

/// Whether a normal's side is known, or its sign is only the canonical one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Sign {
    /// It points to the side from which the surface was seen.
    Known,
    /// The surface may have been seen from either side.
    #[default]
    Unknown,
}

/// A point's normal, estimated or kept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Estimate {
    /// Quantised; [0, 0, 0] where the 16 nearest points are collinear or coincident.
    pub normal: Normal,
    /// `Known` for kept normals and where a majority of neighbours' normals settled it; else the
    /// normal has the canonical sign (its largest component is positive).
    pub sign: Sign,
}

/// What became of the points.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Points that kept the normal of the file.
    pub n_kept: u64,
    /// Points with an estimated normal.
    pub n_estimated: u64,
    /// Of these, points whose sign the neighbours settled.
    pub n_signed: u64,
    /// Points without a normal.
    pub n_none: u64,
    /// Searches that went beyond their tile: for reports, it depends on the memory budget.
    pub n_widened: u64,
}

/// Estimates normals and calls `sink(first, normals)` for consecutive ranges of points, in order,
/// covering all; ranges are at most 65536 long.
///
/// The neighbourhood of a point is the [`K`] points nearest to it by squared distance on the grid,
/// itself included, coincident points counted each; among equally distant ones at the end those
/// with the lexicographically smaller g come first. Fewer than [`K`] points are all neighbours. For
/// [`Wanted::Missing`] an estimated normal takes the side of most of the normals that the file gave
/// for points at the positions of the neighbourhood.
///
/// Runs on the current rayon pool and keeps within `memory_bytes`, buffers of at most 1 MiB a
/// thread aside. Progress counts points.
///
/// # Errors
/// Where the disk or the sink fails, the run was asked to stop, or `memory_bytes` is too small for
/// a coarse view of the cloud (64 MiB suffice for 10^10 points).
///
/// Source: DESIGN.md [D-5].
pub fn estimate<P: SortedPoints>(
    points: &P,
    wanted: Wanted,
    memory_bytes: u64,
    watch: &dyn Watch,
    mut sink: impl FnMut(u64, &[Estimate]) -> Result<(), StoreError>,
) -> Result<Counts, StoreError> {
    watch.stage("normals", Some(points.len()), "points");
    let budget = Budget::new(memory_bytes, wanted);
    let blocks = survey(points, wanted, &budget, watch)?;
    let mut counts = Counts::default();
    let mut first = 0;
    while first < blocks.len() {
        let plan = blocks.plan_tile(first, &budget);
        first = plan.core.end;
        let tile = Tile::load(points, &blocks, &plan, wanted, budget.chunk_points, watch)?;
        let work = Work { points, blocks: &blocks, plan: &plan, tile: &tile, watch };
        let (found, n_widened) = work.run()?;
        counts.n_widened += n_widened;
        let mut reader = Found::new(&tile, &found, wanted);
        let core = blocks.points_of(plan.core.clone());
        let (mut known, mut normals) = (Vec::new(), Vec::new());
        for start in core.clone().step_by(budget.chunk_points) {
            watch.check()?;
            points.read(start..core.end.min(start + budget.chunk_points as u64), &mut known)?;
            normals.clear();
            normals.extend(known.iter().map(|p| reader.next(p)));
            known.iter().zip(&normals).for_each(|(p, e)| counts.add(wanted.wants(p), e));
            sink(start, &normals)?;
        }
    }
    Ok(counts)
}

impl Counts {
    /// Counts one more point.
    fn add(&mut self, is_wanted: bool, estimate: &Estimate) {
        match (is_wanted, estimate.normal != [0; 3]) {
            (false, _) => self.n_kept += 1,
            (true, false) => self.n_none += 1,
            (true, true) => {
                self.n_estimated += 1;
                self.n_signed += u64::from(estimate.sign == Sign::Known);
            }
        }
    }
}

/// Cuts the cloud into blocks; into one where it fits the budget.
fn survey(
    points: &impl SortedPoints,
    wanted: Wanted,
    budget: &Budget,
    watch: &dyn Watch,
) -> Result<Blocks, StoreError> {
    if budget.points_bytes(points.len()) <= budget.tile_bytes {
        return Ok(Blocks::whole(points.len()));
    }
    let mut block_points = budget.block_points();
    loop {
        let scanned = Blocks::scan(points, wanted, block_points as usize, budget, watch)?;
        match scanned {
            Some(blocks) => return Ok(blocks),
            None => block_points = budget.larger_blocks(block_points)?,
        }
    }
}
