//! The points of the scans, with what the map says of each.

use std::io::{self, Write};
use std::path::Path;
use std::process::ExitCode;

use pvmap::query::Snap;
use pvmap::{ClosedFile, Error, ExportRequest, Exported, Limits, PointField, PointsFile};

use super::super::{Context, mib, parse_point};
use super::Args;
use crate::progress::{StageDone, si};

/// Reads `visible-from=x,y,z`, `sees-count`, `leaf`, `level` or `bin`.
pub(super) fn parse_field(text: &str) -> Result<PointField, String> {
    match text.split_once('=') {
        Some(("visible-from", place)) => Ok(PointField::VisibleFrom(parse_point(place)?)),
        None if text == "sees-count" => Ok(PointField::SeesCount),
        None if text == "leaf" => Ok(PointField::Leaf),
        None if text == "level" => Ok(PointField::Level),
        None if text == "bin" => Ok(PointField::Bin),
        _ => Err(format!(
            "{text:?} is no field; write visible-from=x,y,z, sees-count, leaf, level or bin"
        )),
    }
}

/// Writes the points to a file that has yet to get its name.
pub(super) fn run(
    args: &Args,
    octree: &Path,
    output: PointsFile,
    context: &Context,
) -> Result<(Exported, ClosedFile), Error> {
    let request = ExportRequest {
        map: args.map.clone(),
        octree: octree.to_path_buf(),
        output: args.points.clone().unwrap_or_default(),
        overwrite: args.overwrite,
        fields: args.fields.clone(),
        snap: args.snap.map_or(Snap::FourHalfSpacings, Snap::Within),
    };
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    pvmap::write_points(&request, output, &limits, &context.progress)
}

/// Says what was done, unless a table went to the same place.
pub(super) fn report(args: &Args, done: &Exported, stages: &[StageDone]) -> io::Result<ExitCode> {
    let tables = [&args.surfels, &args.nodes, &args.links];
    if tables.into_iter().flatten().any(|path| pvmap::is_stdout(path)) {
        return Ok(ExitCode::SUCCESS);
    }
    let seconds: f64 = stages.iter().map(|s| s.seconds).sum();
    let peak = stages.iter().map(|s| s.peak_bytes).max().unwrap_or(0);
    let mut out = io::stdout().lock();
    let name = args.points.as_deref().unwrap_or(Path::new(""));
    writeln!(out, "{}", name.display())?;
    let names = if done.names.is_empty() { "none".to_owned() } else { done.names.join(", ") };
    writeln!(out, "  points    {}; new fields: {names}", done.n_points)?;
    writeln!(
        out,
        "  disk      {} and {} temporary",
        mib(done.output_bytes),
        mib(done.temporary_bytes)
    )?;
    let rate = done.n_points as f64 / seconds.max(1e-9);
    writeln!(
        out,
        "  time      {seconds:.2} s, {} points/s, at most {} of memory",
        si(rate),
        mib(peak)
    )?;
    Ok(ExitCode::SUCCESS)
}
