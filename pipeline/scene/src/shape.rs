//! The pieces a scene is made of: flat quads and triangles, and spheres.

use crate::vector::{Vector, add_scaled, cross, distance2, dot, length, sub, unit};

/// One piece of surface. Flat pieces block from both sides; a normal points into the void.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Shape {
    /// A rectangle; its corners run counter-clockwise as seen from the void.
    Quad([Vector; 4]),
    /// A triangle; its corners run counter-clockwise as seen from the void.
    Triangle([Vector; 3]),
    /// A triangle that stands for a bent piece: a point's normal comes from those at its corners,
    /// of length 1. What it hides and who faces it is decided by the flat triangle.
    Smooth {
        /// As of a triangle.
        corners: [Vector; 3],
        /// A normal each.
        normals: [[f32; 3]; 3],
    },
    /// A whole sphere, seen from outside.
    Sphere {
        /// Its middle.
        centre: Vector,
        /// Its radius.
        radius_m: f64,
    },
}

impl Shape {
    /// Gives the area in m².
    pub(crate) fn area(&self) -> f64 {
        match self {
            Shape::Quad(c) => length(plane_normal(c)),
            Shape::Triangle(c) | Shape::Smooth { corners: c, .. } => 0.5 * length(plane_normal(c)),
            Shape::Sphere { radius_m, .. } => 4.0 * std::f64::consts::PI * radius_m * radius_m,
        }
    }

    /// Gives how much longer than wide the unit square of [`Shape::at`] becomes.
    pub(crate) fn aspect(&self) -> f64 {
        match self {
            Shape::Quad([a, b, _, d]) => length(sub(*d, *a)) / length(sub(*b, *a)),
            Shape::Triangle([a, b, c]) | Shape::Smooth { corners: [a, b, c], .. } => {
                length(sub(*c, *a)) / length(sub(*b, *a))
            }
            Shape::Sphere { .. } => 1.0,
        }
    }

    /// Maps (u, v) of the open unit square to a place and its normal. Equal areas of the square
    /// become equal areas of the surface.
    pub(crate) fn at(&self, u: f64, v: f64) -> (Vector, Vector) {
        match self {
            Shape::Quad([a, b, _, d]) => {
                let along = add_scaled(*a, u, sub(*b, *a));
                (add_scaled(along, v, sub(*d, *a)), self.normal_at(*a))
            }
            Shape::Triangle([a, b, c]) => {
                let [s, t] = triangle_of_square(u, v);
                let along = add_scaled(*a, s, sub(*b, *a));
                (add_scaled(along, t, sub(*c, *a)), self.normal_at(*a))
            }
            Shape::Smooth { corners: [a, b, c], normals } => {
                let [s, t] = triangle_of_square(u, v);
                let place = add_scaled(add_scaled(*a, s, sub(*b, *a)), t, sub(*c, *a));
                (place, self.blended(normals, [1.0 - s - t, s, t]))
            }
            Shape::Sphere { centre, radius_m } => {
                let direction = sphere_of_square(u, v);
                (add_scaled(*centre, *radius_m, direction), direction)
            }
        }
    }

    /// Mixes normals of corners; where they cancel out, the flat normal stays.
    fn blended(&self, normals: &[[f32; 3]; 3], shares: [f64; 3]) -> Vector {
        let mixed =
            [0, 1, 2].map(|i| (0..3).map(|k| shares[k] * f64::from(normals[k][i])).sum::<f64>());
        if length(mixed) > 1e-3 { unit(mixed) } else { self.normal_at([0.0; 3]) }
    }

    /// Gives the unit normal at a place of the surface.
    pub(crate) fn normal_at(&self, place: Vector) -> Vector {
        match self {
            Shape::Quad(c) => unit(plane_normal(c)),
            Shape::Triangle(c) | Shape::Smooth { corners: c, .. } => unit(plane_normal(c)),
            Shape::Sphere { centre, .. } => unit(sub(place, *centre)),
        }
    }

