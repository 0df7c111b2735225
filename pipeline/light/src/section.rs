//! What a box cuts out of a plane.

use pvmap_geometry::Box3;

/// A convex polygon: a rectangle that two lines cut has at most six corners.
///
/// It is kept as it is seen along the axis where the plane's normal is longest, from a place of the
/// plane.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Section {
    from: [f64; 3],
    axis: usize,
    /// How much the plane rises on that axis with each of the two others, in cyclic order.
    slope: [f64; 2],
    corners: [[f64; 2]; 8],
    n: usize,
    /// Whether it reaches the lowest and the highest side of the box on each axis.
    pub(crate) low: [bool; 3],
    pub(crate) high: [bool; 3],
}

impl Section {
    /// Cuts the plane through `from`, perpendicular to `normal` of any length, with a box.
    pub(crate) fn new(from: [f64; 3], normal: [f64; 3], limit: &Box3) -> Section {
        // Seen along that axis it is a rectangle between two parallel lines, along which the plane
        // leaves the box through its two other sides.
        let n = normal;
        let axis = (0..3).fold(0, |a, i| if n[i].abs() > n[a].abs() { i } else { a });
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let side =
            |i: usize| (f64::from(limit.min[i]) - from[i], f64::from(limit.max[i]) - from[i]);
        let ((u0, u1), (v0, v1), (low, high)) = (side(u), side(v), side(axis));
        let slope = [-n[u] / n[axis], -n[v] / n[axis]];
        let (corners, none) = ([[0.0; 2]; 8], [false; 3]);
        let mut section = Section { from, axis, slope, corners, n: 0, low: none, high: none };
        if u0 > u1 || v0 > v1 || low > high {
            return section;
        }
        [[u0, v0], [u1, v0], [u1, v1], [u0, v1]].into_iter().for_each(|p| section.push(p));
        let along = |p: [f64; 2]| slope[0] * p[0] + slope[1] * p[1];
        section.high[axis] = section.clip(|p| high - along(p));
        section.low[axis] = section.clip(|p| along(p) - low);
        for (k, (i, (least, most))) in [(u, (u0, u1)), (v, (v0, v1))].into_iter().enumerate() {
            let corners = &section.corners[..section.n];
            section.low[i] = corners.iter().any(|p| p[k] <= least);
            section.high[i] = corners.iter().any(|p| p[k] >= most);
        }
        section
    }

    fn push(&mut self, p: [f64; 2]) {
        self.corners[self.n] = p;
        self.n += 1;
    }

    /// Keeps where a linear function is not negative; says whether there was anything else.
    fn clip(&mut self, inside: impl Fn([f64; 2]) -> f64) -> bool {
        let mut kept = Section { n: 0, ..*self };
        let mut is_cut = false;
        for i in 0..self.n {
            let (p, q) = (self.corners[i], self.corners[(i + 1) % self.n]);
            let (at_p, at_q) = (inside(p), inside(q));
            if at_p >= 0.0 {
                kept.push(p);
            }
            is_cut |= at_p < 0.0;
            if (at_p < 0.0) != (at_q < 0.0) {
                let t = at_p / (at_p - at_q);
                kept.push([p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])]);
            }
        }
        *self = kept;
        is_cut
    }

    /// Gives the axis where the plane's normal is longest.
    pub(crate) fn axis(&self) -> usize {
        self.axis
    }

    /// Gives its area, 0 where the box does not meet the plane.
    pub(crate) fn area(&self) -> f64 {
        let [a, b] = self.slope;
        let corners = &self.corners[..self.n];
        let twice =
            (0..self.n).map(|i| twice_area([[0.0; 2], corners[i], corners[(i + 1) % self.n]]));
        twice.sum::<f64>().abs() / 2.0 * (1.0 + a * a + b * b).sqrt()
    }

    /// Gives its corners in space, in their order around it.
    pub(crate) fn corners(&self) -> impl Iterator<Item = [f64; 3]> + Clone + '_ {
        self.corners[..self.n].iter().map(|&p| self.place(p))
    }

    /// Gives the triangles between its first corner and each of its sides, in space.
    pub(crate) fn triangles(&self) -> impl Iterator<Item = [[f64; 3]; 3]> + '_ {
        self.flat_triangles().map(|corners| corners.map(|p| self.place(p)))
    }

    /// Gives places spread over it with the shares of its area that they stand for: the middles of
    /// the quarters of its triangles.
    pub(crate) fn places(&self) -> impl Iterator<Item = ([f64; 3], f64)> + '_ {
        let all: f64 = self.flat_triangles().map(|t| twice_area(t).abs()).sum();
        self.flat_triangles().flat_map(move |t| {
            let share = twice_area(t).abs() / all / 4.0;
            // A third of each corner, or two thirds of one and a sixth of the others.
            let weights = [[2.0, 2.0, 2.0], [4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]];
            weights.map(|w| {
                let at = |k: usize| (w[0] * t[0][k] + w[1] * t[1][k] + w[2] * t[2][k]) / 6.0;
                (self.place([at(0), at(1)]), share)
            })
        })
    }

    fn flat_triangles(&self) -> impl Iterator<Item = [[f64; 2]; 3]> + '_ {
        let corners = &self.corners[..self.n];
        (1..self.n.saturating_sub(1)).map(|i| [corners[0], corners[i], corners[i + 1]])
    }

    fn place(&self, p: [f64; 2]) -> [f64; 3] {
        let mut place = self.from;
        place[self.axis] += self.slope[0] * p[0] + self.slope[1] * p[1];
        place[(self.axis + 1) % 3] += p[0];
        place[(self.axis + 2) % 3] += p[1];
        place
    }
}

fn twice_area([a, b, c]: [[f64; 2]; 3]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNIT: Box3 = Box3 { min: [0; 3], max: [1000; 3] };

    #[test]
    fn a_plane_cuts_a_cube_in_a_square_a_rectangle_a_hexagon_and_a_triangle() {
        let middle = [500.0; 3];
        let cases = [
            ([0.0, 0.0, 3.0], middle, 1e6),
            ([0.0, 1.0, 1.0], middle, 1e6 * 2f64.sqrt()),
            // The hexagon through the middle has sides of √2 / 2.
            ([1.0, 1.0, -1.0], middle, 1e6 * 0.75 * 3f64.sqrt()),
            // The triangle through three corners.
            ([1.0, 1.0, 1.0], [1000.0, 0.0, 0.0], 1e6 * 0.5 * 3f64.sqrt()),
        ];
        for (n, c, expected) in cases {
            let section = Section::new(c, n, &UNIT);
            let area = section.area();
            assert!((area - expected).abs() < 1e-6 * expected, "{n:?}: {area}, not {expected}");
            let shares: f64 = section.places().map(|(_, share)| share).sum();
            assert!((shares - 1.0).abs() < 1e-12, "{shares}");
            for place in section.corners().chain(section.places().map(|(place, _)| place)) {
                let off: f64 = (0..3).map(|i| n[i] * (place[i] - c[i])).sum();
                assert!(off.abs() < 1e-9, "{place:?}");
                assert!(place.iter().all(|v| (-1e-9..=1000.0 + 1e-9).contains(v)), "{place:?}");
            }
        }
    }

    #[test]
    fn a_plane_that_meets_no_more_than_a_corner_has_no_area() {
        assert_eq!(Section::new([0.0; 3], [1.0; 3], &UNIT).area(), 0.0);
    }
}
