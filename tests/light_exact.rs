//! Light through the whole way, from points by `pvmap build` and `lights.toml` to the light file,
//! where the answer is known: closed rooms and the inside of a sphere, a scene that is moved or
//! scaled, any number of threads, an old scaling. And what light holds, and refuses.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;

use std::f64::consts::PI;

use pvmap::geometry::Positions;
use pvmap::light::areas_grid2;
use pvmap::scene::SceneKind;
use pvmap::vmap::light::Found;
use pvmap::vmap::{Container, Kind, LightSummary, LightView};

use crate::cli_common::{Bench, MIB, Run, allowed_bytes};
use crate::common::{Cloud, room_cloud, scene_cloud};

/// A folder with the octree and map `room.*` of a cloud.
fn built(cloud: &Cloud, options: &str) -> Bench {
    let bench = Bench::new();
    cloud.write_ply(&bench.path("room.ply"));
    bench.line("ingest room.ply --progress off").ok();
    bench.line(&format!("build room.octree {options} --progress off")).ok();
    bench
}

/// Lights `room.vmap` and gives the bytes of the light.
fn lit(bench: &Bench, lights: &str, options: &str) -> Vec<u8> {
    run(bench, lights, options).ok();
    bench.read("room.light")
}

fn run(bench: &Bench, lights: &str, options: &str) -> Run {
    bench.write("lights.toml", lights);
    bench.line(&format!("light room.vmap --lights lights.toml --progress off {options}"))
}

fn summary(light: &[u8]) -> LightSummary {
    *LightView::open(light).unwrap().summary()
}

/// What was found of the surfels in the first channel.
fn found(light: &[u8]) -> Vec<Found> {
    let view = LightView::open(light).unwrap();
    (0..view.summary().n_surfels).map(|id| view.found(id).unwrap()[0]).collect()
}

fn irradiance(light: &[u8]) -> Vec<f64> {
    found(light).into_iter().map(|f| f64::from(f.irradiance)).collect()
}

/// By how much radiosity is off, as shares of what it should be: the mean over all area, and the
/// most.
fn off(bench: &Bench, light: &[u8], expected: f64) -> (f64, f64) {
    let areas = bench.with_map("room.vmap", |map| areas_grid2(map).unwrap());
    let offs = found(light).into_iter().map(|f| (f64::from(f.radiosity) / expected - 1.0).abs());
    let (mut sum, mut most) = (0.0, 0.0f64);
    for (off, area) in offs.zip(&areas) {
        (sum, most) = (sum + off * area, most.max(off));
    }
    (sum / areas.iter().sum::<f64>(), most)
}

/// All of a scene shines and reflects alike.
fn furnace(albedo: f64) -> String {
    format!("[albedo]\nfrom = {albedo}\n[[glow]]\nall = true\nexitance = 1\n")
}

#[test]
fn n75_a_furnace_of_albedo_one_half_is_twice_as_bright_as_it_shines() {
    for kind in [SceneKind::Empty, SceneKind::Furnished] {
        let bench = built(&scene_cloud(kind, 20_000), "");
        for (options, bound) in [("--error 0.1%", 1e-3), ("--direct --error 1e-7", 1e-6)] {
            let light = lit(&bench, &furnace(0.5), options);
            let (mean, most) = off(&bench, &light, 2.0);
            let told = summary(&light);
            // B = 1 + H / 2, and what arrives is short by what rows are.
            let short = told.row_error + told.residual;
            assert!(mean <= short + 1e-7, "{kind:?} {options}: {mean:e} of {told:?}");
            assert!(mean <= bound, "{kind:?} {options}: {mean:e}");
            // Rows are right on average, where so little is asked for everywhere; the worst, along
            // edges, are some 8 times as far off, and those of narrow gaps more.
            let most_off = match (options.contains("direct"), kind) {
                (true, _) => bound,
                (false, SceneKind::Empty) => 5.0 * bound,
                (false, _) => f64::INFINITY,
            };
            assert!(most <= most_off, "{kind:?} {options}: {most:e} somewhere");
        }
    }
}

#[test]
fn n77_a_closed_room_that_absorbs_nothing_has_no_light() {
    let bench = built(&scene_cloud(SceneKind::Empty, 20_000), "");
    for options in ["", "--direct"] {
        run(&bench, &furnace(1.0), options).fails(65, &["room.vmap", "no finite solution"]);
    }
    run(&bench, &furnace(1.0), "--no bounces").ok();
}

