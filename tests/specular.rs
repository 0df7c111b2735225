//! Light by way of mirrors and glass: where photons land, what becomes of flux, and what an eye
//! sees in them. Source: catalogue light.md §3.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::f64::consts::PI;
use std::sync::Mutex;

use pvmap::geometry::Positions;
use pvmap::light::{
    Effect, Elements, Glimpses, Gloss, LightOptions, Lighting, Lit, SeenAt, ThrownFlux, Wishes,
};
use pvmap::lights::Lights;
use pvmap::query::Map;
use pvmap::scene::SceneKind;
use pvmap::{BuildConfig, Quiet};

use crate::common::{Cloud, LIMITS, build_with, ingest_with, room_cloud, scene_cloud};

/// A piece of a surface: places and their normals.
type Piece = Vec<([f64; 3], [f32; 3])>;

/// n × n points of a parallelogram, each anywhere in its part.
fn sheet(n: usize, corner: [f64; 3], sides: [[f64; 3]; 2], normal: [f32; 3]) -> Piece {
    let mut rng = fastrand::Rng::with_seed(3);
    let mut at = |k: usize| (k as f64 + rng.f64()) / n as f64;
    let place = |k: usize| {
        let (u, v) = (at(k % n), at(k / n));
        ([0, 1, 2].map(|i| corner[i] + u * sides[0][i] + v * sides[1][i]), normal)
    };
    (0..n * n).map(place).collect()
}

/// The radius of the ball.
const RADIUS: f64 = 0.5;
/// The height of its middle: a ball lens of index 1.5 has its focus 3/2 of its radius behind its
/// middle, and that is the floor.
const HEIGHT: f64 = 0.75;

/// n points of the ball, evenly, on a spiral.
fn ball(n: usize) -> Piece {
    let one = |k: usize| {
        let z = 1.0 - (2.0 * k as f64 + 1.0) / n as f64;
        let (r, angle) = ((1.0 - z * z).sqrt(), PI * (3.0 - 5f64.sqrt()) * k as f64);
        let normal = [r * angle.cos(), r * angle.sin(), z];
        let place = [0, 1, 2].map(|i| RADIUS * normal[i] + if i == 2 { HEIGHT } else { 0.0 });
        (place, normal.map(|v| v as f32))
    };
    (0..n).map(one).collect()
}

fn floor() -> Piece {
    sheet(96, [-1.0, -1.0, 0.0], [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], [0.0, 0.0, 1.0])
}

/// The map of some pieces.
fn map_of(pieces: &[Piece]) -> Vec<u8> {
    let (places, normals) = pieces.concat().into_iter().unzip();
    let cloud =
        Cloud { positions: Positions::Double(places), normals: Some(normals), colors: None };
    map_of_cloud(&cloud)
}

fn map_of_cloud(cloud: &Cloud) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let scan = folder.path().join("scan.ply");
    cloud.write_ply(&scan);
    let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
    let config = BuildConfig { max_level: 8, leaf_capacity: 12, ..BuildConfig::default() };
    build_with(&octree, &config, &LIMITS)
}

/// Lights a map by a `lights.toml`.
fn light(bytes: &[u8], lights: &str, options: LightOptions) -> (Elements, Lit) {
    let map = Map::open(bytes).unwrap().solid();
    let elements = Elements::of_map(map.view()).unwrap();
    let given = Lights::parse(lights).unwrap().assign(map.view(), &elements, None).unwrap();
    let kept = elements.clone();
    let scene =
        Lighting::new(&map, elements, given.materials, given.lamps, given.sky, options).unwrap();
    let planned = scene.plan(&Quiet).unwrap();
    (kept, scene.run(&planned, None, &Quiet).unwrap())
}

fn usual() -> LightOptions {
    LightOptions::default()
}

/// Demands that no flux is lost: of photons to the rounding of sums, of all to the residual of the
/// solution.
#[track_caller]
fn assert_balanced(lit: &Lit) {
    assert!(lit.work.n_photons > 0 && !lit.thrown.is_empty(), "photons were sent");
    for ThrownFlux { resent, landed, escaped } in &lit.thrown {
        let off = landed + escaped - resent;
        assert!(off.abs() <= 1e-9 * resent, "{landed} + {escaped} of {resent}");
    }
    for channel in &lit.channels {
        let b = channel.balance;
        let off = (b.absorbed + b.escaped - b.emitted).abs();
        assert!(off <= 1e-3 * b.emitted, "{b:?}");
    }
}

