//! Point-exact answers against brute force over all points, in exact rationals. [V-7]

use std::collections::HashSet;
use std::num::NonZero;

use fastrand::Rng;
use pvmap_geometry::Frame;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_query::exact::{Disagreement, Exact, ExactOptions, StoredPoint, Verdict};
use pvmap_query::{ErrorKind, Map, Place, QueryError};
use pvmap_vmap::{OctreeView, Shape};

use crate::common::{About, Cut, Parts, grow, random_points};
use crate::octree::{Key, octree_file, random_cloud, sorted};

type Vector = [i128; 3];

fn options(delta_grid: u32, k: u32) -> ExactOptions {
    ExactOptions::new(delta_grid, NonZero::new(k).unwrap())
}

fn vector<T: Into<i128> + Copy>(v: [T; 3]) -> Vector {
    v.map(Into::into)
}

fn minus(a: Vector, b: Vector) -> Vector {
    [0, 1, 2].map(|i| a[i] - b[i])
}

fn dot(a: Vector, b: Vector) -> i128 {
    (0..3).map(|i| a[i] * b[i]).sum()
}

/// What the pairs of a run had in them: a test of nothing must not pass.
#[derive(Debug, Default)]
struct Seen {
    n_pairs: u64,
    visible: u64,
    backfacing: u64,
    hidden: u64,
    at_delta: u64,
    near_an_end: u64,
    of_an_end: u64,
    coincident: u64,
    ended_early: u64,
}

/// §3 of the paper, word by word: is `a` on the side of `b` that it can be seen from?
fn looks_at(a: &Key, b: &Key) -> bool {
    let s = dot(vector(a.normal), minus(vector(b.g), vector(a.g)));
    a.g != b.g && (a.normal == [0; 3] || s > 0 || !a.oriented && s != 0)
}

/// §3 of the paper: does the tangent plane of c cross pq between its ends, within Δ of c and
/// farther than that from the ends? With x = X/s.
fn occludes(p: &Key, q: &Key, c: &Key, delta_grid: u32, seen: &mut Seen) -> bool {
    let (n, d) = (vector(c.normal), minus(vector(q.g), vector(p.g)));
    let (s, h) = (dot(n, d), dot(n, minus(vector(c.g), vector(p.g))));
    let (s, h) = if s < 0 { (-s, -h) } else { (s, h) };
    if s == 0 || h <= 0 || h >= s {
        return false;
    }
    let x = [0, 1, 2].map(|i| s * i128::from(p.g[i]) + h * d[i]);
    let limit = (s * i128::from(delta_grid)).pow(2);
    let distance2 = |v: &Key| {
        let off = minus(x, vector(v.g).map(|c| s * c));
        dot(off, off)
    };
    let (own, near_end) = (distance2(c), distance2(p) <= limit || distance2(q) <= limit);
    seen.at_delta += u64::from(own == limit && !near_end);
    seen.near_an_end += u64::from(own <= limit && near_end);
    // What noise put above either end: x is X/s, places are multiplied by s.
    let is_above = |e: &Key, other: &Key| {
        let (m, away) = (vector(e.normal), minus(vector(other.g), vector(e.g)));
        let [to, from] = [e, other].map(|v| {
            let off = minus(x, vector(v.g).map(|c| s * c));
            (dot(off, off), dot(m, off).abs())
        });
        let cosine = dot(n, m);
        let is_like = cosine >= 0 && 4 * cosine * cosine >= 3 * dot(n, n) * dot(m, m);
        let knows_side = c.oriented && e.oriented && e.normal != [0; 3];
        let is_near = to.0 <= from.0 && to.1 <= s * i128::from(delta_grid) * (1 << 14);
        knows_side && is_like && dot(n, away) > 0 && is_near
    };
    let is_of_an_end = own <= limit && !near_end && (is_above(p, q) || is_above(q, p));
    seen.of_an_end += u64::from(is_of_an_end);
    own <= limit && !near_end && !is_of_an_end
}

/// All occluders in order, the first of each place.
fn all_occluders(cloud: &[Key], p: &Key, q: &Key, delta: u32, seen: &mut Seen) -> Vec<u64> {
    let mut places = HashSet::new();
    let mut first_of_place = |(index, c): (usize, &Key)| {
        let is_one = occludes(p, q, c, delta, seen);
        let is_new = is_one && places.insert(c.g);
        seen.coincident += u64::from(is_one && !is_new);
        is_new.then_some(index as u64)
    };
    cloud.iter().enumerate().filter_map(&mut first_of_place).collect()
}

