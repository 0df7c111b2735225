//! Light in rooms against what a path tracer found: the whole way from points, by `lights.toml` and
//! the light file, to the light at places of floor and walls.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
mod reference;

use std::path::Path;

use pvmap::light::LightOptions;
use pvmap::query::{Map, Place, Snap};
use pvmap::vmap::LightView;
use pvmap::{BuildConfig, LightRequest, LitMap, Quiet, light_map};

use crate::common::{LIMITS, build_with, ingest_with, scene_cloud};
use crate::reference::{EXITANCE, LAMP, Reference, reference};

/// The clouds' unit, a tenth of a millimetre, in metres.
const UNIT_M: f64 = 1e-4;

/// How far light is from the reference: the mean of 256 places, over all channels, and the most.
fn off(rows: &[Reference], n_points: u64, folder: &Path) -> (f64, f64) {
    let scan = folder.join("scan.ply");
    scene_cloud(rows[0].room(), n_points).write_ply(&scan);
    let octree = ingest_with(&[scan], folder, &LIMITS, |_| {});
    let (map_path, light_path) = (folder.join("room.vmap"), folder.join("room.light"));
    std::fs::write(&map_path, build_with(&octree, &BuildConfig::default(), &LIMITS)).unwrap();
    let albedo = if rows[0].scene.ends_with("scan") { "\"scan\"" } else { "0.7" };
    let [x0, y0, x1, y1] = LAMP.map(|v| v / UNIT_M);
    // Surfels at the lamp's edge glow as a whole or not at all, but the flux is the lamp's.
    let flux = EXITANCE * (x1 - x0) * (y1 - y0);
    let lights = folder.join("lights.toml");
    let text = format!(
        "[albedo]\nfrom = {albedo}\n[[glow]]\nbox = [{x0}, {y0}, 54500.0, {x1}, {y1}, 56000.0]\n\
         flux = {flux:?}\n"
    );
    std::fs::write(&lights, text).unwrap();
    let request = LightRequest {
        map: map_path.clone(),
        octree: None,
        lights,
        output: Some(light_path.clone()),
        scale_of: None,
        options: LightOptions::default(),
    };
    light_map(&request, &LIMITS, &Quiet).unwrap();
    let (map_bytes, light_bytes) =
        (std::fs::read(&map_path).unwrap(), std::fs::read(&light_path).unwrap());
    let map = Map::open(&map_bytes).unwrap();
    let light = LightView::open(&light_bytes).unwrap();
    let lit = LitMap::read((&light_path, &light), (&map_path, map.view())).unwrap();
    let frame = &map.view().frame().frame;
    let (mut sum, mut most) = (0.0, 0.0f64);
    for row in rows {
        let position = row.position.map(|v| v / UNIT_M);
        let place = Place { position, normal: Some(row.normal) };
        let at = map.locate(&place, Snap::FourHalfSpacings).unwrap();
        let g = frame.grid_of_query(position).unwrap();
        let found = lit.irradiance(g, row.normal, at.surfel);
        for (found, expected) in found.iter().zip(row.irradiance) {
            let off = (found / expected - 1.0).abs();
            (sum, most) = (sum + off, most.max(off));
        }
    }
    (sum / (3 * rows.len()) as f64, most)
}

#[test]
fn rooms_are_lit_as_a_path_tracer_lights_them() {
    for scene in ["empty-grey", "furnished-grey", "furnished-scan"] {
        let rows: Vec<Reference> =
            reference().into_iter().filter(|row| row.scene == scene).collect();
        let folder = tempfile::tempdir().unwrap();
        let (mean, most) = off(&rows, 100_000, folder.path());
        println!("{scene}: off by {mean:.4} on average, {most:.4} at the most");
        assert!(mean <= 0.02, "{scene}: {mean}");
    }
}
