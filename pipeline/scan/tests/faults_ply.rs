//! Broken and hostile PLY, by the rows of the catalogue of faults.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::time::{Duration, Instant};

use common::{LENIENT, SKIP, STRICT, file, points, read, refusal_of, report_of};
use pvmap_scan::Source;

/// A PLY file: format, the lines behind it (each with its newline), the body.
fn ply(format: &str, lines: &str, body: &[u8]) -> Vec<u8> {
    let mut bytes = format!("ply\nformat {format} 1.0\n{lines}end_header\n").into_bytes();
    bytes.extend_from_slice(body);
    bytes
}

fn xyz(n: &str) -> String {
    format!("element vertex {n}\nproperty float x\nproperty float y\nproperty float z\n")
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn f59_cut_anywhere() {
    let rows: Vec<f32> = (0..300).map(|i| i as f32).collect();
    let text: String = (0..100).map(|i| format!("{i} {i} 0\n")).collect();
    let lists = "element vertex 100\nproperty float x\nproperty list uchar int l\n\
                 property float y\nproperty float z\n";
    let listed: Vec<u8> = (0..100u32)
        .flat_map(|i| {
            let x = (i as f32).to_le_bytes();
            [&x[..], &[2], &[7; 8], &x, &x].concat()
        })
        .collect();
    for (name, good, body) in [
        ("fixed", ply("binary_little_endian", &xyz("100"), &floats(&rows)), 1200),
        ("text", ply("ascii", &xyz("100"), text.as_bytes()), text.len()),
        ("listed", ply("binary_little_endian", lists, &listed), listed.len()),
    ] {
        assert_eq!(report_of(&good, STRICT).unwrap().n_read, 100, "{name}");
        // The last line of a text may lack its newline.
        let last = good.len() - usize::from(name == "text");
        for cut in 0..last {
            refusal_of(&good[..cut], STRICT);
            let lenient = report_of(&good[..cut], LENIENT);
            let n_bytes = cut.saturating_sub(good.len() - body);
            let most = match name {
                "fixed" => n_bytes / 12,
                "listed" => n_bytes / 21,
                _ => 100,
            };
            match lenient {
                Ok(report) if name == "text" => assert!(report.n_read <= 100),
                Ok(report) => assert_eq!(report.n_read, most as u64, "{name} {cut}"),
                Err(_) => assert!(cut < good.len() - body, "{name} {cut}"),
            }
        }
    }
}

#[test]
fn f61_counts_that_cannot_be() {
    let start = Instant::now();
    for n in ["1152921504606846976", "18446744073709551615", "3"] {
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let bytes = ply(format, &xyz(n), &[b'1'; 12]);
            assert!(refusal_of(&bytes, STRICT).contains(&format!("declares {n} points")));
        }
    }
    for n in ["18446744073709551616", "-1", "1.5", "many", ""] {
        assert!(refusal_of(&ply("ascii", &xyz(n), b"1 2 3\n"), STRICT).contains("line 3"), "{n}");
    }
    // Also of an element that is only stepped over.
    let lines = format!("element pad 1152921504606846976\nproperty double p\n{}", xyz("1"));
    let bytes = ply("binary_little_endian", &lines, &floats(&[0.0; 5]));
    assert!(refusal_of(&bytes, STRICT).contains("declares 1152921504606846976 of pad"));
    assert!(start.elapsed() < Duration::from_secs(1));
}

#[test]
fn f62_an_element_without_properties_is_skipped_at_once() {
    let start = Instant::now();
    for (format, body) in
        [("ascii", b"1 2 3\n".to_vec()), ("binary_little_endian", floats(&[1.0, 2.0, 3.0]))]
    {
        let lines = format!("element nothing 1152921504606846976\n{}", xyz("1"));
        assert_eq!(report_of(&ply(format, &lines, &body), STRICT).unwrap().n_read, 1);
        // Vertices without properties have no place.
        refusal_of(&ply(format, "element vertex 1152921504606846976\n", &body), STRICT);
    }
    assert!(start.elapsed() < Duration::from_secs(1));
}

