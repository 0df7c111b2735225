//! One scan file, opened and checked: what it holds, where to cut it, its points in batches.

use std::ops::Range;
use std::path::{Path, PathBuf};

use pvmap_geometry::{PointBatch, Positions};
use pvmap_store::InputFile;
use pvmap_store::input::Identity;
use rayon::prelude::*;

use crate::error::{ScanError, escaped};
use crate::field::ScalarField;
use crate::las::LasFile;
use crate::ply::PlyFile;

/// How to treat a file that is not quite right.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReadOptions {
    /// Drop and count points with a coordinate that is not finite, instead of refusing the file.
    pub skip_invalid: bool,
    /// Read the part of a cut file that is there, instead of refusing it (F52, F59).
    pub lenient: bool,
}

/// How a source stores its coordinates; the same word as [`Positions`] in its batches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PositionKind {
    /// LAS: world = X · scale + offset.
    Lattice {
        /// World units per lattice step, finite and > 0.
        scale: [f64; 3],
        /// World coordinate of lattice step 0, finite.
        offset: [f64; 3],
    },
    /// PLY with three `float` coordinates.
    Single,
    /// PLY with any other coordinates.
    Double,
}

/// What full brightness is in a colour column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorRange {
    /// 0…255.
    Eight,
    /// 0…65535.
    Sixteen,
    /// 16-bit fields that some programs fill with 0…255: [`ReadReport::color_max`] tells.
    Either,
}

/// How a source stores its intensity; the same word as [`pvmap_geometry::Intensity`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IntensityKind {
    /// Whole numbers up to 16 bits.
    U16,
    /// Anything else.
    F32,
}

/// Which columns the batches of a source have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Columns {
    /// Red, green, blue.
    pub color: Option<ColorRange>,
    /// Return strength.
    pub intensity: Option<IntensityKind>,
    /// ASPRS class.
    pub classification: bool,
    /// GPS time.
    pub gps_time: bool,
    /// Normals (single points may still lack one).
    pub normal: bool,
}

/// Where on earth, in the file's own bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Crs {
    /// OGC well-known text.
    Wkt(Vec<u8>),
    /// The three GeoTIFF records; the last two may be empty.
    GeoTiff {
        /// Record 34735: the key directory.
        keys: Vec<u8>,
        /// Record 34736: its doubles.
        doubles: Vec<u8>,
        /// Record 34737: its texts.
        texts: Vec<u8>,
    },
}

impl Crs {
    /// Takes GeoTIFF records apart that stand one behind another: keys, doubles, texts. None where
    /// the keys are not all there or name doubles that are not.
    pub fn of_geotiff(bytes: &[u8]) -> Option<Crs> {
        let word = |at: usize| Some(u16::from_le_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]));
        // A row of four u16 says how many keys follow: rows of key, where its value is (34736 is
        // the doubles), how many values and from which on.
        let keys_end = 8 * (usize::from(word(6)?) + 1);
        let mut n_doubles = 0;
        for row in (8..keys_end).step_by(8) {
            if word(row + 2)? == 34736 {
                n_doubles =
                    n_doubles.max(usize::from(word(row + 4)?) + usize::from(word(row + 6)?));
            }
        }
        let (keys, rest) = bytes.split_at_checked(keys_end)?;
        let (doubles, texts) = rest.split_at_checked(8 * n_doubles)?;
        Some(Crs::GeoTiff { keys: keys.into(), doubles: doubles.into(), texts: texts.into() })
    }

    /// Says whether coordinates are degrees of longitude and latitude.
    pub fn is_geographic(&self) -> bool {
        match self {
            Crs::Wkt(text) => {
                let text = text.trim_ascii_start();
                [&b"GEOGCS"[..], b"GEOGCRS", b"GEODCRS"].iter().any(|w| text.starts_with(w))
            }
            // A directory is rows of four u16; key 1024 (the model) is 2 for geographic.
            Crs::GeoTiff { keys, .. } => keys.chunks_exact(8).skip(1).any(|row| {
                let word = |i: usize| u16::from_le_bytes([row[2 * i], row[2 * i + 1]]);
                word(0) == 1024 && word(1) == 0 && word(3) == 2
            }),
        }
    }
}

