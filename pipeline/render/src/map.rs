//! The surfels of a map as splats.
//!
//! A surfel is drawn as the piece of its plane in the box of its points, grown a little. Its disc
//! would not do: it reaches to the farthest point, which leaves the corners of a square patch bare
//! and hangs over wherever the patch is long and thin, as along an edge. On a thin limb a box is
//! mostly air, and its plane cuts more out of it than the points stand for: there an ellipse about
//! their mean of about the area that is due is drawn. How far apart points are is asked of the
//! surfels around, since the few points of a small leaf do not tell.

use std::ops::Range;

use pvmap_geometry::normal::Normal;
use pvmap_vmap::{MapView, Surfel};

use crate::error::RenderError;
use crate::octree::NOISE_HALF_SPACINGS;
use crate::paint::{Paint, Sample};
use crate::source::{Shape, Source, Splat};

/// Half spacings by which a box of points is drawn larger on every side: points that lie at random
/// leave gaps of more than their mean spacing between the boxes of two leaves.
const OVERLAP: f32 = 2.0;
/// Surfels that share a spacing: they follow each other in Morton order.
const GROUP_SURFELS: u32 = 8;
/// Surfels on either side that are asked for it, too.
const N_BESIDE: u32 = 16;
/// Surfels of fewer points say nothing of the spacing, DESIGN.md §3.
const ENOUGH_POINTS: u64 = 4;
/// The area due to a surfel is that of a disc of a square spacing a point, its radius grown by so
/// many half spacings: few points leave larger gaps, of their size, than many.
const DUE_OVERLAP: f32 = 1.25;
/// A box of so many times that, or less, is drawn as it is.
const MOST_OF_DUE: f32 = 1.6;
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
        // Below `n_surfels`, which is a u32.
        let [start, end] = [range.start, range.end].map(|id| id as u32);
        let first = (start - start % GROUP_SURFELS).saturating_sub(N_BESIDE);
        let last = end.saturating_add(GROUP_SURFELS + N_BESIDE).min(self.view.summary().n_surfels);
        let read = |id| Ok(self.view.surfel(id)?);
        let around: Vec<Surfel> = (first..last).map(read).collect::<Result<_, RenderError>>()?;
        let mut half_spacing = 0.5;
        for id in start..end {
            let surfel = &around[(id - first) as usize];
            if id == start || id % GROUP_SURFELS == 0 {
                let group = id - id % GROUP_SURFELS;
                let from = group.saturating_sub(N_BESIDE) - first;
                let to = last.min(group + GROUP_SURFELS + N_BESIDE) - first;
                half_spacing = local_half_spacing(&around[from as usize..to as usize]);
            }
            let normal = unit(surfel.normal);
            let scanned = surfel.color.map(|color| color.map(|v| f32::from(v) / 65535.0));
            let (place, bin) = (surfel.centroid, surfel.bin);
            let sample = Sample { surfel: Some(id), point: None, place, scanned, normal, bin };
            out.push(Splat {
                centre: surfel.centroid.map(|v| v as f32),
                normal,
                shape: plate(surfel, half_spacing, self.scale),
                noise: half_spacing * NOISE_HALF_SPACINGS,
                two_sided: surfel.two_sided,
                color: self.paint.color(&sample),
                glossy: self.paint.glossy(Some(id)),
            });
        }
        Ok(())
    }
}

/// Gives the lower median of half the spacing over surfels of enough points; over all where none
/// has. At least a half.
///
/// The box of m points at random is on average (m - 1)/(m + 1) times as wide as what they lie in,
/// and so are spacings that are taken from it.
fn local_half_spacing(around: &[Surfel]) -> f32 {
    let of = |least: u64| {
        let enough = around.iter().filter(|surfel| surfel.n_points >= least);
        let unbiased = |surfel: &Surfel| {
            let m = surfel.n_points.max(2) as f32;
            surfel.half_spacing as f32 * (m + 1.0) / (m - 1.0)
        };
        let mut each: Vec<f32> = enough.map(unbiased).collect();
        let middle = each.len().checked_sub(1)? / 2;
        Some(*each.select_nth_unstable_by(middle, f32::total_cmp).1)
    };
    let enough = around.iter().any(|surfel| surfel.n_points >= ENOUGH_POINTS);
    of(if enough { ENOUGH_POINTS } else { 0 }).unwrap_or(0.5).max(0.5)
}

