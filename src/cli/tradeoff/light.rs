//! `pvmap tradeoff SCENE --lights`: what the light of each map costs, and how far it is off.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::config::RawConfig;
use pvmap::lights::Lights;
use pvmap::query::Map;
use pvmap::tradeoff::light::table::{self, CSV_HEADER, percent};
use pvmap::tradeoff::light::{
    KnownPlace, LightJudge, LightSubject, Lit, LitOutcome, LitRow, Way, Yardstick, choose, front,
    plot,
};
use pvmap::tradeoff::{Built, Outcome, Row, Setting, Sweep};
use pvmap::vmap::{FormatError, LightView};
use pvmap::{Error, Limits, Mapped, Watch};
use serde_json::{Value, json};

use super::super::light::{parse_share, require_multipoles};
use super::super::{Context, Outcome as Answer, one_line, print_json};
use super::child::{self, Ended, Job, Measured};
use super::maps::{Made, Maps, TempMap, built_of};
use super::outputs::Outputs;
use super::source::Source;
use super::{Args, axes, clock_of, places, setting_json, sweep_of};

/// What shines, and how to light.
#[derive(Debug, Clone, Default, clap::Args)]
pub(super) struct LightArgs {
    /// Light each map by this file, as pvmap light takes it, and say how
    /// far its light is off
    #[arg(long, value_name = "FILE.toml", verbatim_doc_comment)]
    lights: Option<PathBuf>,
    /// Irradiance that was measured or traced at places; columns x, y, z,
    /// nx, ny, nz and irradiance, or red, green, blue
    #[arg(long, value_name = "PLACES.csv", requires = "lights", verbatim_doc_comment)]
    irradiance: Option<PathBuf>,
    /// Orders of multipoles to try, 1 to 7
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "P,…",
        requires = "lights",
        value_parser = clap::value_parser!(u8).range(1..=7)
    )]
    order: Vec<u8>,
    /// Errors to ask for: 5%,0.01
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "E,…",
        requires = "lights",
        value_parser = parse_share
    )]
    error: Vec<f64>,
    /// Try all pairs of surfels one by one
    #[arg(long, requires = "lights")]
    direct: bool,
}

impl LightArgs {
    /// Says whether maps are to be lit, and asked about no pairs.
    pub(super) fn are_asked_for(&self) -> bool {
        self.lights.is_some()
    }

    /// Lists the files that are read.
    pub(super) fn inputs(&self) -> impl Iterator<Item = PathBuf> {
        self.lights.clone().into_iter().chain(self.irradiance.clone())
    }

    /// Lists the ways that are asked for, each once, or the usual ones.
    fn ways(&self) -> Vec<Way> {
        let orders = self.order.iter().map(|&p| Way::Order(p));
        let direct = self.direct.then_some(Way::Direct);
        let all = orders.chain(direct).chain(self.error.iter().map(|&e| Way::Error(e)));
        let mut ways: Vec<Way> = Vec::new();
        for way in all {
            if !ways.contains(&way) {
                ways.push(way);
            }
        }
        if ways.is_empty() { Way::usual() } else { ways }
    }
}

/// Refuses what is about pairs of points.
pub(super) fn refused(option: &str) -> Error {
    Error::Usage(format!("{option}: that is about pairs of points; leave it or --lights away"))
}

/// Builds the map of every setting, and lights it in every way.
pub(super) fn run(args: &Args, context: &Context) -> Answer {
    let about_pairs = [
        ("--pairs", args.pairs.is_some()),
        ("--truth", args.truth.is_some()),
        ("--segment", args.segment),
    ];
    if let Some((option, _)) = about_pairs.into_iter().find(|(_, is_given)| *is_given) {
        return Err(refused(option).into());
    }
    args.lights.error.iter().try_for_each(|&error| require_multipoles(error))?;
    let lights = args.lights.lights.as_deref().unwrap_or_else(|| Path::new(""));
    Lights::read(lights)?;
    let known = args.lights.irradiance.as_deref().map(places::read).transpose()?;
    let settings = sweep(args)?.settings;
    let outputs = Outputs::begin(args, CSV_HEADER)?;
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    let source = Source::find(args, &limits, &context.progress)?;
    let file = pvmap::open_octree(source.octree())?;
    let view = source.view(&file)?;
    let watch = &context.progress;
    let maps = Maps { args, source: &source, view: &view, n: settings.len(), watch };
    let subject = subject(args, lights, view.summary().n_points, known.as_deref());
    let lighting = Lighting { args, lights, source: &source, known, watch };
    let mut rows = Vec::new();
    let measured = lighting.measure_all(&maps, &settings, &mut rows);
    outputs.finish(
        (measured, !rows.is_empty()),
        |file| table::write_csv(file, &rows, &subject),
        || plot::draw(&rows, &subject, args.want),
        |is_stopped| print(args, &rows, &subject, is_stopped),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Lists the settings that were asked for.
fn sweep(args: &Args) -> Result<Sweep, Error> {
    if args.config.is_empty() && axes(args).is_empty() {
        return Sweep::for_light("depth8", &RawConfig::find(Path::new("depth8"))?);
    }
    sweep_of(args, &["depth8"])
}

fn subject(
    args: &Args,
    lights: &Path,
    n_points: u64,
    known: Option<&[KnownPlace]>,
) -> LightSubject {
    let name = |path: &Path| one_line(&path.display().to_string());
    let places = args.lights.irradiance.as_deref().zip(known);
    LightSubject {
        name: name(&args.source),
        n_points,
        lights: name(lights),
        judge: places.map_or(LightJudge::Reference, |(file, known)| LightJudge::Places {
            file: name(file),
            n: known.len(),
        }),
        clock: clock_of(args),
    }
}

/// What maps are lit by and held against.
struct Lighting<'a> {
    args: &'a Args,
    lights: &'a Path,
    source: &'a Source,
    /// Places whose irradiance is known, if some are.
    known: Option<Vec<KnownPlace>>,
    watch: &'a dyn Watch,
}

/// A map that is there.
struct OneMap<'a> {
    setting: &'a Setting,
    path: &'a Path,
    map: &'a Map<'a>,
    built: Built,
}

