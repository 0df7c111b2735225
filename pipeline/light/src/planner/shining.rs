//! What shines on a scene, and how much of it arrives: looked at from some elements.

use std::f64::consts::PI;

use pvmap_store::Watch;
use rayon::prelude::*;

use crate::error::{LightError, check};
use crate::incident::Air;
use crate::lighting::Lighting;
use crate::plan::Effect;
use crate::sum::sum;

use super::N_LOOKED_FROM;

/// Of a count that never was, with 95 % certainty the rate is below this over the tries.
const NEVER: f64 = 3.0;

/// What shines. Flux is that of the three channels together.
pub(super) struct Shining {
    /// All flux: what elements emit, and what arrives of lamps and sky.
    pub(super) flux: f64,
    pub(super) emitted: f64,
    pub(super) of_lamps: f64,
    pub(super) of_sky: f64,
    /// What would arrive from lamps if nothing were in between.
    pub(super) unblocked: f64,
    pub(super) tries: Tries,
    pub(super) sky: SkyLook,
    /// Of the flux of lamps and sky what mirrors and lenses send on.
    pub(super) sent_on: f64,
    /// What mirrors and lenses send on of what shines, and of what is reflected, at the most. They
    /// gather it: there is a bound on all of it, but none on what a place gets.
    pub(super) thrown: [f64; 2],
    /// By element: whether it emits, or a lamp or the sky may reach it.
    pub(super) is_lit: Vec<bool>,
    /// What arrives at each element from lamps if nothing is in between, by channel.
    pub(super) from_lamps: [Vec<f64>; 3],
    /// The largest exitance that is not reflected twice, by what may arrive from outside, but not
    /// by way of mirrors and lenses.
    pub(super) most: f64,
    /// All light for what is emitted, 1 / (1 - ρ) at the most; 1 without bounces.
    pub(super) growth: f64,
}

/// Segments to lamps that were tried.
#[derive(Default)]
pub(super) struct Tries {
    /// Elements that lamps reach, and those of them that were tried.
    pub(super) n_reached: usize,
    pub(super) n_tried: usize,
    /// Whether these are all.
    pub(super) is_all: bool,
    pub(super) n_segments: u64,
    pub(super) n_blocked: u64,
    /// The share of the light that was blocked.
    pub(super) lost: f64,
}

/// A look at the sky.
#[derive(Default)]
pub(super) struct SkyLook {
    /// What would arrive if all of the sky were open everywhere.
    pub(super) whole: f64,
    /// The share that is open.
    pub(super) open: f64,
    /// The element that sees most of it, and how much.
    pub(super) best: Option<(u32, f64)>,
    pub(super) n_directions: u64,
}

/// Gives what share it may be of which `k` of `n` tries were found, with 95 % certainty.
pub(super) fn at_most(k: f64, n: f64) -> f64 {
    if n > 0.0 { ((k + 2.0 * k.sqrt() + NEVER) / n).min(1.0) } else { 1.0 }
}

impl Tries {
    /// Gives the share of the light that is blocked at the most, and of what arrives at the least.
    pub(super) fn lost_at_most(&self) -> f64 {
        let n = self.n_tried as f64;
        if self.is_all { self.lost } else { at_most(self.lost * n, n) }
    }

    /// Gives the share that arrives; of what was never found a try.
    fn arriving(&self) -> f64 {
        let least = if self.is_all { 0.0 } else { 1.0 / self.n_tried.max(1) as f64 };
        (1.0 - self.lost).max(least)
    }
}

impl Shining {
    /// Gives the share of all light that so much flux makes, with all that is reflected of it.
    pub(super) fn lasting(&self, flux: f64) -> f64 {
        if flux == 0.0 { 0.0 } else { flux * self.growth / self.flux }
    }

    /// Gives all that mirrors and lenses send on at the most.
    pub(super) fn all_thrown(&self) -> f64 {
        self.thrown[0] + self.thrown[1]
    }
}

