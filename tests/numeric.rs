//! Rows N01…N51 of the numeric catalogue that concern the way from a file to a map.
//! Those that concern one room are tests there, under the same names.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;
#[path = "common/model.rs"]
mod model;

use std::collections::BTreeSet;

use cli_common::{Bench, Run, info, patch, ply_header, write_las};
use common::{contents, is_slow_run, rects};
use pvmap::geometry::disc::Profile;
use pvmap::geometry::grid::GRID_MAX;
use pvmap::geometry::{GridPoint, morton};
use pvmap::vmap::MapView;
use pvmap::vmap::tree::Nodes;

/// Writes a PLY of doubles, with normals if there are as many.
fn write_ply(bench: &Bench, name: &str, points: &[[f64; 3]], normals: &[[f64; 3]]) {
    let mut bytes = b"ply\nformat binary_little_endian 1.0\n".to_vec();
    bytes.extend(format!("element vertex {}\n", points.len()).bytes());
    let names = ["x", "y", "z", "nx", "ny", "nz"];
    for name in &names[..if normals.is_empty() { 3 } else { 6 }] {
        bytes.extend(format!("property double {name}\n").bytes());
    }
    bytes.extend(b"end_header\n");
    for (i, point) in points.iter().enumerate() {
        let row = point.iter().chain(normals.get(i).into_iter().flatten());
        bytes.extend(row.flat_map(|v| v.to_le_bytes()));
    }
    bench.write(name, bytes);
}

/// Writes a LAS of millimetre steps whose offset is another than 0; its bounds are those of 0.
fn write_las_at(bench: &Bench, offset: [f64; 3], n: u64, step: impl Fn(u64) -> [i32; 3]) {
    write_las(&bench.path("s.las"), n, step);
    for (axis, value) in (0..).zip(offset) {
        patch(&bench.path("s.las"), 155 + 8 * axis, &value.to_le_bytes());
    }
}

fn ingest(bench: &Bench, scan: &str) -> Run {
    bench.line(&format!("ingest {scan} -o s.octree --overwrite")).ok()
}

/// Gives the grid positions of all points of `s.octree`, in its order.
fn stored(bench: &Bench) -> Vec<GridPoint> {
    bench.with_octree("s.octree", |octree| {
        let points = octree.points(0, octree.summary().n_points).unwrap();
        points.iter().map(|point| point.unwrap().key.g).collect()
    })
}

/// Gives the world positions of all points of `s.octree`, in its order.
fn world(bench: &Bench) -> Vec<[f64; 3]> {
    let places = stored(bench);
    bench.with_octree("s.octree", |octree| {
        let frame = &octree.frame().frame;
        places.into_iter().map(|g| frame.world_of(g)).collect()
    })
}

/// Builds `s.octree` and says what is in the map: surfels without what the frame decides, links.
fn map_of(bench: &Bench, flags: &str) -> (Vec<String>, Vec<(u32, u32)>) {
    bench.line(&format!("build s.octree -o s.vmap {flags}")).ok();
    bench.line("verify s.vmap").ok();
    bench.with_map("s.vmap", |view: &MapView<'_>| {
        let surfels = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap());
        let surfels = surfels.map(|surfel| format!("{surfel:?}")).collect();
        let lists = (0..view.links().n_blocks()).map(|i| view.links().lists(i).unwrap());
        let links = lists.flat_map(|lists| {
            let all = lists.lists().flat_map(|(a, to)| to.iter().map(move |&b| (a, b)));
            all.collect::<Vec<_>>()
        });
        (surfels, links.collect())
    })
}

/// A hall of two floors that face each other.
fn hall(n_side: usize, step: f64) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
    let places = |z: f64| {
        let place = move |i: usize| [(i % n_side) as f64 * step, (i / n_side) as f64 * step, z];
        (0..n_side * n_side).map(place)
    };
    let height = n_side as f64 / 2.0 * step;
    let points = places(0.0).chain(places(height)).collect();
    let up = |z: f64| vec![[0.0, 0.0, z]; n_side * n_side];
    (points, [up(1.0), up(-1.0)].concat())
}

