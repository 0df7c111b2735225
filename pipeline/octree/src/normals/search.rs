//! Neighbourhoods inside a tile: a whole bucket of them at a time, the stragglers one by one.

use std::cmp::Ordering;
use std::convert::Infallible;
use std::ops::ControlFlow;

use pvmap_geometry::Box3;

use super::K;
use super::neighbours::{Neighbour, Neighbours};
use super::tile::{BUCKET, Tile};

/// The most candidates gathered around a bucket: some twenty times what even density needs.
const MAX_CANDIDATES: usize = 2048;

/// Classes of distance² that candidates are counted in.
const BINS: usize = 64;

/// How much farther (squared) than the last bucket's neighbourhoods reached on average candidates
/// are gathered: then some 2 % of the neighbourhoods of a room reach beyond.
const MARGIN2: f64 = 1.8;

/// How much farther (squared) a second look goes for those.
const SECOND_LOOK2: u64 = 3;

/// Searches one tile, bucket after bucket; keeps its arrays, and what it learned of the density.
#[derive(Debug)]
pub(super) struct Search<'a> {
    tile: &'a Tile,
    /// How many of the rows below are candidates: all positions at most √`r2` from the region.
    n_candidates: usize,
    /// In f64 squared distances (below 2^46) are exact and the loop over them vectorises.
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
    positions: Vec<u32>,
    counts: Vec<u8>,
    r2: u64,
    /// Each candidate's squared distance from the place asked about.
    d2: Vec<f64>,
    /// The candidates at most √`r2` from there.
    inside: Vec<u32>,
    /// Those among which the 16th nearest is.
    edge: Vec<Neighbour>,
    reached2: Mean,
}

/// The mean of what was reached in the open bucket, and in the last one that had any.
#[derive(Debug, Default)]
struct Mean {
    sum: f64,
    n: u32,
    last: Option<f64>,
}

impl<'a> Search<'a> {
    /// Prepares to search a tile.
    pub(super) fn new(tile: &'a Tile) -> Search<'a> {
        const ROWS: usize = MAX_CANDIDATES + BUCKET;
        Search {
            tile,
            n_candidates: 0,
            x: vec![0.0; ROWS],
            y: vec![0.0; ROWS],
            z: vec![0.0; ROWS],
            positions: vec![0; ROWS],
            counts: vec![0; ROWS],
            r2: 0,
            d2: Vec::with_capacity(ROWS),
            inside: Vec::with_capacity(ROWS),
            edge: Vec::new(),
            reached2: Mean::default(),
        }
    }

    /// Gathers the candidates around a bucket. Gives the squared distance they are complete to.
    pub(super) fn open(&mut self, bucket: usize) -> u64 {
        let region = self.tile.tree.leaves()[bucket];
        let diagonal2 = Box3::at(region.min).distance2(region.max);
        let guess2 = self.reached2.close().map_or(4 * diagonal2, |v| (v * MARGIN2) as u64);
        // Where the bucket alone has enough points, nobody in it has to look farther than across.
        let enough = self.tile.bucket(bucket).len() >= K;
        self.r2 = if enough { guess2.min(diagonal2) } else { guess2 };
        while !self.gather(&region) {
            self.r2 /= 4;
        }
        self.r2
    }

    /// Gathers more candidates, around some positions of the open bucket, for a second look;
    /// leaves those there are where they would be too many.
    pub(super) fn reopen(&mut self, positions: &[usize]) {
        let join = |b: Box3, &i: &usize| b.join(&Box3::at(self.tile.place(i)));
        let region = positions.iter().fold(Box3::EMPTY, join);
        self.r2 *= SECOND_LOOK2;
        while !self.gather(&region) {
            self.r2 /= 4;
        }
    }

    /// Collects the positions near `region`; false when there are too many.
    fn gather(&mut self, region: &Box3) -> bool {
        let tile = self.tile;
        let (low, high) = (region.min.map(f64::from), region.max.map(f64::from));
        let r2 = self.r2 as f64;
        let mut n = 0;
        let full = tile.tree.within(region, self.r2, &mut |near| {
            if n > MAX_CANDIDATES {
                return ControlFlow::Break(());
            }
            for i in tile.bucket(near) {
                let p = tile.place(i).map(f64::from);
                let gap = [0, 1, 2].map(|a| (low[a] - p[a]).max(p[a] - high[a]).max(0.0));
                // Every row is written, and kept by counting it: that is faster than to branch.
                (self.x[n], self.y[n], self.z[n]) = (p[0], p[1], p[2]);
                self.positions[n] = i as u32;
                self.counts[n] = tile.counts[i];
                n += usize::from(gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] <= r2);
            }
            ControlFlow::Continue(())
        });
        self.n_candidates = n;
        full.is_continue()
    }

