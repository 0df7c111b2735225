//! Broken and hostile LAS and LAZ, by the rows of the catalogue of faults.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::time::{Duration, Instant};

use common::{
    LENIENT, Random, STRICT, file, las_12, las_14, laz, patch, points, points_offset, read,
    read_parts, refusal_of, report_of, vlr,
};
use pvmap_scan::{Crs, ErrorKind, ReadOptions, ScanError, Source};

/// Inserts VLRs behind the header of a LAS file.
fn with_vlrs(mut las: Vec<u8>, vlrs: &[Vec<u8>]) -> Vec<u8> {
    let at = points_offset(&las);
    let all = vlrs.concat();
    patch(&mut las, 96, &((at + all.len()) as u32).to_le_bytes());
    patch(&mut las, 100, &(vlrs.len() as u32).to_le_bytes());
    las.splice(at..at, all);
    las
}

/// Appends EVLRs to a LAS 1.4 file.
fn with_evlrs(mut las: Vec<u8>, evlrs: &[Vec<u8>]) -> Vec<u8> {
    let at = las.len() as u64;
    patch(&mut las, 235, &at.to_le_bytes());
    patch(&mut las, 243, &(evlrs.len() as u32).to_le_bytes());
    las.extend(evlrs.concat());
    las
}

fn warnings(bytes: &[u8], options: ReadOptions) -> String {
    let (_folder, path) = file("bytes", bytes);
    Source::open(&path, 0, options).unwrap().info().warnings.join("\n")
}

#[test]
fn f52_more_points_declared_than_fit() {
    for n in [11, 12, 1000, u32::MAX] {
        let mut las = las_12(10);
        patch(&mut las, 107, &n.to_le_bytes());
        let expected = format!("declares {n} points but holds 10");
        assert!(refusal_of(&las, STRICT).starts_with(&expected));
        assert_eq!(report_of(&las, LENIENT).unwrap().n_read, 10);
        assert!(warnings(&las, LENIENT).contains(&expected));
    }
    for n in [11, 1 << 33, u64::MAX] {
        let mut las = las_14(10);
        patch(&mut las, 247, &n.to_le_bytes());
        assert!(refusal_of(&las, STRICT).starts_with(&format!("declares {n} points")));
        assert_eq!(report_of(&las, LENIENT).unwrap().n_read, 10);
    }
    for format in [1, 7] {
        let mut laz = laz(format, 1000, |i| [i as i32; 3]);
        let at = if format == 1 { 107 } else { 247 };
        patch(&mut laz, at, &100_000u32.to_le_bytes());
        assert!(refusal_of(&laz, STRICT).starts_with("declares 100000 points but holds 50000"));
        patch(&mut laz, at, &40_000u32.to_le_bytes());
        let message = refusal_of(&laz, STRICT);
        assert!(message.contains(if format == 1 { "end too early" } else { "holds 1000 points" }));
    }
}

#[test]
fn f53_fewer_points_declared_than_are_there() {
    let mut las = las_12(10);
    patch(&mut las, 107, &7u32.to_le_bytes());
    assert_eq!(report_of(&las, STRICT).unwrap().n_read, 7);
    let expected = "declares 7 points but holds 10: the last 3 are not read";
    assert_eq!(warnings(&las, STRICT), expected);
    patch(&mut las, 107, &0u32.to_le_bytes());
    assert!(warnings(&las, STRICT).starts_with("declares 0 points but holds 10"));

    let mut laz = laz(1, 120_000, |i| [i as i32; 3]);
    patch(&mut laz, 107, &70_000u32.to_le_bytes());
    assert_eq!(report_of(&laz, STRICT).unwrap().n_read, 70_000);
    assert!(warnings(&laz, STRICT).starts_with("declares 70000 points but holds 100001"));
    patch(&mut laz, 107, &0u32.to_le_bytes());
    assert!(warnings(&laz, STRICT).starts_with("declares 0 points but holds"));
}

