//! The light of a light file as colours of a picture.

use std::path::{Path, PathBuf};

use pvmap::query::Map;
use pvmap::render::{Camera, Glossy, Picture, Rgb, Sample, held_bytes, held_bytes_glossy};
use pvmap::vmap::{LightView, MapView};
use pvmap::{Error, Exposure, Gaze, LitMap, Mapped, Mirrors, Watch, left_out, memory};

use super::Args;
use crate::cli::Context;

/// Pixels whose rays are held at once.
const PIXELS_AT_ONCE: usize = 1 << 16;

/// Light, and how much of it is white.
pub(super) struct Light {
    path: PathBuf,
    bytes: Mapped,
    lit: LitMap,
    exposure: f64,
}

/// Reads the light that was asked for.
pub(super) fn of(args: &Args, map: &MapView<'_>, map_path: &Path) -> Result<Option<Light>, Error> {
    let Some(path) = &args.light else { return Ok(None) };
    let bytes = Mapped::open(path)?;
    let view = LightView::open(&bytes).map_err(|e| Error::artifact(path, e))?;
    let what = "the picture (--size) and the light of the map";
    memory::require(what, held_bytes(args.size) + lit_bytes(map, false), args.memory)?;
    let lit = LitMap::read((path, &view), (map_path, map))?;
    let exposure = lit.exposure(args.exposure);
    Ok(Some(Light { path: path.clone(), bytes, lit, exposure }))
}

/// Gives the bytes that the light of a map holds, and its mirrors if it has some.
pub(super) fn lit_bytes(map: &MapView<'_>, has_mirrors: bool) -> u64 {
    let mirrors = if has_mirrors { Mirrors::held_bytes(map.summary()) } else { 0 };
    LitMap::held_bytes(map.summary().n_surfels) + mirrors
}

impl Light {
    /// Gives what colours splats.
    pub(super) fn lighting(&self) -> impl Fn(u32, &Sample) -> Rgb + Sync {
        move |surfel, of| {
            let radiosity = match of.point {
                Some(_) => self.lit.radiosity(of.place, of.normal, surfel, of.scanned),
                None => self.lit.of_surfel(surfel),
            };
            radiosity.map(|b| (b * self.exposure).min(1.0) as f32)
        }
    }

    /// Reads what mirrors and lets light through, unless that is not wanted; none where nothing
    /// does.
    pub(super) fn mirrors<'a>(
        &'a self,
        args: &Args,
        map: &'a Map<'a>,
        context: &Context,
    ) -> Result<Option<Mirrors<'a>>, Error> {
        let view = LightView::open(&self.bytes).map_err(|e| Error::artifact(&self.path, e))?;
        if args.no_mirrors || !view.has_gloss() {
            return Ok(None);
        }
        for effect in left_out((&self.path, &view))? {
            let (name, path) = (effect.name(), self.path.display());
            context.progress.note(&format!("{path} was planned without {name}: so is the picture"));
        }
        let what = "the picture with its mirrors (--size) and the light of the map";
        let need_bytes = held_bytes_glossy(args.size) + lit_bytes(map.view(), true);
        memory::require(what, need_bytes, args.memory)?;
        Mirrors::read((&self.path, &view), &self.lit, map)
    }

    /// Adds to a picture what is seen in mirrors and through lenses.
    pub(super) fn look(
        &self,
        (map_path, mirrors): (&Path, &Mirrors<'_>),
        camera: &Camera,
        (mut picture, glossy): (Picture, Vec<Glossy>),
        context: &Context,
    ) -> Result<Picture, Error> {
        let watch = &context.progress;
        watch.stage("mirrors", Some(glossy.len() as u64), "pixels");
        let mut n_rays = 0;
        for some in glossy.chunks(PIXELS_AT_ONCE) {
            let gazes = some.iter().map(|at| {
                let (place, direction) = camera.ray(at.pixel, at.depth);
                Gaze { surfel: at.surfel, place, direction }
            });
            let seen = mirrors.look(map_path, &gazes.collect::<Vec<Gaze>>(), watch)?;
            for (at, seen) in some.iter().zip(seen) {
                let times = f64::from(at.share) * self.exposure;
                picture.add_light(at.pixel, seen.light.map(|b| (b * times) as f32));
                n_rays += seen.n_rays;
            }
        }
        watch.take_stages();
        watch.note(&format!("mirrors: {} pixels, {n_rays} rays", glossy.len()));
        Ok(picture)
    }

    /// Says an exposure that was chosen, so that it can be given again.
    pub(super) fn tell(&self, args: &Args, context: &Context) {
        if args.exposure == Exposure::Auto {
            context.progress.note(&format!("exposed so: --exposure {}", self.exposure));
        }
    }
}
