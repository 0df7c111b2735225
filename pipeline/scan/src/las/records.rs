//! Point records of LAS: where each column lies in a record, and records turned into columns.

use pvmap_geometry::{Intensity, PointBatch, Positions};

use super::extra::{HAS_OFFSET, HAS_SCALE, described_bytes, name_of};
use super::header::Header;
use crate::bytes::{f64_at, i32_at, take, u16_at, u32_at};
use crate::error::escaped;

/// Bytes of an extra-bytes descriptor (LAS 1.4 specification, table 24).
pub(crate) const DESCRIPTOR_BYTES: usize = 192;

/// Where the columns lie in a record of one file.
#[derive(Debug, Clone)]
pub(crate) struct RecordLayout {
    /// Bytes of a record.
    pub(crate) record_bytes: usize,
    /// Formats 0…5 keep flags in the upper bits of the class.
    class_at: usize,
    class_mask: u8,
    gps_at: Option<usize>,
    color_at: Option<usize>,
    normal: Option<[ExtraField; 3]>,
}

impl RecordLayout {
    /// Lays out the records of a file by its point format and extra-bytes descriptors.
    pub(crate) fn of(
        header: &Header,
        descriptors: &[u8],
        warnings: &mut Vec<String>,
    ) -> RecordLayout {
        let is_legacy = header.point_format < 6;
        let (gps_at, color_at, extra_at) = match header.point_format {
            0 => (None, None, 20),
            1 => (Some(20), None, 28),
            2 => (None, Some(20), 26),
            3 => (Some(20), Some(28), 34),
            4 => (Some(20), None, 57),
            5 => (Some(20), Some(28), 63),
            6 => (Some(22), None, 30),
            7 => (Some(22), Some(30), 36),
            8 => (Some(22), Some(30), 38),
            9 => (Some(22), None, 59),
            _ => (Some(22), Some(30), 67),
        };
        let record_bytes = usize::from(header.record_bytes);
        let normal = find_normal(descriptors, extra_at..record_bytes, warnings);
        RecordLayout {
            record_bytes,
            class_at: if is_legacy { 15 } else { 16 },
            class_mask: if is_legacy { 0x1f } else { 0xff },
            gps_at,
            color_at,
            normal,
        }
    }

    pub(crate) fn has_gps_time(&self) -> bool {
        self.gps_at.is_some()
    }

    pub(crate) fn has_color(&self) -> bool {
        self.color_at.is_some()
    }

    pub(crate) fn has_normal(&self) -> bool {
        self.normal.is_some()
    }

    /// Makes an empty batch with all columns of the file and room for `n` points.
    pub(crate) fn empty_batch(&self, source: u32, n: usize) -> PointBatch {
        PointBatch {
            source,
            records: Vec::with_capacity(n),
            positions: Positions::Lattice(Vec::with_capacity(n)),
            color: self.color_at.map(|_| Vec::with_capacity(n)),
            intensity: Some(Intensity::U16(Vec::with_capacity(n))),
            classification: Some(Vec::with_capacity(n)),
            gps_time: self.gps_at.map(|_| Vec::with_capacity(n)),
            normal: self.normal.map(|_| Vec::with_capacity(n)),
        }
    }

    /// Appends whole raw records, the first of which has number `first`, to a batch made by
    /// [`RecordLayout::empty_batch`].
    pub(crate) fn append(&self, raw: &[u8], first: u64, batch: &mut PointBatch) {
        let rows = || raw.chunks_exact(self.record_bytes);
        batch.records.extend(first..first + rows().len() as u64);
        if let Positions::Lattice(places) = &mut batch.positions {
            places.extend(rows().map(|r| [i32_at(r, 0), i32_at(r, 4), i32_at(r, 8)]));
        }
        if let Some(Intensity::U16(values)) = &mut batch.intensity {
            values.extend(rows().map(|r| u16_at(r, 12)));
        }
        if let Some(classes) = &mut batch.classification {
            classes.extend(rows().map(|r| r[self.class_at] & self.class_mask));
        }
        if let (Some(at), Some(times)) = (self.gps_at, &mut batch.gps_time) {
            times.extend(rows().map(|r| f64_at(r, at)));
        }
        if let (Some(at), Some(colors)) = (self.color_at, &mut batch.color) {
            colors.extend(rows().map(|r| [u16_at(r, at), u16_at(r, at + 2), u16_at(r, at + 4)]));
        }
        // Written out: the compiler does not inline a closure over an array.
        if let (Some([x, y, z]), Some(normals)) = (&self.normal, &mut batch.normal) {
            normals.extend(rows().map(|r| [x.value(r), y.value(r), z.value(r)]));
        }
    }
}

/// A number in the extra bytes: value = stored · scale + offset.
#[derive(Debug, Clone, Copy)]
struct ExtraField {
    at: usize,
    /// 1…10: u8, i8, u16, i16, u32, i32, u64, i64, f32, f64.
    kind: u8,
    scale: f64,
    offset: f64,
}

