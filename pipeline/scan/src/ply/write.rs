//! PLY out: binary little-endian vertices.

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use ply_rs::ply::{
    Addable, DefaultElement, ElementDef, Encoding, Header, PropertyDef, PropertyType, ScalarType,
};
use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_store::{AtomicFile, ClosedFile, StoreError};

use crate::error::ScanError;
use crate::field::{self, FieldKind, ScalarField};
use crate::source::ColorRange;

/// Which columns to write, beside x, y and z.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PlyColumns {
    /// Coordinates as `double` instead of `float`.
    pub double: bool,
    /// nx, ny, nz as `float`.
    pub normal: bool,
    /// red, green, blue: `uchar` for [`ColorRange::Eight`], else `ushort`.
    pub color: Option<ColorRange>,
    /// intensity as `float`.
    pub intensity: bool,
    /// classification as `uchar`.
    pub classification: bool,
    /// gps_time as `double`.
    pub gps_time: bool,
}

/// What a PLY file has beside its columns.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PlyExtras {
    /// Lines of comment, in ASCII, the first right behind the format.
    pub comments: Vec<String>,
    /// Numbers in properties of their names behind the columns, each with its description in a
    /// comment.
    pub fields: Vec<ScalarField>,
}

impl PlyExtras {
    /// Says what cannot be written, if anything.
    fn problem(&self) -> Option<String> {
        let is_line = |c: &&String| c.bytes().all(|b| b.is_ascii() && !b.is_ascii_control());
        let comment = self.comments.iter().find(|c| !is_line(c));
        let comment = comment.map(|c| format!("{c:?} is no comment that can be written"));
        comment.or_else(|| self.fields.iter().find_map(ScalarField::problem))
    }
}

/// Writes points to a binary PLY file that appears under its name when it is whole.
pub struct PlyWriter {
    out: BufWriter<AtomicFile>,
    columns: PlyColumns,
    fields: Vec<ScalarField>,
    n_declared: u64,
    n_written: u64,
    path: PathBuf,
}

impl PlyWriter {
    /// Starts a file of exactly `n_points` points.
    ///
    /// # Errors
    /// Where it cannot be created.
    pub fn create(path: &Path, n_points: u64, columns: PlyColumns) -> Result<PlyWriter, ScanError> {
        PlyWriter::create_in(AtomicFile::create(path)?, n_points, columns, &PlyExtras::default())
    }

    /// Begins the points of a file that was started, which have `extras`, too.
    ///
    /// # Errors
    /// Where it cannot be written, or a field or a comment is none that can be.
    pub fn create_in(
        file: AtomicFile,
        n_points: u64,
        columns: PlyColumns,
        extras: &PlyExtras,
    ) -> Result<PlyWriter, ScanError> {
        let path = file.path().to_path_buf();
        if let Some(problem) = extras.problem() {
            return Err(ScanError::Write { path, problem });
        }
        let mut out = BufWriter::with_capacity(1 << 20, file);
        let header = header(n_points as usize, columns, extras);
        ply_rs::writer::Writer::<DefaultElement>::new()
            .write_header(&mut out, &header)
            .map_err(|e| StoreError::io(&path, "write", io::Error::other(e)))?;
        let fields = extras.fields.clone();
        Ok(PlyWriter { out, columns, fields, n_declared: n_points, n_written: 0, path })
    }

    /// Gives the bytes of such a file.
    pub fn file_bytes(n_points: u64, columns: PlyColumns, extras: &PlyExtras) -> u64 {
        let mut head = Vec::new();
        let header = header(n_points as usize, columns, extras);
        // Into memory, where nothing fails.
        let _ = ply_rs::writer::Writer::<DefaultElement>::new().write_header(&mut head, &header);
        let color_bytes = match columns.color {
            Some(ColorRange::Eight) => 3,
            Some(_) => 6,
            None => 0,
        };
        let row_bytes = if columns.double { 24 } else { 12 }
            + if columns.normal { 12 } else { 0 }
            + color_bytes
            + if columns.intensity { 4 } else { 0 }
            + usize::from(columns.classification)
            + if columns.gps_time { 8 } else { 0 }
            + field::n_bytes(&extras.fields);
        n_points.saturating_mul(row_bytes as u64).saturating_add(head.len() as u64)
    }

