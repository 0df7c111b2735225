//! `pvmap build`: an octree to its visibility map.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use pvmap::config::{RawConfig, RawInteraction, RawProfile, RawSpacing, RawTree, at_lines};
use pvmap::{Built, Checkpoints, Error};

use super::{Context, Outcome, mib, refuse_input, threads_parser};
use crate::progress::si;

/// Cut an octree into surfels and make its visibility map.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Presets:
  depth8    cells down to 1/256 of the scan's extent, some 50 points a surfel: the default
  accurate  smaller surfels where points are spread: fewer wrong answers, for
            some 1.3 times the time
  quick     depth8, but what is far is seen coarsely: in a cave 4 times quicker
            for 1.9 % more wrong answers, by segments for none
  preview   cells down to 1/64, some 200 points a surfel: a first look
  paper     as in the paper: a plain octree, with averaged normals at edges

A configuration file has the same names as keys, all optional, and a table for what pairs are
decided; flags override it. In brackets above stands what depth8 says, which has no list:
  max_level = 8
  leaf_capacity = 50
  max_spread = 10
  tree = \"binned\"
  profile = \"patch\"
  spacing = \"leaf\"
  fractions = false
  threads = 0
  memory = \"1GiB\"
  [interaction]
  list = \"pairs.csv\"     columns node_a,node_b; instead of all siblings
  opening_angle = 0      0 decides all leaf pairs
  min_form_factor = 0
  min_exchange = 0

A build can be stopped at any time and in any way (Ctrl-C, kill, power cut): what was there under
the map's name stays, and the same command goes on where it was. Until the map is done, the tasks
that are lie in the folder NAME.vmap.build beside it, locked against a second build of the same
map. When it goes on, the configuration must be the same; threads and memory may be others, as
long as a thread's share of the memory holds the tasks that were planned.

Examples:
  pvmap build                                   the only *.octree here, depth 8
  pvmap build grotto.octree --config preview    a first look
  pvmap build --config depth8 --max-level 9 -o fine.vmap")]
