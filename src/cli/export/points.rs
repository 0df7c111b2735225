//! The points of the scans, with what the map says of each.

use std::io::Write;
use std::path::Path;

use pvmap::query::Snap;
use pvmap::{ExportRequest, Limits, PointField};

use super::super::{Context, mib, parse_point};
use super::Args;
use crate::progress::si;

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

/// Writes the points, and says what was done unless a table goes to the same place.
pub(super) fn run(
    args: &Args,
    octree: &Path,
    output: &Path,
    context: &Context,
) -> anyhow::Result<()> {
    let request = ExportRequest {
        map: args.map.clone(),
        octree: octree.to_path_buf(),
        output: output.to_path_buf(),
        fields: args.fields.clone(),
        snap: args.snap.map_or(Snap::FourHalfSpacings, Snap::Within),
    };
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    let done = pvmap::export_points(&request, &limits, &context.progress)?;
    let stages = context.progress.take_stages();
    let tables = [&args.surfels, &args.nodes, &args.links];
    if tables.into_iter().flatten().any(|path| pvmap::is_stdout(path)) {
        return Ok(());
    }
    let seconds: f64 = stages.iter().map(|s| s.seconds).sum();
    let peak = stages.iter().map(|s| s.peak_bytes).max().unwrap_or(0);
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", output.display())?;
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
    Ok(())
}
