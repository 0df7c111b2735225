//! LAS and LAZ written again: the file as it is, with numbers of ours behind each point.
//!
//! Everything is copied as bytes, whatever it means. Only what must is changed: how long a record
//! is, what its extra bytes are, how points are compressed, where things begin, and the name of
//! the program that made the file. The `las` crate would know fewer of the bytes: it keeps one
//! extended record of several, and no wave packets.

use std::io::Write;
use std::ops::Range;
use std::path::PathBuf;

use ::laz::{LasZipCompressor, LazVlr};
use pvmap_geometry::Positions;
use pvmap_store::{ClosedFile, InputFile, Watch};

use super::extra::descriptors;
use super::header::{Header, RECORD_BYTES};
use super::tail::Tail;
use super::vlr::{Kind, VlrName, walk_plain};
use super::write::{BOUNDS_OFFSET, MAX_VLR_BYTES, bounds, descriptor, whole_texts};
use super::{LasFile, RawRecords, laz};
use crate::bytes::{i32_at, u32_at, u64_at};
use crate::error::ScanError;
use crate::field::{self, ScalarField};
use crate::out::{Out, lost, refused};
use crate::rewrite::RewriteOptions;
use crate::source::{SourceInfo, StoredBounds};

/// Where a header names the program that made the file, in 32 bytes.
const SOFTWARE: Range<usize> = 58..90;
/// Where it says where the wave packets begin, from LAS 1.3 on.
const WAVES_OFFSET: usize = 227;
/// Bit of the global encoding: wave packets stand in a file of their own.
const HAS_WAVE_FILE: u8 = 4;
/// Returns that a header counts: before LAS 1.4, and since.
const N_LEGACY_RETURNS: usize = 5;
const N_RETURNS: usize = 15;

/// The points of an output.
enum Points {
    Plain(Out),
    Laz(Box<LasZipCompressor<'static, Out>>),
}

/// A LAS or LAZ that is read and written again.
pub(crate) struct LasRewrite<'a> {
    las: &'a LasFile,
    info: &'a SourceInfo,
    file: &'a InputFile,
    records: RawRecords<'a>,
    points: Points,
    fields: Vec<ScalarField>,
    /// The header as it will be.
    head: Vec<u8>,
    /// Descriptors of extra bytes, where they are too many to stand before the points.
    late: Option<Vec<u8>>,
    /// The records that were read last, and what becomes of them.
    raw: Vec<u8>,
    rows: Vec<u8>,
    n_written: u64,
    n_of_return: [u64; N_RETURNS],
    bounds: StoredBounds,
    path: PathBuf,
}

