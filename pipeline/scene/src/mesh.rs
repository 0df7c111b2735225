//! Triangle meshes, such as statues: checked, turned upright, placed; and a scene as a mesh.

use std::collections::HashMap;
use std::str::FromStr;

use crate::scene::Surface;
use crate::shape::Shape;
use crate::vector::{Vector, cross, dot, length, sub};
use crate::{Scene, SceneError};

/// Farther out, areas would overflow.
const MOST_M: f64 = 1e60;

/// Triangles with common corners, counter-clockwise as seen from outside.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    corners: Vec<Vector>,
    /// A direction a corner, of any length.
    normals: Option<Vec<[f32; 3]>>,
    triangles: Vec<[u32; 3]>,
}

/// Which axis of a model points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Up {
    /// As in the Stanford models; their z, the front, then points to the front of a room.
    #[default]
    Y,
    /// As in the scenes.
    Z,
}

impl FromStr for Up {
    type Err = String;

    fn from_str(name: &str) -> Result<Up, String> {
        match name {
            "y" => Ok(Up::Y),
            "z" => Ok(Up::Z),
            _ => Err(format!("{name:?} is neither y nor z")),
        }
    }
}

impl Mesh {
    /// Checks a mesh. Triangles without an area, of which models have some, are left out: they
    /// hold no points and hide nothing.
    ///
    /// # Errors
    /// Where a triangle names a corner or a normal that is not there or no place, and where no
    /// triangle has an area.
    pub fn new(
        corners: Vec<[f64; 3]>,
        normals: Option<Vec<[f32; 3]>>,
        triangles: Vec<[u32; 3]>,
    ) -> Result<Mesh, SceneError> {
        let n_corners = corners.len().min(normals.as_ref().map_or(usize::MAX, Vec::len));
        for (triangle, indices) in triangles.iter().enumerate() {
            for &corner in indices {
                if corner as usize >= n_corners {
                    return Err(SceneError::NoCorner { triangle, corner, n_corners });
                }
                let place = corners[corner as usize];
                if !place.iter().all(|c| c.abs() <= MOST_M) {
                    return Err(SceneError::NoPlace { corner });
                }
            }
        }
        let n_triangles = triangles.len();
        let mut mesh = Mesh { corners, normals, triangles: Vec::new() };
        let has_area = |t: &[u32; 3]| length(mesh.normal_of(*t)) > 0.0;
        mesh.triangles = triangles.into_iter().filter(has_area).collect();
        if mesh.triangles.is_empty() {
            return Err(SceneError::NoArea { n_triangles });
        }
        Ok(mesh)
    }

    /// Gives the corners: metres in a scene, else a model's own units.
    pub fn corners(&self) -> &[[f64; 3]] {
        &self.corners
    }

    /// Gives the triangles as indices of corners.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Gives the lowest and the highest corner of the box around all triangles.
    pub fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let all = || self.triangles.iter().flatten().map(|&c| self.corners[c as usize]);
        let low = all().fold([f64::INFINITY; 3], |m, c| [0, 1, 2].map(|i| c[i].min(m[i])));
        (low, all().fold([f64::NEG_INFINITY; 3], |m, c| [0, 1, 2].map(|i| c[i].max(m[i]))))
    }

    /// Stands a model upright and turns its triangles' front outward.
    ///
    /// All of them are turned over where the normals of the corners say so or, without such, where
    /// the mesh encloses a negative volume. The normals are turned along with the model, never
    /// over: they are what the model says.
    #[must_use]
    pub fn upright(mut self, up: Up) -> Mesh {
        if up == Up::Y {
            self.corners.iter_mut().for_each(|c| *c = [c[0], -c[2], c[1]]);
            self.normals.iter_mut().flatten().for_each(|n| *n = [n[0], -n[2], n[1]]);
        }
        if self.outwardness() < 0.0 {
            self.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        self
    }

    /// Puts it onto a floor, its middle over `foot_m`, its longest side `size_m`.
    #[must_use]
    pub fn placed(mut self, foot_m: [f64; 2], size_m: f64) -> Mesh {
        let (low, high) = self.bounds();
        let scale = size_m / longest(low, high);
        for corner in &mut self.corners {
            for i in 0..2 {
                corner[i] = foot_m[i] + scale * (corner[i] - 0.5 * (low[i] + high[i]));
            }
            corner[2] = scale * (corner[2] - low[2]);
        }
        self
    }

    /// Gives the longest side a model may have to fit into a space of these sides.
    pub(crate) fn fit_m(&self, space_m: Vector) -> f64 {
        let (low, high) = self.bounds();
        let scales = (0..3).filter(|&i| high[i] > low[i]).map(|i| space_m[i] / (high[i] - low[i]));
        scales.fold(f64::INFINITY, f64::min) * longest(low, high)
    }

    /// Gives the triangles as surfaces, smooth where all their corners have normals.
    pub(crate) fn shapes(&self) -> impl Iterator<Item = Shape> + '_ {
        self.triangles.iter().map(|t| {
            let corners = self.corners_of(*t);
            let usable = |n: &[f32; 3]| {
                let n = n.map(f64::from);
                let size = length(n);
                (size > 0.0 && size.is_finite()).then(|| n.map(|c| (c / size) as f32))
            };
            let normals = self.normals.as_ref();
            let normals = normals.and_then(|all| match t.map(|c| usable(&all[c as usize])) {
                [Some(a), Some(b), Some(c)] => Some([a, b, c]),
                _ => None,
            });
            match normals {
                Some(normals) => Shape::Smooth { corners, normals },
                None => Shape::Triangle(corners),
            }
        })
    }

    /// Gives a number that is negative where the triangles face inward.
    fn outwardness(&self) -> f64 {
        let (low, high) = self.bounds();
        let scale = longest(low, high);
        // Around its middle, so that holes count little, and of size 1, so that nothing overflows.
        let near = |c: Vector| [0, 1, 2].map(|i| (c[i] - 0.5 * (low[i] + high[i])) / scale);
        let of = |t: &[u32; 3]| {
            let [a, b, c] = self.corners_of(*t).map(near);
            let out = cross(sub(b, a), sub(c, a));
            let Some(normals) = &self.normals else { return dot(a, out) };
            let normals = t.map(|c| normals[c as usize].map(f64::from));
            normals.iter().map(|n| dot(*n, out)).filter(|v| v.is_finite()).sum()
        };
        self.triangles.iter().map(of).sum()
    }

    fn corners_of(&self, triangle: [u32; 3]) -> [Vector; 3] {
        triangle.map(|corner| self.corners[corner as usize])
    }

    /// Gives a triangle's normal, twice its area long.
    fn normal_of(&self, triangle: [u32; 3]) -> Vector {
        let [a, b, c] = self.corners_of(triangle);
        cross(sub(b, a), sub(c, a))
    }
}

