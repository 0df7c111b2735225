//! From materials and lamps to the light of a scene: plan first, then no more than planned.

use std::cell::Cell;
use std::path::PathBuf;
use std::sync::Arc;

use pvmap_query::Map;
use pvmap_store::Watch;

use crate::balance::{Balanced, Scaling, Scene};
use crate::element::Elements;
use crate::error::{LightError, check};
use crate::exchange::{Exchange, ExchangeStats};
use crate::incident::{Air, Incident, OpenSky};
use crate::lamp::{Lamp, Sky};
use crate::material::{Channel, Materials};
use crate::plan::{Effect, Plan, Wishes};
use crate::solve::{FluxBalance, Operator, Solution, SolveOptions, solve_each};
use crate::specular::{Thrown, ThrownFlux};
use crate::sum::sum;

/// What is lit, and how well.
#[derive(Debug, Clone)]
pub struct LightOptions {
    /// The error that light may have, as a share of it: 0.01 for one part in a hundred.
    pub error: f64,
    /// The share of all emitted flux that an effect must be worth.
    pub worth: f64,
    /// Whether pairs are taken one by one, the oracle of the grids.
    pub is_direct: bool,
    /// The order of grids, whatever the error asks for.
    pub order: Option<usize>,
    /// What is wanted of effects.
    pub wishes: Wishes,
    /// Memory that the exchange may take.
    pub memory_bytes: u64,
    /// Where its lists go, in nameless files, if they do not fit; none holds them all the same.
    pub spill_folder: Option<PathBuf>,
}

impl Default for LightOptions {
    fn default() -> LightOptions {
        LightOptions {
            error: 0.01,
            worth: 1e-3,
            is_direct: false,
            order: None,
            wishes: Wishes::default(),
            memory_bytes: 1 << 30,
            spill_folder: None,
        }
    }
}

/// A scene that is to be lit.
#[derive(Debug)]
pub struct Lighting<'a> {
    pub(crate) map: &'a Map<'a>,
    pub(crate) elements: Arc<Elements>,
    pub(crate) materials: Materials,
    pub(crate) lamps: Vec<Lamp>,
    pub(crate) sky: Option<Sky>,
    pub(crate) options: LightOptions,
}

/// A plan with what was prepared for it.
#[derive(Debug)]
pub struct Planned {
    /// What is to be computed.
    pub plan: Plan,
    pub(crate) exchange: Option<Exchange>,
    pub(crate) n_lamp_tries: u64,
}

/// What was touched at run time, counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Work {
    /// Segments tried between lamps and elements.
    pub n_lamp_segments: u64,
    /// Segments tried to the sky.
    pub n_sky_segments: u64,
    /// Times that the exchange of all elements was applied.
    pub n_applications: u64,
    /// Iterations of the solver, in all channels.
    pub n_iterations: u64,
    /// Channels.
    pub n_channels: u64,
    /// Pairs taken by quadrature.
    pub n_near_field: u64,
    /// Photons sent to what mirrors or lets light through.
    pub n_photons: u64,
}

/// The light of one channel.
#[derive(Debug, Clone, PartialEq)]
pub struct LitChannel {
    /// E and ρ.
    pub given: Channel,
    /// B = E + ρ H of each element.
    pub exitance: Vec<f64>,
    /// H of each element: from others, from lamps and from the sky.
    pub irradiance: Vec<f64>,
    /// Where the flux went, that of lamps and sky included.
    pub balance: FluxBalance,
}

