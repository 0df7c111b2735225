//! How a splat covers the pixels of a picture.
//!
//! The ray through a pixel meets the splat's plane at a place p from its middle. With the splat's
//! half axes as units p is (a, b, c); the pixel is on a disc or an ellipse where F = a² + b² + c²
//! ≤ 1, on a patch, the piece of a plane in a box, where F = max(a², b², c²) ≤ 1. That is exact for
//! either lens. A splat that is smaller than a pixel, or seen from its edge, would fall between the
//! rays: it covers at least a spot of [`SPOT_PX`] around its middle, too. Beyond its rim it fades
//! out over [`FRINGE_PX`].
//!
//! a, b, c and the depth are linear in the pixel's column and row, over one denominator that is
//! linear, too: so a row is walked with a few multiplications and one division a pixel.
//!
//! Source: ray against plane and the spot as in Botsch et al. 2005, "High-quality surface splatting
//! on today's GPUs", §3.

use crate::camera::{Camera, Seen};
use crate::color::Rgb;
use crate::source::{Shape, Splat};
use crate::vector::{Vector, add_scaled, cross, direction, dot};

/// The radius of the spot that any splat covers: half a pixel's diagonal is 0.71, so that some
/// pixel's middle is always in it.
const SPOT_PX: f32 = 0.75;
/// How far beyond its rim a splat fades out.
const FRINGE_PX: f32 = 1.0;
/// A splat that is tilted more than this (the cosine) is taken as tilted so much: 1.1° from its
/// edge.
const MIN_COSINE: f64 = 0.02;
/// What a splat weighs among others that is seen from its edge; 1 if seen from the front.
const MIN_WEIGHT: f64 = 1e-3;
/// A splat that is tilted more than this (the cosine) is drawn smaller: at an outline it stands
/// out, and of a wall so tilted there are many in every pixel.
const GRAZING_COSINE: f64 = 0.2;
/// So much of a disc is left when it is seen from its edge, and of a patch, which has fewer beside
/// it.
const GRAZING_DISC: f64 = 0.5;
const GRAZING_PATCH: f64 = 0.85;
/// But not a splat that is larger than this share of its distance: its tilt is not one.
const LARGE_SHARE: f64 = 0.05;
/// A ray that meets a plane farther than so many times the distance of the splat's middle, or
/// behind the eye, misses the splat.
const MAX_FARTHER: f32 = 1e3;
/// A splat whose middle is nearer to the eye than this share of its size, or behind it, is
/// projected about its farthest place.
const NEAR_SHARE: f64 = 0.01;
/// Of a splat that is not projected about its middle there is no spot.
const NO_SPOT: f32 = 1e12;

/// A splat as a camera sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Disc {
    /// The columns it may cover, from and to without.
    pub(crate) columns: Span,
    /// The rows it may cover, from and to without.
    pub(crate) rows: Span,
    /// What may be so much farther than it and still be of the same surface, grid steps.
    pub(crate) tolerance: f32,
    /// Linear light, shaded.
    pub(crate) color: Rgb,
    /// What its colour weighs among those of the same surface.
    pub(crate) weight: f32,
    /// The surfel, where that mirrors or lets light through; else [`NOT_GLOSSY`].
    pub(crate) glossy: u32,
    /// What it is projected about, its middle as a rule: pixels from the middle of the picture.
    offset_px: [f32; 2],
    /// Depth there, grid steps.
    depth: f32,
    /// No place on it is nearer or farther by more, grid steps.
    reach: f32,
    /// a, b and c there.
    start: [f32; 3],
    /// What a pixel to the right adds to a, b and c, and one down.
    grow: [[f32; 3]; 2],
    /// Below 0 a, b and c count so many times: a box has other sides there.
    ratio: [f32; 3],
    is_round: bool,
    /// What a pixel right and down adds to the denominator.
    bend: [f32; 2],
    /// What a pixel right and down takes from the depth.
    climb: [f32; 2],
    /// 1 over the square of the spot's radius.
    spot: f32,
}

/// There are fewer surfels.
pub(crate) const NOT_GLOSSY: u32 = u32::MAX;

/// From and to without.
type Span = [u16; 2];

/// How splats look.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Look {
    /// Whether one-sided splats that are turned away are left out.
    pub(crate) cull_back: bool,
    /// How much darker a splat is that is seen from its edge, 0…1.
    pub(crate) shade: f32,
}