fn check(cloud: &[Key], exact: &Exact<'_, '_>, [i, j]: [usize; 2], seen: &mut Seen) {
    let ends = [i, j].map(|i| exact.point(i as u64).unwrap());
    for (end, i) in ends.iter().zip([i, j]) {
        let key = Key { g: end.g(), normal: end.normal(), oriented: end.is_oriented() };
        assert_eq!((end.index(), key), (i as u64, cloud[i]));
    }
    let verdict = exact.pair(&ends[0], &ends[1]).unwrap();
    let back = exact.pair(&ends[1], &ends[0]).unwrap();
    assert_eq!(verdict, back, "{:?} {:?}", cloud[i], cloud[j]);
    let (p, q) = (&cloud[i], &cloud[j]);
    seen.n_pairs += 1;
    let faces = looks_at(p, q) && looks_at(q, p);
    assert_eq!(verdict.faces, faces, "{p:?} {q:?}");
    if !faces {
        seen.backfacing += 1;
        assert!(!verdict.visible && verdict.occluders.is_empty(), "{p:?} {q:?}");
        return;
    }
    let (delta, k) = (exact.options().delta_grid(), exact.options().k().get() as usize);
    let mut expected = all_occluders(cloud, p, q, delta, seen);
    seen.ended_early += u64::from(expected.len() > k);
    expected.truncate(k);
    assert_eq!(verdict.visible, expected.len() < k, "{p:?} {q:?} {delta}");
    assert_eq!(verdict.occluders, expected, "{p:?} {q:?} {delta}");
    seen.visible += u64::from(verdict.visible);
    seen.hidden += u64::from(!verdict.visible);
}

/// Draws a Δ that means something to a cloud, or one of the least and the greatest.
fn random_delta(rng: &mut Rng, cloud: &[Key]) -> u32 {
    let span = |i: usize| {
        let along = cloud.iter().map(|key| key.g[i]);
        along.clone().max().unwrap_or(0) - along.min().unwrap_or(0)
    };
    let width = span(0).max(span(1)).max(span(2));
    match rng.u8(..8) {
        0 => 0,
        1 => rng.u32(..4),
        2 => u32::MAX,
        _ => width / rng.u32(3..24),
    }
}

/// Rows N56 and N63 ask that a walk through cells, or leaps over empty ones, miss no candidate:
/// here a candidate is a point, and every occluder that brute force finds is found.
#[test]
fn v7_n56_n63_pairs_are_decided_as_all_points_say() {
    let mut rng = Rng::with_seed(70);
    let mut seen = Seen::default();
    for _ in 0..400 {
        let n = rng.usize(2..400);
        let cloud = random_cloud(&mut rng, n);
        let file = octree_file(&cloud);
        let octree = OctreeView::open(&file).unwrap();
        octree.verify().unwrap();
        for _ in 0..5 {
            let k = if rng.bool() { 1 } else { rng.u32(1..40) };
            let exact = Exact::new(&octree, options(random_delta(&mut rng, &cloud), k));
            for _ in 0..20 {
                let pair = [0; 2].map(|_| rng.usize(..cloud.len()));
                check(&cloud, &exact, pair, &mut seen);
            }
        }
    }
    println!("{seen:?}");
    let least = [seen.visible, seen.backfacing, seen.hidden, seen.ended_early, seen.near_an_end];
    assert!(least.into_iter().all(|n| n > 1_000), "{seen:?}");
    assert!(seen.at_delta > 100 && seen.coincident > 100 && seen.of_an_end > 100, "{seen:?}");
}

/// Two walls that face each other across the whole cube and a third, with holes, between them.
fn three_walls(side: u32) -> Vec<Key> {
    let step = GRID_MAX / (side - 1);
    let wall = |x: u32, nx: i16, keep: fn(u32) -> bool| {
        let place = move |i: u32| [x, (i % side) * step, (i / side) * step];
        let kept = (0..side * side).filter(move |&i| keep(i));
        kept.map(move |i| Key { g: place(i), normal: [nx, 0, 0], oriented: true })
    };
    let near = wall(0, 1 << 14, |_| true);
    let far = wall(GRID_MAX, -1 << 14, |_| true);
    let middle = wall(1 << 21, 1 << 14, |i| i % 5 > 0);
    sorted(near.chain(far).chain(middle).collect())
}