/// A lit scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Lit {
    /// One channel, or red, green and blue.
    pub channels: Vec<LitChannel>,
    /// What arrives from lamps, in red, green and blue.
    pub from_lamps: [f64; 3],
    /// The share of open sky over each element; empty where it was not called for.
    pub open_sky: Vec<f32>,
    /// What mirrors and lenses sent on, by channel; empty where nothing was.
    pub thrown: Vec<ThrownFlux>,
    /// What they would have sent on of reflected light if it had not been enough by then, as a
    /// share of what is emitted and arrives; 0 where it came to an end by itself.
    pub left_to_throw: f64,
    /// The scaling of the exchange, one number an element; 1 where nothing was exchanged.
    pub scale: Vec<f64>,
    /// The order of the grids; none where pairs were taken one by one, or not at all.
    pub order: Option<usize>,
    /// The mean error of what grids bring to 64 elements, as a share of what arrives there.
    pub operator_error: f64,
    /// By how much rows of the exchange are off, as a share of all area.
    pub row_error: f64,
    /// Iterations of the solver, in the channel with the most.
    pub iterations: usize,
    /// The share of light that a bounce leaves at the most, in the channel with the most.
    pub reflected: f64,
    /// Flux that may be missing, as a share of what is emitted.
    pub residual: f64,
    /// What was touched.
    pub work: Work,
    /// What the exchange took.
    pub stats: ExchangeStats,
}

/// Elements at which grids are compared with the sum pair by pair.
const N_COMPARED: usize = 64;
/// What is solved, once or again.
#[derive(Clone, Copy)]
pub(crate) struct Solved<'s> {
    pub(crate) plan: &'s Plan,
    pub(crate) balanced: Option<&'s Balanced<'s>>,
    pub(crate) channels: &'s [Channel],
}

/// The part of what an exchange may be off by that is for its rows.
const ROW_SHARE: f64 = 0.5;
/// Rows are scaled at the most so often; in a closed box five leave 1e-3.
const MAX_SCALINGS: usize = 20;

