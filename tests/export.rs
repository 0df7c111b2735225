//! Exports onto the user's own points: what was scanned comes back as it was and where it was, with
//! fields that are what `Map::pair` says one by one.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};

use cli_common::{Bench, TWO_THREADS, floor, patch, room};
use fastrand::Rng;
use pvmap::geometry::{Intensity, PointBatch, Positions};
use pvmap::query::{Located, Map, Place, Snap};
use pvmap::scan::{
    ColorRange, Crs, LasContent, LasOptions, LasWriter, PlyColumns, PlyWriter, ReadOptions, Source,
};
use pvmap::vmap::tree::route;
use pvmap::vmap::{MapView, OctreeView};
use pvmap::{Error, ExportRequest, Exported, Limits, PointField, Quiet, StoreError, Watch};

/// Where the eye of these tests is, on the floor.
const EYE: [f64; 3] = [0.1, 0.1, -1.0];
const OTHER_EYE: [f64; 3] = [-0.9, 0.9, 1.0];
const MOST_TIME: f64 = 3e8;

/// Gives a floor and a ceiling that see each other past a plate between them, in random order,
/// with all attributes.
fn scan(n: u32, seed: u64) -> PointBatch {
    let rng = &mut Rng::with_seed(seed);
    let mut points = Vec::new();
    for (z, half) in [(-1.0, 1.0), (1.0, 1.0), (0.0f64, 0.4)] {
        for i in 0..n * n {
            let place =
                [i % n, i / n].map(|v| half * (2.0 * f64::from(v) / f64::from(n - 1) - 1.0));
            let up = if z == 0.0 { f64::from(i % 2) * 2.0 - 1.0 } else { -z };
            points.push(([place[0], place[1], z], [0.0, 0.0, up as f32]));
        }
    }
    rng.shuffle(&mut points);
    let mut each = |most: u64| points.iter().map(|_| rng.u64(..=most)).collect::<Vec<u64>>();
    let three = |a: Vec<u64>| a.iter().map(|v| [*v as u16, (v >> 16) as u16, 7]).collect();
    PointBatch {
        source: 0,
        records: (0..points.len() as u64).collect(),
        positions: Positions::Double(points.iter().map(|p| p.0).collect()),
        color: Some(three(each(u64::from(u32::MAX)))),
        intensity: Some(Intensity::U16(each(60_000).iter().map(|v| *v as u16).collect())),
        classification: Some(each(31).iter().map(|v| *v as u8).collect()),
        gps_time: Some(each(1 << 40).iter().map(|v| *v as f64 / MOST_TIME * 1e6).collect()),
        normal: Some(points.iter().map(|p| p.1).collect()),
    }
}

const NO_CONTENT: LasContent = LasContent {
    color: false,
    gps_time: false,
    is_standard_gps_time: true,
    crs: None,
    fields: Vec::new(),
};

fn write_las(path: &Path, batch: &PointBatch, offset: [f64; 3], content: &LasContent) {
    let compressed = path.extension().unwrap() == "laz";
    let options = LasOptions { compressed, scale: [0.001; 3], offset, normals: true };
    let mut las = LasWriter::create_with(path, options, content).unwrap();
    las.write(batch).unwrap();
    las.finish().unwrap();
}

fn write_ply(path: &Path, batch: &PointBatch, columns: PlyColumns) {
    let mut ply = PlyWriter::create(path, batch.len() as u64, columns).unwrap();
    ply.write(batch).unwrap();
    ply.finish().unwrap();
}

const ALL_COLUMNS: PlyColumns = PlyColumns {
    double: false,
    normal: true,
    color: Some(ColorRange::Sixteen),
    intensity: true,
    classification: true,
    gps_time: true,
};

/// Reads all points of a file.
fn read(path: &Path) -> (Source, PointBatch) {
    let source = Source::open(path, 0, ReadOptions::default()).unwrap();
    let (mut found, n) = (None, source.info().n_points);
    let keep = |batch| {
        found = Some(batch);
        Ok::<_, pvmap::scan::ScanError>(())
    };
    source.read(0..n, n as usize, keep).unwrap();
    (source, found.unwrap())
}

/// Takes scans the whole way.
fn build(bench: &Bench, scans: &[&str]) {
    let scans = scans.join(" ");
    bench.line(&format!("ingest {scans} -o a.octree --overwrite --normals file")).ok();
    bench.line("build a.octree --max-level 4 -o a.vmap").ok();
}

