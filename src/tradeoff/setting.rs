//! Settings: configurations with short names, and lists of them.

use pvmap_geometry::disc::Profile;
use pvmap_vmap::{Shape, Spacing};

use crate::config::{PRESETS, RawConfig, RawInteraction, RawProfile, RawSpacing, RawTree};
use crate::{BuildConfig, Error};

/// A configuration with a short name.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// What it is called: "depth8", "level 7", "capacity 100, spread 3".
    pub name: String,
    /// As a configuration file has it.
    pub raw: RawConfig,
    /// What decides the content of its map.
    pub config: BuildConfig,
    /// Whether its map is asked by the segments between places.
    pub by_segment: bool,
}

impl Setting {
    fn new(name: String, raw: RawConfig) -> Result<Setting, Error> {
        let (config, _) = raw.clone().check()?;
        Ok(Setting { name, raw, config, by_segment: false })
    }

    /// Gives the setting that is default.
    pub(super) fn plain() -> Setting {
        let (raw, config) = (RawConfig::default(), BuildConfig::default());
        Setting { name: "depth8".to_owned(), raw, config, by_segment: false }
    }

    /// Gives the same setting, its map asked by the segments between places.
    pub fn segments(&self) -> Setting {
        let name = format!("{}, segments", self.name);
        Setting { name, by_segment: true, ..self.clone() }
    }

    /// Gives the word for how its map is made and asked: exact and by its leaves, or otherwise.
    pub fn mode(&self) -> String {
        let BuildConfig { interaction, approximation, .. } = &self.config;
        let words = [
            (interaction.is_some(), "given list"),
            (approximation.opening_angle > 0.0, "opening angle"),
            (approximation.min_form_factor > 0.0, "form factor"),
            (approximation.min_exchange > 0.0, "exchange"),
            (self.config.fractions, "fractions"),
            (self.by_segment, "segments"),
        ];
        let said: Vec<&str> =
            words.into_iter().filter(|(is_so, _)| *is_so).map(|(_, word)| word).collect();
        if said.is_empty() { "exact".to_owned() } else { said.join(", ") }
    }

    /// Gives the word for its tree.
    pub fn tree(&self) -> &'static str {
        match self.config.tree {
            Shape::Binned => "binned",
            Shape::Paper => "paper",
        }
    }

    /// Gives the word for its profile.
    pub fn profile(&self) -> &'static str {
        match self.config.profile {
            Profile::Patch => "patch",
            Profile::Oriented => "oriented",
            Profile::Paper => "paper",
        }
    }

    /// Gives the word for where its half spacings come from.
    pub fn spacing(&self) -> &'static str {
        match self.config.spacing {
            Spacing::Leaf => "leaf",
            Spacing::Neighbors => "neighbors",
        }
    }
}

/// Values to try, an axis each; an empty axis keeps what a configuration says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Axes {
    /// Deepest levels.
    pub max_level: Vec<u8>,
    /// Capacities of leaves, points.
    pub leaf_capacity: Vec<u64>,
    /// How far leaves may be spread, times.
    pub max_spread: Vec<u16>,
    /// Trees.
    pub tree: Vec<RawTree>,
    /// Profiles.
    pub profile: Vec<RawProfile>,
    /// Where half spacings come from.
    pub spacing: Vec<RawSpacing>,
    /// Opening angles; 0 is exact.
    pub opening_angle: Vec<f64>,
    /// Least form factors; 0 is exact.
    pub min_form_factor: Vec<f64>,
    /// Least exchanges; 0 is exact.
    pub min_exchange: Vec<f64>,
    /// Visible fractions for leaf pairs half in shadow, or none.
    pub fractions: Vec<bool>,
}

impl Axes {
    /// Says whether there is nothing to try.
    pub fn is_empty(&self) -> bool {
        *self == Axes::default()
    }