impl Disc {
    /// Projects a splat; none where it is not in the picture.
    pub(crate) fn of(splat: &Splat, camera: &Camera, look: Look) -> Option<Disc> {
        let middle = camera.place_of(splat.centre.map(f64::from));
        let normal = match splat.normal {
            // It faces the camera.
            [0.0, 0.0, 0.0] => direction(camera.seen(middle)?.ray)?.map(|v| -v),
            normal => camera.turn(normal.map(f64::from)),
        };
        let outline = Outline::of(splat, normal, camera).shrunk(middle, normal, camera);
        let off = outline.anchor(middle, normal, camera)?;
        let seen = camera.seen(add_scaled(middle, off, 1.0))?;
        let length = dot(seen.ray, seen.ray).sqrt();
        let facing = dot(normal, seen.ray);
        if look.cull_back && !splat.two_sided && facing >= 0.0 {
            return None;
        }
        let [columns, rows] = outline.covered(middle, &seen, normal, camera)?;
        let cosine = (facing.abs() / length).min(1.0);
        let facing = facing.abs().max(MIN_COSINE * length).copysign(facing);
        let focal_px = camera.focal_px();
        let depth = seen.place[2];
        let (step, fall, bend) = match camera.is_perspective() {
            true => (depth / focal_px, depth, 1.0),
            false => (1.0 / focal_px, 1.0, 0.0),
        };
        // Share of `fall` by which its plane comes nearer, a pixel right and down.
        let slope = [0, 1].map(|i| normal[i] / (focal_px * facing));
        let grow = |i: usize| {
            let of = |axis: Vector| axis[i] * step - dot(axis, seen.ray) * fall * slope[i];
            outline.axes.map(|axis| of(axis) as f32)
        };
        let is_at_middle = off == [0.0; 3];
        let light = 1.0 - look.shade * (1.0 - cosine as f32);
        Some(Disc {
            columns,
            rows,
            // What lies behind it in a pixel goes with it.
            tolerance: splat.noise.max((1.5 * step) as f32),
            color: splat.color.map(|v| v * light),
            weight: (cosine * cosine).max(MIN_WEIGHT) as f32,
            glossy: splat.glossy.unwrap_or(NOT_GLOSSY),
            offset_px: seen.offset_px.map(|v| v as f32),
            depth: depth as f32,
            reach: (outline.reach * if is_at_middle { 1.0 } else { 2.0 }) as f32,
            start: outline.axes.map(|axis| dot(axis, off) as f32),
            grow: [grow(0), grow(1)],
            ratio: outline.ratio.map(|v| v as f32),
            is_round: outline.is_round,
            bend: slope.map(|v| (bend * v) as f32),
            climb: slope.map(|v| (fall * v) as f32),
            spot: if is_at_middle { 1.0 / (SPOT_PX * SPOT_PX) } else { NO_SPOT },
        })
    }

    /// Gives the least depth that any place of it can have.
    pub(crate) fn nearest(&self) -> f32 {
        self.depth - self.reach
    }

    /// Prepares for the pixels of a row, `y` pixels from the picture's middle.
    #[inline(always)]
    pub(crate) fn row(&self, y: f32) -> Row<'_> {
        let dy = y - self.offset_px[1];
        Row {
            disc: self,
            dy,
            share: self.grow[1].map(|v| v * dy),
            under: 1.0 + self.bend[1] * dy,
            climb: self.climb[1] * dy,
        }
    }
}

/// A splat along a row of pixels.
pub(crate) struct Row<'d> {
    disc: &'d Disc,
    dy: f32,
    share: [f32; 3],
    under: f32,
    climb: f32,
}