const FIELDS: &str = "--field visible-from=0.1,0.1,-1 --field sees-count --field leaf \
                      --field level --field bin --field visible-from=-0.9,0.9,1";
const NAMES: [&str; 6] = ["visible_from", "sees_count", "leaf", "level", "bin", "visible_from_2"];
/// Bytes of the fields behind each record, of the types u8 u32 u32 u8 i8 u8.
const FIELD_BYTES: usize = 12;

fn export(bench: &Bench, output: &str) {
    let line = format!("export a.vmap --octree a.octree --points {output} {FIELDS}");
    let run = bench.line(&line).ok();
    assert!(run.stdout.contains(&NAMES.join(", ")), "{}", run.stdout);
}

/// Reads the fields behind the records of a LAS or a PLY.
fn fields_of(path: &Path) -> Vec<[i64; 6]> {
    let bytes = std::fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let n_points = read(path).1.len();
    let (start, stride) = match bytes.starts_with(b"LASF") {
        true => (word(96), word(105) & 0xffff),
        false => {
            let end = b"end_header\n";
            let start = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
            (start, (bytes.len() - start) / n_points)
        }
    };
    let rows = bytes[start..].chunks_exact(stride).take(n_points);
    rows.map(|row| {
        let f = &row[stride - FIELD_BYTES..];
        let long = |at: usize| u32::from_le_bytes(f[at..at + 4].try_into().unwrap()).into();
        [f[0].into(), long(1), long(5), f[9].into(), (f[10] as i8).into(), f[11].into()]
    })
    .collect()
}

/// Says by [`Map::pair`] and [`route`] what the fields of all points must be, by source and record.
fn expected(bench: &Bench) -> Vec<[i64; 6]> {
    let (map, octree) = (bench.read("a.vmap"), bench.read("a.octree/points.pvo"));
    let (map, octree) = (Map::open(&map).unwrap(), OctreeView::open(&octree).unwrap());
    let view = map.view();
    let leaves: Vec<Located> = (0..view.summary().n_surfels)
        .map(|surfel| Located { surfel, node: view.surfel(surfel).unwrap().node, distance: 0.0 })
        .collect();
    let sees = |a: &Located, b: &Located| map.pair(a, b).unwrap().visible;
    let of_eye = |position| {
        let eye = map.locate(&Place { position, normal: None }, Snap::default()).unwrap();
        leaves.iter().map(|leaf| i64::from(sees(&eye, leaf))).collect::<Vec<_>>()
    };
    let (first, second) = (of_eye(EYE), of_eye(OTHER_EYE));
    let count = |a: &Located| leaves.iter().filter(|b| a.surfel != b.surfel && sees(a, b)).count();
    let counts: Vec<i64> = leaves.iter().map(|a| count(a) as i64).collect();
    assert!(first.contains(&0) && first.contains(&1) && second != first, "an eye that sees some");
    let source = octree.schema().column("source").map(|c| c.offset);
    let record = octree.schema().column("record").unwrap().offset;
    let word = |r: &[u8], at: usize| u32::from_le_bytes(r[at..at + 4].try_into().unwrap());
    let n_points = octree.summary().n_points;
    let mut rows: Vec<((u32, u32), [i64; 6])> = octree
        .points(0, n_points)
        .unwrap()
        .iter()
        .map(|point| {
            let point = point.unwrap();
            let leaf = route(view, &point.key).unwrap().unwrap();
            let id = leaves.iter().position(|l| l.node == leaf).unwrap();
            let s = view.surfel(id as u32).unwrap();
            let place = (source.map_or(0, |at| word(point.record, at)), word(point.record, record));
            let (level, bin) = (s.level.into(), s.bin.into());
            (place, [first[id], counts[id], id as i64, level, bin, second[id]])
        })
        .collect();
    rows.sort_unstable();
    rows.into_iter().map(|row| row.1).collect()
}

