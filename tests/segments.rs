//! Pairs asked by the segment between the places: against brute force over all surfels of random
//! small maps, from the file and kept in memory, and at the command line.
//!
//! 150 maps in a plain run, 1 500 where PVMAP_SLOW_TESTS is set.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;
#[path = "common/model.rs"]
mod model;

use std::ops::AddAssign;

use fastrand::Rng;
use pvmap::geometry::GridPoint;
use pvmap::geometry::disc::Profile;
use pvmap::geometry::grid::GRID_MAX;
use pvmap::geometry::normal::{NORMAL_LENGTH, quantise};
use pvmap::query::{Located, Map, Place, QueryError, SegmentAnswer, SettledBy, Snap, Spot};
use pvmap::vmap::{MapView, Shape, Spacing};
use pvmap::{Approximation, BuildConfig, Limits, NormalsFrom, Orientation};
use serde_json::Value;

use crate::cli_common::{Bench, ply_header};
use crate::common::{
    LIMITS, build_with, contents, ingest_with, is_slow_run, on_threads, random_cloud, rects,
    room_cloud,
};
use crate::model::{Model, Vector};

/// What settled the pairs of a run, and of what surfels: a test of nothing must not pass.
#[derive(Debug, Default, Clone, Copy)]
struct Seen {
    one_leaf: u64,
    away: u64,
    linked: u64,
    blocked: u64,
    free: u64,
    unlike_leaves: u64,
    linked_but_blocked: u64,
    paper: u64,
    two_sided: u64,
    no_normal: u64,
    decided_by_own_normal: u64,
    /// By a sample, in a map with visible fractions.
    tried: u64,
}

impl AddAssign for Seen {
    fn add_assign(&mut self, other: Seen) {
        self.one_leaf += other.one_leaf;
        self.away += other.away;
        self.linked += other.linked;
        self.blocked += other.blocked;
        self.free += other.free;
        self.unlike_leaves += other.unlike_leaves;
        self.linked_but_blocked += other.linked_but_blocked;
        self.tried += other.tried;
        self.paper += other.paper;
        self.two_sided += other.two_sided;
        self.no_normal += other.no_normal;
        self.decided_by_own_normal += other.decided_by_own_normal;
    }
}

/// A leaf, a place and the normal given with it.
type End = (usize, GridPoint, Option<Vector>);

/// Makes the bytes of a map of a random cloud.
fn random_map(rng: &mut Rng) -> (Vec<u8>, Profile) {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = random_cloud(rng);
    if rng.u8(..8) == 0 {
        cloud.normals = None;
    }
    let scan = folder.path().join("scan.las");
    cloud.write_las(&scan, 0.01, [0.0, 512_345.25, -3.0]);
    let limits = Limits { threads: 1, memory_bytes: 64 << 20 };
    let octree = ingest_with(&[scan], folder.path(), &limits, |request| {
        request.normals = match rng.u8(..6) {
            0 => NormalsFrom::None,
            1 => NormalsFrom::Estimate,
            _ => NormalsFrom::Auto,
        };
        request.orientation = if rng.bool() { Orientation::Up } else { Orientation::Unknown };
    });
    let config = BuildConfig {
        max_level: rng.u8(1..=6),
        leaf_capacity: rng.u64(..=8),
        max_spread: 0,
        tree: if rng.bool() { Shape::Binned } else { Shape::Paper },
        profile: match rng.u8(..5) {
            0..3 => Profile::Patch,
            3 => Profile::Oriented,
            _ => Profile::Paper,
        },
        spacing: if rng.bool() { Spacing::Leaf } else { Spacing::Neighbors },
        fractions: rng.u8(..4) == 0,
        approximation: Approximation {
            min_exchange: if rng.u8(..3) == 0 { 0.1f64.powi(rng.i32(1..5)) } else { 0.0 },
            ..Approximation::default()
        },
        ..BuildConfig::default()
    };
    (build_with(&octree, &config, &limits), config.profile)
}

/// Draws a place in or around the patch of a surfel, in the cube.
fn place_at(rng: &mut Rng, model: &Model, surfel: usize) -> GridPoint {
    let disc = &model.surfels[surfel];
    if rng.u8(..4) == 0 {
        return disc.centroid.map(|c| c as u32);
    }
    let beyond = if rng.u8(..4) == 0 { disc.half_spacing } else { 0 };
    [0, 1, 2].map(|i| {
        let (low, high) = (disc.patch.0[i] - beyond, disc.patch.1[i] + beyond);
        rng.i128(low..=high).clamp(0, i128::from(GRID_MAX)) as u32
    })
}

