//! Light on maps of generated rooms: what surfels stand for, and the fast multipole method against
//! the direct sum over the map's own links.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::f64::consts::PI;
use std::path::Path;

use pvmap::geometry::Positions;
use pvmap::light::{
    Balanced, Elements, Exchange, Hierarchy, Kernel, LightError, Scene, SolveOptions, areas_grid2,
    solve,
};
use pvmap::query::{Located, Map};
use pvmap::vmap::{MapView, Shape, Spacing};
use pvmap::{Approximation, BuildConfig, NormalsFrom};

use crate::common::{Cloud, LIMITS, build_with, ingest_with, room_cloud};

fn map_of(cloud: &Cloud, folder: &Path, normals: NormalsFrom, config: &BuildConfig) -> Vec<u8> {
    let scan = folder.join("scan.ply");
    cloud.write_ply(&scan);
    let octree = ingest_with(&[scan], folder, &LIMITS, |request| request.normals = normals);
    build_with(&octree, config, &LIMITS)
}

fn config(max_level: u8, leaf_capacity: u64) -> BuildConfig {
    BuildConfig { max_level, leaf_capacity, ..BuildConfig::default() }
}

/// A map of the furnished room of few leaves.
fn small_room(n: u64, config: &BuildConfig, normals: NormalsFrom) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    map_of(&room_cloud(n), folder.path(), normals, config)
}

fn exchange(map: &MapView<'_>, order: Option<usize>) -> Result<Exchange, LightError> {
    let (elements, tree) = (Elements::of_map(map)?, Hierarchy::of_map(map)?);
    match order {
        None => Exchange::direct(elements, tree, map, Kernel::default()),
        Some(order) => Exchange::multipole(elements, tree, map, Kernel::default(), order),
    }
}

/// The flux a unit of area where each element has another exitance.
fn irradiance(exchange: &Exchange) -> Vec<f64> {
    let areas = exchange.elements().areas();
    let exitance: Vec<f64> = (0..areas.len()).map(|i| (i * 7919 % 101) as f64).collect();
    let flux = exchange.apply(&exitance).unwrap();
    flux.iter().zip(areas).map(|(flux, area)| flux / area).collect()
}

/// By how much the largest irradiance may be off by an order.
fn bound(order: usize) -> f64 {
    10.0 * (3.0 + 8f64.sqrt()).powi(-(order as i32))
}

fn error(found: &[f64], exact: &[f64]) -> f64 {
    let most = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let off = most(&mut found.iter().zip(exact).map(|(a, b)| (a - b).abs()));
    off / most(&mut exact.iter().copied())
}

#[test]
fn orders_are_right_within_their_bounds_on_a_furnished_room() {
    let bytes = small_room(40_000, &config(6, 30), NormalsFrom::Auto);
    let map = MapView::open(&bytes).unwrap();
    let exact = irradiance(&exchange(&map, None).unwrap());
    for order in 1..=7 {
        let operator = exchange(&map, Some(order)).unwrap();
        let (off, bound) = (error(&irradiance(&operator), &exact), bound(order));
        assert!(off <= bound, "order {order}: {off:e} > {bound:e}");
        assert!(order > 4 || operator.stats().n_far > 0, "order {order}: nothing was far");
    }
}

#[test]
fn every_visible_pair_of_leaves_is_taken_once_each_way() {
    for (tree, normals) in [
        (Shape::Binned, NormalsFrom::Auto),
        (Shape::Paper, NormalsFrom::Auto),
        (Shape::Binned, NormalsFrom::Estimate),
    ] {
        let bytes = small_room(6_000, &BuildConfig { tree, ..config(5, 12) }, normals);
        let map = MapView::open(&bytes).unwrap();
        let n = map.summary().n_surfels as usize;
        for order in [None, Some(1), Some(3)] {
            let operator = exchange(&map, order).unwrap();
            assert_eq!(operator.elements().n_without_normal(), 0);
            let mut is_taken = vec![false; n * n];
            for one in operator.interactions() {
                for i in one.targets.0..one.targets.1 {
                    for j in one.sources.0..one.sources.1 {
                        let taken = &mut is_taken[i as usize * n + j as usize];
                        assert!(!std::mem::replace(taken, true), "{i} from {j} twice");
                    }
                }
            }
            let count = is_taken.iter().filter(|taken| **taken).count() as u128;
            assert_eq!(count, 2 * map.summary().n_visible_pairs, "{tree:?}, order {order:?}");
        }
    }
}

