//! Answers of a map against exact geometry: random pairs of places, counted.

use std::path::Path;
use std::time::Instant;

use fastrand::Rng;
use pvmap_query::exact::Exact;
use pvmap_query::{ErrorKind, Located, Map, Place, QueryError, Snap};
use pvmap_scene::{MOST_POINTS, Sample, Scene};
use pvmap_store::Watch;
use pvmap_vmap::bytes::FieldReader;
use pvmap_vmap::fraction::SEGMENTS;
use pvmap_vmap::octree::Placement;
use pvmap_vmap::schema::{Column, ColumnType};
use pvmap_vmap::{FormatError, OctreeView};
use rayon::prelude::*;

use crate::Error;

/// Pairs drawn, answered and judged at a time.
pub(crate) const CHUNK_PAIRS: u64 = 4096;
/// Triangles are asked for places by number: these are more than anybody will draw, and so many
/// that a triangle's share of them is its share of the area.
const N_PLACES: u64 = MOST_POINTS;

/// A place that is asked about.
#[derive(Debug, Clone, Copy)]
pub struct Drawn {
    /// As a map is asked.
    pub place: Place,
    /// As the truth is asked; none where the place is not on any of its surfaces.
    pub sample: Option<Sample>,
}

/// A way to answer whether two places see each other: a column of a comparison.
pub struct Way<'a> {
    /// What it is called.
    pub name: &'static str,
    /// The answer.
    pub answer: Answer<'a>,
}

/// Says whether two places see each other.
pub type Answer<'a> = Box<dyn FnMut(&Place, &Place) -> Result<Reply, Error> + 'a>;

/// What a way says of two places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reply {
    /// Whether they see each other.
    pub visible: bool,
    /// How much of each other is seen, in sixteenths: all or nothing but for visible fractions.
    pub n_free: u8,
    /// Whether one is so far from what answers for it that a question would be refused by default.
    pub is_far: bool,
}

impl Reply {
    fn new(visible: bool, is_far: bool) -> Reply {
        Reply { visible, n_free: if visible { SEGMENTS } else { 0 }, is_far }
    }
}

impl From<bool> for Reply {
    fn from(visible: bool) -> Reply {
        Reply::new(visible, false)
    }
}

impl<'a> Way<'a> {
    /// Answers by the leaves of a map, however far from a place the nearest one is.
    pub fn leaves(map: &'a Map<'_>) -> Way<'a> {
        let answer = move |a: &Place, b: &Place| {
            let ((a, a_is_far), (b, b_is_far)) = (locate(map, a)?, locate(map, b)?);
            Ok(Reply::new(map.pair(&a, &b)?.visible, a_is_far || b_is_far))
        };
        Way { name: "leaves", answer: Box::new(answer) }
    }

    /// Answers by the segments between places, among the surfels of a map.
    pub fn segments(map: &'a Map<'_>) -> Way<'a> {
        let answer = move |a: &Place, b: &Place| {
            let ((c, c_is_far), (d, d_is_far)) = (locate(map, a)?, locate(map, b)?);
            let (a, b) = (map.spot(a, c)?, map.spot(b, d)?);
            let visible = map.pair_by_segment(&a, &b)?.visible;
            Ok(Reply::new(visible, c_is_far || d_is_far))
        };
        Way { name: "segments", answer: Box::new(answer) }
    }

    /// Answers by the visible fractions of a map: yes from half on. [F-24]
    pub fn fractions(map: &'a Map<'_>) -> Way<'a> {
        let answer = move |a: &Place, b: &Place| {
            let ((a, a_is_far), (b, b_is_far)) = (locate(map, a)?, locate(map, b)?);
            let n_free = map.pair_fraction(&a, &b)?.n_free;
            let visible = 2 * n_free >= SEGMENTS;
            Ok(Reply { visible, n_free, is_far: a_is_far || b_is_far })
        };
        Way { name: "fractions", answer: Box::new(answer) }
    }

    /// Answers by the points of an octree, those nearest to the places. [V-7]
    pub fn points(exact: Exact<'a, 'a>) -> Way<'a> {
        let answer = move |a: &Place, b: &Place| {
            let [a, b] = [exact.nearest(a)?.point, exact.nearest(b)?.point];
            Ok(exact.pair(&a, &b)?.visible.into())
        };
        Way { name: "points", answer: Box::new(answer) }
    }

    /// Answers; nothing where a place is outside the cube.
    pub(crate) fn reply(&mut self, a: &Place, b: &Place) -> Result<Option<Reply>, Error> {
        match (self.answer)(a, b) {
            Ok(reply) => Ok(Some(reply)),
            Err(Error::Query(e)) if e.kind() == ErrorKind::Place => Ok(None),
            Err(e) => Err(e),
        }
    }
}