impl Row<'_> {
    /// Gives how far a pixel, `x` from the picture's middle, is from what is projected about.
    #[inline(always)]
    pub(crate) fn offset(&self, x: f32) -> f32 {
        x - self.disc.offset_px[0]
    }

    /// Gives how many times as far as its middle the ray of a pixel meets the plane; not a
    /// positive number where it does not.
    #[inline(always)]
    pub(crate) fn farther(&self, dx: f32) -> f32 {
        1.0 / (self.under + self.disc.bend[0] * dx)
    }

    /// Gives the depth of the plane there.
    #[inline(always)]
    pub(crate) fn depth(&self, dx: f32, farther: f32) -> f32 {
        let disc = self.disc;
        let ahead = -(self.climb + disc.climb[0] * dx) * farther;
        disc.depth + ahead.clamp(-disc.reach, disc.reach)
    }

    /// Gives a, b and c.
    #[inline(always)]
    fn place(&self, dx: f32, farther: f32) -> [f32; 3] {
        let disc = self.disc;
        [0, 1, 2].map(|i| disc.start[i] + (self.share[i] + disc.grow[0][i] * dx) * farther)
    }

    /// Gives F: 0 in the middle, 1 at the rim.
    #[inline(always)]
    pub(crate) fn share2(&self, dx: f32, farther: f32) -> f32 {
        let disc = self.disc;
        let place = self.place(dx, farther);
        let [a, b, c] = [0, 1, 2].map(|i| place[i].max(-place[i] * disc.ratio[i]));
        let (sum, most) = (a * a + b * b + c * c, a.max(b).max(c));
        let share2 = if disc.is_round { sum } else { most * most };
        let spot2 = (dx * dx + self.dy * self.dy) * disc.spot;
        if is_met(farther) { share2.min(spot2) } else { spot2 }
    }

    /// Gives how much of a pixel it covers beyond its rim: 1 on the rim, 0 at the end of the
    /// fringe.
    pub(crate) fn fringe(&self, dx: f32, farther: f32) -> f32 {
        let away = if is_met(farther) { self.beyond(dx, farther) } else { f32::INFINITY };
        let spot = match self.disc.spot {
            NO_SPOT => f32::INFINITY,
            _ => (dx * dx + self.dy * self.dy).sqrt() - SPOT_PX,
        };
        (1.0 - away.min(spot) / FRINGE_PX).clamp(0.0, 1.0)
    }

    /// Gives how many pixels beyond the rim a place is: to first order (F - 1)/|∇F|.
    fn beyond(&self, dx: f32, farther: f32) -> f32 {
        let disc = self.disc;
        let place = self.place(dx, farther);
        // a² and its growth a pixel right and down.
        let [a, b, c] = [0, 1, 2].map(|i| {
            let times = if place[i] < 0.0 { disc.ratio[i] * disc.ratio[i] } else { 1.0 };
            let moved = place[i] - disc.start[i];
            let growth =
                |k: usize| 2.0 * place[i] * (disc.grow[k][i] - moved * disc.bend[k]) * farther;
            [place[i] * place[i], growth(0), growth(1)].map(|v| v * times)
        });
        let [share2, right, down] = match disc.is_round {
            true => [0, 1, 2].map(|i| a[i] + b[i] + c[i]),
            false if a[0] >= b[0] && a[0] >= c[0] => a,
            false if b[0] >= c[0] => b,
            false => c,
        };
        (share2 - 1.0) / (right * right + down * down).sqrt().max(f32::MIN_POSITIVE)
    }
}

#[inline(always)]
fn is_met(farther: f32) -> bool {
    farther > 0.0 && farther < MAX_FARTHER
}

/// What a splat cuts out of its plane, seen from the camera: right, down, ahead.
struct Outline {
    is_round: bool,
    axes: [Vector; 3],
    ratio: Vector,
    /// From its middle to a disc's rim or a patch's corners.
    reach: f64,
    corners: [Vector; 4],
}

impl Outline {
    fn of(splat: &Splat, normal: Vector, camera: &Camera) -> Outline {
        let round = |axes: [Vector; 3], reach: f64| Outline {
            is_round: true,
            axes,
            ratio: [1.0; 3],
            reach,
            corners: [[0.0; 3]; 4],
        };
        match splat.shape {
            Shape::Box(sides) if splat.normal != [0.0; 3] => {
                let sides = sides.map(|corner| corner.map(f64::from));
                Outline::of_box(sides, splat.normal.map(f64::from), camera)
            }
            Shape::Ellipse(half) if splat.normal != [0.0; 3] => {
                let axes = axes_of(half.map(f64::from), camera);
                round(axes, half.into_iter().fold(0.0, f32::max).into())
            }
            Shape::Round(radius) => round(in_plane(normal, radius.into()), radius.into()),
            Shape::Box([_, half]) | Shape::Ellipse(half) => {
                let radius = half.into_iter().fold(0.0, f32::max).into();
                round(in_plane(normal, radius), radius)
            }
        }
    }