    /// Gives the place of the surface that is nearest to `p`.
    pub(crate) fn nearest(&self, p: Vector) -> Vector {
        match self {
            Shape::Quad(c) => nearest_of_polygon(c, p),
            Shape::Triangle(c) | Shape::Smooth { corners: c, .. } => nearest_of_polygon(c, p),
            Shape::Sphere { centre, radius_m } => {
                let out = sub(p, *centre);
                // Every place is equally near to the centre; the pole stands for them.
                let direction = if length(out) > 0.0 { unit(out) } else { [0.0, 0.0, 1.0] };
                add_scaled(*centre, *radius_m, direction)
            }
        }
    }

    /// Says whether the surface crosses the open segment from p to q.
    ///
    /// Flat: p and q lie strictly on opposite sides of the plane, and the line meets the piece or
    /// its rim. Two pieces with a common edge (the same corners, bit for bit) let nothing through
    /// between them. Sphere: a place strictly between p and q lies strictly inside; p and q are
    /// outside.
    pub(crate) fn crosses(&self, p: Vector, q: Vector) -> bool {
        match self {
            Shape::Quad(c) => polygon_crosses(c, p, q),
            Shape::Triangle(c) | Shape::Smooth { corners: c, .. } => polygon_crosses(c, p, q),
            Shape::Sphere { centre, radius_m } => {
                let (d, out) = (sub(q, p), sub(p, *centre));
                let t = -dot(out, d) / dot(d, d);
                let closest = add_scaled(out, t, d);
                t > 0.0 && t < 1.0 && dot(closest, closest) < radius_m * radius_m
            }
        }
    }

    /// Gives the lowest and the highest corner of the box around the surface.
    pub(crate) fn bounds(&self) -> (Vector, Vector) {
        let around = |corners: &[Vector]| {
            let axis = |i: usize| corners.iter().map(move |c| c[i]);
            let min = [0, 1, 2].map(|i| axis(i).fold(f64::INFINITY, f64::min));
            (min, [0, 1, 2].map(|i| axis(i).fold(f64::NEG_INFINITY, f64::max)))
        };
        match self {
            Shape::Quad(c) => around(c),
            Shape::Triangle(c) | Shape::Smooth { corners: c, .. } => around(c),
            Shape::Sphere { centre, radius_m } => {
                (centre.map(|v| v - radius_m), centre.map(|v| v + radius_m))
            }
        }
    }
}

/// Gives the normal of a flat piece by its first three corners, not of length 1.
fn plane_normal(corners: &[Vector]) -> Vector {
    cross(sub(corners[1], corners[0]), sub(corners[2], corners[0]))
}

/// Gives each corner with the one after it.
fn edges(corners: &[Vector]) -> impl Iterator<Item = (Vector, Vector)> {
    (0..corners.len()).map(|i| (corners[i], corners[(i + 1) % corners.len()]))
}

fn polygon_crosses(corners: &[Vector], p: Vector, q: Vector) -> bool {
    let normal = plane_normal(corners);
    let (side_p, side_q) = (dot(normal, sub(p, corners[0])), dot(normal, sub(q, corners[0])));
    if !(side_p < 0.0 && side_q > 0.0 || side_p > 0.0 && side_q < 0.0) {
        return false;
    }
    // On which side of each edge the line passes. The number of an edge seen from its other
    // piece, where it runs backwards, is exactly the negative one (see `cross`), so the line
    // cannot pass outside both.
    let d = sub(q, p);
    let (mut left, mut right) = (true, true);
    for (a, b) in edges(corners) {
        let volume = dot(d, cross(sub(a, p), sub(b, p)));
        left &= volume >= 0.0;
        right &= volume <= 0.0;
    }
    left || right
}

