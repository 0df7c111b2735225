//! Statues in a room: where they stand, how points are shared out, and the mesh that is the truth.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

use pvmap_scene::{Mesh, Sample, Scene, SceneError, SceneKind, Up};

/// A ball of radius 1 around the origin, y up, its front outward; bent by its normals if asked.
fn ball(is_smooth: bool) -> Mesh {
    const N: u32 = 24;
    let angle = |i: u32, of: u32| std::f64::consts::PI * f64::from(i) / f64::from(of);
    let corner = |i: u32, j: u32| {
        let (turn, tilt) = (2.0 * angle(i % N, N), angle(j, N));
        [tilt.sin() * turn.cos(), tilt.cos(), tilt.sin() * turn.sin()]
    };
    let corners: Vec<_> = (0..=N).flat_map(|j| (0..N).map(move |i| corner(i, j))).collect();
    let quads = (0..N).flat_map(|j| (0..N).map(move |i| (j * N + i, j * N + (i + 1) % N)));
    let triangles = quads.flat_map(|(a, b)| [[a, b, b + N], [a, b + N, a + N]]).collect();
    let normals = is_smooth.then(|| corners.iter().map(|c| c.map(|v| v as f32 * 3.0)).collect());
    Mesh::new(corners, normals, triangles).unwrap()
}

/// A roof, longer than high, without a floor.
fn roof() -> Mesh {
    let corners = [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 0.0, 4.0], [0.0, 0.0, 4.0]];
    let ridge = [[0.0, 2.0, 2.0], [9.0, 2.0, 2.0]];
    let triangles = [[0, 5, 1], [0, 4, 5], [2, 4, 3], [2, 5, 4], [0, 3, 4], [1, 5, 2]];
    Mesh::new(corners.into_iter().chain(ridge).collect(), None, triangles.to_vec()).unwrap()
}

fn two() -> Scene {
    let statues = vec![ball(true).upright(Up::Y), roof().upright(Up::Y)];
    Scene::with_statues(1, statues, None).unwrap()
}