    /// Appends a batch; columns that it lacks are 0. Lattice positions are written as their steps.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn write(&mut self, batch: &PointBatch) -> Result<(), ScanError> {
        self.write_with(batch, &[])
    }

    /// Appends a batch and the values of its fields, a column each.
    ///
    /// # Errors
    /// Those of [`PlyWriter::write`], and where the values are not one a field and point.
    pub fn write_with(&mut self, batch: &PointBatch, values: &[Vec<f64>]) -> Result<(), ScanError> {
        if let Some(problem) = field::mismatch(&self.fields, values, batch.len()) {
            return Err(ScanError::Write { path: self.path.clone(), problem });
        }
        let mut row = Vec::new();
        for i in 0..batch.len() {
            row.clear();
            self.encode(batch, i, &mut row);
            self.fields.iter().zip(values).for_each(|(f, v)| f.kind.put(v[i], &mut row));
            self.out.write_all(&row).map_err(|e| StoreError::io(&self.path, "write", e))?;
        }
        self.n_written += batch.len() as u64;
        Ok(())
    }

    /// Completes the file and gives it its name.
    ///
    /// # Errors
    /// Where more or fewer points were written than declared, or the disk fails.
    pub fn finish(self) -> Result<(), ScanError> {
        Ok(self.close()?.publish(false)?)
    }

    /// Completes the file, which has yet to get its name.
    ///
    /// # Errors
    /// Those of [`PlyWriter::finish`].
    pub fn close(self) -> Result<ClosedFile, ScanError> {
        if self.n_written != self.n_declared {
            let problem = format!("{} points of {} given", self.n_written, self.n_declared);
            return Err(ScanError::Write { path: self.path, problem });
        }
        let file = self
            .out
            .into_inner()
            .map_err(|e| StoreError::io(&self.path, "write", e.into_error()))?;
        Ok(file.close()?)
    }

    /// Appends the row of point `i`.
    fn encode(&self, batch: &PointBatch, i: usize, row: &mut Vec<u8>) {
        let columns = self.columns;
        let place = match &batch.positions {
            Positions::Lattice(v) => v[i].map(f64::from),
            Positions::Single(v) => v[i].map(f64::from),
            Positions::Double(v) => v[i],
        };
        for c in place {
            if columns.double {
                row.extend_from_slice(&c.to_le_bytes());
            } else {
                row.extend_from_slice(&(c as f32).to_le_bytes());
            }
        }
        if columns.normal {
            let normal = batch.normal.as_ref().map_or([0.0; 3], |v| v[i]);
            normal.iter().for_each(|c| row.extend_from_slice(&c.to_le_bytes()));
        }
        if let Some(range) = columns.color {
            let color = batch.color.as_ref().map_or([0; 3], |v| v[i]);
            for c in color {
                match range {
                    ColorRange::Eight => row.push(c.min(255) as u8),
                    _ => row.extend_from_slice(&c.to_le_bytes()),
                }
            }
        }
        if columns.intensity {
            let intensity = match &batch.intensity {
                Some(Intensity::U16(v)) => f32::from(v[i]),
                Some(Intensity::F32(v)) => v[i],
                None => 0.0,
            };
            row.extend_from_slice(&intensity.to_le_bytes());
        }
        if columns.classification {
            row.push(batch.classification.as_ref().map_or(0, |v| v[i]));
        }
        if columns.gps_time {
            let time = batch.gps_time.as_ref().map_or(0.0, |v| v[i]);
            row.extend_from_slice(&time.to_le_bytes());
        }
    }
}

/// Describes the columns.
fn header(n_points: usize, columns: PlyColumns, extras: &PlyExtras) -> Header {
    let fields = &extras.fields;
    let mut vertex = ElementDef::new("vertex".to_owned());
    vertex.count = n_points;
    let mut add = |names: &[&str], kind: ScalarType| {
        for name in names {
            let kind = PropertyType::Scalar(kind.clone());
            vertex.properties.add(PropertyDef::new((*name).to_owned(), kind));
        }
    };
    add(&["x", "y", "z"], if columns.double { ScalarType::Double } else { ScalarType::Float });
    if columns.normal {
        add(&["nx", "ny", "nz"], ScalarType::Float);
    }
    if let Some(range) = columns.color {
        let kind = if range == ColorRange::Eight { ScalarType::UChar } else { ScalarType::UShort };
        add(&["red", "green", "blue"], kind);
    }
    if columns.intensity {
        add(&["intensity"], ScalarType::Float);
    }
    if columns.classification {
        add(&["classification"], ScalarType::UChar);
    }
    if columns.gps_time {
        add(&["gps_time"], ScalarType::Double);
    }
    fields.iter().for_each(|field| vertex.properties.add(property(field)));
    let mut header = Header::new();
    header.comments.extend(extras.comments.iter().cloned());
    let described = fields.iter().filter(|f| !f.description.is_empty());
    header.comments.extend(described.map(|f| format!("{}: {}", f.name, f.description)));
    header.encoding = Encoding::BinaryLittleEndian;
    header.elements.add(vertex);
    header
}

/// Describes the property that a field is in.
pub(super) fn property(field: &ScalarField) -> PropertyDef {
    let kind = match field.kind {
        FieldKind::U8 => ScalarType::UChar,
        FieldKind::I8 => ScalarType::Char,
        FieldKind::U32 => ScalarType::UInt,
        FieldKind::F32 => ScalarType::Float,
        FieldKind::F64 => ScalarType::Double,
    };
    PropertyDef::new(field.name.clone(), PropertyType::Scalar(kind))
}
