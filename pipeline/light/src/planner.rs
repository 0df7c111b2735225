//! What a scene calls for: the evidence, the bounds and the costs of a plan.

use std::f64::consts::PI;
use std::sync::Arc;

use pvmap_store::Watch;
use rayon::prelude::*;

use crate::error::{LightError, check};
use crate::exchange::Exchange;
use crate::hierarchy::{Hierarchy, Links};
use crate::incident::Air;
use crate::kernel::Kernel;
use crate::lighting::{Lighting, Planned};
use crate::near_field::near_pairs;
use crate::plan::{Decision, Effect, Plan};
use crate::sum::sum;

/// What grids of each order err by, at the most of all surfels of a furnished room, as shares of
/// the largest flux: measured, `examples/speed.rs`, and rounded up.
const ORDER_ERRORS: [f64; 8] = [f64::NAN, 0.5, 4e-2, 4e-3, 8e-4, 6e-5, 6e-6, 1e-6];
/// The share of open directions below which a scene is closed: patches do not quite meet at edges,
/// which leaves 0.4 % in a closed room.
const CLOSED: f64 = 1e-2;
/// Elements from which it is looked whether anything escapes.
const N_LOOKED_FROM: usize = 256;
/// Processor seconds of a segment in the air, of a pair of elements, and of one between a place of
/// a grid and another, roughly: for costs that are said beforehand.
const SEGMENT_SECONDS: f64 = 5e-6;
const PAIR_SECONDS: f64 = 1.5e-9;
/// Bytes held for an element, a node and a pair with a visible fraction, at the most: numbers in
/// both precisions, materials and incident light, what passes and solver hold of three channels.
const ELEMENT_BYTES: u64 = 128 + 12 * 8 + 3 * (8 + 24 + 24 + 8) + 3 * 6 * 8;
const NODE_BYTES: u64 = 24 + 128 + 72 + 20 + 160;
const FRACTION_BYTES: u64 = 12 + 2 * 16 + 2 * 12;
/// Of a count that never was, with 95 % certainty the rate is below this over the tries.
const NEVER: f64 = 3.0;

/// What an effect would change, before wishes.
struct Call {
    is_on: bool,
    evidence: String,
    skipped: f64,
    seconds: f64,
}

impl Call {
    fn off(evidence: impl Into<String>) -> Call {
        Call { is_on: false, evidence: evidence.into(), skipped: 0.0, seconds: 0.0 }
    }

    fn on(evidence: impl Into<String>, skipped: f64) -> Call {
        Call { is_on: true, evidence: evidence.into(), skipped, seconds: 0.0 }
    }

    /// On where what would be left out is worth it.
    fn if_worth(self, worth: f64) -> Call {
        Call { is_on: self.skipped > worth, ..self }
    }

    fn costing(self, seconds: f64) -> Call {
        Call { seconds, ..self }
    }
}

/// What shines, before anything is in between.
struct Shining {
    /// All flux: of elements, of lamps that arrives, of the sky.
    flux: f64,
    of_lamps: f64,
    of_sky: f64,
    /// Of the flux of lamps and sky what mirrors and lenses send on.
    sent_on: f64,
    /// By element: whether it emits, or a lamp or the sky may reach it.
    is_lit: Vec<bool>,
    /// The largest exitance that is not reflected twice, by what may arrive from outside.
    most: f64,
}

