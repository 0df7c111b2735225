//! Answers against exact geometry: random pairs of points of the demo's room, with their normals,
//! asked of the map that each of two ready-made configurations builds: its leaves, and the segments
//! between the points among its surfels.
//!
//! 40 000 points and 20 000 pairs in a plain run; the figures of the README, 400 000 points and
//! 100 000 pairs, where PVMAP_SLOW_TESTS is set.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::path::Path;

use pvmap::accuracy::{self, Comparison, Drawn, Way};
use pvmap::config::RawConfig;
use pvmap::query::{Map, Place};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{Quiet, vmap::MapView};

use crate::common::{LIMITS, build_with, ingest_with, is_slow_run};

/// Asks a map about random pairs of the points it was made of.
fn ask(map: &[u8], scene: &Scene, n_points: u64, n_pairs: u64) -> Comparison {
    MapView::open(map).unwrap().verify().unwrap();
    let map = Map::open(map).unwrap();
    let points = scene.points(n_points);
    let mut draw = |rng: &mut fastrand::Rng| {
        let sample = points.at(rng.u64(..n_points));
        // Of its position the file holds f32.
        let position = sample.position.map(|v| f64::from(v as f32));
        let place = Place { position, normal: Some(sample.normal) };
        Ok(Drawn { place, sample: Some(sample) })
    };
    let mut ways = [Way::leaves(&map), Way::segments(&map)];
    accuracy::compare(scene, (n_pairs, 1), &mut draw, &mut ways, &Quiet).unwrap()
}

#[test]
fn answers_agree_with_exact_geometry() {
    // Promised are 98.5 % of the whole room with `depth8`; measured were 99.35 %, and 97.03 % with
    // `paper`. A tenth of the points, whose surfels are larger, gave 97.80 % and 90.70 %.
    let (n_points, n_pairs, bars) = if is_slow_run() {
        (400_000, 100_000, [98.5, 96.5])
    } else {
        (40_000, 20_000, [97.5, 90.0])
    };
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::new(SceneKind::Furnished, 1);
    let scan = folder.path().join("room.ply");
    let request = SceneRequest { n_points, shuffle: false };
    scenes::write(&scene, &request, &scan, &LIMITS, &Quiet).unwrap();
    let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
    for (preset, bar) in ["depth8", "paper"].into_iter().zip(bars) {
        let (config, _) = RawConfig::find(Path::new(preset)).unwrap().check().unwrap();
        let map = build_with(&octree, &config, &LIMITS);
        let found = ask(&map, &scene, n_points, n_pairs);
        assert_eq!((found.n_pairs, found.n_left_out), (n_pairs, 0));
        let percent = 100.0 * found.tallies[0].n_agreeing() as f64 / n_pairs as f64;
        eprintln!("{preset}, {n_points} points: {percent:.2} % agree, {found:?}");
        assert!(percent >= bar, "{preset}: {percent:.2} %, {bar} expected");
        // Of the whole room segments have a third less wrong than leaves, of the small one half.
        let [leaves, segments] = [0, 1].map(|way| n_pairs - found.tallies[way].n_agreeing());
        eprintln!("{preset}: wrong are {leaves} pairs by leaves, {segments} by segments");
        let most = if preset == "paper" { leaves } else { 3 * leaves / 4 };
        assert!(segments <= most, "{preset}: {segments} of {leaves}");
        // Neither answer is so rare that it could be missing.
        let n_yes = found.n_visible as f64 / n_pairs as f64;
        assert!((0.2..0.9).contains(&n_yes), "{n_yes} of the pairs are visible");
    }
}
