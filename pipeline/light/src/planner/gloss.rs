//! What mirrors and lets light through, and what they throw.

use crate::error::LightError;
use crate::hierarchy::Hierarchy;
use crate::lighting::Lighting;
use crate::plan::Effect;
use crate::sum::sum;
use crate::throw::MAX_ROUNDS;

use super::shining::Shining;
use super::{Call, SOLVING};

use super::exchanged::first_link;

/// Processor seconds of a photon, roughly, measured on a ball of glass in a furnished room.
const PHOTON_SECONDS: f64 = 8e-5;

impl Lighting<'_> {
    /// Calls for mirrors in pictures, for refraction, for caustics, and for those of reflected
    /// light.
    pub(super) fn call_gloss(
        &self,
        shining: &Shining,
        hierarchy: &Hierarchy,
    ) -> Result<[Call; 4], LightError> {
        let gloss = &self.materials.gloss;
        let photons = self.n_photons() as f64 * PHOTON_SECONDS;
        let [mirror, refraction] = self.call_views(shining, photons);
        if !self.materials.has_gloss() || shining.flux == 0.0 {
            let none = || Call::off("nothing mirrors or lets light through");
            return Ok([mirror, refraction, none(), none()]);
        }
        let areas = self.elements.areas();
        let is_glossy: Vec<bool> =
            gloss.iter().map(|one| one.specular + one.transmissive > 0.0).collect();
        // No element gets more than the brightest sends, and all rows add up to 1 at the most.
        let taken = sum((0..areas.len())
            .map(|id| areas[id] * f64::from(gloss[id].specular + gloss[id].transmissive)));
        let at_most = |exitance: f64| 3.0 * taken * exitance;
        let links = self.map.view();
        let link = match first_link(links, hierarchy, &shining.is_lit, &is_glossy)? {
            // A lamp may shine on a mirror and on nothing that sees it.
            None => {
                let both = is_glossy.iter().zip(&shining.is_lit).map(|(a, b)| *a && *b);
                first_link(links, hierarchy, &both.collect::<Vec<_>>(), &vec![true; areas.len()])?
            }
            link => link,
        };
        let call = |flux: f64, what: String| {
            let worth = self.options.worth;
            Call::on(what, shining.lasting(flux)).if_worth(worth).costing(photons)
        };
        let n = self.n_photons();
        let Some((a, b)) = link else {
            let why = "nothing lit sees what mirrors or lets light through";
            // From outside light goes through glass that nobody sees, and by way of mirrors away.
            let caustics = match shining.sent_on > 0.0 {
                true => call(shining.sent_on, format!("lamps or sky shine on them: {n} photons")),
                false => Call::off(why),
            };
            return Ok([mirror, refraction, caustics, Call::off(why)]);
        };
        let lit = at_most(shining.most) + shining.sent_on;
        let rho = self.max_albedo();
        let reflected = if rho > 0.0 { at_most(shining.most * rho * shining.growth) } else { 0.0 };
        let why = format!("link {a}-{b}, lit to glossy");
        let caustics = call(lit, format!("{why}: {n} photons"));
        let again = call(reflected, format!("{why}: what is reflected"));
        Ok([mirror, refraction, caustics, again])
    }

    /// Calls for what is seen in mirrors and through glass, and for photons through it.
    fn call_views(&self, shining: &Shining, photon_seconds: f64) -> [Call; 2] {
        let gloss = &self.materials.gloss;
        let most = |of: fn(&crate::Gloss) -> f32| {
            let shares = gloss.iter().map(of).enumerate().filter(|one| one.1 > 0.0);
            shares.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
        };
        let mirror = match most(|one| one.specular) {
            Some((id, share)) => {
                let what = format!("surfel {id} mirrors; pictures follow its rays");
                Call::on(what, f64::from(share))
            }
            None => Call::off("nothing mirrors"),
        };
        let refraction = match most(|one| one.transmissive) {
            Some((id, share)) => {
                let grown = f64::from(share) * shining.growth;
                Call::on(format!("light goes through surfel {id}"), grown).costing(photon_seconds)
            }
            None => Call::off("nothing lets light through"),
        };
        [mirror, refraction]
    }

    /// Adds to the cost of light that is thrown again what it takes to solve for it.
    pub(super) fn costing_rounds(&self, again: Call, application: f64) -> Call {
        let n_channels = match self.options.wishes.of(Effect::Color) {
            Some(false) => 1.0,
            _ => 3.0,
        };
        let rounds = f64::from(MAX_ROUNDS);
        let solving = n_channels * SOLVING * application;
        let seconds = if again.seconds > 0.0 { again.seconds + rounds * solving } else { 0.0 };
        again.costing(seconds)
    }
}
