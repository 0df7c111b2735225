//! A statue to put into a room, made from a seed.

use fastrand::Rng;
use pvmap::scene::{Mesh, SceneError};

/// A grid of that many around and up.
const GRID: [u32; 2] = [192, 128];
/// Its folds: how many, and how deep all together, as a share of its width.
const N_FOLDS: usize = 12;
const FOLDS_DEEP: f64 = 0.35;

/// Makes a statue of its own for every seed: a draped figure, narrow at the neck, in folds; y up.
///
/// # Errors
/// Never, as long as figures have an area.
pub(crate) fn statue_of_seed(seed: u64) -> Result<Mesh, SceneError> {
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
    Mesh::new(corners, None, triangles.collect())
}
