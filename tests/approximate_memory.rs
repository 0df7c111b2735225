//! Approximate builds hold no more than they may, however many coarser trees they have, and neither
//! do those that try pairs by samples. Source: DESIGN.md [D-9].
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::fmt::Write as _;

use cli_common::{Bench, MIB, allowed_bytes, ply_header};

/// Builds with 64 MiB and two or eight threads, and demands that each build holds what it may.
fn builds_within_64_mib(bench: &Bench, options: &str) {
    for n_threads in [2, 8] {
        let line = format!("build a.octree {options} --memory 64MiB --threads {n_threads}");
        let run = bench.line(&format!("{line} --progress off")).ok();
        let (held, allowed) = (run.anon_bytes / MIB, allowed_bytes(64 * MIB, n_threads) / MIB);
        assert!(held <= allowed, "{held} MiB held, {allowed} MiB allowed: {line}");
    }
}

#[test]
fn d9_a_cave_in_coarser_trees_or_tried_by_samples_stays_within_the_memory() {
    let bench = Bench::new();
    bench.line("scene cave --points 40k -o a.ply --progress off").ok();
    bench.line("ingest a.ply --progress off").ok();
    for angle in ["0.15", "0.3"] {
        let options = format!("--max-level 8 --leaf-capacity 12 --opening-angle {angle}");
        builds_within_64_mib(&bench, &options);
    }
    for tried in ["--fractions", "--min-exchange 1e-6", "--opening-angle 0.15 --fractions"] {
        let options = format!("--max-level 8 --leaf-capacity 12 {tried}");
        builds_within_64_mib(&bench, &options);
    }
}

#[test]
fn d9_twenty_coarser_trees_stay_within_the_memory() {
    let bench = Bench::new();
    // Clouds around one place, each half as wide as the one before: leaves on every level.
    let (mut random, n) = (fastrand::Rng::with_seed(5), 120);
    let mut text = ply_header(19 * n, &["x", "y", "z", "nx", "ny", "nz"]);
    for halved in 0..19 * n {
        let wide = 0.5f64.powi((halved / n) as i32);
        for _ in 0..3 {
            write!(text, "{} ", wide * (random.f64() - 0.5)).unwrap();
        }
        let [x, y] = [random.f64() - 0.5, random.f64() - 0.5];
        writeln!(text, "{x} {y} 0.3").unwrap();
    }
    bench.write("a.ply", text);
    bench.line("ingest a.ply --progress off").ok();
    builds_within_64_mib(&bench, "--max-level 21 --leaf-capacity 1 --opening-angle 0.3");
}