    /// Gives every combination of the values.
    fn product(&self) -> Vec<RawConfig> {
        let mut found = vec![RawConfig::default()];
        found = each(found, &self.tree, |raw, &v| raw.tree = Some(v));
        found = each(found, &self.profile, |raw, &v| raw.profile = Some(v));
        found = each(found, &self.spacing, |raw, &v| raw.spacing = Some(v));
        found = each(found, &self.opening_angle, |raw, &v| {
            raw.interaction.get_or_insert_default().opening_angle = Some(v);
        });
        found = each(found, &self.min_form_factor, |raw, &v| {
            raw.interaction.get_or_insert_default().min_form_factor = Some(v);
        });
        found = each(found, &self.min_exchange, |raw, &v| {
            raw.interaction.get_or_insert_default().min_exchange = Some(v);
        });
        found = each(found, &self.fractions, |raw, &v| raw.fractions = Some(v));
        found = each(found, &self.max_level, |raw, &v| raw.max_level = Some(v));
        found = each(found, &self.leaf_capacity, |raw, &v| raw.leaf_capacity = Some(v));
        each(found, &self.max_spread, |raw, &v| raw.max_spread = Some(v))
    }
}

/// Sets every value in every configuration; leaves them as they are where there is none.
fn each<T>(
    configs: Vec<RawConfig>,
    values: &[T],
    set: impl Fn(&mut RawConfig, &T),
) -> Vec<RawConfig> {
    if values.is_empty() {
        return configs;
    }
    let with = |raw: RawConfig| {
        values.iter().map({
            let set = &set;
            move |value| {
                let mut raw = raw.clone();
                set(&mut raw, value);
                raw
            }
        })
    };
    configs.into_iter().flat_map(with).collect()
}

/// Settings to try, each once, in an order that stays.
#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    /// The settings.
    pub settings: Vec<Setting>,
}

impl Sweep {
    /// Crosses configurations, each with its name, with the values of the axes. Where there are no
    /// values they are tried as they are; of settings that say the same the first is kept.
    ///
    /// # Errors
    /// Where a value is out of range or an interaction list cannot be read.
    pub fn of(bases: &[(String, RawConfig)], axes: &Axes) -> Result<Sweep, Error> {
        let mut sweep = Sweep { settings: Vec::new() };
        for (name, base) in bases {
            let (plain, _) = base.clone().check()?;
            for over in axes.product() {
                let differences = differences(&over, &plain);
                let raw = over.over(base.clone());
                let name = match (&differences[..], bases) {
                    ([], _) => name.clone(),
                    (some, [_]) => some.join(", "),
                    (some, _) => format!("{name}, {}", some.join(", ")),
                };
                sweep.push(Setting::new(name, raw)?);
            }
        }
        Ok(sweep)
    }

    /// Goes from one configuration along one axis at a time: approximations, levels, capacities,
    /// spreads, spacings of leaves around (with small leaves, too, which need them), all three as
    /// `accurate` has them, the other profiles, the paper's tree, and both.
    ///
    /// # Errors
    /// Where the configuration is none.
    pub fn around(name: &str, base: &RawConfig) -> Result<Sweep, Error> {
        let one = |axes: Axes| Sweep::of(&[(name.to_owned(), base.clone())], &axes);
        let mut sweep = one(Axes::default())?;
        let steps = [
            Axes { opening_angle: vec![0.06, 0.1, 0.15, 0.25], ..Axes::default() },
            Axes { min_form_factor: vec![1e-4], ..Axes::default() },
            Axes { min_exchange: vec![1e-7, 1e-6], ..Axes::default() },
            Axes { fractions: vec![true], ..Axes::default() },
            Axes { max_level: vec![5, 6, 7], ..Axes::default() },
            Axes { leaf_capacity: vec![12, 25, 100, 200], ..Axes::default() },
            Axes { max_spread: vec![0, 3], ..Axes::default() },
            Axes {
                spacing: vec![RawSpacing::Neighbors],
                leaf_capacity: vec![12, 25, 50],
                ..Axes::default()
            },
            // The preset `accurate`.
            Axes {
                spacing: vec![RawSpacing::Neighbors],
                leaf_capacity: vec![25],
                max_spread: vec![3],
                ..Axes::default()
            },
            Axes { profile: vec![RawProfile::Oriented, RawProfile::Paper], ..Axes::default() },
            Axes { tree: vec![RawTree::Paper], ..Axes::default() },
            // The preset `paper`.
            Axes {
                max_spread: vec![0],
                tree: vec![RawTree::Paper],
                profile: vec![RawProfile::Paper],
                ..Axes::default()
            },
        ];
        for axes in steps {
            one(axes)?.settings.into_iter().for_each(|setting| sweep.push(setting));
        }
        Ok(sweep)
    }

