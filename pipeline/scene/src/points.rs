//! Points sampled from a scene: any of them at any time, in a scanner's order or shuffled.

use crate::Scene;
use crate::random::{Permutation, bits, unit_pair};

/// The most points of a scene. A surface's first point is the product of an f64 share and their
/// number, so that with more the last bits of the shares would show.
pub const MOST_POINTS: u64 = 1 << 40;

/// A place on a surface of a scene, as a scan would record it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Where, in metres.
    pub position: [f64; 3],
    /// The surface's normal there, of length 1, into the void.
    pub normal: [f32; 3],
    /// The surface's colour there: red, green, blue.
    pub color: [u8; 3],
}

/// `n` points of a scene, none of them stored: each is a pure function of (kind, seed, n, index),
/// so threads may take any parts in any order.
///
/// Every surface has its share of the points by area, to within one. They come surface by surface,
/// and along a surface in stripes, to and fro. Each stripe is cut into as many cells as it has
/// points, all of one area and nearly square, with one point anywhere inside each.
#[derive(Debug, Clone, Copy)]
pub struct Points<'a> {
    scene: &'a Scene,
    n: u64,
    order: Option<Permutation>,
}

impl Scene {
    /// Samples `n` points, 0 ≤ n ≤ [`MOST_POINTS`], in a scanner's order. Nothing is computed yet.
    pub fn points(&self, n: u64) -> Points<'_> {
        Points { scene: self, n, order: None }
    }

    /// Gives the surface that holds place `place` of `n`, its first place and how many it has.
    fn surface_of(&self, place: u64, n: u64) -> (usize, u64, u64) {
        let end = |share: f64| (share * n as f64 + 0.5) as u64;
        let surface = self.shares.partition_point(|&share| end(share) <= place);
        let first = if surface == 0 { 0 } else { end(self.shares[surface - 1]) };
        (surface, first, end(self.shares[surface]) - first)
    }
}

impl<'a> Points<'a> {
    /// Gives the scene that is sampled.
    pub(crate) fn scene(&self) -> &'a Scene {
        self.scene
    }

    /// Gives what the chance of the points hangs on.
    pub(crate) fn key(&self) -> u64 {
        self.scene.key
    }

    /// Gives so many points of the same scene, in order if these are.
    pub(crate) fn resized(&self, n: u64) -> Points<'a> {
        let points = self.scene.points(n);
        if self.order.is_some() { points.shuffled() } else { points }
    }

    /// Counts the points.
    pub fn len(&self) -> u64 {
        self.n
    }

    /// Says whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// Gives the same points in an order without any sense, the same for the same (kind, seed, n).
    pub fn shuffled(self) -> Self {
        let key = bits(self.scene.key ^ self.n, 0);
        Points { order: Some(Permutation::new(self.n, key)), ..self }
    }

    /// Gives the point number `index`.
    ///
    /// # Panics
    /// Where `index` is not below [`Points::len`].
    pub fn at(&self, index: u64) -> Sample {
        assert!(index < self.n, "point {index} of {}", self.n);
        let place = self.order.map_or(index, |order| order.of(index));
        let (surface, first, count) = self.scene.surface_of(place, self.n);
        let surface = &self.scene.surfaces[surface];
        let chance = unit_pair(bits(self.scene.key, place));
        let [u, v] = jittered(place - first, count, surface.shape.aspect(), chance);
        let (position, normal) = surface.shape.at(u, v);
        let color = surface.paint.color(position);
        Sample { position, normal: normal.map(|c| c as f32), color }
    }
}

/// Places number `j` of `k` points in the open unit square, which will become `aspect` times as
/// long (v) as wide (u). `chance` says where in its cell.
fn jittered(j: u64, k: u64, aspect: f64, chance: [f64; 2]) -> [f64; 2] {
    let rows = ((k as f64 * aspect).sqrt() as u64).clamp(1, k);
    // Row i begins with point ⌊i·k/rows⌋ and is as high as it has points, so cells are alike.
    let row = times(j + 1, rows, 1, k);
    let (begin, end) = (times(row, k, 0, rows), times(row + 1, k, 0, rows));
    let column = if row.is_multiple_of(2) { j - begin } else { end - 1 - j };
    let in_row = (end - begin) as f64;
    [(column as f64 + chance[0]) / in_row, (begin as f64 + chance[1] * in_row) / k as f64]
}

