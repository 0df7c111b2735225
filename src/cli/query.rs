//! `pvmap query`: ask a map.

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Subcommand;
use pvmap::Error;
use pvmap::query::{Located, Map, PairAnswer, Place, QueryError, Snap};
use pvmap::rows::Rows;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::{Outcome, map_file, parse_point, print_json};

/// Ask a map
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Coordinates are in the scan's units, as pvmap info shows its origin and extent; they may begin
with a minus. pvmap query MAP pair --help tells all of a question.

Examples:
  pvmap query grotto.vmap pair 1,2,3 -4,5,6       yes (exit 0) or no (exit 1)
  pvmap query grotto.vmap pairs rows.csv          a row an answer
  cat rows.csv | pvmap query grotto.vmap pairs - --json")]
pub(super) struct Args {
    /// The map, as pvmap build makes it
    #[arg(value_name = "NAME.vmap")]
    map: PathBuf,
    #[command(subcommand)]
    question: Question,
}

#[derive(Debug, Subcommand)]
enum Question {
    Pair(PairArgs),
    Pairs(PairsArgs),
}

/// Do two places see each other? Exit 0 for yes, 1 for no
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A place is answered for by the surfel (the disc that stands for some points) nearest to it. Where
two surfaces meet, at an edge or in a thin wall, a normal says which of them is meant; it need
not have length 1.

Answer:
  yes or no
  surfels   which surfels the places lie on
  distances how far from them, in the scan's units
  link      the two nodes that settle it, where the answer is yes
  settles   how many points lie in each of them: all of these see each other

Examples:
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6 --normal1 0,0,1 --snap 0.2 --json")]
struct PairArgs {
    /// One place, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X1,Y1,Z1")]
    a: [f64; 3],
    /// The other
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X2,Y2,Z2")]
    b: [f64; 3],
    /// Normal of the surface that the first place is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal1: Option<[f64; 3]>,
    /// Normal of the surface that the other is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal2: Option<[f64; 3]>,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_name = "DIST", verbatim_doc_comment)]
    snap: Option<f64>,
    /// Answer as one JSON object
    #[arg(long)]
    json: bool,
}

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
  error                         why there is no answer

It ends with 0 once every row is answered, and with 65 at a row that is no text or longer than
64 KiB.

Examples:
  pvmap query grotto.vmap pairs rows.csv > answers.csv
  printf 'x1,y1,z1,x2,y2,z2\\n1,2,3,-4,5,6\\n' | pvmap query grotto.vmap pairs -")]
struct PairsArgs {
    /// A CSV file with a header row, or - for standard input
    #[arg(value_name = "ROWS.csv")]
    rows: PathBuf,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_name = "DIST", verbatim_doc_comment)]
    snap: Option<f64>,
    /// Answer as a JSON object a line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let (path, bytes) = map_file(&args.map)?;
    let map = Map::open(&bytes).map_err(|e| named(&path, e))?;
    match &args.question {
        Question::Pair(pair) => answer_pair(&map, &path, pair),
        Question::Pairs(pairs) => answer_pairs(&map, &path, pairs),
    }
}

/// Says which map an error is about, where it is about the map.
fn named(path: &Path, e: QueryError) -> Error {
    match e {
        QueryError::Format(e) => Error::artifact(path, e),
        e => Error::Query(e),
    }
}

fn snap_of(snap: Option<f64>) -> Snap {
    snap.map_or(Snap::FourHalfSpacings, Snap::Within)
}

/// Two located places and what the map says of them.
type Answer = (Located, Located, PairAnswer);

fn ask(map: &Map<'_>, a: &Place, b: &Place, snap: Snap) -> Result<Answer, QueryError> {
    let (a, b) = (map.locate(a, snap)?, map.locate(b, snap)?);
    let answer = map.pair(&a, &b)?;
    Ok((a, b, answer))
}