pub(super) struct Args {
    /// The octree [default: the only *.octree in the current directory]
    octree: Option<PathBuf>,
    /// A TOML file, or where there is none of that name a preset
    /// [default: depth8]
    #[arg(
        long,
        default_value = "depth8",
        hide_default_value = true,
        value_name = "FILE|PRESET",
        verbatim_doc_comment
    )]
    config: PathBuf,
    /// The map to make; one of that name is replaced when all is done
    /// [default: the octree's name with .vmap, in the current directory]
    #[arg(short, long, value_name = "NAME.vmap", verbatim_doc_comment)]
    output: Option<PathBuf>,
    /// Deepest level, 1 to 21: cells of 1/2^L of the extent [depth8: 8]
    #[arg(long, value_name = "L", value_parser = clap::value_parser!(u8).range(1..=21))]
    max_level: Option<u8>,
    /// Most points of a leaf above the deepest level; 0 cuts all the way
    /// [depth8: 50]
    #[arg(long, value_name = "N", verbatim_doc_comment)]
    leaf_capacity: Option<u64>,
    /// Cuts leaves further whose points are so spread that their box has
    /// more than N times the area they cover, such as stray points; 3 cuts
    /// thin limbs, too, for more leaves and time, 0 nothing [depth8: 10]
    #[arg(long, value_name = "N", verbatim_doc_comment)]
    max_spread: Option<u16>,
    /// binned (an octree for each of six directions of normals) or paper
    /// (one plain octree) [depth8: binned]
    #[arg(
        long,
        value_enum,
        value_name = "SHAPE",
        verbatim_doc_comment,
        hide_possible_values = true
    )]
    tree: Option<RawTree>,
    /// How a surfel blocks: patch (as far as its points reach along the
    /// axes of the scan), oriented (and along its own surface: better where
    /// surfaces are slanted) or paper (wherever its cell is met)
    /// [depth8: patch]
    #[arg(long, value_enum, value_name = "HOW", verbatim_doc_comment, hide_possible_values = true)]
    profile: Option<RawProfile>,
    /// How far a patch goes beyond its points: half the spacing of the
    /// leaf's own points, or that of its neighbors', which leaves no gaps
    /// between leaves of few points [depth8: leaf]
    #[arg(
        long,
        value_enum,
        value_name = "WHOSE",
        verbatim_doc_comment,
        hide_possible_values = true
    )]
    spacing: Option<RawSpacing>,
    /// Approximate: do not open cells that are seen, from where they are
    /// looked at, under at most this angle (side over distance, 0 to 1);
    /// 0.15 is quick, 0.06 careful, 0 exact [depth8: 0]
    #[arg(long, value_name = "ANGLE", verbatim_doc_comment)]
    opening_angle: Option<f64>,
    /// Approximate: may leave out pairs, as if they did not see each other,
    /// of which neither leaf's form factor to the other, unhindered, reaches
    /// this much (0 to 1) [depth8: 0]
    #[arg(long, value_name = "F", verbatim_doc_comment)]
    min_form_factor: Option<f64>,
    /// Approximate: do not open a pair of cells that exchange less than
    /// this share of all light (each pair by itself), were nothing between;
    /// 16 segments say how much of each other they see (query … pair
    /// --fraction); 1e-6 is quick, 1e-7 careful [depth8: 0]
    #[arg(long, value_name = "SHARE", verbatim_doc_comment)]
    min_exchange: Option<f64>,
    /// Try pairs of leaves half in shadow by 16 segments and keep how many
    /// are free, for query … pair --fraction; what the map says of whole
    /// leaves stays as it is
    #[arg(long, verbatim_doc_comment)]
    fractions: bool,
    /// Threads; 0 takes as many as the machine has [depth8: 0]
    #[arg(long, value_name = "N", value_parser = threads_parser())]
    threads: Option<usize>,
    /// Most memory to hold, at least 64MiB [depth8: 1GiB]
    #[arg(long, value_name = "SIZE", value_parser = checked_memory)]
    memory: Option<String>,
    /// How long finished tasks may wait to be written down, about; 0 writes
    /// down each at once
    #[arg(long, value_name = "SECONDS", default_value = "10", verbatim_doc_comment)]
    checkpoint: u32,
    /// Begin anew, and discard what an unfinished build left
    #[arg(long)]
    restart: bool,
    /// Stop when standard input ends: with whoever started this build, whatever became of it
    #[arg(long, hide = true)]
    until_input_ends: bool,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    if args.until_input_ends {
        context.progress.end_with(std::io::stdin());
    }
    let flags = RawConfig {
        max_level: args.max_level,
        leaf_capacity: args.leaf_capacity,
        max_spread: args.max_spread,
        tree: args.tree,
        profile: args.profile,
        spacing: args.spacing,
        fractions: args.fractions.then_some(true),
        threads: args.threads,
        memory: args.memory.clone(),
        interaction: Some(RawInteraction {
            list: None,
            opening_angle: args.opening_angle,
            min_form_factor: args.min_form_factor,
            min_exchange: args.min_exchange,
        }),
    };
    let raw = flags.over(RawConfig::find(&args.config)?);
    let list = raw.interaction.as_ref().and_then(|i| i.list.clone());
    let (config, limits) = raw.check()?;
    let octree = match &args.octree {
        Some(octree) => octree.clone(),
        None => only_octree(Path::new("."))?,
    };
    let output = match &args.output {
        Some(output) => output.clone(),
        None => default_output(&octree),
    };
    refuse_input(&output, &[octree.join(pvmap::vmap::octree::FILE_NAME)])?;
    let every = Duration::from_secs(args.checkpoint.into());
    let checkpoints = Checkpoints { every, restart: args.restart };
    let built =
        pvmap::build_with(&octree, &output, &config, &limits, &checkpoints, &context.progress);
    let built = built.map_err(|e| match &list {
        Some(list) => at_lines(list, e),
        None => e,
    })?;
    print(&output, &built, context)?;
    Ok(ExitCode::SUCCESS)
}