/// What a scan file holds, known from its header alone.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceInfo {
    /// The name it was opened by.
    pub path: PathBuf,
    /// Format and version in words, such as "LAZ 1.4, point format 7".
    pub format: String,
    /// Records in the file: what reading all of it gives or accounts for.
    pub n_points: u64,
    /// Records that the header declares and the file cannot hold; only in a lenient read.
    pub n_missing: u64,
    /// Records that the file holds beyond the header's count; they are not read.
    pub n_beyond: u64,
    /// Bytes of the file.
    pub len_bytes: u64,
    /// How coordinates are stored.
    pub kind: PositionKind,
    /// The header's bounds in lattice steps, rounded; only for `Lattice`, and none where the
    /// header's are inverted or not finite. A hint: nobody may rely on them ([D-1], F60).
    pub bounds: Option<([i64; 3], [i64; 3])>,
    /// What the batches hold.
    pub columns: Columns,
    /// The coordinate reference system, if the file names one.
    pub crs: Option<Crs>,
    /// Whether GPS times are seconds since 1980, less 1e9, instead of a week's; none where the
    /// file has none or does not say.
    pub is_gps_time_since_1980: Option<bool>,
    /// What the user should know, a line each.
    pub warnings: Vec<String>,
}

/// Bounds of stored coordinates, both ends included: lattice steps or world units, as the source
/// stores them (a lattice step is exact in f64).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StoredBounds {
    /// The least coordinate along each axis.
    pub min: [f64; 3],
    /// The greatest coordinate along each axis.
    pub max: [f64; 3],
}

impl StoredBounds {
    /// The bounds of nothing.
    pub const EMPTY: StoredBounds =
        StoredBounds { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };

    /// Gives the bounds of both.
    pub fn join(&self, other: &StoredBounds) -> StoredBounds {
        StoredBounds {
            min: [0, 1, 2].map(|i| self.min[i].min(other.min[i])),
            max: [0, 1, 2].map(|i| self.max[i].max(other.max[i])),
        }
    }

    /// Gives the bounds of a batch's coordinates.
    pub(crate) fn of(positions: &Positions) -> StoredBounds {
        let bounds = positions.bounds().map(|(min, max)| StoredBounds { min, max });
        bounds.unwrap_or(StoredBounds::EMPTY)
    }
}

/// What became of the records of one part: `n_read + n_dropped + n_missing` is their number.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReadReport {
    /// Points handed over.
    pub n_read: u64,
    /// Points dropped because a coordinate is not finite.
    pub n_dropped: u64,
    /// The first record dropped.
    pub first_dropped: Option<u64>,
    /// Records that a lenient read could not find in a cut file.
    pub n_missing: u64,
    /// Points outside the header's bounds, where there are any ([`SourceInfo::bounds`]).
    pub n_outside_bounds: u64,
    /// True bounds of the points of a LAS, lattice steps, both ends included.
    pub true_bounds: Option<([i64; 3], [i64; 3])>,
    /// Points whose normal is zero or not finite, in a file with normals.
    pub n_normals_missing: u64,
    /// The largest red, green or blue.
    pub color_max: u16,
}

impl ReadReport {
    /// Sums up two parts.
    pub fn join(&self, other: &ReadReport) -> ReadReport {
        ReadReport {
            n_read: self.n_read + other.n_read,
            n_dropped: self.n_dropped + other.n_dropped,
            first_dropped: [self.first_dropped, other.first_dropped].into_iter().flatten().min(),
            n_missing: self.n_missing + other.n_missing,
            n_outside_bounds: self.n_outside_bounds + other.n_outside_bounds,
            true_bounds: match (self.true_bounds, other.true_bounds) {
                (Some(a), Some(b)) => Some((
                    [0, 1, 2].map(|i| a.0[i].min(b.0[i])),
                    [0, 1, 2].map(|i| a.1[i].max(b.1[i])),
                )),
                (a, b) => a.or(b),
            },
            n_normals_missing: self.n_normals_missing + other.n_normals_missing,
            color_max: self.color_max.max(other.color_max),
        }
    }
}

/// A reader over one range of records, in order.
pub(crate) trait PartReader {
    /// Decodes up to `n` more records, or gives `None` where the range (or, leniently, the file)
    /// ends. The batch may be empty if all of its records were dropped.
    fn next(&mut self, n: usize) -> Result<Option<PointBatch>, ScanError>;

