//! Real scans, and a made one of many leaves, the whole way: ingest, build, verify, query, each
//! stage within the memory of [D-9].
//!
//! The great scans are behind `PVMAP_SLOW_TESTS`: with `PVMAP_SLOW_TESTS=1` to depth 6, with
//! `PVMAP_SLOW_TESTS=all` as `depth8.toml` says, which takes about an hour for the room.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::fmt::Write;
use std::path::Path;

use cli_common::{Bench, MIB, Run, allowed_bytes, data, is_slow_asked_for};
use pvmap::geometry::Positions;
use pvmap::scan::{PositionKind, ReadOptions, ScanError, Source};
use serde_json::Value;

/// Threads of every run here: [D-9] allows 2 MiB for each.
const N_THREADS: u64 = 2;

/// A scan, how to take it in and how to build it.
struct Case {
    /// A file below the data folder.
    file: &'static str,
    n_points: u64,
    ingest: &'static str,
    build: &'static str,
    memory_mib: u64,
}

/// Runs one stage of the command and demands what [D-9] promises, as seen from outside and as the
/// command itself reports.
fn run_within(bench: &Bench, line: &str, input: &Path, memory_mib: u64) -> Run {
    let limits = format!("--progress json --threads {N_THREADS} --memory {memory_mib}MiB");
    let words: Vec<&str> = line.split_whitespace().chain(limits.split_whitespace()).collect();
    let mut command = bench.command(words);
    command.arg(input);
    let run = Run::of(command).ok();
    let allowed = allowed_bytes(memory_mib * MIB, N_THREADS);
    let mib = |bytes: u64| bytes / MIB;
    let lines = run.stderr.lines().map(|l| serde_json::from_str::<Value>(l).unwrap());
    for stage in lines.filter(|l| l["ended"] == true) {
        let held = stage["rss_anon_bytes"].as_u64().unwrap();
        eprintln!("{}: {} {:.1} s, {} MiB", line, stage["stage"], stage["seconds"], mib(held));
        assert!(held <= allowed, "{}: {} of {} MiB", stage["stage"], mib(held), mib(allowed));
        let total = stage["total"].as_u64().unwrap_or(u64::MAX);
        assert!(stage["done"].as_u64().unwrap() <= total, "more than all is done: {stage}");
    }
    let held = run.anon_bytes;
    assert!(held <= allowed, "{line}: {} of {} MiB", mib(held), mib(allowed));
    run
}

/// The default, named as a user names it.
const DEPTH_8: &str = "--config depth8.toml";

/// Says how a scan of millions of points is built in a slow run.
fn depth_of_great_scans() -> &'static str {
    let is_all = std::env::var_os("PVMAP_SLOW_TESTS").is_some_and(|asked| asked == "all");
    if is_all { DEPTH_8 } else { "--max-level 6" }
}

/// Takes a scan the whole way and gives the folder with its octree and map.
fn the_whole_way(case: &Case) {
    let Some(folder) = data("") else { return };
    let input = folder.join(case.file);
    let bench = Bench::new();
    let ingest = format!("ingest -o a.octree {}", case.ingest);
    run_within(&bench, &ingest, &input, case.memory_mib);
    bench.line("verify a.octree").ok();
    assert_eq!(bench.n_stored("a.octree"), case.n_points);

    let build = format!("build -o a.vmap {}", case.build);
    run_within(&bench, &build, Path::new("a.octree"), case.memory_mib);
    bench.line("verify a.vmap").ok();
    bench.with_map("a.vmap", |view| {
        let s = view.summary();
        assert_eq!(s.n_points, case.n_points);
        assert!(s.n_surfels > 1 && s.n_links > 0, "{s:?}");
    });
    assert_eq!(bench.names(), ["a.octree", "a.vmap"]);
    assert_answers(&bench, &input);
}

/// A room whose walls have 16 points a leaf or less: more than 200 000 leaves.
const MANY_LEAVES: &str = "--leaf-capacity 16 --max-level 21";

#[test]
fn d9_two_hundred_thousand_leaves_in_64_mib() {
    let bench = Bench::new();
    bench.line("scene empty --points 1600k -o a.ply").ok();
    run_within(&bench, "ingest -o a.octree", Path::new("a.ply"), 64);
    let build = |map: &str| format!("build -o {map} {MANY_LEAVES}");
    run_within(&bench, &build("a.vmap"), Path::new("a.octree"), 64);
    bench.with_map("a.vmap", |view| assert!(view.summary().n_surfels >= 200_000));
    // With room for all its tables it makes the same map.
    bench.run([&build("b.vmap"), " a.octree --memory 1GiB"].concat().split(' ')).ok();
    assert!(bench.read("a.vmap") == bench.read("b.vmap"));
    assert_eq!(bench.names(), ["a.octree", "a.ply", "a.vmap", "b.vmap"]);
}

