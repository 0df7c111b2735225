//! The surfels of a map as splats.
//!
//! A surfel is drawn as the piece of its plane in its patch box. Its disc would not do: it reaches
//! to the farthest point, which leaves the corners of a square patch bare and hangs over wherever
//! the patch is long and thin, as along an edge.

use std::ops::Range;

use pvmap_geometry::normal::{NORMAL_LENGTH, Normal, dominant_axis};
use pvmap_vmap::{MapView, Surfel};

use crate::color::{VIOLET, gray, of_bin, of_normal, ramp, srgb};
use crate::error::RenderError;
use crate::source::{ColorBy, Shape, Source, Splat};

/// Half spacings by which a patch is drawn larger on every side: points that lie at random leave
/// gaps of more than their mean spacing between the boxes of two leaves.
const OVERLAP: f32 = 1.0;

/// The surfels of a map.
pub struct MapSplats<'a> {
    view: &'a MapView<'a>,
    color_by: ColorBy,
    seen: Option<&'a (dyn Fn(u32) -> bool + Sync)>,
    scale: f32,
}

impl std::fmt::Debug for MapSplats<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MapSplats").field("color_by", &self.color_by).finish_non_exhaustive()
    }
}

impl<'a> MapSplats<'a> {
    /// Takes the surfels of a map, `scale` times as large; those that are `seen` are
    /// violet.
    ///
    /// # Errors
    /// Where there are values to colour by, but not one a surfel.
    pub fn new(
        view: &'a MapView<'a>,
        color_by: ColorBy,
        seen: Option<&'a (dyn Fn(u32) -> bool + Sync)>,
        scale: f32,
    ) -> Result<MapSplats<'a>, RenderError> {
        let expected = view.summary().n_surfels;
        match &color_by {
            ColorBy::Values(values) if values.of.len() != expected as usize => {
                Err(RenderError::Values { found: values.of.len(), expected })
            }
            _ => Ok(MapSplats { view, color_by, seen, scale }),
        }
    }

    /// Says whether the scan has no colours: all its surfels are like the first.
    ///
    /// # Errors
    /// Where that cannot be read.
    pub fn is_gray(&self) -> Result<bool, RenderError> {
        Ok(self.n_splats() == 0 || self.view.surfel(0)?.color.is_none())
    }

    fn color(&self, id: u32, surfel: &Surfel) -> [f32; 3] {
        if self.seen.is_some_and(|seen| seen(id)) {
            return srgb(VIOLET);
        }
        match &self.color_by {
            ColorBy::Rgb => {
                surfel.color.map_or_else(gray, |color| color.map(|v| f32::from(v) / 65535.0))
            }
            ColorBy::Normal => of_normal(unit(surfel.normal)),
            ColorBy::Bin => of_bin(surfel.bin),
            ColorBy::Values(values) => values.share(id as usize).map_or_else(gray, ramp),
        }
    }
}

impl Source for MapSplats<'_> {
    fn n_splats(&self) -> u64 {
        self.view.summary().n_surfels.into()
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError> {
        for id in range {
            // Below `n_surfels`, which is a u32.
            let id = id as u32;
            let surfel = self.view.surfel(id)?;
            let (centre, shape) = patch(&surfel, self.scale);
            out.push(Splat {
                centre,
                normal: unit(surfel.normal),
                shape,
                two_sided: surfel.two_sided,
                color: self.color(id, &surfel),
            });
        }
        Ok(())
    }
}

/// Gives the middle of a surfel's patch, on its plane, and its extent.
fn patch(surfel: &Surfel, scale: f32) -> ([f32; 3], Shape) {
    let (min, max) = (surfel.patch.min, surfel.patch.max);
    let more = (surfel.half_spacing as f32 * OVERLAP).max(0.5);
    let half = [0, 1, 2].map(|i| ((max[i] - min[i]) as f32 / 2.0 + more) * scale);
    let centroid = surfel.centroid.map(f64::from);
    let middle = [0, 1, 2].map(|i| f64::from(min[i] + max[i]) / 2.0);
    let n = surfel.normal.map(f64::from);
    let axis = dominant_axis(surfel.normal);
    if n[axis] == 0.0 {
        return (centroid.map(|v| v as f32), Shape::Box(half));
    }
    let mut centre = middle;
    let others = [0, 1, 2].into_iter().filter(|&i| i != axis);
    let climb: f64 = others.map(|i| n[i] * (middle[i] - centroid[i])).sum();
    centre[axis] = centroid[axis] - climb / n[axis];
    (centre.map(|v| v as f32), Shape::Box(half))
}

/// Gives a quantised normal in length 1, or zero.
pub(crate) fn unit(n: Normal) -> [f32; 3] {
    n.map(|v| f32::from(v) / NORMAL_LENGTH as f32)
}
