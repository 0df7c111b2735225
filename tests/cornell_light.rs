//! Light in the Cornell rooms: what a path tracer found, and that it is to be trusted.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod reference;
mod vectors;

use std::collections::BTreeMap;
use std::f64::consts::PI;

use pvmap::scene::Scene;

use crate::reference::{EXITANCE, LAMP, Reference, reference};
use crate::vectors::{cross, dot, sub};

/// The room's side in metres: the height of the lamp.
const SIDE_M: f64 = 5.5;
/// How far the table's places stay from other surfaces, in metres.
const GAP_M: f64 = 0.11;
/// Places on the lamp along either of its sides.
const N_LAMP: usize = 48;

/// The rows of each scene.
fn scenes() -> BTreeMap<String, Vec<Reference>> {
    let mut scenes = BTreeMap::<_, Vec<_>>::new();
    for row in reference() {
        scenes.entry(row.scene.clone()).or_default().push(row);
    }
    scenes
}

/// Irradiance from the whole lamp by Lambert's formula: half of the lamp's radiance times the sum
/// over its sides of the angle they span, by the cosine to their plane's normal.
fn lambert(row: &Reference) -> f64 {
    let [x0, y0, x1, y1] = LAMP;
    let corners = [[x0, y0], [x0, y1], [x1, y1], [x1, y0]];
    let to = corners.map(|[x, y]| sub([x, y, SIDE_M], row.position));
    let normal = row.normal.map(f64::from);
    let sides = (0..4).map(|i| {
        let (a, b) = (to[i], to[(i + 1) % 4]);
        let plane = cross(a, b);
        let sine = dot(plane, plane).sqrt();
        sine.atan2(dot(a, b)) * dot(plane, normal) / sine
    });
    (EXITANCE / PI * 0.5 * sides.sum::<f64>()).abs()
}

/// Irradiance from what a place sees of the lamp, by the scene's own truth, and how many of
/// [`N_LAMP`]² equal parts of the lamp it sees.
fn from_visible_lamp(scene: &Scene, row: &Reference) -> (f64, usize) {
    let [x0, y0, x1, y1] = LAMP;
    let at = |from: f64, to: f64, i| from + (to - from) * (i as f64 + 0.5) / N_LAMP as f64;
    let part_m2 = (x1 - x0) * (y1 - y0) / (N_LAMP * N_LAMP) as f64;
    let (mut irradiance, mut n_seen) = (0.0, 0);
    for i in 0..N_LAMP * N_LAMP {
        let place = [at(x0, x1, i % N_LAMP), at(y0, y1, i / N_LAMP), SIDE_M];
        if scene.sees_points(row.position, row.normal, place, [0.0, 0.0, -1.0]) {
            let d = sub(place, row.position);
            let r2 = dot(d, d);
            let cosines = dot(d, row.normal.map(f64::from)) * d[2] / r2;
            irradiance += EXITANCE * cosines * part_m2 / (PI * r2);
            n_seen += 1;
        }
    }
    (irradiance, n_seen)
}

#[test]
fn each_scene_has_the_same_64_places_of_the_floor_and_48_of_each_wall() {
    let scenes = scenes();
    let names: Vec<&str> = scenes.keys().map(String::as_str).collect();
    assert_eq!(names, ["empty-grey", "furnished-grey", "furnished-scan"]);
    let places = |name| scenes[name].iter().map(|r| (r.position, r.normal)).collect::<Vec<_>>();
    for name in names {
        assert_eq!(places(name), places("empty-grey"));
        let inward = [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]];
        for (side, n) in inward.into_iter().zip([64, 48, 48, 48, 48]) {
            let side = side.map(|c| c as f32);
            assert_eq!(scenes[name].iter().filter(|row| row.normal == side).count(), n, "{side:?}");
        }
    }
}

#[test]
fn the_places_lie_on_surfaces_and_keep_away_from_others() {
    for row in reference() {
        let scene = Scene::new(row.room(), 1);
        // Away by rounding at most: the nearest place of a triangle is computed.
        let is_there = |place: [f64; 3]| {
            let off = sub(place, row.position);
            dot(off, off) < 1e-24
        };
        let on = scene.project(row.position, row.normal).unwrap();
        assert!(is_there(on.position) && on.normal == row.normal, "{row:?}: {on:?}");
        // A neighbour within half the gap would be found, whatever its normal.
        let over = [0, 1, 2].map(|i| row.position[i] + 0.5 * GAP_M * f64::from(row.normal[i]));
        let near = scene.project(over, [0.0; 3]);
        assert!(near.is_none_or(|sample| is_there(sample.position)), "{row:?}");
        let n_edges = row.position.iter().filter(|&&c| !(GAP_M..=SIDE_M - GAP_M).contains(&c));
        assert_eq!(n_edges.count(), 1, "{row:?}");
    }
}

#[test]
fn what_comes_straight_from_the_lamp_is_what_form_factors_and_the_truth_say() {
    for (name, rows) in scenes() {
        let scene = Scene::new(rows[0].room(), 1);
        let (mut n_lit, mut n_dark) = (0, 0);
        for row in &rows {
            let whole = lambert(row);
            let (seen, n_seen) = from_visible_lamp(&scene, row);
            if n_seen == N_LAMP * N_LAMP {
                assert!((row.direct - whole).abs() <= 1e-3 * whole, "{row:?}: {whole}");
                n_lit += 1;
            } else if n_seen == 0 {
                assert!(row.direct <= 1e-3 * whole, "{row:?}: {whole}");
                n_dark += 1;
            }
            // The edge of a shadow cuts the parts of the lamp that it crosses.
            assert!((row.direct - seen).abs() <= 0.01 * whole, "{row:?}: {seen}");
        }
        let is_empty = name.starts_with("empty");
        assert!(if is_empty { n_lit == 256 } else { n_lit >= 190 && n_dark >= 15 }, "{name}");
    }
}

#[test]
fn reflected_light_adds_to_the_direct_and_takes_the_colour_of_the_walls() {
    for (name, rows) in scenes() {
        // Of channel 0 or 1, what comes by reflection to a third of the floor and the white walls.
        let reflected = |channel: usize, from_m: f64| {
            let is_there = |row: &&Reference| {
                row.normal[0] == 0.0 && (from_m..from_m + SIDE_M / 3.0).contains(&row.position[0])
            };
            let rows = rows.iter().filter(is_there);
            rows.map(|row| row.irradiance[channel] - row.direct).sum::<f64>()
        };
        let redness = |from_m| reflected(0, from_m) / reflected(1, from_m);
        let (left, right) = (redness(0.0), redness(SIDE_M * 2.0 / 3.0));
        if name.ends_with("grey") {
            assert_eq!((left, right), (1.0, 1.0));
        } else {
            assert!(left > 1.2 && left > 1.2 * right, "{left} {right}");
        }
        for row in &rows {
            assert!(row.irradiance.iter().all(|&all| all > row.direct), "{row:?}");
            assert!(row.error < 0.004, "{row:?}");
        }
        assert!(rows.iter().filter(|row| row.error <= 0.003).count() >= 250, "{name}");
    }
}
