//! The leaf kernel: the segments between a few leaves and a few others against a list of discs, by
//! floats with a proven bound ([`crate::packets`]), and by integers where that does not settle it.

use pvmap_geometry::Box3;
use pvmap_geometry::disc::Disc;

use crate::packets::{DiscBatch, Packet, Shot, WIDTH, fire};

/// Discs that segments are tested against.
#[derive(Debug, Default)]
pub struct Blockers {
    /// Surfel ids.
    ids: Vec<u32>,
    batches: Vec<DiscBatch>,
}

impl Blockers {
    /// Loads discs: surfel ids, each with the box of all places at which it can block.
    pub fn load(&mut self, discs: &[Disc], list: impl Iterator<Item = (u32, Box3)>) {
        self.ids.clear();
        self.batches.clear();
        for (id, reach) in list {
            let k = self.ids.len() % WIDTH;
            if k == 0 {
                self.batches.push(DiscBatch::EMPTY);
            }
            if let Some(batch) = self.batches.last_mut() {
                batch.set(k, &discs[id as usize], &reach);
            }
            self.ids.push(id);
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

    /// Closes the open segments of a packet that some disc blocks; gives the position of the disc
    /// that closed the most. Exact. Source: DESIGN.md [V-2].
    pub fn shoot(
        &self,
        shot: &Shot<'_>,
        packet: &mut Packet,
        counts: &mut Counts,
    ) -> Option<usize> {
        fire(shot, &self.batches, &self.ids, packet, counts)
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
    /// Sheets asked about a block.
    pub n_sheets: u64,
    /// Segments that a sheet surely blocks.
    pub n_by_sheets: u64,
    /// Segments that a sheet left undecided.
    pub n_unsure: u64,
    /// Discs loaded to test segments against.
    pub n_loaded: u64,
    /// Discs tested against a packet of segments.
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
        self.n_sheets += other.n_sheets;
        self.n_by_sheets += other.n_by_sheets;
        self.n_unsure += other.n_unsure;
        self.n_loaded += other.n_loaded;
        self.n_tests += other.n_tests;
        self.n_exact += other.n_exact;
    }
}

/// The discs that blocked lately: the next block is close to the one before and likely meets some
/// of them too, which spares it the search for candidates.
#[derive(Debug, Default)]
pub struct Recent {
    blockers: Blockers,
    next: usize,
}

/// Discs remembered.
const N_RECENT: usize = WIDTH;

impl Recent {
    /// Gives the discs.
    pub fn blockers(&self) -> &Blockers {
        &self.blockers
    }

    /// Remembers a disc of a list, forgetting the oldest.
    pub fn remember(&mut self, list: &Blockers, position: usize) {
        let id = list.ids[position];
        let Blockers { ids, batches } = &mut self.blockers;
        if ids.contains(&id) {
            return;
        }
        if ids.len() <= self.next {
            ids.push(id);
            batches.resize(ids.len().div_ceil(WIDTH), DiscBatch::EMPTY);
        }
        ids[self.next] = id;
        let from = &list.batches[position / WIDTH];
        batches[self.next / WIDTH].copy(self.next % WIDTH, from, position % WIDTH);
        self.next = (self.next + 1) % N_RECENT;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds;
    use crate::ends::Ends;
    use crate::packets::pack;
    use fastrand::Rng;
    use pvmap_geometry::disc::{self, Profile};
    use pvmap_geometry::rect::Moments;
    use pvmap_geometry::{Rect, normal};

    fn disc(rng: &mut Rng, origin: i32, size: i32) -> Disc {
        let normal = normal::rescale([0; 3].map(|_| rng.i64(-3..=3)));
        let centroid = [0; 3].map(|_| origin + rng.i32(0..size));
        let r = rng.u64(0..=size as u64 / 2);
        Disc {
            centroid,
            normal,
            two_sided: rng.bool(),
            radius2: r * r,
            limit: Box3::at(centroid).grown(rng.i32(1..=1 + size / 2)),
            rect: bounds::tests::rect(rng, normal, 1 + size / 2),
        }
    }

    /// Makes three discs: two ends, and one that passes the segment between them, or the rim of an
    /// end where it cuts the segment, within a step² or so; or with a side of its rectangle within
    /// a step.
    fn close_shave(rng: &mut Rng) -> Option<[Disc; 3]> {
        let size = 1 << rng.u32(8..=22);
        let origin = rng.i32(0..=(1 << 22) - size);
        let mut discs = [0; 3].map(|_| disc(rng, origin, size));
        let minus = |u: [i32; 3], v: [i32; 3]| [0, 1, 2].map(|i| f64::from(u[i]) - f64::from(v[i]));
        let dot = |u: [f64; 3], v: [f64; 3]| (0..3).map(|i| u[i] * v[i]).sum::<f64>();
        let [a, b, k] = discs.map(|d| d.centroid);
        let end = rng.usize(..3);
        if end < 2 && rng.bool() {
            // A plane that all but holds this end, far from the middle of its disc.
            let [x, y, z] = minus(discs[end].centroid, k).map(|v| v as i64);
            let [u, v, w] = [0; 3].map(|_| rng.i64(-9..=9));
            discs[2].normal = normal::rescale([y * w - z * v, z * u - x * w, x * v - y * u]);
        }
        if end < 2 {
            (discs[2].radius2, discs[2].limit) = ((1 << 46) - 1, Box3::at(k).grown(1 << 22));
        }
        let (d, n) = (minus(b, a), discs[2].normal.map(f64::from));
        let t = dot(n, minus(k, a)) / dot(n, d);
        let from = minus(a, discs[end].centroid);
        let way = [0, 1, 2].map(|i| from[i] + t * d[i]);
        let near2 = dot(way, way).round() + f64::from(rng.i32(-1..=1));
        discs[end].radius2 = near2.max(0.0) as u64;
        discs[2].rect = Rect::NONE;
        if end == 2 && discs[2].normal != [0; 3] && (0.0..1.0).contains(&t) {
            let mut rect = Rect::along(Moments::new(discs[2].normal).axes());
            rect.hold(way.map(|v| v as i64));
            discs[2].rect = rect.grown(rng.i32(0..=1));
            discs[2].radius2 = (discs[2].radius2 + (1 << 20)).min((1 << 46) - 1);
        }
        ((0.0..1.0).contains(&t) && near2 < (1u64 << 46) as f64).then_some(discs)
    }

    #[test]
    fn v2_no_bound_of_floats_decides_a_close_shave() {
        let mut rng = Rng::with_seed(5);
        let (mut n_blocked, mut counts) = (0, Counts::default());
        let mut n_left = 300_000;
        while n_left > 0 {
            let Some(discs) = close_shave(&mut rng) else { continue };
            n_left -= 1;
            let profile = [Profile::Patch, Profile::Oriented][n_left % 2];
            let [rows, columns] = [0..1, 1..2].map(|surfels| {
                let mut ends = Ends::NONE;
                ends.load(&discs, surfels, profile);
                ends
            });
            let mut blockers = Blockers::default();
            let reach = bounds::of_group(&discs[2..], profile).blockers;
            blockers.load(&discs, [(2, reach)].into_iter());
            let shot = Shot { discs: &discs, profile, block: [&rows, &columns], is_tried: false };
            let mut packets = Vec::new();
            pack(shot.block, &[1], &mut packets);
            blockers.shoot(&shot, &mut packets[0], &mut counts);
            let is_blocked = disc::blocks(profile, &discs[0], &discs[1], &discs[2]);
            assert_eq!(packets[0].n_open() == 0, is_blocked, "{discs:?}");
            n_blocked += usize::from(is_blocked);
        }
        let found = format!("{n_blocked} blocked, {counts:?}");
        assert!(n_blocked > 50_000 && counts.n_exact > 1_000, "{found}");
    }

    #[test]
    fn v3_the_filtered_kernel_agrees_with_integers() {
        let mut rng = Rng::with_seed(3);
        let (mut n_blocked, mut n_culled, mut counts) = (0, 0, Counts::default());
        for _ in 0..4_000 {
            // Small sizes make ties, large ones make rounding; far from the origin they do both.
            let size = 1 << rng.u32(2..=22);
            let origin = rng.i32(0..=(1 << 22) - size);
            let discs: Vec<Disc> =
                (0..rng.usize(5..90)).map(|_| disc(&mut rng, origin, size)).collect();
            let n = discs.len() as u32;
            let range = |rng: &mut Rng| {
                let (first, most) = (rng.u32(0..n), [2, 64][rng.usize(..2)]);
                first..(first + 1 + rng.u32(0..most)).min(n)
            };
            let sides = [range(&mut rng), range(&mut rng)];
            let pairs = || {
                let columns = || sides[1].clone().enumerate();
                sides[0].clone().enumerate().flat_map(move |a| columns().map(move |b| (a, b)))
            };
            let disc = |id: u32| &discs[id as usize];
            for profile in [Profile::Paper, Profile::Patch, Profile::Oriented] {
                let [rows, columns] = sides.each_ref().map(|surfels| {
                    let mut ends = Ends::NONE;
                    ends.load(&discs, surfels.clone(), profile);
                    ends
                });
                let mut open = Vec::new();
                rows.faces(&columns, &mut open);
                for ((row, a), (column, b)) in pairs() {
                    assert_eq!(open[row] >> column & 1 == 1, disc::faces_both(disc(a), disc(b)));
                }
                open.fill(u64::MAX >> (64 - columns.len()));
                let reach = |id| bounds::of_group(&[*disc(id)], profile).blockers;
                let mut blockers = Blockers::default();
                blockers.load(&discs, (0..n).map(|id| (id, reach(id))));
                let shot =
                    Shot { discs: &discs, profile, block: [&rows, &columns], is_tried: false };
                let mut packets = Vec::new();
                pack(shot.block, &open, &mut packets);
                assert_eq!(packets.len(), (rows.len() * columns.len()).div_ceil(WIDTH));
                open.fill(0);
                let n_tests = counts.n_tests;
                for packet in &mut packets {
                    let n_open = packet.n_open();
                    let best = blockers.shoot(&shot, packet, &mut counts);
                    assert_eq!(best.is_some(), packet.n_open() < n_open);
                    packet.note(&mut open);
                }
                n_culled += (packets.len() * blockers.len()) as u64 + n_tests - counts.n_tests;
                for ((row, a), (column, b)) in pairs() {
                    let any = (0..n)
                        .filter(|k| *k != a && *k != b)
                        .any(|k| disc::blocks(profile, disc(a), disc(b), disc(k)));
                    let is_open = open[row] >> column & 1 == 1;
                    assert_eq!(is_open, !any, "{profile:?} {a} {b} {discs:?}");
                    n_blocked += usize::from(any);
                }
            }
        }
        let found = format!("{n_blocked} blocked, {n_culled} culled, {counts:?}");
        assert!(n_blocked > 10_000 && n_culled > 100_000 && counts.n_exact > 100, "{found}");
    }
}