#[test]
fn n01_a_millimetre_at_utm_is_kept() {
    let bench = Bench::new();
    let row = |i: usize| [500_000.0 + i as f64 * 0.001, 4_600_000.0 + i as f64 * 0.001, 100.0];
    write_ply(&bench, "s.ply", &(0..1000).map(row).collect::<Vec<_>>(), &[]);
    ingest(&bench, "s.ply");
    assert_eq!(stored(&bench).into_iter().collect::<BTreeSet<_>>().len(), 1000);
    // On a lattice, here and there: the same map.
    let mut maps = Vec::new();
    for offset in [[0.0; 3], [500_000.0, 4_600_000.0, 100.0]] {
        write_las_at(&bench, offset, 1000, |i| [i as i32, i as i32, 7]);
        ingest(&bench, "s.las");
        assert_eq!(stored(&bench).into_iter().collect::<BTreeSet<_>>().len(), 1000);
        maps.push(map_of(&bench, "--leaf-capacity 1 --max-level 21"));
        assert_eq!(maps[0].0.len(), 1000);
    }
    assert_eq!(maps[0], maps[1]);
}

#[test]
fn n02_far_from_the_origin_nothing_is_lost_beyond_what_the_file_lost() {
    // The row asks for a refusal where a step of the grid is finer than a double. Steps of pvmap
    // are parts of the extent and not of the coordinates, so that case only keeps what a double
    // keeps: the error is half a step, or the rounding of the file.
    for origin in [6.4e6, 1.5e11] {
        let bench = Bench::new();
        let points: Vec<_> = (0..1000).map(|i| [origin + f64::from(i) * 0.01, 0.0, 0.0]).collect();
        write_ply(&bench, "s.ply", &points, &[]);
        ingest(&bench, "s.ply");
        let unit = bench.with_octree("s.octree", |octree| octree.frame().frame.unit());
        let ulp = f64::from_bits(origin.to_bits() + 1) - origin;
        for (found, given) in world(&bench).iter().zip(&points) {
            // Of numbers so near each other the difference is exact.
            assert!((found[0] - given[0]).abs() <= unit / 2.0 + 2.0 * ulp, "{found:?} {given:?}");
        }
        // Where a step is finer than a double, as at 1.5e11, it parts what doubles part.
        let n_given = points.iter().map(|p| p[0].to_bits()).collect::<BTreeSet<_>>().len();
        assert_eq!(stored(&bench).into_iter().collect::<BTreeSet<_>>().len(), n_given);
        assert_eq!((unit < ulp, n_given), (origin > 1e10, 1000));
    }
}

#[test]
fn n03_what_was_quantised_stays_where_it_is() {
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(3);
    let points: Vec<_> = (0..5000).map(|_| [0; 3].map(|_| rng.f64() * 17.3 - 4.1)).collect();
    write_ply(&bench, "s.ply", &points, &[]);
    ingest(&bench, "s.ply");
    // Places of the grid as numbers: whole ones, so that quantising them again is exact.
    let first: Vec<GridPoint> = stored(&bench);
    let again: Vec<_> = first.iter().map(|g| g.map(f64::from)).collect();
    write_ply(&bench, "again.ply", &again, &[]);
    ingest(&bench, "again.ply");
    assert_eq!(stored(&bench), first);
    // A float holds 24 bits, more than a place has.
    let rows = first.iter().map(|[x, y, z]| format!("{x} {y} {z}\n"));
    bench.write("float.ply", ply_header(5000, &["x", "y", "z"]) + &rows.collect::<String>());
    ingest(&bench, "float.ply");
    assert_eq!(stored(&bench), first);
}

