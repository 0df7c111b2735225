//! What is written is read again, point for point; the same points give the same bytes.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::path::Path;

use common::{Point, STRICT, points, read, read_parts};
use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_scan::{
    ColorRange, Crs, ErrorKind, FieldKind, LasContent, LasOptions, LasWriter, PlyColumns,
    PlyExtras, PlyWriter, ScalarField, ScanError, Source,
};
use pvmap_store::AtomicFile;

/// Points `first..first + n` of a made-up scan on a lattice of 1 mm.
fn batch(first: u64, n: u64) -> PointBatch {
    let records: Vec<u64> = (first..first + n).collect();
    let each = |f: &dyn Fn(u64) -> f64| records.iter().map(|&i| f(i)).collect::<Vec<f64>>();
    let x = each(&|i| 500_000.0 + (i % 1000) as f64 * 0.001);
    let y = each(&|i| 4_600_000.0 - (i / 1000) as f64 * 0.001);
    PointBatch {
        source: 0,
        positions: Positions::Double(
            x.iter().zip(&y).map(|(&x, &y)| [x, y, (x * 7.0 - y).fract()]).collect(),
        ),
        color: Some(records.iter().map(|&i| [i as u8; 3].map(u16::from)).collect()),
        intensity: Some(Intensity::U16(records.iter().map(|&i| i as u16).collect())),
        classification: Some(records.iter().map(|&i| i as u8).collect()),
        gps_time: Some(each(&|i| i as f64 / 3.0)),
        normal: Some(records.iter().map(|&i| [(i % 7) as f32, -0.5, 1e-3]).collect()),
        records,
    }
}

const OPTIONS: LasOptions = LasOptions {
    compressed: false,
    scale: [0.001; 3],
    offset: [500_000.0, 4_600_000.0, 0.0],
    normals: true,
};

fn write_las(path: &Path, options: LasOptions, n: u64) {
    let mut writer = LasWriter::create(path, options).unwrap();
    for first in (0..n).step_by(7000) {
        writer.write(&batch(first, 7000.min(n - first))).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn las_and_laz() {
    let folder = tempfile::tempdir().unwrap();
    for (name, compressed) in [("a.las", false), ("a.laz", true)] {
        let path = folder.path().join(name);
        let options = LasOptions { compressed, ..OPTIONS };
        write_las(&path, options, 60_000);
        let first_bytes = std::fs::read(&path).unwrap();
        write_las(&path, options, 60_000);
        assert_eq!(std::fs::read(&path).unwrap(), first_bytes, "same points, same bytes");
        assert_eq!(first_bytes[90..94], [0; 4], "no date");

        let (source, batches, report) = read_parts(&path, STRICT, 3).unwrap();
        assert_eq!(report.n_read, 60_000);
        assert_eq!((report.color_max, report.n_outside_bounds), (255, 0));
        let written = points(&[batch(0, 60_000)]);
        let found = points(&batches);
        let (mut min, mut max) = ([i64::MAX; 3], [i64::MIN; 3]);
        for (a, b) in written.iter().zip(&found) {
            let place = [0, 1, 2].map(|i| ((a.place[i] - OPTIONS.offset[i]) / 0.001).round());
            for i in 0..3 {
                min[i] = min[i].min(place[i] as i64);
                max[i] = max[i].max(place[i] as i64);
            }
            assert_eq!(*b, Point { place, ..a.clone() });
        }
        assert_eq!(source.info().bounds, Some((min, max)), "{name}");
        assert!(source.info().warnings.is_empty());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1 + usize::from(compressed));
    }
}

#[test]
fn ply() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let columns = PlyColumns {
        double: true,
        normal: true,
        color: Some(ColorRange::Eight),
        intensity: true,
        classification: true,
        gps_time: true,
    };
    let mut writer = PlyWriter::create(&path, 20_000, columns).unwrap();
    writer.write(&batch(0, 5000)).unwrap();
    writer.write(&batch(5000, 15_000)).unwrap();
    writer.finish().unwrap();
    let (source, batches, _) = read_parts(&path, STRICT, 3).unwrap();
    let written = points(&[batch(0, 20_000)]);
    assert_eq!(points(&batches), written);
    let bounds = source.bounds_scan(0..20_000).unwrap();
    let least = |axis: usize| written.iter().map(|p| p.place[axis]).fold(f64::INFINITY, f64::min);
    assert_eq!(bounds.min, [0, 1, 2].map(least));

    let plain = PlyColumns { color: Some(ColorRange::Sixteen), ..PlyColumns::default() };
    let mut writer = PlyWriter::create(&path, 3, plain).unwrap();
    writer.write(&batch(7, 3)).unwrap();
    writer.finish().unwrap();
    let (_, batches, _) = read(&path, STRICT).unwrap();
    let p = &points(&batches)[2];
    assert_eq!((p.place[0], p.color, p.normal), (f64::from(500_000.009f32), Some([9; 3]), None));
}

