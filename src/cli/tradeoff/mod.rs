//! `pvmap tradeoff`: what each setting of a build costs, and how often its map is wrong.

mod child;
mod defects;
mod light;
mod maps;
mod outputs;
mod places;
mod source;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::accuracy::{ScanPoints, Way};
use pvmap::config::{RawConfig, RawProfile, RawSpacing, RawTree};
use pvmap::query::Map;
use pvmap::tradeoff::pareto::{Wish, choose, front};
use pvmap::tradeoff::table::{self, CSV_HEADER};
use pvmap::tradeoff::{
    Axes, Built, Clock, Judge, Outcome, Row, Sample, Setting, Share, Subject, Sweep, plot,
};
use pvmap::vmap::OctreeView;
use pvmap::{Error, Limits, Mapped, Watch};
use serde_json::{Value, json};

use self::child::Measured;
use self::defects::DefectArgs;
use self::light::LightArgs;
use self::maps::{Made, Maps, built_of};
use self::outputs::Outputs;
use self::source::Source;
use super::threads_parser;
use super::{Context, Outcome as Answer, one_line, parse_count, parse_some, print_json};

/// Show what each setting of a build costs and buys: time, memory, size, error
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Of one octree a map is built for every setting, each by a pvmap build of its own, and all maps are
asked about the same random pairs of points. The pairs are points of the scan that face each other
in truth; what is counted is how many of them a map has wrong.

Truth is the exact geometry of a scene that is generated here (empty, packed, furnished, cave), or
the triangles of --truth, asked as pvmap accuracy asks them. Without either the points themselves
answer, as with pvmap query MAP pair --exact; that is a reference and not truth, and is called so.
A scan file is ingested with default options; for others give the octree of pvmap ingest.

Settings: without any of the options from --config to --fractions, some twenty settings
around depth8, most with one thing changed. With several values the settings are all combinations
of them: --max-level 7,8 --leaf-capacity 50,100 are four. What is not given stays as --config has
it; with several configurations each of them is combined. A setting whose build takes longer than
--limit is stopped, and one that would take far longer, by those built before it, is not begun.
Settings that cut the same tree have the same map: it is built once, and the others' rows say as
which. What is approximate, by an opening angle, a least form factor or a least exchange, has colors
of its own.

Columns, with 95 % intervals (Wilson):
  seconds              from the octree to the finished map; of several --runs the least
  memory               most anonymous memory of the building process, of all runs
  leaves, links        of the map, each link once
  map                  size of the file
  query                what a pair took to answer: both places found in the map, then the pair
  wrongly visible      of the pairs that face each other: the map says yes, the truth no
  wrongly invisible    of the same pairs: the map says no, the truth yes
  error, both          the two together
  squared error        in CSV and JSON: how much is said to be seen, 0 to 1, less 1 or 0 in truth,
                       squared, on average; other than the error only with visible fractions
With --segment each map has a second row, asked as pvmap query MAP pair --segment asks it: the build
is the same, query and error are its own.
With --cpu seconds are those of all its threads together (CSV and JSON have both anyway). A star
marks settings that no other beats in both, seconds and error. --want recommends one of
them: for an error the quickest whose interval ends below it, for a time the most accurate that
keeps it. Where there is none, the line says which comes nearest; the exit code is 0 all the same.

Defects: with any of --defects to --estimate-normals a generated scene is scanned several times,
first as it is and then with each value of each defect by itself, and the settings (without --config
depth8 and accurate) are tried on every scan. Truth is asked where a point was before its defect; so
a map is wrong, too, where noise moved a point out of sight or its normal has the wrong sign. With
--uneven the number of points stays, with --holes those in balls are missing. Without
--estimate-normals points have the exact normals of their surfaces, however noisy they are; those
that have none are estimated. The plot has a panel a defect and a line a setting.

