//! How far a run is, for a person or a program, on stderr. Source: DESIGN.md [D-10].
//!
//! Stages only add to a counter; one thread looks at it now and then, draws, and samples memory.

use std::collections::VecDeque;
use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use pvmap::{Watch, memory};

use crate::cli::one_line;

/// How progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Mode {
    /// Bars on a terminal, plain lines elsewhere.
    Auto,
    /// Bars.
    Bar,
    /// A line every few seconds.
    Plain,
    /// A JSON object a line.
    Json,
    /// Nothing but warnings and errors.
    Off,
}

/// How often memory is sampled.
const TICK: Duration = Duration::from_millis(10);
/// How often lines are printed, plain and JSON.
const LINE_EVERY: Duration = Duration::from_secs(2);
/// Stages shorter than this are not worth a line of their own.
const SHORT: Duration = Duration::from_millis(500);
/// The pace is that of the last ten seconds: what went fast at first says little of the rest.
const PACE_EVERY: Duration = Duration::from_millis(500);
const PACE_SAMPLES: usize = 20;
/// What stands right of a bar; the same width for all, or the bars would twitch.
const BESIDE_BAR: usize = 48;

/// A stage that has ended.
#[derive(Debug, Clone)]
pub(crate) struct StageDone {
    /// Its name.
    pub(crate) name: &'static str,
    /// Wall time.
    pub(crate) seconds: f64,
    /// Most anonymous memory seen while it ran.
    pub(crate) peak_bytes: u64,
}

struct Stage {
    name: &'static str,
    unit: &'static str,
    total: Option<u64>,
    started: Instant,
    said: Instant,
    peak_bytes: u64,
    bar: Option<ProgressBar>,
    /// What is known of its chunk tasks.
    tasks: Option<Tasks>,
    /// When so much was done, the latest last.
    pace: VecDeque<(Instant, u64)>,
}

/// The chunk tasks of a stage, and what they found.
#[derive(Debug, Clone, Copy)]
struct Tasks {
    n_done: u64,
    n_total: u64,
    n_links: u64,
}

/// The same, as they are told from many threads.
#[derive(Debug, Default)]
struct TasksTold {
    n_done: AtomicU64,
    n_total: AtomicU64,
    n_links: AtomicU64,
}

impl TasksTold {
    /// Threads may tell in another order than they count.
    fn tell(&self, n_done: u64, n_total: u64, n_links: u64) {
        self.n_done.fetch_max(n_done, Ordering::Relaxed);
        self.n_total.store(n_total, Ordering::Relaxed);
        self.n_links.fetch_max(n_links, Ordering::Relaxed);
    }

    fn forget(&self) {
        for n in [&self.n_done, &self.n_total, &self.n_links] {
            n.store(0, Ordering::Relaxed);
        }
    }

    /// Gives what was told; none where there are no tasks.
    fn get(&self) -> Option<Tasks> {
        let [n_done, n_total, n_links] =
            [&self.n_done, &self.n_total, &self.n_links].map(|n| n.load(Ordering::Relaxed));
        (n_total > 0).then_some(Tasks { n_done, n_total, n_links })
    }
}

struct Shared {
    mode: Mode,
    /// The signal that asked to stop, 0 for none.
    signal: Arc<AtomicUsize>,
    done: AtomicU64,
    tasks: TasksTold,
    quit: AtomicBool,
    stage: Mutex<Option<Stage>>,
    finished: Mutex<Vec<StageDone>>,
}

/// Shows the progress of a run until it is dropped.
pub(crate) struct Progress {
    shared: Arc<Shared>,
    ticker: Option<JoinHandle<()>>,
}

