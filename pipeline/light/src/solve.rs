//! Radiosity from emission and albedo.
//!
//! What is solved for is the light that has been reflected, X = B - E:
//!
//! (A_i / ρ_i) X_i - (G X)_i = (G E)_i,  X_i = 0 where ρ_i = 0,
//!
//! symmetric, and positive definite while less is reflected than arrives. So B = E to the bit where
//! nothing is reflected or nothing shines.

use std::borrow::Cow;

use crate::error::LightError;
use crate::material::check_each;
use crate::sum::sum;

/// A symmetric exchange of light between elements.
pub trait Operator {
    /// Gives the area of each element.
    fn areas(&self) -> &[f64];

    /// Gives G b.
    ///
    /// # Errors
    /// Where there are not as many values as elements.
    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError>;

    /// Gives G b for each of some b, the same bits as one by one.
    ///
    /// # Errors
    /// Those of [`Operator::apply`].
    fn apply_each(&self, b: &[&[f64]]) -> Result<Vec<Vec<f64>>, LightError> {
        b.iter().map(|b| self.apply(b)).collect()
    }

    /// Gives Σ_j G_ij of each element.
    ///
    /// # Errors
    /// Those of [`Operator::apply`].
    fn row_sums(&self) -> Result<Vec<f64>, LightError> {
        self.apply(&vec![1.0; self.areas().len()])
    }

    /// Gives the share of its area by which a row may be off.
    fn row_error(&self) -> f64 {
        0.0
    }
}

/// How the equations are solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Conjugate gradients with the preconditioner ρ/A: 3 to 6 iterations to 1e-3.
    ConjugateGradients,
    /// Jacobi iteration, a bounce of light each: the reference, and what goes on where conjugate
    /// gradients break down because the operator is not positive definite.
    Jacobi,
}

/// How many times as far off as all light an element may be, as a share of what leaves it: by the
/// flux of all alone a room with a weak lamp would be left in the dark beside one with a strong
/// lamp. Furnished rooms and a cave with a lamp take no iteration more, 0.01 % to 10 % wrong.
const MOST_OFF: f64 = 300.0;
/// What an element sends counts no less there than this part of the tolerance of the mean: light
/// that comes round ten corners is not waited for.
const DARK: f64 = 1e-2;

/// How far to go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolveOptions {
    /// The method to begin with.
    pub method: Method,
    /// The flux that may be wrong, as a share of what is emitted.
    pub tolerance: f64,
    /// Iterations at the most.
    pub max_iterations: usize,
}

impl Default for SolveOptions {
    fn default() -> SolveOptions {
        // Jacobi needs 14 000 iterations to 1e-6 at an albedo of 0.999.
        let (method, max_iterations) = (Method::ConjugateGradients, 100_000);
        SolveOptions { method, tolerance: 1e-4, max_iterations }
    }
}

/// Where the emitted flux went: emitted = absorbed + escaped, but for the residual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FluxBalance {
    /// Σ A E.
    pub emitted: f64,
    /// Σ A (1 - ρ) H.
    pub absorbed: f64,
    /// Σ A (B - H), what leaves elements and arrives at none.
    pub escaped: f64,
    /// Flux below 0 that was cut off at the end: interpolation may overshoot.
    pub clipped: f64,
}

/// The light of a scene in one channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// B of each element, at least E.
    pub exitance: Vec<f64>,
    /// H of each element, at least 0.
    pub irradiance: Vec<f64>,
    /// Iterations done.
    pub iterations: usize,
    /// The share of light that a bounce leaves at the most, max ρ_i Σ_j G_ij / A_i, below 1: no
    /// eigenvalue of (ρ/A) G is larger (Gershgorin).
    pub reflected: f64,
    /// Flux that may be missing at the most, as a share of what is emitted.
    pub residual: f64,
    /// What the last iteration was done with.
    pub method: Method,
    /// Where the flux went.
    pub balance: FluxBalance,
}

