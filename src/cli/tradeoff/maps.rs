//! The maps of a sweep, one after the other.

use std::path::{Path, PathBuf};

use pvmap::query::Map;
use pvmap::tradeoff::forecast::{self, CutTree};
use pvmap::tradeoff::{Built, Outcome, Row, Setting};
use pvmap::vmap::OctreeView;
use pvmap::{Error, Limits, Watch};

use super::Args;
use super::child::{self, Ended, Job, Measured};
use super::source::Source;

/// What maps are made of.
pub(super) struct Maps<'a> {
    pub(super) args: &'a Args,
    pub(super) source: &'a Source,
    pub(super) view: &'a OctreeView<'a>,
    /// How many there will be.
    pub(super) n: usize,
    pub(super) watch: &'a dyn Watch,
}

/// What became of a setting.
pub(super) enum Made {
    /// Its map, and what that took.
    Map(TempMap, Measured),
    /// There is none.
    Not(Outcome),
}

/// A map that is gone when it is dropped.
pub(super) struct TempMap(PathBuf);

impl TempMap {
    pub(super) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TempMap {
    fn drop(&mut self) {
        // Gone at the end in any case.
        let _ = std::fs::remove_file(&self.0);
    }
}

impl Maps<'_> {
    /// Builds the map of a setting, unless the rows of those before it say that there is no need,
    /// or no hope; gives also the tree it cuts, where that fits the memory.
    ///
    /// # Errors
    /// Where the octree is damaged, the build fails or the run is asked to stop.
    pub(super) fn make(
        &self,
        i: usize,
        setting: &Setting,
        rows: &[Row],
    ) -> Result<(Option<CutTree>, Made), Error> {
        let Maps { args, source, view, n, watch } = *self;
        watch.check()?;
        watch.note(&format!("{} of {n}: {}", i + 1, setting.name));
        let limits = Limits { threads: args.threads, memory_bytes: args.memory };
        let cut = limits.run(|| CutTree::of(view, setting, args.memory, watch))??;
        if let Some(outcome) = cut.and_then(|cut| self.foreseen(rows, setting, &cut)) {
            return Ok((cut, Made::Not(outcome)));
        }
        let map = TempMap(source.file(&format!("{i}.vmap")));
        let job = Job::build(args, setting, source.octree(), map.path())?;
        let made = match child::run_often(&job, watch)? {
            Ended::Stopped => Made::Not(Outcome::Stopped(args.limit as f64)),
            Ended::Refused(why) => Made::Not(Outcome::Refused(why)),
            Ended::Done(measured) => Made::Map(map, measured),
        };
        Ok((cut, made))
    }

    /// Says what becomes of a setting, where that is known without a build; else tells what to
    /// expect.
    fn foreseen(&self, rows: &[Row], setting: &Setting, cut: &CutTree) -> Option<Outcome> {
        if let Some(row) = forecast::same_map(rows, setting, cut) {
            return Some(Outcome::Same(row.setting.name.clone()));
        }
        let expected = forecast::expected_seconds(rows, setting, cut)?;
        if forecast::is_hopeless(expected, self.args.limit) {
            return Some(Outcome::NotBegun(expected));
        }
        self.watch.note(&format!("{} leaves, some {expected:.1} s expected", cut.n_leaves));
        None
    }
}

/// Says what a map took and is, of so many bytes; no pairs are asked yet.
pub(super) fn built_of(args: &Args, map: &Map<'_>, map_bytes: u64, measured: &Measured) -> Built {
    let summary = map.view().summary();
    Built {
        seconds: measured.of_clock(args),
        cpu_seconds: measured.cpu_seconds,
        build_seconds: measured.seconds,
        visibility_seconds: measured.visibility_seconds,
        peak_bytes: measured.peak_bytes,
        n_leaves: summary.n_surfels.into(),
        n_links: summary.n_links,
        map_bytes,
        ..Built::default()
    }
}
