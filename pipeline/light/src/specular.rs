//! Light that mirrors and lenses throw: photons from what is lit, by way of what is glossy.
//!
//! Flux is not sampled: what arrives at each glossy element is what the exchange sends there. The
//! photons only share it out among directions: from a place on a source that is linked to the
//! element through a place on the element, on by reflection or refraction, and at last onto the
//! elements around the place that is hit. No photon goes where nothing glossy is.

use std::f64::consts::PI;

use fastrand::Rng;
use pvmap_query::Map;
use pvmap_store::Watch;
use rayon::prelude::*;

use crate::balance::Balanced;
use crate::element::{Element, Elements};
use crate::error::{LightError, check};
use crate::hierarchy::Span;
use crate::incident::Air;
use crate::lamp::Lamp;
use crate::material::Gloss;
use crate::solve::Operator;
use crate::surroundings::Surroundings;
use crate::vector::{add, beside, dot, norm, scale, sub};

/// Glossy elements whose photons are traced before what they bring is added up.
const CHUNK: usize = 64;
/// Glossy surfaces that a photon meets at the most.
const MAX_DEPTH: u32 = 8;
/// Radii of an element around a hit within which its light is spread, and normals are averaged.
const SPREAD_RADII: f64 = 2.5;
/// How far behind a surface a ray goes on, in radii of its element: it does not hit its own.
const START_RADII: f64 = 2.0;

/// What shines at glossy elements: exitance by channel, and lamps.
pub(crate) struct Shining<'a> {
    pub(crate) exitance: &'a [Vec<f64>],
    pub(crate) lamps: &'a [Lamp],
}

/// What photons brought.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Thrown {
    /// Flux an area of each element, by channel.
    pub(crate) irradiance: Vec<Vec<f64>>,
    /// Flux that glossy elements sent on, by channel: it was not absorbed there.
    pub(crate) resent: Vec<f64>,
    /// Of it, what went into the open.
    pub(crate) escaped: Vec<f64>,
    /// Photons.
    pub(crate) n_photons: u64,
}

impl Thrown {
    /// Adds what another pass brought to what arrives.
    pub(crate) fn add(&mut self, more: Thrown, incident: &mut [Vec<f64>]) {
        for (incident, thrown) in incident.iter_mut().zip(&more.irradiance) {
            incident.iter_mut().zip(thrown).for_each(|(h, more)| *h += more);
        }
        let n = more.resent.len();
        for (all, more) in [(&mut self.resent, more.resent), (&mut self.escaped, more.escaped)] {
            all.resize(n, 0.0);
            all.iter_mut().zip(more).for_each(|(all, more)| *all += more);
        }
        self.n_photons += more.n_photons;
    }
}

/// What glossy elements do with light.
pub(crate) struct Specular<'a> {
    pub(crate) map: &'a Map<'a>,
    pub(crate) elements: &'a Elements,
    pub(crate) gloss: &'a [Gloss],
    pub(crate) balanced: &'a Balanced<'a>,
    pub(crate) surroundings: &'a Surroundings<'a>,
    /// Whether light goes through what lets it.
    pub(crate) refracts: bool,
    /// Photons in all, about.
    pub(crate) n_photons: u64,
}

/// Where photons to a glossy element come from.
#[derive(Debug, Clone, Copy)]
enum From {
    Element(u32),
    Lamp(usize),
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
    pub(crate) fn pass(
        &self,
        shining: &Shining<'_>,
        watch: &dyn Watch,
    ) -> Result<Thrown, LightError> {
        let (n, n_channels) = (self.elements.len(), shining.exitance.len());
        let zeros = vec![vec![0.0; n]; n_channels];
        let none = vec![0.0; n_channels];
        let mut thrown =
            Thrown { irradiance: zeros, resent: none.clone(), escaped: none, n_photons: 0 };
        let flux = self.flux_from_elements(shining)?;
        let of_lamps = self.flux_from_lamps(shining.lamps, n_channels)?;
        let glossy = self.glossy();
        let arriving = |k: usize| {
            let id = glossy[k] as usize;
            let lamps: f64 = of_lamps[k].iter().map(total).sum();
            flux.iter().map(|channel| channel[id]).sum::<f64>() + lamps
        };
        let all: f64 = (0..glossy.len()).map(arriving).sum();
        if all <= 0.0 {
            return Ok(thrown);
        }
        let one = |k: usize| {
            check(watch)?;
            let id = glossy[k] as usize;
            let mut here = [0.0; 3];
            flux.iter().zip(&mut here).for_each(|(channel, to)| *to = channel[id]);
            let share = arriving(k) / all;
            let n_photons = (share * self.n_photons as f64).ceil() as u64;
            self.photons_by(glossy[k], here, &of_lamps[k], (shining, n_photons))
        };
        for first in (0..glossy.len()).step_by(CHUNK) {
            let range = first..glossy.len().min(first + CHUNK);
            let n_done = range.len() as u64;
            let brought = range.into_par_iter().map(one).collect::<Result<Vec<_>, LightError>>()?;
            watch.advance(n_done);
            for Brought { deposits, resent, escaped, n_photons } in brought {
                for (to, flux) in deposits {
                    let area = self.elements.area[to as usize];
                    for (channel, flux) in thrown.irradiance.iter_mut().zip(flux) {
                        channel[to as usize] += flux / area;
                    }
                }
                thrown.resent.iter_mut().zip(resent).for_each(|(all, more)| *all += more);
                thrown.escaped.iter_mut().zip(escaped).for_each(|(all, more)| *all += more);
                thrown.n_photons += n_photons;
            }
        }
        Ok(thrown)
    }

