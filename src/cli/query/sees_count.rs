//! `pvmap query MAP sees-count`: how many others each surfel sees.

use std::io::Write;
use std::process::ExitCode;

use serde_json::json;

use super::{Asked, Outcome, stdout};

/// How many others does every surfel see?
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Output columns, a row a surfel:
  surfel                        its id
  x y z                         its centre, in the scan's units
  sees                          how many other surfels it sees

Examples:
  pvmap query grotto.vmap sees-count > counts.csv
  pvmap query grotto.vmap sees-count --json")]
pub(super) struct Args {
    /// Answer as a JSON object a line
    #[arg(long)]
    json: bool,
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    let counts = asked.named(pvmap::sees_counts(asked.map, asked.progress))?;
    // On a terminal the answer would stand where the bar is.
    asked.progress.take_stages();
    let mut out = stdout();
    if !args.json {
        writeln!(out, "surfel,x,y,z,sees")?;
    }
    for (id, n) in (0..).zip(counts) {
        let [x, y, z] = asked.named(asked.centroid(id))?;
        if args.json {
            writeln!(out, "{}", json!({ "surfel": id, "place": [x, y, z], "sees": n }))?;
        } else {
            writeln!(out, "{id},{x},{y},{z},{n}")?;
        }
    }
    out.flush()?;
    Ok(ExitCode::SUCCESS)
}
