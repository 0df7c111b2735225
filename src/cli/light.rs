//! `pvmap light`: the light of every surfel of a map.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::light::{Effect, LightOptions, Wishes};
use pvmap::vmap::octree::FILE_NAME;
use pvmap::{LightDone, LightReport, LightRequest, Limits, Watch};

use super::{Context, Outcome, mib, refuse_input, threads_parser};
use crate::progress::StageDone;

/// Light a map: radiosity of all its surfels
#[derive(Debug, clap::Args)]
#[command(after_help = "\
What shines and what reflects stands in a TOML file, colours as one number or [r, g, b] in linear
light or \"#rrggbb\", places in the scan's units:
  [albedo]                      what surfaces reflect
  from = \"scan\"                 the scan's colours, or a number or colour for all
  [[glow]]                      a part of the scan that shines
  box = [2, 2, 5.4, 3.5, 3.5, 5.6]    or sphere, class, color with within, near
  exitance = 12                 flux an area, or flux = 100 in all
  [[material]]                  what a part of the scan is, the same choices or all = true
  near = [1, 2, 0.5]
  albedo = 0.1
  specular = 0.8                also transmissive and refraction
  [[point]]                     lights that are no part of the scan: point, spot, area
  position = [2, 2, 3]
  flux = 50
  [sun]
  azimuth = 135                 degrees clockwise from +y; elevation above the horizon
  elevation = 40
  irradiance = 3
  [sky]
  radiance = [0.2, 0.3, 0.5]

Before anything is solved it is planned which effects the scene calls for, each with its evidence,
the most that is left out without it (a share of all emitted flux) and its cost; --plan stops there.
Effects: direct, sky, occlusion, bounces, color, mirror-view, refraction, caustics,
diffuse-specular-diffuse, near-field, order.

The result says of every surfel what it emits (E), what arrives (H) and what leaves it
(B = E + albedo H), flux an area in the unit of the lights. The same map and lights give the same
bytes, whatever the threads.

Examples:
  pvmap light room.vmap --lights lights.toml                  makes room.light
  pvmap light room.vmap --lights lights.toml --plan           what it takes, and why
  pvmap light room.vmap --lights evening.toml --scale-of room.light -o evening.light
  pvmap render room.vmap --light room.light --octree room.octree -o lit.png")]
pub(super) struct Args {
    /// The map
    #[arg(value_name = "NAME.vmap")]
    map: PathBuf,
    /// What shines and what reflects, see below
    #[arg(long, value_name = "FILE.toml")]
    lights: PathBuf,
    /// The octree of the map, for rules by class
    #[arg(long, value_name = "NAME.octree")]
    octree: Option<PathBuf>,
    /// The file to make, or replace [default: the map's name with .light, in
    /// the current directory]
    #[arg(short, long, value_name = "NAME.light", verbatim_doc_comment)]
    output: Option<PathBuf>,
    /// How much light may be wrong: 1%, 0.01
    #[arg(long, default_value = "1%", value_parser = parse_share, value_name = "E")]
    error: f64,
    /// Plan and stop: what the scene calls for, and why
    #[arg(long)]
    plan: bool,
    /// Compute an effect, whatever the scene calls for; as often as wanted
    #[arg(long, value_name = "EFFECT", value_parser = parse_effect)]
    force: Vec<Effect>,
    /// Leave an effect out, whatever the scene calls for
    #[arg(long, value_name = "EFFECT", value_parser = parse_effect)]
    no: Vec<Effect>,
    /// Take over the scaling of an earlier light file of this map: quicker
    #[arg(long, value_name = "OLD.light")]
    scale_of: Option<PathBuf>,
    /// Multipoles of this order, 1 to 7 [default: what the error asks for]
    #[arg(
        long,
        value_name = "P",
        value_parser = clap::value_parser!(u8).range(1..=7),
        conflicts_with = "direct"
    )]
    order: Option<u8>,
    /// Take all pairs of surfels one by one: slow, and as exact as it gets
    #[arg(long)]
    direct: bool,
    /// Threads; 0 takes as many as the machine has
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = threads_parser())]
    threads: usize,
    /// Most memory to hold, at least 64MiB
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let output = match &args.output {
        Some(output) => output.clone(),
        None => default_output(&args.map),
    };
    let octree = args.octree.iter().map(|folder| folder.join(FILE_NAME));
    let inputs: Vec<PathBuf> =
        [args.map.clone(), args.lights.clone()].into_iter().chain(octree).collect();
    refuse_input(&output, &inputs)?;
    let request = LightRequest {
        map: args.map.clone(),
        octree: args.octree.clone(),
        lights: args.lights.clone(),
        output: (!args.plan).then(|| output.clone()),
        scale_of: args.scale_of.clone(),
        options: LightOptions {
            error: args.error,
            is_direct: args.direct,
            order: args.order.map(usize::from),
            wishes: wishes(args),
            ..LightOptions::default()
        },
    };
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    let report = pvmap::light_map(&request, &limits, &context.progress)?;
    for note in &report.notes {
        context.progress.note(&format!("{}: {note}", args.lights.display()));
    }
    print(&output, &report, &context.progress.take_stages())?;
    Ok(ExitCode::SUCCESS)
}

