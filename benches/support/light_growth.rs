//! How light grows with the surfels of a map.

use std::error::Error;
use std::path::Path;
use std::process::Command;

use pvmap::config::RawConfig;
use pvmap::light::{Elements, Exchange, Hierarchy, Kernel, LightOptions};
use pvmap::scene::SceneKind;
use pvmap::vmap::MapView;
use pvmap::{BuildConfig, LightDone, LightRequest, Limits, Mapped, Quiet};
use serde::{Deserialize, Serialize};

use super::peak::peak_bytes_of;
use super::power::Growth;
use super::processor::{BENCH, mean_of, timed};
use crate::{LIGHTS, OTHER_LIGHTS, octree_of};

/// Points of the rooms: leaves of flat walls are cut all at once, in leaps of four.
pub(crate) const POINTS: [u64; 4] = [100_000, 400_000, 1_600_000, 6_000_000];
/// The argument that makes this program measure one light and print it.
pub(crate) const MEASURE: &str = "measure-one-light";
/// Links of more points of a furnished room do not fit the memory in an exact map.
const MOST_POINTS_FURNISHED: u64 = 1_600_000;
const MAX_LEVEL: u8 = 9;
const LIMITS: Limits = Limits { threads: 0, memory_bytes: 4 << 30 };
/// The surfels up to which the furnished room's exponents are fitted.
const FITTED_SURFELS: u64 = 200_000;
/// Where the fit is told.
const TOLD_SURFELS: f64 = 350_000.0;

/// The light of a map: what there was and what it took. Seconds are of processors.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Grown {
    scene: String,
    preset: String,
    points: u64,
    surfels: u32,
    links: u64,
    /// To build the map.
    map_seconds: f64,
    order: u32,
    /// Pairs of surfels taken one by one and pairs of nodes taken by grids, each both ways.
    near_pairs: u64,
    far_pairs: u64,
    lists_bytes: u64,
    iterations: u32,
    applications: u64,
    /// To make the lists of the exchange, and to apply it once.
    lists_seconds: f64,
    application_seconds: f64,
    /// From the map to the light file: of processors, and by the clock.
    light_seconds: f64,
    light_wall_seconds: f64,
    /// The same with the scaling of that light, for another lamp.
    relight_seconds: f64,
    relight_wall_seconds: f64,
    peak_rss_anon_bytes: u64,
}

/// A figure whose growth is told.
type Figure = (&'static str, fn(&Grown) -> f64);

const FIGURES: [Figure; 4] = [
    ("lists", |row| row.lists_seconds),
    ("application", |row| row.application_seconds),
    ("light", |row| row.light_seconds),
    ("relight", |row| row.relight_seconds),
];

/// Lights rooms of so many points, prints a line each and the exponents, and writes the table.
///
/// # Errors
/// Where a map cannot be built or lit, or the table not be written.
pub(crate) fn run(output: &Path, points: &[u64]) -> Result<(), Box<dyn Error>> {
    let mut rows = Vec::new();
    println!("{}", head());
    for kind in [SceneKind::Empty, SceneKind::Furnished] {
        for &n_points in points {
            let folder = tempfile::tempdir()?;
            let octree = octree_of(kind, n_points, folder.path())?;
            for preset in ["depth8", "quick"] {
                let is_furnished = kind == SceneKind::Furnished;
                if preset == "depth8" && is_furnished && n_points > MOST_POINTS_FURNISHED {
                    continue;
                }
                let map = folder.path().join("s.vmap");
                let (config, _) = RawConfig::find(Path::new(preset))?.check()?;
                let config = BuildConfig { max_level: MAX_LEVEL, ..config };
                let (built, took) = timed(|| pvmap::build(&octree, &map, &config, &LIMITS, &Quiet));
                built?;
                let row = Grown {
                    scene: kind.name().to_owned(),
                    preset: preset.to_owned(),
                    map_seconds: took.processor_seconds,
                    ..in_a_process(&map)?
                };
                println!("{}", line(&row));
                rows.push(row);
                write(&output.join("scaling.csv"), &rows)?;
            }
        }
    }
    println!("\n{}", exponents(&rows));
    Ok(())
}

/// Writes rows: each is worth keeping should the next one fail.
fn write(path: &Path, rows: &[Grown]) -> Result<(), Box<dyn Error>> {
    let mut writer = csv::Writer::from_path(path)?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.flush()?)
}

