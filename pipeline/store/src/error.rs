//! What can go wrong at the door to the disk.

use std::io;
use std::path::{Path, PathBuf};

/// A failure of the disk, with the file it happened to.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// An input does not exist.
    #[error("{}: no such file", path.display())]
    NotFound {
        /// The file asked for.
        path: PathBuf,
    },
    /// Something exists but is not a regular file.
    #[error("{}: not a regular file", path.display())]
    NotAFile {
        /// The file asked for.
        path: PathBuf,
    },
    /// The user may not do this.
    #[error("{}: permission denied ({action})", path.display())]
    Permission {
        /// The file or folder.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
    },
    /// An output cannot be made where it was asked for.
    #[error("{}: cannot create: {reason}", path.display())]
    CannotCreate {
        /// The output.
        path: PathBuf,
        /// Why not, and what to do.
        reason: String,
    },
    /// The disk is full.
    #[error("{}: no space left ({action}); free some and run again", path.display())]
    NoSpace {
        /// The file being written.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
    },
    /// The disk has less left than the run is known to need.
    #[error(
        "{}: needs about {} MiB of disk, {} MiB are left; free some or choose another folder",
        path.display(), need_bytes >> 20, have_bytes >> 20
    )]
    TooLittleDisk {
        /// The output.
        path: PathBuf,
        /// What the run will write at most.
        need_bytes: u64,
        /// What is left.
        have_bytes: u64,
    },
    /// Any other failure of the operating system.
    #[error("{}: {action} failed: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// Another run makes this output.
    #[error("{}: locked by {holder}; wait for it or stop it", path.display())]
    Locked {
        /// The output.
        path: PathBuf,
        /// Who, and since when.
        holder: String,
    },
    /// A temporary file is not what was written to it.
    #[error(
        "{}: damaged since it was written; run again, what was in it is done anew", path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The run was asked to stop.
    #[error("interrupted")]
    Interrupted,
    /// The memory budget cannot hold what a stage needs at the least.
    #[error(
        "--memory leaves {} MiB for {what}, which needs at least {} MiB; give it more",
        have_bytes >> 20, (need_bytes >> 20) + 1
    )]
    Budget {
        /// What had to be held.
        what: &'static str,
        /// What it needs at least.
        need_bytes: u64,
        /// What there is.
        have_bytes: u64,
    },
}

impl StoreError {
    /// Names an error of the operating system by its path and what was tried.
    pub fn io(path: &Path, action: &'static str, source: io::Error) -> StoreError {
        let path = path.to_path_buf();
        match source.kind() {
            io::ErrorKind::NotFound => StoreError::NotFound { path },
            io::ErrorKind::PermissionDenied => StoreError::Permission { path, action },
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                StoreError::NoSpace { path, action }
            }
            _ => StoreError::Io { path, action, source },
        }
    }

    /// Names an error at a file of the run's own, which was there and could be written before: that
    /// it is missing or may not be touched any more is a failure of the disk, not a wrong name.
    pub fn own(path: &Path, action: &'static str, source: io::Error) -> StoreError {
        match StoreError::io(path, action, source) {
            StoreError::NotFound { path } => {
                StoreError::Io { path, action, source: io::ErrorKind::NotFound.into() }
            }
            StoreError::Permission { path, action } => {
                StoreError::Io { path, action, source: io::ErrorKind::PermissionDenied.into() }
            }
            other => other,
        }
    }
}
