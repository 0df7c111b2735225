//! What is violet in a picture: held against the map, the points and the exact triangles.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod vectors;

use cli_common::{Bench, data, is_slow_asked_for, needle};
use pvmap::geometry::Frame;
use pvmap::query::exact::{Exact, ExactOptions};
use pvmap::query::{Map, Place, QueryError, Snap, SurfelSet};
use pvmap::render::{
    Camera, ColorBy, Lens, MapSplats, OctreeSplats, Paint, Seen, Size, Source, Style, VIOLET,
    Values, View, ramp, render, srgb,
};
use pvmap::scene::{Mesh, Scene};
use pvmap::scenes;
use pvmap::vmap::OctreeView;
use pvmap::vmap::tree::{Nodes, route};
use rayon::prelude::*;
use vectors::{cross, dot, sub};

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
    bench.line("build room.octree").ok();
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
        let paints = [
            Paint::new(ColorBy::Rgb, Some(Seen::Surfels(&is_seen))),
            Paint::new(ColorBy::Values(numbers), None),
        ];
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
            OctreeSplats::new(
                octree,
                None,
                Paint::new(ColorBy::Rgb, Some(Seen::Surfels(&is_seen))),
                1.0
            )
            .is_err()
        );
    });
}

#[test]
fn asked_of_the_points_each_surfel_has_the_verdict_of_its_nearest_and_each_point_its_own() {
    let bench = needle_room("6k");
    with_both(&bench, |map, octree| {
        let exact = Exact::new(octree, ExactOptions::usual(map).unwrap());
        let at = map.locate(&place(EYE), Snap::default()).unwrap();
        let eye = exact.nearest(&place(EYE)).unwrap().point;
        let found = exact.visible_from(map, &eye, &at, &|_| true).unwrap();
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
        let stopped = exact.visible_from(map, &eye, &at, &|_| false);
        assert_eq!(stopped, Err(QueryError::Stopped));

        let n_points = octree.summary().n_points;
        let told = std::sync::atomic::AtomicU64::new(0);
        let tell = |n| {
            told.fetch_add(n, std::sync::atomic::Ordering::Relaxed);
            true
        };
        let points = exact.points_visible_from(&eye, &tell).unwrap();
        assert_eq!(told.into_inner(), n_points);
        let sees = |i: u64| exact.pair(&eye, &exact.point(i).unwrap()).unwrap().visible;
        assert!((0..n_points).all(|i| points.contains(i) == sees(i)));
        assert_eq!(points.len(), (0..n_points).filter(|&i| points.contains(i)).count() as u64);
        assert!(!points.contains(n_points) && (1..n_points).contains(&points.len()));
        let stopped = exact.points_visible_from(&eye, &|_| false);
        assert_eq!(stopped, Err(QueryError::Stopped));
    });
}

/// Into the open side of the Cornell room.
const OUTSIDE: View = View {
    eye: [2.75, -6.6, 3.3],
    target: [2.75, 2.75, 2.6],
    up: [0.0, 0.0, 1.0],
    lens: Lens::Perspective { fov_deg: FOV_DEG },
};
const FOV_DEG: f64 = 44.0;
const SIZE: Size = Size { width_px: 200, height_px: 180 };
/// On the red wall, which faces +x.
const ON_THE_WALL: [f64; 3] = [0.0, 1.5, 3.0];

/// What a pixel shows of the exact triangles: a place and its normal.
type Hit = ([f64; 3], [f64; 3]);