    /// Lists the elements that mirror or let light through.
    pub(crate) fn glossy(&self) -> Vec<u32> {
        let ids = (0..self.elements.len() as u32).zip(self.gloss);
        ids.filter(|(_, gloss)| self.taken(gloss) > 0.0).map(|(id, _)| id).collect()
    }

    /// Gives the share of light that an element mirrors or lets through.
    fn taken(&self, gloss: &Gloss) -> f64 {
        let through = if self.refracts { gloss.transmissive } else { 0.0 };
        f64::from(gloss.specular + through)
    }

    /// Gives what arrives at every element from others, by channel.
    fn flux_from_elements(&self, shining: &Shining<'_>) -> Result<Vec<Vec<f64>>, LightError> {
        let one = |exitance: &Vec<f64>| match exitance.iter().any(|&b| b > 0.0) {
            true => self.balanced.apply(exitance),
            false => Ok(vec![0.0; exitance.len()]),
        };
        shining.exitance.iter().map(one).collect()
    }

    /// Gives what arrives at each glossy element from each lamp.
    fn flux_from_lamps(
        &self,
        lamps: &[Lamp],
        n_channels: usize,
    ) -> Result<Vec<Vec<[f64; 3]>>, LightError> {
        let air = Air::new(self.map, self.elements);
        let one = |&id: &u32| {
            let area = self.elements.area[id as usize];
            let of_lamp = |lamp: &Lamp| {
                let irradiance = air.of_lamp(lamp, id)?;
                let flux = scale(irradiance, area);
                // One channel is the mean of three.
                Ok(if n_channels == 3 { flux } else { [total(&flux) / 3.0, 0.0, 0.0] })
            };
            lamps.iter().map(of_lamp).collect::<Result<Vec<_>, LightError>>()
        };
        self.glossy().par_iter().map(one).collect()
    }

