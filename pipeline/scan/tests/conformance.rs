//! Every conformance file loads with the right count, or is refused with the right reason. Counts
//! and values were read once with laspy 2 and plyfile.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use common::{Point, STRICT, data, point, points, read, read_parts};
use pvmap_scan::{ColorRange, Crs, PositionKind, Source};

/// File, and points or a part of the message that refuses it.
const LAS: &[(&str, Result<u64, &str>)] = &[
    ("PDAL_1.0_0.las", Ok(1)),
    ("PDAL_1.0_1.las", Ok(1)),
    ("PDAL_1.1_0.las", Ok(1)),
    ("PDAL_1.1_1.las", Ok(1)),
    ("PDAL_1.2_0.las", Ok(1)),
    ("PDAL_1.2_1.las", Ok(1)),
    ("PDAL_1.2_2.las", Ok(1)),
    ("PDAL_1.2_3.las", Ok(1)),
    ("PDAL_lots_of_vlr.las", Ok(1)),
    ("PDAL_no-points.las", Ok(0)),
    ("connormanning_ellipsoid.copc.laz", Ok(100_000)),
    ("hobuinc_no-points-1.3.laz", Ok(0)),
    ("laspy_1_4_w_evlr.las", Ok(1000)),
    ("laspy_1_4_w_evlr.laz", Ok(1000)),
    ("laspy_autzen_trim.laz", Ok(110_000)),
    ("laspy_extrabytes.las", Ok(1065)),
    ("laspy_fullwave.laz", Ok(10_750)),
    ("laspy_plane.laz", Ok(28_185)),
    ("laspy_simple.copc.laz", Ok(1065)),
    ("laspy_simple1_4.las", Ok(22_600)),
    ("laspy_simple_with_page.copc.laz", Ok(1065)),
    ("laspy_unregistered_extra_bytes.las", Ok(4)),
    ("laz-rs_extra-bytes.laz", Ok(1065)),
    ("laz-rs_point-time-color.laz", Ok(1065)),
    ("laz-rs_point10.laz", Ok(1065)),
    ("pnext_v3d0.las", Ok(10)),
    ("pnext_v3d3.las", Ok(10)),
    ("pnext_v4d0.las", Ok(10)),
    ("pnext_v4d3.las", Ok(10)),
    ("pnext_v4d6.las", Ok(10)),
    ("pnext_v4d7.las", Ok(10)),
    ("pnext_v4d8.las", Ok(10)),
    ("r-lidar_Megaplot.laz", Ok(81_590)),
    ("visgl_indoor.laz", Ok(808_042)),
    ("visgl_pdrf10-1.4.las", Ok(1024)),
    ("visgl_pdrf10-1.5.las", Ok(1024)),
];

const PLY: &[(&str, Result<u64, &str>)] = &[
    ("PDAL_mesh.ply", Ok(4)),
    ("PDAL_simple_binary.ply", Ok(3)),
    ("PDAL_simple_text.ply", Ok(3)),
    ("PDAL_sized_dims.ply", Err("the vertices have no x, y and z")),
    ("PDAL_unsized_dims.ply", Err("the vertices have no x, y and z")),
    ("assimp_Wuson.ply", Err("line 3: \"Created by Blender3D")),
    ("assimp_cube.ply", Ok(8)),
    ("assimp_cube_binary.ply", Ok(8)),
    ("assimp_cube_binary_header_with_RN_newline.ply", Ok(8)),
    ("assimp_cube_binary_starts_with_nl.ply", Ok(8)),
    ("assimp_cube_uv.ply", Ok(24)),
    ("assimp_float-color.ply", Ok(3)),
    ("assimp_issue623.ply", Err("line 14: 6 columns, expected 7 (vertex_indices is missing)")),
    ("assimp_points.ply", Ok(4)),
    ("cartographer-project_xyz_f32_rgb_u8_intensity_f32.ply", Ok(8)),
    ("cartographer-project_xyz_f32_rgb_u8_le.ply", Ok(8)),
    ("cartographer-project_xyz_f32_rgba_u8_le.ply", Ok(8)),
    ("ddiakopoulos_icosahedron.ply", Ok(12)),
    ("ddiakopoulos_icosahedron_ascii.ply", Ok(12)),
    ("ddiakopoulos_sofa.ply", Ok(12_103)),
    ("google_test_pos_color.ply", Ok(114)),
    ("google_test_pos_color_ascii.ply", Ok(114)),
    ("made_list_before_vertex_be.ply", Ok(3)),
    ("made_normal_x_diffuse_red.ply", Ok(3)),
    ("made_rgb_float_scalar_alias_le.ply", Ok(3)),
    ("mitsuba-renderer_bunny_attribute_color.ply", Ok(6056)),
    ("nmwsharp_platonic_shelf.ply", Ok(50)),
    ("nmwsharp_platonic_shelf_ascii.ply", Ok(50)),
    ("nmwsharp_platonic_shelf_big_endian.ply", Ok(50)),
    ("pyvista_horse.ply", Ok(48_485)),
    ("tianmaolin_Armadillo.ply", Ok(38_294)),
    ("visgl_ripple_bin.ply", Ok(10_201)),
];

