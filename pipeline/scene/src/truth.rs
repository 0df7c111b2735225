//! The truth: which points of a scene see each other, asked of the surfaces themselves.

use crate::vector::{Vector, distance2, dot, sub};
use crate::{Sample, Scene};

/// A surface holds an end of a segment if it is no farther from it than this share of the
/// scene's extent: a thousand times what rounding moves a sample off its surface, and for a
/// room of 5.5 m still the twentieth part of an atom.
const TOUCH: f64 = 1e-12;

/// How far from the surfaces a place may be, as a share of the extent (a room: 55 mm).
const REACH: f64 = 0.01;

/// Least cosine between a given normal and that of the surface it is taken to be on: 60°.
const AGREE: f64 = 0.5;

impl Scene {
    /// Says whether two samples of this scene see each other.
    ///
    /// They do if both face each other (with d from a to b: normal of a · d > 0 and normal of
    /// b · d < 0) and no surface crosses the open segment between them. A flat surface crosses it
    /// if the ends lie strictly on opposite sides of its plane and the line meets the piece or
    /// its rim, from whichever side; a sphere does if a place strictly between the ends lies
    /// strictly inside. A surface that holds an end, to within 1e-12 of the scene's extent, never
    /// counts: a flat piece cannot hide its own points, what a sphere hides of itself does not
    /// face, and past a rim that holds an end the neighbours of a closed scene decide.
    ///
    /// Symmetric, bit for bit. The decision is in f64: it is exact but for segments that pass a
    /// silhouette within rounding, some 1e-15 of the extent.
    pub fn sees(&self, a: &Sample, b: &Sample) -> bool {
        // In one order whoever asks, so that rounding cannot tell (a, b) from (b, a).
        let (p, q) = if a.position <= b.position { (a, b) } else { (b, a) };
        Scene::faces(a, b) && !self.is_blocked(p.position, q.position)
    }

    /// Says whether two samples face each other, whatever is between them.
    pub fn faces(a: &Sample, b: &Sample) -> bool {
        let d = sub(b.position, a.position);
        dot(a.normal.map(f64::from), d) > 0.0 && dot(b.normal.map(f64::from), d) < 0.0
    }

    /// Says whether two places near the surfaces, such as stored and rounded points, see each
    /// other: [`Scene::sees`] of their projections ([`Scene::project`]). False where either is
    /// not near a surface that agrees with its normal.
    pub fn sees_points(&self, a: [f64; 3], na: [f32; 3], b: [f64; 3], nb: [f32; 3]) -> bool {
        match (self.project(a, na), self.project(b, nb)) {
            (Some(a), Some(b)) => self.sees(&a, &b),
            _ => false,
        }
    }

    /// Moves a place onto the scene: to the nearest place of the nearest surface whose normal is
    /// within 60° of the given one, and gives the sample there, with the surface's own normal.
    ///
    /// The given normal may have any length; with [0, 0, 0] every surface agrees. Of two equally
    /// near surfaces the one that comes first in scanning order is taken. Nothing where no such
    /// surface is within a hundredth of the scene's extent (55 mm in a room).
    pub fn project(&self, position: [f64; 3], normal: [f32; 3]) -> Option<Sample> {
        let given = normal.map(f64::from);
        let least = AGREE * dot(given, given).sqrt();
        let reach = REACH * self.extent_m;
        let surface = self.bvh.nearest(position, reach * reach, |s| {
            let shape = &self.surfaces[s as usize].shape;
            let place = shape.nearest(position);
            let agrees = dot(shape.normal_at(place), given) >= least;
            agrees.then(|| distance2(place, position))
        })?;
        let surface = &self.surfaces[surface as usize];
        let place = surface.shape.nearest(position);
        let normal = surface.shape.normal_at(place).map(|c| c as f32);
        Some(Sample { position: place, normal, color: surface.paint.color(place) })
    }

