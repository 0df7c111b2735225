//! From scan files to an octree: joins the readers of `scan` to the sort of `octree`.

use std::collections::HashMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use pvmap_octree::OctreeError;
use pvmap_octree::ingest::{
    Account, ColorPlan, Ingest, IngestOptions, IngestReport, NormalsFrom, Orientation,
    PositionPlan, SourcePlan, Turns,
};
use pvmap_query::quality::{NormalQuality, measure};
use pvmap_scan::{
    ColorRange, Crs, IntensityKind, PositionKind, ReadOptions, ReadReport, ScanError, Source,
    StoredBounds,
};
use pvmap_store::{InputFile, StoreError, Watch};
use pvmap_vmap::OctreeView;
use pvmap_vmap::frame::CrsKind;
use pvmap_vmap::schema::ColumnType;
use rayon::prelude::*;

use crate::build::open_octree;
use crate::told::contradiction;
use crate::{Error, Limits};

/// Points of a batch: large enough to amortise a call, small enough for 64 MiB.
const BATCH_LEN: usize = 16_384;
/// Parts a thread: enough that the threads end at about the same time.
const PARTS_A_THREAD: u64 = 16;
/// Points of a source that choose the buckets: a hundred and more a bucket.
const SAMPLE_POINTS: u64 = 1 << 15;
/// Points at which normals of the file are compared with the points around them: enough to tell
/// on which side of 45° their median is, and a few milliseconds.
const QUALITY_POINTS: u64 = 512;

/// Which scans to take in, and how.
#[derive(Debug, Clone)]
pub struct IngestRequest {
    /// The scan files, in the order that names them.
    pub inputs: Vec<PathBuf>,
    /// The octree to make.
    pub output: PathBuf,
    /// Whether it may replace an octree of that name.
    pub overwrite: bool,
    /// How files that are not quite right are treated.
    pub read: ReadOptions,
    /// Where normals come from.
    pub normals: NormalsFrom,
    /// What gives estimated normals their side.
    pub orientation: Orientation,
}

impl IngestRequest {
    /// Asks for the defaults.
    pub fn new(inputs: impl IntoIterator<Item = PathBuf>, output: PathBuf) -> IngestRequest {
        IngestRequest {
            inputs: inputs.into_iter().collect(),
            output,
            overwrite: false,
            read: ReadOptions::default(),
            normals: NormalsFrom::default(),
            orientation: Orientation::default(),
        }
    }
}

/// What an ingest did.
#[derive(Debug, Clone)]
pub struct Ingested {
    /// Counts and sizes.
    pub report: IngestReport,
    /// What became of the records, a source each.
    pub reads: Vec<ReadReport>,
    /// What a sample of points says of the normals of the file, where there are any: they are
    /// taken as they are, but where they contradict the points a warning says so.
    pub normals: Option<NormalQuality>,
}

