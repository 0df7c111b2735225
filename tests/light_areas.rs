//! Areas are those of the surfaces in scans that are as scanners make them, uneven and noisy.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;

use pvmap::geometry::Positions;
use pvmap::light::areas_grid2;
use pvmap::vmap::MapView;

use crate::cli_common::Bench;
use crate::common::Cloud;

/// Far pairs in coarser trees: quick, and the leaves are the same.
const QUICK: &str = "--opening-angle 0.15 --progress off";

/// A folder with the map `scan.vmap` of a generated scene with defects.
fn scanned(scene: &str, ingest: &str) -> Bench {
    let bench = Bench::new();
    bench.line(&format!("scene {scene} -o scan.laz --progress off")).ok();
    bench.line(&format!("ingest scan.laz {ingest} --progress off")).ok();
    bench.line(&format!("build scan.octree {QUICK}")).ok();
    bench
}

fn built(cloud: &Cloud) -> Bench {
    let bench = Bench::new();
    cloud.write_ply(&bench.path("scan.ply"));
    bench.line("ingest scan.ply --progress off").ok();
    bench.line(&format!("build scan.octree {QUICK}")).ok();
    bench
}

/// Where each surfel is, in the world, with its normal and its area.
fn surfels(map: &MapView<'_>) -> Vec<([f64; 3], [f64; 3], f64)> {
    let frame = &map.frame().frame;
    let unit = frame.unit();
    let rows = (0..).zip(areas_grid2(map).unwrap()).map(|(id, area)| {
        let surfel = map.surfel(id).unwrap();
        let place = frame.world_of_real(surfel.centroid.map(f64::from));
        (place, surfel.normal.map(|n| f64::from(n) / 16384.0), area * unit * unit)
    });
    rows.collect()
}

/// The furnished room's surfaces, and its ceiling.
const ROOM_M2: f64 = 212.1588;
const CEILING_M2: f64 = 30.25;

#[test]
fn areas_are_those_of_the_plan_however_uneven_and_noisy_the_points() {
    let estimated = "--normals estimate --sensor 2.75,2.75,4.5";
    for (defects, ingest, most) in [
        ("", "", 0.003),
        ("--noise 3mm", "", 0.003),
        ("--noise 3mm", estimated, 0.005),
        ("--uneven 64", "", 0.012),
        ("--uneven 64", estimated, 0.04),
        ("--uneven 64 --noise 10mm", "", 0.03),
        ("--uneven 64 --noise 10mm", estimated, 0.04),
    ] {
        let bench = scanned(&format!("furnished --points 200k {defects}"), ingest);
        let all = bench.with_map("scan.vmap", surfels);
        let area: f64 = all.iter().map(|row| row.2).sum();
        println!("{defects} {ingest}: {area:.2} m² of {ROOM_M2}");
        assert!((area / ROOM_M2 - 1.0).abs() <= most, "{defects} {ingest}: {area}");
        // A part is not too large because another is too small.
        let half = |is_dense: bool| {
            let is_there = |c: [f64; 3]| c[2] > 5.4 && (c[0] < 2.75) == is_dense;
            let ceiling = all.iter().filter(|(c, n, _)| is_there(*c) && n[2].abs() > 0.6);
            ceiling.map(|row| row.2).sum::<f64>() / (CEILING_M2 / 2.0)
        };
        let [dense, sparse] = [true, false].map(half);
        let what = format!("{defects} {ingest}: {dense:.3} dense, {sparse:.3} sparse");
        assert!((dense - 1.0).abs() < 0.03 && (sparse - 1.0).abs() < 0.1, "{what}");
    }
}

#[test]
fn a_thin_wall_has_the_area_of_both_of_its_faces() {
    // 2 cm thick, in leaves of 5 cm, denser to one side.
    let mut rng = fastrand::Rng::with_seed(5);
    let (mut places, mut normals) = (Vec::new(), Vec::new());
    for k in 0..60_000 {
        let side = f64::from(k % 2) * 2.0 - 1.0;
        let along = 2.0 * rng.f64().powi(2);
        places.push([1.0 + 0.01 * side, along, 2.0 * rng.f64()]);
        normals.push([side as f32, 0.0, 0.0]);
    }
    let cloud =
        Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None };
    let area: f64 = built(&cloud).with_map("scan.vmap", surfels).iter().map(|row| row.2).sum();
    assert!((area / 8.0 - 1.0).abs() < 0.02, "{area}, not 8");
}
