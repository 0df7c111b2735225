//! Exports onto scans that are not whole: what `pvmap ingest --lenient` took of them comes back, or
//! the place is named; and exports that are asked to stop.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use std::time::{Duration, Instant};

use cli_common::faults::{send, start, wait_for};
use cli_common::{Bench, Run, patch};
use export_common::raw::{Pieces, evlr, n_points, records, word};

/// Takes `name` the whole way, leniently.
fn build(bench: &Bench, name: &str) {
    bench.line(&format!("ingest {name} -o a.octree --normals none --lenient --overwrite")).ok();
    bench.line("build a.octree --max-level 4 -o a.vmap --restart").ok();
}

fn export(bench: &Bench, name: &str, output: &str) -> Run {
    let line = format!("export a.vmap --points {output} --scan {name} --field leaf --overwrite");
    bench.line(&format!("{line} --progress off"))
}

/// Writes a LAZ of several chunks, and gives the records of the LAS it was made of.
fn write_laz(bench: &Bench) -> Vec<Vec<u8>> {
    let pieces = Pieces { n_extra: 1000, ..Pieces::new(4, 6, 95) };
    bench.write("whole.las", pieces.joined());
    build(bench, "whole.las");
    bench.line("export a.vmap --points a.laz --scan whole.las").ok();
    pieces.rows()
}

/// Demands that `output` has these records, with four bytes more each.
fn assert_kept(bench: &Bench, output: &str, rows: &[Vec<u8>]) {
    let (found, n) = records(&bench.path(output));
    assert_eq!((found.len() / n, n), (rows.len(), rows[0].len() + 4));
    assert!(found.chunks_exact(n).zip(rows).all(|(a, b)| a[..n - 4] == b[..]), "{output}");
}

#[test]
fn a_laz_without_its_chunk_table_comes_back() {
    let bench = Bench::new();
    let rows = write_laz(&bench);
    let at = word(&bench.read("a.laz"), 96);
    patch(&bench.path("a.laz"), at as u64, &[0xff; 7]);
    build(&bench, "a.laz");
    for output in ["out.las", "out.laz"] {
        export(&bench, "a.laz", output).ok();
        assert_kept(&bench, output, &rows);
    }
}

#[test]
fn a_laz_that_is_broken_in_the_middle_is_refused_with_the_place() {
    let bench = Bench::new();
    let rows = write_laz(&bench);
    // A chunk begins with a record as it is, behind which is how many there are.
    let bytes = bench.read("a.laz");
    let chunk_points =
        word(&bytes, bytes.windows(14).position(|w| w == b"laszip encoded").unwrap() + 64);
    assert!(2 * chunk_points < rows.len(), "three chunks of {chunk_points}");
    let row = &rows[chunk_points];
    let at = bytes.windows(row.len()).position(|w| w == row).unwrap() + row.len();
    patch(&bench.path("a.laz"), at as u64 + 4, &[0xff; 8]);
    build(&bench, "a.laz");
    let place = format!("record {chunk_points} cannot be read");
    assert!(bench.n_stored("a.octree") > chunk_points as u64, "what is behind it was taken");
    export(&bench, "a.laz", "out.laz").fails(65, &["a.laz", &place, "without --scan"]);
    assert!(!bench.names().contains(&"out.laz".to_owned()));
    // Where nothing was taken from behind it, what is before it is written.
    patch(&bench.path("a.laz"), 247, &(2 * chunk_points as u64).to_le_bytes());
    build(&bench, "a.laz");
    export(&bench, "a.laz", "out.las").ok();
    assert_kept(&bench, "out.las", &rows[..chunk_points]);
    assert_eq!(n_points(&bench.read("out.las")), chunk_points);
}

#[test]
fn extended_records_before_one_that_is_cut_off_come_back() {
    let bench = Bench::new();
    let [first, second] = [50, 5000].map(|n| evlr("scanner", 10, "", &vec![n as u8; n]));
    let evlrs = vec![first.clone(), second];
    let whole = Pieces { evlrs, ..Pieces::new(4, 6, 20) }.joined();
    bench.write("a.las", &whole[..whole.len() - 100]);
    build(&bench, "a.las");
    let run = export(&bench, "a.las", "out.las").ok();
    let is_of_scan = |l: &str| l.starts_with("pvmap: warning: a.las: EVLR 2 of 2");
    assert!(run.stderr.lines().any(is_of_scan), "{}", run.stderr);
    let bytes = bench.read("out.las");
    assert_eq!(word(&bytes, 243), 1);
    let listed = &bytes[word(&bytes, 235)..];
    assert!(listed.starts_with(&first));
    // What there is of the other stays as bytes.
    assert_eq!(listed.len(), whole.len() - 100 - word(&whole, 235));
}

#[test]
fn room_on_the_disk_is_asked_for_what_is_there() {
    let bench = Bench::new();
    let whole = Pieces::new(4, 6, 20);
    bench.write("a.las", whole.joined());
    // A header that lies: of so many there is no disk.
    patch(&bench.path("a.las"), 247, &(1u64 << 45).to_le_bytes());
    build(&bench, "a.las");
    export(&bench, "a.las", "out.las").ok();
    assert_kept(&bench, "out.las", &whole.rows());
    assert_eq!(n_points(&bench.read("out.las")), 400);
}

#[test]
fn exit_130_an_export_that_copies_what_is_behind_the_points_stops() {
    const LONG_BYTES: u64 = 8 << 30;
    let bench = Bench::new();
    let mut las =
        Pieces { evlrs: vec![evlr("long", 1, "", &[])], ..Pieces::new(4, 6, 30) }.joined();
    let at = las.len() - 60 + 20;
    las[at..at + 8].copy_from_slice(&LONG_BYTES.to_le_bytes());
    let mut ply = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex 900\nproperty float x\n\
         property float y\nproperty float z\nelement junk {}\nproperty double q\nend_header\n",
        LONG_BYTES / 8
    )
    .into_bytes();
    for i in 0..900u16 {
        let place = [i % 30, i / 30, 0].map(|v| f32::from(v).to_le_bytes());
        ply.extend(place.concat());
    }
    for (name, output, bytes) in [("a.las", "out.las", las), ("a.ply", "out.ply", ply)] {
        // A hole, which takes no room.
        let n_bytes = bytes.len() as u64;
        bench.write(name, bytes);
        let file = std::fs::File::options().write(true).open(bench.path(name)).unwrap();
        file.set_len(n_bytes + LONG_BYTES).unwrap();
        build(&bench, name);
        let names = bench.names();
        let line = format!("export a.vmap --points {output} --scan {name} --progress off");
        let child = start(&bench, &line);
        let is_copying = || {
            let others = bench.names().into_iter().filter(|n| !names.contains(n));
            let bytes = others.filter_map(|n| bench.path(n).metadata().ok()).map(|m| m.len());
            bytes.max().unwrap_or(0) > 8 << 20
        };
        wait_for("the copying", is_copying);
        let asked = Instant::now();
        send(&child, "INT");
        let run = Run::watch(child, asked).fails(130, &["interrupted", "nothing was left behind"]);
        assert!(run.elapsed < Duration::from_secs(2), "{:?}", run.elapsed);
        assert_eq!(bench.names(), names);
        std::fs::remove_file(bench.path(name)).unwrap();
    }
}
