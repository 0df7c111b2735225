//! Hostile, broken and odd scans through the command: every point kept, or exit 65 with one line
//! that says where; nothing left behind, memory bounded. What exactly is refused, and why, is
//! tested where the files are read; here it is what the command makes of it.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use cli_common::{
    Bench, LAS_BOUNDS, MIB, Run, TWO_THREADS, XYZ, data, floor, info, patch, ply_header, write_las,
};

/// Where a LAS 1.4 header has its number of points.
const LAS_14_COUNT: u64 = 247;

const TIGHT: [&str; 4] = ["--memory", "64MiB", TWO_THREADS[0], TWO_THREADS[1]];

/// Ingests `input` within 64 MiB, without normals where it is their count that matters.
fn ingest_tight(bench: &Bench, input: &str, more: &[&str]) -> Run {
    bench.run([&["ingest", input], &TIGHT[..], more].concat())
}

/// Cuts and connects an octree within 64 MiB and checks all of the map.
fn build_tight(bench: &Bench, octree: &str, more: &[&str]) {
    let map = [&["build", octree, "-o", "a.vmap"], &TIGHT[..], more].concat();
    bench.run(map).ok().within(64);
    bench.line("verify a.vmap").ok();
}

/// Demands that every record of a single source was stored exactly once.
fn assert_all_stored(bench: &Bench, octree: &str, n: u64) {
    bench.line(&format!("verify {octree}")).ok();
    bench.with_octree(octree, |view| {
        assert_eq!((view.summary().n_points, view.summary().n_read), (n, n));
        assert_eq!(view.sources().iter().map(|s| s.n_stored).sum::<u64>(), n);
    });
}

#[test]
fn three_million_coincident_points_among_four() {
    let bench = Bench::new();
    let place = floor(1000);
    // A floor of 1 M points; the other 3 M lie on its middle.
    write_las(
        &bench.path("a.las"),
        4_000_000,
        |i| if i < 1_000_000 { place(i) } else { [5000; 3] },
    );
    // Normals are estimated, too: 3 M neighbours at distance 0 must not hang the search.
    ingest_tight(&bench, "a.las", &[]).ok().within(64);
    assert_all_stored(&bench, "a.octree", 4_000_000);
    build_tight(&bench, "a.octree", &["--max-level", "5"]);
    bench.with_map("a.vmap", |view| assert_eq!(view.summary().n_points, 4_000_000));
    assert_eq!(bench.names(), ["a.las", "a.octree", "a.vmap"]);
}

#[test]
fn one_outlier_a_thousand_kilometres_away() {
    let bench = Bench::new();
    let (n, place) = (2_000_000, floor(1500));
    let far = |i| if i == 1_234_567 { [1_000_000_000; 3] } else { place(i) };
    write_las(&bench.path("a.las"), n, far);
    ingest_tight(&bench, "a.las", &["--normals", "none"]).ok().within(64);
    assert_all_stored(&bench, "a.octree", n);
    bench.with_octree("a.octree", |view| {
        assert_eq!(view.frame().frame.extent(), 1_000_000.0);
    });
    // All points but one lie in one cell down to level 16.
    for level in ["8", "21"] {
        build_tight(&bench, "a.octree", &["--max-level", level]);
    }
    assert_eq!(bench.names(), ["a.las", "a.octree", "a.vmap"]);
}

#[test]
fn header_bounds_that_lie_change_no_byte() {
    let honest = Bench::new();
    let n = 1_500_000;
    let scattered =
        |i: u64| [0, 20, 40].map(|s| (i.wrapping_mul(0x9E37_79B9) >> s & 0xFFFF) as i32);
    write_las(&honest.path("a.las"), n, scattered);
    ingest_tight(&honest, "a.las", &["--normals", "none"]).ok().within(64);
    assert_all_stored(&honest, "a.octree", n);
    let expected = octree_bytes(&honest);

    let bench = Bench::new();
    std::fs::copy(honest.path("a.las"), bench.path("a.las")).unwrap();
    let cases: [(&str, [f64; 2]); 5] = [
        ("understated", [20.0, 10.0]),
        ("overstated", [1e6, -1e6]),
        ("a single place", [0.0, 0.0]),
        ("swapped", [0.0, 65.535]),
        ("not a number", [f64::NAN; 2]),
    ];
    for (case, axis) in cases {
        let bounds: Vec<u8> = [axis; 3].iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        patch(&bench.path("a.las"), LAS_BOUNDS, &bounds);
        let run = ingest_tight(&bench, "a.las", &["--normals", "none", "--overwrite"]);
        let run = run.ok().within(64);
        if case != "overstated" {
            run.warns(&["a.las", "bounds"]);
        }
        assert_eq!(bench.names(), ["a.las", "a.octree"], "{case}");
        assert!(octree_bytes(&bench) == expected, "{case}: the bytes differ");
    }
}

