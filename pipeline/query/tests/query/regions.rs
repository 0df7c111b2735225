//! `region` against every pair of surfels.

use fastrand::Rng;
use pvmap_geometry::GridPoint;
use pvmap_geometry::disc::Profile;
use pvmap_query::{Ball, ErrorKind, Map, Sight};
use pvmap_vmap::Shape;

use crate::common::{Cut, frame};
use crate::sound::{Sound, maps, room};

/// Gives the surfels of a ball by looking at all.
fn inside(sound: &Sound, g: GridPoint, radius: f64) -> Vec<u32> {
    let radius2 = (radius / frame().unit()).powi(2).floor() as i128;
    let is_in = |s: &u32| {
        let c = sound.tree.surfels[*s as usize].centroid;
        let off2 = (0..3).map(|i| (i128::from(c[i]) - i128::from(g[i])).pow(2)).sum::<i128>();
        off2 <= radius2
    };
    (0..sound.n_surfels()).filter(is_in).collect()
}

fn random_ball(rng: &mut Rng) -> (GridPoint, Ball) {
    // Some on a wall.
    let mut g = [0; 3].map(|_| rng.u32(..(1 << 22) - 1));
    g[rng.usize(..3)] *= rng.u32(..2);
    let middle = frame().world_of(g);
    let most = 1 << rng.u32(18..24);
    let radius = f64::from(rng.u32(..most)) * frame().unit();
    (frame().grid_of_query(middle).unwrap(), Ball { middle, radius })
}

#[test]
fn v5_regions_see_what_the_predicates_say() {
    let mut rng = Rng::with_seed(31);
    let mut n = [0; 4];
    for sound in maps(32, 18) {
        let map = Map::open(&sound.file).unwrap();
        let points = |s: u32| u128::from(sound.tree.surfels[s as usize].n_points);
        for i in 0..150 {
            if i == 75 {
                assert_eq!(map.keep(1 << 30), Ok(true));
            }
            let ((g, one), (h, other)) = (random_ball(&mut rng), random_ball(&mut rng));
            let (x, y) = (inside(&sound, g, one.radius), inside(&sound, h, other.radius));
            let found = map.region(&one, &other);
            if x.is_empty() || y.is_empty() {
                assert_eq!(found.unwrap_err().kind(), ErrorKind::Place);
                n[0] += 1;
                continue;
            }
            let found = found.unwrap();
            assert_eq!(found.n_surfels, [x.len() as u32, y.len() as u32]);
            let of = |set: &[u32]| set.iter().map(|&s| points(s)).sum::<u128>();
            assert_eq!(found.n_points.map(u128::from), [of(&x), of(&y)]);
            let pairs = || x.iter().flat_map(|&s| y.iter().map(move |&t| (s, t)));
            let seen = pairs().filter(|&(s, t)| sound.sees(s, t));
            let n_visible: u128 = seen.map(|(s, t)| points(s) * points(t)).sum();
            assert_eq!(found.n_visible, n_visible);
            let n_all = of(&x) * of(&y);
            assert!((found.sight.share() - n_visible as f64 / n_all as f64).abs() < 1e-9);
            let (expected, slot) = match n_visible {
                0 => (Sight::None, 1),
                v if v == n_all => (Sight::All, 2),
                _ => (found.sight, 3),
            };
            assert_eq!(found.sight, expected);
            assert_eq!(matches!(found.sight, Sight::Part(_)), slot == 3);
            n[slot] += 1;
            assert_eq!(map.region(&other, &one).unwrap().n_visible, n_visible);
        }
    }
    assert!(n.iter().all(|&n| n > 10), "{n:?}");
}

#[test]
fn on_open_scenes_a_region_takes_the_same_few_links_however_many_surfels_it_has() {
    let mut rng = Rng::with_seed(33);
    let last = (1 << 22) - 1;
    let mut answers = Vec::new();
    for k in [4, 6, 9] {
        let cut = Cut { shape: Shape::Binned, leaf_capacity: 3, max_level: 8, few: 1 << 16 };
        let sound = Sound::new(&room(&mut rng, k), cut, Profile::Patch);
        let map = Map::open(&sound.file).unwrap();
        let side = frame().unit() * f64::from(1 << 22);
        // The floor of an empty room and its ceiling.
        for share in [0.45, 0.2] {
            let ball = |g| Ball { middle: frame().world_of(g), radius: share * side };
            let [low, high] = [[1 << 21, 1 << 21, 0], [1 << 21, 1 << 21, last - 1]];
            let found = map.region(&ball(low), &ball(high)).unwrap();
            answers.push((found, found.n_surfels[0]));
        }
    }
    for (found, n_surfels) in &answers {
        assert!(found.n_links <= 2, "{n_surfels} surfels: {found:?}");
        assert!(found.n_nodes <= 6, "{n_surfels} surfels: {found:?}");
    }
    let most = answers.iter().map(|a| a.1).max().unwrap();
    assert!(most > 30, "{answers:?}");
}

#[test]
fn what_is_no_ball_is_refused() {
    let sound = maps(34, 1).next().unwrap();
    let map = Map::open(&sound.file).unwrap();
    let middle = frame().world_of([1 << 21; 3]);
    let whole = Ball { middle, radius: 1e9 };
    assert!(map.region(&whole, &whole).is_ok());
    for radius in [-1.0, f64::NAN] {
        let error = map.region(&whole, &Ball { middle, radius }).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Usage, "{error}");
    }
    let out = Ball { middle: [0.0; 3], radius: 1.0 };
    assert_eq!(map.region(&out, &whole).unwrap_err().kind(), ErrorKind::Place);
    let nothing = map.region(&whole, &Ball { middle, radius: 0.0 }).unwrap_err().to_string();
    assert!(nothing.contains("within 0 of "), "{nothing}");
}
