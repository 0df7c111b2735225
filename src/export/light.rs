//! What a light file says of points.

use std::path::{Path, PathBuf};

use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Frame, GridPoint, PointBatch, Positions};
use pvmap_render::{Rgb, encode, encode_wide, linear};
use pvmap_store::{Mapped, Watch};
use pvmap_vmap::{FormatError, LightView, MapView, OctreeView, Source};
use rayon::prelude::*;

use super::ExportRequest;
use super::fields::PointField;
use super::lattice::world;
use super::output::Kind;
use crate::Error;
use crate::lit::{Exposure, LitMap, require_light};

/// The light of a map that an export shows.
#[derive(Debug, Clone)]
pub struct ExportLight {
    /// The light file.
    pub file: PathBuf,
    /// What radiosity is multiplied with where it becomes the colour of points.
    pub exposure: Exposure,
}

/// Light that is ready to be asked about points.
pub(super) struct PointLight {
    /// Where a field needs it.
    lit: Option<LitMap>,
    /// The open sky above each surfel, where a field needs it.
    sky: Vec<f32>,
    exposure: f64,
    is_grey: bool,
    frame: Frame,
    sources: Vec<Source>,
}

impl PointLight {
    /// Reads what fields need of a light file.
    ///
    /// # Errors
    /// Where fields need one and there is none, or the other way round, it is of another map, has
    /// no open sky where a field wants it, or is damaged.
    pub(super) fn of(
        light: Option<&ExportLight>,
        fields: &[PointField],
        (map_path, map): (&Path, &MapView<'_>),
        octree: &OctreeView<'_>,
    ) -> Result<Option<PointLight>, Error> {
        let wanting = fields.iter().find(|field| field.is_of_light());
        let refuse = |message: String| Err(Error::Usage(message));
        let (light, path) = match (light, wanting) {
            (None, None) => return Ok(None),
            (None, Some(field)) => return Err(PointLight::lacks(field)),
            (Some(_), None) => {
                return refuse(
                    "--light goes with --field radiosity, irradiance or sky-view".into(),
                );
            }
            (Some(light), Some(_)) => (light, &light.file),
        };
        let bytes = Mapped::open(path)?;
        let view = LightView::open(&bytes).map_err(|e| Error::artifact(path, e))?;
        require_light((path, &view), (map_path, map))?;
        let lit = match fields.iter().any(|f| f.needs_places()) {
            true => Some(LitMap::read((path, &view), (map_path, map))?),
            false => None,
        };
        let exposure = match &lit {
            Some(lit) if fields.contains(&PointField::Radiosity) => lit.exposure(light.exposure),
            _ => 1.0,
        };
        let sky = match fields.contains(&PointField::SkyView) {
            true => sky_of(path, &view)?,
            false => Vec::new(),
        };
        let (frame, sources) = (octree.frame().frame, octree.sources().to_vec());
        let is_grey = view.summary().n_channels == 1;
        Ok(Some(PointLight { lit, sky, exposure, is_grey, frame, sources }))
    }

    /// Says an exposure that was chosen, so that it can be given again.
    pub(super) fn tell(&self, request: &ExportRequest, watch: &dyn Watch) {
        let is_auto = request.light.as_ref().is_some_and(|light| light.exposure == Exposure::Auto);
        if is_auto && request.fields.contains(&PointField::Radiosity) {
            watch.note(&format!("exposed so: --exposure {}", self.exposure));
        }
    }

    /// Says that a field needs a light file.
    pub(super) fn lacks(field: &PointField) -> Error {
        let name = field.word();
        Error::Usage(format!("--field {name} needs a light file: give --light NAME.light"))
    }

    /// Gives the bytes that fields hold in memory.
    pub(super) fn held_bytes(fields: &[PointField], n_surfels: u32) -> u64 {
        let lit = fields.iter().any(|f| f.needs_places());
        let sky = fields.contains(&PointField::SkyView);
        let of_sky = u64::from(n_surfels) * size_of::<f32>() as u64;
        u64::from(lit) * LitMap::held_bytes(n_surfels) + u64::from(sky) * of_sky
    }

    /// Says whether all light has one colour.
    pub(super) fn is_grey(&self) -> bool {
        self.is_grey
    }

    /// Gives the share of open sky above each surfel.
    pub(super) fn sky(&self) -> &[f32] {
        &self.sky
    }

    /// Gives the irradiance of points.
    pub(super) fn irradiance(&self, points: &LitPoints<'_>) -> Vec<[f64; 3]> {
        self.each(points, |lit, place, normal, surfel, _| lit.irradiance(place, normal, surfel))
    }

    /// Gives the radiosity of points.
    pub(super) fn radiosity(&self, points: &LitPoints<'_>) -> Vec<[f64; 3]> {
        self.each(points, |lit, place, normal, surfel, color| {
            lit.radiosity(place, normal, surfel, color)
        })
    }

    fn each(
        &self,
        points: &LitPoints<'_>,
        light: impl Fn(&LitMap, GridPoint, [f32; 3], u32, Option<Rgb>) -> [f64; 3] + Sync,
    ) -> Vec<[f64; 3]> {
        let LitPoints { batch, surfels, normals } = *points;
        let Some(lit) = &self.lit else { return vec![[0.0; 3]; batch.len()] };
        let places = self.places(batch);
        let depth = self.sources.get(batch.source as usize).map_or(0, |s| s.color_depth);
        let colors = batch.color.as_ref().filter(|_| depth > 0);
        let one = |i: usize| {
            let color = colors.map(|colors| match depth {
                8 => linear(colors[i].map(|v| v.min(255) * 257)),
                _ => linear(colors[i]),
            });
            light(
                lit,
                places[i],
                super::fields::unit(&normals[i]).map(|v| v as f32),
                surfels[i],
                color,
            )
        };
        (0..batch.len()).into_par_iter().map(one).collect()
    }

    /// Gives the places of points on the grid, as [D-1] has them.
    fn places(&self, batch: &PointBatch) -> Vec<GridPoint> {
        // A batch has points of one source, which there is.
        let source = &self.sources[batch.source as usize];
        let of_world = |x: &[f64; 3]| self.frame.grid_of_world(*x);
        match (&self.frame, &batch.positions) {
            (Frame::Lattice { .. }, Positions::Lattice(steps)) => {
                let common =
                    |x: &[i32; 3], i: usize| i64::from(x[i]).saturating_add(source.shift[i]);
                let grid =
                    |x: &[i32; 3]| self.frame.grid_of_lattice([0, 1, 2].map(|i| common(x, i)));
                steps.iter().map(grid).collect()
            }
            (_, Positions::Lattice(steps)) => {
                world(steps, source.scale, source.offset).iter().map(of_world).collect()
            }
            (_, Positions::Single(places)) => {
                places.iter().map(|x| of_world(&x.map(f64::from))).collect()
            }
            (_, Positions::Double(places)) => places.iter().map(of_world).collect(),
        }
    }

    /// Gives the columns of light.
    pub(super) fn columns(&self, light: &[[f64; 3]]) -> impl Iterator<Item = Vec<f64>> {
        let n = if self.is_grey { 1 } else { 3 };
        (0..n).map(|channel| light.iter().map(|v| v[channel]).collect())
    }

    /// Gives the colours of a file for radiosity in columns.
    pub(super) fn colors(&self, columns: &[Vec<f64>], kind: Kind) -> Vec<[u16; 3]> {
        let channel = |i: usize| &columns[if self.is_grey { 0 } else { i }];
        let [red, green, blue] = [channel(0), channel(1), channel(2)];
        let shown = |b: f64| (b * self.exposure).min(1.0) as f32;
        let colors = (0..red.len()).map(|i| [red[i], green[i], blue[i]].map(shown));
        match kind {
            Kind::Ply => colors.map(|c| encode(c).map(u16::from)).collect(),
            Kind::Las | Kind::Laz => colors.map(encode_wide).collect(),
        }
    }
}

/// Points of one source, with what the octree and the map say of them.
#[derive(Clone, Copy)]
pub(super) struct LitPoints<'a> {
    pub(super) batch: &'a PointBatch,
    pub(super) surfels: &'a [u32],
    pub(super) normals: &'a [Normal],
}

/// Reads the open sky of all surfels.
fn sky_of(path: &Path, view: &LightView<'_>) -> Result<Vec<f32>, Error> {
    if !view.has_sky() {
        return Err(Error::Data(format!(
            "{}: has no open sky, which its scene did not call for; pvmap light … --force sky \
             computes it",
            path.display()
        )));
    }
    let share = |surfel| Ok(view.sky(surfel)?.unwrap_or_default());
    let shares: Result<_, FormatError> = (0..view.summary().n_surfels).map(share).collect();
    shares.map_err(|e| Error::artifact(path, e))
}
