//! `pvmap scene`: a generated scan with known truth.

use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::Limits;
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};

use super::{Context, Outcome, parse_count};

/// Write a generated scene as a scan file, with normals and colours
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Scenes, in metres:
  empty       the Cornell room, 5.5 m wide: red wall left, green wall right
  packed      the room filled by one large box
  furnished   the room with a sphere and a box
  cave        a cavern with columns and niches, different for every seed

The same name, points, seed and order give the same bytes. LAS and LAZ hold places to 0.1 mm.

Examples:
  pvmap scene cave -o cave.ply
  pvmap scene furnished --points 20M --seed 7 -o room.las --shuffle")]
pub(super) struct Args {
    /// empty, packed, furnished or cave
    name: SceneKind,
    /// How many points: 400000, 400k, 20M
    #[arg(long, default_value = "400k", value_parser = parse_count, value_name = "N")]
    points: u64,
    /// What the points (and a cave's shape) are drawn from
    #[arg(long, default_value_t = 1, value_name = "S")]
    seed: u64,
    /// The file to write, or replace; its ending (.las, .laz, .ply) says how
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Random order instead of a scanner's
    #[arg(long)]
    shuffle: bool,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let scene = Scene::new(args.name, args.seed);
    let request = SceneRequest { n_points: args.points, shuffle: args.shuffle };
    scenes::write(&scene, &request, &args.output, &Limits::default(), &context.progress)?;
    Ok(ExitCode::SUCCESS)
}
