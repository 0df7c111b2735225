//! `pvmap tradeoff SCENE --defects`: what noise, density, holes and wrong normals cost.

use std::io::{self, Write};
use std::process::ExitCode;

use pvmap::accuracy::ScanPoints;
use pvmap::scene::{MOST_POINTS, Scene};
use pvmap::scenes::SceneRequest;
use pvmap::tradeoff::defects::{Case, Defect, DefectKind, plot, table};
use pvmap::tradeoff::{Judge, Sample, Setting, Truth};
use pvmap::{Error, Limits, NormalsFrom, Watch};
use serde_json::{Value, json};

use super::super::defects::{parse_length, parse_missing, parse_ratio, parse_share};
use super::super::{Context, Outcome, parse_some, print_json};
use super::source::{self, Source};
use super::{Args, Outputs, measure_all, n_pairs, rows_json, subject, sweep_of};

/// The settings that are tried on every scan, where none are asked for.
const SETTINGS: [&str; 2] = ["depth8", "accurate"];

/// Which defects to try.
#[derive(Debug, Clone, Default, clap::Args)]
pub(super) struct DefectArgs {
    /// Try all of the following, with usual values where none are given
    #[arg(long)]
    defects: bool,
    /// Numbers of points
    #[arg(long, value_delimiter = ',', value_parser = parse_some, value_name = "N,…")]
    density: Vec<u64>,
    /// Standard deviations of the distance from the surface, along its
    /// normal: 0.5mm, 1cm, 0.003 (metres)
    #[arg(
        long,
        value_delimiter = ',',
        value_parser = parse_length,
        value_name = "D,…",
        verbatim_doc_comment
    )]
    noise: Vec<f64>,
    /// How many times denser points are at the least x than at the greatest
    #[arg(long, value_delimiter = ',', value_parser = parse_ratio, value_name = "R,…")]
    uneven: Vec<f64>,
    /// Shares of the points that are missing, in balls of a 25th of the
    /// extent: 5%, 0.05
    #[arg(
        long,
        value_delimiter = ',',
        value_parser = parse_missing,
        value_name = "SHARE,…",
        verbatim_doc_comment
    )]
    holes: Vec<f64>,
    /// Shares of the points without a normal
    #[arg(long, value_delimiter = ',', value_parser = parse_share, value_name = "SHARE,…")]
    no_normals: Vec<f64>,
    /// Shares of the points whose normal has the wrong sign
    #[arg(long, value_delimiter = ',', value_parser = parse_share, value_name = "SHARE,…")]
    flip_normals: Vec<f64>,
    /// Estimate the normals of all these scans from their points
    #[arg(long)]
    estimate_normals: bool,
}

impl DefectArgs {
    /// Says whether scans with defects are wanted, and no sweep over settings.
    pub(super) fn are_asked_for(&self) -> bool {
        self.defects
            || self.estimate_normals
            || DefectKind::ALL.iter().any(|&k| !self.values(k).is_empty())
    }

    fn values(&self, kind: DefectKind) -> Vec<f64> {
        match kind {
            DefectKind::Density => self.density.iter().map(|&n| n as f64).collect(),
            DefectKind::Noise => self.noise.clone(),
            DefectKind::Unevenness => self.uneven.clone(),
            DefectKind::Holes => self.holes.clone(),
            DefectKind::NoNormals => self.no_normals.clone(),
            DefectKind::FlippedNormals => self.flip_normals.clone(),
        }
    }

    /// Lists the scans: first as it is, then each defect by itself. Values that change nothing are
    /// the first.
    fn list(&self, n_points: u64) -> Vec<Option<Defect>> {
        let mut found: Vec<Option<Defect>> = vec![None];
        for kind in DefectKind::ALL {
            let mut values = self.values(kind);
            if values.is_empty() && self.defects {
                values = kind.usual(n_points);
            }
            for value in values.into_iter().filter(|&v| v != kind.plain_value(n_points)) {
                let defect = Some(Defect { kind, value });
                if !found.contains(&defect) {
                    found.push(defect);
                }
            }
        }
        found
    }
}