/// n random points of a closed box, their normals inward.
fn random_box(n: usize) -> Cloud {
    let mut rng = fastrand::Rng::with_seed(3);
    let mut normals = Vec::new();
    let mut place = || {
        let (axis, is_far) = (rng.usize(..3), rng.bool());
        let mut p = [0; 3].map(|_| rng.f64());
        p[axis] = f64::from(u8::from(is_far));
        let mut normal = [0.0; 3];
        normal[axis] = if is_far { -1.0 } else { 1.0 };
        normals.push(normal);
        p
    };
    let places = (0..n).map(|_| place()).collect();
    Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None }
}

#[test]
fn n72_random_points_of_a_closed_box_are_all_alike() {
    // With fewer points a leaf its patches leave gaps, which are no openings.
    for options in ["--leaf-capacity 200", ""] {
        let bench = built(&random_box(100_000), options);
        let light = lit(&bench, &furnace(0.8), "--error 0.002%");
        let (mean, most) = off(&bench, &light, 5.0);
        // 5.000 ± 1e-3 everywhere.
        assert!(5.0 * most <= 1e-3, "{options} {mean:e}, at the most {most:e}");
    }
}

#[test]
fn a_scaling_for_a_larger_error_is_not_good_enough_for_a_smaller_one() {
    let bench = built(&scene_cloud(SceneKind::Empty, 20_000), "");
    bench.write("rough.light", lit(&bench, &furnace(0.8), ""));
    let fresh = lit(&bench, &furnace(0.8), "--error 0.05%");
    let again = lit(&bench, &furnace(0.8), "--error 0.05% --scale-of rough.light");
    assert!(again == fresh, "another light than that of a full run");
    // The other way round it is taken as it is.
    bench.write("fine.light", &fresh);
    let rough = lit(&bench, &furnace(0.8), "--scale-of fine.light");
    assert_eq!(summary(&rough).row_error, summary(&fresh).row_error);
}

#[test]
fn rows_that_do_not_fit_the_error_are_told() {
    let bench = built(&scene_cloud(SceneKind::Furnished, 20_000), "");
    let rough = run(&bench, &furnace(0.5), "--error 5%").ok();
    assert!(!rough.stderr.contains("rows of the exchange"), "{}", rough.stderr);
    run(&bench, &furnace(0.5), "--error 0.01%").ok().warns(&["rows of the exchange are off by"]);
}

/// n points of a sphere of radius 2, facing inward: none is near another for the number there is.
fn sphere(n: usize) -> Cloud {
    let golden = PI * (3.0 - 5f64.sqrt());
    let out = |i: usize| {
        let (z, angle) = (1.0 - (2.0 * i as f64 + 1.0) / n as f64, golden * i as f64);
        let r = (1.0 - z * z).sqrt();
        [r * angle.cos(), r * angle.sin(), z]
    };
    let places = (0..n).map(|i| out(i).map(|c| 2.0 * c)).collect();
    let normals = (0..n).map(|i| out(i).map(|c| -c as f32)).collect();
    Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None }
}

#[test]
fn n67_an_integrating_sphere_spreads_flux_evenly() {
    let bench = built(&sphere(40_000), "");
    let area = bench.with_map("room.vmap", |map| {
        let steps: f64 = areas_grid2(map).unwrap().iter().sum();
        steps * map.frame().frame.unit().powi(2)
    });
    assert!((area / (16.0 * PI) - 1.0).abs() < 0.01, "an area of {area}");
    for rho in [0.5, 0.9] {
        let glow = "[[glow]]\nbox = [-3, -3, 1.5, 3, 3, 3]\nflux = 7\n";
        let lights = format!("[albedo]\nfrom = {rho}\n{glow}");
        for options in ["--error 0.5%", "--direct --error 0.5%"] {
            let found = irradiance(&lit(&bench, &lights, options));
            // What comes from the lamp at once is as even as what is reflected: Φ / A.
            let offs: Vec<f64> = found.iter().map(|h| h * (1.0 - rho) * area / 7.0 - 1.0).collect();
            let mean = offs.iter().sum::<f64>() / offs.len() as f64;
            let most = offs.iter().fold(0.0f64, |most, off| most.max((off - mean).abs()));
            assert!(mean.abs() <= 5e-3, "albedo {rho} {options}: {mean:e}");
            assert!(most <= 0.02, "albedo {rho} {options}: uneven by {most:e}");
        }
    }
}

