//! LAS and LAZ written again: the file as it is, with numbers of ours behind each point.
//!
//! Everything is copied as bytes, whatever it means. Only what must is changed: how long a record
//! is, what its extra bytes are, how points are compressed, where things begin, and the name of
//! the program that made the file. The `las` crate would know fewer of the bytes: it keeps one
//! extended record of several, and no wave packets.

use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use ::laz::{LasZipCompressor, LazVlr};
use pvmap_geometry::Positions;
use pvmap_store::{AtomicFile, ClosedFile, InputFile, StoreError};

use super::extra::descriptors;
use super::header::{Header, RECORD_BYTES};
use super::vlr::{Kind, VlrName, walk_extended, walk_plain};
use super::write::{descriptor, whole_texts};
use super::{LasFile, RawRecords, laz};
use crate::bytes::{copy, i32_at, u32_at, u64_at};
use crate::error::ScanError;
use crate::field::{self, ScalarField};
use crate::rewrite::RewriteOptions;
use crate::source::SourceInfo;

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
    Plain(BufWriter<AtomicFile>),
    Laz(Box<LasZipCompressor<'static, BufWriter<AtomicFile>>>),
}

/// A LAS or LAZ that is read and written again.
pub(crate) struct LasRewrite<'a> {
    las: &'a LasFile,
    file: &'a InputFile,
    records: RawRecords<'a>,
    points: Points,
    fields: Vec<ScalarField>,
    /// The header as it will be.
    head: Vec<u8>,
    /// The records that were read last, and what becomes of them.
    raw: Vec<u8>,
    rows: Vec<u8>,
    n_written: u64,
    n_of_return: [u64; N_RETURNS],
    path: PathBuf,
}

impl<'a> LasRewrite<'a> {
    /// Writes all that stands before the points; what is not kept goes to `warnings`.
    pub(crate) fn begin(
        las: &'a LasFile,
        (info, file): (&SourceInfo, &'a InputFile),
        options: RewriteOptions<'_>,
        warnings: &mut Vec<String>,
    ) -> Result<LasRewrite<'a>, ScanError> {
        let RewriteOptions { output, compressed, fields, software } = options;
        let path = output.path().to_path_buf();
        let fail = |problem: String| ScanError::Write { path: path.clone(), problem };
        if let Some(problem) = fields.iter().find_map(ScalarField::problem) {
            return Err(fail(problem));
        }
        let header = &las.header;
        let record_bytes = u16::try_from(las.layout.record_bytes + field::n_bytes(fields))
            .map_err(|_| fail("its records would have more than 65535 bytes".to_owned()))?;
        let mut head = vec![0; header.header_bytes as usize];
        file.read_exact_at(&mut head, 0)?;
        patch_format(&mut head, header, (record_bytes, compressed), software);
        if head[6] & HAS_WAVE_FILE != 0 {
            warnings.push("its wave packets are in a .wdp file: copy that to its name, too".into());
        }
        let coded = compressed.then(|| laz::vlr_of(header.point_format, record_bytes));
        let coded = coded.transpose().map_err(fail)?;
        let extra = describe(las, fields, warnings);
        let out = BufWriter::with_capacity(1 << 20, output);
        let mut front = Front { out, n_vlrs: 0, path: path.clone() };
        front.write(&head)?;
        front.copy_vlrs(las, file, (&extra, coded.as_ref()), fields, warnings)?;
        let Front { mut out, n_vlrs, .. } = front;
        let begin = out.stream_position().map_err(|e| StoreError::io(&path, "write", e))?;
        let begin = u32::try_from(begin).map_err(|_| fail("too much before its points".into()))?;
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
            file,
            records: las.raw_reader(file, info.n_points),
            points,
            fields: fields.to_vec(),
            head,
            raw: Vec::new(),
            rows: Vec::new(),
            n_written: 0,
            n_of_return: [0; N_RETURNS],
            path,
        })
    }

    /// Reads some of the next records, up to `n`; gives their places, none at the end.
    pub(crate) fn read(&mut self, n: u64) -> Result<Positions, ScanError> {
        self.raw.clear();
        self.raw.extend_from_slice(self.records.block(n)?);
        let rows = self.raw.chunks_exact(self.las.layout.record_bytes);
        Ok(Positions::Lattice(rows.map(|r| [i32_at(r, 0), i32_at(r, 4), i32_at(r, 8)]).collect()))
    }

    /// Writes the records that were read last, each with its values: a column a field.
    pub(crate) fn write(&mut self, values: &[Vec<f64>]) -> Result<(), ScanError> {
        let record_bytes = self.las.layout.record_bytes;
        let n = self.raw.len() / record_bytes;
        if let Some(problem) = field::mismatch(&self.fields, values, n) {
            return Err(ScanError::Write { path: self.path.clone(), problem });
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
        .map_err(|e| StoreError::io(&self.path, "write", e).into())
    }

    /// Writes all that stands behind the points, and the header once more.
    pub(crate) fn close(mut self) -> Result<ClosedFile, ScanError> {
        let path = self.path;
        let fail = |e| StoreError::io(&path, "write", e);
        let mut out = match self.points {
            Points::Plain(out) => out,
            Points::Laz(mut laz) => {
                laz.done().map_err(fail)?;
                laz.into_inner()
            }
        };
        let at = out.seek(SeekFrom::End(0)).map_err(fail)?;
        let mut tail = Tail { at, first_evlr: 0, n_evlrs: 0, waves: None };
        tail.copy(self.file, &self.las.header, (&mut out, &path), &self.head).or_else(|e| {
            // What a cut file lacks was told when it was opened.
            let is_cut = self.las.options.lenient && matches!(e, ScanError::Header { .. });
            if is_cut { Ok(()) } else { Err(e) }
        })?;
        if let Some(at) = tail.waves {
            self.head[WAVES_OFFSET..WAVES_OFFSET + 8].copy_from_slice(&at.to_le_bytes());
        }
        if self.las.header.version >= (1, 4) {
            self.head[235..243].copy_from_slice(&tail.first_evlr.to_le_bytes());
            self.head[243..247].copy_from_slice(&tail.n_evlrs.to_le_bytes());
        }
        if self.n_written != self.las.header.n_points {
            patch_counts(&mut self.head, &self.las.header, self.n_written, &self.n_of_return);
        }
        let file = out.into_inner().map_err(|e| fail(e.into_error()))?;
        file.write_at(&self.head, 0)?;
        Ok(file.close()?)
    }
}