#[test]
fn f54_offsets_and_sizes_out_of_range() {
    let las = las_12(10);
    for at in [0u32, 1, 226, las.len() as u32 + 1, u32::MAX] {
        let mut bad = las.clone();
        patch(&mut bad, 96, &at.to_le_bytes());
        assert!(refusal_of(&bad, STRICT).contains(&format!("points begin at byte {at}")));
    }
    for n in [0u16, 1, 226, u16::MAX] {
        let mut bad = las.clone();
        patch(&mut bad, 94, &n.to_le_bytes());
        assert!(refusal_of(&bad, STRICT).contains(&format!("header size {n}")));
    }
    for n in [0u16, 1, 19] {
        let mut bad = las.clone();
        patch(&mut bad, 105, &n.to_le_bytes());
        assert!(refusal_of(&bad, STRICT).contains(&format!("record length {n}")));
    }
    // Points need not begin at an even byte, nor right behind the header.
    let mut odd = las.clone();
    patch(&mut odd, 96, &230u32.to_le_bytes());
    odd.splice(227..227, [0; 3]);
    assert_eq!(report_of(&odd, STRICT).unwrap().n_read, 10);
}

#[test]
fn f55_lengths_of_records_past_the_end() {
    let start = Instant::now();
    let mut las = las_12(10);
    patch(&mut las, 100, &u32::MAX.to_le_bytes());
    assert!(refusal_of(&las, STRICT).contains("VLR 1 of 4294967295"));

    let mut las = with_vlrs(las_12(10), &[vlr("any", 1, b"abc", false)]);
    patch(&mut las, 227 + 20, &u16::MAX.to_le_bytes());
    assert!(refusal_of(&las, STRICT).contains("VLR 1 of 1: 65535 bytes"));

    let good = with_evlrs(las_14(10), &[vlr("any", 1, b"abc", true), vlr("any", 2, b"", true)]);
    assert_eq!(report_of(&good, STRICT).unwrap().n_read, 10);
    let at = good.len() - 60 - 63;
    for n in [4u64 + 60, 1 << 40, u64::MAX] {
        let mut bad = good.clone();
        patch(&mut bad, at + 20, &n.to_le_bytes());
        assert!(refusal_of(&bad, STRICT).contains("EVLR"), "{n}");
        assert_eq!(report_of(&bad, LENIENT).unwrap().n_read, 10);
    }
    let mut bad = good.clone();
    patch(&mut bad, 243, &u32::MAX.to_le_bytes());
    assert!(refusal_of(&bad, STRICT).contains("EVLR 3 of 4294967295"));
    patch(&mut bad, 235, &u64::MAX.to_le_bytes());
    assert!(refusal_of(&bad, STRICT).contains("EVLR 1 of"));
    assert!(start.elapsed() < Duration::from_secs(1));
}

#[test]
fn a_crs_in_the_second_evlr_is_found() {
    let text = b"PROJCS[\"somewhere\"]\0";
    let records = [vlr("copc", 1, &[1; 100], true), vlr("LASF_Projection", 2112, text, true)];
    let (_folder, path) = file("a.las", &with_evlrs(las_14(3), &records));
    let source = Source::open(&path, 0, STRICT).unwrap();
    assert_eq!(source.info().crs, Some(Crs::Wkt(b"PROJCS[\"somewhere\"]".to_vec())));
}

#[test]
fn f56_lattices_that_are_none() {
    let tiny = f64::MIN_POSITIVE / 2.0;
    for scale in [0.0, -0.0, -0.01, f64::NAN, f64::INFINITY, tiny, f64::MAX] {
        let mut las = las_12(10);
        patch(&mut las, 139, &scale.to_le_bytes());
        let message = refusal_of(&las, STRICT);
        assert!(message.contains("y scale") || message.contains("not finite"), "{message}");
    }
    for offset in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut las = las_12(10);
        patch(&mut las, 171, &offset.to_le_bytes());
        assert!(refusal_of(&las, STRICT).contains("z offset"));
    }
}

#[test]
fn f57_the_count_of_las_14_wins() {
    let mut las = las_14(10);
    patch(&mut las, 107, &4u32.to_le_bytes());
    assert_eq!(report_of(&las, STRICT).unwrap().n_read, 10);
    let text = warnings(&las, STRICT);
    assert!(text.contains("declares 10 points and, in its legacy field, 4"), "{text}");
}

