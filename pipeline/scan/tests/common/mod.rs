//! What the tests of this room share: small files built byte by byte, and reading them to the end.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]

use std::path::{Path, PathBuf};

use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_scan::{ErrorKind, ReadOptions, ReadReport, ScanError, Source};

pub const STRICT: ReadOptions = ReadOptions { skip_invalid: false, lenient: false };
pub const LENIENT: ReadOptions = ReadOptions { skip_invalid: false, lenient: true };
pub const SKIP: ReadOptions = ReadOptions { skip_invalid: true, lenient: false };

/// The folder of real files, or none (said aloud) where it is absent.
pub fn data(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("skipped: no {}", path.display());
    None
}

/// A folder and a file in it with these bytes.
pub fn file(name: &str, bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

/// Reads a whole file, in `n_parts` parts and small batches: all its points in one batch.
pub fn read_parts(
    path: &Path,
    options: ReadOptions,
    n_parts: u64,
) -> Result<(Source, Vec<PointBatch>, ReadReport), ScanError> {
    let source = Source::open(path, 3, options)?;
    let mut batches = Vec::new();
    let mut sum = ReadReport::default();
    for part in source.parts(n_parts) {
        let report = source.read(part.clone(), 1000, |batch| {
            assert!(batch.len() <= 1000 && batch.source == 3);
            batches.push(batch);
            Ok::<(), ScanError>(())
        })?;
        let n = part.end - part.start;
        assert_eq!(report.n_read + report.n_dropped + report.n_missing, n, "{part:?}");
        sum = sum.join(&report);
    }
    assert_eq!(sum.n_read, batches.iter().map(|b| b.len() as u64).sum::<u64>());
    Ok((source, batches, sum))
}

/// Reads a whole file as one part.
pub fn read(
    path: &Path,
    options: ReadOptions,
) -> Result<(Source, Vec<PointBatch>, ReadReport), ScanError> {
    read_parts(path, options, 1)
}

/// Reads bytes as a file and gives the report.
pub fn report_of(bytes: &[u8], options: ReadOptions) -> Result<ReadReport, ScanError> {
    let (_folder, path) = file("bytes", bytes);
    read(&path, options).map(|(_, _, report)| report)
}

/// Reads bytes that must be refused as bad data, and gives the message behind the file's name.
pub fn refusal_of(bytes: &[u8], options: ReadOptions) -> String {
    let error = report_of(bytes, options).expect_err("must be refused");
    assert_eq!(error.kind(), ErrorKind::BadData, "{error}");
    let text = error.to_string();
    assert!(!text.contains('\n'), "one line: {text}");
    text.split_once("bytes: ").map(|(_, message)| message.to_owned()).unwrap_or(text)
}

/// One point, whatever its columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    pub record: u64,
    pub place: [f64; 3],
    pub color: Option<[u16; 3]>,
    pub intensity: Option<f32>,
    pub class: Option<u8>,
    pub gps_time: Option<f64>,
    pub normal: Option<[f32; 3]>,
}

/// Gives point `i` over all batches.
pub fn point(batches: &[PointBatch], mut i: usize) -> Point {
    let batch = batches
        .iter()
        .find(|b| {
            let is_here = i < b.len();
            if !is_here {
                i -= b.len();
            }
            is_here
        })
        .expect("there are so many points");
    Point {
        record: batch.records[i],
        place: match &batch.positions {
            Positions::Lattice(v) => v[i].map(f64::from),
            Positions::Single(v) => v[i].map(f64::from),
            Positions::Double(v) => v[i],
        },
        color: batch.color.as_ref().map(|v| v[i]),
        intensity: batch.intensity.as_ref().map(|v| match v {
            Intensity::U16(v) => f32::from(v[i]),
            Intensity::F32(v) => v[i],
        }),
        class: batch.classification.as_ref().map(|v| v[i]),
        gps_time: batch.gps_time.as_ref().map(|v| v[i]),
        normal: batch.normal.as_ref().map(|v| v[i]),
    }
}

/// Gives all points in record order.
pub fn points(batches: &[PointBatch]) -> Vec<Point> {
    let n = batches.iter().map(PointBatch::len).sum();
    let mut all: Vec<Point> = (0..n).map(|i| point(batches, i)).collect();
    all.sort_by_key(|p| p.record);
    all
}

/// Overwrites bytes.
pub fn patch(bytes: &mut [u8], at: usize, with: &[u8]) {
    bytes[at..at + with.len()].copy_from_slice(with);
}

