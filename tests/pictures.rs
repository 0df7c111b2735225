//! What is violet in a picture: held against the map, the points and the exact triangles.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, needle};
use pvmap::query::exact::{Exact, ExactOptions};
use pvmap::query::{Map, Place, Snap, SurfelSet};
use pvmap::render::{ColorBy, MapSplats, OctreeSplats, Paint, Source, VIOLET, Values, ramp, srgb};
use pvmap::vmap::OctreeView;
use pvmap::vmap::tree::{Nodes, route};

const EYE: [f64; 3] = [2.75, 0.4, 0.0];

/// A folder with the Cornell room around a needle, `room.vmap` and what it was made from.
fn needle_room(n_points: &str) -> Bench {
    let bench = Bench::new();
    needle(&bench.path("needle.ply"));
    bench
        .line(&format!(
            "scene cornell --model needle.ply --points {n_points} -o room.ply --truth room.mesh.ply"
        ))
        .ok();
    bench.line("ingest room.ply").ok();
    bench.line("build room.octree --leaf-capacity 8").ok();
    bench
}

fn place(position: [f64; 3]) -> Place {
    Place { position, normal: Some([0.0, 0.0, 1.0]) }
}

/// Shows the map and the octree of a room to `look`.
fn with_both(bench: &Bench, look: impl FnOnce(&Map<'_>, &OctreeView<'_>)) {
    let bytes = bench.read("room.vmap");
    let map = Map::open(&bytes).unwrap();
    bench.with_octree("room.octree", |octree| look(&map, octree));
}

#[test]
fn a_point_has_the_colour_of_its_surfel() {
    let bench = needle_room("20k");
    with_both(&bench, |map, octree| {
        let (view, n_surfels) = (map.view(), map.view().summary().n_surfels);
        let at = map.locate(&place(EYE), Snap::default()).unwrap();
        let seen = map.visible_from(&at).unwrap().surfels;
        let is_seen = |id: u32| seen.contains(id);
        let numbers = Values::new((0..n_surfels).map(|id| id as f32).collect());
        let paints =
            [Paint::new(ColorBy::Rgb, Some(&is_seen)), Paint::new(ColorBy::Values(numbers), None)];
        let n_points = octree.summary().n_points;
        let surfels: Vec<u32> = octree
            .points(0, n_points)
            .unwrap()
            .iter()
            .map(|point| route(view, &point.unwrap().key).unwrap().unwrap())
            .map(|node| view.node(node).unwrap().first_surfel)
            .collect();
        for (i, paint) in paints.into_iter().enumerate() {
            let drawn = OctreeSplats::new(octree, Some(view), paint.clone(), 1.0).unwrap();
            let (mut splats, mut of_surfels) = (Vec::new(), Vec::new());
            // In pieces that end anywhere.
            for first in (0..n_points).step_by(777) {
                drawn.read(first..n_points.min(first + 777), &mut splats).unwrap();
            }
            let patches = MapSplats::new(view, paint, 1.0).unwrap();
            patches.read(0..n_surfels.into(), &mut of_surfels).unwrap();
            let mut n_violet = 0;
            for (splat, &surfel) in splats.iter().zip(&surfels) {
                let violet = splat.color == srgb(VIOLET);
                n_violet += usize::from(violet);
                if i == 0 {
                    assert_eq!(violet, seen.contains(surfel));
                    assert_eq!(violet, of_surfels[surfel as usize].color == srgb(VIOLET));
                } else {
                    let share = surfel as f32 / (n_surfels - 1) as f32;
                    assert_eq!(splat.color, ramp(share));
                    assert_eq!(splat.color, of_surfels[surfel as usize].color);
                }
            }
            let n = splats.len();
            assert!(i == 1 || (n / 4..n * 9 / 10).contains(&n_violet), "{n_violet} of {n}");
        }
        assert!(
            OctreeSplats::new(octree, None, Paint::new(ColorBy::Rgb, Some(&is_seen)), 1.0).is_err()
        );
    });
}

#[test]
fn asked_of_the_points_each_surfel_has_the_verdict_of_its_nearest() {
    let bench = needle_room("6k");
    with_both(&bench, |map, octree| {
        let exact = Exact::new(octree, ExactOptions::usual(map).unwrap());
        let at = map.locate(&place(EYE), Snap::default()).unwrap();
        let eye = exact.nearest(&place(EYE)).unwrap().point;
        let found = exact.visible_from(map, &eye, &at, &|_| true).unwrap().unwrap();
        let frame = &map.view().frame().frame;
        let mut ids = Vec::new();
        for id in 0..map.view().summary().n_surfels {
            let surfel = map.view().surfel(id).unwrap();
            let position = frame.world_of(surfel.centroid);
            let normal = Some(surfel.normal.map(f32::from));
            let point = exact.nearest(&Place { position, normal }).unwrap().point;
            if id == at.surfel || exact.pair(&eye, &point).unwrap().visible {
                ids.push(id..id + 1);
            }
        }
        assert_eq!(found, SurfelSet::of(ids));
        // Mostly what the map says, but not all of it.
        let by_leaves = map.visible_from(&at).unwrap().surfels;
        let n_surfels = map.view().summary().n_surfels;
        let n_other = (0..n_surfels).filter(|&id| found.contains(id) != by_leaves.contains(id));
        assert!((1..n_surfels as usize / 8).contains(&n_other.count()));
        assert_eq!(exact.visible_from(map, &eye, &at, &|_| false), Ok(None));
    });
}
