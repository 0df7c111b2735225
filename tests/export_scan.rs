//! Exports onto a scan's own file: every byte of it comes back, with fields that are those of the
//! points of the octree.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use std::path::Path;

use cli_common::{Bench, TWO_THREADS, data, floor};
use export_common::raw::{records, word};
use export_common::{FIELD_BYTES, FIELDS, fields_of, python, scan};
use fastrand::Rng;
use las::point::Format;
use las::{Builder, PointDataBuilder, Reader, Transform, Vector, Vlr, Writer};
use pvmap::geometry::Positions;

/// Bytes of a header that an export changes: the software, where the points are and what they are
/// like, where extended records are.
const CHANGED: [std::ops::Range<usize>; 4] = [58..90, 96..107, 227..235, 235..247];
/// What the extra bytes of these scans are: u16, u8, and one that nobody described.
const EXTRA_BYTES: u16 = 4;
/// Where step 0 of these scans is, along each axis.
const OFFSET: f64 = -7.0;

fn vlr(user_id: &str, record_id: u16, data: Vec<u8>) -> Vlr {
    Vlr { user_id: user_id.into(), record_id, description: "of the scanner".into(), data }
}

/// Describes two extra bytes, one of them by the name of a field.
fn descriptors() -> Vec<u8> {
    let mut bytes = vec![0; 2 * 192];
    (bytes[2], bytes[192 + 2]) = (3, 1);
    bytes[4..14].copy_from_slice(b"echo_width");
    bytes[196..208].copy_from_slice(b"visible_from");
    bytes
}

/// Gives a floor and a ceiling with a plate between them, a millimetre a step, in records that are
/// random otherwise.
fn rows(format: &Format, seed: u64) -> Vec<u8> {
    let rng = &mut Rng::with_seed(seed);
    let Positions::Double(places) = scan(30, seed).positions else { panic!("other positions") };
    let mut rows = Vec::new();
    for place in places {
        let at = rows.len();
        rows.resize_with(at + usize::from(format.len()), || rng.u8(..));
        for (slot, v) in rows[at..at + 12].chunks_exact_mut(4).zip(place) {
            slot.copy_from_slice(&(((v - OFFSET) * 1000.0).round() as i32).to_le_bytes());
        }
        if !format.is_extended {
            // A header before LAS 1.4 counts five returns, and the crate takes no more.
            rows[at + 14] = rows[at + 14] & 0xf8 | rng.u8(1..6);
        }
    }
    rows
}

/// Writes a scan of a point format with all that a surveyor's file has.
fn write(path: &Path, point_format: u8, seed: u64) {
    let mut format = Format::new(point_format).unwrap();
    format.extra_bytes = EXTRA_BYTES;
    format.is_compressed = path.extension().unwrap() == "laz";
    let mut builder = Builder::default();
    builder.point_format = format;
    builder.version = las::Version::new(1, if point_format < 4 { 2 } else { 4 });
    builder.file_source_id = 77;
    builder.guid = "6ba7b810-9dad-11d1-80b4-00c04fd430c8".parse().unwrap();
    builder.system_identifier = "a scanner".into();
    builder.generating_software = "its own".into();
    builder.padding = vec![3, 4, 5];
    builder.vlr_padding = vec![6; 7];
    let along = Transform { scale: 0.001, offset: OFFSET };
    let transforms = Vector { x: along, y: along, z: along };
    builder.transforms = transforms;
    builder.vlrs = vec![
        vlr("LASF_Projection", 4711, b"half a system".to_vec()),
        vlr("LASF_Spec", 4, descriptors()),
        vlr("scanner", 9, vec![1; 300]),
    ];
    if point_format >= 6 {
        let long = vlr("scanner", 10, (0..70_000u32).map(|v| v as u8).collect());
        builder.evlrs = vec![long, vlr("scanner", 11, vec![8; 20])];
    }
    let mut writer = Writer::from_path(path, builder.into_header().unwrap()).unwrap();
    let points = PointDataBuilder::new().with_format(format).with_transforms(transforms);
    writer.write_points(&points.build_from_bytes(rows(&format, seed)).unwrap()).unwrap();
    writer.close().unwrap();
}

