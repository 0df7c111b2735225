//! `pvmap query MAP pairs`: a table of pairs.

use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use pvmap::query::exact::{Disagreement, Exact};
use pvmap::query::{ErrorKind, Located, PairAnswer, Place, QueryError, Snap};
use pvmap::rows::{Row, RowBlock};
use rayon::prelude::*;
use serde_json::Value;

use super::batch::{self, Batch, Columns, Header, RowError, numbers, numbers_if_any};
use super::fraction::{self, FractionPairs};
use super::segment::SegmentPairs;
use super::{Asked, Outcome, pair, parse_distance, place, snap_of};
use crate::cli::exact::{Points, PointsArgs};

/// Answer a table of pairs, a row an input row, in order
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Input columns, by name in a header row, in any order, among others that are not read:
  x1 y1 z1 x2 y2 z2             the two places, in the scan's units
  nx1 ny1 nz1 nx2 ny2 nz2       optional: normals that say which surface is meant

Output columns:
  visible                       0 or 1, empty where there is no answer
  surfel1 surfel2               which surfels the places lie on
  distance1 distance2           how far from them, in the scan's units
  leaves                        with --segment or --exact, where visible is what the segment or
                                the points nearest to the places say: the same by the surfels
  blocker                       with --segment: a surfel that blocks the segment, if one does
  fraction                      with --fraction: how much the surfels see of each other, 0 to 1
  error                         why there is no answer

With --exact it says at the end, on stderr, how often surfels and points disagree. pvmap query
MAP pair --help tells what --segment, --fraction and --exact ask, and what they are for.

It ends with 0 once every row is answered, and with 65 at a row that is no text or longer than
64 KiB.

Examples:
  pvmap query grotto.vmap pairs rows.csv > answers.csv
  pvmap query grotto.vmap pairs rows.csv --segment > answers.csv
  pvmap query grotto.vmap pairs rows.csv --exact --delta 0.02 --k 2 > answers.csv
  printf 'x1,y1,z1,x2,y2,z2\\n1,2,3,-4,5,6\\n' | pvmap query grotto.vmap pairs -")]
pub(super) struct Args {
    /// A CSV file with a header row, or - for standard input
    #[arg(value_name = "ROWS.csv")]
    rows: PathBuf,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_parser = parse_distance, allow_hyphen_values = true, value_name = "DIST")]
    #[arg(verbatim_doc_comment)]
    snap: Option<f64>,
    /// Ask the segment between the places instead of that between the
    /// centres of their surfels: right more often, and slower
    #[arg(long, conflicts_with = "exact", verbatim_doc_comment)]
    segment: bool,
    /// Tell how much the surfels see of each other, too, where the map was
    /// built with --fractions or --min-exchange
    #[arg(long, conflicts_with_all = ["exact", "segment"], verbatim_doc_comment)]
    fraction: bool,
    #[command(flatten)]
    points: PointsArgs,
    /// Most memory that the map may be kept in: a long table is then
    /// answered several times faster
    #[arg(
        long,
        default_value = "1GiB",
        value_parser = pvmap::parse_memory,
        value_name = "SIZE",
        verbatim_doc_comment
    )]
    memory: u64,
    /// Answer as a JSON object a line
    #[arg(long)]
    json: bool,
}

/// From so many rows on reading the whole map pays.
const KEEP_ROWS: usize = 1 << 16;