/// Finds the radiosity of elements with an emission E ≥ 0 and an albedo ρ, 0…1.
///
/// Without emission, or without reflection, no iteration is done.
///
/// # Errors
/// Where there are not as many values as elements, a value is out of range, all that arrives
/// somewhere is reflected and nothing is lost (no finite solution), the residual is no number, or
/// `max_iterations` do not reach the tolerance.
pub fn solve(
    operator: &impl Operator,
    emission: &[f64],
    albedo: &[f64],
    options: &SolveOptions,
) -> Result<Solution, LightError> {
    Ok(solve_each(operator, &[(emission, albedo)], options)?.swap_remove(0))
}

/// Solves for several channels, emission and albedo each, side by side: what [`solve`] finds for
/// each, to the bit.
///
/// # Errors
/// Those of [`solve`], for any of them.
pub(crate) fn solve_each(
    operator: &impl Operator,
    channels: &[(&[f64], &[f64])],
    options: &SolveOptions,
) -> Result<Vec<Solution>, LightError> {
    let areas = operator.areas();
    let n = areas.len();
    for (emission, albedo) in channels {
        check_each(n, "emission", "0 or more", emission, |e| e >= 0.0 && e.is_finite())?;
        check_each(n, "albedo", "between 0 and 1", albedo, |rho| (0.0..=1.0).contains(&rho))?;
    }
    let is_legal = options.tolerance > 0.0 && options.tolerance < f64::INFINITY;
    if !is_legal {
        let (what, range) = ("the tolerance", "above 0");
        return Err(LightError::Setting { what, value: options.tolerance, range });
    }
    let emitted = |emission: &[f64]| sum(areas.iter().zip(emission).map(|(a, e)| a * e));
    let shines = channels.iter().any(|(emission, _)| emitted(emission) > 0.0);
    let row_sums = if shines { operator.row_sums()? } else { Vec::new() };
    let area = sum(areas.iter().copied());
    let mut systems = Vec::new();
    for &(emission, albedo) in channels {
        let emitted = emitted(emission);
        if emitted > 0.0 {
            let reflected = reflected(operator, &row_sums, albedo)?;
            let dark = DARK * options.tolerance * emitted / area;
            systems.push(System { operator, emission, albedo, emitted, reflected, dark });
        }
    }
    let mut states = State::begin(&systems, options.method)?;
    iterate(operator, &systems, &mut states, options)?;
    let mut solved = systems.iter().zip(states);
    let solution = |(emission, _): &(&[f64], &[f64])| match emitted(emission) > 0.0 {
        true => match solved.next() {
            Some((system, state)) => finish(system, state),
            None => unreachable!("a system for each channel that shines"),
        },
        false => Ok(Solution::dark(n, options.method)),
    };
    channels.iter().map(solution).collect()
}

/// Goes on until no system lacks more than may be wrong.
fn iterate<O: Operator>(
    operator: &O,
    systems: &[System<'_, O>],
    states: &mut [State],
    options: &SolveOptions,
) -> Result<(), LightError> {
    loop {
        let mut running = Vec::new();
        for (system, state) in systems.iter().zip(states.iter_mut()) {
            let (residual, iterations) = (state.residual, state.iterations);
            // NaN is not below the limit: it must not pass for a solution.
            let share = options.tolerance * system.loss();
            if residual <= share * system.emitted && state.worst <= MOST_OFF * share {
                continue;
            }
            if !residual.is_finite() {
                return Err(LightError::NotFinite { residual, iterations });
            }
            if iterations >= options.max_iterations {
                let (residual, tolerance) = (system.relative(residual), options.tolerance);
                return Err(LightError::NotConverged { iterations, residual, tolerance });
            }
            running.push((system, state));
        }
        if running.is_empty() {
            return Ok(());
        }
        let asked: Vec<_> = running.iter().map(|(system, state)| state.asks(system)).collect();
        let asked: Vec<&[f64]> = asked.iter().map(|b| &b[..]).collect();
        let applied = operator.apply_each(&asked)?;
        for ((system, state), applied) in running.into_iter().zip(applied) {
            state.step(system, applied);
        }
    }
}

/// Gives max ρ_i Σ_j G_ij / A_i, the share of light that one bounce leaves at the most; below 1.
fn reflected(
    operator: &impl Operator,
    row_sums: &[f64],
    albedo: &[f64],
) -> Result<f64, LightError> {
    let rows = row_sums.iter().zip(operator.areas()).zip(albedo);
    let shares = rows.map(|((sum, area), rho)| rho * sum / area);
    let most = shares.fold(0.0, |most, share| if share > most { share } else { most });
    // Rows are known no better than that.
    let doubt = f64::max(1e-12, 2.0 * operator.row_error());
    if most < 1.0 - doubt {
        Ok(most)
    } else {
        Err(LightError::NoFiniteSolution { reflected: most })
    }
}

struct System<'a, O> {
    operator: &'a O,
    emission: &'a [f64],
    albedo: &'a [f64],
    /// Σ A E.
    emitted: f64,
    /// What a bounce leaves of light at the most, a share of it.
    reflected: f64,
    /// The exitance that counts at the least.
    dark: f64,
}