    fn of_box([low, high]: [Vector; 2], normal: Vector, camera: &Camera) -> Outline {
        let size = normal.map(f64::abs);
        let lead = if size[0] >= size[1] && size[0] >= size[2] {
            0
        } else if size[1] >= size[2] {
            1
        } else {
            2
        };
        let (u, v) = ((lead + 1) % 3, (lead + 2) % 3);
        // Where two sides meet the plane; the box may end before that along `lead`.
        let corner = |at_u: f64, at_v: f64| {
            let mut corner = [0.0; 3];
            (corner[u], corner[v]) = (at_u, at_v);
            corner[lead] = -(normal[u] * at_u + normal[v] * at_v) / normal[lead];
            camera.turn(corner)
        };
        let corners = [
            corner(low[u], low[v]),
            corner(low[u], high[v]),
            corner(high[u], low[v]),
            corner(high[u], high[v]),
        ];
        Outline {
            is_round: false,
            axes: axes_of(high, camera),
            ratio: [0, 1, 2].map(|i| -high[i] / low[i]),
            reach: corners.iter().map(|&c| dot(c, c)).fold(0.0, f64::max).sqrt(),
            corners,
        }
    }

    /// Makes it smaller where it is seen from its edge.
    fn shrunk(mut self, middle: Vector, normal: Vector, camera: &Camera) -> Outline {
        let ray = if camera.is_perspective() { middle } else { [0.0, 0.0, 1.0] };
        let cosine = (dot(normal, ray) / dot(ray, ray).sqrt()).abs();
        let is_large = camera.is_perspective() && self.reach > LARGE_SHARE * middle[2];
        // No cosine is one of a splat at the eye.
        let is_grazing = cosine < GRAZING_COSINE;
        if is_large || !is_grazing {
            return self;
        }
        let least = if self.is_round { GRAZING_DISC } else { GRAZING_PATCH };
        let share = least + (1.0 - least) * cosine / GRAZING_COSINE;
        self.reach *= share;
        self.axes = self.axes.map(|axis| axis.map(|v| v / share));
        self.corners = self.corners.map(|corner| corner.map(|v| v * share));
        self
    }

    /// Finds what the splat is projected about, from its middle: that itself, or where it is not
    /// well before the eye the farthest place in its plane. None where all of it is behind.
    fn anchor(&self, middle: Vector, normal: Vector, camera: &Camera) -> Option<Vector> {
        if !camera.is_perspective() || middle[2] > self.reach * NEAR_SHARE {
            return Some([0.0; 3]);
        }
        let ahead = add_scaled([0.0, 0.0, 1.0], normal, -normal[2]);
        match direction(ahead).map(|ahead| ahead.map(|v| v * self.reach)) {
            Some(off) if middle[2] + off[2] > self.reach * NEAR_SHARE => Some(off),
            _ => (middle[2] > 0.0).then_some([0.0; 3]),
        }
    }

    /// Finds the columns and rows it may cover, its fringe included; none where there are none.
    fn covered(
        &self,
        middle: Vector,
        seen: &Seen,
        normal: Vector,
        camera: &Camera,
    ) -> Option<[Span; 2]> {
        let size = camera.size();
        if self.is_beside(middle, camera) {
            return None;
        }
        let span = |axis: usize, side_px: u32| {
            let (low, high) = match self.is_round {
                true => disc_extent(middle, normal, self.reach, camera, axis),
                false => self.patch_extent(middle, camera, axis),
            };
            let (spot, margin) = (f64::from(SPOT_PX), f64::from(FRINGE_PX));
            let low = low.min(seen.offset_px[axis] - spot) - margin;
            let high = high.max(seen.offset_px[axis] + spot) + margin;
            // Pixel i's middle is at i + 1/2 - side/2. Sides are at most 2^14.
            let (half, end) = (f64::from(side_px) / 2.0 - 0.5, f64::from(side_px));
            let from = (low + half).ceil().clamp(0.0, end) as u16;
            let to = (high + half + 1.0).floor().clamp(0.0, end) as u16;
            (from < to).then_some([from, to])
        };
        Some([span(0, size.width_px)?, span(1, size.height_px)?])
    }

