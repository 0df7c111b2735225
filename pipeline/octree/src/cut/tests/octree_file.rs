//! Small octree files in memory.

use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::{Frame, morton};
use pvmap_vmap::container::{Written, align, head_bytes};
use pvmap_vmap::frame::{CrsKind, FrameRecord};
use pvmap_vmap::octree::{CODE_STRIDE, PointNormal, SECTIONS, close_octree, digest_of};
use pvmap_vmap::records::Record;
use pvmap_vmap::schema::{ColumnType, Schema};
use pvmap_vmap::tree::RoutingKey;
use pvmap_vmap::{OctreeSummary, Source};

use super::TestPoint;

/// Makes the file of a cloud: sorted by Morton code, points of one code in the given order; one
/// source for each of `color_depths`. Section `normals` is absent where no point has one.
pub(super) fn octree_file(cloud: &[TestPoint], color_depths: &[u32]) -> Vec<u8> {
    let mut sorted = cloud.to_vec();
    sorted.sort_by_key(|p| morton::encode(p.g));
    file_in_order(&sorted, color_depths)
}

/// Makes the file of a cloud that is taken as sorted.
pub(super) fn file_in_order(cloud: &[TestPoint], color_depths: &[u32]) -> Vec<u8> {
    let extent = f64::from(GRID_MAX);
    let frame =
        FrameRecord { frame: Frame::of_world([0.0; 3], [extent; 3]), crs_kind: CrsKind::None };
    let schema = Schema::new(&[
        ("position", ColumnType::F64x3),
        ("record", ColumnType::U64),
        ("source", ColumnType::U32),
        ("color", ColumnType::U16x3),
    ]);
    let codes = cloud.iter().step_by(CODE_STRIDE as usize);
    let contents = [
        (OctreeSummary::BYTES, summary(cloud).to_bytes()),
        (32, schema.to_bytes()),
        (Source::BYTES, sources(cloud, color_depths)),
        (0, Vec::new()),
        (schema.record_bytes(), records(cloud)),
        (8, normals(cloud)),
        (8, codes.flat_map(|p| morton::encode(p.g).to_le_bytes()).collect()),
        (FrameRecord::BYTES, frame.to_bytes()),
        (0, Vec::new()),
    ];
    assemble(&contents)
}

fn summary(cloud: &[TestPoint]) -> OctreeSummary {
    let n_points = cloud.len() as u64;
    let keys = cloud.iter().map(key_of);
    OctreeSummary {
        n_points,
        n_read: n_points,
        digest: keys.fold(0, |sum, key| sum.wrapping_add(digest_of(&key))),
        ..OctreeSummary::default()
    }
}

/// Gives what routes a point.
pub(super) fn key_of(p: &TestPoint) -> RoutingKey {
    RoutingKey { g: p.g, normal: p.normal, oriented: p.oriented }
}

fn sources(cloud: &[TestPoint], color_depths: &[u32]) -> Vec<u8> {
    let rows = color_depths.iter().enumerate().flat_map(|(i, &color_depth)| {
        Source {
            name: (0, 0),
            format: 3,
            n_stored: cloud.iter().filter(|p| p.source == i as u32).count() as u64,
            n_invalid: 0,
            scale: [1.0; 3],
            offset: [0.0; 3],
            shift: [0; 3],
            color_depth,
            gps_time: 0,
            columns: 0,
        }
        .to_bytes()
    });
    rows.collect()
}

fn records(cloud: &[TestPoint]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (i, p) in cloud.iter().enumerate() {
        // Half a step in, so that no rounding of x/E·E leaves the step.
        let x = p.g.map(|g| (f64::from(g) + 0.5).min(f64::from(GRID_MAX)));
        bytes.extend(x.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend((i as u64).to_le_bytes());
        bytes.extend(p.source.to_le_bytes());
        bytes.extend(p.color.iter().flat_map(|v| v.to_le_bytes()));
    }
    bytes
}

fn normals(cloud: &[TestPoint]) -> Vec<u8> {
    if cloud.iter().all(|p| p.normal == [0; 3]) {
        return Vec::new();
    }
    let row = |p: &TestPoint| {
        PointNormal { normal: p.normal, oriented: p.oriented, from_source: true }.to_bytes()
    };
    cloud.iter().flat_map(row).collect()
}

/// Puts sections (record size, bytes) in their places and closes the file.
fn assemble(contents: &[(usize, Vec<u8>)]) -> Vec<u8> {
    let mut file = vec![0; head_bytes(contents.len()) as usize];
    let mut written = Vec::new();
    for (name, (record_bytes, bytes)) in SECTIONS.into_iter().zip(contents) {
        file.resize(align(file.len() as u64) as usize, 0);
        written.push(Written {
            name,
            offset_bytes: file.len() as u64,
            len_bytes: bytes.len() as u64,
            record_bytes: *record_bytes as u32,
            sums: bytes.chunks(65_536).map(crc32).collect(),
        });
        file.extend(bytes);
    }
    let closing = close_octree(&written);
    file[..closing.head.len()].copy_from_slice(&closing.head);
    file.resize(closing.sums_offset_bytes as usize, 0);
    file.extend(closing.sums);
    file
}

/// The CRC-32 of [F-3], bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |c: u32, _| {
            c >> 1 ^ if c & 1 == 1 { 0xedb8_8320 } else { 0 }
        })
    })
}
