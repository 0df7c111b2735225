//! The public header block of LAS 1.0 to 1.5, checked against the file's length.

use pvmap_store::InputFile;

use crate::bytes::{f64_at, u16_at, u32_at, u64_at};
use crate::error::ScanError;

/// Bytes of a point record by point format, without extra bytes.
pub(crate) const RECORD_BYTES: [u16; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];

/// Length of the longest header that is looked at: that of LAS 1.4, which 1.5 begins with.
const HEADER_BYTES: usize = 375;

/// A header whose every offset lies inside the file and whose lattice is sound.
#[derive(Debug, Clone)]
pub(crate) struct Header {
    /// Major and minor version.
    pub(crate) version: (u8, u8),
    /// Bit 0 of the global encoding.
    pub(crate) is_gps_time_since_1980: bool,
    /// Bytes of the header.
    pub(crate) header_bytes: u64,
    /// Where the point records begin.
    pub(crate) points_offset: u64,
    /// Where they end at the latest: at the next thing in the file, or with it.
    pub(crate) points_end: u64,
    /// How many variable length records follow the header.
    pub(crate) n_vlrs: u32,
    /// Where the extended ones begin.
    pub(crate) evlrs_offset: u64,
    /// How many extended ones there are.
    pub(crate) n_evlrs: u32,
    /// 0…10.
    pub(crate) point_format: u8,
    /// Whether the points are compressed (LAZ).
    pub(crate) is_compressed: bool,
    /// Bytes of an uncompressed point record.
    pub(crate) record_bytes: u16,
    /// Points by the header.
    pub(crate) n_points: u64,
    /// World units per lattice step.
    pub(crate) scale: [f64; 3],
    /// World coordinate of step 0.
    pub(crate) offset: [f64; 3],
    /// The header's bounds in lattice steps, where they make sense.
    pub(crate) bounds: Option<([i64; 3], [i64; 3])>,
}

impl Header {
    /// Reads and checks the header; what is odd but harmless goes to `warnings`.
    pub(crate) fn read(file: &InputFile, warnings: &mut Vec<String>) -> Result<Header, ScanError> {
        let fail = |problem: String| ScanError::header(file.path(), "LAS header", problem);
        let n = file.len_bytes();
        let mut bytes = vec![0; n.min(HEADER_BYTES as u64) as usize];
        file.read_exact_at(&mut bytes, 0)?;
        if bytes.len() < 227 {
            return Err(fail(format!("the file ends after {n} bytes, a header has 227 or more")));
        }
        let version = (bytes[24], bytes[25]);
        let least = match version {
            (1, 0..=2) => 227,
            (1, 3) => 235,
            (1, 4) => 375,
            (1, 5) => 393,
            (a, b) => {
                return Err(fail(format!("version {a}.{b} is unknown, expected 1.0 to 1.5")));
            }
        };
        let header_bytes = u64::from(u16_at(&bytes, 94));
        if header_bytes < least || header_bytes > n {
            return Err(fail(format!(
                "header size {header_bytes}, expected {least} to {n} (the file's length)"
            )));
        }
        let has_14 = version >= (1, 4);
        let points_offset = u64::from(u32_at(&bytes, 96));
        if points_offset < header_bytes || points_offset > n {
            return Err(fail(format!(
                "points begin at byte {points_offset}, expected {header_bytes} to {n}"
            )));
        }
        let (point_format, is_compressed, record_bytes) = point_format(&bytes).map_err(fail)?;
        let (scale, offset) = lattice(&bytes).map_err(fail)?;
        let mut header = Header {
            version,
            is_gps_time_since_1980: bytes[6] & 1 == 1,
            header_bytes,
            points_offset,
            points_end: n,
            n_vlrs: u32_at(&bytes, 100),
            evlrs_offset: if has_14 { u64_at(&bytes, 235) } else { 0 },
            n_evlrs: if has_14 { u32_at(&bytes, 243) } else { 0 },
            point_format,
            is_compressed,
            record_bytes,
            n_points: count(&bytes, has_14, warnings),
            scale,
            offset,
            bounds: bounds(&bytes, scale, offset),
        };
        header.find_end(&bytes);
        if header.bounds.is_none() && header.n_points > 0 {
            // Max before min, an axis at a time.
            let axis = |at| format!("{:?} to {:?}", f64_at(&bytes, at + 8), f64_at(&bytes, at));
            let [x, y, z] = [179, 195, 211].map(axis);
            warnings.push(format!(
                "the header's bounds, x {x}, y {y}, z {z}, are inverted, infinite or off: not used"
            ));
        }
        Ok(header)
    }