fn nearest_of_polygon(corners: &[Vector], p: Vector) -> Vector {
    let normal = plane_normal(corners);
    let height = dot(normal, sub(p, corners[0])) / dot(normal, normal);
    let foot = add_scaled(p, -height, normal);
    if edges(corners).all(|(a, b)| dot(normal, cross(sub(b, a), sub(foot, a))) >= 0.0) {
        return foot;
    }
    let mut nearest = corners[0];
    for (a, b) in edges(corners) {
        let along = sub(b, a);
        let t = (dot(sub(p, a), along) / dot(along, along)).clamp(0.0, 1.0);
        let place = add_scaled(a, t, along);
        if distance2(p, place) < distance2(p, nearest) {
            nearest = place;
        }
    }
    nearest
}

/// Maps the unit square to barycentric (s, t), s + t ≤ 1, area-true and with little distortion:
/// the square is folded along its diagonal and each half is pressed into half the triangle.
///
/// Source: Heitz 2019, "A low-distortion map between triangle and square".
fn triangle_of_square(u: f64, v: f64) -> [f64; 2] {
    if v > u { [0.5 * u, v - 0.5 * u] } else { [u - 0.5 * v, 0.5 * v] }
}

/// Maps the unit square to a direction, area-true: the square is an octahedron unfolded, its
/// middle the north pole, its corners the south pole, each of its eight triangles an octant.
///
/// Source: Clarberg 2008, "Fast equal-area mapping of the (hemi)sphere using SIMD".
fn sphere_of_square(u: f64, v: f64) -> Vector {
    let (a, b) = (2.0 * u - 1.0, 2.0 * v - 1.0);
    let (abs_a, abs_b) = (a.abs(), b.abs());
    let is_north = abs_a + abs_b <= 1.0;
    let (x, y) = if is_north { (abs_a, abs_b) } else { (1.0 - abs_b, 1.0 - abs_a) };
    let r = x + y;
    let [cos, sin] = quarter_turn(if r > 0.0 { y / r } else { 0.0 });
    let radius = r * (2.0 - r * r).sqrt();
    let z = 1.0 - r * r;
    [(radius * cos).copysign(a), (radius * sin).copysign(b), if is_north { z } else { -z }]
}

