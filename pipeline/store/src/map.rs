//! Finished artifacts, mapped into memory read-only.

use std::fs::File;
use std::ops::Deref;
use std::path::Path;

use memmap2::Mmap;

use crate::StoreError;

/// The bytes of a finished file. Only pvmap's own artifacts are mapped: they are written once and
/// renamed into place, so nobody changes them under a reader; a scan of the user's is never mapped.
#[derive(Debug)]
pub struct Mapped {
    map: Mmap,
}

impl Mapped {
    /// Maps a whole file.
    ///
    /// # Errors
    /// Where it does not exist, is not a regular file or cannot be mapped.
    pub fn open(path: &Path) -> Result<Mapped, StoreError> {
        let fail = |e| StoreError::io(path, "open", e);
        if !std::fs::metadata(path).map_err(fail)?.is_file() {
            return Err(StoreError::NotAFile { path: path.to_path_buf() });
        }
        let file = File::open(path).map_err(fail)?;
        // SAFETY: the artifact is complete and under its final name; pvmap replaces artifacts by
        // renaming, never by writing into them, so the mapped bytes do not change. Whoever cuts
        // the file short by other means gets SIGBUS, not undefined behaviour in a reader of bytes.
        let map = unsafe { Mmap::map(&file) }.map_err(|e| StoreError::io(path, "map", e))?;
        Ok(Mapped { map })
    }
}

impl Deref for Mapped {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.map
    }
}