/// Makes sure that a size is one for `memory`, as the configuration has it.
fn checked_memory(text: &str) -> Result<String, String> {
    pvmap::parse_memory(text).map(|_| text.to_owned())
}

/// Finds the octree of a folder that holds exactly one.
fn only_octree(folder: &Path) -> Result<PathBuf, Error> {
    let listed = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = listed
        .map(|entry| PathBuf::from(entry.file_name()))
        .filter(|name| name.extension().is_some_and(|e| e == "octree"))
        .collect();
    found.sort();
    match found.as_slice() {
        [one] => Ok(one.clone()),
        [] => Err(Error::Usage(
            "no *.octree here; name one, or make one with pvmap ingest".to_owned(),
        )),
        several => {
            let names: Vec<_> = several.iter().map(|p| p.display().to_string()).collect();
            Err(Error::Usage(format!("several octrees here, name one: {}", names.join(", "))))
        }
    }
}

fn default_output(octree: &Path) -> PathBuf {
    PathBuf::from(octree.file_name().unwrap_or(octree.as_os_str())).with_extension("vmap")
}

fn print(output: &Path, built: &Built, context: &Context) -> std::io::Result<()> {
    let s = &built.report.summary;
    let stages = context.progress.take_stages();
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", output.display())?;
    writeln!(out, "  surfels   {} for {} points, {} nodes", s.n_surfels, s.n_points, s.n_nodes)?;
    let pairs = built.n_leaf_pairs;
    let share = |n: u128| 100.0 * n as f64 / (pairs as f64).max(1.0);
    writeln!(out, "  pairs     {pairs}, {:.1} % see each other", share(s.n_visible_pairs))?;
    let fewer = fewer_links(s.n_links, s.n_surfels);
    writeln!(
        out,
        "  links     {}, {fewer:.2} % fewer than N² = {}",
        s.n_links,
        square(s.n_surfels)
    )?;
    let a_link = built.report.link_bytes as f64 / (s.n_links as f64).max(1.0);
    if s.n_fractions > 0 {
        writeln!(out, "  fractions {} pairs of nodes seen in part", s.n_fractions)?;
    }
    writeln!(out, "  disk      {}, {a_link:.2} bytes a link", mib(built.report.output_bytes))?;
    let c = &built.report.counts;
    writeln!(
        out,
        "  work      {} node pairs, {} candidates, {} segments ({} by discs met lately),",
        si(c.n_node_pairs as f64),
        si(c.n_candidates as f64),
        si(c.n_segments as f64),
        si(c.n_remembered as f64),
    )?;
    writeln!(
        out,
        "            {} sheets asked, {} blocked by them, {} left undecided,",
        si(c.n_sheets as f64),
        si(c.n_by_sheets as f64),
        si(c.n_unsure as f64)
    )?;
    writeln!(
        out,
        "            {} discs loaded, {} tests of 16 segments, {} settled exactly",
        si(c.n_loaded as f64),
        si(c.n_tests as f64),
        si(c.n_exact as f64)
    )?;
    let seconds: f64 = stages.iter().map(|s| s.seconds).sum();
    let peak = stages.iter().map(|s| s.peak_bytes).max().unwrap_or(0);
    let pace = match built.report.n_tasks_resumed {
        0 => format!("{} pairs/s", si(pairs as f64 / seconds.max(1e-9))),
        // What an earlier run did took time of its own.
        n => format!("for {} of {} tasks", built.report.n_tasks - n, built.report.n_tasks),
    };
    writeln!(out, "  time      {seconds:.2} s, {pace}, at most {} of memory", mib(peak))
}

/// Gives N², which counts each pair of surfels twice, as the paper does.
pub(super) fn square(n_surfels: u32) -> u64 {
    u64::from(n_surfels) * u64::from(n_surfels)
}

/// Gives by how many per cent there are fewer links than N², both counted twice.
pub(super) fn fewer_links(n_links: u64, n_surfels: u32) -> f64 {
    100.0 * (1.0 - 2.0 * n_links as f64 / (square(n_surfels) as f64).max(1.0))
}
