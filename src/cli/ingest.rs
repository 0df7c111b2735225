//! `pvmap ingest`: scan files to an octree.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::scan::ReadOptions;
use pvmap::{Error, IngestRequest, Ingested, Limits, NormalsFrom, Orientation, Watch, memory};

use super::{Context, Outcome, mib, parse_point, refuse_input, threads_parser};
use crate::progress::si;

/// Stream scan files into a sorted octree on disk.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Every record is stored with its colour, intensity, class, GPS time and normal, or counted with a
reason; a scan that is broken or cut short is refused. What does not fit in memory goes to a
temporary file beside the output. Normals that are estimated count from both sides, unless
--sensor or --up says which side was seen.

Examples:
  pvmap ingest grotto.las                            makes grotto.octree here
  pvmap ingest a.las b.laz -o site.octree            several scans, one octree
  pvmap ingest room.laz --sensor 0,0,1.77            normals toward the scanner
  pvmap ingest tile.laz --up --memory 512MiB         an airborne tile, in half a gigabyte")]
pub(super) struct Args {
    /// LAS 1.0 to 1.4, LAZ or PLY files
    #[arg(required = true, value_name = "SCAN")]
    inputs: Vec<PathBuf>,
    /// The octree to make [default: the scan's name with .octree, in the
    /// current directory; several scans need a name]
    #[arg(short, long, value_name = "NAME.octree", verbatim_doc_comment)]
    output: Option<PathBuf>,
    /// Replace an octree of that name, at once and only when all is done
    #[arg(long)]
    overwrite: bool,
    /// Most memory to hold, at least 64MiB
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
    /// Threads; 0 takes as many as the machine has
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = threads_parser())]
    threads: usize,
    /// Where normals come from: auto (the file's where it has them, else
    /// estimated), file, estimate (whatever the file has) or none
    /// [default: auto]
    #[arg(
        long,
        value_enum,
        default_value = "auto",
        hide_default_value = true,
        value_name = "FROM",
        verbatim_doc_comment,
        hide_possible_values = true
    )]
    normals: Normals,
    /// Where the scanner stood, in the scan's units: estimated normals turn
    /// to it; given several times, to the nearest
    #[arg(
        long,
        value_parser = parse_point,
        value_name = "X,Y,Z",
        allow_hyphen_values = true,
        verbatim_doc_comment
    )]
    sensor: Vec<[f64; 3]>,
    /// Estimated normals turn up (airborne and terrain scans)
    #[arg(long, conflicts_with = "sensor")]
    up: bool,
    /// Drop and count points whose coordinates are not finite
    #[arg(long)]
    skip_invalid: bool,
    /// Read what is there of a file that was cut short
    #[arg(long)]
    lenient: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Normals {
    /// The file's where it has them, else estimated.
    Auto,
    /// The file's alone.
    File,
    /// Estimated, whatever the file has.
    Estimate,
    /// None at all.
    None,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let output = output(args)?;
    refuse_input(&output, &args.inputs)?;
    let request = IngestRequest {
        inputs: args.inputs.clone(),
        output,
        overwrite: args.overwrite,
        read: ReadOptions { skip_invalid: args.skip_invalid, lenient: args.lenient },
        normals: match args.normals {
            Normals::Auto => NormalsFrom::Auto,
            Normals::File => NormalsFrom::File,
            Normals::Estimate => NormalsFrom::Estimate,
            Normals::None => NormalsFrom::None,
        },
        orientation: match (args.up, args.sensor.is_empty()) {
            (true, _) => Orientation::Up,
            (false, false) => Orientation::Sensors(args.sensor.clone()),
            (false, true) => Orientation::Unknown,
        },
    };
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    if let Some(free) = memory::free_disk_bytes(&request.output) {
        let size: u64 = args.inputs.iter().filter_map(|p| p.metadata().ok()).map(|m| m.len()).sum();
        if size > free / 4 {
            context.progress.warn(&format!("{} of disk are left", mib(free)));
        }
    }
    let done = pvmap::ingest(&request, &limits, &context.progress)?;
    print(&request, &done, context)?;
    Ok(ExitCode::SUCCESS)
}

fn output(args: &Args) -> Result<PathBuf, Error> {
    match (&args.output, args.inputs.as_slice()) {
        (Some(output), _) => Ok(output.clone()),
        (None, [input]) => Ok(pvmap::default_octree(input)),
        (None, _) => Err(Error::Usage(
            "several scans need a name for their octree: add -o NAME.octree".to_owned(),
        )),
    }
}

/// Says of so many records what is rarely so.
fn some(n: u64, what: &str) -> String {
    if n == 0 { String::new() } else { format!("; {n} {what}") }
}

fn print(request: &IngestRequest, done: &Ingested, context: &Context) -> std::io::Result<()> {
    let s = &done.report.summary;
    let stages = context.progress.take_stages();
    let seconds: f64 = stages.iter().map(|s| s.seconds).sum();
    let peak = stages.iter().map(|s| s.peak_bytes).max().unwrap_or(0);
    let mut out = std::io::stdout().lock();
    writeln!(out, "{}", request.output.display())?;
    writeln!(
        out,
        "  records   {} read = {} stored + {} not finite{}{}",
        s.n_read,
        s.n_points,
        s.n_invalid,
        some(s.n_missing, "declared are not there"),
        some(s.n_beyond, "beyond the header's count were not read")
    )?;
    writeln!(
        out,
        "  normals   {} from the file, {} estimated, {} none; {} with a known side",
        s.n_normals_file,
        s.n_normals_estimated,
        s.n_points - s.n_normals_file - s.n_normals_estimated,
        s.n_oriented
    )?;
    if let Some((normals, median)) = done.normals.as_ref().and_then(|n| Some((n, n.median_deg?))) {
        writeln!(
            out,
            "  angles    {median:.1}° to planes of their neighbours (median of {} of the file's)",
            normals.n_angles()
        )?;
    }
    writeln!(
        out,
        "  disk      {} and {} temporary{}",
        mib(done.report.output_bytes),
        mib(done.report.temporary_bytes),
        if done.report.bounds_were_wrong {
            " (the headers' bounds were not the true ones)"
        } else {
            ""
        }
    )?;
    let rate = s.n_points as f64 / seconds.max(1e-9);
    writeln!(
        out,
        "  time      {seconds:.2} s, {} points/s, at most {} of memory",
        si(rate),
        mib(peak)
    )
}