#[test]
fn v7_large_octrees_are_searched_by_their_index_and_only_near_the_line() {
    let mut rng = Rng::with_seed(71);
    let mut seen = Seen::default();
    let cloud = three_walls(100);
    let file = octree_file(&cloud);
    let octree = OctreeView::open(&file).unwrap();
    let exact = Exact::new(&octree, options(30_000, 1));
    let (mut n_points, mut n_asked) = (0, 0);
    for _ in 0..1_000 {
        let pair = [0; 2].map(|_| rng.usize(..cloud.len()));
        check(&cloud, &exact, pair, &mut seen);
        let [p, q] = pair.map(|i| exact.point(i as u64).unwrap());
        let work = exact.pair(&p, &q).unwrap().work;
        assert!(work.n_points < cloud.len() as u64 / 8, "{p:?} {q:?} {work:?}");
        (n_points, n_asked) = (n_points + work.n_points, n_asked + u64::from(work.n_cells > 0));
    }
    println!("{seen:?}, {} points read a question of {}", n_points / n_asked, cloud.len());
    assert!(seen.visible > 20 && seen.hidden > 20, "{seen:?}");
}

#[test]
fn v7_n57_n58_n59_n62_segments_through_faces_edges_and_corners_of_cells() {
    let far = GRID_MAX - GRID_MAX % 2;
    let ends = [[0, 0, 0], [far, far, far], [0, far, 0], [far, 0, far], [0, 0, far], [far, 0, 0]];
    let end = |g: [u32; 3]| Key { g, normal: [0; 3], oriented: false };
    // Points on and beside the middle, which is a corner of cells of every level.
    let near = [(1 << 21) - 1, 1 << 21, (1 << 21) + 1];
    let grid = (0..27).map(|i| [near[i % 3], near[i / 3 % 3], near[i / 9]]);
    let mut seen = Seen::default();
    for normal in [[1 << 14, 0, 0], [9459, 9459, 9459], [0, 11585, -11585], [1, 0, 1 << 14]] {
        let middle = grid.clone().map(|g| Key { g, normal, oriented: true });
        // So many that the cells are divided.
        let crowd = middle.clone().flat_map(|key| vec![key; 80]);
        for points in [middle.collect::<Vec<_>>(), crowd.collect()] {
            let cloud = sorted(ends.into_iter().map(end).chain(points).collect());
            let file = octree_file(&cloud);
            let octree = OctreeView::open(&file).unwrap();
            let is_end = |i: &usize| cloud[*i].normal == [0; 3];
            let all: Vec<usize> = (0..cloud.len()).filter(is_end).collect();
            for (delta, k) in [(0, 1), (0, 28), (1, 28), (2, 28), (3, 2), (3, 28), (1000, 28)] {
                let exact = Exact::new(&octree, options(delta, k));
                for (&i, &j) in all.iter().flat_map(|i| all.iter().map(move |j| (i, j))) {
                    check(&cloud, &exact, [i, j], &mut seen);
                }
            }
        }
    }
    println!("{seen:?}");
    assert!(seen.at_delta > 100 && seen.hidden > 20, "{seen:?}");
}

fn ask(octree: &OctreeView<'_>, delta_grid: u32, k: u32, p: [u32; 3], q: [u32; 3]) -> Verdict {
    let exact = Exact::new(octree, options(delta_grid, k));
    let at = |g: [u32; 3]| exact.nearest(&Place { position: g.map(f64::from), normal: None });
    exact.pair(&at(p).unwrap().point, &at(q).unwrap().point).unwrap()
}

#[test]
fn n64_the_longest_segment_meets_no_more_cells_than_there_are() {
    // From corner to corner, past points in cells of the last level; then where every point of the
    // scan is within reach of the line. Each cell is met once at the most.
    let mut rng = Rng::with_seed(64);
    let key = |g| Key { g, normal: [1 << 14, 0, 0], oriented: false };
    let mut cloud: Vec<Key> = (0..3000)
        .map(|_| {
            let t = rng.u32(..GRID_MAX);
            key([0; 3].map(|_| t.saturating_add(rng.u32(..5)).min(GRID_MAX)))
        })
        .collect();
    cloud.extend([key([0; 3]), key([GRID_MAX; 3])]);
    let file = octree_file(&sorted(cloud));
    let octree = OctreeView::open(&file).unwrap();
    let n_cells = (1..=21).map(|level| {
        let points = octree.points(0, 3002).unwrap();
        let code = |g| pvmap_geometry::morton::encode(g) >> (3 * (21 - level));
        points.iter().map(|p| code(p.unwrap().key.g)).collect::<HashSet<_>>().len() as u64
    });
    let n_cells = 1 + n_cells.sum::<u64>();
    for delta in [0, 1, 1 << 21, u32::MAX] {
        let exact = Exact::new(&octree, options(delta, u32::MAX));
        let ends = [exact.point(0).unwrap(), exact.point(3001).unwrap()];
        let work = exact.pair(&ends[0], &ends[1]).unwrap().work;
        assert!(work.n_cells <= n_cells, "{delta}: {} of {n_cells} cells", work.n_cells);
    }
}