#[test]
fn n04_tiles_of_different_scales_are_one_scan() {
    let bench = Bench::new();
    let step = |i: u64| [i as i32 * 37 - 18_000, i as i32 * 91, (i % 13) as i32 * 200];
    // All of 32 bits: the sum of a step and an offset in steps of the other's would not fit.
    let wide = |i: u64| {
        let span = (i * u64::from(u32::MAX) / 999) as i64 + i64::from(i32::MIN);
        [span, -span - 1, span / 7].map(|v| i32::try_from(v).unwrap())
    };
    write_las(&bench.path("a.las"), 1000, step);
    write_las(&bench.path("b.las"), 1000, wide);
    let (scale, offset) = (3.4e-7f64, [500.0f64, -300.0, 9000.0]);
    for axis in 0..3u64 {
        patch(&bench.path("b.las"), 131 + 8 * axis, &scale.to_le_bytes());
        patch(&bench.path("b.las"), 155 + 8 * axis, &offset[axis as usize].to_le_bytes());
    }
    bench.line("ingest a.las b.las -o s.octree").ok();
    let found = world(&bench);
    assert_eq!(found.len(), 2000);
    let unit = bench.with_octree("s.octree", |octree| octree.frame().frame.unit());
    let scales = scales_of(&bench.path("a.las"));
    let near =
        |x: [f64; 3]| found.iter().any(|f| (0..3).all(|i| (f[i] - x[i]).abs() <= unit * 0.5001));
    for i in 0..1000 {
        let (x, y) = (step(i).map(f64::from), wide(i).map(f64::from));
        assert!(near([0, 1, 2].map(|axis| x[axis] * scales[0][axis] + scales[1][axis])), "{i}");
        assert!(near([0, 1, 2].map(|axis| y[axis] * scale + offset[axis])), "{i}");
    }
}

/// Reads scale and offset of a LAS.
fn scales_of(path: &std::path::Path) -> [[f64; 3]; 2] {
    let bytes = std::fs::read(path).unwrap();
    let at = |i: usize| f64::from_le_bytes(bytes[i..i + 8].try_into().unwrap());
    [131, 155].map(|start| [0, 1, 2].map(|axis| at(start + 8 * axis)))
}

#[test]
fn n05_bounds_of_a_header_decide_nothing() {
    let bench = Bench::new();
    let step = |i: u64| [(i * 7919 % 4001) as i32, (i * 104_729 % 3001) as i32, i as i32 % 700];
    write_las(&bench.path("s.las"), 3000, step);
    ingest(&bench, "s.las");
    let expected = stored(&bench);
    // A box of nothing, one that is too small, one the wrong way round, and what is no box: each as
    // max and min of an axis.
    for (max, min, told) in [
        (0.0f64, 0.0f64, "x 0 to 0,"),
        (1.0, -1.0, "x -1 to 1,"),
        (-1.0, 1.0, "x 1.0 to -1.0,"),
        (f64::NAN, f64::NAN, "x NaN to NaN,"),
        (1e300, 1e300, "x 1e300 to 1e300,"),
    ] {
        let bad = [max, min].repeat(3);
        write_las(&bench.path("s.las"), 3000, step);
        for (i, value) in bad.iter().enumerate() {
            patch(&bench.path("s.las"), 179 + 8 * i as u64, &value.to_le_bytes());
        }
        // Both boxes are told.
        let run = ingest(&bench, "s.las").warns(&["s.las", "bounds", told]);
        run.warns(&["s.las", "true bounds are", "x 0 to 4, y 0 to 3, z 0 to 0.699"]);
        assert_eq!(stored(&bench), expected, "{bad:?}");
    }
}

#[test]
fn n07_n08_n43_n53_no_point_one_point_and_one_place() {
    let bench = Bench::new();
    for (n, n_surfels) in [(0, 0), (1, 1), (500, 1)] {
        write_ply(&bench, "s.ply", &vec![[3.0, -4.0, 5.0]; n], &vec![[0.0, 0.0, 1.0]; n]);
        let run = ingest(&bench, "s.ply");
        assert_eq!(run.stderr.contains("warning"), n == 0, "{}", run.stderr);
        bench.line("verify s.octree").ok();
        for flags in ["", "--tree paper --profile paper"] {
            let (surfels, links) = map_of(&bench, flags);
            assert_eq!((surfels.len(), links.len()), (n_surfels, 0), "{n} {flags}");
            // A place sees itself, and no link says so. [V-6]
            let run = bench.line("query s.vmap pair 3,-4,5 3,-4,5");
            run.exits(if n == 0 { 65 } else { 0 });
        }
    }
}

