//! `pvmap query MAP region`: what do the points around one place see of those around another?

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::Error;
use pvmap::query::{Ball, RegionAnswer, Sight};
use pvmap::rows::RowBlock;
use serde_json::{Value, json};

use super::batch::{self, Batch, Columns, RowError, numbers};
use super::{Asked, Outcome, parse_point};

/// Do the points around one place see those around another: all, some or none?
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The points are those of all surfels whose centres are that near. A fraction is one of pairs: a
point here, a point there. Links that cover many points of both are counted at once.

Input columns of --rows, by name in a header row, in any order, among others that are not read:
  x1 y1 z1 r1 x2 y2 z2 r2       the two places and how far around them, in the scan's units

Output columns:
  sees                          all, some or none, empty where there is no answer
  fraction                      how many of the pairs see each other, 0 to 1
  surfels1 surfels2             surfels around each place
  points1 points2               points around each place
  links                         links that were counted
  error                         why there is no answer

Examples:
  pvmap query grotto.vmap region 1,2,3 0.5 -4,5,6 0.5
  pvmap query grotto.vmap region --rows rows.csv --json")]
pub(super) struct Args {
    /// One place, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X1,Y1,Z1")]
    #[arg(required_unless_present = "rows", requires = "r2")]
    a: Option<[f64; 3]>,
    /// How far around it
    #[arg(value_name = "R1", allow_hyphen_values = true)]
    r1: Option<f64>,
    /// The other place
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X2,Y2,Z2")]
    b: Option<[f64; 3]>,
    /// How far around that
    #[arg(value_name = "R2", allow_hyphen_values = true)]
    r2: Option<f64>,
    /// Answer the rows of a CSV file, or of standard input for -
    #[arg(long, value_name = "ROWS.csv", conflicts_with = "a")]
    rows: Option<PathBuf>,
    /// Answer as one JSON object, or one a line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    let balls = match (args.a, args.r1, args.b, args.r2, &args.rows) {
        (_, _, _, _, Some(rows)) => return table(asked, args, rows),
        (Some(a), Some(r1), Some(b), Some(r2), None) => {
            [Ball { middle: a, radius: r1 }, Ball { middle: b, radius: r2 }]
        }
        _ => {
            let message = "give two places and a radius each, or --rows";
            return Err(Error::Usage(message.to_owned()).into());
        }
    };
    let found = asked.named(asked.map.region(&balls[0], &balls[1]))?;
    if args.json {
        asked.print_json(as_json(&found))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut out = io::stdout().lock();
    writeln!(out, "{}", word(&found))?;
    writeln!(out, "  fraction  {} of all pairs of points", found.sight.share())?;
    writeln!(out, "  surfels   {} and {}", found.n_surfels[0], found.n_surfels[1])?;
    writeln!(out, "  points    {} and {}", found.n_points[0], found.n_points[1])?;
    writeln!(out, "  links     {} counted", found.n_links)?;
    Ok(ExitCode::SUCCESS)
}

fn word(found: &RegionAnswer) -> &'static str {
    match found.sight {
        Sight::All => "all",
        Sight::Part(_) => "some",
        Sight::None => "none",
    }
}

fn as_json(found: &RegionAnswer) -> Value {
    json!({
        "sees": word(found),
        "fraction": found.sight.share(),
        "surfels": found.n_surfels,
        "points": found.n_points,
        // As many as points times points: beyond what JSON numbers hold.
        "visible_pairs": found.n_visible.to_string(),
        "links": found.n_links,
        "nodes": found.n_nodes,
    })
}

fn table(asked: &Asked<'_, '_>, args: &Args, rows: &std::path::Path) -> Outcome {
    let names = ["x1", "y1", "z1", "r1", "x2", "y2", "z2", "r2"];
    let (rows, columns) = batch::open(rows, |header| header.all(names, "x1,y1,z1,r1,x2,y2,z2,r2"))?;
    batch::answer(rows, &Regions { asked, columns }, args.json, asked.progress)
}

struct Regions<'q, 'm, 'a> {
    asked: &'q Asked<'m, 'a>,
    columns: Columns<8>,
}

impl Batch for Regions<'_, '_, '_> {
    type Answer = RegionAnswer;

    const HEADER: &'static str = "sees,fraction,surfels1,surfels2,points1,points2,links,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<RegionAnswer, RowError>> {
        batch::each(rows, |row| {
            let [x1, y1, z1, r1, x2, y2, z2, r2] = numbers(row, &self.columns)?;
            let one = Ball { middle: [x1, y1, z1], radius: r1 };
            let other = Ball { middle: [x2, y2, z2], radius: r2 };
            self.asked.of_row(self.asked.map.region(&one, &other))
        })
    }

    fn write(&self, found: &RegionAnswer, out: &mut Vec<u8>) -> io::Result<()> {
        let ([s1, s2], [p1, p2]) = (found.n_surfels, found.n_points);
        let (word, share) = (word(found), found.sight.share());
        write!(out, "{word},{share},{s1},{s2},{p1},{p2},{},", found.n_links)
    }

    fn object(&self, found: &RegionAnswer) -> Value {
        as_json(found)
    }
}
