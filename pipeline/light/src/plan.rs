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
    /// The share of all light, emitted and reflected, that is wrong or missing without it: as far
    /// as is known at the most, 0…1.
    pub skipped: f64,
    /// Processor seconds that it takes, or would take, roughly.
    pub seconds: f64,
}

/// What leads out of a scene, and whether it counts as closed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlook {
    /// The share of directions from surfels in which there is nothing, but for gaps of patches.
    pub open_share: f64,
    /// Directions that were looked in.
    pub n_directions: u64,
    /// Whether that is so little that the scene is closed but for it: so much escapes everywhere
    /// alike.
    pub is_closed: bool,
    /// What light there is too much of, as a share of it, if gaps are taken for none and are some.
    pub doubt: f64,
}

/// The share of directions that gaps between patches leave open in rooms that are closed, beside
/// those that are known for such: up to 1.3e-3 of 16 384 were counted where points lie at random.
const GAPS: f64 = 1.5e-3;

/// The decisions of all effects, in the order of [`Effect::ALL`].
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// A decision an effect.
    pub decisions: Vec<Decision>,
    /// The order of grids, 1…7; none where pairs are taken one by one.
    pub order: Option<usize>,
    /// What leads out; none where no light is exchanged.
    pub outlook: Option<Outlook>,
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

    /// Sums what is left out at the most, as a share of all light.
    pub fn skipped(&self) -> f64 {
        let left_out = self.decisions.iter().filter(|decision| !decision.is_on);
        left_out.map(|decision| decision.skipped).sum()
    }

    /// Gives the share of light that escapes everywhere alike; none where the scene is open.
    pub fn let_out(&self) -> Option<f64> {
        let closed = self.outlook.filter(|outlook| outlook.is_closed);
        closed.map(|Outlook { open_share, .. }| if open_share < GAPS { 0.0 } else { open_share })
    }

    /// Says whether an effect was computed, by the text of a plan; none where that does not say.
    pub fn said_of(text: &str, effect: Effect) -> Option<bool> {
        let mut lines = text.lines().map(str::split_whitespace);
        let state = lines.find_map(|mut words| {
            if words.next() == Some(effect.name()) { words.next() } else { None }
        })?;
        match state.trim_end_matches(',') {
            "on" => Some(true),
            "off" => Some(false),
            _ => None,
        }
    }
}

/// Columns of a line before the evidence, and of the evidence.
const BEFORE_EVIDENCE: usize = 54;
const EVIDENCE: usize = 46;

impl fmt::Display for Plan {
    /// Writes a line an effect: its name, on or off, the share of all light that is lost without
    /// it at the most, the seconds and the evidence, which goes on in lines that begin with spaces;
    /// then whether the scene is closed.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<25}{:<11}{:>7}  {:>7}  evidence", "effect", "", "loses", "CPU s")?;
        for decision in &self.decisions {
            let state = match (decision.is_on, decision.is_wish) {
                (true, false) => "on",
                (false, false) => "off",
                (true, true) => "on, asked",
                (false, true) => "off, asked",
            };
            let begin = (decision.effect.name(), state, decision.skipped, decision.seconds);
            write_line(f, begin, &decision.evidence)?;
        }
        let Some(Outlook { open_share, n_directions, doubt, .. }) = self.outlook else {
            return Ok(());
        };
        let (state, why) = match self.let_out() {
            Some(0.0) => ("closed", "as gaps of patches do"),
            Some(_) => ("closed", "so much escapes, everywhere alike"),
            None => ("open", "what arrives nowhere escapes"),
        };
        let percent = 100.0 * open_share;
        let what = match open_share {
            0.0 => format!("none of {n_directions} directions leads out"),
            _ => format!("{percent:.2} % of {n_directions} directions lead out: {why}"),
        };
        let doubt = if self.let_out() == Some(0.0) { doubt } else { 0.0 };
        write_line(f, ("scene", state, doubt, 0.0), &what)
    }
}

/// Writes a line of a plan.
fn write_line(
    f: &mut fmt::Formatter<'_>,
    (name, state, bound, seconds): (&str, &str, f64, f64),
    evidence: &str,
) -> fmt::Result {
    let bound = match bound {
        0.0 => "0".to_owned(),
        all if all >= 0.95 => "all".to_owned(),
        part => format!("≤ {part:.0e}"),
    };
    write!(f, "{name:<25}{state:<11}{bound:>7}  {seconds:>7.2}  ")?;
    let mut column = 0;
    for word in evidence.split_whitespace() {
        let length = word.chars().count();
        if column > 0 && column + 1 + length > EVIDENCE {
            write!(f, "\n{:BEFORE_EVIDENCE$}", "")?;
            column = 0;
        }
        let gap = if column > 0 { " " } else { "" };
        write!(f, "{gap}{word}")?;
        column += gap.len() + length;
    }
    writeln!(f)
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
    fn lines_are_short_and_say_of_each_effect_whether_it_is_on() {
        let decide = |effect: Effect| Decision {
            effect,
            is_on: effect > Effect::Bounces,
            is_wish: effect > Effect::Caustics,
            evidence: "many long words of evidence ".repeat(effect.index()),
            skipped: [3e5, 1e-3, 0.0][effect.index() % 3],
            seconds: 1234.5,
        };
        let outlook =
            Outlook { open_share: 1e-3, n_directions: 16_384, is_closed: true, doubt: 3e-3 };
        let plan = Plan {
            decisions: Effect::ALL.into_iter().map(decide).collect(),
            order: None,
            outlook: Some(outlook),
        };
        let text = plan.to_string();
        assert!(text.lines().all(|line| line.chars().count() <= 100), "{text}");
        assert!(text.contains("all") && !text.contains("3e5"), "{text}");
        assert!(text.contains("\nscene                    closed"), "{text}");
        for effect in Effect::ALL {
            assert_eq!(Plan::said_of(&text, effect), Some(plan.is_on(effect)), "{text}");
        }
        assert_eq!(Plan::said_of("direct: on\nskylight on\n", Effect::Direct), None);
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