    /// Gives how many uncompressed records there is room for.
    pub(crate) fn n_records_fit(&self) -> u64 {
        (self.points_end - self.points_offset) / u64::from(self.record_bytes)
    }

    /// Ends the points at the first thing that comes after them: wave packets or EVLRs.
    fn find_end(&mut self, bytes: &[u8]) {
        if self.n_evlrs > 0 && self.evlrs_offset >= self.points_offset {
            self.points_end = self.points_end.min(self.evlrs_offset);
        }
        if self.version >= (1, 3) {
            let waves = u64_at(bytes, 227);
            if waves > self.points_offset {
                self.points_end = self.points_end.min(waves);
            }
        }
    }
}

/// Reads the point format and the record length.
fn point_format(bytes: &[u8]) -> Result<(u8, bool, u16), String> {
    // Bit 7 marks LAZ; bit 6 marked an abandoned kind of it.
    let (id, is_compressed) = (bytes[104] & 0x7f, bytes[104] & 0x80 != 0);
    let Some(&least) = RECORD_BYTES.get(usize::from(id)) else {
        return Err(format!("point format {id} is unknown, expected 0 to 10"));
    };
    let record_bytes = u16_at(bytes, 105);
    if record_bytes < least {
        return Err(format!(
            "record length {record_bytes}, point format {id} needs {least} or more"
        ));
    }
    Ok((id, is_compressed, record_bytes))
}

/// Reads scale and offset and makes sure that every coordinate on the lattice is finite (F56).
fn lattice(bytes: &[u8]) -> Result<([f64; 3], [f64; 3]), String> {
    let scale = [131, 139, 147].map(|at| f64_at(bytes, at));
    let offset = [155, 163, 171].map(|at| f64_at(bytes, at));
    for (axis, (s, o)) in ["x", "y", "z"].iter().zip(scale.iter().zip(&offset)) {
        if !(s.is_normal() && *s > 0.0) {
            return Err(format!("{axis} scale {s}, expected a positive number"));
        }
        if !(o.is_finite() && (s * 2_147_483_648.0 + o.abs()).is_finite()) {
            return Err(format!("{axis} offset {o} with scale {s}: coordinates are not finite"));
        }
    }
    Ok((scale, offset))
}

/// Reads the point count; in LAS 1.4 the 64-bit one wins over the legacy one (F57).
fn count(bytes: &[u8], has_14: bool, warnings: &mut Vec<String>) -> u64 {
    let legacy = u64::from(u32_at(bytes, 107));
    if !has_14 {
        return legacy;
    }
    let n = u64_at(bytes, 247);
    if legacy != 0 && legacy != n {
        warnings.push(format!(
            "the header declares {n} points and, in its legacy field, {legacy}: the first counts"
        ));
    }
    n
}

/// Turns the header's bounds into lattice steps; none where no scan can have them.
fn bounds(bytes: &[u8], scale: [f64; 3], offset: [f64; 3]) -> Option<([i64; 3], [i64; 3])> {
    let step = |i: usize, at: usize| ((f64_at(bytes, at) - offset[i]) / scale[i]).round();
    // The header has max before min, an axis at a time.
    let max = [step(0, 179), step(1, 195), step(2, 211)];
    let min = [step(0, 187), step(1, 203), step(2, 219)];
    let is_sound = (0..3).all(|i| {
        min[i] <= max[i] && min[i] >= f64::from(i32::MIN) && max[i] <= f64::from(i32::MAX)
    });
    is_sound.then(|| (min.map(|v| v as i64), max.map(|v| v as i64)))
}
