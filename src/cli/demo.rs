//! `pvmap demo`: the whole way on a generated room, with the figures that matter.

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use pvmap::accuracy::{self, Comparison, Drawn, Way};
use pvmap::config::RawConfig;
use pvmap::query::{Map, Place};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::{FormatError, MapView};
use pvmap::{BuildConfig, Built, Error, IngestRequest, Limits, Mapped, StoreError};

use super::build::{fewer_links, square};
use super::{Context, Outcome, mib, parse_count, parse_some};
use crate::progress::StageDone;

/// Go the whole way with a generated room, and print what it took
#[derive(Debug, clap::Args)]
#[command(after_help = "\
It writes a furnished room as a scan, ingests it, builds its map (depth8), verifies that, and
compares answers with the exact geometry. All files are temporary unless --keep is given.

Examples:
  pvmap demo
  pvmap demo --points 100k              a quicker look
  pvmap demo --keep room                the same, and a room to play with")]
pub(super) struct Args {
    /// Points of the room
    #[arg(long, default_value = "400k", value_parser = parse_some, value_name = "N")]
    points: u64,
    /// What the points are drawn from
    #[arg(long, default_value_t = 1, value_name = "S")]
    seed: u64,
    /// Random pairs of points whose answers are compared
    #[arg(long, default_value = "100k", value_parser = parse_count, value_name = "N")]
    pairs: u64,
    /// Build as the paper does too, and compare; takes some minutes
    #[arg(long)]
    paper: bool,
    /// Keep NAME.ply, NAME.octree and NAME.vmap here; none may exist
    #[arg(long, value_name = "NAME")]
    keep: Option<String>,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let folder = tempfile::tempdir()
        .map_err(|e| pvmap::StoreError::io(Path::new("."), "make a temporary folder in", e))?;
    let (base, name) = match &args.keep {
        Some(name) => (Path::new("."), name.as_str()),
        None => (folder.path(), "room"),
    };
    let file = |ending: &str| base.join(format!("{name}.{ending}"));
    let scene = Scene::new(SceneKind::Furnished, args.seed);
    let limits = Limits::default();
    let watch = &context.progress;
    for ending in ["ply", "octree", "vmap", "paper.vmap"] {
        if args.keep.is_some() && file(ending).exists() {
            let reason = "it exists already; keep the demo under another name".to_owned();
            return Err(
                Error::Store(StoreError::CannotCreate { path: file(ending), reason }).into()
            );
        }
    }
    let request = SceneRequest { n_points: args.points, shuffle: false };
    scenes::write(&scene, &request, &file("ply"), &limits, watch)?;
    let ingest = IngestRequest::new([file("ply")], file("octree"));
    pvmap::ingest(&ingest, &limits, watch)?;
    let mut stages = context.progress.take_stages();
    let mut columns = Vec::new();
    let presets: &[&str] = if args.paper { &["depth8", "paper"] } else { &["depth8"] };
    for preset in presets {
        let (config, _) = RawConfig::find(Path::new(preset))?.check()?;
        let map = if *preset == "depth8" { file("vmap") } else { file("paper.vmap") };
        let built = pvmap::build(&file("octree"), &map, &config, &limits, watch)?;
        let sample = try_out(&map, &scene, args, context)?;
        columns.push(Column { preset, config, built, sample });
        if *preset == "depth8" {
            stages.extend(context.progress.take_stages());
        }
    }
    print(args, &columns, &stages)?;
    Ok(ExitCode::SUCCESS)
}

/// What one configuration gave.
struct Column<'a> {
    preset: &'a str,
    config: BuildConfig,
    built: Built,
    sample: Comparison,
}

/// Verifies a map and asks it about random pairs of the scene's points.
fn try_out(
    path: &Path,
    scene: &Scene,
    args: &Args,
    context: &Context,
) -> Result<Comparison, Error> {
    use pvmap::Watch;
    let bytes = Mapped::open(path)?;
    let named = |e: FormatError| Error::artifact(path, e);
    context.progress.stage("verify", None, "bytes");
    MapView::open(&bytes).and_then(|v| v.verify()).map_err(named)?;
    context.progress.advance(bytes.len() as u64);
    context.progress.stage("query", Some(args.pairs), "pairs");
    let map = Map::open(&bytes)?;
    let points = scene.points(args.points);
    let mut draw = |rng: &mut fastrand::Rng| {
        let sample = points.at(rng.u64(..args.points));
        // The file holds f32: what it rounded away must not put a place outside the cube.
        let position = sample.position.map(|v| f64::from(v as f32));
        let place = Place { position, normal: Some(sample.normal) };
        Ok(Drawn { place, sample: Some(sample) })
    };
    let asked = (args.pairs, args.seed);
    let mut ways = [Way::leaves(&map), Way::segments(&map)];
    accuracy::compare(scene, asked, &mut draw, &mut ways, &context.progress)
}

fn print(args: &Args, columns: &[Column<'_>], stages: &[StageDone]) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "A furnished room of {} points (seed {})\n", args.points, args.seed)?;
    let mut row = |name: &str, value: &dyn Fn(&Column<'_>) -> String| {
        write!(out, "{name:<22}")?;
        columns.iter().try_for_each(|c| write!(out, "{:>16}", value(c)))?;
        writeln!(out)
    };
    row("", &|c| c.preset.to_owned())?;
    row("leaves N", &|c| c.built.report.summary.n_surfels.to_string())?;
    row("leaf pairs", &|c| c.built.n_leaf_pairs.to_string())?;
    row("links", &|c| c.built.report.summary.n_links.to_string())?;
    row("links, both ways", &|c| (2 * c.built.report.summary.n_links).to_string())?;
    row("N²", &|c| square(c.built.report.summary.n_surfels).to_string())?;
    row("fewer than N²", &|c| {
        let s = &c.built.report.summary;
        format!("{:.2} %", fewer_links(s.n_links, s.n_surfels))
    })?;
    row("map", &|c| mib(c.built.report.output_bytes))?;
    row("depth", &|c| c.config.max_level.to_string())?;
    row("pairs asked", &|c| c.sample.n_pairs.to_string())?;
    row("agree with truth", &|c| share(c.sample.tallies[0].n_agreeing(), c.sample.n_pairs))?;
    row("truly visible", &|c| share(c.sample.n_visible, c.sample.n_pairs))?;
    row("wrongly visible", &|c| share(c.sample.tallies[0].n_false_visible, c.sample.n_pairs))?;
    row("wrongly invisible", &|c| share(c.sample.tallies[0].n_false_invisible, c.sample.n_pairs))?;
    row("answers a second", &|c| format!("{:.0}", c.sample.rate(&c.sample.tallies[0])))?;
    row("segments agree", &|c| share(c.sample.tallies[1].n_agreeing(), c.sample.n_pairs))?;
    row("answers a second", &|c| format!("{:.0}", c.sample.rate(&c.sample.tallies[1])))?;
    writeln!(out, "\n{:<22}{:>16}{:>16}", "stage (depth8)", "seconds", "peak memory")?;
    for stage in stages {
        writeln!(out, "{:<22}{:>16.2}{:>16}", stage.name, stage.seconds, mib(stage.peak_bytes))?;
    }
    Ok(())
}

fn share(n: u64, of: u64) -> String {
    if of == 0 { "–".to_owned() } else { format!("{:.2} %", 100.0 * n as f64 / of as f64) }
}