/// Ingests and builds `name`, whose normals are estimated.
fn build(bench: &Bench, name: &str) {
    bench.line(&format!("ingest {name} -o a.octree --overwrite")).ok();
    bench.line("build a.octree --max-level 4 -o a.vmap").ok();
}

/// Holds an output against the scan it was made of, and its fields against `fields`.
fn assert_kept(bench: &Bench, (name, output): (&str, &str), fields: &[u8], what: &str) {
    let ((was, was_bytes), (is, is_bytes)) =
        (records(&bench.path(name)), records(&bench.path(output)));
    let added = fields.len() / (was.len() / was_bytes);
    assert_eq!(is_bytes, was_bytes + added, "{what}");
    assert_eq!(is.len() / is_bytes, was.len() / was_bytes, "{what}");
    for (i, row) in is.chunks_exact(is_bytes).enumerate() {
        assert_eq!(row[..was_bytes], was[i * was_bytes..][..was_bytes], "{what}, record {i}");
        assert_eq!(row[was_bytes..], fields[i * added..][..added], "{what}, record {i}");
    }
    let (was, is) = (bench.read(name), bench.read(output));
    let header_bytes = word(&was, 94) & 0xffff;
    for at in 0..header_bytes {
        let is_changed = CHANGED.iter().any(|r| r.contains(&at)) && (at < 227 || was[25] > 3);
        assert!(is_changed || was[at] == is[at], "{what}: byte {at} of the header");
    }
    assert!(is[58..].starts_with(b"pvmap export\0"));
    let (was_head, is_head) = (
        Reader::from_path(bench.path(name)).unwrap().header().clone(),
        Reader::from_path(bench.path(output)).unwrap().header().clone(),
    );
    let other = |v: &&Vlr| v.user_id != "laszip encoded" && v.record_id != 4;
    let [was_vlrs, is_vlrs] =
        [&was_head, &is_head].map(|h| h.vlrs().iter().filter(other).cloned().collect::<Vec<Vlr>>());
    assert_eq!(was_vlrs, is_vlrs, "{what}");
    if was[25] > 3 {
        let tail = |bytes: &[u8]| (word(bytes, 243), bytes[word(bytes, 235)..].to_vec());
        if word(&was, 243) > 0 {
            assert!(tail(&was) == tail(&is), "{what}: extended records");
        }
    }
}

/// Gives the fields of all points as bytes, from an export that knows the points alone.
fn plain_fields(bench: &Bench) -> Vec<u8> {
    bench.line(&format!("export a.vmap --points plain.las --overwrite {FIELDS}")).ok();
    let (rows, n) = records(&bench.path("plain.las"));
    rows.chunks_exact(n).flat_map(|row| row[n - FIELD_BYTES..].to_vec()).collect()
}

#[test]
fn every_byte_of_a_las_of_any_format_comes_back() {
    for point_format in [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10] {
        for name in ["a.las", "a.laz"] {
            let bench = Bench::new();
            write(&bench.path(name), point_format, 51);
            build(&bench, name);
            let fields = plain_fields(&bench);
            assert!(fields_of(&bench.path("plain.las")).iter().any(|f| f[0] == 1 && f[1] > 1));
            for output in ["out.las", "out.laz"] {
                let line = format!("export a.vmap --points {output} --scan {name} {FIELDS}");
                let run = bench.line(&line).ok();
                let names = "visible_from_2, sees_count, leaf, level, bin, visible_from_3";
                assert!(run.stdout.contains(names), "{}", run.stdout);
                let what = format!("format {point_format}, {name} to {output}");
                assert_kept(&bench, (name, output), &fields, &what);
                // It is a scan like any other, and of it the same can be made.
                let line = format!("export a.vmap --points next.las --scan {output} --overwrite");
                bench.line(&line).ok();
                assert_kept(&bench, (output, "next.las"), &[], &what);
            }
        }
    }
}