#[test]
fn scans_without_sides_and_coarse_maps_are_lit_within_the_bounds() {
    let coarse = Approximation { opening_angle: 0.3, ..Approximation::default() };
    for (config, normals) in [
        (config(5, 12), NormalsFrom::Estimate),
        (BuildConfig { tree: Shape::Paper, ..config(5, 12) }, NormalsFrom::Auto),
        (BuildConfig { approximation: coarse, ..config(6, 12) }, NormalsFrom::Auto),
        (BuildConfig { spacing: Spacing::Neighbors, ..config(6, 12) }, NormalsFrom::Auto),
    ] {
        let bytes = small_room(12_000, &config, normals);
        let map = MapView::open(&bytes).unwrap();
        let exact = irradiance(&exchange(&map, None).unwrap());
        for order in [2, 4] {
            let found = irradiance(&exchange(&map, Some(order)).unwrap());
            let (off, bound) = (error(&found, &exact), bound(order));
            assert!(off <= bound, "{config:?}, order {order}: {off:e} > {bound:e}");
        }
    }
}

#[test]
fn n88_threads_change_no_bit_of_what_a_map_sends() {
    let bytes = small_room(20_000, &config(6, 20), NormalsFrom::Auto);
    let map = MapView::open(&bytes).unwrap();
    for order in [None, Some(3)] {
        let bits = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool.install(|| irradiance(&exchange(&map, order).unwrap()));
            found.iter().map(|v| v.to_bits()).collect::<Vec<u64>>()
        };
        let one = bits(1);
        for threads in [2, 7, 64] {
            assert!(bits(threads) == one, "order {order:?}, {threads} threads");
        }
    }
}

#[test]
fn n83_light_in_a_furnished_room_is_accounted_for() {
    let bytes = small_room(20_000, &config(6, 20), NormalsFrom::Auto);
    let map = MapView::open(&bytes).unwrap();
    let operator = exchange(&map, Some(4)).unwrap();
    let n = operator.elements().len();
    let open = Balanced::new(&operator, Scene::Open, 1e-4, 100).unwrap();
    let emission: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i % 40 == 0))).collect();
    let options = SolveOptions { tolerance: 1e-10, ..SolveOptions::default() };
    let found = solve(&open, &emission, &vec![0.7; n], &options).unwrap();
    let b = found.balance;
    assert!((b.emitted - b.absorbed - b.escaped).abs() <= 1e-9 * b.emitted, "{b:?}");
    assert!(b.clipped <= bound(4) * b.emitted, "{b:?}");
}

#[test]
fn visible_fractions_are_the_part_that_is_exchanged() {
    let sampled = Approximation { min_exchange: 1e-5, ..Approximation::default() };
    for config in [
        BuildConfig { fractions: true, ..config(5, 12) },
        BuildConfig { approximation: sampled, ..config(5, 12) },
    ] {
        let bytes = small_room(3_000, &config, NormalsFrom::Auto);
        let map = Map::open(&bytes).unwrap();
        let direct = exchange(map.view(), None).unwrap();
        let (elements, n) = (direct.elements(), direct.elements().len() as u32);
        let at = |surfel: u32| {
            let node = map.view().surfel(surfel).unwrap().node;
            Located { surfel, node, distance: 0.0 }
        };
        let mut n_parts = 0;
        for j in 0..n {
            let unit: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i == j))).collect();
            let column = direct.apply(&unit).unwrap();
            for i in (0..n).filter(|&i| i != j) {
                let fraction = map.pair_fraction(&at(i), &at(j)).unwrap().fraction();
                n_parts += u32::from(fraction > 0.0 && fraction < 1.0);
                let whole = Kernel::default().exchange(elements, i as usize, j as usize);
                let off = (column[i as usize] - fraction * whole).abs();
                assert!(off <= 1e-15 * whole, "{i} from {j}: {fraction} of {whole:e}, {off:e}");
            }
        }
        assert!(n_parts > 0 && direct.stats().n_parts > 0, "nothing is half in shadow");
        let exact = irradiance(&direct);
        for order in [2, 4] {
            let found = irradiance(&exchange(map.view(), Some(order)).unwrap());
            let (off, bound) = (error(&found, &exact), bound(order));
            assert!(off <= bound, "{config:?}, order {order}: {off:e} > {bound:e}");
        }
    }
}

