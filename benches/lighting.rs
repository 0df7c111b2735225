//! What light costs and how it grows: `cargo bench --bench lighting [-- ARGUMENTS]`, see `--help`.
//!
//! The furnished Cornell room, albedo 0.7 and a lamp in its ceiling, of which a path tracer knows
//! the irradiance at 256 places (`tests/reference`): maps of several depths and capacities, each
//! lit by grids of orders 1 to 5, pair by pair, and as three errors ask for. A row a light:
//! processor seconds of the map and of the light, surfels, links, and how far the irradiance of
//! the places, interpolated as exports do, is from the path tracer's. With `--scale` instead how
//! light grows with the surfels of empty and furnished rooms, each in a process of its own, and the
//! exponents. Both go to a folder as CSV, the former as an SVG plot, too. Run as a test, a few
//! thousand points.
//!
//! Seconds are of processors, all threads together, where a column does not say otherwise: they
//! tell less of what else was running.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{IngestRequest, Limits, Quiet};

mod support {
    pub(crate) mod light_cost;
    pub(crate) mod light_growth;
    pub(crate) mod light_plot;
    pub(crate) mod peak;
    pub(crate) mod power;
    pub(crate) mod processor;
}

#[path = "../tests/reference/mod.rs"]
mod reference;

use support::processor::BENCH;
use support::{light_cost, light_growth};

/// The lamp of the path tracer in the ceiling, by its flux: surfels across its edge count whole.
/// 10 · 1.3 m · 1.05 m.
const LIGHTS: &str = "\
[albedo]
from = 0.7
[[glow]]
box = [2.1, 2.225, 5.49, 3.4, 3.275, 5.51]
flux = 13.65
";
/// Another lamp in the same room: a part of the floor.
const OTHER_LIGHTS: &str = "\
[albedo]
from = 0.7
[[glow]]
box = [0.5, 0.5, -0.01, 1.5, 1.5, 0.01]
flux = 20
";
const SEED: u64 = 1;

/// Measure what light costs
#[derive(Debug, Parser)]
struct Args {
    /// Where results go
    #[arg(long, value_name = "FOLDER", default_value = "target/lighting")]
    output: PathBuf,
    /// Measure how light grows with the surfels instead
    #[arg(long)]
    scale: bool,
    /// Draw the plot of an earlier cornell.csv again, and measure nothing
    #[arg(long, value_name = "OLD.csv")]
    redraw: Option<PathBuf>,
    /// Deepest levels of the maps
    #[arg(long, value_delimiter = ',', value_name = "L,…", default_value = "5,6,7,8")]
    levels: Vec<u8>,
    /// Points of the room; of all rooms, with --scale
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    points: Vec<u64>,
    /// What cargo bench says to every benchmark
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<ExitCode, Box<dyn Error>> {
    let given: Vec<String> = std::env::args().collect();
    if given.get(1).is_some_and(|a| a == light_growth::MEASURE) {
        light_growth::measure_one(Path::new(&given[2]))?;
        return Ok(ExitCode::SUCCESS);
    }
    if given.iter().any(|a| a == BENCH) {
        run(&Args::parse())?;
        return Ok(ExitCode::SUCCESS);
    }
    // As a test: cargo test's own arguments mean nothing here.
    let folder = tempfile::tempdir()?;
    for (scale, points) in [(false, vec![40_000]), (true, vec![20_000, 40_000])] {
        let output = folder.path().to_owned();
        run(&Args { output, scale, redraw: None, levels: vec![5], points, bench: false })?;
    }
    let curve = || std::fs::read_to_string(folder.path().join("cornell.svg"));
    let drawn = curve()?;
    assert!(drawn.ends_with("</svg>\n"), "a drawing without an end");
    light_cost::redraw(&folder.path().join("cornell.csv"), folder.path())?;
    assert!(curve()? == drawn, "another drawing of the same table");
    Ok(ExitCode::SUCCESS)
}

fn run(args: &Args) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(&args.output)?;
    let points = |usual: &[u64]| match args.points.is_empty() {
        true => usual.to_vec(),
        false => args.points.clone(),
    };
    if let Some(table) = &args.redraw {
        return light_cost::redraw(table, &args.output);
    }
    match args.scale {
        true => light_growth::run(&args.output, &points(&light_growth::POINTS)),
        false => {
            for n_points in points(&[light_cost::POINTS]) {
                light_cost::run(&args.output, n_points, &args.levels)?;
            }
            Ok(())
        }
    }
}

/// Makes the octree of a room.
fn octree_of(kind: SceneKind, n_points: u64, folder: &Path) -> Result<PathBuf, Box<dyn Error>> {
    let [scan, octree] = ["s.ply", "s.octree"].map(|name| folder.join(name));
    let request = SceneRequest { n_points, shuffle: false };
    scenes::write(&Scene::new(kind, SEED), &request, &scan, &Limits::default(), &Quiet)?;
    pvmap::ingest(&IngestRequest::new([scan.clone()], octree.clone()), &Limits::default(), &Quiet)?;
    std::fs::remove_file(scan)?;
    Ok(octree)
}