impl<O: Operator> System<'_, O> {
    /// Gives what a bounce takes from light at the least, a share of it.
    fn loss(&self) -> f64 {
        1.0 - self.reflected
    }

    /// Gives the flux that a residual may leave out, as a share of what is emitted.
    fn relative(&self, residual: f64) -> f64 {
        residual / (self.emitted * self.loss())
    }

    /// Gives (ρ/A) v.
    fn reflect(&self, flux: &[f64]) -> Vec<f64> {
        let rows = self.albedo.iter().zip(self.operator.areas()).zip(flux);
        rows.map(|((rho, area), flux)| rho / area * flux).collect()
    }

    /// Sums ρ |r|: the flux that a residual stands for.
    fn size(&self, residual: &[f64]) -> f64 {
        sum(self.albedo.iter().zip(residual).map(|(rho, r)| rho * r.abs()))
    }

    /// Gives the largest share that steps, flux an area, have in what leaves an element; NaN where
    /// one is no number.
    fn worst(&self, x: &[f64], steps: impl Iterator<Item = f64>) -> f64 {
        let of_lit = |(b, step): (f64, f64)| step.abs() / b.max(self.dark);
        let shares = self.lit(x).into_iter().zip(steps).map(of_lit);
        shares.fold(0.0, |most, share| if share <= most { most } else { share })
    }

    /// Gives (A/ρ) x where something is reflected, else 0; x is 0 there.
    fn diagonal(&self, x: &[f64]) -> impl Iterator<Item = f64> {
        let rows = self.albedo.iter().zip(self.operator.areas()).zip(x);
        rows.map(|((&rho, area), x)| if rho > 0.0 { area / rho * x } else { 0.0 })
    }

    /// Gives E + x.
    fn lit(&self, x: &[f64]) -> Vec<f64> {
        self.emission.iter().zip(x).map(|(e, x)| e + x).collect()
    }
}

/// What iterations go on with.
struct State {
    method: Method,
    /// Light that has been reflected.
    x: Vec<f64>,
    /// G E + G x - (A/ρ) x, by conjugate gradients kept up to date; where nothing is reflected,
    /// what arrives.
    r: Vec<f64>,
    /// The direction of the next step.
    p: Vec<f64>,
    /// r · (ρ/A) r.
    rz: f64,
    residual: f64,
    /// What the residual is of the light of the element with the largest share of it.
    worst: f64,
    iterations: usize,
}