fn octree_bytes(bench: &Bench) -> Vec<u8> {
    bench.read(Path::new("a.octree").join(pvmap::vmap::octree::FILE_NAME))
}

#[test]
fn f52_count_twice_what_is_there() {
    for name in ["a.las", "a.laz"] {
        let bench = Bench::new();
        write_las(&bench.path(name), 200_000, floor(500));
        patch(&bench.path(name), LAS_14_COUNT, &400_000u64.to_le_bytes());
        bench.line(&format!("ingest {name}")).fails(65, &[name, "400000", "200000"]);
        assert_eq!(bench.names(), [name]);
    }
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 1000, floor(50));
    for n in [0, 1001, u64::from(u32::MAX), u64::MAX] {
        patch(&bench.path("a.las"), LAS_14_COUNT, &n.to_le_bytes());
        let (strict, n_lenient) = if n == 0 { (0, 0) } else { (65, 1000) };
        bench.line("ingest a.las -o strict.octree").exits(strict);
        let run = bench.line("ingest a.las --lenient --overwrite").ok();
        run.warns(&["a.las"]);
        assert_eq!(bench.n_stored("a.octree"), n_lenient, "{n}");
    }
}

#[test]
fn f53_count_less_than_what_is_there() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 1000, floor(50));
    patch(&bench.path("a.las"), LAS_14_COUNT, &700u64.to_le_bytes());
    let run = bench.line("ingest a.las").ok();
    let run = run.warns(&["a.las", "declares 700 points but holds 1000"]);
    assert!(run.stdout.contains("700 stored + 0 not finite; 300 beyond"), "{}", run.stdout);
    assert_all_stored(&bench, "a.octree", 700);
}

#[test]
fn d4_every_record_is_stored_or_counted_with_a_reason() {
    let bench = Bench::new();
    for (name, declared) in [("cut.las", 130u64), ("long.las", 60)] {
        write_las(&bench.path(name), 100, floor(10));
        patch(&bench.path(name), LAS_14_COUNT, &declared.to_le_bytes());
    }
    bench.write("a.ply", ply_header(3, &XYZ) + "0 0 0\nnan 0 0\n1 1 1\n");
    let line = "ingest cut.las long.las a.ply -o a.octree --lenient --skip-invalid";
    let run = bench.line(line).ok();
    let sum = "163 read = 162 stored + 1 not finite; 30 declared are not there; 40 beyond";
    assert!(run.stdout.contains(sum), "{}", run.stdout);
    let info = info(&bench, "a.octree");
    for (field, n) in [
        ("points", 162),
        ("records_read", 163),
        ("records_invalid", 1),
        ("records_missing", 30),
        ("records_beyond_the_header", 40),
    ] {
        assert_eq!(info[field], n, "{field}");
    }
    // What is lenient still gives something, or says why not.
    let laz = bench.path("b.laz");
    write_las(&laz, 60_000, floor(300));
    let n_bytes = laz.metadata().unwrap().len();
    std::fs::File::options().write(true).open(&laz).unwrap().set_len(n_bytes / 2).unwrap();
    bench.line("ingest b.laz --lenient").fails(65, &["b.laz", "60000", "none"]);
}

/// A broken file: its name, its bytes, and a part of the one line that refuses it.
type Broken = (&'static str, Vec<u8>, &'static str);