impl<'a> LasRewrite<'a> {
    /// Writes all that stands before the points; what is not kept goes to `warnings`.
    pub(crate) fn begin(
        las: &'a LasFile,
        (info, file): (&'a SourceInfo, &'a InputFile),
        options: RewriteOptions<'_>,
        warnings: &mut Vec<String>,
        watch: &dyn Watch,
    ) -> Result<LasRewrite<'a>, ScanError> {
        let RewriteOptions { output, compressed, fields, software } = options;
        let path = output.path().to_path_buf();
        let fail = |problem: String| refused(&path, problem);
        let header = &las.header;
        let record_bytes = u16::try_from(las.layout.record_bytes + field::n_bytes(fields))
            .map_err(|_| fail("its records would have more than 65535 bytes".to_owned()))?;
        let mut head = vec![0; header.header_bytes as usize];
        file.read_exact_at(&mut head, 0)?;
        patch_format(&mut head, header, (record_bytes, compressed), software);
        if head[6] & HAS_WAVE_FILE != 0 {
            warnings.push("its wave packets are in a .wdp file: copy that to its name, too".into());
        }
        // It reads no formats with wave packets at all.
        let is_read = !matches!(header.point_format, 4 | 5);
        if !fields.is_empty() && header.version < (1, 4) && is_read {
            let (major, minor) = header.version;
            warnings.push(format!(
                "LAS {major}.{minor}: PDAL reads its new fields with \
                 --readers.las.use_eb_vlr=true alone"
            ));
        }
        let coded = compressed.then(|| laz::vlr_of(header.point_format, record_bytes));
        let coded = coded.transpose().map_err(fail)?;
        let extra = describe(las, fields, warnings);
        let is_late = extra.len() > MAX_VLR_BYTES;
        if is_late && header.version < (1, 4) {
            return Err(fail(format!("too many extra bytes to describe: {}", extra.len())));
        }
        let (extra, late) = if is_late { (Vec::new(), Some(extra)) } else { (extra, None) };
        watch.stage("front", Some(header.points_offset), "bytes");
        let mut front = Front { out: Out::new(output), n_vlrs: 0, watch };
        front.out.put(&head)?;
        front.copy_vlrs(las, file, (&extra, coded.as_ref()), fields, warnings)?;
        let Front { mut out, n_vlrs, .. } = front;
        let begin = u32::try_from(out.position()?);
        let begin = begin.map_err(|_| fail("too much before its points".into()))?;
        head[96..100].copy_from_slice(&begin.to_le_bytes());
        head[100..104].copy_from_slice(&n_vlrs.to_le_bytes());
        let points = match coded {
            None => Points::Plain(out),
            Some(vlr) => {
                let laz = LasZipCompressor::new(out, vlr).map_err(|e| fail(e.to_string()))?;
                Points::Laz(Box::new(laz))
            }
        };
        Ok(LasRewrite {
            las,
            info,
            file,
            records: las.raw_reader(file, info.n_points),
            points,
            fields: fields.to_vec(),
            head,
            late,
            raw: Vec::new(),
            rows: Vec::new(),
            n_written: 0,
            n_of_return: [0; N_RETURNS],
            bounds: StoredBounds::EMPTY,
            path,
        })
    }

    /// Says why reading ended before the last record, if it did.
    pub(crate) fn stopped(&self) -> Option<&str> {
        self.records.stopped()
    }

    /// Reads some of the next records, up to `n`; gives their places, none at the end.
    pub(crate) fn read(&mut self, n: u64) -> Result<Positions, ScanError> {
        self.raw.clear();
        self.raw.extend_from_slice(self.records.block(n)?);
        let rows = self.raw.chunks_exact(self.las.layout.record_bytes);
        let places = rows.map(|r| [i32_at(r, 0), i32_at(r, 4), i32_at(r, 8)]).collect();
        let places = Positions::Lattice(places);
        self.bounds = self.bounds.join(&StoredBounds::of(&places));
        Ok(places)
    }

    /// Writes the records that were read last, each with its values: a column a field.
    pub(crate) fn write(&mut self, values: &[Vec<f64>]) -> Result<(), ScanError> {
        let record_bytes = self.las.layout.record_bytes;
        let n = self.raw.len() / record_bytes;
        if let Some(problem) = field::mismatch(&self.fields, values, n) {
            return Err(refused(&self.path, problem));
        }
        self.rows.clear();
        let return_mask = if self.las.header.point_format < 6 { 0x07 } else { 0x0f };
        for (i, row) in self.raw.chunks_exact(record_bytes).enumerate() {
            self.rows.extend_from_slice(row);
            self.fields.iter().zip(values).for_each(|(f, v)| f.kind.put(v[i], &mut self.rows));
            // Returns count from 1; 0 is none of them.
            if let Some(at) = usize::from(row[14] & return_mask).checked_sub(1) {
                self.n_of_return[at] += 1;
            }
        }
        self.n_written += n as u64;
        match &mut self.points {
            Points::Plain(out) => out.write_all(&self.rows),
            Points::Laz(laz) => laz.compress_many(&self.rows),
        }
        .map_err(|e| lost(&self.path, e))
    }

    /// Writes all that stands behind the points, and the header once more.
    pub(crate) fn close(mut self, watch: &dyn Watch) -> Result<ClosedFile, ScanError> {
        let mut out = match self.points {
            Points::Plain(out) => out,
            Points::Laz(mut laz) => {
                laz.done().map_err(|e| lost(&self.path, e))?;
                laz.into_inner()
            }
        };
        let header = &self.las.header;
        let waves = if header.version >= (1, 3) { u64_at(&self.head, WAVES_OFFSET) } else { 0 };
        let ours = self.late.as_deref().map(|data| (self.las.extra_name(), data));
        let tail = Tail::of(self.las, self.info, self.file)?;
        let places = tail.write((self.file, &mut out), waves, ours, watch)?;
        if let Some(at) = places.waves {
            self.head[WAVES_OFFSET..WAVES_OFFSET + 8].copy_from_slice(&at.to_le_bytes());
        }
        if header.version >= (1, 4) {
            self.head[235..243].copy_from_slice(&places.first_evlr.to_le_bytes());
            self.head[243..247].copy_from_slice(&places.n_evlrs.to_le_bytes());
        }
        if self.n_written != header.n_points {
            patch_counts(&mut self.head, header, self.n_written, &self.n_of_return);
            let bounds = bounds(self.bounds, header.scale, header.offset);
            self.head[BOUNDS_OFFSET..BOUNDS_OFFSET + bounds.len()].copy_from_slice(&bounds);
        }
        out.close(&self.head)
    }
}

