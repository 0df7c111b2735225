//! The leaf kernel: the segments between a few leaves and a few leaves against a list of discs, by
//! floats with a proven bound ([`crate::lanes`]), and by integers where the bound does not settle it.

use pvmap_geometry::Box3;
use pvmap_geometry::disc::{self, Disc, Profile};

use crate::lanes::{Chunk, Doubt, Plate, Tile, WIDTH, Work, bits, fire};

/// Discs that segments are tested against.
#[derive(Debug, Default)]
pub struct Blockers {
    /// Surfel ids, and where each can block.
    ids: Vec<(u32, Box3)>,
    plates: Vec<Plate>,
    chunks: Vec<Chunk>,
    work: Work,
}

impl Blockers {
    /// Loads discs: surfel ids, each with the box of all places at which it can block.
    pub fn load(&mut self, discs: &[Disc], list: impl Iterator<Item = (u32, Box3)>) {
        self.ids.clear();
        self.plates.clear();
        self.chunks.clear();
        for (id, reach) in list {
            self.put(self.ids.len(), discs, id, &reach);
        }
    }

    /// Counts the discs.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Puts a surfel at a position, at most one past the end.
    fn put(&mut self, position: usize, discs: &[Disc], id: u32, reach: &Box3) {
        let plate = Plate::new(&discs[id as usize]);
        if position == self.ids.len() {
            self.ids.push((id, *reach));
            self.plates.push(plate);
            self.chunks.resize(self.ids.len().div_ceil(WIDTH), Chunk::EMPTY);
        }
        self.ids[position] = (id, *reach);
        self.plates[position] = plate;
        self.chunks[position / WIDTH].set(position % WIDTH, &plate, reach);
    }

    /// Takes away the open segments of a tile that some disc blocks; gives the surfel that blocked
    /// last. Exact. Source: DESIGN.md [V-2].
    pub fn shoot(
        &mut self,
        profile: Profile,
        discs: &[Disc],
        tile: &mut Tile<'_>,
        counts: &mut Counts,
    ) -> Option<(u32, Box3)> {
        let mut last = fire(&self.chunks, &self.plates, profile, tile, &mut self.work, counts);
        for &Doubt { row, lanes } in &self.work.doubts {
            let a = &discs[tile.rows.surfel(row)];
            for k in bits(lanes) {
                counts.n_exact += 1;
                let b = &discs[tile.columns.surfel(k)];
                let blocks = |&&position: &&u32| {
                    let id = self.ids[position as usize].0;
                    disc::blocks(profile, a, b, &discs[id as usize])
                };
                if let Some(&position) = self.work.positions.iter().find(blocks) {
                    tile.open[row] &= !(1 << k);
                    last = Some(position);
                }
            }
        }
        last.map(|position| self.ids[position as usize])
    }
}

/// How much work deciding took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Node pairs the recursion looked at.
    pub n_node_pairs: u64,
    /// Candidate nodes tested against a pair.
    pub n_candidates: u64,
    /// Leaf pairs whose segment was tested against discs.
    pub n_segments: u64,
    /// Of these, pairs that a disc of late memory blocks.
    pub n_remembered: u64,
    /// Discs loaded to test segments against.
    pub n_loaded: u64,
    /// Discs tested against the segments of a row of a tile.
    pub n_tests: u64,
    /// Segments settled by integers because the float bound did not.
    pub n_exact: u64,
}

impl Counts {
    /// Adds up.
    pub fn add(&mut self, other: &Counts) {
        self.n_node_pairs += other.n_node_pairs;
        self.n_candidates += other.n_candidates;
        self.n_segments += other.n_segments;
        self.n_remembered += other.n_remembered;
        self.n_loaded += other.n_loaded;
        self.n_tests += other.n_tests;
        self.n_exact += other.n_exact;
    }
}

/// The discs that blocked lately: the next tile is close to the one before and likely meets some
/// of them too, which spares it the search for candidates.
#[derive(Debug, Default)]
pub struct Recent {
    blockers: Blockers,
    next: usize,
}

/// Discs remembered.
const N_RECENT: usize = 2 * WIDTH;

impl Recent {
    /// Gives the discs.
    pub fn blockers(&mut self) -> &mut Blockers {
        &mut self.blockers
    }

    /// Remembers a disc, forgetting the oldest.
    pub fn remember(&mut self, discs: &[Disc], id: u32, reach: &Box3) {
        if self.blockers.ids.iter().all(|known| known.0 != id) {
            self.blockers.put(self.next, discs, id, reach);
            self.next = (self.next + 1) % N_RECENT;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::Ends;
    use fastrand::Rng;

    fn reach(disc: &Disc, profile: Profile) -> Box3 {
        crate::bounds::of_group(&[*disc], profile).blockers
    }

    fn disc(rng: &mut Rng, size: i32) -> Disc {
        let normal = [0; 3].map(|_| rng.i64(-3..=3));
        let centroid = [0; 3].map(|_| rng.i32(0..size));
        let r = rng.u64(0..=size as u64 / 2);
        Disc {
            centroid,
            normal: pvmap_geometry::normal::rescale(normal),
            two_sided: rng.bool(),
            radius2: r * r,
            limit: Box3::at(centroid).grown(rng.i32(1..=1 + size / 2)),
        }
    }

    #[test]
    fn v3_the_filtered_kernel_agrees_with_integers() {
        let mut rng = Rng::with_seed(3);
        let (mut n_blocked, mut counts) = (0, Counts::default());
        for _ in 0..20_000 {
            // Small sizes make ties, large ones make rounding.
            let size = 1 << rng.u32(2..=22);
            let discs: Vec<Disc> = (0..rng.usize(5..90)).map(|_| disc(&mut rng, size)).collect();
            let n = discs.len() as u32;
            let range = |rng: &mut Rng| {
                let first = rng.u32(0..n);
                first..(first + 1 + rng.u32(0..WIDTH as u32)).min(n)
            };
            let (rows, columns) = (range(&mut rng), range(&mut rng));
            let ends = [&rows, &columns].map(|surfels| Ends::new(&discs, surfels.clone()));
            let facing = ends[0].faces(&ends[1]);
            let pairs = || {
                let columns = || columns.clone().enumerate();
                rows.clone().enumerate().flat_map(move |a| columns().map(move |b| (a, b)))
            };
            let disc = |id: u32| &discs[id as usize];
            for ((row, a), (k, b)) in pairs() {
                assert_eq!(facing[row] >> k & 1 == 1, disc::faces_both(disc(a), disc(b)));
            }
            let mut blockers = Blockers::default();
            for profile in [Profile::Paper, Profile::Patch] {
                blockers.load(&discs, (0..n).map(|id| (id, reach(disc(id), profile))));
                let mut open = [0; WIDTH];
                open[..rows.len()].fill(u64::MAX >> (64 - columns.len()));
                let mut tile = Tile { rows: &ends[0], columns: &ends[1], open };
                let last = blockers.shoot(profile, &discs, &mut tile, &mut counts);
                for ((row, a), (k, b)) in pairs() {
                    let any = (0..n)
                        .filter(|k| *k != a && *k != b)
                        .any(|k| disc::blocks(profile, disc(a), disc(b), disc(k)));
                    assert_eq!(tile.open[row] >> k & 1 == 0, any, "{profile:?} {a} {b} {discs:?}");
                    n_blocked += usize::from(any);
                }
                assert_eq!(last.is_some(), tile.open != open);
            }
        }
        assert!(n_blocked > 10_000 && counts.n_exact > 100, "{n_blocked} blocked, {counts:?}");
    }
}