#[test]
fn n09_a_line_of_points_has_a_map() {
    let bench = Bench::new();
    let points: Vec<_> = (0..2000).map(|i| [5.0, 7.0, f64::from(i) * 0.25]).collect();
    write_ply(&bench, "s.ply", &points, &[]);
    ingest(&bench, "s.ply");
    assert!(stored(&bench).iter().all(|g| g[0] == 0 && g[1] == 0));
    let (surfels, links) = map_of(&bench, "--leaf-capacity 20");
    assert!((100..=250).contains(&surfels.len()), "{}", surfels.len());
    // Points of no normal face everybody, and a line has none to give them.
    assert!(!links.is_empty());
}

#[test]
fn n12_points_on_the_faces_of_cells_are_in_the_upper_cell() {
    let bench = Bench::new();
    // Extents of 2^22 - 1 steps, so that cells begin at whole numbers.
    let side = f64::from((1 << 22) - 1);
    let origin = [500_000.0, 4_600_000.0, 0.0];
    let mut points: Vec<_> = (0..4096u32).map(|k| origin.map(|o| o + f64::from(k << 10))).collect();
    points.push(origin.map(|o| o + side));
    write_ply(&bench, "s.ply", &points, &[]);
    ingest(&bench, "s.ply");
    let found: Vec<u32> = stored(&bench).iter().map(|g| g[0]).collect();
    let expected: Vec<u32> = (0..4096).map(|k| k << 10).chain([(1 << 22) - 1]).collect();
    assert_eq!(found, expected);
}

#[test]
fn n13_points_of_one_code_have_one_order_whatever_the_threads() {
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(13);
    let place = |_| [rng.u8(..3), rng.u8(..3), rng.u8(..3)].map(f64::from);
    let points: Vec<_> = (0..20_000).map(place).collect();
    write_ply(&bench, "s.ply", &points, &[]);
    let mut all = BTreeSet::new();
    for (threads, memory) in [(1, "64MiB"), (2, "64MiB"), (5, "1GiB")] {
        let flags = format!("--threads {threads} --memory {memory}");
        bench.line(&format!("ingest s.ply -o s.octree --overwrite {flags}")).ok();
        bench.line("build s.octree -o s.vmap").ok();
        all.insert((bench.read("s.octree/points.pvo"), bench.read("s.vmap")));
    }
    assert_eq!(all.len(), 1);
}

#[test]
fn n15_a_negative_zero_is_a_zero() {
    let bench = Bench::new();
    let (points, normals) = hall(20, 0.5);
    write_ply(&bench, "s.ply", &points, &normals);
    ingest(&bench, "s.ply");
    let expected = map_of(&bench, "");
    let signed: Vec<_> =
        points.iter().map(|p| p.map(|v| if v == 0.0 { -0.0 } else { v })).collect();
    assert!(signed.iter().flatten().any(|v| v.is_sign_negative()));
    let bytes = bench.read("s.vmap");
    write_ply(&bench, "s.ply", &signed, &normals);
    ingest(&bench, "s.ply");
    assert_eq!(map_of(&bench, ""), expected);
    assert!(bench.read("s.vmap") == bytes, "not the same bytes");
}

#[test]
fn n16_n17_n46_any_size_that_a_double_has_gives_the_same_map() {
    let bench = Bench::new();
    let (points, normals) = hall(24, 0.5);
    let mut expected = None;
    // Powers of two, so that no bit is lost: denormal numbers, and up to 1e300.
    for exponent in [0, -1030, -300, 12, 500, 990] {
        // Twice, as 2^-1030 itself is denormal.
        let half = 2f64.powi(exponent / 2);
        let scaled = |p: &[f64; 3]| p.map(|v| v * half * half);
        write_ply(&bench, "s.ply", &points.iter().map(scaled).collect::<Vec<_>>(), &normals);
        ingest(&bench, "s.ply");
        let found = map_of(&bench, "");
        assert!(!found.1.is_empty());
        assert_eq!(&found, expected.get_or_insert(found.clone()), "2^{exponent}");
    }
}