/// Finds the leaf of a place, and says whether it is farther from it than is allowed by default.
fn locate(map: &Map<'_>, place: &Place) -> Result<(Located, bool), QueryError> {
    match map.locate(place, Snap::default()) {
        Err(QueryError::NoSurface { .. }) => {
            Ok((map.locate(place, Snap::Within(f64::INFINITY))?, true))
        }
        located => located.map(|located| (located, false)),
    }
}

/// What a comparison found.
#[derive(Debug, Clone, Default)]
pub struct Comparison {
    /// Pairs that were judged by the truth.
    pub n_pairs: u64,
    /// Pairs that were not: a place is on none of the truth's surfaces.
    pub n_left_out: u64,
    /// Judged pairs that face each other, whatever is between them.
    pub n_facing: u64,
    /// Judged pairs that see each other.
    pub n_visible: u64,
    /// How each way did, in the order given.
    pub tallies: Vec<Tally>,
}

/// How one way of answering did.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tally {
    /// What it is called.
    pub name: &'static str,
    /// Judged pairs it answered; what follows but for the next is about these.
    pub n_pairs: u64,
    /// Judged pairs it did not answer: a place is outside the cube.
    pub n_refused: u64,
    /// Pairs with a place farther from what answers for it than is allowed by default.
    pub n_far: u64,
    /// Pairs that face each other.
    pub n_facing: u64,
    /// Pairs it says see each other.
    pub n_said_visible: u64,
    /// Those of them that do not.
    pub n_false_visible: u64,
    /// Pairs it says do not see each other, and they do.
    pub n_false_invisible: u64,
    /// Those of both kinds that face each other.
    pub n_wrong_facing: u64,
    /// The squares of the differences between how much it says is seen, in sixteenths, and all or
    /// nothing, added up.
    pub n_squares: u64,
    /// What all its answers took, one after the other.
    pub seconds: f64,
}

impl Tally {
    /// Counts the pairs that were answered as the truth does.
    pub fn n_agreeing(&self) -> u64 {
        self.n_pairs - self.n_false_visible - self.n_false_invisible
    }

    /// Counts those of them that face each other.
    pub fn n_agreeing_facing(&self) -> u64 {
        self.n_facing - self.n_wrong_facing
    }

    /// Gives the mean squared error of how much it says is seen, 0 to 1: of answers that are yes or
    /// no the share that is wrong. Source: Brier 1950.
    pub fn squared_error(&self) -> f64 {
        let of_one = f64::from(SEGMENTS).powi(2);
        self.n_squares as f64 / of_one / self.n_pairs.max(1) as f64
    }

    pub(crate) fn count(&mut self, verdict: Verdict, reply: Option<Reply>) {
        let Some(Reply { visible, n_free, is_far }) = reply else {
            self.n_refused += 1;
            return;
        };
        self.n_pairs += 1;
        self.n_far += u64::from(is_far);
        self.n_facing += u64::from(verdict.faces);
        self.n_said_visible += u64::from(visible);
        self.n_false_visible += u64::from(visible && !verdict.sees);
        self.n_false_invisible += u64::from(verdict.sees && !visible);
        let in_truth = if verdict.sees { SEGMENTS } else { 0 };
        self.n_squares += u64::from(n_free.abs_diff(in_truth)).pow(2);
        self.n_wrong_facing += u64::from(verdict.faces && verdict.sees != visible);
    }
}

impl Comparison {
    /// Gives a way's answers a second.
    pub fn rate(&self, tally: &Tally) -> f64 {
        (self.n_pairs + self.n_left_out) as f64 / tally.seconds.max(1e-9)
    }

