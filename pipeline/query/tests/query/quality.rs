//! What is said of points and their normals: against brute force, and against what was planted.

use fastrand::Rng;
use pvmap_geometry::normal::quantise;
use pvmap_geometry::plane::Moments;
use pvmap_query::QueryError;
use pvmap_query::quality::{NormalQuality, Quality, measure};
use pvmap_vmap::OctreeView;

use crate::octree::{Key, octree_file_with, random_cloud, sorted};

const UP: [i16; 3] = [0, 0, 1 << 14];

/// Measures `n` points of a cloud on a lattice of unit steps; its normals are those of the file.
fn quality_of(cloud: Vec<Key>, n: u64) -> Quality {
    let file = octree_file_with(&sorted(cloud), true);
    let octree = OctreeView::open(&file).unwrap();
    octree.verify().unwrap();
    measure(&octree, n, &|_| true).unwrap()
}

fn distance2(a: &Key, b: &Key) -> u64 {
    (0..3).map(|i| u64::from(a.g[i].abs_diff(b.g[i])).pow(2)).sum()
}

/// The value below which `percent` of the others are, by counting.
fn quantile(values: &[f64], percent: usize) -> Option<f64> {
    let n_up_to = |v: f64| values.iter().filter(|w| **w <= v).count();
    let enough = values.iter().copied().filter(|v| n_up_to(*v) * 100 >= values.len() * percent);
    enough.min_by(f64::total_cmp)
}

/// What brute force says of one point.
struct One {
    is_coincident: bool,
    spacing: Option<f64>,
    thickness: Option<f64>,
    is_at_rim: Option<bool>,
    angle: Option<f64>,
    is_turned: Option<bool>,
}

/// Sorts the neighbours by the angle at which they are seen, and looks for the widest between two.
fn is_at_rim(offsets: &[[f64; 3]], n: [f64; 3]) -> Option<bool> {
    let axis = if n[0].abs() < 0.6 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let u = [0, 1, 2].map(|i| axis[i] - dot(axis, n) * n[i]);
    let v = cross(n, u);
    let flat = offsets.iter().filter(|d| dot(cross(**d, n), cross(**d, n)) > 1e-6);
    let mut angles: Vec<f64> = flat.map(|d| dot(*d, v).atan2(dot(*d, u))).collect();
    angles.sort_by(f64::total_cmp);
    let round = angles.first()? + std::f64::consts::TAU;
    let next = angles.iter().skip(1).chain([&round]);
    let widest = angles.iter().zip(next).map(|(a, b)| b - a).fold(0.0, f64::max);
    (angles.len() >= 8).then_some(widest.to_degrees() > 120.0 + 1e-7)
}

fn look(cloud: &[Key], i: usize) -> One {
    let p = &cloud[i];
    let mut order: Vec<usize> = (0..cloud.len()).collect();
    order.sort_by_key(|&j| (distance2(p, &cloud[j]), cloud[j].g, j));
    let others = order.iter().map(|&j| distance2(p, &cloud[j]));
    let is_coincident = others.clone().filter(|d2| *d2 == 0).count() > 1;
    let spacing = others.clone().find(|d2| *d2 > 0).map(|d2| (d2 as f64).sqrt());
    order.truncate(16);
    let mut moments = Moments::default();
    for &j in &order {
        moments.add([0, 1, 2].map(|a| i64::from(cloud[j].g[a]) - i64::from(p.g[a])), 1);
    }
    let plane = moments.plane();
    let n_free = order.len() as f64 - 3.0;
    let normal = p.normal.map(f64::from);
    let angle = plane.filter(|_| p.normal != [0; 3]).map(|plane| {
        let along: f64 = (0..3).map(|a| plane.normal[a] * normal[a]).sum();
        (along / normal.iter().map(|v| v * v).sum::<f64>().sqrt()).abs().min(1.0).acos()
    });
    let with_sides = order.iter().filter(|&&j| j != i && cloud[j].oriented && p.oriented);
    let along =
        |q: &Key| -> i64 { (0..3).map(|a| i64::from(p.normal[a]) * i64::from(q.normal[a])).sum() };
    let signs: Vec<i64> = with_sides.map(|&j| along(&cloud[j]).signum()).collect();
    One {
        is_coincident,
        spacing,
        thickness: plane.filter(|_| n_free > 0.0).map(|p| (p.residual2 / n_free).sqrt()),
        is_at_rim: plane.and_then(|plane| {
            let offset =
                |&j: &usize| [0, 1, 2].map(|a| f64::from(cloud[j].g[a]) - f64::from(p.g[a]));
            is_at_rim(&order.iter().map(offset).collect::<Vec<_>>(), plane.normal)
        }),
        angle: angle.map(f64::to_degrees),
        is_turned: (!signs.is_empty()).then(|| signs.iter().sum::<i64>() < 0),
    }
}

