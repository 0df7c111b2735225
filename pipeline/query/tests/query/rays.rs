//! `ray` and `shadow` against all surfels, in rational numbers of 128 bits.

use std::sync::atomic::{AtomicU64, Ordering};

use fastrand::Rng;
use pvmap_geometry::disc::{self, Disc, Profile, segment_meets};
use pvmap_geometry::{Box3, Rect};
use pvmap_query::{ErrorKind, Light, Located, Map, Place, QueryError, Sight, Snap};

use crate::common::frame;
use crate::sound::{Sound, maps};

/// A ray on the grid, as the documentation of `Map::ray` says.
fn on_grid(origin: [f64; 3], direction: [f64; 3]) -> ([i128; 3], [i128; 3]) {
    let o = frame().steps_of_query(origin).map(|v| v.floor() as i128);
    let longest = direction.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    (o, direction.map(|v| (v / longest * f64::from(1 << 21)).round() as i128))
}

/// Where a ray hits a disc, as h over s.
fn hit(profile: Profile, o: [i128; 3], d: [i128; 3], k: &Disc) -> Option<(i128, i128)> {
    let n = k.normal.map(i128::from);
    let w = [0, 1, 2].map(|i| i128::from(k.centroid[i]) - o[i]);
    let dot = |v: [i128; 3]| n[0] * v[0] + n[1] * v[1] + n[2] * v[2];
    let sign = dot(d).signum();
    let (h, s) = (sign * dot(w), sign * dot(d));
    if s == 0 || h <= 0 {
        return None;
    }
    let off2: i128 = (0..3).map(|i| (h * d[i] - s * w[i]).pow(2)).sum();
    let far = [0, 1, 2].map(|i| (o[i] + 64 * d[i]) as i32);
    let in_box = || {
        (0..3).all(|i| {
            let x = o[i] * s + h * d[i];
            i128::from(k.limit.min[i]) * s <= x && x <= i128::from(k.limit.max[i]) * s
        })
    };
    let in_rect = || {
        (0..2).all(|i| {
            let axis = k.rect.axes[i].map(i128::from);
            let along: i128 = (0..3).map(|j| axis[j] * (h * d[j] - s * w[j])).sum();
            let [low, high] = [k.rect.low[i], k.rect.high[i]].map(|v| i128::from(v) << 14);
            low * s <= along && along <= high * s
        })
    };
    let within = match profile {
        Profile::Paper => segment_meets(o.map(|v| v as i32), far, &k.limit),
        Profile::Patch => in_box(),
        Profile::Oriented => in_box() && in_rect(),
    };
    (within && off2 <= i128::from(k.radius2) * s * s).then_some((h, s))
}

/// The first surfel of all that a ray hits; from a leaf, the first that it sees.
fn first(sound: &Sound, o: [i128; 3], d: [i128; 3], from: Option<u32>) -> Option<(u32, f64)> {
    let mut best: Option<(i128, i128, u32)> = None;
    for (id, k) in (0..).zip(&sound.discs) {
        let Some((h, s)) = hit(sound.profile, o, d, k) else { continue };
        if let Some(a) = from {
            let own = &sound.discs[a as usize];
            let at = |i: usize| s * (o[i] - i128::from(own.centroid[i])) + h * d[i];
            let near =
                (0..3).map(|i| at(i).pow(2)).sum::<i128>() <= i128::from(own.radius2) * s * s;
            if a == id || !sound.sees(a, id) || sound.profile != Profile::Paper && near {
                continue;
            }
        }
        if best.is_none_or(|(h2, s2, _)| h * s2 < h2 * s) {
            best = Some((h, s, id));
        }
    }
    best.map(|(h, s, id)| (id, h as f64 / s as f64))
}

fn at(sound: &Sound, surfel: u32) -> Located {
    Located { surfel, node: sound.tree.surfels[surfel as usize].node, distance: 0.0 }
}

