//! Outputs: written under a temporary name in the same folder, then renamed: absent, old or whole.
//!
//! One rule says what may stand under an output's name beforehand (F32): nothing, or a thing of
//! the same kind, which is replaced. A link is followed: what it points at is replaced, the link
//! stays. Anything else, such as a FIFO or a device, is refused before any work. Only a table,
//! which is written from front to back, may also go to a stream ([`TableFile`]).

use std::fs::{DirEntry, File, FileType, Permissions};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::fd::AsFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileExt, FileTypeExt, PermissionsExt};
use std::path::{Path, PathBuf};

use tempfile::{NamedTempFile, TempDir, TempPath};

use crate::{InputFile, StoreError, WorkFolder};

/// A file that appears under its name only when [`AtomicFile::commit`] is called; dropped before,
/// it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFile {
    file: File,
    temp: TempPath,
    path: PathBuf,
    /// `path`, or what it links to.
    target: PathBuf,
}

impl AtomicFile {
    /// Starts an output beside its final name.
    ///
    /// # Errors
    /// Where the folder does not exist or may not be written, or something that is no regular file
    /// has that name.
    pub fn create(path: &Path) -> Result<AtomicFile, StoreError> {
        let target = standing_file(path)?;
        let named = NamedTempFile::with_prefix_in(".pvmap-", folder_of(&target))
            .map_err(|e| cannot_create(path, e))?;
        let (file, temp) = named.into_parts();
        Ok(AtomicFile { file, temp, path: path.to_path_buf(), target })
    }

    /// Starts the output of a work folder, in that folder.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn create_in(work: &WorkFolder, name: &str) -> Result<AtomicFile, StoreError> {
        let (temp, path) = (work.file(name), work.output().to_path_buf());
        let fail = |e| StoreError::own(&path, "start", e);
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&temp);
        let (file, temp) = (file.map_err(fail)?, TempPath::try_from_path(temp).map_err(fail)?);
        Ok(AtomicFile { file, temp, path, target: work.target().to_path_buf() })
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

    /// Makes what is written so far durable; several threads may write meanwhile.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn sync_written(&self) -> Result<(), StoreError> {
        self.file.sync_data().map_err(|e| StoreError::io(&self.path, "sync", e))
    }

    /// Makes the file durable and gives it its final name, replacing what was there.
    ///
    /// # Errors
    /// Where the disk fails; then what was under the name before is still there.
    pub fn commit(self) -> Result<(), StoreError> {
        self.close()?.publish(false)
    }

    /// Makes the file durable under the name it has until it is published.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn close(self) -> Result<ClosedFile, StoreError> {
        let fail = |e| StoreError::io(&self.path, "commit", e);
        // mkstemp makes files for the owner alone; an artifact is as readable as the umask says.
        set_default_mode(&self.file).map_err(fail)?;
        self.file.sync_all().map_err(fail)?;
        Ok(ClosedFile { temp: self.temp, path: self.path, target: self.target })
    }
}

/// A file that is whole and durable but has not got its name.
#[derive(Debug)]
pub struct ClosedFile {
    temp: TempPath,
    path: PathBuf,
    target: PathBuf,
}

impl ClosedFile {
    /// Gives the name it has until it is published.
    pub fn temp_path(&self) -> &Path {
        &self.temp
    }

