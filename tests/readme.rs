//! What the README tells a reader to type does what it says.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::path::Path;
use std::process::Command;

use cli_common::{Bench, Run};

/// Points of the README's scene, and of this test's: a debug build is slow.
const POINTS: (&str, &str) = ("--points 200k", "--points 20k");

#[test]
fn the_commands_for_a_scan_of_ones_own_work_as_written() {
    let text = include_str!("../README.md");
    let (_, own_scan) = text.split_once("## With your own scan").unwrap();
    let lines = own_scan.lines().filter_map(|line| line.strip_prefix("    "));
    let lines: Vec<String> = lines.map(|line| line.replace(POINTS.0, POINTS.1)).collect();
    assert!(lines.len() > 5 && lines[0].contains(POINTS.1), "{lines:?}");

    let bench = Bench::new();
    let folder = Path::new(env!("CARGO_BIN_EXE_pvmap")).parent().unwrap();
    let path = std::env::join_paths(
        [folder.to_path_buf()].into_iter().chain(std::env::split_paths(env!("PATH"))),
    );
    let run = |line: &str| {
        let mut shell = Command::new("sh");
        shell.args(["-c", line]).current_dir(bench.path("")).env("PATH", path.as_ref().unwrap());
        Run::of(shell).ok()
    };
    for line in &lines {
        let stdout = run(line).stdout;
        match line.split_whitespace().nth(3) {
            Some("pair") => assert!(stdout.starts_with("yes"), "{stdout}"),
            Some("pairs") => assert_eq!(stdout.lines().count(), 2, "{stdout}"),
            _ => {}
        }
    }
    let made = [
        "grotto.laz",
        "grotto.light",
        "grotto.octree",
        "grotto.vmap",
        "lights.toml",
        "lit.png",
        "rows.csv",
        "seen.laz",
    ];
    assert_eq!(bench.names(), made);
}
