//! The plan of effects: what each scene calls for, that nothing else is touched, and that what is
//! left out is worth no more than the plan says.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use pvmap::geometry::Positions;
use pvmap::light::{Effect, LightOptions, Plan, Wishes, areas_grid2};
use pvmap::scene::SceneKind;
use pvmap::vmap::{LightView, MapView};
use pvmap::{BuildConfig, LightReport, LightRequest, Quiet, Watch, light_map, light_map_telling};
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
        light_map(&self.request(lights, options, output), &LIMITS, &Quiet).unwrap()
    }

    fn request(
        &self,
        lights: &str,
        options: LightOptions,
        output: Option<PathBuf>,
    ) -> LightRequest {
        let path = self.folder.path().join("lights.toml");
        std::fs::write(&path, lights).unwrap();
        LightRequest {
            map: self.map(),
            octree: None,
            lights: path,
            output,
            scale_of: None,
            options,
        }
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
    level(&[plate(60, 900, [0, 0, 0])])
}

/// n × n places, so far apart, from a corner on.
fn plate(n: i32, step: i32, [x, y, z]: [i32; 3]) -> Vec<[i32; 3]> {
    let places = (0..n).flat_map(|i| (0..n).map(move |j| [x + i * step, y + j * step, z]));
    places.collect()
}

/// Plates that face up.
fn level(plates: &[Vec<[i32; 3]>]) -> Cloud {
    let positions = plates.concat();
    let normals = Some(vec![[0.0, 0.0, 1.0]; positions.len()]);
    Cloud { normals, positions: Positions::Lattice(positions), colors: None }
}

/// Hears which stages begin.
#[derive(Default)]
struct Heard(Mutex<Vec<&'static str>>);

impl Watch for Heard {
    fn stage(&self, name: &'static str, _total: Option<u64>, _unit: &'static str) {
        self.0.lock().unwrap().push(name);
    }

    fn advance(&self, _n: u64) {}

    fn warn(&self, _message: &str) {}

    fn is_stopped(&self) -> bool {
        false
    }
}

#[test]
fn the_plan_is_told_before_anything_is_lit() {
    let stage = Stage::room(SceneKind::Empty);
    let lights = format!("{GREY}{GLOW}{LAMP}{SKY}");
    let request = stage.request(&lights, LightOptions::default(), Some(stage.output()));
    let (heard, before) = (Heard::default(), Mutex::new(None));
    let tell = |report: &LightReport| {
        assert!(report.done.is_none());
        *before.lock().unwrap() = Some(heard.0.lock().unwrap().clone());
    };
    let report = light_map_telling(&request, &LIMITS, &tell, &heard).unwrap();
    assert!(report.done.is_some());
    assert_eq!(before.into_inner().unwrap().unwrap(), ["areas", "plan"]);
    let after = heard.0.into_inner().unwrap();
    let lit = after.starts_with(&["areas", "plan", "lamps", "sky"]) && after.contains(&"solve");
    assert!(lit, "{after:?}");
}

/// Asks to stop once all effects are decided.
#[derive(Default)]
struct StopsAfterEffects {
    n_decided: AtomicU64,
    n_asked: AtomicU64,
}

impl Watch for StopsAfterEffects {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}

    fn advance(&self, n: u64) {
        self.n_decided.fetch_add(n, Ordering::Relaxed);
    }

    fn warn(&self, _message: &str) {}

    fn is_stopped(&self) -> bool {
        // The first time is when the last effects are counted.
        let all = Effect::ALL.len() as u64;
        self.n_decided.load(Ordering::Relaxed) == all
            && self.n_asked.fetch_add(1, Ordering::Relaxed) > 0
    }
}

#[test]
fn who_asks_to_stop_while_a_way_out_is_looked_for_is_heard() {
    let stage = Stage::room(SceneKind::Empty);
    let request = stage.request(&format!("{GREY}{GLOW}"), LightOptions::default(), None);
    let stopped = light_map(&request, &LIMITS, &StopsAfterEffects::default()).unwrap_err();
    assert!(stopped.to_string().contains("interrupted"), "{stopped}");
}

/// A ground of some 1000 surfels, and over a place of it a small plate.
fn ground_with_a_plate() -> Stage {
    Stage::new(&level(&[plate(160, 340, [0, 0, 0]), plate(24, 100, [30_000, 30_000, 4000])]))
}

/// A spot from above that reaches the plate, and what is around its shadow.
const SPOT: &str = "[[spot]]\nposition = [31150, 31150, 30000]\ndirection = [0, 0, -1]\n\
                    angle = 4.5\nflux = 1e8\n";

