//! Newton's method for a scaling of which every row is to be right.
//!
//! Scaling by square roots leaves of what rows are off by ½ (1 - λ) a round, λ an eigenvalue of the
//! exchange: next to nothing of it goes where two surfaces see little but each other and λ is near
//! -1. With d_i = exp(δ_i) times as much the rows s_i become A_i, to first order, where
//! (diag(s) + G') δ = A - s: symmetric and positive definite but for that, so each step takes a few
//! applications by conjugate gradients and squares what is left.

use pvmap_store::Watch;

use crate::error::{LightError, check};
use crate::exchange::Exchange;
use crate::sum::sum;

/// Steps of Newton's method at the most, and of conjugate gradients within each.
const MAX_STEPS: usize = 8;
const MAX_INNER: usize = 60;
/// What a step of conjugate gradients leaves of the residual before the next of Newton's method.
const LEFT: f64 = 1e-3;
/// The most that a step adds to the logarithm of a number, or takes from it.
const MAX_GROWTH: f64 = 0.5;

/// A scaling as it is improved.
pub(crate) struct Refined {
    pub(crate) scale: Vec<f64>,
    /// Σ_j d_i G_ij d_j.
    pub(crate) row_sums: Vec<f64>,
    /// Times that the exchange was applied.
    pub(crate) n_applications: usize,
}

/// Goes on from a scaling of a closed scene and its rows until no row is off by more than
/// `tolerance` of its area, or no step helps. Rows that add up to nothing stay so.
pub(crate) fn refine(
    exchange: &Exchange,
    (scale, row_sums): (Vec<f64>, Vec<f64>),
    tolerance: f64,
    watch: &dyn Watch,
) -> Result<Refined, LightError> {
    let areas = exchange.elements().areas();
    let mut best = Refined { scale, row_sums, n_applications: 0 };
    for _ in 0..MAX_STEPS {
        let missing = best.missing(areas);
        if missing.iter().zip(areas).all(|(off, area)| off.abs() <= tolerance * area) {
            break;
        }
        let (step, n) = newton_step(exchange, &best, &missing, watch)?;
        let grown = best.scale.iter().zip(step);
        let grown = grown.map(|(d, step)| d * step.clamp(-MAX_GROWTH, MAX_GROWTH).exp());
        let scale: Vec<f64> = grown.collect();
        let row_sums = apply(exchange, &scale, &vec![1.0; areas.len()])?;
        let n_applications = best.n_applications + n + 1;
        watch.advance(n as u64 + 1);
        let next = Refined { scale, row_sums, n_applications };
        let off = |missing: &[f64]| sum(missing.iter().map(|off| off.abs()));
        if off(&next.missing(areas)) < off(&missing) {
            best = next;
        } else {
            return Ok(Refined { n_applications, ..best });
        }
    }
    Ok(best)
}

impl Refined {
    /// Gives what each row lacks; 0 where it adds up to nothing.
    fn missing(&self, areas: &[f64]) -> Vec<f64> {
        let rows = self.row_sums.iter().zip(areas);
        rows.map(|(sum, area)| if *sum > 0.0 { area - sum } else { 0.0 }).collect()
    }
}

/// Gives D G D v.
fn apply(exchange: &Exchange, scale: &[f64], v: &[f64]) -> Result<Vec<f64>, LightError> {
    let scaled: Vec<f64> = scale.iter().zip(v).map(|(d, v)| d * v).collect();
    Ok(scale.iter().zip(exchange.apply(&scaled)?).map(|(d, flux)| d * flux).collect())
}

/// Solves (diag(s) + D G D) δ = what is missing, δ = 0 where nothing is, and says how many
/// applications it took.
fn newton_step(
    exchange: &Exchange,
    Refined { scale, row_sums, .. }: &Refined,
    missing: &[f64],
    watch: &dyn Watch,
) -> Result<(Vec<f64>, usize), LightError> {
    let conditioned = |r: &[f64]| -> Vec<f64> {
        r.iter().zip(row_sums).map(|(r, s)| if *r != 0.0 { r / s } else { 0.0 }).collect()
    };
    let mut step = vec![0.0; missing.len()];
    let mut r = missing.to_vec();
    let mut p = conditioned(&r);
    let mut rz = dot(&r, &p);
    let enough = LEFT * LEFT * rz;
    for n in 0..MAX_INNER {
        check(watch)?;
        let mut product = apply(exchange, scale, &p)?;
        for (i, product) in product.iter_mut().enumerate() {
            *product = if missing[i] == 0.0 { 0.0 } else { *product + row_sums[i] * p[i] };
        }
        let curvature = dot(&p, &product);
        if curvature.is_nan() || curvature <= 0.0 {
            return Ok((step, n + 1));
        }
        let by = rz / curvature;
        step.iter_mut().zip(&p).for_each(|(step, p)| *step += by * p);
        r.iter_mut().zip(&product).for_each(|(r, product)| *r -= by * product);
        let z = conditioned(&r);
        let next = dot(&r, &z);
        if next <= enough {
            return Ok((step, n + 1));
        }
        p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + next / rz * *p);
        rz = next;
    }
    Ok((step, MAX_INNER))
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    sum(a.iter().zip(b).map(|(a, b)| a * b))
}
