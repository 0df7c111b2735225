//! `pvmap query`: ask a map. A file a question, and what they share: the map at hand
//! ([`Asked`]) and tables of questions (`batch`).

mod batch;
mod fraction;
mod pair;
mod pairs;
mod ray;
mod region;
mod sees_count;
mod segment;
mod shadow;
mod visible_from;

use std::io::{self, BufWriter, Stdout};
use std::path::{Path, PathBuf};

use clap::Subcommand;
use pvmap::query::{Located, Map, Place, QueryError, Snap};
use pvmap::{Error, Limits};
use serde_json::{Value, json};

use self::batch::RowError;

use super::{Context, LAST, Outcome, map_file, parse_point, print_json, threads_parser};
use crate::progress::Progress;

/// Ask a map
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Coordinates are in the scan's units, as pvmap info shows its origin and extent; they may begin
with a minus. pvmap query MAP pair --help tells all of a question.

Examples:
  pvmap query grotto.vmap pair 1,2,3 -4,5,6       yes (exit 0) or no (exit 1)
  pvmap query grotto.vmap pairs rows.csv          a row an answer
  cat rows.csv | pvmap query grotto.vmap pairs - --json
  pvmap query grotto.vmap visible-from 1,2,3 > seen.csv
  pvmap query grotto.vmap region 1,2,3 0.5 -4,5,6 0.5
  pvmap query grotto.vmap ray 1,2,3 0,0,-1
  pvmap query grotto.vmap shadow 1,2,3 --light 0,0,9")]
pub(super) struct Args {
    /// The map, as pvmap build makes it
    #[arg(value_name = "NAME.vmap")]
    map: PathBuf,
    /// Threads; 0 takes as many as the machine has
    #[arg(long, global = true, default_value_t = 0, value_name = "N")]
    #[arg(value_parser = threads_parser(), display_order = LAST)]
    threads: usize,
    #[command(subcommand)]
    question: Question,
}

#[derive(Debug, Subcommand)]
enum Question {
    Pair(pair::Args),
    Pairs(pairs::Args),
    VisibleFrom(visible_from::Args),
    SeesCount(sees_count::Args),
    Region(region::Args),
    Ray(ray::Args),
    Shadow(shadow::Args),
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let (path, bytes) = map_file(&args.map)?;
    let map = Map::open(&bytes).map_err(|e| Error::of_query(&path, e))?;
    let asked = Asked { map: &map, path: &path, progress: &context.progress };
    let answer = || match &args.question {
        Question::Pair(args) => pair::run(&asked, args),
        Question::Pairs(args) => pairs::run(&asked, args),
        Question::VisibleFrom(args) => visible_from::run(&asked, args),
        Question::SeesCount(args) => sees_count::run(&asked, args),
        Question::Region(args) => region::run(&asked, args),
        Question::Ray(args) => ray::run(&asked, args),
        Question::Shadow(args) => shadow::run(&asked, args),
    };
    Limits { threads: args.threads, ..Limits::default() }.run(answer)?
}

/// Reads a distance.
fn parse_distance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v >= 0.0 => Ok(v),
        _ => Err(format!("{text:?} is no distance; give a number of 0 or more")),
    }
}

fn snap_of(snap: Option<f64>) -> Snap {
    snap.map_or(Snap::FourHalfSpacings, Snap::Within)
}

fn place(position: [f64; 3], normal: Option<[f64; 3]>) -> Place {
    Place { position, normal: normal.map(|n| n.map(|v| v as f32)) }
}

/// The map that is asked.
struct Asked<'m, 'a> {
    map: &'m Map<'a>,
    path: &'m Path,
    progress: &'m Progress,
}

impl Asked<'_, '_> {
    /// Says which map an error is about.
    fn named<T>(&self, answer: Result<T, QueryError>) -> Result<T, Error> {
        answer.map_err(|e| Error::of_query(self.path, e))
    }

    /// Says whether an error is the row's or the map's.
    fn of_row<T>(&self, answer: Result<T, QueryError>) -> Result<T, RowError> {
        answer.map_err(|e| match e {
            QueryError::Format(e) => RowError::Map(Error::artifact(self.path, e)),
            e => RowError::Row(e.to_string()),
        })
    }

    /// Gives the centroid of a surfel in the scan's units.
    fn centroid(&self, surfel: u32) -> Result<[f64; 3], QueryError> {
        let surfel = self.map.view().surfel(surfel)?;
        Ok(self.map.view().frame().frame.world_of(surfel.centroid))
    }

    /// Prints an answer, and how much was read for it: blocks of 64 KiB, and frames of links.
    fn print_json(&self, mut answer: Value) -> std::io::Result<()> {
        answer["blocks"] = json!(self.map.view().file().n_blocks_read());
        answer["frames"] = json!(self.map.n_frames_decoded());
        print_json(&answer)
    }

    /// Locates a place given on the command line.
    fn locate(&self, place: &Place, snap: Option<f64>) -> Result<Located, Error> {
        self.named(self.map.locate(place, snap_of(snap)))
    }
}

/// Standard output for long answers.
fn stdout() -> BufWriter<Stdout> {
    BufWriter::with_capacity(1 << 16, io::stdout())
}

/// Writes a vector as the command line takes it.
fn commas(v: [f64; 3]) -> String {
    format!("{},{},{}", v[0], v[1], v[2])
}
