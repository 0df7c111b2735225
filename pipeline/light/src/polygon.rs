//! What a shining polygon sends to a place, and what a place sends to a triangle.

use std::f64::consts::{PI, TAU};

use crate::vector::{add, cross, dot, norm, scale, sub};

/// The directions within an angle of an axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cone {
    /// Of length 1.
    pub(crate) axis: [f64; 3],
    /// 0…π.
    pub(crate) angle: f64,
}

impl Cone {
    /// Gives the angle between its axis and a direction of any length, however small.
    pub(crate) fn off(&self, direction: [f64; 3]) -> f64 {
        norm(cross(direction, self.axis)).atan2(dot(direction, self.axis))
    }
}

/// Triangles that a cone's edge cuts are halved until they are so many times smaller than it, or
/// than what is left around it.
const FINENESS: f64 = 64.0;
/// They are halved so often at the most, where a cone of next to no angle falls on them or where
/// they are next to its tip: of 53 bits of a place some are left.
const MAX_HALVINGS: u32 = 48;

/// Gives the solid angle under which the origin sees a triangle, 0…2π: exactly the share of what a
/// point light sends out that arrives there, however near it is.
///
/// Source: Van Oosterom and Strackee 1983.
pub(crate) fn solid_angle([a, b, c]: [[f64; 3]; 3]) -> f64 {
    let [of_a, of_b, of_c] = [a, b, c].map(norm);
    // a · (b × c), by differences: corners that are next to each other would leave nothing of it.
    let volume = dot(a, cross(sub(b, a), sub(c, a))).abs();
    let around = of_a * of_b * of_c + dot(a, b) * of_c + dot(a, c) * of_b + dot(b, c) * of_a;
    if volume > 0.0 { 2.0 * volume.atan2(around) } else { 0.0 }
}

/// Gives the solid angle of what lies in a cone of a triangle, its tip the origin. Of the smallest
/// triangles that the cone's edge cuts their middle decides.
pub(crate) fn solid_angle_within(triangle: [[f64; 3]; 3], cone: &Cone) -> f64 {
    within(triangle, cone, MAX_HALVINGS)
}

fn within([a, b, c]: [[f64; 3]; 3], cone: &Cone, n_halvings: u32) -> f64 {
    let middle = scale(add(a, add(b, c)), 1.0 / 3.0);
    let radius = [a, b, c].map(|p| norm(sub(p, middle))).into_iter().fold(0.0, f64::max);
    let away = norm(middle);
    let off = cone.off(middle);
    // Half the angle of a ball around it.
    let half = if radius < away { (radius / away).asin() } else { TAU };
    if off - half >= cone.angle {
        return 0.0;
    }
    let is_small = half * FINENESS <= cone.angle.min(PI - cone.angle) || n_halvings == 0;
    if off + half <= cone.angle || is_small && off <= cone.angle {
        return solid_angle([a, b, c]);
    }
    if is_small {
        return 0.0;
    }
    let between = |p: [f64; 3], q: [f64; 3]| scale(add(p, q), 0.5);
    let (ab, bc, ca) = (between(a, b), between(b, c), between(c, a));
    let quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]];
    quarters.into_iter().map(|quarter| within(quarter, cone, n_halvings - 1)).sum()
}

