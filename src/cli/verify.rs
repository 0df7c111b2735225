//! `pvmap verify`: every byte of an artifact.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::Error;
use pvmap::vmap::container::kind_of;
use pvmap::vmap::{Kind, MapView, OctreeView};

use super::{Outcome, map_file};

/// Check every byte of an octree or a map, and every rule of the format.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  pvmap verify grotto.vmap && cp grotto.vmap /archive/")]
pub(super) struct Args {
    /// A .vmap file or an .octree folder.
    file: PathBuf,
}

pub(super) fn run(args: &Args) -> Outcome {
    let (path, bytes) = map_file(&args.file)?;
    let checked = match kind_of(&bytes) {
        Some(Kind::Octree) => OctreeView::open(&bytes).and_then(|v| v.verify()),
        _ => MapView::open(&bytes).and_then(|v| v.verify()),
    };
    checked.map_err(|e| Error::artifact(&path, e))?;
    writeln!(std::io::stdout().lock(), "{}: sound", args.file.display())?;
    Ok(ExitCode::SUCCESS)
}