/// Holds `s.vmap` against the definitions: who sees whom, and which links say so. Gives how many
/// pairs of leaves see each other, and how many face each other and are blocked.
fn check_by_brute_force(bench: &Bench, profile: Profile) -> [u64; 2] {
    bench.with_map("s.vmap", |view: &MapView<'_>| {
        let (nodes, surfels, links) = contents(view);
        let model = model::Model::new(&nodes, &surfels, &rects(view), profile);
        let found = links.iter().map(|&(a, b)| (a as usize, b as usize));
        assert!(found.eq(model.links_from(&model.sibling_pairs())));
        assert_eq!(view.summary().n_visible_pairs, u128::from(model.n_visible()));
        [model.n_visible(), model.n_blocked]
    })
}

#[test]
fn n18_a_slab_as_thin_as_paper_is_cut_by_its_sides() {
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(18);
    // 10 km by 10 km by 1 mm.
    let place = |_| [rng.f64() * 1e4, rng.f64() * 1e4, rng.f64() * 1e-3];
    let points: Vec<_> = (0..3000).map(place).collect();
    // In strips that look along the slab, to and fro.
    let facing = |p: &[f64; 3]| [1.0, -1.0][(p[0] / 1250.0) as usize % 2];
    let normals: Vec<_> = points.iter().map(|p| [facing(p), 0.0, 0.5]).collect();
    write_ply(&bench, "s.ply", &points, &normals);
    ingest(&bench, "s.ply");
    assert!(stored(&bench).iter().all(|g| g[2] == 0));
    for (flags, profile) in [
        ("--leaf-capacity 16 --max-level 21", Profile::Patch),
        ("--leaf-capacity 16 --max-level 21 --tree paper --profile paper", Profile::Paper),
    ] {
        let (surfels, links) = map_of(&bench, flags);
        assert!(surfels.len() > 200 && !links.is_empty(), "{}", surfels.len());
        let [n_visible, n_blocked] = check_by_brute_force(&bench, profile);
        assert!(n_visible > 100 && n_blocked > 100, "{n_visible} {n_blocked}");
    }
}

#[test]
fn n19_a_crowd_in_a_wide_plain_is_no_deeper_than_the_grid() {
    // A million and a million where slow tests are asked for.
    let n = if is_slow_run() { 1_000_000 } else { 50_000 };
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(19);
    let mut place = |size: f64| [0; 3].map(|_| rng.f64() * size);
    let mut points: Vec<_> = (0..n).map(|_| place(1e-3)).collect();
    points.extend((0..n).map(|_| place(1e3)));
    write_ply(&bench, "s.ply", &points, &[]);
    // What estimates normals has the same crowd to search.
    bench.line("ingest s.ply -o s.octree --memory 64MiB --threads 2").ok().within(64);
    let line = "ingest s.ply -o s.octree --normals none --overwrite --memory 64MiB --threads 2";
    bench.line(line).ok().within(64);
    for level in [4, 21] {
        let capacity = n / 50;
        let flags = format!("--leaf-capacity {capacity} --memory 64MiB --threads 2");
        let run = bench.line(&format!("build s.octree -o s.vmap --max-level {level} {flags}")).ok();
        run.within(64);
        bench.with_map("s.vmap", |view: &MapView<'_>| {
            let levels = (0..view.n_nodes()).map(|id| view.node(id).unwrap().level);
            // The crowd is 4 steps wide: to part it takes all levels that there are.
            assert_eq!(levels.max(), Some(level));
            let surfels = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap());
            assert_eq!(surfels.map(|s| s.n_points).sum::<u64>(), 2 * n as u64);
        });
    }
    assert!(stored(&bench).is_sorted_by_key(|&g| morton::encode(g)));
}

