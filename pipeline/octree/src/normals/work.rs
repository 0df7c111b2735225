//! From a tile to its normals, in parallel, and back to the points in their order.

use std::ops::Range;

use pvmap_geometry::morton;
use pvmap_geometry::normal::canonical_binned;
use pvmap_store::{StoreError, Watch};
use rayon::prelude::*;

use super::beyond::Beyond;
use super::blocks::{Blocks, TilePlan};
use super::neighbours::Neighbours;
use super::search::Search;
use super::tile::Tile;
use super::{Estimate, KnownPoint, Sign, SortedPoints, Wanted};

/// Buckets in one task of a thread: some thousand points, a few milliseconds.
const TASK_BUCKETS: usize = 64;

/// A tile and where it comes from.
pub(super) struct Work<'a, P> {
    pub(super) points: &'a P,
    pub(super) blocks: &'a Blocks,
    pub(super) plan: &'a TilePlan,
    pub(super) tile: &'a Tile,
    pub(super) watch: &'a dyn Watch,
}

/// What a thread searches with.
struct Tools<'a, P> {
    search: Search<'a>,
    beyond: Beyond<'a, P>,
    near: Neighbours,
}

/// Some buckets, and the room for what is found for their core positions.
struct Task<'a> {
    buckets: Range<usize>,
    positions: Range<usize>,
    found: &'a mut [Estimate],
}

impl Task<'_> {
    /// Gives the room for one of its positions.
    fn at(&mut self, position: usize) -> &mut Estimate {
        &mut self.found[position - self.positions.start]
    }
}

impl<P: SortedPoints> Work<'_, P> {
    /// Finds the normals of the core positions; gives them and how many searches left the tile.
    ///
    /// # Errors
    /// Where the disk fails or the run was asked to stop.
    pub(super) fn run(self) -> Result<(Vec<Estimate>, u64), StoreError> {
        let core = &self.tile.core;
        let mut found = vec![Estimate::default(); core.len()];
        let tools = || Tools {
            search: Search::new(self.tile),
            beyond: Beyond::new(self.points, self.blocks, self.plan),
            near: Neighbours::default(),
        };
        let all = self.blocks.points_of(self.plan.core.clone());
        let n_points = all.end - all.start;
        // The points of a tile are reported as its positions are done, each with an equal share.
        let share = |position: usize| {
            u128::from(n_points) * (position - core.start) as u128 / core.len().max(1) as u128
        };
        let n_widened = self
            .tasks(&mut found)
            .into_par_iter()
            .map_init(tools, |tools, task| {
                self.watch.check()?;
                let positions = task.positions.clone();
                let n_widened = tools.perform(self.tile, task)?;
                self.watch.advance((share(positions.end) - share(positions.start)) as u64);
                Ok(n_widened)
            })
            .try_reduce(|| 0, |a, b| Ok(a + b))?;
        if core.is_empty() {
            self.watch.advance(n_points);
        }
        Ok((found, n_widened))
    }

    /// Cuts the core positions into tasks.
    fn tasks<'f>(&self, mut found: &'f mut [Estimate]) -> Vec<Task<'f>> {
        let core = &self.tile.core;
        let first = self.tile.buckets.partition_point(|&b| b as usize <= core.start);
        let end = self.tile.buckets.partition_point(|&b| (b as usize) < core.end);
        let mut tasks = Vec::new();
        for start in (first.saturating_sub(1)..end).step_by(TASK_BUCKETS) {
            let buckets = start..end.min(start + TASK_BUCKETS);
            let from = core.start.max(self.tile.buckets[buckets.start] as usize);
            let to = core.end.min(self.tile.buckets[buckets.end] as usize);
            let (mine, rest) = found.split_at_mut(to - from);
            found = rest;
            tasks.push(Task { buckets, positions: from..to, found: mine });
        }
        tasks
    }
}

impl<P: SortedPoints> Tools<'_, P> {
    /// Does a task; gives how many searches left the tile.
    fn perform(&mut self, tile: &Tile, mut task: Task) -> Result<u64, StoreError> {
        let before = self.beyond.n_widened;
        for bucket in task.buckets.clone() {
            let all = tile.bucket(bucket);
            let mine = all.start.max(task.positions.start)..all.end.min(task.positions.end);
            if !mine.clone().any(|position| tile.is_wanted(position)) {
                continue;
            }
            let r2 = self.search.open(bucket);
            self.beyond.open(&tile.tree.leaves()[bucket], r2);
            let mut late = Vec::new();
            for position in mine.filter(|&position| tile.is_wanted(position)) {
                if self.search.find(position, &mut self.near) {
                    *task.at(position) = self.conclude(tile, position)?;
                } else {
                    late.push(position);
                }
            }
            if !late.is_empty() {
                self.search.reopen(&late);
            }
            for position in late {
                if !self.search.find(position, &mut self.near) {
                    self.search.find_anywhere(position, &mut self.near);
                }
                *task.at(position) = self.conclude(tile, position)?;
            }
        }
        Ok(self.beyond.n_widened - before)
    }

    /// Turns a neighbourhood found in the tile into a normal.
    fn conclude(&mut self, tile: &Tile, position: usize) -> Result<Estimate, StoreError> {
        let g = tile.place(position).map(|v| v as u32);
        self.beyond.complete(g, &mut self.near)?;
        let Some(normal) = self.near.normal(g).map(canonical_binned) else {
            return Ok(Estimate::default());
        };
        let balance = match &tile.votes {
            Some(votes) => self.beyond.votes(normal, &self.near, votes)?,
            None => 0,
        };
        Ok(match balance {
            0 => Estimate { normal, sign: Sign::Unknown },
            1.. => Estimate { normal, sign: Sign::Known },
            _ => Estimate { normal: normal.map(|c| -c), sign: Sign::Known },
        })
    }
}

/// Hands a tile's normals out to its points as they come by.
pub(super) struct Found<'a> {
    tile: &'a Tile,
    found: &'a [Estimate],
    wanted: Wanted,
    /// The first core position whose Morton code is not below that of the last point.
    cursor: usize,
}

impl<'a> Found<'a> {
    /// Starts with the first core point; `found` has a row for each core position.
    pub(super) fn new(tile: &'a Tile, found: &'a [Estimate], wanted: Wanted) -> Found<'a> {
        Found { tile, found, wanted, cursor: tile.core.start }
    }

    /// Gives the normal of the next core point.
    pub(super) fn next(&mut self, point: &KnownPoint) -> Estimate {
        if let Some(normal) = point.normal.filter(|_| !self.wanted.wants(point)) {
            return Estimate { normal, sign: Sign::Known };
        }
        let code = morton::encode(point.g);
        while self.tile.code(self.cursor) < code {
            self.cursor += 1;
        }
        // The code's few positions follow each other; the point's is one of them.
        let mut position = self.cursor;
        while self.tile.place(position) != point.g.map(|v| v as i32) {
            position += 1;
        }
        self.found[position - self.tile.core.start]
    }
}