/// Casts the ray of every pixel at triangles; those that are turned away are not there.
fn hits(mesh: &Mesh) -> Vec<Option<Hit>> {
    let triangles: Vec<_> = mesh
        .triangles()
        .iter()
        .map(|t| t.map(|c| mesh.corners()[c as usize]))
        .map(|[a, b, c]| (a, sub(b, a), sub(c, a)))
        .collect();
    let ahead = direction(sub(OUTSIDE.target, OUTSIDE.eye));
    let right = direction(cross(ahead, OUTSIDE.up));
    let down = cross(ahead, right);
    let (width, height) = (f64::from(SIZE.width_px), f64::from(SIZE.height_px));
    let focal = height / 2.0 / (FOV_DEG.to_radians() / 2.0).tan();
    let cast = |pixel: u32| {
        let x = f64::from(pixel % SIZE.width_px) + 0.5 - width / 2.0;
        let y = f64::from(pixel / SIZE.width_px) + 0.5 - height / 2.0;
        let d = [0, 1, 2].map(|i| ahead[i] + (right[i] * x + down[i] * y) / focal);
        let mut nearest: Option<(f64, [f64; 3])> = None;
        for (a, ab, ac) in &triangles {
            // Möller and Trumbore 1997.
            let across = cross(d, *ac);
            let scale = dot(*ab, across);
            if scale <= 0.0 {
                continue;
            }
            let off = sub(OUTSIDE.eye, *a);
            let (u, along) = (dot(off, across) / scale, cross(off, *ab));
            let (v, t) = (dot(d, along) / scale, dot(*ac, along) / scale);
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && nearest.is_none_or(|(n, _)| t < n) {
                nearest = Some((t, cross(*ab, *ac)));
            }
        }
        nearest.map(|(t, n)| ([0, 1, 2].map(|i| OUTSIDE.eye[i] + t * d[i]), direction(n)))
    };
    (0..SIZE.width_px * SIZE.height_px).into_par_iter().map(cast).collect()
}

/// Says of every pixel whether truth sees what it shows from a place; none where it shows nothing.
fn truth_from(mesh: &Mesh, eye: &Place) -> Vec<Option<bool>> {
    let scene = Scene::of_mesh(mesh, 1);
    let (position, normal) = (eye.position, eye.normal.unwrap());
    let sees = |hit: &Option<Hit>| {
        hit.map(|(at, n)| scene.sees_points(position, normal, at, n.map(|v| v as f32)))
    };
    hits(mesh).par_iter().map(sees).collect()
}

/// Says of every pixel whether it is violet; none where nothing is.
fn violet_of(splats: &dyn Source, frame: &Frame) -> Vec<Option<bool>> {
    let camera = Camera::new(&OUTSIDE, SIZE, frame).unwrap();
    let style = Style { background: [255; 3], cull_back: true, shade: 0.0 };
    let picture = render(splats, &camera, &style, 1 << 30, &mut |_| true).unwrap();
    let near = |c: [u8; 3]| (0..3).all(|i| c[i].abs_diff(VIOLET[i]) < 60);
    let of = |(x, y)| picture.is_covered(x, y).then(|| near(picture.pixel(x, y)));
    let all = (0..SIZE.height_px).flat_map(|y| (0..SIZE.width_px).map(move |x| (x, y)));
    all.map(of).collect()
}

/// Gives the share of the pixels with something in them of which both do not say the same.
fn share_of_others(found: &[Option<bool>], truth: &[Option<bool>]) -> f64 {
    let both = || found.iter().zip(truth).filter_map(|(f, t)| f.zip(*t));
    both().filter(|(f, t)| f != t).count() as f64 / both().count() as f64
}

/// Counts connected pixels of one verdict, fewer than `n_most`, of which truth says otherwise for
/// most.
fn n_specks(found: &[Option<bool>], truth: &[Option<bool>], n_most: usize) -> usize {
    let width = SIZE.width_px as usize;
    let mut is_done = vec![false; found.len()];
    let mut n_specks = 0;
    for start in 0..found.len() {
        let Some(verdict) = found[start] else { continue };
        let (mut open, mut all) = (vec![start], Vec::new());
        while let Some(at) = open.pop() {
            if found[at] != Some(verdict) || std::mem::replace(&mut is_done[at], true) {
                continue;
            }
            all.push(at);
            let x = at % width;
            open.extend((x > 0).then(|| at - 1));
            open.extend((x + 1 < width).then_some(at + 1));
            open.extend(at.checked_sub(width));
            open.extend(Some(at + width).filter(|&below| below < found.len()));
        }
        let n_wrong = all.iter().filter(|&&at| truth[at] == Some(!verdict)).count();
        n_specks += usize::from(all.len() < n_most && n_wrong * 2 > all.len());
    }
    n_specks
}

/// Pixels of one and a half leaves on the room's back wall.
fn n_pixels_of_a_leaf(map: &Map<'_>) -> usize {
    let view = map.view();
    let side = |id| {
        let surfel = view.surfel(id).unwrap();
        2.0 * f64::from(surfel.half_spacing) * (surfel.n_points as f64).sqrt()
    };
    let mut sides: Vec<f64> = (0..view.summary().n_surfels).map(side).collect();
    sides.sort_by(f64::total_cmp);
    let side_m = sides[sides.len() / 2] * view.frame().frame.unit();
    let focal = f64::from(SIZE.height_px) / 2.0 / (FOV_DEG.to_radians() / 2.0).tan();
    (1.5 * (side_m * focal / 12.1).powi(2)).ceil() as usize
}

