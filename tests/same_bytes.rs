//! Same points, same bytes: whatever the threads, the memory, the order of the points or the
//! number of files they come in; and for a scan that was moved or scaled the same bytes outside
//! the frame record. Source: DESIGN.md [D-2], [D-8].
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fastrand::Rng;
use pvmap::geometry::Positions;
use pvmap::geometry::disc::Profile;
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::{Container, Kind, MapView, Shape};
use pvmap::{
    BuildConfig, Checkpoints, IngestRequest, Ingested, Limits, NormalsFrom, Orientation, Quiet,
};

use crate::common::{Cloud, LIMITS, build_with, ingest_with, room_cloud};

const SMALL: Limits = Limits { threads: 2, memory_bytes: 64 << 20 };
const LARGE: Limits = Limits { threads: 2, memory_bytes: 4 << 30 };

/// Lattice step of the clouds here, metres.
const SCALE_M: f64 = 0.0001;

/// Writes points of a scene.
fn scene_file(kind: SceneKind, n_points: u64, shuffle: bool, path: &Path) -> PathBuf {
    let request = SceneRequest { n_points, shuffle };
    scenes::write(&Scene::new(kind, 1), &request, path, &LIMITS, &Quiet).unwrap();
    path.to_path_buf()
}

/// Reads every file of an octree folder.
fn files_of(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let read = |path: PathBuf| {
        (path.strip_prefix(folder).unwrap().to_path_buf(), std::fs::read(&path).unwrap())
    };
    entries.map(read).collect()
}

/// Ingests one scan with limits; gives all files of the octree and what was done.
fn octree_of(
    scan: &Path,
    limits: &Limits,
    set: impl FnOnce(&mut IngestRequest),
) -> (BTreeMap<PathBuf, Vec<u8>>, Ingested) {
    let folder = tempfile::tempdir().unwrap();
    let octree = folder.path().join("scan.octree");
    let mut request = IngestRequest::new([scan.to_path_buf()], octree.clone());
    set(&mut request);
    let ingested = pvmap::ingest(&request, limits, &Quiet).unwrap();
    (files_of(&octree), ingested)
}

/// From scans to the bytes of their map.
fn map_of(
    scans: &[PathBuf],
    config: &BuildConfig,
    set: impl FnOnce(&mut IngestRequest),
) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let octree = ingest_with(scans, folder.path(), &LIMITS, set);
    build_with(&octree, config, &LIMITS)
}

/// Says where the bytes of two files first differ.
fn assert_same(found: &[u8], expected: &[u8], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}: lengths");
    let differs = found.iter().zip(expected).position(|(a, b)| a != b);
    assert_eq!(differs, None, "{what}: first differing byte");
}

/// The places of a map that may differ when only the frame record does: sections `frame` and
/// `crs`, their checksums, and the three fields of the header that cover those.
fn frame_record(bytes: &[u8]) -> Vec<Range<usize>> {
    let file = Container::open(bytes, Kind::Map).unwrap();
    let sums = file.sections().last().unwrap().offset_bytes as usize;
    let mut ranges = vec![32..48, 56..60, 60..64];
    let mut first_block = 0;
    for section in file.sections() {
        let n_blocks = section.len_bytes.div_ceil(65_536) as usize;
        if section.name == "frame" || section.name == "crs" {
            let start = section.offset_bytes as usize;
            ranges.push(start..start + section.len_bytes as usize);
            ranges.push(sums + 4 * first_block..sums + 4 * (first_block + n_blocks));
        }
        first_block += n_blocks;
    }
    ranges
}

/// Compares two maps byte by byte outside the frame record, which must differ.
fn assert_same_but_frame(found: &[u8], expected: &[u8], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}: lengths");
    let allowed = frame_record(expected);
    assert_eq!(allowed, frame_record(found), "{what}: sections");
    let differ: Vec<usize> = (0..found.len()).filter(|&i| found[i] != expected[i]).collect();
    assert!(!differ.is_empty(), "{what}: the frame is the same");
    let outside = differ.iter().find(|&i| !allowed.iter().any(|range| range.contains(i)));
    assert_eq!(outside, None, "{what}: first differing byte outside the frame record");
    MapView::open(found).unwrap().verify().unwrap();
}

