//! Who works in a folder: a lock that dies with its process.

use std::fs::{File, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::StoreError;

/// The file that is locked; it says by whom and since when.
pub(crate) const LOCK: &str = "lock";
/// The file that is the lock itself where the system knows no locks (F34): it outlives a process
/// that is killed, and has to be removed by hand then.
pub(crate) const LOCK_ALONE: &str = "lock.exclusive";

/// A lock that is held until it is dropped.
#[derive(Debug)]
pub(crate) struct Lock {
    _file: File,
    /// A lock that is the file itself.
    alone: Option<PathBuf>,
}

impl Lock {
    /// Takes the lock of a folder, on behalf of an output. None where the folder went away
    /// meanwhile.
    ///
    /// # Errors
    /// Where another process holds it.
    pub(crate) fn take(folder: &Path, output: &Path) -> Result<Option<Lock>, StoreError> {
        let path = folder.join(LOCK);
        let fail = |e| StoreError::io(&path, "lock", e);
        let opened =
            File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = match opened {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(fail)?,
        };
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return locked(output, &mut file, ""),
            Err(TryLockError::Error(e)) if is_unsupported(&e) => {
                return Lock::take_alone(folder, output);
            }
            Err(TryLockError::Error(e)) => return Err(fail(e)),
        }
        // Its holder may have removed it between the opening and the locking.
        let ours = file.metadata().map_err(fail)?;
        if !std::fs::metadata(&path).is_ok_and(|m| (m.dev(), m.ino()) == (ours.dev(), ours.ino())) {
            return Ok(None);
        }
        file.set_len(0).and_then(|()| file.write_all(me().as_bytes())).map_err(fail)?;
        Ok(Some(Lock { _file: file, alone: None }))
    }

    /// Takes a lock that is there as long as its file.
    fn take_alone(folder: &Path, output: &Path) -> Result<Option<Lock>, StoreError> {
        let path = folder.join(LOCK_ALONE);
        match File::options().read(true).write(true).create_new(true).open(&path) {
            Ok(mut file) => {
                file.write_all(me().as_bytes()).map_err(|e| StoreError::io(&path, "lock", e))?;
                Ok(Some(Lock { _file: file, alone: Some(path) }))
            }
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {
                let mut file = File::open(&path).map_err(|e| StoreError::io(&path, "open", e))?;
                let hint = format!(" (if no such process runs, remove {})", path.display());
                locked(output, &mut file, &hint)
            }
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(StoreError::io(&path, "lock", e)),
        }
    }

    /// Removes the files of the lock from a folder that is done with.
    pub(crate) fn remove(&mut self, folder: &Path) {
        self.give_back();
        // Where that fails the next run removes it.
        let _ = std::fs::remove_file(folder.join(LOCK));
    }

    fn give_back(&mut self) {
        if let Some(path) = self.alone.take() {
            // Where that fails the next run is told how to do it by hand.
            let _ = std::fs::remove_file(path);
        }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        self.give_back();
    }
}

/// Says who holds a lock.
fn locked<T>(output: &Path, file: &mut File, hint: &str) -> Result<T, StoreError> {
    let mut text = String::new();
    // Its holder may be about to write its name.
    let _ = file.read_to_string(&mut text);
    let holder = match text.trim() {
        "" => "another process".to_owned(),
        name => format!("{name}{hint}"),
    };
    Err(StoreError::Locked { path: output.to_path_buf(), holder })
}

/// Says whether a lock failed because the file system has none.
fn is_unsupported(e: &io::Error) -> bool {
    use rustix::io::Errno;
    let errno = Errno::from_io_error(e);
    errno.is_some_and(|e| [Errno::NOLCK, Errno::OPNOTSUPP, Errno::NOSYS].contains(&e))
}

/// Gives this process and the time: process 4711 since 2026-11-22 12:31:07 UTC.
fn me() -> String {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("process {} since {}", std::process::id(), utc(since.as_secs()))
}

/// Writes a time as people do.
fn utc(seconds: u64) -> String {
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Years that begin in March end with their leap day; 400 of them have 146 097 days, and the
    // first such 400 years begin 719 468 days before 1970.
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    // March to July, and August to December, have 31, 30, 31, 30, 31 days: 153.
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (year, month) = match month {
        0..10 => (era * 400 + year, month + 3),
        _ => (era * 400 + year + 1, month - 9),
    };
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn f70_times_from_1970_to_2106() {
        for (seconds, text) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_399, "2000-02-28 23:59:59 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (951_868_800, "2000-03-01 00:00:00 UTC"),
            (1_767_225_599, "2025-12-31 23:59:59 UTC"),
            (4_107_542_400, "2100-03-01 00:00:00 UTC"),
            (4_294_967_296, "2106-02-07 06:28:16 UTC"),
        ] {
            assert_eq!(utc(seconds), text);
        }
    }
}
