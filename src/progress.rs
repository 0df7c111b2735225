//! How far a run is, for a person or a program, on stderr. Source: DESIGN.md [D-10].
//!
//! Stages only add to a counter; one thread looks at it now and then, draws, and samples memory.

use std::io::{IsTerminal, Write};
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
}

struct Shared {
    mode: Mode,
    /// The signal that asked to stop, 0 for none.
    signal: Arc<AtomicUsize>,
    done: AtomicU64,
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
            quit: AtomicBool::new(false),
            stage: Mutex::new(None),
            finished: Mutex::default(),
        });
        let ticker = std::thread::spawn({
            let shared = shared.clone();
            move || {
                while !shared.quit.load(Ordering::Relaxed) {
                    shared.tick();
                    std::thread::sleep(TICK);
                }
            }
        });
        Progress { shared, ticker: Some(ticker) }
    }

    /// Ends the stage at hand and gives all stages so far, forgetting them.
    pub(crate) fn take_stages(&self) -> Vec<StageDone> {
        self.shared.end_stage();
        std::mem::take(&mut lock(&self.shared.finished))
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
        let bar = (self.shared.mode == Mode::Bar).then(|| bar(name, total, unit));
        let peak_bytes = memory::rss_anon_bytes().unwrap_or(0);
        self.shared.done.store(0, Ordering::Relaxed);
        let stage = Stage { name, unit, total, started: now, said: now, peak_bytes, bar };
        *lock(&self.shared.stage) = Some(stage);
    }

    fn advance(&self, n: u64) {
        self.shared.done.fetch_add(n, Ordering::Relaxed);
    }

    fn warn(&self, message: &str) {
        let stage = lock(&self.shared.stage);
        let print = || match self.shared.mode {
            Mode::Json => say(&serde_json::json!({ "warning": message }).to_string()),
            _ => say(&format!("pvmap: warning: {}", one_line(message))),
        };
        match stage.as_ref().and_then(|s| s.bar.as_ref()) {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }

    fn is_stopped(&self) -> bool {
        self.shared.signal.load(Ordering::Relaxed) != 0
    }
}

impl Shared {
    fn tick(&self) {
        let mut stage = lock(&self.stage);
        let Some(stage) = stage.as_mut() else { return };
        stage.peak_bytes = stage.peak_bytes.max(memory::rss_anon_bytes().unwrap_or(0));
        let done = self.done.load(Ordering::Relaxed);
        if let Some(bar) = &stage.bar {
            bar.set_position(done);
        } else if stage.said.elapsed() >= LINE_EVERY {
            stage.said = Instant::now();
            self.print(stage, done, false);
        }
    }

    fn end_stage(&self) {
        let Some(mut stage) = lock(&self.stage).take() else { return };
        let done = self.done.load(Ordering::Relaxed);
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
        let seconds = stage.started.elapsed().as_secs_f64();
        let rate = done as f64 / seconds.max(1e-9);
        let left = stage.total.filter(|_| done > 0).map(|t| t.saturating_sub(done));
        let eta = left.map(|n| n as f64 / rate);
        match self.mode {
            Mode::Json => say(&serde_json::json!({
                "stage": stage.name, "done": done, "total": stage.total, "unit": stage.unit,
                "seconds": seconds, "rate": rate, "eta_seconds": if ended { None } else { eta },
                "rss_anon_bytes": stage.peak_bytes, "ended": ended,
            })
            .to_string()),
            Mode::Plain => {
                let share = stage.total.filter(|&t| t > 0).map(|t| 100.0 * done as f64 / t as f64);
                let share = share.map_or(String::new(), |p| format!(" ({p:.0} %)"));
                let eta =
                    eta.filter(|_| !ended).map_or(String::new(), |s| format!(", {s:.0} s left"));
                say(&format!(
                    "pvmap: {}: {} {}{share} in {seconds:.1} s, {}/s{eta}",
                    stage.name,
                    si(done as f64),
                    stage.unit,
                    si(rate)
                ));
            }
            Mode::Auto | Mode::Bar | Mode::Off => {}
        }
    }
}

fn bar(name: &'static str, total: Option<u64>, unit: &'static str) -> ProgressBar {
    let bar = match total {
        Some(total) => ProgressBar::new(total),
        None => ProgressBar::no_length(),
    };
    let template = match total {
        Some(_) => {
            "{prefix:>11} {wide_bar} {percent:>3} %  {human_pos} {msg}, {per_sec}, {eta} left"
        }
        None => "{prefix:>11} {spinner} {human_pos} {msg}, {per_sec}",
    };
    let style =
        ProgressStyle::with_template(template).expect("the templates above are well-formed");
    bar.with_style(style).with_prefix(name).with_message(unit)
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
    match v {
        v if v >= 1e12 => format!("{:.2} T", v / 1e12),
        v if v >= 1e9 => format!("{:.2} G", v / 1e9),
        v if v >= 1e6 => format!("{:.2} M", v / 1e6),
        v if v >= 1e4 => format!("{:.1} k", v / 1e3),
        v => format!("{v:.0}"),
    }
}