    /// Traces the photons of one glossy element, at which `flux` arrives from elements and more
    /// from lamps.
    fn photons_by(
        &self,
        id: u32,
        flux: [f64; 3],
        of_lamps: &[[f64; 3]],
        (shining, n_photons): (&Shining<'_>, u64),
    ) -> Result<Brought, LightError> {
        let mut rng = Rng::with_seed(u64::from(id));
        let mut brought = Brought::default();
        let sources = self.sources_of(id, shining);
        let weight: f64 = sources.iter().map(|source| total(&source.1)).sum();
        let lamps_flux: f64 = of_lamps.iter().map(total).sum();
        let all = total(&flux) + lamps_flux;
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
                self.photon(id, From::Element(from), carried, (shining, &mut rng), &mut brought)?;
            }
        }
        for (lamp, flux) in of_lamps.iter().enumerate().filter(|(_, flux)| total(flux) > 0.0) {
            let n = share(total(flux));
            for _ in 0..n {
                let carried = scale(*flux, 1.0 / n as f64);
                self.photon(id, From::Lamp(lamp), carried, (shining, &mut rng), &mut brought)?;
            }
        }
        Ok(brought)
    }

    /// Lists the elements that send light to one, and how much of each channel.
    fn sources_of(&self, id: u32, shining: &Shining<'_>) -> Vec<(u32, [f64; 3])> {
        let exchange = self.balanced.exchange();
        let spans: Vec<Span> = exchange.sources_of(id);
        let mut sources = Vec::new();
        for j in spans.into_iter().flat_map(|(from, to)| from..to) {
            let mut color = [0.0; 3];
            for (to, channel) in color.iter_mut().zip(shining.exitance) {
                *to = channel[j as usize];
            }
            if total(&color) > 0.0 {
                let by =
                    exchange.of_pair(id as usize, j as usize) * self.balanced.scale()[j as usize];
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
        from: From,
        carried: [f64; 3],
        (shining, rng): (&Shining<'_>, &mut Rng),
        brought: &mut Brought,
    ) -> Result<(), LightError> {
        brought.n_photons += 1;
        let mut at = id;
        let mut place = somewhere_on(&self.elements.get(id as usize), rng);
        let mut direction = match from {
            From::Element(j) => sub(place, somewhere_on(&self.elements.get(j as usize), rng)),
            From::Lamp(lamp) => self.along_lamp(&shining.lamps[lamp], place, rng),
        };
        let mut carried = carried;
        for _ in 0..MAX_DEPTH {
            let length = norm(direction);
            if length == 0.0 {
                break;
            }
            let taken = self.taken(&self.gloss[at as usize]);
            if taken <= 0.0 {
                return Ok(());
            }
            let along = scale(direction, 1.0 / length);
            let normal = self.surroundings.normal_at(place, at, SPREAD_RADII);
            direction = self.onwards(at, along, normal, rng);
            carried = scale(carried, taken);
            (0..3).for_each(|c| brought.resent[c] += carried[c]);
            let radius = self.radius(at);
            let start = add(place, scale(direction, START_RADII * radius));
            let air = Air::new(self.map, self.elements);
            match air.first_hit(start, direction)? {
                None => {
                    (0..3).for_each(|c| brought.escaped[c] += carried[c]);
                    return Ok(());
                }
                Some((hit, there)) => {
                    self.deposit(hit, there, carried, brought);
                    (at, place) = (hit, there);
                }
            }
        }
        Ok(())
    }

    /// Gives the direction in which a glossy element sends light on: mirrored or refracted, one of
    /// both by chance.
    fn onwards(&self, id: u32, along: [f64; 3], normal: [f64; 3], rng: &mut Rng) -> [f64; 3] {
        let gloss = &self.gloss[id as usize];
        let facing = if dot(along, normal) > 0.0 { scale(normal, -1.0) } else { normal };
        let cosine = -dot(along, facing);
        let mirrored = add(along, scale(facing, 2.0 * cosine));
        let through = if self.refracts { f64::from(gloss.transmissive) } else { 0.0 };
        if through <= 0.0 {
            return mirrored;
        }
        let index = f64::from(gloss.refraction).max(1.0);
        // Normals look out of what is denser.
        let eta = if dot(along, normal) < 0.0 { 1.0 / index } else { index };
        let (reflected, inner) = fresnel(cosine, eta);
        let mirror = f64::from(gloss.specular) + through * reflected;
        if rng.f64() * (f64::from(gloss.specular) + through) < mirror {
            return mirrored;
        }
        add(scale(along, eta), scale(facing, eta * cosine - inner))
    }

    /// Gives the direction in which light of a lamp arrives at a place.
    fn along_lamp(&self, lamp: &Lamp, place: [f64; 3], rng: &mut Rng) -> [f64; 3] {
        let origin = Air::new(self.map, self.elements).origin();
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
        let near = self.surroundings.around(there, hit, SPREAD_RADII * self.radius(hit));
        let areas = |&(id, weight): &(u32, f64)| (id, weight * self.elements.area[id as usize]);
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

    fn radius(&self, id: u32) -> f64 {
        (self.elements.area[id as usize] / PI).sqrt()
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

/// Gives the share of unpolarised light that is reflected, and the cosine of the rest behind the
/// surface; 1 where all is.
pub(crate) fn fresnel(cosine: f64, eta: f64) -> (f64, f64) {
    let sin2 = eta * eta * (1.0 - cosine * cosine);
    if sin2 >= 1.0 {
        return (1.0, 0.0);
    }
    let inner = (1.0 - sin2).sqrt();
    let across = (eta * cosine - inner) / (eta * cosine + inner);
    let along = (cosine - eta * inner) / (cosine + eta * inner);
    (0.5 * (across * across + along * along), inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vector::cross;

    #[test]
    fn glass_reflects_four_per_cent_ahead_and_all_at_a_slant() {
        let (ahead, inner) = fresnel(1.0, 1.0 / 1.5);
        assert!((ahead - 0.04).abs() < 1e-15 && inner == 1.0);
        // Out of the glass beyond 41.8°.
        assert_eq!(fresnel(42f64.to_radians().cos(), 1.5), (1.0, 0.0));
        assert!(fresnel(41f64.to_radians().cos(), 1.5).0 < 1.0);
        assert!((fresnel(1e-9, 1.0 / 1.5).0 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn brewster_light_of_one_polarisation_is_not_reflected() {
        let cosine = (1.0 / (1.0 + 1.5f64 * 1.5)).sqrt();
        let (reflected, inner) = fresnel(cosine, 1.0 / 1.5);
        let across = (cosine / 1.5 - inner) / (cosine / 1.5 + inner);
        assert!((reflected - 0.5 * across * across).abs() < 1e-15);
    }

    #[test]
    fn a_mirrored_direction_has_the_same_slant() {
        let (along, normal) = ([0.6, 0.0, -0.8], [0.0, 0.0, 1.0]);
        let mirrored = add(along, scale(normal, -2.0 * dot(along, normal)));
        assert_eq!(mirrored, [0.6, 0.0, 0.8]);
        assert_eq!(cross(mirrored, along), cross([0.6, 0.0, 0.8], along));
    }
}