impl LasFile {
    /// Gives the bytes of the file, about, if it is written again with fields and uncompressed.
    pub(crate) fn rewritten_bytes(&self, info: &SourceInfo, fields: &[ScalarField]) -> u64 {
        let record_bytes = (self.layout.record_bytes + field::n_bytes(fields)) as u64;
        let records = info.n_points.saturating_mul(record_bytes);
        let behind = info.len_bytes.saturating_sub(self.end_of_points(info));
        records.saturating_add(self.header.points_offset + behind)
    }

    /// Gives where the points end, as far as that is known: of a LAZ where the next thing begins
    /// that the header names.
    pub(super) fn end_of_points(&self, info: &SourceInfo) -> u64 {
        let header = &self.header;
        if header.is_compressed || info.n_missing > 0 {
            return header.points_end;
        }
        // No overflow: there is room for them.
        header.points_offset + info.n_points * u64::from(header.record_bytes)
    }

    /// Gives what the record is called that describes the extra bytes.
    fn extra_name(&self) -> VlrName {
        self.extra.name.unwrap_or_else(VlrName::extra_bytes)
    }

    /// Gives the memory that decoding and coding hold while it is written again with fields.
    pub(crate) fn coder_bytes(&self, compressed: bool, fields: &[ScalarField]) -> u64 {
        let decoder_bytes = self.laz.as_ref().map_or(0, |laz| laz.decoder_bytes(&self.header));
        let n_bytes = self.layout.record_bytes + field::n_bytes(fields);
        // Where there can be no such records that is said when they are begun.
        let record_bytes = u16::try_from(n_bytes).ok().filter(|_| compressed);
        let coder_bytes = record_bytes.map(|n| laz::coder_bytes(self.header.point_format, n));
        decoder_bytes + coder_bytes.unwrap_or(0)
    }
}

/// Says in a header what the points are like and who wrote the file.
fn patch_format(
    head: &mut [u8],
    header: &Header,
    (record_bytes, is_compressed): (u16, bool),
    software: &str,
) {
    head[104] = header.point_format | if is_compressed { 0x80 } else { 0 };
    head[105..107].copy_from_slice(&record_bytes.to_le_bytes());
    head[SOFTWARE].fill(0);
    // A zero is behind it.
    let name = &software.as_bytes()[..software.len().min(SOFTWARE.len() - 1)];
    head[SOFTWARE.start..SOFTWARE.start + name.len()].copy_from_slice(name);
}

