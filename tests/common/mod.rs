//! What the end-to-end tests share: small clouds, scan files of them, octrees and maps made
//! through the facade.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]

use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use fastrand::Rng;
use pvmap::geometry::{PointBatch, Positions, Rect};
use pvmap::scan::{ColorRange, LasOptions, LasWriter, PlyColumns, PlyWriter};
use pvmap::scene::{Scene, SceneKind};
use pvmap::vmap::tree::Nodes;
use pvmap::vmap::{MapView, Node, Surfel};
use pvmap::{BuildConfig, IngestRequest, Limits, Quiet};

/// Few threads: the tests run side by side.
pub const LIMITS: Limits = Limits { threads: 2, memory_bytes: 1 << 30 };

/// Says whether the long form of a test is asked for.
pub fn is_slow_run() -> bool {
    std::env::var_os("PVMAP_SLOW_TESTS").is_some()
}

/// Runs pieces 0…n-1 of a test on plain threads; gives the results in no order.
///
/// Not on rayon's: a worker that waits for the pool of a build takes up the next piece meanwhile,
/// and in that one the next, until its stack is full.
pub fn on_threads<T: Send>(n: u64, work: impl Fn(u64) -> T + Sync) -> Vec<T> {
    let next = AtomicU64::new(0);
    let run = || {
        let pieces = std::iter::repeat_with(|| next.fetch_add(1, Ordering::Relaxed));
        pieces.take_while(|&i| i < n).map(&work).collect::<Vec<T>>()
    };
    let n_threads = std::thread::available_parallelism().map_or(2, NonZero::get);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..n_threads).map(|_| scope.spawn(run)).collect();
        let done = threads.into_iter().map(|t| t.join());
        done.flat_map(|d| d.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

/// Points before they are a file.
#[derive(Debug, Clone)]
pub struct Cloud {
    pub positions: Positions,
    /// A normal each; zero or not finite where a point has none.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Red, green, blue of 8 bits.
    pub colors: Option<Vec<[u16; 3]>>,
}

impl Cloud {
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Says whether any point has a usable normal.
    pub fn has_normals(&self) -> bool {
        let usable = |n: &[f32; 3]| n.iter().all(|c| c.is_finite()) && n.iter().any(|&c| c != 0.0);
        self.normals.as_ref().is_some_and(|normals| normals.iter().any(usable))
    }

    fn batch(&self) -> PointBatch {
        PointBatch {
            source: 0,
            records: (0..self.len() as u64).collect(),
            positions: self.positions.clone(),
            color: self.colors.clone(),
            intensity: None,
            classification: None,
            gps_time: None,
            normal: self.normals.clone(),
        }
    }

    /// Writes a LAS file.
    pub fn write_las(&self, path: &Path, scale: f64, offset: [f64; 3]) {
        let normals = self.normals.is_some();
        let options = LasOptions { compressed: false, scale: [scale; 3], offset, normals };
        let mut writer = LasWriter::create(path, options).unwrap();
        writer.write(&self.batch()).unwrap();
        writer.finish().unwrap();
    }

    /// Writes a binary PLY file.
    pub fn write_ply(&self, path: &Path) {
        let double = matches!(self.positions, Positions::Double(_));
        let normal = self.normals.is_some();
        let color = self.colors.is_some().then_some(ColorRange::Eight);
        let columns = PlyColumns { double, normal, color, ..PlyColumns::default() };
        let mut writer = PlyWriter::create(path, self.len() as u64, columns).unwrap();
        writer.write(&self.batch()).unwrap();
        writer.finish().unwrap();
    }

    /// Keeps the points of some indices.
    pub fn part(&self, indices: impl Iterator<Item = usize> + Clone) -> Cloud {
        let positions = match &self.positions {
            Positions::Lattice(v) => Positions::Lattice(indices.clone().map(|i| v[i]).collect()),
            Positions::Single(v) => Positions::Single(indices.clone().map(|i| v[i]).collect()),
            Positions::Double(v) => Positions::Double(indices.clone().map(|i| v[i]).collect()),
        };
        let normals = self.normals.as_ref().map(|v| indices.clone().map(|i| v[i]).collect());
        let colors = self.colors.as_ref().map(|v| indices.map(|i| v[i]).collect());
        Cloud { positions, normals, colors }
    }
}

/// Makes 5 to 400 points of a random kind on a lattice of a random width, with normals on most.
///
/// Lattices of a few steps a side bring coincident points, shared centroids and ties; wide ones
/// bring the general case and the largest numbers; on aligned ones points are corners of cells,
/// and segments touch cells in a place, an edge or a side.
pub fn random_cloud(rng: &mut Rng) -> Cloud {
    let is_aligned = rng.u8(..4) == 0;
    let (side, low_bits) = match rng.bool() {
        _ if is_aligned => ((1 << 22) - 1, rng.u32(17..22)),
        true => (rng.i32(1..12), 0),
        false => (1 << rng.u32(5..30), 0),
    };
    let n = 5 + rng.usize(..396).min(rng.usize(..396));
    let kind = rng.u8(..5);
    let jitter = [0.0, 0.02, 0.8][rng.usize(..3)];
    let missing = [0, 0, 1, 8][rng.usize(..4)];
    let mut positions = Vec::with_capacity(n);
    let mut normals = Vec::with_capacity(n);
    for _ in 0..n {
        let (p, normal) = random_point(rng, kind, side);
        positions.push(p.map(|c| c >> low_bits << low_bits));
        let shaken = normal.map(|c| c + jitter * (rng.f32() - 0.5));
        let broken = if rng.bool() { [0.0; 3] } else { [f32::NAN, 0.0, 1.0] };
        normals.push(if rng.u8(..16) < missing { broken } else { shaken });
    }
    if is_aligned {
        // With these the grid is the lattice.
        (positions[0], positions[1]) = ([0; 3], [side; 3]);
    }
    Cloud { positions: Positions::Lattice(positions), normals: Some(normals), colors: None }
}

/// Takes points of the furnished room, with normals and colours, on a lattice of a tenth of a
/// millimetre.
pub fn room_cloud(n: u64) -> Cloud {
    scene_cloud(SceneKind::Furnished, n)
}

/// Points of a generated scene, seed 1, on a lattice of a tenth of a millimetre.
pub fn scene_cloud(kind: SceneKind, n: u64) -> Cloud {
    let scene = Scene::new(kind, 1);
    let samples: Vec<_> = (0..n).map(|i| scene.points(n).at(i)).collect();
    let steps = |p: [f64; 3]| p.map(|c| (c / 0.0001).round() as i32);
    Cloud {
        positions: Positions::Lattice(samples.iter().map(|s| steps(s.position)).collect()),
        normals: Some(samples.iter().map(|s| s.normal).collect()),
        colors: Some(samples.iter().map(|s| s.color.map(u16::from)).collect()),
    }
}

/// Draws a point of a kind of scene in a cube, with the normal of the surface it is on.
fn random_point(rng: &mut Rng, kind: u8, side: i32) -> ([i32; 3], [f32; 3]) {
    let mut p = [0; 3].map(|_| rng.i32(0..=side));
    let mut n = [0.0; 3];
    let half = side / 2;
    match kind {
        // Noise.
        0 => n = [0; 3].map(|_| rng.f32() - 0.5),
        // Two walls that face each other, and a smaller one with both faces between them.
        1 => {
            let wall = rng.usize(..4);
            p[0] = [0, side, half, half][wall];
            n[0] = [1.0, -1.0, 1.0, -1.0][wall];
            if wall > 1 {
                p[1] /= 2;
            }
        }
        // A room, its faces inward, around a small box, its faces outward.
        2 => {
            let (axis, top, inner) = (rng.usize(..3), rng.bool(), rng.u8(..3) == 0);
            p[axis] = if top { side } else { 0 };
            n[axis] = if top == inner { 1.0 } else { -1.0 };
            if inner {
                p = p.map(|v| side / 3 + v / 3);
            }
        }
        // A corner of three walls.
        3 => {
            let axis = rng.usize(..3);
            p[axis] = 0;
            n[axis] = 1.0;
        }
        // A slope over a floor.
        _ if rng.bool() => {
            p[2] = (p[0] + p[1]) / 2;
            n = [1.0, 1.0, -2.0];
        }
        _ => {
            p[2] = 0;
            n[2] = 1.0;
        }
    }
    (p, n)
}

/// Ingests scans into a folder, with limits.
pub fn ingest_with(
    scans: &[PathBuf],
    folder: &Path,
    limits: &Limits,
    set: impl FnOnce(&mut IngestRequest),
) -> PathBuf {
    let octree = folder.join("scan.octree");
    let mut request = IngestRequest::new(scans.iter().cloned(), octree.clone());
    request.overwrite = true;
    set(&mut request);
    pvmap::ingest(&request, limits, &Quiet).unwrap();
    octree
}

/// Builds a map and gives its bytes.
pub fn build_with(octree: &Path, config: &BuildConfig, limits: &Limits) -> Vec<u8> {
    let output = octree.with_extension("vmap");
    pvmap::build(octree, &output, config, limits, &Quiet).unwrap();
    std::fs::read(output).unwrap()
}

/// Reads all nodes, surfels and links of a map.
pub fn contents(view: &MapView<'_>) -> (Vec<Node>, Vec<Surfel>, Vec<(u32, u32)>) {
    let nodes = (0..view.n_nodes()).map(|id| view.node(id).unwrap()).collect();
    let surfels = (0..view.summary().n_surfels).map(|id| view.surfel(id).unwrap()).collect();
    let lists = (0..view.links().n_blocks()).map(|i| view.links().lists(i).unwrap());
    let links = lists.flat_map(|l| l.iter().collect::<Vec<_>>()).collect();
    (nodes, surfels, links)
}

/// Gives the rectangles of a map; none where its profile has none.
pub fn rects(view: &MapView<'_>) -> Vec<Rect> {
    (0..view.summary().n_surfels).filter_map(|id| view.rect(id).unwrap()).collect()
}
