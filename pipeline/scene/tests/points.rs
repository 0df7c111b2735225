//! What a reader of a generated scan relies on.

use pvmap_scene::{Sample, Scene, SceneKind};

/// A sample as bits, to compare and to sort.
fn key(s: Sample) -> ([u64; 3], [u32; 3], [u8; 3]) {
    (s.position.map(f64::to_bits), s.normal.map(f32::to_bits), s.color)
}

fn distance(a: &Sample, b: &Sample) -> f64 {
    (0..3).map(|i| (a.position[i] - b.position[i]).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn shuffled_points_are_the_same_points() {
    for kind in SceneKind::ALL {
        let scene = Scene::new(kind, 1);
        for n in [0, 1, 2, 3, 1000, 4097] {
            let points = scene.points(n);
            assert_eq!((points.len(), points.is_empty()), (n, n == 0));
            let mut plain: Vec<_> = (0..n).map(|i| key(points.at(i))).collect();
            let mut shuffled: Vec<_> = (0..n).map(|i| key(points.shuffled().at(i))).collect();
            assert!(n < 1000 || plain != shuffled);
            plain.sort_unstable();
            shuffled.sort_unstable();
            assert_eq!(plain, shuffled);
        }
    }
}

#[test]
fn points_hang_on_the_seed_and_nothing_else() {
    for kind in SceneKind::ALL {
        let all = |seed| {
            let scene = Scene::new(kind, seed);
            (0..500).map(|i| key(scene.points(500).shuffled().at(i))).collect::<Vec<_>>()
        };
        assert_eq!(all(7), all(7));
        let (one, other) = (all(7), all(8));
        assert!(one.iter().all(|p| !other.contains(p)), "{kind}");
    }
}

#[test]
fn points_are_the_same_bits_on_every_host() {
    let digest = |kind| {
        let scene = Scene::new(kind, 42);
        let points = scene.points(3000).shuffled();
        let mut hash = 0u64;
        for i in 0..points.len() {
            let (position, normal, color) = key(points.at(i));
            let words =
                position.into_iter().chain(normal.map(u64::from)).chain(color.map(u64::from));
            // FNV's step over 64-bit words: any change of any bit shows.
            words.for_each(|w| hash = (hash ^ w).wrapping_mul(0x0100_0000_01b3));
        }
        hash
    };
    // As first generated; a change here changes every generated file.
    let expected =
        [13360123087216520953, 1854460723453519004, 4501708755955467827, 15555174544342029340];
    assert_eq!(SceneKind::ALL.map(digest), expected);
}

#[test]
fn the_rooms_fill_their_cube() {
    for kind in [SceneKind::Empty, SceneKind::Packed, SceneKind::Furnished] {
        let scene = Scene::new(kind, 2);
        let points = scene.points(2000);
        for axis in 0..3 {
            let along = || (0..points.len()).map(|i| points.at(i).position[axis]);
            assert_eq!(along().fold(f64::INFINITY, f64::min), 0.0);
            assert_eq!(along().fold(f64::NEG_INFINITY, f64::max), 5.5);
        }
    }
}

#[test]
fn walls_have_their_colours() {
    let scene = Scene::new(SceneKind::Empty, 3);
    let points = scene.points(600);
    for i in 0..points.len() {
        let Sample { position: [x, ..], color: [r, g, b], .. } = points.at(i);
        let expected = if x == 0.0 {
            r > 2 * g && r > 2 * b
        } else if x == 5.5 {
            g > 2 * r && g > 2 * b
        } else {
            r.abs_diff(b) < 20 && r > 200
        };
        assert!(expected, "{:?}", points.at(i));
    }
    let cave = Scene::new(SceneKind::Cave, 3);
    let mut colors: Vec<_> = (0..500).map(|i| cave.points(500).at(i).color).collect();
    colors.sort_unstable();
    colors.dedup();
    assert!(colors.len() > 50, "{}", colors.len());
}

#[test]
fn the_plain_order_is_a_scanners_and_the_shuffled_one_is_none() {
    for kind in SceneKind::ALL {
        let scene = Scene::new(kind, 4);
        let points = scene.points(50_000);
        let median_step = |points: pvmap_scene::Points| {
            let mut steps: Vec<f64> =
                (1..points.len()).map(|i| distance(&points.at(i - 1), &points.at(i))).collect();
            steps.sort_by(f64::total_cmp);
            steps[steps.len() / 2]
        };
        let (plain, shuffled) = (median_step(points), median_step(points.shuffled()));
        assert!(plain * 20.0 < shuffled, "{kind}: {plain} {shuffled}");
    }
}

#[test]
#[should_panic(expected = "point 5 of 5")]
fn there_is_no_point_after_the_last() {
    Scene::new(SceneKind::Empty, 0).points(5).at(5);
}