#[test]
fn extra_bytes_of_a_scan_keep_their_names_and_fields_stand_behind_them() {
    let bench = Bench::new();
    write(&bench.path("a.las"), 8, 52);
    build(&bench, "a.las");
    for output in ["out.las", "out.laz"] {
        bench.line(&format!("export a.vmap --points {output} --scan a.las {FIELDS}")).ok();
    }
    let found = Reader::from_path(bench.path("out.las")).unwrap();
    let vlr = found.header().vlrs().iter().find(|v| v.record_id == 4).unwrap();
    let names: Vec<&str> = vlr
        .data
        .chunks_exact(192)
        .map(|d| std::str::from_utf8(&d[4..36]).unwrap().trim_end_matches('\0'))
        .collect();
    // A byte that nobody described gets a name, so that those behind it have their places.
    let expected = ["echo_width", "visible_from", "unnamed_1", "visible_from_2", "sees_count"];
    assert_eq!(names[..5], expected);
    let script = "
import laspy, numpy as np
assert laspy.LazBackend.detect_available()
a = laspy.read('a.las')
for name in ['out.las', 'out.laz']:
    b = laspy.read(name)
    same = list(a.point_format.standard_dimension_names) + ['echo_width', 'visible_from']
    for d in same:
        assert np.array(a[d]).tobytes() == np.array(b[d]).tobytes(), (name, d)
    names = list(b.point_format.extra_dimension_names)
    assert names[-6:] == 'visible_from_2 sees_count leaf level bin visible_from_3'.split(), names
    assert 0 < np.array(b['visible_from_2']).mean() < 1 and b['sees_count'].max() > 1
    assert (a.header.uuid, a.header.creation_date, a.header.file_source_id) == (
        b.header.uuid, b.header.creation_date, b.header.file_source_id)
    assert a.header.system_identifier == b.header.system_identifier
    assert (a.header.mins == b.header.mins).all() and (a.header.maxs == b.header.maxs).all()
    assert (a.header.number_of_points_by_return == b.header.number_of_points_by_return).all()
    evlrs = [[(v.user_id, v.record_id, v.record_data_bytes()) for v in f.evlrs] for f in (a, b)]
    assert evlrs[0] == evlrs[1] and len(evlrs[0]) == 2
";
    python(&bench, "laspy", script);
}

#[test]
fn a_scan_that_the_octree_was_not_made_of_is_refused() {
    let bench = Bench::new();
    write(&bench.path("a.las"), 6, 53);
    build(&bench, "a.las");
    let line = "export a.vmap --points out.las --field leaf --scan";
    // A record that is elsewhere; a millimetre, which is far more than a step of the grid.
    let mut bytes = bench.read("a.las");
    let at = word(&bytes, 96) + 1000 * (word(&bytes, 105) & 0xffff);
    bytes[at] ^= 1;
    bench.write("moved.las", &bytes);
    let words = ["moved.las", "not the scan", "record 1000 is at"];
    bench.line(&format!("{line} moved.las")).fails(65, &words);
    // Other bytes of a record may be changed.
    bytes[at] ^= 1;
    bytes[at + 17] ^= 1;
    bench.write("edited.las", &bytes);
    bench.line(&format!("{line} edited.las --overwrite")).ok();
    // Of another size.
    std::fs::remove_file(bench.path("out.las")).unwrap();
    cli_common::write_las(&bench.path("small.las"), 9, floor(3));
    bench.line(&format!("{line} small.las")).fails(65, &["small.las", "9 records", "a.las (2700)"]);
    bench.line(&format!("{line} none.las")).fails(66, &["none.las"]);
    bench.write("b.ply", cli_common::room_ply(12));
    bench.line(&format!("{line} b.ply")).fails(2, &["b.ply", ".ply"]);
    let line = "export a.vmap --points out.ply --scan a.las";
    bench.line(line).fails(2, &["a.las", ".las or .laz"]);
    let line = "export a.vmap --points a.las --overwrite --scan a.las";
    bench.line(line).fails(2, &["one of the inputs"]);
    bench.line("export a.vmap --scan a.las --surfels s.csv").exits(2);
    let left = ["a.las", "a.octree", "a.vmap", "b.ply", "edited.las", "moved.las", "small.las"];
    assert_eq!(bench.names(), left);
}