const EXPECTED: &str = "x1,y1,z1,x2,y2,z2, and nx1,ny1,nz1,nx2,ny2,nz2 to choose sides";

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    if args.fraction {
        fraction::require(asked)?;
    }
    let (rows, columns) = batch::open(&args.rows, |header| {
        Ok([
            PlaceColumns::find(header, ["x1", "y1", "z1"], ["nx1", "ny1", "nz1"], EXPECTED)?,
            PlaceColumns::find(header, ["x2", "y2", "z2"], ["nx2", "ny2", "nz2"], EXPECTED)?,
        ])
    })?;
    let pairs = Pairs {
        asked,
        columns,
        snap: snap_of(args.snap),
        memory_bytes: args.memory,
        n_rows: AtomicUsize::new(0),
        is_kept: OnceLock::new(),
    };
    if args.segment {
        return batch::answer(rows, &SegmentPairs(pairs), args.json, asked.progress);
    }
    if args.fraction {
        return batch::answer(rows, &FractionPairs(pairs), args.json, asked.progress);
    }
    if !args.points.exact {
        return batch::answer(rows, &pairs, args.json, asked.progress);
    }
    let points = args.points.open(asked.path)?;
    let view = points.view()?;
    let options =
        args.points.nearness.options(asked.map).map_err(|e| points.named(asked.path, e))?;
    let exact = Exact::new(&view, options);
    exact.require_map(asked.map).map_err(|e| points.named(asked.path, e))?;
    let both = ExactPairs { pairs, points: &points, exact, found: Mutex::default() };
    let ended = batch::answer(rows, &both, args.json, asked.progress)?;
    let found = both.found.into_inner().unwrap_or_else(PoisonError::into_inner);
    // Where stderr is closed the table has to do.
    let _ = writeln!(
        std::io::stderr().lock(),
        "pvmap: surfels and points disagree in {} of {} pairs ({:.2} %): {} only the points see, \
         {} only the surfels",
        found.n_exact_only + found.n_leaf_only,
        found.n_pairs(),
        100.0 * found.share(),
        found.n_exact_only,
        found.n_leaf_only,
    );
    Ok(ended)
}

/// Where the columns of a place are.
pub(super) struct PlaceColumns {
    position: Columns<3>,
    normal: Option<Columns<3>>,
}

impl PlaceColumns {
    /// Finds them by their names.
    pub(super) fn find(
        header: &Header<'_>,
        position: [&'static str; 3],
        normal: [&'static str; 3],
        expected: &str,
    ) -> Result<PlaceColumns, String> {
        let position = header.all(position, expected)?;
        Ok(PlaceColumns { position, normal: header.all_or_none(normal, expected)? })
    }

    /// Reads the place of a row. Empty cells of a normal: this row does not choose a side.
    pub(super) fn read(&self, row: Row<'_>) -> Result<Place, String> {
        let normal = numbers_if_any(row, &self.normal)?;
        Ok(place(numbers(row, &self.position)?, normal))
    }
}

pub(super) struct Pairs<'q, 'm, 'a> {
    pub(super) asked: &'q Asked<'m, 'a>,
    columns: [PlaceColumns; 2],
    snap: Snap,
    /// Most memory to keep the map in.
    memory_bytes: u64,
    /// Rows so far.
    n_rows: AtomicUsize,
    /// Whether the map is in memory, once that was tried: then rows are answered in any order.
    is_kept: OnceLock<bool>,
}

/// Answers, in the order of their questions.
type Answers<A> = Vec<Result<A, QueryError>>;

/// How rows are asked.
pub(super) struct Ask<'f, Q, A> {
    /// Makes the question of a row.
    pub(super) find: &'f (dyn Fn(Row<'_>) -> Result<Q, RowError> + Sync),
    /// Keeps in so many bytes what the answers need; says whether all of it is kept.
    pub(super) keep: &'f dyn Fn(u64) -> Result<bool, QueryError>,
    /// Answers one question.
    pub(super) one: &'f (dyn Fn(&Q) -> Result<A, QueryError> + Sync),
    /// Answers many, in order.
    pub(super) many: &'f dyn Fn(&[Q]) -> Answers<A>,
}

