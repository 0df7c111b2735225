//! The command line: a file a subcommand, arguments in, exit code out.

mod accuracy;
mod build;
mod columns;
mod defects;
mod demo;
mod exact;
mod export;
mod info;
mod ingest;
mod light;
mod query;
mod render;
mod scene;
mod tradeoff;
mod verify;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use clap::{Parser, Subcommand};
use pvmap::scenes::{self, Model};
use pvmap::{Error, Exposure, StoreError, VisibilityError};

use crate::progress::{Mode, Progress};

/// What sees what in a point scan
#[derive(Debug, Parser)]
#[command(name = "pvmap", version, arg_required_else_help = true, after_help = EXAMPLES)]
struct Cli {
    /// Progress on stderr: auto (bars on a terminal, else lines), bar, plain
    /// (a line every 2 s), json (an object a line) or off [default: auto]
    #[arg(
        long,
        global = true,
        value_enum,
        default_value = "auto",
        hide_default_value = true,
        value_name = "MODE",
        verbatim_doc_comment,
        hide_possible_values = true,
        display_order = LAST
    )]
    progress: Mode,

    #[command(subcommand)]
    command: Command,
}

/// Options of all subcommands stand behind a subcommand's own.
const LAST: usize = 900;

const EXAMPLES: &str = "\
Scan files (LAS, LAZ, PLY) become a sorted octree, the octree becomes a visibility map, and the
map answers questions. Coordinates and distances are in the scan's own units; sizes are written
64MiB, 1GiB or 500MB.

Examples:
  pvmap demo                                       the whole way on a generated room, half a minute
  pvmap ingest grotto.las --sensor 0,0,1.8         scan file to grotto.octree
  pvmap build                                      the only *.octree here to grotto.vmap
  pvmap query grotto.vmap pair 1,2,3 -4,5,6        do these two places see each other?
  pvmap info grotto.vmap                           what is in it

Exit codes:
  0 done, or yes          1 query pair: no           2 wrong usage          65 bad data
  66 no such input        70 a bug, no memory        73 cannot create       74 disk or I/O
  75 locked               77 no permission           78 configuration, version
  129, 130, 143 stopped by a signal";

#[derive(Debug, Subcommand)]
enum Command {
    Ingest(ingest::Args),
    Build(build::Args),
    Query(query::Args),
    Light(light::Args),
    Render(render::Args),
    Info(info::Args),
    Verify(verify::Args),
    Export(export::Args),
    Scene(scene::Args),
    Accuracy(accuracy::Args),
    Tradeoff(tradeoff::Args),
    Demo(demo::Args),
}

/// What every subcommand gets.
struct Context {
    progress: Progress,
}

/// The answer of a subcommand that is not an error.
type Outcome = anyhow::Result<ExitCode>;

/// Runs the command; prints at most one line of error.
pub(crate) fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => return explain(&e),
    };
    let signal = Arc::new(AtomicUsize::new(0));
    // A question leaves nothing behind: it may end at the first signal.
    let at_once = matches!(cli.command, Command::Query(_) | Command::Info(_) | Command::Verify(_));
    if let Err(e) = listen(&signal, at_once) {
        report(&format!("cannot listen for signals: {e}"));
        return ExitCode::from(70);
    }
    hook_panics();
    let context = Context { progress: Progress::new(cli.progress, signal.clone()) };
    let result =
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(cli.command, &context)));
    if !matches!(result, Ok(Ok(_))) {
        context.progress.give_up();
    }
    drop(context);
    match result {
        Ok(Ok(code)) => code,
        Ok(Err(e)) => fail(&e, signal.load(Ordering::Relaxed)),
        // The panic hook has said what happened.
        Err(_) => ExitCode::from(70),
    }
}

