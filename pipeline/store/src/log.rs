//! An append-only file of records, each durable before the next is begun. Whatever a crash leaves
//! of the last one is cut off when the file is opened again; nothing before it is lost.
//!
//! | bytes | what |
//! |---|---|
//! | as given | the head, which says what the records belong to |
//! | 4, for each record | its length, little-endian |
//! | 4 | CRC-32 of the length and the payload, little-endian |
//! | length | the payload |

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use crate::StoreError;

/// No record is longer; a length beyond it is no length.
pub const MAX_RECORD_BYTES: usize = 64 << 20;

/// What stands before a payload.
const PREFIX_BYTES: usize = 8;

/// A log that is open for more records.
#[derive(Debug)]
pub struct Log {
    file: File,
    path: PathBuf,
    n_dropped_bytes: u64,
    /// Whether the last record may be there in part.
    is_torn: bool,
}

impl Log {
    /// Starts a log, in place of what has that name. Its name is durable when its folder is.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn create(path: &Path, head: &[u8]) -> Result<Log, StoreError> {
        let fail = |e| StoreError::own(path, "start", e);
        let mut file = File::create(path).map_err(fail)?;
        file.write_all(head).map_err(fail)?;
        Ok(Log { file, path: path.to_path_buf(), n_dropped_bytes: 0, is_torn: false })
    }

    /// Opens a log for more records; gives `each` the payload of those it has, until one is broken
    /// or `each` refuses it: it and what follows are cut off. None where there is no log with this
    /// head.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn open(
        path: &Path,
        head: &[u8],
        mut each: impl FnMut(&[u8]) -> bool,
    ) -> Result<Option<Log>, StoreError> {
        let fail = |e| StoreError::own(path, "read", e);
        let mut file = match File::options().read(true).append(true).open(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(fail)?,
        };
        let n_bytes = file.metadata().map_err(fail)?.len();
        let mut reader = BufReader::new(&mut file);
        let mut found = vec![0; head.len()];
        if !read_whole(&mut reader, &mut found).map_err(fail)? || found != head {
            return Ok(None);
        }
        let mut good_bytes = head.len() as u64;
        while let Some(payload) = next_record(&mut reader, n_bytes - good_bytes).map_err(fail)? {
            if !each(&payload) {
                break;
            }
            good_bytes += (PREFIX_BYTES + payload.len()) as u64;
        }
        drop(reader);
        if good_bytes < n_bytes {
            file.set_len(good_bytes).map_err(|e| StoreError::own(path, "shorten", e))?;
        }
        let n_dropped_bytes = n_bytes - good_bytes;
        Ok(Some(Log { file, path: path.to_path_buf(), n_dropped_bytes, is_torn: false }))
    }

    /// Gives how many bytes at the end were cut off when it was opened.
    pub fn n_dropped_bytes(&self) -> u64 {
        self.n_dropped_bytes
    }

    /// Appends a record and makes it durable.
    ///
    /// # Errors
    /// Where the disk fails or is full; the record may be there then, whole or in part. After it
    /// nothing would be found, so nothing is appended any more.
    pub fn append(&mut self, payload: &[u8]) -> Result<(), StoreError> {
        assert!(payload.len() <= MAX_RECORD_BYTES, "records are kept short");
        let len = (payload.len() as u32).to_le_bytes();
        let crc = crc_of(len, payload).to_le_bytes();
        let fail = |e| StoreError::own(&self.path, "append to", e);
        if self.is_torn {
            return Err(fail(std::io::Error::other("an earlier record failed")));
        }
        self.is_torn = true;
        self.file.write_all(&[&len, &crc, payload].concat()).map_err(fail)?;
        self.file.sync_data().map_err(fail)?;
        self.is_torn = false;
        Ok(())
    }
}

/// Reads a record; none where it is broken or none is left.
fn next_record(file: &mut impl Read, left_bytes: u64) -> std::io::Result<Option<Vec<u8>>> {
    let mut prefix = [0; PREFIX_BYTES];
    if left_bytes < PREFIX_BYTES as u64 || !read_whole(file, &mut prefix)? {
        return Ok(None);
    }
    let [a, b, c, d, crc @ ..] = prefix;
    let len = [a, b, c, d];
    let n_bytes = u32::from_le_bytes(len) as usize;
    // Before any memory is taken for it.
    if n_bytes > MAX_RECORD_BYTES || (PREFIX_BYTES + n_bytes) as u64 > left_bytes {
        return Ok(None);
    }
    let mut payload = vec![0; n_bytes];
    let whole = read_whole(file, &mut payload)?;
    Ok((whole && crc_of(len, &payload) == u32::from_le_bytes(crc)).then_some(payload))
}

/// Reads exactly so much; false where the file ends before.
fn read_whole(file: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<bool> {
    match file.read_exact(buffer) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == ErrorKind::UnexpectedEof => Ok(false),
        Err(e) => Err(e),
    }
}

fn crc_of(len: [u8; 4], payload: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&len);
    hasher.update(payload);
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &[u8] = b"of this run";

    fn read(path: &Path) -> Option<Vec<Vec<u8>>> {
        let mut found = Vec::new();
        let log = Log::open(path, HEAD, |payload| {
            found.push(payload.to_vec());
            true
        });
        log.unwrap().map(|_| found)
    }

    #[test]
    fn f05_a_torn_tail_is_cut_off_and_nothing_before_it_is_lost() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        assert_eq!(read(&path), None);
        let records = [&b"one"[..], b"", b"three and more"];
        let mut log = Log::create(&path, HEAD).unwrap();
        let mut ends = vec![HEAD.len()];
        for record in records {
            log.append(record).unwrap();
            ends.push(std::fs::metadata(&path).unwrap().len() as usize);
        }
        let whole = std::fs::read(&path).unwrap();
        for n_bytes in 0..=whole.len() {
            // Cut short; or written over: then the broken record goes, and what follows it.
            for overwritten in [false, true] {
                let mut torn = whole[..n_bytes].to_vec();
                if overwritten {
                    torn.extend(whole[n_bytes..].iter().map(|b| !b));
                }
                std::fs::write(&path, torn).unwrap();
                let n_good = ends.iter().filter(|&&end| end <= n_bytes).count();
                let kept = |n| records[..n].iter().map(|r| r.to_vec()).collect();
                let expected: Option<Vec<Vec<u8>>> = n_good.checked_sub(1).map(kept);
                assert_eq!(read(&path), expected, "{n_bytes}");
                if n_good > 0 {
                    let n_left = std::fs::metadata(&path).unwrap().len() as usize;
                    assert_eq!(n_left, ends[n_good - 1]);
                    let mut log = Log::open(&path, HEAD, |_| true).unwrap().unwrap();
                    log.append(b"again").unwrap();
                    assert_eq!(read(&path).unwrap().last().unwrap(), b"again");
                }
            }
        }
    }

    #[test]
    fn a_log_of_something_else_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        Log::create(&path, b"of that run").unwrap().append(b"one").unwrap();
        assert_eq!(read(&path), None);
        // A length that no record has takes no memory.
        std::fs::write(&path, [HEAD, &[0xff; 40]].concat()).unwrap();
        assert_eq!(read(&path), Some(vec![]));
    }

    #[test]
    fn what_is_refused_is_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = Log::create(&path, HEAD).unwrap();
        for record in [b"a", b"b", b"c"] {
            log.append(record).unwrap();
        }
        Log::open(&path, HEAD, |payload| payload != b"b").unwrap().unwrap();
        assert_eq!(read(&path), Some(vec![b"a".to_vec()]));
    }
}
