//! Exports: what they are refused for, what they replace, that they stream within their memory and
//! leave nothing behind, and surfels as discs.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use std::sync::atomic::{AtomicU64, Ordering};

use cli_common::{Bench, TWO_THREADS, floor, patch, room};
use export_common::{ALL_COLUMNS, EYE, build, read, scan, write_las, write_ply};
use pvmap::geometry::Positions;
use pvmap::query::{Place, Snap};
use pvmap::scan::{ColorRange, LasContent, PlyColumns, ReadOptions, Source};
use pvmap::vmap::MapView;
use pvmap::{Error, ExportRequest, Exported, Limits, PointField, Quiet, StoreError, Watch};

fn request(bench: &Bench, output: &str) -> ExportRequest {
    ExportRequest {
        map: bench.path("a.vmap"),
        octree: bench.path("a.octree"),
        output: bench.path(output),
        overwrite: false,
        fields: vec![
            PointField::VisibleFrom(Place { position: EYE, normal: None }),
            PointField::SeesCount,
        ],
        snap: Snap::default(),
        scan: None,
        light: None,
    }
}

fn export_within(
    request: &ExportRequest,
    limits: (usize, u64),
    watch: &dyn Watch,
) -> Result<Exported, Error> {
    let limits = Limits { threads: limits.0, memory_bytes: limits.1 };
    pvmap::export_points(request, &limits, watch)
}

#[test]
fn d8_threads_and_memory_change_no_byte() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(80, 10), [0.0; 3], &LasContent::default());
    build(&bench, &["a.las"]);
    for ending in ["las", "laz", "ply"] {
        let first = format!("first.{ending}");
        let done = export_within(&request(&bench, &first), (1, 1 << 30), &Quiet).unwrap();
        assert_eq!((done.n_points, done.temporary_bytes), (3 * 80 * 80, 0));
        for limits in [(2, 1 << 30), (3, 1 << 30), (1, 1 << 16), (3, 1 << 17)] {
            let output = format!("next.{ending}");
            let done = export_within(&request(&bench, &output), limits, &Quiet).unwrap();
            assert_eq!(done.temporary_bytes > 0, limits.1 < 1 << 20, "{limits:?}");
            assert!(bench.read(&first) == bench.read(&output), "{ending}, {limits:?}");
        }
    }
    let tight = export_within(&request(&bench, "no.las"), (1, 1 << 10), &Quiet);
    assert_eq!(tight.unwrap_err().exit_code(), 78);
}

#[test]
fn d9_an_export_streams_within_its_memory() {
    let bench = Bench::new();
    let n_points = 1_440_000;
    cli_common::write_las(&bench.path("a.las"), n_points, floor(1200));
    bench.line("ingest a.las --normals none").ok();
    bench.line("build a.octree --max-level 5").ok();
    for output in ["out.las", "out.laz", "out.ply"] {
        let line = "export a.vmap --field sees-count --field normal --field record \
                    --field lit=6,6,4 --field visible-from=6,6,0 --memory 64MiB --points";
        let words = line.split_whitespace().chain([output]).chain(TWO_THREADS);
        let run = bench.run(words).ok().within(64);
        assert!(run.stderr.contains("of temporary disk in"), "{}", run.stderr);
        assert!(!run.stdout.contains(" 0.0 MiB temporary"), "{}", run.stdout);
    }
    let (_, found) = read(&bench.path("out.laz"));
    let place = floor(1200);
    let places = Positions::Lattice((0..n_points).map(place).collect());
    assert!(found.positions == places && found.records.into_iter().eq(0..n_points));
    let made = ["a.las", "a.octree", "a.vmap", "out.las", "out.laz", "out.ply"];
    assert_eq!(bench.names(), made);
}