#[test]
fn v7_n49_occluders_of_one_place_are_one_witness() {
    let up = |g| Key { g, normal: [0, 0, 1 << 14], oriented: true };
    let down = |g| Key { g, normal: [0, 0, -1 << 14], oriented: true };
    let (p, q) = ([500, 500, 0], [500, 500, 1000]);
    let mut cloud = vec![up(p), down(q), up([503, 504, 500])];
    cloud.extend([up([500, 500, 500]); 100]);
    let file = octree_file(&sorted(cloud));
    let octree = OctreeView::open(&file).unwrap();
    // 5 steps away is within 5 and not within 4.
    for (delta, n) in [(0, 1), (4, 1), (5, 2)] {
        for k in 1..4 {
            let verdict = ask(&octree, delta, k, p, q);
            assert_eq!(verdict.visible, n < k, "{delta} {k}");
            assert_eq!(verdict.occluders.len() as u32, n.min(k));
        }
    }
    // Nothing counts within Δ of an end, and with a Δ beyond the cube that is everywhere.
    assert!(!ask(&octree, 499, 2, p, q).visible);
    assert!(ask(&octree, 500, 1, p, q).visible && ask(&octree, u32::MAX, 1, p, q).visible);
    // A point does not see itself: there is no direction to face.
    let own = ask(&octree, 0, 1, p, p);
    assert!(!own.faces && !own.visible);
}

#[test]
fn v7_noise_above_an_end_hides_nothing_and_a_table_hides_what_is_under_it() {
    let mut rng = Rng::with_seed(75);
    let (side, step, height) = (60, 1000, 12_000);
    let sheet = |z: u32, up: bool, rng: &mut Rng| -> Vec<Key> {
        let normal = [0, 0, if up { 1 << 14 } else { -1 << 14 }];
        let place = |i: u32| [i % side * step, i / side * step, z];
        let mut noisy = |i| place(i).map(|v: u32| (v + rng.u32(..800)).saturating_sub(400));
        (0..side * side).map(|i| Key { g: noisy(i), normal, oriented: true }).collect()
    };
    let floor = sheet(1_000, true, &mut rng);
    let ceiling = sheet(height, false, &mut rng);
    let is_table = |key: &Key| (15_000..45_000).contains(&key.g[0]) && key.g[1] > 30_000;
    let mut table = sheet(5_000, false, &mut rng);
    table.extend(sheet(6_000, true, &mut rng));
    table.retain(is_table);
    let cloud = sorted([floor, ceiling, table].concat());
    let file = octree_file(&cloud);
    let octree = OctreeView::open(&file).unwrap();
    let exact = Exact::new(&octree, options(step, 2));
    let (mut beside, mut under) = (Seen::default(), Seen::default());
    while beside.n_pairs < 1000 || under.n_pairs < 100 {
        let pair = [0; 2].map(|_| rng.usize(..cloud.len()));
        let [p, q] = pair.map(|i| &cloud[i]);
        if p.g[2] > 2000 || q.g[2] < height - 1000 {
            continue;
        }
        // The table's half of the room, or the other half.
        let far = [p, q].map(|key| key.g[1]);
        let is_under = |key: &Key| {
            (20_000..40_000).contains(&key.g[0]) && (35_000..55_000).contains(&key.g[1])
        };
        if far.iter().all(|&y| y < 28_000) {
            check(&cloud, &exact, pair, &mut beside);
        } else if is_under(p) && is_under(q) {
            check(&cloud, &exact, pair, &mut under);
        }
    }
    println!("{beside:?} {under:?}");
    assert!(beside.visible == beside.n_pairs && beside.of_an_end > 500, "{beside:?}");
    assert!(under.hidden == under.n_pairs, "{under:?}");
}

