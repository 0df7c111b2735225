//! From a map and what shines to its light file: joins the lights of `lights.toml` to the room
//! `light`.

use std::path::{Path, PathBuf};

use pvmap_light::{
    Elements, Gloss, Lamp, LightError, LightOptions, Lighting, Lit, MAX_ROUNDS, Plan, Scaling,
    Work, areas_grid2,
};
use pvmap_query::Map;
use pvmap_store::output::folder_of;
use pvmap_store::{Mapped, StoreError, Watch};
use pvmap_vmap::light::Factors;
use pvmap_vmap::{FormatError, LightSummary, LightView, MapView};

use crate::build::open_octree;
use crate::figures::in_digits;
use crate::light_file::check_output;
use crate::lights::{Assigned, Glowing, Lights, majority_classes};
use crate::{Error, LightChannel, LightContent, Limits, require_light, write_light};

/// What is to be lit, and where its light goes.
#[derive(Debug, Clone)]
pub struct LightRequest {
    /// The map.
    pub map: PathBuf,
    /// The octree it was built from: rules by class look at its points.
    pub octree: Option<PathBuf>,
    /// What shines and what reflects.
    pub lights: PathBuf,
    /// The light file to make; none stops at the plan.
    pub output: Option<PathBuf>,
    /// A light file of the same map whose scaling is taken over.
    pub scale_of: Option<PathBuf>,
    /// How well.
    pub options: LightOptions,
}

/// What was planned and done.
#[derive(Debug, Clone)]
pub struct LightReport {
    /// The decisions.
    pub plan: Plan,
    /// What glows were found to be, in their order.
    pub glows: Vec<Glowing>,
    /// What was noticed in the lights.
    pub notes: Vec<String>,
    /// What was noticed in the map.
    pub map_notes: Vec<String>,
    /// What was noticed once they shone.
    pub notes_after: Vec<String>,
    /// Surfels.
    pub n_surfels: u32,
    /// Surfels without a normal, which take no part.
    pub n_without_normal: usize,
    /// What was computed, unless it stopped at the plan.
    pub done: Option<LightDone>,
}

/// What was computed.
#[derive(Debug, Clone)]
pub struct LightDone {
    /// As it stands in the file.
    pub summary: LightSummary,
    /// The share of light that a bounce leaves at the most; 0 where nothing is reflected.
    pub reflected: f64,
    /// What was touched.
    pub work: Work,
    /// Bytes of the file.
    pub output_bytes: u64,
}