fn answer_pair(map: &Map<'_>, path: &Path, args: &PairArgs) -> Outcome {
    let place = |position, normal: Option<[f64; 3]>| Place {
        position,
        normal: normal.map(|n| n.map(|v| v as f32)),
    };
    let (a, b) = (place(args.a, args.normal1), place(args.b, args.normal2));
    let (a, b, answer) = ask(map, &a, &b, snap_of(args.snap)).map_err(|e| named(path, e))?;
    if args.json {
        print_json(&as_json(&a, &b, &answer))?;
    } else {
        let mut out = io::stdout().lock();
        writeln!(out, "{}", if answer.visible { "yes" } else { "no" })?;
        writeln!(out, "  surfels   {} and {}", a.surfel, b.surfel)?;
        writeln!(out, "  distances {} and {}", a.distance, b.distance)?;
        match &answer.link {
            Some(link) => {
                let ((na, nb), (pa, pb)) = (link.nodes, link.n_points);
                writeln!(out, "  link      nodes {na} and {nb}")?;
                writeln!(out, "  settles   {pa} points on one side, {pb} on the other")?;
            }
            None if answer.visible => writeln!(out, "  link      none: both lie on one surfel")?,
            None => {}
        }
    }
    Ok(ExitCode::from(u8::from(!answer.visible)))
}

fn as_json(a: &Located, b: &Located, answer: &PairAnswer) -> Value {
    let link = answer.link.as_ref().map(|link| {
        json!({
            "nodes": [link.nodes.0, link.nodes.1],
            "points": [link.n_points.0, link.n_points.1],
        })
    });
    json!({
        "visible": answer.visible,
        "surfel1": a.surfel,
        "surfel2": b.surfel,
        "distance1": a.distance,
        "distance2": b.distance,
        "link": link,
    })
}

/// Rows answered at once, and their bytes where rows are long.
const CHUNK_ROWS: usize = 1 << 16;
const CHUNK_BYTES: usize = 16 << 20;

fn answer_pairs(map: &Map<'_>, path: &Path, args: &PairsArgs) -> Outcome {
    let mut rows = Rows::open(&args.rows)?;
    let columns = Columns::find(rows.header())
        .map_err(|what| Error::Data(format!("{}: {what}", rows.name().display())))?;
    let mut out = BufWriter::with_capacity(1 << 16, io::stdout().lock());
    if !args.json {
        writeln!(out, "visible,surfel1,surfel2,distance1,distance2,error")?;
    }
    let snap = snap_of(args.snap);
    loop {
        let (chunk, ended) = next_chunk(&mut rows);
        let refuse = |e: QueryError| match e {
            QueryError::Format(e) => RowError::Map(Error::artifact(path, e)),
            e => RowError::Row(e.to_string()),
        };
        let locate = |row: &csv::StringRecord| {
            let (a, b) = columns.places(row)?;
            let located = |place| map.locate(place, snap).map_err(refuse);
            Ok((located(&a)?, located(&b)?))
        };
        let located: Vec<Result<_, RowError>> = chunk.par_iter().map(locate).collect();
        let questions: Vec<(Located, Located)> =
            located.iter().filter_map(|row| row.as_ref().ok().copied()).collect();
        let mut answers = map.pairs(&questions).into_iter();
        for row in located {
            let answer = row.and_then(|(a, b)| {
                let answer = answers.next().expect("one for each located row");
                Ok((a, b, answer.map_err(refuse)?))
            });
            write_row(&mut out, answer, args.json)?;
        }
        // The rows before one that cannot be read have their answers.
        if let Some(ended) = ended {
            out.flush()?;
            return Ok(ended?);
        }
    }
}

/// Reads some rows; at the end of the table also how it ended, well or with a row that cannot be
/// read.
fn next_chunk(rows: &mut Rows) -> (Vec<csv::StringRecord>, Option<Result<ExitCode, Error>>) {
    let (mut chunk, mut n_bytes) = (Vec::new(), 0);
    while chunk.len() < CHUNK_ROWS && n_bytes < CHUNK_BYTES {
        match rows.read() {
            Ok(Some(row)) => {
                n_bytes += row.as_slice().len();
                chunk.push(row);
            }
            Ok(None) => return (chunk, Some(Ok(ExitCode::SUCCESS))),
            Err(e) => return (chunk, Some(Err(e))),
        }
    }
    (chunk, None)
}

