//! The keys that decide the content of a map, as its `config` section has them. [F-14]

use pvmap_geometry::disc::Profile;
use pvmap_geometry::morton;

use crate::tree::{Shape, Spacing};

/// What decides the content of a map besides the points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapConfig {
    /// Deepest level of a cell, 1…21.
    pub max_level: u8,
    /// Most points of a leaf above the deepest level; 0 for a full tree.
    pub leaf_capacity: u64,
    /// How many times the area that its points cover a leaf may stretch over; 0 for any.
    pub max_spread: u16,
    /// Which tree.
    pub shape: Shape,
    /// How discs block.
    pub profile: Profile,
    /// Where the half spacings come from.
    pub spacing: Spacing,
    /// How many pairs were given to start from, and the XXH3-128 of their rows. [V-5]
    pub interaction_pairs: Option<(u32, u128)>,
    /// The side of a cell over its distance up to which it is not opened, 0…1; 0 opens all.
    pub opening_angle: f64,
    /// The form factor below which leaf pairs may be left out, 0…1; 0 leaves out none.
    pub min_form_factor: f64,
    /// The exchange below which a node pair is tried by a sample, 0…1; 0 opens all. [F-26]
    pub min_exchange: f64,
    /// Whether leaf pairs half in shadow have visible fractions. [F-26]
    pub fractions: bool,
}

impl MapConfig {
    /// Gives the canonical text.
    pub fn to_text(&self) -> String {
        let tree = match self.shape {
            Shape::Binned => "binned",
            Shape::Paper => "paper",
        };
        let profile = match self.profile {
            Profile::Patch => "patch",
            Profile::Oriented => "oriented",
            Profile::Paper => "paper",
        };
        let MapConfig { max_level, leaf_capacity, max_spread, opening_angle, .. } = *self;
        let mut text = format!(
            "max_level = {max_level}\nleaf_capacity = {leaf_capacity}\n\
             tree = \"{tree}\"\nprofile = \"{profile}\"\n"
        );
        if max_spread > 0 {
            text.push_str(&format!("max_spread = {max_spread}\n"));
        }
        match self.spacing {
            Spacing::Leaf => {}
            Spacing::Neighbors => text.push_str("spacing = \"neighbors\"\n"),
        }
        if let Some((n, digest)) = self.interaction_pairs {
            text.push_str(&format!("interaction_pairs = \"{n}:{digest:032x}\"\n"));
        }
        if opening_angle > 0.0 {
            text.push_str(&format!("opening_angle = {opening_angle}\n"));
        }
        if self.min_form_factor > 0.0 {
            text.push_str(&format!("min_form_factor = {}\n", self.min_form_factor));
        }
        if self.min_exchange > 0.0 {
            text.push_str(&format!("min_exchange = {}\n", self.min_exchange));
        }
        if self.fractions {
            text.push_str("fractions = true\n");
        }
        text
    }

    /// Says whether the map has the sections of visible fractions. [F-24]
    pub fn has_fractions(&self) -> bool {
        self.fractions || self.min_exchange > 0.0
    }

