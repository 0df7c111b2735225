//! The leaf kernel: one segment against a list of discs, by floats with a proven bound, and by
//! integers where the bound does not settle it.
//!
//! Sixteen discs at a time go through a filter without branches (`Chunk`, `find_chunk`), which
//! lets the compiler use what the processor has; what passes is settled one by one (`settle`).
//!
//! Planes are exact in f64: n·c and its sums stay below 2^40. The crossing x = c_a + t·d has one
//! rounded division and, an axis, one product and two sums of numbers below 2^24, so each
//! component of x - c_k is off by less than 2^-27 =: ε (three roundings of at most 2^-53·2^24, and
//! t·d off by 2^-52·2^23). For |x - c_k| near R the square is then off by less than
//! 2·√3·ε·R + 2^-50·R² < 2^-24·(R + 1) as R < 2^23; `margin` takes four times that.

use multiversion::multiversion;
use pvmap_geometry::disc::{self, Disc, Profile};

/// How far off a component of a crossing can be.
const EPSILON: f64 = 1.0 / (1u64 << 27) as f64;

/// Discs that are filtered together.
const WIDTH: usize = 16;

/// How far off a squared distance near `radius2` can be.
#[inline]
fn margin(radius2: f64) -> f64 {
    (radius2.sqrt() + 1.0) / (1u64 << 22) as f64
}

/// Sixteen discs, a column each. A place without a disc has a zero normal and never crosses.
#[derive(Debug, Clone)]
struct Chunk {
    normal: [[f64; WIDTH]; 3],
    /// n·c_k.
    offset: [f64; WIDTH],
    centroid: [[f64; WIDTH]; 3],
    /// R² and what it can be off by.
    reach2: [f64; WIDTH],
    /// The patch box and what a crossing can be off by; everything for profile `paper`.
    low: [[f64; WIDTH]; 3],
    high: [[f64; WIDTH]; 3],
    /// n·c_a - n·c_k for the segment start at hand: which side of each plane it is on.
    side: [f64; WIDTH],
}

impl Chunk {
    const EMPTY: Chunk = Chunk {
        normal: [[0.0; WIDTH]; 3],
        offset: [0.0; WIDTH],
        centroid: [[0.0; WIDTH]; 3],
        reach2: [0.0; WIDTH],
        low: [[0.0; WIDTH]; 3],
        high: [[0.0; WIDTH]; 3],
        side: [0.0; WIDTH],
    };

    fn set(&mut self, profile: Profile, k: usize, disc: &Disc) {
        let n = disc.normal.map(f64::from);
        let c = disc.centroid.map(f64::from);
        for i in 0..3 {
            self.normal[i][k] = n[i];
            self.centroid[i][k] = c[i];
            (self.low[i][k], self.high[i][k]) = match profile {
                Profile::Patch => {
                    (f64::from(disc.limit.min[i]) - EPSILON, f64::from(disc.limit.max[i]) + EPSILON)
                }
                Profile::Paper => (f64::NEG_INFINITY, f64::INFINITY),
            };
        }
        self.offset[k] = n[0] * c[0] + n[1] * c[1] + n[2] * c[2];
        let radius2 = disc.radius2 as f64;
        self.reach2[k] = radius2 + margin(radius2);
    }
}

/// The discs of a candidate list, loaded once for many segments.
#[derive(Debug, Default)]
pub struct Blockers {
    /// Surfel ids.
    ids: Vec<u32>,
    chunks: Vec<Chunk>,
}

/// One end of a segment.
#[derive(Debug, Clone, Copy)]
pub struct End {
    /// Surfel id.
    pub id: u32,
    centroid: [f64; 3],
    radius2: f64,
}