/// Ingests each file; demands exit 65, one line, little memory and no traces.
fn assert_refused(broken: impl IntoIterator<Item = Broken>) {
    for (name, bytes, reason) in broken {
        let bench = Bench::new();
        bench.write(name, bytes);
        let run = bench.line(&format!("ingest {name}")).fails(65, &[name, reason]);
        assert!(run.elapsed < Duration::from_secs(5) && run.rss_bytes < 64 * MIB, "{run:?}");
        assert_eq!(bench.names(), [name]);
    }
}

/// A LAS 1.4 file of 100 points, patched.
fn las(at: usize, bytes: &[u8]) -> Vec<u8> {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 100, floor(10));
    let mut las = bench.read("a.las");
    las[at..at + bytes.len()].copy_from_slice(bytes);
    las
}

#[test]
fn f54_to_f56_headers_that_lie() {
    assert_refused([
        ("header.las", las(94, &[0; 2]), "header"),
        ("points.las", las(96, &[255; 4]), "4294967295"),
        ("record.las", las(105, &[0; 2]), "record length 0"),
        ("vlrs.las", las(100, &[255; 4]), "VLR"),
        ("evlrs.las", las(243, &[255; 4]), "EVLR"),
        ("scale.las", las(131, &[0; 8]), "scale"),
        ("offset.las", las(155, &f64::NAN.to_le_bytes()), "offset"),
    ]);
}

#[test]
fn f57_legacy_and_14_counts_disagree() {
    let bench = Bench::new();
    bench.write("a.las", las(107, &60u32.to_le_bytes()));
    bench.line("ingest a.las").ok().warns(&["a.las", "60"]);
    assert_eq!(bench.n_stored("a.octree"), 100);
}

#[test]
fn f58_f59_cut_short() {
    let bench = Bench::new();
    for name in ["a.las", "a.laz"] {
        write_las(&bench.path(name), 120_000, floor(400));
    }
    let [mut las, mut laz] = ["a.las", "a.laz"].map(|name| bench.read(name));
    las.truncate(las.len() / 2 + 5);
    laz.truncate(laz.len() / 2);
    assert_refused([("cut.las", las.clone(), "120000"), ("cut.laz", laz, "chunk table")]);

    let bench = Bench::new();
    bench.write("a.las", &las);
    bench.line("ingest a.las --lenient").ok().warns(&["a.las"]);
    // The 36-byte records begin at byte 375, behind the header.
    assert_eq!(bench.n_stored("a.octree"), (las.len() as u64 - 375) / 36);
}

#[test]
fn f60_noise_amid_the_points_is_kept_and_reported() {
    let bench = Bench::new();
    bench.write("a.las", las(375 + 36 * 50, &[0x7A; 12]));
    bench.line("ingest a.las").ok().warns(&["a.las", "1 points lie outside"]);
    assert_eq!(bench.n_stored("a.octree"), 100);
}