    /// Says whether a surface that holds neither end crosses the open segment.
    fn is_blocked(&self, p: Vector, q: Vector) -> bool {
        let touch = TOUCH * self.extent_m;
        self.bvh.any_along(p, q, |s| {
            let shape = &self.surfaces[s as usize].shape;
            let holds = |end: Vector| distance2(shape.nearest(end), end) <= touch * touch;
            shape.crosses(p, q) && !holds(p) && !holds(q)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SceneKind;
    use crate::shape::Shape;
    use crate::vector::{add_scaled, cross};

    /// Where on the line p + t·d a surface is met, by other formulas than `Shape::crosses`.
    fn meets(shape: &Shape, p: Vector, d: Vector) -> Vec<f64> {
        let triangle = |[a, b, c]: [Vector; 3]| {
            // Möller and Trumbore 1997.
            let (ab, ac) = (sub(b, a), sub(c, a));
            let across = cross(d, ac);
            let scale = dot(ab, across);
            let u = dot(sub(p, a), across) / scale;
            let along = cross(sub(p, a), ab);
            let v = dot(d, along) / scale;
            (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| dot(ac, along) / scale)
        };
        match *shape {
            Shape::Triangle(corners) | Shape::Smooth { corners, .. } => {
                triangle(corners).into_iter().collect()
            }
            Shape::Quad([a, b, c, d]) => {
                triangle([a, b, c]).or(triangle([a, c, d])).into_iter().collect()
            }
            Shape::Sphere { centre, radius_m } => {
                let out = sub(p, centre);
                let (a, b) = (dot(d, d), dot(out, d));
                let root = b * b - a * (dot(out, out) - radius_m * radius_m);
                if root <= 0.0 {
                    return Vec::new();
                }
                vec![(-b - root.sqrt()) / a, (-b + root.sqrt()) / a]
            }
        }
    }

    fn all_meets(scene: &Scene, p: Vector, d: Vector) -> impl Iterator<Item = f64> {
        scene.surfaces.iter().flat_map(move |s| meets(&s.shape, p, d))
    }

    #[test]
    fn the_truth_is_that_of_all_surfaces_one_by_one() {
        for (kind, n) in [(SceneKind::Cave, 600), (SceneKind::Furnished, 40_000)] {
            let scene = Scene::new(kind, 8);
            let points = scene.points(n).shuffled();
            let (mut seen, mut hidden) = (0, 0);
            for i in (0..n).step_by(2) {
                let (a, b) = (points.at(i), points.at(i + 1));
                let d = sub(b.position, a.position);
                let cosines = [a.normal, b.normal].map(|n| dot(n.map(f64::from), d));
                if cosines[0] <= 0.0 || cosines[1] >= 0.0 {
                    assert!(!scene.sees(&a, &b));
                    continue;
                }
                let free =
                    all_meets(&scene, a.position, d).all(|t| !(1e-9..1.0 - 1e-9).contains(&t));
                assert_eq!(scene.sees(&a, &b), free, "{kind}: {a:?} {b:?}");
                assert_eq!(scene.sees(&b, &a), free, "{kind}: {b:?} {a:?}");
                seen += u32::from(free);
                hidden += u32::from(!free);
            }
            assert!(seen > 20 && hidden > 20, "{kind}: {seen} {hidden}");
        }
    }

    #[test]
    fn normals_point_into_the_void() {
        for kind in SceneKind::ALL {
            let scene = Scene::new(kind, 9);
            let points = scene.points(200).shuffled();
            for i in 0..points.len() {
                let sample = points.at(i);
                // From the void an odd number of surfaces lies ahead, whatever the way.
                let ahead = |side: f64| {
                    let p = add_scaled(sample.position, side, sample.normal.map(f64::from));
                    all_meets(&scene, p, [0.31, 0.62, 0.71]).filter(|&t| t > 0.0).count()
                };
                assert_eq!((ahead(1e-6) % 2, ahead(-1e-6) % 2), (1, 0), "{kind}: {sample:?}");
            }
        }
    }

    #[test]
    fn projection_finds_the_surface_one_by_one_finds() {
        let scene = Scene::new(SceneKind::Cave, 10);
        let points = scene.points(200).shuffled();
        for i in 0..points.len() {
            let sample = points.at(i);
            let p = sample.position.map(|v| (v * 100.0).round() / 100.0);
            let found = scene.project(p, sample.normal).expect("a point is near the cave");
            let normal = sample.normal.map(f64::from);
            let nearest = scene
                .surfaces
                .iter()
                .map(|s| (s.shape.nearest(p), s))
                .filter(|(place, s)| dot(s.shape.normal_at(*place), normal) > 0.5)
                .map(|(place, _)| distance2(place, p))
                .fold(f64::INFINITY, f64::min);
            assert_eq!(distance2(found.position, p), nearest);
        }
    }
}
