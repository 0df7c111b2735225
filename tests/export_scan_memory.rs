//! Exports onto a scan's own file hold no more than they may, however wide its records are.
//! Source: DESIGN.md [D-9].
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use cli_common::{Bench, TWO_THREADS};
use export_common::raw::{Pieces, n_points, records};

/// Writes a scan of wide records, whose octree is `a.octree`.
fn built(pieces: &Pieces) -> Bench {
    let bench = Bench::new();
    bench.write("a.las", pieces.joined());
    bench.line("ingest a.las --normals none").ok();
    bench.line("build a.octree --max-level 4").ok();
    bench
}

fn export(bench: &Bench, scan: &str, output: &str, memory: &str) -> cli_common::Run {
    let line = format!("export a.vmap --points {output} --scan {scan} --field record --memory");
    bench.run(line.split_whitespace().chain([memory]).chain(TWO_THREADS))
}

#[test]
fn d9_a_laz_of_wide_records_is_written_within_the_memory() {
    // As formats of either kind are coded: a layer a byte, and one after another.
    for (point_format, n_extra, side) in [(6, 1000, 90), (6, 300, 130), (1, 6000, 40)] {
        let bench = built(&Pieces { n_extra, ..Pieces::new(4, point_format, side) });
        export(&bench, "a.las", "out.laz", "64MiB").ok().within(64);
        // A LAZ is read and written by two of them.
        bench.line("ingest out.laz -o a.octree --normals none --overwrite").ok();
        bench.line("build a.octree --max-level 4 --restart").ok();
        export(&bench, "out.laz", "next.laz", "128MiB").ok().within(128);
        let (was, n_was) = records(&bench.path("a.las"));
        let (is, n_is) = records(&bench.path("next.laz"));
        assert_eq!((n_is, n_points(&bench.read("next.laz"))), (n_was + 8, was.len() / n_was));
        assert!(was.chunks_exact(n_was).zip(is.chunks_exact(n_is)).all(|(a, b)| a == &b[..n_was]));
    }
}

#[test]
fn d9_a_laz_whose_records_are_too_wide_for_the_memory_is_refused() {
    let bench = built(&Pieces { n_extra: 65_000, ..Pieces::new(4, 6, 5) });
    let words = ["--memory leaves 32 MiB", "wide records of a LAZ", "give it more"];
    export(&bench, "a.las", "out.laz", "64MiB").fails(78, &words).within(64);
    assert!(!bench.names().contains(&"out.laz".to_owned()));
    // Nothing codes a LAS.
    export(&bench, "a.las", "out.las", "64MiB").ok().within(64);
}
