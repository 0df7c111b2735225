//! How light grows: `cargo bench --bench lighting [-- ARGUMENTS]`, see `--help`.
//!
//! Empty and furnished Cornell rooms of more and more points, albedo 0.7 and a lamp in the ceiling,
//! each lit in a process of its own: what the light takes, its parts, another lamp for the same
//! map, memory, and the exponents in the surfels. A row a light goes to a folder as CSV. What light
//! costs for an error says `pvmap tradeoff --lights`. Run as a test, a few thousand points.
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
    pub(crate) mod light_growth;
    pub(crate) mod peak;
    pub(crate) mod power;
    pub(crate) mod processor;
}

use support::light_growth;
use support::processor::BENCH;

/// The lamp of the path tracer in the ceiling.
const LIGHTS: &str = include_str!("../tests/reference/grey.toml");
/// Another lamp in the same room: a part of the floor.
const OTHER_LIGHTS: &str = "\
[albedo]
from = 0.7
[[glow]]
box = [0.5, 0.5, -0.01, 1.5, 1.5, 0.01]
flux = 20
";
const SEED: u64 = 1;

/// Measure how light grows with the surfels
#[derive(Debug, Parser)]
struct Args {
    /// Where the table goes
    #[arg(long, value_name = "FOLDER", default_value = "target/lighting")]
    output: PathBuf,
    /// Points of the rooms
    #[arg(long, value_delimiter = ',', value_name = "N,…", default_values_t = light_growth::POINTS)]
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
        let args = Args::parse();
        run(&args.output, &args.points)?;
        return Ok(ExitCode::SUCCESS);
    }
    // As a test: cargo test's own arguments mean nothing here.
    let folder = tempfile::tempdir()?;
    run(folder.path(), &[20_000, 40_000])?;
    Ok(ExitCode::SUCCESS)
}

fn run(output: &Path, points: &[u64]) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(output)?;
    light_growth::run(output, points)
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