#[test]
fn f63_lists_of_impossible_length() {
    let lines = |index: &str| {
        format!("element face 1\nproperty list {index} double vertex_indices\n{}", xyz("1"))
    };
    let vertex = floats(&[1.0, 2.0, 3.0]);
    for (index, length) in [
        ("char", (-1i8).to_le_bytes().to_vec()),
        ("int", (-1i32).to_le_bytes().to_vec()),
        ("int", i32::MAX.to_le_bytes().to_vec()),
        ("uint", u32::MAX.to_le_bytes().to_vec()),
        ("uchar", vec![2]),
    ] {
        let body = [length, vertex.clone()].concat();
        let message = refusal_of(&ply("binary_little_endian", &lines(index), &body), STRICT);
        assert!(message.contains("vertex_indices of face") && message.contains("list of length"));
    }
    for index in ["float", "double"] {
        let message = refusal_of(&ply("binary_little_endian", &lines(index), &vertex), STRICT);
        assert!(message.contains("counted in fractions"));
    }
    let bytes = ply("ascii", &format!("{}property list list uchar int l\n", xyz("1")), b"1 2 3\n");
    assert!(refusal_of(&bytes, STRICT).contains("line 7"));
    let lines = format!("{}property list uchar int l\n", xyz("1"));
    for length in ["-1", "2", "2147483648", "99999999999", "nan", "1.0"] {
        let body = format!("1 2 3 {length} 7\n");
        let message = refusal_of(&ply("ascii", &lines, body.as_bytes()), STRICT);
        assert!(message.starts_with("line 9"), "{message}");
    }
    assert_eq!(report_of(&ply("ascii", &lines, b"1 2 3 2 7 7\n"), STRICT).unwrap().n_read, 1);
    let before = format!("element face 1\nproperty list uchar int vertex_indices\n{}", xyz("1"));
    for row in ["-1", "3 0 0", "1 0 0", "x"] {
        let bytes = ply("ascii", &before, format!("{row}\n1 2 3\n").as_bytes());
        let message = refusal_of(&bytes, STRICT);
        assert!(message.starts_with("line 10"), "{row}: {message}");
    }
    assert_eq!(report_of(&ply("ascii", &before, b"2 0 0\n1 2 3\n"), STRICT).unwrap().n_read, 1);
}

