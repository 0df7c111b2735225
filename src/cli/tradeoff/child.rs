//! A build or a light in a process of its own: its peak of memory is then its own, and it can be
//! ended at any time. What it takes is what `pvmap … --progress json` tells of its stages.

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use pvmap::tradeoff::Setting;
use pvmap::{Error, StoreError, Watch};
use serde_json::Value;

use super::Args;

/// The command itself, whatever became of its file meanwhile.
const SELF: &str = "/proc/self/exe";
/// How often a wish to stop is looked for.
const TICK: Duration = Duration::from_millis(50);
/// It outgrows `--memory`, has too many nodes, or lights do not fit the map: all else that ends so
/// was refused before.
const REFUSED: i32 = 78;

/// What is shown of a light: its name, and what is counted of it.
const LIGHT: [&str; 2] = ["light", "stages"];

/// How a build or a light ended.
pub(super) enum Ended {
    /// It is there.
    Done(Measured),
    /// It took longer than it may.
    Stopped,
    /// It cannot be made, within the memory or at all: why.
    Refused(String),
}

/// What a build or a light took.
#[derive(Debug, Default)]
pub(super) struct Measured {
    /// Its stages together.
    pub(super) seconds: f64,
    /// Those of a build from the nodes to the last pair decided.
    pub(super) visibility_seconds: f64,
    pub(super) cpu_seconds: f64,
    pub(super) peak_bytes: u64,
}

impl Measured {
    /// Gives the seconds that are compared.
    pub(super) fn of_clock(&self, args: &Args) -> f64 {
        if args.cpu { self.cpu_seconds } else { self.seconds }
    }

    fn merge(&mut self, other: &Measured) {
        self.seconds = self.seconds.min(other.seconds);
        self.visibility_seconds = self.visibility_seconds.min(other.visibility_seconds);
        self.cpu_seconds = self.cpu_seconds.min(other.cpu_seconds);
        self.peak_bytes = self.peak_bytes.max(other.peak_bytes);
    }
}

/// What is to be run.
pub(super) struct Job<'a> {
    args: &'a Args,
    /// What it is called in messages.
    name: String,
    /// What is shown: the subcommand, and what is counted of it.
    stage: [&'static str; 2],
    /// Without those of all jobs.
    arguments: Vec<OsString>,
    /// The map, which has no name that means anything to anybody.
    map: PathBuf,
    /// The folder it works in, which stays where it is ended.
    work: Option<PathBuf>,
    /// Whether its warnings are handed on.
    pub(super) is_heard: bool,
}

impl<'a> Job<'a> {
    /// Prepares the build of a setting's map.
    ///
    /// # Errors
    /// Where its configuration cannot be written beside the map.
    pub(super) fn build(
        args: &'a Args,
        setting: &Setting,
        octree: &Path,
        map: &Path,
    ) -> Result<Job<'a>, Error> {
        let config = map.with_extension("toml");
        std::fs::write(&config, setting.raw.to_toml()?)
            .map_err(|e| StoreError::io(&config, "write", e))?;
        let arguments =
            ["build".as_ref(), octree, "-o".as_ref(), map, "--config".as_ref(), &config];
        Ok(Job {
            args,
            name: setting.name.clone(),
            stage: ["build", "pairs"],
            arguments: arguments.map(OsString::from).into(),
            map: map.to_path_buf(),
            work: Some(map.with_extension("vmap.build")),
            is_heard: true,
        })
    }

    /// Prepares a light of a map, with options that say which; the octree is there for rules by
    /// class.
    pub(super) fn light(
        args: &'a Args,
        name: String,
        (lights, octree, map): (&Path, &Path, &Path),
        way: &[String],
        output: &Path,
    ) -> Job<'a> {
        let arguments: [&Path; 8] = [
            "light".as_ref(),
            map,
            "--lights".as_ref(),
            lights,
            "--octree".as_ref(),
            octree,
            "-o".as_ref(),
            output,
        ];
        let mut arguments: Vec<OsString> = arguments.map(OsString::from).into();
        arguments.extend(way.iter().map(OsString::from));
        let map = map.to_path_buf();
        Job { args, name, stage: LIGHT, arguments, map, work: None, is_heard: true }
    }
}

/// Runs a job as often as was wished; the least seconds and the most memory count.
///
/// # Errors
/// Where it cannot be started or fails, or the run is asked to stop.
pub(super) fn run_often(job: &Job<'_>, watch: &dyn Watch) -> Result<Ended, Error> {
    let mut ended = run(job, watch)?;
    for _ in 1..job.args.runs {
        let Ended::Done(best) = &mut ended else { break };
        // Where another run takes too long, what the first made is still there.
        if let Ended::Done(again) = run(job, watch)? {
            best.merge(&again);
        }
    }
    Ok(ended)
}