#[test]
fn v2_a_ray_hits_what_is_first_of_all() {
    let mut rng = Rng::with_seed(41);
    let (mut n_hit, mut n_missed, mut n_opened, mut n_all) = (0, 0, 0, 0);
    for sound in maps(42, 24) {
        let map = Map::open(&sound.file).unwrap();
        for round in 0..300 {
            let from = (round % 2 == 0).then(|| rng.u32(..sound.n_surfels()));
            let origin = match from {
                Some(a) => frame().world_of(sound.tree.surfels[a as usize].centroid),
                None => {
                    // A cube's side around the cube, too.
                    let g = [0; 3].map(|_| f64::from(rng.i32(-(1 << 22)..(2 << 22) - 2)) + 0.5);
                    frame().world_of_real(g)
                }
            };
            let mut direction = [0; 3].map(|_| rng.f64() - 0.5);
            if from.is_none() && rng.bool() {
                // To the middle of the room, more or less.
                let middle = frame().world_of([1 << 21; 3]);
                for i in 0..3 {
                    direction[i] += 4.0 * (middle[i] - origin[i]) / frame().extent();
                }
            }
            if rng.u8(..4) == 0 {
                direction[rng.usize(..3)] = 0.0;
            }
            let (o, d) = on_grid(origin, direction);
            let located = from.map(|a| at(&sound, a));
            let found = map.ray(origin, direction, located.as_ref()).unwrap();
            n_opened += found.n_surfels;
            n_all += u64::from(sound.n_surfels());
            let Some((id, t)) = first(&sound, o, d, from) else {
                assert_eq!(found.hit, None, "round {round}");
                n_missed += 1;
                continue;
            };
            let hit = found.hit.unwrap();
            assert_eq!(hit.surfel, id, "round {round}");
            let length = d.map(|v| v as f64).iter().map(|v| v * v).sum::<f64>().sqrt();
            let distance = t * length * frame().unit();
            assert!((hit.distance - distance).abs() <= 1e-9 * distance, "{hit:?}, {distance}");
            n_hit += 1;
        }
    }
    assert!(n_hit > 2000 && n_missed > 2000, "{n_hit} hit, {n_missed} missed");
    assert!(n_opened * 8 < n_all, "{n_opened} of {n_all} surfels were tested");
}

#[test]
fn a_ray_from_afar_and_what_is_none() {
    let sound = maps(43, 1).next().unwrap();
    let map = Map::open(&sound.file).unwrap();
    let middle = frame().world_of([1 << 21, 5 << 19, 5 << 19]);
    // From the middle to the wall, and from far behind the middle to the wall behind it.
    let wall = map.ray(middle, [1.0, 0.01, 0.02], None).unwrap().hit.unwrap();
    let unit = frame().unit();
    assert!((wall.distance - f64::from(1 << 21) * unit).abs() < 0.01 * wall.distance);
    assert!((wall.place[0] - middle[0] - wall.distance).abs() < 0.01 * wall.distance);
    assert!((wall.normal[0] + 1.0).abs() < 0.01, "{wall:?}");
    let far = [middle[0] - 1e9, middle[1], middle[2]];
    let from_afar = map.ray(far, [1.0, 0.0, 0.0], None).unwrap().hit.unwrap();
    let expected = 1e9 - f64::from(1 << 21) * unit;
    assert!((from_afar.distance - expected).abs() < 1.0, "{from_afar:?}");
    assert_eq!(map.ray(far, [-1.0, 0.0, 0.0], None).unwrap().hit, None);
    assert_eq!(map.ray(far, [0.0, 0.0, 1.0], None).unwrap().hit, None);
    for bad in [[0.0; 3], [f64::NAN, 1.0, 0.0], [f64::INFINITY, 0.0, 0.0]] {
        let error = map.ray(middle, bad, None).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Usage, "{error}");
    }
    assert!(matches!(map.ray([f64::NAN; 3], [1.0; 3], None), Err(QueryError::NoPlace(_))));
}