/// Ways of having normals, each a path of its own through an ingest.
const NORMALS: [(NormalsFrom, Orientation); 3] = [
    (NormalsFrom::Auto, Orientation::Unknown),
    (NormalsFrom::Estimate, Orientation::Up),
    (NormalsFrom::Estimate, Orientation::Unknown),
];

fn with_normals(
    (normals, orientation): &(NormalsFrom, Orientation),
) -> impl FnOnce(&mut IngestRequest) {
    let (normals, orientation) = (*normals, orientation.clone());
    move |request| {
        request.normals = normals;
        request.orientation = orientation;
    }
}

/// Trees of some thousand leaves, of both shapes; one with rectangles.
fn configs() -> [BuildConfig; 2] {
    let (max_level, leaf_capacity, max_spread) = (6, 10, 3);
    let binned = BuildConfig { max_level, leaf_capacity, max_spread, ..BuildConfig::default() };
    let (tree, profile) = (Shape::Paper, Profile::Oriented);
    let paper = BuildConfig { tree, profile, max_level: 4, ..binned.clone() };
    [binned, paper]
}

#[test]
fn d8_threads_change_no_byte() {
    let folder = tempfile::tempdir().unwrap();
    let scan = scene_file(SceneKind::Furnished, 40_000, false, &folder.path().join("room.las"));
    let threads = |threads| Limits { threads, ..LIMITS };
    for normals in &NORMALS {
        let (one, _) = octree_of(&scan, &threads(1), with_normals(normals));
        for n in [2, 3, 8] {
            let (other, _) = octree_of(&scan, &threads(n), with_normals(normals));
            assert!(one == other, "octrees of 1 and {n} threads, normals {normals:?}");
        }
    }
    let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
    for config in
        [BuildConfig { leaf_capacity: 20, ..BuildConfig::default() }, configs()[1].clone()]
    {
        let one = build_with(&octree, &config, &threads(1));
        for n in [2, 3, 8] {
            let other = build_with(&octree, &config, &threads(n));
            assert_same(&other, &one, &format!("maps of 1 and {n} threads, {config:?}"));
        }
    }
}

#[test]
fn d8_memory_changes_no_byte_of_an_octree() {
    let folder = tempfile::tempdir().unwrap();
    for (name, shuffle) in [("coherent.las", false), ("shuffled.las", true)] {
        let scan = scene_file(SceneKind::Cave, 3_000_000, shuffle, &folder.path().join(name));
        let (small, spilling) = octree_of(&scan, &SMALL, |_| {});
        let (large, holding) = octree_of(&scan, &LARGE, |_| {});
        assert!(spilling.report.temporary_bytes > 100_000_000, "{:?}", spilling.report);
        assert_eq!(holding.report.temporary_bytes, 0, "{:?}", holding.report);
        assert!(small == large, "octrees of 64 MiB and 4 GiB, {name}");
    }
}

#[test]
fn d8_memory_changes_no_estimated_normal() {
    let folder = tempfile::tempdir().unwrap();
    let scan = scene_file(SceneKind::Furnished, 400_000, true, &folder.path().join("room.laz"));
    let normals = (NormalsFrom::Estimate, Orientation::Sensors(vec![[2.75, 2.75, 2.0]]));
    let (small, _) = octree_of(&scan, &SMALL, with_normals(&normals));
    let (large, _) = octree_of(&scan, &LARGE, with_normals(&normals));
    assert!(small == large, "octrees of 64 MiB and 4 GiB");
}

/// Points all over a cube with normals in all directions: half of all leaves' faces meet, few are
/// blocked, and hardly a node sees another as a whole. So there is a link for every fourth pair.
fn noise_cloud(n: usize) -> Cloud {
    let mut rng = Rng::with_seed(1);
    let positions = (0..n).map(|_| [0; 3].map(|_| rng.i32(0..1 << 24))).collect();
    let normals = (0..n).map(|_| [0; 3].map(|_| rng.f32() - 0.5)).collect();
    Cloud { positions: Positions::Lattice(positions), normals: Some(normals), colors: None }
}