#[test]
fn las_of_any_format_comes_back_as_it_was_with_fields_that_are_right() {
    // A directory of one key: the model, number 1024, is projected.
    let keys = [1u16, 1, 0, 1, 1024, 0, 1, 1].iter().flat_map(|v| v.to_le_bytes()).collect();
    let tiff = Some(Crs::GeoTiff { keys, doubles: Vec::new(), texts: b"here|".to_vec() });
    let wkt = Some(Crs::Wkt(b"PROJCS[\"somewhere\"]".to_vec()));
    for (format, name, color, gps_time, crs) in [
        (0, "a.las", false, false, &tiff),
        (1, "a.laz", false, true, &tiff),
        (2, "a.las", true, false, &tiff),
        (3, "a.las", true, true, &tiff),
        (3, "a.laz", true, true, &tiff),
        (6, "a.las", false, true, &None),
        (7, "a.las", true, true, &wkt),
        (7, "a.laz", true, true, &wkt),
    ] {
        let bench = Bench::new();
        let content = LasContent { color, gps_time, crs: crs.clone(), ..NO_CONTENT };
        write_las(&bench.path(name), &scan(30, format), [500_000.0, -3.0, 0.0], &content);
        let (source, batch) = read(&bench.path(name));
        assert!(source.info().format.ends_with(&format!("format {format}")));
        bench.line(&format!("ingest {name} -o a.octree")).ok();
        bench.line("build a.octree --max-level 4 -o a.vmap").ok();
        for output in ["out.las", "out.laz"] {
            export(&bench, output);
            let (found_source, found) = read(&bench.path(output));
            assert!(found == batch, "{format}, {name} to {output}");
            assert_eq!(found_source.info().kind, source.info().kind);
            assert_eq!(found_source.info().columns, source.info().columns);
            assert_eq!(found_source.info().bounds, source.info().bounds);
            assert_eq!(&found_source.info().crs, crs);
            let found_format = &found_source.info().format;
            assert!(found_format.ends_with(&format!("format {format}")), "{found_format}");
            // Bit 0 of the global encoding: times since 1980, which those of no week must be.
            assert_eq!(bench.read(output)[6] & 1, u8::from(gps_time));
        }
    }
}

#[test]
fn the_fields_are_what_pairs_say() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(40, 5), [0.0; 3], &LasContent::default());
    build(&bench, &["a.las"]);
    let expected = expected(&bench);
    for output in ["out.las", "out.ply"] {
        export(&bench, output);
        assert!(fields_of(&bench.path(output)) == expected, "{output}");
    }
}

#[test]
fn ply_comes_back_as_it_was() {
    for double in [false, true] {
        let bench = Bench::new();
        write_ply(&bench.path("a.ply"), &scan(30, 6), PlyColumns { double, ..ALL_COLUMNS });
        build(&bench, &["a.ply"]);
        let (source, batch) = read(&bench.path("a.ply"));
        export(&bench, "out.ply");
        let (found_source, found) = read(&bench.path("out.ply"));
        assert!(found == batch && found_source.info().columns == source.info().columns);
        assert!(fields_of(&bench.path("out.ply")) == expected(&bench));
        // In a LAS they are on a lattice of a hundred-millionth, and the rest is as it was.
        let line = "export a.vmap --octree a.octree --points out.laz";
        bench.line(line).ok().warns(&["rounded", ".ply"]);
        let (_, found) = read(&bench.path("out.laz"));
        let places = [&batch, &found].map(|b| world(&b.positions));
        let far = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).any(|i| (a[i] - b[i]).abs() > 1e-8);
        assert!(!places[0].iter().zip(&places[1]).any(far));
        assert!(found.color == batch.color && found.classification == batch.classification);
        assert!(found.gps_time == batch.gps_time && found.normal == batch.normal);
    }
}

/// Gives world coordinates; a lattice is the one of a hundred-millionth from -1 on.
fn world(positions: &Positions) -> Vec<[f64; 3]> {
    match positions {
        Positions::Lattice(v) => v.iter().map(|x| x.map(|x| f64::from(x) * 1e-8 - 1.0)).collect(),
        Positions::Single(v) => v.iter().map(|x| x.map(f64::from)).collect(),
        Positions::Double(v) => v.clone(),
    }
}

