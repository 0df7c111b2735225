//! PLY written again: the file as it is, with properties of ours behind those of each vertex.
//!
//! Lines of the header, other elements and the rows of vertices are copied as bytes, lists too.

use std::io::Write;

use ply_rs::ply::DefaultElement;
use ply_rs::writer::Writer;
use pvmap_geometry::Positions;
use pvmap_store::{ClosedFile, InputFile, Watch};

use super::header::Encoding;
use super::rows::{ListedRows, TextRows};
use super::write::property;
use super::{PlyFile, Rows};
use crate::bytes::BLOCK_BYTES;
use crate::error::ScanError;
use crate::field::{self, FieldKind, ScalarField};
use crate::out::{Out, refused};
use crate::rewrite::RewriteOptions;
use crate::source::SourceInfo;

/// The longest row with lists that is held; no scan has nearly so long ones.
const MOST_ROW_BYTES: u64 = 16 << 20;
/// Bytes of a number as text, about.
const TEXT_BYTES: u64 = 12;

/// A PLY that is read and written again.
pub(crate) struct PlyRewrite<'a> {
    ply: &'a PlyFile,
    file: &'a InputFile,
    rows: Rows<'a>,
    out: Out,
    fields: Vec<ScalarField>,
    line_end: &'static [u8],
    /// The vertex that comes next, and how many there are.
    next: u64,
    n_points: u64,
    /// The rows that were read last: their bytes, where each ends in them, their numbers.
    raw: Vec<u8>,
    ends: Vec<usize>,
    packed: Vec<u8>,
}

impl<'a> PlyRewrite<'a> {
    /// Writes all that stands before the vertices.
    pub(crate) fn begin(
        ply: &'a PlyFile,
        (info, file): (&SourceInfo, &'a InputFile),
        options: RewriteOptions<'_>,
        watch: &dyn Watch,
    ) -> Result<PlyRewrite<'a>, ScanError> {
        let RewriteOptions { output, fields, software, .. } = options;
        if info.n_missing > 0 {
            // Its header has the count, before anybody knows how many rows are whole.
            return Err(ScanError::Unsupported {
                path: info.path.clone(),
                found: "a PLY that was cut short".to_owned(),
                advice: "it is not written again; export without --scan",
            });
        }
        let mut head = vec![0; ply.header.body_offset as usize];
        file.read_exact_at(&mut head, 0)?;
        let line_end = line_end(&head, ply.header.newline);
        let head = lengthened(&head, (ply.header.newline, line_end), fields, software);
        let mut out = Out::new(output);
        out.put(&head)?;
        out.copy_all("front", file, ply.header.body_offset..ply.start.0, watch)?;
        let rows = if ply.header.encoding == Encoding::Ascii {
            Rows::Text(TextRows::new(file, &ply.header, ply.start))
        } else if ply.is_seekable() {
            Rows::Fixed
        } else {
            Rows::Listed(ListedRows::new(file, ply.start.0, ply.header.encoding))
        };
        Ok(PlyRewrite {
            ply,
            file,
            rows,
            out,
            fields: fields.to_vec(),
            line_end,
            next: 0,
            n_points: info.n_points,
            raw: Vec::new(),
            ends: Vec::new(),
            packed: Vec::new(),
        })
    }

    /// Reads some of the next vertices, up to `n`; gives their places, none at the end.
    pub(crate) fn read(&mut self, n: u64) -> Result<Positions, ScanError> {
        self.raw.clear();
        self.ends.clear();
        self.packed.clear();
        let n = n.min(self.n_points - self.next);
        let (ply, file) = (self.ply, self.file);
        match &mut self.rows {
            Rows::Fixed => {
                let row_bytes = ply.layout.row_bytes;
                let n = n.min((BLOCK_BYTES / row_bytes).max(1) as u64) as usize;
                self.raw.resize(n * row_bytes, 0);
                let at = ply.start.0 + self.next * row_bytes as u64;
                file.read_exact_at(&mut self.raw, at)?;
                self.ends.extend((1..=n).map(|i| i * row_bytes));
                self.packed.extend_from_slice(&self.raw);
            }
            Rows::Listed(rows) => {
                let start = rows.offset();
                for record in self.next..self.next + n {
                    let before = rows.offset();
                    if before - start > BLOCK_BYTES as u64 {
                        break;
                    }
                    rows.read(&ply.vertex, record, &mut self.packed)?;
                    if rows.offset() - before > MOST_ROW_BYTES {
                        let problem = format!("a row of {} bytes", rows.offset() - before);
                        return Err(ScanError::record(file.path(), record, problem));
                    }
                    self.ends.push((rows.offset() - start) as usize);
                }
                self.raw.resize((rows.offset() - start) as usize, 0);
                file.read_exact_at(&mut self.raw, start)?;
            }
            Rows::Text(rows) => {
                for record in self.next..self.next + n {
                    if self.raw.len() > BLOCK_BYTES {
                        break;
                    }
                    rows.read(&ply.vertex, &ply.layout, record, &mut self.packed)?;
                    self.raw.extend_from_slice(rows.line().trim_ascii_end());
                    self.ends.push(self.raw.len());
                }
            }
        }
        self.next += self.ends.len() as u64;
        let mut positions = ply.layout.empty_positions(self.ends.len());
        ply.layout.append_positions(&self.packed, &mut positions);
        Ok(positions)
    }

