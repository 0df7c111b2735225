//! PLY: a header of elements and properties, then rows as text or bytes of either order.
//!
//! Only the header goes through `ply-rs`. Its body readers are ten times slower than a fixed
//! stride, refuse nan and inf, hold every list in memory and read lines without a limit.

mod header;
pub(crate) mod mesh;
pub(crate) mod rewrite;
mod rows;
mod vertex;
pub(crate) mod write;

use std::ops::Range;

use pvmap_geometry::{PointBatch, Positions};
use pvmap_store::InputFile;

use crate::bytes::BLOCK_BYTES;
use crate::error::{ErrorKind, ScanError};
use crate::source::{PartReader, ReadOptions, SourceInfo, StoredBounds};
use header::{Element, Encoding, Header};
use rows::{ListedRows, TextRows};
use vertex::VertexLayout;

/// A checked PLY file.
#[derive(Debug)]
pub(crate) struct PlyFile {
    header: Header,
    vertex: Element,
    layout: VertexLayout,
    /// Where the first vertex is, and for text the number of its line.
    start: (u64, u64),
}

impl PlyFile {
    /// Reads the header, steps over what is before the vertices and checks their count.
    pub(crate) fn open(
        file: &InputFile,
        options: ReadOptions,
    ) -> Result<(PlyFile, SourceInfo), ScanError> {
        let broken = |problem: String| ScanError::header(file.path(), "PLY header", problem);
        let header = Header::read(file)?;
        let i = header.elements.iter().position(|e| e.name == "vertex");
        let i = i.ok_or_else(|| broken("there is no element named vertex".to_owned()))?;
        let vertex = header.elements[i].clone();
        let layout = VertexLayout::of(&vertex, header.encoding).map_err(broken)?;
        let start = find_vertices(file, &header, &header.elements[..i])?;
        let mut warnings = Vec::new();
        let n_points = n_points(file, &header, &vertex, start.0, options, &mut warnings)?;
        let encoding = match header.encoding {
            Encoding::Ascii => "ASCII",
            Encoding::Little => "binary little-endian",
            Encoding::Big => "binary big-endian",
        };
        let info = SourceInfo {
            path: file.path().to_path_buf(),
            format: format!("PLY 1.0, {encoding}"),
            n_points,
            n_missing: vertex.count - n_points,
            n_beyond: 0,
            len_bytes: file.len_bytes(),
            kind: layout.kind(),
            bounds: None,
            columns: layout.columns(),
            crs: None,
            is_gps_time_since_1980: None,
            warnings,
        };
        Ok((PlyFile { header, vertex, layout, start }, info))
    }

    /// Says whether every vertex can be found without reading those before it.
    pub(crate) fn is_seekable(&self) -> bool {
        self.header.encoding != Encoding::Ascii && self.vertex.row_bytes().is_some()
    }

    /// Reads a range of vertices of the file this was made from.
    pub(crate) fn reader<'a>(
        &'a self,
        file: &'a InputFile,
        source: u32,
        part: Range<u64>,
        options: ReadOptions,
    ) -> Result<VertexReader<'a>, ScanError> {
        let (rows, next) = if self.header.encoding == Encoding::Ascii {
            (Rows::Text(TextRows::new(file, &self.header, self.start)), 0)
        } else if self.is_seekable() {
            (Rows::Fixed, part.start)
        } else {
            (Rows::Listed(ListedRows::new(file, self.start.0, self.header.encoding)), 0)
        };
        let mut reader = VertexReader {
            ply: self,
            file,
            source,
            options,
            rows,
            next,
            end: part.end,
            packed: Vec::new(),
            dropped: (0, None),
        };
        while reader.next < part.start {
            let n = reader.block().min(part.start - reader.next);
            reader.fill(n)?;
        }
        Ok(reader)
    }
}