/// Gives ⌊(a·b - less) / by⌋, below 2^64; a·b itself need not be: a long triangle that many places
/// are asked of has a row for each.
#[inline]
fn times(a: u64, b: u64, less: u64, by: u64) -> u64 {
    ((u128::from(a) * u128::from(b) - u128::from(less)) / u128::from(by)) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SceneKind;
    use crate::vector::{distance2, dot};

    #[test]
    fn points_lie_on_their_surface_and_normals_have_length_one() {
        for kind in SceneKind::ALL {
            let scene = Scene::new(kind, 3);
            let n = 20_011;
            for i in 0..n {
                let (surface, _, _) = scene.surface_of(i, n);
                let sample = scene.points(n).at(i);
                let shape = &scene.surfaces[surface].shape;
                let off = distance2(shape.nearest(sample.position), sample.position).sqrt();
                assert!(off < 1e-14 * 32.0, "{kind} point {i} is {off} m off");
                let normal = sample.normal.map(f64::from);
                assert!((dot(normal, normal) - 1.0).abs() < 3e-7, "{kind} point {i}");
            }
        }
    }

    #[test]
    fn a_corridor_is_sampled_to_its_end_with_the_most_points() {
        // Three metres wide, so long that every place has a row of its own.
        let corners = vec![[0.0; 3], [3.0, 0.0, 0.0], [0.0, 0.0, 9e12]];
        let mesh = crate::Mesh::new(corners, None, vec![[0, 1, 2]]).unwrap();
        let corridor = Scene::of_mesh(&mesh, 1);
        let points = corridor.points(MOST_POINTS);
        for index in [0, 1, MOST_POINTS / 2, MOST_POINTS - 2, MOST_POINTS - 1] {
            let [x, y, z] = points.at(index).position;
            assert!(x >= 0.0 && y == 0.0 && z >= 0.0 && x / 3.0 + z / 9e12 < 1.0 + 1e-9);
        }
        for (k, aspect) in [(MOST_POINTS, 1e13), (MOST_POINTS, 1.0), (MOST_POINTS - 1, 1e-13)] {
            for j in [0, k / 3, k - 1] {
                let [u, v] = jittered(j, k, aspect, [0.5; 2]);
                assert!(u > 0.0 && u < 1.0 && v > 0.0 && v < 1.0, "{u} {v}");
            }
        }
    }

    #[test]
    fn every_surface_has_its_share_by_area() {
        for kind in SceneKind::ALL {
            let scene = Scene::new(kind, 4);
            let n = 1_000_003;
            let area: f64 = scene.surfaces.iter().map(|s| s.shape.area()).sum();
            let mut next = 0;
            while next < n {
                let (surface, first, count) = scene.surface_of(next, n);
                assert_eq!(first, next);
                let due = scene.surfaces[surface].shape.area() / area * n as f64;
                assert!((count as f64 - due).abs() <= 1.0 + 1e-6, "{kind}: {count} for {due}");
                next += count;
            }
            assert_eq!(next, n);
        }
    }

    #[test]
    fn a_surface_is_covered_evenly_for_any_count_and_shape() {
        for (k, aspect) in [(10_000, 1.0), (9_973, 0.2), (10_007, 30.0), (9_999, 1e9), (1, 1.0)] {
            let mut counts = [0u64; 64];
            for j in 0..k {
                let [u, v] = jittered(j, k, aspect, unit_pair(bits(6, j)));
                assert!(u > 0.0 && u < 1.0 && v > 0.0 && v < 1.0, "{u} {v}");
                counts[(u * 8.0) as usize * 8 + (v * 8.0) as usize] += 1;
            }
            // 63 degrees of freedom: above 108 in one of 3 000 draws even without the cells.
            let mean = k as f64 / 64.0;
            let chi2: f64 = counts.iter().map(|&c| (c as f64 - mean).powi(2) / mean).sum();
            assert!(k == 1 || chi2 < 108.0, "{chi2} for {k} {aspect}");
        }
    }
}
