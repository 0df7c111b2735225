//! How a splat covers the pixels of a picture.
//!
//! The ray through a pixel meets the splat's plane at a place p from its middle. With the splat's
//! half axes as units p is (a, b, c); the pixel is on a disc where F = a² + b² ≤ 1, on a patch,
//! the piece of a plane in a box, where F = max(a², b², c²) ≤ 1. That is exact for either lens. A
//! splat that is smaller than a pixel, or seen from its edge, would fall between the rays: it
//! covers at least a spot of [`SPOT_PX`] around its middle, too. Beyond its rim it fades out over
//! [`FRINGE_PX`].
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
/// A ray that meets a plane farther than so many times the distance of the splat's middle, or
/// behind the eye, misses the splat.
const MAX_FARTHER: f32 = 1e3;

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
    /// Its middle, pixels from the middle of the picture.
    offset_px: [f32; 2],
    /// Depth of its middle, grid steps.
    depth: f32,
    /// No place on it is farther from its middle, grid steps.
    reach: f32,
    /// Its half axes: a place p from its middle is a = p · axes[0], and so on; a disc has two.
    axes: [[f32; 3]; 3],
    is_round: bool,
    /// Grid steps a pixel at its middle.
    step: f32,
    /// The ray through its middle, right and down for one ahead.
    ray: [f32; 2],
    /// Share of `fall` by which its plane comes nearer, a pixel right and down.
    slope: [f32; 2],
    /// Perspective: its depth. Orthographic: a grid step.
    fall: f32,
    /// Perspective: 1. Orthographic: 0, the rays are parallel.
    bend: f32,
    /// Perspective: slope of a ray a pixel. Orthographic: 0.
    spread: f32,
}

/// From and to without.
type Span = [u16; 2];