impl Lighting<'_> {
    /// Builds the maps and lights each, a row a light.
    fn measure_all(
        &self,
        maps: &Maps<'_>,
        settings: &[Setting],
        rows: &mut Vec<LitRow>,
    ) -> Result<(), Error> {
        // Of maps alone, by which those that come are judged.
        let mut map_rows: Vec<Row> = Vec::new();
        for (i, setting) in settings.iter().enumerate() {
            let (cut, made) = maps.make(i, setting, &map_rows)?;
            let outcome = match made {
                Made::Map(map, measured) => {
                    Outcome::Built(self.light_all(setting, &map, &measured, rows)?)
                }
                Made::Not(outcome) => {
                    let without = LitOutcome::NoMap(outcome.clone());
                    rows.push(LitRow { setting: setting.clone(), way: None, outcome: without });
                    outcome
                }
            };
            map_rows.push(Row { setting: setting.clone(), cut, outcome });
        }
        Ok(())
    }

    /// Lights a map in all ways.
    fn light_all(
        &self,
        setting: &Setting,
        map: &TempMap,
        measured: &Measured,
        rows: &mut Vec<LitRow>,
    ) -> Result<Built, Error> {
        let path = map.path();
        let bytes = Mapped::open(path)?;
        let map = Map::open(&bytes).map_err(|e| Error::of_query(path, e))?.solid();
        let built = built_of(self.args, &map, bytes.len() as u64, measured);
        let one = OneMap { setting, path, map: &map, built };
        let mut row = |way, outcome| rows.push(LitRow { setting: setting.clone(), way, outcome });
        let yardstick = match self.yardstick(&one)? {
            Ok(yardstick) => yardstick,
            Err(why) => {
                row(None, LitOutcome::NoReference(why));
                return Ok(one.built);
            }
        };
        // The reference has said what there was to notice.
        let mut is_heard = self.known.is_some();
        for way in self.args.lights.ways() {
            row(Some(way), self.light(&one, way, &yardstick, is_heard)?);
            is_heard = false;
        }
        Ok(one.built)
    }

    /// Finds what the lights of a map are held against; else says why there is nothing.
    fn yardstick(&self, one: &OneMap<'_>) -> Result<Result<Yardstick, String>, Error> {
        if let Some(known) = &self.known {
            let found = Yardstick::of_places(known, one.map, one.path)?;
            if found.is_empty() {
                let file = self.args.lights.irradiance.as_deref().unwrap_or(self.lights);
                return Err(Error::Data(format!(
                    "{}: none of its {} places lies on a surface; give them in the units of the \
                     scan",
                    file.display(),
                    known.len()
                )));
            }
            return Ok(Ok(found));
        }
        let name = format!("{}, reference", one.setting.name);
        let error = LightJudge::REFERENCE_ERROR.to_string();
        let options = ["--direct", "--error", &error].map(str::to_owned);
        let output = TempLight(one.path.with_extension("reference.light"));
        let files = (self.lights, self.source.octree(), one.path);
        let job = Job::light(self.args, name, files, &options, &output.0);
        match child::run(&job, self.watch)? {
            Ended::Stopped => return Ok(Err(format!("stopped at {} s", self.args.limit))),
            Ended::Refused(why) => return Ok(Err(why)),
            Ended::Done(_) => {}
        }
        let bytes = Mapped::open(&output.0)?;
        let light = LightView::open(&bytes).map_err(|e| damaged(&output, e))?;
        let found = Yardstick::of_light((&output.0, &light), (one.path, one.map.view()))?;
        if found.is_empty() {
            return Ok(Err("no surfel has a normal".to_owned()));
        }
        Ok(Ok(found))
    }

    /// Lights a map in one way, and says how far that is off.
    fn light(
        &self,
        one: &OneMap<'_>,
        way: Way,
        yardstick: &Yardstick,
        is_heard: bool,
    ) -> Result<LitOutcome, Error> {
        let name = format!("{}, {}", one.setting.name, way.name());
        let output = TempLight(one.path.with_extension("light"));
        let files = (self.lights, self.source.octree(), one.path);
        let mut job = Job::light(self.args, name.clone(), files, &options(way), &output.0);
        job.is_heard = is_heard;
        let measured = match child::run_often(&job, self.watch)? {
            Ended::Stopped => return Ok(LitOutcome::Stopped(self.args.limit as f64)),
            Ended::Refused(why) => return Ok(LitOutcome::Refused(why)),
            Ended::Done(measured) => measured,
        };
        let bytes = Mapped::open(&output.0)?;
        let light = LightView::open(&bytes).map_err(|e| damaged(&output, e))?;
        let off = yardstick.off((&output.0, &light), (one.path, one.map.view()))?;
        let summary = light.summary();
        let lit = Lit {
            map: one.built.clone(),
            seconds: measured.of_clock(self.args),
            light_seconds: measured.seconds,
            cpu_seconds: measured.cpu_seconds,
            peak_bytes: measured.peak_bytes,
            order: summary.order,
            iterations: summary.iterations,
            operator_error: summary.operator_error,
            off,
        };
        self.watch.note(&format!("{name}: {:.2} s, error {} %", lit.seconds, percent(off.mean)));
        Ok(LitOutcome::Lit(Box::new(lit)))
    }
}