/// n points of a sphere of radius 2 around a far place, facing outward.
fn sphere(n: usize) -> Cloud {
    let mut rng = fastrand::Rng::with_seed(1);
    let out = |rng: &mut fastrand::Rng| {
        let (z, angle) = (2.0 * rng.f64() - 1.0, 2.0 * PI * rng.f64());
        let r = (1.0 - z * z).sqrt();
        [r * angle.cos(), r * angle.sin(), z]
    };
    let normals: Vec<[f64; 3]> = (0..n).map(|_| out(&mut rng)).collect();
    let places = normals.iter().map(|v| [7.0 + 2.0 * v[0], 2.0 * v[1], 2.0 * v[2]]).collect();
    Cloud {
        positions: Positions::Double(places),
        normals: Some(normals.iter().map(|v| v.map(|c| c as f32)).collect()),
        colors: None,
    }
}

#[test]
fn n91_areas_of_surfels_add_up_to_the_surface() {
    // The sphere has 4 π R². The furnished room, in steps of 0.1 mm: walls, ceiling and
    // floor, the box's top in the place of its foot, its sides, and the ball.
    let room = 1e8 * (6.0 * 5.5 * 5.5 + 4.0 * PI * 0.81 + 4.0 * 1.6 * 3.2);
    let spread = BuildConfig { max_spread: 3, ..config(8, 25) };
    let neighbors = BuildConfig { spacing: Spacing::Neighbors, ..config(7, 25) };
    // Cells are leaves where they have few points for their size: the fewer a leaf may have, the
    // larger the area a point is taken for.
    let scenes =
        [(sphere(20_000), 16.0 * PI, [3e-2, 8e-2]), (room_cloud(30_000), room, [5e-3, 3e-2])];
    for (cloud, exact, bounds) in scenes {
        for (config, bound) in [
            (config(6, 30), bounds[0]),
            (spread.clone(), bounds[0]),
            (neighbors.clone(), bounds[0]),
            (config(7, 5), bounds[1]),
        ] {
            let folder = tempfile::tempdir().unwrap();
            let bytes = map_of(&cloud, folder.path(), NormalsFrom::Auto, &config);
            let map = MapView::open(&bytes).unwrap();
            let sum: f64 = areas_grid2(&map).unwrap().iter().sum();
            let step = map.frame().frame.unit();
            let off = sum * step * step / exact - 1.0;
            assert!(off.abs() < bound, "{config:?}: {off:+.4} of {exact}");
        }
    }
}

#[test]
fn maps_of_no_point_and_of_one_are_dark() {
    let cloud = room_cloud(1);
    for cloud in [cloud.part(0..0), cloud] {
        let folder = tempfile::tempdir().unwrap();
        let bytes = map_of(&cloud, folder.path(), NormalsFrom::Auto, &config(6, 30));
        let map = MapView::open(&bytes).unwrap();
        for order in [None, Some(3)] {
            let operator = exchange(&map, order).unwrap();
            let n = operator.elements().len();
            let found = solve(&operator, &vec![2.0; n], &vec![0.5; n], &SolveOptions::default());
            assert_eq!(found.unwrap().exitance, vec![2.0; n]);
        }
    }
}
