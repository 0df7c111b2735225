//! `pvmap query MAP visible-from`: all that a place sees.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::query::{Located, Place, QueryError, VisibleSet};
use pvmap::rows::RowBlock;
use pvmap::{Error, Quiet, Watch};
use serde_json::{Value, json};

use super::batch::{self, Batch, RowError};
use super::pairs::PlaceColumns;
use super::{Asked, Outcome, parse_distance, parse_point, place, snap_of, stdout};

/// Which surfels does a place see? That which it lies on is among them
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A place lies on the surfel nearest to it. With --air it is one of a scanner, a camera or an eye in
the air that looks everywhere; then a segment to each surfel decides, and not the links, which may
take some seconds.

Output columns, a row a surfel:
  surfel                        its id
  x y z                         its centre, in the scan's units
  points                        how many points it stands for

Input columns of --rows, by name in a header row, in any order, among others that are not read:
  x y z                         the place, in the scan's units
  nx ny nz                      optional: normals that say which surface is meant

Output columns of --rows, a row an input row:
  surfel distance               the surfel that the place lies on, and how far from it; empty
                                with --air
  seen points                   how many surfels and points are seen
  ranges                        their ids, from-to with semicolons between
  error                         why there is no answer

Examples:
  pvmap query grotto.vmap visible-from 1.5,2,0.3 > seen.csv
  pvmap query grotto.vmap visible-from 1.5,2,1.7 --air > scanned.csv
  pvmap query grotto.vmap visible-from --rows rows.csv --json")]
pub(super) struct Args {
    /// The place, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    #[arg(required_unless_present = "rows")]
    place: Option<[f64; 3]>,
    /// Normal of the surface that the place is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal: Option<[f64; 3]>,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_parser = parse_distance, allow_hyphen_values = true, value_name = "DIST")]
    #[arg(verbatim_doc_comment)]
    snap: Option<f64>,
    /// The place is in the air
    #[arg(long, conflicts_with_all = ["normal", "snap"])]
    air: bool,
    /// Answer the rows of a CSV file, or of standard input for -
    #[arg(long, value_name = "ROWS.csv", conflicts_with_all = ["place", "normal"])]
    rows: Option<PathBuf>,
    /// Answer as one JSON object, or one a line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    let from = match (args.place, &args.rows) {
        (_, Some(rows)) => return table(asked, args, rows),
        (Some(position), None) => place(position, args.normal),
        _ => return Err(Error::Usage("give a place, or --rows".to_owned()).into()),
    };
    let seen = asked.named(look(asked, &from, args, asked.progress))?;
    // On a terminal the answer would stand where the bar is.
    asked.progress.take_stages();
    if args.json {
        let mut object = as_json(&seen);
        object["links"] = json!(seen.found.n_links);
        asked.print_json(object)?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut out = stdout();
    writeln!(out, "surfel,x,y,z,points")?;
    for id in seen.found.surfels.ids() {
        let [x, y, z] = asked.named(asked.centroid(id))?;
        let surfel = asked.named(asked.map.view().surfel(id).map_err(QueryError::from))?;
        writeln!(out, "{id},{x},{y},{z},{}", surfel.n_points)?;
    }
    out.flush()?;
    Ok(ExitCode::SUCCESS)
}

/// What a place sees.
struct Seen {
    /// None in the air.
    from: Option<Located>,
    found: VisibleSet,
}

fn look(
    asked: &Asked<'_, '_>,
    from: &Place,
    args: &Args,
    watch: &dyn Watch,
) -> Result<Seen, QueryError> {
    if args.air {
        let found = pvmap::visible_from_air(asked.map, from.position, watch)?;
        return Ok(Seen { from: None, found });
    }
    let from = asked.map.locate(from, snap_of(args.snap))?;
    let found = asked.map.visible_from(&from)?;
    Ok(Seen { from: Some(from), found })
}

fn as_json(seen: &Seen) -> Value {
    let ranges = seen.found.surfels.ranges().iter();
    json!({
        "surfel": seen.from.map(|from| from.surfel),
        "distance": seen.from.map(|from| from.distance),
        "seen": seen.found.surfels.len(),
        "points": seen.found.n_points,
        "ranges": ranges.map(|r| [r.start, r.end - 1]).collect::<Vec<_>>(),
    })
}

fn table(asked: &Asked<'_, '_>, args: &Args, rows: &Path) -> Outcome {
    let expected = "x,y,z, and nx,ny,nz to choose sides";
    let (rows, columns) = batch::open(rows, |header| {
        PlaceColumns::find(header, ["x", "y", "z"], ["nx", "ny", "nz"], expected)
    })?;
    batch::answer(rows, &Looks { asked, columns, args }, args.json, asked.progress)
}

struct Looks<'q, 'm, 'a> {
    asked: &'q Asked<'m, 'a>,
    columns: PlaceColumns,
    args: &'q Args,
}

impl Batch for Looks<'_, '_, '_> {
    type Answer = Seen;

    const HEADER: &'static str = "surfel,distance,seen,points,ranges,error";

    fn block_rows(&self) -> usize {
        if self.args.air { 1 } else { 64 }
    }

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Seen, RowError>> {
        batch::each(rows, |row| {
            let from = self.columns.read(row)?;
            self.asked.of_row(look(self.asked, &from, self.args, &Quiet))
        })
    }

    fn write(&self, seen: &Seen, out: &mut Vec<u8>) -> io::Result<()> {
        let Seen { from, found } = seen;
        let (n_surfels, n_points) = (found.surfels.len(), found.n_points);
        match from {
            Some(from) => write!(out, "{},{},", from.surfel, from.distance)?,
            None => write!(out, ",,")?,
        }
        write!(out, "{n_surfels},{n_points},")?;
        for (i, range) in found.surfels.ranges().iter().enumerate() {
            let before = if i > 0 { ";" } else { "" };
            write!(out, "{before}{}-{}", range.start, range.end - 1)?;
        }
        write!(out, ",")
    }

    fn object(&self, seen: &Seen) -> Value {
        as_json(seen)
    }
}