/// Draws a normal for a place on a surfel: none, any, or one near that of the surfel, either way
/// up.
fn normal_at(rng: &mut Rng, model: &Model, surfel: usize) -> Option<[f32; 3]> {
    let any = [0; 3].map(|_| rng.f32() - 0.5);
    let near = model.surfels[surfel].normal.map(|v| v as f32 / NORMAL_LENGTH as f32);
    let way = if rng.u8(..4) == 0 { -1.0 } else { 1.0 };
    match rng.u8(..3) {
        0 => None,
        1 => Some(any),
        _ => Some([0, 1, 2].map(|i| way * near[i] + any[i])),
    }
}

/// Says by the words of what settles a pair of different leaves.
fn expected(
    model: &Model,
    profile: Profile,
    ends: [End; 2],
    (answer, is_tried): (&SegmentAnswer, bool),
) -> SettledBy {
    let is_wide = !is_tried
        && answer.by_leaves.link.is_some_and(|link| {
            let (a, b) = link.nodes;
            model.leaves[a as usize].len() >= 8 && model.leaves[b as usize].len() >= 8
        });
    match model.blockers(profile, ends) {
        None => SettledBy::Facing,
        Some(_) if is_wide => SettledBy::Link,
        Some(blockers) => match blockers.first() {
            Some(&k) => SettledBy::Blocker(k as u32),
            None => SettledBy::NoBlocker,
        },
    }
}

/// Puts random questions to a random map, from the file and kept, one by one and all at once.
fn check_map(seed: u64) -> Seen {
    let mut rng = Rng::with_seed(seed);
    let (bytes, profile) = random_map(&mut rng);
    let view = MapView::open(&bytes).unwrap();
    let (nodes, surfels, _) = contents(&view);
    let model = Model::new(&nodes, &surfels, &rects(&view), profile);
    let (map, kept) = (Map::open(&bytes).unwrap(), Map::open(&bytes).unwrap());
    assert!(kept.keep_discs(1 << 30).unwrap(), "seed {seed}");
    let mut seen = Seen::default();
    let (mut questions, mut answers) = (Vec::new(), Vec::new());
    for _ in 0..240 {
        let [x, y] = [0, 1].map(|_| rng.usize(..model.surfels.len()));
        let [p, q] = [x, y].map(|surfel| {
            (place_at(&mut rng, &model, surfel), normal_at(&mut rng, &model, surfel))
        });
        let spot = |s: usize, (g, normal): (GridPoint, Option<[f32; 3]>)| -> (End, Spot) {
            let frame = &map.view().frame().frame;
            let place = Place { position: frame.world_of(g), normal };
            let node = model.surfels[s].node as u32;
            let located = Located { surfel: s as u32, node, distance: 0.0 };
            let g = frame.grid_of_query(place.position).unwrap();
            let normal = normal.map(|n| quantise(n).unwrap().map(i128::from));
            ((s, g, normal), map.spot(&place, located).unwrap())
        };
        let [(p, a), (q, b)] = [spot(x, p), spot(y, q)];
        let note = format!("seed {seed}, {profile:?}: {p:?}, {q:?}");
        let answer = map.pair_by_segment(&a, &b).unwrap();
        assert_eq!(answer.by_leaves, map.pair(a.located(), b.located()).unwrap(), "{note}");
        let settled_by = match x == y {
            true => SettledBy::Leaf,
            false => {
                let tried = map.pair_fraction(a.located(), b.located()).unwrap().tried;
                seen.tried += u64::from(tried.is_some());
                expected(&model, profile, [p, q], (&answer, tried.is_some()))
            }
        };
        assert_eq!(answer.settled_by, settled_by, "{note}");
        let sees = !matches!(settled_by, SettledBy::Facing | SettledBy::Blocker(_));
        assert_eq!(answer.visible, sees, "{note}");
        let back = map.pair_by_segment(&b, &a).unwrap();
        assert_eq!((back.visible, back.settled_by), (sees, settled_by), "back, {note}");
        assert_eq!(kept.pair_by_segment(&a, &b).unwrap(), answer, "kept, {note}");
        questions.push((a, b));
        answers.push(Ok(answer));
        let blockers = || model.blockers(profile, [p, q]).unwrap_or_default();
        match settled_by {
            SettledBy::Leaf => seen.one_leaf += 1,
            SettledBy::Facing => seen.away += 1,
            SettledBy::Link => {
                seen.linked += 1;
                seen.linked_but_blocked += u64::from(!blockers().is_empty());
            }
            SettledBy::Blocker(_) => seen.blocked += 1,
            SettledBy::NoBlocker => seen.free += 1,
        }
        let plain = model.blockers(profile, [(x, p.1, None), (y, q.1, None)]);
        let faces = model.blockers(profile, [p, q]).is_some();
        seen.decided_by_own_normal += u64::from(x != y && plain.is_some() != faces);
        seen.unlike_leaves += u64::from(answer.visible != answer.by_leaves.visible);
        seen.paper += u64::from(profile == Profile::Paper && x != y && answer.visible);
        seen.no_normal += u64::from(model.surfels[x].normal == [0; 3]);
        seen.two_sided += u64::from(model.surfels[x].two_sided);
    }
    assert_eq!(map.pairs_by_segment(&questions), answers, "seed {seed}");
    assert_eq!(kept.pairs_by_segment(&questions), answers, "seed {seed}");
    seen
}

