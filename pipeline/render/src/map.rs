//! The surfels of a map as splats.
//!
//! A surfel is drawn as the piece of its plane in its patch box. Its disc would not do: it reaches
//! to the farthest point, which leaves the corners of a square patch bare and hangs over wherever
//! the patch is long and thin, as along an edge.

use std::ops::Range;

use pvmap_geometry::normal::{NORMAL_LENGTH, Normal, dominant_axis};
use pvmap_vmap::{MapView, Surfel};

use crate::error::RenderError;
use crate::paint::{Paint, Sample};
use crate::source::{Shape, Source, Splat};

/// Half spacings by which a patch is drawn larger on every side: points that lie at random leave
/// gaps of more than their mean spacing between the boxes of two leaves.
const OVERLAP: f32 = 1.0;
/// So many surfels, spread over the map, say whether a scan has colours.
const N_ASKED_FOR_COLOR: u32 = 64;

/// The surfels of a map.
#[derive(Debug)]
pub struct MapSplats<'a> {
    view: &'a MapView<'a>,
    paint: Paint<'a>,
    scale: f32,
}

impl<'a> MapSplats<'a> {
    /// Takes the surfels of a map, `scale` times as large.
    ///
    /// # Errors
    /// Where there are values to colour by, but not one a surfel.
    pub fn new(
        view: &'a MapView<'a>,
        paint: Paint<'a>,
        scale: f32,
    ) -> Result<MapSplats<'a>, RenderError> {
        paint.check(view.summary().n_surfels)?;
        Ok(MapSplats { view, paint, scale })
    }
}

impl Source for MapSplats<'_> {
    fn n_splats(&self) -> u64 {
        self.view.summary().n_surfels.into()
    }

    fn is_gray(&self) -> Result<bool, RenderError> {
        let n_surfels = self.view.summary().n_surfels;
        let step = n_surfels.div_ceil(N_ASKED_FOR_COLOR).max(1);
        for id in (0..n_surfels).step_by(step as usize) {
            if self.view.surfel(id)?.color.is_some() {
                return Ok(false);
            }
        }
        Ok(self.paint.is_of_scan())
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError> {
        for id in range {
            // Below `n_surfels`, which is a u32.
            let id = id as u32;
            let surfel = self.view.surfel(id)?;
            let (centre, shape) = patch(&surfel, self.scale);
            let normal = unit(surfel.normal);
            let scanned = surfel.color.map(|color| color.map(|v| f32::from(v) / 65535.0));
            let sample = Sample { surfel: Some(id), scanned, normal, bin: surfel.bin };
            let (two_sided, color) = (surfel.two_sided, self.paint.color(&sample));
            out.push(Splat { centre, normal, shape, two_sided, color });
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
