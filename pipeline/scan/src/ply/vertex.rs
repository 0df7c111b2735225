//! The columns of PLY vertices: which property is what, and packed rows turned into columns.

use pvmap_geometry::{Intensity, PointBatch, Positions};

use super::header::{Element, Encoding, PropertyKind, Scalar};
use crate::bytes::take;
use crate::las::records::normal_axis;
use crate::source::{ColorRange, Columns, IntensityKind, PositionKind};

/// A number of a packed row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Field {
    at: usize,
    kind: Scalar,
    is_big: bool,
}

/// Where the columns lie in a packed row: the row's scalars in file order, its lists left out.
#[derive(Debug, Clone)]
pub(crate) struct VertexLayout {
    /// Bytes of a packed row.
    pub(crate) row_bytes: usize,
    /// For each property: where its number goes in the packed row, if it is wanted.
    pub(crate) wanted: Vec<Option<usize>>,
    position: [Field; 3],
    is_single: bool,
    normal: Option<[Field; 3]>,
    color: Option<[Field; 3]>,
    intensity: Option<(Field, IntensityKind)>,
    classification: Option<Field>,
    gps_time: Option<Field>,
}

impl VertexLayout {
    /// Finds the columns by their names; fails where x, y or z is missing.
    pub(crate) fn of(vertex: &Element, encoding: Encoding) -> Result<VertexLayout, String> {
        let mut row_bytes = 0;
        let mut fields = Vec::new();
        for p in &vertex.properties {
            fields.push(match p.kind {
                PropertyKind::Scalar(kind) => {
                    let at = row_bytes;
                    row_bytes += kind.n_bytes();
                    Some(Field { at, kind, is_big: encoding == Encoding::Big })
                }
                PropertyKind::List(..) => None,
            });
        }
        let mut wanted = vec![None; fields.len()];
        let mut find = |names: &[&str]| -> Option<Field> {
            let is_one = |p: &str| names.iter().any(|n| p.eq_ignore_ascii_case(n));
            let i = (0..fields.len())
                .find(|&i| fields[i].is_some() && is_one(&vertex.properties[i].name))?;
            wanted[i] = fields[i].map(|f: Field| f.at);
            fields[i]
        };
        let position = match [find(&["x"]), find(&["y"]), find(&["z"])] {
            [Some(x), Some(y), Some(z)] => [x, y, z],
            _ => return Err("the vertices have no x, y and z".to_owned()),
        };
        let color = triple(
            find(&["red", "r", "diffuse_red"]),
            find(&["green", "g", "diffuse_green"]),
            find(&["blue", "b", "diffuse_blue"]),
        );
        let intensity = find(&["intensity", "scalar_intensity"]);
        let classification = find(&["classification", "scalar_classification"]);
        let gps_time = find(&["gps_time", "gpstime", "scalar_gpstime", "scalar_gps_time"]);
        let mut normal = [None; 3];
        for (i, p) in vertex.properties.iter().enumerate() {
            // The first of an axis: an export puts the normals of a map behind those of the scan.
            if let (Some(axis), Some(field)) = (normal_axis(p.name.as_bytes()), fields[i])
                && normal[axis].is_none()
            {
                normal[axis] = Some(field);
                wanted[i] = Some(field.at);
            }
        }
        Ok(VertexLayout {
            row_bytes,
            wanted,
            position,
            is_single: position.iter().all(|f| f.kind == Scalar::F32),
            normal: triple(normal[0], normal[1], normal[2]),
            color,
            intensity: intensity.map(|f| match f.kind {
                Scalar::U8 | Scalar::U16 => (f, IntensityKind::U16),
                _ => (f, IntensityKind::F32),
            }),
            classification,
            gps_time,
        })
    }

    /// Says how coordinates are stored.
    pub(crate) fn kind(&self) -> PositionKind {
        if self.is_single { PositionKind::Single } else { PositionKind::Double }
    }

    /// Says which columns there are.
    pub(crate) fn columns(&self) -> Columns {
        Columns {
            color: self.color.map(|c| match c[0].kind {
                Scalar::U8 => ColorRange::Eight,
                Scalar::U16 | Scalar::F32 | Scalar::F64 => ColorRange::Sixteen,
                _ => ColorRange::Either,
            }),
            intensity: self.intensity.map(|(_, kind)| kind),
            classification: self.classification.is_some(),
            gps_time: self.gps_time.is_some(),
            normal: self.normal.is_some(),
        }
    }

    /// Makes an empty batch with room for `n` points.
    pub(crate) fn empty_batch(&self, source: u32, n: usize) -> PointBatch {
        PointBatch {
            source,
            records: Vec::with_capacity(n),
            positions: self.empty_positions(n),
            color: self.color.map(|_| Vec::with_capacity(n)),
            intensity: self.intensity.map(|(_, kind)| match kind {
                IntensityKind::U16 => Intensity::U16(Vec::with_capacity(n)),
                IntensityKind::F32 => Intensity::F32(Vec::with_capacity(n)),
            }),
            classification: self.classification.map(|_| Vec::with_capacity(n)),
            gps_time: self.gps_time.map(|_| Vec::with_capacity(n)),
            normal: self.normal.map(|_| Vec::with_capacity(n)),
        }
    }

