//! A tile: the distinct positions of some blocks in memory, in buckets of a few dozen.

use std::ops::Range;

use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Box3, morton};
use pvmap_store::{StoreError, Watch};

use super::blocks::{Blocks, PLACES_A_CODE, TilePlan};
use super::boxes::{BoxTree, cell_len};
use super::{K, KnownPoint, SortedPoints, Wanted};

/// The most positions in a bucket: twice a neighbourhood.
pub(super) const BUCKET: usize = 32;

/// Distinct positions in the order of (Morton code, g), with how many points each has.
#[derive(Debug)]
pub(super) struct Tile {
    pub(super) x: Vec<i32>,
    pub(super) y: Vec<i32>,
    pub(super) z: Vec<i32>,
    /// Points at each position, counted to [`K`]: more make no difference.
    pub(super) counts: Vec<u8>,
    /// What votes about signs need; none where all normals are estimated.
    pub(super) votes: Option<Votes>,
    /// The positions of the core blocks.
    pub(super) core: Range<usize>,
    /// The first position of each bucket, then the number of positions.
    pub(super) buckets: Vec<u32>,
    /// Over the boxes of the buckets.
    pub(super) tree: BoxTree,
}

/// The normals that the file gave for the points at each position.
#[derive(Debug, Default)]
pub(super) struct Votes {
    /// Where each position's normals start in `normals`, then their number.
    pub(super) firsts: Vec<u32>,
    pub(super) normals: Vec<Normal>,
    /// Whether a point at the position has no normal.
    pub(super) is_missing: Vec<bool>,
    /// Positions of heavy blocks, rising: their normals stay on disk.
    pub(super) heavy: Vec<u32>,
}

impl Tile {
    /// Reads the loaded blocks of a plan.
    ///
    /// # Errors
    /// Where the disk fails or the run was asked to stop.
    pub(super) fn load(
        points: &impl SortedPoints,
        blocks: &Blocks,
        plan: &TilePlan,
        wanted: Wanted,
        chunk_points: usize,
        watch: &dyn Watch,
    ) -> Result<Tile, StoreError> {
        let runs = runs(blocks, plan);
        let most = runs.iter().cloned().flatten().map(|b| blocks.most_positions(b)).sum();
        let mut loader = Loader::new(wanted, most);
        let mut core = 0..0;
        let mut known = Vec::new();
        for run in runs {
            let first = loader.tile.x.len();
            let heavy = blocks.is_heavy(run.start);
            let all = blocks.points_of(run.clone());
            for start in all.clone().step_by(chunk_points) {
                watch.check()?;
                points.read(start..all.end.min(start + chunk_points as u64), &mut known)?;
                known.iter().for_each(|p| loader.add(p, heavy));
            }
            loader.flush(heavy);
            if plan.core.contains(&run.start) {
                core = if core.is_empty() { first } else { core.start }..loader.tile.x.len();
            }
        }
        let mut tile = loader.tile;
        tile.core = core;
        if let Some(votes) = &mut tile.votes {
            votes.firsts.push(votes.normals.len() as u32);
        }
        tile.cut();
        Ok(tile)
    }

    /// Gives where a position is.
    #[inline]
    pub(super) fn place(&self, position: usize) -> [i32; 3] {
        [self.x[position], self.y[position], self.z[position]]
    }

    /// Gives the Morton code of a position.
    #[inline]
    pub(super) fn code(&self, position: usize) -> u64 {
        morton::encode(self.place(position).map(|v| v as u32))
    }

    /// Gives the positions of a bucket.
    #[inline]
    pub(super) fn bucket(&self, bucket: usize) -> Range<usize> {
        self.buckets[bucket] as usize..self.buckets[bucket + 1] as usize
    }

    /// Says whether a position has points to estimate.
    #[inline]
    pub(super) fn is_wanted(&self, position: usize) -> bool {
        self.votes.as_ref().is_none_or(|v| v.is_missing[position])
    }

