//! The light of a light file as colours of a picture.

use std::path::Path;

use pvmap::render::{Rgb, Sample};
use pvmap::vmap::{LightView, MapView};
use pvmap::{Error, Exposure, LitMap, Mapped, Watch};

use super::Args;
use crate::cli::Context;

/// Light, and how much of it is white.
pub(super) struct Light {
    lit: LitMap,
    exposure: f64,
}

/// Reads the light that was asked for.
pub(super) fn of(args: &Args, map: &MapView<'_>, map_path: &Path) -> Result<Option<Light>, Error> {
    let Some(path) = &args.light else { return Ok(None) };
    let bytes = Mapped::open(path)?;
    let view = LightView::open(&bytes).map_err(|e| Error::artifact(path, e))?;
    let lit = LitMap::read((path, &view), (map_path, map))?;
    let exposure = lit.exposure(args.exposure, map).map_err(|e| Error::artifact(map_path, e))?;
    Ok(Some(Light { lit, exposure }))
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

    /// Says an exposure that was chosen, so that it can be given again.
    pub(super) fn tell(&self, args: &Args, context: &Context) {
        if args.exposure == Exposure::Auto {
            context.progress.note(&format!("exposed so: --exposure {}", self.exposure));
        }
    }
}
