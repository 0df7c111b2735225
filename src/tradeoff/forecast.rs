//! What is known of a setting before its map is built: the tree it cuts, which takes a moment.

use pvmap_store::Watch;
use pvmap_vmap::OctreeView;
use pvmap_vmap::records::Record;
use xxhash_rust::xxh3::Xxh3Default;

use super::{Row, Setting};
use crate::{Error, build};

/// A build that is expected to take so many times as long as it may is not begun: the expectation
/// may be wrong by a factor of three.
const SURELY: f64 = 4.0;
/// Below so many leaves a build takes its time for other things than their pairs.
const FEWEST_LEAVES: u64 = 1000;
/// The exit code of a tree that outgrows the memory, or has too many nodes.
const TOO_LARGE: u8 = 78;

/// A tree that was cut: how many leaves it has, and what tells it from others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CutTree {
    /// Leaves.
    pub n_leaves: u64,
    /// xxh3-128 over nodes and surfels.
    digest: u128,
}

impl CutTree {
    /// Cuts an octree as a setting says and forgets the tree; nothing where it is too large for the
    /// memory, which its build will tell. Runs on the current rayon pool.
    ///
    /// # Errors
    /// Where the octree is damaged or the run is asked to stop.
    pub fn of(
        octree: &OctreeView<'_>,
        setting: &Setting,
        memory_bytes: u64,
        watch: &dyn Watch,
    ) -> Result<Option<CutTree>, Error> {
        let tree = match build::cut_tree(octree, &setting.config, memory_bytes, watch) {
            Err(e) if e.exit_code() == TOO_LARGE => return Ok(None),
            tree => tree?,
        };
        let mut hash = Xxh3Default::new();
        tree.nodes.iter().for_each(|node| hash.update(&node.to_bytes()));
        tree.surfels.iter().for_each(|surfel| hash.update(&surfel.to_bytes()));
        Ok(Some(CutTree { n_leaves: tree.surfels.len() as u64, digest: hash.digest128() }))
    }
}

/// Finds the first row whose map has the same tree, profile and all else that decides links: such a
/// map differs in the record of its configuration alone.
pub fn same_map<'a>(rows: &'a [Row], setting: &Setting, cut: &CutTree) -> Option<&'a Row> {
    rows.iter().find(|row| row.cut == Some(*cut) && decides_alike(&row.setting, setting))
}

/// Says whether two settings differ in nothing but how they cut the tree.
fn decides_alike(a: &Setting, b: &Setting) -> bool {
    let mut same = a.clone();
    same.name.clone_from(&b.name);
    same.raw.clone_from(&b.raw);
    same.config.max_level = b.config.max_level;
    same.config.leaf_capacity = b.config.leaf_capacity;
    same.config.max_spread = b.config.max_spread;
    same.config.spacing = b.config.spacing;
    same.config.tree = b.config.tree;
    same == *b
}

/// Guesses the seconds of a build from those of the row with the most similar number of leaves,
/// among those of its tree and profile if there are any: a build takes about as long as there are
/// pairs of leaves. Only rows count that decide of those pairs what it decides, exactly or as
/// coarsely; nothing is known before there is one of at least 1000 leaves.
pub fn expected_seconds(rows: &[Row], setting: &Setting, cut: &CutTree) -> Option<f64> {
    let of = |s: &Setting| (s.tree(), s.profile());
    let is_like = |s: &Setting| {
        s.config.approximation == setting.config.approximation
            && s.config.interaction == setting.config.interaction
    };
    let ratio = |n_leaves: u64| cut.n_leaves.max(1) as f64 / n_leaves.max(1) as f64;
    let alike = rows.iter().filter(|row| is_like(&row.setting));
    let built = alike.filter_map(|row| Some((&row.setting, row.built()?)));
    let many = built.filter(|(_, built)| built.n_leaves >= FEWEST_LEAVES);
    let (_, nearest) = many.min_by(|(a, x), (b, y)| {
        let key = |s: &Setting, n: u64| (of(s) != of(setting), ratio(n).ln().abs());
        let (a, b) = (key(a, x.n_leaves), key(b, y.n_leaves));
        a.0.cmp(&b.0).then(a.1.total_cmp(&b.1))
    })?;
    Some(nearest.build_seconds * ratio(nearest.n_leaves).powi(2))
}

/// Says whether a build of so many expected seconds would surely not end within a limit.
pub fn is_hopeless(expected_seconds: f64, limit_seconds: u64) -> bool {
    expected_seconds > SURELY * limit_seconds as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{RawConfig, RawProfile};
    use crate::tradeoff::{Axes, Built, Outcome, Sweep};

    fn settings() -> Vec<Setting> {
        let axes = Axes {
            profile: vec![RawProfile::Patch, RawProfile::Paper],
            max_level: vec![7, 8],
            ..Axes::default()
        };
        let base = ("depth8".to_owned(), RawConfig::default());
        Sweep::of(&[base], &axes).unwrap().settings
    }

    fn row(setting: &Setting, n_leaves: u64, digest: u128, build_seconds: f64) -> Row {
        let outcome = Outcome::Built(Built { n_leaves, build_seconds, ..Built::default() });
        Row { setting: setting.clone(), cut: Some(CutTree { n_leaves, digest }), outcome }
    }

    #[test]
    fn maps_of_one_tree_are_the_same_where_links_are_decided_alike() {
        let settings = settings();
        let rows = [row(&settings[0], 900, 1, 1.0)];
        let cut = CutTree { n_leaves: 900, digest: 1 };
        let name = |setting: &Setting, cut: &CutTree| {
            same_map(&rows, setting, cut).map(|row| row.setting.name.clone())
        };
        assert_eq!(name(&settings[1], &cut), Some(settings[0].name.clone()));
        assert_eq!(name(&settings[1], &CutTree { digest: 2, ..cut }), None, "another tree");
        assert_eq!(settings[3].profile(), "paper");
        assert_eq!(name(&settings[3], &cut), None, "another profile");
    }

    #[test]
    fn what_is_approximate_is_expected_by_its_own_rows() {
        let axes = Axes { opening_angle: vec![0.0, 0.06, 0.15], ..Axes::default() };
        let base = ("depth8".to_owned(), RawConfig::default());
        let settings = Sweep::of(&[base], &axes).unwrap().settings;
        let cut = CutTree { n_leaves: 8000, digest: 9 };
        let rows = [row(&settings[0], 8000, 1, 500.0), row(&settings[1], 4000, 2, 10.0)];
        let expected = |i: usize| expected_seconds(&rows, &settings[i], &cut);
        assert_eq!([0, 1, 2].map(expected), [Some(500.0), Some(40.0), None]);
    }

    #[test]
    fn twice_the_leaves_take_four_times_as_long() {
        let settings = settings();
        let cut = CutTree { n_leaves: 8000, digest: 9 };
        assert_eq!(expected_seconds(&[], &settings[0], &cut), None);
        let few = [row(&settings[0], 999, 1, 1.0)];
        assert_eq!(expected_seconds(&few, &settings[0], &cut), None);
        let rows = [
            row(&settings[0], 1000, 1, 1.0),
            row(&settings[1], 4000, 2, 10.0),
            row(&settings[2], 8000, 3, 99.0),
        ];
        // The row of another profile has as many leaves, but another way to decide.
        assert_eq!(expected_seconds(&rows, &settings[0], &cut), Some(40.0));
        assert_eq!(expected_seconds(&rows, &settings[3], &cut), Some(99.0));
        assert!(is_hopeless(40.0, 9) && !is_hopeless(40.0, 10));
    }
}
