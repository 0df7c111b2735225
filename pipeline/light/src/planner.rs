//! What a scene calls for: the evidence, the bounds and the costs of a plan.

use pvmap_store::Watch;

use crate::error::{LightError, check};
use crate::hierarchy::Hierarchy;
use crate::incident::N_DIRECTIONS;
use crate::kernel::Kernel;
use crate::lighting::{Lighting, Planned};
use crate::near_field::{corrections, near_pairs};
use crate::plan::{Decision, Effect, Plan};

use self::exchanged::{MAKING, application_seconds, first_link};
use self::shining::{Shining, at_most};

mod color;
mod exchanged;
mod gloss;
mod outlook;
mod shining;

/// Elements from which it is looked at lamps, at the sky and for a way out.
const N_LOOKED_FROM: usize = 256;
/// Processor seconds of a segment in the air and of what arrives from a lamp without one, roughly:
/// for costs that are said beforehand.
const SEGMENT_SECONDS: f64 = 5e-6;
const LAMP_SECONDS: f64 = 5e-8;
/// Times that an exchange is applied to scale it, and to solve a channel, roughly.
const SCALING: f64 = 6.0;
const SOLVING: f64 = 6.0;

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
        Call { is_on: true, ..Call::off(evidence) }.skipping(skipped)
    }

    /// Takes what is lost without it; all, where that may be more than there is.
    fn skipping(self, skipped: f64) -> Call {
        // What is no number is not known: it may be all.
        Call { skipped: if skipped < 1.0 { skipped } else { 1.0 }, ..self }
    }

    /// On where what would be left out is worth it.
    fn if_worth(self, worth: f64) -> Call {
        Call { is_on: self.skipped > worth, ..self }
    }

    fn costing(self, seconds: f64) -> Call {
        Call { seconds, ..self }
    }

    fn decided(self, effect: Effect, wish: Option<bool>) -> Decision {
        let Call { is_on, evidence, skipped, seconds } = self;
        let is_wish = wish.is_some_and(|wish| wish != is_on);
        Decision { effect, is_on: wish.unwrap_or(is_on), is_wish, evidence, skipped, seconds }
    }
}

/// Passes on the wish to stop alone: an effect is one step of a plan, whatever it looks at.
struct Unheard<'w>(&'w dyn Watch);

impl Watch for Unheard<'_> {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}

    fn advance(&self, _n: u64) {}

    fn warn(&self, message: &str) {
        self.0.warn(message);
    }

    fn is_stopped(&self) -> bool {
        self.0.is_stopped()
    }
}