/// Gives what a surfel's plane is cut to.
fn plate(surfel: &Surfel, half_spacing: f32, scale: f32) -> Shape {
    let margin = i64::from(surfel.half_spacing);
    let more = half_spacing * OVERLAP;
    let from_middle = |i: usize, corner: i64| (corner - i64::from(surfel.centroid[i])) as f32;
    // In a forged file a centroid may lie anywhere; elsewhere it is among its points.
    let low = [0, 1, 2]
        .map(|i| (from_middle(i, i64::from(surfel.patch.min[i]) + margin) - more).min(-0.5));
    let high = [0, 1, 2]
        .map(|i| (from_middle(i, i64::from(surfel.patch.max[i]) - margin) + more).max(0.5));
    let disc = 2.0 * (surfel.n_points as f32 / std::f32::consts::PI).sqrt();
    let radius = half_spacing * (disc + DUE_OVERLAP);
    let n = unit(surfel.normal);
    if n == [0.0; 3] {
        let most = [0, 1, 2].map(|i| high[i].max(-low[i])).into_iter().fold(0.0, f32::max);
        return Shape::Round(radius.clamp(0.5, most) * scale);
    }
    let due = std::f32::consts::PI * radius * radius;
    let is_box =
        surfel.n_points >= ENOUGH_POINTS && area_in_box(n, [low, high]) <= MOST_OF_DUE * due;
    if is_box {
        return Shape::Box([low.map(|v| v * scale), high.map(|v| v * scale)]);
    }
    let half = [0, 1, 2].map(|i| (high[i] - low[i]) / 2.0);
    // The plane cuts an ellipse of π a b c / |(a n_x, b n_y, c n_z)| out of the ellipsoid.
    let across = [0, 1, 2].map(|i| half[i] * n[i]).map(|v| v * v).iter().sum::<f32>().sqrt();
    let area = std::f32::consts::PI * half[0] * half[1] * half[2] / across;
    let times = (due / area).sqrt();
    Shape::Ellipse(half.map(|v| v * times * scale))
}

/// Gives the area of what lies in a box of the plane through the origin: the box's corners are the
/// least and the greatest.
fn area_in_box(n: [f32; 3], [low, high]: [[f32; 3]; 2]) -> f32 {
    let lead = (0..3).fold(0, |lead, i| if n[i].abs() > n[lead].abs() { i } else { lead });
    let (u, v) = ((lead + 1) % 3, (lead + 2) % 3);
    // In (u, v): the rectangle, cut where the plane leaves the box along `lead`.
    let mut polygon =
        vec![[low[u], low[v]], [high[u], low[v]], [high[u], high[v]], [low[u], high[v]]];
    for (bound, sign) in [(high[lead], 1.0), (-low[lead], -1.0)] {
        let room = |[a, b]: [f32; 2]| bound + sign * (n[u] * a + n[v] * b) / n[lead];
        if polygon.iter().all(|&p| room(p) >= 0.0) {
            continue;
        }
        let mut rest = Vec::with_capacity(polygon.len() + 1);
        for (i, &p) in polygon.iter().enumerate() {
            let q = polygon[(i + 1) % polygon.len()];
            let (at_p, at_q) = (room(p), room(q));
            if at_p >= 0.0 {
                rest.push(p);
            }
            if (at_p >= 0.0) != (at_q >= 0.0) {
                let t = at_p / (at_p - at_q);
                rest.push([0, 1].map(|k| p[k] + t * (q[k] - p[k])));
            }
        }
        polygon = rest;
    }
    let twice: f32 = (0..polygon.len())
        .map(|i| (polygon[i], polygon[(i + 1) % polygon.len()]))
        .map(|(p, q)| p[0] * q[1] - p[1] * q[0])
        .sum();
    twice.abs() / 2.0 / n[lead].abs()
}

