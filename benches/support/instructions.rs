//! Counts the instructions of a whole process.
//!
//! Cachegrind with its caches switched off: it counts instructions and nothing else, needs no
//! library in the program counted (which gungraun does, and a runner of its own version beside it)
//! and writes the sum into one line. The processor that valgrind plays has AVX2 at most, so the
//! counts are those of the AVX2 paths on every machine that has it.

use std::error::Error;
use std::process::Command;

/// Says whether valgrind can be run.
pub(crate) fn can_count() -> bool {
    Command::new("valgrind").arg("--version").output().is_ok_and(|o| o.status.success())
}

/// Runs a command to its end and counts.
///
/// # Errors
/// Where it cannot be started, fails, or valgrind does not tell the sum.
pub(crate) fn of(command: &Command) -> Result<u64, Box<dyn Error>> {
    let mut counted = Command::new("valgrind");
    counted.args(["--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null"]);
    counted.arg(command.get_program()).args(command.get_args());
    let output = counted.output()?;
    let said = String::from_utf8_lossy(&output.stderr);
    let sum = said.lines().rev().find_map(sum_in).filter(|_| output.status.success());
    Ok(sum.ok_or_else(|| format!("{counted:?}: {said}"))?)
}

/// Reads `==123== I   refs:      1,234,567`.
fn sum_in(line: &str) -> Option<u64> {
    let (_, number) = line.split_once("refs:").filter(|(name, _)| name.contains(" I "))?;
    number.trim().replace(',', "").parse().ok()
}