    /// Says whether all of it lies outside one side of the pyramid that the picture shows.
    ///
    /// What reaches behind the eye would otherwise be looked for at every pixel, and from within a
    /// room thousands of splats beside the eye do.
    fn is_beside(&self, middle: Vector, camera: &Camera) -> bool {
        let (size, focal_px) = (camera.size(), camera.focal_px());
        let outside = |axis: usize, side_px: u32| {
            let half = f64::from(side_px) / 2.0 + f64::from(FRINGE_PX + SPOT_PX);
            let slant = (focal_px * focal_px + half * half).sqrt();
            let beyond = middle[axis].abs() * focal_px - middle[2] * half;
            beyond > self.reach * slant
        };
        camera.is_perspective() && (outside(0, size.width_px) || outside(1, size.height_px))
    }

    /// Gives where a patch begins and ends along an axis of the picture: at its corners.
    fn patch_extent(&self, middle: Vector, camera: &Camera, axis: usize) -> (f64, f64) {
        let corners = self.corners.map(|corner| add_scaled(middle, corner, 1.0));
        if camera.is_perspective() && corners.iter().any(|corner| corner[2] <= 0.0) {
            // It reaches behind the eye.
            return (f64::NEG_INFINITY, f64::INFINITY);
        }
        let flat = corners.map(|corner| camera.flat(corner)[axis]);
        flat.iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)))
    }
}

/// Gives the axes of the scan, each over a length.
fn axes_of(half: Vector, camera: &Camera) -> [Vector; 3] {
    [0, 1, 2].map(|i| {
        let mut axis = [0.0; 3];
        axis[i] = 1.0 / half[i];
        camera.turn(axis)
    })
}

/// Gives any two directions at right angles in a plane, over a radius.
fn in_plane(normal: Vector, radius: f64) -> [Vector; 3] {
    let least = if normal[0].abs() < 0.6 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let first = direction(cross(normal, least)).unwrap_or(least);
    [first, cross(normal, first), [0.0; 3]].map(|axis| axis.map(|v| v / radius))
}

/// Gives where a disc begins and ends along an axis of the picture, pixels from its middle.
fn disc_extent(
    place: Vector,
    normal: Vector,
    radius: f64,
    camera: &Camera,
    axis: usize,
) -> (f64, f64) {
    let focal_px = camera.focal_px();
    let radius2 = radius * radius;
    if !camera.is_perspective() {
        let half = (radius2 * (1.0 - normal[axis] * normal[axis]).max(0.0)).sqrt();
        return ((place[axis] - half) * focal_px, (place[axis] + half) * focal_px);
    }
    // The rays that touch the disc are the roots of a x² - 2 b x + c: the dual conic of its
    // picture, R²(I - n nᵀ) - p pᵀ, cut along one axis.
    let a = radius2 * (1.0 - normal[2] * normal[2]) - place[2] * place[2];
    let b = -radius2 * normal[axis] * normal[2] - place[axis] * place[2];
    let c = radius2 * (1.0 - normal[axis] * normal[axis]) - place[axis] * place[axis];
    if a >= 0.0 {
        // It reaches behind the eye.
        return (f64::NEG_INFINITY, f64::INFINITY);
    }
    let root = (b * b - a * c).max(0.0).sqrt();
    ((b + root) / a * focal_px, (b - root) / a * focal_px)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Lens, Size, View};
    use pvmap_geometry::{Frame, grid};

    #[test]
    fn what_lies_beside_the_eye_is_looked_for_nowhere() {
        let frame = Frame::of_world([0.0; 3], [f64::from(grid::GRID_MAX); 3]);
        let (eye, target) = ([1000.0; 3], [1000.0, 2000.0, 1000.0]);
        let lens = Lens::Perspective { fov_deg: 90.0 };
        let view = View { eye, target, up: [0.0, 0.0, 1.0], lens };
        let size = Size { width_px: 100, height_px: 100 };
        let camera = Camera::new(&view, size, &frame).expect("a good camera");
        let look = Look { cull_back: false, shade: 0.0 };
        let at = |x: f32, shape| {
            let (centre, normal) = ([x, 1001.0, 1000.0], [1.0, 0.0, 0.0]);
            let (color, noise) = ([1.0; 3], 1.0);
            let splat =
                Splat { centre, normal, shape, two_sided: true, color, noise, glossy: None };
            Disc::of(&splat, &camera, look)
        };
        for shape in [Shape::Round(5.0), Shape::Box([[-3.0; 3], [3.0; 3]])] {
            // Both reach behind the eye, the second into the picture.
            assert!(at(1100.0, shape).is_none() && at(900.0, shape).is_none());
            assert!(at(1002.0, shape).is_some_and(|disc| disc.columns == [0, 100]));
        }
    }
}