    /// Gives the file its final name, replacing what was there.
    ///
    /// # Errors
    /// Where the disk fails; then what was under the name before is still there, and the file
    /// stays if it `is_kept`.
    pub fn publish(self, is_kept: bool) -> Result<(), StoreError> {
        if let Err(e) = self.temp.persist(&self.target) {
            if is_kept {
                // Where it cannot stay it is made again.
                let _ = e.path.keep();
            }
            return Err(StoreError::own(&self.path, "rename", e.error));
        }
        sync_folder(folder_of(&self.target))
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

/// A table: an output that is written from front to back and may therefore be a stream too.
#[derive(Debug)]
pub struct TableFile {
    sink: Sink,
    path: PathBuf,
}

#[derive(Debug)]
enum Sink {
    File(AtomicFile),
    Stream(File),
    /// A FIFO or device that is opened when something is to be written.
    Waiting(PathBuf),
}

impl TableFile {
    /// Starts a table: on standard output for `-` or `/dev/stdout`, in a FIFO or a character
    /// device that has that name, else in an [`AtomicFile`]. What is written first to a FIFO waits
    /// for its reader: several may be started before any is read.
    ///
    /// # Errors
    /// Those of [`AtomicFile::create`], and where standard output is closed.
    pub fn create(path: &Path) -> Result<TableFile, StoreError> {
        let fail = |e| StoreError::io(path, "open", e);
        let sink = if is_stdout(path) {
            // Not by opening /dev/stdout: that would begin a redirected file anew.
            Sink::Stream(io::stdout().as_fd().try_clone_to_owned().map_err(fail)?.into())
        } else {
            match standing(path)? {
                (target, Some(kind)) if kind.is_fifo() || kind.is_char_device() => {
                    Sink::Waiting(target)
                }
                _ => Sink::File(AtomicFile::create(path)?),
            }
        };
        Ok(TableFile { sink, path: path.to_path_buf() })
    }

    /// Gives the name it was asked for by.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Ends the table; a file gets its name now.
    ///
    /// # Errors
    /// Those of [`AtomicFile::commit`].
    pub fn commit(self) -> Result<(), StoreError> {
        self.close()?.map_or(Ok(()), |file| file.publish(false))
    }

    /// Ends the table; a file is durable and has yet to get its name.
    ///
    /// # Errors
    /// Those of [`AtomicFile::close`].
    pub fn close(self) -> Result<Option<ClosedFile>, StoreError> {
        match self.sink {
            Sink::File(file) => file.close().map(Some),
            Sink::Stream(_) | Sink::Waiting(_) => Ok(None),
        }
    }

    fn out(&mut self) -> io::Result<&mut dyn Write> {
        if let Sink::Waiting(target) = &self.sink {
            self.sink = Sink::Stream(File::options().write(true).open(target)?);
        }
        match &mut self.sink {
            Sink::File(file) => Ok(file),
            Sink::Stream(stream) => Ok(stream),
            Sink::Waiting(_) => Err(io::ErrorKind::NotConnected.into()),
        }
    }
}

impl Write for TableFile {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.out()?.write(buf)
    }

    fn flush(&mut self) -> io::Result<()> {
        match self.sink {
            // Nothing was written that could be.
            Sink::Waiting(_) => Ok(()),
            _ => self.out()?.flush(),
        }
    }
}

/// Says whether an output's name means standard output.
pub fn is_stdout(path: &Path) -> bool {
    path == Path::new("-") || path == Path::new("/dev/stdout")
}

/// Why a folder is not replaced.
const FOREIGN: &str = "the folder of that name holds other things; give another name";

/// A folder that appears under its name only when [`AtomicFolder::commit`] is called; dropped
/// before, it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFolder {
    temp: TempDir,
    path: PathBuf,
    /// `path`, or what it links to.
    target: PathBuf,
    overwrite: bool,
    only: OnlyFile,
}

/// The one file of a folder, by its name and its first bytes.
#[derive(Debug, Clone, Copy)]
pub struct OnlyFile {
    /// Its name.
    pub name: &'static str,
    /// What it begins with.
    pub start: &'static [u8],
}

impl OnlyFile {
    /// Says whether a folder holds nothing else; it may be empty.
    fn is_all_of(&self, folder: &Path) -> bool {
        let Ok(entries) = std::fs::read_dir(folder) else { return false };
        let is_it = |e: io::Result<DirEntry>| {
            e.is_ok_and(|e| e.file_name() == self.name && begins_with(&e.path(), self.start))
        };
        entries.into_iter().all(is_it)
    }
}

/// Says whether a regular file begins with these bytes.
fn begins_with(path: &Path, start: &[u8]) -> bool {
    let mut found = vec![0; start.len()];
    let read = |file: InputFile| file.read_exact_at(&mut found, 0);
    InputFile::open(path).and_then(read).is_ok() && found == start
}

/// Refuses to replace a file that is there and not empty, unless it begins as one of its kind.
///
/// # Errors
/// Where it does not.
pub fn require_own(path: &Path, start: &[u8], kind: &str) -> Result<(), StoreError> {
    let is_empty = |meta: std::fs::Metadata| !meta.is_file() || meta.len() == 0;
    if std::fs::metadata(path).map_or(true, is_empty) || begins_with(path, start) {
        return Ok(());
    }
    refuse(path, format!("a file of that name is not {kind}; give another name or remove it"))
}