#[test]
fn v7_a_point_of_an_ends_surface_is_near_it_like_it_and_passed_from_behind() {
    let (up, down) = ([0, 0, 1 << 14], [0, 0, -1 << 14]);
    // A place of the segment and a point there; Δ; whether the point counts.
    let is_hidden = |q: [u32; 3], c: Key, delta: u32, sides: bool| {
        let end = |g, normal| Key { g, normal, oriented: sides };
        let cloud = sorted(vec![end([0; 3], up), end(q, down), c]);
        let file = octree_file(&cloud);
        let octree = OctreeView::open(&file).unwrap();
        !ask(&octree, delta, 1, [0; 3], q).visible
    };
    let point = |g, normal| Key { g, normal, oriented: true };
    // A fifth of the way, 300 above the plane of one end and 500 from it.
    let (q, c) = ([2000, 0, 1500], [400, 0, 300]);
    assert!(is_hidden(q, point(c, up), 299, true));
    assert!(!is_hidden(q, point(c, up), 300, true));
    // A side that nobody knows, of either, excuses nothing.
    assert!(is_hidden(q, Key { oriented: false, ..point(c, up) }, 300, true));
    assert!(is_hidden(q, point(c, up), 300, false));
    // What looks back at the end is a surface in front of it.
    assert!(is_hidden(q, point(c, down), 300, true));
    // 30° are like enough, 31° are not; the segment goes the way that both look.
    let tilted = |deg: f64| {
        let (sin, cos) = deg.to_radians().sin_cos();
        [0, (16384.0 * sin).round() as i16, (16384.0 * cos).round() as i16]
    };
    assert!(!is_hidden(q, point(c, tilted(29.9)), 300, true));
    assert!(is_hidden(q, point(c, tilted(30.1)), 300, true));
    // Half way is as near to the one as to the other, a step further is not.
    let q = [2000, 0, 40];
    assert!(!is_hidden(q, point([1000, 0, 20], up), 20, true));
    assert!(is_hidden(q, point([1050, 0, 21], up), 21, true));
    // And so from the other end.
    assert!(!is_hidden(q, point([1050, 0, 21], down), 19, true));
    assert!(is_hidden(q, point([1050, 0, 21], down), 18, true));
    assert!(is_hidden(q, point([950, 0, 19], down), 21, true));
}

#[test]
fn v7_n48_a_lower_k_and_one_more_point_let_nobody_see_more() {
    let mut rng = Rng::with_seed(48);
    let (mut n_hidden_by_k, mut n_hidden_by_one) = (0, 0);
    for _ in 0..500 {
        let n = rng.usize(2..200);
        let cloud = random_cloud(&mut rng, n);
        // One more, somewhere near the middle of the others.
        let [p, q] = [0; 2].map(|_| cloud[rng.usize(..cloud.len())]);
        let g = [0, 1, 2].map(|i| p.g[i].midpoint(q.g[i]));
        let normal = [0; 3].map(|_| rng.i16(-9000..=9000));
        let more = Key { g, normal, oriented: true };
        let larger = sorted(cloud.iter().copied().chain([more]).collect());
        let files = [&cloud, &larger].map(|cloud| octree_file(cloud));
        let views = [0, 1].map(|i| OctreeView::open(&files[i]).unwrap());
        let delta = random_delta(&mut rng, &cloud);
        for _ in 0..30 {
            let pair = [0; 2].map(|_| rng.usize(..cloud.len()));
            let sees = |view: usize, k: u32| {
                let exact = Exact::new(&views[view], options(delta, k));
                // The points of the smaller octree keep their order in the larger one.
                let all = if view == 0 { &cloud } else { &larger };
                let at = |i: usize| {
                    let is_same = |j: &usize| all[*j] == cloud[i];
                    (0..all.len()).find(is_same).unwrap() as u64
                };
                let [p, q] = pair.map(|i| exact.point(at(i)).unwrap());
                exact.pair(&p, &q).unwrap().visible
            };
            let by_k = [1, 2, 3, 8].map(|k| sees(0, k));
            assert!(by_k.is_sorted(), "{by_k:?}");
            n_hidden_by_k += u32::from(by_k[0] != by_k[3]);
            for (k, before) in [(1, by_k[0]), (2, by_k[1])] {
                let after = sees(1, k);
                assert!(before || !after, "one more point, and {pair:?} see each other");
                n_hidden_by_one += u32::from(before != after);
            }
        }
    }
    assert!(n_hidden_by_k > 100 && n_hidden_by_one > 20, "{n_hidden_by_k} {n_hidden_by_one}");
}