    /// Crosses the levels and capacities of one configuration that light takes anything from little
    /// to much with, and adds two maps whose far pairs are coarse.
    ///
    /// # Errors
    /// Where the configuration is none.
    pub fn for_light(name: &str, base: &RawConfig) -> Result<Sweep, Error> {
        let steps = [
            Axes {
                max_level: vec![5, 6, 7, 8],
                leaf_capacity: vec![200, 50, 25],
                ..Axes::default()
            },
            Axes { min_exchange: vec![1e-6], ..Axes::default() },
            Axes { opening_angle: vec![0.15], ..Axes::default() },
        ];
        let mut sweep = Sweep { settings: Vec::new() };
        for axes in steps {
            let some = Sweep::of(&[(name.to_owned(), base.clone())], &axes)?;
            some.settings.into_iter().for_each(|setting| sweep.push(setting));
        }
        Ok(sweep)
    }

    /// Adds a setting, unless there is one that says the same.
    fn push(&mut self, mut setting: Setting) {
        if self.settings.iter().any(|s| s.config == setting.config) {
            return;
        }
        // What ships under a name goes by that name.
        let is_same = |text: &str| {
            let preset = toml::from_str::<RawConfig>(text).ok().and_then(|raw| raw.check().ok());
            preset.is_some_and(|(config, _)| config == setting.config)
        };
        if let Some((name, _)) = PRESETS.into_iter().find(|(_, text)| is_same(text)) {
            setting.name = name.to_owned();
        }
        self.settings.push(setting);
    }
}