impl AtomicFolder {
    /// Starts an output folder beside its final name, in which one file will be. A folder with
    /// anything else in it is not replaced.
    ///
    /// # Errors
    /// Where something is under that name already and `overwrite` is not set, what is there is not
    /// such a folder, or the parent does not exist or may not be written.
    pub fn create(
        path: &Path,
        overwrite: bool,
        only: OnlyFile,
    ) -> Result<AtomicFolder, StoreError> {
        let target = match standing(path)? {
            (_, Some(kind)) if !kind.is_dir() => {
                return refuse(path, format!("{} has that name; give another", word_of(kind)));
            }
            (_, Some(_)) if !overwrite => {
                return refuse(path, "it exists already; --overwrite replaces it".to_owned());
            }
            (target, Some(_)) if !only.is_all_of(&target) => {
                return refuse(path, FOREIGN.to_owned());
            }
            (target, _) => target,
        };
        let temp = TempDir::with_prefix_in(".pvmap-", folder_of(&target))
            .map_err(|e| cannot_create(path, e))?;
        Ok(AtomicFolder { temp, path: path.to_path_buf(), target, overwrite, only })
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
        let (temp, path, target) = (self.temp.path(), self.path.as_path(), self.target.as_path());
        let fail = |e: rustix::io::Errno| StoreError::io(path, "rename", e.into());
        set_default_folder_mode(temp).map_err(|e| StoreError::io(path, "commit", e))?;
        sync_folder(temp)?;
        let exists = target.exists();
        let flags = if exists { RenameFlags::EXCHANGE } else { RenameFlags::NOREPLACE };
        if exists && !self.overwrite {
            return Err(fail(rustix::io::Errno::EXIST));
        }
        if exists && !self.only.is_all_of(target) {
            return refuse(path, FOREIGN.to_owned());
        }
        renameat_with(CWD, temp, CWD, target, flags).map_err(fail)?;
        sync_folder(folder_of(target))?;
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
        .map_err(|e| StoreError::own(folder, "sync the folder", e))
}

/// Finds where a file goes: nothing is there, or a file that it replaces. Links are followed.
pub(crate) fn standing_file(path: &Path) -> Result<PathBuf, StoreError> {
    match standing(path)? {
        (_, Some(kind)) if !kind.is_file() => {
            refuse(path, format!("{} has that name; give another", word_of(kind)))
        }
        (_, None) if path.as_os_str().as_bytes().ends_with(b"/") => {
            refuse(path, "a folder's name, it ends in a slash; give a file's".to_owned())
        }
        (target, _) => Ok(target),
    }
}

/// Finds what stands under an output's name, and where: links are followed.
fn standing(path: &Path) -> Result<(PathBuf, Option<FileType>), StoreError> {
    if path.file_name().is_none() {
        return refuse(path, "that is no name for an output".to_owned());
    }
    let target = match std::fs::symlink_metadata(path) {
        Ok(meta) if meta.is_symlink() => match std::fs::canonicalize(path) {
            Ok(target) => target,
            Err(e) => return refuse(path, format!("a link that leads nowhere ({})", e.kind())),
        },
        Ok(_) => path.to_path_buf(),
        // Whether the folder it would be in is there shows when the output is begun.
        Err(_) => return Ok((path.to_path_buf(), None)),
    };
    let meta = std::fs::metadata(&target).map_err(|e| StoreError::io(path, "look at", e))?;
    Ok((target, Some(meta.file_type())))
}

fn word_of(kind: FileType) -> &'static str {
    match kind {
        _ if kind.is_file() => "a file",
        _ if kind.is_dir() => "a folder",
        _ if kind.is_fifo() => "a FIFO",
        _ if kind.is_char_device() || kind.is_block_device() => "a device",
        _ => "a socket",
    }
}

pub(crate) fn refuse<T>(path: &Path, reason: String) -> Result<T, StoreError> {
    Err(StoreError::CannotCreate { path: path.to_path_buf(), reason })
}

