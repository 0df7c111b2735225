//! Which effects a scene calls for, each with its evidence, bound and cost.

use std::fmt;

/// An effect that a scene may or may not call for. Source: catalogue/light.md §4.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Effect {
    /// Light straight from what shines.
    Direct,
    /// Light of the sky.
    Sky,
    /// What stands between lamps and what they shine on.
    Occlusion,
    /// Light that is reflected, once or more.
    Bounces,
    /// Three channels instead of one.
    Color,
    /// Mirrored surfaces in a picture.
    MirrorView,
    /// Surfaces that let light through.
    Refraction,
    /// Light that mirrors and lenses throw on surfaces.
    Caustics,
    /// The same of light that surfaces have reflected before.
    DiffuseSpecularDiffuse,
    /// Quadrature of pairs whose middles do not stand for them.
    NearField,
    /// Grids of more than one place.
    Order,
}

impl Effect {
    /// All of them, in the order of a plan.
    pub const ALL: [Effect; 11] = [
        Effect::Direct,
        Effect::Sky,
        Effect::Occlusion,
        Effect::Bounces,
        Effect::Color,
        Effect::MirrorView,
        Effect::Refraction,
        Effect::Caustics,
        Effect::DiffuseSpecularDiffuse,
        Effect::NearField,
        Effect::Order,
    ];

    /// Gives its name.
    pub fn name(self) -> &'static str {
        match self {
            Effect::Direct => "direct",
            Effect::Sky => "sky",
            Effect::Occlusion => "occlusion",
            Effect::Bounces => "bounces",
            Effect::Color => "color",
            Effect::MirrorView => "mirror-view",
            Effect::Refraction => "refraction",
            Effect::Caustics => "caustics",
            Effect::DiffuseSpecularDiffuse => "diffuse-specular-diffuse",
            Effect::NearField => "near-field",
            Effect::Order => "order",
        }
    }

    /// Finds the effect of a name.
    pub fn of_name(name: &str) -> Option<Effect> {
        Effect::ALL.into_iter().find(|effect| effect.name() == name)
    }

    fn index(self) -> usize {
        self as usize
    }
}

/// What a person wants of some effects, whatever the scene calls for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wishes([Option<bool>; Effect::ALL.len()]);

impl Wishes {
    /// Wants an effect, or wants it not.
    pub fn set(&mut self, effect: Effect, is_on: bool) {
        self.0[effect.index()] = Some(is_on);
    }

    /// Gives what is wanted of an effect.
    pub fn of(&self, effect: Effect) -> Option<bool> {
        self.0[effect.index()]
    }
}

/// What is decided of an effect, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// Which effect.
    pub effect: Effect,
    /// Whether it is computed.
    pub is_on: bool,
    /// Whether a wish decided it.
    pub is_wish: bool,
    /// What the scene says, with the surfels that say it.
    pub evidence: String,
    /// The share of all emitted flux that is wrong or missing at the most without it.
    pub skipped: f64,
    /// Processor seconds that it takes, or would take, roughly.
    pub seconds: f64,
}

/// The decisions of all effects, in the order of [`Effect::ALL`].
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// A decision an effect.
    pub decisions: Vec<Decision>,
    /// The order of grids, 1…7; none where pairs are taken one by one.
    pub order: Option<usize>,
    /// Bounces after which what is left is below the tolerance.
    pub bounces: u32,
    /// The share of directions from surfels in which there is nothing.
    pub open_share: f64,
    /// Whether that is so little that nothing escapes.
    pub is_closed: bool,
}

impl Plan {
    /// Gives what is decided of an effect.
    pub fn decision(&self, effect: Effect) -> &Decision {
        &self.decisions[effect.index()]
    }

    /// Says whether an effect is computed.
    pub fn is_on(&self, effect: Effect) -> bool {
        self.decision(effect).is_on
    }

    /// Sums what is left out at the most, as a share of all emitted flux.
    pub fn skipped(&self) -> f64 {
        let left_out = self.decisions.iter().filter(|decision| !decision.is_on);
        left_out.map(|decision| decision.skipped).sum()
    }
}

impl fmt::Display for Plan {
    /// Writes a line an effect: its name, on or off, the bound, the seconds and the evidence.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<26}{:<9}{:>9}  {:>9}  evidence", "effect", "", "left out", "CPU s")?;
        for decision in &self.decisions {
            let state = match (decision.is_on, decision.is_wish) {
                (true, false) => "on",
                (false, false) => "off",
                (true, true) => "on, asked",
                (false, true) => "off, asked",
            };
            let bound = if decision.is_on { 0.0 } else { decision.skipped };
            let bound = if bound == 0.0 { "0".to_owned() } else { format!("≤ {bound:.0e}") };
            let seconds = format!("{:.2}", decision.seconds);
            let name = decision.effect.name();
            writeln!(f, "{name:<25} {state:<10}{bound:>8}  {seconds:>9}  {}", decision.evidence)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_effect_is_found_by_its_name() {
        for (index, effect) in Effect::ALL.into_iter().enumerate() {
            assert_eq!(effect.index(), index);
            assert_eq!(Effect::of_name(effect.name()), Some(effect));
        }
        assert_eq!(Effect::of_name("fog"), None);
    }

    #[test]
    fn a_wish_is_kept_by_effect() {
        let mut wishes = Wishes::default();
        wishes.set(Effect::Sky, true);
        wishes.set(Effect::Color, false);
        assert_eq!(wishes.of(Effect::Sky), Some(true));
        assert_eq!(wishes.of(Effect::Color), Some(false));
        assert_eq!(wishes.of(Effect::Bounces), None);
    }
}