/// Rows of places of a level rectangle, in the middles of squares of a side, with a normal.
fn level([x0, x1]: [f64; 2], [y0, y1]: [f64; 2], z: f64, side: f64, up: f32) -> Vec<Spot> {
    let n = |from: f64, to: f64| ((to - from) / side).round() as usize;
    let at = |from: f64, k: usize| from + side * (k as f64 + 0.5);
    let rows = (0..n(x0, x1)).flat_map(|i| (0..n(y0, y1)).map(move |j| (i, j)));
    rows.map(|(i, j)| ([at(x0, i), at(y0, j), z], [0.0, 0.0, up])).collect()
}

/// A place and its normal.
type Spot = ([f64; 3], [f32; 3]);

/// Builds what faces up and what is above it, in leaves of a number of points.
fn built_of(pieces: &[Vec<Spot>], leaf_capacity: u32) -> Bench {
    let (places, normals) = pieces.concat().into_iter().unzip();
    let positions = Positions::Double(places);
    let cloud = Cloud { positions, normals: Some(normals), colors: None };
    built(&cloud, &format!("--leaf-capacity {leaf_capacity} --max-spread 0"))
}

/// The unit square at a height of 2 shines down, nothing reflects.
const SQUARE: &str = "[albedo]\nfrom = 0\n[[area]]\ncorner = [0, 0, 2]\n\
                      sides = [[0, 1, 0], [1, 0, 0]]\nexitance = 1\n";

#[test]
fn answer_10_a_blocker_before_an_area_lamp() {
    // One surfel under its middle, and at half its height one that blocks.
    let receiver = level([0.45, 0.55], [0.45, 0.55], 0.0, 0.01, 1.0);
    for (side, expected, bound) in
        [(0.0, 0.073_478, 1e-5), (0.25, 0.053_989, 1e-3), (0.5, 0.0, 0.0)]
    {
        let across = [0.5 - side / 2.0, 0.5 + side / 2.0];
        let blocker = level(across, across, 1.0, side / 25.0, -1.0);
        let bench = built_of(&[receiver.clone(), blocker], 1000);
        let (light, table) = (lit(&bench, SQUARE, ""), irradiance);
        let n = bench.with_map("room.vmap", |map| map.summary().n_surfels);
        assert_eq!(n, if side > 0.0 { 2 } else { 1 });
        // Binned by normals: what faces down comes last.
        let found = table(&light)[0];
        let off = (found - expected).abs();
        assert!(off <= bound * expected, "{side}: {found}, not {expected}");
    }
}

/// What a level place at height 0 gets of a strip of the lamp, a unit of its width, by quadrature.
fn of_strip([x, y]: [f64; 2], u: f64) -> f64 {
    let n = 200;
    let part = |k: usize| {
        let v = (k as f64 + 0.5) / n as f64;
        let r2 = (u - x).powi(2) + (v - y).powi(2) + 4.0;
        4.0 / (PI * r2 * r2)
    };
    (0..n).map(part).sum::<f64>() / n as f64
}

