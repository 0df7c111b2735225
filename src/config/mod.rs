//! The configuration of a build: TOML files, presets that ship with the command, checked values.

use std::path::{Path, PathBuf};

use pvmap_geometry::disc::Profile;
use pvmap_store::{InputFile, StoreError};
use pvmap_visibility::interaction::GIVEN_BYTES;
use pvmap_visibility::{Approximation, VisibilityError};
use pvmap_vmap::{Shape, Spacing};
use serde::{Deserialize, Serialize};

use crate::Error;
use crate::limits::{Limits, parse_memory};
use crate::rows::Rows;

/// The presets of `configs/`, embedded.
pub const PRESETS: [(&str, &str); 5] = [
    ("accurate", include_str!("../../configs/accurate.toml")),
    ("depth8", include_str!("../../configs/depth8.toml")),
    ("paper", include_str!("../../configs/paper.toml")),
    ("preview", include_str!("../../configs/preview.toml")),
    ("quick", include_str!("../../configs/quick.toml")),
];

/// What decides the content of a map.
#[derive(Debug, Clone, PartialEq)]
pub struct BuildConfig {
    /// Deepest level of a cell, 1…21.
    pub max_level: u8,
    /// Most points of a leaf above the deepest level; 0 makes a full tree.
    pub leaf_capacity: u64,
    /// How many times the area that its points cover a leaf may stretch over before it is cut
    /// further, above the deepest level; 0 asks for nothing.
    pub max_spread: u16,
    /// Which tree.
    pub tree: Shape,
    /// How discs block.
    pub profile: Profile,
    /// Where the half spacings of leaves come from.
    pub spacing: Spacing,
    /// Whether leaf pairs half in shadow get visible fractions. [F-24]
    pub fractions: bool,
    /// Pairs of node ids to start from instead of all siblings. [V-5]
    pub interaction: Option<Vec<(u32, u32)>>,
    /// What may be left out or seen coarsely; nothing in an exact map. [D-6]
    pub approximation: Approximation,
}

impl Default for BuildConfig {
    fn default() -> BuildConfig {
        BuildConfig {
            max_level: 8,
            leaf_capacity: 50,
            max_spread: 10,
            tree: Shape::Binned,
            profile: Profile::Patch,
            spacing: Spacing::Leaf,
            fractions: false,
            interaction: None,
            approximation: Approximation::default(),
        }
    }
}

/// A configuration file as it is written; every key may be missing.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RawConfig {
    /// `max_level`, 1…21.
    pub max_level: Option<u8>,
    /// `leaf_capacity`, points.
    pub leaf_capacity: Option<u64>,
    /// `max_spread`, times, 0 for any.
    pub max_spread: Option<u16>,
    /// `tree`.
    pub tree: Option<RawTree>,
    /// `profile`.
    pub profile: Option<RawProfile>,
    /// `spacing`.
    pub spacing: Option<RawSpacing>,
    /// `fractions`.
    pub fractions: Option<bool>,
    /// `threads`, 0 for all.
    pub threads: Option<usize>,
    /// `memory`, such as "1GiB".
    pub memory: Option<String>,
    /// `[interaction]`.
    pub interaction: Option<RawInteraction>,
}

/// `tree = "binned" | "paper"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum RawTree {
    /// One octree a normal bin, leaves split by normal quadrants.
    Binned,
    /// The plain adaptive octree of the paper.
    Paper,
}

/// `profile = "patch" | "oriented" | "paper"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum RawProfile {
    /// Discs cut to their points' box, transparent near their own ends.
    Patch,
    /// The same, cut to a rectangle along their points' main axes, too.
    Oriented,
    /// Discs wherever the segment meets their cell.
    Paper,
}

/// `spacing = "leaf" | "neighbors"`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum RawSpacing {
    /// By the box of a leaf's own points.
    Leaf,
    /// By the boxes of the leaves around it.
    Neighbors,
}

