//! What is seen in mirrors and through lenses, by the light of a light file: rays from the pixels
//! of a picture to what scatters light, and the light there.

use std::f64::consts::PI;
use std::path::Path;

use pvmap_geometry::GridPoint;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_light::{Effect, Elements, Glimpse, Glimpses, Gloss, LightError, Plan, SeenAt, Sky};
use pvmap_query::Map;
use pvmap_store::{StoreError, Watch};
use pvmap_vmap::{LightView, MapSummary};
use rayon::prelude::*;

use crate::Error;
use crate::light_map::of_light;
use crate::lights::Lights;
use crate::lit::LitMap;

/// Rays from the eye that are followed between two looks at whether to stop.
const GAZES_AT_ONCE: usize = 256;

/// What mirrors and what lets light through, and the light of all else.
#[derive(Debug)]
pub struct Mirrors<'a> {
    map: &'a Map<'a>,
    lit: &'a LitMap,
    glimpses: Glimpses<'a>,
    sky: Option<Sky>,
}

/// A look at a glossy surfel, in world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// The surfel.
    pub surfel: u32,
    /// Where on it.
    pub place: [f64; 3],
    /// From the eye, of any length.
    pub direction: [f64; 3],
}

/// Lists what pictures of a light leave out because its plan did, though surfels mirror or let
/// light through: these, and a sky that shines. A file that does not say leaves out nothing.
///
/// # Errors
/// Where it, at this path, is damaged.
pub fn left_out((path, light): (&Path, &LightView<'_>)) -> Result<Vec<Effect>, Error> {
    if !light.has_gloss() {
        return Ok(Vec::new());
    }
    let damaged = |e| Error::artifact(path, e);
    let plan = light.plan().map_err(damaged)?;
    let mut left_out = Vec::new();
    for effect in [Effect::MirrorView, Effect::Refraction] {
        let share = |gloss: Gloss| match effect {
            Effect::MirrorView => gloss.specular,
            _ => gloss.transmissive,
        };
        let mut ids = 0..light.summary().n_surfels;
        let is_some = |id| Ok(light.gloss(id)?.is_some_and(|gloss| share(gloss) > 0.0));
        let is_off = Plan::said_of(plan, effect) == Some(false);
        if is_off && ids.try_fold(false, |any, id| Ok(any || is_some(id)?)).map_err(damaged)? {
            left_out.push(effect);
        }
    }
    let shines = |sky: &Sky| sky.radiance.iter().any(|&l| l > 0.0);
    let is_off = Plan::said_of(plan, Effect::Sky) == Some(false);
    if is_off && sky_of((path, light))?.is_some_and(|sky| shines(&sky)) {
        left_out.push(Effect::Sky);
    }
    Ok(left_out)
}

/// Reads the sky that a light was made with.
fn sky_of((path, light): (&Path, &LightView<'_>)) -> Result<Option<Sky>, Error> {
    Ok(Lights::parse(light.lights().map_err(|e| Error::artifact(path, e))?)?.sky())
}

impl<'a> Mirrors<'a> {
    /// Reads what surfels mirror and let through; none where nothing of the scan does, or its plan
    /// left both out. The map is that of the light, and [`Map::solid`].
    ///
    /// # Errors
    /// Where a file is damaged.
    pub fn read(
        (path, light): (&Path, &LightView<'_>),
        lit: &'a LitMap,
        map: &'a Map<'a>,
    ) -> Result<Option<Mirrors<'a>>, Error> {
        if !light.has_gloss() {
            return Ok(None);
        }
        let damaged = |e| Error::artifact(path, e);
        let left_out = left_out((path, light))?;
        let is_out = |effect| left_out.contains(&effect);
        let as_planned = |gloss: Gloss| Gloss {
            specular: if is_out(Effect::MirrorView) { 0.0 } else { gloss.specular },
            transmissive: if is_out(Effect::Refraction) { 0.0 } else { gloss.transmissive },
            ..gloss
        };
        let gloss = (0..light.summary().n_surfels)
            .map(|id| Ok(as_planned(light.gloss(id)?.unwrap_or_default())))
            .collect::<Result<Vec<_>, _>>()
            .map_err(damaged)?;
        if !gloss.iter().any(Gloss::is_any) {
            return Ok(None);
        }
        let fail = |e| of_light(path, e);
        let elements = Elements::with_areas(map.view(), &lit.areas()).map_err(fail)?;
        let glimpses = Glimpses::new(map, elements, gloss).map_err(fail)?;
        let sky = sky_of((path, light))?.filter(|_| !is_out(Effect::Sky));
        Ok(Some(Mirrors { map, lit, glimpses, sky }))
    }

    /// Gives the bytes that the mirrors of such a map hold in memory, about.
    pub fn held_bytes(summary: &MapSummary) -> u64 {
        Glimpses::held_bytes(summary.n_surfels, summary.n_nodes)
    }

    /// Says whether a surfel mirrors or lets light through.
    pub fn is_glossy(&self, surfel: u32) -> bool {
        self.glimpses.is_glossy(surfel)
    }

    /// Gives what is seen by each look, in their order: radiosity times its share, and the rays it
    /// took. The same for any number of threads; `watch` is told of each look.
    ///
    /// # Errors
    /// Where the map, at this path, is damaged, or the run is asked to stop.
    pub fn look(
        &self,
        map_path: &Path,
        gazes: &[Gaze],
        watch: &dyn Watch,
    ) -> Result<Vec<Glimpse>, Error> {
        let some = |gazes: &[Gaze]| {
            if watch.is_stopped() {
                return Err(StoreError::Interrupted.into());
            }
            let seen = gazes.iter().map(|gaze| self.look_once(gaze)).collect::<Result<Vec<_>, _>>();
            watch.advance(gazes.len() as u64);
            seen.map_err(|e| of_light(map_path, e))
        };
        let all = gazes.par_chunks(GAZES_AT_ONCE).map(some).collect::<Result<Vec<_>, Error>>()?;
        Ok(all.into_iter().flatten().collect())
    }

    fn look_once(&self, gaze: &Gaze) -> Result<Glimpse, LightError> {
        let radiosity = |at: &SeenAt| {
            let normal = at.normal.map(|v| v as f32);
            self.lit.radiosity(self.grid_of(at.place), normal, at.surfel, None)
        };
        let sky = |direction: [f64; 3]| {
            let Some(Sky { radiance, up }) = self.sky else { return [0.0; 3] };
            let height: f64 = (0..3).map(|i| direction[i] * up[i]).sum();
            radiance.map(|l| if height > 0.0 { PI * l } else { 0.0 })
        };
        self.glimpses.look((gaze.surfel, gaze.place, gaze.direction), &radiosity, &sky)
    }

    fn grid_of(&self, place: [f64; 3]) -> GridPoint {
        let steps = self.map.view().frame().frame.steps_of_query(place);
        // `as` brings what is below the grid to 0.
        steps.map(|v| (v as u32).min(GRID_MAX))
    }
}