#[test]
fn f64_headers_beyond_the_limits() {
    let start = Instant::now();
    let no_end = b"ply\nformat ascii 1.0\nelement vertex 1\n".to_vec();
    assert!(refusal_of(&no_end, STRICT).contains("no end_header"));
    let long = [b"ply\nformat ascii 1.0\ncomment ".to_vec(), vec![b'x'; 1 << 26]].concat();
    assert!(refusal_of(&long, STRICT).contains("line 3: longer than 65536 bytes"));
    let comments = format!("ply\n{}", "comment nothing\n".repeat(1 << 17));
    assert!(refusal_of(comments.as_bytes(), STRICT).contains("no end_header within 10485"));
    let many: String = (0..5000).map(|i| format!("property float p{i}\n")).collect();
    let bytes = ply("ascii", &format!("{}{many}", xyz("1")), b"1 2 3\n");
    assert!(refusal_of(&bytes, STRICT).contains("more than 4096 of property"));
    let bytes = ply("ascii", &format!("{}property int x\n", xyz("1")), b"1 2 3 4\n");
    assert!(refusal_of(&bytes, STRICT).contains("line 7: a second property named x"));
    let bytes = ply("ascii", &format!("{}property int a\0b\nelement\n", xyz("1")), b"1 2 3 4\n");
    assert!(refusal_of(&bytes, STRICT).contains("line 8"));
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn f64_line_ends_blanks_and_odd_names() {
    let header = |nl: &str| {
        [
            "ply ",
            "format ascii 1.0",
            "comment nu\u{e9}",
            "obj_info",
            "element vertex 2 ",
            "property  float\tx",
            "property float y ",
            "property float z",
            "property float Dip (deg)",
            "end_header",
            "1 2 3 4",
            " 4\t5 6  4 ",
            "",
        ]
        .join(nl)
        .replace("Dip (deg)", "Dip_(deg)")
    };
    for nl in ["\n", "\r\n", "\r"] {
        let (_folder, path) = file("a.ply", header(nl).as_bytes());
        let (_, batches, report) = read(&path, STRICT).unwrap();
        assert_eq!(report.n_read, 2, "{nl:?}");
        assert_eq!(points(&batches)[1].place, [4.0, 5.0, 6.0]);
    }
    // A comment in Latin-1, and a body that begins with a newline byte.
    let mut bytes = b"ply\r\nformat binary_little_endian 1.0\r\ncomment \xe9\r\n".to_vec();
    bytes.extend_from_slice(xyz("1").replace('\n', "\r\n").as_bytes());
    bytes.extend_from_slice(b"end_header\r\n");
    bytes.extend_from_slice(&floats(&[f32::from_le_bytes([10, 13, 10, 64]), 2.0, 3.0]));
    assert_eq!(report_of(&bytes, STRICT).unwrap().n_read, 1);
    // Mixed: the last line of the header ends otherwise than the first.
    let bytes = String::from_utf8(ply("ascii", &xyz("1"), b"1 2 3\n")).unwrap();
    let bytes = bytes.replace("end_header\n", "end_header\r\n");
    assert_eq!(report_of(bytes.as_bytes(), STRICT).unwrap().n_read, 1);
}

#[test]
fn f65_n14_words_that_are_no_finite_number() {
    let body =
        |word: &str| ply("ascii", &xyz("3"), format!("0 0 0\n1 {word} 1\n2 2 2\n").as_bytes());
    for word in [
        "nan",
        "NaN",
        "-nan",
        "nan(ind)",
        "-nan(ind)",
        "inf",
        "-INF",
        "infinity",
        "1e400",
        "-1e400",
        "1.#QNAN",
        "-1.#IND",
        "1.#INF",
    ] {
        let message = refusal_of(&body(word), STRICT);
        assert!(message.starts_with("point 1: a coordinate is not finite"), "{word}: {message}");
        let report = report_of(&body(word), SKIP).unwrap();
        assert_eq!((report.n_read, report.n_dropped, report.first_dropped), (2, 1, Some(1)));
    }
    let digits = "1".repeat(1_000_000);
    for word in ["0x1p3", "1,5", "one", "--1", "1e", "\0", "\u{663}", digits.as_str()] {
        assert!(refusal_of(&body(word), STRICT).starts_with("line 9: "));
        assert!(refusal_of(&body(word), SKIP).starts_with("line 9: "));
    }
    for word in ["+1", "1.", ".5", "1E-3", "1e-400", "-0", "00012", &"1".repeat(30_000)[..30]] {
        assert_eq!(report_of(&body(word), STRICT).unwrap().n_read, 3, "{word}");
    }
}

#[test]
fn n14_invalid_coordinates_in_binary_are_dropped_and_counted() {
    let mut rows: Vec<f32> = (0..30_000).map(|i| i as f32).collect();
    for i in [5, 6, 7000, 9999] {
        rows[3 * i + i % 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][i % 3];
    }
    let bytes = ply("binary_little_endian", &xyz("10000"), &floats(&rows));
    assert!(refusal_of(&bytes, STRICT).starts_with("point 5: a coordinate is not finite"));
    let (_folder, path) = file("a.ply", &bytes);
    let (source, batches, report) = read(&path, SKIP).unwrap();
    assert_eq!((report.n_read, report.n_dropped, report.first_dropped), (9996, 4, Some(5)));
    let points = points(&batches);
    assert_eq!((points[4].record, points[5].record, points[5].place[0]), (4, 7, 21.0));
    let bounds = source.bounds_scan(0..10_000).unwrap();
    assert_eq!((bounds.min, bounds.max), ([0.0, 1.0, 2.0], [29_994.0, 29_995.0, 29_996.0]));
}

#[test]
fn bad_columns_are_refused_with_their_line() {
    for (row, problem) in [
        ("1 2", "line 9: 2 columns, expected 3 (z is missing)"),
        ("1 2 3 4", "line 9: 1 columns too many, expected 3"),
    ] {
        let bytes = ply("ascii", &xyz("2"), format!("0.000 0 0\n{row}\n").as_bytes());
        assert_eq!(refusal_of(&bytes, STRICT), problem);
    }
    let lines =
        format!("{}property uchar red\nproperty uchar green\nproperty uchar blue\n", xyz("1"));
    for (row, is_good) in
        [("255 0 7", true), ("255.0 0 7", true), ("256 0 7", false), ("-1 0 7", false)]
    {
        let bytes = ply("ascii", &lines, format!("1 2 3 {row}\n").as_bytes());
        assert_eq!(report_of(&bytes, STRICT).is_ok(), is_good, "{row}");
    }
}

#[test]
fn every_type_in_every_encoding() {
    let types = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"];
    let numbers = [-7.0f64, 250.0, -3000.0, 65_000.0, -70_000.0, 4e9, 0.5, 0.25];
    for axis in 0..8 {
        let lines = format!(
            "element vertex 1\nproperty {} x\nproperty {} y\nproperty {} z\n",
            types[axis],
            types[(axis + 1) % 8],
            types[(axis + 2) % 8]
        );
        let values = [0, 1, 2].map(|i| numbers[(axis + i) % 8]);
        let text = format!("{} {} {}", values[0], values[1], values[2]);
        let encode = |i: usize| -> Vec<u8> {
            let v = values[i];
            match (axis + i) % 8 {
                0 => (v as i8).to_be_bytes().to_vec(),
                1 => (v as u8).to_be_bytes().to_vec(),
                2 => (v as i16).to_be_bytes().to_vec(),
                3 => (v as u16).to_be_bytes().to_vec(),
                4 => (v as i32).to_be_bytes().to_vec(),
                5 => (v as u32).to_be_bytes().to_vec(),
                6 => (v as f32).to_be_bytes().to_vec(),
                _ => v.to_be_bytes().to_vec(),
            }
        };
        let big: Vec<u8> = (0..3).flat_map(encode).collect();
        let little: Vec<u8> =
            (0..3).flat_map(|i| encode(i).into_iter().rev().collect::<Vec<u8>>()).collect();
        for (format, body) in [
            ("ascii", text.as_bytes()),
            ("binary_big_endian", &big),
            ("binary_little_endian", &little),
        ] {
            let (_folder, path) = file("a.ply", &ply(format, &lines, body));
            let (_, batches, _) = read(&path, STRICT).unwrap();
            assert_eq!(points(&batches)[0].place, values, "{format} {lines}");
        }
    }
}

#[test]
fn an_empty_ply_has_no_parts() {
    let (_folder, path) = file("a.ply", &ply("ascii", &xyz("0"), b""));
    let source = Source::open(&path, 0, STRICT).unwrap();
    assert_eq!((source.info().n_points, source.parts(4).len()), (0, 0));
}
