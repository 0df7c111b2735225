//! How builds grow with the scene: `cargo bench --bench scaling [-- ARGUMENTS]`, see `--help`.
//!
//! Four generated scenes at several sizes, built as `configs/nightly.toml` says, each build in a
//! process of its own, so that its peak of memory is its own. A row a build: points, leaves, leaf
//! pairs, links, bytes, seconds (median of three where that is quick), peak memory, temporary
//! bytes, segments settled by integers over tests, and instructions where asked for.
//! Below it the exponents with which seconds, instructions, links and memory grow with the leaves.
//! All of it goes to a folder as CSV, text and an SVG plot. With `--against` an earlier CSV,
//! 15 % more instructions or a 15 % larger exponent of instructions, links or memory end the run
//! with exit code 1. Run as a test, a few hundred leaves.

use std::error::Error;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use clap::Parser;
use pvmap::config::RawConfig;
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{IngestRequest, Limits, Quiet};

mod support {
    pub(crate) mod compare;
    pub(crate) mod growth;
    pub(crate) mod instructions;
    pub(crate) mod measure;
    pub(crate) mod peak;
    pub(crate) mod plot;
    pub(crate) mod power;
    pub(crate) mod row;
    pub(crate) mod table;
}

use support::growth::{Figure, of_scene};
use support::power::Growth;
use support::row::Row;
use support::{compare, growth, instructions, measure, peak, plot, table};

const CONFIG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/nightly.toml");
/// Builds quicker than this are run three times.
const QUICK_SECONDS: f64 = 2.0;
/// The argument that makes this program measure one build and print it.
const MEASURE: &str = "measure-one-build";
const SEED: u64 = 1;

/// Measure how builds grow with the scene
#[derive(Debug, Parser)]
struct Args {
    /// Where results go
    #[arg(long, value_name = "FOLDER", default_value = "target/scaling")]
    output: PathBuf,
    /// Leaves, about; up to 200000 is sensible
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "N,…",
        default_value = "1000,3000,10000,30000"
    )]
    sizes: Vec<u64>,
    /// Of empty, furnished, packed, cave
    #[arg(long, value_delimiter = ',', default_value = "empty,furnished,packed,cave")]
    scenes: Vec<SceneKind>,
    /// Count instructions, too, of builds up to that size; needs valgrind, and some thirty
    /// times as long
    #[arg(long, value_name = "SIZE", num_args = 0..=1, default_missing_value = "3000")]
    instructions: Option<u64>,
    /// The scaling.csv of an earlier run, to be no worse than
    #[arg(long, value_name = "OLD.csv")]
    against: Option<PathBuf>,
    /// What cargo bench says to every benchmark
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> Result<ExitCode, Box<dyn Error>> {
    let given: Vec<String> = std::env::args().collect();
    if given.get(1).is_some_and(|a| a == MEASURE) {
        return measure_one(Path::new(&given[2]), Path::new(&given[3]));
    }
    if given.iter().any(|a| a == "--bench") {
        return run(&Args::parse());
    }
    // As a test: cargo test's own arguments mean nothing here.
    let folder = tempfile::tempdir()?;
    let output = folder.path().join("scaling");
    let small = ["scaling", "--sizes", "100,300", "--scenes", "empty,furnished", "--output"];
    run(&Args::parse_from(small.into_iter().map(PathBuf::from).chain([output])))
}

fn run(args: &Args) -> Result<ExitCode, Box<dyn Error>> {
    if args.instructions.is_some() && !instructions::can_count() {
        return Err("--instructions needs valgrind; install it or leave them out".into());
    }
    let before = args.against.as_deref().map(table::read).transpose()?;
    std::fs::create_dir_all(&args.output)?;
    let mut rows = Vec::new();
    println!("{}", head());
    for &kind in &args.scenes {
        for &size in &args.sizes {
            let row = measured(kind, size, args)?;
            println!("{}", line(&row));
            rows.push(row);
            // Each row is worth keeping should the next one fail.
            table::write(&args.output.join("scaling.csv"), &rows)?;
        }
    }
    let exponents = exponents(&rows);
    println!("\n{exponents}");
    let lines: Vec<String> = [head()].into_iter().chain(rows.iter().map(line)).collect();
    let text = format!("{}\n\n{exponents}", lines.join("\n"));
    std::fs::write(args.output.join("scaling.txt"), text)?;
    let subtitle = "built as configs/nightly.toml says; dashed: the powers of N that fit best";
    std::fs::write(args.output.join("scaling.svg"), plot::draw(&rows, subtitle))?;
    Ok(judge(&rows, before.as_deref()))
}

/// Compares with an earlier result; a line a finding on stderr.
fn judge(rows: &[Row], before: Option<&[Row]>) -> ExitCode {
    let Some(before) = before else { return ExitCode::SUCCESS };
    let findings = compare::regressions(rows, before);
    for finding in &findings {
        eprintln!("regression: {finding}");
    }
    if findings.is_empty() {
        println!("no worse than the earlier result");
        return ExitCode::SUCCESS;
    }
    ExitCode::FAILURE
}

