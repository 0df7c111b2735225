//! placeholder
use super::Outcome;
/// Ask a map.
#[derive(Debug, clap::Args)]
pub(super) struct Args {}
pub(super) fn run(_: &Args) -> Outcome {
    todo!()
}
