//! How fast scan files are drained on one and on two threads: `speed [FILE…]`.
//!
//! Without files, 5 M points are written to a temporary folder as LAS, LAZ and PLY first (that is
//! timed too).

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use pvmap_geometry::{PointBatch, Positions};
use pvmap_scan::{
    ColorRange, LasOptions, LasWriter, PlyColumns, PlyWriter, ReadOptions, ReadReport, ScanError,
    Source,
};

const N_POINTS: u64 = 5_000_000;
const BATCH: u64 = 65_536;

fn main() -> Result<(), Box<dyn Error>> {
    let mut paths: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let folder = tempfile::tempdir()?;
    if paths.is_empty() {
        paths = generate(folder.path())?;
    }
    for path in paths {
        for n_threads in [1, 2] {
            let start = Instant::now();
            let report = drain(&path, n_threads)?;
            let rate = report.n_read as f64 / start.elapsed().as_secs_f64() / 1e6;
            println!("{}: {n_threads} threads: {rate:.2} M points/s", path.display());
        }
    }
    Ok(())
}

/// Reads all parts of a file, shared among threads.
fn drain(path: &Path, n_threads: u64) -> Result<ReadReport, ScanError> {
    let source = Source::open(path, 0, ReadOptions::default())?;
    let parts = source.parts(8 * n_threads);
    let next = AtomicUsize::new(0);
    let work = || -> Result<ReadReport, ScanError> {
        let mut sum = ReadReport::default();
        while let Some(part) = parts.get(next.fetch_add(1, Ordering::Relaxed)) {
            let report = source.read(part.clone(), BATCH as usize, |batch| {
                std::hint::black_box(&batch);
                Ok::<(), ScanError>(())
            })?;
            sum = sum.join(&report);
        }
        Ok(sum)
    };
    let reports: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..n_threads).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(|t| t.join().expect("a worker returns its errors")).collect()
    });
    let mut sum = ReadReport::default();
    for report in reports {
        sum = sum.join(&report?);
    }
    Ok(sum)
}

/// Writes the same points in three formats.
fn generate(folder: &Path) -> Result<Vec<PathBuf>, ScanError> {
    let mut paths = Vec::new();
    for (name, compressed) in [("5M.las", false), ("5M.laz", true)] {
        let path = folder.join(name);
        let options =
            LasOptions { compressed, scale: [0.001; 3], offset: [0.0; 3], normals: false };
        let start = Instant::now();
        let mut writer = LasWriter::create(&path, options)?;
        for first in (0..N_POINTS).step_by(BATCH as usize) {
            writer.write(&batch(first, BATCH.min(N_POINTS - first)))?;
        }
        writer.finish()?;
        report_written(&path, start);
        paths.push(path);
    }
    let path = folder.join("5M.ply");
    let columns =
        PlyColumns { normal: true, color: Some(ColorRange::Eight), ..PlyColumns::default() };
    let start = Instant::now();
    let mut writer = PlyWriter::create(&path, N_POINTS, columns)?;
    for first in (0..N_POINTS).step_by(BATCH as usize) {
        writer.write(&batch(first, BATCH.min(N_POINTS - first)))?;
    }
    writer.finish()?;
    report_written(&path, start);
    paths.push(path);
    Ok(paths)
}

fn report_written(path: &Path, start: Instant) {
    let rate = N_POINTS as f64 / start.elapsed().as_secs_f64() / 1e6;
    println!("{}: written (and made) at {rate:.2} M points/s", path.display());
}

/// Points of a scanner that turns: a bumpy wall around it, swept column by column.
fn batch(first: u64, n: u64) -> PointBatch {
    let records: Vec<u64> = (first..first + n).collect();
    let place = |i: &u64| {
        let (column, row) = ((i / 2000) as f64 / 400.0, (i % 2000) as f64 / 1000.0 - 1.0);
        // Bits of the record number, scrambled: noise of some millimetres.
        let noise = (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 44) as f64 * 1e-8;
        let radius = 5.0 + 0.3 * (column * 9.0).sin() * (row * 7.0).cos() + noise;
        [radius * column.cos(), radius * column.sin(), radius * row]
    };
    PointBatch {
        source: 0,
        positions: Positions::Double(records.iter().map(place).collect()),
        color: Some(records.iter().map(|i| [(i % 251) as u16, 128, (i % 13) as u16]).collect()),
        intensity: None,
        classification: None,
        gps_time: None,
        normal: Some(records.iter().map(|i| [1.0, (i % 100) as f32 * 0.01, 0.5]).collect()),
        records,
    }
}