    /// Says whether the coordinates of a packed row are finite.
    #[inline(always)]
    pub(crate) fn is_finite(&self, row: &[u8]) -> bool {
        if self.is_single {
            self.position.iter().all(|f| f.single(row).is_finite())
        } else {
            self.position.iter().all(|f| f.real(row).is_finite())
        }
    }

    /// Makes positions with room for `n` points.
    pub(crate) fn empty_positions(&self, n: usize) -> Positions {
        if self.is_single {
            Positions::Single(Vec::with_capacity(n))
        } else {
            Positions::Double(Vec::with_capacity(n))
        }
    }

    /// Appends the places of packed rows to positions made by [`VertexLayout::empty_positions`].
    pub(crate) fn append_positions(&self, packed: &[u8], positions: &mut Positions) {
        let rows = packed.chunks_exact(self.row_bytes);
        match positions {
            Positions::Single(v) => v.extend(rows.map(|r| three(&self.position, r, Field::single))),
            Positions::Double(v) => v.extend(rows.map(|r| three(&self.position, r, Field::real))),
            Positions::Lattice(_) => {}
        }
    }

    /// Appends the other columns (not the record numbers) of packed rows to a batch made by
    /// [`VertexLayout::empty_batch`].
    pub(crate) fn append_others(&self, packed: &[u8], batch: &mut PointBatch) {
        let rows = || packed.chunks_exact(self.row_bytes);
        if let (Some(fields), Some(normals)) = (self.normal, &mut batch.normal) {
            if fields.iter().all(|f| f.kind == Scalar::F32) {
                normals.extend(rows().map(|r| three(&fields, r, Field::single)));
            } else {
                normals.extend(rows().map(|r| three(&fields, r, |f, r| f.real(r) as f32)));
            }
        }
        if let (Some(fields), Some(colors)) = (self.color, &mut batch.color) {
            if fields.iter().all(|f| f.kind == Scalar::U8) {
                colors.extend(rows().map(|r| three(&fields, r, |f, r| u16::from(r[f.at]))));
            } else {
                colors.extend(rows().map(|r| three(&fields, r, Field::brightness)));
            }
        }
        match (self.intensity, &mut batch.intensity) {
            (Some((f, _)), Some(Intensity::U16(v))) => v.extend(rows().map(|r| f.real(r) as u16)),
            (Some((f, _)), Some(Intensity::F32(v))) => v.extend(rows().map(|r| f.real(r) as f32)),
            _ => {}
        }
        if let (Some(f), Some(classes)) = (self.classification, &mut batch.classification) {
            classes.extend(rows().map(|r| f.real(r) as u8));
        }
        if let (Some(f), Some(times)) = (self.gps_time, &mut batch.gps_time) {
            times.extend(rows().map(|r| f.real(r)));
        }
    }
}

fn triple(a: Option<Field>, b: Option<Field>, c: Option<Field>) -> Option<[Field; 3]> {
    Some([a?, b?, c?])
}

/// Reads three numbers of a row. Written out: the compiler does not inline a closure over an array.
#[inline(always)]
fn three<T>(fields: &[Field; 3], row: &[u8], read: impl Fn(&Field, &[u8]) -> T) -> [T; 3] {
    [read(&fields[0], row), read(&fields[1], row), read(&fields[2], row)]
}

impl Field {
    /// Reads a float.
    #[inline(always)]
    fn single(&self, row: &[u8]) -> f32 {
        let bytes = take(row, self.at);
        if self.is_big { f32::from_be_bytes(bytes) } else { f32::from_le_bytes(bytes) }
    }

    /// Reads a number of any type; every one of them is exact in f64.
    #[inline(always)]
    fn real(&self, row: &[u8]) -> f64 {
        match self.kind {
            Scalar::F32 => f64::from(self.single(row)),
            Scalar::F64 => {
                let bytes = take(row, self.at);
                if self.is_big { f64::from_be_bytes(bytes) } else { f64::from_le_bytes(bytes) }
            }
            kind => whole(&row[self.at..], kind, self.is_big) as f64,
        }
    }

    /// Reads a colour channel: whole numbers as they are, fractions of 1 as fractions of 65535.
    #[inline(always)]
    fn brightness(&self, row: &[u8]) -> u16 {
        let value = self.real(row);
        // `as` keeps the ends and turns NaN into 0.
        if self.kind.is_whole() { value as u16 } else { (value * 65535.0).round() as u16 }
    }
}

/// Reads a whole number at the start of `bytes`.
#[inline(always)]
pub(crate) fn whole(bytes: &[u8], kind: Scalar, is_big: bool) -> i64 {
    macro_rules! read {
        ($t:ty) => {{
            let bytes = take(bytes, 0);
            i64::from(if is_big { <$t>::from_be_bytes(bytes) } else { <$t>::from_le_bytes(bytes) })
        }};
    }
    match kind {
        Scalar::I8 => read!(i8),
        Scalar::U8 => read!(u8),
        Scalar::I16 => read!(i16),
        Scalar::U16 => read!(u16),
        Scalar::I32 => read!(i32),
        Scalar::U32 => read!(u32),
        Scalar::F32 | Scalar::F64 => unreachable!("a fraction where a whole number was checked"),
    }
}
