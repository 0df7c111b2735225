//! What a run holds, what a thread took and what a disk has left.

use std::path::Path;

use crate::StoreError;
use crate::output::folder_of;

/// The least `--memory` a run accepts.
pub const MIN_BYTES: u64 = 64 << 20;

/// Reads the anonymous memory of this process now (`RssAnon`), the figure [D-9] bounds; mapped
/// files are not in it. `None` where the system does not tell.
pub fn rss_anon_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("RssAnon:"))?;
    let kib: u64 = line.trim().strip_suffix(" kB")?.trim().parse().ok()?;
    Some(kib << 10)
}

/// Reads the processor time that the calling thread took so far, seconds. `None` where the system
/// does not tell.
pub fn thread_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    let nanoseconds: u64 = text.split_whitespace().next()?.parse().ok()?;
    Some(nanoseconds as f64 * 1e-9)
}

/// Reads how many bytes the disk under a path to be made has left for this user.
pub fn free_disk_bytes(path: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(folder_of(path)).ok()?;
    stat.f_bavail.checked_mul(stat.f_frsize)
}

/// Refuses a run whose estimate does not fit on the disk (F21).
///
/// # Errors
/// Where it is known that the disk has less left than is needed.
pub fn require_disk(path: &Path, need_bytes: u64) -> Result<(), StoreError> {
    match free_disk_bytes(path) {
        Some(have_bytes) if have_bytes < need_bytes => {
            Err(StoreError::TooLittleDisk { path: path.to_path_buf(), need_bytes, have_bytes })
        }
        _ => Ok(()),
    }
}

/// Refuses a stage that cannot keep its budget.
///
/// # Errors
/// Where it needs more than there is.
pub fn require(what: &'static str, need_bytes: u64, have_bytes: u64) -> Result<(), StoreError> {
    if need_bytes > have_bytes {
        return Err(StoreError::Budget { what, need_bytes, have_bytes });
    }
    Ok(())
}