#[test]
fn d8_memory_changes_no_byte_of_a_map() {
    let folder = tempfile::tempdir().unwrap();
    let scan = folder.path().join("noise.las");
    noise_cloud(6600).write_las(&scan, SCALE_M, [0.0; 3]);
    let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
    let config = BuildConfig {
        tree: Shape::Paper,
        profile: Profile::Paper,
        leaf_capacity: 1,
        ..BuildConfig::default()
    };
    // Only memory sends links to disk: on a slow machine a checkpoint would, too.
    let checkpoints = Checkpoints { every: Duration::MAX, ..Checkpoints::default() };
    let build = |name: &str, limits: &Limits| {
        let output = folder.path().join(name);
        let built =
            pvmap::build_with(&octree, &output, &config, limits, &checkpoints, &Quiet).unwrap();
        (std::fs::read(output).unwrap(), built.report)
    };
    let (small, report) = build("small.vmap", &SMALL);
    // Sorting a link takes 16 bytes: they do not fit.
    assert!(report.summary.n_links * 16 > SMALL.memory_bytes, "{report:?}");
    let (large, other) = build("large.vmap", &LARGE);
    assert!(report.temporary_bytes > 0, "no run in 64 MiB went to disk: {report:?}");
    assert_eq!(other.temporary_bytes, 0, "runs of 4 GiB went to disk");
    assert_same(&small, &large, "maps of 64 MiB and 4 GiB");
}

#[test]
fn d8_two_runs_make_the_same_folder_and_map() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["room.las", "room.laz", "room.ply"] {
        let scan = scene_file(SceneKind::Furnished, 6_000, false, &folder.path().join(name));
        for normals in &NORMALS {
            let (one, _) = octree_of(&scan, &LIMITS, with_normals(normals));
            let (two, _) = octree_of(&scan, &LIMITS, with_normals(normals));
            assert!(one == two, "octrees of two runs, {name}, normals {normals:?}");
        }
        let scans = [scan];
        let run = || map_of(&scans, &configs()[0], |_| {});
        assert_same(&run(), &run(), name);
    }
}

#[test]
fn d2_n13_shuffled_points_make_the_same_map() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["room.las", "room.laz", "room.ply"] {
        let scan = |shuffle, order: &str| {
            let path = folder.path().join(order).join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            [scene_file(SceneKind::Furnished, 6_000, shuffle, &path)]
        };
        let (coherent, shuffled) = (scan(false, "coherent"), scan(true, "shuffled"));
        for normals in &NORMALS {
            for config in configs() {
                let expected = map_of(&coherent, &config, with_normals(normals));
                let found = map_of(&shuffled, &config, with_normals(normals));
                assert_same(&found, &expected, &format!("{name}, {normals:?}, {config:?}"));
            }
        }
    }
}

/// Moves every point by whole lattice steps.
fn stepped(cloud: &Cloud, steps: [i32; 3]) -> Cloud {
    let Positions::Lattice(places) = &cloud.positions else { unreachable!("made on a lattice") };
    let moved = places.iter().map(|p| [0, 1, 2].map(|i| p[i] + steps[i])).collect();
    Cloud { positions: Positions::Lattice(moved), ..cloud.clone() }
}

/// Compares the maps of a LAS at its place and of others, for all ways of having normals.
fn compare_las(moved: &[(&str, Cloud, f64, [f64; 3])]) {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path().join("home.las");
    room_cloud(6_000).write_las(&home, SCALE_M, [0.0; 3]);
    let others: Vec<_> = moved
        .iter()
        .map(|(what, cloud, scale, offset)| {
            let path = folder.path().join(format!("{what}.las"));
            cloud.write_las(&path, *scale, *offset);
            (what, path)
        })
        .collect();
    for (normals, config) in NORMALS.iter().flat_map(|n| configs().map(|c| (n, c))) {
        let expected = map_of(std::slice::from_ref(&home), &config, with_normals(normals));
        for (what, path) in &others {
            let found = map_of(std::slice::from_ref(path), &config, with_normals(normals));
            assert_same_but_frame(&found, &expected, &format!("{what}, {normals:?}, {config:?}"));
        }
    }
}

#[test]
fn d2_n45_a_las_moved_by_500_km_makes_the_same_map() {
    let cloud = room_cloud(6_000);
    compare_las(&[
        ("offset", cloud.clone(), SCALE_M, [500_000.0, -500_000.0, 500_000.0]),
        // No whole number of steps, and nothing a float holds exactly.
        ("odd offset", cloud.clone(), SCALE_M, [500_000.123_456_7, 0.1, -1e7 / 3.0]),
        ("steps", stepped(&cloud, [12_345, -1_000_000, 2_000_000_000]), SCALE_M, [0.0; 3]),
        ("both", stepped(&cloud, [-7, 7, 1]), SCALE_M, [500_000.0; 3]),
    ]);
}

