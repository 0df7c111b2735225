//! LAS and LAZ: one header, two ways to store the records.

mod extra;
pub(crate) mod header;
pub(crate) mod laz;
pub(crate) mod records;
pub(crate) mod rewrite;
mod tail;
mod vlr;
pub(crate) mod write;

use std::ops::Range;

use pvmap_geometry::PointBatch;
use pvmap_store::InputFile;

use crate::bytes::BLOCK_BYTES;
use crate::error::ScanError;
use crate::source::{
    ColorRange, Columns, IntensityKind, PartReader, PositionKind, ReadOptions, SourceInfo,
};
use extra::Described;
use header::Header;
use laz::{Laz, LazReader};
use records::RecordLayout;
use vlr::Records;

/// The most bytes that an empty LAZ has for points: a pointer and a chunk table of nothing.
const EMPTY_LAZ_BYTES: u64 = 64;

/// A checked LAS or LAZ file.
#[derive(Debug)]
pub(crate) struct LasFile {
    header: Header,
    layout: RecordLayout,
    laz: Option<Laz>,
    extra: Described,
    options: ReadOptions,
}

impl LasFile {
    /// Reads and checks everything but the points.
    pub(crate) fn open(
        file: &InputFile,
        options: ReadOptions,
    ) -> Result<(LasFile, SourceInfo), ScanError> {
        let mut warnings = Vec::new();
        let header = Header::read(file, &mut warnings)?;
        let records = Records::read(file, &header, options.lenient, &mut warnings)?;
        let layout = RecordLayout::of(&header, &records.extra.descriptors, &mut warnings);
        let laz = match (header.is_compressed, header.n_points) {
            (true, 1..) => {
                let vlr = records.laszip.as_deref();
                Some(Laz::open(file, &header, vlr, options.lenient)?)
            }
            _ => None,
        };
        let n_present = laz
            .as_ref()
            .map_or_else(|| header.n_records_fit()..=header.n_records_fit(), Laz::n_points);
        let n_sure = if header.is_compressed && laz.is_none() { 0 } else { *n_present.start() };
        let n_points = reconcile(file, &header, n_present, options.lenient, &mut warnings)?;
        let (extra, crs) = records.into_extra_and_crs();
        if crs.as_ref().is_some_and(|c| c.is_geographic()) {
            warnings.push(
                "coordinates are degrees: distances along z are on another scale; reproject first"
                    .to_owned(),
            );
        }
        let (name, (major, minor)) =
            (if header.is_compressed { "LAZ" } else { "LAS" }, header.version);
        let info = SourceInfo {
            path: file.path().to_path_buf(),
            format: format!("{name} {major}.{minor}, point format {}", header.point_format),
            n_points,
            n_missing: header.n_points.saturating_sub(n_points),
            n_beyond: n_sure.saturating_sub(n_points),
            len_bytes: file.len_bytes(),
            kind: PositionKind::Lattice { scale: header.scale, offset: header.offset },
            bounds: header.bounds,
            columns: Columns {
                color: layout.has_color().then_some(ColorRange::Either),
                intensity: Some(IntensityKind::U16),
                classification: true,
                gps_time: layout.has_gps_time(),
                normal: layout.has_normal(),
            },
            crs,
            is_gps_time_since_1980: layout.has_gps_time().then_some(header.is_gps_time_since_1980),
            warnings,
        };
        Ok((LasFile { header, layout, laz, extra, options }, info))
    }

    /// Says whether the records are stored in chunks that are decoded from their start.
    pub(crate) fn is_compressed(&self) -> bool {
        self.laz.is_some()
    }

    /// Gives the record nearest to `record` at which decoding can start for free.
    pub(crate) fn cut_near(&self, record: u64) -> u64 {
        self.laz.as_ref().map_or(record, |laz| laz.cut_near(record))
    }