/// Names the values that are others than those of a configuration.
fn differences(over: &RawConfig, plain: &BuildConfig) -> Vec<String> {
    let tree = |tree| match tree {
        RawTree::Binned => ("binned", Shape::Binned),
        RawTree::Paper => ("paper", Shape::Paper),
    };
    let profile = |profile| match profile {
        RawProfile::Patch => ("patch", Profile::Patch),
        RawProfile::Oriented => ("oriented", Profile::Oriented),
        RawProfile::Paper => ("paper", Profile::Paper),
    };
    let spacing = |spacing| match spacing {
        RawSpacing::Leaf => ("leaf", Spacing::Leaf),
        RawSpacing::Neighbors => ("neighbors", Spacing::Neighbors),
    };
    let tree = over.tree.map(tree).filter(|t| t.1 != plain.tree);
    let profile = over.profile.map(profile).filter(|p| p.1 != plain.profile);
    let spacing = over.spacing.map(spacing).filter(|s| s.1 != plain.spacing);
    let level = over.max_level.filter(|&v| v != plain.max_level);
    let capacity = over.leaf_capacity.filter(|&v| v != plain.leaf_capacity);
    let spread = over.max_spread.filter(|&v| v != plain.max_spread);
    let RawInteraction { opening_angle, min_form_factor, min_exchange, .. } =
        over.interaction.clone().unwrap_or_default();
    let angle = opening_angle.filter(|&v| v != plain.approximation.opening_angle);
    let factor = min_form_factor.filter(|&v| v != plain.approximation.min_form_factor);
    let exchange = min_exchange.filter(|&v| v != plain.approximation.min_exchange);
    let fractions = over.fractions.filter(|&v| v != plain.fractions);
    [
        tree.map(|(word, _)| format!("tree {word}")),
        profile.map(|(word, _)| format!("profile {word}")),
        spacing.map(|(word, _)| format!("spacing {word}")),
        level.map(|v| format!("level {v}")),
        capacity.map(|v| format!("capacity {v}")),
        spread.map(|v| format!("spread {v}")),
        angle.map(|v| format!("opening angle {v}")),
        factor.map(|v| format!("form factor {v}")),
        exchange.map(|v| format!("exchange {v:e}")),
        fractions.map(|v| if v { "fractions" } else { "no fractions" }.to_owned()),
    ]
    .into_iter()
    .flatten()
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(sweep: &Sweep) -> Vec<&str> {
        sweep.settings.iter().map(|s| s.name.as_str()).collect()
    }

    fn preset(name: &str) -> (String, RawConfig) {
        (name.to_owned(), RawConfig::find(name.as_ref()).unwrap())
    }

    #[test]
    fn axes_are_crossed_and_named_by_what_differs() {
        let axes = Axes {
            max_level: vec![7, 8],
            leaf_capacity: vec![50, 100],
            tree: vec![RawTree::Binned],
            ..Axes::default()
        };
        let sweep = Sweep::of(&[preset("depth8")], &axes).unwrap();
        assert_eq!(names(&sweep), ["level 7", "level 7, capacity 100", "depth8", "capacity 100"]);
        let found: Vec<_> =
            sweep.settings.iter().map(|s| (s.config.max_level, s.config.leaf_capacity)).collect();
        assert_eq!(found, [(7, 50), (7, 100), (8, 50), (8, 100)]);
        // What was crossed is what a build would be told.
        for setting in &sweep.settings {
            assert_eq!(setting.raw.clone().check().unwrap().0, setting.config);
        }
    }

    #[test]
    fn several_configurations_keep_their_names_and_equal_ones_are_one() {
        let axes = Axes { max_level: vec![8, 9], ..Axes::default() };
        let bases = [preset("depth8"), preset("paper"), preset("depth8")];
        let sweep = Sweep::of(&bases, &axes).unwrap();
        assert_eq!(names(&sweep), ["depth8", "depth8, level 9", "paper", "paper, level 9"]);
    }

    #[test]
    fn around_a_configuration_each_axis_is_seen() {
        let (name, base) = preset("depth8");
        let sweep = Sweep::around(&name, &base).unwrap();
        assert_eq!(sweep.settings[0].config, BuildConfig::default());
        let differs = |of: fn(&BuildConfig) -> u64| {
            sweep.settings.iter().any(|s| of(&s.config) != of(&BuildConfig::default()))
        };
        assert!(differs(|c| c.max_level.into()) && differs(|c| c.leaf_capacity));
        assert!(differs(|c| c.max_spread.into()) && differs(|c| (c.tree == Shape::Paper).into()));
        assert!(differs(|c| (c.profile == Profile::Paper).into()));
        assert!(differs(|c| (c.spacing == Spacing::Neighbors).into()));
        assert!(differs(|c| (c.approximation.opening_angle > 0.0).into()));
        assert!(differs(|c| (c.approximation.min_form_factor > 0.0).into()));
        assert!(differs(|c| (c.approximation.min_exchange > 0.0).into()));
        assert!(differs(|c| c.fractions.into()));
        let modes: Vec<String> = sweep.settings.iter().map(Setting::mode).collect();
        assert!(
            ["exact", "opening angle", "form factor"].iter().all(|m| modes.iter().any(|n| n == m))
        );
        assert!(
            names(&sweep).contains(&"paper") && names(&sweep).contains(&"accurate"),
            "{:?}",
            names(&sweep)
        );
        let mut unique = names(&sweep);
        unique.sort_unstable();
        unique.dedup();
        assert_eq!(unique.len(), sweep.settings.len());
    }

    #[test]
    fn values_out_of_range_are_refused() {
        let axes = Axes { max_level: vec![22], ..Axes::default() };
        let refused = Sweep::of(&[preset("depth8")], &axes).unwrap_err();
        assert_eq!(refused.exit_code(), 78);
    }
}