/// Steps over the elements before the vertices.
fn find_vertices(
    file: &InputFile,
    header: &Header,
    before: &[Element],
) -> Result<(u64, u64), ScanError> {
    let mut place = (header.body_offset, header.body_line);
    for element in before.iter().filter(|e| e.count > 0 && !e.properties.is_empty()) {
        check_room(file, header, element, place.0)?;
        if header.encoding == Encoding::Ascii {
            let mut rows = TextRows::new(file, header, place);
            for i in 0..element.count {
                rows.skip(element, i)?;
            }
            place = rows.place();
        } else if let Some(n) = element.row_bytes() {
            // No overflow: the room for them was just checked.
            place.0 += element.count * n as u64;
        } else {
            let mut rows = ListedRows::new(file, place.0, header.encoding);
            let mut row = Vec::new();
            for i in 0..element.count {
                row.clear();
                rows.read(element, i, &mut row)?;
            }
            place.0 = rows.offset();
        }
    }
    Ok(place)
}

/// Gives the most rows of an element that fit into the file behind `at`.
fn n_rows_fit(file: &InputFile, header: &Header, element: &Element, at: u64) -> u64 {
    let left = file.len_bytes().saturating_sub(at);
    // The last line of a text may lack its end.
    let spare = u64::from(header.encoding == Encoding::Ascii);
    (left + spare) / element.least_bytes(header.encoding)
}

/// Refuses an element that cannot be there (F61).
fn check_room(
    file: &InputFile,
    header: &Header,
    element: &Element,
    at: u64,
) -> Result<(), ScanError> {
    let most = n_rows_fit(file, header, element, at);
    if element.count <= most {
        return Ok(());
    }
    let problem = format!(
        "declares {} of {}, the bytes left hold {most} at the most: the file is cut short or its \
         header is wrong",
        element.count, element.name
    );
    Err(ScanError::header(file.path(), "PLY body", problem))
}

/// Compares the vertex count with the bytes that are left (F61).
fn n_points(
    file: &InputFile,
    header: &Header,
    vertex: &Element,
    at: u64,
    options: ReadOptions,
    warnings: &mut Vec<String>,
) -> Result<u64, ScanError> {
    let (declared, most) = (vertex.count, n_rows_fit(file, header, vertex, at));
    if declared <= most {
        return Ok(declared);
    }
    if !options.lenient {
        let path = file.path().to_path_buf();
        return Err(ScanError::Short { path, declared, present: most });
    }
    warnings.push(format!("declares {declared} points but holds {most}: reading those"));
    Ok(most)
}

/// Reads a range of vertices.
pub(crate) struct VertexReader<'a> {
    ply: &'a PlyFile,
    file: &'a InputFile,
    source: u32,
    options: ReadOptions,
    rows: Rows<'a>,
    /// The vertex that comes next, and the one before which to stop.
    next: u64,
    end: u64,
    packed: Vec<u8>,
    dropped: (u64, Option<u64>),
}

/// Where packed rows come from.
enum Rows<'a> {
    /// The file's own rows are packed.
    Fixed,
    Listed(ListedRows<'a>),
    Text(TextRows<'a>),
}

impl PartReader for VertexReader<'_> {
    fn next(&mut self, n: usize) -> Result<Option<PointBatch>, ScanError> {
        if self.next >= self.end {
            return Ok(None);
        }
        let n = (n as u64).min(self.end - self.next);
        let batch_end = self.next + n;
        let mut batch = self.ply.layout.empty_batch(self.source, n as usize);
        while self.next < batch_end {
            let first = self.next;
            self.take(batch_end - first)?;
            self.keep_finite(first, &mut batch)?;
            if self.end == first {
                break;
            }
        }
        Ok(Some(batch))
    }

    fn dropped(&self) -> (u64, Option<u64>) {
        self.dropped
    }
}