#[test]
fn n20_more_points_than_32_bits_count_are_counted_in_64() {
    // 400 billion records, none of which is on the disk: a file with a hole.
    let bench = Bench::new();
    write_las(&bench.path("s.las"), 10, |i| [i as i32, 0, 0]);
    let (path, n_points) = (bench.path("s.las"), 400_000_000_000u64);
    let bytes = bench.read("s.las");
    let [offset, record_bytes] = [
        u64::from(u32::from_le_bytes(bytes[96..100].try_into().unwrap())),
        u64::from(u16::from_le_bytes(bytes[105..107].try_into().unwrap())),
    ];
    assert_eq!(bytes[25], 4, "LAS 1.4 counts in 64 bits");
    patch(&path, 107, &0u32.to_le_bytes());
    patch(&path, 247, &n_points.to_le_bytes());
    let file = std::fs::File::options().write(true).open(&path).unwrap();
    file.set_len(offset + n_points * record_bytes).unwrap();
    // Refused before any is read: all of them would have to fit on the disk.
    let mib = (n_points * record_bytes) >> 20;
    let run = bench.line("ingest s.las -o s.octree").fails(74, &["MiB of disk"]);
    let needed = run.stderr.split_whitespace().filter_map(|word| word.parse::<f64>().ok());
    assert!(needed.fold(0.0, f64::max) > mib as f64, "{}", run.stderr);
}

#[test]
fn n26_estimated_normals_are_the_same_wherever_the_scan_is() {
    // A floor with a millimetre of noise, here and at UTM: in floats E[x²] - E[x]² is noise there.
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(26);
    let steps: Vec<[i32; 3]> =
        (0..3000).map(|i| [i % 60 * 10, i / 60 * 10, rng.i32(-2..=2)]).collect();
    let mut all = BTreeSet::new();
    for offset in [[0.0f64; 3], [500_000.0, 4_600_000.0, 100.0]] {
        write_las_at(&bench, offset, 3000, |i| steps[i as usize]);
        ingest(&bench, "s.las");
        // What was planted, √2 mm, to 30 %, and not a digit of it from where the scan is.
        let quality = info(&bench, "s.octree --quality")["quality"].clone();
        let thickness = quality["thickness"].as_f64().unwrap();
        assert!((0.7..1.3).contains(&(thickness / 0.001_414)), "{thickness}");
        let lengths = ["spacing", "thickness"].map(|key| quality[key].to_string());
        let normals = bench.with_octree("s.octree", |octree| {
            let points = octree.points(0, 3000).unwrap();
            points.iter().map(|p| p.unwrap().key.normal).collect::<Vec<_>>()
        });
        let n_up = normals.iter().filter(|n| n[2].unsigned_abs() > 14_000).count();
        assert!(n_up > 2900, "{n_up}");
        all.insert((normals, lengths));
    }
    assert_eq!(all.len(), 1);
}

#[test]
fn n29_broken_normals_are_counted_as_missing_and_estimated() {
    let bench = Bench::new();
    let (points, mut normals) = hall(20, 0.5);
    let inf = f64::INFINITY;
    let broken = [[0.0; 3], [f64::NAN, 0.0, 1.0], [f64::NAN; 3], [0.0, inf, 0.0], [1.0, 0.0, -inf]];
    for (i, bad) in (0..).step_by(7).zip(broken.iter().cycle()).take(35) {
        normals[i] = *bad;
    }
    write_ply(&bench, "s.ply", &points, &normals);
    ingest(&bench, "s.ply");
    let found = &info(&bench, "s.octree")["normals"];
    let counts = ["from_file", "estimated", "none"].map(|key| found[key].as_u64().unwrap());
    assert_eq!(counts, [800 - 35, 35, 0]);
    // They are those of the floor and the ceiling again.
    bench.with_octree("s.octree", |octree| {
        for point in octree.points(0, 800).unwrap().iter() {
            let key = point.unwrap().key;
            let up = if key.g[2] == 0 { 1 << 14 } else { -1 << 14 };
            assert_eq!(key.normal, [0, 0, up]);
        }
    });
}