#[test]
fn one_of_several_scans_is_found_by_its_records_and_its_name() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("other")).unwrap();
    for (name, seed) in [("a.las", 54), ("b.laz", 55), ("other/a.las", 56)] {
        write(&bench.path(name), 7, seed);
    }
    cli_common::write_las(&bench.path("c.las"), 400, floor(20));
    let export = |scan: &str| {
        bench.line(&format!(
            "export a.vmap --points out.las --overwrite --scan {scan} --field source --field record"
        ))
    };
    let ingest = |scans: &str| {
        bench.line(&format!("ingest {scans} -o a.octree --overwrite")).ok();
        bench.line("build a.octree --max-level 4 -o a.vmap").ok();
    };
    ingest("a.las c.las b.laz");
    for (scan, number, n_points) in
        [("a.las", 0u32, 2700u32), ("c.las", 1, 400), ("b.laz", 2, 2700)]
    {
        assert!(export(scan).ok().stdout.contains(&format!("points    {n_points};")));
        let of = |i: u32| [number.to_le_bytes(), i.to_le_bytes()].concat();
        let fields: Vec<u8> = (0..n_points).flat_map(of).collect();
        if scan == "c.las" {
            let (rows, n) = records(&bench.path("out.las"));
            assert!(rows.chunks_exact(n).flat_map(|r| &r[n - 8..]).eq(&fields));
        } else {
            assert_kept(&bench, (scan, "out.las"), &fields, scan);
        }
    }
    // By the number of records alone it could be either.
    std::fs::copy(bench.path("b.laz"), bench.path("copy.laz")).unwrap();
    export("copy.laz").fails(65, &["copy.laz", "name", "a.las (2700), b.laz (2700)"]);
    std::fs::copy(bench.path("c.las"), bench.path("copy.las")).unwrap();
    export("copy.las").ok();
    // Of one name and number of records the first point tells.
    ingest("a.las other/a.las");
    for (scan, number) in [("a.las", 0u32), ("other/a.las", 1)] {
        export(scan).ok();
        let (rows, n) = records(&bench.path("out.las"));
        assert!(rows.chunks_exact(n).all(|r| r[n - 8..n - 4] == number.to_le_bytes()), "{scan}");
    }
    let mut moved = bench.read("a.las");
    let at = word(&moved, 96);
    moved[at] ^= 0x80;
    std::fs::create_dir(bench.path("third")).unwrap();
    bench.write("third/a.las", moved);
    export("third/a.las").fails(65, &["third/a.las", "begin with another point"]);
    std::fs::copy(bench.path("a.las"), bench.path("other/a.las")).unwrap();
    ingest("a.las other/a.las");
    export("a.las").fails(65, &["a.las", "several scans of this name", "first point"]);
}