/// Prints the help that was asked for, or in one line what is wrong with the command line.
fn explain(e: &clap::Error) -> ExitCode {
    use clap::error::ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand;
    if !e.use_stderr() || e.kind() == DisplayHelpOnMissingArgumentOrSubcommand {
        // Whoever read our output has seen enough.
        let _ = e.print();
        return ExitCode::from(if e.use_stderr() { 2 } else { 0 });
    }
    // What is wrong, then tips, each in lines of its own, then the usage.
    let text = e.to_string();
    let lines = text.lines().map(str::trim).take_while(|l| !l.starts_with("Usage:"));
    let mut message = String::new();
    for line in lines.filter(|l| !l.is_empty() && !l.starts_with("For more information")) {
        message += match line {
            _ if message.is_empty() => "",
            _ if line.starts_with("tip:") => "; ",
            _ => " ",
        };
        message += line.trim_start_matches("error: ");
    }
    report(&format!("{message}; --help tells more"));
    ExitCode::from(2)
}

fn run(command: Command, context: &Context) -> Outcome {
    match command {
        Command::Ingest(args) => ingest::run(&args, context),
        Command::Build(args) => build::run(&args, context),
        Command::Query(args) => query::run(&args, context),
        Command::Light(args) => light::run(&args, context),
        Command::Render(args) => render::run(&args, context),
        Command::Info(args) => info::run(&args, context),
        Command::Verify(args) => verify::run(&args, context),
        Command::Export(args) => export::run(&args, context),
        Command::Scene(args) => scene::run(&args, context),
        Command::Accuracy(args) => accuracy::run(&args, context),
        Command::Tradeoff(args) => tradeoff::run(&args, context),
        Command::Demo(args) => demo::run(&args, context),
    }
}

