//! Rows N01…N51 of the numeric catalogue that concern the way from a file to a map.
//! Those that concern one room are tests there, under the same names.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::collections::BTreeSet;

use cli_common::{Bench, Run, patch, write_las};
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
        let lists = (0..view.n_link_blocks()).map(|i| view.link_lists(i).unwrap());
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
    write_las(&bench.path("s.las"), 1000, |i| [i as i32, i as i32, 7]);
    ingest(&bench, "s.las");
    assert_eq!(stored(&bench).into_iter().collect::<BTreeSet<_>>().len(), 1000);
    assert_eq!(map_of(&bench, "--leaf-capacity 1 --max-level 21").0.len(), 1000);
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
            assert!((found[0] - given[0]).abs() <= unit / 2.0 + 2.0 * ulp, "{found:?} {given:?}");
        }
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
}

#[test]
fn n04_tiles_of_different_scales_are_one_scan() {
    let bench = Bench::new();
    let step = |i: u64| [i as i32 * 37 - 18_000, i as i32 * 91, (i % 13) as i32 * 200];
    write_las(&bench.path("a.las"), 1000, step);
    write_las(&bench.path("b.las"), 1000, step);
    // The scale and the offset of the other: full use of 32 bits, and far away.
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
    for i in (0..1000).step_by(97) {
        let x = step(i).map(f64::from);
        assert!(near([0, 1, 2].map(|axis| x[axis] * scales[0][axis] + scales[1][axis])), "{i}");
        assert!(near([0, 1, 2].map(|axis| x[axis] * scale + offset[axis])), "{i}");
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
    for bad in [[0.0f64; 6], [f64::NAN; 6], [1.0, -1.0, 1.0, -1.0, 1.0, -1.0], [1e300; 6]] {
        write_las(&bench.path("s.las"), 3000, step);
        for (i, value) in bad.iter().enumerate() {
            patch(&bench.path("s.las"), 179 + 8 * i as u64, &value.to_le_bytes());
        }
        ingest(&bench, "s.las").warns(&["s.las"]);
        assert_eq!(stored(&bench), expected, "{bad:?}");
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
    write_ply(&bench, "s.ply", &signed, &normals);
    ingest(&bench, "s.ply");
    assert_eq!(map_of(&bench, ""), expected);
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

#[test]
fn n18_a_slab_as_thin_as_paper_is_cut_by_its_sides() {
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(18);
    // 10 km by 10 km by 1 mm.
    let place = |_| [rng.f64() * 1e4, rng.f64() * 1e4, rng.f64() * 1e-3];
    let points: Vec<_> = (0..20_000).map(place).collect();
    write_ply(&bench, "s.ply", &points, &vec![[0.0, 0.0, 1.0]; points.len()]);
    ingest(&bench, "s.ply");
    assert!(stored(&bench).iter().all(|g| g[2] == 0));
    let (surfels, links) = map_of(&bench, "--leaf-capacity 16");
    assert!(surfels.len() > 1000);
    assert_eq!(links, []);
}

#[test]
fn n19_a_crowd_in_a_wide_plain_is_no_deeper_than_the_grid() {
    let bench = Bench::new();
    let mut rng = fastrand::Rng::with_seed(19);
    let mut place = |size: f64| [0; 3].map(|_| rng.f64() * size);
    let mut points: Vec<_> = (0..50_000).map(|_| place(1e-3)).collect();
    points.extend((0..50_000).map(|_| place(1e3)));
    write_ply(&bench, "s.ply", &points, &[]);
    ingest(&bench, "s.ply").within(128);
    bench.line("build s.octree -o s.vmap --max-level 4 --leaf-capacity 50").ok();
    bench.with_map("s.vmap", |view: &MapView<'_>| {
        let levels = (0..view.n_nodes()).map(|id| view.node(id).unwrap().level);
        assert_eq!(levels.max(), Some(4));
        let n_points = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap().n_points);
        assert_eq!(n_points.sum::<u64>(), 100_000);
    });
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
        write_las(&bench.path("s.las"), 3000, |i| steps[i as usize]);
        for axis in 0..3 {
            patch(&bench.path("s.las"), 155 + 8 * axis, &offset[axis as usize].to_le_bytes());
        }
        // The bounds of the header are those of before.
        ingest(&bench, "s.las");
        let normals = bench.with_octree("s.octree", |octree| {
            let points = octree.points(0, 3000).unwrap();
            points.iter().map(|p| p.unwrap().key.normal).collect::<Vec<_>>()
        });
        let n_up = normals.iter().filter(|n| n[2].unsigned_abs() > 14_000).count();
        assert!(n_up > 2900, "{n_up}");
        all.insert(normals);
    }
    assert_eq!(all.len(), 1);
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