/// So coarse that not all surfels are tried.
fn coarse() -> LightOptions {
    LightOptions { worth: 0.05, ..LightOptions::default() }
}

#[test]
fn what_stands_in_a_narrow_spot_is_found_among_the_surfels_that_it_reaches() {
    let stage = ground_with_a_plate();
    let plan = stage.run(&format!("{GREY}{SPOT}"), coarse(), None).plan;
    let decision = plan.decision(Effect::Occlusion);
    assert!(decision.is_on, "{decision:?}");
    // Beside the plate nothing is in between, and all that are reached are asked.
    let beside = SPOT.replace("31150, 31150", "10000, 40000");
    let decision = stage.run(&format!("{GREY}{beside}"), coarse(), None).plan;
    let decision = decision.decision(Effect::Occlusion);
    assert!(!decision.is_on && decision.skipped == 0.0, "{decision:?}");
}

#[test]
fn a_colour_counts_by_the_light_that_falls_on_it() {
    let stage = ground_with_a_plate();
    let red = "[[material]]\nbox = [30000, 30000, 3900, 32300, 32300, 4100]\n\
               albedo = [0.7, 0.1, 0.1]\n";
    let calls = |lights: &str| {
        let plan = stage.run(lights, coarse(), None).plan;
        (plan.is_on(Effect::Color), plan.decision(Effect::Color).skipped)
    };
    let (is_on, skipped) = calls(&format!("{GREY}{red}{SPOT}"));
    assert!(is_on && skipped > 0.1, "most of the light falls on it: {skipped}");
    let elsewhere = SPOT.replace("31150, 31150", "10000, 40000");
    let (is_on, skipped) = calls(&format!("{GREY}{red}{elsewhere}"));
    assert!(!is_on, "no light falls on it: {skipped}");
    let colored = elsewhere.replace("1e8", "[2e8, 1e8, 1e8]");
    assert!(calls(&format!("{GREY}{colored}")).0, "the light has a colour");
}

/// A room without furniture of which a square of the ceiling is open: 3.5 % of it, 0.58 % of all.
fn room_with_a_hole(n: u64) -> Cloud {
    let cloud = scene_cloud(SceneKind::Empty, n);
    let Positions::Lattice(places) = &cloud.positions else { panic!("a lattice") };
    let is_hole =
        |p: &[i32; 3]| p[2] > 54_900 && p[0].max(p[1]) < 30_000 && p[0].min(p[1]) > 19_700;
    let kept: Vec<usize> = (0..places.len()).filter(|&i| !is_hole(&places[i])).collect();
    assert!(kept.len() < places.len());
    let normals = cloud.normals.as_ref().map(|all| kept.iter().map(|&i| all[i]).collect());
    let positions = Positions::Lattice(kept.iter().map(|&i| places[i]).collect());
    Cloud { normals, positions, colors: None }
}

#[test]
fn a_small_hole_counts_where_light_is_reflected_often() {
    let (closed, open) = (Stage::room(SceneKind::Empty), Stage::new(&room_with_a_hole(20_000)));
    let glowing =
        |rho: f64| format!("[albedo]\nfrom = {rho:?}\n[[glow]]\nall = true\nexitance = 1.0\n");
    for (stage, share) in [(&closed, 0.0), (&open, 0.0058)] {
        for rho in [0.95, 0.3] {
            let report = stage.light(&glowing(rho), LightOptions::default());
            let outlook = report.plan.outlook.unwrap();
            assert!((outlook.open_share - share).abs() < 1.5e-3, "{share}: {outlook:?}");
            let text = report.plan.to_string();
            assert!(text.contains("\nscene                    closed "), "{text}");
            // Where all is alike B = 1 / (1 - ρ (1 - s)), s what leads out.
            let expected = 1.0 / (1.0 - rho * (1.0 - share));
            let all = radiosity(&stage.output());
            let off = all.iter().sum::<f64>() / all.len() as f64 / expected - 1.0;
            println!("albedo {rho}: {outlook:?}, off by {off:.4}");
            assert!(off.abs() < 0.02, "albedo {rho}, open {share}: off by {off}");
        }
    }
    // Between two plates far more leads out.
    let mut plates = level(&[plate(60, 900, [0, 0, 0]), plate(60, 900, [0, 0, 20_000])]);
    plates.normals.iter_mut().for_each(|all| all[3600..].fill([0.0, 0.0, -1.0]));
    let plan = Stage::new(&plates).run(&glowing(0.5), LightOptions::default(), None).plan;
    assert!(plan.let_out().is_none() && plan.to_string().contains(" open "), "{plan}");
}

