//! Scaling an exchange so that every element gets the light there is, and no more.

use std::cell::Cell;

use pvmap_store::{Quiet, Watch};
use rayon::prelude::*;

use crate::error::{LightError, check};
use crate::exchange::Exchange;
use crate::material::check_each;
use crate::refine::{Refined, refine};
use crate::solve::Operator;
use crate::sum::sum;

/// How much rows are scaled up at the most where it is rows on average that count: of elements on
/// thin limbs, which see little more than the inside, what they see would be made into all.
const MAX_SCALE: f64 = 2.0;

/// Scaling ends where a round leaves more than this of what rows are off by on average.
const STALLED: f64 = 0.9;
/// Tolerances of rows up to which each one counts, not their mean: who asks for so little asks for
/// it everywhere.
const EACH: f64 = 1e-5;
/// How many times their mean rows of some elements may be off.
const SAMPLE_DOUBT: f64 = 4.0;

/// What surrounds the elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scene {
    /// Elements all around: what leaves one arrives at others, Σ_j G_ij = A_i.
    Closed,
    /// Light may escape: Σ_j G_ij ≤ A_i.
    Open,
}

/// An exchange G' = D G D, D a diagonal that makes its rows add up; as symmetric as G.
///
/// Without it rows of a closed scene add up to 0.96 to 1.24, more light or less with each bounce,
/// and points at random give radiosities from -152 to 83 where 5 is right.
#[derive(Debug)]
pub struct Balanced<'a> {
    exchange: &'a Exchange,
    scale: Vec<f64>,
    /// Σ_j G'_ij; empty where it was not computed.
    row_sums: Vec<f64>,
    row_error: f64,
    iterations: usize,
}

/// A scaling of an exchange, kept from one run to the next.
#[derive(Debug, Clone, PartialEq)]
pub struct Scaling {
    /// D, a number above 0 each element.
    pub scale: Vec<f64>,
    /// By how much rows are off with it, as a share of all area.
    pub row_error: f64,
    /// The error that was asked for when it was found.
    pub error: f64,
}

impl<'a> Balanced<'a> {
    /// Scales until no row is off by more than `tolerance` of its area, or `max_iterations` times:
    /// d_i ← d_i √(A_i / (d_i (G d)_i)), in an open scene no more than 1. Rows that add up to
    /// nothing stay so.
    ///
    /// # Errors
    /// Where the tolerance is negative or not finite.
    pub fn new(
        exchange: &'a Exchange,
        scene: Scene,
        tolerance: f64,
        max_iterations: usize,
    ) -> Result<Balanced<'a>, LightError> {
        if !(0.0..f64::INFINITY).contains(&tolerance) {
            let (what, range) = ("the tolerance of rows", "0 or more");
            return Err(LightError::Setting { what, value: tolerance, range });
        }
        let areas = exchange.elements().areas();
        let is_enough = |rows: &[f64]| row_error(scene, areas, rows) <= tolerance;
        Balanced::until(exchange, scene, (max_iterations, f64::INFINITY), &Quiet, &is_enough)
    }

    /// Scales until rows are off by no more than `tolerance` of all area on average, while that
    /// helps and at most `max_iterations` times, and then down what is still too large: some rows
    /// of narrow corners take hundreds of rounds, and light must not grow there meanwhile. Where
    /// the tolerance is very small, each row is brought as near in between.
    pub(crate) fn on_average(
        exchange: &'a Exchange,
        scene: Scene,
        (tolerance, max_iterations): (f64, usize),
        watch: &dyn Watch,
    ) -> Result<Balanced<'a>, LightError> {
        let areas = exchange.elements().areas();
        let last = Cell::new(f64::INFINITY);
        let is_enough = |rows: &[f64]| {
            let off = mean_error(scene, areas, rows);
            off <= tolerance || off > STALLED * last.replace(off)
        };
        let mut balanced =
            Balanced::until(exchange, scene, (max_iterations, MAX_SCALE), watch, &is_enough)?;
        if scene == Scene::Closed && tolerance <= EACH {
            balanced.refine(tolerance, watch)?;
        }
        for (d, (sum, area)) in balanced.scale.iter_mut().zip(balanced.row_sums.iter().zip(areas)) {
            // The others can only get less, too, so that no row is too large then.
            *d *= if sum > area { area / sum } else { 1.0 };
        }
        balanced.row_sums = row_sums(exchange, &balanced.scale)?;
        balanced.row_error = mean_error(scene, areas, &balanced.row_sums);
        balanced.iterations += 1;
        Ok(balanced)
    }

    /// Goes on until each row is right that may be.
    fn refine(&mut self, tolerance: f64, watch: &dyn Watch) -> Result<(), LightError> {
        let from = (std::mem::take(&mut self.scale), std::mem::take(&mut self.row_sums));
        let Refined { scale, row_sums, n_applications } =
            refine(self.exchange, from, tolerance, watch)?;
        (self.scale, self.row_sums) = (scale, row_sums);
        self.iterations += n_applications;
        Ok(())
    }

    fn until(
        exchange: &'a Exchange,
        scene: Scene,
        (max_iterations, max_scale): (usize, f64),
        watch: &dyn Watch,
        is_enough: &dyn Fn(&[f64]) -> bool,
    ) -> Result<Balanced<'a>, LightError> {
        let areas = exchange.elements().areas();
        let mut scale = vec![1.0; areas.len()];
        let mut iterations = 0;
        loop {
            check(watch)?;
            let row_sums = row_sums(exchange, &scale)?;
            watch.advance(1);
            if is_enough(&row_sums) || iterations == max_iterations {
                let row_error = row_error(scene, areas, &row_sums);
                return Ok(Balanced { exchange, scale, row_sums, row_error, iterations });
            }
            for ((d, &sum), &area) in scale.iter_mut().zip(&row_sums).zip(areas) {
                let next = if sum > 0.0 { *d * (area / sum).sqrt() } else { *d };
                *d = next.min(if scene == Scene::Open { 1.0 } else { max_scale });
            }
            iterations += 1;
        }
    }

    /// Takes a scaling that was found before for the same exchange; what rows fall short is as it
    /// was then.
    ///
    /// # Errors
    /// Where there is not a number above 0 an element, or rows of the elements `some` are off by
    /// more than `tolerance` beyond what they were: it was found for another exchange.
    pub(crate) fn again(
        exchange: &'a Exchange,
        scene: Scene,
        Scaling { scale, row_error, .. }: Scaling,
        (some, tolerance): (&[u32], f64),
    ) -> Result<Balanced<'a>, LightError> {
        let areas = exchange.elements().areas();
        check_each(areas.len(), "the scale", "above 0", &scale, |d| d > 0.0 && d.is_finite())?;
        let row =
            |&id: &u32| (areas[id as usize], scale[id as usize] * exchange.flux_at(id, &scale));
        let (areas, rows): (Vec<f64>, Vec<f64>) = some.par_iter().map(row).unzip();
        let off = mean_error(scene, &areas, &rows);
        if off > SAMPLE_DOUBT * row_error + tolerance {
            return Err(LightError::OtherScaling { off, row_error });
        }
        Ok(Balanced { exchange, scale, row_sums: Vec::new(), row_error, iterations: 0 })
    }

    /// Lets a share of what leaves each element escape: a scene that is closed but for small
    /// openings.
    pub(crate) fn letting_out(mut self, share: f64) -> Balanced<'a> {
        let by = (1.0 - share).sqrt();
        self.scale.iter_mut().for_each(|d| *d *= by);
        self.row_sums.iter_mut().for_each(|sum| *sum *= 1.0 - share);
        self
    }

    /// Gives what is scaled.
    pub(crate) fn exchange(&self) -> &Exchange {
        self.exchange
    }

    /// Gives the share of its area by which a row is off at the most.
    pub fn row_error(&self) -> f64 {
        self.row_error
    }

    /// Counts how often rows were scaled.
    pub fn iterations(&self) -> usize {
        self.iterations
    }

    /// Counts how often the exchange was applied to find the scaling.
    pub(crate) fn n_applications(&self) -> u64 {
        match self.iterations {
            0 => 0,
            n => n as u64 + 1,
        }
    }

    /// Gives D.
    pub fn scale(&self) -> &[f64] {
        &self.scale
    }
}