#[test]
fn a_ray_from_afar_hits_what_one_from_nearby_hits() {
    let mut rng = Rng::with_seed(46);
    let (mut n_hit, mut n_other) = (0, 0);
    for sound in maps(47, 12) {
        let map = Map::open(&sound.file).unwrap();
        for _ in 0..100 {
            let to = frame().world_of([0; 3].map(|_| rng.u32(..1 << 22)));
            let way = [0; 3].map(|_| rng.f64() - 0.5);
            let length = way.iter().map(|v| v * v).sum::<f64>().sqrt();
            // Both begin outside; nothing is out there.
            let from = |distance: f64| {
                let origin = [0, 1, 2].map(|i| to[i] - way[i] / length * distance);
                map.ray(origin, way, None).unwrap().hit.map(|hit| (hit.surfel, hit.distance))
            };
            let side = frame().unit() * f64::from(1 << 22);
            let (near, far) = (from(2.0 * side), from(1e4 * side));
            n_hit += u32::from(near.is_some());
            // Rounding moves a ray by a step of the grid: past an edge now and then.
            let same = match (near, far) {
                (Some(near), Some(far)) => {
                    let moved = far.1 - near.1 - (1e4 - 2.0) * side;
                    near.0 == far.0 && moved.abs() < 100.0 * frame().unit()
                }
                (near, far) => near == far,
            };
            n_other += u32::from(!same);
        }
    }
    assert!(n_hit > 200 && n_other < 12, "{n_hit} hit, {n_other} otherwise from afar");
    let sound = maps(47, 1).next().unwrap();
    let map = Map::open(&sound.file).unwrap();
    for far in [1e305, -1e17, f64::INFINITY] {
        let found = map.ray([far, 0.5, 0.5], [-far.signum(), 0.0, 0.0], None);
        assert!(matches!(found, Err(QueryError::NoPlace(_))), "{far}");
    }
}

/// Holds all that is seen from a place in the air against the predicates.
fn check_all_from_the_air(rng: &mut Rng, sound: &Sound, map: &Map<'_>) {
    let g = [0; 3].map(|_| rng.i32(-(1 << 22) + 1..(2 << 22) - 2));
    let eye = frame().world_of_real(g.map(|v| f64::from(v) + 0.5));
    let air = frame().steps_of_query(eye).map(|v| v.floor() as i32);
    let (normal, two_sided, limit) = ([0; 3], false, Box3::at(air));
    let eye_disc = Disc { centroid: air, normal, two_sided, radius2: 0, limit, rect: Rect::NONE };
    let discs = &sound.discs;
    let is_seen = |a: usize| {
        let hides =
            |k: usize| k != a && disc::blocks(sound.profile, &discs[a], &eye_disc, &discs[k]);
        disc::faces_both(&discs[a], &eye_disc) && !(0..discs.len()).any(hides)
    };
    let expected: Vec<u32> = (0..sound.n_surfels()).filter(|&a| is_seen(a as usize)).collect();
    let told = AtomicU64::new(0);
    let tell = |n| {
        told.fetch_add(n, Ordering::Relaxed);
        true
    };
    let found = map.visible_from_air(eye, &tell).unwrap();
    assert_eq!(found.surfels.ids().collect::<Vec<_>>(), expected);
    let n_points = expected.iter().map(|&a| map.view().surfel(a).unwrap().n_points);
    assert_eq!(found.n_points, n_points.sum::<u64>());
    assert_eq!(told.into_inner(), u64::from(sound.n_surfels()));
    assert_eq!(map.visible_from_air(eye, &|_| false), Err(QueryError::Stopped));
    for far in [1e30, f64::NAN, f64::INFINITY] {
        let refused = map.visible_from_air([far, 0.0, 0.0], &|_| true);
        assert!(matches!(refused, Err(QueryError::OutsideCube { .. })), "{far}");
    }
}

#[test]
fn v3_a_light_in_the_air_reaches_what_nothing_hides() {
    let mut rng = Rng::with_seed(44);
    let (mut n_lit, mut n_dark) = (0, 0);
    for sound in maps(45, 24) {
        let map = Map::open(&sound.file).unwrap();
        for _ in 0..300 {
            let a = rng.u32(..sound.n_surfels());
            let g = [0; 3].map(|_| f64::from(rng.i32(-(1 << 22)..(2 << 22) - 2)) + 0.5);
            let lamp = frame().world_of_real(g);
            let air = frame().steps_of_query(lamp).map(|v| v.floor() as i32);
            let b = Disc {
                centroid: air,
                normal: [0; 3],
                two_sided: false,
                radius2: 0,
                limit: Box3::at(air),
                rect: Rect::NONE,
            };
            let own = &sound.discs[a as usize];
            let hides =
                |k: usize| k != a as usize && disc::blocks(sound.profile, own, &b, &sound.discs[k]);
            let faces = disc::faces_both(own, &b);
            let hidden = (0..sound.discs.len()).any(hides);
            let found = map.shadow(&at(&sound, a), &Light::Air(lamp)).unwrap();
            let lit = faces && !hidden;
            assert_eq!(found.reaches, if lit { Sight::All } else { Sight::None });
            assert_eq!(found.blocker.is_some(), faces && hidden);
            assert!(found.blocker.is_none_or(|k| hides(k as usize)));
            (n_lit, n_dark) = (n_lit + u32::from(lit), n_dark + u32::from(faces && hidden));
        }
        check_all_from_the_air(&mut rng, &sound, &map);
    }
    assert!(n_lit > 300 && n_dark > 300, "{n_lit} lit, {n_dark} in shadow");
    let sound = maps(45, 1).next().unwrap();
    let map = Map::open(&sound.file).unwrap();
    let floor = map
        .locate(
            &Place { position: frame().world_of([1 << 21, 1 << 21, 0]), normal: None },
            Snap::Within(1e9),
        )
        .unwrap();
    let up = frame().world_of([1 << 21; 3]);
    let sun = |z: f64| map.shadow(&floor, &Light::Air([up[0], up[1], up[2] + z])).unwrap();
    assert_eq!(sun(1.0).reaches, Sight::All);
    assert!(sun(1e12).blocker.is_some(), "the ceiling is in the way of the sun");
    assert!(map.shadow(&floor, &Light::Air([f64::INFINITY; 3])).is_err());
}