/// A LAS 1.2 file of point format 0 with `n` points at (i, 2i, 3i), scale 0.01.
pub fn las_12(n: u32) -> Vec<u8> {
    let mut bytes = header(2, 227, 0, 20, n);
    for i in 0..n as i32 {
        let mut record = [0; 20];
        for (axis, step) in [i, 2 * i, 3 * i].into_iter().enumerate() {
            patch(&mut record, 4 * axis, &step.to_le_bytes());
        }
        bytes.extend_from_slice(&record);
    }
    bytes
}

/// A LAS 1.4 file of point format 6 with `n` points at (i, 2i, 3i), scale 0.01.
pub fn las_14(n: u32) -> Vec<u8> {
    let mut bytes = header(4, 375, 6, 30, 0);
    patch(&mut bytes, 247, &u64::from(n).to_le_bytes());
    for i in 0..n as i32 {
        let mut record = [0; 30];
        for (axis, step) in [i, 2 * i, 3 * i].into_iter().enumerate() {
            patch(&mut record, 4 * axis, &step.to_le_bytes());
        }
        bytes.extend_from_slice(&record);
    }
    bytes
}

fn header(minor: u8, n_bytes: u16, format: u8, record_bytes: u16, n: u32) -> Vec<u8> {
    let mut bytes = vec![0; usize::from(n_bytes)];
    patch(&mut bytes, 0, b"LASF");
    patch(&mut bytes, 24, &[1, minor]);
    patch(&mut bytes, 94, &n_bytes.to_le_bytes());
    patch(&mut bytes, 96, &u32::from(n_bytes).to_le_bytes());
    bytes[104] = format;
    patch(&mut bytes, 105, &record_bytes.to_le_bytes());
    patch(&mut bytes, 107, &n.to_le_bytes());
    for axis in 0..3 {
        patch(&mut bytes, 131 + 8 * axis, &0.01f64.to_le_bytes());
        patch(&mut bytes, 179 + 16 * axis, &1e6f64.to_le_bytes());
        patch(&mut bytes, 187 + 16 * axis, &0f64.to_le_bytes());
    }
    bytes
}

/// A VLR or, with `is_extended`, an EVLR.
pub fn vlr(user: &str, id: u16, payload: &[u8], is_extended: bool) -> Vec<u8> {
    let mut bytes = vec![0; 20];
    patch(&mut bytes, 2, user.as_bytes());
    patch(&mut bytes, 18, &id.to_le_bytes());
    if is_extended {
        bytes.extend_from_slice(&(payload.len() as u64).to_le_bytes());
    } else {
        bytes.extend_from_slice(&(payload.len() as u16).to_le_bytes());
    }
    bytes.extend_from_slice(&[0; 32]);
    bytes.extend_from_slice(payload);
    bytes
}

/// A LAZ file through the `las` crate: point format 1 (coded point by point, LAS 1.2) or 7 (in
/// layers, LAS 1.4), in chunks of 50 000.
pub fn laz(format: u8, n: u32, place: impl Fn(u32) -> [i32; 3]) -> Vec<u8> {
    let mut point_format = las::point::Format::new(format).unwrap();
    point_format.is_compressed = true;
    let mut builder = las::Builder::default();
    builder.version = las::Version::new(1, if format < 6 { 2 } else { 4 });
    builder.point_format = point_format;
    let out = std::io::Cursor::new(Vec::new());
    let mut writer = las::Writer::new(out, builder.into_header().unwrap()).unwrap();
    let record_bytes = usize::from(point_format.len());
    let mut raw = vec![0; n as usize * record_bytes];
    for (i, row) in raw.chunks_exact_mut(record_bytes).enumerate() {
        for (axis, step) in place(i as u32).into_iter().enumerate() {
            patch(row, 4 * axis, &step.to_le_bytes());
        }
    }
    let points = las::PointDataBuilder::new()
        .with_format(point_format)
        .with_transforms(*writer.header().transforms())
        .build_from_bytes(raw)
        .unwrap();
    writer.write_points(&points).unwrap();
    writer.into_inner().unwrap().into_inner()
}

/// Where the points of a LAS file begin.
pub fn points_offset(bytes: &[u8]) -> usize {
    u32::from_le_bytes([bytes[96], bytes[97], bytes[98], bytes[99]]) as usize
}

/// Numbers that look random and are always the same.
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, n: usize) -> usize {
        // xorshift64*
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % n
    }
}