#[test]
fn the_nearest_point_is_that_of_all_points() {
    let mut rng = Rng::with_seed(72);
    let (mut other_face, mut none_agrees) = (0, 0);
    for _ in 0..300 {
        let n = rng.usize(1..300);
        let cloud = random_cloud(&mut rng, n);
        let file = octree_file(&cloud);
        let octree = OctreeView::open(&file).unwrap();
        let delta = random_delta(&mut rng, &cloud).min(1 << 20);
        let exact = Exact::new(&octree, options(delta, 1));
        for _ in 0..20 {
            let near = cloud[rng.usize(..n)].g;
            let width = 1 << rng.u32(..22);
            let g = near.map(|v| v.saturating_sub(rng.u32(..width)).min(GRID_MAX));
            let normal = rng.bool().then(|| [0; 3].map(|_| rng.f32() - 0.5));
            let place = Place { position: g.map(f64::from), normal };
            let found = exact.nearest(&place).unwrap();
            let given = normal.and_then(pvmap_geometry::normal::quantise);
            let fit = |(i, c): (usize, &Key)| {
                let off = minus(vector(c.g), vector(g));
                let along = dot(vector(c.normal), vector(given.unwrap_or_default()));
                (dot(off, off), -if c.oriented { along } else { along.abs() }, i as u64)
            };
            let all = || cloud.iter().enumerate().map(fit);
            let any = all().min().unwrap();
            // The root rounded up, 0 of 0.
            let root = any.0.isqrt() + i128::from(any.0.isqrt().pow(2) < any.0);
            let reach = root + i128::from(delta);
            let agreeing = all().filter(|f| f.1 < 0 && f.0 <= reach * reach).min();
            let expected = agreeing.filter(|_| given.is_some()).unwrap_or(any);
            assert_eq!(found.point.index(), expected.2, "{place:?} {delta}");
            assert_eq!(found.distance, (expected.0 as f64).sqrt());
            other_face += u32::from(expected.2 != any.2);
            none_agrees += u32::from(given.is_some() && agreeing.is_none());
        }
    }
    assert!(other_face > 100 && none_agrees > 100, "{other_face} {none_agrees}");
}

#[test]
fn places_and_options_without_an_answer() {
    let empty = octree_file(&[]);
    let octree = OctreeView::open(&empty).unwrap();
    let exact = Exact::new(&octree, options(1, 1));
    let place = Place { position: [1.0; 3], normal: None };
    assert_eq!(exact.nearest(&place), Err(QueryError::NoPoints));
    assert_eq!(exact.point(0).unwrap_err().kind(), ErrorKind::Octree);
    let outside = exact.nearest(&Place { position: [-1.0, 0.0, 0.0], normal: None });
    assert_eq!(outside.unwrap_err().kind(), ErrorKind::Place);
    let no_direction = exact.nearest(&Place { normal: Some([0.0; 3]), ..place });
    assert_eq!(no_direction.unwrap_err().kind(), ErrorKind::Usage);

    let one = NonZero::new(1).unwrap();
    let frame = Frame::of_world([0.0; 3], [f64::from(GRID_MAX) / 1000.0, 0.0, 0.0]);
    for (delta, expected) in [(0.0, 0), (0.01, 10), (1e300, (1 << 23) - 1)] {
        let taken = ExactOptions::in_units_of(&frame, delta, one).unwrap();
        assert_eq!(taken.delta_grid(), expected);
    }
    let flat = Frame::of_world([1.0; 3], [1.0; 3]);
    assert!(ExactOptions::in_units_of(&flat, 0.0, one).is_ok());
    for bad in [-1e-9, f64::NAN] {
        let refused = ExactOptions::in_units_of(&frame, bad, one).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::Usage);
    }
}