Light: with --lights no pairs are asked. Each map is lit in several ways, each by a pvmap light of
its own: by multipoles of orders 1 to 5, pair by pair, and for errors of 5 %, 1 % and 0.2 %; with
any of --order, --direct and --error by these alone. By --order and --direct as much is left to
solve as pvmap light leaves without --error. Without any of the options from --config to --fractions
maps are of levels 5 to 8 with capacities of 200, 50 and 25, and depth8 with a least exchange of
1e-6 and with an opening angle of 0.15.
With --irradiance a light is held against what is known of places: there it is interpolated as pvmap
export does, and its differences in red, green and blue are added up, as a share of what is known; a
column irradiance is held against the mean of the three. Other columns are ignored, and lines that
begin with #. Places farther than four half spacings from the surfaces of a map are left out, and
counted. Without --irradiance the light of the same map, pair by pair to 1e-6, is held against: that
is a reference and not truth, for it has the errors of the map itself. Then all surfels count by
their area, but those without a normal are left out, and differences are shares of the mean
irradiance. Columns:
  map, light, both     seconds: from the octree to the map, from the map to the light, together
  memory               most anonymous memory of the lighting process, of all runs
  order, rounds        of the multipoles, - where there are none; rounds of the solver
  error                mean of the absolute differences
  bias, largest        mean of the differences, above 0 where it is too bright; the largest of them
  left out             places on no surface of the map, or surfels without a normal
Stars and --want go by both and error, which has no interval here. The plot has a panel for the
seconds of the light alone and one for those of both, and a color for maps of a capacity and kind.

The same seed gives the same pairs, and the same counts on any machine; seconds and memory are those
of this one. Ctrl-C prints what is measured so far; files are then not written. Maps and what is
generated lie in the system's folder for temporary files (TMPDIR) until the end.

Examples:
  pvmap tradeoff furnished
  pvmap tradeoff cave --points 1M --svg cave.svg --csv cave.csv --want error=1%
  pvmap tradeoff furnished --config depth8,accurate --segment
  pvmap tradeoff grotto.octree --max-level 6,7,8 --leaf-capacity 25,50,100 --limit 600
  pvmap tradeoff furnished --noise 1mm,3mm,1cm --holes 5%,20% --csv rough.csv --svg rough.svg
  pvmap tradeoff furnished --lights lamp.toml --cpu --svg light.svg --want error=1%
  pvmap tradeoff hall.octree --lights lamps.toml --irradiance lux.csv --config depth8 --order 2,3
  pvmap tradeoff room.ply --truth room.mesh.ply --config depth8,paper,mine.toml --want time=30s")]
