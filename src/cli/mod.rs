//! The command line: a file a subcommand, arguments in, exit code out.

mod build;
mod demo;
mod export;
mod info;
mod ingest;
mod query;
mod scene;
mod verify;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use clap::{Parser, Subcommand};
use pvmap::Error;

use crate::progress::{Mode, Progress};

/// What sees what in a point scan.
///
/// Scan files (LAS, LAZ, PLY) become a sorted octree, the octree becomes a visibility map, and the
/// map answers questions.
#[derive(Debug, Parser)]
#[command(name = "pvmap", version, arg_required_else_help = true, after_help = EXAMPLES)]
struct Cli {
    /// How progress is shown, on stderr.
    #[arg(long, global = true, value_enum, default_value = "auto", value_name = "MODE")]
    progress: Mode,

    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "\
Examples:
  pvmap demo                                       the whole way on a generated room
  pvmap ingest grotto.las --sensor 0,0,1.8         scan file to grotto.octree
  pvmap build --config depth8.toml                 the only *.octree here to its .vmap
  pvmap query grotto.vmap pair 1,2,3 -4,5,6        do these two points see each other?
  pvmap info grotto.vmap                           what is in it";

#[derive(Debug, Subcommand)]
enum Command {
    Ingest(ingest::Args),
    Build(build::Args),
    Query(query::Args),
    Info(info::Args),
    Verify(verify::Args),
    Export(export::Args),
    Scene(scene::Args),
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
    let cli = Cli::parse();
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
    drop(context);
    match result {
        Ok(Ok(code)) => code,
        Ok(Err(e)) => fail(&e, signal.load(Ordering::Relaxed)),
        // The panic hook has said what happened.
        Err(_) => ExitCode::from(70),
    }
}

fn run(command: Command, context: &Context) -> Outcome {
    match command {
        Command::Ingest(args) => ingest::run(&args, context),
        Command::Build(args) => build::run(&args, context),
        Command::Query(args) => query::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Export(args) => export::run(&args, context),
        Command::Scene(args) => scene::run(&args, context),
        Command::Demo(args) => demo::run(&args, context),
    }
}

/// Stops at the first SIGINT or SIGTERM with everything tidy, at the second at once.
fn listen(signal: &Arc<AtomicUsize>, at_once: bool) -> io::Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    use signal_hook::flag;
    let asked = Arc::new(AtomicBool::new(at_once));
    for (name, code) in [(SIGINT, 130), (SIGTERM, 143)] {
        flag::register_conditional_shutdown(name, code, asked.clone())?;
        flag::register(name, asked.clone())?;
        flag::register_usize(name, signal.clone(), name as usize)?;
    }
    Ok(())
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
    if let Some(e) = e.downcast_ref::<io::Error>() {
        // Whoever read our output has seen enough.
        if e.kind() == io::ErrorKind::BrokenPipe {
            return ExitCode::SUCCESS;
        }
        report(&format!("cannot write the answer: {e}"));
        return ExitCode::from(74);
    }
    let code = e.downcast_ref::<Error>().map_or(70, Error::exit_code);
    if code == 130 {
        report("interrupted; nothing was left behind");
        return ExitCode::from(if signal == signal_hook::consts::SIGTERM as usize {
            143
        } else {
            130
        });
    }
    report(&e.to_string());
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

/// Reads `x,y,z`.
fn parse_point(text: &str) -> Result<[f64; 3], String> {
    let parts: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect::<Option<_>>()
        .ok_or_else(|| format!("{text:?} is not three numbers; write x,y,z"))?;
    parts.try_into().map_err(|_| format!("{text:?} is not three numbers; write x,y,z"))
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
        _ => Err(format!("{text:?} is not a number of points; write for example 400k or 20M")),
    }
}

/// Writes a size: 12.3 MiB.
fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / (1 << 20) as f64)
}
