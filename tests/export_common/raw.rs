//! LAS files made byte by byte, as no writer here makes them, and taken apart again.

use std::path::Path;

use fastrand::Rng;
use las::Reader;

/// Bytes of a point record by point format, without extra bytes.
const RECORD_BYTES: [usize; 11] = [20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67];
/// Bytes of a header by the minor version.
const HEADER_BYTES: [usize; 5] = [227, 227, 227, 235, 375];

/// A LAS in pieces: a floor, a centimetre a step, in records that are random otherwise.
pub struct Pieces {
    pub minor: u8,
    pub point_format: u8,
    /// Points along each side of the floor.
    pub side: u32,
    /// How high it is, in steps.
    pub z: i32,
    pub n_extra: usize,
    pub vlrs: Vec<Vec<u8>>,
    /// Behind the points, before extended records.
    pub between: Vec<u8>,
    pub evlrs: Vec<Vec<u8>>,
    /// Behind all.
    pub tail: Vec<u8>,
    /// How far behind the points the header says that wave packets begin.
    pub waves_at: Option<usize>,
}

impl Pieces {
    pub fn new(minor: u8, point_format: u8, side: u32) -> Pieces {
        Pieces {
            minor,
            point_format,
            side,
            z: 0,
            n_extra: 0,
            vlrs: Vec::new(),
            between: Vec::new(),
            evlrs: Vec::new(),
            tail: Vec::new(),
            waves_at: None,
        }
    }

    pub fn n_points(&self) -> u32 {
        self.side * self.side
    }

    /// Gives the bytes of a record.
    pub fn record_bytes(&self) -> usize {
        RECORD_BYTES[usize::from(self.point_format)] + self.n_extra
    }

    /// Joins them.
    pub fn joined(&self) -> Vec<u8> {
        let mut head = vec![0; HEADER_BYTES[usize::from(self.minor)]];
        let n = self.n_points();
        let start = head.len() + self.vlrs.concat().len();
        let end = start + n as usize * self.record_bytes();
        let mut put = |at: usize, bytes: &[u8]| head[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, b"LASF");
        put(24, &[1, self.minor]);
        put(94, &(HEADER_BYTES[usize::from(self.minor)] as u16).to_le_bytes());
        put(96, &(start as u32).to_le_bytes());
        put(100, &(self.vlrs.len() as u32).to_le_bytes());
        put(104, &[self.point_format]);
        put(105, &(self.record_bytes() as u16).to_le_bytes());
        let is_legacy = self.point_format < 6;
        put(107, &(if is_legacy { n } else { 0 }).to_le_bytes());
        put(111, &(if is_legacy { n } else { 0 }).to_le_bytes());
        for axis in 0..3 {
            put(131 + 8 * axis, &0.01f64.to_le_bytes());
            let (most, least) = match axis {
                2 => (self.z, self.z),
                _ => (self.side as i32 - 1, 0),
            };
            put(179 + 16 * axis, &(f64::from(most) * 0.01).to_le_bytes());
            put(187 + 16 * axis, &(f64::from(least) * 0.01).to_le_bytes());
        }
        if let Some(at) = self.waves_at {
            put(6, &[2]);
            put(227, &((end + at) as u64).to_le_bytes());
        }
        if self.minor >= 4 {
            let at = if self.evlrs.is_empty() { 0 } else { end + self.between.len() };
            put(235, &(at as u64).to_le_bytes());
            put(243, &(self.evlrs.len() as u32).to_le_bytes());
            put(247, &u64::from(n).to_le_bytes());
            put(255, &u64::from(n).to_le_bytes());
        }
        let behind = [self.between.clone(), self.evlrs.concat(), self.tail.clone()].concat();
        [head, self.vlrs.concat(), self.rows().concat(), behind].concat()
    }

    /// Gives its records.
    pub fn rows(&self) -> Vec<Vec<u8>> {
        let rng = &mut Rng::with_seed(71);
        let row = |i: u32| {
            let mut row: Vec<u8> = (0..self.record_bytes()).map(|_| rng.u8(..)).collect();
            let place = [(i % self.side) as i32, (i / self.side) as i32, self.z];
            for (slot, v) in row[..12].chunks_exact_mut(4).zip(place) {
                slot.copy_from_slice(&v.to_le_bytes());
            }
            // The only return.
            row[14] = if self.point_format < 6 { 0x09 } else { 0x11 };
            row
        };
        (0..self.n_points()).map(row).collect()
    }
}

/// Makes a plain record.
pub fn vlr(user_id: &str, record_id: u16, description: &str, data: &[u8]) -> Vec<u8> {
    record((user_id, record_id, description), &(data.len() as u16).to_le_bytes(), data)
}

/// Makes an extended record.
pub fn evlr(user_id: &str, record_id: u16, description: &str, data: &[u8]) -> Vec<u8> {
    record((user_id, record_id, description), &(data.len() as u64).to_le_bytes(), data)
}

fn record((user, id, text): (&str, u16, &str), n_bytes: &[u8], data: &[u8]) -> Vec<u8> {
    let mut out = vec![0xaa, 0xbb];
    out.extend(user.bytes().chain([0; 16]).take(16));
    out.extend(id.to_le_bytes());
    out.extend(n_bytes);
    out.extend(text.bytes().chain([0; 32]).take(32));
    [out, data.to_vec()].concat()
}

/// Describes extra bytes: their type, options and name.
pub fn descriptor(kind: u8, options: u8, name: &str) -> Vec<u8> {
    let mut bytes = vec![0; 192];
    (bytes[2], bytes[3]) = (kind, options);
    bytes[4..4 + name.len()].copy_from_slice(name.as_bytes());
    bytes
}

/// Gives the plain records of a file: their headers and what is in them.
pub fn vlrs(bytes: &[u8]) -> Vec<(Vec<u8>, Vec<u8>)> {
    let mut at = word(bytes, 94) & 0xffff;
    let each = |_| {
        let (head, rest) = bytes[at..].split_at(54);
        let n_bytes = word(head, 20) & 0xffff;
        at += 54 + n_bytes;
        (head.to_vec(), rest[..n_bytes].to_vec())
    };
    (0..word(bytes, 100)).map(each).collect()
}

/// Gives what is in the one record of a file that has this number.
pub fn payload(bytes: &[u8], record_id: u16) -> Vec<u8> {
    let mut all = vlrs(bytes).into_iter().filter(|v| v.0[18..20] == record_id.to_le_bytes());
    let found = all.next().unwrap().1;
    assert!(all.next().is_none(), "two records {record_id}");
    found
}

/// Gives the names that descriptors have.
pub fn names(descriptors: &[u8]) -> Vec<String> {
    let name = |d: &[u8]| String::from_utf8_lossy(&d[4..36]).trim_end_matches('\0').to_owned();
    descriptors.chunks_exact(192).map(name).collect()
}

/// Gives the bytes of all records, and how many a record has.
pub fn records(path: &Path) -> (Vec<u8>, usize) {
    let bytes = std::fs::read(path).unwrap();
    if bytes[104] & 0x80 == 0 {
        let (start, n_bytes) = (word(&bytes, 96), word(&bytes, 105) & 0xffff);
        return (bytes[start..start + n_points(&bytes) * n_bytes].to_vec(), n_bytes);
    }
    let points = Reader::from_path(path).unwrap().read_all().unwrap();
    (points.raw_bytes().to_vec(), points.record_len())
}

/// Gives how many points a header declares.
pub fn n_points(bytes: &[u8]) -> usize {
    word(bytes, if bytes[25] > 3 { 247 } else { 107 })
}

/// Reads a number of 32 bits.
pub fn word(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize
}
