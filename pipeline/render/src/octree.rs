//! The points of an octree as splats.

use std::ops::Range;

use pvmap_geometry::GridPoint;
use pvmap_vmap::bytes::FieldReader;
use pvmap_vmap::{MapView, OctreeView, Router};

use crate::color::{Rgb, srgb};
use crate::error::RenderError;
use crate::map::unit;
use crate::paint::{Paint, Sample};
use crate::source::{Shape, Source, Splat};

/// Points whose box tells how far apart they are: they follow each other in Morton order.
const GROUP_POINTS: usize = 16;
/// Groups on either side whose spacings are looked at, too: the box of a group that jumps from one
/// cell to a far one says nothing, and the median does not hear it.
const N_BESIDE: usize = 3;
/// Half spacings in a point's radius. Points that lie at random leave e^(-π r² / (2h)²) of a
/// surface bare: 46 % at r = h, 4 % at 2 h, 0.08 % at 3 h.
const RADIUS_HALF_SPACINGS: f32 = 3.0;
/// Half spacings by which a surface may be deeper than one of its points says.
pub(crate) const NOISE_HALF_SPACINGS: f32 = 2.0;

/// The points of an octree: discs of three half spacings.
#[derive(Debug)]
pub struct OctreeSplats<'a> {
    view: &'a OctreeView<'a>,
    map: Option<&'a MapView<'a>>,
    paint: Paint<'a>,
    scale: f32,
    color_at: Option<usize>,
    source_at: Option<usize>,
}

impl<'a> OctreeSplats<'a> {
    /// Takes the points of an octree, with `scale` times their radius. The map, one that was built
    /// from this octree, says which surfel a point belongs to.
    ///
    /// # Errors
    /// Where colours need surfels and there is no map, or not a number a surfel.
    pub fn new(
        view: &'a OctreeView<'a>,
        map: Option<&'a MapView<'a>>,
        paint: Paint<'a>,
        scale: f32,
    ) -> Result<OctreeSplats<'a>, RenderError> {
        match map {
            Some(map) => paint.check(map.summary().n_surfels)?,
            None if paint.needs_surfel() => return Err(RenderError::NoMap),
            None => {}
        }
        // Who needs no surfel does not look for it.
        let map = map.filter(|_| paint.needs_surfel());
        let at = |name| view.schema().column(name).map(|c| c.offset);
        let (color_at, source_at) = (at("color"), at("source"));
        Ok(OctreeSplats { view, map, paint, scale, color_at, source_at })
    }

    /// Gives a record's colour; none where its source has none.
    fn scanned(&self, record: &[u8]) -> Option<Rgb> {
        let source = self.source_at.map_or(0, |at| FieldReader::new(&record[at..]).u32());
        let mut fields = FieldReader::new(&record[self.color_at?..]);
        let stored = [fields.u16(), fields.u16(), fields.u16()];
        match self.view.sources().get(source as usize)?.color_depth {
            0 => None,
            8 => Some(srgb(stored.map(|v| v.min(255) as u8))),
            _ => Some(srgb(stored.map(|v| (v >> 8) as u8))),
        }
    }
}

impl Source for OctreeSplats<'_> {
    fn n_splats(&self) -> u64 {
        self.view.summary().n_points
    }

    fn is_gray(&self) -> Result<bool, RenderError> {
        let is_colored = self.view.sources().iter().any(|source| source.color_depth > 0);
        Ok(self.paint.is_of_scan() && !(self.color_at.is_some() && is_colored))
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError> {
        let points = self.view.points(range.start, range.end - range.start)?;
        let mut places = Vec::with_capacity((range.end - range.start) as usize);
        let first = out.len();
        // It remembers leaves, and points come in Morton order.
        let mut router = self.map.map(Router::new);
        for (index, point) in (range.start..).zip(points.iter()) {
            let point = point?;
            let surfel = match &mut router {
                Some(router) => {
                    let found = router.surfel_of(&point.key).map_err(RenderError::Map)?;
                    Some(found.ok_or(RenderError::NoLeaf)?)
                }
                None => None,
            };
            let normal = unit(point.key.normal);
            let scanned = self.scanned(point.record);
            let bin = point.key.bin() as i8;
            let place = point.key.g;
            let sample = Sample { surfel, point: Some(index), place, scanned, normal, bin };
            let (color, glossy) = (self.paint.color(&sample), self.paint.glossy(surfel));
            places.push(place);
            let centre = place.map(|v| v as f32);
            let two_sided = !point.key.oriented;
            let shape = Shape::Round(1.0);
            out.push(Splat { centre, normal, shape, noise: 1.0, two_sided, color, glossy });
        }
        let half_spacings = half_spacings(&places);
        for (i, splat) in out[first..].iter_mut().enumerate() {
            let half_spacing = half_spacings[i / GROUP_POINTS];
            splat.shape = Shape::Round(half_spacing * RADIUS_HALF_SPACINGS * self.scale);
            splat.noise = half_spacing * NOISE_HALF_SPACINGS;
        }
        Ok(())
    }
}

/// Gives half the spacing of each group of points, in grid steps, at least a half.
fn half_spacings(places: &[GridPoint]) -> Vec<f32> {
    let own: Vec<f32> = places.chunks(GROUP_POINTS).map(half_spacing).collect();
    let around = |i: usize| {
        let (from, to) = (i.saturating_sub(N_BESIDE), own.len().min(i + N_BESIDE + 1));
        let mut near = own[from..to].to_vec();
        near.sort_unstable_by(f32::total_cmp);
        near[(near.len() - 1) / 2]
    };
    (0..own.len()).map(around).collect()
}

/// Gives half the spacing of some points on one surface: as for a surfel, DESIGN.md §3.
fn half_spacing(places: &[GridPoint]) -> f32 {
    let mut sides = [0, 1, 2].map(|i| {
        let axis = || places.iter().map(|g| g[i]);
        let (min, max) = (axis().min().unwrap_or(0), axis().max().unwrap_or(0));
        (max - min + 1) as f32
    });
    sides.sort_unstable_by(f32::total_cmp);
    let area = sides[1] * sides[2] / places.len() as f32;
    (area.sqrt() / 2.0).max(0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_the_spacing_of_a_square_lattice_is_half_its_step() {
        // Four by four points, ten steps apart: the box has one column fewer than points.
        let square = |x0: u32| (0..16).map(move |i| [x0 + i % 4 * 10, i / 4 * 10, 7]);
        let places: Vec<GridPoint> = (0..9).flat_map(|k| square(k * 40)).collect();
        for h in half_spacings(&places) {
            assert!((3.7..=5.0).contains(&h), "{h}");
        }
    }

    #[test]
    fn a_group_that_jumps_is_not_heard() {
        let mut places: Vec<GridPoint> = (0..160).map(|i| [i % 4 * 10, i / 4 * 10, 0]).collect();
        places[80] = [4_000_000; 3];
        assert!(half_spacings(&places).iter().all(|&h| h < 10.0));
    }
}