impl Lighting<'_> {
    /// Looks at what shines.
    pub(super) fn shining(&self, watch: &dyn Watch) -> Result<Shining, LightError> {
        let areas = self.elements.areas();
        let n = areas.len();
        let air = Air::new(self.map, &self.elements);
        let from_lamps = match self.lamps.is_empty() {
            true => [0, 1, 2].map(|_| vec![0.0; n]),
            false => air.lamps(&self.lamps, (false, false), watch)?.irradiance,
        };
        let emission = self.materials.channels.each_ref().map(|channel| &channel.emission);
        let flux_at =
            |of: [&Vec<f64>; 3], id: usize| areas[id] * of.iter().map(|c| c[id]).sum::<f64>();
        let reach: Vec<f64> = (0..n).map(|id| flux_at(from_lamps.each_ref(), id)).collect();
        let unblocked = sum(reach.iter().copied());
        let emitted = sum((0..n).map(|id| flux_at(emission, id)));
        let bounces = self.options.wishes.of(Effect::Bounces) != Some(false);
        let growth = if bounces { 1.0 / (1.0 - self.max_albedo()) } else { 1.0 };
        let tries = match self.options.wishes.of(Effect::Occlusion) {
            // They shine through everything.
            Some(false) => Tries::default(),
            _ => self.try_lamps(&air, &reach, growth, watch)?,
        };
        let sky = self.look_at_sky(&air, watch)?;
        let of_lamps = unblocked * tries.arriving();
        let of_sky = match (sky.n_directions, sky.best) {
            (1.., None) => sky.whole / sky.n_directions as f64,
            _ => sky.whole * sky.open,
        };
        let mut shining = Shining {
            flux: emitted + of_lamps + of_sky,
            emitted,
            of_lamps,
            of_sky,
            unblocked,
            tries,
            sky,
            sent_on: 0.0,
            thrown: [0.0; 2],
            is_lit: vec![false; n],
            from_lamps,
            most: 0.0,
            growth,
        };
        self.light_each(&mut shining);
        shining.thrown = self.thrown_at_most(&shining);
        Ok(shining)
    }

    /// Adds up what is said of each element.
    fn light_each(&self, shining: &mut Shining) {
        let radiance = self.sky.map_or([0.0; 3], |sky| sky.radiance);
        // Of the sky what arrives on average.
        let open = match shining.sky.whole {
            0.0 => 0.0,
            whole => shining.of_sky / whole,
        };
        for (index, channel) in self.materials.channels.iter().enumerate() {
            let from_sky = PI * radiance[index];
            for (id, &area) in self.elements.areas().iter().enumerate() {
                let from_lamps = shining.from_lamps[index][id];
                let outside = from_lamps + from_sky;
                let gloss = self.materials.gloss.get(id).copied().unwrap_or_default();
                let taken = f64::from(gloss.specular + gloss.transmissive);
                shining.sent_on += area * taken * (from_lamps + from_sky * open);
                shining.is_lit[id] |= channel.emission[id] > 0.0 || outside > 0.0;
                let exitance = channel.emission[id] + channel.albedo[id] * outside;
                shining.most = shining.most.max(exitance);
            }
        }
    }

    /// Tries segments to lamps from elements that are drawn by the flux that would arrive there:
    /// some, and where none is blocked as many as it takes to rule out what is worth anything.
    fn try_lamps(
        &self,
        air: &Air<'_>,
        reach: &[f64],
        growth: f64,
        watch: &dyn Watch,
    ) -> Result<Tries, LightError> {
        let reached: Vec<u32> =
            (0..reach.len() as u32).filter(|&id| reach[id as usize] > 0.0).collect();
        // A number that is too large for an integer is cut.
        let wanted = (NEVER * growth / self.options.worth).ceil() as usize;
        let mut tries = Tries { n_reached: reached.len(), is_all: true, ..Tries::default() };
        if reached.is_empty() {
            return Ok(tries);
        }
        let all = sum(reach.iter().copied());
        for n in [N_LOOKED_FROM, wanted.max(N_LOOKED_FROM)] {
            tries.is_all = reached.len() <= n;
            let ids = if tries.is_all { reached.clone() } else { drawn(&reached, reach, all, n) };
            let found = air.try_lamps(&self.lamps, &ids, watch)?;
            tries.n_tried = ids.len();
            tries.n_segments = found.iter().map(|row| row.1).sum();
            tries.n_blocked = found.iter().map(|row| row.2).sum();
            let lost = ids.iter().zip(&found).map(|(&id, (arriving, ..))| {
                let (id, whole) = (id as usize, reach[id as usize]);
                let part = self.elements.areas()[id] * arriving.iter().sum::<f64>() / whole;
                // As often as it was drawn, all are drawn alike.
                let weight = if tries.is_all { whole / all } else { 1.0 / ids.len() as f64 };
                weight * (1.0 - part.min(1.0))
            });
            tries.lost = sum(lost).clamp(0.0, 1.0);
            if tries.n_blocked > 0 || tries.is_all {
                break;
            }
        }
        Ok(tries)
    }

    /// Looks at the sky from some elements.
    fn look_at_sky(&self, air: &Air<'_>, watch: &dyn Watch) -> Result<SkyLook, LightError> {
        let Some(sky) = self.sky.filter(|sky| sky.radiance.iter().any(|&l| l > 0.0)) else {
            return Ok(SkyLook::default());
        };
        let areas = self.elements.areas();
        let ids = self.some(N_LOOKED_FROM);
        let looks = ids.par_iter().map(|&id| {
            check(watch)?;
            air.sky_over(id, Some(sky.up))
        });
        let looks = looks.collect::<Result<Vec<_>, LightError>>()?;
        let rows = || ids.iter().zip(&looks).map(|(&id, look)| (id, f64::from(look.0)));
        let seen = sum(rows().map(|(id, share)| areas[id as usize] * share));
        let looked = sum(ids.iter().map(|&id| areas[id as usize]));
        let best = rows().max_by(|a, b| a.1.total_cmp(&b.1)).filter(|best| best.1 > 0.0);
        let whole: f64 = sky.radiance.iter().map(|l| PI * l).sum();
        Ok(SkyLook {
            whole: whole * sum(areas.iter().copied()),
            open: if looked > 0.0 { seen / looked } else { 0.0 },
            best,
            n_directions: looks.iter().map(|look| look.1).sum(),
        })
    }
}

/// Draws `n` elements by their weights: one at each of n even steps through their sum.
fn drawn(ids: &[u32], weights: &[f64], all: f64, n: usize) -> Vec<u32> {
    let mut drawn = Vec::with_capacity(n);
    let mut until = 0.0;
    for &id in ids {
        until += weights[id as usize];
        while drawn.len() < n && (drawn.len() as f64 + 0.5) / n as f64 * all <= until {
            drawn.push(id);
        }
    }
    drawn
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_never_found_is_bounded_and_what_was_is_more() {
        assert_eq!(at_most(0.0, 3000.0), 1e-3);
        assert!(at_most(10.0, 1000.0) > 10e-3 && at_most(10.0, 1000.0) < 25e-3);
        assert_eq!((at_most(9.0, 10.0), at_most(0.0, 0.0)), (1.0, 1.0));
    }

    #[test]
    fn elements_are_drawn_as_often_as_they_weigh() {
        let weights = [1.0, 0.0, 6.0, 3.0];
        let drawn = drawn(&[0, 2, 3], &weights, 10.0, 1000);
        let count = |id| drawn.iter().filter(|&&one| one == id).count();
        assert_eq!([0, 1, 2, 3].map(count), [100, 0, 600, 300]);
    }
}