impl<'a> Lighting<'a> {
    /// Takes a map, materials for its surfels, lamps and a sky.
    ///
    /// # Errors
    /// Where the map is damaged or materials do not fit it.
    pub fn new(
        map: &'a Map<'a>,
        elements: Elements,
        materials: Materials,
        lamps: Vec<Lamp>,
        sky: Option<Sky>,
        options: LightOptions,
    ) -> Result<Lighting<'a>, LightError> {
        materials.check(&elements)?;
        let range = "above 0 and below 1";
        for (what, value) in [("the error", options.error), ("the worth", options.worth)] {
            if !(value > 0.0 && value < 1.0) {
                return Err(LightError::Setting { what, value, range });
            }
        }
        let elements = Arc::new(elements);
        Ok(Lighting { map, elements, materials, lamps, sky, options })
    }

    /// Gives the largest albedo of all channels.
    pub(crate) fn max_albedo(&self) -> f64 {
        let all = self.materials.channels.iter().flat_map(|channel| &channel.albedo);
        all.copied().fold(0.0, f64::max)
    }

    /// Gives what an exchange may be off by: operator errors grow by ρ / (1 - ρ), and the solver
    /// has a quarter of the error.
    pub(crate) fn operator_tolerance(&self) -> f64 {
        let rho = self.max_albedo().max(0.1);
        self.options.error * (1.0 - rho) / rho
    }

    /// Gives what rows of the exchange may be off by, as a share of all area.
    pub fn row_tolerance(&self) -> f64 {
        ROW_SHARE * self.operator_tolerance()
    }

    /// Computes what was planned. `scaling` is that of an earlier run for the same map: it is not
    /// found again, unless a smaller error is asked for now than it is good for.
    ///
    /// # Errors
    /// Where the map is damaged, there is no finite solution, or the run is asked to stop.
    pub fn run(
        &self,
        planned: &Planned,
        scaling: Option<Scaling>,
        watch: &dyn Watch,
    ) -> Result<Lit, LightError> {
        let plan = &planned.plan;
        let n = self.elements.len();
        let mut work = Work { n_lamp_segments: planned.n_lamp_tries, ..Work::default() };
        let (incident, open, from_lamps) = self.incident(plan, &mut work, watch)?;
        let channels = self.channels(plan.is_on(Effect::Color));
        let mut lit = Lit {
            channels: Vec::new(),
            from_lamps,
            open_sky: open.share,
            thrown: Vec::new(),
            left_to_throw: 0.0,
            scale: vec![1.0; n],
            order: None,
            operator_error: 0.0,
            row_error: 0.0,
            iterations: 0,
            reflected: 0.0,
            residual: 0.0,
            work,
            stats: ExchangeStats::default(),
        };
        lit.work.n_channels = channels.len() as u64;
        let balanced = match &planned.exchange {
            Some(exchange) => Some(self.balanced(exchange, plan, scaling, &mut lit, watch)?),
            None => None,
        };
        let mut incident: Vec<Vec<f64>> = (0..channels.len())
            .map(|index| channel_of(&incident, index, plan.is_on(Effect::Color)))
            .collect();
        let from_outside: Vec<f64> = incident.iter().map(|h| self.flux_of(h)).collect();
        let scene = Solved { plan, balanced: balanced.as_ref(), channels: &channels };
        let thrown = match self.materials.has_gloss() {
            true => self.throw(&scene, &mut incident, &mut lit, watch)?,
            false => Thrown::default(),
        };
        if lit.channels.is_empty() {
            self.solve_all(&scene, &incident, &mut lit, watch)?;
        }
        for (index, channel) in lit.channels.iter_mut().enumerate() {
            let flux = thrown.flux.get(index).copied().unwrap_or_default();
            let outside = from_outside.get(index).copied().unwrap_or(0.0);
            // What was thrown is counted where it came from, and glossy elements did not keep it.
            channel.balance.emitted = self.flux_of(&channel.given.emission) + outside;
            channel.balance.absorbed -= flux.resent;
            channel.balance.escaped += flux.escaped;
        }
        lit.work.n_photons = thrown.n_photons;
        lit.thrown = thrown.flux;
        Ok(lit)
    }

    /// Solves all channels for what arrives from outside.
    pub(crate) fn solve_all(
        &self,
        scene: &Solved<'_>,
        incident: &[Vec<f64>],
        lit: &mut Lit,
        watch: &dyn Watch,
    ) -> Result<(), LightError> {
        let found = match scene.balanced {
            Some(balanced) => self.exchanged(scene, balanced, incident, lit, watch)?,
            None => Vec::new(),
        };
        let channel = |(index, given): (usize, &Channel)| {
            self.channel(given, &incident[index], found.get(index))
        };
        lit.channels = scene.channels.iter().enumerate().map(channel).collect();
        Ok(())
    }

    /// Finds what elements exchange, in all channels.
    fn exchanged(
        &self,
        scene: &Solved<'_>,
        balanced: &Balanced<'_>,
        incident: &[Vec<f64>],
        lit: &mut Lit,
        watch: &dyn Watch,
    ) -> Result<Vec<Solution>, LightError> {
        watch.stage("solve", None, "rounds");
        let has_bounces = scene.plan.is_on(Effect::Bounces);
        let nothing = vec![0.0; self.elements.len()];
        // What arrives from outside is as good as emitted where it is reflected; without bounces
        // others see what shines by itself alone.
        let shining = |(given, incident): (&Channel, &Vec<f64>)| -> Vec<f64> {
            let rows = given.emission.iter().zip(&given.albedo).zip(incident);
            rows.map(|((e, rho), h)| if has_bounces { e + rho * h } else { *e }).collect()
        };
        let shining: Vec<_> = scene.channels.iter().zip(incident).map(shining).collect();
        let given = shining.iter().zip(scene.channels).map(|(shining, given)| {
            (&shining[..], if has_bounces { &given.albedo[..] } else { &nothing[..] })
        });
        let given: Vec<_> = given.collect();
        let absorbs = |albedo: &[f64]| albedo.iter().any(|&rho| rho < 1.0);
        if scene.plan.let_out() == Some(0.0) && !given.iter().all(|given| absorbs(given.1)) {
            // Rows that scaling left a little short are no way out.
            return Err(LightError::NoFiniteSolution { reflected: 1.0 });
        }
        // Below an albedo of 1 it does not matter by how much a row is less than its area.
        let needs_rows = scene.channels.iter().any(|given| given.albedo.contains(&1.0));
        let operator = Watched { balanced, watch, needs_rows, n_applications: Cell::new(0) };
        let found = solve_each(&operator, &given, &self.solve_options())?;
        lit.work.n_applications += operator.n_applications.get();
        for found in &found {
            lit.work.n_iterations += found.iterations as u64;
            lit.iterations = lit.iterations.max(found.iterations);
            lit.reflected = lit.reflected.max(found.reflected);
            lit.residual = lit.residual.max(found.residual);
        }
        lit.operator_error =
            found.first().map_or(0.0, |first| self.operator_error(balanced, first));
        Ok(found)
    }

    /// Sums what arrives at all elements.
    pub(crate) fn flux_of(&self, irradiance: &[f64]) -> f64 {
        sum(self.elements.areas().iter().zip(irradiance).map(|(a, h)| a * h))
    }

    /// Gives what arrives from lamps and sky, and the flux of lamps alone.
    fn incident(
        &self,
        plan: &Plan,
        work: &mut Work,
        watch: &dyn Watch,
    ) -> Result<(Incident, OpenSky, [f64; 3]), LightError> {
        let n = self.elements.len();
        let air = Air::new(self.map, &self.elements);
        let mut incident =
            Incident { irradiance: [0, 1, 2].map(|_| vec![0.0; n]), ..Incident::default() };
        if plan.is_on(Effect::Direct) && !self.lamps.is_empty() {
            let n_rows = (n * self.lamps.len()) as u64;
            watch.stage("lamps", Some(n_rows), "surfels");
            // Where no shadows are wanted more arrives than rays would bring.
            let is_bounded = self.options.wishes.of(Effect::Occlusion) != Some(false);
            let how = (plan.is_on(Effect::Occlusion), is_bounded);
            incident = air.lamps(&self.lamps, how, watch)?;
            work.n_lamp_segments += incident.n_segments;
        }
        let from_lamps =
            [0, 1, 2].map(|channel: usize| self.flux_of(&incident.irradiance[channel]));
        let mut open = OpenSky::default();
        if plan.is_on(Effect::Sky) {
            watch.stage("sky", Some(n as u64), "surfels");
            let nowhere = Sky { radiance: [0.0; 3], up: [0.0, 0.0, 1.0] };
            let sky = self.sky.unwrap_or(nowhere);
            open = air.sky(sky.up, watch)?;
            work.n_sky_segments = open.n_segments;
            incident.add_sky(&sky, &open);
        }
        Ok((incident, open, from_lamps))
    }

    /// Gives the channels that are computed: three, or their mean.
    fn channels(&self, has_color: bool) -> Vec<Channel> {
        let all = &self.materials.channels;
        if has_color {
            return all.to_vec();
        }
        let mean = |of: fn(&Channel) -> &Vec<f64>| {
            let [r, g, b] = [0, 1, 2].map(|c| of(&all[c]));
            r.iter().zip(g).zip(b).map(|((r, g), b)| mean([*r, *g, *b])).collect()
        };
        vec![Channel { emission: mean(|c| &c.emission), albedo: mean(|c| &c.albedo) }]
    }

    /// Scales the exchange, or takes the scale of before.
    fn balanced<'e>(
        &self,
        exchange: &'e Exchange,
        plan: &Plan,
        scaling: Option<Scaling>,
        lit: &mut Lit,
        watch: &dyn Watch,
    ) -> Result<Balanced<'e>, LightError> {
        watch.stage("scale", None, "rounds");
        let scene = if plan.let_out().is_some() { Scene::Closed } else { Scene::Open };
        let tolerance = self.row_tolerance();
        let is_good = |scaling: &Scaling| {
            scaling.row_error <= tolerance || scaling.error <= self.options.error
        };
        let balanced = match scaling.filter(is_good) {
            Some(scaling) => {
                let (some, doubt) = (self.some(N_COMPARED), self.operator_tolerance());
                Balanced::again(exchange, scene, scaling, (&some, doubt))?
            }
            None => Balanced::on_average(exchange, scene, (tolerance, MAX_SCALINGS), watch)?,
        };
        lit.scale = balanced.scale().to_vec();
        lit.row_error = balanced.row_error();
        lit.order = exchange.order();
        lit.stats = exchange.stats();
        lit.work.n_near_field = exchange.n_near_field();
        lit.work.n_applications += balanced.n_applications();
        Ok(balanced.letting_out(plan.let_out().unwrap_or(0.0)))
    }

    /// Joins what arrives from outside and what elements exchange.
    fn channel(&self, given: &Channel, incident: &[f64], found: Option<&Solution>) -> LitChannel {
        let areas = self.elements.areas();
        let from_others = found.map_or(&[][..], |found| &found.irradiance);
        let mut irradiance = incident.to_vec();
        irradiance.iter_mut().zip(from_others).for_each(|(h, more)| *h += more);
        let rows = given.emission.iter().zip(&given.albedo).zip(&irradiance);
        let exitance: Vec<f64> = rows.map(|((e, rho), h)| e + rho * h).collect();
        let emitted = self.flux_of(&given.emission) + self.flux_of(incident);
        let rows = areas.iter().zip(&irradiance).zip(&given.albedo);
        let absorbed = sum(rows.map(|((a, h), rho)| a * h * (1.0 - rho)));
        let escaped = self.flux_of(&exitance) - self.flux_of(from_others);
        let clipped = found.map_or(0.0, |found| found.balance.clipped);
        let balance = FluxBalance { emitted, absorbed, escaped, clipped };
        LitChannel { given: given.clone(), exitance, irradiance, balance }
    }

    /// Says how far the grids are off at some elements, lit as they are.
    fn operator_error(&self, balanced: &Balanced<'_>, found: &Solution) -> f64 {
        let scale = balanced.scale();
        let b: Vec<f64> = found.exitance.iter().zip(scale).map(|(b, d)| b * d).collect();
        let rows = found.irradiance.iter().zip(self.elements.areas()).zip(scale);
        let flux: Vec<f64> = rows.map(|((h, area), d)| h * area / d).collect();
        balanced.exchange().error_at(&self.some(N_COMPARED), &b, &flux)
    }

    fn solve_options(&self) -> SolveOptions {
        SolveOptions { tolerance: 0.25 * self.options.error, ..SolveOptions::default() }
    }
}