#[test]
fn f61_to_f65_text_that_lies() {
    let ply = |header: &str, body: &str| -> Vec<u8> {
        format!("ply\nformat ascii 1.0\n{header}{body}").into()
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let with = |body: &str| ply(&format!("element vertex 1\n{xyz}end_header\n"), body);
    let huge = format!("element vertex 1152921504606846976\n{xyz}end_header\n");
    let bare = format!("element a 1152921504606846976\nelement vertex 1\n{xyz}end_header\n");
    let list = format!("element vertex 1\n{xyz}property list int float l\nend_header\n");
    assert_refused([
        ("huge.ply", ply(&huge, "1 2 3\n"), "1152921504606846976"),
        ("list.ply", ply(&list, "1 2 3 -1\n"), "-1"),
        ("long_list.ply", ply(&list, "1 2 3 2147483648 1\n"), ""),
        ("endless.ply", ply("comment ", &"c".repeat(1 << 20)), ""),
        ("wide.ply", ply("", &"property float x\n".repeat(1 << 16)), ""),
        ("overflow.ply", with("1 1e400 3\n"), "finite"),
        ("hex.ply", with("1 0x1p3 3\n"), "0x1p3"),
        ("comma.ply", with("1,5 2 3\n"), "1,5"),
        ("ind.ply", with("1 nan(ind) 3\n"), "finite"),
        ("digits.ply", with(&"1".repeat(1 << 20)), ""),
    ]);
    // F62: an element without properties takes no room and no time, however many there are.
    let bench = Bench::new();
    bench.write("a.ply", ply(&bare, "1 2 3\n"));
    let run = bench.line("ingest a.ply").ok();
    assert!(run.elapsed < Duration::from_secs(5));
    assert_eq!(bench.n_stored("a.octree"), 1);
}

#[test]
fn points_that_are_not_finite_are_dropped_when_asked_for() {
    let bench = Bench::new();
    bench.write("a.ply", ply_header(4, &XYZ) + "0 0 0\nnan 0 0\n1 1 1\n0 inf 0\n");
    bench.line("ingest a.ply").fails(65, &["a.ply", "point 1", "finite"]);
    assert_eq!(bench.names(), ["a.ply"]);
    let run = bench.line("ingest a.ply --skip-invalid").ok();
    let run = run.warns(&["a.ply", "dropped 2 points", "point 1"]);
    assert!(run.stdout.contains("4 read = 2 stored + 2 not finite"), "{}", run.stdout);
    bench.with_octree("a.octree", |view| {
        let s = view.summary();
        assert_eq!((s.n_points, s.n_invalid, s.n_read), (2, 2, 4));
    });
}

#[test]
fn f66_the_same_file_twice() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 1000, floor(50));
    std::fs::hard_link(bench.path("a.las"), bench.path("b.las")).unwrap();
    let run = bench.line("ingest a.las b.las -o a.octree").ok();
    run.warns(&["b.las is a.las again"]);
    assert_eq!(bench.n_stored("a.octree"), 2000);
}

#[test]
fn f66_a_file_that_changes_while_it_is_read() {
    let bench = Bench::new();
    let path = bench.path("a.las");
    write_las(&path, 1_000_000, floor(1000));
    let mut command = bench.command(["ingest", "a.las", "--normals", "none"]);
    command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
    let mut growing = std::fs::File::options().append(true).open(path).unwrap();
    let child = command.spawn().unwrap();
    let is_over = std::sync::atomic::AtomicBool::new(false);
    let run = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(std::sync::atomic::Ordering::Relaxed) {
                std::io::Write::write_all(&mut growing, b"+").unwrap();
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        let run = Run::watch(child, Instant::now());
        is_over.store(true, std::sync::atomic::Ordering::Relaxed);
        run
    });
    run.fails(65, &["a.las", "changed while"]);
    assert_eq!(bench.names(), ["a.las"]);
}

#[test]
fn f67_names_of_any_bytes() {
    let long = format!("{}.ply", "l".repeat(251));
    let names: [&[u8]; 5] =
        [b"nu\xff\xfe.ply", b"a\n b.ply", b"-x.ply", long.as_bytes(), "gr\u{f8}tte.ply".as_bytes()];
    for name in names.map(OsStr::from_bytes) {
        let bench = Bench::new();
        bench.write(name, ply_header(1, &XYZ) + "1 2 3\n");
        let args = ["ingest", "-o", "out.octree", "--"].map(OsStr::new);
        bench.run(args.iter().copied().chain([name])).ok();
        assert_eq!(bench.n_stored("out.octree"), 1);
        let run = bench.line("info out.octree").ok();
        assert!(run.stdout.contains("PLY"), "{}", run.stdout);

        // A message about such a file is one line all the same.
        bench.write(name, "ply\nformat\n");
        let args = ["ingest", "--overwrite", "-o", "out.octree", "--"].map(OsStr::new);
        bench.run(args.into_iter().chain([name])).fails(65, &[]);
    }
    // The octree takes its name from the scan's.
    let bench = Bench::new();
    bench.write(OsStr::from_bytes(b"nu\xff.ply"), ply_header(1, &XYZ) + "1 2 3\n");
    bench.run([OsStr::new("ingest"), OsStr::from_bytes(b"nu\xff.ply")]).ok();
    assert!(bench.path(OsStr::from_bytes(b"nu\xff.octree")).is_dir());
}