    /// Finds the neighbourhood of a position of the open bucket among the candidates; false where
    /// it reaches beyond them.
    pub(super) fn find(&mut self, position: usize, near: &mut Neighbours) -> bool {
        near.clear();
        self.measure(self.tile.place(position).map(f64::from));
        // On a surface distances² are spread evenly, so a bin has about one candidate. Rounding is
        // monotone: whoever is in a lower bin is strictly nearer; and r2 itself is in the last.
        let scale = (BINS - 1) as f64 / (self.r2 as f64).max(1.0);
        let bin = |d2: f64| (d2 * scale) as usize;
        let mut n_points = [0u32; BINS];
        for &i in &self.inside {
            n_points[bin(self.d2[i as usize])] += u32::from(self.counts[i as usize]);
        }
        let mut total = 0;
        let Some(last) = n_points.iter().position(|n| {
            total += n;
            total >= K as u32
        }) else {
            return false;
        };
        self.edge.clear();
        for &i in &self.inside {
            let d2 = self.d2[i as usize];
            match bin(d2).cmp(&last) {
                Ordering::Less => near.push(self.candidate(i)),
                Ordering::Equal => self.edge.push(self.candidate(i)),
                Ordering::Greater => {}
            }
        }
        self.edge.sort_unstable_by_key(|n| (n.d2, n.g));
        self.edge.iter().for_each(|&n| near.push(n));
        self.reached2.add(near.reach2() as f64);
        true
    }

    /// Finds a neighbourhood in the whole tile.
    pub(super) fn find_anywhere(&mut self, position: usize, near: &mut Neighbours) {
        near.clear();
        let tile = self.tile;
        let place = tile.place(position);
        let never: Result<(), Infallible> = tile.tree.nearest(place, u64::MAX, &mut |bucket| {
            for i in tile.bucket(bucket) {
                let d2 = Box3::at(tile.place(i)).distance2(place);
                near.offer(self.resident(d2, i));
            }
            Ok(near.reach2())
        });
        match never {
            Ok(()) => {}
        }
        if near.is_full() {
            self.reached2.add(near.reach2() as f64);
        }
    }

    /// Measures the distances² of the candidates from a place and lists those within `r2`.
    fn measure(&mut self, [x, y, z]: [f64; 3]) {
        let all = ..self.n_candidates;
        let columns = self.x[all].iter().zip(&self.y[all]).zip(&self.z[all]);
        self.d2.clear();
        self.d2.extend(columns.map(|((cx, cy), cz)| {
            let [dx, dy, dz] = [cx - x, cy - y, cz - z];
            dx * dx + dy * dy + dz * dz
        }));
        let r2 = self.r2 as f64;
        self.inside.resize(self.d2.len(), 0);
        let mut n = 0;
        for (i, &d2) in self.d2.iter().enumerate() {
            self.inside[n] = i as u32;
            n += usize::from(d2 <= r2);
        }
        self.inside.truncate(n);
    }

    /// Describes a candidate as a neighbour.
    #[inline]
    fn candidate(&self, i: u32) -> Neighbour {
        let i = i as usize;
        let g = [self.x[i], self.y[i], self.z[i]].map(|v| v as u32);
        let count = u32::from(self.counts[i]);
        Neighbour { d2: self.d2[i] as u64, g, count, position: self.positions[i] }
    }

    /// Describes a position of the tile as a neighbour.
    #[inline]
    fn resident(&self, d2: u64, position: usize) -> Neighbour {
        let count = u32::from(self.tile.counts[position]);
        let g = self.tile.place(position).map(|v| v as u32);
        Neighbour { d2, g, count, position: position as u32 }
    }
}

impl Mean {
    /// Counts one more neighbourhood.
    #[inline]
    fn add(&mut self, reached2: f64) {
        self.sum += reached2;
        self.n += 1;
    }

    /// Starts anew; gives the mean so far, of the last bucket that had any.
    fn close(&mut self) -> Option<f64> {
        if self.n > 0 {
            self.last = Some(self.sum / f64::from(self.n));
        }
        (self.sum, self.n) = (0.0, 0);
        self.last
    }
}