    /// Writes the vertices that were read last, each with its values: a column a field.
    pub(crate) fn write(&mut self, values: &[Vec<f64>]) -> Result<(), ScanError> {
        if let Some(problem) = field::mismatch(&self.fields, values, self.ends.len()) {
            return Err(refused(self.out.path(), problem));
        }
        let mut row = Vec::new();
        let mut start = 0;
        for (i, &end) in self.ends.iter().enumerate() {
            row.clear();
            row.extend_from_slice(&self.raw[start..end]);
            start = end;
            for (field, values) in self.fields.iter().zip(values) {
                put(field.kind, values[i], self.ply.header.encoding, &mut row);
            }
            if self.ply.header.encoding == Encoding::Ascii {
                row.extend_from_slice(self.line_end);
            }
            self.out.put(&row)?;
        }
        Ok(())
    }

    /// Writes all that stands behind the vertices.
    pub(crate) fn close(mut self, watch: &dyn Watch) -> Result<ClosedFile, ScanError> {
        let end = match &self.rows {
            Rows::Fixed => self.ply.start.0 + self.n_points * self.ply.layout.row_bytes as u64,
            Rows::Listed(rows) => rows.offset(),
            Rows::Text(rows) => rows.place().0,
        };
        self.out.copy_all("rest", self.file, end..self.file.len_bytes(), watch)?;
        self.out.close(&[])
    }
}

impl PlyFile {
    /// Gives the names of the properties of its vertices.
    pub(crate) fn names(&self) -> Vec<String> {
        self.vertex.properties.iter().map(|p| p.name.clone()).collect()
    }

    /// Gives the bytes of the file, about, if it is written again with fields.
    pub(crate) fn rewritten_bytes(&self, info: &SourceInfo, fields: &[ScalarField]) -> u64 {
        let of = |f: &ScalarField| match self.header.encoding {
            Encoding::Ascii => TEXT_BYTES,
            _ => f.kind.n_bytes() as u64,
        };
        let added = info.n_points.saturating_mul(fields.iter().map(of).sum());
        info.len_bytes.saturating_add(added)
    }
}

/// Gives what ends the lines of a header.
fn line_end(head: &[u8], newline: u8) -> &'static [u8] {
    let first = head.split(|&b| b == newline).next().unwrap_or_default();
    match newline {
        b'\r' => b"\r",
        _ if first.ends_with(b"\r") => b"\r\n",
        _ => b"\n",
    }
}

/// Adds lines to a header: who wrote the file and what the fields are behind its format, the
/// fields themselves behind the properties of a vertex.
fn lengthened(
    head: &[u8],
    (newline, line_end): (u8, &[u8]),
    fields: &[ScalarField],
    software: &str,
) -> Vec<u8> {
    let mut out = Vec::new();
    let add = |out: &mut Vec<u8>, line: String| {
        out.extend_from_slice(line.as_bytes());
        out.extend_from_slice(line_end);
    };
    let lines = head.split_inclusive(|&b| b == newline);
    let comment = format!("comment {software}");
    let (mut is_vertex, mut is_behind_format) = (false, false);
    for line in lines {
        let mut words = line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
        let word = words.next().unwrap_or_default();
        let is_there = line.trim_ascii() == comment.as_bytes();
        if is_behind_format {
            // Of a file that was written so before the line is kept.
            add(&mut out, comment.clone());
            let described = fields.iter().filter(|f| !f.description.is_empty());
            described.for_each(|f| add(&mut out, format!("comment {}: {}", f.name, f.description)));
        }
        if is_vertex && matches!(word, b"element" | b"end_header") {
            fields.iter().for_each(|f| add(&mut out, property_line(f)));
            is_vertex = false;
        }
        is_vertex |= word == b"element" && words.next() == Some(b"vertex");
        if !(is_behind_format && is_there) {
            out.extend_from_slice(line);
        }
        is_behind_format = word == b"format";
    }
    out
}

/// Gives the line of a header that a field has, without its end.
fn property_line(field: &ScalarField) -> String {
    let mut line = Vec::new();
    let writer = Writer::<DefaultElement>::new();
    // Into memory, where nothing fails.
    let _ = writer.write_line_property_definition(&mut line, &property(field));
    String::from_utf8_lossy(line.trim_ascii_end()).into_owned()
}

/// Appends a value as the file has its numbers.
fn put(kind: FieldKind, value: f64, encoding: Encoding, row: &mut Vec<u8>) {
    let at = row.len();
    match encoding {
        Encoding::Little => kind.put(value, row),
        Encoding::Big => {
            kind.put(value, row);
            row[at..].reverse();
        }
        Encoding::Ascii => {
            // Into memory, where nothing fails. `as` keeps the ends, as it does in bytes.
            let _ = match kind {
                FieldKind::U8 => write!(row, " {}", value as u8),
                FieldKind::I8 => write!(row, " {}", value as i8),
                FieldKind::U32 => write!(row, " {}", value as u32),
                FieldKind::F32 => write!(row, " {}", value as f32),
                FieldKind::F64 => write!(row, " {value}"),
            };
        }
    }
}