impl Lighting<'_> {
    /// Decides which effects are computed, and prepares the exchange if any light is exchanged.
    ///
    /// # Errors
    /// Where the map is damaged, or the run is asked to stop.
    pub fn plan(&self, watch: &dyn Watch) -> Result<Planned, LightError> {
        watch.stage("plan", Some(Effect::ALL.len() as u64), "effects");
        let done = |n: u64| {
            watch.advance(n);
            check(watch)
        };
        let hierarchy = Hierarchy::of_map(self.map.view())?;
        let shining = self.shining(&Unheard(watch))?;
        let direct = self.call_direct(&shining);
        let sky = self.call_sky(&shining);
        let occlusion = self.call_occlusion(&shining);
        done(3)?;
        let bounces = self.call_bounces(&shining, &hierarchy)?;
        let gloss = self.call_gloss(&shining, &hierarchy)?;
        let exchanges = self.exchanges(&shining, &direct, &bounces);
        let color = self.call_color(&shining, exchanges);
        done(6)?;
        let near = match exchanges {
            true => {
                let (elements, links, kernel) =
                    (&self.elements, self.map.view(), Kernel::default());
                let pairs = near_pairs(elements, &hierarchy, links, kernel, self.options.worth)?;
                corrections(elements, kernel, &pairs)?
            }
            false => Vec::new(),
        };
        let near_field = self.call_near_field(&near, &shining);
        let (order_call, order) = self.call_order(exchanges, &shining);
        let is_order = self.options.wishes.of(Effect::Order).unwrap_or(order_call.is_on);
        let order = if is_order { order } else { order.map(|_| 1) };
        let is_near = self.options.wishes.of(Effect::NearField).unwrap_or(near_field.is_on);
        let near = if is_near { &near[..] } else { &[] };
        let exchange = exchanges.then(|| self.exchange(&hierarchy, order, near)).transpose()?;
        done(2)?;
        let cost = exchange.as_ref().map_or(0.0, application_seconds);
        let [mirror, refraction, caustics, again] = gloss;
        let calls = [
            (Effect::Direct, direct),
            (Effect::Sky, sky),
            (Effect::Occlusion, occlusion),
            (Effect::Bounces, bounces.costing((SCALING + SOLVING) * cost)),
            // Two channels more.
            (Effect::Color, color.costing(2.0 * SOLVING * cost)),
            (Effect::MirrorView, mirror),
            (Effect::Refraction, refraction),
            (Effect::Caustics, caustics),
            (Effect::DiffuseSpecularDiffuse, self.costing_rounds(again, cost)),
            (Effect::NearField, near_field),
            (Effect::Order, order_call.costing(MAKING * cost)),
        ];
        let decide =
            |(effect, call): (Effect, Call)| call.decided(effect, self.options.wishes.of(effect));
        let decisions = calls.into_iter().map(decide).collect();
        let outlook = exchanges.then(|| self.outlook(&Unheard(watch))).transpose()?;
        let plan = Plan { decisions, order, outlook };
        Ok(Planned { plan, exchange, n_lamp_tries: shining.tries.n_segments })
    }

    /// Says whether surfels send each other light that counts.
    fn exchanges(&self, shining: &Shining, direct: &Call, bounces: &Call) -> bool {
        let is_on = |effect, call: &Call| {
            self.options.wishes.of(effect).unwrap_or(call.is_on) && shining.flux > 0.0
        };
        let links = self.map.view().summary();
        is_on(Effect::Direct, direct)
            && (shining.emitted > 0.0 || is_on(Effect::Bounces, bounces))
            && links.n_links + links.n_fractions > 0
    }

    fn call_direct(&self, shining: &Shining) -> Call {
        if shining.flux == 0.0 {
            let why = match shining.unblocked > 0.0 {
                true => "nothing of the light of lamps arrives",
                false => "nothing shines",
            };
            return Call::off(why);
        }
        let n_lit = shining.is_lit.iter().filter(|&&is_lit| is_lit).count();
        let n_lamps = self.lamps.len();
        let of = |flux: f64| 100.0 * flux / shining.flux;
        let lamps = match n_lamps {
            0 => String::new(),
            n => format!(", lamps ({n}) {:.0} %", of(shining.of_lamps)),
        };
        let sky = match shining.sky.whole {
            0.0 => String::new(),
            _ => format!(", sky {:.0} %", of(shining.of_sky)),
        };
        Call::on(format!("{n_lit} surfels shine or are shone on{lamps}{sky}"), 1.0)
            .costing(n_lit as f64 * n_lamps as f64 * LAMP_SECONDS)
    }

    fn call_sky(&self, shining: &Shining) -> Call {
        let seconds = N_DIRECTIONS as f64 * self.elements.len() as f64 * SEGMENT_SECONDS;
        let look = &shining.sky;
        if look.whole == 0.0 {
            return Call::off("the sky is dark").costing(seconds);
        }
        let n = look.n_directions;
        let call = match look.best {
            Some((id, most)) => {
                let [open, most] = [look.open, most].map(|share| 100.0 * share);
                let what =
                    format!("{open:.2} % of {n} directions open, of surfel {id} {most:.0} %");
                Call::on(what, shining.lasting(shining.of_sky))
            }
            None => {
                let what = format!("none of {n} directions is open (95 %)");
                Call::on(what, shining.lasting(look.whole * at_most(0.0, n as f64)))
            }
        };
        call.if_worth(self.options.worth).costing(seconds)
    }

    fn call_occlusion(&self, shining: &Shining) -> Call {
        if shining.unblocked == 0.0 {
            return Call::off("no lamps: what glows is linked to what sees it");
        }
        let tries = &shining.tries;
        let seconds = tries.n_segments as f64 / tries.n_tried.max(1) as f64
            * tries.n_reached as f64
            * SEGMENT_SECONDS;
        let (n, of) = (tries.n_segments, if tries.is_all { "of all" } else { "of" });
        let evidence = match (n, tries.n_blocked) {
            (0, _) => "segments to lamps are not tried".to_owned(),
            (_, 0) if tries.is_all => format!("none {of} {n} segments to lamps is blocked"),
            (_, 0) => format!("none {of} {n} segments to lamps is blocked (95 %)"),
            (_, blocked) => {
                let percent = 100.0 * tries.lost;
                format!("{blocked} {of} {n} segments to lamps blocked, {percent:.1} % of light")
            }
        };
        Call::on(evidence, shining.lasting(shining.unblocked * tries.lost_at_most()))
            .if_worth(self.options.worth)
            .costing(seconds)
    }

    /// Says of each element whether it reflects light.
    fn reflecting(&self) -> Vec<bool> {
        let reflects = |id: usize| self.materials.channels.iter().any(|c| c.albedo[id] > 0.0);
        (0..self.elements.len()).map(reflects).collect()
    }

    fn call_bounces(&self, shining: &Shining, hierarchy: &Hierarchy) -> Result<Call, LightError> {
        let rho = self.max_albedo();
        if shining.flux == 0.0 || rho == 0.0 {
            let why = if rho == 0.0 { "nothing reflects" } else { "nothing shines" };
            return Ok(Call::off(why));
        }
        let reflecting = self.reflecting();
        // What mirrors and lenses throw lights anything.
        let everywhere = self.materials.has_gloss().then(|| vec![true; reflecting.len()]);
        let is_lit = everywhere.as_ref().unwrap_or(&shining.is_lit);
        // Light that comes back from others: what is lit and reflects has a share of it, too.
        let Some((a, b)) = first_link(self.map.view(), hierarchy, is_lit, &reflecting)? else {
            return Ok(Call::off("no surfel that reflects is linked to one that is lit"));
        };
        let worth = self.options.worth;
        // After so many what is left is worth nothing.
        let n_bounces = ((worth * (1.0 - rho)).ln() / rho.ln()).ceil().max(1.0);
        let many =
            if rho < 1.0 { format!("{n_bounces:.0} bounces") } else { "all bounces".to_owned() };
        // Of all light, 1 / (1 - ρ) of what is emitted, all but that.
        let call = Call::on(format!("link {a}-{b}, albedo to {rho:.2}: {many}"), rho);
        Ok(call.if_worth(worth))
    }
}