    /// Gives how many records were dropped so far, and the first of them.
    fn dropped(&self) -> (u64, Option<u64>) {
        (0, None)
    }
}

/// One scan file, opened and checked. Several threads may read different parts at once: each
/// read opens the file anew.
#[derive(Debug)]
pub struct Source {
    index: u32,
    identity: Identity,
    options: ReadOptions,
    info: SourceInfo,
    content: Content,
}

/// What a source is of.
#[derive(Debug)]
pub(crate) enum Content {
    Las(LasFile),
    Ply(PlyFile),
}

impl Source {
    /// Opens a scan file and checks its header against its length.
    ///
    /// `index` is the number of the source within its ingest; batches carry it.
    ///
    /// # Errors
    /// Where the file cannot be opened, is no LAS, LAZ or PLY, or its header is broken.
    pub fn open(path: &Path, index: u32, options: ReadOptions) -> Result<Source, ScanError> {
        let file = InputFile::open(path)?;
        let mut start = vec![0; file.len_bytes().min(512) as usize];
        file.read_exact_at(&mut start, 0)?;
        let (content, info) = if start.starts_with(b"LASF") {
            let (las, info) = blame_disk(&file, LasFile::open(&file, options))?;
            (Content::Las(las), info)
        } else if is_ply(&start) {
            let (ply, info) = blame_disk(&file, PlyFile::open(&file, options))?;
            (Content::Ply(ply), info)
        } else {
            return Err(foreign(path, &start));
        };
        Ok(Source { index, identity: file.identity(), options, info, content })
    }

    /// Gives what the file holds.
    pub fn info(&self) -> &SourceInfo {
        &self.info
    }

    /// Gives the names of what records have beside the fields of their point format, or of the
    /// properties of vertices.
    pub fn names(&self) -> Vec<String> {
        match &self.content {
            Content::Las(las) => las.names(),
            Content::Ply(ply) => ply.names(),
        }
    }

    /// Gives the bytes of the file, about, if it is written again with fields and uncompressed.
    pub fn rewritten_bytes(&self, fields: &[ScalarField]) -> u64 {
        match &self.content {
            Content::Las(las) => las.rewritten_bytes(&self.info, fields),
            Content::Ply(ply) => ply.rewritten_bytes(&self.info, fields),
        }
    }

    /// Gives the memory that a [`crate::Rewrite`] with fields holds beside a few blocks: that of
    /// decoding a LAZ and, where `compressed`, of coding one, which is much where records are wide.
    pub fn coder_bytes(&self, compressed: bool, fields: &[ScalarField]) -> u64 {
        match &self.content {
            Content::Las(las) => las.coder_bytes(compressed, fields),
            Content::Ply(_) => 0,
        }
    }

    pub(crate) fn content(&self) -> &Content {
        &self.content
    }

    /// Cuts the records into up to `n` ranges that are decoded independently at no extra cost.
    ///
    /// LAS and binary PLY of fixed stride: equal ranges. LAZ: whole chunks. ASCII, and vertices
    /// with lists: one range. A file without points gives none.
    pub fn parts(&self, n: u64) -> Vec<Range<u64>> {
        let total = self.info.n_points;
        let even = (1..n).map(|i| (u128::from(total) * u128::from(i) / u128::from(n)) as u64);
        let mut cuts: Vec<u64> = match &self.content {
            Content::Las(las) => even.map(|record| las.cut_near(record)).collect(),
            Content::Ply(ply) if ply.is_seekable() => even.collect(),
            Content::Ply(_) => Vec::new(),
        };
        cuts.insert(0, 0);
        cuts.push(total);
        cuts.dedup();
        cuts.windows(2).map(|w| w[0]..w[1]).collect()
    }