const MIRROR: &str = "
[albedo]
from = 0.0
[[point]]
position = [-1.0, 0.0, 1.0]
intensity = 1.0
";
const MIRRORING: &str = "
[[material]]
box = [-2.1, -2.1, -0.01, 1.99, 2.1, 0.01]
specular = 0.9
";

/// A floor of 4 by 4 and a wall of 2 by 2 that stands on its right edge.
fn floor_and_wall() -> Vec<u8> {
    let floor = sheet(64, [-2.0, -2.0, 0.0], [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0]], [0.0, 0.0, 1.0]);
    let wall = sheet(48, [2.0, -1.0, 0.0], [[0.0, 2.0, 0.0], [0.0, 0.0, 2.0]], [-1.0, 0.0, 0.0]);
    map_of(&[floor, wall])
}

#[test]
fn a_mirror_lights_a_wall_as_the_image_of_the_lamp_would() {
    let bytes = floor_and_wall();
    let (elements, without) = light(&bytes, MIRROR, usual());
    let (_, with) = light(&bytes, &format!("{MIRROR}{MIRRORING}"), usual());
    assert_eq!(without.work.n_photons, 0);
    assert_balanced(&with);
    // By quarters of the wall along either side: flux of the image that is as far below the floor.
    let (mut found, mut expected) = ([[0.0; 4]; 4], [[0.0; 4]; 4]);
    let image = [-1.0, 0.0, -1.0];
    for id in 0..elements.len() {
        let one = elements.get(id);
        if one.normal[0] > -0.5 {
            continue;
        }
        // Elements are measured from the scan's lowest corner.
        let place = [one.position[0] - 2.0, one.position[1] - 2.0, one.position[2]];
        let to = [0, 1, 2].map(|i| place[i] - image[i]);
        let r2: f64 = to.iter().map(|v| v * v).sum();
        let part = [place[1] + 1.0, place[2]].map(|v| ((2.0 * v) as usize).min(3));
        let arrives = with.channels[0].irradiance[id] - without.channels[0].irradiance[id];
        found[part[0]][part[1]] += one.area * arrives;
        expected[part[0]][part[1]] += one.area * 0.9 * to[0] / (r2 * r2.sqrt());
    }
    for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
        let off = found / expected - 1.0;
        // A few hundred photons each.
        assert!(off.abs() < 0.12, "{found:.4}, the image gives {expected:.4}");
    }
    let sum = |of: &[[f64; 4]; 4]| of.iter().flatten().sum::<f64>();
    let off = sum(&found) / sum(&expected) - 1.0;
    assert!(off.abs() < 0.02, "{off}");
}

#[test]
fn a_spot_on_a_mirror_lights_what_it_does_not_shine_on() {
    let spot = "
[albedo]
from = 0.0
[[spot]]
position = [-1.0, 0.0, 1.0]
target = [0.5, 0.0, 0.0]
angle = 8
flux = 1.0
";
    let bytes = floor_and_wall();
    let (elements, lit) = light(&bytes, &format!("{spot}{MIRRORING}"), usual());
    assert_balanced(&lit);
    let row = |id| (elements.get(id), lit.channels[0].irradiance[id]);
    let rows: Vec<_> = (0..elements.len()).map(row).collect();
    let on_floor: f64 =
        rows.iter().filter(|(one, _)| one.normal[2] > 0.5).map(|(one, h)| one.area * h).sum();
    let on_wall: Vec<(f64, f64)> = rows
        .iter()
        .filter(|(one, _)| one.normal[0] < -0.5)
        .map(|(one, h)| (one.area * h, one.position[2]))
        .collect();
    let flux: f64 = on_wall.iter().map(|row| row.0).sum();
    let height = on_wall.iter().map(|row| row.0 * row.1).sum::<f64>() / flux;
    // All of the cone is mirrored; its middle climbs as it fell, 1 over 1.5, from 0.5 to 2.
    assert!((flux / (0.9 * on_floor) - 1.0).abs() < 0.02, "{flux} of {on_floor}");
    assert!((0.9..1.15).contains(&height), "{height}");
}

