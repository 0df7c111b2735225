//! The command `pvmap`: what sees what in a point scan.

mod cli;
mod progress;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
