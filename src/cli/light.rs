//! `pvmap light`: the light of every surfel of a map.

use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};

use pvmap::light::{Effect, LightOptions, Wishes};
use pvmap::lights::{EXAMPLE, Glowing};
use pvmap::query::Map;
use pvmap::vmap::LightSummary;
use pvmap::vmap::octree::FILE_NAME;
use pvmap::{Error, LightDone, LightReport, LightRequest, Limits, Watch, in_digits};

use super::{Context, Outcome, map_file, mib, refuse_input, threads_parser};
use crate::progress::StageDone;

/// Light a map: radiosity of all its surfels
#[derive(Debug, clap::Args)]
#[command(override_usage = "\
pvmap light [OPTIONS] --lights <FILE.toml> <NAME.vmap>
       pvmap light --example")]
#[command(after_help = "\
What shines and what reflects stands in a TOML file, colours as one number or [r, g, b] in linear
light or \"#rrggbb\", places in the scan's units; --example prints one that lights any scan, with
all other keys commented out:
  [albedo]                      what surfaces reflect
  from = \"scan\"                 the scan's colours, or a number or colour for all; of the scan's:
  exposure = 1.0                how many times as bright; max (0.95) is the most, missing (0.5)
                                is that of surfels without a colour
  [[glow]]                      a part of the scan that shines
  box = [2, 2, 5.4, 3.5, 3.5, 5.6]    or sphere, class, color with within, near
  flux = 100                    in all, or exitance, flux an area
  [[material]]                  what a part of the scan is, the same choices or all = true
  near = [1, 2, 0.5]
  albedo = 0.1
  specular = 0.8                also transmissive and refraction
  [[point]]                     lights that are no part of the scan
  position = [2, 2, 3]
  flux = 50                     in all, or intensity, flux a solid angle
  [[spot]]                      as a point, but into a cone
  position = [1, 1, 5]
  target = [2, 2, 0]            or direction = [x, y, z]
  angle = 20                    degrees, from the axis of the cone to its side
  flux = 50
  [[area]]                      a parallelogram that shines the way of side × side
  corner = [2, 2, 5]
  sides = [[0, 1, 0], [1, 0, 0]]
  exitance = 8                  or flux in all
  [sun]
  azimuth = 135                 degrees clockwise from +y, and elevation above the horizon; or
  elevation = 40                direction = [x, y, z], to the sun
  irradiance = 3
  [sky]
  radiance = [0.2, 0.3, 0.5]    up = [x, y, z] where that is not +z

A rule takes whole surfels, those whose middles it selects: where a box cuts some, flux is what is
meant and exitance times the area of the box is not. What each glow has is printed: surfels, their
area in the scan's units, flux. A rule that selects none is an error.

Before anything is solved it is planned and printed which effects the scene calls for, each with the
share of all light that is lost without it at the most, as far as is known, its cost and the
evidence; --plan stops there. Effects: direct, sky, occlusion, bounces, color, mirror-view,
refraction, caustics, diffuse-specular-diffuse, near-field, order. Pictures keep to the plan, too:
what was made with --no mirror-view, --no refraction or --no sky shows no mirrors, nothing through
glass or no sky in them.

The result says of every surfel what it emits (E), what arrives (H) and what leaves it
(B = E + albedo H), flux an area in the unit of the lights. The same map and lights give the same
bytes, whatever the threads.

Examples:
  pvmap light --example > lights.toml                         to begin with
  pvmap light room.vmap --lights lights.toml                  makes room.light
  pvmap light room.vmap --lights lights.toml --plan           what it takes, and why
  pvmap light room.vmap --lights evening.toml --scale-of room.light -o evening.light
  pvmap render room.vmap --light room.light --octree room.octree -o lit.png")]
