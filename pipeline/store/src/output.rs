//! Outputs: written under a temporary name in the same folder, then renamed: absent, old or whole.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use tempfile::{NamedTempFile, TempPath};

use crate::StoreError;

/// A file that appears under its name only when [`AtomicFile::commit`] is called; dropped before,
/// it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFile {
    file: File,
    temp: TempPath,
    path: PathBuf,
}

impl AtomicFile {
    /// Starts an output beside its final name.
    ///
    /// # Errors
    /// Where the folder does not exist or may not be written, or `path` is a folder.
    pub fn create(path: &Path) -> Result<AtomicFile, StoreError> {
        if path.is_dir() || path.file_name().is_none() {
            let reason = "it is a folder".to_owned();
            return Err(StoreError::CannotCreate { path: path.to_path_buf(), reason });
        }
        let named = NamedTempFile::with_prefix_in(".pvmap-", folder_of(path)).map_err(|e| {
            match e.kind() {
                io::ErrorKind::PermissionDenied | io::ErrorKind::StorageFull => {
                    StoreError::io(path, "create", e)
                }
                _ => StoreError::CannotCreate {
                    path: path.to_path_buf(),
                    reason: e.kind().to_string(),
                },
            }
        })?;
        let (file, temp) = named.into_parts();
        Ok(AtomicFile { file, temp, path: path.to_path_buf() })
    }

    /// Gives the final name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the name it has until it is committed.
    pub fn temp_path(&self) -> &Path {
        &self.temp
    }

    /// Writes all of `bytes` at `offset_bytes`; several threads may do so at once.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn write_at(&self, bytes: &[u8], offset_bytes: u64) -> Result<(), StoreError> {
        self.file
            .write_all_at(bytes, offset_bytes)
            .map_err(|e| StoreError::io(&self.path, "write", e))
    }

    /// Makes the file durable and gives it its final name, replacing what was there.
    ///
    /// # Errors
    /// Where the disk fails; then what was under the name before is still there.
    pub fn commit(self) -> Result<(), StoreError> {
        let fail = |e| StoreError::io(&self.path, "commit", e);
        // mkstemp makes files for the owner alone; an artifact is as readable as the umask says.
        set_default_mode(&self.file).map_err(fail)?;
        self.file.sync_all().map_err(fail)?;
        self.temp
            .persist(&self.path)
            .map_err(|e| StoreError::io(&self.path, "rename", e.error))?;
        sync_folder(folder_of(&self.path))
    }
}

impl Write for AtomicFile {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.file.write(buf)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

/// Gives the folder a file is or will be in.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    }
}

/// Makes the names in a folder durable.
///
/// # Errors
/// Where the disk fails.
pub fn sync_folder(folder: &Path) -> Result<(), StoreError> {
    File::open(folder)
        .and_then(|f| f.sync_all())
        .map_err(|e| StoreError::io(folder, "sync the folder", e))
}

/// Gives a file the mode that creating it plainly would have given.
fn set_default_mode(file: &File) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    let mask = rustix::process::umask(rustix::fs::Mode::empty());
    rustix::process::umask(mask);
    file.set_permissions(std::fs::Permissions::from_mode(0o666 & !mask.bits()))
}