/// What a pixel sees of a splat.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cover {
    /// F: 0 in the middle, 1 at the rim.
    pub(crate) share2: f32,
    /// Depth there, grid steps.
    pub(crate) depth: f32,
}

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
        let seen = camera.see(splat.centre.map(f64::from))?;
        let length = dot(seen.ray, seen.ray).sqrt();
        let has_normal = splat.normal != [0.0; 3];
        let normal = match has_normal {
            true => camera.turn(splat.normal.map(f64::from)),
            false => seen.ray.map(|v| -v / length),
        };
        let facing = dot(normal, seen.ray);
        if look.cull_back && !splat.two_sided && facing >= 0.0 {
            return None;
        }
        let outline = Outline::of(splat, normal, camera);
        let [columns, rows] = outline.covered(&seen, normal, camera)?;
        let cosine = (facing.abs() / length).min(1.0);
        let facing = facing.abs().max(MIN_COSINE * length).copysign(facing);
        let focal_px = camera.focal_px();
        let depth = seen.place[2];
        let (step, fall, bend) = match camera.is_perspective() {
            true => (depth / focal_px, depth, 1.0),
            false => (1.0 / focal_px, 1.0, 0.0),
        };
        let light = 1.0 - look.shade * (1.0 - cosine as f32);
        Some(Disc {
            columns,
            rows,
            // Noise is no more than a splat's size; what lies behind it in a pixel goes with it.
            tolerance: outline.size.max(1.5 * step) as f32,
            color: splat.color.map(|v| v * light),
            offset_px: seen.offset_px.map(|v| v as f32),
            depth: depth as f32,
            reach: outline.reach as f32,
            axes: outline.axes.map(|axis| axis.map(|v| v as f32)),
            is_round: outline.is_round,
            step: step as f32,
            ray: [seen.ray[0] as f32, seen.ray[1] as f32],
            slope: [0, 1].map(|i| (normal[i] / (focal_px * facing)) as f32),
            fall: fall as f32,
            bend: bend as f32,
            spread: (bend / focal_px) as f32,
        })
    }

    /// Gives how far a place on an axis, in pixels from the picture's middle, is from its own.
    #[inline(always)]
    pub(crate) fn offset(&self, x: f32, axis: usize) -> f32 {
        x - self.offset_px[axis]
    }

    /// Gives the place p where the ray `dx`, `dy` pixels from its middle meets its plane, and how
    /// many times as far as its middle that is; not a positive number where it does not.
    #[inline(always)]
    fn meet(&self, dx: f32, dy: f32) -> ([f32; 3], f32) {
        let k = self.slope[0] * dx + self.slope[1] * dy;
        let farther = 1.0 / (1.0 + self.bend * k);
        let ahead = -self.fall * k * farther;
        let right = self.step * dx * farther + self.ray[0] * ahead;
        let down = self.step * dy * farther + self.ray[1] * ahead;
        ([right, down, ahead], farther)
    }

    /// Tells what the pixel `dx`, `dy` from its middle sees of it.
    #[inline(always)]
    pub(crate) fn at(&self, dx: f32, dy: f32) -> Cover {
        let (p, farther) = self.meet(dx, dy);
        let [a2, b2, c2] = self.axes.map(|axis| along(p, axis)).map(|a| a * a);
        let share2 = if self.is_round { a2 + b2 } else { a2.max(b2).max(c2) };
        let spot2 = (dx * dx + dy * dy) * (1.0 / (SPOT_PX * SPOT_PX));
        let share2 = if is_met(farther) { share2.min(spot2) } else { spot2 };
        Cover { share2, depth: self.depth + p[2].clamp(-self.reach, self.reach) }
    }

    /// Gives how much of the pixel `dx`, `dy` from its middle it covers beyond its rim: 1 on the
    /// rim, 0 at the end of the fringe.
    pub(crate) fn fringe(&self, dx: f32, dy: f32) -> f32 {
        let spot = (dx * dx + dy * dy).sqrt() - SPOT_PX;
        let (p, farther) = self.meet(dx, dy);
        let away = if is_met(farther) { self.beyond(p, farther, dx, dy) } else { f32::INFINITY };
        (1.0 - away.min(spot) / FRINGE_PX).clamp(0.0, 1.0)
    }

    /// Gives how many pixels beyond the rim a place is: to first order (F - 1)/|∇F|.
    fn beyond(&self, p: [f32; 3], farther: f32, dx: f32, dy: f32) -> f32 {
        let ray = [self.ray[0] + dx * self.spread, self.ray[1] + dy * self.spread, 1.0];
        let (grow, fall) = (self.step * farther, self.fall * farther * farther);
        // a² and its growth a pixel right and down.
        let [a, b, c] = self.axes.map(|axis| {
            let (a, sideways) = (along(p, axis), along(ray, axis) * fall);
            let growth = |i: usize| 2.0 * a * (axis[i] * grow - sideways * self.slope[i]);
            [a * a, growth(0), growth(1)]
        });
        let [share2, right, down] = match self.is_round {
            true => [a[0] + b[0], a[1] + b[1], a[2] + b[2]],
            false if a[0] >= b[0] && a[0] >= c[0] => a,
            false if b[0] >= c[0] => b,
            false => c,
        };
        (share2 - 1.0) / (right * right + down * down).sqrt().max(f32::MIN_POSITIVE)
    }
}

#[inline(always)]
fn along(p: [f32; 3], axis: [f32; 3]) -> f32 {
    p[0] * axis[0] + p[1] * axis[1] + p[2] * axis[2]
}

#[inline(always)]
fn is_met(farther: f32) -> bool {
    farther > 0.0 && farther < MAX_FARTHER
}

/// What a splat cuts out of its plane, seen from the camera: right, down, ahead.
struct Outline {
    is_round: bool,
    axes: [Vector; 3],
    /// From its middle to a disc's rim or a patch's corners.
    reach: f64,
    /// As long as it is wide if it were a square or a disc.
    size: f64,
    corners: [Vector; 4],
}

impl Outline {
    fn of(splat: &Splat, normal: Vector, camera: &Camera) -> Outline {
        match splat.shape {
            Shape::Box(half) if splat.normal != [0.0; 3] => {
                Outline::of_box(half.map(f64::from), splat.normal.map(f64::from), camera)
            }
            Shape::Box([x, y, z]) => Outline::of_disc(f64::from(x.max(y).max(z)), normal),
            Shape::Round(radius) => Outline::of_disc(radius.into(), normal),
        }
    }