pub(super) struct Args {
    /// The map
    #[arg(value_name = "NAME.vmap", required_unless_present = "example")]
    map: Option<PathBuf>,
    /// What shines and what reflects, see below
    #[arg(long, value_name = "FILE.toml", required_unless_present = "example")]
    lights: Option<PathBuf>,
    /// Print a lights file for any scan, with all that one may hold
    #[arg(long, exclusive = true)]
    example: bool,
    /// The octree of the map, for rules by class
    #[arg(long, value_name = "NAME.octree")]
    octree: Option<PathBuf>,
    /// The file to make, or replace [default: the map's name with .light, in
    /// the current directory]
    #[arg(short, long, value_name = "NAME.light", verbatim_doc_comment)]
    output: Option<PathBuf>,
    /// How much light may be wrong: 1%, 0.01, at least 1e-6
    #[arg(long, default_value = "1%", value_parser = parse_share, value_name = "E")]
    error: f64,
    /// Plan and stop: what the scene calls for, and why
    #[arg(long)]
    plan: bool,
    /// Compute an effect, whatever the scene calls for; may be repeated
    #[arg(long, value_name = "EFFECT", value_parser = parse_effect)]
    force: Vec<Effect>,
    /// Leave an effect out, whatever the scene calls for; may be repeated
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
    /// Stop when standard input ends: with whoever started this, whatever became of it
    #[arg(long, hide = true)]
    until_input_ends: bool,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    if args.until_input_ends {
        context.progress.end_with(std::io::stdin());
    }
    let (Some(map), Some(lights)) = (&args.map, &args.lights) else {
        write!(io::stdout().lock(), "{EXAMPLE}")?;
        return Ok(ExitCode::SUCCESS);
    };
    let output = match &args.output {
        Some(output) => output.clone(),
        None => default_output(map),
    };
    check(args, map, lights, &output)?;
    let request = LightRequest {
        map: map.clone(),
        octree: args.octree.clone(),
        lights: lights.clone(),
        output: (!args.plan).then(|| output.clone()),
        scale_of: args.scale_of.clone(),
        options: LightOptions {
            error: args.error,
            is_direct: args.direct,
            order: args.order.map(usize::from),
            wishes: wishes(args)?,
            ..LightOptions::default()
        },
    };
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    // What is printed in the midst of it, and how that went.
    let told = Mutex::new((Vec::new(), Ok(())));
    let tell = |report: &LightReport| {
        // The bar must be gone before.
        let stages = context.progress.take_stages();
        notes(lights, &report.notes, context);
        notes(map, &report.map_notes, context);
        let mut out = io::stdout().lock();
        let printed = write!(out, "{}{}", report.plan, glows(report)).and_then(|()| out.flush());
        *told.lock().unwrap_or_else(PoisonError::into_inner) = (stages, printed);
    };
    let report = pvmap::light_map_telling(&request, &limits, &tell, &context.progress)?;
    let (mut stages, printed) = told.into_inner().unwrap_or_else(PoisonError::into_inner);
    // The light is there, whoever reads the plan.
    printed?;
    stages.extend(context.progress.take_stages());
    notes(lights, &report.notes_after, context);
    report.done.iter().try_for_each(|done| print(&output, &report, done, &stages))?;
    Ok(ExitCode::SUCCESS)
}

/// Refuses inputs that are not what they have to be, and an output that is one of them.
fn check(args: &Args, map: &Path, lights: &Path, output: &Path) -> Result<(), Error> {
    if !args.direct {
        require_multipoles(args.error)?;
    }
    let (path, bytes) = map_file(map)?;
    Map::open(&bytes).map_err(|e| Error::of_query(&path, e))?;
    let octree = args.octree.iter().map(|folder| folder.join(FILE_NAME));
    let inputs: Vec<PathBuf> =
        [map.to_path_buf(), lights.to_path_buf()].into_iter().chain(octree).collect();
    refuse_input(output, &inputs)
}

/// Refuses an error that multipoles do not keep.
pub(super) fn require_multipoles(error: f64) -> Result<(), Error> {
    if error < LEAST_ERROR {
        let what = "multipoles err by 1e-6; give a larger one, or --direct";
        return Err(Error::Usage(format!("--error {error:e}: {what}")));
    }
    Ok(())
}

/// Tells what was noticed in a file, with or without progress.
fn notes(path: &Path, notes: &[String], context: &Context) {
    for note in notes {
        context.progress.warn(&format!("{}: {note}", path.display()));
    }
}

/// Says what each glow is, a line each: it has whole surfels, whatever a box cuts.
fn glows(report: &LightReport) -> String {
    let color = |flux: [f64; 3]| match flux.map(|v| in_digits(v, 4)) {
        [r, g, b] if r == g && g == b => r,
        [r, g, b] => format!("[{r}, {g}, {b}]"),
    };
    let line = |(index, glow): (usize, &Glowing)| {
        let (number, n, area) = (index + 1, glow.n_surfels, in_digits(glow.area, 4));
        format!("glow {number}: {n} surfels, area {area}, flux {}\n", color(glow.flux))
    };
    report.glows.iter().enumerate().map(line).collect()
}