#[test]
fn the_sky_is_measured_by_what_of_it_arrives() {
    // Nothing else shines, and a hole of half a hundredth lets it in.
    let hole = Stage::new(&room_with_a_hole(20_000));
    let report = hole.light(&format!("{GREY}{SKY}"), LightOptions::default());
    assert!(report.plan.is_on(Effect::Sky), "{}", report.plan);
    assert!(radiosity(&hole.output()).iter().sum::<f64>() > 0.0);
    assert!(report.plan.decision(Effect::Sky).skipped > 0.9, "{}", report.plan);
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
fn near_field_and_order_change_no_more_than_the_plan_says_and_that_is_not_all() {
    for (kind, lights) in [
        (SceneKind::Furnished, format!("{GREY}{GLOW}")),
        (SceneKind::Empty, format!("[albedo]\nfrom = 0.5\n{LAMP}")),
    ] {
        let stage = Stage::room(kind);
        let plan = stage.light(&lights, LightOptions::default()).plan;
        let planned = radiosity(&stage.output());
        for effect in [Effect::NearField, Effect::Order] {
            let mut wishes = Wishes::default();
            wishes.set(effect, false);
            stage.light(&lights, LightOptions { wishes, ..LightOptions::default() });
            let without = radiosity(&stage.output());
            let off: f64 = without.iter().zip(&planned).map(|(a, b)| (a - b).abs()).sum();
            let (off, bound) = (off / planned.iter().sum::<f64>(), plan.decision(effect).skipped);
            println!("{kind:?} without {}: {off:.5}, bound {bound:.3}", effect.name());
            assert!(off > 0.0 && off <= bound && bound < 0.95, "{kind:?}: {off}, {bound}");
        }
    }
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
        // Both are solved to the error asked for.
        let bound = 2.0 * 0.01 + planned.plan.skipped();
        assert!(off <= bound * sum, "{kind:?}: {} > {bound}", off / sum);
    }
}

#[test]
fn it_is_noted_what_mirrors_would_still_throw() {
    let stage = Stage::new(&scene_cloud(SceneKind::Empty, 10_000));
    let notes = |albedo: f64| {
        let lights = format!(
            "[albedo]\nfrom = {albedo:?}\n{GLOW}[[material]]\nall = true\nspecular = 0.5\n"
        );
        let options = LightOptions { error: 0.045, ..LightOptions::default() };
        stage.light(&lights, options).notes_after
    };
    assert_eq!(notes(0.05), [""; 0]);
    let told = notes(0.45);
    assert!(told.len() == 1 && told[0].contains("after 5 rounds "), "{told:?}");
}

/// What leaves all surfels together: red, green, blue; and what of it the solver may lack.
struct Flux {
    plan: Plan,
    leaves: [f64; 3],
    residual: f64,
}

impl Stage {
    /// Lights it with these effects forced.
    fn flux(&self, lights: &str, forced: &[Effect]) -> Flux {
        let mut wishes = Wishes::default();
        forced.iter().for_each(|&effect| wishes.set(effect, true));
        // As few photons as there are.
        let options = LightOptions { error: 0.045, wishes, ..LightOptions::default() };
        let LightReport { plan, done, .. } = self.light(lights, options);
        let bytes = std::fs::read(self.map()).unwrap();
        let areas = areas_grid2(&MapView::open(&bytes).unwrap()).unwrap();
        let all = radiosity(&self.output());
        let leaves = [0, 1, 2].map(|c| {
            let rows = areas.iter().zip(all.chunks(3));
            rows.map(|(area, b)| area * b[c]).sum()
        });
        Flux { plan, leaves, residual: done.unwrap().summary.residual }
    }
}

/// Lights a scene as planned, with each effect alone that was left out for what it is worth, and
/// with all: nothing changes by more than the plan says, but for what solving may leave. Gives what
/// was left out for its worth.
#[track_caller]
fn left_out_within_bounds(what: &str, stage: &Stage, lights: &str) -> Vec<Effect> {
    let planned = stage.flux(lights, &[]);
    let decision = |&effect: &Effect| planned.plan.decision(effect);
    let is_left_out = |effect: &Effect| !decision(effect).is_on && decision(effect).skipped > 0.0;
    let left_out: Vec<Effect> = Effect::ALL.into_iter().filter(is_left_out).collect();
    let alone = left_out.iter().map(|effect| (vec![*effect], decision(effect).skipped));
    for (forced, skipped) in alone.chain([(Effect::ALL.to_vec(), planned.plan.skipped())]) {
        let found = stage.flux(lights, &forced);
        assert!(forced.iter().all(|&effect| found.plan.is_on(effect)));
        let off: f64 = (0..3).map(|c| (found.leaves[c] - planned.leaves[c]).abs()).sum();
        let off = off / found.leaves.iter().sum::<f64>();
        let bound = skipped + found.residual + planned.residual;
        println!("{what}: {:?} of {}: {off:.1e}, {skipped:.1e}", forced[0], forced.len());
        assert!(off <= bound, "{what}: {forced:?}: {off:e} > {bound:e}\n{}", planned.plan);
    }
    left_out
}

