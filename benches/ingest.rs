//! How fast scans become octrees: `cargo bench --bench ingest [-- POINTS] [PART OF A NAME]`.
//!
//! Generated rooms, without normal estimation but for the last: LAS of point format 7 in coherent
//! and in random order, plain and with normals as extra bytes, with bounds that lie; LAZ; PLY with
//! normals; LAS whose normals are estimated. Each is taken in with 1 GiB and with 128 MiB. A row an
//! input, medians of five runs that take turns: million points a second with either budget and of
//! decoding alone, the time with the small budget over that with the large one, the share of
//! decoding in the time with the large one, and the bytes written over the bytes of the octree (the
//! larger of the two budgets). Without arguments 20 million points (5 million for the last two);
//! run as a test, a small number.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use pvmap::scan::{LasOptions, LasWriter, ReadOptions, ScanError, Source};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{Error, IngestRequest, Limits, NormalsFrom, Quiet};

const RUNS: usize = 5;
const BUDGETS: [u64; 2] = [1 << 30, 128 << 20];
/// Where a LAS header has the least x.
const LEAST_X_OFFSET: u64 = 187;
/// Points generated at once.
const BLOCK_POINTS: u64 = 1 << 18;

/// One input to take in.
struct Case {
    name: &'static str,
    /// Points, as a share of those asked for: 1/1 or 1/4.
    divisor: u64,
    shuffle: bool,
    normals: bool,
    lies: bool,
    estimate: bool,
}

const fn case(name: &'static str, shuffle: bool, normals: bool) -> Case {
    Case { name, divisor: 1, shuffle, normals, lies: false, estimate: false }
}

const CASES: [Case; 9] = [
    case("coherent.las", false, false),
    case("shuffled.las", true, false),
    case("coherent-normals.las", false, true),
    case("shuffled-normals.las", true, true),
    Case { lies: true, ..case("lying-bounds.las", false, false) },
    case("coherent.laz", false, false),
    case("coherent-normals.laz", false, true),
    Case { divisor: 4, ..case("coherent-normals.ply", false, true) },
    Case { divisor: 4, estimate: true, ..case("estimated.las", false, false) },
];

fn main() -> Result<(), Error> {
    let arguments: Vec<String> = std::env::args().collect();
    let as_test = !arguments.iter().any(|a| a == "--bench");
    let asked = arguments.iter().skip(1).find_map(|a| a.parse::<u64>().ok());
    let is_word = |a: &&String| !a.starts_with('-') && a.parse::<u64>().is_err();
    let wanted = arguments.iter().skip(1).find(is_word).map_or("", String::as_str);
    let n_points = asked.unwrap_or(if as_test { 20_000 } else { 20_000_000 });
    let folder = tempfile::tempdir().expect("the temporary folder can be written");
    println!("{n_points} points ({} for the last two), {} threads", n_points / 4, threads());
    println!(
        "{:<22}{:>28}{:>10}{:>12}{:>10}",
        "", "million points a second", "128 MiB", "decoding", "written"
    );
    println!(
        "{:<22}{:>8}{:>9}{:>11}{:>10}{:>12}{:>10}",
        "input", "1 GiB", "128 MiB", "decoding", "/ 1 GiB", "/ 1 GiB", "/ octree"
    );
    for case in CASES.iter().filter(|case| case.name.contains(wanted)) {
        let input = folder.path().join(case.name);
        write(case, n_points / case.divisor, &input)?;
        measure(case, &input, n_points / case.divisor)?;
        std::fs::remove_file(&input).expect("the file was just written");
    }
    Ok(())
}

/// Generates an input.
fn write(case: &Case, n_points: u64, input: &Path) -> Result<(), Error> {
    let scene = Scene::new(SceneKind::Furnished, 1);
    let request = SceneRequest { n_points, shuffle: case.shuffle };
    if case.normals {
        return scenes::write(&scene, &request, input, &Limits::default(), &Quiet);
    }
    let compressed = input.extension().is_some_and(|e| e == "laz");
    let (scale, offset) = ([0.0001; 3], [0.0; 3]);
    let options = LasOptions { compressed, scale, offset, normals: false };
    let mut writer = LasWriter::create(input, options)?;
    for first in (0..n_points).step_by(BLOCK_POINTS as usize) {
        let n = BLOCK_POINTS.min(n_points - first);
        writer.write(&scenes::batch(&scene, &request, first, n))?;
    }
    writer.finish()?;
    if case.lies {
        understate_bounds(input);
    }
    Ok(())
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Makes the header of a LAS file say that x begins a metre later than it does: the frame moves.
fn understate_bounds(path: &Path) {
    use std::os::unix::fs::FileExt;
    let file = std::fs::File::options().read(true).write(true).open(path).expect("just written");
    let mut least = [0; 8];
    file.read_exact_at(&mut least, LEAST_X_OFFSET).expect("just written");
    let later = f64::from_le_bytes(least) + 1.0;
    file.write_all_at(&later.to_le_bytes(), LEAST_X_OFFSET).expect("just written");
}

fn measure(case: &Case, input: &Path, n_points: u64) -> Result<(), Error> {
    let output = input.with_extension("octree");
    let mut request = IngestRequest::new([PathBuf::from(input)], output.clone());
    request.normals = match (case.normals, case.estimate) {
        (true, _) => NormalsFrom::File,
        (_, true) => NormalsFrom::Estimate,
        _ => NormalsFrom::None,
    };
    request.overwrite = true;
    let mut written = 0.0f64;
    let mut seconds = [const { Vec::new() }; 3];
    for _ in 0..RUNS {
        for (times, memory_bytes) in seconds.iter_mut().zip(BUDGETS) {
            let limits = Limits { threads: 0, memory_bytes };
            times.push(time(|| {
                let done = pvmap::ingest(&request, &limits, &Quiet)?.report;
                let bytes = done.output_bytes + done.temporary_bytes;
                written = written.max(bytes as f64 / done.output_bytes as f64);
                Ok(())
            })?);
        }
        seconds[2].push(time(|| decode(input))?);
    }
    std::fs::remove_dir_all(&output).expect("just written");
    let [large, small, decoding] = seconds.map(median);
    let rate = |seconds: f64| n_points as f64 / seconds / 1e6;
    println!(
        "{:<22}{:>8.2}{:>9.2}{:>11.2}{:>10.2}{:>10.0} %{:>10.2}",
        case.name,
        rate(large),
        rate(small),
        rate(decoding),
        small / large,
        100.0 * decoding / large,
        written
    );
    Ok(())
}

/// Reads all points on all threads and throws them away.
fn decode(input: &Path) -> Result<(), Error> {
    let source = Source::open(input, 0, ReadOptions::default())?;
    let parts: Vec<Range<u64>> = source.parts(threads() as u64 * 16);
    let next = std::sync::atomic::AtomicUsize::new(0);
    let work = || -> Result<(), ScanError> {
        while let Some(part) = parts.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
            source.read(part.clone(), 16_384, |_| Ok::<_, ScanError>(()))?;
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let running: Vec<_> = (0..threads()).map(|_| scope.spawn(work)).collect();
        running.into_iter().try_for_each(|r| r.join().expect("reading does not panic"))
    })?;
    Ok(())
}

fn time(run: impl FnOnce() -> Result<(), Error>) -> Result<f64, Error> {
    let started = Instant::now();
    run()?;
    Ok(started.elapsed().as_secs_f64())
}

fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}
