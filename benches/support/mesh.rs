//! Statues to put into a room: triangle meshes from PLY files or from a seed, sampled as points.

use std::error::Error;
use std::path::Path;
use std::process::Command;

use fastrand::Rng;
use ply_rs::parser::Parser;
use ply_rs::ply::{DefaultElement, Property};
use pvmap::scene::Sample;

/// Statues are of grey stone.
const STONE: [u8; 3] = [168, 160, 150];
/// A statue from a seed: a grid of that many around and up.
const GRID: [u32; 2] = [192, 128];
/// Its folds: how many, and how deep all together, as a share of its width.
const N_FOLDS: usize = 12;
const FOLDS_DEEP: f64 = 0.35;

/// Triangles with common corners, counter-clockwise as seen from outside.
#[derive(Debug)]
pub(crate) struct Mesh {
    corners: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Reads vertices and triangles of a PLY file, also where gzip has packed it.
    ///
    /// # Errors
    /// Where the file cannot be read or holds no triangles.
    pub(crate) fn of_ply(path: &Path) -> Result<Mesh, Box<dyn Error>> {
        let bytes = match path.extension().is_some_and(|e| e == "gz") {
            true => Command::new("gzip").arg("-dc").arg(path).output()?.stdout,
            false => std::fs::read(path)?,
        };
        let ply = Parser::<DefaultElement>::new().read_ply(&mut bytes.as_slice())?;
        let of = |name: &str| ply.payload.get(name).ok_or_else(|| format!("no element {name}"));
        let axis = |v: &DefaultElement, name| v.get(name).and_then(Property::to_f32_lossy);
        let corner = |v| Some([axis(v, "x")?, axis(v, "y")?, axis(v, "z")?].map(f64::from));
        let face = |f: &DefaultElement| {
            let corners = f.get("vertex_indices").and_then(Property::to_u32_list)?;
            <[u32; 3]>::try_from(corners).ok()
        };
        let corners: Option<Vec<_>> = of("vertex")?.iter().map(corner).collect();
        let triangles: Option<Vec<_>> = of("face")?.iter().map(face).collect();
        let (Some(corners), Some(triangles)) = (corners, triangles) else {
            return Err(format!("{}: not a mesh of triangles", path.display()).into());
        };
        Ok(Mesh { corners, triangles })
    }

    /// Makes a statue of its own for every seed: a draped figure, narrow at the neck, in folds.
    pub(crate) fn of_seed(seed: u64) -> Mesh {
        let mut rng = Rng::with_seed(seed);
        // Waves around and up, each with a phase.
        let folds = [0; N_FOLDS].map(|_| (rng.i32(0..7), rng.i32(1..9), rng.f64()));
        let [around, up] = GRID;
        let turn = std::f64::consts::TAU;
        let corner = |i: u32, j: u32| {
            let (u, v) = (f64::from(i) / f64::from(around), f64::from(j) / f64::from(up));
            let wave = |&(m, k, phase): &(i32, i32, f64)| {
                (turn * (f64::from(m) * u + 0.5 * f64::from(k) * v + phase)).sin()
            };
            let folds = 1.0 + FOLDS_DEEP / N_FOLDS as f64 * folds.iter().map(wave).sum::<f64>();
            // A body up to the neck at seven tenths, then a head.
            let body = 0.06 + 0.2 * (v / 0.7 * turn / 2.0).sin().abs().sqrt() * (1.1 - v);
            let radius = (v * (1.0 - v)).powf(0.25) * body * folds;
            [radius * (turn * u).cos(), v, -radius * (turn * u).sin()]
        };
        let corners = (0..=up).flat_map(|j| (0..around).map(move |i| corner(i, j))).collect();
        let quads = (0..up).flat_map(|j| (0..around).map(move |i| (i, j)));
        let triangles = quads.flat_map(|(i, j)| {
            let next = (i + 1) % around;
            let [a, b] = [i, next].map(|i| j * around + i);
            let [c, d] = [next, i].map(|i| (j + 1) * around + i);
            [[a, b, c], [a, c, d]]
        });
        Mesh { corners, triangles: triangles.collect() }
    }

    /// Stands it upright (models have y up, rooms z) on a floor, its middle over `foot_m`, its
    /// longest side `size_m`.
    pub(crate) fn placed(mut self, foot_m: [f64; 2], size_m: f64) -> Mesh {
        for corner in &mut self.corners {
            let [x, y, z] = *corner;
            *corner = [x, -z, y];
        }
        let axis = |i: usize| self.corners.iter().map(move |c| c[i]);
        let low = [0, 1, 2].map(|i| axis(i).fold(f64::INFINITY, f64::min));
        let high = [0, 1, 2].map(|i| axis(i).fold(f64::NEG_INFINITY, f64::max));
        let scale = size_m / (0..3).map(|i| high[i] - low[i]).fold(0.0, f64::max);
        for corner in &mut self.corners {
            for i in 0..2 {
                corner[i] = foot_m[i] + scale * (corner[i] - 0.5 * (low[i] + high[i]));
            }
            corner[2] = scale * (corner[2] - low[2]);
        }
        self
    }

    /// Samples points evenly by area, in the order of the triangles.
    pub(crate) fn points(&self, n: u64, seed: u64) -> Vec<Sample> {
        let mut rng = Rng::with_seed(seed);
        let mut area = 0.0;
        let areas: Vec<f64> = (0..self.triangles.len())
            .map(|i| {
                area += length(self.normal(i));
                area
            })
            .collect();
        (0..n)
            .map(|i| {
                let place = (i as f64 + rng.f64()) / n as f64 * area;
                let triangle = areas.partition_point(|&a| a <= place).min(areas.len() - 1);
                self.point_of(triangle, &mut rng)
            })
            .collect()
    }

    fn point_of(&self, triangle: usize, rng: &mut Rng) -> Sample {
        let [a, b, c] = self.corners_of(triangle);
        let (root, share) = (rng.f64().sqrt(), rng.f64());
        let [s, t] = [root * (1.0 - share), root * share];
        let position = [0, 1, 2].map(|i| a[i] + s * (b[i] - a[i]) + t * (c[i] - a[i]));
        let normal = self.normal(triangle);
        let size = length(normal);
        Sample { position, normal: normal.map(|n| (n / size) as f32), color: STONE }
    }

    fn corners_of(&self, triangle: usize) -> [[f64; 3]; 3] {
        self.triangles[triangle].map(|corner| self.corners[corner as usize])
    }

    /// Gives a triangle's normal, twice its area long.
    fn normal(&self, triangle: usize) -> [f64; 3] {
        let [a, b, c] = self.corners_of(triangle);
        let (u, v) = ([0, 1, 2].map(|i| b[i] - a[i]), [0, 1, 2].map(|i| c[i] - a[i]));
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    }
}

fn length(v: [f64; 3]) -> f64 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}