    /// Cuts the positions into buckets, one cell each.
    fn cut(&mut self) {
        let mut boxes = Vec::new();
        let (mut start, mut before) = (0, None);
        while start < self.x.len() {
            let shown = start..self.x.len().min(start + BUCKET + 1);
            let mut codes = [0; BUCKET + 1];
            for (code, i) in codes.iter_mut().zip(shown.clone()) {
                *code = self.code(i);
            }
            let len = cell_len(&codes[..shown.len()], before, BUCKET);
            let join = |b: Box3, i| b.join(&Box3::at(self.place(i)));
            boxes.push((start..start + len).fold(Box3::EMPTY, join));
            self.buckets.push(start as u32);
            before = Some(codes[len - 1]);
            start += len;
        }
        self.buckets.push(start as u32);
        self.tree = BoxTree::new(boxes);
    }
}

/// Lists the loaded blocks as runs that are all core or all halo, all heavy or not.
fn runs(blocks: &Blocks, plan: &TilePlan) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for block in (0..blocks.len()).filter(|&b| plan.is_loaded[b]) {
        let kind = |b| (plan.core.contains(&b), blocks.is_heavy(b));
        match runs.last_mut() {
            Some(run) if run.end == block && kind(run.start) == kind(block) => run.end += 1,
            _ => runs.push(block..block + 1),
        }
    }
    runs
}

/// Merges the points of one Morton code after another into positions.
struct Loader {
    tile: Tile,
    code: Option<u64>,
    /// One for each place of the code, in the lexicographic order of g.
    places: [Place; PLACES_A_CODE],
}

/// What is known of the points at one place.
#[derive(Debug, Default)]
struct Place {
    count: u8,
    is_missing: bool,
    normals: Vec<Normal>,
}

impl Loader {
    /// Starts a tile of at most `most` positions: room is reserved once, never moved.
    fn new(wanted: Wanted, most: u64) -> Loader {
        let most = usize::try_from(most).expect("a tile fits the memory budget");
        let votes = match wanted {
            Wanted::All => None,
            Wanted::Missing => Some(Votes {
                firsts: Vec::with_capacity(most + 1),
                normals: Vec::with_capacity(most),
                is_missing: Vec::with_capacity(most),
                heavy: Vec::new(),
            }),
        };
        let tile = Tile {
            x: Vec::with_capacity(most),
            y: Vec::with_capacity(most),
            z: Vec::with_capacity(most),
            counts: Vec::with_capacity(most),
            votes,
            core: 0..0,
            buckets: Vec::new(),
            tree: BoxTree::new(Vec::new()),
        };
        Loader { tile, code: None, places: Default::default() }
    }

    /// Takes the next point of the sorted cloud.
    #[inline]
    fn add(&mut self, point: &KnownPoint, heavy: bool) {
        let code = morton::encode(point.g);
        if self.code != Some(code) {
            self.flush(heavy);
            self.code = Some(code);
        }
        let [x, y, z] = point.g.map(|v| v as usize & 1);
        let place = &mut self.places[x << 2 | y << 1 | z];
        place.count = (place.count + 1).min(K as u8);
        match point.normal {
            None => place.is_missing = true,
            Some(n) if self.tile.votes.is_some() && !heavy => place.normals.push(n),
            Some(_) => {}
        }
    }

    /// Turns the places of the code at hand into positions.
    fn flush(&mut self, heavy: bool) {
        let Some(code) = self.code.take() else { return };
        let corner = morton::decode(code).map(|v| v as i32);
        let tile = &mut self.tile;
        for (i, place) in self.places.iter_mut().enumerate().filter(|(_, p)| p.count > 0) {
            if let Some(votes) = &mut tile.votes {
                if heavy {
                    votes.heavy.push(tile.x.len() as u32);
                }
                votes.firsts.push(votes.normals.len() as u32);
                votes.normals.append(&mut place.normals);
                votes.is_missing.push(place.is_missing);
            }
            tile.x.push(corner[0] + (i as i32 >> 2));
            tile.y.push(corner[1] + (i as i32 >> 1 & 1));
            tile.z.push(corner[2] + (i as i32 & 1));
            tile.counts.push(std::mem::take(&mut place.count));
            place.is_missing = false;
        }
    }
}
