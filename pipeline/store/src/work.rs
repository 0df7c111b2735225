//! The folder in which an output is made: `OUT.build` beside `OUT`, locked by the run that works in
//! it, kept by a run that ends before its time, taken up by the next, and gone when `OUT` is there.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::StoreError;
use crate::lock::{LOCK, LOCK_ALONE, Lock};
use crate::output::{cannot_create, folder_of, refuse, standing_file, sync_folder};

/// What the folder's name ends in.
const ENDING: &str = ".build";
/// What a file's name ends in until it is whole.
pub const PART: &str = ".part";

/// A work folder that this run has locked. Dropped without being kept, it leaves nothing behind.
#[derive(Debug)]
pub struct WorkFolder {
    folder: PathBuf,
    output: PathBuf,
    /// `output`, or what it links to.
    target: PathBuf,
    is_own: fn(&str) -> bool,
    is_kept: bool,
    lock: Lock,
}

impl WorkFolder {
    /// Makes and locks the work folder of an output, or locks the one that is there.
    /// `is_own` says which names a run gives to files in it: a folder with others is refused.
    ///
    /// # Errors
    /// Where the output could not be made, the folder is none of ours or lies on another disk, or
    /// another run holds its lock.
    pub fn open(output: &Path, is_own: fn(&str) -> bool) -> Result<WorkFolder, StoreError> {
        let target = standing_file(output)?;
        let mut name = target.file_name().unwrap_or_default().to_owned();
        name.push(ENDING);
        let folder = target.with_file_name(name);
        loop {
            match std::fs::create_dir(&folder) {
                Err(e) if e.kind() == ErrorKind::AlreadyExists => check(output, &folder, is_own)?,
                made => made.map_err(|e| cannot_create(output, e))?,
            }
            // None: its holder has just finished and taken it away.
            if let Some(lock) = Lock::take(&folder, output)? {
                let is_kept = holds_more_than_a_lock(&folder);
                let output = output.to_path_buf();
                return Ok(WorkFolder { folder, output, target, is_own, is_kept, lock });
            }
        }
    }

    /// Gives the folder.
    pub fn path(&self) -> &Path {
        &self.folder
    }

    /// Gives the output's name as it was asked for.
    pub fn output(&self) -> &Path {
        &self.output
    }

    /// Gives where the output goes: links are followed.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Gives the place of a file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Says whether the folder stays where it is when this run ends. One with files of an earlier
    /// run does unless it is told not to.
    pub fn keep(&mut self, is_kept: bool) {
        self.is_kept = is_kept;
    }

    /// Writes a file that appears under its name whole. The name is durable after [`Self::sync`].
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), StoreError> {
        write_whole(&self.file(name), |file| file.write_all(bytes))
    }

    /// Reads a small file; none where there is none of that name or it is longer than `most_bytes`.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn read(&self, name: &str, most_bytes: u64) -> Result<Option<Vec<u8>>, StoreError> {
        use io::Read;
        let path = self.file(name);
        let fail = |e| StoreError::own(&path, "read", e);
        let file = match File::open(&path) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(fail)?,
        };
        let mut bytes = Vec::new();
        file.take(most_bytes + 1).read_to_end(&mut bytes).map_err(fail)?;
        Ok(Some(bytes).filter(|b| b.len() as u64 <= most_bytes))
    }

    /// Makes the names in the folder durable.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn sync(&self) -> Result<(), StoreError> {
        sync_folder(&self.folder)
    }

    /// Makes the folder's own name durable.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn sync_name(&self) -> Result<(), StoreError> {
        sync_folder(folder_of(&self.folder))
    }

    /// Removes those files of a run of which `is_of_no_use` says so; the lock stays.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn clear(&self, is_of_no_use: impl Fn(&str) -> bool) -> Result<(), StoreError> {
        let fail = |e| StoreError::own(&self.folder, "clear", e);
        for entry in std::fs::read_dir(&self.folder).map_err(fail)? {
            let name = entry.map_err(fail)?.file_name();
            let is_ours = |name: &str| is_ours(name, self.is_own);
            if name.to_str().is_some_and(|name| is_ours(name) && is_of_no_use(name)) {
                std::fs::remove_file(self.folder.join(name)).map_err(fail)?;
            }
        }
        Ok(())
    }
}

impl Drop for WorkFolder {
    fn drop(&mut self) {
        if !self.is_kept {
            // What cannot be removed now is taken up or removed by the next run.
            let _ = self.clear(|_| true);
            self.lock.remove(&self.folder);
            let _ = std::fs::remove_dir(&self.folder);
        }
    }
}

/// Makes sure that what stands under the folder's name is a work folder on the same disk.
fn check(output: &Path, folder: &Path, is_own: fn(&str) -> bool) -> Result<(), StoreError> {
    let refused = |why: &str| refuse(output, format!("{}: {why}", folder.display()));
    let fail = |e| StoreError::io(folder, "look at", e);
    let meta = match std::fs::symlink_metadata(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
        meta => meta.map_err(fail)?,
    };
    if !meta.is_dir() {
        return refused("no folder to work in; move it away or give another name");
    }
    let beside = std::fs::metadata(folder_of(folder)).map_err(fail)?;
    if beside.dev() != meta.dev() {
        return refused("on another disk than the output; unmount it or give another name");
    }
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let name = entry.map_err(fail)?.file_name();
        if !is_lock(&name) && !name.to_str().is_some_and(|n| is_ours(n, is_own)) {
            return refused("holds things that are not of a build; move it away");
        }
    }
    Ok(())
}

/// Says whether a run made a file, the lock aside.
fn is_ours(name: &str, is_own: fn(&str) -> bool) -> bool {
    // The latter are nameless files, where the system knows none, between two calls.
    is_own(name) || name.starts_with(".tmp")
}

fn is_lock(name: &OsStr) -> bool {
    name == LOCK || name == LOCK_ALONE
}

fn holds_more_than_a_lock(folder: &Path) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|e| e.file_name()).any(|name| !is_lock(&name))
}

/// Writes a file beside its name, makes it durable and gives it its name.
///
/// A sync that fails leaves in doubt what is on the disk, and the next one would not say so (F24):
/// the file is discarded and written anew, once.
///
/// # Errors
/// Where the disk fails or is full.
pub(crate) fn write_whole(
    path: &Path,
    mut write: impl FnMut(&mut File) -> io::Result<()>,
) -> Result<(), StoreError> {
    let mut part = path.as_os_str().to_owned();
    part.push(PART);
    let part = Path::new(&part);
    let mut attempt = || -> Result<io::Result<()>, StoreError> {
        let fail = |e| StoreError::own(path, "write", e);
        let mut file = File::create(part).map_err(fail)?;
        write(&mut file).map_err(fail)?;
        Ok(file.sync_all())
    };
    if attempt()?.is_err() {
        std::fs::remove_file(part).map_err(|e| StoreError::own(path, "discard", e))?;
        attempt()?.map_err(|e| StoreError::own(path, "sync", e))?;
    }
    std::fs::rename(part, path).map_err(|e| StoreError::own(path, "rename", e))
}
