//! Light in rooms against what a path tracer found: the way from a scan to the light at places of
//! its floor and walls.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
mod reference;

use pvmap::light::{Channel, Elements, LightOptions, Lighting, Lit, Materials};
use pvmap::query::{Map, Place, Snap};
use pvmap::{BuildConfig, Quiet};

use crate::common::{LIMITS, build_with, ingest_with};
use crate::reference::{EXITANCE, LAMP, Reference, reference};

fn rows(scene: &str) -> Vec<Reference> {
    reference().into_iter().filter(|row| row.scene == scene).collect()
}

#[test]
fn the_cornell_room_is_lit_as_a_path_tracer_lights_it() {
    let n: u64 = std::env::var("NPOINTS").ok().and_then(|v| v.parse().ok()).unwrap_or(100_000);
    for name in ["empty-grey", "furnished-grey"] {
        let rows = rows(name);
        let folder = tempfile::tempdir().unwrap();
        let scan = folder.path().join("scan.ply");
        common::scene_cloud(rows[0].room(), n).write_ply(&scan);
        let octree = ingest_with(&[scan], folder.path(), &LIMITS, |_| {});
        let config = BuildConfig::default();
        let bytes = build_with(&octree, &config, &LIMITS);
        let map = Map::open(&bytes).unwrap().solid();
        let elements = Elements::of_map(map.view()).unwrap();
        let frame = map.view().frame().frame;
        let [x0, y0, x1, y1] = LAMP;
        let glows: Vec<bool> = (0..elements.len() as u32)
            .map(|id| {
                let surfel = map.view().surfel(id).unwrap();
                let [x, y, z] = frame.world_of(surfel.centroid).map(|v| v * 1e-4);
                z > 5.49 && (x0..x1).contains(&x) && (y0..y1).contains(&y)
            })
            .collect();
        let area: f64 =
            1e-8 * elements.areas().iter().zip(&glows).filter(|g| *g.1).map(|g| g.0).sum::<f64>();
        let exitance = EXITANCE * (x1 - x0) * (y1 - y0) / area;
        let emission = glows.iter().map(|&g| if g { exitance } else { 0.0 }).collect();
        let channel = Channel { emission, albedo: vec![0.7; elements.len()] };
        let channels = [channel.clone(), channel.clone(), channel];
        let materials = Materials { channels, gloss: Vec::new() };
        let error = std::env::var("ERR").ok().and_then(|v| v.parse().ok()).unwrap_or(0.01);
        let options = LightOptions { error, ..LightOptions::default() };
        let scene = Lighting::new(&map, elements, materials, Vec::new(), None, options).unwrap();
        let planned = scene.plan(&Quiet).unwrap();
        let lit: Lit = scene.run(&planned, None, &Quiet).unwrap();
        let off = |row: &Reference| {
            let place = Place { position: row.position.map(|v| v * 1e4), normal: Some(row.normal) };
            let at = map.locate(&place, Snap::FourHalfSpacings).unwrap();
            let found = lit.channels[0].irradiance[at.surfel as usize];
            found / row.irradiance[0] - 1.0
        };
        let offs: Vec<f64> = rows.iter().map(off).collect();
        let mean = offs.iter().map(|o| o.abs()).sum::<f64>() / 256.0;
        let bias = offs.iter().sum::<f64>() / 256.0;
        let most = offs.iter().fold(0.0f64, |m, o| m.max(o.abs()));
        println!(
            "{name}: {} surfels, lamp {:.4}, mean {mean:.4} bias {bias:.4} most {most:.4} {:?} {:?} open {}",
            lit.scale.len(),
            area / ((x1 - x0) * (y1 - y0)),
            lit.row_error,
            lit.channels[0].balance,
            planned.plan.open_share
        );
        for (k, normal) in
            [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
                .iter()
                .enumerate()
        {
            let on: Vec<f64> = rows
                .iter()
                .zip(&offs)
                .filter(|(r, _)| r.normal == *normal)
                .map(|(_, o)| *o)
                .collect();
            println!(
                "  {k}: mean {:.4} bias {:.4}",
                on.iter().map(|o| o.abs()).sum::<f64>() / on.len() as f64,
                on.iter().sum::<f64>() / on.len() as f64
            );
        }
    }
}
