//! The leaf kernel: one segment against a list of discs, by floats with a proven bound, and by
//! integers where the bound does not settle it.
//!
//! Planes are settled exactly in f64: n·c and its sums stay below 2^40. The crossing x = c_a + t·d
//! has one rounded division and, an axis, one product and two sums of numbers below 2^24, so each
//! component of x - c_k is off by less than 2^-27 =: ε (three roundings of at most 2^-53·2^24, and
//! t·d off by 2^-52·2^23). For |x - c_k| near R the square is then off by less than
//! 2·√3·ε·R + 2^-50·R² < 2^-24·(R + 1) as R < 2^23; [`margin`] takes four times that.

use pvmap_geometry::disc::{self, Disc, Profile};

/// How far off a component of a crossing can be.
const EPSILON: f64 = 1.0 / (1u64 << 27) as f64;

/// How far off a squared distance near `radius2` can be.
#[inline]
fn margin(radius2: f64) -> f64 {
    (radius2.sqrt() + 1.0) / (1u64 << 22) as f64
}

/// The discs of a candidate list, a column each, loaded once for many segments.
#[derive(Debug, Default)]
pub struct Blockers {
    /// Surfel ids.
    ids: Vec<u32>,
    normal: [Vec<f64>; 3],
    /// n·c_k.
    offset: Vec<f64>,
    /// n·c_a - n·c_k for the segment start at hand: which side of each plane it is on.
    side: Vec<f64>,
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
    /// Leaf pairs decided by testing discs.
    pub n_segments: u64,
    /// Discs whose plane crosses the segment between its ends.
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
        self.n_tests += other.n_tests;
        self.n_exact += other.n_exact;
    }
}

impl Blockers {
    /// Loads the discs with these surfel ids.
    pub fn load(&mut self, discs: &[Disc], ids: impl Iterator<Item = u32>) {
        self.ids.clear();
        self.normal.iter_mut().for_each(Vec::clear);
        self.offset.clear();
        for id in ids {
            let disc = &discs[id as usize];
            self.ids.push(id);
            let mut offset = 0.0;
            for i in 0..3 {
                let n = f64::from(disc.normal[i]);
                self.normal[i].push(n);
                offset += n * f64::from(disc.centroid[i]);
            }
            self.offset.push(offset);
        }
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// Sets the start of the segments that follow.
    pub fn start_at(&mut self, a: &End) {
        let [nx, ny, nz] = &self.normal;
        let c = a.centroid;
        self.side.clear();
        self.side.extend(
            (0..self.ids.len())
                .map(|k| nx[k] * c[0] + ny[k] * c[1] + nz[k] * c[2] - self.offset[k]),
        );
    }

    /// Finds a disc that blocks the segment from the start set before to `b`, trying `hint` (a
    /// position in the list) first; gives its position.
    pub fn find(
        &self,
        profile: Profile,
        discs: &[Disc],
        a: &End,
        b: &End,
        hint: usize,
        counts: &mut Counts,
    ) -> Option<usize> {
        counts.n_segments += 1;
        let tested = |k: usize, counts: &mut Counts| {
            let here = self.side[k];
            let there = self.side_of(k, b.centroid);
            here * there < 0.0
                && self.blocks(profile, discs, a, b, k, here / (here - there), counts)
        };
        if hint < self.ids.len() && tested(hint, counts) {
            return Some(hint);
        }
        (0..self.ids.len()).find(|&k| tested(k, counts))
    }

    #[inline(always)]
    fn side_of(&self, k: usize, c: [f64; 3]) -> f64 {
        let [nx, ny, nz] = &self.normal;
        nx[k] * c[0] + ny[k] * c[1] + nz[k] * c[2] - self.offset[k]
    }

    /// Decides [V-2] for a disc whose plane crosses strictly between the ends, at `t`.
    #[allow(clippy::too_many_arguments)]
    fn blocks(
        &self,
        profile: Profile,
        discs: &[Disc],
        a: &End,
        b: &End,
        k: usize,
        t: f64,
        counts: &mut Counts,
    ) -> bool {
        counts.n_tests += 1;
        let disc = &discs[self.ids[k] as usize];
        match settle(profile, disc, a, b, t) {
            Some(verdict) => verdict,
            None => {
                counts.n_exact += 1;
                disc::blocks(profile, &discs[a.id as usize], &discs[b.id as usize], disc)
            }
        }
    }
}

/// Decides by floats; `None` where the bound does not settle it.
#[inline]
fn settle(profile: Profile, disc: &Disc, a: &End, b: &End, t: f64) -> Option<bool> {
    let d = [0, 1, 2].map(|i| b.centroid[i] - a.centroid[i]);
    let x = [0, 1, 2].map(|i| a.centroid[i] + t * d[i]);
    let mut away2 = 0.0;
    for i in 0..3 {
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