/// Gives cosine and sine of t quarter turns, 0 ≤ t ≤ 1, without libm, whose last bit differs from
/// host to host. The angle is true to 4e-9, the length to the last bits.
fn quarter_turn(t: f64) -> [f64; 2] {
    // Taylor around the middle, where the angle is at most π/4.
    let x = (t - 0.5) * std::f64::consts::FRAC_PI_2;
    let x2 = x * x;
    let sin = x * (1.0 - x2 / 6.0 * (1.0 - x2 / 20.0 * (1.0 - x2 / 42.0 * (1.0 - x2 / 72.0))));
    let cos = 1.0
        - x2 / 2.0 * (1.0 - x2 / 12.0 * (1.0 - x2 / 30.0 * (1.0 - x2 / 56.0 * (1.0 - x2 / 90.0))));
    // The eighth turn from the middle back, and to length 1: (c - s)² + (c + s)² = 2(c² + s²).
    let length = (2.0 * (cos * cos + sin * sin)).sqrt();
    [(cos - sin) / length, (cos + sin) / length]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{bits, unit_pair};

    const TRIANGLE: Shape = Shape::Triangle([[0.0; 3], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
    const BALL: Shape = Shape::Sphere { centre: [1.0, 2.0, 3.0], radius_m: 0.5 };

    /// Chi-square of counts that should all be alike, against its degrees of freedom.
    fn is_even(counts: &[u64]) -> bool {
        let mean = counts.iter().sum::<u64>() as f64 / counts.len() as f64;
        let chi2: f64 = counts.iter().map(|&c| (c as f64 - mean).powi(2) / mean).sum();
        let freedom = counts.len() as f64 - 1.0;
        chi2 < freedom + 4.0 * (2.0 * freedom).sqrt()
    }

    #[test]
    fn quarter_turns_follow_the_circle() {
        for i in 0..=1000 {
            let t = f64::from(i) / 1000.0;
            let [cos, sin] = quarter_turn(t);
            let angle = t * std::f64::consts::FRAC_PI_2;
            assert!((cos - angle.cos()).abs() < 4e-9 && (sin - angle.sin()).abs() < 4e-9);
            assert!((cos * cos + sin * sin - 1.0).abs() < 1e-15);
        }
    }

    #[test]
    fn equal_areas_of_the_square_become_equal_areas() {
        let (mut on_sphere, mut on_triangle) = ([0u64; 80], [0u64; 100]);
        for i in 0..200_000 {
            let [u, v] = unit_pair(bits(1, i));
            let (_, d) = BALL.at(u, v);
            // Slices of equal height have equal areas, and so have the four quadrants of one and
            // the two halves of a quadrant.
            let slice = ((d[2] + 1.0) * 5.0) as usize;
            let octant = usize::from(d[0] > 0.0)
                + 2 * usize::from(d[1] > 0.0)
                + 4 * usize::from(d[0].abs() > d[1].abs());
            on_sphere[slice * 8 + octant] += 1;
            let (p, _) = TRIANGLE.at(u, v);
            // A hundred triangles like the whole: strips along x, then a tooth of the strip.
            let (x, y) = (p[0] * 5.0, p[1] * 10.0);
            let (i, j) = (x as usize, y as usize);
            let upper = usize::from(x.fract() + y.fract() > 1.0);
            on_triangle[(0..j).map(|k| 19 - 2 * k).sum::<usize>() + 2 * i + upper] += 1;
        }
        assert!(is_even(&on_sphere), "{on_sphere:?}");
        assert!(is_even(&on_triangle), "{on_triangle:?}");
    }

    #[test]
    fn nearest_places() {
        assert_eq!(TRIANGLE.nearest([0.5, 0.25, -3.0]), [0.5, 0.25, 0.0]);
        assert_eq!(TRIANGLE.nearest([-1.0, -1.0, 1.0]), [0.0; 3]);
        assert_eq!(TRIANGLE.nearest([1.0, -2.0, 1.0]), [1.0, 0.0, 0.0]);
        assert_eq!(BALL.nearest([1.0, 5.0, 3.0]), [1.0, 2.5, 3.0]);
    }

    #[test]
    fn a_segment_along_a_common_edge_does_not_slip_through() {
        let [a, b, c, d] = [[0.1, 0.2, 0.3], [1.7, 0.1, 0.4], [1.5, 1.9, 0.2], [0.3, 1.3, 0.6]];
        let halves = [Shape::Triangle([a, b, c]), Shape::Triangle([a, c, d])];
        for i in 0..10_000 {
            let [s, t] = unit_pair(bits(9, i));
            // Aimed at the diagonal as well as rounding allows.
            let on_edge = add_scaled(a, s, sub(c, a));
            let away = [t - 0.5, s * t - 0.2, 1.0];
            let (p, q) = (add_scaled(on_edge, 1.0, away), add_scaled(on_edge, -0.7, away));
            assert!(halves.iter().any(|h| h.crosses(p, q)), "{p:?} {q:?}");
        }
    }

    #[test]
    fn ends_in_the_plane_and_grazing_lines_do_not_cross() {
        assert!(TRIANGLE.crosses([0.5, 0.2, 1.0], [0.5, 0.2, -1.0]));
        assert!(!TRIANGLE.crosses([0.5, 0.2, 1.0], [0.5, 0.2, 0.0]));
        assert!(!TRIANGLE.crosses([-1.0, 0.2, 0.0], [3.0, 0.2, 0.0]));
        assert!(!TRIANGLE.crosses([1.5, 0.9, 1.0], [1.5, 0.9, -1.0]));
        assert!(BALL.crosses([1.0, 2.0, 0.0], [1.0, 2.0, 9.0]));
        assert!(!BALL.crosses([1.0, 2.0, 0.0], [1.0, 2.0, 1.0]));
        assert!(!BALL.crosses([1.5, 2.0, 0.0], [1.5, 2.0, 9.0]));
    }
}