/// Holds pictures of `room.vmap`, by surfels and by points, against the exact triangles.
fn shadows_are_where_they_should_be(bench: &Bench) {
    let mesh = scenes::read_mesh(&bench.path("room.mesh.ply"), 1 << 30).unwrap().mesh;
    let eye = Place { position: ON_THE_WALL, normal: Some([1.0, 0.0, 0.0]) };
    let truth = truth_from(&mesh, &eye);
    let n_seen = truth.iter().filter(|t| **t == Some(true)).count();
    let n_hidden = truth.iter().filter(|t| **t == Some(false)).count();
    assert!(n_seen > truth.len() / 4 && n_hidden > truth.len() / 20, "{n_seen} {n_hidden}");
    with_both(bench, |map, octree| {
        let (view, frame) = (map.view(), &map.view().frame().frame);
        let usual = ExactOptions::usual(map).unwrap();
        let wide = ExactOptions::new(2 * usual.delta_grid(), 5.try_into().unwrap());
        let exact = Exact::new(octree, wide);
        let picture = |eye: &Place, of_points: bool| {
            let at = map.locate(eye, Snap::default()).unwrap();
            match of_points {
                false => {
                    let seen = map.visible_from(&at).unwrap().surfels;
                    let is_seen = |id: u32| seen.contains(id);
                    let paint = Paint::new(ColorBy::Rgb, Some(Seen::Surfels(&is_seen)));
                    violet_of(&MapSplats::new(view, paint, 1.0).unwrap(), frame)
                }
                true => {
                    let point = exact.nearest(eye).unwrap().point;
                    let seen = exact.points_visible_from(&point, &|_| true).unwrap();
                    let is_seen = |index: u64| seen.contains(index);
                    let paint = Paint::new(ColorBy::Rgb, Some(Seen::Points(&is_seen)));
                    violet_of(&OctreeSplats::new(octree, None, paint, 1.0).unwrap(), frame)
                }
            }
        };
        let n_most = n_pixels_of_a_leaf(map);
        for of_points in [false, true] {
            let found = picture(&eye, of_points);
            let both = found.iter().zip(&truth);
            let n_other = both.filter(|(a, b)| a.is_some() != b.is_some());
            // Patches hang over the edges of the room by a spacing, about a pixel.
            let n_other = n_other.count();
            assert!(n_other < truth.len() * 3 / 100, "its outline: {n_other}");
            let share = share_of_others(&found, &truth);
            let n_specks = n_specks(&found, &truth, n_most);
            eprintln!("points {of_points}: {share:.4} differ, {n_specks} specks of < {n_most} px");
            assert!(share < 0.03, "{share}");
            // The eye's own leaf, and along the needle's edge, where patches of two faces hang over
            // it: 11 and 12.
            assert!(n_specks < 20, "{n_specks}");
        }
        // The same from across the room: its shadows are on other walls.
        let [x, y, z] = ON_THE_WALL;
        let across = Place { position: [5.5 - x, y, z], normal: Some([-1.0, 0.0, 0.0]) };
        assert!(share_of_others(&picture(&across, false), &truth) > 0.1);
    });
}

#[test]
fn shadows_of_a_needle_are_where_they_should_be() {
    shadows_are_where_they_should_be(&needle_room("60k"));
}

#[test]
fn shadows_of_the_bunny_are_where_they_should_be() {
    let Some(stanford) = data("stanford") else { return };
    if !is_slow_asked_for() {
        return;
    }
    let bench = Bench::new();
    let model = stanford.join("bunny_bun_zipper.ply");
    let model = model.to_str().unwrap();
    bench.run(["scene", "cornell", "--model", model, "-o", "room.ply", "--truth", "room.mesh.ply"]);
    bench.line("ingest room.ply").ok();
    bench.line("build room.octree").ok();
    shadows_are_where_they_should_be(&bench);
}

fn direction(a: [f64; 3]) -> [f64; 3] {
    a.map(|v| v / dot(a, a).sqrt())
}
