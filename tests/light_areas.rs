//! Areas are those of the surfaces in scans that are as scanners make them, uneven and noisy; what
//! lamps give arrives, however near or narrow they are; and the sky is as open as it is.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;

use std::f64::consts::TAU;

use pvmap::geometry::Positions;
use pvmap::light::areas_grid2;
use pvmap::vmap::{LightView, MapView};

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
fn leaves_of_a_point_or_two_have_the_area_of_what_they_lie_on() {
    let bench = scanned("furnished --points 6k", "");
    for capacity in [1, 2, 4] {
        bench.line(&format!("build scan.octree {QUICK} --leaf-capacity {capacity}")).ok();
        let all = bench.with_map("scan.vmap", surfels);
        let area: f64 = all.iter().map(|surfel| surfel.2).sum();
        println!("{capacity}: {area:.1} m² of {ROOM_M2}, {} surfels", all.len());
        assert!((area / ROOM_M2 - 1.0).abs() < 0.15, "{capacity}: {area} m²");
    }
    bench.write("lights.toml", "[[glow]]\nall = true\nexitance = 1\n");
    let run = bench.line("light scan.vmap --lights lights.toml --plan --progress off").ok();
    assert!(!run.stderr.contains("too few points"), "{}", run.stderr);
    bench.line(&format!("build scan.octree {QUICK} --leaf-capacity 1")).ok();
    let run = bench.line("light scan.vmap --lights lights.toml --plan --progress off").ok();
    run.warns(&["surfels have too few points to tell how far these are apart"]);
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

/// What arrives of 100 that lamps give where nothing reflects.
fn arriving(bench: &Bench, lamp: &str) -> f64 {
    bench.write("lights.toml", format!("[albedo]\nfrom = 0\n{lamp}\n"));
    bench.line("light scan.vmap --lights lights.toml --progress off").ok();
    let light = bench.read("scan.light");
    LightView::open(&light).unwrap().summary().balance[0][0]
}

#[test]
fn what_lamps_give_arrives_in_a_closed_room_however_near_or_narrow_they_are() {
    let point = |place: &str| format!("[[point]]\nposition = {place}\nflux = 100");
    let spot = |angle: f64| {
        let at = "position = [2.75, 2.75, 4.0]\ndirection = [0.6, 0.48, -0.64]";
        format!("[[spot]]\n{at}\nangle = {angle:?}\nflux = 100")
    };
    // Leaves of 17 cm and more: the spot of 0.5° is 3 cm wide.
    for (scene, most) in [("empty --points 50k", 0.002), ("furnished --points 100k", 0.01)] {
        let bench = scanned(scene, "");
        let places = ["[2.75, 2.75, 4.0]", "[2.83, 2.71, 5.49]", "[0.02, 0.05, 0.03]"];
        let lamps = places.map(point).into_iter().chain([0.5, 1.0, 2.0, 5.0, 20.0].map(spot));
        for lamp in lamps {
            let found = arriving(&bench, &lamp);
            println!("{scene}, {lamp}: {found}");
            assert!((found / 100.0 - 1.0).abs() <= most, "{scene}, {lamp}: {found}");
        }
    }
    // Over the edges of the box, and on the ball: outlines of leaves do not meet there.
    let bench = scanned("furnished --points 100k", "");
    let edge = "direction = [0.1, 0.2, -1]";
    let ball = "direction = [0.25, -0.23, -0.94]";
    for (direction, angle) in [(edge, 0.5), (edge, 1.0), (ball, 0.5)] {
        let at = format!("position = [2.75, 2.75, 4.0]\n{direction}");
        let found = arriving(&bench, &format!("[[spot]]\n{at}\nangle = {angle:?}\nflux = 100"));
        println!("{direction}, {angle}: {found}");
        assert!((found / 100.0 - 1.0).abs() <= 0.05, "{direction}, {angle}: {found}");
    }
    // By the areas of before it was 85 of 100.
    let bench = scanned("furnished --points 200k --uneven 64", "");
    let found = arriving(&bench, &point("[2.75, 2.75, 4.0]"));
    assert!((found / 100.0 - 1.0).abs() <= 0.02, "uneven: {found}");
}

/// Half the side and the height of a tower on the middle of a ground, 20 by 20.
const HALF: f64 = 1.0;
const HEIGHT: f64 = 6.0;

fn tower() -> Cloud {
    let mut rng = fastrand::Rng::with_seed(7);
    let mut between = |low: f64, high: f64| low + (high - low) * rng.f64();
    let (mut places, mut normals) = (Vec::new(), Vec::new());
    while places.len() < 60_000 {
        let [x, y] = [between(-10.0, 10.0), between(-10.0, 10.0)];
        if x.abs().max(y.abs()) > HALF {
            places.push([x, y, 0.0]);
            normals.push([0.0, 0.0, 1.0]);
        }
    }
    for k in 0..16_000 {
        let (axis, side) = (k % 2, if k % 4 < 2 { 1.0 } else { -1.0 });
        let (mut place, mut normal) = ([0.0, 0.0, between(0.0, HEIGHT)], [0.0; 3]);
        (place[axis], normal[axis]) = (side * HALF, side as f32);
        place[1 - axis] = between(-HALF, HALF);
        places.push(place);
        normals.push(normal);
    }
    Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None }
}

