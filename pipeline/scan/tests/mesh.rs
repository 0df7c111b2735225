//! Meshes: written ones come back, foreign ones are read, and what is none is told in a line.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::io::Write;
use std::path::{Path, PathBuf};

use pvmap_scan::{ErrorKind, MeshData, MeshMemory, MeshWriter, ScanError};

const TEXT: &str = "ply\nformat ascii 1.0\ncomment of nothing\nelement vertex 4\n\
property float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\n\
property float nz\nelement face 2\nproperty uchar flags\n\
property list uchar int vertex_index\nend_header\n\
0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1.5 0 0 1 0\n7 3 0 1 2\n8 4 0 1 2 3\n";

fn file(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
    common::file("mesh.ply", bytes)
}

fn read_mesh(path: &Path) -> Result<MeshData, ScanError> {
    pvmap_scan::read_mesh(path, MeshMemory::of_mesh(1 << 30))
}

fn refused(bytes: &[u8]) -> String {
    let (_folder, path) = file(bytes);
    let e = read_mesh(&path).expect_err("it is no mesh");
    assert_eq!(e.kind(), ErrorKind::BadData);
    let message = e.to_string();
    assert!(!message.contains('\n') && message.chars().count() < 400, "{message}");
    message
}

#[test]
fn a_written_mesh_comes_back_to_the_last_bit() {
    let corners = [[0.1, -2.0, 1e-30], [1.0 / 3.0, 5.5, -0.0], [7e9, 0.2, 0.3], [1.0, 2.0, 3.0]];
    let (triangles, colors) = ([[0, 1, 2], [3, 2, 1]], [[1, 2, 3], [255, 0, 9]]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mesh.ply");
    MeshWriter::create(&path).unwrap().finish(&corners, &triangles, &colors).unwrap();
    let found = read_mesh(&path).unwrap();
    assert_eq!(found.triangles, triangles);
    assert_eq!(found.corners.as_flattened().len(), 12);
    let bits = |c: &[[f64; 3]]| c.as_flattened().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&found.corners), bits(&corners));
    assert_eq!(found.normals, None);
}