/// Has one map lit by another process of this program.
fn in_a_process(map: &Path) -> Result<Grown, Box<dyn Error>> {
    let mut command = Command::new(std::env::current_exe()?);
    let output =
        command.arg(MEASURE).arg(map).args(std::env::args().filter(|a| a == BENCH)).output()?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into());
    }
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// Lights a map and prints what it took.
///
/// # Errors
/// Where the map cannot be lit.
pub(crate) fn measure_one(path: &Path) -> Result<(), Box<dyn Error>> {
    let [first, second] = ["light", "relight"].map(|name| path.with_extension(name));
    let light = |text: &str, output: &Path, scale_of: Option<&Path>| {
        let lights = path.with_extension("toml");
        std::fs::write(&lights, text)?;
        let request = LightRequest {
            map: path.to_owned(),
            octree: None,
            lights,
            output: Some(output.to_owned()),
            scale_of: scale_of.map(Path::to_owned),
            options: LightOptions::default(),
        };
        let report = pvmap::light_map(&request, &LIMITS, &Quiet)?;
        Ok::<LightDone, Box<dyn Error>>(report.done.ok_or("nothing was computed")?)
    };
    let (measured, peak_rss_anon_bytes) = peak_bytes_of(|| mean_of(|| light(LIGHTS, &first, None)));
    let (done, light_took) = measured?;
    let (_, relight_took) = mean_of(|| light(OTHER_LIGHTS, &second, Some(&first)))?;
    let bytes = Mapped::open(path)?;
    let map = MapView::open(&bytes)?;
    let order = done.summary.order as usize;
    let make = || {
        let (elements, hierarchy) = (Elements::of_map(&map)?, Hierarchy::of_map(&map)?);
        Exchange::multipole(elements, hierarchy, &map, Kernel::default(), order)
    };
    let (exchange, lists) = LIMITS.run(|| mean_of(make))??;
    let ones = vec![1.0; exchange.elements().len()];
    let (_, application) = LIMITS.run(|| mean_of(|| exchange.apply(&ones)))??;
    let stats = exchange.stats();
    let row = Grown {
        points: map.summary().n_points,
        surfels: map.summary().n_surfels,
        links: map.summary().n_links,
        order: done.summary.order,
        near_pairs: stats.n_near_pairs,
        far_pairs: stats.n_far as u64,
        lists_bytes: stats.held_bytes as u64,
        iterations: done.summary.iterations,
        applications: done.work.n_applications,
        lists_seconds: lists.processor_seconds,
        application_seconds: application.processor_seconds,
        light_seconds: light_took.processor_seconds,
        light_wall_seconds: light_took.wall_seconds,
        relight_seconds: relight_took.processor_seconds,
        relight_wall_seconds: relight_took.wall_seconds,
        peak_rss_anon_bytes,
        ..Grown::default()
    };
    println!("{}", serde_json::to_string(&row)?);
    Ok(())
}

fn head() -> String {
    format!(
        "{:<10}{:<8}{:>9}{:>8}{:>10}{:>7}{:>6}{:>8}{:>8}{:>8}{:>8}{:>9}{:>9}{:>9}{:>9}",
        "scene",
        "preset",
        "points",
        "surfels",
        "links",
        "map",
        "order",
        "applied",
        "lists",
        "apply",
        "light",
        "by clock",
        "relight",
        "by clock",
        "peak MiB"
    )
}

fn line(row: &Grown) -> String {
    format!(
        "{:<10}{:<8}{:>9}{:>8}{:>10}{:>7.2}{:>6}{:>8}{:>8.2}{:>8.3}{:>8.2}{:>9.2}{:>9.2}{:>9.2}\
         {:>9.1}",
        row.scene,
        row.preset,
        row.points,
        row.surfels,
        row.links,
        row.map_seconds,
        row.order,
        row.applications,
        row.lists_seconds,
        row.application_seconds,
        row.light_seconds,
        row.light_wall_seconds,
        row.relight_seconds,
        row.relight_wall_seconds,
        row.peak_rss_anon_bytes as f64 / f64::from(1 << 20)
    )
}

/// Tells with which powers of the surfels seconds grow, of rooms up to 200 000 surfels and of all,
/// and the seconds that the latter means at 350 000.
fn exponents(rows: &[Grown]) -> String {
    let mut lines = vec![format!(
        "{:<28}{:>14}{:>14}{:>18}",
        "seconds over surfels", "to 200 000", "all", "at 350 000, s"
    )];
    for scene in ["empty", "furnished"] {
        for preset in ["depth8", "quick"] {
            for (figure, of) in FIGURES {
                let fit = |most: u64| {
                    let here = rows.iter().filter(|row| {
                        (row.scene.as_str(), row.preset.as_str()) == (scene, preset)
                            && u64::from(row.surfels) <= most
                            && of(row) > 0.0
                    });
                    let points: Vec<_> =
                        here.map(|row| (f64::from(row.surfels), of(row))).collect();
                    Growth::fit(&points)
                };
                let tell = |growth: Option<Growth>, of: fn(&Growth) -> f64| {
                    growth.map_or("-".to_owned(), |growth| format!("{:.2}", of(&growth)))
                };
                let [few, all] = [FITTED_SURFELS, u64::MAX].map(fit);
                lines.push(format!(
                    "{:<28}{:>14}{:>14}{:>18}",
                    format!("{scene} {preset}: {figure}"),
                    tell(few, |growth| growth.exponent),
                    tell(all, |growth| growth.exponent),
                    tell(all, |growth| growth.at(TOLD_SURFELS))
                ));
            }
        }
    }
    lines.join("\n")
}