/// Measures the settings on a scan for each defect.
pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let Some(kind) = source::kind_of(args)? else {
        let source = args.source.display();
        let message =
            format!("{source}: defects are those of a generated scene, such as furnished");
        return Err(Error::Usage(message).into());
    };
    if args.want.is_some() {
        let message = "--want chooses among settings; leave the defects away for it".to_owned();
        return Err(Error::Usage(message).into());
    }
    let n_points = args.points.unwrap_or(source::POINTS);
    if args.defects.density.iter().any(|&n| n > MOST_POINTS) {
        return Err(Error::Usage(format!("--density: give 1 to {MOST_POINTS}")).into());
    }
    let settings = sweep_of(args, &SETTINGS)?.settings;
    let n_pairs = n_pairs(args)?;
    let outputs = Outputs::begin(args, &table::CSV_HEADER)?;
    let scene = Scene::new(kind, args.seed);
    let mut cases = Vec::new();
    let measured = measure(args, &scene, (n_points, n_pairs), &settings, context, &mut cases);
    outputs.finish(
        (measured, !cases.is_empty()),
        |file| table::write_csv(file, &cases),
        || plot::draw(&cases),
        |is_stopped| print(args, &cases, is_stopped),
    )?;
    Ok(ExitCode::SUCCESS)
}

/// Makes the scans one after the other, and builds and asks every setting on each.
fn measure(
    args: &Args,
    scene: &Scene,
    (n_points, n_pairs): (u64, u64),
    settings: &[Setting],
    context: &Context,
    cases: &mut Vec<Case>,
) -> Result<(), Error> {
    let watch = &context.progress;
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    let normals = match args.defects.estimate_normals {
        true => NormalsFrom::Estimate,
        false => NormalsFrom::Auto,
    };
    let defects = args.defects.list(n_points);
    let n_scans = defects.len();
    for (i, defect) in defects.into_iter().enumerate() {
        watch.check()?;
        let name = defect.map_or_else(|| "as it is".to_owned(), |defect| defect.name());
        watch.note(&format!("scan {} of {n_scans}: {name}", i + 1));
        let (n, defects) =
            defect.map_or_else(|| (n_points, Default::default()), |d| d.apply(n_points));
        let scan = SceneRequest { n_points: n, shuffle: false }.with(scene, &defects);
        let source = Source::of_scan(&scan, normals, &limits, watch)?;
        let file = pvmap::open_octree(source.octree())?;
        let view = source.view(&file)?;
        let points = ScanPoints::new(&view, source.octree())?;
        let truth = Truth::Recorded(&scan);
        let drawn = limits.run(|| Sample::draw(&truth, &points, (n_pairs, args.seed), watch))?;
        let sample = drawn.map_err(|e| source.named(e))?;
        let subject = subject(args, view.summary().n_points, &sample, Judge::Geometry)?;
        let mut rows = Vec::new();
        let measured = measure_all(args, settings, (&source, &view), &sample, context, &mut rows);
        if !rows.is_empty() {
            cases.push(Case { defect, subject, rows });
        }
        measured?;
    }
    Ok(())
}

fn print(args: &Args, cases: &[Case], is_stopped: bool) -> io::Result<()> {
    if args.json {
        return print_json(&as_json(cases, is_stopped));
    }
    io::stdout().lock().write_all(table::text(cases).as_bytes())
}

fn as_json(cases: &[Case], is_stopped: bool) -> Value {
    let scans = cases.iter().map(|case| {
        json!({
            "scan": case.name(),
            "defect": case.defect.map(|defect| defect.kind.word()),
            "value": case.defect.map(|defect| defect.value),
            "points": case.subject.n_points,
            "facing": case.subject.n_facing,
            "visible": case.subject.n_visible,
            "settings": rows_json(&case.rows),
        })
    });
    let scans: Vec<Value> = scans.collect();
    let subject = cases.first().map(|case| &case.subject);
    json!({
        "source": subject.map(|s| &s.name),
        "seed": subject.map(|s| s.seed),
        "pairs": subject.map(|s| s.n_drawn),
        "judge": subject.map(|s| s.judge.word()),
        "compared_by": subject.map(|s| s.clock.column()),
        "scans": scans,
        "stopped": is_stopped,
    })
}