#[test]
fn q1_segments_are_asked_as_brute_force_does() {
    let n = if is_slow_run() { 1500 } else { 150 };
    let mut seen = Seen::default();
    on_threads(n, |i| check_map(70_000 + i)).into_iter().for_each(|map| seen += map);
    eprintln!("{n} maps: {seen:?}");
    assert!(seen.one_leaf > n && seen.away > 10 * n && seen.linked > n, "{seen:?}");
    assert!(seen.blocked > 10 * n && seen.free > 10 * n, "{seen:?}");
    assert!(seen.unlike_leaves > n && seen.linked_but_blocked > 0, "{seen:?}");
    assert!(seen.paper > n && seen.two_sided > n && seen.no_normal > n, "{seen:?}");
    assert!(seen.decided_by_own_normal > n && seen.tried > n, "{seen:?}");
}

/// Makes the bytes of a map of the furnished room.
fn room_map(n_points: u64) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let scan = folder.path().join("scan.las");
    room_cloud(n_points).write_las(&scan, 0.0001, [0.0; 3]);
    let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
    build_with(&octree, &BuildConfig::default(), &LIMITS)
}

#[test]
fn what_does_not_fit_is_not_kept_and_answers_stay() {
    let bytes = room_map(6000);
    let map = Map::open(&bytes).unwrap();
    let mut rng = Rng::with_seed(5);
    // On the floor and on the ceiling.
    let mut spot = |z: f64| {
        let place = Place { position: [5.0 * rng.f64(), 5.0 * rng.f64(), z], normal: None };
        let located = map.locate(&place, Snap::Within(1.0)).unwrap();
        map.spot(&place, located).unwrap()
    };
    let questions: Vec<(Spot, Spot)> = (0..300).map(|_| (spot(0.01), spot(5.4))).collect();
    let answers = map.pairs_by_segment(&questions);
    let n_seen = answers.iter().flatten().filter(|answer| answer.visible).count();
    assert!((30..270).contains(&n_seen), "{n_seen} of 300 see each other");
    for memory_bytes in [0, 1 << 10, 1 << 30] {
        let map = Map::open(&bytes).unwrap();
        let is_kept = map.keep_discs(memory_bytes).unwrap();
        assert_eq!(is_kept, memory_bytes == 1 << 30, "{memory_bytes} bytes");
        assert_eq!(map.pairs_by_segment(&questions), answers, "{memory_bytes} bytes");
    }
    let at = |position| Place { position, normal: None };
    let outside = map.spot(&at([9.0, 0.0, 0.0]), *questions[0].0.located());
    assert!(matches!(outside, Err(QueryError::OutsideCube { .. })), "{outside:?}");
    // Located on another map, which has more leaves.
    let other = room_map(500);
    let other = Map::open(&other).unwrap();
    let last = Located { surfel: map.view().summary().n_surfels - 1, node: 9999, distance: 0.0 };
    let strange = other.spot(&at([2.0, 2.0, 0.1]), last).unwrap();
    for memory_bytes in [0, 1 << 30] {
        other.keep_discs(memory_bytes).unwrap();
        assert!(other.pair_by_segment(&strange, &questions[0].0).is_err());
    }
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap()
}

/// Two floors of a square and above them a ceiling; between them a plate over a half.
fn bench() -> Bench {
    let bench = Bench::new();
    let mut text = ply_header(3 * 1600, &["x", "y", "z", "nx", "ny", "nz"]);
    for (z, nz) in [(0, 1), (40, -1)] {
        text.extend((0..1600).map(|i| format!("{} {} {z} 0 0 {nz}\n", i % 40, i / 40)));
    }
    // Seen from below and from above.
    for nz in [1, -1] {
        text.extend((0..800).map(|i| format!("{} {} 20 0 0 {nz}\n", i % 20, i / 20)));
    }
    bench.write("hall.ply", text);
    bench.line("ingest hall.ply").ok();
    bench.line("build --leaf-capacity 64 --spacing neighbors").ok();
    bench
}