impl End {
    /// Loads a surfel as the end of segments.
    pub fn new(discs: &[Disc], id: u32) -> End {
        let disc = &discs[id as usize];
        End { id, centroid: disc.centroid.map(f64::from), radius2: disc.radius2 as f64 }
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
    /// Discs that passed the filter and were settled one by one.
    pub n_tests: u64,
    /// Of these, settled by integers because the float bound did not.
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

impl Blockers {
    /// Loads the discs with these surfel ids.
    pub fn load(&mut self, profile: Profile, discs: &[Disc], ids: impl Iterator<Item = u32>) {
        self.ids.clear();
        self.ids.extend(ids);
        self.chunks.clear();
        self.chunks.resize(self.ids.len().div_ceil(WIDTH), Chunk::EMPTY);
        for (i, &id) in self.ids.iter().enumerate() {
            self.chunks[i / WIDTH].set(profile, i % WIDTH, &discs[id as usize]);
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

    /// Gives the surfel at a position of the list.
    pub fn id(&self, position: usize) -> u32 {
        self.ids[position]
    }

    /// Says whether a surfel is in the list.
    pub fn contains(&self, id: u32) -> bool {
        self.ids.contains(&id)
    }

    /// Puts a surfel at a position, at most one past the end.
    pub fn put(&mut self, profile: Profile, position: usize, discs: &[Disc], id: u32) {
        if position == self.ids.len() {
            self.ids.push(id);
            self.chunks.resize(self.ids.len().div_ceil(WIDTH), Chunk::EMPTY);
        }
        self.ids[position] = id;
        self.chunks[position / WIDTH].set(profile, position % WIDTH, &discs[id as usize]);
    }

    /// Sets the start of the segments that follow.
    pub fn start_at(&mut self, a: &End) {
        start_chunks(&mut self.chunks, a.centroid);
    }

    /// Finds a disc that blocks the segment from the start set before to `b`; gives its position.
    pub fn find(
        &self,
        profile: Profile,
        discs: &[Disc],
        a: &End,
        b: &End,
        counts: &mut Counts,
    ) -> Option<usize> {
        let mut at = 0;
        while let Some((chunk, passed)) = find_chunk(&self.chunks, at, a.centroid, b.centroid) {
            for k in (0..WIDTH).filter(|&k| passed[k] != 0) {
                let found = chunk * WIDTH + k;
                if self.blocks(profile, discs, a, b, found, counts) {
                    return Some(found);
                }
            }
            at = chunk + 1;
        }
        None
    }

    /// Decides [V-2] for one disc.
    #[inline]
    fn blocks(
        &self,
        profile: Profile,
        discs: &[Disc],
        a: &End,
        b: &End,
        position: usize,
        counts: &mut Counts,
    ) -> bool {
        let (chunk, k) = (&self.chunks[position / WIDTH], position % WIDTH);
        let [nx, ny, nz] = &chunk.normal;
        let here = chunk.side[k];
        let c = b.centroid;
        let there = nx[k] * c[0] + ny[k] * c[1] + nz[k] * c[2] - chunk.offset[k];
        if here * there >= 0.0 {
            return false;
        }
        counts.n_tests += 1;
        let disc = &discs[self.ids[position] as usize];
        settle(profile, disc, a, b, here / (here - there)).unwrap_or_else(|| {
            counts.n_exact += 1;
            disc::blocks(profile, &discs[a.id as usize], &discs[b.id as usize], disc)
        })
    }
}

/// The discs that blocked lately: the next segment is close to the one before and likely meets one
/// of them too, which spares it the search for candidates.
#[derive(Debug, Default)]
pub struct Recent {
    blockers: Blockers,
    next: usize,
}

/// Discs remembered: two chunks of the filter.
const N_RECENT: usize = 2 * WIDTH;

impl Recent {
    /// Gives the discs.
    pub fn blockers(&mut self) -> &mut Blockers {
        &mut self.blockers
    }

    /// Remembers a disc, forgetting the oldest. The next segment must set its start anew.
    pub fn remember(&mut self, profile: Profile, discs: &[Disc], id: u32) {
        if !self.blockers.contains(id) {
            self.blockers.put(profile, self.next, discs, id);
            self.next = (self.next + 1) % N_RECENT;
        }
    }
}

/// Computes for every disc which side of its plane the start of the coming segments is on.
#[multiversion(targets = "simd")]
fn start_chunks(chunks: &mut [Chunk], c: [f64; 3]) {
    for chunk in chunks {
        let [nx, ny, nz] = &chunk.normal;
        for k in 0..WIDTH {
            chunk.side[k] = nx[k] * c[0] + ny[k] * c[1] + nz[k] * c[2] - chunk.offset[k];
        }
    }
}

/// Finds the first chunk from `at` on in which some disc may block the segment a…b: its plane
/// crosses strictly between the ends, not farther from its centroid than its radius and within its
/// patch box, give or take what the floats can be off by. Gives the chunk and a flag a disc.
#[multiversion(targets = "simd")]
fn find_chunk(
    chunks: &[Chunk],
    at: usize,
    a: [f64; 3],
    b: [f64; 3],
) -> Option<(usize, [u8; WIDTH])> {
    let d = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    for (i, chunk) in chunks.iter().enumerate().skip(at) {
        let [nx, ny, nz] = &chunk.normal;
        let [cx, cy, cz] = &chunk.centroid;
        let mut passed = [0u8; WIDTH];
        for k in 0..WIDTH {
            let here = chunk.side[k];
            let there = nx[k] * b[0] + ny[k] * b[1] + nz[k] * b[2] - chunk.offset[k];
            // Where the signs agree t is no share of the segment, or NaN, and is not looked at.
            let t = here / (here - there);
            let (x, y, z) = (a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]);
            let (u, v, w) = (x - cx[k], y - cy[k], z - cz[k]);
            let near = (u * u + v * v + w * w <= chunk.reach2[k])
                & (x >= chunk.low[0][k])
                & (x <= chunk.high[0][k])
                & (y >= chunk.low[1][k])
                & (y <= chunk.high[1][k])
                & (z >= chunk.low[2][k])
                & (z <= chunk.high[2][k]);
            passed[k] = u8::from((here * there < 0.0) & near);
        }
        if passed != [0; WIDTH] {
            return Some((i, passed));
        }
    }
    None
}

/// Decides by floats; `None` where the bound does not settle it.
#[inline]
fn settle(profile: Profile, disc: &Disc, a: &End, b: &End, t: f64) -> Option<bool> {
    let (mut d, mut x) = ([0.0; 3], [0.0; 3]);
    let mut away2 = 0.0;
    for i in 0..3 {
        d[i] = b.centroid[i] - a.centroid[i];
        x[i] = a.centroid[i] + t * d[i];
        let v = x[i] - f64::from(disc.centroid[i]);
        away2 += v * v;
    }
    let radius2 = disc.radius2 as f64;
    let near = margin(radius2);
    if away2 > radius2 + near {
        return Some(false);
    }
    let mut sure = away2 < radius2 - near;
    match profile {
        Profile::Paper => {
            let (a, b) = (a.centroid.map(|v| v as i32), b.centroid.map(|v| v as i32));
            let meets = disc::segment_meets(a, b, &disc.limit);
            return if !meets { Some(false) } else { sure.then_some(true) };
        }
        Profile::Patch => {
            for i in 0..3 {
                let (low, high) = (f64::from(disc.limit.min[i]), f64::from(disc.limit.max[i]));
                if x[i] < low - EPSILON || x[i] > high + EPSILON {
                    return Some(false);
                }
                sure &= x[i] > low + EPSILON && x[i] < high - EPSILON;
            }
            let d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            for (share, end) in [(t, a), (1.0 - t, b)] {
                let from_end2 = share * share * d2;
                let near = margin(end.radius2);
                if from_end2 < end.radius2 - near {
                    return Some(false);
                }
                sure &= from_end2 > end.radius2 + near;
            }
        }
    }
    sure.then_some(true)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastrand::Rng;
    use pvmap_geometry::Box3;

    fn disc(rng: &mut Rng, size: i32) -> Disc {
        let normal = [0; 3].map(|_| rng.i64(-3..=3));
        let centroid = [0; 3].map(|_| rng.i32(0..size));
        let r = rng.u64(0..=size as u64 / 2);
        Disc {
            centroid,
            normal: pvmap_geometry::normal::rescale(normal),
            two_sided: false,
            radius2: r * r,
            limit: Box3::at(centroid).grown(rng.i32(1..=1 + size / 2)),
        }
    }

    #[test]
    fn v3_the_filtered_kernel_agrees_with_integers() {
        let mut rng = Rng::with_seed(3);
        let (mut n_blocked, mut counts, mut n_exact) = (0, Counts::default(), 0);
        for _ in 0..60_000 {
            // Small sizes make ties, large ones make rounding.
            let size = 1 << rng.u32(2..22);
            let discs: Vec<Disc> = (0..rng.usize(3..40)).map(|_| disc(&mut rng, size)).collect();
            let (a, b) = (End::new(&discs, 0), End::new(&discs, 1));
            let mut blockers = Blockers::default();
            for profile in [Profile::Paper, Profile::Patch] {
                blockers.load(profile, &discs, 0..discs.len() as u32);
                blockers.start_at(&a);
                let found = blockers.find(profile, &discs, &a, &b, &mut counts);
                let exact = |k: &usize| disc::blocks(profile, &discs[0], &discs[1], &discs[*k]);
                assert!(found.iter().all(|k| *k > 1 && exact(k)), "{profile:?} {discs:?}");
                let any = (2..discs.len()).any(|k| exact(&k));
                assert_eq!(found.is_some(), any, "{profile:?} {discs:?}");
                n_blocked += usize::from(any);
            }
            n_exact = counts.n_exact;
        }
        assert!(n_blocked > 10_000 && n_exact > 100, "{n_blocked} blocked, {n_exact} exact");
    }
}