    fn count(&mut self, verdict: Option<Verdict>, replies: &[Option<Reply>]) {
        let Some(verdict) = verdict else {
            self.n_left_out += 1;
            return;
        };
        self.n_pairs += 1;
        self.n_facing += u64::from(verdict.faces);
        self.n_visible += u64::from(verdict.sees);
        self.tallies.iter_mut().zip(replies).for_each(|(t, reply)| t.count(verdict, *reply));
    }
}

/// What the truth says of a pair.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Verdict {
    pub(crate) faces: bool,
    pub(crate) sees: bool,
}

/// Draws pairs of places, asks every way and the truth about each, and counts.
///
/// # Errors
/// Where a place cannot be drawn, a map is damaged or the run is asked to stop.
pub fn compare(
    truth: &Scene,
    (n_pairs, seed): (u64, u64),
    draw: &mut dyn FnMut(&mut Rng) -> Result<Drawn, Error>,
    ways: &mut [Way<'_>],
    watch: &dyn Watch,
) -> Result<Comparison, Error> {
    let untold = |w: &Way<'_>| Tally { name: w.name, ..Tally::default() };
    let mut found =
        Comparison { tallies: ways.iter().map(untold).collect(), ..Comparison::default() };
    let mut rng = Rng::with_seed(seed);
    let mut left = n_pairs;
    while left > 0 {
        watch.check()?;
        let n = left.min(CHUNK_PAIRS);
        let mut pair = || Ok::<_, Error>([draw(&mut rng)?, draw(&mut rng)?]);
        let pairs: Vec<[Drawn; 2]> = (0..n).map(|_| pair()).collect::<Result<_, _>>()?;
        let mut replies = vec![Vec::with_capacity(ways.len()); pairs.len()];
        for (way, tally) in ways.iter_mut().zip(&mut found.tallies) {
            let started = Instant::now();
            for ([a, b], replies) in pairs.iter().zip(&mut replies) {
                replies.push(way.reply(&a.place, &b.place)?);
            }
            tally.seconds += started.elapsed().as_secs_f64();
        }
        let verdicts: Vec<Option<Verdict>> = pairs.par_iter().map(|p| judge(truth, p)).collect();
        verdicts.into_iter().zip(&replies).for_each(|(v, replies)| found.count(v, replies));
        watch.advance(n);
        left -= n;
    }
    Ok(found)
}

pub(crate) fn judge(truth: &Scene, pair: &[Drawn; 2]) -> Option<Verdict> {
    let (a, b) = (pair[0].sample?, pair[1].sample?);
    Some(Verdict { faces: Scene::faces(&a, &b), sees: truth.sees(&a, &b) })
}

/// Draws places of the truth's own surfaces, by area, with their normals.
pub fn draw_place(truth: &Scene, rng: &mut Rng) -> Drawn {
    let sample = truth.points(N_PLACES).at(rng.u64(..N_PLACES));
    let place = Place { position: sample.position, normal: Some(sample.normal) };
    Drawn { place, sample: Some(sample) }
}

/// The points of an octree, to be drawn from.
pub struct ScanPoints<'a> {
    view: &'a OctreeView<'a>,
    path: &'a Path,
    placement: Placement,
    /// Where a record has its number.
    number: Column,
}

/// A point of an octree that was drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ScanPoint {
    /// Its place in the order of the octree.
    pub(crate) index: u64,
    /// Its record in the scan.
    pub(crate) record: u64,
    /// As a map is asked.
    pub(crate) place: Place,
    /// Its normal; zero where it has none or its side is not known.
    side: [f32; 3],
}

impl ScanPoint {
    /// Finds where the truth is asked, see [`ScanPoints::draw`].
    pub(crate) fn on(&self, truth: &Scene) -> Drawn {
        Drawn { place: self.place, sample: truth.project(self.place.position, self.side) }
    }
}