/// Gives the options of `pvmap light` that a way stands for.
fn options(way: Way) -> Vec<String> {
    match way {
        Way::Order(p) => vec!["--order".to_owned(), p.to_string()],
        Way::Direct => vec!["--direct".to_owned()],
        Way::Error(e) => vec!["--error".to_owned(), e.to_string()],
    }
}

/// A light file that is gone when it is dropped.
struct TempLight(PathBuf);

impl Drop for TempLight {
    fn drop(&mut self) {
        // Gone at the end in any case.
        let _ = std::fs::remove_file(&self.0);
    }
}

fn damaged(light: &TempLight, e: FormatError) -> Error {
    Error::artifact(&light.0, e)
}

fn print(args: &Args, rows: &[LitRow], subject: &LightSubject, is_stopped: bool) -> io::Result<()> {
    if args.json {
        return print_json(&as_json(args, rows, subject, is_stopped));
    }
    io::stdout().lock().write_all(table::text(rows, subject, args.want).as_bytes())
}

fn as_json(args: &Args, rows: &[LitRow], subject: &LightSubject, is_stopped: bool) -> Value {
    let choice = args.want.and_then(|wish| choose(rows, wish));
    let recommended = choice.map(|choice| {
        let row = &rows[choice.row];
        let light = row.way.map(Way::name);
        json!({ "setting": row.setting.name, "light": light, "is_met": choice.is_met })
    });
    let places = match &subject.judge {
        LightJudge::Places { n, .. } => Some(n),
        LightJudge::Reference => None,
    };
    let rows = rows.iter().zip(front(rows)).map(row_json).collect::<Vec<_>>();
    json!({
        "source": subject.name,
        "points": subject.n_points,
        "lights": subject.lights,
        "judge": subject.judge.word(),
        "places": places,
        "compared_by": if args.cpu { "light_cpu_seconds" } else { "light_seconds" },
        "rows": rows,
        "want": args.want.map(|wish| wish.to_string()),
        "recommended": recommended,
        "stopped": is_stopped,
    })
}

fn row_json((row, on_front): (&LitRow, bool)) -> Value {
    let mut value = setting_json(&row.setting);
    let fields = [
        ("light", json!(row.way.map(Way::name))),
        ("outcome", json!(row.outcome.word())),
        ("why_not", json!(row.outcome.why_not())),
        ("on_front", json!(on_front)),
    ];
    value.extend(fields.map(|(key, value)| (key.to_owned(), value)));
    value.extend(row.lit().into_iter().flat_map(lit_json));
    Value::from(value)
}

fn lit_json(lit: &Lit) -> serde_json::Map<String, Value> {
    let fields = [
        ("build_seconds", json!(lit.map.build_seconds)),
        ("build_cpu_seconds", json!(lit.map.cpu_seconds)),
        ("build_peak_rss_anon_bytes", json!(lit.map.peak_bytes)),
        ("leaves", json!(lit.map.n_leaves)),
        ("links", json!(lit.map.n_links)),
        ("map_bytes", json!(lit.map.map_bytes)),
        ("light_seconds", json!(lit.light_seconds)),
        ("light_cpu_seconds", json!(lit.cpu_seconds)),
        ("light_peak_rss_anon_bytes", json!(lit.peak_bytes)),
        ("order", json!(lit.order)),
        ("iterations", json!(lit.iterations)),
        ("operator_error", json!(lit.operator_error)),
        ("judged", json!(lit.off.n)),
        ("left_out", json!(lit.off.n_left_out)),
        ("mean_error", json!(lit.off.mean)),
        ("bias", json!(lit.off.bias)),
        ("largest_error", json!(lit.off.largest)),
    ];
    fields.map(|(key, value)| (key.to_owned(), value)).into_iter().collect()
}