impl Pairs<'_, '_, '_> {
    /// Reads both places of a row and finds their leaves.
    pub(super) fn locate(&self, row: Row<'_>) -> Result<[(Place, Located); 2], RowError> {
        let places = [self.columns[0].read(row)?, self.columns[1].read(row)?];
        let located = |place: Place| -> Result<(Place, Located), RowError> {
            let located = self.asked.map.locate(&place, self.snap);
            Ok((place, self.asked.of_row(located)?))
        };
        Ok([located(places[0])?, located(places[1])?])
    }

    /// Answers rows: each by itself where the map is kept, else all in the order that reads least.
    pub(super) fn ask<Q: Copy + Send, A: Send>(
        &self,
        rows: &RowBlock,
        ask: &Ask<'_, Q, A>,
    ) -> Vec<Result<(Q, A), RowError>> {
        // A damaged map is the error of the rows that meet the damage.
        let keep = || (ask.keep)(self.memory_bytes).unwrap_or(false);
        let n_rows = self.n_rows.fetch_add(rows.len(), Ordering::Relaxed) + rows.len();
        if n_rows >= KEEP_ROWS && *self.is_kept.get_or_init(keep) {
            return batch::each(rows, |row| {
                let question = (ask.find)(row)?;
                Ok((question, self.asked.of_row((ask.one)(&question))?))
            });
        }
        let found = batch::each(rows, ask.find);
        let questions: Vec<Q> = found.iter().filter_map(|row| row.as_ref().ok().copied()).collect();
        let mut answers = (ask.many)(&questions).into_iter();
        let answered = |row: Result<Q, RowError>| {
            let question = row?;
            let answer = answers.next().expect("one for each question");
            Ok((question, self.asked.of_row(answer)?))
        };
        found.into_iter().map(answered).collect()
    }
}

impl Batch for Pairs<'_, '_, '_> {
    type Answer = ((Located, Located), PairAnswer);

    const HEADER: &'static str = "visible,surfel1,surfel2,distance1,distance2,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Self::Answer, RowError>> {
        let map = self.asked.map;
        let ask = Ask {
            find: &|row| self.locate(row).map(|[(_, a), (_, b)]| (a, b)),
            keep: &|memory_bytes| map.keep(memory_bytes),
            one: &|(a, b)| map.pair(a, b),
            many: &|questions| map.pairs(questions),
        };
        self.ask(rows, &ask)
    }

    fn write(&self, ((a, b), answer): &Self::Answer, out: &mut Vec<u8>) -> std::io::Result<()> {
        let visible = u8::from(answer.visible);
        write!(out, "{visible},{},{},{},{},", a.surfel, b.surfel, a.distance, b.distance)
    }

    fn object(&self, ((a, b), answer): &Self::Answer) -> Value {
        pair::as_json(a, b, answer)
    }
}

/// Pairs that are asked of the points, too.
struct ExactPairs<'q, 'm, 'a, 'v, 'o> {
    pairs: Pairs<'q, 'm, 'a>,
    points: &'q Points,
    exact: Exact<'v, 'o>,
    found: Mutex<Disagreement>,
}

impl ExactPairs<'_, '_, '_, '_, '_> {
    fn ask_points(&self, row: Row<'_>) -> Result<bool, RowError> {
        let Pairs { asked, columns, .. } = &self.pairs;
        let [a, b] = [columns[0].read(row)?, columns[1].read(row)?];
        let exact = &self.exact;
        let ask = || exact.pair(&exact.nearest(&a)?.point, &exact.nearest(&b)?.point);
        ask().map(|verdict| verdict.visible).map_err(|e: QueryError| match e.kind() {
            ErrorKind::Place | ErrorKind::Usage => RowError::Row(e.to_string()),
            _ => RowError::Map(self.points.named(asked.path, e)),
        })
    }
}

impl Batch for ExactPairs<'_, '_, '_, '_, '_> {
    type Answer = (((Located, Located), PairAnswer), bool);

    const HEADER: &'static str = "visible,surfel1,surfel2,distance1,distance2,leaves,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Self::Answer, RowError>> {
        let by_leaves = self.pairs.answers(rows);
        let both: Vec<Result<Self::Answer, RowError>> = by_leaves
            .into_par_iter()
            .enumerate()
            .map(|(i, answer)| Ok((answer?, self.ask_points(rows.row(i))?)))
            .collect();
        let mut found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        for ((_, answer), exact) in both.iter().flatten() {
            found.count(answer.visible, *exact);
        }
        both
    }

    fn write(&self, (answer, exact): &Self::Answer, out: &mut Vec<u8>) -> std::io::Result<()> {
        let (ends, by_leaves) = *answer;
        let answer = (ends, PairAnswer { visible: *exact, ..by_leaves });
        self.pairs.write(&answer, out)?;
        write!(out, "{},", u8::from(by_leaves.visible))
    }

    fn object(&self, (answer, exact): &Self::Answer) -> Value {
        let mut object = self.pairs.object(answer);
        object["leaves"] = object["visible"].clone();
        object["visible"] = (*exact).into();
        object
    }
}