impl Progress {
    /// Starts to watch; `signal` holds the signal that asks to stop, 0 for none.
    pub(crate) fn new(mode: Mode, signal: Arc<AtomicUsize>) -> Progress {
        let terminal = std::io::stderr().is_terminal();
        let mode = match mode {
            Mode::Auto if terminal => Mode::Bar,
            Mode::Auto => Mode::Plain,
            mode => mode,
        };
        let shared = Arc::new(Shared {
            mode,
            signal,
            done: AtomicU64::new(0),
            tasks: TasksTold::default(),
            quit: AtomicBool::new(false),
            stage: Mutex::new(None),
            finished: Mutex::default(),
        });
        let tick = {
            let shared = shared.clone();
            move || {
                while !shared.quit.load(Ordering::Relaxed) {
                    shared.tick();
                    std::thread::sleep(TICK);
                }
            }
        };
        // Where there is no thread for it (F72), the run goes on without: only ends are told then.
        let ticker = std::thread::Builder::new().spawn(tick).ok();
        Progress { shared, ticker }
    }

    /// Ends the stage at hand and gives all stages so far, forgetting them.
    pub(crate) fn take_stages(&self) -> Vec<StageDone> {
        self.shared.end_stage();
        std::mem::take(&mut lock(&self.shared.finished))
    }

    /// Stops the run when `input` ends: whoever holds its other end is gone.
    pub(crate) fn end_with(&self, mut input: impl io::Read + Send + 'static) {
        let shared = self.shared.clone();
        let wait = move || {
            // What cannot be read will not say more.
            let _ = io::copy(&mut input, &mut io::sink());
            let _ = shared.signal.compare_exchange(
                0,
                signal_hook::consts::SIGTERM as usize,
                Ordering::Relaxed,
                Ordering::Relaxed,
            );
        };
        // Where there is no thread for it (F72), the run ends by itself.
        let _ = std::thread::Builder::new().spawn(wait);
    }

    /// Forgets the stage at hand: it did not end, and the error says why.
    pub(crate) fn give_up(&self) {
        if let Some(bar) = lock(&self.shared.stage).take().and_then(|stage| stage.bar) {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.shared.quit.store(true, Ordering::Relaxed);
        if let Some(ticker) = self.ticker.take() {
            // A ticker that panicked has nothing more to show.
            let _ = ticker.join();
        }
        self.shared.end_stage();
    }
}

impl Watch for Progress {
    fn stage(&self, name: &'static str, total: Option<u64>, unit: &'static str) {
        self.shared.end_stage();
        let now = Instant::now();
        let bar = (self.shared.mode == Mode::Bar).then(|| bar(name, total));
        let peak_bytes = memory::rss_anon_bytes().unwrap_or(0);
        self.shared.done.store(0, Ordering::Relaxed);
        self.shared.tasks.forget();
        let (pace, tasks) = (VecDeque::with_capacity(PACE_SAMPLES), None);
        let stage =
            Stage { name, unit, total, started: now, said: now, peak_bytes, bar, tasks, pace };
        *lock(&self.shared.stage) = Some(stage);
    }

    fn advance(&self, n: u64) {
        self.shared.done.fetch_add(n, Ordering::Relaxed);
    }

    fn warn(&self, message: &str) {
        self.shared.tell("warning", &format!("warning: {}", one_line(message)), message);
    }

    fn note(&self, message: &str) {
        if self.shared.mode != Mode::Off {
            self.shared.tell("note", &one_line(message), message);
        }
    }

    fn tasks(&self, n_done: u64, n_total: u64, n_links: u64) {
        self.shared.tasks.tell(n_done, n_total, n_links);
    }