    /// Reads the canonical text; none where it cannot be that of a map, or is not canonical.
    pub fn of_text(text: &str) -> Option<MapConfig> {
        let mut lines = text.lines().peekable();
        let max_level = lines.next()?.strip_prefix("max_level = ")?.parse().ok()?;
        let leaf_capacity = lines.next()?.strip_prefix("leaf_capacity = ")?.parse().ok()?;
        let shape = match lines.next()? {
            "tree = \"binned\"" => Shape::Binned,
            "tree = \"paper\"" => Shape::Paper,
            _ => return None,
        };
        let profile = profile_of(lines.next()?)?;
        // The keys that need not be there, in this order.
        let mut next = |key: &str| {
            let line = lines.peek()?.strip_prefix(key)?.strip_prefix(" = ")?;
            lines.next();
            Some(line)
        };
        let max_spread = next("max_spread").map_or(Some(0), |v| v.parse().ok())?;
        let spacing = match next("spacing") {
            None => Spacing::Leaf,
            Some("\"neighbors\"") => Spacing::Neighbors,
            Some(_) => return None,
        };
        let pairs = next("interaction_pairs").map(|value| {
            let (n, digest) = value.strip_prefix('"')?.strip_suffix('"')?.split_once(':')?;
            Some((n.parse().ok()?, u128::from_str_radix(digest, 16).ok()?))
        });
        let interaction_pairs = match pairs {
            Some(None) => return None,
            pairs => pairs.flatten(),
        };
        let opening_angle = next("opening_angle").map_or(Some(0.0), share)?;
        let min_form_factor = next("min_form_factor").map_or(Some(0.0), share)?;
        let min_exchange = next("min_exchange").map_or(Some(0.0), share)?;
        let fractions = next("fractions").is_some();
        let config = MapConfig {
            max_level,
            leaf_capacity,
            max_spread,
            shape,
            profile,
            spacing,
            interaction_pairs,
            opening_angle,
            min_form_factor,
            min_exchange,
            fractions,
        };
        let is_level = (1..=morton::MAX_LEVEL).contains(&max_level);
        (is_level && config.to_text() == text).then_some(config)
    }
}

fn share(text: &str) -> Option<f64> {
    text.parse().ok().filter(|v| (0.0..=1.0).contains(v))
}

/// Reads the profile out of a canonical text.
pub(crate) fn profile_of(config: &str) -> Option<Profile> {
    config.lines().find_map(|line| match line {
        "profile = \"patch\"" => Some(Profile::Patch),
        "profile = \"oriented\"" => Some(Profile::Oriented),
        "profile = \"paper\"" => Some(Profile::Paper),
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: MapConfig = MapConfig {
        max_level: 8,
        leaf_capacity: 50,
        max_spread: 0,
        shape: Shape::Binned,
        profile: Profile::Patch,
        spacing: Spacing::Leaf,
        interaction_pairs: None,
        opening_angle: 0.0,
        min_form_factor: 0.0,
        min_exchange: 0.0,
        fractions: false,
    };

    #[test]
    fn what_is_written_is_read_again() {
        let all = MapConfig {
            max_spread: 3,
            shape: Shape::Paper,
            profile: Profile::Paper,
            spacing: Spacing::Neighbors,
            interaction_pairs: Some((7, u128::MAX)),
            opening_angle: 0.15,
            min_form_factor: 1e-9,
            min_exchange: 0.5,
            fractions: true,
            ..PLAIN
        };
        let far = MapConfig { min_form_factor: 0.25, ..PLAIN };
        for config in [PLAIN, all, far] {
            assert_eq!(MapConfig::of_text(&config.to_text()), Some(config));
        }
        let text = all.to_text();
        let end = "opening_angle = 0.15\nmin_form_factor = 0.000000001\nmin_exchange = 0.5\n\
                   fractions = true\n";
        assert!(text.ends_with(end), "{text}");
    }

    #[test]
    fn what_is_not_canonical_is_refused() {
        let plain = PLAIN.to_text();
        for more in [
            "opening_angle = 0\n",
            "opening_angle = 1.5\n",
            "opening_angle = NaN\n",
            "opening_angle = 1e-1\n",
            "min_form_factor = 0.1\nopening_angle = 0.1\n",
            "spacing = \"leaf\"\n",
            "fractions = false\n",
            "fractions = true\nmin_exchange = 0.1\n",
            "interaction_pairs = \"7\"\n",
            "more = 1\n",
        ] {
            assert_eq!(MapConfig::of_text(&format!("{plain}{more}")), None, "{more}");
        }
        assert_eq!(MapConfig::of_text(&plain.replace("level = 8", "level = 22")), None);
        assert_eq!(MapConfig::of_text(plain.trim_end()), None);
    }
}