#[test]
fn nothing_is_left_of_a_file_that_was_not_finished() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    for compressed in [false, true] {
        let mut writer = LasWriter::create(&path, LasOptions { compressed, ..OPTIONS }).unwrap();
        writer.write(&batch(0, 10)).unwrap();
        drop(writer);
    }
    let writer = PlyWriter::create(&path, 3, PlyColumns::default()).unwrap();
    assert!(matches!(writer.finish(), Err(ScanError::Write { .. })));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn what_does_not_fit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    let far = LasOptions { offset: [0.0; 3], scale: [1e-6; 3], ..OPTIONS };
    let mut writer = LasWriter::create(&path, far).unwrap();
    let error = writer.write(&batch(0, 1)).unwrap_err();
    assert!(error.to_string().contains("does not fit the lattice"), "{error}");
    let flat = LasOptions { scale: [0.0; 3], ..OPTIONS };
    assert!(LasWriter::create(&path, flat).is_err());
    let nowhere = folder.path().join("none/a.las");
    let error = LasWriter::create(&nowhere, OPTIONS).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::CannotCreate);
}

#[test]
fn an_empty_las_loads() {
    let folder = tempfile::tempdir().unwrap();
    for (name, compressed) in [("a.las", false), ("a.laz", true)] {
        let path = folder.path().join(name);
        write_las(&path, LasOptions { compressed, ..OPTIONS }, 0);
        let source = Source::open(&path, 0, STRICT).unwrap();
        assert_eq!((source.info().n_points, source.parts(2).len()), (0, 0));
        assert!(source.info().warnings.is_empty());
    }
}

