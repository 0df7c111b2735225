//! `lights.toml`: what shines on a scan and what its surfaces are made of, laid onto the surfels
//! of its map.
//!
//! [`Lights`] is such a file, checked: a fault names line and column. [`EXAMPLE`] says all that one
//! may hold. [`Lights::assign`] gives each surfel its albedo, gloss and emission, and the lamps and
//! the sky that are added; [`majority_classes`] reads from the octree what rules by class ask for.

mod assign;
mod parse;
mod rules;
mod table;

use std::path::Path;

pub use crate::classes::majority_classes;
use crate::config::read_text;
use crate::{Error, lights::table::Fault};
pub use assign::{Assigned, Glowing};
use pvmap_light::Sky;
use rules::{Albedo, Rules, Selection, unit};

/// A `lights.toml` with all that one may hold, and what it means.
pub const EXAMPLE: &str = include_str!("example.toml");

/// What a `lights.toml` says. Two are equal if they say the same, wherever they say it.
#[derive(Debug, Clone)]
pub struct Lights {
    rules: Rules,
    glows_at: Vec<Mark>,
    materials_at: Vec<Mark>,
}

/// Says that a rule by class has no classes.
fn without_classes(mark: &Mark) -> Error {
    let what = "a map has no classes; give --octree NAME.octree, the one it was built from";
    Error::Usage(format!("{}{what}", mark.prefix))
}

/// Where a rule stands.
#[derive(Debug, Clone, Default)]
struct Mark {
    line: usize,
    /// For messages: `lights.toml:12:1: `, or `12:1: ` of a text without a name.
    prefix: String,
}

impl PartialEq for Lights {
    fn eq(&self, other: &Lights) -> bool {
        self.rules == other.rules
    }
}

impl Lights {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// Where it cannot be read, is larger than 1 MiB or is none, with path, line and column.
    pub fn read(path: &Path) -> Result<Lights, Error> {
        Lights::named(&format!("{}:", path.display()), &read_text(path)?)
    }

    /// Reads and checks a text.
    ///
    /// # Errors
    /// Where it is no `lights.toml`, with line and column.
    pub fn parse(text: &str) -> Result<Lights, Error> {
        Lights::named("", text)
    }

    fn named(name: &str, text: &str) -> Result<Lights, Error> {
        let mark = |at: usize| {
            let before = text.get(..at).unwrap_or(text);
            let line = before.matches('\n').count() + 1;
            let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
            Mark { line, prefix: format!("{name}{line}:{column}: ") }
        };
        let parsed = parse::parse(text)
            .map_err(|Fault { at, what }| Error::Config(format!("{}{what}", mark(at).prefix)))?;
        let marks = |all: &[usize]| all.iter().map(|&at| mark(at)).collect();
        Ok(Lights {
            glows_at: marks(&parsed.glows_at),
            materials_at: marks(&parsed.materials_at),
            rules: parsed.rules,
        })
    }

    /// Writes what is said as canonical TOML: without comments, colours in linear light, nothing
    /// left to a default. Read again it is equal.
    pub fn to_text(&self) -> String {
        self.rules.to_text()
    }

    /// Gives the exposure by which the scan's colours count; 1 where they do not.
    pub fn exposure(&self) -> f64 {
        match self.rules.albedo {
            Albedo::Scan { exposure, .. } => exposure,
            _ => 1.0,
        }
    }

    /// Gives the sky, its up of length 1.
    pub fn sky(&self) -> Option<Sky> {
        self.rules.sky.map(|sky| Sky { up: unit(sky.up), ..sky })
    }

    /// Says whether a rule selects by class, which a map does not have: [`majority_classes`] does.
    pub fn needs_classes(&self) -> bool {
        self.first_by_class().is_some()
    }

    /// Says where a rule by class stands that lacks classes.
    pub(crate) fn without_classes(&self) -> Error {
        without_classes(self.first_by_class().unwrap_or(&Mark::default()))
    }

    /// Finds the first rule that selects by class.
    fn first_by_class(&self) -> Option<&Mark> {
        let rules = &self.rules;
        let glows = rules.glows.iter().map(|glow| &glow.on).zip(&self.glows_at);
        let materials = rules.materials.iter().map(|one| &one.on).zip(&self.materials_at);
        let mut by_class =
            glows.chain(materials).filter(|(on, _)| matches!(on, Selection::Class(_)));
        by_class.next().map(|(_, mark)| mark)
    }
}