/// Streams scan files into a sorted octree.
///
/// # Errors
/// Where an input cannot be read or is broken, the output exists, the disk fails or is too small,
/// or the run is asked to stop; nothing is left behind then.
pub fn ingest(
    request: &IngestRequest,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<Ingested, Error> {
    limits.run(|| run(request, limits, watch))?
}

fn run(request: &IngestRequest, limits: &Limits, watch: &dyn Watch) -> Result<Ingested, Error> {
    let sources = open_all(request, watch)?;
    let bounds: Vec<Option<StoredBounds>> =
        sources.iter().map(known_bounds).collect::<Result<_, _>>()?;
    let plans: Vec<SourcePlan> =
        sources.iter().zip(&bounds).map(|(s, b)| plan(s, b.as_ref())).collect();
    let mut samples = Vec::new();
    for source in &sources {
        samples.extend(source.sample(SAMPLE_POINTS)?);
    }
    let options = IngestOptions {
        output: request.output.clone(),
        overwrite: request.overwrite,
        memory_bytes: limits.memory_bytes,
        normals: request.normals,
        orientation: request.orientation.clone(),
    };
    let job = Ingest::new(options, plans, &samples, watch)?;
    drop(samples);
    let reads = read_all(&sources, &job, watch)?;
    check_normals(request, &reads, &sources)?;
    report_oddities(&sources, &reads, watch);
    let account = |(source, read): (&Source, &ReadReport)| Account {
        n_read: read.n_read,
        n_invalid: read.n_dropped,
        n_missing: source.info().n_missing + read.n_missing,
        n_beyond: source.info().n_beyond,
    };
    if let Some((source, n)) = nothing_left(&sources, &reads) {
        let path = source.info().path.display();
        return Err(Error::Data(format!(
            "{path}: declares {n} points, of what is left of it none can be read; copy it again"
        )));
    }
    let accounts: Vec<Account> = sources.iter().zip(&reads).map(account).collect();
    let report = job.finish(&accounts)?;
    if report.summary.n_normals_estimated == 0 && request.orientation != Orientation::Unknown {
        watch.warn("--sensor and --up had no effect: no normal was estimated");
    }
    let normals = if report.summary.n_normals_file > 0 { look(request, watch)? } else { None };
    Ok(Ingested { report, reads, normals })
}

/// Compares normals of the file with the points around them, at a sample.
fn look(request: &IngestRequest, watch: &dyn Watch) -> Result<Option<NormalQuality>, Error> {
    let path = &request.output;
    let mapped = open_octree(path)?;
    let octree = OctreeView::open(&mapped).map_err(|e| Error::artifact(path, e))?;
    // The octree is there: a wish to stop comes too late.
    let quality = measure(&octree, QUALITY_POINTS, &|_| true);
    let quality = quality.map_err(|e| Error::of_octree(path, e))?;
    if let Some(warning) = contradiction(path, &quality) {
        watch.warn(&warning);
    }
    Ok(quality.normals.median_deg.map(|_| quality.normals))
}

/// Finds a source that declares points, and their number, where a lenient ingest got none at all.
fn nothing_left<'a>(sources: &'a [Source], reads: &[ReadReport]) -> Option<(&'a Source, u64)> {
    if reads.iter().any(|r| r.n_read + r.n_dropped > 0) {
        return None;
    }
    let missing = |(s, r): (&'a Source, &ReadReport)| (s, s.info().n_missing + r.n_missing);
    sources.iter().zip(reads).map(missing).find(|&(_, n)| n > 0)
}

/// Opens all inputs, warning of what their headers say twice or wrongly.
fn open_all(request: &IngestRequest, watch: &dyn Watch) -> Result<Vec<Source>, Error> {
    let mut seen = HashMap::new();
    let mut sources = Vec::with_capacity(request.inputs.len());
    for (path, index) in request.inputs.iter().zip(0u32..) {
        let identity = InputFile::open(path)?.identity();
        if let Some(first) = seen.insert(identity.inode, path) {
            watch.warn(&format!(
                "{} is {} again; its points are taken twice",
                path.display(),
                first.display()
            ));
        }
        let source = Source::open(path, index, request.read)?;
        for warning in &source.info().warnings {
            watch.warn(&format!("{}: {warning}", path.display()));
        }
        sources.push(source);
    }
    warn_of_systems(&sources, watch);
    Ok(sources)
}

/// Tells where scans name other coordinate reference systems: one alone can be kept. [F-7]
fn warn_of_systems(sources: &[Source], watch: &dyn Watch) {
    let mut named = sources.iter().filter(|s| s.info().crs.is_some());
    let Some(first) = named.next().map(Source::info) else { return };
    for other in named.map(Source::info).filter(|other| other.crs != first.crs) {
        watch.warn(&format!(
            "{}: its coordinate reference system is not that of {}, or in other words; that one is \
             kept, and coordinates are taken as they are",
            other.path.display(),
            first.path.display()
        ));
    }
}

/// Gives the bounds of a source as far as they are known before it is decoded.
fn known_bounds(source: &Source) -> Result<Option<StoredBounds>, Error> {
    let info = source.info();
    if let Some((min, max)) = info.bounds {
        let real = |v: [i64; 3]| v.map(|x| x as f64);
        return Ok(Some(StoredBounds { min: real(min), max: real(max) }));
    }
    // A LAS header without usable bounds is not read twice: its records are packed again. A PLY
    // has none, but its coordinates are cheap to scan; text, which is not, comes as one part.
    let parts = source.parts(rayon::current_num_threads() as u64);
    if matches!(info.kind, PositionKind::Lattice { .. }) || parts.len() < 2 {
        return Ok(None);
    }
    let each = parts.into_par_iter().map(|part| source.bounds_scan(part));
    let joined = each.try_reduce(|| StoredBounds::EMPTY, |a, b| Ok(a.join(&b)))?;
    Ok((joined.min[0] <= joined.max[0]).then_some(joined))
}

/// Says of a source what the sort must know.
fn plan(source: &Source, bounds: Option<&StoredBounds>) -> SourcePlan {
    let info = source.info();
    let format = match &info.format {
        f if f.starts_with("LAS") => 1,
        f if f.starts_with("LAZ") => 2,
        _ => 3,
    };
    let world = bounds.map(|b| (b.min, b.max));
    let lattice = bounds.map(|b| (b.min.map(|v| v as i64), b.max.map(|v| v as i64)));
    let name = info.path.file_name().unwrap_or_default();
    SourcePlan {
        name: name.as_encoded_bytes().to_vec(),
        format,
        positions: match info.kind {
            PositionKind::Lattice { scale, offset } => {
                PositionPlan::Lattice { scale, offset, bounds: lattice }
            }
            PositionKind::Single => PositionPlan::Single(world),
            PositionKind::Double => PositionPlan::Double(world),
        },
        n_declared: info.n_points,
        color: match info.columns.color {
            None => ColorPlan::Absent,
            Some(ColorRange::Eight) => ColorPlan::Eight,
            Some(ColorRange::Sixteen) => ColorPlan::Sixteen,
            Some(ColorRange::Either) => ColorPlan::Either,
        },
        intensity: info.columns.intensity.map(|kind| match kind {
            IntensityKind::U16 => ColumnType::U16,
            IntensityKind::F32 => ColumnType::F32,
        }),
        has_class: info.columns.classification,
        has_gps_time: info.columns.gps_time,
        is_gps_time_since_1980: info.is_gps_time_since_1980,
        has_normal: info.columns.normal,
        crs: info.crs.as_ref().map(|crs| match crs {
            Crs::Wkt(text) => (CrsKind::Wkt, text.clone()),
            Crs::GeoTiff { keys, doubles, texts } => {
                (CrsKind::GeoTiff, [keys.as_slice(), doubles, texts].concat())
            }
        }),
    }
}

/// Either side of the join can fail while a part is read.
enum Failure {
    Scan(ScanError),
    Octree(OctreeError),
}

impl From<ScanError> for Failure {
    fn from(e: ScanError) -> Failure {
        Failure::Scan(e)
    }
}

impl From<Failure> for Error {
    fn from(e: Failure) -> Error {
        match e {
            Failure::Scan(e) => e.into(),
            Failure::Octree(e) => e.into(),
        }
    }
}

/// Reads all parts of all sources on all threads.
fn read_all(
    sources: &[Source],
    job: &Ingest<'_>,
    watch: &dyn Watch,
) -> Result<Vec<ReadReport>, Error> {
    let total = sources.iter().map(|s| s.info().n_points).sum();
    watch.stage("read", Some(total), "points");
    let n_parts = rayon::current_num_threads() as u64 * PARTS_A_THREAD;
    let parts: Vec<(usize, Range<u64>)> = sources
        .iter()
        .enumerate()
        .flat_map(|(i, s)| s.parts(n_parts).into_iter().map(move |part| (i, part)))
        .collect();
    let joined = Mutex::new(vec![ReadReport::default(); sources.len()]);
    Turns::run(parts.len(), |turns| {
        let mut worker = job.worker();
        while let Some(turn) = turns.take() {
            let (i, part) = &parts[turn];
            let report = sources[*i].read(part.clone(), BATCH_LEN, |batch| {
                watch.check().map_err(|e| Failure::Octree(e.into()))?;
                worker.push(&batch).map_err(Failure::Octree)?;
                watch.advance(batch.len() as u64);
                Ok::<_, Failure>(())
            })?;
            let mut joined = joined.lock().unwrap_or_else(PoisonError::into_inner);
            joined[*i] = joined[*i].join(&report);
        }
        Ok::<_, Error>(worker.finish()?)
    })?;
    Ok(joined.into_inner().unwrap_or_else(PoisonError::into_inner))
}

/// `--normals file` promises the file's normals: without any it cannot be kept.
fn check_normals(
    request: &IngestRequest,
    reads: &[ReadReport],
    sources: &[Source],
) -> Result<(), Error> {
    let has =
        |(s, r): (&Source, &ReadReport)| s.info().columns.normal && r.n_read > r.n_normals_missing;
    let any = sources.iter().zip(reads).any(has);
    let some_points = reads.iter().any(|r| r.n_read > 0);
    if request.normals == NormalsFrom::File && some_points && !any {
        return Err(Error::Data(
            "no input has normals; use --normals estimate, or leave --normals away".to_owned(),
        ));
    }
    Ok(())
}

/// Tells what does not stop an ingest but should be known.
fn report_oddities(sources: &[Source], reads: &[ReadReport], watch: &dyn Watch) {
    for (source, read) in sources.iter().zip(reads) {
        let name = source.info().path.display();
        if read.n_dropped > 0 {
            let first = read.first_dropped.unwrap_or_default();
            watch.warn(&format!(
                "{name}: dropped {} points with a coordinate that is not finite, \
                 the first is point {first}",
                read.n_dropped
            ));
        }
        if read.n_missing > 0 {
            watch.warn(&format!("{name}: {} declared points are not in the file", read.n_missing));
        }
        report_bounds(source, read, watch);
    }
    if reads.iter().all(|r| r.n_read == 0) {
        watch.warn("there are no points; the octree is empty");
    }
}

/// Tells where a header's bounds are not those of its points: the true ones are used.
fn report_bounds(source: &Source, read: &ReadReport, watch: &dyn Watch) {
    let info = source.info();
    let PositionKind::Lattice { scale, offset } = info.kind else { return };
    let Some(found) = read.true_bounds else { return };
    let name = info.path.display();
    let text = |(min, max): ([i64; 3], [i64; 3])| {
        let world = |i: usize, v: i64| twelve_digits(v as f64 * scale[i] + offset[i]);
        let axis = |i: usize| format!("{} to {}", world(i, min[i]), world(i, max[i]));
        format!("x {}, y {}, z {}", axis(0), axis(1), axis(2))
    };
    match info.bounds {
        None => watch.warn(&format!("{name}: its true bounds are {}", text(found))),
        Some(declared) if read.n_outside_bounds > 0 => watch.warn(&format!(
            "{name}: {} points lie outside the bounds of its header, {}; the true bounds are used, \
             {}",
            read.n_outside_bounds,
            text(declared),
            text(found)
        )),
        Some(_) => {}
    }
}

/// Gives a coordinate without the digits that scale times steps has beyond it.
fn twelve_digits(v: f64) -> f64 {
    // What was written in digits is a number.
    format!("{v:.11e}").parse().unwrap_or(v)
}

/// Gives the octree a single input makes when no name is given: `dir/grotto.las` → `grotto.octree`.
pub fn default_output(input: &Path) -> PathBuf {
    let stem = input.file_stem().unwrap_or(input.as_os_str());
    let stem = Path::new(stem);
    // A COPC file is named grotto.copc.laz.
    let stem = match stem.extension() {
        Some(e) if e.eq_ignore_ascii_case("copc") => stem.with_extension(""),
        _ => stem.to_path_buf(),
    };
    let mut name = stem.into_os_string();
    name.push(".octree");
    name.into()
}

/// Says whether an output would replace one of its inputs (F33).
pub fn is_input(output: &Path, inputs: &[PathBuf]) -> Result<bool, StoreError> {
    let Ok(output) = InputFile::open(output) else { return Ok(false) };
    for input in inputs.iter().filter(|i| i.is_file()) {
        if InputFile::open(input)?.identity().inode == output.identity().inode {
            return Ok(true);
        }
    }
    Ok(false)
}
