//! Answers against exact geometry: random pairs of points of the demo's room, with their normals,
//! asked of the map that each of the two ready-made configurations builds.
//!
//! 40 000 points and 20 000 pairs in a plain run; the figures of the README, 400 000 points and
//! 100 000 pairs, where PVMAP_SLOW_TESTS is set.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::path::Path;

use fastrand::Rng;
use pvmap::config::RawConfig;
use pvmap::query::{Map, Place, Snap};
use pvmap::scene::{Sample, Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{Quiet, vmap::MapView};

use crate::common::{LIMITS, build_with, ingest_with, is_slow_run};

/// What the pairs of a run said.
#[derive(Debug, Clone, Copy, Default)]
struct Agreement {
    n_pairs: u32,
    n_visible: u32,
    n_wrongly_visible: u32,
    n_wrongly_invisible: u32,
}

impl Agreement {
    fn percent(&self) -> f64 {
        let n_wrong = self.n_wrongly_visible + self.n_wrongly_invisible;
        100.0 * (1.0 - f64::from(n_wrong) / f64::from(self.n_pairs))
    }
}

/// Gives a sample as a place: of its position the file holds f32.
fn place(sample: &Sample) -> Place {
    let position = sample.position.map(|v| f64::from(v as f32));
    Place { position, normal: Some(sample.normal) }
}

/// Asks a map about random pairs of the points it was made of. Each point is in some leaf, so that
/// no snap limit is needed.
fn ask(map: &[u8], scene: &Scene, n_points: u64, n_pairs: u32) -> Agreement {
    MapView::open(map).unwrap().verify().unwrap();
    let map = Map::open(map).unwrap();
    let points = scene.points(n_points);
    let mut rng = Rng::with_seed(1);
    let mut found = Agreement { n_pairs, ..Agreement::default() };
    for _ in 0..n_pairs {
        let [a, b] = [0; 2].map(|_| points.at(rng.u64(..n_points)));
        let [at_a, at_b] = [&a, &b].map(|s| map.locate(&place(s), Snap::default()).unwrap());
        let (visible, truth) = (map.pair(&at_a, &at_b).unwrap().visible, scene.sees(&a, &b));
        found.n_visible += u32::from(truth);
        found.n_wrongly_visible += u32::from(visible && !truth);
        found.n_wrongly_invisible += u32::from(truth && !visible);
    }
    found
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
        eprintln!("{preset}, {n_points} points: {:.2} % agree, {found:?}", found.percent());
        assert!(found.percent() >= bar, "{preset}: {:.2} %, {bar} expected", found.percent());
        // Neither answer is so rare that it could be missing.
        let n_yes = f64::from(found.n_visible) / f64::from(n_pairs);
        assert!((0.2..0.9).contains(&n_yes), "{n_yes} of the pairs are visible");
    }
}