    /// Reads a range of records, in order, in batches of up to `batch_len` points.
    ///
    /// Any range within the file may be asked for; those of [`Source::parts`] waste nothing. An
    /// error of `sink` ends the read and is passed on.
    ///
    /// # Errors
    /// Where a record cannot be decoded, a coordinate is not finite (unless `skip_invalid`), or
    /// the file changed since it was opened.
    pub fn read<E: From<ScanError>>(
        &self,
        part: Range<u64>,
        batch_len: usize,
        mut sink: impl FnMut(PointBatch) -> Result<(), E>,
    ) -> Result<ReadReport, E> {
        let part = part.start.min(self.info.n_points)..part.end.min(self.info.n_points);
        let file = self.reopen()?;
        let mut report = ReadReport::default();
        let mut reader = self.settle(&file, self.reader(&file, part.clone()))?;
        while let Some(batch) = self.settle(&file, reader.next(batch_len.max(1)))? {
            self.account(&batch, &mut report);
            if !batch.is_empty() {
                sink(batch)?;
            }
        }
        (report.n_dropped, report.first_dropped) = reader.dropped();
        let n_wanted = part.end.saturating_sub(part.start);
        report.n_missing = n_wanted - report.n_read - report.n_dropped;
        self.check_unchanged(&file)?;
        if report.n_missing > 0 && !self.options.lenient {
            let (path, declared) = (self.info.path.clone(), self.info.n_points);
            let present = declared - report.n_missing;
            return Err(E::from(ScanError::Short { path, declared, present }));
        }
        Ok(report)
    }

    /// Reads some `n_points` points from all over the file, for guessing how they lie: a few at
    /// every place where decoding is free, most places where that costs next to nothing. Points
    /// that follow each other lie side by side, so many places tell more than many points.
    ///
    /// # Errors
    /// As [`Source::read`].
    pub fn sample(&self, n_points: u64) -> Result<Vec<PointBatch>, ScanError> {
        let n_places = match &self.content {
            // A chunk of a LAZ is read whole, however few of its points are wanted.
            Content::Las(las) if las.is_compressed() => n_points / 128,
            _ => n_points / 8,
        };
        let parts = self.parts(n_places.max(1));
        if parts.len() < 2 && self.info.n_points > n_points {
            // One long part: reading its start says nothing of the rest.
            return Ok(Vec::new());
        }
        let file = self.reopen()?;
        let n_each = n_points / (parts.len() as u64).max(1);
        let read = |part: Range<u64>| {
            let some = part.start..part.end.min(part.start + n_each);
            let mut reader = self.settle(&file, self.reader(&file, some))?;
            self.settle(&file, reader.next(n_each as usize))
        };
        let batches: Result<Vec<_>, _> = parts.into_par_iter().map(read).collect();
        Ok(batches?.into_iter().flatten().collect())
    }

    /// Finds the exact bounds of a range of records, decoding only their coordinates where the
    /// format allows it (binary PLY of fixed stride, whose header has no bounds).
    ///
    /// # Errors
    /// As [`Source::read`].
    pub fn bounds_scan(&self, part: Range<u64>) -> Result<StoredBounds, ScanError> {
        if let Content::Ply(ply) = &self.content {
            let file = self.reopen()?;
            let reader = self.settle(&file, ply.reader(&file, self.index, part, self.options))?;
            let bounds = self.settle(&file, reader.bounds())?;
            self.check_unchanged(&file)?;
            return Ok(bounds);
        }
        let mut bounds = StoredBounds::EMPTY;
        self.read(part, BOUNDS_BATCH, |batch| {
            bounds = bounds.join(&StoredBounds::of(&batch.positions));
            Ok::<(), ScanError>(())
        })?;
        Ok(bounds)
    }