impl LasFile {
    /// Gives the bytes of the file, about, if it is written again with fields and uncompressed.
    pub(crate) fn rewritten_bytes(&self, info: &SourceInfo, fields: &[ScalarField]) -> u64 {
        let Header { points_offset, points_end, .. } = self.header;
        let record_bytes = (self.layout.record_bytes + field::n_bytes(fields)) as u64;
        let records = info.n_points.saturating_mul(record_bytes);
        records.saturating_add(points_offset + info.len_bytes.saturating_sub(points_end))
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
struct Front {
    out: BufWriter<AtomicFile>,
    n_vlrs: u32,
    path: PathBuf,
}

impl Front {
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
                copy(file, vlr.at..vlr.end(), (&mut self.out, &self.path))
            }
        })?;
        let name = las.extra.name.unwrap_or_else(VlrName::extra_bytes);
        extra.map_or(Ok(()), |extra| self.put(&name, extra))?;
        if let Some(text) = whole_texts(fields) {
            let name = VlrName::new(&text.user_id, text.record_id, &text.description);
            self.put(&name, &text.data)?;
        }
        laz.map_or(Ok(()), |laz| self.put_laz(&VlrName::laszip(), laz))?;
        copy(file, end..header.points_offset, (&mut self.out, &self.path))
    }

    fn put_laz(&mut self, name: &VlrName, laz: &LazVlr) -> Result<(), ScanError> {
        let mut data = Vec::new();
        laz.write_to(&mut data).map_err(|e| StoreError::io(&self.path, "write", e))?;
        self.put(name, &data)
    }

    /// Writes a record of our own.
    fn put(&mut self, name: &VlrName, data: &[u8]) -> Result<(), ScanError> {
        let n_bytes = u16::try_from(data.len()).map_err(|_| ScanError::Write {
            path: self.path.clone(),
            problem: format!("too many extra bytes to describe: {}", data.len()),
        })?;
        self.n_vlrs += 1;
        self.write(&name.plain(n_bytes))?;
        self.write(data)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), ScanError> {
        Ok(self.out.write_all(bytes).map_err(|e| StoreError::io(&self.path, "write", e))?)
    }
}

/// What stands behind the points.
struct Tail {
    at: u64,
    first_evlr: u64,
    n_evlrs: u32,
    /// Where the wave packets begin now, if there are any.
    waves: Option<u64>,
}

impl Tail {
    /// Copies extended records and wave packets.
    fn copy(
        &mut self,
        file: &InputFile,
        header: &Header,
        (out, path): (&mut BufWriter<AtomicFile>, &Path),
        head: &[u8],
    ) -> Result<(), ScanError> {
        let waves = if header.version >= (1, 3) { u64_at(head, WAVES_OFFSET) } else { 0 };
        let end = file.len_bytes();
        let has_waves = waves >= header.points_offset && waves < end;
        // They are one of the extended records, or stand by themselves in LAS 1.3.
        let mut are_listed = false;
        walk_extended(file, header, |vlr| {
            are_listed |= vlr.at == waves;
            Ok(())
        })?;
        if has_waves && !are_listed {
            let is_before = header.n_evlrs > 0 && header.evlrs_offset > waves;
            let range = waves..if is_before { header.evlrs_offset } else { end };
            self.waves = Some(self.at);
            self.at += range.end - range.start;
            copy(file, range, (out, path))?;
        }
        walk_extended(file, header, |vlr| {
            if matches!(vlr.name.kind(), Kind::ExtraBytes | Kind::Laszip | Kind::Copc) {
                return Ok(());
            }
            if has_waves && vlr.at == waves {
                self.waves = Some(self.at);
            }
            if self.n_evlrs == 0 {
                self.first_evlr = self.at;
            }
            self.n_evlrs += 1;
            self.at += vlr.end() - vlr.at;
            copy(file, vlr.at..vlr.end(), (out, path))
        })
    }
}