/// Gives a quantised normal in length 1, or zero.
pub(crate) fn unit(n: Normal) -> [f32; 3] {
    let n = n.map(f32::from);
    let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 { n.map(|v| v / length) } else { n }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pvmap_geometry::Box3;

    fn surfel(points: [[i32; 3]; 2], normal: Normal, n_points: u64, half_spacing: u32) -> Surfel {
        let [min, max] = points;
        Surfel {
            centroid: [0, 1, 2].map(|i| ((min[i] + max[i]) / 2) as u32),
            normal,
            two_sided: false,
            half_spacing,
            radius2: 0,
            n_points,
            first_code: 0,
            patch: Box3 { min, max }.grown(half_spacing as i32),
            color: None,
            level: 0,
            bin: 0,
            node: 0,
        }
    }

    #[test]
    fn areas_of_planes_in_boxes() {
        let cube = [[-1.0; 3], [1.0; 3]];
        let third = 1.0 / 3f32.sqrt();
        // A square; a hexagon of side √2; a square tilted along a face's diagonal.
        for (n, area) in [
            ([0.0, 0.0, 1.0], 4.0),
            ([third, -third, third], 3.0 * 3f32.sqrt()),
            ([0.0, 0.5f32.sqrt(), 0.5f32.sqrt()], 4.0 * 2f32.sqrt()),
        ] {
            let found = area_in_box(n, cube);
            assert!((found / area - 1.0).abs() < 1e-5, "{n:?} {found} {area}");
        }
        // Nothing of it lies beyond the middle.
        let half = area_in_box([0.0, 0.8, 0.6], [[-1.0, -1.0, -1e-6], [1.0, 3.0, 5.0]]);
        assert!((half - 2.0 / 0.6).abs() < 1e-4, "{half}");
    }

    #[test]
    fn a_wall_is_drawn_in_boxes_and_a_limb_as_large_as_is_due() {
        // 16 points ten steps apart.
        let wall = surfel([[100, 100, 50], [130, 130, 50]], [0, 0, 1 << 14], 16, 5);
        let Shape::Box([low, high]) = plate(&wall, 5.0, 1.0) else { panic!("no box") };
        assert_eq!((low, high), ([-25.0, -25.0, -10.0], [25.0, 25.0, 10.0]));
        // As many, along a limb that a plane crosses from corner to corner of its box.
        let n = [9459, 9459, 9459];
        let limb = surfel([[100, 100, 100], [200, 200, 200]], n, 16, 30);
        let Shape::Ellipse(half) = plate(&limb, 5.0, 1.0) else { panic!("no ellipse") };
        let radius = (16.0 * 100.0 / std::f32::consts::PI).sqrt() + 5.0 * DUE_OVERLAP;
        assert!((half[0] / radius - 1.0).abs() < 1e-3, "{half:?} {radius}");
    }

    #[test]
    fn spacings_are_those_around_and_not_of_lone_points() {
        let of = |m, h| surfel([[0; 3]; 2], [0, 0, 1 << 14], m, h);
        let around = [of(1, 90), of(16, 5), of(2, 70), of(9, 6), of(4, 40)];
        assert_eq!(local_half_spacing(&around), 6.0 * 10.0 / 8.0);
        assert_eq!(local_half_spacing(&[of(1, 90)]), 270.0);
        assert_eq!(local_half_spacing(&[]), 0.5);
    }

    #[test]
    fn normals_of_any_length_have_length_1() {
        assert_eq!(unit([0, 0, 0]), [0.0; 3]);
        assert_eq!(unit([0, -3, 4]), [0.0, -0.6, 0.8]);
        assert_eq!(unit([i16::MIN, 0, 0]), [-1.0, 0.0, 0.0]);
    }
}