/// Gives the share of the sky that the tower hides from a place of the ground: of each face that it
/// sees, an upright rectangle on the ground.
fn hidden(place: [f64; 3]) -> f64 {
    let faces = [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)];
    let of_face = |(axis, side): (usize, f64)| {
        let away = place[axis] * side - HALF;
        if away <= 0.0 {
            return 0.0;
        }
        // Over a foot from a to b, at a distance: Lambert's sum, of which the edge on the ground
        // and the top count, for the upright ones lie in planes square to the ground.
        let angle = |distance: f64, to: f64| (to / distance).atan() / distance;
        let top = away.hypot(HEIGHT);
        let of = |to: f64| away * (angle(away, to) - angle(top, to)) / TAU;
        of(HALF - place[1 - axis]) - of(-HALF - place[1 - axis])
    };
    faces.into_iter().map(of_face).sum()
}

#[test]
fn the_sky_around_a_tower_is_as_open_as_it_is_in_all_directions() {
    let bench = built(&tower());
    bench.write("lights.toml", "[albedo]\nfrom = 0\n[sky]\nradiance = 1\n");
    bench.line("light scan.vmap --lights lights.toml --progress off").ok();
    let bytes = bench.read("scan.light");
    let light = LightView::open(&bytes).unwrap();
    let all = bench.with_map("scan.vmap", surfels);
    let (mut squares, mut n) = (0.0, 0);
    // Of 32 directions from the tower, what is off on average.
    let mut by_direction = [(0.0, 0); 32];
    for (id, (place, _, _)) in (0..).zip(&all) {
        let from_tower = place[0].abs().max(place[1].abs());
        if place[2] > 0.01 || from_tower < HALF + 0.1 {
            continue;
        }
        let off = f64::from(light.sky(id).unwrap().unwrap()) - (1.0 - hidden(*place));
        (squares, n) = (squares + off * off, n + 1);
        if from_tower < 6.0 {
            let turn = place[1].atan2(place[0]) / TAU + 0.5;
            let one = &mut by_direction[(turn * 32.0) as usize % 32];
            *one = (one.0 + off, one.1 + 1);
        }
    }
    let mean = f64::sqrt(squares / f64::from(n));
    assert!(n > 1000 && mean < 0.012, "off by {mean} at {n} places");
    for (k, (sum, n)) in by_direction.into_iter().enumerate() {
        let off: f64 = sum / f64::from(n);
        assert!(n > 10 && off.abs() < 0.006, "direction {k}: {off} of {n}");
    }
}

#[test]
fn at_the_foot_of_a_long_wall_half_of_the_sky_is_open() {
    // 40 long, 4 high: at the distance d of an endless one (1 + d / √(d² + 16)) / 2.
    let mut rng = fastrand::Rng::with_seed(9);
    let (mut places, mut normals) = (Vec::new(), Vec::new());
    for _ in 0..60_000 {
        places.push([4.0 * rng.f64(), 40.0 * rng.f64(), 0.0]);
        normals.push([0.0, 0.0, 1.0]);
        places.push([0.0, 40.0 * rng.f64(), 4.0 * rng.f64()]);
        normals.push([1.0, 0.0, 0.0]);
    }
    let cloud =
        Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None };
    let bench = built(&cloud);
    bench.write("lights.toml", "[albedo]\nfrom = 0\n[sky]\nradiance = 1\n");
    bench.line("light scan.vmap --lights lights.toml --progress off").ok();
    let bytes = bench.read("scan.light");
    let light = LightView::open(&bytes).unwrap();
    let (mut sum, mut n, mut foot) = (0.0, 0, (0.0, 0));
    for (id, (place, normal, _)) in (0..).zip(bench.with_map("scan.vmap", surfels)) {
        let [d, along, _] = place;
        if normal[2] < 0.5 || (along - 20.0).abs() > 5.0 {
            continue;
        }
        let expected = (1.0 + d / d.hypot(4.0)) / 2.0;
        let open = f64::from(light.sky(id).unwrap().unwrap());
        (sum, n) = (sum + (open - expected).powi(2), n + 1);
        if d < 0.3 {
            foot = (foot.0 + open - expected, foot.1 + 1);
        }
    }
    let (mean, at_foot) = (f64::sqrt(sum / f64::from(n)), foot.0 / f64::from(foot.1));
    assert!(n > 300 && mean < 0.02, "off by {mean} at {n} places");
    assert!(foot.1 > 20 && at_foot.abs() < 0.01, "{at_foot} of {} at its foot", foot.1);
}