#[test]
fn f58_chunk_tables_that_lie() {
    for format in [1, 7] {
        let good = laz(format, 120_000, |i| [i as i32, (i * 7 % 1000) as i32, 5]);
        assert_eq!(report_of(&good, STRICT).unwrap().n_read, 120_000);
        let data = points_offset(&good);
        let table = u64::from_le_bytes(good[data..data + 8].try_into().unwrap()) as usize;
        for pointer in [0i64, 1, -2, data as i64, good.len() as i64, i64::MAX, i64::MIN] {
            let mut bad = good.clone();
            patch(&mut bad, data, &pointer.to_le_bytes());
            assert!(refusal_of(&bad, STRICT).contains("LAZ chunk table"), "{pointer}");
        }
        for count in [0u32, 1 << 20, u32::MAX] {
            let mut bad = good.clone();
            patch(&mut bad, table + 4, &count.to_le_bytes());
            assert!(refusal_of(&bad, STRICT).contains("LAZ chunk table"), "{count}");
        }
        // Missing: without it nobody knows that the file is whole, but its chunks can be read.
        let mut cut = good[..table].to_vec();
        assert!(refusal_of(&cut, STRICT).contains("LAZ chunk table"));
        assert_eq!(report_of(&cut, LENIENT).unwrap().n_read, 120_000);
        // A writer that could not go back leaves -1 and puts the place at the very end.
        patch(&mut cut, data, &(-1i64).to_le_bytes());
        cut.extend_from_slice(&good[table..]);
        cut.extend_from_slice(&(table as u64).to_le_bytes());
        assert_eq!(report_of(&cut, STRICT).unwrap().n_read, 120_000);
        // Sizes of chunks: the coded bytes of the table are anything.
        let mut random = Random(7);
        for _ in 0..200 {
            let mut bad = good.clone();
            let at = table + 8 + random.below(bad.len() - table - 8);
            bad[at] ^= 1 << random.below(8);
            let _ = report_of(&bad, STRICT);
        }
    }
}

#[test]
fn f58_layers_that_do_not_fit() {
    let good = laz(7, 1000, |i| [i as i32; 3]);
    // Behind the pointer and the first record: the count, then the sizes of ten layers.
    let at = points_offset(&good) + 8 + 36;
    for layer in 1..=10 {
        let mut bad = good.clone();
        patch(&mut bad, at + 4 * layer, &u32::MAX.to_le_bytes());
        assert!(refusal_of(&bad, STRICT).contains("its chunk needs 429"), "{layer}");
    }
}

#[test]
fn f59_cut_anywhere() {
    let (folder, _) = file("none", b"");
    let path = folder.path().join("cut");
    let mut random = Random(59);
    for (good, n) in [
        (las_12(400), 400),
        (laz(1, 60_000, |i| [i as i32, (i * i % 977) as i32, 1]), 60_000),
        (laz(7, 60_000, |i| [i as i32, (i * i % 977) as i32, 1]), 60_000),
    ] {
        let whole = good.len();
        let near = 4096.min(whole);
        let mut cuts: Vec<usize> = (0..near).step_by(7).chain(whole - near..whole).collect();
        cuts.extend((0..200).map(|_| random.below(whole)));
        cuts.sort_unstable();
        cuts.dedup();
        std::fs::write(&path, &good).unwrap();
        let handle = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
        let mut n_before = n;
        for &cut in cuts.iter().rev() {
            handle.set_len(cut as u64).unwrap();
            let strict = read(&path, STRICT);
            assert!(matches!(strict, Err(ref e) if e.kind() == ErrorKind::BadData), "{cut}");
            if cut % 64 == 0
                && let Ok((_, batches, report)) = read(&path, LENIENT)
            {
                let points = points(&batches);
                // Whatever is whole is kept: records of a LAS, chunks of a LAZ, the first of which
                // has 50 000 points.
                let least = if n == 400 {
                    (cut as u64 - 227) / 20
                } else {
                    50_000 * u64::from(cut * 10 > whole * 9)
                };
                assert!((least..=n_before).contains(&report.n_read), "{cut}: {}", report.n_read);
                assert_eq!(points.len() as u64, report.n_read);
                n_before = report.n_read;
                let is_prefix = |(i, p): (usize, &common::Point)| p.record == i as u64;
                assert!(points.iter().enumerate().all(is_prefix));
                assert!(points.iter().all(|p| p.place[0] == p.record as f64), "{cut}");
            }
        }
    }
}

