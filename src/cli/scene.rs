//! `pvmap scene`: a generated scan with known truth.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::scene::{MOST_POINTS, Mesh, Scene, SceneError, SceneKind, Up};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{Error, Limits, Watch, is_input};

use super::defects::DefectArgs;
use super::{Context, Outcome, parse_count, read_mesh, refuse_input};

/// Write a generated scene as a scan file, with normals and colours
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Scenes, in metres:
  empty       the Cornell room, 5.5 m wide: red wall left, green wall right
  packed      the room filled by one large box
  furnished   the room with a sphere and a box
  cave        a cavern with columns and niches, different for every seed
  cornell     the room with models in a row on its floor as statues; without any it is empty, or
              with --packed packed

A model is a PLY mesh, plain or packed by gzip. Points lie evenly by area on room and statues
alike, with the normals of the model's vertices where it has some, else of its triangles, turned
outward. A statue is 3 m long at its longest side, or less where several share the room.

A scan is without defects unless some are asked for; pvmap tradeoff SCENE --defects measures what
each of them costs.

The same name, models, points, seed, order and defects give the same bytes. LAS and LAZ hold places
to 0.1 mm.

Examples:
  pvmap scene cave -o cave.ply
  pvmap scene furnished --points 20M --seed 7 -o room.las --shuffle
  pvmap scene cave --noise 3mm --holes 5% --flip-normals 1% -o rough.laz
  pvmap scene cornell --model bunny.ply -o room.ply --truth room.mesh.ply
  pvmap scene cornell --model a.ply --model b.ply.gz --points 100k,50k,50k -o two.ply")]
pub(super) struct Args {
    /// empty, packed, furnished, cave or cornell
    #[arg(value_parser = parse_name)]
    name: Name,
    /// How many points: 400000, 400k, 20M; or how many for the room and for
    /// each model, N,N1,N2 [default: 400k]
    #[arg(
        long,
        verbatim_doc_comment,
        hide_default_value = true,
        default_value = "400k",
        value_parser = parse_count,
        value_delimiter = ',',
        value_name = "N"
    )]
    points: Vec<u64>,
    /// What the points (and a cave's shape) are drawn from
    #[arg(long, default_value_t = 1, value_name = "S")]
    seed: u64,
    /// The file to write, or replace; its ending (.las, .laz, .ply) says how
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Random order instead of a scanner's
    #[arg(long)]
    shuffle: bool,
    /// A mesh to stand in the room cornell; several stand side by side
    #[arg(long = "model", value_name = "MESH.ply", conflicts_with = "packed")]
    models: Vec<PathBuf>,
    /// Which axis of the models points up, y or z
    #[arg(long, default_value = "y", value_name = "AXIS", requires = "models")]
    up: Up,
    /// The longest side of each statue, in metres [default: 3, or what fits]
    #[arg(long, value_parser = parse_size, value_name = "M", requires = "models")]
    size: Option<f64>,
    /// Fill the room cornell with one large box
    #[arg(long)]
    packed: bool,
    #[command(flatten)]
    defects: DefectArgs,
    /// Write the exact triangles, too, as a PLY mesh (not of furnished)
    #[arg(long, value_name = "MESH.ply")]
    truth: Option<PathBuf>,
    /// Most memory that models take, at least 64MiB
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
}

/// Which scene is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Name {
    Kind(SceneKind),
    Cornell,
}

fn parse_name(name: &str) -> Result<Name, SceneError> {
    if name == "cornell" { Ok(Name::Cornell) } else { name.parse().map(Name::Kind) }
}

/// Reads a length.
fn parse_size(text: &str) -> Result<f64, String> {
    let size = text.parse().ok().filter(|&v: &f64| v > 0.0 && v.is_finite());
    size.ok_or_else(|| format!("{text:?} is no length above 0, in metres"))
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    if args.name != Name::Cornell && (args.packed || !args.models.is_empty()) {
        let message = "--model and --packed are for the scene cornell".to_owned();
        return Err(Error::Usage(message).into());
    }
    refuse_input(&args.output, &args.models)?;
    if let Some(truth) = &args.truth {
        refuse_input(truth, &args.models)?;
        if *truth == args.output || is_input(truth, std::slice::from_ref(&args.output))? {
            let message = format!("{}: scan and truth cannot be one file", truth.display());
            return Err(Error::Usage(message).into());
        }
        if args.name == Name::Kind(SceneKind::Furnished) {
            let source = SceneError::Round;
            return Err(Error::Scene { path: truth.clone(), source }.into());
        }
    }
    let n_points = args.points.iter().sum();
    if n_points > MOST_POINTS {
        let message = format!("--points: {n_points}, a scene has at most {MOST_POINTS}");
        return Err(Error::Usage(message).into());
    }
    let scene = scene(args, context)?;
    let scene = match &args.points[..] {
        [_] => scene,
        parts if parts.len() == scene.n_parts() => scene.shared_out(parts),
        parts => {
            let (given, wanted) = (parts.len(), scene.n_parts());
            let message = format!("--points: {given} numbers given, expected 1 or {wanted}");
            return Err(Error::Usage(message).into());
        }
    };
    let request = SceneRequest { n_points, shuffle: args.shuffle };
    let points = request.with(&scene, &args.defects.defects());
    let (limits, watch) = (Limits::default(), &context.progress);
    match &args.truth {
        None => scenes::write_scan(&points, &args.output, &limits, watch)?,
        Some(truth) => {
            scenes::write_with_truth(&points, [&args.output, truth], &limits, watch)?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn scene(args: &Args, context: &Context) -> Result<Scene, Error> {
    let kind = match args.name {
        Name::Kind(kind) => kind,
        Name::Cornell if args.packed => SceneKind::Packed,
        Name::Cornell => SceneKind::Empty,
    };
    if args.models.is_empty() {
        return Ok(Scene::new(kind, args.seed));
    }
    context.progress.stage("models", Some(args.models.len() as u64), "models");
    let mut left_bytes = args.memory;
    let statue = |path: &PathBuf| {
        context.progress.check()?;
        let model = read_mesh(path, left_bytes)?;
        left_bytes -= model.held_bytes;
        context.progress.advance(1);
        Ok(model.mesh.upright(args.up))
    };
    let statues: Vec<Mesh> = args.models.iter().map(statue).collect::<Result<_, Error>>()?;
    Scene::with_statues(args.seed, statues, args.size).map_err(|source| {
        let i = match source {
            SceneError::TooMany { most, .. } => most,
            SceneError::TooLarge { statue, .. } => statue - 1,
            _ => 0,
        };
        let path: &Path = &args.models[i];
        Error::Scene { path: path.to_path_buf(), source }
    })
}
