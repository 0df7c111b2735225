//! Finished artifacts, mapped into memory read-only.

use std::fs::File;
use std::io;
use std::ops::Deref;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};

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

/// Ends the process with `code`, after a line on stderr, when a page of a mapped file cannot be
/// read: the disk failed, or somebody cut the file short (F22, F39). Without it the system does so
/// with no word. For commands: a library does not decide about its process.
///
/// # Errors
/// Where the system does not let signals be handled.
pub fn exit_on_lost_pages(code: i32) -> io::Result<()> {
    EXIT_CODE.store(code, Ordering::Relaxed);
    // Not by a crate that chains handlers: the one std has put there comes first then, gives the
    // signal back to the system, and a second thread that meets such a page ends the process.
    // SAFETY: zeroes are a valid sigaction (no flags, an empty mask); the handler has the signature
    // that a sigaction without SA_SIGINFO asks for and does only what a handler may.
    let done = unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = on_lost_page as extern "C" fn(libc::c_int) as libc::sighandler_t;
        libc::sigaction(libc::SIGBUS, &action, std::ptr::null_mut())
    };
    if done == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

static EXIT_CODE: AtomicI32 = AtomicI32::new(0);
static IS_SAID: AtomicBool = AtomicBool::new(false);

extern "C" fn on_lost_page(_signal: libc::c_int) {
    const LINE: &[u8] = b"pvmap: error: a file in use can no longer be read: its disk failed, or \
        it was cut short while it was open\n";
    // SAFETY: write, pause and _exit may be called in a handler; LINE is as long as it says.
    unsafe {
        // Said once, and the first thread ends all.
        while IS_SAID.swap(true, Ordering::Relaxed) {
            libc::pause();
        }
        // Where stderr is closed the exit code has to do.
        libc::write(libc::STDERR_FILENO, LINE.as_ptr().cast(), LINE.len());
        libc::_exit(EXIT_CODE.load(Ordering::Relaxed));
    }
}

impl Deref for Mapped {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.map
    }
}
