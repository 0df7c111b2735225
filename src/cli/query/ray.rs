//! `pvmap query MAP ray`: what does a ray hit first?

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::Error;
use pvmap::query::{Located, Place, QueryError, RayAnswer};
use pvmap::rows::RowBlock;
use serde_json::{Value, json};

use super::batch::{self, Batch, Columns, RowError, numbers};
use super::pairs::PlaceColumns;
use super::{Asked, Outcome, commas, parse_distance, parse_point, place, snap_of};

/// What does a ray hit first?
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A ray from a place on a surface hits the first of the surfels that are seen from there, as the map
has them; a ray from the air, the first of all. --air takes every place for one in the air.

Input columns of --rows, by name in a header row, in any order, among others that are not read:
  x y z dx dy dz                origin and direction, in the scan's units
  nx ny nz                      optional: normals that say which surface the origin is on

Output columns:
  hit                           0 or 1, empty where there is no answer
  surfel distance               what is hit and how far from the origin, in the scan's units
  x y z nx ny nz                where, and the normal there, of length 1
  from                          the surfel that the origin is on, empty in the air
  error                         why there is no answer

Examples:
  pvmap query grotto.vmap ray 1,2,3 0,0,-1
  pvmap query grotto.vmap ray --rows rows.csv --air > hits.csv")]
pub(super) struct Args {
    /// Where the ray begins, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    #[arg(required_unless_present = "rows", requires = "direction")]
    origin: Option<[f64; 3]>,
    /// Where it goes; any length
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "DX,DY,DZ")]
    direction: Option<[f64; 3]>,
    /// Normal of the surface that the origin is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal: Option<[f64; 3]>,
    /// How far from a surface the origin may be to be on it, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_parser = parse_distance, allow_hyphen_values = true, value_name = "DIST")]
    #[arg(verbatim_doc_comment)]
    snap: Option<f64>,
    /// Rays begin in the air, however near to a surface
    #[arg(long, conflicts_with_all = ["snap", "normal"])]
    air: bool,
    /// Answer the rows of a CSV file, or of standard input for -
    #[arg(long, value_name = "ROWS.csv", conflicts_with_all = ["origin", "normal"])]
    rows: Option<PathBuf>,
    /// Answer as one JSON object, or one a line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    let (origin, direction) = match (args.origin, args.direction, &args.rows) {
        (_, _, Some(rows)) => return table(asked, args, rows),
        (Some(origin), Some(direction), None) => (origin, direction),
        _ => return Err(Error::Usage("give an origin and a direction, or --rows".into()).into()),
    };
    let (from, found) = asked.named(shoot(asked, args, &place(origin, args.normal), direction))?;
    if args.json {
        asked.print_json(as_json(&from, &found))?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut out = io::stdout().lock();
    match &found.hit {
        Some(hit) => {
            writeln!(out, "hit")?;
            writeln!(out, "  surfel    {}", hit.surfel)?;
            writeln!(out, "  distance  {}", hit.distance)?;
            writeln!(out, "  place     {}", commas(hit.place))?;
            writeln!(out, "  normal    {}", commas(hit.normal))?;
        }
        None => writeln!(out, "nothing")?,
    }
    match from {
        Some(from) => writeln!(out, "  from      surfel {}", from.surfel)?,
        None => writeln!(out, "  from      the air")?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Where a ray began, if on a surfel, and what it hit.
type Shot = (Option<Located>, RayAnswer);

fn shoot(
    asked: &Asked<'_, '_>,
    args: &Args,
    origin: &Place,
    direction: [f64; 3],
) -> Result<Shot, QueryError> {
    let from = match args.air {
        true => None,
        false => asked.map.surface_at(origin, snap_of(args.snap))?,
    };
    Ok((from, asked.map.ray(origin.position, direction, from.as_ref())?))
}

fn as_json(from: &Option<Located>, found: &RayAnswer) -> Value {
    let hit = found.hit.as_ref().map(|hit| {
        json!({
            "surfel": hit.surfel,
            "distance": hit.distance,
            "place": hit.place,
            "normal": hit.normal,
        })
    });
    json!({
        "hit": hit,
        "from": from.as_ref().map(|from| from.surfel),
        "nodes": found.n_nodes,
        "surfels": found.n_surfels,
    })
}

fn table(asked: &Asked<'_, '_>, args: &Args, rows: &Path) -> Outcome {
    let expected = "x,y,z,dx,dy,dz, and nx,ny,nz to choose sides";
    let (rows, (origin, direction)) = batch::open(rows, |header| {
        let origin = PlaceColumns::find(header, ["x", "y", "z"], ["nx", "ny", "nz"], expected)?;
        Ok((origin, header.all(["dx", "dy", "dz"], expected)?))
    })?;
    batch::answer(rows, &Rays { asked, args, origin, direction }, args.json, asked.progress)
}

struct Rays<'q, 'm, 'a> {
    asked: &'q Asked<'m, 'a>,
    args: &'q Args,
    origin: PlaceColumns,
    direction: Columns<3>,
}

impl Batch for Rays<'_, '_, '_> {
    type Answer = Shot;

    const HEADER: &'static str = "hit,surfel,distance,x,y,z,nx,ny,nz,from,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Shot, RowError>> {
        batch::each(rows, |row| {
            let (origin, direction) = (self.origin.read(row)?, numbers(row, &self.direction)?);
            self.asked.of_row(shoot(self.asked, self.args, &origin, direction))
        })
    }

    fn write(&self, (from, found): &Shot, out: &mut Vec<u8>) -> io::Result<()> {
        match &found.hit {
            Some(hit) => {
                let (x, n) = (commas(hit.place), commas(hit.normal));
                write!(out, "1,{},{},{x},{n},", hit.surfel, hit.distance)?;
            }
            None => write!(out, "0,,,,,,,,,")?,
        }
        match from {
            Some(from) => write!(out, "{},", from.surfel),
            None => write!(out, ","),
        }
    }

    fn object(&self, (from, found): &Shot) -> Value {
        as_json(from, found)
    }
}