/// Counts the points anew, of a file that was cut short.
fn patch_counts(head: &mut [u8], header: &Header, n: u64, n_of_return: &[u64; N_RETURNS]) {
    // Where legacy counts are 0 there are others.
    let small = |n: u64| u32::try_from(n).unwrap_or(0).to_le_bytes();
    if u32_at(head, 107) != 0 {
        head[107..111].copy_from_slice(&small(n));
    }
    let legacy = &mut head[111..111 + 4 * N_LEGACY_RETURNS];
    if legacy.iter().any(|&b| b != 0) {
        let slots = legacy.chunks_exact_mut(4).zip(n_of_return);
        slots.for_each(|(slot, &n)| slot.copy_from_slice(&small(n)));
    }
    if header.version >= (1, 4) {
        head[247..255].copy_from_slice(&n.to_le_bytes());
        let slots = head[255..255 + 8 * N_RETURNS].chunks_exact_mut(8);
        slots.zip(n_of_return).for_each(|(slot, n)| slot.copy_from_slice(&n.to_le_bytes()));
    }
}

/// Describes the extra bytes of the file and the fields behind them.
fn describe(las: &LasFile, fields: &[ScalarField], warnings: &mut Vec<String>) -> Vec<u8> {
    let n_extra = las.header.record_bytes - RECORD_BYTES[usize::from(las.header.point_format)];
    let mut all = descriptors(&las.extra.descriptors, n_extra.into(), warnings);
    all.extend(fields.iter().flat_map(descriptor));
    all
}

/// What stands between the header and the points.
struct Front<'a> {
    out: Out,
    n_vlrs: u32,
    watch: &'a dyn Watch,
}

impl Front<'_> {
    /// Copies the plain records and the bytes behind them; those that say what points are like are
    /// replaced where they stand, or put behind the others.
    fn copy_vlrs(
        &mut self,
        las: &LasFile,
        file: &InputFile,
        (extra, laz): (&[u8], Option<&LazVlr>),
        fields: &[ScalarField],
        warnings: &mut Vec<String>,
    ) -> Result<(), ScanError> {
        let header = &las.header;
        let (mut extra, mut laz) = ((!extra.is_empty()).then_some(extra), laz);
        let end = walk_plain(file, header, |vlr| match vlr.name.kind() {
            Kind::ExtraBytes => extra.take().map_or(Ok(()), |e| self.put(&vlr.name, e)),
            Kind::Laszip => laz.take().map_or(Ok(()), |laz| self.put_laz(&vlr.name, laz)),
            Kind::Copc => {
                let what = "it is no COPC any more: the index of its points is left out";
                warnings.push(what.to_owned());
                Ok(())
            }
            _ => {
                self.n_vlrs += 1;
                self.out.copy(file, vlr.at..vlr.end(), self.watch)
            }
        })?;
        extra.map_or(Ok(()), |extra| self.put(&las.extra_name(), extra))?;
        if let Some(text) = whole_texts(fields) {
            let name = VlrName::new(&text.user_id, text.record_id, &text.description);
            self.put(&name, &text.data)?;
        }
        laz.map_or(Ok(()), |laz| self.put_laz(&VlrName::laszip(), laz))?;
        self.out.copy(file, end..header.points_offset, self.watch)
    }

    fn put_laz(&mut self, name: &VlrName, laz: &LazVlr) -> Result<(), ScanError> {
        let mut data = Vec::new();
        laz.write_to(&mut data).map_err(|e| lost(self.out.path(), e))?;
        self.put(name, &data)
    }

    /// Writes a record of our own.
    fn put(&mut self, name: &VlrName, data: &[u8]) -> Result<(), ScanError> {
        let n_bytes = u16::try_from(data.len()).map_err(|_| {
            refused(self.out.path(), format!("a record of {} bytes has no room", data.len()))
        })?;
        self.n_vlrs += 1;
        self.out.put(&name.plain(n_bytes))?;
        self.out.put(data)
    }
}