impl<'a> ScanPoints<'a> {
    /// Takes an octree with points; `path` is what an error names.
    ///
    /// # Errors
    /// Where there is no point.
    pub fn new(view: &'a OctreeView<'a>, path: &'a Path) -> Result<ScanPoints<'a>, Error> {
        if view.summary().n_points == 0 {
            let message = format!("{}: there are no points to draw from", path.display());
            return Err(Error::Data(message));
        }
        let placement = Placement::new(view.schema(), view.frame().frame, view.sources());
        // A schema begins with position and record. [F-9]
        let number = view.schema().columns()[1];
        Ok(ScanPoints { view, path, placement, number })
    }

    /// Draws a point, see [`ScanPoints::at`].
    ///
    /// # Errors
    /// Where the octree is damaged.
    pub fn draw(&self, truth: &Scene, rng: &mut Rng) -> Result<Drawn, Error> {
        self.at(truth, rng.u64(..self.view.summary().n_points))
    }

    /// Gives a point by its place in the order of the octree. The truth is asked at the nearest
    /// place of its surfaces whose front is within 60° of the point's normal (any front where its
    /// side is unknown).
    ///
    /// # Errors
    /// Where the octree is damaged or has no such point.
    pub fn at(&self, truth: &Scene, index: u64) -> Result<Drawn, Error> {
        Ok(self.point(index)?.on(truth))
    }

    /// Draws a point.
    pub(crate) fn pick(&self, rng: &mut Rng) -> Result<ScanPoint, Error> {
        self.point(rng.u64(..self.view.summary().n_points))
    }

    /// Reads a point by its place in the order of the octree.
    fn point(&self, index: u64) -> Result<ScanPoint, Error> {
        let named = |e: FormatError| Error::artifact(self.path, e);
        let points = self.view.points(index, 1).map_err(named)?;
        let point = points.iter().next().expect("one was asked for").map_err(named)?;
        let no_source = || Error::Data(format!("{}: a point of no source", self.path.display()));
        let position = self.placement.world(point.record).ok_or_else(no_source)?;
        let normal = point.key.normal.map(f32::from);
        let has_normal = normal != [0.0; 3];
        let side = if point.key.oriented { normal } else { [0.0; 3] };
        let place = Place { position, normal: has_normal.then_some(normal) };
        let mut number = FieldReader::new(&point.record[self.number.offset..]);
        let record = match self.number.kind {
            ColumnType::U64 => number.u64(),
            _ => number.u32().into(),
        };
        Ok(ScanPoint { index, record, place, side })
    }
}

/// Gives the 95 % interval of a share of which `k` of `n` were seen.
///
/// Source: Wilson 1927, the score interval.
pub fn wilson(k: u64, n: u64) -> [f64; 2] {
    if n == 0 {
        return [0.0, 1.0];
    }
    const Z: f64 = 1.959_963_984_540_054;
    let (n, p) = (n as f64, k as f64 / n as f64);
    let middle = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    [((middle - half) / scale).max(0.0), ((middle + half) / scale).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use pvmap_scene::SceneKind;
    use pvmap_store::Quiet;

    #[test]
    fn wilsons_interval() {
        let near = |found: [f64; 2], low: f64, high: f64| {
            assert!((found[0] - low).abs() < 5e-5 && (found[1] - high).abs() < 5e-5, "{found:?}");
        };
        // Wilson's interval is known from textbooks for these.
        near(wilson(5, 10), 0.2366, 0.7634);
        near(wilson(0, 10), 0.0, 0.2775);
        near(wilson(10, 10), 0.7225, 1.0);
        near(wilson(81, 263), 0.2553, 0.3662);
        near(wilson(0, 0), 0.0, 1.0);
    }

    #[test]
    fn counts_are_those_of_each_pair() {
        let truth = Scene::new(SceneKind::Packed, 1);
        let mut asked = Vec::new();
        let says = |n: usize| n.is_multiple_of(3);
        let mut ways = [
            Way { name: "yes", answer: Box::new(|_: &Place, _: &Place| Ok(true.into())) },
            Way {
                name: "every third",
                answer: Box::new(|a: &Place, b: &Place| {
                    asked.push((*a, *b));
                    Ok(says(asked.len()).into())
                }),
            },
        ];
        let mut draw = |rng: &mut Rng| Ok(draw_place(&truth, rng));
        let found = compare(&truth, (5000, 7), &mut draw, &mut ways, &Quiet).unwrap();
        drop(ways);
        let mut wrong = [0, 0, 0];
        let mut n_visible = 0;
        for ((a, b), n) in asked.iter().zip(1..) {
            let normal = |p: &Place| p.normal.unwrap();
            let sees = truth.sees_points(a.position, normal(a), b.position, normal(b));
            n_visible += u64::from(sees);
            wrong[0] += u64::from(!sees);
            wrong[1] += u64::from(says(n) && !sees);
            wrong[2] += u64::from(!says(n) && sees);
        }
        assert_eq!((found.n_pairs, found.n_left_out), (5000, 0));
        assert_eq!(found.n_visible, n_visible);
        assert!(n_visible > 500 && n_visible < found.n_facing && found.n_facing < 4000);
        let counts = found.tallies.iter().map(|t| (t.n_false_visible, t.n_false_invisible));
        assert_eq!(counts.collect::<Vec<_>>(), [(wrong[0], 0), (wrong[1], wrong[2])]);
        let said = found.tallies.iter().map(|t| t.n_said_visible);
        assert_eq!(said.collect::<Vec<_>>(), [5000, 5000 / 3]);
        assert_eq!(found.tallies[0].n_agreeing(), n_visible);
        assert_eq!(found.tallies[0].n_agreeing_facing(), n_visible);
    }

    #[test]
    fn squared_errors_are_those_of_the_shares() {
        let mut tally = Tally::default();
        for (n_free, sees) in [(4, false), (8, true), (12, true), (16, false), (0, false)] {
            let reply = Reply { visible: 2 * n_free >= SEGMENTS, n_free, is_far: false };
            tally.count(Verdict { faces: true, sees }, Some(reply));
        }
        // 1/16 + 1/4 + 1/16 + 1 + 0, of five.
        assert!((tally.squared_error() - 1.375 / 5.0).abs() < 1e-12, "{tally:?}");
        assert_eq!((tally.n_false_visible, tally.n_false_invisible), (1, 0));
        // Of answers that are yes or no it is the share that is wrong.
        let mut tally = Tally::default();
        for (visible, sees) in [(true, true), (true, false), (false, true), (false, false)] {
            tally.count(Verdict { faces: true, sees }, Some(visible.into()));
        }
        assert!((tally.squared_error() - 0.5).abs() < 1e-12, "{tally:?}");
    }

    #[test]
    fn what_cannot_be_asked_is_left_out() {
        let truth = Scene::new(SceneKind::Empty, 1);
        let mut n_drawn = 0;
        let mut draw = |rng: &mut Rng| {
            n_drawn += 1;
            let drawn = draw_place(&truth, rng);
            Ok(if n_drawn % 10 == 0 { Drawn { sample: None, ..drawn } } else { drawn })
        };
        let no = |_: &Place, _: &Place| Ok(false.into());
        let mut n_asked = 0;
        let outside = QueryError::OutsideCube { place: [9.0; 3], min: [0.0; 3], max: [1.0; 3] };
        let picky = |_: &Place, _: &Place| {
            n_asked += 1;
            match n_asked % 4 {
                0 => Err(Error::Query(outside.clone())),
                n => Ok(Reply::new(false, n == 1)),
            }
        };
        let mut ways = [
            Way { name: "no", answer: Box::new(no) },
            Way { name: "picky", answer: Box::new(picky) },
        ];
        let found = compare(&truth, (100, 1), &mut draw, &mut ways, &Quiet).unwrap();
        // Every fifth pair has a place that is nowhere; of the other 80 one in four is refused.
        assert_eq!((found.n_pairs, found.n_left_out), (80, 20));
        let [no, picky] = &found.tallies[..] else { panic!("one a way: {found:?}") };
        assert_eq!((no.n_pairs, no.n_refused, no.n_far), (80, 0, 0), "another's refusals");
        assert_eq!((picky.n_pairs, picky.n_refused, picky.n_far), (60, 20, 20));
        assert_eq!(no.n_facing, found.n_facing);
        assert!(picky.n_facing < found.n_facing && picky.n_agreeing() < 60);
    }
}