/// Says why an output could not be started.
pub(crate) fn cannot_create(path: &Path, e: io::Error) -> StoreError {
    match e.kind() {
        io::ErrorKind::PermissionDenied | io::ErrorKind::StorageFull => {
            StoreError::io(path, "create", e)
        }
        kind => {
            let reason = match kind {
                io::ErrorKind::NotFound => "its folder does not exist; make it first".to_owned(),
                kind => format!("its folder cannot be written: {kind}"),
            };
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

#[cfg(test)]
mod tests {
    use super::*;

    const NOTE: OnlyFile = OnlyFile { name: "note", start: b"NOTE" };

    /// Names and the bytes or "folder" behind them, without temporary ones left behind.
    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<String> =
            entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    fn reason_of<T: std::fmt::Debug>(result: Result<T, StoreError>) -> String {
        match result {
            Err(StoreError::CannotCreate { reason, .. }) => reason,
            other => panic!("not refused: {other:?}"),
        }
    }

    #[test]
    fn f32_what_stands_under_the_name_of_an_output() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("file"), "old").unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        rustix::fs::mknodat(
            rustix::fs::CWD,
            at("fifo"),
            rustix::fs::FileType::Fifo,
            0o600.into(),
            0,
        )
        .unwrap();
        std::os::unix::net::UnixListener::bind(at("socket")).unwrap();
        for (name, word) in
            [("folder", "a folder"), ("fifo", "a FIFO"), ("socket", "a socket"), ("new/", "folder")]
        {
            assert!(reason_of(AtomicFile::create(&at(name))).contains(word), "{name}");
        }
        assert!(reason_of(AtomicFile::create(Path::new("/dev/null"))).contains("a device"));
        for name in ["..", "/", ""] {
            assert!(reason_of(AtomicFile::create(Path::new(name))).contains("no name"), "{name}");
        }
        for (name, word) in [("file", "a file"), ("fifo", "a FIFO"), ("folder", "--overwrite")] {
            let reason = reason_of(AtomicFolder::create(&at(name), false, NOTE));
            assert!(reason.contains(word), "{name}: {reason}");
        }
        assert_eq!(names(folder.path()), ["fifo", "file", "folder", "socket"]);
        assert_eq!(std::fs::read(at("file")).unwrap(), b"old");
    }

    #[test]
    fn f32_a_link_is_followed_and_stays() {
        let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let link = |name: &str, target: &str| {
            let link = folder.path().join(name);
            std::os::unix::fs::symlink(other.path().join(target), &link).unwrap();
            link
        };
        let (file, tree, nowhere) = (link("a", "file"), link("b", "tree"), link("c", "none"));
        std::fs::write(other.path().join("file"), "old").unwrap();
        std::fs::create_dir(other.path().join("tree")).unwrap();
        let mut output = AtomicFile::create(&file).unwrap();
        output.write_all(b"new").unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), b"old");
        output.commit().unwrap();
        assert_eq!(std::fs::read(other.path().join("file")).unwrap(), b"new");

        let output = AtomicFolder::create(&tree, true, NOTE).unwrap();
        std::fs::write(output.temp_path().join("points"), "").unwrap();
        output.commit().unwrap();
        assert_eq!(names(&tree), ["points"]);
        assert!([&file, &tree].iter().all(|l| l.is_symlink()));
        assert!(reason_of(AtomicFile::create(&nowhere)).contains("leads nowhere"));
        assert_eq!((names(folder.path()).len(), names(other.path()).len()), (3, 2));
    }

    #[test]
    fn f32_a_folder_with_other_things_in_it_is_never_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let tree = folder.path().join("tree");
        std::fs::create_dir(&tree).unwrap();
        let make = || AtomicFolder::create(&tree, true, NOTE);
        assert!(make().is_ok(), "an empty one may be");
        std::fs::write(tree.join("note"), "NOTES").unwrap();
        assert!(make().is_ok(), "one of its kind may be");
        for (name, content) in [("note", "NOT a note"), ("note", "NO"), ("thesis", "NOTES")] {
            std::fs::write(tree.join("note"), "NOTES").unwrap();
            std::fs::write(tree.join(name), content).unwrap();
            assert!(reason_of(make()).contains("other things"), "{name}: {content}");
        }
        // What comes while the output is made is safe too.
        std::fs::remove_file(tree.join("thesis")).unwrap();
        let output = make().unwrap();
        std::fs::write(tree.join("thesis"), "precious").unwrap();
        assert!(reason_of(output.commit()).contains("other things"));
        assert_eq!(names(&tree), ["note", "thesis"]);
        assert_eq!(names(folder.path()), ["tree"]);
    }

    #[test]
    fn f32_a_table_may_go_to_a_stream() {
        let folder = tempfile::tempdir().unwrap();
        let fifo = folder.path().join("fifo");
        rustix::fs::mknodat(rustix::fs::CWD, &fifo, rustix::fs::FileType::Fifo, 0o600.into(), 0)
            .unwrap();
        let reader = std::thread::spawn({
            let fifo = fifo.clone();
            move || std::fs::read(fifo).unwrap()
        });
        let mut table = TableFile::create(&fifo).unwrap();
        table.write_all(b"a,b\n").unwrap();
        table.commit().unwrap();
        assert_eq!(reader.join().unwrap(), b"a,b\n");
        assert_eq!(names(folder.path()), ["fifo"]);

        let mut full = TableFile::create(Path::new("/dev/full")).unwrap();
        assert_eq!(full.write(b"a").unwrap_err().kind(), io::ErrorKind::StorageFull);
    }
}