    fn reader<'a>(
        &'a self,
        file: &'a InputFile,
        part: Range<u64>,
    ) -> Result<Box<dyn PartReader + 'a>, ScanError> {
        match &self.content {
            Content::Las(las) => Ok(las.reader(file, self.index, part)),
            Content::Ply(ply) => Ok(Box::new(ply.reader(file, self.index, part, self.options)?)),
        }
    }

    /// Opens the file again and makes sure that it is still the one that was checked.
    ///
    /// # Errors
    /// Where it is not there any more, or another.
    pub fn reopen(&self) -> Result<InputFile, ScanError> {
        let file = InputFile::open(&self.info.path)?;
        if file.identity() != self.identity {
            return Err(ScanError::Changed { path: self.info.path.clone() });
        }
        Ok(file)
    }

    /// Blames a failure on whoever changed the file, where somebody did, or on the disk.
    pub(crate) fn settle<T>(
        &self,
        file: &InputFile,
        result: Result<T, ScanError>,
    ) -> Result<T, ScanError> {
        if result.is_err() {
            self.check_unchanged(file)?;
        }
        blame_disk(file, result)
    }

    pub(crate) fn check_unchanged(&self, file: &InputFile) -> Result<(), ScanError> {
        if file.is_unchanged() {
            Ok(())
        } else {
            Err(ScanError::Changed { path: self.info.path.clone() })
        }
    }

    /// Adds a batch to the sums that ingest prints and checks ([D-4]).
    fn account(&self, batch: &PointBatch, report: &mut ReadReport) {
        report.n_read += batch.len() as u64;
        if let Some(colors) = &batch.color {
            let max = colors.as_flattened().iter().fold(0, |max, &c| c.max(max));
            report.color_max = report.color_max.max(max);
        }
        if let Some(normals) = &batch.normal {
            let is_missing = |n: &&[f32; 3]| !pvmap_geometry::normal::is_direction(**n);
            report.n_normals_missing += normals.iter().filter(is_missing).count() as u64;
        }
        let Positions::Lattice(places) = &batch.positions else { return };
        let all = batch.positions.bounds();
        // Steps are whole numbers that a float holds.
        let true_bounds = all.map(|(min, max)| (min.map(|v| v as i64), max.map(|v| v as i64)));
        *report = report.join(&ReadReport { true_bounds, ..ReadReport::default() });
        if let Some((min, max)) = self.info.bounds {
            // Bounds outside i32 hold nothing back on that side.
            let fit = |v: i64| v.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32;
            let (min, max) = (min.map(fit), max.map(fit));
            let is_within = |(low, high): ([f64; 3], [f64; 3])| {
                (0..3).all(|i| low[i] >= f64::from(min[i]) && high[i] <= f64::from(max[i]))
            };
            if all.is_none_or(is_within) {
                return;
            }
            let is_outside =
                |p: &&[i32; 3]| (0..3).fold(false, |o, i| o | (p[i] < min[i]) | (p[i] > max[i]));
            report.n_outside_bounds += places.iter().filter(is_outside).count() as u64;
        }
    }
}

/// Points decoded at a time where only their bounds are wanted.
const BOUNDS_BATCH: usize = 1 << 14;

/// Puts the disk in the place of what a decoder made of its failure, where it failed.
fn blame_disk<T>(file: &InputFile, result: Result<T, ScanError>) -> Result<T, ScanError> {
    match file.failure() {
        Some(failure) if result.is_err() => Err(failure.into()),
        _ => result,
    }
}

/// Says whether a file begins like a PLY: the word alone on its line.
fn is_ply(start: &[u8]) -> bool {
    start.starts_with(b"ply") && start.get(3).is_none_or(|b| b.is_ascii_whitespace())
}

/// Names what a file is instead of a scan.
fn foreign(path: &Path, start: &[u8]) -> ScanError {
    let text = start.trim_ascii_start().to_ascii_lowercase();
    let advice = "give a LAS, LAZ or PLY file";
    let (found, advice) = if start.is_empty() {
        ("the file is empty".to_owned(), "copy it again")
    } else if start.starts_with(b"ASTM-E57") {
        ("an E57 file".to_owned(), "E57 is not read yet: convert it to LAS, LAZ or PLY")
    } else if start.starts_with(b"version https://git-lfs") {
        let found = "a git-lfs pointer instead of the data it stands for".to_owned();
        (found, "run `git lfs pull` and try again")
    } else if text.starts_with(b"<!doctype") || text.starts_with(b"<html") {
        ("a web page (HTML), not a scan".to_owned(), "the download failed: fetch it again")
    } else if start.starts_with(&[0x1f, 0x8b]) {
        ("a gzip file".to_owned(), "unpack it with gunzip")
    } else if start.starts_with(b"PK\x03\x04") {
        ("a zip archive".to_owned(), "unpack it with unzip")
    } else {
        (format!("not a LAS, LAZ or PLY file (it begins with \"{}\")", escaped(start, 8)), advice)
    };
    ScanError::Unsupported { path: path.to_path_buf(), found, advice }
}
