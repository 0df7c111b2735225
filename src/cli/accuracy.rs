//! `pvmap accuracy`: how often a map is right.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::accuracy::{self, Comparison, Drawn, ScanPoints, Tally, Way, wilson};
use pvmap::query::Map;
use pvmap::query::exact::{Exact, check_pair};
use pvmap::scene::Scene;
use pvmap::{Error, Watch};
use serde_json::{Value, json};

use super::exact::{Nearness, Points};
use super::{Context, Outcome, map_file, parse_some, print_json, read_mesh};

/// Compare answers of a map with the exact triangles of its scene
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Random pairs of places are asked of the map and of the triangles. With --octree the places are
points of the scan, each with its normal; the triangles are then asked at the place nearest to the
point on a triangle whose front is within 60° of that normal. Without it they are places on the
triangles, even by area, with the triangles' normals.

In truth two places see each other where both triangles turn their front (counter-clockwise) to
the other place and no third triangle crosses the segment between them, whichever its front. A
triangle that holds an end, to within 1e-12 of the mesh's extent, hides nothing from that end.

The map is asked twice: its leaves, as pvmap query MAP pair asks them, and the segments between
the places, as with --segment there. A map with visible fractions answers by them, too: yes where
half of the segments or more are free. With --exact the points of the octree are asked, too.

Output, with 95 % intervals (Wilson); shares of all pairs, then of those that were answered:
  face each other      by the triangles' fronts, whatever is between
  see each other       by the triangles
  left out             with --octree: pairs with a place farther from the triangles than a
                       hundredth of their extent, counted nowhere else
  agree                answers of the map that are those of the triangles
  agree, facing        the same, of the pairs that face each other
  wrongly visible      the map says yes, the triangles no
  wrongly invisible    the map says no, the triangles yes
  visible, wrong       of the pairs that the map says see each other those that do not
  squared error        the mean square of how much is said to be seen less what is in truth, 1 or
                       0: for answers that are yes or no the share that is wrong
  refused              pairs without an answer: a place is outside the cube
  far                  pairs that a map answered although a place is so far from its surfel that
                       pvmap query MAP pair would ask for --snap

Examples:
  pvmap scene cornell --model bunny.ply -o room.ply --truth room.mesh.ply
  pvmap ingest room.ply
  pvmap build room.octree
  pvmap accuracy room.vmap --truth room.mesh.ply --octree room.octree
  pvmap accuracy room.vmap --truth room.mesh.ply --octree room.octree --exact")]
