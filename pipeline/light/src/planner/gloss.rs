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
        let is_glossy: Vec<bool> =
            gloss.iter().map(|one| one.specular + one.transmissive > 0.0).collect();
        let links = self.map.view();
        let call = |flux: f64, what: String| {
            let worth = self.options.worth;
            Call::on(what, shining.lasting(flux)).if_worth(worth).costing(photons)
        };
        let n = self.n_photons();
        let caustics = match first_link(links, hierarchy, &shining.is_lit, &is_glossy)? {
            Some((a, b)) => {
                call(shining.thrown[0], format!("link {a}-{b}, lit to glossy: {n} photons"))
            }
            // A lamp may shine on a mirror and on nothing that sees it.
            None if shining.sent_on > 0.0 => {
                call(shining.sent_on, format!("lamps or sky shine on them: {n} photons"))
            }
            None => Call::off("nothing lit sees what mirrors or lets light through"),
        };
        // What sees them may get light from anywhere, and by way of them, too.
        let reflects = self.reflecting();
        let again = match first_link(links, hierarchy, &reflects, &is_glossy)? {
            Some((a, b)) => call(shining.thrown[1], format!("link {a}-{b}, reflecting to glossy")),
            None => Call::off("nothing that reflects sees what mirrors or lets light through"),
        };
        Ok([mirror, refraction, caustics, again])
    }

    /// Gives what glossy elements send on of what shines, and of what is reflected.
    pub(super) fn thrown_at_most(&self, shining: &Shining) -> [f64; 2] {
        if !self.materials.has_gloss() {
            return [0.0; 2];
        }
        let rows = self.materials.gloss.iter().zip(self.elements.areas());
        let taken = rows.map(|(one, area)| area * f64::from(one.specular + one.transmissive));
        // No element gets more than the brightest sends, and all rows add up to 1 at the most.
        let taken = sum(taken);
        let at_most = |exitance: f64| 3.0 * taken * exitance;
        let again = match self.max_albedo() {
            0.0 => 0.0,
            rho => rho * shining.growth,
        };
        let lit = at_most(shining.most) + shining.sent_on;
        let reflected = at_most(shining.most * again);
        // What was sent on once may all of it come back.
        [lit, reflected + again * (lit + reflected)]
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