#[test]
fn a_scan_without_points_and_damaged_artifacts() {
    let bench = Bench::new();
    bench.write("none.ply", cli_common::ply_header(0, &cli_common::XYZ));
    bench.line("ingest none.ply").ok();
    bench.line("build none.octree").ok();
    for output in ["out.las", "out.laz", "out.ply"] {
        let line = "export none.vmap --octree none.octree --field sees-count --field bin --points";
        bench.line(&format!("{line} {output}")).ok();
        let source = Source::open(&bench.path(output), 0, ReadOptions::default()).unwrap();
        assert_eq!(source.info().n_points, 0, "{output}");
    }
    write_las(&bench.path("a.las"), &scan(20, 16), [0.0; 3], &LasContent::default());
    build(&bench, &["a.las"]);
    let points_at = bench.with_octree("a.octree", |view| {
        view.file().section("points", view.schema().record_bytes() as u32).unwrap().offset_bytes
    });
    let links_at =
        bench.with_map("a.vmap", |view| view.file().section("links", 0).unwrap().offset_bytes);
    let names = bench.names();
    let (octree, map) = (bench.read("a.octree/points.pvo"), bench.read("a.vmap"));
    for (file, whole, at) in
        [("a.octree/points.pvo", &octree, points_at), ("a.vmap", &map, links_at)]
    {
        patch(&bench.path(file), at + 5, &[!whole[at as usize + 5]]);
        let line = "export a.vmap --octree a.octree --points gone.las --field sees-count";
        bench.line(line).fails(65, &[file]);
        assert_eq!(bench.names(), names);
        bench.write(file, whole);
    }
}

/// Asks to stop when it was asked so many times whether to.
struct StopAfter(AtomicU64);

impl Watch for StopAfter {
    fn stage(&self, _: &'static str, _: Option<u64>, _: &'static str) {}
    fn advance(&self, _: u64) {}
    fn warn(&self, _: &str) {}
    fn is_stopped(&self) -> bool {
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_err()
    }
}

#[test]
fn an_export_that_is_stopped_leaves_nothing_behind() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(60, 11), [0.0; 3], &LasContent::default());
    build(&bench, &["a.las"]);
    bench.line("export a.vmap --octree a.octree --points out.las").ok();
    let old = bench.read("out.las");
    let (names, request) = (bench.names(), request(&bench, "out.las"));
    let mut n_stops = 0;
    for n_checks in 0.. {
        let watch = StopAfter(n_checks.into());
        let limits = (1 + n_checks as usize % 2, 1 << 18);
        match export_within(&request, limits, &watch) {
            Ok(_) => break,
            Err(Error::Store(StoreError::Interrupted)) => {}
            Err(e) => assert_eq!(e.exit_code(), 130, "{e}"),
        }
        assert!(bench.read("out.las") == old);
        assert_eq!(bench.names(), names);
        n_stops += 1;
    }
    assert!(n_stops > 5, "{n_stops}");
    assert!(bench.read("out.las") != old);
}

#[test]
fn what_an_export_is_refused_for() {
    let bench = Bench::new();
    let content = LasContent::default();
    write_las(&bench.path("a.las"), &scan(20, 12), [0.0; 3], &content);
    build(&bench, &["a.las"]);
    let names = bench.names();
    let inputs = ["a.las", "a.vmap", "a.octree/points.pvo"].map(|name| bench.read(name));
    let all = "export a.vmap --octree a.octree --points";
    for (line, words) in [
        ("export a.vmap --octree a.octree", &["--points"][..]),
        ("export a.vmap --field leaf --links -", &["--points"]),
        (&format!("{all} out.xyz"), &["out.xyz", ".las, .laz or .ply"]),
        (&format!("{all} out.las --field colour"), &["colour", "sees-count"]),
        (&format!("{all} out.las --field visible-from=1,2"), &["three numbers"]),
        (&format!("{all} out.las --field visible-from=1,2,3,4"), &["six"]),
        (&format!("{all} out.las --field lit=1"), &["three numbers"]),
        (&format!("{all} out.las --surfels ./out.las"), &["one place"]),
        (&format!("{all} a.vmap"), &["one of the inputs"]),
        (&format!("{all} a.octree/points.pvo"), &["one of the inputs"]),
    ] {
        bench.line(line).fails(2, words);
    }
    for output in ["missing/out.las", "missing/out.ply"] {
        bench.line(&format!("{all} {output}")).fails(73, &["missing"]);
    }
    bench.line(&format!("{all} out.las --field visible-from=0,0,-0.5")).fails(65, &["no surface"]);
    // Without a name it is the octree beside the map.
    std::fs::rename(bench.path("a.octree"), bench.path("b.octree")).unwrap();
    bench.line("export a.vmap --points out.las").fails(66, &["a.octree"]);
    std::fs::rename(bench.path("b.octree"), bench.path("a.octree")).unwrap();
    let near = format!("{all} near.las --field visible-from=0,0,-0.5 --snap 1");
    bench.line(&near).ok();
    bench.line(&near.replace("--octree a.octree ", "")).ok();
    assert_eq!(inputs, ["a.las", "a.vmap", "a.octree/points.pvo"].map(|name| bench.read(name)));
    std::fs::remove_file(bench.path("near.las")).unwrap();
    assert_eq!(bench.names(), names);
}

