//! The plan of effects: what each scene calls for, that nothing else is touched, and that what is
//! left out is worth no more than the plan says.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::path::{Path, PathBuf};

use pvmap::geometry::Positions;
use pvmap::light::{Effect, LightOptions, Wishes};
use pvmap::scene::SceneKind;
use pvmap::vmap::LightView;
use pvmap::{BuildConfig, LightReport, LightRequest, Quiet, light_map};
use tempfile::TempDir;

use crate::common::{Cloud, LIMITS, build_with, ingest_with, scene_cloud};

/// A map in a folder of its own, in which lights may be tried.
struct Stage {
    folder: TempDir,
}

impl Stage {
    fn new(cloud: &Cloud) -> Stage {
        let folder = tempfile::tempdir().unwrap();
        let scan = folder.path().join("scan.ply");
        cloud.write_ply(&scan);
        let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
        let config = BuildConfig { max_level: 5, ..BuildConfig::default() };
        let stage = Stage { folder };
        std::fs::write(stage.map(), build_with(&octree, &config, &LIMITS)).unwrap();
        stage
    }

    fn room(kind: SceneKind) -> Stage {
        Stage::new(&scene_cloud(kind, 20_000))
    }

    fn map(&self) -> PathBuf {
        self.folder.path().join("scene.vmap")
    }

    fn light(&self, lights: &str, options: LightOptions) -> LightReport {
        self.run(lights, options, Some(self.output()))
    }

    fn run(&self, lights: &str, options: LightOptions, output: Option<PathBuf>) -> LightReport {
        let path = self.folder.path().join("lights.toml");
        std::fs::write(&path, lights).unwrap();
        let request = LightRequest {
            map: self.map(),
            octree: None,
            lights: path,
            output,
            scale_of: None,
            options,
        };
        light_map(&request, &LIMITS, &Quiet).unwrap()
    }

    fn output(&self) -> PathBuf {
        self.folder.path().join("scene.light")
    }

    /// Says whether an effect is on.
    fn calls_for(&self, effect: Effect, lights: &str) -> bool {
        self.run(lights, LightOptions::default(), None).plan.is_on(effect)
    }
}

/// The radiosity of all surfels, three numbers each.
fn radiosity(path: &Path) -> Vec<f64> {
    let bytes = std::fs::read(path).unwrap();
    let light = LightView::open(&bytes).unwrap();
    let of = |id| light.found(id).unwrap().map(|one| f64::from(one.radiosity));
    (0..light.summary().n_surfels).flat_map(of).collect()
}

/// The clouds' unit is a tenth of a millimetre.
const GREY: &str = "[albedo]\nfrom = 0.7\n";
const GLOW: &str = "[[glow]]\nbox = [20000, 20000, 54000, 35000, 35000, 56000]\nexitance = 1.0\n";
const LAMP: &str = "[[point]]\nposition = [15000, 27000, 45000]\nintensity = 1e8\n";
const SKY: &str = "[sky]\nradiance = 0.3\n";

/// A level ground, its normals up.
fn ground() -> Cloud {
    let places = (0..60).flat_map(|x| (0..60).map(move |y| [x * 900, y * 900, 0]));
    let positions: Vec<[i32; 3]> = places.collect();
    let normals = Some(vec![[0.0, 0.0, 1.0]; positions.len()]);
    Cloud { normals, positions: Positions::Lattice(positions), colors: None }
}

#[test]
fn a_grey_closed_diffuse_box_runs_none_of_the_optional_effects() {
    let report =
        Stage::room(SceneKind::Empty).light(&format!("{GREY}{GLOW}"), LightOptions::default());
    let optional = [
        Effect::Sky,
        Effect::Occlusion,
        Effect::Color,
        Effect::MirrorView,
        Effect::Refraction,
        Effect::Caustics,
        Effect::DiffuseSpecularDiffuse,
    ];
    for effect in optional {
        assert!(!report.plan.is_on(effect), "{effect:?}");
    }
    assert!(report.plan.is_on(Effect::Direct) && report.plan.is_on(Effect::Bounces));
    let work = report.done.unwrap().work;
    assert_eq!((work.n_lamp_segments, work.n_sky_segments, work.n_photons), (0, 0, 0));
    assert_eq!(work.n_channels, 1);
    assert!(work.n_applications > 0 && work.n_iterations > 0);
}

