//! Outputs: written under a temporary name in the same folder, then renamed: absent, old or whole.

use std::fs::{File, Permissions};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::{FileExt, PermissionsExt};
use std::path::{Path, PathBuf};

use tempfile::{NamedTempFile, TempDir, TempPath};

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
        let named =
            NamedTempFile::with_prefix_in(".pvmap-", folder_of(path)).map_err(|e| {
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

    /// Reads back what was written at `offset_bytes`.
    ///
    /// # Errors
    /// Where the disk fails or so much was not written.
    pub fn read_at(&self, buf: &mut [u8], offset_bytes: u64) -> Result<(), StoreError> {
        self.file
            .read_exact_at(buf, offset_bytes)
            .map_err(|e| StoreError::io(&self.path, "read back", e))
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
        self.temp.persist(&self.path).map_err(|e| StoreError::io(&self.path, "rename", e.error))?;
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

/// A folder that appears under its name only when [`AtomicFolder::commit`] is called; dropped
/// before, it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFolder {
    temp: TempDir,
    path: PathBuf,
    overwrite: bool,
}

impl AtomicFolder {
    /// Starts an output folder beside its final name.
    ///
    /// # Errors
    /// Where something is under that name already and `overwrite` is not set, what is there is not
    /// a folder, or the parent does not exist or may not be written.
    pub fn create(path: &Path, overwrite: bool) -> Result<AtomicFolder, StoreError> {
        let refuse = |reason: &str| {
            Err(StoreError::CannotCreate { path: path.to_path_buf(), reason: reason.to_owned() })
        };
        match std::fs::symlink_metadata(path) {
            Ok(meta) if !meta.is_dir() => return refuse("something else has that name"),
            Ok(_) if !overwrite => return refuse("it exists already; --overwrite replaces it"),
            _ => {}
        }
        let temp = TempDir::with_prefix_in(".pvmap-", folder_of(path))
            .map_err(|e| cannot_create(path, e))?;
        Ok(AtomicFolder { temp, path: path.to_path_buf(), overwrite })
    }

    /// Gives the folder to write into.
    pub fn temp_path(&self) -> &Path {
        self.temp.path()
    }

    /// Gives the folder its final name, replacing what was there if that was allowed. The files
    /// in it are durable already.
    ///
    /// # Errors
    /// Where the disk fails, or the name was taken meanwhile; then what is there stays.
    pub fn commit(self) -> Result<(), StoreError> {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        let (temp, path) = (self.temp.path(), self.path.as_path());
        let fail = |e: rustix::io::Errno| StoreError::io(path, "rename", e.into());
        set_default_folder_mode(temp).map_err(|e| StoreError::io(path, "commit", e))?;
        sync_folder(temp)?;
        let exists = path.exists();
        let flags = if exists { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
        if exists && !self.overwrite {
            return Err(fail(rustix::io::Errno::EXIST));
        }
        renameat_with(CWD, temp, CWD, path, flags).map_err(fail)?;
        sync_folder(folder_of(path))?;
        if exists {
            // Now the old folder has the temporary name and goes with it.
            return self.temp.close().map_err(|e| StoreError::io(path, "remove the old", e));
        }
        // The temporary name is gone; there is nothing left to clean up.
        let _ = self.temp.keep();
        Ok(())
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

/// Says why an output could not be started.
fn cannot_create(path: &Path, e: io::Error) -> StoreError {
    match e.kind() {
        io::ErrorKind::PermissionDenied | io::ErrorKind::StorageFull => {
            StoreError::io(path, "create", e)
        }
        kind => {
            let reason = format!("its folder cannot be written: {kind}");
            StoreError::CannotCreate { path: path.to_path_buf(), reason }
        }
    }
}

/// Gives a file the mode that creating it plainly would have given.
fn set_default_mode(file: &File) -> io::Result<()> {
    file.set_permissions(Permissions::from_mode(0o666 & !umask()))
}

/// Gives a folder the mode that creating it plainly would have given.
fn set_default_folder_mode(folder: &Path) -> io::Result<()> {
    std::fs::set_permissions(folder, Permissions::from_mode(0o777 & !umask()))
}

/// Reads the file mode mask without changing it; the usual 022 where the system does not tell.
fn umask() -> u32 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("Umask:"));
    line.and_then(|l| u32::from_str_radix(l.trim(), 8).ok()).unwrap_or(0o022)
}