#[test]
fn f60_noise_amid_the_points_is_counted_where_it_shows() {
    let mut las = las_12(1000);
    let mut random = Random(60);
    // The header's bounds are 0 to 1e8 steps; the sign bit of x takes a point out of them.
    for i in 0..50 {
        las[227 + 20 * (20 * i) + 3] ^= 0x80;
        las[227 + 20 * (20 * i) + 12] = random.below(256) as u8;
    }
    let report = report_of(&las, STRICT).unwrap();
    assert_eq!((report.n_read, report.n_outside_bounds), (1000, 50));
}

#[test]
fn f66_a_file_that_changes_is_noticed() {
    let (_folder, path) = file("a.las", &las_12(5000));
    let source = Source::open(&path, 0, STRICT).unwrap();
    let changed = |e: ScanError| assert!(matches!(e, ScanError::Changed { .. }), "{e}");
    let cut = |n: u64| {
        std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(n).unwrap();
    };
    // While it is read: longer, then shorter.
    for n in [200_000, 50_000] {
        let source = Source::open(&path, 0, LENIENT).unwrap();
        let grow = |_| {
            cut(n);
            Ok::<(), ScanError>(())
        };
        changed(source.read(0..source.info().n_points, 100, grow).unwrap_err());
    }
    // Since it was opened.
    changed(source.read(0..10, 10, |_| Ok::<(), ScanError>(())).unwrap_err());
    changed(source.bounds_scan(0..10).unwrap_err());
    std::fs::remove_file(&path).unwrap();
    let gone = source.read(0..10, 10, |_| Ok::<(), ScanError>(())).unwrap_err();
    assert_eq!(gone.kind(), ErrorKind::NotFound);
}

#[cfg(unix)]
#[test]
fn f67_names_of_any_bytes() {
    use std::os::unix::ffi::OsStrExt;
    let folder = tempfile::tempdir().unwrap();
    for name in [&b"nu\xff\xfe a\n b.las"[..], b"-x.las", &[b'n'; 255]] {
        let path = folder.path().join(std::ffi::OsStr::from_bytes(name));
        std::fs::write(&path, las_12(3)).unwrap();
        assert_eq!(read(&path, STRICT).unwrap().2.n_read, 3);
        std::fs::write(&path, &las_12(3)[..250]).unwrap();
        let message = read(&path, STRICT).unwrap_err().to_string();
        assert!(!message.contains('\n'), "{message}");
    }
}

#[test]
fn f68_many_open_sources_hold_no_handles() {
    let folder = tempfile::tempdir().unwrap();
    let sources: Vec<Source> = (0..3000)
        .map(|i| {
            let path = folder.path().join(format!("{i}.las"));
            std::fs::write(&path, las_12(1)).unwrap();
            Source::open(&path, i, STRICT).unwrap()
        })
        .collect();
    let n_handles = std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    assert!(n_handles < 200, "{n_handles}");
    let read = |s: &Source| s.read(0..1, 1, |_| Ok::<(), ScanError>(())).unwrap().n_read;
    assert_eq!(sources.iter().map(read).sum::<u64>(), 3000);
}

#[test]
fn f69_equal_points_unpack_to_no_more_than_declared() {
    for format in [1, 7] {
        let bytes = laz(format, 500_000, |_| [1, 2, 3]);
        assert!(bytes.len() < 100_000);
        let (_folder, path) = file("a.laz", &bytes);
        let (_, batches, report) = read_parts(&path, STRICT, 4).unwrap();
        assert_eq!(report.n_read, 500_000);
        assert!(batches.iter().all(|b| b.len() <= 1000));
    }
}
