//! What lies outside the tile: neighbours in blocks that are not loaded, votes that stayed on disk.

use std::ops::ControlFlow;

use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Box3, GridPoint};
use pvmap_store::StoreError;

use super::blocks::{Blocks, TilePlan};
use super::neighbours::{ELSEWHERE, Neighbour, Neighbours};
use super::tile::Votes;
use super::{KnownPoint, SortedPoints};

/// Blocks kept per thread: those around a corner of the tile. 8 of 4096 points are 0.6 MiB.
const MAX_KEPT: usize = 8;

/// Points read at once of a block that is too large to keep.
const STEP_POINTS: usize = 4096;

/// Reads single blocks for the few searches that a tile cannot answer.
#[derive(Debug)]
pub(super) struct Beyond<'a, P> {
    points: &'a P,
    blocks: &'a Blocks,
    plan: &'a TilePlan,
    is_all_loaded: bool,
    /// Around the open bucket everything up to this squared distance is loaded.
    clear2: Option<u64>,
    kept: Vec<(usize, Vec<KnownPoint>)>,
    oldest: usize,
    /// Searches that had to look outside the tile.
    pub(super) n_widened: u64,
}

impl<'a, P: SortedPoints> Beyond<'a, P> {
    /// Prepares to look outside the tile of `plan`.
    pub(super) fn new(points: &'a P, blocks: &'a Blocks, plan: &'a TilePlan) -> Beyond<'a, P> {
        let is_all_loaded = plan.is_loaded.iter().all(|&l| l);
        let (kept, oldest) = (Vec::new(), 0);
        Beyond { points, blocks, plan, is_all_loaded, clear2: None, kept, oldest, n_widened: 0 }
    }

    /// Looks once, for all positions in `region`, whether all that is at most √`r2` away is loaded.
    pub(super) fn open(&mut self, region: &Box3, r2: u64) {
        self.clear2 = (!self.has_unloaded(region, r2)).then_some(r2);
    }

    /// Adds to a neighbourhood found in the tile what unloaded blocks have to say.
    ///
    /// # Errors
    /// Where the disk fails.
    pub(super) fn complete(
        &mut self,
        g: GridPoint,
        near: &mut Neighbours,
    ) -> Result<(), StoreError> {
        if self.is_all_loaded {
            return Ok(());
        }
        let (reach2, place) = (near.reach2(), g.map(|v| v as i32));
        if self.clear2.is_some_and(|c| reach2 <= c) || !self.has_unloaded(&Box3::at(place), reach2)
        {
            return Ok(());
        }
        self.n_widened += 1;
        near.sort();
        let (blocks, plan) = (self.blocks, self.plan);
        blocks.tree().nearest(place, reach2, &mut |block| {
            if !plan.is_loaded[block] {
                self.read(block, |p| {
                    let d2 = Box3::at(p.g.map(|v| v as i32)).distance2(place);
                    near.offer(Neighbour { d2, g: p.g, count: 1, position: ELSEWHERE });
                })?;
            }
            Ok(near.reach2())
        })
    }

    /// Counts the votes of all points at the positions of a neighbourhood: how many more of their
    /// normals point to the side of `n` than away from it.
    ///
    /// # Errors
    /// Where the disk fails.
    pub(super) fn votes(
        &mut self,
        n: Normal,
        near: &Neighbours,
        votes: &Votes,
    ) -> Result<i64, StoreError> {
        let mut balance = 0;
        for e in near.entries() {
            if e.position != ELSEWHERE && votes.heavy.binary_search(&e.position).is_err() {
                let [first, end] = [0, 1].map(|i| votes.firsts[e.position as usize + i] as usize);
                balance += votes.normals[first..end].iter().map(|&v| vote(n, v)).sum::<i64>();
            } else if let Some(block) = self.block_of(e.g) {
                self.read(block, |p| {
                    if let Some(v) = p.normal.filter(|_| p.g == e.g) {
                        balance += vote(n, v);
                    }
                })?;
            }
        }
        Ok(balance)
    }

    /// Says whether some block at most √`r2` from `region` is not loaded.
    fn has_unloaded(&self, region: &Box3, r2: u64) -> bool {
        let is_missing = |block: usize| {
            if self.plan.is_loaded[block] {
                ControlFlow::Continue(())
            } else {
                ControlFlow::Break(())
            }
        };
        !self.is_all_loaded && self.blocks.tree().within(region, r2, &mut { is_missing }).is_break()
    }

    /// Gives the block of a position; the boxes of blocks are disjoint.
    fn block_of(&self, g: GridPoint) -> Option<usize> {
        let place = Box3::at(g.map(|v| v as i32));
        self.blocks.tree().within(&place, 0, &mut ControlFlow::Break).break_value()
    }

    /// Shows every point of a block.
    fn read(&mut self, block: usize, mut show: impl FnMut(&KnownPoint)) -> Result<(), StoreError> {
        let all = self.blocks.points_of(block..block + 1);
        if let Some((_, known)) = self.kept.iter().find(|(kept, _)| *kept == block) {
            known.iter().for_each(show);
            return Ok(());
        }
        let slot = if self.kept.len() < MAX_KEPT {
            self.kept.push((block, Vec::new()));
            self.kept.len() - 1
        } else {
            self.oldest = (self.oldest + 1) % MAX_KEPT;
            self.oldest
        };
        let (kept, known) = &mut self.kept[slot];
        // Of a heavy block only the last part is in the buffer at the end, so it has no name.
        *kept = usize::MAX;
        let step = STEP_POINTS;
        for start in all.clone().step_by(step) {
            self.points.read(start..all.end.min(start + step as u64), known)?;
            known.iter().for_each(&mut show);
        }
        if !self.blocks.is_heavy(block) {
            self.kept[slot].0 = block;
        }
        Ok(())
    }
}

/// Gives 1 for a normal on the side of `n`, -1 for one on the other, 0 for one across.
fn vote(n: Normal, other: Normal) -> i64 {
    (0..3).map(|i| i64::from(n[i]) * i64::from(other[i])).sum::<i64>().signum()
}