#[test]
fn an_error_of_the_sink_passes_through() {
    #[derive(Debug)]
    enum Mine {
        Enough,
        Scan,
    }
    impl From<ScanError> for Mine {
        fn from(_: ScanError) -> Mine {
            Mine::Scan
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    write_las(&path, OPTIONS, 100);
    let source = Source::open(&path, 0, STRICT).unwrap();
    let stop = source.read(0..100, 10, |_| Err(Mine::Enough));
    assert!(matches!(stop, Err(Mine::Enough)));
    std::fs::write(&path, b"other").unwrap();
    assert!(matches!(source.read(0..100, 10, |_| Err(Mine::Enough)), Err(Mine::Scan)));
}

#[test]
fn a_sample_comes_from_all_over_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    let offset = [500_000.0, 4_600_000.0, 0.0];
    let options = LasOptions { compressed: false, scale: [0.001; 3], offset, normals: false };
    let mut writer = LasWriter::create(&path, options).unwrap();
    writer.write(&batch(0, 10_000)).unwrap();
    writer.finish().unwrap();
    let source = Source::open(&path, 0, STRICT).unwrap();
    let records: Vec<u64> =
        source.sample(800).unwrap().into_iter().flat_map(|batch| batch.records).collect();
    let expected: Vec<u64> =
        (0..100).flat_map(|place| (0..8).map(move |i| place * 100 + i)).collect();
    assert_eq!(records, expected);
    let all = source.sample(1 << 20).unwrap();
    assert_eq!(all.iter().map(PointBatch::len).sum::<usize>(), 10_000);
}

#[test]
fn geotiff_records_are_taken_apart_as_they_were_put_together() {
    let words = |v: &[u16]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    // Two keys: one that is a number, one that is the doubles 1 and 2.
    let keys = words(&[1, 1, 0, 2, 1024, 0, 1, 1, 2057, 34736, 2, 1]);
    let (doubles, texts) = (vec![7; 24], b"here|".to_vec());
    let all = [keys.as_slice(), &doubles, &texts].concat();
    let n_needed = keys.len() + doubles.len();
    assert_eq!(Crs::of_geotiff(&all), Some(Crs::GeoTiff { keys, doubles, texts }));
    for n in 0..n_needed {
        assert_eq!(Crs::of_geotiff(&all[..n]), None, "{n} bytes");
    }
}

#[test]
fn how_long_a_file_gets_is_known_before() {
    let folder = tempfile::tempdir().unwrap();
    let field = |name: &str, kind| ScalarField {
        name: name.to_owned(),
        description: "a text that has no room where it belongs, so".to_owned(),
        kind,
    };
    let fields = vec![field("a", FieldKind::U8), field("b", FieldKind::F64)];
    let values = |n: usize| vec![vec![1.0; n], vec![0.1; n]];
    let long = Some(Crs::Wkt(vec![b'x'; 100_000]));
    let keys = [1u16, 1, 0, 1, 1024, 0, 1, 1].into_iter().flat_map(u16::to_le_bytes).collect();
    let tiff = Some(Crs::GeoTiff { keys, doubles: Vec::new(), texts: vec![b'x'; 70_000] });
    for (crs, color, gps_time) in
        [(None, true, true), (None, false, true), (long, true, true), (tiff, false, false)]
    {
        let plain = LasContent { color, gps_time, crs, ..LasContent::default() };
        let content = LasContent { fields: fields.clone(), ..plain };
        let path = folder.path().join("a.las");
        let mut writer = LasWriter::create_with(&path, OPTIONS, &content).unwrap();
        writer.write_with(&batch(0, 32), &values(32)).unwrap();
        writer.finish().unwrap();
        let n_bytes = std::fs::metadata(&path).unwrap().len();
        assert_eq!(LasWriter::file_bytes(OPTIONS, &content, 32).unwrap(), n_bytes);
        assert_eq!(Source::open(&path, 0, STRICT).unwrap().info().crs, content.crs);
    }
    let all = PlyColumns {
        double: true,
        normal: true,
        color: Some(ColorRange::Eight),
        intensity: true,
        classification: true,
        gps_time: true,
    };
    let extras = PlyExtras { comments: vec!["mine".to_owned()], fields };
    for columns in
        [all, PlyColumns::default(), PlyColumns { color: Some(ColorRange::Sixteen), ..all }]
    {
        let path = folder.path().join("a.ply");
        let file = AtomicFile::create(&path).unwrap();
        let mut writer = PlyWriter::create_in(file, 32, columns, &extras).unwrap();
        writer.write_with(&batch(0, 32), &values(32)).unwrap();
        writer.finish().unwrap();
        let n_bytes = std::fs::metadata(&path).unwrap().len();
        assert_eq!(PlyWriter::file_bytes(32, columns, &extras), n_bytes);
    }
    let comments = vec!["two\nlines".to_owned()];
    let extras = PlyExtras { comments, ..PlyExtras::default() };
    let file = AtomicFile::create(&folder.path().join("b.ply")).unwrap();
    assert!(PlyWriter::create_in(file, 0, all, &extras).is_err());
}
