//! What a light of the Cornell room costs and how far it is from a path tracer's.

use std::error::Error;
use std::path::{Path, PathBuf};

use pvmap::light::LightOptions;
use pvmap::query::{Map, Place, Snap};
use pvmap::scene::SceneKind;
use pvmap::vmap::{LightView, MapSummary};
use pvmap::{Approximation, BuildConfig, LightRequest, Limits, LitMap, Mapped, Quiet};
use serde::{Deserialize, Serialize};

use super::light_plot;
use super::processor::mean_of;
use crate::reference::{Reference, reference};
use crate::{LIGHTS, octree_of};

/// Points of the room.
pub(crate) const POINTS: u64 = 400_000;
const SCENE: &str = "furnished-grey";

/// A light of a map.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Cost {
    pub(crate) points: u64,
    /// The map: level and capacity, or what is left out of it.
    pub(crate) map: String,
    pub(crate) max_level: u8,
    pub(crate) leaf_capacity: u64,
    pub(crate) surfels: u32,
    pub(crate) links: u64,
    /// Of processors, from the octree to the finished map.
    pub(crate) map_seconds: f64,
    /// The light: p and an order, direct, or an error that was asked for.
    pub(crate) light: String,
    /// 0 where pairs are taken one by one.
    pub(crate) order: u32,
    pub(crate) iterations: u32,
    /// Of processors, from the map to the finished light file.
    pub(crate) light_seconds: f64,
    /// Over the places, of the path tracer's irradiance: mean of the absolute differences, mean of
    /// the differences, largest.
    pub(crate) mean_error: f64,
    pub(crate) bias: f64,
    pub(crate) largest_error: f64,
    /// Of the exchange by grids at 64 surfels, of the mean.
    pub(crate) operator_error: f64,
    /// Whether no other light takes as little, the map included, and is as near.
    pub(crate) is_front: bool,
}

/// A map that is lit, and what it took.
struct Built {
    path: PathBuf,
    name: String,
    config: BuildConfig,
    summary: MapSummary,
    seconds: f64,
}

/// Lights maps of the room, prints a line each, and writes the table and the plot.
///
/// # Errors
/// Where a map cannot be built or lit, or a file not be written.
pub(crate) fn run(output: &Path, n_points: u64, levels: &[u8]) -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let octree = octree_of(SceneKind::Furnished, n_points, folder.path())?;
    let places: Vec<Reference> = reference().into_iter().filter(|r| r.scene == SCENE).collect();
    let mut rows = Vec::new();
    println!("{}", head());
    for (name, config) in maps(levels) {
        let path = folder.path().join("s.vmap");
        let build = || pvmap::build(&octree, &path, &config, &Limits::default(), &Quiet);
        let (built, took) = mean_of(build)?;
        let (summary, seconds) = (built.report.summary, took.processor_seconds);
        let map = Built { path, name, config, summary, seconds };
        for (light, options) in lights() {
            let row = cost(&map, light, options, &places)?;
            println!("{}", line(&row));
            rows.push(row);
        }
    }
    mark_front(&mut rows);
    println!("\nno other takes as little, map and light together, and is as near:\n{}", head());
    rows.iter().filter(|row| row.is_front).for_each(|row| println!("{}", line(row)));
    let mut writer = csv::Writer::from_path(output.join("cornell.csv"))?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    writer.flush()?;
    std::fs::write(output.join("cornell.svg"), light_plot::draw(&rows))?;
    Ok(())
}

/// Draws an earlier table again.
///
/// # Errors
/// Where it cannot be read or the plot not be written.
pub(crate) fn redraw(table: &Path, output: &Path) -> Result<(), Box<dyn Error>> {
    let rows: Result<Vec<Cost>, _> = csv::Reader::from_path(table)?.into_deserialize().collect();
    Ok(std::fs::write(output.join("cornell.svg"), light_plot::draw(&rows?))?)
}

/// Gives the maps: depths by capacities, and two that leave something out.
fn maps(levels: &[u8]) -> Vec<(String, BuildConfig)> {
    let of = |max_level, leaf_capacity| BuildConfig {
        max_level,
        leaf_capacity,
        ..BuildConfig::default()
    };
    let mut all = Vec::new();
    for &max_level in levels {
        for leaf_capacity in [200, 50, 25] {
            let name = format!("L{max_level} c{leaf_capacity}");
            all.push((name, of(max_level, leaf_capacity)));
        }
    }
    let exact = Approximation::default();
    let left_out = [
        ("exchange 1e-6", Approximation { min_exchange: 1e-6, ..exact }),
        ("angle 0.15", Approximation { opening_angle: 0.15, ..exact }),
    ];
    all.extend(left_out.map(|(name, approximation)| {
        (name.to_owned(), BuildConfig { approximation, ..of(8, 50) })
    }));
    all
}