/// Gives the longest side of a box; more than 0 for one around a triangle with an area.
fn longest(low: Vector, high: Vector) -> f64 {
    sub(high, low).into_iter().fold(0.0, f64::max)
}

impl Scene {
    /// What [`Scene::mesh`] holds for each corner, at most: a place among the corners and one in
    /// the table of those known. Each may just have grown: half full, and its last size copied.
    pub const MESH_CORNER_BYTES: u64 = 3 * size_of::<(Vector, (Vector, u32))>() as u64;
    /// What it holds for each triangle, at most.
    pub const MESH_TRIANGLE_BYTES: u64 = 3 * size_of::<([u32; 3], [u8; 3])>() as u64;

    /// Gives the scene's exact triangles, its statues' included, and a colour each: surface by
    /// surface, a rectangle as two; what is at one place is one corner.
    ///
    /// # Errors
    /// [`SceneError::Round`] where there is a sphere, which no triangles are.
    pub fn mesh(&self) -> Result<(Mesh, Vec<[u8; 3]>), SceneError> {
        let mut corners = Vec::new();
        let mut known = HashMap::new();
        let (mut triangles, mut colors) = (Vec::new(), Vec::new());
        let mut corner = |place: Vector| {
            // Adding 0 makes one zero of the two.
            let key = place.map(|c| (c + 0.0).to_bits());
            *known.entry(key).or_insert_with(|| {
                corners.push(place);
                corners.len() as u32 - 1
            })
        };
        for Surface { shape, paint } in &self.surfaces {
            let pieces: &[[Vector; 3]] = match shape {
                Shape::Quad([a, b, c, d]) => &[[*a, *b, *c], [*a, *c, *d]],
                Shape::Triangle(corners) | Shape::Smooth { corners, .. } => &[*corners],
                Shape::Sphere { .. } => return Err(SceneError::Round),
            };
            for piece in pieces {
                triangles.push(piece.map(&mut corner));
                colors.push(paint.color(piece[0]));
            }
        }
        Ok((Mesh { corners, normals: None, triangles }, colors))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron, its front outward, y up.
    fn model(normals: Option<Vec<[f32; 3]>>) -> Mesh {
        let corners = vec![[0.0; 3], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [1, 1, 2]];
        Mesh::new(corners, normals, triangles).unwrap()
    }

    #[test]
    fn a_model_is_turned_upright_and_outward() {
        let mesh = model(None);
        assert_eq!(mesh.triangles.len(), 4, "one has no area");
        let upright = mesh.clone().upright(Up::Y);
        assert_eq!(upright.corners[2], [0.0, 0.0, 1.0], "y became z");
        assert_eq!(upright.corners[3], [0.0, -1.0, 0.0], "z became the front");
        assert_eq!(upright.triangles, mesh.triangles, "a turn changes no side");
        let mut inward = mesh.clone();
        inward.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert!(inward.outwardness() < 0.0 && inward.upright(Up::Z).outwardness() > 0.0);
        // The normals have the last word: these say that the void is inside.
        let inward: Vec<[f32; 3]> =
            mesh.corners.iter().map(|c| [0, 1, 2].map(|i| (0.25 - c[i]) as f32)).collect();
        let cave = model(Some(inward)).upright(Up::Z);
        assert_eq!(cave.triangles[0], [0, 1, 2]);
    }

    #[test]
    fn a_model_is_placed_and_fits() {
        let placed = model(None).placed([3.0, 2.0], 4.0);
        assert_eq!(placed.bounds(), ([1.0, 1.0, 0.0], [5.0, 3.0, 2.0]));
        assert_eq!(model(None).fit_m([1.0, 5.0, 0.4]), 0.8);
    }

    #[test]
    fn what_is_no_mesh_is_told() {
        let corners = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [f64::NAN; 3]];
        let of = |triangles: &[[u32; 3]]| Mesh::new(corners.clone(), None, triangles.to_vec());
        assert!(of(&[[0, 1, 2]]).is_ok(), "the corner that is none is not used");
        assert_eq!(of(&[[0, 1, 3]]), Err(SceneError::NoPlace { corner: 3 }));
        let missing = SceneError::NoCorner { triangle: 1, corner: 4, n_corners: 4 };
        assert_eq!(of(&[[0, 1, 2], [4, 1, 2]]), Err(missing));
        assert_eq!(of(&[]), Err(SceneError::NoArea { n_triangles: 0 }));
        assert_eq!(of(&[[0, 1, 1], [2, 2, 2]]), Err(SceneError::NoArea { n_triangles: 2 }));
    }
}
