//! What colour a surfel has, and with it the points that belong to it.

use pvmap_geometry::GridPoint;

use crate::color::{Rgb, VIOLET, gray, of_bin, of_normal, ramp, srgb};
use crate::error::RenderError;
use crate::source::{ColorBy, Values};

/// Says what is seen.
#[derive(Clone, Copy)]
pub enum Seen<'a> {
    /// Which surfels, by their ids; a point is seen where its surfel is.
    Surfels(&'a (dyn Fn(u32) -> bool + Sync)),
    /// Which points, by their places in the order of the octree; a surfel is not seen.
    Points(&'a (dyn Fn(u64) -> bool + Sync)),
}

/// Gives a surfel, or a point of a surfel with that surfel's id, the colour that light gives it.
pub type ColorOf<'a> = &'a (dyn Fn(u32, &Sample) -> Rgb + Sync);

/// Says of a surfel whether it mirrors or lets light through.
pub type IsGlossy<'a> = &'a (dyn Fn(u32) -> bool + Sync);

/// Colours surfels and points.
#[derive(Clone)]
pub struct Paint<'a> {
    color_by: ColorBy,
    seen: Option<Seen<'a>>,
    lighting: Option<ColorOf<'a>>,
    glossy: Option<IsGlossy<'a>>,
}

/// What is known of a surfel or a point.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// The surfel, or that of the point; none where no map says.
    pub surfel: Option<u32>,
    /// The point's place in the order of the octree; none for a surfel.
    pub point: Option<u64>,
    /// The point, or the surfel's centroid.
    pub place: GridPoint,
    /// In linear light; none where it was not recorded.
    pub scanned: Option<Rgb>,
    /// Of length 1, or zero.
    pub normal: [f32; 3],
    /// Of the normal, -1…6.
    pub bin: i8,
}

impl std::fmt::Debug for Paint<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Paint").field("color_by", &self.color_by).finish_non_exhaustive()
    }
}

impl<'a> Paint<'a> {
    /// Colours by something; what is `seen` is violet.
    pub fn new(color_by: ColorBy, seen: Option<Seen<'a>>) -> Paint<'a> {
        Paint { color_by, seen, lighting: None, glossy: None }
    }

    /// Shows light, whatever it coloured by; what is `seen` is violet still.
    pub fn lit(self, lighting: ColorOf<'a>) -> Paint<'a> {
        Paint { lighting: Some(lighting), ..self }
    }

    /// Marks what mirrors or lets light through, for [`crate::render_glossy`].
    pub fn glossy_where(self, glossy: IsGlossy<'a>) -> Paint<'a> {
        Paint { glossy: Some(glossy), ..self }
    }

    /// Gives the numbers that are coloured, if it is numbers.
    pub fn values(&self) -> Option<&Values> {
        match &self.color_by {
            ColorBy::Values(values) => Some(values),
            _ => None,
        }
    }

    /// Says whether a colour needs the surfel.
    pub(crate) fn needs_surfel(&self) -> bool {
        let asks_map = self.values().is_some() || self.lighting.is_some();
        asks_map || matches!(self.seen, Some(Seen::Surfels(_)))
    }

    /// Says whether colours are the scan's.
    pub(crate) fn is_of_scan(&self) -> bool {
        matches!(self.color_by, ColorBy::Rgb) && self.lighting.is_none()
    }

    /// Demands a number a surfel where numbers are coloured.
    pub(crate) fn check(&self, n_surfels: u32) -> Result<(), RenderError> {
        match self.values() {
            Some(values) if values.of.len() != n_surfels as usize => {
                Err(RenderError::Values { found: values.of.len(), expected: n_surfels })
            }
            _ => Ok(()),
        }
    }

    /// Gives a surfel back that mirrors or lets light through.
    pub(crate) fn glossy(&self, surfel: Option<u32>) -> Option<u32> {
        surfel.filter(|&id| self.glossy.is_some_and(|is_glossy| is_glossy(id)))
    }

    /// Gives the colour.
    pub(crate) fn color(&self, of: &Sample) -> Rgb {
        let is_seen = match self.seen {
            Some(Seen::Surfels(seen)) => of.surfel.is_some_and(seen),
            Some(Seen::Points(seen)) => of.point.is_some_and(seen),
            None => false,
        };
        if is_seen {
            return srgb(VIOLET);
        }
        if let (Some(lighting), Some(surfel)) = (self.lighting, of.surfel) {
            return lighting(surfel, of);
        }
        let share = |values: &Values| values.share(of.surfel? as usize);
        match &self.color_by {
            ColorBy::Rgb => of.scanned.unwrap_or_else(gray),
            ColorBy::Normal => of_normal(of.normal),
            ColorBy::Bin => of_bin(of.bin),
            ColorBy::Values(values) => share(values).map_or_else(gray, ramp),
        }
    }
}