pub(super) struct Args {
    /// A scene to generate, a scan file, or an octree, as pvmap ingest
    /// makes it
    #[arg(value_name = "SCENE|SCAN|NAME.octree", verbatim_doc_comment)]
    source: PathBuf,
    /// The exact triangles of the scan, a PLY mesh
    #[arg(long, value_name = "MESH.ply")]
    truth: Option<PathBuf>,
    /// How many points a generated scene has [default: 400k]
    #[arg(long, value_parser = parse_count, value_name = "N")]
    points: Option<u64>,
    /// How many pairs are drawn [default: 100k]
    #[arg(long, value_parser = parse_some, value_name = "N")]
    pairs: Option<u64>,
    /// What pairs and generated points are drawn from
    #[arg(long, default_value_t = 1, value_name = "S")]
    seed: u64,
    /// Configurations: TOML files, or where there is none of a name
    /// presets [default: depth8]
    #[arg(long, value_delimiter = ',', value_name = "NAME,…", verbatim_doc_comment)]
    config: Vec<PathBuf>,
    /// Deepest levels to try, 1 to 21
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "L,…",
        value_parser = clap::value_parser!(u8).range(1..=21)
    )]
    max_level: Vec<u8>,
    /// Capacities of leaves to try, in points
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    leaf_capacity: Vec<u64>,
    /// Spreads of leaves to try, 0 for any
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    max_spread: Vec<u16>,
    /// Trees to try: binned, paper
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        value_name = "SHAPE,…",
        hide_possible_values = true
    )]
    tree: Vec<RawTree>,
    /// Profiles to try: patch, oriented, paper
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        value_name = "HOW,…",
        hide_possible_values = true
    )]
    profile: Vec<RawProfile>,
    /// Spacings to try: leaf, neighbors
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        value_name = "FROM,…",
        hide_possible_values = true
    )]
    spacing: Vec<RawSpacing>,
    /// Opening angles to try, 0 to 1; 0 is exact
    #[arg(long, value_delimiter = ',', value_name = "A,…")]
    opening_angle: Vec<f64>,
    /// Least form factors to try, 0 to 1, with commas; 0 is exact
    #[arg(long, value_delimiter = ',', value_name = "F")]
    min_form_factor: Vec<f64>,
    /// Least exchanges to try, 0 to 1, with commas; 0 is exact
    #[arg(long, value_delimiter = ',', value_name = "SHARE")]
    min_exchange: Vec<f64>,
    /// Build each map with visible fractions, too, and answer by them: yes
    /// where half or more is seen
    #[arg(long, verbatim_doc_comment)]
    fractions: bool,
    /// Ask each map by the segments between the points, too: rows of their
    /// own
    #[arg(long, verbatim_doc_comment)]
    segment: bool,
    /// Seconds that a build may take, and each light
    #[arg(long, default_value_t = 300, value_name = "SECONDS")]
    limit: u64,
    /// How often maps are built, and lit; the quickest counts
    #[arg(
        long,
        default_value_t = 1,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    runs: u32,
    /// Compare processor seconds: they tell less of what else is running
    #[arg(long)]
    cpu: bool,
    /// What is wanted: error=0.5% (the quickest such setting) or time=30s
    /// (the most accurate such setting)
    #[arg(long, value_name = "WISH", verbatim_doc_comment)]
    want: Option<Wish>,
    /// Where the table goes as CSV; - for standard output
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    /// Where error against seconds is drawn
    #[arg(long, value_name = "FILE.svg")]
    svg: Option<PathBuf>,
    /// Answer as one JSON object
    #[arg(long)]
    json: bool,
    /// Replace files of those names whatever they are
    #[arg(long)]
    overwrite: bool,
    /// Threads of a build or light; 0 takes as many as there are
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = threads_parser())]
    threads: usize,
    /// Most memory of a build, a light or the triangles
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
    #[command(flatten, next_help_heading = "Defects of a generated scan")]
    defects: DefectArgs,
    #[command(flatten, next_help_heading = "Light of the maps")]
    lights: Box<LightArgs>,
}