#[test]
fn f68_two_thousand_tiny_files() {
    let bench = Bench::new();
    let names: Vec<String> = (0..2000).map(|i| format!("{i}.ply")).collect();
    for (i, name) in names.iter().enumerate() {
        bench.write(name, ply_header(1, &XYZ) + &format!("{i} {} 0\n", i % 40));
    }
    let command = bench.command(
        ["ingest", "-o", "all.octree", "--normals", "none"]
            .into_iter()
            .chain(names.iter().map(|n| &**n)),
    );
    let run = Run::of(with_few_handles(command)).ok();
    assert!(run.elapsed < Duration::from_secs(10), "{:?}", run.elapsed);
    bench.with_octree("all.octree", |view| {
        assert_eq!((view.summary().n_points, view.sources().len()), (2000, 2000));
    });
}

#[test]
fn f68_a_leaf_a_point() {
    let side: u64 = if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { 1000 } else { 250 };
    let memory = format!("{}MiB", side.pow(2) * 1024 / MIB + 64);
    let bench = Bench::new();
    write_las(&bench.path("a.las"), side * side, floor(side));
    bench.line("ingest a.las --normals none").ok();
    let line = format!("build --leaf-capacity 1 --max-level 12 --memory {memory} --threads 2");
    let run = bench.line(&line).ok().within(memory.trim_end_matches("MiB").parse().unwrap());
    assert!(run.elapsed < Duration::from_secs(60), "{:?}", run.elapsed);
    bench.with_map("a.vmap", |view| assert_eq!(u64::from(view.summary().n_surfels), side * side));
}

#[test]
fn d9_a_tree_too_large_for_its_memory_is_refused_within_it() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 600_000, floor(775));
    ingest_tight(&bench, "a.las", &["--normals", "none"]).ok().within(64);
    for shape in ["binned", "paper"] {
        let leaves = ["--max-level", "21", "--leaf-capacity", "1", "--tree", shape];
        let run = bench.run([&["build", "a.octree"], &TIGHT[..], &leaves].concat());
        run.fails(78, &["--memory", "surfels"]).within(64);
    }
    assert_eq!(bench.names(), ["a.las", "a.octree"]);
}

/// Runs a command with no more than 64 files open at a time, where that can be arranged.
fn with_few_handles(command: Command) -> Command {
    if Command::new("prlimit").arg("--version").output().is_err() {
        eprintln!("skipped: no prlimit; the number of open files is not limited");
        return command;
    }
    let mut limited = Command::new("prlimit");
    limited.arg("--nofile=64").arg(command.get_program()).args(command.get_args());
    limited.current_dir(command.get_current_dir().unwrap());
    limited
}

#[test]
fn f69_four_million_equal_points_in_a_small_laz() {
    let bench = Bench::new();
    write_las(&bench.path("a.laz"), 4_000_000, |_| [7; 3]);
    assert!(bench.path("a.laz").metadata().unwrap().len() < MIB);
    ingest_tight(&bench, "a.laz", &["--normals", "none"]).ok().within(64);
    assert_all_stored(&bench, "a.octree", 4_000_000);
    build_tight(&bench, "a.octree", &[]);
    bench.with_map("a.vmap", |view| {
        assert_eq!((view.summary().n_surfels, view.summary().n_links), (1, 0));
    });
}

#[test]
fn no_points_make_an_empty_octree_and_an_empty_map() {
    let bench = Bench::new();
    write_las(&bench.path("none.las"), 0, floor(1));
    write_las(&bench.path("none.laz"), 0, floor(1));
    bench.write("none.ply", ply_header(0, &XYZ));
    for name in ["none.las", "none.laz", "none.ply"] {
        let run = bench.line(&format!("ingest {name} --overwrite")).ok();
        run.warns(&["no points"]);
        for options in ["--config paper", "--profile oriented", "--config quick", ""] {
            bench.line(&format!("build none.octree {options}")).ok();
            bench.line("verify none.vmap").ok();
        }
        for artifact in ["none.octree", "none.vmap"] {
            bench.line(&format!("verify {artifact}")).ok();
            bench.line(&format!("info {artifact} --json")).ok();
            bench.line(&format!("info {artifact}")).ok();
        }
        bench.line("export none.vmap --surfels S.csv --nodes N.csv --links L.csv").ok();
        for table in ["S.csv", "N.csv", "L.csv"] {
            let text = String::from_utf8(bench.read(table)).unwrap();
            assert_eq!(text.lines().count(), 1, "{table} of {name}: {text}");
        }
        bench.line("query none.vmap pair 0,0,0 1,1,1").fails(65, &["no points"]);
    }
}