#[test]
fn d2_n46_a_las_scaled_by_a_power_of_two_makes_the_same_map() {
    let cloud = room_cloud(6_000);
    let scaled = |k: i32| SCALE_M * 2f64.powi(k);
    compare_las(&[
        ("half", cloud.clone(), scaled(-1), [0.0; 3]),
        ("1024", cloud.clone(), scaled(10), [0.0; 3]),
        ("tiny", cloud.clone(), scaled(-300), [0.0; 3]),
        ("huge", cloud.clone(), scaled(300), [0.0; 3]),
    ]);
}

#[test]
fn d2_n46_a_ply_scaled_by_a_power_of_two_makes_the_same_map() {
    let folder = tempfile::tempdir().unwrap();
    let room = room_cloud(6_000);
    let Positions::Lattice(steps) = &room.positions else { unreachable!("made on a lattice") };
    let double = |k: i32| {
        let place = |p: &[i32; 3]| p.map(|c| (f64::from(c) * SCALE_M + 0.7) * 2f64.powi(k));
        Positions::Double(steps.iter().map(place).collect())
    };
    let single = |k: i32| {
        let place = |p: &[i32; 3]| p.map(|c| (c as f32 * 0.0001 + 0.7) * 2f32.powi(k));
        Positions::Single(steps.iter().map(place).collect())
    };
    let file = |name: &str, positions| {
        let path = folder.path().join(name);
        Cloud { positions, ..room.clone() }.write_ply(&path);
        path
    };
    let doubles = [0, 1, -3, 20, -300, 300].map(|k| file(&format!("double{k}.ply"), double(k)));
    let singles = [0, 1, -3, 20, -60, 60].map(|k| file(&format!("single{k}.ply"), single(k)));
    for (normals, files) in NORMALS.iter().flat_map(|n| [(n, &doubles), (n, &singles)]) {
        let config = &configs()[0];
        let expected = map_of(&files[..1], config, with_normals(normals));
        for path in &files[1..] {
            let found = map_of(std::slice::from_ref(path), config, with_normals(normals));
            assert_same_but_frame(&found, &expected, &format!("{}, {normals:?}", path.display()));
        }
    }
}

#[test]
fn d2_the_parts_of_a_las_make_the_map_of_the_whole() {
    let folder = tempfile::tempdir().unwrap();
    let room = room_cloud(6_000);
    let n = room.len();
    let file = |name: &str, cloud: &Cloud, offset: [f64; 3]| {
        let path = folder.path().join(name);
        cloud.write_las(&path, SCALE_M, offset);
        path
    };
    let whole = file("whole.las", &room, [0.0; 3]);
    let first = file("first.las", &room.part(0..n / 3), [0.0; 3]);
    let rest = file("rest.las", &room.part(n / 3..n), [0.0; 3]);
    let odd = file("odd.las", &room.part((1..n).step_by(2)), [0.0; 3]);
    let even = file("even.las", &room.part((0..n).step_by(2)), [0.0; 3]);
    // The same places: 20 000 steps less from an offset 2 m further. [D-1]
    let shifted = stepped(&room.part(n / 3..n), [-20_000, 0, 20_000]);
    let shifted = file("shifted.las", &shifted, [2.0, 0.0, -2.0]);
    for (normals, config) in NORMALS.iter().flat_map(|n| configs().map(|c| (n, c))) {
        let expected = map_of(std::slice::from_ref(&whole), &config, with_normals(normals));
        for parts in [[&first, &rest], [&rest, &first], [&odd, &even], [&first, &shifted]] {
            let found = map_of(&parts.map(PathBuf::clone), &config, with_normals(normals));
            assert_same(&found, &expected, &format!("{parts:?}, {normals:?}, {config:?}"));
        }
        let parts = [shifted.clone(), first.clone()];
        let found = map_of(&parts, &config, with_normals(normals));
        assert_same_but_frame(&found, &expected, &format!("{parts:?}, {normals:?}, {config:?}"));
    }
}