#[test]
fn an_area_lamp_casts_a_soft_shadow() {
    // Half way up all is covered up to x = 0.5, so that a place at x sees the lamp from 1 - x on.
    // What covers is one leaf: between patches of points on a grid there are gaps.
    let floor = level([-0.5, 1.5], [0.4, 0.6], 0.0, 0.0025, 1.0);
    let cover = level([-1.0, 0.5], [-0.5, 1.5], 1.0, 0.0625, -1.0);
    let bench = built_of(&[floor, cover], 800);
    let light = lit(&bench, SQUARE, "");
    // Binned by normals: the floor comes first.
    let places: Vec<[f64; 3]> = bench.with_map("room.vmap", |map| {
        let surfels = (0..map.summary().n_surfels).map(|id| map.surfel(id).unwrap());
        let floor = surfels.take_while(|surfel| surfel.normal[2] > 0);
        floor.map(|surfel| map.frame().frame.world_of(surfel.centroid)).collect()
    });
    let (mut n_half, mut most) = (0, 0.0f64);
    for ([x, y, _], found) in places.into_iter().zip(irradiance(&light)) {
        let n = 600;
        let strips: Vec<f64> =
            (0..n).map(|k| of_strip([x, y], (k as f64 + 0.5) / f64::from(n))).collect();
        let first = ((1.0 - x).clamp(0.0, 1.0) * f64::from(n)).round() as usize;
        let expected = strips[first..].iter().sum::<f64>() / f64::from(n);
        // Twelve strips are seen or not by their middles, and the patch ends 0.001 too early.
        let brightest = strips.iter().copied().fold(0.0, f64::max);
        let off = (found - expected).abs() / brightest;
        assert!(off <= 1.0 / 24.0 + 3e-3, "at {x:.3}: {found}, not {expected}: {off:.4}");
        n_half += u32::from(x > 0.0 && x < 1.0);
        most = most.max(off);
        if !(-0.01..1.01).contains(&x) {
            assert!((found / expected - 1.0).abs() < 1e-4 || found == expected, "at {x}: {found}");
        }
    }
    assert!(n_half > 50, "{n_half} surfels in half shadow");
    println!("off by {most:.4} of the lamp's width at the most");
}

/// A wall of the room shines, all reflects in its colour: nothing names a length.
const LIGHTS: &str = "[albedo]\nfrom = \"scan\"\n[[glow]]\ncolor = \"#ba2620\"\nwithin = 0.05\n\
                      exitance = [3, 2, 1]\n";

/// The bytes of all sections of a light file but its summary and the checksums, `sums`.
fn sections(light: &[u8]) -> Vec<(String, &[u8])> {
    let file = Container::open(light, Kind::Light).unwrap();
    let of_content = |name: &str| !["summary", "sums"].contains(&name);
    let sections = file.sections().iter().filter(|s| of_content(&s.name));
    let bytes = |start: u64, len: u64| &light[start as usize..][..len as usize];
    sections.map(|s| (s.name.clone(), bytes(s.offset_bytes, s.len_bytes))).collect()
}

#[track_caller]
fn assert_same_sections(found: &[u8], expected: &[u8], what: &str) {
    let (found, expected) = (sections(found), sections(expected));
    assert_eq!(found.len(), expected.len(), "{what}");
    for (found, expected) in found.iter().zip(&expected) {
        assert!(found == expected, "{what}: section {}", found.0);
    }
}

#[test]
fn threads_change_no_byte_of_light() {
    let bench = built(&room_cloud(20_000), "");
    for options in ["", "--direct"] {
        let one = lit(&bench, LIGHTS, &format!("{options} --threads 1"));
        for threads in [2, 8] {
            let many = lit(&bench, LIGHTS, &format!("{options} --threads {threads}"));
            assert!(many == one, "{options}: {threads} threads");
        }
    }
}

#[test]
fn every_order_is_within_its_bound_of_the_light_of_all_pairs() {
    let bench = built(&room_cloud(40_000), "");
    let lamp = "[[glow]]\nbox = [21000, 22250, 54000, 34000, 32750, 56000]\nexitance = 10\n";
    let lights = &format!("[albedo]\nfrom = 0.5\n{lamp}");
    let exact = irradiance(&lit(&bench, lights, "--direct --error 0.1%"));
    let most = exact.iter().copied().fold(0.0, f64::max);
    for order in 1..=5 {
        let light = lit(&bench, lights, &format!("--order {order} --error 0.1%"));
        let found = irradiance(&light);
        let off = found.iter().zip(&exact).fold(0.0f64, |m, (a, b)| m.max((a - b).abs()));
        let bound = 10.0 * (3.0 + 8f64.sqrt()).powi(-order) + 1e-3;
        assert!(off <= bound * most, "order {order}: {:e} > {bound:e}", off / most);
    }
}

#[test]
fn an_old_scaling_gives_the_light_of_a_full_run_to_the_bit() {
    let bench = built(&room_cloud(20_000), "");
    let other = LIGHTS.replace("[3, 2, 1]", "[0, 1, 2]");
    for options in ["", "--direct"] {
        let old = lit(&bench, LIGHTS, options);
        bench.write("old.light", &old);
        let full = lit(&bench, &other, options);
        assert!(full != old, "another lamp gives the same light");
        let quick = lit(&bench, &other, &format!("{options} --scale-of old.light"));
        assert_eq!(summary(&quick), summary(&full), "{options}");
        assert!(quick == full, "{options}");
    }
}

