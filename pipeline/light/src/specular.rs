//! Light that mirrors and lenses throw: photons from what is lit, by way of what is glossy.
//!
//! Flux is not sampled: what arrives at each glossy element is what the exchange sends there. The
//! photons only share it out among directions: from a place on a source that is linked to the
//! element through a place on the element, on by reflection or refraction, and at last onto the
//! elements around the place that is hit. No photon goes where nothing glossy is.

use std::f64::consts::PI;

use fastrand::Rng;
use pvmap_store::Watch;
use rayon::prelude::*;

use crate::balance::Balanced;
use crate::element::Element;
use crate::error::{LightError, check};
use crate::hierarchy::Span;
use crate::incident::{Air, OpenSquares};
use crate::lamp::{Lamp, Sky};
use crate::lighting::mean;
use crate::optics::{Optics, SPREAD_RADII};
use crate::solve::Operator;
use crate::sum::sum;
use crate::vector::{add, beside, norm, scale, sub};

/// Glossy elements whose photons are traced before what they bring is added up.
const CHUNK: usize = 64;
/// Glossy surfaces that a photon meets at the most.
const MAX_DEPTH: u32 = 8;
/// What shines at glossy elements: exitance by channel, lamps, and the sky with the share of it
/// that is open over each element.
pub(crate) struct Shining<'a> {
    pub(crate) exitance: &'a [Vec<f64>],
    pub(crate) lamps: &'a [Lamp],
    pub(crate) sky: Option<(&'a Sky, &'a [f32])>,
}

/// Flux that mirrors and lenses sent on: what was not absorbed there.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ThrownFlux {
    /// All of it; what meets several of them is counted at each.
    pub resent: f64,
    /// What arrived at elements.
    pub landed: f64,
    /// What went into the open.
    pub escaped: f64,
}

/// What photons brought.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Thrown {
    /// Flux an area of each element, by channel.
    pub(crate) irradiance: Vec<Vec<f64>>,
    /// By channel.
    pub(crate) flux: Vec<ThrownFlux>,
    /// Photons.
    pub(crate) n_photons: u64,
}

impl Thrown {
    /// Adds what another pass brought to what arrives.
    pub(crate) fn add(&mut self, more: Thrown, incident: &mut [Vec<f64>]) {
        for (incident, thrown) in incident.iter_mut().zip(&more.irradiance) {
            incident.iter_mut().zip(thrown).for_each(|(h, more)| *h += more);
        }
        self.flux.resize(more.flux.len(), ThrownFlux::default());
        for (all, more) in self.flux.iter_mut().zip(more.flux) {
            all.resent += more.resent;
            all.landed += more.landed;
            all.escaped += more.escaped;
        }
        self.n_photons += more.n_photons;
    }
}

/// What glossy elements do with light.
pub(crate) struct Specular<'a> {
    pub(crate) optics: Optics<'a>,
    /// None where elements send each other nothing: lamps may shine.
    pub(crate) balanced: Option<&'a Balanced<'a>>,
    /// Photons of the pass that brings most, about.
    pub(crate) n_photons: u64,
}