    fn is_stopped(&self) -> bool {
        self.shared.signal.load(Ordering::Relaxed) != 0
    }
}

impl Shared {
    /// Says a line of its own: plain, or as JSON under a key.
    fn tell(&self, key: &str, line: &str, message: &str) {
        let stage = lock(&self.stage);
        let print = || match self.mode {
            Mode::Json => say(&serde_json::json!({ key: message }).to_string()),
            _ => say(&format!("pvmap: {line}")),
        };
        match stage.as_ref().and_then(|s| s.bar.as_ref()) {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }

    fn tick(&self) {
        let mut stage = lock(&self.stage);
        let Some(stage) = stage.as_mut() else { return };
        stage.peak_bytes = stage.peak_bytes.max(memory::rss_anon_bytes().unwrap_or(0));
        let done = self.done.load(Ordering::Relaxed);
        stage.tasks = self.tasks.get();
        stage.pace(done);
        if let Some(bar) = &stage.bar {
            bar.set_position(done);
            let below = stage.tasks.map(|t| format!("\n{:>11} {}", "", t.said_of(false)));
            let beside = stage.counted_of(done, false);
            bar.set_message(format!("{beside:<BESIDE_BAR$}{}", below.unwrap_or_default()));
        } else if stage.said.elapsed() >= LINE_EVERY {
            stage.said = Instant::now();
            self.print(stage, done, false);
        }
    }

    fn end_stage(&self) {
        let Some(mut stage) = lock(&self.stage).take() else { return };
        let done = self.done.load(Ordering::Relaxed);
        stage.tasks = self.tasks.get();
        stage.peak_bytes = stage.peak_bytes.max(memory::rss_anon_bytes().unwrap_or(0));
        if let Some(bar) = stage.bar.take() {
            bar.finish_and_clear();
        } else if stage.started.elapsed() >= SHORT || self.mode == Mode::Json {
            self.print(&stage, done, true);
        }
        let seconds = stage.started.elapsed().as_secs_f64();
        let done = StageDone { name: stage.name, seconds, peak_bytes: stage.peak_bytes };
        lock(&self.finished).push(done);
    }

    fn print(&self, stage: &Stage, done: u64, ended: bool) {
        match self.mode {
            Mode::Json => say(&serde_json::json!({
                "stage": stage.name, "done": done, "total": stage.total, "unit": stage.unit,
                "tasks_done": stage.tasks.map(|t| t.n_done),
                "tasks_total": stage.tasks.map(|t| t.n_total),
                "links": stage.tasks.map(|t| t.n_links),
                "seconds": stage.seconds(), "rate": stage.rate(done, ended),
                "eta_seconds": if ended { None } else { stage.eta_seconds(done) },
                "rss_anon_bytes": stage.peak_bytes, "ended": ended,
            })
            .to_string()),
            Mode::Plain => say(&format!("pvmap: {}: {}", stage.name, stage.said_of(done, ended))),
            Mode::Auto | Mode::Bar | Mode::Off => {}
        }
    }
}

impl Stage {
    /// Notes how much is done by now.
    fn pace(&mut self, done: u64) {
        if self.pace.back().is_none_or(|(at, _)| at.elapsed() >= PACE_EVERY) {
            if self.pace.len() == PACE_SAMPLES {
                self.pace.pop_front();
            }
            self.pace.push_back((Instant::now(), done));
        }
    }

    fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Gives units a second: of late, or over the whole stage.
    fn rate(&self, done: u64, of_all: bool) -> f64 {
        match self.pace.front() {
            Some(&(at, before)) if !of_all && at.elapsed() >= PACE_EVERY => {
                done.saturating_sub(before) as f64 / at.elapsed().as_secs_f64()
            }
            _ => done as f64 / self.seconds().max(1e-9),
        }
    }

    /// Guesses how long the rest takes; none where the total is not known or nothing moves.
    fn eta_seconds(&self, done: u64) -> Option<f64> {
        let rate = self.rate(done, false);
        let left = self.total?.saturating_sub(done) as f64;
        (rate > 0.0).then_some(left / rate)
    }

    /// Says how far it is: 280 M of 401 M pairs, 33.8 M/s, 4 s left; 310 of 400 tasks, 5.1 M links.
    fn said_of(&self, done: u64, ended: bool) -> String {
        let tasks = self.tasks.map(|t| format!("; {}", t.said_of(ended)));
        format!("{}{}", self.counted_of(done, ended), tasks.unwrap_or_default())
    }