fn look_at_all(cloud: &[Key]) -> Quality {
    let all: Vec<One> = (0..cloud.len()).map(|i| look(cloud, i)).collect();
    let count = |f: &dyn Fn(&One) -> bool| all.iter().filter(|one| f(one)).count() as u64;
    let values = |f: &dyn Fn(&One) -> Option<f64>| all.iter().filter_map(f).collect::<Vec<_>>();
    let spacings = values(&|one| one.spacing);
    let angles = values(&|one| one.angle);
    let quantiles = [5, 50, 95].map(|percent| quantile(&spacings, percent));
    let class = |class: u64| {
        let (low, high) = (15.0 * class as f64, 15.0 * (class + 1) as f64);
        count(&|one| one.angle.is_some_and(|a| low <= a && (a < high || high == 90.0)))
    };
    Quality {
        n_sampled: all.len() as u64,
        n_coincident: count(&|one| one.is_coincident),
        spacing: quantiles[0].map(|_| quantiles.map(Option::unwrap)),
        thickness: quantile(&values(&|one| one.thickness), 50),
        n_inside_or_rim: count(&|one| one.is_at_rim.is_some()),
        n_rim: count(&|one| one.is_at_rim == Some(true)),
        normals: NormalQuality {
            angles: [0, 1, 2, 3, 4, 5].map(class),
            median_deg: quantile(&angles, 50),
            n_oriented: count(&|one| one.is_turned.is_some()),
            n_turned: count(&|one| one.is_turned == Some(true)),
        },
    }
}

#[test]
fn all_points_of_small_clouds_are_measured_as_brute_force_does() {
    let mut rng = Rng::with_seed(90);
    let (mut n_coincident, mut n_turned, mut n_angles, mut n_rim) = (0, 0, 0, 0);
    for _ in 0..150 {
        let n = rng.usize(1..500);
        let cloud = sorted(random_cloud(&mut rng, n));
        let found = quality_of(cloud.clone(), u64::MAX);
        assert_eq!(found, look_at_all(&cloud));
        n_coincident += found.n_coincident;
        n_turned += found.normals.n_turned;
        n_rim += found.n_rim;
        n_angles += found.normals.n_angles();
    }
    assert!(n_coincident > 100 && n_turned > 100 && n_angles > 10_000 && n_rim > 1000);
}

/// A floor of `n` by `n` points `step` apart, facing up.
fn floor(n: u32, step: u32) -> Vec<Key> {
    let place = |i| [i % n * step, i / n * step, 1 << 20];
    (0..n * n).map(|i| Key { g: place(i), normal: UP, oriented: true }).collect()
}

/// A number of mean 0 and standard deviation 1, all but normally distributed.
fn noise(rng: &mut Rng) -> f64 {
    (0..12).map(|_| rng.f64()).sum::<f64>() - 6.0
}

