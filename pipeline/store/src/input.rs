//! Inputs: the user's own files, read and never mapped (another program may cut them short).

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::SystemTime;

use crate::StoreError;

/// An input file, open for reading, that remembers its name and what it looked like when opened.
#[derive(Debug)]
pub struct InputFile {
    file: File,
    path: PathBuf,
    identity: Identity,
    /// The system's number of the first failure of the disk.
    failure: OnceLock<i32>,
}

/// What tells a file from another, and from itself after a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Bytes in the file.
    pub len_bytes: u64,
    /// When it was last written to.
    pub modified: Option<SystemTime>,
    /// The device it is on and its number there.
    pub inode: (u64, u64),
}

impl InputFile {
    /// Opens a regular file.
    ///
    /// # Errors
    /// Where it does not exist, is not a regular file or may not be read.
    pub fn open(path: &Path) -> Result<InputFile, StoreError> {
        let meta = std::fs::metadata(path).map_err(|e| StoreError::io(path, "open", e))?;
        if !meta.is_file() {
            // Checked before opening: opening a FIFO would wait for a writer for ever.
            return Err(StoreError::NotAFile { path: path.to_path_buf() });
        }
        let file = File::open(path).map_err(|e| StoreError::io(path, "open", e))?;
        let meta = file.metadata().map_err(|e| StoreError::io(path, "open", e))?;
        let identity = Identity {
            len_bytes: meta.len(),
            modified: meta.modified().ok(),
            inode: (meta.dev(), meta.ino()),
        };
        Ok(InputFile { file, path: path.to_path_buf(), identity, failure: OnceLock::new() })
    }

    /// Gives the name it was opened by.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives its length when it was opened.
    pub fn len_bytes(&self) -> u64 {
        self.identity.len_bytes
    }

    /// Gives what it looked like when it was opened.
    pub fn identity(&self) -> Identity {
        self.identity
    }

    /// Says whether the file still looks as it did when it was opened (F66).
    pub fn is_unchanged(&self) -> bool {
        self.file.metadata().is_ok_and(|m| {
            m.len() == self.identity.len_bytes && m.modified().ok() == self.identity.modified
        })
    }

    /// Fills `buf` from `offset_bytes`, leaving the cursor alone.
    ///
    /// # Errors
    /// Where the file ends before or the disk fails.
    pub fn read_exact_at(&self, buf: &mut [u8], offset_bytes: u64) -> Result<(), StoreError> {
        self.file.read_exact_at(buf, offset_bytes).map_err(|e| {
            if let Some(number) = e.raw_os_error() {
                self.failure.get_or_init(|| number);
            }
            StoreError::io(&self.path, "read", e)
        })
    }

    /// Gives the first failure of the disk that a read met. A decoder between this file and its
    /// reader may have made bad data of it, or even an end of the file.
    pub fn failure(&self) -> Option<StoreError> {
        let number = *self.failure.get()?;
        Some(StoreError::io(&self.path, "read", io::Error::from_raw_os_error(number)))
    }
}

impl Read for InputFile {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        self.file.read(buf)
    }
}

impl Seek for InputFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_of_the_disk_is_remembered_and_an_end_is_none() {
        let file = InputFile::open(Path::new("/proc/self/maps")).unwrap();
        assert!(file.read_exact_at(&mut [0; 8], 1 << 40).is_err());
        assert!(file.failure().is_none());
        // The first page of a process is never there: reading it is an I/O error.
        let Ok(file) = InputFile::open(Path::new("/proc/self/mem")) else {
            return eprintln!("skipped: there is no /proc/self/mem");
        };
        assert!(file.read_exact_at(&mut [0; 8], 0).is_err());
        assert!(matches!(file.failure(), Some(StoreError::Io { .. })));
    }
}