/// The table `[interaction]`.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RawInteraction {
    /// A CSV file with columns node_a,node_b; relative to the configuration file.
    pub list: Option<PathBuf>,
    /// `opening_angle`, the side of a cell over its distance, 0 to 1.
    pub opening_angle: Option<f64>,
    /// `min_form_factor`, 0 to 1.
    pub min_form_factor: Option<f64>,
    /// `min_exchange`, 0 to 1.
    pub min_exchange: Option<f64>,
}

impl RawInteraction {
    /// Takes what is set here, else what is set in `below`.
    fn over(self, below: RawInteraction) -> RawInteraction {
        RawInteraction {
            list: self.list.or(below.list),
            opening_angle: self.opening_angle.or(below.opening_angle),
            min_form_factor: self.min_form_factor.or(below.min_form_factor),
            min_exchange: self.min_exchange.or(below.min_exchange),
        }
    }

    fn approximation(&self) -> Result<Approximation, String> {
        let share = |key: &str, value: Option<f64>| match value.unwrap_or(0.0) {
            // A zero without a sign: it is told and compared.
            v if (0.0..=1.0).contains(&v) => Ok(v.abs()),
            v => Err(format!("{key} = {v}: it must be 0 to 1")),
        };
        Ok(Approximation {
            opening_angle: share("opening_angle", self.opening_angle)?,
            min_form_factor: share("min_form_factor", self.min_form_factor)?,
            min_exchange: share("min_exchange", self.min_exchange)?,
        })
    }
}

impl RawConfig {
    /// Finds a configuration: a file if there is one of that name, else a preset.
    ///
    /// # Errors
    /// Where neither is there, the file cannot be read, or a key is unknown or has a bad value.
    pub fn find(name: &Path) -> Result<RawConfig, Error> {
        if name.is_file() {
            let text = read_text(name)?;
            let mut raw = parse(&name.display().to_string(), &text)?;
            raw.memory_bytes()
                .and(raw.deepest_level())
                .and(raw.interaction.clone().unwrap_or_default().approximation().map(|_| 0))
                .map_err(|e| Error::Config(format!("{}: {e}", name.display())))?;
            let list = raw.interaction.as_mut().and_then(|i| i.list.as_mut());
            if let (Some(list), Some(folder)) = (list, name.parent()) {
                *list = folder.join(&*list);
            }
            return Ok(raw);
        }
        let wanted = name.to_string_lossy();
        let wanted = wanted.strip_suffix(".toml").unwrap_or(&wanted);
        match PRESETS.into_iter().find(|p| p.0 == wanted) {
            Some((preset, text)) => parse(preset, text),
            None => {
                let known = PRESETS.map(|p| p.0).join(", ");
                Err(Error::Config(format!(
                    "{}: no such configuration; give a TOML file or one of: {known}",
                    name.display()
                )))
            }
        }
    }

    /// Takes what is set here, else what is set in `below`.
    pub fn over(self, below: RawConfig) -> RawConfig {
        RawConfig {
            max_level: self.max_level.or(below.max_level),
            leaf_capacity: self.leaf_capacity.or(below.leaf_capacity),
            max_spread: self.max_spread.or(below.max_spread),
            tree: self.tree.or(below.tree),
            profile: self.profile.or(below.profile),
            spacing: self.spacing.or(below.spacing),
            fractions: self.fractions.or(below.fractions),
            threads: self.threads.or(below.threads),
            memory: self.memory.or(below.memory),
            interaction: match (self.interaction, below.interaction) {
                (Some(own), Some(below)) => Some(own.over(below)),
                (own, below) => own.or(below),
            },
        }
    }

    /// Writes it as a file that may lie anywhere: a list is named by its whole path.
    ///
    /// # Errors
    /// Where that path is no text, or not known.
    pub fn to_toml(&self) -> Result<String, Error> {
        let mut raw = self.clone();
        if let Some(list) = raw.interaction.as_mut().and_then(|i| i.list.as_mut()) {
            *list = std::path::absolute(&*list).map_err(|e| StoreError::io(list, "find", e))?;
        }
        toml::to_string(&raw).map_err(|e| Error::Config(format!("a configuration: {e}")))
    }