#[test]
fn several_scans_follow_each_other() {
    let bench = Bench::new();
    let content = LasContent::default();
    let (first, mut second) = (scan(30, 7), scan(20, 8));
    write_las(&bench.path("a.las"), &first, [0.0; 3], &content);
    // Another offset of the same lattice, and 8-bit colours.
    second.color.iter_mut().flatten().flatten().for_each(|c| *c %= 256);
    write_las(&bench.path("b.laz"), &second, [2.0, 0.0, -1.0], &content);
    build(&bench, &["b.laz", "a.las"]);
    let expected = expected(&bench);
    for output in ["out.las", "out.ply"] {
        export(&bench, output);
        assert!(fields_of(&bench.path(output)) == expected, "{output}");
    }
    let (b, a) = (read(&bench.path("b.laz")).1, read(&bench.path("a.las")).1);
    let (_, found) = read(&bench.path("out.las"));
    let [Positions::Lattice(b_at), Positions::Lattice(a_at), Positions::Lattice(at)] =
        [&b.positions, &a.positions, &found.positions]
    else {
        panic!("no lattice");
    };
    // The lattice is that of the first: the other's places are 2000 and 1000 steps away in it.
    let moved = a_at.iter().map(|x| [x[0] - 2000, x[1], x[2] + 1000]);
    assert!(b_at.iter().copied().chain(moved).eq(at.iter().copied()));
    let times = b.gps_time.iter().chain(&a.gps_time).flatten();
    assert!(times.eq(found.gps_time.iter().flatten()));
    // Full brightness is one thing in one file.
    let bright = b.color.iter().flatten().map(|c| c.map(|v| v * 257));
    assert!(bright.chain(a.color.clone().unwrap()).eq(found.color.clone().unwrap()));

    // On different lattices, and with a PLY among them.
    write_las(&bench.path("b.laz"), &second, [0.0004, 0.0, 0.0], &content);
    write_ply(&bench.path("c.ply"), &scan(10, 9), ALL_COLUMNS);
    for (scans, is_near) in [(&["a.las", "b.laz"][..], 5.1e-4), (&["b.laz", "c.ply"], 1e-8)] {
        build(&bench, scans);
        for output in ["out.ply", "out.las"] {
            export(&bench, output);
            assert!(fields_of(&bench.path(output)) == self::expected(&bench), "{scans:?}");
        }
        let places = ["out.ply", "out.las"].map(|name| {
            let (source, batch) = read(&bench.path(name));
            match (source.info().kind, batch.positions) {
                (pvmap::scan::PositionKind::Lattice { scale, offset }, Positions::Lattice(v)) => {
                    let world =
                        |x: &[i32; 3]| [0, 1, 2].map(|i| f64::from(x[i]) * scale[i] + offset[i]);
                    v.iter().map(world).collect()
                }
                (_, positions) => world(&positions),
            }
        });
        let far = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).any(|i| (a[i] - b[i]).abs() > is_near);
        assert!(!places[0].iter().zip(&places[1]).any(far), "{scans:?}");
    }
}

fn request(bench: &Bench, output: &str) -> ExportRequest {
    ExportRequest {
        map: bench.path("a.vmap"),
        octree: bench.path("a.octree"),
        output: bench.path(output),
        fields: vec![PointField::VisibleFrom(EYE), PointField::SeesCount],
        snap: Snap::default(),
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
        let line = "export a.vmap --octree a.octree --field sees-count --memory 64MiB --points";
        let words = line.split(' ').chain([output]).chain(TWO_THREADS);
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
    bench.write("out.las", "old");
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
        assert_eq!(bench.read("out.las"), b"old");
        assert_eq!(bench.names(), names);
        n_stops += 1;
    }
    assert!(n_stops > 5, "{n_stops}");
    assert!(bench.read("out.las").starts_with(b"LASF"));
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
        ("export a.vmap --points out.las", &["--octree"][..]),
        ("export a.vmap --octree a.octree", &["--points"]),
        ("export a.vmap --field leaf --links -", &["--points"]),
        (&format!("{all} out.xyz"), &["out.xyz", ".las, .laz or .ply"]),
        (&format!("{all} out.las --field colour"), &["colour", "sees-count"]),
        (&format!("{all} out.las --field visible-from=1,2"), &["three numbers"]),
        (&format!("{all} out.las --surfels ./out.las"), &["one place"]),
        (&format!("{all} a.vmap"), &["one of the inputs"]),
        (&format!("{all} a.octree/points.pvo"), &["one of the inputs"]),
        (&format!("{all} ./a.las"), &["a scan that the octree was made from"]),
    ] {
        bench.line(line).fails(2, words);
    }
    bench.line(&format!("{all} missing/out.las")).fails(73, &["missing"]);
    bench.line(&format!("{all} out.las --field visible-from=0,0,-0.5")).fails(65, &["no surface"]);
    let near = format!("{all} near.las --field visible-from=0,0,-0.5 --snap 1");
    bench.line(&near).ok();
    assert_eq!(inputs, ["a.las", "a.vmap", "a.octree/points.pvo"].map(|name| bench.read(name)));
    std::fs::remove_file(bench.path("near.las")).unwrap();
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
    let bench = room();
    bench.line("export room.vmap --surfels S.csv").ok();
    bench.line("export room.vmap --surfels discs.ply").ok();
    let (source, discs) = read(&bench.path("discs.ply"));
    assert!(source.info().columns.color.is_none() && source.info().columns.normal);
    let bytes = bench.read("room.vmap");
    let view = MapView::open(&bytes).unwrap();
    let Positions::Double(places) = &discs.positions else { panic!("no doubles") };
    assert_eq!(places.len(), view.summary().n_surfels as usize);
    for (i, (place, normal)) in places.iter().zip(discs.normal.unwrap()).enumerate() {
        // A floor at -1 and a ceiling at 1 that look at each other.
        assert!((place[2].abs() - 1.0).abs() < 1e-6, "{i}: {place:?}");
        assert_eq!(normal, [0.0, 0.0, -place[2].signum() as f32]);
        let centroid = view.surfel(i as u32).unwrap().centroid;
        assert_eq!(*place, view.frame().frame.world_of(centroid));
    }
    let n_rows = String::from_utf8(bench.read("S.csv")).unwrap().lines().count();
    assert_eq!(n_rows, places.len() + 1);
}