#[test]
fn what_mirrors_throw_where_no_lamp_shines_has_its_colour() {
    // A spot on a floor that mirrors: the wall on its edge gets nothing but by way of it.
    let floor = plate(60, 900, [0, 0, 0]);
    let wall: Vec<_> = floor.iter().map(|p| [54_000, p[1], p[0]]).collect();
    let n = floor.len();
    let mut both = level(&[floor, wall]);
    both.normals.iter_mut().for_each(|all| all[n..].fill([-1.0, 0.0, 0.0]));
    let stage = Stage::new(&both);
    let spot = "[albedo]\nfrom = 0.5\n[[spot]]\nposition = [14000, 27000, 30000]\n\
                target = [34000, 27000, 0]\nangle = 8\nflux = 1e8\n\
                [[material]]\nbox = [-100, -100, -100, 50000, 56000, 100]\n\
                albedo = 0.0\nspecular = 0.9\n";
    let red = "[[material]]\nbox = [53900, 17000, 10000, 54100, 37000, 40000]\n\
               albedo = [0.7, 0.1, 0.1]\n";
    left_out_within_bounds("a spot in a mirror", &stage, spot);
    left_out_within_bounds("on red", &stage, &format!("{spot}{red}"));
}

#[test]
fn a_mirror_that_sees_no_lamp_throws_what_others_reflect() {
    // A plate that shines up, over a floor that mirrors.
    let plates = [
        plate(60, 900, [0, 0, 0]),
        plate(20, 500, [20_000, 20_000, 9000]),
        plate(60, 900, [0, 0, 40_000]),
    ];
    let n_up = plates[0].len() + plates[1].len();
    let mut all = level(&plates);
    all.normals.iter_mut().for_each(|all| all[n_up..].fill([0.0, 0.0, -1.0]));
    let lights = "[albedo]\nfrom = 0.7\n\
                  [[glow]]\nbox = [0, 0, 8000, 56000, 56000, 10000]\nexitance = 1.0\n\
                  [[material]]\nbox = [-100, -100, -100, 56000, 56000, 100]\n\
                  albedo = 0.1\nspecular = 0.8\n";
    left_out_within_bounds("indirect light", &Stage::new(&all), lights);
}

#[test]
fn mirrors_glass_and_colours_change_no_more_than_the_plan_says() {
    let stage = Stage::new(&scene_cloud(SceneKind::Furnished, 10_000));
    let glossy = |share: f64| {
        format!(
            "[[material]]\nbox = [-1000, 54900, -1000, 56000, 56000, 56000]\nalbedo = 0.05\n\
             specular = {share:?}\n\
             [[material]]\nsphere = [39000, 18000, 9000, 9200]\nalbedo = 0.02\n\
             transmissive = {share:?}\nrefraction = 1.5\n"
        )
    };
    let tint = |by: f64| {
        let red = 0.5 + by;
        format!(
            "[[material]]\nbox = [-1000, -1000, -100, 20000, 20000, 100]\n\
             albedo = [{red:?}, 0.5, 0.5]\n"
        )
    };
    let bright = format!("[albedo]\nfrom = 0.5\n{GLOW}[sky]\nradiance = 0.0001\n");
    let scan = bright.replace("0.5", "\"scan\"");
    let mut left_out = Vec::new();
    for (what, lights) in [
        ("gloss", format!("{bright}{}", glossy(0.9))),
        ("colour", format!("{bright}{}", tint(0.3))),
        ("gloss, hardly a colour", format!("{bright}{}{}", glossy(0.9), tint(1e-5))),
        ("hardly any gloss, colours", format!("{scan}{LAMP}{}", glossy(1e-6))),
        ("hardly any of both", format!("{bright}{}{}", glossy(1e-6), tint(1e-5))),
        ("both", format!("{scan}{LAMP}{}", glossy(0.9))),
    ] {
        left_out.extend(left_out_within_bounds(what, &stage, &lights));
    }
    for effect in [Effect::Sky, Effect::Color, Effect::Caustics, Effect::DiffuseSpecularDiffuse] {
        assert!(left_out.contains(&effect), "{effect:?} is left out nowhere");
    }
}