fn wishes(args: &Args) -> Wishes {
    let mut wishes = Wishes::default();
    args.force.iter().for_each(|&effect| wishes.set(effect, true));
    args.no.iter().for_each(|&effect| wishes.set(effect, false));
    wishes
}

fn default_output(map: &Path) -> PathBuf {
    PathBuf::from(map.file_name().unwrap_or(map.as_os_str())).with_extension("light")
}

/// Reads a share: `1%` or `0.01`.
fn parse_share(text: &str) -> Result<f64, String> {
    let (number, by) = match text.strip_suffix('%') {
        Some(number) => (number, 0.01),
        None => (text, 1.0),
    };
    let share = number.trim().parse::<f64>().map(|v| v * by).ok();
    share
        .filter(|share| *share > 0.0 && *share < 1.0)
        .ok_or_else(|| format!("{text:?} is no share above 0 and below 1; write 1% or 0.01"))
}

fn parse_effect(text: &str) -> Result<Effect, String> {
    Effect::of_name(text).ok_or_else(|| {
        let names = Effect::ALL.map(Effect::name);
        format!("{text:?} is no effect; there are {}", names.join(", "))
    })
}

fn print(output: &Path, report: &LightReport, stages: &[StageDone]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    write!(out, "{}", report.plan)?;
    let Some(done) = &report.done else { return Ok(()) };
    let LightDone { summary, work, output_bytes } = done;
    writeln!(out, "{}", output.display())?;
    let without = match report.n_without_normal {
        0 => String::new(),
        n => format!("; {n} without a normal take no part"),
    };
    writeln!(out, "  surfels   {}, {} channels{without}", report.n_surfels, summary.n_channels)?;
    let by = match summary.order {
        0 => "pair by pair".to_owned(),
        p => {
            format!("multipoles of order {p}, off by {:.1e} at 64 surfels", summary.operator_error)
        }
    };
    writeln!(
        out,
        "  light     {by}; rows within {:.1e}, {} iterations to {:.1e}",
        summary.row_error, summary.iterations, summary.residual
    )?;
    let of = |index: usize| summary.balance.iter().map(|row| row[index]).sum::<f64>();
    let share = |flux: f64| 100.0 * flux / of(0).max(f64::MIN_POSITIVE);
    writeln!(
        out,
        "  flux      {:.6} emitted: {:.2} % absorbed, {:.2} % escaped",
        of(0),
        share(of(1)),
        share(of(2))
    )?;
    writeln!(
        out,
        "  work      {} applications, {} segments to lamps, {} to the sky, {} near pairs",
        work.n_applications, work.n_lamp_segments, work.n_sky_segments, work.n_near_field
    )?;
    if work.n_photons > 0 {
        writeln!(out, "            {} photons by way of mirrors and lenses", work.n_photons)?;
    }
    writeln!(out, "  disk      {}", mib(*output_bytes))?;
    let seconds: f64 = stages.iter().map(|s| s.seconds).sum();
    let peak = stages.iter().map(|s| s.peak_bytes).max().unwrap_or(0);
    writeln!(out, "  time      {seconds:.2} s, at most {} of memory", mib(peak))
}
