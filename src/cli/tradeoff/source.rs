//! What a sweep is about: a generated scene, a scan or an octree, and what says what is true of it.

use std::path::{Path, PathBuf};

use pvmap::scene::{MOST_POINTS, Scan, Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::tradeoff::{Judge, Truth};
use pvmap::vmap::OctreeView;
use pvmap::vmap::octree::FILE_NAME;
use pvmap::{Error, IngestRequest, Limits, Mapped, NormalsFrom, StoreError, Watch};
use tempfile::TempDir;

use super::super::read_mesh;
use super::Args;

/// Points of a generated scene, where none are asked for.
pub(super) const POINTS: u64 = 400_000;

/// The octree that all settings are built of.
pub(super) struct Source {
    /// Where maps lie, and what is generated.
    folder: TempDir,
    octree: PathBuf,
    /// The surfaces that are the truth, if there are any.
    surfaces: Option<(Scene, Judge)>,
}

fn folder() -> Result<TempDir, Error> {
    let made = tempfile::Builder::new().prefix("pvmap-").tempdir();
    Ok(made.map_err(|e| StoreError::io(&std::env::temp_dir(), "make a folder in", e))?)
}

/// Lists the files that are read.
pub(super) fn inputs(args: &Args) -> Vec<PathBuf> {
    let source = &args.source;
    let source = if source.is_dir() { source.join(FILE_NAME) } else { source.clone() };
    let read = std::iter::once(source).chain(args.truth.clone()).chain(args.config.clone());
    let read = read.chain(args.lights.inputs());
    // Names of scenes and presets are no files.
    read.filter(|path| path.exists()).collect()
}

impl Source {
    /// Finds an octree, or makes one of a scan or of a scene.
    ///
    /// # Errors
    /// Where there is nothing of that name, or it or the truth cannot be read.
    pub(super) fn find(args: &Args, limits: &Limits, watch: &dyn Watch) -> Result<Source, Error> {
        let folder = folder()?;
        let kind = kind_of(args)?;
        let octree = match kind {
            None if args.source.is_dir() => args.source.clone(),
            _ => folder.path().join("scan.octree"),
        };
        let mut surfaces = None;
        if let Some(truth) = &args.truth {
            watch.stage("truth", None, "triangles");
            let mesh = read_mesh(truth, limits.memory_bytes)?.mesh;
            let scene = Scene::of_mesh(&mesh, args.seed);
            watch.advance(scene.n_surfaces() as u64);
            surfaces = Some((scene, Judge::Triangles));
        }
        let scan = match kind {
            None => args.source.clone(),
            Some(kind) => {
                let scan = folder.path().join("scan.ply");
                let scene = Scene::new(kind, args.seed);
                let n_points = args.points.unwrap_or(POINTS);
                let request = SceneRequest { n_points, shuffle: false };
                scenes::write(&scene, &request, &scan, limits, watch)?;
                surfaces = Some((scene, Judge::Geometry));
                scan
            }
        };
        if octree != args.source {
            pvmap::ingest(&IngestRequest::new([scan], octree.clone()), limits, watch)?;
        }
        Ok(Source { folder, octree, surfaces })
    }

    /// Makes an octree of a scan with defects.
    ///
    /// # Errors
    /// Where there is no room for it, or the run is asked to stop.
    pub(super) fn of_scan(
        points: &Scan<'_>,
        normals: NormalsFrom,
        limits: &Limits,
        watch: &dyn Watch,
    ) -> Result<Source, Error> {
        let folder = folder()?;
        let [scan, octree] = ["scan.ply", "scan.octree"].map(|name| folder.path().join(name));
        scenes::write_scan(points, &scan, limits, watch)?;
        let request = IngestRequest { normals, ..IngestRequest::new([scan], octree.clone()) };
        pvmap::ingest(&request, limits, watch)?;
        Ok(Source { folder, octree, surfaces: None })
    }

    pub(super) fn octree(&self) -> &Path {
        &self.octree
    }

    /// Gives the path of a temporary file.
    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(super) fn view<'a>(&self, file: &'a Mapped) -> Result<OctreeView<'a>, Error> {
        OctreeView::open(file).map_err(|e| Error::artifact(&self.octree.join(FILE_NAME), e))
    }

    /// Says who judges.
    ///
    /// # Errors
    /// Where the points are to judge, and the octree is damaged or its tree outgrows the memory.
    pub(super) fn truth<'a>(
        &'a self,
        view: &'a OctreeView<'a>,
        limits: &Limits,
        watch: &dyn Watch,
    ) -> Result<(Truth<'a>, Judge), Error> {
        if let Some((scene, judge)) = &self.surfaces {
            return Ok((Truth::Surfaces(scene), *judge));
        }
        let (truth, _) = limits.run(|| Truth::of_points(view, limits.memory_bytes, watch))??;
        Ok((truth, Judge::Reference))
    }

    /// Says which file an error is about.
    pub(super) fn named(&self, e: Error) -> Error {
        use pvmap::query::QueryError;
        match e {
            Error::Query(QueryError::Octree(e) | QueryError::Format(e)) => {
                Error::artifact(&self.octree.join(FILE_NAME), e)
            }
            e => e,
        }
    }
}

/// Gives the scene that is meant, if a scene is: what is there goes by its own name.
pub(super) fn kind_of(args: &Args) -> Result<Option<SceneKind>, Error> {
    let source = args.source.display();
    let kind = args.source.to_str().and_then(|name| name.parse::<SceneKind>().ok());
    let refuse = |message: String| Err(Error::Usage(message));
    match kind.filter(|_| !args.source.exists()) {
        None if args.points.is_some() => {
            refuse(format!("{source}: --points are those of a generated scene"))
        }
        None if !args.source.exists() => Err(Error::NoSource(args.source.clone())),
        None => Ok(None),
        Some(_) if args.truth.is_some() => {
            refuse(format!("{source}: the truth of a generated scene is known without --truth"))
        }
        Some(_) if args.points.is_some_and(|n| n == 0 || n > MOST_POINTS) => {
            refuse(format!("--points: give 1 to {MOST_POINTS}"))
        }
        Some(kind) => Ok(Some(kind)),
    }
}
