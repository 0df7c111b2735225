//! Light that is thrown, reflected and thrown again.

use std::sync::Arc;

use pvmap_store::Watch;

use crate::error::LightError;
use crate::hierarchy::Hierarchy;
use crate::lighting::{Lighting, Lit, Solved};
use crate::optics::Optics;
use crate::plan::Effect;
use crate::specular::{Shining, Specular, Thrown};
use crate::surroundings::Surroundings;

/// Photons times the square of the error, and their number at the least and at the most.
const PHOTONS: f64 = 20.0;
const MIN_PHOTONS: u64 = 10_000;
const MAX_PHOTONS: u64 = 4_000_000;
/// Rounds of light that is thrown, reflected and thrown again, at the most.
pub const MAX_ROUNDS: u32 = 5;

impl Lighting<'_> {
    /// Adds what glossy elements throw to what arrives from outside: first of what shines, then of
    /// what was reflected, until that is not worth it or [`MAX_ROUNDS`] are done: `lit` says what
    /// was left then. Leaves the channels solved where it had to solve them and nothing came after.
    pub(crate) fn throw(
        &self,
        scene: &Solved<'_>,
        incident: &mut [Vec<f64>],
        lit: &mut Lit,
        watch: &dyn Watch,
    ) -> Result<Thrown, LightError> {
        let mut thrown = Thrown::default();
        let shines: f64 = scene
            .channels
            .iter()
            .zip(&*incident)
            .map(|(given, incident)| self.flux_of(&given.emission) + self.flux_of(incident))
            .sum();
        let hierarchy = Hierarchy::of_map(self.map.view())?;
        let surroundings = Surroundings::new(Arc::clone(&self.elements), hierarchy);
        let optics = Optics {
            map: self.map,
            elements: &self.elements,
            gloss: &self.materials.gloss,
            surroundings: &surroundings,
            refracts: scene.plan.is_on(Effect::Refraction),
        };
        let specular = Specular { optics, balanced: scene.balanced, n_photons: self.n_photons() };
        let n_glossy = specular.glossy().len() as u64;
        let mut sent: Vec<Vec<f64>> = scene.channels.iter().map(|c| c.emission.clone()).collect();
        let mut most = 0.0;
        if scene.plan.is_on(Effect::Caustics) {
            watch.stage("caustics", Some(n_glossy), "surfels");
            let open = std::mem::take(&mut lit.open_sky);
            let sky = self.sky.as_ref().filter(|_| !open.is_empty()).map(|sky| (sky, &open[..]));
            let shining = Shining { exitance: &sent, lamps: &self.lamps, sky };
            thrown.add(specular.pass(&shining, &mut most, watch)?, incident);
            lit.open_sky = open;
        }
        if !scene.plan.is_on(Effect::DiffuseSpecularDiffuse) || scene.balanced.is_none() {
            return Ok(thrown);
        }
        for round in 0.. {
            self.solve_all(scene, incident, lit, watch)?;
            let new: Vec<Vec<f64>> = lit
                .channels
                .iter()
                .zip(&sent)
                .map(|(lit, sent)| {
                    lit.exitance.iter().zip(sent).map(|(b, sent)| (b - sent).max(0.0)).collect()
                })
                .collect();
            if round == MAX_ROUNDS {
                lit.left_to_throw = specular.resent_of(&new)? / shines;
                return Ok(thrown);
            }
            watch.stage("caustics", Some(n_glossy), "surfels");
            let shining = Shining { exitance: &new, lamps: &[], sky: None };
            let more = specular.pass(&shining, &mut most, watch)?;
            let resent: f64 = more.flux.iter().map(|flux| flux.resent).sum();
            thrown.add(more, incident);
            lit.channels.iter().zip(&mut sent).for_each(|(lit, sent)| {
                sent.clone_from(&lit.exitance);
            });
            if resent <= self.options.worth * shines {
                break;
            }
        }
        // What came last is still to be reflected.
        lit.channels.clear();
        Ok(thrown)
    }

    /// Gives the photons of the pass that brings most: they err as one over the root of their
    /// number.
    pub(crate) fn n_photons(&self) -> u64 {
        let n_photons = (PHOTONS / (self.options.error * self.options.error)) as u64;
        n_photons.clamp(MIN_PHOTONS, MAX_PHOTONS)
    }
}
