//! The points of the scans, with what the map says of each.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::query::{Place, Snap};
use pvmap::{
    ClosedFile, Error, ExportLight, ExportRequest, Exported, Limits, PlaceAnswer, PointField,
    PointsFile,
};

use super::super::{Context, mib, parse_point};
use super::Args;
use crate::progress::{StageDone, si};

/// The fields without a place.
const PLAIN: [(&str, PointField); 10] = [
    ("sees-count", PointField::SeesCount),
    ("leaf", PointField::Leaf),
    ("level", PointField::Level),
    ("bin", PointField::Bin),
    ("normal", PointField::Normal),
    ("record", PointField::Record),
    ("source", PointField::Source),
    ("radiosity", PointField::Radiosity),
    ("irradiance", PointField::Irradiance),
    ("sky-view", PointField::SkyView),
];

/// Reads a field as help shows it.
pub(super) fn parse_field(text: &str) -> Result<PointField, String> {
    match text.split_once('=') {
        Some(("visible-from", place)) => Ok(PointField::VisibleFrom(parse_place(place)?)),
        Some(("lit", place)) => Ok(PointField::Lit(parse_point(place)?)),
        _ => PLAIN.iter().find(|plain| plain.0 == text).map(|plain| plain.1).ok_or_else(|| {
            format!(
                "{text:?} is no field; write visible-from=x,y,z, lit=x,y,z, {}",
                PLAIN.map(|plain| plain.0).join(", ")
            )
        }),
    }
}

/// Reads `x,y,z` or `x,y,z,nx,ny,nz`.
fn parse_place(text: &str) -> Result<Place, String> {
    let side = text.match_indices(',').nth(2).map(|(at, _)| at);
    let Some(at) = side else { return Ok(Place { position: parse_point(text)?, normal: None }) };
    let refuse = |_| format!("{text:?} is not three numbers or six; write x,y,z or x,y,z,nx,ny,nz");
    let position = parse_point(&text[..at]).map_err(refuse)?;
    let normal = parse_point(&text[at + 1..]).map_err(refuse)?;
    Ok(Place { position, normal: Some(normal.map(|v| v as f32)) })
}

/// Writes the points to a file that has yet to get its name.
pub(super) fn run(
    args: &Args,
    octree: PathBuf,
    output: PointsFile,
    context: &Context,
) -> Result<(Exported, ClosedFile), Error> {
    let request = ExportRequest {
        map: args.map.clone(),
        octree,
        output: args.points.clone().unwrap_or_default(),
        overwrite: args.overwrite,
        fields: args.fields.clone(),
        snap: args.snap.map_or(Snap::FourHalfSpacings, Snap::Within),
        scan: args.scan.clone(),
        light: args.light.clone().map(|file| ExportLight { file, exposure: args.exposure }),
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
    for PlaceAnswer { name, surfel } in &done.places {
        match surfel {
            Some((surfel, distance)) => {
                writeln!(out, "  place     of {name}: surfel {surfel}, {distance} away")?;
            }
            None => writeln!(out, "  place     of {name}: in the air")?,
        }
    }
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
