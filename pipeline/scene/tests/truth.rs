//! Answers that are known without any computing.

use pvmap_scene::{Sample, Scene, SceneKind};

const UP: [f32; 3] = [0.0, 0.0, 1.0];
const DOWN: [f32; 3] = [0.0, 0.0, -1.0];
const RIGHT: [f32; 3] = [1.0, 0.0, 0.0];
const LEFT: [f32; 3] = [-1.0, 0.0, 0.0];

fn faces(a: &Sample, b: &Sample) -> bool {
    let d = [0, 1, 2].map(|i| b.position[i] - a.position[i]);
    let cos = |n: [f32; 3]| (0..3).map(|i| f64::from(n[i]) * d[i]).sum::<f64>();
    cos(a.normal) > 0.0 && cos(b.normal) < 0.0
}

#[test]
fn in_the_empty_room_every_two_walls_see_each_other() {
    let scene = Scene::new(SceneKind::Empty, 1);
    assert!(scene.sees_points([1.0, 1.0, 0.0], UP, [4.0, 2.0, 5.5], DOWN));
    assert!(!scene.sees_points([1.0, 1.0, 0.0], UP, [4.0, 2.0, 0.0], UP));
    let points = scene.points(20_000).shuffled();
    for i in 1..points.len() {
        let (a, b) = (points.at(i - 1), points.at(i));
        let on_one_wall = a.normal == b.normal;
        assert_eq!(scene.sees(&a, &b), !on_one_wall, "{a:?} {b:?}");
    }
}

#[test]
fn the_box_and_the_sphere_hide_what_is_behind_them() {
    let scene = Scene::new(SceneKind::Furnished, 1);
    // Through the box, past its front, and over its top at 3.2 m.
    assert!(!scene.sees_points([0.0, 3.6, 1.0], RIGHT, [5.5, 3.6, 1.0], LEFT));
    assert!(scene.sees_points([0.0, 2.2, 1.0], RIGHT, [5.5, 2.9, 3.0], LEFT));
    assert!(scene.sees_points([0.0, 3.6, 3.3], RIGHT, [5.5, 3.6, 3.3], LEFT));
    // Through the sphere, beside it and above it.
    assert!(!scene.sees_points([0.0, 1.8, 0.9], RIGHT, [5.5, 1.8, 0.9], LEFT));
    assert!(!scene.sees_points([3.9, 0.95, 0.0], UP, [3.9, 5.5, 1.0], [0.0, -1.0, 0.0]));
    assert!(scene.sees_points([0.0, 0.8, 0.9], RIGHT, [5.5, 0.8, 0.9], LEFT));
    assert!(scene.sees_points([0.0, 1.8, 1.81], RIGHT, [5.5, 1.8, 1.81], LEFT));
    // The sphere's front faces the front wall, its back does not.
    let front_wall = ([3.9, 0.0, 0.9], [0.0, 1.0, 0.0]);
    let (front, back) = (([3.9, 0.9, 0.9], [0.0, -1.0, 0.0]), ([3.9, 2.7, 0.9], [0.0, 1.0, 0.0]));
    assert!(scene.sees_points(front.0, front.1, front_wall.0, front_wall.1));
    assert!(!scene.sees_points(back.0, back.1, front_wall.0, front_wall.1));
    assert!(!scene.sees_points(front.0, front.1, back.0, back.1));
}

#[test]
fn the_packed_room_sees_only_along_its_gaps() {
    let scene = Scene::new(SceneKind::Packed, 1);
    assert!(!scene.sees_points([0.0, 2.7, 2.0], RIGHT, [5.5, 2.7, 2.0], LEFT));
    assert!(scene.sees_points([0.0, 0.3, 2.0], RIGHT, [5.5, 0.3, 2.0], LEFT));
    assert!(scene.sees_points([0.0, 2.7, 5.1], RIGHT, [5.5, 2.7, 5.1], LEFT));
    // Box side and wall across the gap.
    assert!(scene.sees_points([0.0, 2.7, 2.0], RIGHT, [0.5, 2.9, 2.0], LEFT));
}

#[test]
fn sight_is_mutual() {
    for kind in SceneKind::ALL {
        let scene = Scene::new(kind, 2);
        let points = scene.points(20_000).shuffled();
        for i in 1..points.len() {
            let (a, b) = (points.at(i - 1), points.at(i));
            assert_eq!(scene.sees(&a, &b), scene.sees(&b, &a));
            assert!(faces(&a, &b) || !scene.sees(&a, &b));
        }
    }
}

#[test]
fn rounded_points_see_what_the_points_see() {
    for kind in SceneKind::ALL {
        let scene = Scene::new(kind, 3);
        let points = scene.points(40_000).shuffled();
        let mut wrong = 0;
        for i in 1..points.len() {
            let (a, b) = (points.at(i - 1), points.at(i));
            let [pa, pb] = [a, b].map(|s| s.position.map(|v| (v * 1000.0).round() / 1000.0));
            // As stored in a map: 14 bits an axis.
            let [na, nb] = [a, b].map(|s| s.normal.map(|v| (v * 16384.0).round()));
            wrong += u32::from(scene.sees_points(pa, na, pb, nb) != scene.sees(&a, &b));
        }
        // A millimetre decides where a segment passes a silhouette, nowhere else.
        assert!(wrong <= 40, "{kind}: {wrong} of 40 000");
    }
}

#[test]
fn a_sample_projects_onto_itself() {
    for kind in SceneKind::ALL {
        let scene = Scene::new(kind, 4);
        let points = scene.points(2_000);
        for i in 0..points.len() {
            let sample = points.at(i);
            let again = scene.project(sample.position, sample.normal).expect("it is on the scene");
            let off = (0..3).map(|k| (sample.position[k] - again.position[k]).abs());
            assert!(off.fold(0.0, f64::max) < 1e-13, "{kind}: {sample:?} {again:?}");
        }
    }
}

#[test]
fn the_normal_chooses_the_side_of_an_edge() {
    let scene = Scene::new(SceneKind::Empty, 5);
    let corner = [0.003, 2.0, 0.004];
    assert_eq!(scene.project(corner, UP).map(|s| s.position), Some([0.003, 2.0, 0.0]));
    assert_eq!(scene.project(corner, RIGHT).map(|s| s.position), Some([0.0, 2.0, 0.004]));
    assert_eq!(scene.project(corner, [0.0; 3]).map(|s| s.position), Some([0.0, 2.0, 0.004]));
    // Nothing faces down here, and nothing at all is near the middle of the room.
    assert_eq!(scene.project(corner, DOWN), None);
    assert_eq!(scene.project([2.5; 3], [0.0; 3]), None);
    assert!(!scene.sees_points([2.5; 3], UP, [2.0, 2.0, 5.5], DOWN));
}