/// The broken files that load all the same, and how many points they have.
const THESE_LOAD: [(&str, u64); 7] = [
    ("synth_las_bbox_wrong.las", 1),
    ("synth_ply_crlf_binary.ply", 1),
    ("PDAL_issue_2421.ply", 1),
    ("PDAL_bad-geotiff-keys.las", 10),
    ("PDAL_hextest.las", 8),
    ("PDAL_noise-dirty.las", 1065),
    ("PDAL_spurious.las", 1065),
];

/// Files that may go either way, with what each is held to here.
const EITHER_WAY: [(&str, Option<u64>); 3] = [
    // The decoder notices that its bytes end too early.
    ("synth_laz_bitflips.laz", None),
    // A header that lies about its records may lie about more.
    ("PDAL_bad_vlr_count.las", None),
    // The bad list belongs to the faces, and nothing behind the vertices is read.
    ("synth_ply_negative_list.ply", Some(1)),
];

#[test]
fn malformed_files_load_or_exit_65() {
    let Some(folder) = data("malformed") else { return };
    let these = THESE_LOAD.map(|(name, n)| (name, Some(n)));
    for entry in folder.read_dir().unwrap() {
        let path = entry.unwrap().path();
        let listed = [&these[..], &EITHER_WAY].concat();
        let name = path.file_name().unwrap();
        let expected = listed.iter().find(|(n, _)| name == *n).and_then(|(_, n)| *n);
        let run = ingest_one(&path, expected);
        let is_small = run.rss_bytes < 256 * MIB && run.elapsed < Duration::from_secs(5);
        assert!(is_small, "{}: {run:?}", path.display());
    }
}

/// Ingests a file in a folder of its own: `n` points, or exit 65 with its name and nothing left.
fn ingest_one(path: &Path, n: Option<u64>) -> Run {
    let bench = Bench::new();
    let args = ["ingest", "-o", "out.octree"].map(OsStr::new);
    let run = bench.run(args.into_iter().chain([path.as_os_str()]));
    match n {
        Some(n) => {
            assert_eq!(run.code, 0, "{}: {}", path.display(), run.stderr);
            assert_all_stored(&bench, "out.octree", n);
            assert_eq!(bench.names(), ["out.octree"]);
            run
        }
        None => {
            let name = path.file_name().unwrap().to_string_lossy();
            let run = run.fails(65, &[&*name]);
            assert_eq!(bench.names(), [""; 0], "{name}");
            run
        }
    }
}

/// Conformance files that are refused; all others load.
const THESE_DO_NOT: [&str; 4] =
    ["PDAL_sized_dims.ply", "PDAL_unsized_dims.ply", "assimp_Wuson.ply", "assimp_issue623.ply"];

#[test]
fn conformance_files_load_or_exit_65() {
    for folder in ["las_conformance", "ply_conformance"] {
        let Some(folder) = data(folder) else { return };
        for entry in folder.read_dir().unwrap() {
            let path = entry.unwrap().path();
            let is_refused = THESE_DO_NOT.iter().any(|n| path.ends_with(n));
            let n = (!is_refused).then(|| {
                let options = pvmap::scan::ReadOptions::default();
                pvmap::scan::Source::open(&path, 0, options).unwrap().info().n_points
            });
            ingest_one(&path, n);
        }
    }
}

#[test]
fn e57_is_refused_for_now() {
    let Some(folder) = data("e57_conformance") else { return };
    for entry in folder.read_dir().unwrap() {
        let run = ingest_one(&entry.unwrap().path(), None);
        assert!(run.stderr.contains("E57"), "{}", run.stderr);
    }
}
