//! Exports onto LAS files as other programs write them: what their extra bytes are, wave packets
//! and bytes that no record is about come back, in files that other programs read.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use cli_common::{Bench, Run};
use export_common::python;
use export_common::raw::{Pieces, descriptor, names, payload, records, vlr, vlrs, word};
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
