//! Exports onto LAS files as other programs write them: what their extra bytes are, wave packets
//! and bytes that no record is about come back, in files that other programs read.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use cli_common::{Bench, Run};
use export_common::python;
use export_common::raw::{
    Pieces, descriptor, evlr, n_points, names, payload, records, vlr, vlrs, word,
};
use pvmap::scan::{ReadOptions, Source};

/// Takes a scan the whole way, as `a.las`.
fn built(pieces: &Pieces) -> Bench {
    let bench = Bench::new();
    bench.write("a.las", pieces.joined());
    bench.line("ingest a.las -o a.octree --normals none").ok();
    bench.line("build a.octree --max-level 4 -o a.vmap").ok();
    bench
}

/// Writes it again with the numbers of its records, and demands that every record came through.
fn export(bench: &Bench, output: &str) -> Run {
    let line = format!("export a.vmap --points {output} --scan a.las --field record --overwrite");
    let run = bench.line(&line).ok();
    let (was, n_was) = records(&bench.path("a.las"));
    let (is, n_is) = records(&bench.path(output));
    assert_eq!((n_is, is.len() / n_is), (n_was + 4, was.len() / n_was));
    for ((was, is), i) in was.chunks_exact(n_was).zip(is.chunks_exact(n_is)).zip(0..) {
        assert!(*was == is[..n_was] && word(is, n_was) == i, "{output}: record {i}");
    }
    run
}

#[test]
fn wave_packets_of_a_laz_are_coded_as_laszip_knows_it() {
    for point_format in [4, 5] {
        let bench = built(&Pieces { n_extra: 2, ..Pieces::new(3, point_format, 20) });
        export(&bench, "out.laz");
        let laszip = payload(&bench.read("out.laz"), 22204);
        let items: Vec<[usize; 2]> =
            laszip[34..].chunks_exact(6).map(|i| [word(i, 0) & 0xffff, i[4].into()]).collect();
        // Points, GPS times, wave packets, extra bytes.
        assert!(items.contains(&[9, 1]) && items.contains(&[6, 2]) && items.contains(&[0, 2]));
    }
}

#[test]
fn bytes_that_nobody_described_are_described_as_laspy_reads_them() {
    // As scale and offset it reads the bits 8 and 16 of how many there are.
    for n_extra in [1, 7, 8, 12, 16, 31, 305] {
        let own = descriptor(0, 1, "unnamed_1");
        let vlrs = vec![vlr("LASF_Spec", 4, "one of them", &own)];
        let bench = built(&Pieces { n_extra, vlrs, ..Pieces::new(4, 6, 20) });
        for output in ["out.las", "out.laz"] {
            export(&bench, output);
            let descriptors = payload(&bench.read(output), 4);
            let (mut found, n) = (names(&descriptors), descriptors.len() / 192);
            assert_eq!((&found[0], &found[n - 1]), (&"unnamed_1".to_owned(), &"record".to_owned()));
            let runs = descriptors.chunks_exact(192).take(n - 1).map(|d| usize::from(d[3]));
            assert_eq!(runs.sum::<usize>(), n_extra);
            found.sort();
            found.dedup();
            assert_eq!(found.len(), n, "names of their own");
        }
        let script = "
import laspy, numpy as np
for name in ['out.las', 'out.laz']:
    a = laspy.read(name)
    assert (np.array(a['record']) == np.arange(400)).all()
";
        python(&bench, "laspy", script);
    }
}

#[test]
fn extra_bytes_that_several_records_describe_keep_all_their_names() {
    let of = |kind, name: &str, text: &str| vlr("LASF_Spec", 4, text, &descriptor(kind, 0, name));
    let vlrs_in = vec![
        of(3, "amplitude", "RIEGL Extra Bytes"),
        vlr("scanner", 9, "", b"in between"),
        of(1, "confidence", "TerraScan"),
        of(9, "distance", ""),
    ];
    let bench = built(&Pieces { n_extra: 7, vlrs: vlrs_in.clone(), ..Pieces::new(4, 6, 20) });
    export(&bench, "out.las");
    let bytes = bench.read("out.las");
    let found = vlrs(&bytes);
    assert_eq!(names(&payload(&bytes, 4)), ["amplitude", "confidence", "distance", "record"]);
    // They are where the first was and called what it was called.
    let mut head = vlrs_in[0][..54].to_vec();
    head[20..22].copy_from_slice(&(4 * 192u16).to_le_bytes());
    assert_eq!((found.len(), &found[0].0), (2, &head));
    assert_eq!(found[1], (vlrs_in[1][..54].to_vec(), b"in between".to_vec()));
}

#[test]
fn normals_may_be_described_in_several_records() {
    let of = |name: &str| vlr("LASF_Spec", 4, "", &descriptor(9, 0, name));
    let vlrs = ["echo", "NormalX", "NormalY", "NormalZ"].map(of).to_vec();
    let bench = Bench::new();
    bench.write("a.las", Pieces { n_extra: 16, vlrs, ..Pieces::new(2, 1, 20) }.joined());
    let source = Source::open(&bench.path("a.las"), 0, ReadOptions::default()).unwrap();
    assert!(source.info().columns.normal && source.info().warnings.is_empty());
    assert_eq!(source.names(), ["echo", "NormalX", "NormalY", "NormalZ"]);
}

/// Gives a packet of waves, as an extended record has it.
fn waves() -> Vec<u8> {
    evlr("LASF_Spec", 65535, "", &[7, 8, 9].repeat(400))
}