/// Runs a script, or says aloud that it cannot.
fn python(bench: &Bench, module: &str, script: &str) -> bool {
    let run = |script: &str| {
        let mut python = Command::new("python3");
        python.current_dir(bench.path("")).args(["-c", script]).output()
    };
    if !run(&format!("import numpy, {module}")).is_ok_and(|o| o.status.success()) {
        eprintln!("skipped: no python3 with {module} and numpy");
        return false;
    }
    let output = run(script).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    true
}

#[test]
fn laspy_opens_what_is_written_with_fields_and_order_intact() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(40, 15), [7.0; 3], &LasContent::default());
    bench.line("ingest a.las").ok();
    bench.line("build a.octree --max-level 4").ok();
    let fields = "--field visible-from=0.1,0.1,-1 --field visible-from=0,0,1 --field sees-count \
                  --field leaf --field level --field bin";
    for output in ["out.las", "out.laz", "out.ply"] {
        bench.line(&format!("export a.vmap --octree a.octree --points {output} {fields}")).ok();
    }
    let names = "visible_from visible_from_2 sees_count leaf level bin";
    python(
        &bench,
        "laspy",
        &format!(
            "
import laspy, numpy as np
a = laspy.read('a.las')
lists = []
for name in ['out.las', 'out.laz']:
    b = laspy.read(name)
    assert (a.header.scales == b.header.scales).all()
    assert (a.header.offsets == b.header.offsets).all()
    for d in 'X Y Z intensity classification gps_time red green blue nx ny nz'.split():
        assert (np.array(a[d]) == np.array(b[d])).all(), (name, d)
    assert list(b.point_format.extra_dimension_names) == 'nx ny nz {names}'.split()
    info = {{d.name: d for d in b.point_format.extra_dimensions}}
    assert info['visible_from'].description.startswith('1 if seen from 0.1,0.1,-1')
    lists.append([np.array(b[n]) for n in '{names}'.split()])
    kinds = [str(x.dtype) for x in lists[-1]]
    assert kinds == 'uint8 uint8 uint32 uint32 uint8 int8'.split(), kinds
    assert 0 < lists[-1][0].mean() < 1 and lists[-1][2].max() > 0
assert all((x == y).all() for x, y in zip(*lists))
"
        ),
    );
    python(
        &bench,
        "plyfile",
        &format!(
            "
import numpy as np
from plyfile import PlyData
v = PlyData.read('out.ply')['vertex']
names = [p.name for p in v.properties]
assert names[-6:] == '{names}'.split(), names
raw = open('a.las', 'rb').read()
start, n = int.from_bytes(raw[96:100], 'little'), int.from_bytes(raw[105:107], 'little')
rows = np.frombuffer(raw, np.uint8, offset=start, count=len(v.data) * n).reshape(-1, n)
x = rows[:, :12].copy().view(np.int32)
for i, d in enumerate('xyz'):
    assert np.abs(x[:, i] * 0.001 + 7.0 - v[d]).max() < 1e-9, d
color = rows[:, 30:36].copy().view(np.uint16)
assert (np.stack([v['red'], v['green'], v['blue']], 1) == color).all()
assert v['visible_from'].dtype == np.uint8 and 0 < v['visible_from'].mean() < 1
assert v['bin'].dtype == np.int8 and v['sees_count'].dtype == np.uint32
"
        ),
    );
}
