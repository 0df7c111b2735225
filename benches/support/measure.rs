//! Builds a map through the facade and notes what it took.

use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use pvmap::{BuildConfig, Error, Limits, Watch};

use super::row::Row;

/// Hears when stages begin.
#[derive(Debug, Default)]
struct Clock {
    stages: Mutex<Vec<(&'static str, Instant)>>,
}

impl Clock {
    /// Gives the seconds from the beginning of a stage to that of the next one.
    fn seconds_of(&self, name: &str) -> f64 {
        let stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        let from = stages.iter().position(|s| s.0 == name);
        let next = from.and_then(|i| Some((stages[i].1, stages.get(i + 1)?.1)));
        next.map_or(0.0, |(from, to)| (to - from).as_secs_f64())
    }
}

impl Watch for Clock {
    fn stage(&self, name: &'static str, _total: Option<u64>, _unit: &'static str) {
        let mut stages = self.stages.lock().unwrap_or_else(PoisonError::into_inner);
        stages.push((name, Instant::now()));
    }
    fn advance(&self, _n: u64) {}
    fn warn(&self, message: &str) {
        eprintln!("{message}");
    }
    fn is_stopped(&self) -> bool {
        false
    }
}

/// Builds the map of an octree.
///
/// # Errors
/// Where the build fails.
pub(crate) fn build(
    octree: &Path,
    map: &Path,
    config: &BuildConfig,
    limits: &Limits,
) -> Result<Row, Error> {
    let clock = Clock::default();
    let started = Instant::now();
    let built = pvmap::build(octree, map, config, limits, &clock)?;
    let build_seconds = started.elapsed().as_secs_f64();
    let report = &built.report;
    Ok(Row {
        points: report.summary.n_points,
        leaves: report.summary.n_surfels.into(),
        leaf_pairs: u64::try_from(built.n_leaf_pairs).unwrap_or(u64::MAX),
        links: report.summary.n_links,
        map_bytes: report.output_bytes,
        // What is found out about all nodes before the first pair counts, too.
        visibility_seconds: clock.seconds_of("prepare") + clock.seconds_of("visibility"),
        build_seconds,
        temporary_bytes: report.temporary_bytes,
        tests: report.counts.n_tests,
        exact: report.counts.n_exact,
        ..Row::default()
    })
}

/// Gives the middle one, of an even number the greater of the two; 0 of none.
pub(crate) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