fn wishes(args: &Args) -> Result<Wishes, Error> {
    if let Some(both) = args.force.iter().find(|effect| args.no.contains(effect)) {
        let name = both.name();
        return Err(Error::Usage(format!("--force {name} and --no {name}: give one of them")));
    }
    let mut wishes = Wishes::default();
    args.force.iter().for_each(|&effect| wishes.set(effect, true));
    args.no.iter().for_each(|&effect| wishes.set(effect, false));
    Ok(wishes)
}

fn default_output(map: &Path) -> PathBuf {
    PathBuf::from(map.file_name().unwrap_or(map.as_os_str())).with_extension("light")
}

/// Errors that can be asked for, and the least of them without `--direct`: order 7 errs so much.
const ERRORS: Range<f64> = 1e-9..1.0;
const LEAST_ERROR: f64 = 1e-6;

/// Reads a share: `1%` or `0.01`.
pub(super) fn parse_share(text: &str) -> Result<f64, String> {
    let (number, by) = match text.strip_suffix('%') {
        Some(number) => (number, 0.01),
        None => (text, 1.0),
    };
    let share = number.trim().parse::<f64>().map(|v| v * by).ok();
    share
        .filter(|share| ERRORS.contains(share))
        .ok_or_else(|| format!("{text:?} is no share from 1e-9 to below 1; write 1% or 0.01"))
}

fn parse_effect(text: &str) -> Result<Effect, String> {
    Effect::of_name(text).ok_or_else(|| {
        let names = Effect::ALL.map(Effect::name);
        format!("{text:?} is no effect; there are {}", names.join(", "))
    })
}

/// Prints what was made of a plan, which is printed already.
fn print(
    output: &Path,
    report: &LightReport,
    done: &LightDone,
    stages: &[StageDone],
) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let LightDone { summary, reflected, work, output_bytes } = done;
    writeln!(out, "{}", output.display())?;
    let channels = if summary.n_channels == 1 { "one channel" } else { "three channels" };
    let without = match report.n_without_normal {
        0 => String::new(),
        n => format!("; {n} without a normal take no part"),
    };
    writeln!(out, "  surfels   {}, {channels}{without}", report.n_surfels)?;
    let how = match (work.n_applications, summary.order) {
        (0, _) => "surfels send each other none".to_owned(),
        (_, 0) => "pair by pair".to_owned(),
        (_, p) => format!("multipoles of order {p}"),
    };
    let bounces = match *reflected {
        0.0 => String::new(),
        most => format!("; a bounce leaves at most {:.2} % of it", 100.0 * most),
    };
    writeln!(out, "  light     {how}{bounces}")?;
    let errors = errors(summary);
    if !errors.is_empty() {
        writeln!(out, "  errors    {}", errors.join(", "))?;
    }
    let names = if summary.n_channels == 1 { &[""][..] } else { &["red ", "green ", "blue "] };
    for (index, (name, balance)) in names.iter().zip(&summary.balance).enumerate() {
        let label = if index == 0 { "flux" } else { "" };
        writeln!(out, "  {label:<10}{name}{}", flux(balance))?;
    }
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

/// What is not the rounding of numbers.
const LEAST_TOLD: f64 = 1e-9;

/// Lists what is off, where anything is.
fn errors(summary: &LightSummary) -> Vec<String> {
    let told = [
        ("grids", summary.operator_error, " at 64 surfels"),
        ("rows", summary.row_error, ""),
        ("left to solve", summary.residual, ""),
    ];
    let told = told.into_iter().filter(|told| told.1 > LEAST_TOLD);
    told.map(|(what, off, at)| format!("{what} {} %{at}", in_digits(100.0 * off, 2))).collect()
}

/// Says what became of the flux of a channel.
fn flux(&[emitted, absorbed, escaped, _]: &[f64; 4]) -> String {
    if emitted == 0.0 {
        return "nothing shines or arrives".to_owned();
    }
    let share = |flux: f64| 100.0 * flux / emitted;
    let (absorbed, escaped) = (share(absorbed), share(escaped));
    let emitted = in_digits(emitted, 7);
    format!("{emitted} shines or arrives: {absorbed:.2} % absorbed, {escaped:.2} % escaped")
}
