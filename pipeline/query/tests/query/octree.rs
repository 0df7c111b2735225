//! Small octree files made in memory.

use fastrand::Rng;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::normal::{self, Normal};
use pvmap_geometry::{Frame, GridPoint, morton};
use pvmap_vmap::container::{BLOCK_BYTES, Written, align, head_bytes};
use pvmap_vmap::frame::{CrsKind, FrameRecord};
use pvmap_vmap::octree::{CODE_STRIDE, PointNormal, SECTIONS, close_octree, digest_of};
use pvmap_vmap::records::Record;
use pvmap_vmap::schema::{COLUMN_BYTES, ColumnType, Schema};
use pvmap_vmap::tree::RoutingKey;
use pvmap_vmap::{OctreeSummary, Source};

/// A point of a cloud.
pub(crate) type Key = RoutingKey;

/// Sorts a cloud as an octree does.
pub(crate) fn sorted(mut cloud: Vec<Key>) -> Vec<Key> {
    cloud.sort_by_key(|key| morton::encode(key.g));
    cloud
}

/// Makes the file of a cloud that is taken as sorted, on a lattice whose steps are grid steps.
pub(crate) fn octree_file(cloud: &[Key]) -> Vec<u8> {
    octree_file_with(cloud, false)
}

/// Makes such a file and says whether its normals came from the source.
pub(crate) fn octree_file_with(cloud: &[Key], from_source: bool) -> Vec<u8> {
    let frame = Frame::of_lattice([1.0; 3], [0.0; 3], [0; 3], [i64::from(GRID_MAX); 3]);
    let schema = Schema::new(&[("position", ColumnType::I32x3), ("record", ColumnType::U32)]);
    let n_points = cloud.len() as u64;
    let summary = OctreeSummary {
        n_points,
        n_read: n_points,
        digest: cloud.iter().fold(0, |sum, key| sum.wrapping_add(digest_of(key))),
        ..OctreeSummary::default()
    };
    let source = Source {
        name: (0, 0),
        format: 1,
        n_stored: n_points,
        n_invalid: 0,
        scale: [1.0; 3],
        offset: [0.0; 3],
        shift: [0; 3],
        color_depth: 0,
        gps_time: 0,
        columns: 0,
    };
    let record = |(key, number): (&Key, u32)| {
        let fields = [key.g[0], key.g[1], key.g[2], number];
        fields.into_iter().flat_map(u32::to_le_bytes).collect::<Vec<u8>>()
    };
    let row = |key: &Key| {
        let Key { normal, oriented, .. } = *key;
        PointNormal { normal, oriented, from_source: from_source && normal != [0; 3] }.to_bytes()
    };
    let codes = cloud.iter().step_by(CODE_STRIDE as usize);
    let contents = [
        (OctreeSummary::BYTES, summary.to_bytes()),
        (COLUMN_BYTES, schema.to_bytes()),
        (Source::BYTES, source.to_bytes()),
        (0, Vec::new()),
        (schema.record_bytes(), cloud.iter().zip(0..).flat_map(record).collect()),
        (8, cloud.iter().flat_map(row).collect()),
        (8, codes.flat_map(|key| morton::encode(key.g).to_le_bytes()).collect()),
        (FrameRecord::BYTES, FrameRecord { frame, crs_kind: CrsKind::None }.to_bytes()),
        (0, Vec::new()),
    ];
    seal(&contents)
}

fn seal(contents: &[(usize, Vec<u8>)]) -> Vec<u8> {
    let mut file = vec![0; head_bytes(contents.len()) as usize];
    let mut table = Vec::new();
    for (name, (record_bytes, bytes)) in SECTIONS.into_iter().zip(contents) {
        file.resize(align(file.len() as u64) as usize, 0);
        table.push(Written {
            name,
            offset_bytes: file.len() as u64,
            len_bytes: bytes.len() as u64,
            record_bytes: *record_bytes as u32,
            sums: bytes.chunks(BLOCK_BYTES as usize).map(crc32fast::hash).collect(),
        });
        file.extend(bytes);
    }
    let closing = close_octree(&table);
    file.resize(closing.sums_offset_bytes as usize, 0);
    file.extend(closing.sums);
    file[..closing.head.len()].copy_from_slice(&closing.head);
    file
}

/// Draws a cloud. Narrow ones bring coincident points and ties, wide ones the largest numbers,
/// and on steps of a power of two points are corners of cells, and segments go along their edges.
pub(crate) fn random_cloud(rng: &mut Rng, n: usize) -> Vec<Key> {
    let width = if rng.bool() { rng.u32(1..9) } else { 1 << rng.u32(4..=22) };
    let width = width.min(GRID_MAX);
    let low_bits = if rng.u8(..3) == 0 { rng.u32(0..=width.ilog2()) } else { 0 };
    // In a corner of the cube, or anywhere.
    let start = [0; 3].map(|_| match rng.u8(..3) {
        0 => 0,
        1 => GRID_MAX - width,
        _ => rng.u32(0..=GRID_MAX - width),
    });
    let (is_flat, oriented) = (rng.bool(), rng.u8(..3));
    let point = |rng: &mut Rng| {
        let mut off = [0; 3].map(|_| rng.u32(0..=width) >> low_bits << low_bits);
        let axis = rng.usize(..3);
        let mut n = [0; 3].map(|_| rng.f32() - 0.5);
        if is_flat {
            // Walls: some planes, each full of points.
            off[axis] = width / 4 * rng.u32(0..=4);
            n = [0.0; 3];
            n[axis] = if rng.bool() { 1.0 } else { -1.0 };
        }
        let g: GridPoint = [0, 1, 2].map(|i| start[i] + off[i]);
        let normal: Normal = normal::quantise(n).filter(|_| rng.u8(..16) > 0).unwrap_or_default();
        let oriented = normal != [0; 3] && (oriented == 0 || oriented == 1 && rng.bool());
        Key { g, normal, oriented }
    };
    let mut cloud: Vec<Key> = (0..n).map(|_| point(rng)).collect();
    if rng.u8(..4) == 0 {
        // More in one place than any cell may have undivided.
        let n_same = rng.usize(..200);
        let one = cloud[rng.usize(..n)];
        cloud.extend((0..n_same).map(|_| Key { g: one.g, ..point(rng) }));
    }
    sorted(cloud)
}