#[test]
fn wave_packets_in_a_file_are_where_its_header_says() {
    let alone = Pieces { between: waves(), waves_at: Some(0), ..Pieces::new(3, 4, 20) };
    let listed = evlr("scanner", 10, "", b"before");
    let among = Pieces {
        waves_at: Some(listed.len()),
        evlrs: vec![listed, waves(), evlr("scanner", 11, "", b"behind")],
        ..Pieces::new(4, 9, 20)
    };
    for pieces in [alone, among] {
        let bench = built(&pieces);
        for output in ["out.las", "out.laz"] {
            export(&bench, output);
            let bytes = bench.read(output);
            assert!(bytes[word(&bytes, 227)..].starts_with(&waves()), "{output}");
            if pieces.minor == 4 {
                assert_eq!(word(&bytes, 243), 3);
                assert_eq!(bytes[word(&bytes, 235)..], pieces.evlrs.concat(), "{output}");
            } else {
                assert!(bytes.ends_with(&waves()));
            }
        }
    }
}

#[test]
fn bytes_that_no_record_is_about_are_kept() {
    let legacy = Pieces { tail: b"TRAILING".repeat(20), ..Pieces::new(2, 0, 20) };
    let modern = Pieces {
        between: b"BETWEEN".repeat(3),
        evlrs: vec![evlr("scanner", 10, "what", b"listed")],
        tail: b"BEHIND".to_vec(),
        ..Pieces::new(4, 6, 20)
    };
    let no_list = Pieces { tail: b"BEHIND".to_vec(), ..Pieces::new(4, 6, 20) };
    for pieces in [legacy, modern, no_list] {
        let behind = [pieces.between.clone(), pieces.evlrs.concat(), pieces.tail.clone()].concat();
        let bench = built(&pieces);
        for output in ["out.las", "out.laz"] {
            export(&bench, output);
            let bytes = bench.read(output);
            assert!(bytes.ends_with(&behind), "{output}");
            if !pieces.evlrs.is_empty() {
                let at = bytes.len() - pieces.evlrs.concat().len() - pieces.tail.len();
                assert_eq!((word(&bytes, 235), word(&bytes, 243)), (at, 1));
            }
        }
    }
}

#[test]
fn more_descriptors_than_a_record_holds_stand_behind_the_points() {
    let described: Vec<Vec<u8>> =
        (0..400).map(|i| descriptor(1, 0, &format!("field_{i}"))).collect();
    let vlrs_in: Vec<Vec<u8>> =
        described.chunks(300).map(|d| vlr("LASF_Spec", 4, "many", &d.concat())).collect();
    let pieces = |minor, point_format| Pieces {
        n_extra: 400,
        vlrs: vlrs_in.clone(),
        ..Pieces::new(minor, point_format, 10)
    };
    let with_record = Pieces {
        evlrs: vec![evlr("scanner", 10, "", b"listed")],
        tail: b"BEHIND".to_vec(),
        ..pieces(4, 6)
    };
    for pieces in [pieces(4, 6), with_record] {
        let bench = built(&pieces);
        export(&bench, "out.las");
        let bytes = bench.read("out.las");
        assert!(vlrs(&bytes).is_empty());
        assert_eq!(word(&bytes, 243), 1 + pieces.evlrs.len());
        assert!(bytes[word(&bytes, 235)..].starts_with(&pieces.evlrs.concat()));
        let source = Source::open(&bench.path("out.las"), 0, ReadOptions::default()).unwrap();
        let found = source.names();
        assert_eq!(
            (found.len(), found[399].as_str(), &found[400]),
            (401, "field_399", &"record".into())
        );
    }
    let bench = built(&pieces(2, 0));
    let line = "export a.vmap --points out.las --scan a.las --field record";
    bench.line(line).fails(65, &["out.las", "too many extra bytes to describe"]);
}

#[test]
fn a_field_of_an_old_las_is_said_to_need_an_option_of_pdal() {
    for (minor, point_format, is_told) in [(2, 1, true), (4, 1, false), (4, 6, false)] {
        let bench = built(&Pieces::new(minor, point_format, 10));
        let run = export(&bench, "out.las");
        assert_eq!(run.stderr.contains("readers.las.use_eb_vlr"), is_told, "{}", run.stderr);
        if is_told {
            run.warns(&["out.las", "LAS 1.2"]);
        }
    }
}

#[test]
fn a_scan_without_points_is_written_again() {
    for (minor, point_format) in [(2, 1), (4, 6)] {
        let bench = Bench::new();
        let vlrs = vec![vlr("scanner", 9, "", b"nothing here")];
        bench.write("e.las", Pieces { vlrs, ..Pieces::new(minor, point_format, 0) }.joined());
        bench.write("a.las", Pieces::new(4, 6, 20).joined());
        bench.line("ingest a.las e.las -o a.octree --normals none").ok();
        bench.line("build a.octree --max-level 4").ok();
        for output in ["out.las", "out.laz"] {
            bench.line(&format!("export a.vmap --points {output} --scan e.las --field leaf")).ok();
            let bytes = bench.read(output);
            assert_eq!((n_points(&bytes), vlrs_of_scanner(&bytes)), (0, 1));
            bench
                .line(&format!("ingest a.las {output} -o b.octree --normals none --overwrite"))
                .ok();
        }
    }
}

fn vlrs_of_scanner(bytes: &[u8]) -> usize {
    vlrs(bytes).iter().filter(|v| v.0[2..].starts_with(b"scanner")).count()
}