impl ExtraField {
    #[inline(always)]
    fn value(&self, row: &[u8]) -> f32 {
        let at = self.at;
        let stored = match self.kind {
            1 => f64::from(row[at]),
            2 => f64::from(row[at] as i8),
            3 => f64::from(u16_at(row, at)),
            4 => f64::from(i16::from_le_bytes(take(row, at))),
            5 => f64::from(u32_at(row, at)),
            6 => f64::from(i32_at(row, at)),
            7 => u64::from_le_bytes(take(row, at)) as f64,
            8 => i64::from_le_bytes(take(row, at)) as f64,
            9 => f64::from(f32::from_le_bytes(take(row, at))),
            _ => f64_at(row, at),
        };
        (stored * self.scale + self.offset) as f32
    }
}

/// Bytes of one number of a plain descriptor kind.
pub(crate) fn kind_bytes(kind: u8) -> usize {
    match kind {
        1 | 2 => 1,
        3 | 4 => 2,
        5 | 6 | 9 => 4,
        _ => 8,
    }
}

/// Finds the three fields named nx ny nz or NormalX NormalY NormalZ, in any case of letters.
fn find_normal(
    descriptors: &[u8],
    extra: std::ops::Range<usize>,
    warnings: &mut Vec<String>,
) -> Option<[ExtraField; 3]> {
    let mut found = [None; 3];
    let mut at = extra.start;
    for d in descriptors.chunks_exact(DESCRIPTOR_BYTES) {
        let (kind, options) = (d[2], d[3]);
        let name = name_of(d);
        let Some(n_bytes) = described_bytes(d) else {
            let name = escaped(name, 32);
            warnings.push(format!("extra bytes \"{name}\": unknown type {kind}: not read"));
            break;
        };
        if at + n_bytes > extra.end {
            warnings.push(format!(
                "extra bytes \"{}\" lie beyond the record's {} bytes: not read",
                escaped(name, 32),
                extra.end
            ));
            break;
        }
        if let (Some(axis), 1..=10) = (normal_axis(name), kind) {
            let scale = if options & HAS_SCALE != 0 { f64_at(d, 112) } else { 1.0 };
            let offset = if options & HAS_OFFSET != 0 { f64_at(d, 136) } else { 0.0 };
            // The first of an axis: an export puts the normals of a map behind those of the scan.
            found[axis].get_or_insert(ExtraField { at, kind, scale, offset });
        }
        at += n_bytes;
    }
    match found {
        [Some(x), Some(y), Some(z)] => Some([x, y, z]),
        _ => None,
    }
}

/// Gives the axis that a field name says a normal's component is along.
pub(crate) fn normal_axis(name: &[u8]) -> Option<usize> {
    const NAMES: [[&[u8]; 3]; 3] = [
        [b"nx", b"normalx", b"normal_x"],
        [b"ny", b"normaly", b"normal_y"],
        [b"nz", b"normalz", b"normal_z"],
    ];
    NAMES.iter().position(|names| names.iter().any(|n| name.eq_ignore_ascii_case(n)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A descriptor of a field: type, options, name, scale, offset.
    fn descriptor(kind: u8, options: u8, name: &str, scale: f64, offset: f64) -> Vec<u8> {
        let mut d = vec![0; DESCRIPTOR_BYTES];
        (d[2], d[3]) = (kind, options);
        d[4..4 + name.len()].copy_from_slice(name.as_bytes());
        d[112..120].copy_from_slice(&scale.to_le_bytes());
        d[136..144].copy_from_slice(&offset.to_le_bytes());
        d
    }

    #[test]
    fn normals_of_any_type_and_scale() {
        let descriptors = [
            descriptor(0, 3, "three bytes", 0.0, 0.0),
            descriptor(4, 8, "NormalX", 0.0001, 9.0),
            descriptor(13, 0, "two shorts", 0.0, 0.0),
            descriptor(1, 8 | 16, "normaly", 0.5, -1.0),
            descriptor(10, 0, "NORMALZ", 0.0, 0.0),
        ]
        .concat();
        let mut row = vec![0; 20 + 3 + 2 + 4 + 1 + 8];
        row[23..25].copy_from_slice(&(-5000i16).to_le_bytes());
        row[29] = 3;
        row[30..38].copy_from_slice(&0.25f64.to_le_bytes());
        let mut warnings = Vec::new();
        let fields = find_normal(&descriptors, 20..row.len(), &mut warnings);
        assert_eq!(fields.map(|f| f.map(|f| f.value(&row))), Some([-0.5, 0.5, 0.25]));
        assert!(warnings.is_empty());
        // Another name for the same axis does not take its place.
        let again = [descriptors.clone(), descriptor(9, 0, "nx", 0.0, 0.0)].concat();
        let longer = [row.clone(), 7f32.to_le_bytes().to_vec()].concat();
        let fields = find_normal(&again, 20..longer.len(), &mut warnings);
        assert_eq!(fields.map(|f| f[0].value(&longer)), Some(-0.5));
        // The record is a byte too short for the last of them.
        assert!(find_normal(&descriptors, 20..row.len() - 1, &mut warnings).is_none());
        assert_eq!(warnings.len(), 1);
    }
}