#[test]
fn noise_that_was_planted_is_the_thickness() {
    let mut rng = Rng::with_seed(91);
    assert_eq!(quality_of(floor(100, 1000), 2000).thickness, Some(0.0));
    for sigma in [10.0, 100.0, 300.0] {
        let mut cloud = floor(100, 1000);
        for key in &mut cloud {
            // Off the grid within the floor: else the flatter of equally near points count.
            key.g = [key.g[0] + rng.u32(..800), key.g[1] + rng.u32(..800), key.g[2]];
            key.g[2] = (f64::from(key.g[2]) + sigma * noise(&mut rng)).round() as u32;
        }
        let found = quality_of(cloud, 4000);
        // Half of the neighbourhoods have less than 0.97 σ: √(χ² of 13, its median, over 13).
        let thickness = found.thickness.unwrap();
        assert!((0.94..1.0).contains(&(thickness / sigma)), "{sigma}: {thickness}");
        let spacing = found.spacing.unwrap()[1];
        assert!((500.0..800.0).contains(&spacing), "{sigma}: {spacing}");
        assert_eq!(found.thickness_of_spacing(), Some(thickness / spacing));
        assert!(found.normals.median_deg.unwrap() < 0.1 * sigma);
    }
}

/// Counts the points at the rim of a wall of `n` by `n` points in a jittered grid of `step`,
/// without those of a disc of radius `r`; and all its points.
fn rim_of_disc(n: u32, step: u32, r: f64) -> (u64, u64) {
    let mut rng = Rng::with_seed(94);
    let middle = f64::from(n * step) / 2.0;
    let mut cloud = floor(n, step);
    for key in &mut cloud {
        key.g = [key.g[0] + rng.u32(..step), 1 << 20, key.g[1] + rng.u32(..step)];
        key.normal = [0, 1 << 14, 0];
    }
    let distance = |key: &Key| (f64::from(key.g[0]) - middle).hypot(f64::from(key.g[2]) - middle);
    cloud.retain(|key| distance(key) >= r);
    let found = quality_of(cloud.clone(), u64::MAX);
    assert_eq!(found.n_inside_or_rim, cloud.len() as u64);
    (found.n_rim, cloud.len() as u64)
}

#[test]
fn as_many_points_are_at_a_rim_as_it_is_long() {
    // A border of four times 100 steps.
    let (border, n) = rim_of_disc(100, 1000, 0.0);
    assert_eq!(n, 10_000);
    assert!((0.75..1.1).contains(&(border as f64 / 400.0)), "{border}");
    for r_steps in [8.0, 16.0, 32.0] {
        let (all, n) = rim_of_disc(100, 1000, 1000.0 * r_steps);
        let (rim, length) = ((all - border) as f64, std::f64::consts::TAU * r_steps);
        assert!((0.75..1.1).contains(&(rim / length)), "{rim} of {length}, {n} points");
    }
    // Twice as fine, the rim has twice as many points and all have four times.
    let (all, n) = rim_of_disc(200, 500, 16_000.0);
    assert!((0.75..1.1).contains(&(all as f64 / (800.0 + 2.0 * std::f64::consts::TAU * 16.0))));
    assert!((n as f64 / 40_000.0 - 1.0 + 0.0804).abs() < 0.001, "{n}");
}

#[test]
fn densities_and_copies_that_were_planted_are_found() {
    // As many points four times as far apart, beyond the others.
    let mut cloud = floor(60, 500);
    cloud.extend(floor(60, 2000).into_iter().map(|mut key| {
        key.g[0] += 100_000;
        key
    }));
    let found = quality_of(cloud.clone(), 5000);
    assert_eq!((found.spacing, found.unevenness()), (Some([500.0, 500.0, 2000.0]), Some(4.0)));
    assert_eq!((found.n_sampled, found.n_coincident), (5000, 0));
    // Every tenth twice: two of eleven have a twin, and the spacing is what it was.
    let twins: Vec<Key> = cloud.iter().copied().step_by(10).collect();
    cloud.extend(twins);
    let found = quality_of(cloud, 5000);
    let share = found.n_coincident as f64 / 5000.0;
    assert!((share - 2.0 / 11.0).abs() < 0.02, "{share}");
    assert_eq!(found.unevenness(), Some(4.0));
}

