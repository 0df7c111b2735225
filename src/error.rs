//! Everything that can go wrong, with the exit code it ends the command with.

use std::path::{Path, PathBuf};

use pvmap_octree::OctreeError;
use pvmap_query::QueryError;
use pvmap_scan::{ErrorKind, ScanError};
use pvmap_scene::{SceneError, SceneKind};
use pvmap_store::StoreError;
use pvmap_visibility::VisibilityError;
use pvmap_vmap::FormatError;

/// A failure of the pipeline.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A scan file.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// The disk, the budget, a wish to stop.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An octree stage.
    #[error(transparent)]
    Octree(#[from] OctreeError),
    /// The visibility stage.
    #[error(transparent)]
    Visibility(#[from] VisibilityError),
    /// A question that has no answer.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// An artifact that cannot be read.
    #[error("{}: {source}", path.display())]
    Artifact {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: FormatError,
    },
    /// A mesh that is none, or cannot be what it shall be in a scene.
    #[error("{}: {source}", path.display())]
    Scene {
        /// The mesh.
        path: PathBuf,
        /// What is wrong with it.
        source: SceneError,
    },
    /// A configuration that cannot be used.
    #[error("{0}")]
    Config(String),
    /// A request that contradicts itself.
    #[error("{0}")]
    Usage(String),
    /// Data that is not what it should be.
    #[error("{0}")]
    Data(String),
    /// Neither a file nor a scene that could be generated.
    #[error("{}: no such file, nor a scene; give a scan, an octree or one of: {}",
            .0.display(), SceneKind::ALL.map(SceneKind::name).join(", "))]
    NoSource(PathBuf),
    /// A command that was run for a part of the work and failed.
    #[error("{message}")]
    Command {
        /// What it said.
        message: String,
        /// Its exit code.
        code: u8,
    },
    /// The system gives no threads.
    #[error("cannot start threads: {0}; give --threads a smaller number")]
    Threads(String),
}

impl Error {
    /// Names the artifact that a format error is about.
    pub fn artifact(path: &Path, source: FormatError) -> Error {
        Error::Artifact { path: path.to_path_buf(), source }
    }

    /// Says which map a question failed at, where the map is to blame.
    pub fn of_query(path: &Path, e: QueryError) -> Error {
        match e {
            QueryError::Format(e) => Error::artifact(path, e),
            QueryError::Stopped => StoreError::Interrupted.into(),
            e => Error::Query(e),
        }
    }

    /// Says which octree a question failed at, where the octree is to blame.
    pub fn of_octree(path: &Path, e: QueryError) -> Error {
        match e {
            QueryError::Octree(e) => Error::artifact(path, e),
            e => Error::of_query(path, e),
        }
    }

    /// Gives the exit code, as sysexits has them. Source: DESIGN.md §8.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Scan(e) => match e.kind() {
                ErrorKind::BadData => 65,
                ErrorKind::NotFound => 66,
                ErrorKind::Permission => 77,
                ErrorKind::CannotCreate => 73,
                _ => of_scan_store(e),
            },
            Error::Store(e) | Error::Octree(OctreeError::Store(e)) => of_store(e),
            Error::Visibility(VisibilityError::Store(e)) => of_store(e),
            Error::Artifact { source, .. }
            | Error::Octree(OctreeError::Format(source))
            | Error::Query(QueryError::Format(source) | QueryError::Octree(source)) => {
                of_format(source)
            }
            Error::Octree(OctreeError::TooManyNodes) | Error::Config(_) => 78,
            Error::Octree(OctreeError::Columns { .. } | OctreeError::Lost { .. }) => 70,
            Error::Visibility(VisibilityError::Compress(_) | VisibilityError::Panicked(_)) => 70,
            Error::Visibility(VisibilityError::Stopped { .. }) => 130,
            Error::Visibility(
                VisibilityError::Differs { .. } | VisibilityError::ManyNodes { .. },
            ) => 78,
            Error::Query(e) if e.kind() == pvmap_query::ErrorKind::Usage => 2,
            Error::Visibility(_) | Error::Query(_) | Error::Data(_) => 65,
            Error::Scene { source, .. } => of_scene(source),
            Error::Usage(_) => 2,
            Error::NoSource(_) => 66,
            Error::Command { code, .. } => *code,
            Error::Threads(_) => 74,
        }
    }
}

fn of_scene(e: &SceneError) -> u8 {
    match e {
        SceneError::TooMany { .. } | SceneError::TooLarge { .. } | SceneError::Round => 2,
        _ => 65,
    }
}

fn of_scan_store(e: &ScanError) -> u8 {
    match e {
        ScanError::Store(e) => of_store(e),
        _ => 65,
    }
}

fn of_store(e: &StoreError) -> u8 {
    match e {
        StoreError::NotFound { .. } | StoreError::NotAFile { .. } => 66,
        StoreError::Permission { .. } => 77,
        StoreError::CannotCreate { .. } => 73,
        StoreError::Budget { .. } => 78,
        StoreError::Interrupted => 130,
        StoreError::Locked { .. } => 75,
        StoreError::NoSpace { .. }
        | StoreError::TooLittleDisk { .. }
        | StoreError::Damaged { .. }
        | StoreError::Io { .. } => 74,
    }
}

fn of_format(e: &FormatError) -> u8 {
    match e {
        FormatError::Version { .. } | FormatError::Required { .. } => 78,
        _ => 65,
    }
}