fn distance(p: [f64; 3], q: [f64; 3]) -> f64 {
    (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn points_lie_on_the_triangles_of_the_truth() {
    let scene = two();
    let (mesh, colors) = scene.mesh().unwrap();
    assert_eq!(mesh.triangles().len(), colors.len());
    let truth = Scene::of_mesh(&mesh, 1);
    let points = scene.points(30_000);
    let mut n_bent = 0;
    for i in 0..points.len() {
        let sample = points.at(i);
        let found = truth.project(sample.position, sample.normal).unwrap();
        assert!(distance(found.position, sample.position) < 1e-14, "{sample:?} {found:?}");
        let cosine: f64 =
            (0..3).map(|k| f64::from(found.normal[k]) * f64::from(sample.normal[k])).sum();
        assert!(cosine > 0.97, "{sample:?} {found:?}");
        n_bent += u32::from(cosine < 0.999);
    }
    assert!(n_bent > 500, "the ball's normals are its corners', {n_bent}");
}

#[test]
fn statues_stand_on_the_floor_and_apart() {
    let scene = two();
    let points = scene.points(60_000);
    // What stands where, by its paint: the room is neither of stone nor of bronze.
    let statue = |color| {
        let all = (0..points.len()).map(|i| points.at(i)).filter(|s| s.color == color);
        let places: Vec<_> = all.map(|s: Sample| s.position).collect();
        [0, 1, 2].map(|i| {
            let axis = || places.iter().map(move |p| p[i]);
            (axis().fold(9.0, f64::min), axis().fold(-9.0, f64::max))
        })
    };
    let ball = statue([168, 160, 150]);
    let roof = statue([112, 138, 124]);
    // The ball keeps 0.25 m from the wall and from the middle of the room, and so does the roof.
    assert!(ball[0].0 >= 0.25 && ball[0].1 <= 2.5 && ball[0].1 > 2.4, "{ball:?}");
    assert!(roof[0].0 >= 3.0 && roof[0].1 <= 5.25 && roof[0].1 > 5.2, "{roof:?}");
    for side in [ball, roof] {
        assert!(side[2].0 >= 0.0 && side[2].0 < 0.02 && side[2].1 < 5.25, "{side:?}");
        let middle = 0.5 * (side[1].0 + side[1].1);
        assert!((middle - 2.75).abs() < 0.05, "{side:?}");
    }
}

#[test]
fn triangles_of_two_statues_do_not_meet() {
    let (mesh, colors) = two().mesh().unwrap();
    let corners = |color| {
        let of = mesh.triangles().iter().zip(&colors).filter(move |(_, c)| **c == color);
        of.flat_map(|(t, _)| t.map(|c| mesh.corners()[c as usize][0]))
    };
    let right_of_ball = corners([168, 160, 150]).fold(f64::NEG_INFINITY, f64::max);
    let left_of_roof = corners([112, 138, 124]).fold(f64::INFINITY, f64::min);
    assert!(right_of_ball + 0.49 < left_of_roof, "{right_of_ball} {left_of_roof}");
}

#[test]
fn what_does_not_fit_is_told() {
    let statues = || vec![roof().upright(Up::Y)];
    Scene::with_statues(1, statues(), Some(5.0)).unwrap();
    let Err(SceneError::TooLarge { statue: 1, size_m, most_m }) =
        Scene::with_statues(1, statues(), Some(5.01))
    else {
        panic!("5.01 m and a gap of 0.25 m on both sides are more than 5.5 m");
    };
    assert_eq!((size_m, most_m), (5.01, 5.0));
}

#[test]
fn ten_statues_stand_side_by_side_and_not_one_more() {
    let statues = |n| vec![roof().upright(Up::Y); n];
    let scene = Scene::with_statues(1, statues(10), None).unwrap();
    assert_eq!(scene.n_parts(), 11);
    let corners = scene.mesh().unwrap().0;
    let (low, high) = corners.bounds();
    assert_eq!((low, high), ([0.0; 3], [5.5; 3]), "none stands in a wall");
    // Of 0.55 m each has what its gaps of 0.25 m leave.
    let Err(SceneError::TooLarge { statue: 1, most_m, .. }) =
        Scene::with_statues(1, statues(10), Some(0.06))
    else {
        panic!("0.06 m are more than 5.5 m / 10 - 0.5 m");
    };
    assert!((most_m - 0.05).abs() < 1e-12, "{most_m}");
    for n in [11, 12] {
        let found = Scene::with_statues(1, statues(n), None).map(|s| s.n_surfaces());
        assert_eq!(found, Err(SceneError::TooMany { n_statues: n, most: 10 }));
    }
}

#[test]
fn points_are_shared_out_as_asked() {
    let scene = two();
    assert_eq!(scene.n_parts(), 3);
    let count = |scene: &Scene, n: u64| {
        let color = |i| scene.points(n).at(i).color;
        [[168, 160, 150], [112, 138, 124]].map(|c| (0..n).filter(|&i| color(i) == c).count() as u64)
    };
    // A ball 2.25 m across and a roof 2.25 m long, by area.
    let by_area = count(&scene, 10_000);
    let ball_m2 = std::f64::consts::PI * 2.25 * 2.25;
    let room_m2 = 6.0 * 5.5 * 5.5;
    let share = by_area[0] as f64 / (10_000 - by_area[0] - by_area[1]) as f64;
    assert!((share / (ball_m2 / room_m2) - 1.0).abs() < 0.03, "{by_area:?}");
    for parts in [[5_000, 1_000, 17], [0, 7, 0], [3, 0, 9]] {
        let shared = two().shared_out(&parts);
        assert_eq!(count(&shared, parts.iter().sum()), parts[1..], "{parts:?}");
    }
}

#[test]
fn a_room_without_statues_is_the_empty_room() {
    let scene = Scene::with_statues(5, Vec::new(), None).unwrap();
    let empty = Scene::new(SceneKind::Empty, 5);
    for i in 0..300 {
        assert_eq!(scene.points(300).shuffled().at(i), empty.points(300).shuffled().at(i));
    }
}

#[test]
fn the_mesh_of_a_scene_tells_the_same_truth() {
    for kind in [SceneKind::Packed, SceneKind::Cave] {
        let scene = Scene::new(kind, 3);
        let truth = Scene::of_mesh(&scene.mesh().unwrap().0, 3);
        let points = scene.points(4_000).shuffled();
        let mut n_seen = 0;
        for i in (0..points.len()).step_by(2) {
            let (a, b) = (points.at(i), points.at(i + 1));
            let seen = truth.sees_points(a.position, a.normal, b.position, b.normal);
            assert_eq!(seen, scene.sees(&a, &b), "{kind} {i}");
            n_seen += u32::from(seen);
        }
        assert!(n_seen > 50, "{kind}: {n_seen}");
    }
    assert_eq!(Scene::new(SceneKind::Furnished, 3).mesh(), Err(SceneError::Round));
}