#[test]
fn a_pair_at_the_command_line() {
    let bench = bench();
    let ask = |places: &str| bench.line(&format!("query hall.vmap pair {places} --segment"));
    let told = ask("5,5,0 5,5,40").exits(1).stdout;
    assert!(told.starts_with("no\n  leaves    say no\n  segment   surfel "), "{told}");
    let free = ask("35,5,0 35,6,40").exits(0).stdout;
    assert!(free.starts_with("yes\n  leaves    say yes\n  segment   n"), "{free}");
    let away = ask("35,5,0 5,5,20 --normal2 0,0,1").exits(1).stdout;
    assert!(away.contains("\n  segment   one of the places looks away"), "{away}");
    ask("35,5,0 5,5,20 --normal2 0,0,-1").exits(0);
    ask("35,5,0 35,5,0").exits(0);
    let blocked = json(&ask("5,5,0 5,5,40 --json").exits(1).stdout);
    assert_eq!((&blocked["visible"], &blocked["leaves"]), (&false.into(), &false.into()));
    assert_eq!(blocked["segment"]["settled_by"], "blocker");
    assert!(blocked["segment"]["blocker"].is_u64(), "{blocked}");
    ask("5,5,0 5,5,40 --exact").fails(2, &["--segment", "--exact"]);
}

#[test]
fn the_edge_of_a_shadow_is_where_the_places_say() {
    let bench = bench();
    // From places of one leaf of the floor, past the edge of the plate at x = 19.5, to the ceiling:
    // half a metre decides for the segment, for the leaves all are alike.
    let mut rows = "x1,y1,z1,x2,y2,z2\n".to_owned();
    let mut expected = Vec::new();
    for i in 0..80 {
        // What lies halfway; two metres around the edge of the plate nothing is promised.
        let (x1, y) = (f64::from(i) * 0.4, 4.0 + f64::from(i % 8));
        let halfway = if i % 2 == 0 { 17.4 } else { 22.4 };
        let x2 = 2.0 * halfway - x1;
        if (0.0..=39.0).contains(&x2) {
            rows += &format!("{x1},{y},0,{x2},{y},40\n");
            expected.push(if halfway > 20.0 { "1" } else { "0" });
        }
    }
    bench.write("rows.csv", rows);
    let table = bench.line("query hall.vmap pairs rows.csv --segment").ok().stdout;
    let mut lines = table.lines();
    assert_eq!(
        lines.next(),
        Some("visible,surfel1,surfel2,distance1,distance2,leaves,blocker,error")
    );
    let cells: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    let said: Vec<&str> = cells.iter().map(|row| row[0]).collect();
    assert_eq!(said, expected);
    assert!(cells.iter().all(|row| row[6].is_empty() == (row[0] == "1")), "{table}");
    let plain = bench.line("query hall.vmap pairs rows.csv").ok().stdout;
    let leaves: Vec<&str> = plain.lines().skip(1).map(|l| &l[..1]).collect();
    assert_eq!(cells.iter().map(|row| row[5]).collect::<Vec<_>>(), leaves);
    assert_ne!(said, leaves, "leaves are as wide as that");
    let lines = bench.line("query hall.vmap pairs rows.csv --segment --json").ok().stdout;
    for (line, row) in lines.lines().zip(&cells) {
        let object = json(line);
        assert_eq!(object["visible"], row[0] == "1", "{object}");
        assert_eq!(object["leaves"], row[5] == "1", "{object}");
        assert_eq!(object["segment"]["blocker"].as_u64(), row[6].parse().ok(), "{object}");
    }
    // Enough rows to keep the map: the same answers.
    let many = std::fs::read_to_string(bench.path("rows.csv")).unwrap();
    let (header, rows) = many.split_once('\n').unwrap();
    let n = (1 << 16) / rows.lines().count() + 1;
    bench.write("many.csv", format!("{header}\n{}", rows.repeat(n)));
    let kept = bench.line("query hall.vmap pairs many.csv --segment").ok().stdout;
    let (header, answers) = table.split_once('\n').unwrap();
    assert!(kept == format!("{header}\n{}", answers.repeat(n)), "answers of a kept map differ");
}
