//! Seconds of processors and of the clock.

use std::time::Instant;

/// What `/proc` counts processor time in, on every architecture that Linux has today.
const TICKS_A_SECOND: f64 = 100.0;
/// Jobs of a benchmark quicker than this are done again, and the mean is taken: a tick is a
/// hundredth.
const QUICK_SECONDS: f64 = 0.5;
const RUNS: u32 = 5;
/// What cargo bench says to every benchmark; a test hears nothing of it.
pub(crate) const BENCH: &str = "--bench";

/// What a job took.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Took {
    /// Of processors, all threads of this process together.
    pub(crate) processor_seconds: f64,
    pub(crate) wall_seconds: f64,
}

/// Runs a job and says what it took.
pub(crate) fn timed<T>(job: impl FnOnce() -> T) -> (T, Took) {
    let (before, started) = (processor_seconds(), Instant::now());
    let done = job();
    let wall_seconds = started.elapsed().as_secs_f64();
    (done, Took { processor_seconds: processor_seconds() - before, wall_seconds })
}

/// Runs a job, a quick one several times, and says what it took in the mean.
///
/// # Errors
/// That of the first run that fails.
pub(crate) fn mean_of<T, E>(job: impl Fn() -> Result<T, E>) -> Result<(T, Took), E> {
    let (done, took) = timed(&job);
    let done = done?;
    let is_bench = std::env::args().any(|a| a == BENCH);
    if took.processor_seconds >= QUICK_SECONDS || !is_bench {
        return Ok((done, took));
    }
    let (runs, all) = timed(|| (0..RUNS).try_for_each(|_| job().map(drop)));
    runs?;
    // In whole milliseconds: there is no more to it.
    let mean = |seconds: f64| (seconds / f64::from(RUNS) * 1e3).round() / 1e3;
    let [processor_seconds, wall_seconds] = [all.processor_seconds, all.wall_seconds].map(mean);
    Ok((done, Took { processor_seconds, wall_seconds }))
}

/// Reads what all threads of this process took so far, those that ended, too.
fn processor_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name, which may hold anything, ends with the last bracket. Source: proc(5).
    let fields = text.rsplit(')').next().unwrap_or_default().split_whitespace();
    let ticks = fields.skip(11).take(2).map(|ticks| ticks.parse::<f64>().unwrap_or(0.0));
    ticks.sum::<f64>() / TICKS_A_SECOND
}