/// Gives Σ_j d_i G_ij d_j of each element.
fn row_sums(exchange: &Exchange, scale: &[f64]) -> Result<Vec<f64>, LightError> {
    Ok(scale.iter().zip(exchange.apply(scale)?).map(|(d, sum)| d * sum).collect())
}

/// Gives by how much rows are off, as a share of all area; in an open scene, too large.
fn mean_error(scene: Scene, areas: &[f64], row_sums: &[f64]) -> f64 {
    let rows = || areas.iter().zip(row_sums).filter(|(_, sum)| **sum != 0.0);
    let off = rows().map(|(area, sum)| match scene {
        Scene::Closed => (sum - area).abs(),
        Scene::Open => (sum - area).max(0.0),
    });
    let all = sum(rows().map(|(area, _)| *area));
    if all > 0.0 { sum(off) / all } else { 0.0 }
}

/// Gives the share of its area by which a row is off at the most; in an open scene, too large.
fn row_error(scene: Scene, areas: &[f64], row_sums: &[f64]) -> f64 {
    let off = areas.iter().zip(row_sums).filter(|(_, sum)| **sum != 0.0).map(|(area, sum)| {
        let off = sum / area - 1.0;
        if scene == Scene::Closed { off.abs() } else { off.max(0.0) }
    });
    // A row that is no number must not pass for a good one.
    off.fold(0.0, |most, off| if off > most || off.is_nan() { off } else { most })
}

impl Operator for Balanced<'_> {
    fn areas(&self) -> &[f64] {
        self.exchange.elements().areas()
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        Ok(self.apply_each(&[b])?.swap_remove(0))
    }

    fn apply_each(&self, b: &[&[f64]]) -> Result<Vec<Vec<f64>>, LightError> {
        let times_scale =
            |v: &[f64]| -> Vec<f64> { v.iter().zip(&self.scale).map(|(v, d)| v * d).collect() };
        let scaled: Vec<Vec<f64>> = b.iter().map(|b| times_scale(b)).collect();
        let scaled: Vec<&[f64]> = scaled.iter().map(|b| &b[..]).collect();
        let flux = Operator::apply_each(self.exchange, &scaled)?;
        Ok(flux.iter().map(|flux| times_scale(flux)).collect())
    }

    fn row_sums(&self) -> Result<Vec<f64>, LightError> {
        if self.row_sums.len() == self.scale.len() {
            return Ok(self.row_sums.clone());
        }
        row_sums(self.exchange, &self.scale)
    }

    fn row_error(&self) -> f64 {
        // What they fall short does not make light grow.
        row_error(Scene::Open, self.exchange.elements().areas(), &self.row_sums)
    }
}

impl Operator for Exchange {
    fn areas(&self) -> &[f64] {
        self.elements().areas()
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        Exchange::apply(self, b)
    }

    fn apply_each(&self, b: &[&[f64]]) -> Result<Vec<Vec<f64>>, LightError> {
        Exchange::apply_each(self, b)
    }
}
