//! What can go wrong with a scan file: which file, where in it, what to do next.

use std::fmt;
use std::path::{Path, PathBuf};

use pvmap_store::StoreError;

/// What an error means to whoever asked; the command turns it into an exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// The content of a file is not what it must be.
    BadData,
    /// There is no such input, or it is no regular file.
    NotFound,
    /// The user may not do this.
    Permission,
    /// An output cannot be made where it was asked for.
    CannotCreate,
    /// The disk failed or is full.
    Io,
    /// The run was asked to stop, or another run holds the output.
    Interrupted,
}

/// A scan file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The disk failed, or the file is not there.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The file is no LAS, LAZ or PLY at all, or a kind of it that is not read.
    #[error("{}: {found}; {advice}", Shown(path))]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What it is instead.
        found: String,
        /// What to do next.
        advice: &'static str,
    },
    /// A header contradicts itself, the format or the file's length.
    #[error("{}: broken {place}: {problem}", Shown(path))]
    Header {
        /// The file.
        path: PathBuf,
        /// Which part of the header.
        place: String,
        /// What was expected and what was found.
        problem: String,
    },
    /// The file ends before what its header declares.
    #[error(
        "{}: declares {declared} points but holds {present}: it is cut short or its header is \
         wrong; copy it again, or give --lenient to read what is there",
        Shown(path)
    )]
    Short {
        /// The file.
        path: PathBuf,
        /// Points by the header.
        declared: u64,
        /// Points that can be there at the most.
        present: u64,
    },
    /// A record cannot be decoded.
    #[error("{}: point {record}: {problem}", Shown(path))]
    Record {
        /// The file.
        path: PathBuf,
        /// The record, from 0.
        record: u64,
        /// What was expected and what was found.
        problem: String,
    },
    /// A record has a coordinate that is no number.
    #[error(
        "{}: point {record}: a coordinate is not finite; give --skip-invalid to drop such points",
        Shown(path)
    )]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The record, from 0.
        record: u64,
    },
    /// A row of text cannot be understood.
    #[error("{}: line {line}: {problem}", Shown(path))]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What was expected and what was found.
        problem: String,
    },
    /// The file is not what it was when it was opened (F66).
    #[error("{}: changed while it was read; wait until it is complete and run again", Shown(path))]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// Points do not fit the output they are written to.
    #[error("{}: cannot write: {problem}", Shown(path))]
    Write {
        /// The output.
        path: PathBuf,
        /// Why not.
        problem: String,
    },
}

impl ScanError {
    /// Says what the error means: everything about a file's content is [`ErrorKind::BadData`].
    pub fn kind(&self) -> ErrorKind {
        match self {
            ScanError::Store(e) => match e {
                StoreError::NotFound { .. } | StoreError::NotAFile { .. } => ErrorKind::NotFound,
                StoreError::Permission { .. } => ErrorKind::Permission,
                StoreError::CannotCreate { .. } => ErrorKind::CannotCreate,
                StoreError::Interrupted => ErrorKind::Interrupted,
                _ => ErrorKind::Io,
            },
            _ => ErrorKind::BadData,
        }
    }

    /// Names a broken part of a header.
    pub(crate) fn header(
        path: &Path,
        place: impl Into<String>,
        problem: impl Into<String>,
    ) -> ScanError {
        ScanError::Header { path: path.to_path_buf(), place: place.into(), problem: problem.into() }
    }

    /// Names a record that cannot be decoded.
    pub(crate) fn record(path: &Path, record: u64, problem: impl Into<String>) -> ScanError {
        ScanError::Record { path: path.to_path_buf(), record, problem: problem.into() }
    }

    /// Names a row of text that cannot be understood.
    pub(crate) fn line(path: &Path, line: u64, problem: impl Into<String>) -> ScanError {
        ScanError::Line { path: path.to_path_buf(), line, problem: problem.into() }
    }
}

/// A path on one line: control characters (a name may hold a newline) are escaped.
struct Shown<'a>(&'a Path);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&escaped(self.0.to_string_lossy().as_bytes(), usize::MAX))
    }
}

/// Makes bytes of a file fit to be shown: at most `limit` characters, control ones escaped.
pub(crate) fn escaped(bytes: &[u8], limit: usize) -> String {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(limit.saturating_mul(4))]);
    let mut shown = String::new();
    for c in text.chars().take(limit) {
        if c.is_control() {
            shown.extend(c.escape_default());
        } else {
            shown.push(c);
        }
    }
    if text.chars().nth(limit).is_some() {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn f67_a_newline_in_a_name_stays_on_one_line() {
        let e = ScanError::Changed { path: PathBuf::from("a\n b.las") };
        assert!(e.to_string().starts_with("a\\n b.las: changed"));
        assert_eq!(e.kind(), ErrorKind::BadData);
    }

    #[test]
    fn long_words_are_cut() {
        assert_eq!(escaped(b"abcdef", 3), "abc…");
        assert_eq!(escaped(b"a\0b", 9), "a\\u{0}b");
    }
}