const SUN: &str = "
[albedo]
from = 0.0
[sun]
direction = [0, 0, 1]
irradiance = 1.0
";
const GLASS: &str = "
[[material]]
sphere = [0, 0, 0.75, 0.55]
transmissive = 1.0
refraction = 1.5
";

#[test]
fn a_glass_ball_gathers_light_in_its_focus_and_has_a_shadow_around() {
    let bytes = map_of(&[floor(), ball(4000)]);
    let (elements, dark) = light(&bytes, SUN, usual());
    let (_, lit) = light(&bytes, &format!("{SUN}{GLASS}"), usual());
    assert_balanced(&lit);
    let mean = |lit: &Lit, from: f64, to: f64| {
        let (mut flux, mut area) = (0.0, 0.0);
        for id in 0..elements.len() {
            let one = elements.get(id);
            let away = (one.position[0] - 1.0).hypot(one.position[1] - 1.0);
            if one.position[2] < 0.01 && (from..to).contains(&away) {
                flux += one.area * lit.channels[0].irradiance[id];
                area += one.area;
            }
        }
        flux / area
    };
    assert!((mean(&lit, 0.6, 0.9) - 1.0).abs() < 0.05, "beside it: {}", mean(&lit, 0.6, 0.9));
    assert!(mean(&dark, 0.0, 0.4) < 0.02, "no glass: {}", mean(&dark, 0.0, 0.4));
    // 0.28 of what meets the ball lands within 0.03 of the axis, 0.41 within 0.06: some 28 times
    // what would arrive there; photons are spread over a neighbourhood.
    let axis = mean(&lit, 0.0, 0.06);
    assert!(axis > 6.0, "in the focus: {axis}");
    // 0.04 of what meets it lands there: 0.12 of what would arrive.
    let ring = mean(&lit, 0.32, 0.46);
    assert!(ring < 0.4, "in the shadow: {ring}");
    // By Snell's law and Fresnel's formulas 0.737 of what meets the ball lands within 0.3.
    let found = mean(&lit, 0.0, 0.3) * PI * 0.09 / (PI * RADIUS * RADIUS);
    assert!((0.68..0.78).contains(&found), "{found} of the section");
}

const SKY: &str = "
[albedo]
from = 0.0
[sky]
radiance = 1.0
";

#[test]
fn the_sky_shines_through_a_roof_of_glass_and_by_way_of_a_mirror() {
    // Above the middle of the floor, but for what it lets through it would be dark there.
    let roof = sheet(64, [-1.0, -1.0, 0.5], [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], [0.0, 0.0, 1.0]);
    let bytes = map_of(&[floor(), roof]);
    let glass = "[[material]]\nbox = [-2, -2, 0.4, 2, 2, 0.6]\ntransmissive = 1.0\n";
    let (elements, dark) = light(&bytes, SKY, usual());
    let (_, lit) = light(&bytes, &format!("{SKY}{glass}refraction = 1.0\n"), usual());
    assert_balanced(&lit);
    let in_the_middle = |lit: &Lit| {
        let rows = (0..elements.len()).map(|id| (elements.get(id), lit.channels[0].irradiance[id]));
        let near = rows.filter(|(one, _)| {
            let [x, y, z] = one.position;
            z < 0.01 && (x - 1.0).hypot(y - 1.0) < 0.5
        });
        let (flux, area) =
            near.fold((0.0, 0.0), |sums, (one, h)| (sums.0 + one.area * h, sums.1 + one.area));
        flux / area
    };
    let [dark, lit] = [&dark, &lit].map(in_the_middle);
    // Light goes straight on in what is no denser than air: what the roof fills of the half sphere
    // over a place of the floor. Catalogue light.md §5, 4.
    let corner = |u: f64, v: f64| {
        let part = |u: f64, v: f64| u / u.hypot(0.5) * (v / u.hypot(0.5)).atan();
        (part(u, v) + part(v, u)) / (2.0 * PI)
    };
    let over = |x: f64, y: f64| {
        let signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)];
        signs.iter().map(|(i, j)| corner(1.0 + i * x, 1.0 + j * y)).sum::<f64>()
    };
    assert!((over(0.0, 0.0) - 0.831_2).abs() < 1e-3, "{}", over(0.0, 0.0));
    let steps = (0..400).map(|k| (k % 20, k / 20));
    let places = steps.map(|(i, j)| [i, j].map(|k: u32| (f64::from(k) + 0.5) / 20.0 - 0.5));
    let disc: Vec<f64> =
        places.filter(|[x, y]| x.hypot(*y) < 0.5).map(|[x, y]| over(x, y)).collect();
    let expected = disc.iter().sum::<f64>() / disc.len() as f64;
    let found = (lit - dark) / PI;
    assert!((found / expected - 1.0).abs() < 0.03, "{found} of the whole sky, not {expected}");

    let bytes = floor_and_wall();
    let (elements, without) = light(&bytes, SKY, usual());
    let (_, with) = light(&bytes, &format!("{SKY}{MIRRORING}"), usual());
    assert_balanced(&with);
    let on_wall = |lit: &Lit| -> f64 {
        let ids = (0..elements.len()).filter(|&id| elements.get(id).normal[0] < -0.5);
        ids.map(|id| elements.get(id).area * lit.channels[0].irradiance[id]).sum()
    };
    // The wall gets half of what the whole sky would give it, and by way of the mirror at its foot
    // 0.9 of 0.320, the form factor from the wall to the floor.
    let gained = on_wall(&with) / on_wall(&without);
    assert!((gained - 1.577).abs() < 0.05, "{gained}");
}

