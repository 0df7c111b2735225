//! What the tests of exports share: scans with all attributes, the way there and back, and what a
//! field must be.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

pub mod raw;

use std::path::Path;
use std::process::Command;

use fastrand::Rng;
use pvmap::geometry::{Intensity, PointBatch, Positions};
use pvmap::query::{Located, Map, Place, Snap};
use pvmap::scan::{
    ColorRange, LasContent, LasOptions, LasWriter, PlyColumns, PlyWriter, ReadOptions, Source,
};
use pvmap::vmap::OctreeView;
use pvmap::vmap::tree::route;

use super::cli_common::Bench;

/// Where the eye of these tests is, on the floor.
pub const EYE: [f64; 3] = [0.1, 0.1, -1.0];
pub const OTHER_EYE: [f64; 3] = [-0.9, 0.9, 1.0];
pub const MOST_TIME: f64 = 3e8;

/// Gives a floor and a ceiling that see each other past a plate between them, in random order,
/// with all attributes.
pub fn scan(n: u32, seed: u64) -> PointBatch {
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

pub const NO_CONTENT: LasContent = LasContent {
    color: false,
    gps_time: false,
    is_standard_gps_time: true,
    crs: None,
    fields: Vec::new(),
    software: "pvmap",
};

pub fn write_las(path: &Path, batch: &PointBatch, offset: [f64; 3], content: &LasContent) {
    let compressed = path.extension().unwrap() == "laz";
    let options = LasOptions { compressed, scale: [0.001; 3], offset, normals: true };
    let mut las = LasWriter::create_with(path, options, content).unwrap();
    las.write(batch).unwrap();
    las.finish().unwrap();
}

pub fn write_ply(path: &Path, batch: &PointBatch, columns: PlyColumns) {
    let mut ply = PlyWriter::create(path, batch.len() as u64, columns).unwrap();
    ply.write(batch).unwrap();
    ply.finish().unwrap();
}

pub const ALL_COLUMNS: PlyColumns = PlyColumns {
    double: false,
    normal: true,
    color: Some(ColorRange::Sixteen),
    intensity: true,
    classification: true,
    gps_time: true,
};

/// Reads all points of a file.
pub fn read(path: &Path) -> (Source, PointBatch) {
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
pub fn build(bench: &Bench, scans: &[&str]) {
    let scans = scans.join(" ");
    bench.line(&format!("ingest {scans} -o a.octree --overwrite --normals file")).ok();
    bench.line("build a.octree --max-level 4 -o a.vmap").ok();
}

pub const FIELDS: &str = "--field visible-from=0.1,0.1,-1 --field sees-count --field leaf \
                      --field level --field bin --field visible-from=-0.9,0.9,1";
pub const NAMES: [&str; 6] =
    ["visible_from", "sees_count", "leaf", "level", "bin", "visible_from_2"];
/// Bytes of the fields behind each record, of the types u8 u32 u32 u8 i8 u8.
pub const FIELD_BYTES: usize = 12;

pub fn export(bench: &Bench, output: &str) {
    let line = format!("export a.vmap --octree a.octree --points {output} {FIELDS}");
    let run = bench.line(&line).ok();
    assert!(run.stdout.contains(&NAMES.join(", ")), "{}", run.stdout);
}

/// Reads the fields behind the records of a LAS or a PLY.
pub fn fields_of(path: &Path) -> Vec<[i64; 6]> {
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
pub fn expected(bench: &Bench) -> Vec<[i64; 6]> {
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

/// Gives world coordinates; a lattice is the one of a hundred-millionth from -1 on.
pub fn world(positions: &Positions) -> Vec<[f64; 3]> {
    match positions {
        Positions::Lattice(v) => v.iter().map(|x| x.map(|x| f64::from(x) * 1e-8 - 1.0)).collect(),
        Positions::Single(v) => v.iter().map(|x| x.map(f64::from)).collect(),
        Positions::Double(v) => v.clone(),
    }
}

/// Runs a script of Python in the folder, or says that it cannot.
pub fn python(bench: &Bench, module: &str, script: &str) {
    let run = |script: &str| {
        let mut python = Command::new("python3");
        python.current_dir(bench.path("")).args(["-c", script]).output()
    };
    if !run(&format!("import numpy, {module}")).is_ok_and(|o| o.status.success()) {
        eprintln!("skipped: no python3 with numpy and {module}");
        return;
    }
    let output = run(script).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