/// Runs a job once.
pub(super) fn run(job: &Job<'_>, watch: &dyn Watch) -> Result<Ended, Error> {
    let Job { args, name, stage: [stage, unit], .. } = job;
    let fail = |e| StoreError::io(Path::new(SELF), "run", e);
    let mut command = Command::new(SELF);
    command.args(&job.arguments);
    command.arg("--threads").arg(args.threads.to_string());
    command.arg("--memory").arg(args.memory.to_string());
    // Nothing is ever said to it: what it hears is that this process is no more, even if killed.
    command.args(["--progress", "json", "--until-input-ends"]);
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    watch.stage(stage, None, unit);
    let mut running = Running(command.spawn().map_err(fail)?);
    let lines = lines_of(&mut running.0);
    let deadline = Instant::now() + Duration::from_secs(args.limit);
    let mut told = Told { job, measured: Measured::default(), n_pairs: 0, error: String::new() };
    loop {
        match lines.recv_timeout(TICK) {
            Ok(line) => told.hear(&line, watch),
            Err(RecvTimeoutError::Timeout) => {}
            // Its last line: it has ended, or is about to.
            Err(RecvTimeoutError::Disconnected) => break,
        }
        watch.check()?;
        if Instant::now() >= deadline {
            running.end();
            // Gone at the end in any case, but the disk may be small.
            job.work.iter().for_each(|work| drop(std::fs::remove_dir_all(work)));
            return Ok(Ended::Stopped);
        }
    }
    told.measured.cpu_seconds = cpu_seconds_of(&running.0)?;
    let status = running.0.wait().map_err(fail)?;
    match status.code() {
        Some(0) => Ok(Ended::Done(told.measured)),
        // A signal that was meant for both.
        Some(129 | 130 | 143) if watch.is_stopped() => Err(StoreError::Interrupted.into()),
        Some(REFUSED) => Ok(Ended::Refused(told.error)),
        code => Err(Error::Command {
            message: match told.error.is_empty() {
                true => format!("{name}: the {stage} ended with {status}"),
                false => format!("{name}: {}", told.error),
            },
            code: code.and_then(|code| u8::try_from(code).ok()).unwrap_or(70),
        }),
    }
}

/// What `/proc` counts processor time in, on every architecture that Linux has today.
const TICKS_A_SECOND: f64 = 100.0;

/// Waits for the end of a process that has said its last, and reads what all its threads took. The
/// system knows until somebody asks how it ended.
fn cpu_seconds_of(child: &Child) -> Result<f64, StoreError> {
    let path = PathBuf::from(format!("/proc/{}/stat", child.id()));
    loop {
        let text = std::fs::read_to_string(&path).map_err(|e| StoreError::io(&path, "read", e))?;
        // The name, which may hold anything, ends with the last bracket. Source: proc(5).
        let mut fields = text.rsplit(')').next().unwrap_or_default().split_whitespace();
        let is_over = fields.next().is_none_or(|state| state == "Z");
        let ticks = fields.skip(10).take(2).map(|ticks| ticks.parse::<f64>().unwrap_or(0.0));
        if is_over {
            return Ok(ticks.sum::<f64>() / TICKS_A_SECOND);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A process that does not outlive this.
struct Running(Child);

impl Running {
    fn end(&mut self) {
        // It may have ended by itself; all its files are ours.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
    }
}

/// Hands on what a process says, line by line, until it ends.
fn lines_of(child: &mut Child) -> Receiver<String> {
    let (send, lines) = channel();
    let said = child.stderr.take();
    std::thread::spawn(move || {
        let said = said.into_iter().flat_map(|pipe| BufReader::new(pipe).lines());
        for line in said.map_while(Result::ok) {
            if send.send(line).is_err() {
                break;
            }
        }
    });
    lines
}

/// What was heard of a job.
struct Told<'a> {
    job: &'a Job<'a>,
    measured: Measured,
    n_pairs: u64,
    error: String,
}

impl Told<'_> {
    fn hear(&mut self, line: &str, watch: &dyn Watch) {
        if let Some(error) = line.strip_prefix("pvmap: error: ") {
            error.clone_into(&mut self.error);
            return;
        }
        let Ok(said) = serde_json::from_str::<Value>(line) else { return };
        if let Some(warning) = said["warning"].as_str().filter(|_| self.job.is_heard) {
            let map = self.job.map.display().to_string();
            watch.warn(&warning.replacen(&map, &self.job.name, 1));
        }
        let stage = said["stage"].as_str().unwrap_or_default();
        let number = |key: &str| said[key].as_u64().unwrap_or(0);
        if stage == "visibility" {
            watch.advance(number("done").saturating_sub(self.n_pairs));
            self.n_pairs = number("done");
            watch.tasks(number("tasks_done"), number("tasks_total"), number("links"));
        }
        if said["ended"] == true {
            let seconds = said["seconds"].as_f64().unwrap_or(0.0);
            self.measured.seconds += seconds;
            if ["prepare", "visibility"].contains(&stage) {
                self.measured.visibility_seconds += seconds;
            }
            self.measured.peak_bytes = self.measured.peak_bytes.max(number("rss_anon_bytes"));
            if self.job.stage == LIGHT {
                watch.advance(1);
            }
        }
    }
}
