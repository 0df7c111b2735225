//! Outputs of an export, begun before any work: nothing is replaced but what an export made.

use std::path::Path;

use pvmap_store::output::is_stdout;
use pvmap_store::{AtomicFile, InputFile, StoreError, TableFile};

use crate::Error;

/// What the header of a LAS names as the program that made it.
pub(super) const LAS_SOFTWARE: &str = "pvmap export";
/// The first comment of a PLY.
pub(super) const PLY_COMMENT: &str = "pvmap export";
/// Where a LAS names that program, in 32 bytes.
const LAS_SOFTWARE_OFFSET: usize = 58;
/// Enough of a file to know it by: a PLY may have comments before what it is known by.
const START_BYTES: usize = 64 << 10;

/// The kinds of files that exports make, by which they know their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Made {
    /// A LAS or LAZ.
    Las,
    /// A PLY.
    Ply,
    /// A text with this first line, such as a table with this row of names.
    Table(&'static str),
}

impl Made {
    /// Says whether a file that begins so is one that an export made.
    fn is_start(self, start: &[u8]) -> bool {
        match self {
            Made::Las => {
                let named = start.get(LAS_SOFTWARE_OFFSET..).unwrap_or_default();
                start.starts_with(b"LASF")
                    && named.strip_prefix(LAS_SOFTWARE.as_bytes()).is_some_and(ends_text)
            }
            Made::Ply => {
                // What an export adds is behind the line that says how numbers are written. Other
                // lines of a scan may stand before that, and end in carriage returns.
                let is_cr_only = start.starts_with(b"ply\r") && !start.starts_with(b"ply\r\n");
                let newline = if is_cr_only { b'\r' } else { b'\n' };
                let mut lines = start.split(|&b| b == newline).map(<[u8]>::trim_ascii_end);
                let is_aside = |l: &&[u8]| l.starts_with(b"comment") || l.starts_with(b"obj_info");
                lines.next() == Some(b"ply")
                    && lines.find(|l| !is_aside(l)).is_some_and(|l| l.starts_with(b"format "))
                    && lines.next().and_then(|l| l.strip_prefix(b"comment "))
                        == Some(PLY_COMMENT.as_bytes())
            }
            Made::Table(header) => {
                let rest = start.strip_prefix(header.as_bytes());
                rest.is_some_and(|rest| rest.starts_with(b"\n"))
            }
        }
    }
}

fn ends_text(rest: &[u8]) -> bool {
    rest.first() == Some(&0)
}

/// Starts a file of an export beside its final name.
///
/// # Errors
/// Where a file has that name that is not empty and that no export made, unless `overwrite`; and
/// those of [`AtomicFile::create`].
pub fn begin_file(path: &Path, made: Made, overwrite: bool) -> Result<AtomicFile, Error> {
    require_own(path, made, overwrite)?;
    Ok(AtomicFile::create(path)?)
}

/// Starts a table of an export, which may be a stream.
///
/// # Errors
/// Those of [`begin_file`] and of [`TableFile::create`].
pub fn begin_table(path: &Path, header: &'static str, overwrite: bool) -> Result<TableFile, Error> {
    if !is_stdout(path) {
        require_own(path, Made::Table(header), overwrite)?;
    }
    Ok(TableFile::create(path)?)
}

/// Refuses to replace a file that no export made: it may be the only scan there is.
fn require_own(path: &Path, made: Made, overwrite: bool) -> Result<(), StoreError> {
    // What is not there is not replaced; what is no file is refused, or is a stream.
    let is_some = std::fs::metadata(path).is_ok_and(|m| m.is_file() && m.len() > 0);
    if overwrite || !is_some || start_of(path).is_ok_and(|start| made.is_start(&start)) {
        return Ok(());
    }
    Err(StoreError::CannotCreate {
        path: path.to_path_buf(),
        reason: "a file of that name exists that this command did not make; give another name, \
                 or --overwrite replaces it"
            .to_owned(),
    })
}

fn start_of(path: &Path) -> Result<Vec<u8>, StoreError> {
    let file = InputFile::open(path)?;
    let mut start = vec![0; file.len_bytes().min(START_BYTES as u64) as usize];
    file.read_exact_at(&mut start, 0)?;
    Ok(start)
}