pub(super) fn run(args: &Args, context: &Context) -> Answer {
    if args.defects.are_asked_for() {
        if args.lights.are_asked_for() {
            return Err(light::refused("--defects and its kinds").into());
        }
        return defects::run(args, context);
    }
    if args.lights.are_asked_for() {
        return light::run(args, context);
    }
    let sweep = sweep(args)?;
    let n_pairs = n_pairs(args)?;
    let outputs = Outputs::begin(args, CSV_HEADER)?;
    let watch = &context.progress;
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    let source = Source::find(args, &limits, watch)?;
    let file = pvmap::open_octree(source.octree())?;
    let view = source.view(&file)?;
    let (truth, judge) = source.truth(&view, &limits, watch)?;
    let points = ScanPoints::new(&view, source.octree())?;
    let drawn = limits.run(|| Sample::draw(&truth, &points, (n_pairs, args.seed), watch))?;
    let sample = drawn.map_err(|e| source.named(e))?;
    let subject = subject(args, view.summary().n_points, &sample, judge)?;
    let mut rows = Vec::new();
    let measured =
        measure_all(args, &sweep.settings, (&source, &view), &sample, context, &mut rows);
    outputs.finish(
        (measured, !rows.is_empty()),
        |file| table::write_csv(file, &rows, &subject),
        || plot::draw(&rows, &subject, args.want),
        |is_stopped| print(args, &rows, &subject, is_stopped),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Pairs that are drawn where no other number is asked for.
const PAIRS: u64 = 100_000;

/// Says how many pairs to draw.
fn n_pairs(args: &Args) -> Result<u64, Error> {
    match args.pairs.unwrap_or(PAIRS) {
        n if n > Sample::MAX_PAIRS => {
            Err(Error::Usage(format!("--pairs: {n}, the most are {}", Sample::MAX_PAIRS)))
        }
        n => Ok(n),
    }
}

/// Says what the pairs of a scan are.
fn subject(args: &Args, n_points: u64, sample: &Sample, judge: Judge) -> Result<Subject, Error> {
    let subject = Subject {
        name: one_line(&args.source.display().to_string()),
        n_points,
        seed: args.seed,
        n_drawn: sample.n_drawn(),
        n_left_out: sample.n_left_out(),
        n_facing: sample.n_facing(),
        n_visible: sample.n_visible(),
        judge,
        clock: clock_of(args),
    };
    if subject.n_facing == 0 { Err(nothing_to_ask(&subject)) } else { Ok(subject) }
}

fn clock_of(args: &Args) -> Clock {
    if args.cpu { Clock::Processor } else { Clock::Wall }
}

/// Lists the settings that were asked for.
fn sweep(args: &Args) -> Result<Sweep, Error> {
    if args.config.is_empty() && axes(args).is_empty() {
        return Sweep::around("depth8", &RawConfig::find(Path::new("depth8"))?);
    }
    sweep_of(args, &["depth8"])
}

/// Lists the combinations of configurations, or those that stand for none, and values.
fn sweep_of(args: &Args, default: &[&str]) -> Result<Sweep, Error> {
    let default: Vec<PathBuf> = default.iter().map(PathBuf::from).collect();
    let names = if args.config.is_empty() { &default } else { &args.config };
    let named = |path: &PathBuf| {
        let name = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        Ok::<_, Error>((one_line(&name), RawConfig::find(path)?))
    };
    Sweep::of(&names.iter().map(named).collect::<Result<Vec<_>, _>>()?, &axes(args))
}

fn axes(args: &Args) -> Axes {
    Axes {
        max_level: args.max_level.clone(),
        leaf_capacity: args.leaf_capacity.clone(),
        max_spread: args.max_spread.clone(),
        tree: args.tree.clone(),
        profile: args.profile.clone(),
        spacing: args.spacing.clone(),
        opening_angle: args.opening_angle.clone(),
        min_form_factor: args.min_form_factor.clone(),
        min_exchange: args.min_exchange.clone(),
        fractions: if args.fractions { vec![false, true] } else { Vec::new() },
    }
}

fn nothing_to_ask(subject: &Subject) -> Error {
    let why = match subject.n_left_out == subject.n_drawn {
        true => "on the triangles; give the truth of this scan, in its units",
        false => "face to face; draw more of them with --pairs",
    };
    Error::Data(format!("{}: none of {} pairs lies {why}", subject.name, subject.n_drawn))
}

/// Builds and asks every setting, a row each.
fn measure_all(
    args: &Args,
    settings: &[Setting],
    (source, view): (&Source, &OctreeView<'_>),
    sample: &Sample,
    context: &Context,
    rows: &mut Vec<Row>,
) -> Result<(), Error> {
    let maps = Maps { args, source, view, n: settings.len(), watch: &context.progress };
    for (i, setting) in settings.iter().enumerate() {
        let (cut, made) = maps.make(i, setting, rows)?;
        let mut by_segment = None;
        let outcome = match made {
            Made::Not(outcome) => outcome,
            Made::Map(map, measured) => {
                let ask = |setting: &Setting| {
                    ask(args, (setting, map.path()), sample, &measured, &context.progress)
                };
                let built = ask(setting)?;
                if args.segment {
                    let setting = setting.segments();
                    let outcome = Outcome::Built(ask(&setting)?);
                    by_segment = Some(Row { setting, cut: None, outcome });
                }
                Outcome::Built(built)
            }
        };
        rows.push(Row { setting: setting.clone(), cut, outcome });
        rows.extend(by_segment);
    }
    Ok(())
}

fn told(name: &str, built: &Built) -> String {
    format!("{name}: {:.2} s, error {:.2} %", built.seconds, 100.0 * built.error().value())
}

/// Asks the map of a setting about the pairs.
fn ask(
    args: &Args,
    (setting, path): (&Setting, &Path),
    sample: &Sample,
    measured: &Measured,
    watch: &dyn Watch,
) -> Result<Built, Error> {
    let bytes = Mapped::open(path)?;
    let map = Map::open(&bytes).map_err(|e| Error::of_query(path, e))?;
    let way = match (setting.by_segment, map.has_fractions()) {
        (true, _) => Way::segments(&map),
        (false, true) => Way::fractions(&map),
        (false, false) => Way::leaves(&map),
    };
    let tally = sample.ask_by(way, clock_of(args), watch).map_err(|e| match e {
        Error::Query(e) => Error::of_query(path, e),
        e => e,
    })?;
    let built = Built { tally, ..built_of(args, &map, bytes.len() as u64, measured) };
    watch.note(&told(&setting.name, &built));
    Ok(built)
}

fn print(args: &Args, rows: &[Row], subject: &Subject, is_stopped: bool) -> io::Result<()> {
    if args.json {
        return print_json(&as_json(args, rows, subject, is_stopped));
    }
    io::stdout().lock().write_all(table::text(rows, subject, args.want).as_bytes())
}

fn as_json(args: &Args, rows: &[Row], subject: &Subject, is_stopped: bool) -> Value {
    let choice = args.want.and_then(|wish| choose(rows, wish));
    let recommended = choice
        .map(|choice| json!({ "setting": rows[choice.row].setting.name, "is_met": choice.is_met }));
    json!({
        "source": subject.name,
        "points": subject.n_points,
        "seed": subject.seed,
        "pairs": subject.n_drawn,
        "left_out": subject.n_left_out,
        "facing": subject.n_facing,
        "visible": subject.n_visible,
        "judge": subject.judge.word(),
        "compared_by": subject.clock.column(),
        "settings": rows_json(rows),
        "want": args.want.map(|wish| wish.to_string()),
        "recommended": recommended,
        "stopped": is_stopped,
    })
}

fn rows_json(rows: &[Row]) -> Vec<Value> {
    let of_row = |(row, on_front): (&Row, bool)| {
        let mut value = setting_json(&row.setting);
        value.insert("outcome".to_owned(), json!(table::outcome_word(&row.outcome)));
        value.insert("why_not".to_owned(), json!(row.outcome.why_not()));
        value.insert("on_front".to_owned(), json!(on_front));
        value.extend(row.built().into_iter().flat_map(built_json));
        Value::from(value)
    };
    rows.iter().zip(front(rows)).map(of_row).collect()
}

/// Gives what a setting is, as keys and values.
fn setting_json(setting: &Setting) -> serde_json::Map<String, Value> {
    let fields = [
        ("setting", json!(setting.name)),
        ("mode", json!(setting.mode())),
        ("tree", json!(setting.tree())),
        ("profile", json!(setting.profile())),
        ("spacing", json!(setting.spacing())),
        ("max_level", json!(setting.config.max_level)),
        ("leaf_capacity", json!(setting.config.leaf_capacity)),
        ("max_spread", json!(setting.config.max_spread)),
        ("opening_angle", json!(setting.config.approximation.opening_angle)),
        ("min_form_factor", json!(setting.config.approximation.min_form_factor)),
        ("min_exchange", json!(setting.config.approximation.min_exchange)),
        ("fractions", json!(setting.config.fractions)),
    ];
    fields.map(|(key, value)| (key.to_owned(), value)).into_iter().collect()
}

fn built_json(built: &Built) -> serde_json::Map<String, Value> {
    let share = |share: Share| {
        let [low, high] = share.interval();
        json!({ "n": share.k, "of": share.n, "share": share.value(), "low": low, "high": high })
    };
    let fields = [
        ("build_seconds", json!(built.build_seconds)),
        ("visibility_seconds", json!(built.visibility_seconds)),
        ("cpu_seconds", json!(built.cpu_seconds)),
        ("peak_rss_anon_bytes", json!(built.peak_bytes)),
        ("leaves", json!(built.n_leaves)),
        ("links", json!(built.n_links)),
        ("map_bytes", json!(built.map_bytes)),
        ("query_seconds", json!(built.query_seconds())),
        ("wrongly_visible", share(built.false_visible())),
        ("wrongly_invisible", share(built.false_invisible())),
        ("error", share(built.error())),
        ("squared_error", json!(built.tally.squared_error())),
    ];
    fields.map(|(key, value)| (key.to_owned(), value)).into_iter().collect()
}