    fn of_disc(radius: f64, normal: Vector) -> Outline {
        // Any two directions at right angles in the plane.
        let least = if normal[0].abs() < 0.6 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let first = direction(cross(normal, least)).unwrap_or(least);
        let second = cross(normal, first);
        Outline {
            is_round: true,
            axes: [first, second, [0.0; 3]].map(|axis| axis.map(|v| v / radius)),
            reach: radius,
            size: radius,
            corners: [[0.0; 3]; 4],
        }
    }

    fn of_box(half: Vector, normal: Vector, camera: &Camera) -> Outline {
        let size = normal.map(f64::abs);
        let lead = if size[0] >= size[1] && size[0] >= size[2] {
            0
        } else if size[1] >= size[2] {
            1
        } else {
            2
        };
        let (u, v) = ((lead + 1) % 3, (lead + 2) % 3);
        // From the middle to the middles of two sides: along u or v, then onto the plane.
        let side = |i: usize| {
            let mut side = [0.0; 3];
            side[i] = half[i];
            side[lead] = -normal[i] * half[i] / normal[lead];
            camera.turn(side)
        };
        let sides = [side(u), side(v)];
        let axis = |i: usize| {
            let mut axis = [0.0; 3];
            axis[i] = 1.0 / half[i];
            camera.turn(axis)
        };
        let corners = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]
            .map(|(a, b)| add_scaled(sides[0].map(|v| v * a), sides[1], b));
        let reach2 = dot(corners[0], corners[0]).max(dot(corners[1], corners[1]));
        Outline {
            is_round: false,
            axes: [axis(u), axis(v), axis(lead)],
            reach: reach2.sqrt(),
            size: (half[u] * half[v]).sqrt(),
            corners,
        }
    }

    /// Finds the columns and rows it may cover, its fringe included; none where there are none.
    fn covered(&self, seen: &Seen, normal: Vector, camera: &Camera) -> Option<[Span; 2]> {
        let size = camera.size();
        if self.is_beside(seen, camera) {
            return None;
        }
        let span = |axis: usize, side_px: u32| {
            let (low, high) = match self.is_round {
                true => disc_extent(seen, normal, self.reach, camera, axis),
                false => self.patch_extent(seen, camera, axis),
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
    fn is_beside(&self, seen: &Seen, camera: &Camera) -> bool {
        let (size, focal_px) = (camera.size(), camera.focal_px());
        let outside = |axis: usize, side_px: u32| {
            let half = f64::from(side_px) / 2.0 + f64::from(FRINGE_PX + SPOT_PX);
            let slant = (focal_px * focal_px + half * half).sqrt();
            let beyond = seen.place[axis].abs() * focal_px - seen.place[2] * half;
            beyond > self.reach * slant
        };
        camera.is_perspective() && (outside(0, size.width_px) || outside(1, size.height_px))
    }

    /// Gives where a patch begins and ends along an axis of the picture: at its corners.
    fn patch_extent(&self, seen: &Seen, camera: &Camera, axis: usize) -> (f64, f64) {
        let corners = self.corners.map(|corner| add_scaled(seen.place, corner, 1.0));
        if camera.is_perspective() && corners.iter().any(|corner| corner[2] <= 0.0) {
            // It reaches behind the eye.
            return (f64::NEG_INFINITY, f64::INFINITY);
        }
        let flat = corners.map(|corner| camera.flat(corner)[axis]);
        flat.iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)))
    }
}

/// Gives where a disc begins and ends along an axis of the picture, pixels from its middle.
fn disc_extent(
    seen: &Seen,
    normal: Vector,
    radius: f64,
    camera: &Camera,
    axis: usize,
) -> (f64, f64) {
    let focal_px = camera.focal_px();
    let radius2 = radius * radius;
    let place = seen.place;
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
            let splat = Splat { centre, normal, shape, two_sided: true, color: [1.0; 3] };
            Disc::of(&splat, &camera, look)
        };
        for shape in [Shape::Round(5.0), Shape::Box([3.0; 3])] {
            // Both reach behind the eye, the second into the picture.
            assert!(at(1100.0, shape).is_none() && at(900.0, shape).is_none());
            assert!(at(1002.0, shape).is_some_and(|disc| disc.columns == [0, 100]));
        }
    }
}