/// Lights a map and writes the light of every surfel. The same map and lights give the same bytes
/// for any number of threads.
///
/// # Errors
/// Where the map or the lights cannot be read, do not fit each other or the memory, the light has
/// no finite solution, the file cannot be written or the run is asked to stop.
pub fn light_map(
    request: &LightRequest,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<LightReport, Error> {
    light_map_telling(request, limits, &|_| {}, watch)
}

/// Does the same, and tells the plan before anything is solved.
///
/// # Errors
/// Those of [`light_map`].
pub fn light_map_telling(
    request: &LightRequest,
    limits: &Limits,
    tell: &(dyn Fn(&LightReport) + Sync),
    watch: &dyn Watch,
) -> Result<LightReport, Error> {
    limits.run(|| run(request, limits, tell, watch))?
}

fn run(
    request: &LightRequest,
    limits: &Limits,
    tell: &(dyn Fn(&LightReport) + Sync),
    watch: &dyn Watch,
) -> Result<LightReport, Error> {
    // Before anything that takes time: can it be written?
    request.output.as_deref().map_or(Ok(()), check_output)?;
    let lights = Lights::read(&request.lights)?;
    let bytes = Mapped::open(&request.map)?;
    let map = Map::open(&bytes).map_err(|e| Error::of_query(&request.map, e))?.solid();
    let fail = |e| of_light(&request.map, e);
    watch.stage("areas", None, "surfels");
    let (areas, scaling) = match &request.scale_of {
        Some(path) => {
            let (areas, scaling) = factors_of(path, request, map.view())?;
            (areas, Some(scaling))
        }
        None => (areas_grid2(map.view()).map_err(|e| fail(e.into()))?, None),
    };
    let elements = Elements::with_areas(map.view(), &areas).map_err(fail)?;
    let n_without_normal = elements.n_without_normal();
    let classes = classes_of(request, &lights, map.view(), watch)?;
    let Assigned { materials, lamps, sky, glows, notes } =
        lights.assign(map.view(), &elements, classes.as_deref())?;
    let map_notes = note_of_sides(&elements).into_iter().collect();
    let gloss = materials.gloss.clone();
    let given = lamps.clone();
    let beside = request.output.as_deref().map(|output| folder_of(output).to_path_buf());
    let options = LightOptions {
        memory_bytes: limits.memory_bytes,
        spill_folder: Some(beside.unwrap_or_else(std::env::temp_dir)),
        ..request.options.clone()
    };
    let scene = Lighting::new(&map, elements, materials, lamps, sky, options).map_err(fail)?;
    let planned = scene.plan(watch).map_err(fail)?;
    let n_surfels = map.view().summary().n_surfels;
    let mut notes = notes;
    notes.extend(note_of_spacing(map.view()).map_err(|e| Error::artifact(&request.map, e))?);
    let mut report = LightReport {
        plan: planned.plan.clone(),
        glows,
        notes,
        map_notes,
        notes_after: Vec::new(),
        n_surfels,
        n_without_normal,
        done: None,
    };
    tell(&report);
    if let Some(output) = &request.output {
        let lit = scene.run(&planned, scaling, watch).map_err(fail)?;
        let text = (lights.to_text(), planned.plan.to_string());
        let made = (&lit, &gloss[..], &areas[..]);
        report.notes_after.extend(note_of_flux(&given, lit.from_lamps));
        report.notes_after.extend(note_of_rows(&lit, scene.row_tolerance()));
        report.notes_after.extend(note_of_gloss(lit.left_to_throw));
        report.done = Some(write(output, &text, (request, map.view(), &lights), made, watch)?);
    }
    Ok(report)
}

/// Gives the classes of surfels, where a rule asks for them.
fn classes_of(
    request: &LightRequest,
    lights: &Lights,
    map: &MapView<'_>,
    watch: &dyn Watch,
) -> Result<Option<Vec<u8>>, Error> {
    if !lights.needs_classes() {
        return Ok(None);
    }
    let Some(path) = &request.octree else { return Err(lights.without_classes()) };
    let bytes = open_octree(path)?;
    majority_classes(map, &request.map, &bytes, path, watch).map(Some)
}

/// Reads the areas and the scaling of a light file of the same map.
fn factors_of(
    path: &Path,
    request: &LightRequest,
    map: &MapView<'_>,
) -> Result<(Vec<f64>, Scaling), Error> {
    let bytes = Mapped::open(path)?;
    let damaged = |e| Error::artifact(path, e);
    let view = LightView::open(&bytes).map_err(damaged)?;
    require_light((path, &view), (&request.map, map))?;
    let row = |id| view.factors(id).map(|factors| (factors.area, factors.scale));
    let rows = (0..view.summary().n_surfels).map(row).collect::<Result<_, _>>();
    let (areas, scale): (Vec<f64>, Vec<f64>) = rows.map_err(damaged)?;
    let LightSummary { row_error, error_target, .. } = *view.summary();
    Ok((areas, Scaling { scale, row_error, error: error_target }))
}

/// The share of the area that may have no known side, untold.
const UNTOLD_SIDES: f64 = 0.1;

/// Says of how much of the scan it is not known which side was seen, where that is much.
fn note_of_sides(elements: &Elements) -> Option<String> {
    let all = || (0..elements.len()).map(|i| elements.get(i)).filter(|e| e.normal != [0.0; 3]);
    let (n, whole) = (all().count(), all().map(|e| e.area).sum::<f64>());
    let unknown = || all().filter(|e| e.two_sided);
    let share = unknown().map(|e| e.area).sum::<f64>() / whole;
    let n_unknown = unknown().count();
    (share > UNTOLD_SIDES).then(|| {
        format!(
            "{n_unknown} of {n} surfels, {:.0} % of the area, have no known side: light comes and \
             goes on both, and a closed room may count as open; pvmap ingest --sensor x,y,z \
             (where the scanner stood) or --up tells it",
            100.0 * share
        )
    })
}

/// The share of the flux of lamps that may go elsewhere, or come from nowhere, untold.
const UNTOLD: f64 = 0.05;

/// The share of points whose surfels may not know their spacing, untold.
const UNSPACED: f64 = 0.1;

/// Says how many surfels have patches without extent, where these are many.
fn note_of_spacing(map: &MapView<'_>) -> Result<Option<String>, FormatError> {
    let (mut n_surfels, mut n_points) = (0u32, 0);
    for id in 0..map.summary().n_surfels {
        let surfel = map.surfel(id)?;
        if surfel.half_spacing <= 1 {
            (n_surfels, n_points) = (n_surfels + 1, n_points + surfel.n_points);
        }
    }
    let is_told = n_points as f64 > UNSPACED * map.summary().n_points as f64;
    Ok(is_told.then(|| {
        format!(
            "{n_surfels} of {} surfels have too few points to tell how far these are apart: light \
             passes between them; build with a larger --leaf-capacity or --spacing neighbors",
            map.summary().n_surfels
        )
    }))
}

/// Says by how much rows are off, unless that is what the error that was asked for leaves them.
fn note_of_rows(lit: &Lit, tolerance: f64) -> Option<String> {
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    (lit.row_error > tolerance).then(|| {
        format!(
            "rows of the exchange are off by {} of it, the error asked for leaves them {}: light \
             may be as much darker with every bounce, most of all in narrow corners",
            percent(lit.row_error),
            percent(tolerance)
        )
    })
}

/// Says how much of the light of lamps arrives, unless that is about all.
fn note_of_flux(lamps: &[Lamp], arrives: [f64; 3]) -> Option<String> {
    let total = |flux: [f64; 3]| flux.iter().sum::<f64>();
    let shines = lamps.iter().any(|lamp| total(lamp.color()) > 0.0);
    let given = lamps.iter().map(Lamp::flux).collect::<Option<Vec<_>>>();
    let Some(given) = given else {
        // Nobody knows how much the sun gives.
        let is_dark = shines && total(arrives) == 0.0;
        return is_dark.then(|| "nothing of the light of sun and lamps arrives".to_owned());
    };
    let given: [f64; 3] = [0, 1, 2].map(|c| given.iter().map(|flux| flux[c]).sum());
    let (given_all, arrives_all) = (total(given), total(arrives));
    // Of a cone of next to no angle nothing may be left.
    let share = if given_all > 0.0 { arrives_all / given_all } else { 1.0 };
    if !shines || (share - 1.0).abs() <= UNTOLD {
        return None;
    }
    let told = |flux: [f64; 3]| match flux.map(|v| in_digits(v, 6)) {
        [r, g, b] if r == g && g == b => r,
        [r, g, b] => format!("[{r}, {g}, {b}]"),
    };
    let why = match share {
        0.0 => "; is it inside a wall, or turned away?",
        more if more > 1.0 => ": surfels in it are not small beside its cone or its distance",
        _ => "",
    };
    let (given, arrives) = (told(given), told(arrives));
    Some(format!("lamps give {given}, {arrives} arrives ({:.0} %){why}", 100.0 * share))
}

/// Says what mirrors and lenses did not send on any more, if it went on for too long.
fn note_of_gloss(left: f64) -> Option<String> {
    (left > 0.0).then(|| {
        format!(
            "light goes by way of mirrors and glass, is reflected and goes there again: after \
             {MAX_ROUNDS} rounds {:.2} % of all that shines is on its way there, and left out",
            100.0 * left
        )
    })
}

fn write(
    output: &Path,
    (lights_text, plan_text): &(String, String),
    (request, map, lights): (&LightRequest, &MapView<'_>, &Lights),
    (lit, gloss, areas): (&Lit, &[Gloss], &[f64]),
    watch: &dyn Watch,
) -> Result<LightDone, Error> {
    let mut summary = LightSummary {
        map: map.file().root(),
        n_surfels: map.summary().n_surfels,
        n_channels: lit.channels.len() as u32,
        order: lit.order.unwrap_or(0) as u32,
        iterations: lit.iterations as u32,
        error_target: request.options.error,
        operator_error: lit.operator_error,
        row_error: lit.row_error,
        residual: lit.residual,
        exposure: lights.exposure(),
        balance: Default::default(),
    };
    for (to, channel) in summary.balance.iter_mut().zip(&lit.channels) {
        let from = &channel.balance;
        *to = [from.emitted, from.absorbed, from.escaped, from.clipped];
    }
    let channel = |index: usize| {
        let channel = &lit.channels[index];
        LightChannel {
            emission: &channel.given.emission,
            albedo: &channel.given.albedo,
            irradiance: &channel.irradiance,
        }
    };
    let channels: Vec<LightChannel<'_>> = (0..lit.channels.len()).map(channel).collect();
    let sky: Vec<f64> = lit.open_sky.iter().map(|&share| f64::from(share)).collect();
    let factor = |(&area, &scale): (&f64, &f64)| Factors { area, scale };
    let factors: Vec<Factors> = areas.iter().zip(&lit.scale).map(factor).collect();
    let content = LightContent {
        summary,
        lights: lights_text,
        plan: plan_text,
        channels: &channels,
        gloss: (!gloss.is_empty()).then_some(gloss),
        sky: (!sky.is_empty()).then_some(&sky[..]),
        factors: &factors,
    };
    let output_bytes = write_light(output, &content, watch)?;
    Ok(LightDone { summary, reflected: lit.reflected, work: lit.work, output_bytes })
}

/// Says which map an error is about, where the map is to blame.
pub(crate) fn of_light(map: &Path, e: LightError) -> Error {
    match e {
        LightError::Format(e) => Error::artifact(map, e),
        LightError::Query(e) => Error::of_query(map, e),
        LightError::Store(e) => e.into(),
        LightError::Stopped => StoreError::Interrupted.into(),
        e @ LightError::Memory { .. } => Error::Config(e.to_string()),
        e => Error::Data(format!("{}: {e}", map.display())),
    }
}
