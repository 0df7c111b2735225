//! Pairs of points that face each other, drawn and judged once for all maps.

use std::time::Instant;

use fastrand::Rng;
use pvmap_query::exact::{Exact, ExactOptions};
use pvmap_query::{Map, Place};
use pvmap_scene::{Scan, Scene};
use pvmap_store::{Watch, memory};
use pvmap_vmap::OctreeView;
use rayon::prelude::*;

use crate::accuracy::{self, CHUNK_PAIRS, ScanPoint, ScanPoints, Tally, Verdict, Way};
use crate::{Error, build};

use super::Clock;

/// What judges pairs.
#[derive(Debug, Clone, Copy)]
pub enum Truth<'a> {
    /// Surfaces: of a generated scene, or triangles that were given.
    Surfaces(&'a Scene),
    /// The surfaces of a generated scene, each point where it was before its scan spoiled it: the
    /// octree is of that scan alone.
    Recorded(&'a Scan<'a>),
    /// The points of the octree, one by one: a reference. [V-7]
    Points(Exact<'a, 'a>),
}

impl<'a> Truth<'a> {
    /// Takes the points of an octree, with Δ and K as they are usual with a map of the default
    /// configuration. Runs on the current rayon pool.
    ///
    /// # Errors
    /// Where the octree is damaged, its tree outgrows the memory or the run is asked to stop.
    pub fn of_points(
        octree: &'a OctreeView<'a>,
        memory_bytes: u64,
        watch: &dyn Watch,
    ) -> Result<(Truth<'a>, ExactOptions), Error> {
        let options = build::usual_nearness(octree, memory_bytes, watch)?;
        Ok((Truth::Points(Exact::new(octree, options)), options))
    }

    /// Judges a pair; nothing where a point is on none of its surfaces.
    fn judge(&self, pair: &[ScanPoint; 2]) -> Result<Option<Verdict>, Error> {
        match self {
            Truth::Surfaces(scene) => Ok(accuracy::judge(scene, &pair.map(|p| p.on(scene)))),
            Truth::Recorded(scan) => {
                let is_recorded = |p: &ScanPoint| p.record < scan.len();
                if !pair.iter().all(is_recorded) {
                    return Ok(None);
                }
                let [a, b] = [scan.truly(pair[0].record), scan.truly(pair[1].record)];
                let (faces, sees) = (Scene::faces(&a, &b), scan.scene().sees(&a, &b));
                Ok(Some(Verdict { faces, sees }))
            }
            Truth::Points(exact) => {
                let [a, b] = [exact.point(pair[0].index)?, exact.point(pair[1].index)?];
                let found = exact.pair(&a, &b)?;
                Ok(Some(Verdict { faces: found.faces, sees: found.visible }))
            }
        }
    }
}

/// Pairs of points that face each other.
#[derive(Debug, Clone, Default)]
pub struct Sample {
    pairs: Vec<([Place; 2], bool)>,
    n_drawn: u64,
    n_left_out: u64,
}

impl Sample {
    /// The most pairs that are drawn: 88 bytes each are held.
    pub const MAX_PAIRS: u64 = 10_000_000;

    /// Draws so many pairs of points and keeps those that face each other by the truth. The draw is
    /// that of [`accuracy::compare`] with [`ScanPoints::draw`] and the same seed. Runs on the
    /// current rayon pool.
    ///
    /// # Errors
    /// Where the octree is damaged or the run is asked to stop.
    pub fn draw(
        truth: &Truth<'_>,
        points: &ScanPoints<'_>,
        (n_pairs, seed): (u64, u64),
        watch: &dyn Watch,
    ) -> Result<Sample, Error> {
        watch.stage("judge", Some(n_pairs), "pairs");
        let mut sample = Sample::default();
        let mut rng = Rng::with_seed(seed);
        while sample.n_drawn < n_pairs {
            watch.check()?;
            let n = CHUNK_PAIRS.min(n_pairs - sample.n_drawn);
            let mut pair = || Ok::<_, Error>([points.pick(&mut rng)?, points.pick(&mut rng)?]);
            let pairs: Vec<[ScanPoint; 2]> = (0..n).map(|_| pair()).collect::<Result<_, _>>()?;
            let verdicts: Vec<Option<Verdict>> =
                pairs.par_iter().map(|pair| truth.judge(pair)).collect::<Result<_, _>>()?;
            for (pair, verdict) in pairs.iter().zip(verdicts) {
                match verdict {
                    None => sample.n_left_out += 1,
                    Some(Verdict { faces: true, sees }) => {
                        sample.pairs.push((pair.map(|p| p.place), sees));
                    }
                    Some(_) => {}
                }
            }
            sample.n_drawn += n;
            watch.advance(n);
        }
        Ok(sample)
    }

    /// Gives how many pairs were drawn.
    pub fn n_drawn(&self) -> u64 {
        self.n_drawn
    }

    /// Gives how many of them have a point on none of the truth's surfaces.
    pub fn n_left_out(&self) -> u64 {
        self.n_left_out
    }

    /// Gives how many of them face each other.
    pub fn n_facing(&self) -> u64 {
        self.pairs.len() as u64
    }

    /// Gives how many of those see each other.
    pub fn n_visible(&self) -> u64 {
        self.pairs.iter().filter(|(_, sees)| *sees).count() as u64
    }

    /// Asks a map about all pairs, one after the other; the seconds are those of the clock.
    ///
    /// # Errors
    /// Where the map is damaged or the run is asked to stop.
    pub fn ask(&self, map: &Map<'_>, clock: Clock, watch: &dyn Watch) -> Result<Tally, Error> {
        self.ask_by(Way::leaves(map), clock, watch)
    }

    /// Asks a way about all pairs, as [`Sample::ask`] asks the leaves of a map.
    ///
    /// # Errors
    /// Where the map is damaged or the run is asked to stop.
    pub fn ask_by(
        &self,
        mut way: Way<'_>,
        clock: Clock,
        watch: &dyn Watch,
    ) -> Result<Tally, Error> {
        let begin = Instant::now();
        let seconds = || match clock {
            Clock::Wall => begin.elapsed().as_secs_f64(),
            // Where the system does not tell, the seconds that went by are the most it can be.
            Clock::Processor => {
                memory::thread_seconds().unwrap_or_else(|| begin.elapsed().as_secs_f64())
            }
        };
        watch.stage("query", Some(self.n_facing()), "pairs");
        let mut tally = Tally { name: way.name, ..Tally::default() };
        for pairs in self.pairs.chunks(CHUNK_PAIRS as usize) {
            watch.check()?;
            let started = seconds();
            let replies: Vec<_> =
                pairs.iter().map(|([a, b], _)| way.reply(a, b)).collect::<Result<_, _>>()?;
            tally.seconds += seconds() - started;
            for ((_, sees), reply) in pairs.iter().zip(replies) {
                tally.count(Verdict { faces: true, sees: *sees }, reply);
            }
            watch.advance(pairs.len() as u64);
        }
        Ok(tally)
    }
}