#[test]
fn a_light_of_many_points_is_seen_by_shares() {
    let mut rng = Rng::with_seed(46);
    let mut n = [0; 3];
    for sound in maps(47, 16) {
        let map = Map::open(&sound.file).unwrap();
        for _ in 0..150 {
            let a = rng.u32(..sound.n_surfels());
            let ends = [0; 3].map(|_| {
                let (u, v) = (rng.u32(..(1 << 22) - 1), rng.u32(..(1 << 22) - 1));
                (u.min(v), u.max(v))
            });
            let within = |s: &u32| {
                let c = sound.tree.surfels[*s as usize].centroid;
                (0..3).all(|i| ends[i].0 <= c[i] && c[i] <= ends[i].1)
            };
            let lamps: Vec<u32> = (0..sound.n_surfels()).filter(within).collect();
            let [low, high] = [ends.map(|e| e.0), ends.map(|e| e.1)].map(|g| frame().world_of(g));
            let found = map.shadow(&at(&sound, a), &Light::Box(low, high));
            if lamps.is_empty() {
                assert_eq!(found.unwrap_err().kind(), ErrorKind::Place);
                continue;
            }
            let points = |s: u32| sound.tree.surfels[s as usize].n_points;
            check_share(&sound, a, &lamps, points, found.unwrap().reaches, &mut n);
            let some: Vec<(u32, u64)> = lamps.iter().map(|&s| (s, u64::from(s % 7 + 1))).collect();
            let found = map.shadow(&at(&sound, a), &Light::Points(&some)).unwrap();
            assert_eq!(found.n_surfels as usize, lamps.len());
            check_share(&sound, a, &lamps, |s| u64::from(s % 7 + 1), found.reaches, &mut n);
        }
        for bad in [&[][..], &[(1, 1), (1, 1)], &[(u32::MAX, 1)]] {
            assert!(map.shadow(&at(&sound, 0), &Light::Points(bad)).is_err());
        }
        for (a, b) in [(0, 5), (3, 9), (7, 2)] {
            let found = map.shadow(&at(&sound, a), &Light::Surfel(&at(&sound, b))).unwrap();
            assert_eq!(found.reaches == Sight::All, sound.sees(a, b));
        }
    }
    assert!(n.iter().all(|&n| n > 100), "{n:?}");
}

fn check_share(
    sound: &Sound,
    a: u32,
    lamps: &[u32],
    weight: impl Fn(u32) -> u64,
    found: Sight,
    n: &mut [u32; 3],
) {
    let all: u64 = lamps.iter().map(|&s| weight(s)).sum();
    let seen: u64 = lamps.iter().filter(|&&s| sound.sees(a, s)).map(|&s| weight(s)).sum();
    let share = seen as f64 / all as f64;
    let slot = match found {
        Sight::All => 0,
        Sight::Part(_) => 1,
        Sight::None => 2,
    };
    assert!((found.share() - share).abs() < 1e-12, "{found:?}, {share}");
    assert_eq!(
        slot,
        if seen == all {
            0
        } else if seen > 0 {
            1
        } else {
            2
        }
    );
    n[slot] += 1;
}
