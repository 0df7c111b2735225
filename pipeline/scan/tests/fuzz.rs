//! Flipped bytes and cuts at random (always the same): no panic, no abort, and what loads accounts
//! for every record.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use common::{LENIENT, Random, STRICT, file, las_12, las_14, laz, read_parts, vlr};
use pvmap_scan::{ErrorKind, Source};

/// Small files of every kind, each with the bytes in which a flip matters most.
fn samples() -> Vec<(&'static str, Vec<u8>, usize)> {
    let mut las = las_14(50);
    let at = las.len() as u64;
    common::patch(&mut las, 235, &at.to_le_bytes());
    common::patch(&mut las, 243, &1u32.to_le_bytes());
    las.extend(vlr("LASF_Projection", 2112, b"GEOGCS[]", true));
    let rows: String = (0..50).map(|i| format!("{i} 2.5 -3e1 2 7 8\n")).collect();
    let text = format!(
        "ply\nformat ascii 1.0\nelement vertex 50\nproperty float x\nproperty double y\n\
         property float z\nproperty list uchar int l\nend_header\n{rows}"
    );
    let mut listed = text[..text.find("end_header").unwrap()].replace("ascii", "binary_big_endian");
    listed.push_str("end_header\n");
    let mut listed = listed.into_bytes();
    for i in 0..50u8 {
        listed.extend_from_slice(&[&[0; 16][..], &[2], &[i; 8]].concat());
    }
    let fixed =
        b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar int l\n\
                  element vertex 50\nproperty float x\nproperty float y\nproperty float z\n\
                  property uchar nx\nproperty char ny\nproperty short nz\nend_header\n\x01abcd";
    let fixed = [&fixed[..], &[0x40; 50 * 16]].concat();
    let chunked = |format| laz(format, 50_200, |i| [i as i32, (i * i % 97) as i32, (i % 5) as i32]);
    vec![
        ("las 1.2", las_12(50), 227),
        ("las 1.4", las, 375),
        ("laz pf1", chunked(1), 420),
        ("laz pf7", chunked(7), 700),
        ("ply text", text.into_bytes(), 1000),
        ("ply listed", listed, 1000),
        ("ply fixed", fixed, 300),
    ]
}

/// Reads a broken file in every way there is.
fn exercise(what: &str, bytes: &[u8]) {
    let (_folder, path) = file("broken", bytes);
    for options in [STRICT, LENIENT] {
        match read_parts(&path, options, 2) {
            // That all records are accounted for is asserted by the reading itself.
            Ok((source, _, _)) => assert!(source.info().n_points < 10_000_000, "{what}"),
            Err(e) => assert_eq!(e.kind(), ErrorKind::BadData, "{what}: {e}"),
        }
        if let Ok(source) = Source::open(&path, 0, options) {
            let _ = source.bounds_scan(0..source.info().n_points.min(100));
        }
    }
}

#[test]
fn flipped_bytes_never_panic() {
    let mut random = Random(20);
    for (what, good, head) in samples() {
        for round in 0..150 {
            let mut bad = good.clone();
            for _ in 0..=round % 3 {
                // Mostly the header; every third time anywhere, or the table at the end.
                let n = bad.len();
                let at = match round % 6 {
                    0 => random.below(n),
                    1 => n - 1 - random.below(n.min(40)),
                    _ => random.below(head.min(n)),
                };
                bad[at] = match random.below(4) {
                    0 => 0,
                    1 => 0xff,
                    2 => bad[at] ^ 1 << random.below(8),
                    _ => random.below(256) as u8,
                };
            }
            exercise(&format!("{what}, round {round}"), &bad);
        }
    }
}

#[test]
fn cuts_never_panic() {
    let mut random = Random(21);
    for (what, good, head) in samples() {
        for round in 0..60 {
            let n = if round % 2 == 0 { good.len() } else { head.min(good.len()) };
            let cut = random.below(n);
            exercise(&format!("{what}, cut at {cut}"), &good[..cut]);
        }
    }
}
