//! Bytes sorted into buckets that may be larger than memory: as much as the limit allows is held,
//! the rest goes to one temporary file as extents.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

use crate::StoreError;

/// A set of buckets. Threads append whole records; a bucket gives back its extents in the order in
/// which they arrived, which depends on the threads: whoever reads must sort.
#[derive(Debug)]
pub struct Spill {
    folder: PathBuf,
    file: OnceLock<File>,
    file_bytes: AtomicU64,
    held_bytes: AtomicU64,
    limit_bytes: u64,
    buckets: Vec<Mutex<Bucket>>,
}

#[derive(Debug, Default)]
struct Bucket {
    extents: Vec<Extent>,
    n_bytes: u64,
}

#[derive(Debug)]
enum Extent {
    Held(Vec<u8>),
    OnDisk { offset_bytes: u64, len_bytes: usize },
}

impl Spill {
    /// Makes `n_buckets` empty buckets that hold at most `limit_bytes` in memory; a temporary
    /// file without a name is made in `folder` when it is needed, and ends with the process.
    pub fn new(folder: &Path, n_buckets: usize, limit_bytes: u64) -> Spill {
        Spill {
            folder: folder.to_path_buf(),
            file: OnceLock::new(),
            file_bytes: AtomicU64::new(0),
            held_bytes: AtomicU64::new(0),
            limit_bytes,
            buckets: (0..n_buckets).map(|_| Mutex::default()).collect(),
        }
    }

    /// Counts the buckets.
    pub fn n_buckets(&self) -> usize {
        self.buckets.len()
    }

    /// Gives the bytes in a bucket.
    pub fn bucket_bytes(&self, bucket: usize) -> u64 {
        self.lock(bucket).n_bytes
    }

    /// Gives the bytes that went to disk so far.
    pub fn spilled_bytes(&self) -> u64 {
        self.file_bytes.load(Ordering::Relaxed)
    }

    /// Appends an extent to a bucket, in memory while the limit allows.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn append(&self, bucket: usize, bytes: &[u8]) -> Result<(), StoreError> {
        let len = bytes.len() as u64;
        let held = self.held_bytes.fetch_add(len, Ordering::Relaxed);
        let extent = if held + len <= self.limit_bytes {
            Extent::Held(bytes.to_vec())
        } else {
            self.held_bytes.fetch_sub(len, Ordering::Relaxed);
            let offset_bytes = self.file_bytes.fetch_add(len, Ordering::Relaxed);
            self.file()?
                .write_all_at(bytes, offset_bytes)
                .map_err(|e| StoreError::own(&self.folder, "write a temporary file in", e))?;
            Extent::OnDisk { offset_bytes, len_bytes: bytes.len() }
        };
        let mut bucket = self.lock(bucket);
        bucket.extents.push(extent);
        bucket.n_bytes += len;
        Ok(())
    }

    /// Takes a bucket's bytes, which replace those of `out`, and releases what it held.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn take(&self, bucket: usize, out: &mut Vec<u8>) -> Result<(), StoreError> {
        let taken = std::mem::take(&mut *self.lock(bucket));
        // What `out` has is written over: only what it lacks becomes zeroes first.
        out.resize(taken.n_bytes as usize, 0);
        let mut rest = out.as_mut_slice();
        for extent in taken.extents {
            match extent {
                Extent::Held(bytes) => {
                    let (to, later) = rest.split_at_mut(bytes.len());
                    to.copy_from_slice(&bytes);
                    self.held_bytes.fetch_sub(bytes.len() as u64, Ordering::Relaxed);
                    rest = later;
                }
                Extent::OnDisk { offset_bytes, len_bytes } => {
                    let (to, later) = rest.split_at_mut(len_bytes);
                    self.read(to, offset_bytes)?;
                    rest = later;
                }
            }
        }
        Ok(())
    }

    /// Takes a bucket's extents one by one, releasing each.
    ///
    /// # Errors
    /// Where the disk or `each` fails.
    pub fn drain<E: From<StoreError>>(
        &self,
        bucket: usize,
        mut each: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        let taken = std::mem::take(&mut *self.lock(bucket));
        let mut buffer = Vec::new();
        for extent in taken.extents {
            each(self.bytes_of(&extent, &mut buffer)?)?;
            if let Extent::Held(bytes) = extent {
                self.held_bytes.fetch_sub(bytes.len() as u64, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    /// Shows a bucket's extents one by one and keeps them.
    ///
    /// # Errors
    /// Where the disk or `each` fails.
    pub fn peek<E: From<StoreError>>(
        &self,
        bucket: usize,
        mut each: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        let bucket = self.lock(bucket);
        let mut buffer = Vec::new();
        bucket.extents.iter().try_for_each(|extent| each(self.bytes_of(extent, &mut buffer)?))
    }

    fn bytes_of<'a>(
        &self,
        extent: &'a Extent,
        buffer: &'a mut Vec<u8>,
    ) -> Result<&'a [u8], StoreError> {
        match extent {
            Extent::Held(bytes) => Ok(bytes),
            Extent::OnDisk { offset_bytes, len_bytes } => {
                buffer.resize(*len_bytes, 0);
                self.read(buffer, *offset_bytes)?;
                Ok(buffer)
            }
        }
    }

    fn read(&self, buffer: &mut [u8], offset_bytes: u64) -> Result<(), StoreError> {
        self.file()?
            .read_exact_at(buffer, offset_bytes)
            .map_err(|e| StoreError::own(&self.folder, "read a temporary file in", e))
    }

    fn file(&self) -> Result<&File, StoreError> {
        if let Some(file) = self.file.get() {
            return Ok(file);
        }
        let made = tempfile::tempfile_in(&self.folder)
            .map_err(|e| StoreError::io(&self.folder, "make a temporary file in", e))?;
        Ok(self.file.get_or_init(|| made))
    }

    fn lock(&self, bucket: usize) -> std::sync::MutexGuard<'_, Bucket> {
        self.buckets[bucket].lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_spilled_and_what_is_held_come_back() {
        let folder = tempfile::tempdir().unwrap();
        for limit_bytes in [0, 1000, 1 << 20] {
            let spill = Spill::new(folder.path(), 3, limit_bytes);
            for i in 0..100u8 {
                spill.append(usize::from(i % 3), &[i; 50]).unwrap();
            }
            assert_eq!(spill.spilled_bytes(), 5000u64.saturating_sub(limit_bytes));
            assert_eq!(spill.bucket_bytes(0), 34 * 50);
            let mut out = Vec::new();
            spill.take(1, &mut out).unwrap();
            let expected: Vec<u8> = (0..100).filter(|i| i % 3 == 1).flat_map(|i| [i; 50]).collect();
            assert_eq!(out, expected);
            assert_eq!(spill.bucket_bytes(1), 0);
        }
    }
}