#[test]
fn where_nothing_shines_nothing_is_done() {
    let report = Stage::room(SceneKind::Empty).light(GREY, LightOptions::default());
    assert!(!report.plan.is_on(Effect::Direct) && !report.plan.is_on(Effect::Bounces));
    let work = report.done.unwrap().work;
    assert_eq!((work.n_applications, work.n_lamp_segments, work.n_iterations), (0, 0, 0));
}

#[test]
fn each_effect_is_called_for_by_one_scene_and_not_by_another() {
    let [empty, furnished] = [SceneKind::Empty, SceneKind::Furnished].map(Stage::room);
    let ground = Stage::new(&ground());
    let grey = format!("{GREY}{GLOW}");
    assert!(empty.calls_for(Effect::Direct, &grey));
    assert!(!empty.calls_for(Effect::Direct, GREY));

    assert!(ground.calls_for(Effect::Sky, &format!("{GREY}{SKY}")));
    let bright = format!("{grey}[sky]\nradiance = 0.0001\n");
    assert!(!empty.calls_for(Effect::Sky, &bright));

    assert!(furnished.calls_for(Effect::Occlusion, &format!("{GREY}{LAMP}")));
    assert!(!empty.calls_for(Effect::Occlusion, &format!("{GREY}{LAMP}")));

    assert!(empty.calls_for(Effect::Bounces, &grey));
    assert!(!empty.calls_for(Effect::Bounces, &format!("[albedo]\nfrom = 0.0\n{GLOW}")));
    assert!(!ground.calls_for(Effect::Bounces, &format!("{GREY}{SKY}")));

    assert!(empty.calls_for(Effect::Color, GLOW));
    assert!(!empty.calls_for(Effect::Color, &grey));

    let mirror = |share: f64| {
        format!("{grey}[[material]]\nbox = [0, 0, -100, 56000, 56000, 100]\nspecular = {share:?}\n")
    };
    for effect in [Effect::MirrorView, Effect::Caustics, Effect::DiffuseSpecularDiffuse] {
        assert!(empty.calls_for(effect, &mirror(0.3)), "{effect:?}");
        assert!(!empty.calls_for(effect, &grey), "{effect:?}");
    }
    // So little is seen in it, but throws nothing that would count.
    assert!(empty.calls_for(Effect::MirrorView, &mirror(1e-6)));
    assert!(!empty.calls_for(Effect::Caustics, &mirror(1e-6)));
    let glass = "[[material]]\nbox = [0, 0, -100, 56000, 56000, 100]\ntransmissive = 0.3\n";
    assert!(empty.calls_for(Effect::Refraction, &format!("{grey}{glass}")));
    assert!(!empty.calls_for(Effect::Refraction, &mirror(0.3)));

    assert!(empty.calls_for(Effect::NearField, &grey));
    assert!(!ground.calls_for(Effect::NearField, &format!("{GREY}{SKY}")));

    assert!(empty.calls_for(Effect::Order, &grey));
    let coarse = LightOptions { error: 0.9, ..LightOptions::default() };
    let dark = format!("[albedo]\nfrom = 0.3\n{GLOW}");
    assert!(!empty.run(&dark, coarse, None).plan.is_on(Effect::Order));
}

#[test]
fn all_effects_forced_change_no_more_than_the_plan_says() {
    for (kind, lights) in [
        (SceneKind::Furnished, format!("{GREY}{GLOW}{LAMP}")),
        (SceneKind::Empty, format!("{GREY}{LAMP}[sky]\nradiance = 0.0001\n")),
    ] {
        let stage = Stage::room(kind);
        let planned = stage.light(&lights, LightOptions::default());
        let as_planned = radiosity(&stage.output());
        let mut wishes = Wishes::default();
        Effect::ALL.into_iter().for_each(|effect| wishes.set(effect, true));
        let options = LightOptions { wishes, ..LightOptions::default() };
        let forced = stage.light(&lights, options);
        assert!(Effect::ALL.into_iter().all(|effect| forced.plan.is_on(effect)));
        let all = radiosity(&stage.output());
        let sum: f64 = all.iter().sum();
        let off: f64 = all.iter().zip(&as_planned).map(|(a, b)| (a - b).abs()).sum();
        // Both are solved to the error asked for, and light is reflected 1 / (1 - 0.7) times.
        let bound = 2.0 * 0.01 + planned.plan.skipped() / 0.3;
        assert!(off <= bound * sum, "{kind:?}: {} > {bound}", off / sum);
    }
}