/// Gives the lights: orders, pair by pair, and errors asked for.
fn lights() -> Vec<(String, LightOptions)> {
    let usual = LightOptions::default();
    let of_order = |p| (format!("p{p}"), LightOptions { order: Some(p), ..usual.clone() });
    let of_error =
        |(name, error): (&str, f64)| (name.to_owned(), LightOptions { error, ..usual.clone() });
    let direct = ("direct".to_owned(), LightOptions { is_direct: true, ..usual.clone() });
    let errors = [("5 %", 0.05), ("1 %", 0.01), ("0.2 %", 0.002)];
    (1..=5).map(of_order).chain([direct]).chain(errors.map(of_error)).collect()
}

/// Lights a map and compares it with what is known of places.
fn cost(
    map: &Built,
    light: String,
    options: LightOptions,
    places: &[Reference],
) -> Result<Cost, Box<dyn Error>> {
    let (lights, output) = (map.path.with_extension("toml"), map.path.with_extension("light"));
    std::fs::write(&lights, LIGHTS)?;
    let request = LightRequest {
        map: map.path.clone(),
        octree: None,
        lights,
        output: Some(output.clone()),
        scale_of: None,
        options,
    };
    let (report, took) = mean_of(|| pvmap::light_map(&request, &Limits::default(), &Quiet))?;
    let summary = report.done.ok_or("nothing was computed")?.summary;
    let offs = offs(&map.path, &output, places)?;
    let mean = |of: fn(&f64) -> f64| offs.iter().map(of).sum::<f64>() / offs.len() as f64;
    Ok(Cost {
        points: map.summary.n_points,
        map: map.name.clone(),
        max_level: map.config.max_level,
        leaf_capacity: map.config.leaf_capacity,
        surfels: map.summary.n_surfels,
        links: map.summary.n_links,
        map_seconds: map.seconds,
        light,
        order: summary.order,
        iterations: summary.iterations,
        light_seconds: took.processor_seconds,
        mean_error: mean(|off| off.abs()),
        bias: mean(|off| *off),
        largest_error: offs.iter().fold(0.0, |most, off| off.abs().max(most)),
        operator_error: summary.operator_error,
        is_front: false,
    })
}

/// Gives by how much the light of places is off, as shares of the path tracer's.
fn offs(map: &Path, light: &Path, places: &[Reference]) -> Result<Vec<f64>, Box<dyn Error>> {
    let [map_bytes, light_bytes] = [Mapped::open(map)?, Mapped::open(light)?];
    let view = LightView::open(&light_bytes)?;
    let solid = Map::open(&map_bytes)?.solid();
    let lit = LitMap::read((light, &view), (map, solid.view()))?;
    let frame = solid.view().frame().frame;
    let one = |row: &Reference| {
        let place = Place { position: row.position, normal: Some(row.normal) };
        let surfel = solid.locate(&place, Snap::FourHalfSpacings)?.surfel;
        let at = frame.grid_of_query(row.position).map_err(|_| "a place outside the room")?;
        Ok(lit.irradiance(at, row.normal, surfel)[0] / row.irradiance[0] - 1.0)
    };
    places.iter().map(one).collect()
}

/// Marks the rows that no other beats: in seconds, those of the map included, and mean error.
fn mark_front(rows: &mut [Cost]) {
    let figures: Vec<[f64; 2]> = rows.iter().map(|row| [row.seconds(), row.mean_error]).collect();
    let beats = |a: &[f64; 2], b: &[f64; 2]| a != b && a[0] <= b[0] && a[1] <= b[1];
    for (row, figure) in rows.iter_mut().zip(&figures) {
        row.is_front = !figures.iter().any(|other| beats(other, figure));
    }
}

impl Cost {
    /// Gives the seconds of the map and of its light together.
    pub(crate) fn seconds(&self) -> f64 {
        self.map_seconds + self.light_seconds
    }
}

fn head() -> String {
    format!(
        "{:<14}{:>8}{:>10}{:>8}  {:<8}{:>6}{:>6}{:>9}{:>8}{:>8}{:>9}{:>10}",
        "map",
        "surfels",
        "links",
        "map, s",
        "light",
        "order",
        "iter.",
        "light, s",
        "mean %",
        "bias %",
        "most %",
        "exchange"
    )
}

fn line(row: &Cost) -> String {
    format!(
        "{:<14}{:>8}{:>10}{:>8.2}  {:<8}{:>6}{:>6}{:>9.2}{:>8.2}{:>8.2}{:>9.2}{:>10.1e}",
        row.map,
        row.surfels,
        row.links,
        row.map_seconds,
        row.light,
        row.order,
        row.iterations,
        row.light_seconds,
        100.0 * row.mean_error,
        100.0 * row.bias,
        100.0 * row.largest_error,
        row.operator_error
    )
}
