//! Broken files: which load after all, and what each of the others is refused for. None may panic,
//! abort, or take five seconds.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::time::{Duration, Instant};

use common::{STRICT, data, read};
use pvmap_scan::ErrorKind;

/// File, and points or a part of the message that refuses it.
const FILES: &[(&str, Result<u64, &str>)] = &[
    ("Aurtechmx_InvalidFileLength.e57", Err("E57 is not read yet")),
    ("Aurtechmx_NoPrototype.e57", Err("E57 is not read yet")),
    ("LASzip_broken_coder.laz", Err("coder 15 is unknown")),
    ("LASzip_broken_compressor.laz", Err("compressor 16 does not go with point format 1")),
    ("LASzip_broken_size.laz", Err("item 0 has version 6")),
    ("LASzip_broken_type.laz", Err("items [(6, 20), (22, 8)]")),
    ("LASzip_broken_version.laz", Err("item 0 has version 6")),
    ("MANIFEST_synth.md", Err("not a LAS, LAZ or PLY file")),
    ("PDAL_bad-geotiff-keys.las", Ok(10)),
    // The last of three VLRs is not there: a header that lies about that may lie about more.
    ("PDAL_bad_vlr_count.las", Err("VLR 3 of 3: its header at byte 429 runs into the points")),
    ("PDAL_garbage_nVariableLength.las", Err("VLR 1 of 1069128089")),
    ("PDAL_hextest.las", Ok(8)),
    ("PDAL_issue_2421.ply", Ok(1)),
    ("PDAL_no_vertex.ply", Err("no element named vertex")),
    ("PDAL_noise-dirty.las", Ok(1065)),
    ("PDAL_spurious.las", Ok(1065)),
    ("asmaloney_InvalidCVHeader.e57", Err("E57 is not read yet")),
    ("asmaloney_ZeroPointsInvalid.e57", Err("E57 is not read yet")),
    ("asmaloney_bad-crc.e57", Err("E57 is not read yet")),
    ("assimp_crash-30d6d0f7c529b3b66b4131700b7a4580cd7082df.ply", Err("no end_header")),
    ("assimp_empty.ply", Err("the file is empty")),
    ("cry-inc_corrupt_crc.e57", Err("E57 is not read yet")),
    ("cry-inc_read_error.e57", Err("E57 is not read yet")),
    ("synth_copc_truncated.copc.laz", Err("EVLR 1 of 1: it begins at byte 31544")),
    ("synth_e57_bad_magic.e57", Err("not a LAS, LAZ or PLY file")),
    ("synth_e57_page_crc.e57", Err("E57 is not read yet")),
    ("synth_e57_truncated.e57", Err("E57 is not read yet")),
    ("synth_e57_xml_offset.e57", Err("E57 is not read yet")),
    ("synth_empty.e57", Err("the file is empty")),
    ("synth_empty.las", Err("the file is empty")),
    ("synth_empty.laz", Err("the file is empty")),
    ("synth_empty.ply", Err("the file is empty")),
    ("synth_html_as.laz", Err("a web page (HTML)")),
    ("synth_las14_count64_huge.las", Err("declares 9223372036854775808 points")),
    ("synth_las_bad_magic.las", Err("not a LAS, LAZ or PLY file")),
    ("synth_las_bbox_wrong.las", Ok(1)),
    ("synth_las_count_too_big.las", Err("declares 4000000000 points")),
    ("synth_las_flagged_laz_uncompressed.laz", Err("marked compressed, but no VLR says how")),
    ("synth_las_format_99.las", Err("point format 99 is unknown")),
    ("synth_las_offset_inf.las", Err("x offset inf")),
    ("synth_las_offset_past_eof.las", Err("points begin at byte 4294967280")),
    ("synth_las_reclen_short.las", Err("record length 10, point format 3 needs 34")),
    ("synth_las_reclen_zero.las", Err("record length 0")),
    ("synth_las_scale_nan.las", Err("x scale NaN")),
    ("synth_las_scale_zero.las", Err("x scale 0")),
    ("synth_las_truncated_header.las", Err("the file ends after 100 bytes")),
    ("synth_las_truncated_points.las", Err("declares 1 points")),
    ("synth_las_version_9.9.las", Err("version 9.9 is unknown")),
    ("synth_las_vlr_count_huge.las", Err("VLR 1 of 4294967295")),
    // Forty flipped bits: the decoder runs out of bytes at point 976 of 1065.
    ("synth_laz_bitflips.laz", Err("point 976: its bytes end too early")),
    ("synth_laz_chunktable_minus1.laz", Err("broken LAZ chunk table")),
    ("synth_laz_chunktable_ptr.laz", Err("broken LAZ chunk table")),
    ("synth_laz_truncated.laz", Err("broken LAZ chunk table")),
    ("synth_lfs_pointer.laz", Err("git lfs pull")),
    ("synth_ply_ascii_extra_cols.ply", Err("line 8: 2 columns too many, expected 3")),
    ("synth_ply_count_1e12_binary.ply", Err("declares 1000000000000 points")),
    ("synth_ply_count_huge.ply", Err("declares 18446744073709551615 points")),
    ("synth_ply_count_neg.ply", Err("line 3: \"element vertex -1\"")),
    ("synth_ply_crlf_binary.ply", Ok(1)),
    ("synth_ply_dup_element.ply", Err("line 7: a second element named vertex")),
    ("synth_ply_empty_line.ply", Err("no end_header")),
    ("synth_ply_format_bare.ply", Err("no end_header")),
    ("synth_ply_format_missing.ply", Err("No format line")),
    ("synth_ply_header_64MB_line.ply.note", Err("not a LAS, LAZ or PLY file")),
    ("synth_ply_nan_inf.ply", Err("point 0: a coordinate is not finite")),
    // The bad list belongs to the faces, and nothing behind the vertices is read.
    ("synth_ply_negative_list.ply", Ok(1)),
    ("synth_ply_no_end_header.ply", Err("no end_header")),
    ("synth_ply_no_x.ply", Err("the vertices have no x, y and z")),
    ("synth_ply_prop_before_element.ply", Err("line 3: \"property float x\"")),
    ("synth_ply_short_binary.ply", Err("declares 3 points but holds 2")),
    ("synth_ply_short_by_one.ply", Err("declares 3 points but holds 2")),
    ("synth_ply_text_garbage.ply", Err("line 8: y is \"zero\"")),
    ("synth_ply_unknown_type.ply", Err("line 4: \"property quadruple x\"")),
];

#[test]
fn malformed_files() {
    let Some(folder) = data("malformed") else { return };
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), FILES.len());
    for (name, expected) in FILES {
        let start = Instant::now();
        match (read(&folder.join(name), STRICT), expected) {
            (Ok((_, _, report)), Ok(n)) => assert_eq!(report.n_read, *n, "{name}"),
            (Err(e), Err(reason)) => {
                assert_eq!(e.kind(), ErrorKind::BadData, "{e}");
                assert!(e.to_string().contains(reason), "{e}");
            }
            (Ok(_), Err(_)) => panic!("{name} must be refused"),
            (Err(e), Ok(_)) => panic!("{e}"),
        }
        assert!(start.elapsed() < Duration::from_secs(5), "{name}");
    }
}