/// Points per leaf that make the cut come near the sizes asked for. Cells of flat walls fill evenly
/// and are cut all at once, so that leaves come in leaps; these numbers hit the leaps about half
/// way. A cave's leaves are also cut where the rock bends, which makes them smaller.
fn points_a_leaf(kind: SceneKind) -> u64 {
    match kind {
        SceneKind::Empty => 20,
        SceneKind::Furnished => 23,
        SceneKind::Packed => 30,
        SceneKind::Cave => 10,
    }
}

/// Makes a scene's octree and measures builds of it.
fn measured(kind: SceneKind, size: u64, args: &Args) -> Result<Row, Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let [scan, octree, map] = ["s.ply", "s.octree", "s.vmap"].map(|name| folder.path().join(name));
    let request = SceneRequest { n_points: size * points_a_leaf(kind), shuffle: false };
    scenes::write(&Scene::new(kind, SEED), &request, &scan, &Limits::default(), &Quiet)?;
    pvmap::ingest(&IngestRequest::new([scan], octree.clone()), &Limits::default(), &Quiet)?;
    let mut row = in_a_process(&octree, &map)?;
    if row.build_seconds < QUICK_SECONDS && args.bench {
        let more = [in_a_process(&octree, &map)?, in_a_process(&octree, &map)?];
        let all = || more.iter().chain([&row]);
        let visibility_seconds = measure::median(all().map(|r| r.visibility_seconds));
        let build_seconds = measure::median(all().map(|r| r.build_seconds));
        let peak_rss_anon_bytes = all().map(|r| r.peak_rss_anon_bytes).max().unwrap_or(0);
        row = Row { visibility_seconds, build_seconds, peak_rss_anon_bytes, ..row };
    }
    if args.instructions.is_some_and(|largest| size <= largest) {
        let mut build = Command::new(env!("CARGO_BIN_EXE_pvmap"));
        build.args(["build", "--progress", "off", "--config", CONFIG, "-o"]);
        row.instructions = Some(instructions::of(build.args([&map, &octree]))?);
    }
    Ok(Row { scene: kind.name().to_owned(), size, ..row })
}

/// Has one build measured by another process of this program.
fn in_a_process(octree: &Path, map: &Path) -> Result<Row, Box<dyn Error>> {
    let mut command = Command::new(std::env::current_exe()?);
    let output = command.arg(MEASURE).args([octree, map]).output()?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into());
    }
    Ok(serde_json::from_slice(&output.stdout)?)
}

fn measure_one(octree: &Path, map: &Path) -> Result<ExitCode, Box<dyn Error>> {
    let (config, limits) = RawConfig::find(Path::new(CONFIG))?.check()?;
    let (row, peak_rss_anon_bytes) =
        peak::peak_bytes_of(|| measure::build(octree, map, &config, &limits));
    println!("{}", serde_json::to_string(&Row { peak_rss_anon_bytes, ..row? })?);
    Ok(ExitCode::SUCCESS)
}

fn head() -> String {
    format!(
        "{:<10}{:>9}{:>9}{:>16}{:>13}{:>12}{:>11}{:>9}{:>9}{:>11}{:>9}{:>12}",
        "scene",
        "points",
        "leaves",
        "leaf pairs",
        "links",
        "map, KiB",
        "visibility",
        "build",
        "peak",
        "temporary",
        "exact",
        "instruc-"
    ) + &format!("\n{:>80}{:>9}{:>9}{:>11}{:>9}{:>12}", "s", "s", "MiB", "MiB", "%", "tions, M")
}

fn line(row: &Row) -> String {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let millions = |n: u64| format!("{:.0}", n as f64 / 1e6);
    format!(
        "{:<10}{:>9}{:>9}{:>16}{:>13}{:>12.0}{:>11.3}{:>9.3}{:>9.1}{:>11.1}{:>9.4}{:>12}",
        row.scene,
        row.points,
        row.leaves,
        row.leaf_pairs,
        row.links,
        row.map_bytes as f64 / 1024.0,
        row.visibility_seconds,
        row.build_seconds,
        mib(row.peak_rss_anon_bytes),
        mib(row.temporary_bytes),
        100.0 * row.exact_share(),
        row.instructions.map_or("-".to_owned(), millions)
    )
}

/// Writes the exponents with which figures grow with the leaves, a line a scene.
fn exponents(rows: &[Row]) -> String {
    let mut table = format!("{:<28}", "exponent over leaves");
    for figure in Figure::ALL {
        let _ = write!(table, "{:>14}", figure.name());
    }
    for scene in growth::scenes(rows) {
        let _ = write!(table, "\n{scene:<28}");
        for figure in Figure::ALL {
            let growth = Growth::fit(&figure.points(&of_scene(rows, scene)));
            let exponent = growth.map_or("-".to_owned(), |g| format!("{:.2}", g.exponent));
            let _ = write!(table, "{exponent:>14}");
        }
    }
    table.push('\n');
    table
}