pub(super) struct Args {
    /// The map, as pvmap build makes it
    #[arg(value_name = "NAME.vmap")]
    map: PathBuf,
    /// The exact triangles, a PLY mesh, as pvmap scene --truth writes it
    #[arg(long, value_name = "MESH.ply")]
    truth: PathBuf,
    /// Draw points of the scan instead of places on the triangles
    #[arg(long, value_name = "NAME.octree")]
    octree: Option<PathBuf>,
    /// Ask the points of the octree, too: a third column
    #[arg(long, requires = "octree")]
    exact: bool,
    #[command(flatten)]
    nearness: Nearness,
    /// How many pairs
    #[arg(long, default_value = "100k", value_parser = parse_some, value_name = "N")]
    pairs: u64,
    /// What the pairs are drawn from
    #[arg(long, default_value_t = 1, value_name = "S")]
    seed: u64,
    /// Most memory that the triangles take, at least 64MiB
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
    /// Answer as one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let watch = &context.progress;
    let (path, bytes) = map_file(&args.map)?;
    let map = Map::open(&bytes).map_err(|e| named(&path, e.into()))?;
    let octree = args.octree.as_deref().map(Points::open).transpose()?;
    let view = octree.as_ref().map(Points::view).transpose()?;
    watch.stage("truth", None, "triangles");
    let truth = Scene::of_mesh(&read_mesh(&args.truth, args.memory)?.mesh, args.seed);
    watch.advance(truth.n_surfaces() as u64);
    watch.stage("accuracy", Some(args.pairs), "pairs");
    let mut ways = vec![Way::leaves(&map), Way::segments(&map)];
    ways.extend(map.has_fractions().then(|| Way::fractions(&map)));
    if let (Some(points), Some(view)) = (&octree, &view) {
        let refuse = |e| points.named(&path, e);
        check_pair(map.view(), view).map_err(refuse)?;
        if args.exact {
            let options = args.nearness.options(&map).map_err(refuse)?;
            ways.push(Way::points(Exact::new(view, options)));
        }
    }
    let mut ask = |draw: &mut dyn FnMut(&mut fastrand::Rng) -> Result<Drawn, Error>| {
        accuracy::compare(&truth, (args.pairs, args.seed), draw, &mut ways, watch).map_err(|e| {
            match (e, &octree) {
                (Error::Query(e), Some(points)) => points.named(&path, e),
                (e, _) => named(&path, e),
            }
        })
    };
    let found = match (&octree, &view) {
        (Some(octree), Some(view)) => {
            let points = ScanPoints::new(view, octree.path())?;
            ask(&mut |rng| points.draw(&truth, rng))?
        }
        _ => ask(&mut |rng| Ok(accuracy::draw_place(&truth, rng)))?,
    };
    if found.tallies.iter().all(|t| t.n_pairs == 0) {
        let message = format!(
            "{}: none of the pairs lies both in the map and on the triangles; give the truth of \
             this scan, in its units",
            args.truth.display()
        );
        return Err(Error::Data(message).into());
    }
    if args.json {
        print_json(&as_json(&found, truth.n_surfaces()))?;
    } else {
        print(args, &found, truth.n_surfaces())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Says which map an error is about, where it is about the map.
fn named(path: &std::path::Path, e: Error) -> Error {
    match e {
        Error::Query(pvmap::query::QueryError::Format(e)) => Error::artifact(path, e),
        e => e,
    }
}

/// A count of a way's answers, and of how many it is a part.
type Row = (&'static str, fn(&Tally) -> [u64; 2]);

const ROWS: [Row; 5] = [
    ("agree", |t| [t.n_agreeing(), t.n_pairs]),
    ("agree, facing", |t| [t.n_agreeing_facing(), t.n_facing]),
    ("wrongly visible", |t| [t.n_false_visible, t.n_pairs]),
    ("wrongly invisible", |t| [t.n_false_invisible, t.n_pairs]),
    ("visible, wrong", |t| [t.n_false_visible, t.n_said_visible]),
];

/// Writes a share with its 95 % interval.
fn share([k, n]: [u64; 2]) -> String {
    let [low, high] = wilson(k, n).map(|v| 100.0 * v);
    format!("{:.3} % ({low:.3} – {high:.3})", 100.0 * k as f64 / n.max(1) as f64)
}

fn print(args: &Args, found: &Comparison, n_triangles: usize) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let from = match &args.octree {
        Some(octree) => format!("points of {}", octree.display()),
        None => format!("places on {}", args.truth.display()),
    };
    writeln!(
        out,
        "{} pairs of {from} (seed {}), against {n_triangles} triangles\n",
        found.n_pairs, args.seed
    )?;
    let of_all = |k: u64| share([k, found.n_pairs]);
    writeln!(out, "{:<22}{:>32}", "face each other", of_all(found.n_facing))?;
    writeln!(out, "{:<22}{:>32}", "see each other", of_all(found.n_visible))?;
    writeln!(out, "{:<22}{:>32}\n", "left out", found.n_left_out)?;
    let columns = |cell: &dyn Fn(&Tally) -> String| {
        found.tallies.iter().map(|t| format!("{:>32}", cell(t))).collect::<String>()
    };
    writeln!(out, "{:<22}{}", "answered by", columns(&|t| t.name.to_owned()))?;
    for (name, count) in ROWS {
        writeln!(out, "{name:<22}{}", columns(&|t| share(count(t))))?;
    }
    let squared = |t: &Tally| format!("{:.3} %", 100.0 * t.squared_error());
    writeln!(out, "{:<22}{}", "squared error", columns(&squared))?;
    writeln!(out, "{:<22}{}", "refused", columns(&|t| t.n_refused.to_string()))?;
    writeln!(out, "{:<22}{}", "far", columns(&|t| t.n_far.to_string()))?;
    writeln!(out, "{:<22}{}", "answers a second", columns(&|t| format!("{:.0}", found.rate(t))))
}

fn as_json(found: &Comparison, n_triangles: usize) -> Value {
    let way = |t: &Tally| {
        let mut way = json!({
            "name": t.name,
            "answered": t.n_pairs,
            "refused": t.n_refused,
            "far": t.n_far,
            "answers_per_second": found.rate(t),
            "squared_error": t.squared_error(),
        });
        for (name, count) in ROWS {
            let [k, n] = count(t);
            let [low, high] = wilson(k, n);
            let share = k as f64 / n.max(1) as f64;
            way[name.replace(", ", "_").replace(' ', "_")] =
                json!({ "n": k, "of": n, "share": share, "low": low, "high": high });
        }
        way
    };
    json!({
        "pairs": found.n_pairs,
        "left_out": found.n_left_out,
        "facing": found.n_facing,
        "visible": found.n_visible,
        "triangles": n_triangles,
        "ways": found.tallies.iter().map(way).collect::<Vec<_>>(),
    })
}