#[test]
fn nothing_is_replaced_but_what_an_export_made() {
    let bench = room();
    write_las(&bench.path("scan.las"), &scan(20, 17), [0.0; 3], &LasContent::default());
    write_las(&bench.path("scan.laz"), &scan(20, 17), [0.0; 3], &LasContent::default());
    bench.write("notes.csv", "surfel,cx,cy,note\n1,2,3,mine\n");
    bench.write("empty.ply", "");
    let (all, tables) = ("export room.vmap --octree room.octree", "export room.vmap");
    let mut lines = Vec::new();
    // A scan is never what an export made, even one that pvmap scene did.
    for output in ["room.ply", "scan.las", "scan.laz"] {
        lines.push((format!("{all} --points {output}"), output));
    }
    lines.push((format!("{tables} --surfels room.ply"), "room.ply"));
    lines.push((format!("{all} --points fresh.las --surfels room.ply"), "room.ply"));
    for table in ["surfels", "nodes", "links"] {
        lines.push((format!("{tables} --{table} notes.csv"), "notes.csv"));
        lines.push((format!("{all} --points fresh.las --{table} scan.las"), "scan.las"));
    }
    let before: Vec<Vec<u8>> =
        ["room.ply", "scan.las", "scan.laz", "notes.csv"].map(|name| bench.read(name)).into();
    let names = bench.names();
    for (line, output) in &lines {
        bench.line(line).fails(73, &[output, "did not make", "--overwrite"]);
        assert_eq!(bench.names(), names, "{line}");
    }
    let after = ["room.ply", "scan.las", "scan.laz", "notes.csv"].map(|name| bench.read(name));
    assert!(before == after);
    // An empty file is nobody's, and their own they replace.
    let twice = "--points p.las --surfels empty.ply --nodes n.csv --links l.csv";
    for line in [twice, twice, "--points p.laz --surfels s.csv", "--points p.laz"] {
        bench.line(&format!("{all} {line}")).ok();
    }
    bench.line(&format!("{all} --points empty.ply --surfels s.csv")).ok();
    for (line, output) in lines {
        bench.line(&format!("{line} --overwrite")).ok();
        bench.line(&line).ok();
        assert!(!before.contains(&bench.read(output)), "{line}");
    }
}

#[test]
fn tables_in_fifos_can_be_read_one_after_another() {
    let bench = room();
    bench.line("export room.vmap --nodes n.csv --links l.csv").ok();
    let mut shell = std::process::Command::new("sh");
    let line = "mkfifo n.fifo l.fifo; \"$0\" export room.vmap --nodes n.fifo --links l.fifo & \
                cat n.fifo > n.txt; cat l.fifo > l.txt; wait $!";
    shell.current_dir(bench.path("")).args(["-c", line, env!("CARGO_BIN_EXE_pvmap")]);
    cli_common::Run::of(shell).ok();
    assert_eq!(bench.read("n.txt"), bench.read("n.csv"));
    assert_eq!(bench.read("l.txt"), bench.read("l.csv"));
}

#[test]
fn an_output_that_is_a_link_is_made_where_it_leads() {
    let bench = room();
    std::fs::create_dir(bench.path("there")).unwrap();
    bench.line("export room.vmap --octree room.octree --points there/p.las").ok();
    let first = bench.read("there/p.las");
    std::os::unix::fs::symlink("there/p.las", bench.path("link.las")).unwrap();
    let line = "export room.vmap --octree room.octree --points link.las --field leaf";
    bench.line(line).ok();
    assert!(bench.path("link.las").is_symlink() && bench.read("there/p.las") != first);
}

#[test]
fn outputs_are_begun_before_any_work_and_appear_together() {
    let bench = room();
    let names = bench.names();
    let all = "export room.vmap --octree room.octree --points p.las --surfels s.ply --nodes n.csv";
    bench.line(&format!("{all} --links missing/l.csv")).fails(73, &["missing/l.csv"]);
    assert_eq!(bench.names(), names);
    // A damaged link spoils the last of them: none gets its name.
    let at =
        bench.with_map("room.vmap", |view| view.file().section("links", 0).unwrap().offset_bytes);
    let whole = bench.read("room.vmap");
    patch(&bench.path("room.vmap"), at + 5, &[!whole[at as usize + 5]]);
    bench.line(&format!("{all} --links l.csv")).fails(65, &["room.vmap"]);
    assert_eq!(bench.names(), names);
}