    fn deepest_level(&self) -> Result<u8, String> {
        let max_level = self.max_level.unwrap_or(BuildConfig::default().max_level);
        match max_level {
            1..=21 => Ok(max_level),
            _ => Err(format!("max_level = {max_level}: it must be 1 to 21")),
        }
    }

    fn memory_bytes(&self) -> Result<u64, String> {
        match &self.memory {
            None => Ok(Limits::default().memory_bytes),
            Some(text) => parse_memory(text).map_err(|e| format!("memory = {text:?}: {e}")),
        }
    }

    /// Checks every value and reads the interaction list.
    ///
    /// # Errors
    /// Where a value is out of range, or the list cannot be read or outgrows the memory.
    pub fn check(self) -> Result<(BuildConfig, Limits), Error> {
        let defaults = BuildConfig::default();
        let max_level = self.deepest_level().map_err(Error::Config)?;
        let memory_bytes = self.memory_bytes().map_err(Error::Config)?;
        let limits = Limits { threads: self.threads.unwrap_or(0), memory_bytes };
        limits.check()?;
        let interaction = self.interaction.unwrap_or_default();
        let config = BuildConfig {
            max_level,
            leaf_capacity: self.leaf_capacity.unwrap_or(defaults.leaf_capacity),
            max_spread: self.max_spread.unwrap_or(defaults.max_spread),
            tree: match self.tree {
                None => defaults.tree,
                Some(RawTree::Binned) => Shape::Binned,
                Some(RawTree::Paper) => Shape::Paper,
            },
            profile: match self.profile {
                None => defaults.profile,
                Some(RawProfile::Patch) => Profile::Patch,
                Some(RawProfile::Oriented) => Profile::Oriented,
                Some(RawProfile::Paper) => Profile::Paper,
            },
            spacing: match self.spacing {
                None => defaults.spacing,
                Some(RawSpacing::Leaf) => Spacing::Leaf,
                Some(RawSpacing::Neighbors) => Spacing::Neighbors,
            },
            fractions: self.fractions.unwrap_or(defaults.fractions),
            approximation: interaction.approximation().map_err(Error::Config)?,
            interaction: match interaction.list {
                None => None,
                Some(path) => {
                    let mut pairs = Vec::new();
                    let most = memory_bytes / GIVEN_BYTES as u64;
                    read_pairs(&path, |line, pair| {
                        pairs.push(pair);
                        if pairs.len() as u64 > most {
                            let list = path.display();
                            return Err(Error::Config(format!(
                                "{list}: line {line}: more than the {most} pairs that fit into \
                                 the memory given; give --memory {GIVEN_BYTES} bytes a pair"
                            )));
                        }
                        Ok(())
                    })?;
                    Some(pairs)
                }
            },
        };
        Ok((config, limits))
    }
}

fn parse(name: &str, text: &str) -> Result<RawConfig, Error> {
    toml::from_str(text).map_err(|e: toml::de::Error| {
        let before = &text[..e.span().map_or(0, |s| s.start.min(text.len()))];
        let line = before.matches('\n').count() + 1;
        let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
        Error::Config(format!("{name}: line {line}, column {column}: {}", e.message().trim_end()))
    })
}

/// The longest a configuration may be.
const MAX_CONFIG_BYTES: u64 = 1 << 20;

/// Reads a text file of at most 1 MiB.
pub(crate) fn read_text(path: &Path) -> Result<String, Error> {
    let odd = |what: &str| Error::Config(format!("{}: {what}; give a TOML file", path.display()));
    let file = InputFile::open(path)?;
    if file.len_bytes() > MAX_CONFIG_BYTES {
        return Err(odd("larger than 1 MiB"));
    }
    let mut bytes = vec![0; file.len_bytes() as usize];
    file.read_exact_at(&mut bytes, 0)?;
    String::from_utf8(bytes).map_err(|_| odd("not text"))
}