/// An exchange that tells when it is applied, and stops when asked to.
struct Watched<'e, 'w> {
    balanced: &'e Balanced<'e>,
    watch: &'w dyn Watch,
    needs_rows: bool,
    n_applications: Cell<u64>,
}

impl Operator for Watched<'_, '_> {
    fn areas(&self) -> &[f64] {
        self.balanced.areas()
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        Ok(self.apply_each(&[b])?.swap_remove(0))
    }

    fn apply_each(&self, b: &[&[f64]]) -> Result<Vec<Vec<f64>>, LightError> {
        check(self.watch)?;
        let flux = self.balanced.apply_each(b)?;
        self.n_applications.set(self.n_applications.get() + 1);
        self.watch.advance(1);
        Ok(flux)
    }

    fn row_sums(&self) -> Result<Vec<f64>, LightError> {
        if self.needs_rows { self.balanced.row_sums() } else { Ok(self.areas().to_vec()) }
    }

    fn row_error(&self) -> f64 {
        Operator::row_error(self.balanced)
    }
}

/// Gives what arrives from outside in one channel: one of three, or their mean.
fn channel_of(incident: &Incident, index: usize, has_color: bool) -> Vec<f64> {
    let [r, g, b] = &incident.irradiance;
    if has_color {
        return [r, g, b][index].clone();
    }
    r.iter().zip(g).zip(b).map(|((r, g), b)| mean([*r, *g, *b])).collect()
}

/// Gives the mean of three numbers; of three equal ones the number itself.
pub(crate) fn mean([r, g, b]: [f64; 3]) -> f64 {
    r + ((g - r) + (b - r)) / 3.0
}
