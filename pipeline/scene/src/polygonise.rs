//! From a field on a lattice to the closed triangle mesh between its two signs.

use crate::vector::{Vector, add_scaled, cross, dot, sub};

/// The six ways from the low to the high corner of a cell, an axis at a time: each way's four
/// corners are a tetrahedron, and the six fill the cell. All cells cut their common faces alike.
const WAYS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// A vertex stays this share of its edge away from the edge's ends, so that no triangle is a
/// sliver: the smallest then has 1/512 of the area of a cell's face.
const EDGE_MARGIN: f64 = 1.0 / 16.0;

/// A field sampled at the corners of cubic cells.
#[derive(Debug)]
pub(crate) struct Lattice {
    /// Where corner (0, 0, 0) lies.
    origin: Vector,
    cell_m: f64,
    /// Corners along each axis.
    n_corners: [usize; 3],
    /// The field at each corner, x fastest: positive in the void, not positive in the rock.
    values: Vec<f64>,
}

/// A corner of a tetrahedron.
#[derive(Debug, Clone, Copy)]
struct Corner {
    /// Number of the lattice corner: it orders the ends of an edge.
    index: usize,
    place: Vector,
    value: f64,
}

impl Lattice {
    /// Samples a field at the corners of `n_cells` cells from `origin` on. The outermost corners
    /// become rock whatever the field says, so that the mesh is closed.
    pub(crate) fn new(
        origin: Vector,
        cell_m: f64,
        n_cells: [usize; 3],
        field: impl Fn(Vector) -> f64,
    ) -> Lattice {
        let n_corners = n_cells.map(|n| n + 1);
        let mut lattice = Lattice { origin, cell_m, n_corners, values: Vec::new() };
        let [nx, ny, nz] = n_corners;
        lattice.values.reserve_exact(nx * ny * nz);
        for z in 0..nz {
            for y in 0..ny {
                for x in 0..nx {
                    let outermost = [x, y, z].iter().zip(n_cells).any(|(&i, n)| i == 0 || i == n);
                    let value = field(lattice.place([x, y, z]));
                    lattice.values.push(if outermost { value.min(-1.0) } else { value });
                }
            }
        }
        lattice
    }

    /// Gives the triangles between void and rock, cell by cell, x fastest. Corners run
    /// counter-clockwise as seen from the void; vertices of a common edge are the same bits.
    pub(crate) fn triangles(&self) -> Vec<[Vector; 3]> {
        let mut triangles = Vec::new();
        let [nx, ny, nz] = self.n_corners;
        for z in 0..nz - 1 {
            for y in 0..ny - 1 {
                for x in 0..nx - 1 {
                    self.cut_cell([x, y, z], &mut triangles);
                }
            }
        }
        triangles
    }

    fn cut_cell(&self, cell: [usize; 3], triangles: &mut Vec<[Vector; 3]>) {
        for way in WAYS {
            let mut at = cell;
            let mut corners = [self.corner(at); 4];
            for (corner, axis) in corners[1..].iter_mut().zip(way) {
                at[axis] += 1;
                *corner = self.corner(at);
            }
            cut_tetrahedron(corners, triangles);
        }
    }

    fn corner(&self, at: [usize; 3]) -> Corner {
        let index = (at[2] * self.n_corners[1] + at[1]) * self.n_corners[0] + at[0];
        Corner { index, place: self.place(at), value: self.values[index] }
    }

    fn place(&self, at: [usize; 3]) -> Vector {
        [0, 1, 2].map(|i| self.origin[i] + at[i] as f64 * self.cell_m)
    }
}

fn cut_tetrahedron(mut corners: [Corner; 4], triangles: &mut Vec<[Vector; 3]>) {
    corners.sort_by_key(|c| c.value <= 0.0);
    let n_void = corners.iter().filter(|c| c.value > 0.0).count();
    let [a, b, c, d] = corners;
    let mut add = |v: [Vector; 3]| {
        // The plane through the vertices parts void from rock, so any void corner tells the side.
        let normal = cross(sub(v[1], v[0]), sub(v[2], v[0]));
        let faces_void = dot(normal, sub(a.place, v[0])) > 0.0;
        triangles.push(if faces_void { v } else { [v[0], v[2], v[1]] });
    };
    match n_void {
        1 => add([vertex(a, b), vertex(a, c), vertex(a, d)]),
        2 => {
            add([vertex(a, c), vertex(a, d), vertex(b, d)]);
            add([vertex(a, c), vertex(b, d), vertex(b, c)]);
        }
        3 => add([vertex(a, d), vertex(b, d), vertex(c, d)]),
        _ => {}
    }
}

/// Gives where the field is zero between two corners of different sign, by linear interpolation.
fn vertex(a: Corner, b: Corner) -> Vector {
    // One order of the ends for all cells around the edge, so that all get the same bits.
    let (low, high) = if a.index < b.index { (a, b) } else { (b, a) };
    let t = (low.value / (low.value - high.value)).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    add_scaled(low.place, t, sub(high.place, low.place))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::collections::HashMap;

    /// Checks that each edge is run through exactly once in each direction.
    pub(crate) fn assert_closed<'a>(pieces: impl IntoIterator<Item = &'a [Vector]>) {
        let mut runs: HashMap<[[u64; 3]; 2], u32> = HashMap::new();
        for corners in pieces {
            for i in 0..corners.len() {
                let ends = [corners[i], corners[(i + 1) % corners.len()]];
                let ends = ends.map(|p| p.map(f64::to_bits));
                *runs.entry(ends).or_default() += 1;
            }
        }
        for ([a, b], n) in &runs {
            assert_eq!((*n, runs.get(&[*b, *a])), (1, Some(&1)));
        }
    }

    #[test]
    fn a_ball_of_void_is_closed_and_seen_from_inside() {
        let field = |p: Vector| 1.0 - dot(p, p).sqrt();
        let lattice = Lattice::new([-1.25; 3], 0.125, [20; 3], field);
        let triangles = lattice.triangles();
        assert_closed(triangles.iter().map(|t| &t[..]));
        // Six times the volume, negative because the normals point inwards.
        let volume: f64 = triangles.iter().map(|t| dot(t[0], cross(t[1], t[2]))).sum();
        assert!((-volume / 6.0 / 4.18879 - 1.0).abs() < 0.02, "{volume}");
    }

    #[test]
    fn a_field_that_is_void_at_the_border_is_closed_all_the_same() {
        let triangles = Lattice::new([0.0; 3], 1.0, [3; 3], |_| 1.0).triangles();
        assert!(!triangles.is_empty());
        assert_closed(triangles.iter().map(|t| &t[..]));
        assert!(Lattice::new([0.0; 3], 1.0, [3; 3], |_| -1.0).triangles().is_empty());
    }

    #[test]
    fn a_field_of_zeros_and_jumps_makes_no_sliver() {
        let field = |p: Vector| ((p[0] * 7.0 + p[1] * 3.0 + p[2] * 5.0) as i64 % 3 - 1) as f64;
        let triangles = Lattice::new([0.0; 3], 1.0, [12; 3], field).triangles();
        assert_closed(triangles.iter().map(|t| &t[..]));
        for [a, b, c] in triangles {
            let normal = cross(sub(b, a), sub(c, a));
            assert!(dot(normal, normal).sqrt() > 1.0 / 256.001);
        }
    }
}
