//! Points as scanners record them: off their surfaces, uneven, with holes, with wrong normals.

use crate::holes::make_holes;
use crate::kept::Kept;
use crate::points::{MOST_POINTS, Points, Sample};
use crate::random::{bits, unit_pair};
use crate::vector::add_scaled;

/// What is wrong with the points of a scan; by default nothing.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Defects {
    /// Standard deviation of how far a point is off its surface, to either side along the normal
    /// of the surface, in metres.
    pub noise_m: f64,
    /// How many times denser the points are at the least x of the scene than at the greatest;
    /// between, their density falls with the square of a distance, as with that from a scanner.
    /// 0 and 1 leave it even.
    pub unevenness: f64,
    /// The share of the points that is missing, 0…1: in balls around places of the surfaces.
    pub missing: f64,
    /// The share of the points that have no normal, 0…1.
    pub without_normal: f64,
    /// The share of the points whose normal has the wrong sign, 0…1.
    pub flipped: f64,
}

/// The radius of a hole, as a share of the scene's extent: 0.22 m in a room.
pub const HOLE_RADIUS: f64 = 0.04;

/// What chance is asked for: each has a sequence of its own. Points have those below
/// [`MOST_POINTS`].
#[derive(Debug, Clone, Copy)]
enum Chance {
    Noise = 1,
    Density,
    Holes,
    Normal,
    Sign,
}

/// Halves of hashes that are summed up for one number of noise.
const N_NOISE: u64 = 12;

/// Points with [`Defects`]: what is recorded of each, and where on its surface it truly is.
///
/// Like [`Points`] a pure function of (kind, seed, n, defects). Where points are missing, two
/// bytes are held for each of those that are not; while holes are made, four.
#[derive(Debug)]
pub struct Scan<'a> {
    points: Points<'a>,
    defects: Defects,
    /// Those of the points that are recorded, in order; all where there is none.
    kept: Option<Kept>,
}

impl<'a> Points<'a> {
    /// Gives the points as a scan with defects has them. Where the density is uneven there are as
    /// many all the same, give or take a hundredth; what is in holes is missing.
    pub fn recorded(self, defects: &Defects) -> Scan<'a> {
        let mut points = self;
        let mut kept = None;
        if defects.unevenness > 1.0 && !points.is_empty() {
            let n_kept = uneven(&points, defects.unevenness).len().max(1);
            let n = points.len() as f64 * (points.len() as f64 / n_kept as f64);
            points = points.resized((n as u64).min(MOST_POINTS));
            kept = Some(uneven(&points, defects.unevenness));
        }
        if defects.missing > 0.0 {
            let all = kept.unwrap_or_else(|| (0..points.len()).collect());
            let n_left = (all.len() as f64 * (1.0 - defects.missing.min(1.0))) as u64;
            let radius_m = HOLE_RADIUS * points.scene().extent_m;
            let (places, chance) = (points.resized(MOST_POINTS), points.sequence(Chance::Holes));
            let middle_of = |ball| places.at(bits(chance, ball) % MOST_POINTS).position;
            let place_of = |i| points.at(i).position;
            kept = Some(make_holes(all, n_left, radius_m, place_of, middle_of));
        }
        Scan { points, defects: *defects, kept }
    }

    /// Gives a number of the interval (0, 1) for a point.
    fn chance(&self, what: Chance, index: u64) -> f64 {
        unit_pair(bits(self.sequence(what), index))[0]
    }

    fn sequence(&self, what: Chance) -> u64 {
        bits(self.key(), u64::MAX - what as u64)
    }
}

/// Draws the points that are recorded where density falls to the `ratio`-th part.
fn uneven(points: &Points<'_>, ratio: f64) -> Kept {
    let [low, high] = points.scene().x_range();
    let steep = ratio.sqrt() - 1.0;
    let is_kept = |&i: &u64| {
        let along = (points.at(i).position[0] - low) / (high - low).max(f64::MIN_POSITIVE);
        let distance = 1.0 + steep * along;
        points.chance(Chance::Density, i) * distance * distance < 1.0
    };
    (0..points.len()).filter(is_kept).collect()
}

impl<'a> Scan<'a> {
    /// Counts the points.
    pub fn len(&self) -> u64 {
        self.kept.as_ref().map_or(self.points.len(), Kept::len)
    }

    /// Says whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Gives the scene that was scanned.
    pub fn scene(&self) -> &'a crate::Scene {
        self.points.scene()
    }

    /// Gives what is recorded of point number `index`; without a normal it is [0, 0, 0].
    ///
    /// # Panics
    /// Where `index` is not below [`Scan::len`].
    pub fn at(&self, index: u64) -> Sample {
        let (i, mut sample) = self.truly_of(index);
        let Defects { noise_m, without_normal, flipped, .. } = self.defects;
        if noise_m > 0.0 {
            let off_m = noise_m * self.noise(i);
            sample.position = add_scaled(sample.position, off_m, sample.normal.map(f64::from));
        }
        if self.points.chance(Chance::Sign, i) < flipped {
            sample.normal = sample.normal.map(|c| -c);
        }
        if self.points.chance(Chance::Normal, i) < without_normal {
            sample.normal = [0.0; 3];
        }
        sample
    }

    /// Gives the place of a surface that point number `index` is of, with the surface's own normal:
    /// where the truth is asked.
    ///
    /// # Panics
    /// Where `index` is not below [`Scan::len`].
    pub fn truly(&self, index: u64) -> Sample {
        self.truly_of(index).1
    }

    fn truly_of(&self, index: u64) -> (u64, Sample) {
        let i = self.kept.as_ref().map_or(index, |kept| kept.at(index));
        (i, self.points.at(i))
    }

    /// Draws a number of mean 0 and standard deviation 1, all but normally distributed and never
    /// beyond 6: the sum of twelve even ones.
    fn noise(&self, index: u64) -> f64 {
        let sequence = self.points.sequence(Chance::Noise);
        let pairs = (0..N_NOISE / 2).map(|j| unit_pair(bits(sequence, index * (N_NOISE / 2) + j)));
        pairs.flatten().sum::<f64>() - N_NOISE as f64 / 2.0
    }
}
