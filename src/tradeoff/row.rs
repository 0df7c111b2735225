//! What a setting gave.

use crate::accuracy::{Tally, wilson};

use super::Setting;
use super::forecast::CutTree;

/// A setting and what became of it.
#[derive(Debug, Clone)]
pub struct Row {
    /// The setting.
    pub setting: Setting,
    /// The tree it cuts, where that fits the memory.
    pub cut: Option<CutTree>,
    /// What it gave.
    pub outcome: Outcome,
}

/// What became of a setting.
#[derive(Debug, Clone)]
pub enum Outcome {
    /// Its map was built and asked.
    Built(Built),
    /// Its build was stopped after so many seconds, as was wished.
    Stopped(f64),
    /// It was not begun: it would take about so many seconds, far more than it may.
    NotBegun(f64),
    /// Its map is that of the setting of this name but for the record of its configuration.
    Same(String),
    /// It cannot be built as wished: its tree outgrows the memory.
    Refused(String),
}

/// What a build took, and how often its map was wrong.
#[derive(Debug, Clone, Default)]
pub struct Built {
    /// The seconds that are compared.
    pub seconds: f64,
    /// From the octree to the finished map.
    pub build_seconds: f64,
    /// From the nodes to the last pair decided: without the cut and the writing.
    pub visibility_seconds: f64,
    /// Of processors, all threads of the building process together.
    pub cpu_seconds: f64,
    /// The most anonymous memory of the building process.
    pub peak_bytes: u64,
    /// Leaves.
    pub n_leaves: u64,
    /// Links, each pair once.
    pub n_links: u64,
    /// Bytes of the map.
    pub map_bytes: u64,
    /// The answers.
    pub tally: Tally,
}

impl Built {
    /// Gives the pairs that the map says see each other, and they do not.
    pub fn false_visible(&self) -> Share {
        Share { k: self.tally.n_false_visible, n: self.tally.n_pairs }
    }

    /// Gives the pairs that the map says do not see each other, and they do.
    pub fn false_invisible(&self) -> Share {
        Share { k: self.tally.n_false_invisible, n: self.tally.n_pairs }
    }

    /// Gives both.
    pub fn error(&self) -> Share {
        let k = self.tally.n_false_visible + self.tally.n_false_invisible;
        Share { k, n: self.tally.n_pairs }
    }

    /// Gives what a pair took to answer, on average: both places found, then the pair; read from
    /// the file by one thread, in seconds of the clock that it was asked by.
    pub fn query_seconds(&self) -> f64 {
        self.tally.seconds / self.tally.n_pairs.max(1) as f64
    }
}

impl Row {
    /// Gives what was built, if it was.
    pub fn built(&self) -> Option<&Built> {
        match &self.outcome {
            Outcome::Built(built) => Some(built),
            _ => None,
        }
    }
}

impl Outcome {
    /// Says in a few words why nothing was built.
    pub fn why_not(&self) -> Option<String> {
        match self {
            Outcome::Built(_) => None,
            Outcome::Stopped(seconds) => Some(format!("stopped at {seconds} s")),
            Outcome::NotBegun(seconds) => {
                Some(format!("not begun: some {} expected", span(*seconds)))
            }
            Outcome::Same(name) => Some(format!("as {name}")),
            Outcome::Refused(why) => Some(format!("not built: {why}")),
        }
    }
}

/// Writes about how long something takes: 90 s, 40 min, 7 h.
fn span(seconds: f64) -> String {
    match seconds {
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.0} h", s / 3600.0),
    }
}

/// So many of so many.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Share {
    /// How many.
    pub k: u64,
    /// Of how many.
    pub n: u64,
}

impl Share {
    /// Gives the share, 0…1; 0 of none.
    pub fn value(self) -> f64 {
        self.k as f64 / self.n.max(1) as f64
    }

    /// Gives its 95 % interval (Wilson).
    pub fn interval(self) -> [f64; 2] {
        wilson(self.k, self.n)
    }
}