impl Lighting<'_> {
    /// Decides which effects are computed, and prepares the exchange if any light is exchanged.
    ///
    /// # Errors
    /// Where the map is damaged, or the run is asked to stop.
    pub fn plan(&self, watch: &dyn Watch) -> Result<Planned, LightError> {
        watch.stage("plan", None, "effects");
        let hierarchy = Hierarchy::of_map(self.map.view())?;
        let shining = self.shining(watch)?;
        let mut n_lamp_tries = 0;
        let direct = self.call_direct(&shining);
        let sky = self.call_sky(&shining)?;
        let occlusion = self.call_occlusion(&shining, &mut n_lamp_tries)?;
        let color = self.call_color();
        check(watch)?;
        let (bounces, n_bounces) = self.call_bounces(&shining, &hierarchy)?;
        let gloss = self.call_gloss(&shining, &hierarchy)?;
        let worth = self.options.worth;
        let links = self.map.view();
        let kernel = Kernel::default();
        let is_on = |effect: Effect, call: &Call| {
            self.options.wishes.of(effect).unwrap_or(call.is_on) && shining.flux > 0.0
        };
        let emits = self.materials.channels.iter().any(|c| c.emission.iter().any(|&e| e > 0.0));
        let exchanges = is_on(Effect::Direct, &direct)
            && (emits || is_on(Effect::Bounces, &bounces))
            && links.summary().n_links + links.summary().n_fractions > 0;
        let near = match exchanges {
            true => near_pairs(&self.elements, &hierarchy, links, kernel, worth)?,
            false => Vec::new(),
        };
        check(watch)?;
        let near_field = self.call_near_field(&near);
        let (order_call, order) = self.call_order(exchanges);
        let mut exchange = None;
        let mut order = order;
        if exchanges {
            let wants_order = is_on(Effect::Order, &order_call);
            order = match order {
                Some(_) if !wants_order => Some(1),
                other => other,
            };
            let mut made = self.exchange(&hierarchy, order)?;
            if is_on(Effect::NearField, &near_field) {
                made = made.with_near_field(&near)?;
            }
            exchange = Some(made);
        }
        check(watch)?;
        let bounces = match &exchange {
            Some(exchange) => bounces.costing(application_seconds(exchange) * 12.0),
            None => bounces,
        };
        let [mirror, refraction, caustics, again] = gloss;
        let calls = [
            (Effect::Direct, direct),
            (Effect::Sky, sky),
            (Effect::Occlusion, occlusion),
            (Effect::Bounces, bounces),
            (Effect::Color, color),
            (Effect::MirrorView, mirror),
            (Effect::Refraction, refraction),
            (Effect::Caustics, caustics),
            (Effect::DiffuseSpecularDiffuse, again),
            (Effect::NearField, near_field),
            (Effect::Order, order_call),
        ];
        let decide = |(effect, call): (Effect, Call)| {
            let wish = self.options.wishes.of(effect);
            let Call { is_on, evidence, skipped, seconds } = call;
            let is_wish = wish.is_some_and(|wish| wish != is_on);
            Decision { effect, is_on: wish.unwrap_or(is_on), is_wish, evidence, skipped, seconds }
        };
        let decisions = calls.into_iter().map(decide).collect();
        let open_share = if exchanges { self.open_share()? } else { 1.0 };
        let is_closed = open_share < CLOSED;
        let plan = Plan { decisions, order, bounces: n_bounces, open_share, is_closed };
        Ok(Planned { plan, exchange, n_lamp_tries })
    }

    fn shining(&self, watch: &dyn Watch) -> Result<Shining, LightError> {
        let areas = self.elements.areas();
        let air = Air::new(self.map, &self.elements);
        let lamps = match self.lamps.is_empty() {
            true => None,
            false => Some(air.lamps(&self.lamps, false, watch)?.irradiance),
        };
        let mut shining = Shining {
            flux: 0.0,
            of_lamps: 0.0,
            of_sky: 0.0,
            sent_on: 0.0,
            is_lit: Vec::new(),
            most: 0.0,
        };
        let radiance = self.sky.map_or([0.0; 3], |sky| sky.radiance);
        shining.is_lit = vec![radiance.iter().any(|&l| l > 0.0); areas.len()];
        for (index, channel) in self.materials.channels.iter().enumerate() {
            let from_lamps = |id: usize| lamps.as_ref().map_or(0.0, |lamps| lamps[index][id]);
            let from_sky = PI * radiance[index];
            let ids = || 0..areas.len();
            shining.flux += sum(ids().map(|id| areas[id] * channel.emission[id]));
            shining.of_lamps += sum(ids().map(|id| areas[id] * from_lamps(id)));
            shining.of_sky += sum(ids().map(|id| areas[id] * from_sky));
            for id in ids() {
                let outside = from_lamps(id) + from_sky;
                let gloss = self.materials.gloss.get(id).copied().unwrap_or_default();
                let taken = f64::from(gloss.specular + gloss.transmissive);
                shining.sent_on += areas[id] * outside * taken;
                shining.is_lit[id] |= channel.emission[id] > 0.0 || outside > 0.0;
                let exitance = channel.emission[id] + channel.albedo[id] * outside;
                shining.most = shining.most.max(exitance);
            }
        }
        shining.flux += shining.of_lamps + shining.of_sky;
        Ok(shining)
    }

    fn call_direct(&self, shining: &Shining) -> Call {
        if shining.flux == 0.0 {
            return Call::off("nothing shines");
        }
        let n_lit = shining.is_lit.iter().filter(|&&is_lit| is_lit).count();
        let n_lamps = self.lamps.len();
        let of = |flux: f64| 100.0 * flux / shining.flux;
        Call::on(
            format!(
                "{n_lit} surfels shine or may be shone on; lamps ({n_lamps}) {:.0} %, sky {:.0} % \
                 of the flux",
                of(shining.of_lamps),
                of(shining.of_sky)
            ),
            1.0,
        )
        .costing(n_lit as f64 * n_lamps as f64 * SEGMENT_SECONDS)
    }

    fn call_sky(&self, shining: &Shining) -> Result<Call, LightError> {
        let n = self.elements.len();
        let seconds = 64.0 * n as f64 * SEGMENT_SECONDS;
        let Some(sky) = self.sky.filter(|_| shining.of_sky > 0.0) else {
            return Ok(Call::off("the sky is dark").costing(seconds));
        };
        let air = Air::new(self.map, &self.elements);
        let looks = self.some(N_LOOKED_FROM).into_par_iter().map(|id| {
            let (share, n_segments) = air.sky_over(id, Some(sky.up))?;
            Ok::<_, LightError>((id, share, n_segments))
        });
        let looks = looks.collect::<Result<Vec<_>, _>>()?;
        let n_tried: u64 = looks.iter().map(|look| look.2).sum();
        let share = shining.of_sky / shining.flux;
        let open = sum(looks.iter().map(|look| f64::from(look.1))) / looks.len().max(1) as f64;
        let call = match looks.iter().max_by(|a, b| a.1.total_cmp(&b.1)) {
            Some((id, most, _)) if *most > 0.0 => {
                let (open_percent, most) = (100.0 * open, 100.0 * most);
                let what =
                    format!("open sky {open_percent:.1} % on average, surfel {id} {most:.0} %");
                Call::on(what, share * open).if_worth(self.options.worth)
            }
            _ => {
                let bound = share * NEVER / n_tried.max(1) as f64;
                let what = format!("none of {n_tried} directions is open (95 %)");
                Call { skipped: bound, ..Call::off(what) }
            }
        };
        Ok(call.costing(seconds))
    }

    fn call_occlusion(&self, shining: &Shining, tried: &mut u64) -> Result<Call, LightError> {
        if shining.of_lamps == 0.0 {
            return Ok(Call::off("no lamps: what glows is linked to all that sees it"));
        }
        let ids = self.some((NEVER / self.options.worth).ceil() as usize);
        let air = Air::new(self.map, &self.elements);
        let (n_segments, n_blocked) = air.try_lamps(&self.lamps, &ids)?;
        *tried = n_segments;
        let share = shining.of_lamps / shining.flux;
        let seconds = n_segments as f64 / ids.len().max(1) as f64
            * self.elements.len() as f64
            * SEGMENT_SECONDS;
        let call = match n_blocked {
            0 => {
                let bound = share * NEVER / n_segments.max(1) as f64;
                let what = format!("none of {n_segments} segments to lamps is blocked (95 %)");
                Call { skipped: bound, ..Call::off(what) }
            }
            _ => Call::on(
                format!("{n_blocked} of {n_segments} segments to lamps are blocked"),
                share,
            ),
        };
        Ok(call.costing(seconds))
    }

    fn call_bounces(
        &self,
        shining: &Shining,
        hierarchy: &Hierarchy,
    ) -> Result<(Call, u32), LightError> {
        let rho = self.max_albedo();
        if shining.flux == 0.0 || rho == 0.0 {
            let why = if rho == 0.0 { "nothing reflects" } else { "nothing shines" };
            return Ok((Call::off(why), 0));
        }
        let reflects = |id: usize| self.materials.channels.iter().any(|c| c.albedo[id] > 0.0);
        let reflecting: Vec<bool> = (0..self.elements.len()).map(reflects).collect();
        // Light that comes back from others: what is lit and reflects has a share of it, too.
        let Some((a, b)) = first_link(self.map.view(), hierarchy, &shining.is_lit, &reflecting)?
        else {
            return Ok((Call::off("no surfel that reflects is linked to one that is lit"), 0));
        };
        let worth = self.options.worth;
        let n_bounces = (worth * (1.0 - rho)).ln() / rho.ln();
        let n_bounces = if rho < 1.0 { n_bounces.ceil().max(1.0) as u32 } else { u32::MAX };
        let skipped = if rho < 1.0 { rho / (1.0 - rho) } else { f64::INFINITY };
        let call = Call::on(
            format!("nodes {a} and {b} are linked, albedo to {rho:.2}: {n_bounces} bounces"),
            skipped,
        );
        Ok((call.if_worth(worth), n_bounces))
    }

    fn call_color(&self) -> Call {
        let areas = self.elements.areas();
        let [r, g, b] = &self.materials.channels;
        let spread = |of: fn(&crate::Channel) -> &Vec<f64>| {
            let (mut off, mut all, mut most) = (0.0, 0.0, (0.0, 0));
            for id in 0..areas.len() {
                let values = [of(r)[id], of(g)[id], of(b)[id]];
                let mean = values.iter().sum::<f64>() / 3.0;
                let apart = values.iter().fold(0.0, |m: f64, v| m.max((v - mean).abs()));
                off += areas[id] * apart;
                all += areas[id] * mean;
                if apart > most.0 {
                    most = (apart, id);
                }
            }
            (if all > 0.0 { off / all } else { 0.0 }, most.1)
        };
        let lamps = self.colors_of_lamps();
        let of_lamps = lamps.iter().map(spread_of).fold(0.0, f64::max);
        let (of_emission, shining) = spread(|c| &c.emission);
        let (of_albedo, painted) = spread(|c| &c.albedo);
        let spread = of_emission.max(of_albedo).max(of_lamps);
        let evidence = match spread {
            0.0 => "light and surfaces are grey".to_owned(),
            _ if spread == of_albedo => {
                format!("albedo of surfel {painted}; mean spread {spread:.2}")
            }
            _ if spread == of_emission => format!("light of surfel {shining}; spread {spread:.2}"),
            _ => format!("the light of lamps or sky, spread {spread:.2}"),
        };
        Call::on(evidence, spread).if_worth(self.options.worth)
    }

    fn colors_of_lamps(&self) -> Vec<[f64; 3]> {
        let lamps = self.lamps.iter().map(|lamp| lamp.color());
        lamps.chain(self.sky.iter().map(|sky| sky.radiance)).collect()
    }

    /// Calls for mirrors in pictures, for refraction, for caustics, and for those of reflected
    /// light.
    fn call_gloss(
        &self,
        shining: &Shining,
        hierarchy: &Hierarchy,
    ) -> Result<[Call; 4], LightError> {
        let gloss = &self.materials.gloss;
        let areas = self.elements.areas();
        let first = |of: fn(&crate::Gloss) -> f32| gloss.iter().position(|one| of(one) > 0.0);
        let mirror = match first(|one| one.specular) {
            Some(id) => Call::on(format!("surfel {id} mirrors; pictures follow its rays"), 1.0),
            None => Call::off("nothing mirrors"),
        };
        let refraction = match first(|one| one.transmissive) {
            Some(id) => Call::on(format!("light goes through surfel {id}"), 1.0),
            None => Call::off("nothing lets light through"),
        };
        if !self.materials.has_gloss() || shining.flux == 0.0 {
            let none = || Call::off("nothing mirrors or lets light through");
            return Ok([mirror, refraction, none(), none()]);
        }
        let is_glossy: Vec<bool> =
            gloss.iter().map(|one| one.specular + one.transmissive > 0.0).collect();
        // No element gets more than the brightest sends, and all rows add up to 1 at the most.
        let taken = sum((0..areas.len())
            .map(|id| areas[id] * f64::from(gloss[id].specular + gloss[id].transmissive)));
        let at_most = |exitance: f64| 3.0 * taken * exitance / shining.flux;
        let links = self.map.view();
        let link = match first_link(links, hierarchy, &shining.is_lit, &is_glossy)? {
            // A lamp may shine on a mirror and on nothing that sees it.
            None => {
                let both = is_glossy.iter().zip(&shining.is_lit).map(|(a, b)| *a && *b);
                first_link(links, hierarchy, &both.collect::<Vec<_>>(), &vec![true; areas.len()])?
            }
            link => link,
        };
        let rho = self.max_albedo();
        let worth = self.options.worth;
        let (caustics, again) = match link {
            None => {
                let why = "nothing lit sees what mirrors or lets light through";
                (Call::off(why), Call::off(why))
            }
            Some((a, b)) => {
                let from_outside = shining.sent_on / shining.flux;
                let lit = (at_most(shining.most) + from_outside).min(1.0);
                let reflected = at_most(shining.most * rho / (1.0 - rho).max(1e-9));
                let why = format!("nodes {a} and {b} are linked: one lit, one glossy");
                (
                    Call::on(why.clone(), lit).if_worth(worth),
                    Call::on(why, reflected).if_worth(worth),
                )
            }
        };
        Ok([mirror, refraction, caustics, again])
    }

    fn call_near_field(&self, near: &[[u32; 2]]) -> Call {
        let Some([i, j]) = near.first() else {
            return Call::off("no linked pair is nearer than 3 radii and exchanges much");
        };
        // The middles of a pair may be wrong by all that it exchanges.
        let n = near.len();
        Call::on(format!("{n} pairs nearer than 3 radii, surfels {i} and {j} one of them"), 1.0)
            .costing(81.0 * n as f64 * PAIR_SECONDS)
    }

    fn call_order(&self, exchanges: bool) -> (Call, Option<usize>) {
        if !exchanges {
            return (Call::off("no light is exchanged"), None);
        }
        let wanted = self.operator_tolerance();
        if self.options.is_direct {
            return (Call::off("pairs are taken one by one"), None);
        }
        let chosen = (1..ORDER_ERRORS.len() - 1).find(|&p| ORDER_ERRORS[p] <= wanted);
        let order = self.options.order.or(chosen).unwrap_or(ORDER_ERRORS.len() - 1);
        let (is_on, skipped) = (order > 1, ORDER_ERRORS[1]);
        let evidence = format!(
            "p = {order}: exchange to {wanted:.0e} wanted, usual {:.0e}",
            ORDER_ERRORS[order]
        );
        (Call { is_on, evidence, skipped, seconds: 0.0 }, Some(order))
    }

    /// Makes the exchange.
    fn exchange(
        &self,
        hierarchy: &Hierarchy,
        order: Option<usize>,
    ) -> Result<Exchange, LightError> {
        let (limit_bytes, need_bytes) = (self.options.memory_bytes, self.held_bytes(hierarchy));
        let left = limit_bytes.checked_sub(need_bytes);
        let bytes = left.ok_or(LightError::Memory { limit_bytes, need_bytes })?;
        let spill = self.options.spill_folder.as_deref().map(|folder| (bytes, folder));
        let (elements, kernel) = (Arc::clone(&self.elements), Kernel::default());
        Exchange::within(elements, hierarchy.clone(), self.map.view(), kernel, (order, spill))
    }

    /// Gives the bytes that are held beside the lists of the exchange: elements, materials, what a
    /// solution iterates with, nodes with their bounds and grids, and fractions.
    fn held_bytes(&self, hierarchy: &Hierarchy) -> u64 {
        let n_fractions = self.map.view().summary().n_fractions;
        let (n_elements, n_nodes) = (self.elements.len() as u64, u64::from(hierarchy.n_nodes()));
        ELEMENT_BYTES * n_elements + NODE_BYTES * n_nodes + FRACTION_BYTES * n_fractions
    }

    /// Gives the share of directions from some elements in which nothing is.
    fn open_share(&self) -> Result<f64, LightError> {
        let air = Air::new(self.map, &self.elements);
        let looks = self.some(N_LOOKED_FROM).into_par_iter().map(|id| air.sky_over(id, None));
        let looks = looks.collect::<Result<Vec<_>, LightError>>()?;
        let open = sum(looks.iter().map(|look| f64::from(look.0)));
        Ok(open / looks.len().max(1) as f64)
    }

    /// Gives some elements, evenly spread over all.
    pub(crate) fn some(&self, n: usize) -> Vec<u32> {
        let all = self.elements.len();
        let n = n.min(all);
        (0..n).map(|k| (k as u64 * all as u64 / n as u64) as u32).collect()
    }
}

