//! What a shining polygon sends to a place.

use std::f64::consts::TAU;

use crate::vector::{add, cross, dot, norm, scale, sub};

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