#[test]
fn n33_normals_that_contradict_the_points_are_told_by_their_angles() {
    // Normals of the file as they should be, 30° off, and along the wall.
    let mut rng = Rng::with_seed(33);
    for (degrees, class) in [(0.0f32, 0), (30.1, 2), (40.0, 2), (50.0, 3), (89.9, 5)] {
        let mut cloud = floor(80, 1000);
        for key in &mut cloud {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let turn = rng.f32() * 6.3;
            key.normal = quantise([sin * turn.cos(), sin * turn.sin(), cos]).unwrap();
        }
        let normals = quality_of(cloud, 3000).normals;
        let mut expected = [0; 6];
        expected[class] = 3000;
        assert_eq!((normals.angles, normals.n_angles()), (expected, 3000), "{degrees}");
        assert!((normals.median_deg.unwrap() - f64::from(degrees)).abs() < 0.01);
        assert_eq!(normals.contradict_points(), degrees > 45.0);
    }
    // Of a few points nothing is said, and nothing of normals that were estimated.
    let mut few = floor(3, 1000);
    few.iter_mut().for_each(|key| key.normal = [1 << 14, 0, 0]);
    let found = quality_of(few, 100).normals;
    assert!(found.median_deg.unwrap() > 89.9 && !found.contradict_points(), "{found:?}");
    let file = octree_file_with(&sorted(floor(80, 1000)), false);
    let found = measure(&OctreeView::open(&file).unwrap(), 3000, &|_| true).unwrap().normals;
    assert_eq!((found.n_angles(), found.median_deg, found.contradict_points()), (0, None, false));
}

#[test]
fn sides_that_were_turned_are_counted() {
    let mut rng = Rng::with_seed(92);
    let mut cloud = floor(100, 1000);
    let mut n_turned = 0;
    for key in &mut cloud {
        if rng.u8(..10) == 0 {
            key.normal = [0, 0, -1 << 14];
            n_turned += 1;
        }
    }
    let normals = quality_of(cloud.clone(), u64::MAX).normals;
    assert_eq!((normals.n_oriented, normals.n_turned), (10_000, n_turned));
    let share = quality_of(cloud.clone(), 3000).normals.n_turned as f64 / 3000.0;
    assert!((share - 0.1).abs() < 0.02, "{share}");
    // Of normals without a side nothing is said.
    cloud.iter_mut().for_each(|key| key.oriented = false);
    let normals = quality_of(cloud, 3000).normals;
    assert_eq!((normals.n_oriented, normals.n_turned), (0, 0));
}

#[test]
fn clouds_that_have_little_to_say() {
    let none = quality_of(Vec::new(), 100);
    assert_eq!((none.n_sampled, none.spacing, none.thickness), (0, None, None));
    let one = Key { g: [5; 3], normal: UP, oriented: true };
    let found = quality_of(vec![one], 100);
    assert_eq!((found.n_sampled, found.n_coincident, found.spacing), (1, 0, None));
    // So many copies that no neighbourhood reaches beyond them: they have no spacing, and the
    // search ends.
    let mut cloud = vec![one; 50_000];
    let found = quality_of(cloud.clone(), 2000);
    assert_eq!((found.n_sampled, found.n_coincident, found.spacing), (2000, 2000, None));
    assert_eq!((found.thickness, found.normals.median_deg), (None, None));
    cloud.push(Key { g: [5, 5, 25], ..one });
    let found = quality_of(cloud, 2000);
    assert_eq!(found.spacing, Some([20.0; 3]));
}

#[test]
fn a_sample_is_the_same_every_time_and_may_be_stopped() {
    let mut rng = Rng::with_seed(93);
    let file = octree_file_with(&sorted(random_cloud(&mut rng, 5000)), true);
    let octree = OctreeView::open(&file).unwrap();
    let heard = std::sync::atomic::AtomicU64::new(0);
    let listen = |n| {
        heard.fetch_add(n, std::sync::atomic::Ordering::Relaxed);
        true
    };
    let expected = measure(&octree, 1000, &listen).unwrap();
    assert_eq!((expected.n_sampled, heard.into_inner()), (1000, 1000));
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert_eq!(pool.install(|| measure(&octree, 1000, &|_| true)), Ok(expected.clone()));
    }
    assert_eq!(measure(&octree, 1000, &|_| false), Err(QueryError::Stopped));
}
