//! The cloud seen from afar: a box for every few thousand points, and tiles cut from these blocks.

use std::ops::{ControlFlow, Range};

use pvmap_geometry::{Box3, morton};
use pvmap_store::{StoreError, Watch};

use super::boxes::{BoxTree, cell_len};
use super::budget::{BLOCK_BYTES, Budget};
use super::{KnownPoint, SortedPoints, Wanted};

/// Points read at once while the blocks are cut, in blocks.
const WINDOW_BLOCKS: usize = 16;

/// A block's halo is this part of its longest side: eight spacings of points on a surface (4096 are
/// 64 x 64), where the 16 nearest lie within 2.3.
const HALO_PART: i32 = 8;

/// The places one Morton code covers: 2 x 2 x 2 grid steps.
pub(super) const PLACES_A_CODE: usize = 8;

/// Consecutive runs of the cloud, each the points of one cell, with the boxes around them.
///
/// A block has at most `block_points` points unless all of its points share one Morton code. No two
/// blocks share a code, so their boxes are disjoint.
#[derive(Debug)]
pub(super) struct Blocks {
    /// The first point of each block, then the number of points in the cloud.
    firsts: Vec<u64>,
    /// Whether a block has points to estimate.
    is_wanted: Vec<bool>,
    tree: BoxTree,
    block_points: usize,
}

/// Blocks that are worked on at once.
#[derive(Debug)]
pub(super) struct TilePlan {
    /// The blocks whose points get their normals.
    pub(super) core: Range<usize>,
    /// For every block of the cloud, whether it is in memory: wanted core blocks and their halo.
    pub(super) is_loaded: Vec<bool>,
}

impl Blocks {
    /// Takes the whole cloud as one block, unread.
    pub(super) fn whole(n_points: u64) -> Blocks {
        let far = (1 << pvmap_geometry::grid::GRID_BITS) - 1;
        let cube = Box3 { min: [0; 3], max: [far; 3] };
        let some = n_points > 0;
        Blocks {
            firsts: if some { vec![0, n_points] } else { vec![0] },
            is_wanted: vec![true; usize::from(some)],
            tree: BoxTree::new(vec![cube; usize::from(some)]),
            block_points: usize::MAX,
        }
    }

    /// Cuts the cloud into blocks in one pass; `None` when they need more than the budget has.
    ///
    /// # Errors
    /// Where the disk fails or the run was asked to stop.
    pub(super) fn scan(
        points: &impl SortedPoints,
        wanted: Wanted,
        block_points: usize,
        budget: &Budget,
        watch: &dyn Watch,
    ) -> Result<Option<Blocks>, StoreError> {
        let (mut firsts, mut is_wanted, mut boxes) = (Vec::new(), Vec::new(), Vec::<Box3>::new());
        let (mut known, mut codes) = (Vec::new(), Vec::new());
        let (mut start, mut before) = (0, None);
        while start < points.len() {
            watch.check()?;
            let window = (block_points * WINDOW_BLOCKS) as u64;
            let end = points.len().min(start + window);
            points.read(start..end, &mut known)?;
            codes.clear();
            codes.extend(known.iter().map(|p| morton::encode(p.g)));
            let mut at = 0;
            // A cell near the end of the window may go on beyond it: the next window starts there.
            while at < codes.len() && (end == points.len() || at + block_points < codes.len()) {
                let len = cell_len(&codes[at..], before, block_points);
                let (region, is_any) = summary(&known[at..at + len], wanted);
                match (boxes.last_mut(), is_wanted.last_mut()) {
                    // More points of one code than a window holds.
                    (Some(b), Some(w)) if before == Some(codes[at]) => {
                        *b = b.join(&region);
                        *w |= is_any;
                    }
                    _ => {
                        firsts.push(start + at as u64);
                        is_wanted.push(is_any);
                        boxes.push(region);
                    }
                }
                at += len;
                before = Some(codes[at - 1]);
            }
            start += at as u64;
            if boxes.len() as u64 * BLOCK_BYTES > budget.blocks_bytes {
                return Ok(None);
            }
        }
        firsts.push(points.len());
        Ok(Some(Blocks { firsts, is_wanted, tree: BoxTree::new(boxes), block_points }))
    }

    /// Counts the blocks.
    pub(super) fn len(&self) -> usize {
        self.is_wanted.len()
    }

    /// Gives the tree over the blocks' boxes.
    pub(super) fn tree(&self) -> &BoxTree {
        &self.tree
    }

    /// Gives the points of a run of blocks.
    pub(super) fn points_of(&self, blocks: Range<usize>) -> Range<u64> {
        self.firsts[blocks.start]..self.firsts[blocks.end]
    }

    /// Says whether a block has more points than a block should: all of one Morton code.
    pub(super) fn is_heavy(&self, block: usize) -> bool {
        self.firsts[block + 1] - self.firsts[block] > self.block_points as u64
    }

    /// Plans the tile that starts at block `first`: as many blocks as fit with their halo.
    ///
    /// The halo only saves time: a search that reaches an unloaded block goes on there. So where
    /// one block and its halo are too much, part of the halo is left out.
    pub(super) fn plan_tile(&self, first: usize, budget: &Budget) -> TilePlan {
        let mut is_loaded = vec![false; self.len()];
        let mut used_bytes = 0;
        let mut end = first;
        for block in first..self.len() {
            if self.is_wanted[block] {
                let mut added = self.missing_around(block, &is_loaded);
                let cost = |b: &usize| budget.points_bytes(self.most_positions(*b));
                let added_bytes = added.iter().map(cost).sum::<u64>();
                if used_bytes + added_bytes > budget.tile_bytes {
                    if used_bytes > 0 {
                        break;
                    }
                    let mut left = budget.tile_bytes;
                    added.retain(|b| {
                        let fits = *b == block || cost(b) <= left;
                        left = left.saturating_sub(if fits { cost(b) } else { 0 });
                        fits
                    });
                }
                used_bytes += added_bytes;
                added.into_iter().for_each(|b| is_loaded[b] = true);
            }
            end = block + 1;
        }
        TilePlan { core: first..end, is_loaded }
    }

    /// Lists a block and those around it that are not loaded, itself first.
    fn missing_around(&self, block: usize, is_loaded: &[bool]) -> Vec<usize> {
        let region = self.tree.leaves()[block];
        let side = (0..3).map(|i| region.max[i] - region.min[i]).max().unwrap_or(0);
        let halo = u64::from((side / HALO_PART + 1).unsigned_abs());
        let mut found = vec![block];
        let _: ControlFlow<()> = self.tree.within(&region, halo * halo, &mut |b| {
            if b != block {
                found.push(b);
            }
            ControlFlow::Continue(())
        });
        found.retain(|&b| !is_loaded[b]);
        found
    }

    /// Gives the most distinct positions a block may have.
    pub(super) fn most_positions(&self, block: usize) -> u64 {
        let n_points = self.firsts[block + 1] - self.firsts[block];
        if self.is_heavy(block) { PLACES_A_CODE as u64 } else { n_points }
    }
}

/// Gives the box around some points and whether one of them is to be estimated.
fn summary(points: &[KnownPoint], wanted: Wanted) -> (Box3, bool) {
    let at = |p: &KnownPoint| Box3::at(p.g.map(|v| v as i32));
    let region = points.iter().fold(Box3::EMPTY, |b, p| b.join(&at(p)));
    (region, points.iter().any(|p| wanted.wants(p)))
}