/// Asks whether points of the scan see each other, from both ends: each row has an answer and the
/// two agree; some say yes and some no.
fn assert_answers(bench: &Bench, input: &Path) {
    let places = places(input);
    let (mut forth, mut back) = [(); 2].map(|()| "x1,y1,z1,x2,y2,z2\n".to_owned()).into();
    for (i, a) in places.iter().enumerate() {
        let b = places[(i * 7 + 13) % places.len()];
        for (rows, (a, b)) in [(&mut forth, (a, &b)), (&mut back, (&b, a))] {
            writeln!(rows, "{},{},{},{},{},{}", a[0], a[1], a[2], b[0], b[1], b[2]).unwrap();
        }
    }
    let [forth, back] = [forth, back].map(|rows| {
        bench.write("rows.csv", rows);
        let run = bench.line("query a.vmap pairs rows.csv --json").ok();
        let answers = run.stdout.lines().map(|l| serde_json::from_str::<Value>(l).unwrap());
        answers.collect::<Vec<Value>>()
    });
    assert_eq!((forth.len(), back.len()), (places.len(), places.len()));
    for (forth, back) in forth.iter().zip(&back) {
        assert!(forth["visible"].is_boolean(), "{forth}");
        assert_eq!(forth["visible"], back["visible"], "{forth} {back}");
    }
    let n_yes = forth.iter().filter(|a| a["visible"] == true).count();
    assert!((1..places.len()).contains(&n_yes), "{n_yes} of {} say yes", places.len());
}

/// Gives a thousand points from all over a scan, in world units.
fn places(input: &Path) -> Vec<[f64; 3]> {
    let source = Source::open(input, 0, ReadOptions::default()).unwrap();
    let kind = source.info().kind;
    let mut places = Vec::new();
    let stride = source.info().n_points / 1000;
    for part in source.parts(1) {
        source
            .read(part, 1 << 16, |batch| {
                let wanted = batch.records.iter().enumerate().filter(|(_, r)| *r % stride == 0);
                places.extend(wanted.map(|(i, _)| place(&batch.positions, i, kind)));
                Ok::<_, ScanError>(())
            })
            .unwrap();
    }
    places
}

fn place(positions: &Positions, i: usize, kind: PositionKind) -> [f64; 3] {
    match (positions, kind) {
        (Positions::Lattice(v), PositionKind::Lattice { scale, offset }) => {
            [0, 1, 2].map(|axis| f64::from(v[i][axis]) * scale[axis] + offset[axis])
        }
        (Positions::Single(v), _) => v[i].map(f64::from),
        (Positions::Double(v), _) => v[i],
        (Positions::Lattice(_), _) => unreachable!("a lattice is announced as one"),
    }
}

const LION: Case = Case {
    file: "scans/lion_takanawa_normals_342k.ply",
    n_points: 341_989,
    ingest: "",
    build: "--max-level 4",
    memory_mib: 64,
};

const COPC: Case = Case { file: "scans/lion_takanawa.copc.laz", ..LION };

#[test]
fn lion_with_normals() {
    the_whole_way(&LION);
}

#[test]
fn lion_as_copc() {
    the_whole_way(&COPC);
}

#[test]
fn an_indoor_scan() {
    let file = "las_conformance/visgl_indoor.laz";
    the_whole_way(&Case { file, n_points: 808_042, ..LION });
}

#[test]
fn slow_lion_at_depth_8() {
    if is_slow_asked_for() {
        the_whole_way(&Case { build: DEPTH_8, ..LION });
        the_whole_way(&Case { build: DEPTH_8, ..COPC });
    }
}

#[test]
fn slow_room_of_one_station() {
    if is_slow_asked_for() {
        the_whole_way(&Case {
            file: "scans/room_10grenoble_11.6M_1station.laz",
            n_points: 11_605_395,
            ingest: "--sensor 0,0,1.77",
            build: depth_of_great_scans(),
            memory_mib: 512,
        });
    }
}

#[test]
fn slow_loft_with_normals() {
    if is_slow_asked_for() {
        the_whole_way(&Case {
            file: "scans/loft_normals_3.0M.laz",
            n_points: 3_021_294,
            ingest: "",
            build: depth_of_great_scans(),
            memory_mib: 512,
        });
    }
}

#[test]
fn slow_gorge_from_the_air() {
    if is_slow_asked_for() {
        the_whole_way(&Case {
            file: "scans/airborne_rrg_2.26M.laz",
            n_points: 2_258_235,
            ingest: "--up",
            build: depth_of_great_scans(),
            memory_mib: 512,
        });
    }
}
