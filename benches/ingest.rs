//! How fast scans become octrees: `cargo bench --bench ingest [-- POINTS]`.
//!
//! Generated rooms, coherent and shuffled, as LAS, LAZ and PLY; normals are not estimated. Prints,
//! a row an input and memory budget, the median of three runs: million points a second (decoding
//! alone beside it), and the bytes written over the bytes of the octree. Without arguments 20
//! million points (5 million for PLY); run as a test, a small number.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use pvmap::scan::{ReadOptions, ScanError, Source};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::{Error, IngestRequest, Limits, NormalsFrom, Quiet};

const RUNS: usize = 3;

fn main() -> Result<(), Error> {
    let arguments: Vec<String> = std::env::args().collect();
    let as_test = !arguments.iter().any(|a| a == "--bench");
    let asked = arguments.iter().skip(1).find_map(|a| a.parse::<u64>().ok());
    let n_points = asked.unwrap_or(if as_test { 20_000 } else { 20_000_000 });
    let folder = tempfile::tempdir().expect("the temporary folder can be written");
    println!("{n_points} points ({} for PLY), {} threads", n_points / 4, threads());
    println!(
        "{:<26}{:>9}{:>12}{:>12}{:>14}{:>16}",
        "input", "memory", "M points/s", "decode only", "of decoding", "written/octree"
    );
    for (name, n, shuffle) in [
        ("coherent.las", n_points, false),
        ("shuffled.las", n_points, true),
        ("lying.las", n_points, false),
        ("coherent.laz", n_points, false),
        ("coherent.ply", n_points / 4, false),
    ] {
        let input = folder.path().join(name);
        let scene = Scene::new(SceneKind::Furnished, 1);
        let request = SceneRequest { n_points: n, shuffle };
        scenes::write(&scene, &request, &input, &Limits::default(), &Quiet)?;
        if name == "lying.las" {
            understate_bounds(&input);
        }
        measure(&input, n)?;
        std::fs::remove_file(&input).expect("the file was just written");
    }
    Ok(())
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Halves the greatest x of a LAS header.
fn understate_bounds(path: &Path) {
    use std::os::unix::fs::FileExt;
    let file = std::fs::File::options().write(true).open(path).expect("just written");
    file.write_all_at(&2.0f64.to_le_bytes(), 179).expect("just written");
}

fn measure(input: &Path, n_points: u64) -> Result<(), Error> {
    let decoding = median(|| decode(input))?;
    for memory_bytes in [1 << 30, 128 << 20] {
        let output = input.with_extension("octree");
        let mut request = IngestRequest::new([PathBuf::from(input)], output.clone());
        request.normals = NormalsFrom::File;
        request.overwrite = true;
        let limits = Limits { threads: 0, memory_bytes };
        let mut written = 0.0;
        let seconds = median(|| {
            let done = pvmap::ingest(&request, &limits, &Quiet)?.report;
            let bytes = done.output_bytes + done.temporary_bytes;
            written = bytes as f64 / done.output_bytes as f64;
            Ok(())
        })?;
        let rate = |seconds: f64| n_points as f64 / seconds / 1e6;
        println!(
            "{:<26}{:>6}MiB{:>12.2}{:>12.2}{:>12.0} %{:>16.2}",
            input.file_name().unwrap_or_default().to_string_lossy(),
            memory_bytes >> 20,
            rate(seconds),
            rate(decoding),
            100.0 * decoding / seconds,
            written
        );
        std::fs::remove_dir_all(&output).expect("just written");
    }
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

fn median(mut run: impl FnMut() -> Result<(), Error>) -> Result<f64, Error> {
    let mut seconds = Vec::new();
    for _ in 0..RUNS {
        let started = Instant::now();
        run()?;
        seconds.push(started.elapsed().as_secs_f64());
    }
    seconds.sort_by(f64::total_cmp);
    Ok(seconds[RUNS / 2])
}