fn check_folder(folder: &str, table: &[(&str, Result<u64, &str>)]) {
    let Some(folder) = data(folder) else { return };
    let n_files = std::fs::read_dir(&folder).unwrap().count();
    assert_eq!(n_files, table.len(), "the table lists every file");
    for (name, expected) in table {
        match (read(&folder.join(name), STRICT), expected) {
            (Ok((source, _, report)), Ok(n)) => {
                assert_eq!((report.n_read, source.info().n_points), (*n, *n), "{name}");
                assert_eq!(report.n_outside_bounds, 0, "{name}");
            }
            (Err(e), Err(reason)) => assert!(e.to_string().contains(reason), "{e}"),
            (Ok(_), Err(_)) => panic!("{name} must be refused"),
            (Err(e), Ok(_)) => panic!("{e}"),
        }
    }
}

#[test]
fn las_files() {
    check_folder("las_conformance", LAS);
}

#[test]
fn ply_files() {
    check_folder("ply_conformance", PLY);
}

#[test]
fn parts_make_up_the_whole() {
    let Some(folder) = data("") else { return };
    for name in [
        "las_conformance/laspy_simple.copc.laz",
        "las_conformance/connormanning_ellipsoid.copc.laz",
        "las_conformance/laspy_autzen_trim.laz",
        "las_conformance/laspy_simple1_4.las",
        "ply_conformance/pyvista_horse.ply",
        "ply_conformance/tianmaolin_Armadillo.ply",
    ] {
        let path = folder.join(name);
        let (_, whole, _) = read(&path, STRICT).unwrap();
        let whole = points(&whole);
        let (source, parts, _) = read_parts(&path, STRICT, 3).unwrap();
        assert_eq!(points(&parts), whole, "{name}");
        // A range that begins and ends anywhere.
        let (a, b) = (whole.len() as u64 / 3 + 1, whole.len() as u64 * 2 / 3 + 1);
        let mut middle = Vec::new();
        let keep = |batch| {
            middle.push(batch);
            Ok::<(), pvmap_scan::ScanError>(())
        };
        source.read(a..b, 1000, keep).unwrap();
        assert_eq!(points(&middle), whole[a as usize..b as usize], "{name}");
    }
}

/// The first and the last point of a file: x y z, colour, intensity, class, gps time, normal.
type Row = ([f64; 3], Option<[u16; 3]>, Option<f32>, Option<u8>, Option<f64>, Option<[f32; 3]>);

fn check_ends(name: &str, first: Row, last: Row) {
    let Some(folder) = data("") else { return };
    let (source, batches, _) = read(&folder.join(name), STRICT).unwrap();
    let n = source.info().n_points;
    for (record, row) in [(0, first), (n - 1, last)] {
        let (place, color, intensity, class, gps_time, normal) = row;
        let expected = Point { record, place, color, intensity, class, gps_time, normal };
        assert_eq!(point(&batches, record as usize), expected, "{name}");
    }
}

#[test]
fn values_of_laz_files() {
    check_ends(
        "las_conformance/laspy_autzen_trim.laz",
        (
            [63717798.0, 84939395.0, 41119.0],
            Some([84, 102, 93]),
            Some(4.0),
            Some(1),
            Some(245379.39843682514),
            None,
        ),
        (
            [63603788.0, 84933694.0, 42320.0],
            Some([64, 74, 70]),
            Some(100.0),
            Some(1),
            Some(245385.91112104454),
            None,
        ),
    );
    check_ends(
        "las_conformance/laspy_simple.copc.laz",
        (
            [-115560.0, -204709.0, -6833.0],
            Some([100, 94, 122]),
            Some(124.0),
            Some(1),
            Some(245385.5712732157),
            None,
        ),
        (
            [101314.0, 157598.0, -7683.0],
            Some([164, 140, 153]),
            Some(39.0),
            Some(2),
            Some(249400.70027954775),
            None,
        ),
    );
    check_ends(
        "las_conformance/laspy_fullwave.laz",
        (
            [-413.0, -323.0, 355.0],
            Some([25186, 37522, 12850]),
            Some(2166.0),
            Some(0),
            Some(417218.090871),
            None,
        ),
        (
            [11063.0, -36659.0, 6491.0],
            Some([46003, 16191, 257]),
            Some(3042.0),
            Some(0),
            Some(417219.079417),
            None,
        ),
    );
    check_ends(
        "las_conformance/r-lidar_Megaplot.laz",
        ([68499216.0, 501800692.0, 1730.0], None, Some(41.0), Some(1), Some(483825.894125), None),
        ([68494718.0, 501800671.0, 86.0], None, Some(5.0), Some(1), Some(484376.796728), None),
    );
}