/// Reads an interaction list, CSV with the header `node_a,node_b`; hands out each pair with its
/// line.
fn read_pairs(
    path: &Path,
    mut each: impl FnMut(u64, (u32, u32)) -> Result<(), Error>,
) -> Result<(), Error> {
    let mut rows = Rows::of_file(path)?;
    let fail = |line: u64, what: String| {
        Err(Error::Data(format!("{}: line {line}: {what}", path.display())))
    };
    let columns = ["node_a", "node_b"].map(|name| rows.header().iter().position(|h| h == name));
    let (header_line, n_columns) = (rows.line(), rows.header().len());
    let [Some(a), Some(b)] = columns else {
        let missing = if columns[0].is_none() { "node_a" } else { "node_b" };
        return fail(header_line, format!("no column {missing}; the header is node_a,node_b"));
    };
    while let Some(row) = rows.read()? {
        let line = rows.line();
        if row.len() != n_columns {
            let n = row.len();
            return fail(line, format!("{n} columns, where the header has {n_columns}"));
        }
        let [text_a, text_b] = [row[a].trim(), row[b].trim()];
        match (text_a.parse(), text_b.parse()) {
            (Ok(a), Ok(b)) => each(line, (a, b))?,
            (Err(_), _) => return fail(line, format!("{text_a:?} is no node id")),
            (_, Err(_)) => return fail(line, format!("{text_b:?} is no node id")),
        }
    }
    Ok(())
}

/// Names the lines of an interaction list that an error is about; others stay as they are.
pub fn at_lines(list: &Path, error: Error) -> Error {
    let Error::Visibility(VisibilityError::Interaction { rows, fault }) = error else {
        return error;
    };
    let (mut row, mut lines) = (0, Vec::new());
    // The list is read once more: only the lines of its faults are worth memory.
    let read = read_pairs(list, |line, _| {
        if rows.contains(&row) {
            lines.push(line.to_string());
        }
        row += 1;
        Ok(())
    });
    match read {
        Err(e) => e,
        Ok(()) => {
            let (word, lines) =
                (if lines.len() == 1 { "line" } else { "lines" }, lines.join(" and "));
            Error::Data(format!("{}: {word} {lines}: {fault}", list.display()))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_parse_and_depth8_is_the_default() {
        for (name, text) in PRESETS {
            parse(name, text).unwrap().check().unwrap();
        }
        let depth8 = RawConfig::find(Path::new("depth8.toml")).unwrap().check().unwrap();
        assert_eq!(depth8, (BuildConfig::default(), Limits::default()));
    }

    #[test]
    fn what_is_written_is_read_again() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("pairs.csv"), "node_a,node_b\n1,2\n").unwrap();
        let text = "max_level = 7\nmax_spread = 3\ntree = \"paper\"\nmemory = \"2GiB\"\n\
                    [interaction]\nlist = \"pairs.csv\"\n";
        std::fs::write(folder.path().join("a.toml"), text).unwrap();
        let raw = RawConfig::find(&folder.path().join("a.toml")).unwrap();
        // Elsewhere, the list is still found.
        std::fs::create_dir(folder.path().join("below")).unwrap();
        let copy = folder.path().join("below/b.toml");
        std::fs::write(&copy, raw.to_toml().unwrap()).unwrap();
        let again = RawConfig::find(&copy).unwrap();
        assert_eq!(again.check().unwrap(), raw.check().unwrap());
    }

    #[test]
    fn every_file_of_configs_is_a_configuration() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
        let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        for file in files {
            RawConfig::find(&file).and_then(RawConfig::check).unwrap();
        }
    }

    #[test]
    fn an_unknown_key_is_shown_with_its_line() {
        let message = parse("x.toml", "max_level = 8\nray = 3\n").unwrap_err().to_string();
        assert!(message.contains("line 2, column 1") && message.contains("`ray`"), "{message}");
    }

    #[test]
    fn values_out_of_range_are_refused() {
        for text in ["max_level = 0", "max_level = 22", "memory = \"1MiB\"", "tree = \"oak\""] {
            let found = parse("x", text).and_then(RawConfig::check);
            assert_eq!(found.unwrap_err().exit_code(), 78, "{text}");
        }
    }
}