#[test]
fn points_out_of_order_are_an_error_and_never_a_panic() {
    let mut rng = Rng::with_seed(73);
    let mut n_errors = 0;
    for _ in 0..100 {
        let mut cloud = random_cloud(&mut rng, 300);
        rng.shuffle(&mut cloud);
        let file = octree_file(&cloud);
        let octree = OctreeView::open(&file).unwrap();
        let exact = Exact::new(&octree, options(random_delta(&mut rng, &cloud), 300));
        for _ in 0..20 {
            let [p, q] = [0; 2].map(|_| exact.point(rng.u64(..300)).unwrap());
            n_errors += match exact.pair(&p, &q) {
                Ok(_) => 0,
                Err(QueryError::Octree(e)) => u32::from(e.to_string().contains("Morton order")),
                Err(e) => panic!("{e}"),
            };
            let place = Place { position: q.g().map(f64::from), normal: None };
            n_errors += u32::from(exact.nearest(&place).is_err());
        }
    }
    assert!(n_errors > 300, "{n_errors}");
}

#[test]
fn d12_a_flipped_bit_is_an_error_or_changes_no_answer() {
    let mut rng = Rng::with_seed(76);
    let cloud = random_cloud(&mut rng, 100);
    let sound = octree_file(&cloud);
    let ends = [0, 1, 2, 3, 4].map(|_| rng.u64(..cloud.len() as u64));
    let answers = |bytes: &[u8]| -> Result<Vec<Verdict>, QueryError> {
        let octree = OctreeView::open(bytes)?;
        let exact = Exact::new(&octree, options(1 << 10, 2));
        let points = ends.iter().map(|&i| exact.point(i)).collect::<Result<Vec<_>, _>>()?;
        let place = Place { position: points[0].g().map(f64::from), normal: None };
        let points = [&points[..], &[exact.nearest(&place)?.point]].concat();
        let pairs = points.iter().flat_map(|&p| points.iter().map(move |&q| (p, q)));
        exact.pairs(&pairs.collect::<Vec<_>>()).into_iter().collect()
    };
    let expected = answers(&sound).unwrap();
    assert!(expected.iter().any(|v| v.visible) && expected.iter().any(|v| !v.visible));
    let mut n_refused = 0;
    for at in 0..sound.len() {
        let mut flipped = sound.clone();
        flipped[at] ^= 1 << rng.u32(..8);
        match answers(&flipped) {
            Ok(same) => assert_eq!(same, expected, "byte {at}"),
            Err(_) => n_refused += 1,
        }
    }
    // What is read is refused; the padding between the sections is not read.
    assert!(n_refused > sound.len() * 3 / 4, "{n_refused} of {}", sound.len());
}

#[test]
fn pairs_in_parallel_and_one_by_one() {
    let mut rng = Rng::with_seed(74);
    let cloud = random_cloud(&mut rng, 300);
    let file = octree_file(&cloud);
    let octree = OctreeView::open(&file).unwrap();
    let exact = Exact::new(&octree, options(1000, 2));
    let point = |rng: &mut Rng| exact.point(rng.u64(..300)).unwrap();
    let pairs: Vec<(StoredPoint, StoredPoint)> =
        (0..500).map(|_| (point(&mut rng), point(&mut rng))).collect();
    let one_by_one: Vec<_> = pairs.iter().map(|(p, q)| exact.pair(p, q)).collect();
    assert_eq!(exact.pairs(&pairs), one_by_one);
}

#[test]
fn disagreement_counts_both_ways() {
    let mut found = Disagreement::default();
    assert_eq!((found.n_pairs(), found.share()), (0, 0.0));
    for (leaf, exact, n) in [(true, true, 4), (false, false, 3), (true, false, 2), (false, true, 1)]
    {
        (0..n).for_each(|_| found.count(leaf, exact));
    }
    let once = Disagreement { n_agree: 7, n_exact_only: 1, n_leaf_only: 2 };
    assert_eq!((found, found.n_pairs(), found.share()), (once, 10, 0.3));
    found += once;
    assert_eq!(found, Disagreement { n_agree: 14, n_exact_only: 2, n_leaf_only: 4 });
}

#[test]
fn a_map_of_another_octree_is_refused() {
    let mut rng = Rng::with_seed(75);
    let cut = Cut { shape: Shape::Binned, leaf_capacity: 1, max_level: 8, few: 100 };
    let tree = grow(&random_points(&mut rng, 50), cut);
    let map_file = Parts::new(&tree, &[], About::default()).seal();
    let map = Map::open(&map_file).unwrap();
    let file = octree_file(&random_cloud(&mut rng, 50));
    let octree = OctreeView::open(&file).unwrap();
    let exact = Exact::new(&octree, options(1, 1));
    assert_eq!(exact.require_map(&map), Err(QueryError::OtherOctree));
}