#[test]
fn what_a_cut_file_has_is_written_with_counts_that_are_true() {
    let bench = Bench::new();
    write(&bench.path("a.las"), 7, 57);
    let whole = bench.read("a.las");
    bench.write("cut.las", &whole[..word(&whole, 96) + 1005 * (word(&whole, 105) & 0xffff)]);
    bench.line("ingest cut.las -o a.octree --lenient").ok();
    bench.line("build a.octree --max-level 4 -o a.vmap").ok();
    bench.line("export a.vmap --points out.laz --scan cut.las").ok();
    let (rows, n) = records(&bench.path("out.laz"));
    assert!(rows == records(&bench.path("a.las")).0[..1005 * n]);
    // The count, and those of the returns from the first on.
    let bytes = bench.read("out.laz");
    assert_eq!(word(&bytes, 247), 1005);
    for number in 1..16 {
        let n_of = rows.chunks_exact(n).filter(|r| usize::from(r[14] & 15) == number).count();
        assert_eq!(word(&bytes, 255 + 8 * (number - 1)), n_of, "{number}");
    }
    // The bounds, too: max and min, an axis at a time.
    for axis in 0..3 {
        let steps = rows.chunks_exact(n).map(|r| word(r, 4 * axis) as u32 as i32);
        let world = |step: Option<i32>| f64::from(step.unwrap()) * 0.001 + OFFSET;
        let expected = [world(steps.clone().max()), world(steps.min())];
        let at = 179 + 16 * axis;
        assert_eq!(bytes[at..at + 16], expected.map(f64::to_le_bytes).concat(), "axis {axis}");
    }
}

#[test]
fn d9_a_scan_is_written_again_within_the_memory() {
    let bench = Bench::new();
    cli_common::write_las(&bench.path("a.las"), 1_440_000, floor(1200));
    bench.line("ingest a.las --normals none").ok();
    bench.line("build a.octree --max-level 5").ok();
    for output in ["out.las", "out.laz"] {
        let line = "export a.vmap --scan a.las --field sees-count --field record --memory 64MiB \
                    --points";
        let words = line.split_whitespace().chain([output]).chain(TWO_THREADS);
        bench.run(words).ok().within(64);
        let (rows, n) = records(&bench.path(output));
        assert_eq!((rows.len() / n, n), (1_440_000, 44));
        let numbers = rows.chunks_exact(n).map(|r| word(r, 40));
        assert!(numbers.eq(0..1_440_000));
    }
}

#[test]
fn files_of_other_programs_keep_their_records() {
    let Some(folder) = data("las_conformance") else { return };
    // With returns, wave packets, extended records, extra bytes; indexed; of LAS 1.0 to 1.5.
    for name in [
        "PDAL_1.0_1.las",
        "laspy_1_4_w_evlr.las",
        "laspy_1_4_w_evlr.laz",
        "laspy_autzen_trim.laz",
        "laspy_extrabytes.las",
        "laspy_fullwave.laz",
        "laspy_simple.copc.laz",
        "r-lidar_Megaplot.laz",
        "visgl_pdrf10-1.4.las",
        "visgl_pdrf10-1.5.las",
    ] {
        let bench = Bench::new();
        std::os::unix::fs::symlink(folder.join(name), bench.path(name)).unwrap();
        bench.line(&format!("ingest {name} -o a.octree --normals none")).ok();
        bench.line("build a.octree --max-level 4 -o a.vmap").ok();
        for output in ["out.las", "out.laz"] {
            let line = format!("export a.vmap --points {output} --scan {name} --field record");
            let run = bench.line(&line).ok();
            if name.contains("copc") {
                run.warns(&[output, "no COPC any more"]);
            }
            if output == "out.laz" && name.contains("1.5") {
                // What has no reader here that could hold it against the scan.
                continue;
            }
            let (was, n_was) = records(&bench.path(name));
            let (is, n_is) = records(&bench.path(output));
            assert_eq!((n_is, is.len() / n_is), (n_was + 4, was.len() / n_was), "{name}");
            assert!(was.chunks_exact(n_was).any(|row| row[14] & 7 > 1), "{name}: returns");
            for ((was, is), i) in was.chunks_exact(n_was).zip(is.chunks_exact(n_is)).zip(0..) {
                assert!(*was == is[..n_was] && word(is, n_was) == i, "{name}: record {i}");
            }
        }
    }
}