    /// Says how far it is in units of its own.
    fn counted_of(&self, done: u64, ended: bool) -> String {
        let unit = self.unit;
        let rate = si(self.rate(done, ended));
        let counted = match self.total.filter(|_| !ended) {
            Some(total) => format!("{} of {} {unit}", si(done as f64), si(total as f64)),
            None => format!("{} {unit}", si(done as f64)),
        };
        let time = match self.eta_seconds(done) {
            Some(left) if !ended => format!("{} left", duration(left)),
            _ => duration(self.seconds()),
        };
        match done {
            // It counts at its end, or has just begun.
            0 if self.total.is_none() => time,
            0 => format!("{counted}, {time}"),
            _ => format!("{counted}, {rate}/s, {time}"),
        }
    }
}

impl Tasks {
    fn said_of(&self, ended: bool) -> String {
        let n_links = si(self.n_links as f64);
        match ended {
            true => format!("{} tasks, {n_links} links", self.n_total),
            false => format!("{} of {} tasks, {n_links} links", self.n_done, self.n_total),
        }
    }
}

fn bar(name: &'static str, total: Option<u64>) -> ProgressBar {
    let (bar, template) = match total {
        Some(total) => (ProgressBar::new(total), "{prefix:>11} {wide_bar} {percent:>3} %  {msg}"),
        None => (ProgressBar::no_length(), "{prefix:>11} {spinner} {msg}"),
    };
    let style =
        ProgressStyle::with_template(template).expect("the templates above are well-formed");
    bar.with_style(style).with_prefix(name)
}

/// Writes a line to stderr; where that is closed nobody can be told.
fn say(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Writes a number in three digits and a magnitude: 11.6 M.
pub(crate) fn si(v: f64) -> String {
    // As it will be rounded, 999.6 k is 1.00 M.
    let magnitudes = [(1e12, " T"), (1e9, " G"), (1e6, " M"), (1e4, " k")];
    let of = |least: f64| v >= least * 0.9995;
    match magnitudes.into_iter().find(|m| of(m.0)) {
        None => format!("{v:.0}"),
        Some((least, sign)) => {
            let v = v / if sign == " k" { 1e3 } else { least };
            let n_decimals = if v < 9.995 { 2 } else { usize::from(v < 99.95) };
            format!("{v:.n_decimals$}{sign}")
        }
    }
}

/// Writes a time as exactly as matters: 4 s, 2 min 05 s, 20 min, 3 h 20 min.
pub(crate) fn duration(seconds: f64) -> String {
    let s = seconds.round().min(1e9) as u64;
    match s {
        0..60 => format!("{s} s"),
        60..600 => format!("{} min {:02} s", s / 60, s % 60),
        600..3600 => format!("{} min", s / 60),
        _ => format!("{} h {:02} min", s / 3600, s / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_a_magnitude() {
        for (v, text) in [
            (0.0, "0"),
            (9_990.0, "9990"),
            (12_345.0, "12.3 k"),
            (999_600.0, "1.00 M"),
            (11_630_000.0, "11.6 M"),
            (400_770_516.0, "401 M"),
            (2.5e9, "2.50 G"),
            (1.2344e15, "1234 T"),
        ] {
            assert_eq!(si(v), text);
        }
    }

    #[test]
    fn times_are_as_exact_as_matters() {
        for (seconds, text) in [
            (0.4, "0 s"),
            (59.6, "1 min 00 s"),
            (125.0, "2 min 05 s"),
            (1250.0, "20 min"),
            (12_030.0, "3 h 20 min"),
        ] {
            assert_eq!(duration(seconds), text);
        }
    }

    #[test]
    fn the_pace_is_that_of_late() {
        let ago = |ms| Instant::now() - Duration::from_millis(ms);
        let stage = Stage {
            name: "sort",
            unit: "points",
            total: Some(1_000_000),
            started: ago(20_000),
            said: ago(0),
            peak_bytes: 0,
            bar: None,
            tasks: None,
            // Half of it was done at once, the rest goes at some 10 000 a second.
            pace: [(ago(10_000), 500_000), (ago(1_000), 590_000)].into(),
        };
        assert_eq!(stage.said_of(600_000, false), "600 k of 1.00 M points, 10.0 k/s, 40 s left");
        assert_eq!(stage.said_of(1_000_000, true), "1.00 M points, 50.0 k/s, 20 s");
        let tasks = TasksTold::default();
        assert!(tasks.get().is_none());
        tasks.tell(7, 20, 12_345);
        tasks.tell(6, 20, 11_000);
        let stage = Stage { tasks: tasks.get(), ..stage };
        assert_eq!(
            stage.said_of(600_000, false),
            "600 k of 1.00 M points, 10.0 k/s, 40 s left; 7 of 20 tasks, 12.3 k links"
        );
        tasks.forget();
        assert!(tasks.get().is_none());
    }
}