/// Gives the irradiance of a face of this normal at the origin under a planar convex polygon of
/// exitance 1, clipped by the face's horizon; 0 or more.
///
/// Source: Lambert 1760: half of the sum over the edges of the angle under which each is seen times
/// the cosine of the normal with that of the plane through the edge, over π.
pub(crate) fn irradiance_of_polygon(corners: &[[f64; 3]; 4], normal: [f64; 3]) -> f64 {
    // A plane cuts at most one corner off more than it adds.
    let (mut above, mut n) = ([[0.0; 3]; 5], 0);
    for (k, &corner) in corners.iter().enumerate() {
        let next = corners[(k + 1) % corners.len()];
        let (here, there) = (dot(corner, normal), dot(next, normal));
        if here >= 0.0 && n < above.len() {
            above[n] = corner;
            n += 1;
        }
        if (here >= 0.0) != (there >= 0.0) && n < above.len() {
            above[n] = add(corner, scale(sub(next, corner), here / (here - there)));
            n += 1;
        }
    }
    let edges = (0..n).map(|k| {
        let (from, to) = (above[k], above[(k + 1) % n]);
        let across = cross(from, to);
        let sin = norm(across);
        if sin > 0.0 { sin.atan2(dot(from, to)) * dot(across, normal) / sin } else { 0.0 }
    });
    (edges.sum::<f64>() / TAU).abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(height: f64, [x, y]: [f64; 2]) -> [[f64; 3]; 4] {
        let corner = |a: f64, b: f64| [x + a, y + b, height];
        [corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)]
    }

    /// The two halves of a square of side 2 s at a height, around the axis.
    fn halves(height: f64, s: f64) -> [[[f64; 3]; 3]; 2] {
        let [a, b, c, d] = [[-s, -s], [s, -s], [s, s], [-s, s]].map(|[x, y]| [x, y, height]);
        [[a, b, c], [a, c, d]]
    }

    #[test]
    fn six_faces_of_a_cube_are_all_around_and_a_near_one_is_half_of_it() {
        let face: f64 = halves(0.5, 0.5).into_iter().map(solid_angle).sum();
        assert!((6.0 * face - 2.0 * TAU).abs() < 1e-12, "{face}");
        let near: f64 = halves(1e-6, 1.0).into_iter().map(solid_angle).sum();
        assert!((near - (TAU - 32f64.sqrt() * 1e-6)).abs() < 1e-9, "{near}");
        let far: f64 = halves(1e6, 0.5).into_iter().map(solid_angle).sum();
        assert!((far * 1e12 - 1.0).abs() < 1e-9, "{far}");
    }

    #[test]
    fn a_cone_has_all_of_its_directions_on_a_plane_that_it_meets() {
        let slanted = [0.6, 0.0, 0.8];
        for (degrees, axis) in [
            (1e-7, slanted),
            (1e-3, slanted),
            (0.5, [0.0, 0.0, 1.0]),
            (2.0, slanted),
            (20.0, slanted),
            (60.0, [0.0, 0.0, 1.0]),
        ] {
            let cone = Cone { axis, angle: f64::to_radians(degrees) };
            let expected = 2.0 * TAU * (0.5 * cone.angle).sin().powi(2);
            let found: f64 =
                halves(1.0, 4.0).into_iter().map(|half| solid_angle_within(half, &cone)).sum();
            assert!((found / expected - 1.0).abs() < 3e-3, "{degrees}: {found}, not {expected}");
        }
        let away = Cone { axis: [0.0, 0.0, -1.0], angle: 1.0 };
        assert_eq!(solid_angle_within(halves(1.0, 4.0)[0], &away), 0.0);
        // All but a cone: what is around its axis is left out.
        let wide = Cone { axis: [0.0, 0.0, -1.0], angle: 2.5 };
        let around: f64 =
            halves(1.0, 4.0).into_iter().map(|half| solid_angle_within(half, &wide)).sum();
        let all: f64 = halves(1.0, 4.0).into_iter().map(solid_angle).sum();
        let left_out = TAU * (1.0 + wide.angle.cos());
        assert!(((all - around) / left_out - 1.0).abs() < 3e-3, "{around} of {all}");
    }

    #[test]
    fn a_unit_square_over_its_corner_and_its_centre() {
        // catalogue/light.md §5.4, and §5.10 at a height of 2.
        let up = [0.0, 0.0, 1.0];
        let cases =
            [(1.0, [0.0; 2], 0.138532), (1.0, [-0.5; 2], 0.239456), (2.0, [-0.5; 2], 0.073478)];
        for (height, at, expected) in cases {
            let found = irradiance_of_polygon(&square(height, at), up);
            assert!((found - expected).abs() < 1e-6, "{found}, not {expected}");
        }
    }

    #[test]
    fn what_is_below_the_horizon_sends_nothing() {
        let corners = square(1.0, [-0.5; 2]);
        assert_eq!(irradiance_of_polygon(&corners, [0.0, 0.0, -1.0]), 0.0);
        // A face that looks along the ground sees one half of a wall that the horizon cuts.
        let wall = [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]];
        let upper = [[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]];
        let up = [0.0, 0.0, 1.0];
        let (cut, whole) = (irradiance_of_polygon(&wall, up), irradiance_of_polygon(&upper, up));
        assert!((cut - whole).abs() < 1e-15 && whole > 0.1, "{cut}, {whole}");
    }
}