/// Where photons to a glossy element come from.
enum Source<'a> {
    Element(u32),
    Lamp(&'a Lamp),
    Sky(&'a OpenSquares),
}

/// What the photons of one glossy element brought: flux by element and channel.
#[derive(Default)]
struct Brought {
    deposits: Vec<(u32, [f64; 3])>,
    resent: [f64; 3],
    escaped: [f64; 3],
    n_photons: u64,
}

impl Specular<'_> {
    /// Sends what arrives at glossy elements on to where it is thrown.
    ///
    /// `most` is the flux that arrived in the pass that brought most so far: one that brings less
    /// gets fewer photons, for what it adds to the error is less, too.
    pub(crate) fn pass(
        &self,
        shining: &Shining<'_>,
        most: &mut f64,
        watch: &dyn Watch,
    ) -> Result<Thrown, LightError> {
        let (n, n_channels) = (self.optics.elements.len(), shining.exitance.len());
        let zeros = vec![vec![0.0; n]; n_channels];
        let none = vec![ThrownFlux::default(); n_channels];
        let mut thrown = Thrown { irradiance: zeros, flux: none, n_photons: 0 };
        let flux = self.flux_from_elements(shining.exitance)?;
        let of_outside = self.flux_from_outside(shining, n_channels, watch)?;
        let glossy = self.glossy();
        let arriving = |k: usize| {
            let id = glossy[k] as usize;
            let outside: f64 = of_outside[k].iter().map(total).sum();
            flux.iter().map(|channel| channel[id]).sum::<f64>() + outside
        };
        let all: f64 = (0..glossy.len()).map(arriving).sum();
        if all <= 0.0 {
            return Ok(thrown);
        }
        *most = most.max(all);
        let n_photons = self.n_photons as f64 * all / *most;
        let one = |k: usize| {
            check(watch)?;
            let id = glossy[k] as usize;
            let mut here = [0.0; 3];
            flux.iter().zip(&mut here).for_each(|(channel, to)| *to = channel[id]);
            let share = arriving(k) / all;
            let n_photons = (share * n_photons).ceil() as u64;
            self.photons_by(glossy[k], here, &of_outside[k], (shining, n_photons))
        };
        for first in (0..glossy.len()).step_by(CHUNK) {
            let range = first..glossy.len().min(first + CHUNK);
            let n_done = range.len() as u64;
            let brought = range.into_par_iter().map(one).collect::<Result<Vec<_>, LightError>>()?;
            watch.advance(n_done);
            for Brought { deposits, resent, escaped, n_photons } in brought {
                for (to, flux) in deposits {
                    let area = self.optics.elements.areas()[to as usize];
                    for (channel, flux) in thrown.irradiance.iter_mut().zip(flux) {
                        channel[to as usize] += flux / area;
                    }
                }
                for (channel, flux) in thrown.flux.iter_mut().enumerate() {
                    flux.resent += resent[channel];
                    flux.escaped += escaped[channel];
                }
                thrown.n_photons += n_photons;
            }
        }
        for (flux, irradiance) in thrown.flux.iter_mut().zip(&thrown.irradiance) {
            let rows = irradiance.iter().zip(self.optics.elements.areas());
            flux.landed = sum(rows.map(|(h, area)| h * area));
        }
        Ok(thrown)
    }

    /// Gives what glossy elements would send on of what elements emit, all channels together.
    pub(crate) fn resent_of(&self, exitance: &[Vec<f64>]) -> Result<f64, LightError> {
        let flux = self.flux_from_elements(exitance)?;
        let glossy = self.glossy();
        let of_channel = |flux: &Vec<f64>| {
            sum(glossy.iter().map(|&id| self.optics.taken(id) * flux[id as usize]))
        };
        Ok(flux.iter().map(of_channel).sum())
    }

    /// Lists the elements that mirror or let light through.
    pub(crate) fn glossy(&self) -> Vec<u32> {
        (0..self.optics.elements.len() as u32).filter(|&id| self.optics.taken(id) > 0.0).collect()
    }

    /// Gives what arrives at every element from others, by channel.
    fn flux_from_elements(&self, exitance: &[Vec<f64>]) -> Result<Vec<Vec<f64>>, LightError> {
        let one = |exitance: &Vec<f64>| match self.balanced {
            Some(balanced) if exitance.iter().any(|&b| b > 0.0) => balanced.apply(exitance),
            _ => Ok(vec![0.0; exitance.len()]),
        };
        exitance.iter().map(one).collect()
    }

    /// Gives what arrives at each glossy element from each lamp, and at last from the sky.
    fn flux_from_outside(
        &self,
        shining: &Shining<'_>,
        n_channels: usize,
        watch: &dyn Watch,
    ) -> Result<Vec<Vec<[f64; 3]>>, LightError> {
        let air = Air::new(self.optics.map, self.optics.elements);
        let one = |&id: &u32| {
            check(watch)?;
            let area = self.optics.elements.areas()[id as usize];
            let flux = |irradiance: [f64; 3]| match n_channels {
                3 => scale(irradiance, area),
                _ => [mean(irradiance) * area, 0.0, 0.0],
            };
            let of_lamp = |lamp: &Lamp| Ok(flux(air.of_lamp(lamp, id)?));
            let of_sky = shining.sky.map(|(sky, open)| {
                Ok(flux(scale(sky.radiance, PI * f64::from(open[id as usize]))))
            });
            let of_lamps = shining.lamps.iter().map(of_lamp);
            of_lamps.chain(of_sky).collect::<Result<Vec<_>, LightError>>()
        };
        self.glossy().par_iter().map(one).collect()
    }

    /// Traces the photons of one glossy element, at which `flux` arrives from elements and more
    /// from outside: from each lamp, then from the sky.
    fn photons_by(
        &self,
        id: u32,
        flux: [f64; 3],
        of_outside: &[[f64; 3]],
        (shining, n_photons): (&Shining<'_>, u64),
    ) -> Result<Brought, LightError> {
        let mut rng = Rng::with_seed(u64::from(id));
        let mut brought = Brought::default();
        let sources = self.sources_of(id, shining);
        let weight: f64 = sources.iter().map(|source| total(&source.1)).sum();
        let all = total(&flux) + of_outside.iter().map(total).sum::<f64>();
        let share = |part: f64| (n_photons as f64 * part / all).ceil() as u64;
        if weight > 0.0 && total(&flux) > 0.0 {
            let n = share(total(&flux));
            // Each photon has the colour of where it comes from; all of them together have what
            // arrives.
            let picks = pick(&sources, weight, n, &mut rng);
            let mut sums = [0.0; 3];
            for &index in &picks {
                let color = sources[index].1;
                let by = total(&color);
                (0..3).for_each(|c| sums[c] += color[c] / by);
            }
            for &index in &picks {
                let (from, color) = sources[index];
                let by = total(&color);
                let part = |c: usize| if sums[c] > 0.0 { color[c] / by / sums[c] } else { 0.0 };
                let carried = [0, 1, 2].map(|c| flux[c] * part(c));
                let source = Source::Element(from);
                self.photon(id, &source, carried, &mut rng, &mut brought)?;
            }
        }
        let open = match shining.sky {
            Some((sky, _)) => {
                Air::new(self.optics.map, self.optics.elements).squares(id, sky.up)?
            }
            None => OpenSquares::default(),
        };
        let sources = shining.lamps.iter().map(Source::Lamp).chain([Source::Sky(&open)]);
        for (source, flux) in sources.zip(of_outside).filter(|(_, flux)| total(flux) > 0.0) {
            let n = share(total(flux));
            for _ in 0..n {
                let carried = scale(*flux, 1.0 / n as f64);
                self.photon(id, &source, carried, &mut rng, &mut brought)?;
            }
        }
        Ok(brought)
    }

    /// Lists the elements that send light to one, and how much of each channel.
    fn sources_of(&self, id: u32, shining: &Shining<'_>) -> Vec<(u32, [f64; 3])> {
        let Some(balanced) = self.balanced else { return Vec::new() };
        let exchange = balanced.exchange();
        let spans: Vec<Span> = exchange.sources_of(id);
        let mut sources = Vec::new();
        for j in spans.into_iter().flat_map(|(from, to)| from..to) {
            let mut color = [0.0; 3];
            for (to, channel) in color.iter_mut().zip(shining.exitance) {
                *to = channel[j as usize];
            }
            if total(&color) > 0.0 {
                let by = exchange.of_pair(id as usize, j as usize) * balanced.scale()[j as usize];
                if by > 0.0 {
                    sources.push((j, scale(color, by)));
                }
            }
        }
        sources
    }

    /// Traces a photon from a source by way of a glossy element.
    fn photon(
        &self,
        id: u32,
        from: &Source<'_>,
        carried: [f64; 3],
        rng: &mut Rng,
        brought: &mut Brought,
    ) -> Result<(), LightError> {
        brought.n_photons += 1;
        let mut at = id;
        let mut place = somewhere_on(&self.optics.elements.get(id as usize), rng);
        let mut direction = match *from {
            Source::Element(j) => {
                sub(place, somewhere_on(&self.optics.elements.get(j as usize), rng))
            }
            Source::Lamp(lamp) => self.along_lamp(lamp, place, rng),
            Source::Sky(open) => scale(open.direction(|| rng.f64()), -1.0),
        };
        let mut carried = carried;
        for _ in 0..MAX_DEPTH {
            let (length, taken) = (norm(direction), self.optics.taken(at));
            if length == 0.0 || taken <= 0.0 {
                break;
            }
            let along = scale(direction, 1.0 / length);
            let side = (at, self.optics.is_before(at, along));
            let [mirrored, refracted] = self.optics.branches(side, place, along);
            let is_mirrored = rng.f64() * (mirrored.share + refracted.share) < mirrored.share;
            direction = if is_mirrored { mirrored } else { refracted }.direction;
            carried = scale(carried, taken);
            let hit = self.optics.next_hit(at, place, direction)?;
            match hit {
                // A back keeps what arrives there.
                Some((hit, _)) if self.optics.is_behind(hit, direction) => return Ok(()),
                _ => (0..3).for_each(|c| brought.resent[c] += carried[c]),
            }
            let Some((hit, there)) = hit else {
                (0..3).for_each(|c| brought.escaped[c] += carried[c]);
                return Ok(());
            };
            self.deposit(hit, there, carried, brought);
            (at, place) = (hit, there);
        }
        Ok(())
    }

    /// Gives the direction in which light of a lamp arrives at a place.
    fn along_lamp(&self, lamp: &Lamp, place: [f64; 3], rng: &mut Rng) -> [f64; 3] {
        let origin = Air::new(self.optics.map, self.optics.elements).origin();
        let from = |there: [f64; 3]| sub(place, sub(there, origin));
        match *lamp {
            Lamp::Point { position, .. } | Lamp::Spot { position, .. } => from(position),
            Lamp::Area { corner, sides: [u, v], .. } => {
                let there = add(corner, add(scale(u, rng.f64()), scale(v, rng.f64())));
                from(there)
            }
            Lamp::Sun { direction, .. } => scale(direction, -1.0),
        }
    }

    /// Spreads the light of a photon over the elements around its hit.
    fn deposit(&self, hit: u32, there: [f64; 3], carried: [f64; 3], brought: &mut Brought) {
        let radius = SPREAD_RADII * self.optics.radius(hit);
        let is_glossy = |id: u32| self.optics.taken(id) > 0.0;
        let mut near = self.optics.surroundings.around(there, hit, radius);
        // What goes on from a mirror is not what goes on from the wall around it.
        near.retain(|one| is_glossy(one.0) == is_glossy(hit));
        let areas =
            |&(id, weight): &(u32, f64)| (id, weight * self.optics.elements.areas()[id as usize]);
        let near: Vec<(u32, f64)> = near.iter().map(areas).collect();
        let all: f64 = near.iter().map(|one| one.1).sum();
        if all <= 0.0 {
            brought.deposits.push((hit, carried));
            return;
        }
        for (id, weight) in near {
            brought.deposits.push((id, scale(carried, weight / all)));
        }
    }
}

fn total(flux: &[f64; 3]) -> f64 {
    flux.iter().sum()
}

/// Picks sources by their weights, a stratum of the sum for each photon.
fn pick(sources: &[(u32, [f64; 3])], weight: f64, n: u64, rng: &mut Rng) -> Vec<usize> {
    let (mut index, mut until) = (0, sources.first().map_or(0.0, |source| total(&source.1)));
    let strata = (0..n).map(|k| {
        let at = (k as f64 + rng.f64()) / n as f64 * weight;
        while until < at && index + 1 < sources.len() {
            index += 1;
            until += total(&sources[index].1);
        }
        index
    });
    strata.collect()
}

/// Gives a place on an element, on the square of its area.
fn somewhere_on(element: &Element, rng: &mut Rng) -> [f64; 3] {
    let side = element.area.sqrt();
    let [u, v] = beside(element.normal);
    let off = [0, 1].map(|_| (rng.f64() - 0.5) * side);
    add(element.position, add(scale(u, off[0]), scale(v, off[1])))
}