#[test]
fn text_normals_polygons_and_gzip_are_read() {
    let expected = MeshData {
        corners: vec![[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.5, 0.0]],
        normals: Some(vec![[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        triangles: vec![[0, 1, 2], [0, 1, 2], [0, 2, 3]],
        n_flat_faces: 0,
    };
    let (_folder, path) = file(TEXT.as_bytes());
    assert_eq!(read_mesh(&path).unwrap(), expected);
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(TEXT.as_bytes()).unwrap();
    let packed = packed.finish().unwrap();
    let (_folder, path) = file(&packed);
    assert_eq!(read_mesh(&path).unwrap(), expected);
    assert!(refused(&packed[..packed.len() - 20]).contains("mesh.ply"));
}

#[test]
fn faces_of_fewer_than_three_corners_are_counted_and_left_out() {
    for (flat, n) in [("7 2 0 1", 1), ("7 0", 1), ("7 1 9", 1), ("7 3 0 1 2", 0)] {
        let (_folder, path) = file(TEXT.replacen("7 3 0 1 2", flat, 1).as_bytes());
        let found = read_mesh(&path).unwrap();
        assert_eq!((found.n_flat_faces, found.triangles.len()), (n, 3 - n as usize), "{flat}");
    }
}

#[test]
fn a_mesh_of_more_than_the_memory_is_refused() {
    let least = |corner_bytes, triangle_bytes| {
        let (_folder, path) = file(TEXT.as_bytes());
        let holds = |total_bytes| {
            let memory = MeshMemory { total_bytes, corner_bytes, triangle_bytes };
            match pvmap_scan::read_mesh(&path, memory) {
                Ok(_) => true,
                Err(e) => {
                    let told = e.to_string();
                    assert!(told.contains("--memory") && told.contains("triangles"), "{told}");
                    false
                }
            }
        };
        (0..5000).find(|&bytes| holds(bytes)).unwrap()
    };
    // Four corners and, of two faces, three triangles.
    let bare = least(0, 0);
    assert_eq!(least(100, 0) - bare, 400);
    assert_eq!(least(0, 100) - bare, 300);
}

#[test]
fn what_is_no_mesh_is_told_in_one_line() {
    let changed = |from: &str, to: &str| refused(TEXT.replacen(from, to, 1).as_bytes());
    assert!(refused(b"").contains("PLY header"));
    assert!(refused(b"hello, I am a letter\n").contains("PLY header"));
    assert!(changed("element face", "element fact").contains("no element face"));
    assert!(changed("vertex_index", "corners").contains("no element face"));
    assert!(changed("float z", "float w").contains("no element vertex with x, y and z"));
    assert!(changed("element face 2", "element face 0").contains("no element face"));
    assert!(changed("7 3 0 1 2", "7 3 0 -1 2").contains("face 0: an index"));
    assert!(changed("element face 2", "element face 3").contains("ends before the last of 3"));
    assert!(refused(&TEXT.as_bytes()[..TEXT.len() - 20]).contains("face"));
    // Counts that nothing can hold cost nothing.
    let huge = changed("element vertex 4", "element vertex 1000000000000");
    assert!(huge.contains("declares 1000000000000 of vertex"), "{huge}");
    assert!(changed("element face 2", "element face 4000000000").contains("4000000000 of face"));
    assert!(changed("element vertex 4", "element vertex 99999999999999999999").contains("PLY"));
    let bare = changed("element face 2", "element bare 9000000000\nelement face 2");
    assert!(bare.contains("without any property"), "{bare}");
    let e = read_mesh(Path::new("/nonexistent/mesh.ply")).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert_eq!(read_mesh(Path::new("/tmp")).unwrap_err().kind(), ErrorKind::NotFound);
}

#[test]
fn a_list_longer_than_the_file_is_refused() {
    let binary = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n\
        property float y\nproperty float z\nelement face 1\n\
        property list uint uint vertex_indices\nend_header\n";
    let mut bytes = binary.to_vec();
    bytes.extend_from_slice(&[0; 12]);
    bytes.extend_from_slice(&u32::MAX.to_le_bytes());
    bytes.extend_from_slice(&[0; 8]);
    assert!(refused(&bytes).contains("face"));
}

#[test]
fn no_byte_of_a_small_mesh_makes_a_panic() {
    let (_folder, path) = file(TEXT.as_bytes());
    for at in 0..TEXT.len() {
        for byte in [0, b'\n', b'9', b'-', 0xff] {
            let mut bytes = TEXT.as_bytes().to_vec();
            bytes[at] = byte;
            std::fs::write(&path, &bytes).unwrap();
            let _ = read_mesh(&path);
        }
    }
}

#[test]
fn foreign_files_are_meshes_or_refused() {
    let mut found = Vec::new();
    for folder in ["ply_conformance", "malformed", "stanford"] {
        let Some(folder) = common::data(folder) else { return };
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            match read_mesh(&path) {
                Ok(mesh) => found.push((name, mesh.corners.len(), mesh.triangles.len())),
                Err(e) => {
                    assert_eq!(e.kind(), ErrorKind::BadData, "{e}");
                    assert!(!e.to_string().contains('\n'), "{e}");
                }
            }
        }
    }
    for expected in [
        ("ddiakopoulos_icosahedron.ply", 12, 20),
        ("ddiakopoulos_icosahedron_ascii.ply", 12, 20),
        ("pyvista_horse.ply", 48_485, 96_966),
        ("armadillo_43k.ply", 43_243, 86_482),
        ("bunny_bun_zipper.ply", 35_947, 69_451),
        ("dragon_vrip.ply.gz", 437_645, 871_414),
        ("happy_buddha_50k.ply", 49_950, 100_000),
    ] {
        assert!(found.iter().any(|f| (f.0.as_str(), f.1, f.2) == expected), "{expected:?}");
    }
    eprintln!("meshes: {found:?}");
}
