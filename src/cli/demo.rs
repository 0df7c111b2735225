//! placeholder
use super::{Context, Outcome};
/// The whole way.
#[derive(Debug, clap::Args)]
pub(super) struct Args {}
pub(super) fn run(_: &Args, _: &Context) -> Outcome {
    todo!()
}
