//! Lights a map in which a part of the ceiling glows: `cargo run --release -p pvmap-light --example
//! lit MAP ALBEDO ERROR`. Prints the plan, the work and seconds by the clock.
#![allow(clippy::unwrap_used, reason = "an example fails where it unwraps nothing")]

use std::time::Instant;

use pvmap_light::{Channel, Elements, LightOptions, Lighting, Materials, Scaling};
use pvmap_query::Map;
use pvmap_store::Quiet;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let bytes = std::fs::read(&args[0]).unwrap();
    let (albedo, error) = (args[1].parse::<f64>().unwrap(), args[2].parse::<f64>().unwrap());
    let map = Map::open(&bytes).unwrap().solid();
    let start = Instant::now();
    let elements = Elements::of_map(map.view()).unwrap();
    let n = elements.len();
    let top = (0..n).map(|id| elements.get(id).position[2]).fold(0.0, f64::max);
    let glows = |id: usize| {
        let [x, y, z] = elements.get(id).position.map(|v| v / top);
        z > 0.98 && (0.4..0.6).contains(&x) && (0.4..0.6).contains(&y)
    };
    let emission: Vec<f64> = (0..n).map(|id| if glows(id) { 10.0 } else { 0.0 }).collect();
    let channel = Channel { emission, albedo: vec![albedo; n] };
    let materials =
        Materials { channels: [channel.clone(), channel.clone(), channel], gloss: Vec::new() };
    println!("{n} surfels, {:.2} s", start.elapsed().as_secs_f64());
    let options = LightOptions { error, ..LightOptions::default() };
    let scene = Lighting::new(&map, elements, materials, Vec::new(), None, options).unwrap();
    let planned = scene.plan(&Quiet).unwrap();
    print!("{}", planned.plan);
    println!(
        "closed: {}, {:.2} s",
        planned.plan.let_out().is_some(),
        start.elapsed().as_secs_f64()
    );
    let lit = scene.run(&planned, None, &Quiet).unwrap();
    println!("{:?} {:?}", lit.work, lit.stats);
    println!(
        "operator {:.1e}, rows {:.1e}, residual {:.1e}",
        lit.operator_error, lit.row_error, lit.residual
    );
    println!("{:?}, {:.2} s", lit.channels[0].balance, start.elapsed().as_secs_f64());
    let again = Instant::now();
    let scaling = Scaling { scale: lit.scale.clone(), row_error: lit.row_error, error: 0.01 };
    let relit = scene.run(&planned, Some(scaling), &Quiet).unwrap();
    println!("again in {:.2} s: {}", again.elapsed().as_secs_f64(), relit.channels == lit.channels);
}