#[test]
fn values_of_las_files() {
    for version in ["1.4", "1.5"] {
        check_ends(
            &format!("las_conformance/visgl_pdrf10-{version}.las"),
            (
                [373598160.0, 295657190.0, 195961234.0],
                Some([58450, 4473, 4195]),
                Some(19607.0),
                Some(243),
                Some(0.27554124211046377),
                None,
            ),
            (
                [-1686130731.0, 1843512612.0, -1693648695.0],
                Some([4705, 17448, 49305]),
                Some(19775.0),
                Some(142),
                Some(-7.909586015810054e-100),
                None,
            ),
        );
    }
}

#[test]
fn values_of_ply_files() {
    check_ends(
        "ply_conformance/made_list_before_vertex_be.ply",
        ([0.0; 3], None, None, None, None, None),
        ([0.0, 1.0, 0.0], None, None, None, None, None),
    );
    let row = |place| (place, Some([10, 20, 30]), Some(65535.0), None, None, Some([0.0, 0.0, 1.0]));
    check_ends(
        "ply_conformance/made_normal_x_diffuse_red.ply",
        row([0.0; 3]),
        row([0.0, 1.0, 0.0]),
    );
    // 0.1, 0.2 and 0.3 of 65535.
    let row = |place| (place, Some([6554, 13107, 19661]), Some(0.5), None, None, None);
    check_ends(
        "ply_conformance/made_rgb_float_scalar_alias_le.ply",
        row([0.0; 3]),
        row([0.0, 1.0, 0.0]),
    );
    check_ends(
        "ply_conformance/visgl_ripple_bin.ply",
        (
            [-5.0, -5.0, f64::from(-0.35332f32)],
            Some([10, 119, 55]),
            None,
            None,
            None,
            Some([0.08055324, 0.08055324, 0.993_49]),
        ),
        (
            [5.0, 5.0, f64::from(-0.35332f32)],
            Some([10, 119, 55]),
            None,
            None,
            None,
            Some([-0.08055324, -0.08055324, 0.993_49]),
        ),
    );
    check_ends(
        "ply_conformance/nmwsharp_platonic_shelf_big_endian.ply",
        ([-3.562626, -0.627972, 0.613591], None, None, None, None, None),
        ([6.068807, 0.985759, 0.056527], None, None, None, None, None),
    );
}

#[test]
fn normals_of_real_scans() {
    let Some(folder) = data("scans") else { return };
    let (source, batches, report) = read(&folder.join("loft_normals_3.0M.laz"), STRICT).unwrap();
    assert_eq!(report.n_read, 3_021_294);
    assert!(source.info().columns.normal && report.n_normals_missing == 154_679);
    let normal = point(&batches, 0).normal;
    assert_eq!(normal, Some([0.011_885_034, 0.756_680_5, 0.653_676_87]));

    let (_, batches, report) =
        read(&folder.join("lion_takanawa_normals_342k.ply"), STRICT).unwrap();
    assert_eq!(report.n_read, 341_989);
    let p = point(&batches, 341_988);
    assert_eq!((p.color, p.normal.map(|n| n[0])), (Some([135, 141, 147]), Some(0.712_336_8)));
}

#[test]
fn headers_say_what_is_there() {
    let Some(folder) = data("") else { return };
    let open = |name: &str| Source::open(&folder.join(name), 0, STRICT).unwrap();
    let source = open("las_conformance/laspy_simple1_4.las");
    assert_eq!(source.info().format, "LAS 1.4, point format 7");
    // The CRS is in an EVLR, in degrees.
    assert!(matches!(&source.info().crs, Some(Crs::Wkt(text)) if text.starts_with(b"GEOGCS")));
    assert!(source.info().warnings.iter().any(|w| w.contains("degrees")));
    let source = open("las_conformance/laspy_plane.laz");
    assert!(matches!(source.info().crs, Some(Crs::GeoTiff { .. })));
    let source = open("ply_conformance/pyvista_horse.ply");
    assert_eq!(source.info().format, "PLY 1.0, binary big-endian");
    assert_eq!(source.info().kind, PositionKind::Single);
    assert_eq!(source.info().columns.color, Some(ColorRange::Eight));
    assert_eq!(open("ply_conformance/PDAL_mesh.ply").info().kind, PositionKind::Double);
}