    /// Reads a range of records of the file this was made from.
    pub(crate) fn reader<'a>(
        &'a self,
        file: &'a InputFile,
        source: u32,
        part: Range<u64>,
    ) -> Box<dyn PartReader + 'a> {
        match self.records(file, source, part) {
            RawRecords::Plain(reader) => Box::new(reader),
            RawRecords::Laz(reader) => Box::new(reader),
        }
    }

    /// Reads all of the first `n_points` records as they are.
    pub(crate) fn raw_reader<'a>(&'a self, file: &'a InputFile, n_points: u64) -> RawRecords<'a> {
        self.records(file, 0, 0..n_points)
    }

    /// Gives the names of its extra bytes.
    pub(crate) fn names(&self) -> Vec<String> {
        extra::names(&self.extra.descriptors)
    }

    fn records<'a>(&'a self, file: &'a InputFile, source: u32, left: Range<u64>) -> RawRecords<'a> {
        match &self.laz {
            Some(laz) => {
                RawRecords::Laz(laz.reader(file, &self.layout, source, left, self.options))
            }
            None => {
                RawRecords::Plain(PlainReader { las: self, file, source, left, raw: Vec::new() })
            }
        }
    }
}

/// Compares the header's count with what is there (F52, F53).
fn reconcile(
    file: &InputFile,
    header: &Header,
    n_present: std::ops::RangeInclusive<u64>,
    is_lenient: bool,
    warnings: &mut Vec<String>,
) -> Result<u64, ScanError> {
    let (declared, least, most) = (header.n_points, *n_present.start(), *n_present.end());
    if header.is_compressed && declared == 0 {
        let n_bytes = header.points_end - header.points_offset;
        if n_bytes > EMPTY_LAZ_BYTES {
            warnings.push(format!("declares 0 points but holds {n_bytes} compressed bytes"));
        }
        return Ok(0);
    }
    if declared > most {
        if !is_lenient {
            let path = file.path().to_path_buf();
            return Err(ScanError::Short { path, declared, present: most });
        }
        warnings.push(format!("declares {declared} points but holds {most}: reading those"));
        return Ok(most);
    }
    if declared < least {
        warnings.push(format!(
            "declares {declared} points but holds {least}: the last {} are not read",
            least - declared
        ));
    }
    Ok(declared)
}

/// Records as the file has them, without its compression.
pub(crate) enum RawRecords<'a> {
    Plain(PlainReader<'a>),
    Laz(LazReader<'a>),
}

impl RawRecords<'_> {
    /// Gives some of the next records, up to `n` of them; none at the end.
    pub(crate) fn block(&mut self, n: u64) -> Result<&[u8], ScanError> {
        let left = match self {
            RawRecords::Plain(reader) => reader.left.clone(),
            RawRecords::Laz(reader) => reader.left(),
        };
        let limit = left.end.min(left.start.saturating_add(n));
        match self {
            _ if left.is_empty() => Ok(&[]),
            RawRecords::Plain(reader) => reader.block(limit),
            RawRecords::Laz(reader) => reader.block(limit),
        }
    }

    /// Says why reading ended before the last record, if it did.
    pub(crate) fn stopped(&self) -> Option<&str> {
        match self {
            RawRecords::Plain(_) => None,
            RawRecords::Laz(reader) => reader.stopped(),
        }
    }
}

/// Reads records that are stored as they are.
pub(crate) struct PlainReader<'a> {
    las: &'a LasFile,
    file: &'a InputFile,
    source: u32,
    left: Range<u64>,
    raw: Vec<u8>,
}

impl PartReader for PlainReader<'_> {
    fn next(&mut self, n: usize) -> Result<Option<PointBatch>, ScanError> {
        if self.left.is_empty() {
            return Ok(None);
        }
        let layout = &self.las.layout;
        let n = (n as u64).min(self.left.end - self.left.start);
        let batch_end = self.left.start + n;
        let mut batch = layout.empty_batch(self.source, n as usize);
        while self.left.start < batch_end {
            let first = self.left.start;
            let raw = self.block(batch_end)?;
            layout.append(raw, first, &mut batch);
        }
        Ok(Some(batch))
    }
}

impl PlainReader<'_> {
    /// Gives some of the next records as they are, at most up to record `limit`.
    fn block(&mut self, limit: u64) -> Result<&[u8], ScanError> {
        let record_bytes = self.las.layout.record_bytes;
        let n = ((BLOCK_BYTES / record_bytes).max(1) as u64).min(limit - self.left.start);
        self.raw.resize(n as usize * record_bytes, 0);
        let at = self.las.header.points_offset + self.left.start * record_bytes as u64;
        self.file.read_exact_at(&mut self.raw, at)?;
        self.left.start += n;
        Ok(&self.raw)
    }
}