impl VertexReader<'_> {
    /// Gives how many rows to take at a time.
    fn block(&self) -> u64 {
        (BLOCK_BYTES / self.ply.layout.row_bytes).max(1) as u64
    }

    /// Fills `packed` with some of the next `n` rows. Where a cut file ends and the read is
    /// lenient, `end` moves to the vertex that was the next.
    fn take(&mut self, n: u64) -> Result<(), ScanError> {
        let first = self.next;
        match self.fill(self.block().min(n)) {
            // A lenient read takes what a cut file has, not what a broken disk gives.
            Err(e) if !self.options.lenient || e.kind() != ErrorKind::BadData => Err(e),
            Err(e) if self.file.failure().is_some() => Err(e),
            Err(_) => {
                self.end = first;
                Ok(())
            }
            Ok(()) => Ok(()),
        }
    }

    /// Finds the bounds of the range, decoding nothing but places.
    pub(crate) fn bounds(mut self) -> Result<StoredBounds, ScanError> {
        let mut bounds = StoredBounds::EMPTY;
        let mut positions = self.ply.layout.empty_positions(self.block() as usize);
        while self.next < self.end {
            let first = self.next;
            self.take(self.end - first)?;
            positions.truncate(0);
            self.keep_finite_positions(first, &mut positions, |_| {})?;
            bounds = bounds.join(&StoredBounds::of(&positions));
        }
        Ok(bounds)
    }

    /// Fills `packed` with the next `n` rows; on failure it holds those before the broken one.
    fn fill(&mut self, n: u64) -> Result<(), ScanError> {
        let ply = self.ply;
        match &mut self.rows {
            Rows::Fixed => {
                let row_bytes = ply.layout.row_bytes as u64;
                self.packed.resize((n * row_bytes) as usize, 0);
                let at = ply.start.0 + self.next * row_bytes;
                self.file.read_exact_at(&mut self.packed, at)?;
            }
            Rows::Listed(rows) => {
                self.packed.clear();
                for record in self.next..self.next + n {
                    let good = self.packed.len();
                    let read = rows.read(&ply.vertex, record, &mut self.packed);
                    if read.is_err() {
                        self.packed.truncate(good);
                    }
                    read?;
                }
            }
            Rows::Text(rows) => {
                self.packed.clear();
                for record in self.next..self.next + n {
                    rows.read(&ply.vertex, &ply.layout, record, &mut self.packed)?;
                }
            }
        }
        self.next += n;
        Ok(())
    }

    /// Moves the packed rows, the first of which is vertex `first`, into a batch; rows with a
    /// coordinate that is not finite are refused or dropped.
    fn keep_finite(&mut self, first: u64, batch: &mut PointBatch) -> Result<(), ScanError> {
        let records = &mut batch.records;
        self.keep_finite_positions(first, &mut batch.positions, |kept| records.extend(kept))?;
        self.ply.layout.append_others(&self.packed, batch);
        Ok(())
    }

    /// Appends the places of the packed rows to `positions` and gives `keep` their numbers. Rows
    /// with a coordinate that is not finite are refused, or dropped from the packed ones too.
    fn keep_finite_positions(
        &mut self,
        first: u64,
        positions: &mut Positions,
        mut keep: impl FnMut(Range<u64>),
    ) -> Result<(), ScanError> {
        let layout = &self.ply.layout;
        let size = layout.row_bytes;
        let (n_before, n) = (positions.len(), self.packed.len() / size);
        layout.append_positions(&self.packed, positions);
        if positions.is_finite_from(n_before) {
            keep(first..first + n as u64);
            return Ok(());
        }
        positions.truncate(n_before);
        let mut n_kept = 0;
        for (i, record) in (0..n).zip(first..) {
            let row = i * size..(i + 1) * size;
            if layout.is_finite(&self.packed[row.clone()]) {
                self.packed.copy_within(row, n_kept * size);
                keep(record..record + 1);
                n_kept += 1;
            } else if self.options.skip_invalid {
                self.dropped.0 += 1;
                self.dropped.1.get_or_insert(record);
            } else {
                let path = self.file.path().to_path_buf();
                return Err(ScanError::NotFinite { path, record });
            }
        }
        self.packed.truncate(n_kept * size);
        layout.append_positions(&self.packed, positions);
        Ok(())
    }
}
