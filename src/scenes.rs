//! Generated scenes as scan files, models and truths as meshes: joins `scene` to the readers and
//! writers of `scan`.

use std::path::Path;

use pvmap_geometry::{PointBatch, Positions};
use pvmap_scan::{
    ColorRange, LasOptions, LasWriter, MeshMemory, MeshWriter, PlyColumns, PlyWriter,
};
use pvmap_scene::{Defects, Mesh, Sample, Scan, Scene};
use pvmap_store::Watch;
use rayon::prelude::*;

use crate::{Error, Limits};

/// Points generated at once.
const BLOCK_POINTS: u64 = 1 << 18;
/// Lattice of a written LAS file: a tenth of a millimetre, finer than any scanner's noise.
const SCALE_M: f64 = 0.0001;

/// Which points of a scene to write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneRequest {
    /// How many.
    pub n_points: u64,
    /// Whether in random instead of coherent order.
    pub shuffle: bool,
}

impl SceneRequest {
    /// Gives these points of a scene with defects.
    pub fn with<'a>(&self, scene: &'a Scene, defects: &Defects) -> Scan<'a> {
        let points = scene.points(self.n_points);
        let points = if self.shuffle { points.shuffled() } else { points };
        points.recorded(defects)
    }

    /// Gives these points of a scene as they are.
    pub fn of<'a>(&self, scene: &'a Scene) -> Scan<'a> {
        self.with(scene, &Defects::default())
    }
}

enum Writer {
    Las(LasWriter),
    Ply(PlyWriter),
}

/// Writes points of a scene, with normals and colours, as LAS, LAZ or PLY by the file's ending.
///
/// # Errors
/// Where the ending is another one, the file cannot be written or the run is asked to stop.
pub fn write(
    scene: &Scene,
    request: &SceneRequest,
    path: &Path,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<(), Error> {
    write_scan(&request.of(scene), path, limits, watch)
}

/// Writes points with defects, as [`write()`] does; those without a normal have (0, 0, 0).
///
/// # Errors
/// Those of [`write()`].
pub fn write_scan(
    points: &Scan<'_>,
    path: &Path,
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<(), Error> {
    let mut scan = open(path, points.len())?;
    limits.run(|| {
        scan.fill(points, watch)?;
        scan.finish()
    })?
}

/// Writes points as [`write_scan()`] does, and beside them the scene's exact triangles as a PLY
/// mesh, in its own metres. A scan that got its name has its truth: that gets its name first.
///
/// # Errors
/// Those of [`write()`], and where the scene has a sphere or the mesh cannot be written. Neither
/// file is there then or, where the scan's last step failed, the truth alone.
pub fn write_with_truth(
    points: &Scan<'_>,
    [path, truth]: [&Path; 2],
    limits: &Limits,
    watch: &dyn Watch,
) -> Result<(), Error> {
    // Both are begun before there is any work to lose.
    let mut scan = open(path, points.len())?;
    let file = MeshWriter::create(truth)?;
    let mesh = points.scene().mesh();
    let (mesh, colors) =
        mesh.map_err(|source| Error::Scene { path: truth.to_path_buf(), source })?;
    limits.run(|| {
        scan.fill(points, watch)?;
        file.finish(mesh.corners(), mesh.triangles(), &colors)?;
        scan.finish()
    })?
}

impl Writer {
    fn fill(&mut self, points: &Scan<'_>, watch: &dyn Watch) -> Result<(), Error> {
        watch.stage("scene", Some(points.len()), "points");
        for first in (0..points.len()).step_by(BLOCK_POINTS as usize) {
            watch.check()?;
            let batch = batch_of(points, first, BLOCK_POINTS.min(points.len() - first));
            match self {
                Writer::Las(w) => w.write(&batch)?,
                Writer::Ply(w) => w.write(&batch)?,
            }
            watch.advance(batch.len() as u64);
        }
        Ok(())
    }

    fn finish(self) -> Result<(), Error> {
        match self {
            Writer::Las(w) => w.finish()?,
            Writer::Ply(w) => w.finish()?,
        }
        Ok(())
    }
}

fn open(path: &Path, n_points: u64) -> Result<Writer, Error> {
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    let las = |compressed| {
        let (scale, offset) = ([SCALE_M; 3], [0.0; 3]);
        LasWriter::create(path, LasOptions { compressed, scale, offset, normals: true })
    };
    Ok(match ending.to_str() {
        Some("las") => Writer::Las(las(false)?),
        Some("laz") => Writer::Las(las(true)?),
        Some("ply") => {
            let color = Some(ColorRange::Eight);
            let columns =
                PlyColumns { double: false, normal: true, color, ..PlyColumns::default() };
            Writer::Ply(PlyWriter::create(path, n_points, columns)?)
        }
        _ => {
            let message = format!("{}: a scene is written as .las, .laz or .ply", path.display());
            return Err(Error::Usage(message));
        }
    })
}

/// Generates points `first..first + n` of a scene.
pub fn batch(scene: &Scene, request: &SceneRequest, first: u64, n: u64) -> PointBatch {
    batch_of(&request.of(scene), first, n)
}

fn batch_of(points: &Scan<'_>, first: u64, n: u64) -> PointBatch {
    let samples: Vec<Sample> = (first..first + n).into_par_iter().map(|i| points.at(i)).collect();
    PointBatch {
        source: 0,
        records: (first..first + n).collect(),
        positions: Positions::Double(samples.iter().map(|s| s.position).collect()),
        color: Some(samples.iter().map(|s| s.color.map(u16::from)).collect()),
        intensity: None,
        classification: None,
        gps_time: None,
        normal: Some(samples.iter().map(|s| s.normal).collect()),
    }
}

/// A mesh that was read.
#[derive(Debug)]
pub struct Model {
    /// Its triangles.
    pub mesh: Mesh,
    /// Faces of fewer than three corners, which were left out.
    pub n_flat_faces: u64,
    /// What of the memory it takes, in a scene and when that is written as a mesh again.
    pub held_bytes: u64,
}

/// Reads a mesh, such as a model or the truth of a scene, from a PLY file; gzip may have packed it.
///
/// # Errors
/// Where the file cannot be read, is no mesh, or is more than `memory_bytes` hold of a scene.
pub fn read_mesh(path: &Path, memory_bytes: u64) -> Result<Model, Error> {
    let memory = MeshMemory {
        total_bytes: memory_bytes,
        corner_bytes: Scene::MESH_CORNER_BYTES,
        triangle_bytes: Scene::TRIANGLE_BYTES + Scene::MESH_TRIANGLE_BYTES,
    };
    let read = pvmap_scan::read_mesh(path, memory)?;
    let (n_flat_faces, held_bytes) = (read.n_flat_faces, memory.needed(&read));
    let mesh = Mesh::new(read.corners, read.normals, read.triangles)
        .map_err(|source| Error::Scene { path: path.to_path_buf(), source })?;
    Ok(Model { mesh, n_flat_faces, held_bytes })
}