/// Stops at the first SIGINT, SIGTERM or SIGHUP with everything tidy, at the second at once. A
/// terminal that closes (SIGHUP) stops nothing that was started with `nohup`.
fn listen(signal: &Arc<AtomicUsize>, at_once: bool) -> io::Result<()> {
    use signal_hook::consts::{SIGABRT, SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
    use signal_hook::flag;
    // A file that may not grow is an error of the call that writes it (F27).
    flag::register(SIGXFSZ, Arc::default())?;
    // What std ends the process for, after a line about it: no memory is left (F72), or a bug.
    flag::register_conditional_shutdown(SIGABRT, 70, Arc::new(AtomicBool::new(true)))?;
    pvmap::exit_on_lost_pages(74)?;
    let asked = Arc::new(AtomicBool::new(at_once));
    for name in [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|&s| !is_ignored(s)) {
        flag::register_conditional_shutdown(name, 128 + name, asked.clone())?;
        flag::register(name, asked.clone())?;
        flag::register_usize(name, signal.clone(), name as usize)?;
    }
    Ok(())
}

/// Says whether a signal was being ignored when the command was started.
fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

/// Says a panic in one line. Panics of third-party decoders are caught and become errors with a
/// place; nobody need hear of them twice.
fn hook_panics() {
    std::panic::set_hook(Box::new(|info| {
        if !pvmap::scan::is_decoding() {
            let message = info.to_string().replace('\n', " ");
            report(&format!("a bug, please report it: {message}"));
        }
    }));
}

/// Prints an error and gives its exit code.
fn fail(e: &anyhow::Error, signal: usize) -> ExitCode {
    let from_stdout = e.downcast_ref::<io::Error>();
    let from_table = match e.downcast_ref::<Error>() {
        Some(Error::Store(StoreError::Io { source, .. })) => Some(source),
        _ => None,
    };
    // Whoever read our output has seen enough.
    let is_enough = |e: &io::Error| e.kind() == io::ErrorKind::BrokenPipe;
    if from_stdout.or(from_table).is_some_and(is_enough) {
        return ExitCode::SUCCESS;
    }
    if let Some(e) = from_stdout {
        report(&format!("cannot write the answer: {e}"));
        return ExitCode::from(74);
    }
    let code = e.downcast_ref::<Error>().map_or(70, Error::exit_code);
    if code == 130 {
        match e.downcast_ref::<Error>() {
            Some(stopped @ Error::Visibility(VisibilityError::Stopped { .. })) => {
                report(&stopped.to_string());
            }
            _ => report("interrupted; nothing was left behind"),
        }
        // The number of a signal that is listened to is at most 15.
        return ExitCode::from(128 + signal as u8);
    }
    // The panic hook has said what happened.
    if !matches!(e.downcast_ref::<Error>(), Some(Error::Visibility(VisibilityError::Panicked(_)))) {
        report(&e.to_string());
    }
    ExitCode::from(code)
}

fn report(message: &str) {
    // Where stderr is closed the exit code has to do.
    let _ = writeln!(io::stderr().lock(), "pvmap: error: {}", one_line(message));
}

/// Escapes what would break a line: names of files may hold anything.
pub(crate) fn one_line(message: &str) -> String {
    let mut line = String::with_capacity(message.len());
    for c in message.chars() {
        if c.is_control() {
            line.extend(c.escape_default());
        } else {
            line.push(c);
        }
    }
    line
}

/// Refuses an output that is one of the files it is made from (F33).
fn refuse_input(output: &Path, inputs: &[PathBuf]) -> Result<(), Error> {
    if pvmap::is_input(output, inputs)? {
        let message = format!("{}: the output is one of the inputs", output.display());
        return Err(Error::Usage(message));
    }
    Ok(())
}

/// Writes one JSON value and a newline to stdout.
fn print_json(value: &serde_json::Value) -> io::Result<()> {
    writeln!(io::stdout().lock(), "{value}")
}

/// Maps an artifact; an octree may be named by its folder.
fn map_file(path: &Path) -> Result<(PathBuf, pvmap::Mapped), Error> {
    if path.is_dir() {
        let points = path.join(pvmap::vmap::octree::FILE_NAME);
        return Ok((points, pvmap::open_octree(path)?));
    }
    Ok((path.to_path_buf(), pvmap::Mapped::open(path)?))
}

/// Reads a number of threads.
fn threads_parser() -> clap::builder::RangedU64ValueParser<usize> {
    clap::builder::RangedU64ValueParser::new().range(0..=pvmap::MAX_THREADS as u64)
}

/// Reads `x,y,z`.
fn parse_point(text: &str) -> Result<[f64; 3], String> {
    let parts: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or_else(|| format!("{text:?} is not three numbers; write x,y,z"))?;
    parts.try_into().map_err(|_| format!("{text:?} is not three numbers; write x,y,z"))
}

/// Reads `auto`, or a number above 0.
fn parse_exposure(text: &str) -> Result<Exposure, String> {
    match text.parse::<f64>() {
        _ if text == "auto" => Ok(Exposure::Auto),
        Ok(times) if times > 0.0 && times.is_finite() => Ok(Exposure::Times(times)),
        _ => Err("write a number above 0, or auto".to_owned()),
    }
}

/// Reads a number of points: `400000`, `400k`, `20M`.
fn parse_count(text: &str) -> Result<u64, String> {
    let (number, factor) = match text.char_indices().last() {
        Some((at, 'k' | 'K')) => (&text[..at], 1e3),
        Some((at, 'm' | 'M')) => (&text[..at], 1e6),
        Some((at, 'g' | 'G')) => (&text[..at], 1e9),
        _ => (text, 1.0),
    };
    match number.parse::<f64>() {
        Ok(v) if v >= 0.0 && v * factor < 1e15 => Ok((v * factor).round() as u64),
        _ => Err(format!("{text:?} is no number of 0 to 1000000G; write for example 400k or 20M")),
    }
}

/// Reads a mesh, and says what was left out of it.
fn read_mesh(path: &Path, memory_bytes: u64) -> Result<Model, Error> {
    let model = scenes::read_mesh(path, memory_bytes)?;
    if model.n_flat_faces > 0 {
        // Where stderr is closed nobody wants to know.
        let _ = writeln!(
            std::io::stderr().lock(),
            "pvmap: warning: {}: {} faces of fewer than three corners left out",
            path.display(),
            model.n_flat_faces
        );
    }
    Ok(model)
}

/// Reads a number of points that is not zero.
fn parse_some(text: &str) -> Result<u64, String> {
    match parse_count(text)? {
        0 => Err("there must be some".to_owned()),
        n => Ok(n),
    }
}

/// Writes a size: 12.3 MiB.
fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / (1 << 20) as f64)
}