/// Why a row has no answer: because of the row, or because of the map.
enum RowError {
    Row(String),
    Map(Error),
}

impl From<String> for RowError {
    fn from(what: String) -> RowError {
        RowError::Row(what)
    }
}

fn write_row(
    out: &mut impl Write,
    answer: Result<Answer, RowError>,
    as_lines: bool,
) -> anyhow::Result<()> {
    match answer {
        Err(RowError::Map(e)) => return Err(e.into()),
        Ok((a, b, answer)) if as_lines => writeln!(out, "{}", as_json(&a, &b, &answer))?,
        Ok((a, b, answer)) => writeln!(
            out,
            "{},{},{},{},{},",
            u8::from(answer.visible),
            a.surfel,
            b.surfel,
            a.distance,
            b.distance
        )?,
        Err(RowError::Row(what)) if as_lines => writeln!(out, "{}", json!({ "error": what }))?,
        Err(RowError::Row(what)) => writeln!(out, ",,,,,\"{}\"", what.replace('"', "\"\""))?,
    }
    Ok(())
}

/// Where the columns of a pairs table are.
struct Columns {
    places: [[usize; 3]; 2],
    normals: [Option<[usize; 3]>; 2],
}

impl Columns {
    fn find(header: &csv::StringRecord) -> Result<Columns, String> {
        let column = |name: String| -> Result<Option<usize>, String> {
            let mut found = header.iter().enumerate().filter(|(_, h)| **h == name);
            match (found.next(), found.next()) {
                (_, Some(_)) => Err(format!("column {name} stands twice in the header row")),
                (first, None) => Ok(first.map(|(i, _)| i)),
            }
        };
        let three = |prefix: &str, side: u8| -> Result<[Option<usize>; 3], String> {
            let named = |axis: &str| column(format!("{prefix}{axis}{side}"));
            Ok([named("x")?, named("y")?, named("z")?])
        };
        let whole = |prefix: &str, side: u8, found: [Option<usize>; 3]| match found {
            [Some(x), Some(y), Some(z)] => Ok([x, y, z]),
            [x, y, _] => {
                let axis = if x.is_none() {
                    "x"
                } else if y.is_none() {
                    "y"
                } else {
                    "z"
                };
                Err(format!(
                    "no column {prefix}{axis}{side}; the header row is x1,y1,z1,x2,y2,z2, and \
                     nx1,ny1,nz1,nx2,ny2,nz2 to choose sides"
                ))
            }
        };
        let place = |side| whole("", side, three("", side)?);
        let normal = |side| match three("n", side)? {
            [None, None, None] => Ok(None),
            found => whole("n", side, found).map(Some),
        };
        Ok(Columns { places: [place(1)?, place(2)?], normals: [normal(1)?, normal(2)?] })
    }

    fn places(&self, row: &csv::StringRecord) -> Result<(Place, Place), String> {
        let number = |i: usize, name: &str, side: usize| {
            let text = row.get(i).unwrap_or_default();
            let refuse = |_| format!("{name}{} is {text:?}, expected a number", side + 1);
            text.parse::<f64>().map_err(refuse)
        };
        let three = |at: [usize; 3], [x, y, z]: [&str; 3], side| {
            Ok::<_, String>([
                number(at[0], x, side)?,
                number(at[1], y, side)?,
                number(at[2], z, side)?,
            ])
        };
        let place = |side: usize| {
            let normal = match self.normals[side] {
                // Empty cells: this row does not choose a side.
                Some(at) if at.iter().any(|&i| !row.get(i).unwrap_or_default().is_empty()) => {
                    Some(three(at, ["nx", "ny", "nz"], side)?.map(|v| v as f32))
                }
                _ => None,
            };
            let position = three(self.places[side], ["x", "y", "z"], side)?;
            Ok::<_, String>(Place { position, normal })
        };
        Ok((place(0)?, place(1)?))
    }
}
