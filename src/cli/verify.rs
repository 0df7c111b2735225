//! `pvmap verify`: every byte of an artifact.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::vmap::container::kind_of;
use pvmap::vmap::{Kind, LightView, MapView, OctreeView};
use pvmap::{Error, Watch};

use super::{Context, Outcome, map_file};

/// Check every byte of an octree, a map or a light file, and every rule of the format
#[derive(Debug, clap::Args)]
#[command(after_help = "\
It ends with 0 where all is well, and with 65 and the section and byte of the first damage.

Examples:
  pvmap verify grotto.octree
  pvmap verify grotto.light
  pvmap verify grotto.vmap && cp grotto.vmap /archive/")]
pub(super) struct Args {
    /// A .vmap or .light file or an .octree folder
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let (path, bytes) = map_file(&args.file)?;
    let progress = &context.progress;
    let mut tell = |n| progress.advance(n);
    let checked = match kind_of(&bytes) {
        Some(Kind::Octree) => OctreeView::open(&bytes).and_then(|view| {
            progress.stage("verify", Some(view.verify_bytes()), "bytes");
            view.verify_telling(&mut tell)
        }),
        Some(Kind::Light) => LightView::open(&bytes).and_then(|view| {
            progress.stage("verify", Some(view.verify_bytes()), "bytes");
            view.verify_telling(&mut tell)
        }),
        _ => MapView::open(&bytes).and_then(|view| {
            progress.stage("verify", Some(view.verify_bytes()), "bytes");
            view.verify_telling(&mut tell)
        }),
    };
    checked.map_err(|e| Error::artifact(&path, e))?;
    context.progress.take_stages();
    writeln!(std::io::stdout().lock(), "{}: sound", args.file.display())?;
    Ok(ExitCode::SUCCESS)
}