#[test]
fn a_scaling_of_another_map_is_refused() {
    let bench = built(&room_cloud(20_000), "");
    bench.write("old.light", lit(&bench, LIGHTS, ""));
    bench.line("build room.octree --max-level 4 --progress off").ok();
    let options = "--scale-of old.light -o new.light";
    run(&bench, LIGHTS, options).fails(65, &["old.light", "another map", "room.vmap"]);
    bench.write("old.light", bench.read("room.vmap"));
    run(&bench, LIGHTS, options).fails(65, &["old.light"]);
    assert!(!bench.path("new.light").exists());
}

/// Lights a LAS of steps of 2^k tenths of a millimetre.
fn lit_las(cloud: &Cloud, k: i32, offset: [f64; 3]) -> Vec<u8> {
    let bench = Bench::new();
    cloud.write_las(&bench.path("room.las"), 1e-4 * 2f64.powi(k), offset);
    bench.line("ingest room.las --progress off").ok();
    bench.line("build room.octree --progress off").ok();
    lit(&bench, LIGHTS, "")
}

fn moved(cloud: &Cloud, by: [i32; 3]) -> Cloud {
    let Positions::Lattice(steps) = &cloud.positions else { unreachable!("made on a lattice") };
    let steps = steps.iter().map(|p| [0, 1, 2].map(|i| p[i] + by[i])).collect();
    Cloud { positions: Positions::Lattice(steps), ..cloud.clone() }
}

#[test]
fn n86_a_scan_that_is_moved_has_the_same_light() {
    let cloud = room_cloud(20_000);
    let here = lit_las(&cloud, 0, [0.0; 3]);
    for (by, offset) in
        [([12_345, -1_000_000, 2_000_000_000], [0.0; 3]), ([-7, 7, 1], [500_000.0, -1e6, 0.1])]
    {
        let there = lit_las(&moved(&cloud, by), 0, offset);
        assert_same_sections(&there, &here, &format!("moved by {by:?} and {offset:?}"));
        let map = summary(&there).map;
        assert_eq!(summary(&there), LightSummary { map, ..summary(&here) });
    }
}

#[test]
fn n84_a_scan_of_any_size_has_the_same_light() {
    let cloud = room_cloud(20_000);
    let here = lit_las(&cloud, 0, [0.0; 3]);
    for k in [-1, 10, -30, 100] {
        let there = lit_las(&cloud, k, [0.0; 3]);
        assert_same_sections(&there, &here, &format!("scaled by 2^{k}"));
        // Flux grows with the area.
        let balance = summary(&here).balance.map(|row| row.map(|flux| flux * 4f64.powi(k)));
        let map = summary(&there).map;
        assert_eq!(summary(&there), LightSummary { map, balance, ..summary(&here) }, "2^{k}");
    }
}

#[test]
fn d9_lists_that_do_not_fit_are_on_disk() {
    let bench = built(&scene_cloud(SceneKind::Furnished, 60_000), "--leaf-capacity 8");
    for options in ["", "--order 2", "--direct --error 10%"] {
        let mut lights = Vec::new();
        for (memory_mib, threads) in [(64, 2), (64, 8), (2000, 2)] {
            let line = format!("{options} --memory {memory_mib}MiB --threads {threads}");
            let run = run(&bench, &furnace(0.5), &line);
            let (held, allowed) = (run.anon_bytes, allowed_bytes(memory_mib * MIB, threads));
            run.ok();
            assert!(held <= allowed, "{} MiB held: {line}", held / MIB);
            lights.push((held, bench.read("room.light")));
        }
        let [(small, light), (_, by_eight), (large, in_memory)] = &lights[..] else { panic!() };
        assert!(light == by_eight && light == in_memory, "other bytes: {options}");
        assert!(small < large, "nothing was on disk: {small} and {large} bytes, {options}");
    }
}

#[test]
fn d9_light_of_more_surfels_than_fit_says_what_they_take() {
    let bench = built(&scene_cloud(SceneKind::Empty, 100_000), "--leaf-capacity 1");
    run(&bench, &furnace(0.5), "--memory 64MiB").fails(78, &["memory = 64 MiB", "takes", "MiB"]);
}