impl State {
    /// Begins with what all emit.
    fn begin<O: Operator>(
        systems: &[System<'_, O>],
        method: Method,
    ) -> Result<Vec<State>, LightError> {
        let Some(first) = systems.first() else { return Ok(Vec::new()) };
        let emission: Vec<&[f64]> = systems.iter().map(|system| system.emission).collect();
        let arriving = first.operator.apply_each(&emission)?;
        let states = systems.iter().zip(arriving).map(|(system, r)| {
            let p = system.reflect(&r);
            let (rz, residual) = (dot(&r, &p), system.size(&r));
            let x = vec![0.0; r.len()];
            let worst = system.worst(&x, p.iter().copied());
            State { method, x, r, p, rz, residual, worst, iterations: 0 }
        });
        Ok(states.collect())
    }

    /// Gives G (E + x): the residual says it, but that of Jacobi iteration is one bounce behind.
    fn arriving<O: Operator>(
        &self,
        system: &System<'_, O>,
        exitance: &[f64],
    ) -> Result<Vec<f64>, LightError> {
        if self.method == Method::Jacobi && self.iterations > 0 {
            return system.operator.apply(exitance);
        }
        Ok(self.r.iter().zip(system.diagonal(&self.x)).map(|(r, product)| r + product).collect())
    }

    /// Gives what the exchange is to be applied to next.
    fn asks<'s, O: Operator>(&'s self, system: &System<'_, O>) -> Cow<'s, [f64]> {
        match self.method {
            Method::ConjugateGradients => Cow::Borrowed(&self.p),
            Method::Jacobi => Cow::Owned(system.lit(&self.x)),
        }
    }

    /// Goes on with what was asked for.
    fn step<O: Operator>(&mut self, system: &System<'_, O>, mut applied: Vec<f64>) {
        self.iterations += 1;
        if self.method == Method::Jacobi {
            return self.jacobi_step(system, &applied);
        }
        let diagonal = system.diagonal(&self.p);
        applied.iter_mut().zip(diagonal).for_each(|(product, own)| *product = own - *product);
        let curvature = dot(&self.p, &applied);
        if curvature > 0.0 && self.rz / curvature < f64::INFINITY {
            self.conjugate_step(system, &applied, self.rz / curvature);
        } else {
            self.method = Method::Jacobi;
        }
    }

    fn conjugate_step<O: Operator>(&mut self, system: &System<'_, O>, product: &[f64], step: f64) {
        self.x.iter_mut().zip(&self.p).for_each(|(x, p)| *x += step * p);
        self.r.iter_mut().zip(product).for_each(|(r, product)| *r -= step * product);
        let z = system.reflect(&self.r);
        let rz = dot(&self.r, &z);
        let turn = rz / self.rz;
        self.p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + turn * *p);
        (self.rz, self.residual) = (rz, system.size(&self.r));
        self.worst = system.worst(&self.x, z.into_iter());
    }

    /// Adds one more bounce: x ← (ρ/A) G (E + x).
    fn jacobi_step<O: Operator>(&mut self, system: &System<'_, O>, arriving: &[f64]) {
        let next = system.reflect(arriving);
        let areas = system.operator.areas();
        let steps: Vec<f64> = next.iter().zip(&self.x).map(|(next, x)| next - x).collect();
        // What it was before this step; after it, less.
        self.residual = sum(steps.iter().zip(areas).map(|(step, a)| a * step.abs()));
        self.worst = system.worst(&next, steps.into_iter());
        self.x = next;
    }
}

/// Makes the solution of what has been reflected.
fn finish<O: Operator>(system: &System<'_, O>, state: State) -> Result<Solution, LightError> {
    let (areas, albedo) = (system.operator.areas(), system.albedo);
    let exitance = system.lit(&state.x);
    let flux = state.arriving(system, &exitance)?;
    let absorbed = sum(flux.iter().zip(albedo).map(|(flux, rho)| (1.0 - rho) * flux));
    let leaving = sum(areas.iter().zip(&exitance).map(|(area, b)| area * b));
    let escaped = leaving - sum(flux.iter().copied());
    let clipped = sum(state.x.iter().zip(areas).map(|(x, area)| area * (-x).max(0.0)));
    let lit = system.emission.iter().zip(&state.x).map(|(e, x)| e + x.max(0.0));
    Ok(Solution {
        exitance: lit.collect(),
        irradiance: flux.iter().zip(areas).map(|(flux, area)| flux.max(0.0) / area).collect(),
        iterations: state.iterations,
        reflected: system.reflected,
        residual: system.relative(state.residual),
        method: state.method,
        balance: FluxBalance { emitted: system.emitted, absorbed, escaped, clipped },
    })
}

impl Solution {
    /// Gives the light of a scene in which nothing shines.
    fn dark(n_elements: usize, method: Method) -> Solution {
        Solution {
            exitance: vec![0.0; n_elements],
            irradiance: vec![0.0; n_elements],
            iterations: 0,
            reflected: 0.0,
            residual: 0.0,
            method,
            balance: FluxBalance { emitted: 0.0, absorbed: 0.0, escaped: 0.0, clipped: 0.0 },
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    sum(a.iter().zip(b).map(|(a, b)| a * b))
}