#[test]
fn flux_in_a_closed_room_with_mirror_and_glass_is_accounted_for() {
    let bytes = map_of_cloud(&room_cloud(12_000));
    let lights = "
[[glow]]
box = [21000, 22250, 54500, 34000, 32750, 56000]
exitance = 10
[[material]]
box = [-1000, 54900, -1000, 56000, 56000, 56000]
albedo = 0.05
specular = 0.9
[[material]]
sphere = [39000, 18000, 9000, 9200]
albedo = 0.02
transmissive = 0.9
specular = 0.05
refraction = 1.5
";
    let options = LightOptions { error: 0.03, ..usual() };
    let one = || light(&bytes, lights, options.clone()).1;
    let lit = one();
    assert_balanced(&lit);
    // Nothing is open in a room, but a patch of so few points leaves gaps to the next.
    for ThrownFlux { resent, escaped, .. } in &lit.thrown {
        assert!(*escaped < 3e-2 * resent, "{escaped} of {resent} escapes through gaps");
    }
    for threads in [1, 2, 8] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert!(pool.install(one) == lit, "{threads} threads");
    }
    let mut wishes = Wishes::default();
    wishes.set(Effect::Caustics, false);
    wishes.set(Effect::DiffuseSpecularDiffuse, false);
    let unwanted = light(&bytes, lights, LightOptions { wishes, ..options.clone() }).1;
    assert_eq!(unwanted.work.n_photons, 0);
    let plain = light(&bytes, lights.split("[[material]]").next().unwrap(), options).1;
    assert_eq!((plain.work.n_photons, plain.thrown.len()), (0, 0), "nothing mirrors");
}

#[test]
fn what_mirrors_would_still_throw_after_five_rounds_is_told() {
    let bytes = map_of_cloud(&scene_cloud(SceneKind::Empty, 12_000));
    let left = |albedo: f64| {
        let lights = format!(
            "[albedo]\nfrom = {albedo:?}\n[[glow]]\nall = true\nexitance = 1.0\n\
             [[material]]\nall = true\nspecular = 0.5\n"
        );
        light(&bytes, &lights, LightOptions { error: 0.045, ..usual() }).1.left_to_throw
    };
    assert_eq!(left(0.05), 0.0, "it comes to an end by itself");
    // Where all is alike each round brings c ρ / (1 - ρ) of what the one before did, c what comes
    // of 1 by mirrors alone, eight in a row at the most. A room of so few points loses some of it.
    let (rho, c) = (0.45, 1.0 - 0.5f64.powi(8));
    let first = (1.0 + rho * c) / (1.0 - rho) - 1.0;
    let expected = 0.5 * first * (c * rho / (1.0 - rho)).powi(5);
    let found = left(rho) / expected;
    assert!((0.5..1.0).contains(&found), "{found} of what is left if nothing is lost");
}