#[test]
fn a_map_of_other_points_is_refused() {
    let bench = Bench::new();
    let content = LasContent::default();
    write_las(&bench.path("a.las"), &scan(20, 13), [0.0; 3], &content);
    write_las(&bench.path("more.las"), &scan(21, 13), [0.0; 3], &content);
    // The same points elsewhere: the same digest. [D-2]
    write_las(&bench.path("moved.las"), &scan(20, 13), [0.0; 3], &content);
    patch(&bench.path("moved.las"), 155, &7.0f64.to_le_bytes());
    build(&bench, &["a.las"]);
    for other in ["more", "moved"] {
        bench.line(&format!("ingest {other}.las")).ok();
        let line = format!("export a.vmap --octree {other}.octree --points out.las");
        bench.line(&line).fails(65, &["a.vmap", &format!("{other}.octree"), "other points"]);
    }
    // Shuffled they are the same points.
    write_las(&bench.path("again.las"), &scan(20, 14), [0.0; 3], &content);
    bench.line("ingest again.las").ok();
    bench.line("export a.vmap --octree again.octree --points out.las").ok();
}

#[test]
fn surfels_are_discs_in_scan_units() {
    let bench = Bench::new();
    let content = LasContent { color: true, ..LasContent::default() };
    write_las(&bench.path("a.las"), &scan(30, 18), [5.0, 0.0, 0.0], &content);
    // Beside the other, so that there are surfels without a colour.
    let mut second = scan(20, 19);
    let Positions::Double(places) = &mut second.positions else { panic!("no doubles") };
    places.iter_mut().for_each(|place| place[0] += 3.0);
    write_ply(&bench.path("b.ply"), &second, PlyColumns { color: None, ..ALL_COLUMNS });
    bench.line("ingest a.las b.ply -o a.octree --normals file").ok();
    for (config, is_plain) in [("depth8", false), ("paper", true)] {
        bench.line(&format!("build a.octree --config {config} --max-level 4 -o a.vmap")).ok();
        bench.line("export a.vmap --surfels discs.ply").ok();
        let (source, discs) = read(&bench.path("discs.ply"));
        assert!(source.info().columns.normal);
        assert_eq!(source.info().columns.color, Some(ColorRange::Eight));
        let bytes = bench.read("a.vmap");
        let view = MapView::open(&bytes).unwrap();
        let frame = view.frame().frame;
        let surfels: Vec<_> =
            (0..view.summary().n_surfels).map(|i| view.surfel(i).unwrap()).collect();
        let Positions::Double(places) = &discs.positions else { panic!("no doubles") };
        let expected = surfels.iter().map(|s| frame.world_of(s.centroid));
        assert!(expected.eq(places.iter().copied()));
        let normals = discs.normal.unwrap();
        for (s, normal) in surfels.iter().zip(&normals) {
            let along = [0, 1, 2].map(|i| f32::from(s.normal[i]) / 16384.0 - normal[i]);
            assert!(along.iter().all(|d| d.abs() < 1e-4), "{s:?}");
        }
        // radius n_points level bin surfel, of the types f32 u32 u8 i8 u32, end a row.
        let file = bench.read("discs.ply");
        let end = b"end_header\n";
        let start = file.windows(end.len()).position(|w| w == end).unwrap() + end.len();
        let row_bytes = 24 + 12 + 3 + 14;
        assert_eq!(file.len() - start, surfels.len() * row_bytes);
        let mut colors = Vec::new();
        for (i, (row, s)) in file[start..].chunks_exact(row_bytes).zip(&surfels).enumerate() {
            let four = |at: usize| -> [u8; 4] { row[at..at + 4].try_into().unwrap() };
            let radius = (s.radius2 as f64).sqrt() * frame.unit();
            assert_eq!(f32::from_le_bytes(four(39)), radius as f32);
            assert_eq!(u64::from(u32::from_le_bytes(four(43))), s.n_points);
            assert_eq!((row[47], row[48] as i8), (s.level, s.bin));
            assert_eq!(s.bin == -1, is_plain);
            assert_eq!(u32::from_le_bytes(four(49)) as usize, i);
            // Darkest and brightest stay what they are; between them sRGB is brighter than light.
            for (byte, light) in row[36..39].iter().zip(s.color.unwrap_or_default()) {
                let share = (f64::from(light) / 65535.0 * 255.0).floor();
                assert!(f64::from(*byte) >= share && (*byte == 0) == (light < 10), "{light}");
            }
            colors.push(s.color.is_some());
        }
        assert!(colors.contains(&true) && colors.contains(&false), "with and without colours");
    }
}
