//! What light costs: the maps of a sweep, each lit in several ways, and how far each light is off.
//!
//! A [`Way`] is how a map is lit; a [`LitRow`] a setting lit in a way, and what that took. How far
//! it is off says a [`Yardstick`]: places whose irradiance somebody measured or traced, or the
//! light of the same map pair by pair. [`table`] writes rows as text and CSV, [`plot`] draws them.
//!
//! As with [maps](super), nothing is lit here: each light is a `pvmap light` of its own.

pub mod plot;
pub mod table;
mod yardstick;

use super::pareto::{Choice, Figures, Wish, choose_of, front_of};
use super::table::outcome_word;
use super::{Built, Clock, Outcome, Setting};

pub use yardstick::{KnownPlace, Off, Yardstick};

/// How a map is lit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Way {
    /// By multipoles of this order.
    Order(u8),
    /// All pairs of surfels one by one.
    Direct,
    /// As this error asks for.
    Error(f64),
}

impl Way {
    /// Lists the ways that are tried where none are asked for.
    pub fn usual() -> Vec<Way> {
        let orders = (1..=5).map(Way::Order);
        orders.chain([Way::Direct]).chain([0.05, 0.01, 0.002].map(Way::Error)).collect()
    }

    /// Gives what it is called: "order 3", "direct", "error 1 %".
    pub fn name(self) -> String {
        match self {
            Way::Order(p) => format!("order {p}"),
            Way::Direct => "direct".to_owned(),
            // Digits that a product with 0.01 adds say nothing.
            Way::Error(e) => format!("error {} %", (e * 1e10).round() / 1e8),
        }
    }
}

/// What a sweep over lights is about, as it is told over its rows.
#[derive(Debug, Clone, PartialEq)]
pub struct LightSubject {
    /// The scene or the file.
    pub name: String,
    /// Points of its octree.
    pub n_points: u64,
    /// The file that says what shines.
    pub lights: String,
    /// What says how much light there is.
    pub judge: LightJudge,
    /// Which seconds are compared.
    pub clock: Clock,
}

/// What says how much light there is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LightJudge {
    /// So many places of a file.
    Places {
        /// The file.
        file: String,
        /// How many.
        n: usize,
    },
    /// The light of the same map, pair by pair: a reference and not the truth.
    Reference,
}

impl LightJudge {
    /// The error that the light of a reference is asked for.
    pub const REFERENCE_ERROR: f64 = 1e-6;

    /// Says what it is, in a few words.
    pub fn words(&self) -> String {
        match self {
            LightJudge::Places { file, n } => format!("irradiance of {n} places of {file}"),
            LightJudge::Reference => format!(
                "reference (not truth): the light of the same map pair by pair, to {:e}",
                LightJudge::REFERENCE_ERROR
            ),
        }
    }

    /// Gives the word of a column or key.
    pub fn word(&self) -> &'static str {
        match self {
            LightJudge::Places { .. } => "irradiance",
            LightJudge::Reference => "reference",
        }
    }
}

/// A setting lit in a way, and what became of it.
#[derive(Debug, Clone)]
pub struct LitRow {
    /// The setting of the map.
    pub setting: Setting,
    /// The way; none where no way was tried.
    pub way: Option<Way>,
    /// What it gave.
    pub outcome: LitOutcome,
}

/// What became of a light.
#[derive(Debug, Clone)]
pub enum LitOutcome {
    /// It is there, and was judged.
    Lit(Box<Lit>),
    /// It was stopped after so many seconds, as was wished.
    Stopped(f64),
    /// It cannot be made as wished: why.
    Refused(String),
    /// There is no map to light; never [`Outcome::Built`].
    NoMap(Outcome),
    /// There is a map, but nothing to hold its light against: why.
    NoReference(String),
}

/// What a light took, and how far it is off.
#[derive(Debug, Clone, Default)]
pub struct Lit {
    /// What its map took, of which no pairs were asked.
    pub map: Built,
    /// The seconds of the light that are compared.
    pub seconds: f64,
    /// From the map to the finished light file.
    pub light_seconds: f64,
    /// Of processors, all threads of the process together.
    pub cpu_seconds: f64,
    /// The most anonymous memory of the process.
    pub peak_bytes: u64,
    /// The order of its multipoles; 0 pair by pair.
    pub order: u32,
    /// Iterations of the solver, in the channel with the most.
    pub iterations: u32,
    /// Mean relative error of what multipoles bring, at 64 surfels.
    pub operator_error: f64,
    /// How far it is off.
    pub off: Off,
}

impl Lit {
    /// Gives the seconds of the map and of its light together.
    pub fn both_seconds(&self) -> f64 {
        self.map.seconds + self.seconds
    }
}

impl LitRow {
    /// Gives the light, if it is there.
    pub fn lit(&self) -> Option<&Lit> {
        match &self.outcome {
            LitOutcome::Lit(lit) => Some(lit),
            _ => None,
        }
    }

    /// Gives what it is called: "level 7, order 3".
    pub fn name(&self) -> String {
        let name = &self.setting.name;
        self.way.map_or_else(|| name.clone(), |way| format!("{name}, {}", way.name()))
    }
}

impl LitOutcome {
    /// Gives the word of a column or key.
    pub fn word(&self) -> &'static str {
        match self {
            LitOutcome::Lit(_) => "lit",
            LitOutcome::Stopped(_) => "stopped",
            LitOutcome::Refused(_) => "refused",
            LitOutcome::NoMap(outcome) => outcome_word(outcome),
            LitOutcome::NoReference(_) => "no reference",
        }
    }

    /// Says in a few words why there is no light.
    pub fn why_not(&self) -> Option<String> {
        match self {
            LitOutcome::Lit(_) => None,
            LitOutcome::Stopped(seconds) => Some(format!("stopped at {seconds} s")),
            LitOutcome::Refused(why) => Some(format!("not lit: {why}")),
            LitOutcome::NoMap(outcome) => outcome.why_not().map(|why| format!("map {why}")),
            LitOutcome::NoReference(why) => Some(format!("no reference: {why}")),
        }
    }
}

/// Says of each row whether no other takes as little, map and light together, and is as near.
pub fn front(rows: &[LitRow]) -> Vec<bool> {
    front_of(&figures(rows, Lit::both_seconds))
}

/// Chooses a row, by the seconds of map and light together and the mean error.
pub fn choose(rows: &[LitRow], wish: Wish) -> Option<Choice> {
    choose_of(&figures(rows, Lit::both_seconds), wish)
}

/// Gives what rows are judged by; the error is what it is, without an interval.
fn figures(rows: &[LitRow], seconds: impl Fn(&Lit) -> f64) -> Vec<Option<Figures>> {
    let of_row = |row: &LitRow| {
        let lit = row.lit()?;
        Some(Figures { seconds: seconds(lit), error: lit.off.mean, most: lit.off.mean })
    };
    rows.iter().map(of_row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_are_named_as_they_are_asked_for() {
        let names: Vec<String> = Way::usual().into_iter().map(Way::name).collect();
        assert_eq!(names[..2], ["order 1", "order 2"]);
        assert_eq!(names[4..], ["order 5", "direct", "error 5 %", "error 1 %", "error 0.2 %"]);
        assert_eq!(Way::Error(0.07 * 0.01).name(), "error 0.07 %");
        assert_eq!(Way::Error(1e-6).name(), "error 0.0001 %");
    }
}