/// Follows a ray from a place of a surfel nearest to it; gives light, and all places seen.
fn look(
    bytes: &[u8],
    gloss: Gloss,
    is_glossy: impl Fn([f64; 3], [f64; 3]) -> bool,
    (place, direction): ([f64; 3], [f64; 3]),
    radiosity: impl Fn(&SeenAt) -> f64,
) -> (f64, Vec<[f64; 3]>) {
    let map = Map::open(bytes).unwrap().solid();
    let frame = &map.view().frame().frame;
    let surfels: Vec<_> =
        (0..map.view().summary().n_surfels).map(|id| map.view().surfel(id).unwrap()).collect();
    let glosses = surfels.iter().map(|s| {
        let normal = s.normal.map(|v| f64::from(v) / 16384.0);
        if is_glossy(frame.world_of(s.centroid), normal) { gloss } else { Gloss::default() }
    });
    let elements = Elements::of_map(map.view()).unwrap();
    let glimpses = Glimpses::new(&map, elements, glosses.collect()).unwrap();
    let away = |id: &u32| {
        let at = frame.world_of(surfels[*id as usize].centroid);
        (0..3).map(|i| (at[i] - place[i]).powi(2)).sum::<f64>()
    };
    let ids = 0..surfels.len() as u32;
    let nearest = ids.min_by(|a, b| away(a).total_cmp(&away(b))).unwrap();
    let places = Mutex::new(Vec::new());
    let seen = |at: &SeenAt| {
        places.lock().unwrap().push(at.place);
        [radiosity(at); 3]
    };
    let found = glimpses.look((nearest, place, direction), &seen, &|_| [0.0; 3]).unwrap();
    assert!(found.n_rays > 0);
    (found.light[0], places.into_inner().unwrap())
}

#[test]
fn an_eye_sees_a_wall_in_a_mirror_where_it_is() {
    let bytes = floor_and_wall();
    let gloss = Gloss { specular: 0.8, ..Gloss::default() };
    for (x, slope) in [(-1.0, 0.3), (0.0, 0.5), (0.3, 0.9)] {
        let ray = ([x, 0.1, 0.0], [1.0, 0.0, -slope]);
        let is_floor = |_, normal: [f64; 3]| normal[2] > 0.9;
        let (light, places) = look(&bytes, gloss, is_floor, ray, |_| 2.0);
        assert!((light - 1.6).abs() < 1e-6, "{light}");
        let expected = [2.0, 0.1, slope * (2.0 - x)];
        let off = (0..3).map(|i| (places[0][i] - expected[i]).abs()).fold(0.0, f64::max);
        assert!(off < 1e-3, "{places:?}, {expected:?}");
    }
    // Over the wall there is nothing, and no light without a sky.
    let over = ([1.0, 0.1, 0.0], [1.0, 0.0, -2.5]);
    let (light, places) = look(&bytes, gloss, |_, n| n[2] > 0.9, over, |_| 2.0);
    assert_eq!((light, places.len()), (0.0, 0));
}

#[test]
fn an_eye_sees_the_floor_through_a_ball_as_snell_says() {
    let bytes = map_of(&[floor(), ball(4000)]);
    let gloss = Gloss { specular: 0.0, transmissive: 1.0, refraction: 1.5 };
    let is_ball = |place: [f64; 3], _| place[2] > 0.1;
    let on_floor = |at: &SeenAt| f64::from(u8::from(at.place[2] < 0.01));
    // Through the middle: twice 4 % are reflected, and of these almost nothing comes back.
    let ray = ([0.0, 0.0, HEIGHT + RADIUS], [0.0, 0.0, -1.0]);
    let (light, _) = look(&bytes, gloss, is_ball, ray, on_floor);
    assert!((0.90..0.93).contains(&light), "{light}");
    for share in [0.2, 0.35, 0.5] {
        let sin = share;
        let (into, within) = (f64::asin(sin), f64::asin(sin / 1.5));
        let place = [RADIUS * sin, 0.0, HEIGHT + RADIUS * into.cos()];
        let (_, places) = look(&bytes, gloss, is_ball, (place, [0.0, 0.0, -1.0]), on_floor);
        // It leaves at this angle from the top, turned by twice the difference.
        let (leaves, turned) = (into + PI - 2.0 * within, 2.0 * (into - within));
        let (x, z) = (RADIUS * leaves.sin(), HEIGHT + RADIUS * leaves.cos());
        let expected = x - z * turned.tan();
        let nearest = places.iter().filter(|at| at[2] < 0.01);
        let off = nearest.map(|at| (at[0] - expected).hypot(at[1])).fold(f64::INFINITY, f64::min);
        assert!(off < 0.03, "{share}: {expected}, {places:?}");
    }
}