/// Gives how far the largest of three numbers is from their mean, as a share of it.
fn spread_of(color: &[f64; 3]) -> f64 {
    let mean = color.iter().sum::<f64>() / 3.0;
    let apart = color.iter().fold(0.0, |m: f64, v| m.max((v - mean).abs()));
    if mean > 0.0 { apart / mean } else { 0.0 }
}

/// Finds the first link that joins one of some elements with one of others.
fn first_link(
    links: &(impl Links + ?Sized),
    hierarchy: &Hierarchy,
    some: &[bool],
    others: &[bool],
) -> Result<Option<(u32, u32)>, LightError> {
    let [some, others] = [some, others].map(|which| {
        let counts = std::iter::once(0).chain(which.iter().scan(0u32, |n, &is_one| {
            *n += u32::from(is_one);
            Some(*n)
        }));
        counts.collect::<Vec<u32>>()
    });
    let has = |counts: &[u32], node: u32| {
        let (first, end) = hierarchy.node(node).elements;
        counts[end as usize] > counts[first as usize]
    };
    let joins =
        |&(a, b): &(u32, u32)| has(&some, a) && has(&others, b) || has(&some, b) && has(&others, a);
    let of_block = |index| match links.block(index) {
        Ok(pairs) => pairs.into_iter().find(joins).map(Ok),
        Err(e) => Some(Err(e)),
    };
    let found = (0..links.n_blocks()).into_par_iter().find_map_first(of_block).transpose()?;
    match found {
        Some(link) => Ok(Some(link)),
        None => {
            let partly = links.fractions()?.into_iter().map(|fraction| (fraction.a, fraction.b));
            Ok(partly.into_iter().find(joins))
        }
    }
}

/// Gives the processor seconds of one application, roughly.
fn application_seconds(exchange: &Exchange) -> f64 {
    let stats = exchange.stats();
    (stats.n_near_pairs + stats.n_far_pairs) as f64 * PAIR_SECONDS
}