#[test]
fn n40_n41_walls_that_face_each_other_see_all_of_each_other() {
    // Neither the surfels at the ends nor their neighbours in a wall may hide anything: no
    // self-shadow however flat the angle, and none on a wall without noise.
    let bench = Bench::new();
    for (n_side, step) in [(24, 0.5), (40, 0.013)] {
        let (points, normals) = hall(n_side, step);
        write_ply(&bench, "s.ply", &points, &normals);
        ingest(&bench, "s.ply");
        for flags in ["--leaf-capacity 8", "--leaf-capacity 8 --tree paper --profile paper"] {
            map_of(&bench, flags);
            bench.with_map("s.vmap", |view: &MapView<'_>| {
                let surfels = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap());
                let n_up = surfels.filter(|surfel| surfel.normal[2] > 0).count() as u64;
                let n_down = u64::from(view.summary().n_surfels) - n_up;
                assert_eq!(view.summary().n_visible_pairs, u128::from(n_up * n_down), "{flags}");
            });
        }
    }
}

#[test]
fn n41_what_noise_hides_at_flat_angles_is_measured() {
    // The hall again, with noise across its walls: what a wall's own surfels hide of the other wall
    // is false. By [V-2] iii the neighbourhood of an end hides nothing (`patch`).
    let bench = Bench::new();
    let mut hidden = Vec::new();
    for sigma in [0.0, 0.01, 0.1] {
        let mut rng = fastrand::Rng::with_seed(41);
        let (mut points, normals) = hall(24, 0.5);
        for point in &mut points {
            point[2] += sigma * ((0..12).map(|_| rng.f64()).sum::<f64>() - 6.0);
        }
        write_ply(&bench, "s.ply", &points, &normals);
        ingest(&bench, "s.ply");
        map_of(&bench, "--leaf-capacity 8");
        let [n_visible, n_blocked] = check_by_brute_force(&bench, Profile::Patch);
        hidden.push(n_blocked as f64 / (n_visible + n_blocked) as f64);
        eprintln!("noise {sigma} of spacing 0.5: {n_blocked} hidden, {n_visible} not");
    }
    assert_eq!(hidden[0], 0.0);
    assert!(hidden[1] < 0.01 && hidden[2] < 0.05, "{hidden:?}");
}

#[test]
fn n52_leaves_of_level_2_and_20_see_each_other_as_brute_force_says() {
    // Cells of level 20 are 4 steps wide, those of level 2 2^20: places as whole numbers, with
    // corners that make the cube. All look into its middle.
    let bench = Bench::new();
    let (far, near) = (f64::from(GRID_MAX), 3_145_728.0);
    let mut points = vec![[0.0; 3], [far; 3], [1_048_576.0, 0.0, 0.0], [0.0, far, 0.0]];
    points.extend([0.0, 4.0, 8.0, 12.0].map(|x| [near + x, near, near]));
    points.extend([0.0, 4.0, 8.0].map(|x| [near + x, 900_000.0, 17.0]));
    let normals: Vec<_> = points.iter().map(|p| p.map(|v| far / 2.0 - v)).collect();
    write_ply(&bench, "s.ply", &points, &normals);
    ingest(&bench, "s.ply");
    for (shape, profile) in [("paper", Profile::Paper), ("binned", Profile::Patch)] {
        let name = if profile == Profile::Paper { "paper" } else { "patch" };
        let flags = format!("--tree {shape} --profile {name} --leaf-capacity 1 --max-level 21");
        let (surfels, links) = map_of(&bench, &flags);
        assert_eq!(surfels.len(), points.len());
        let levels = bench.with_map("s.vmap", |view: &MapView<'_>| {
            let all = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap().level);
            all.collect::<BTreeSet<u8>>()
        });
        assert!(levels.first() <= Some(&2) && levels.last() >= Some(&20), "{levels:?}");
        assert!(check_by_brute_force(&bench, profile)[0] > 10 && !links.is_empty());
    }
}
