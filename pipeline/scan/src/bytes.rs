//! Bytes of an input: little-endian words of a slice, and a bounded stream over part of a file.

use std::io::{self, Read, Seek, SeekFrom};

use pvmap_store::InputFile;

/// Bytes that a reader takes from the disk at a time: a few thousand records, within a level-2
/// cache.
pub(crate) const BLOCK_BYTES: usize = 128 << 10;

/// Takes `N` bytes at `at`; the caller has checked that they are there.
#[inline(always)]
pub(crate) fn take<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&bytes[at..at + N]);
    out
}

/// Reads a little-endian u16.
#[inline(always)]
pub(crate) fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(take(bytes, at))
}

/// Reads a little-endian u32.
#[inline(always)]
pub(crate) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(take(bytes, at))
}

/// Reads a little-endian i32.
#[inline(always)]
pub(crate) fn i32_at(bytes: &[u8], at: usize) -> i32 {
    i32::from_le_bytes(take(bytes, at))
}

/// Reads a little-endian u64.
#[inline(always)]
pub(crate) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(take(bytes, at))
}

/// Reads a little-endian f64.
#[inline(always)]
pub(crate) fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(take(bytes, at))
}

/// The bytes `at..end` of a file as a stream: what lies beyond cannot be read by mistake.
#[derive(Debug)]
pub(crate) struct Window<'a> {
    file: &'a InputFile,
    at: u64,
    end: u64,
}

impl<'a> Window<'a> {
    /// Opens a window; `end` beyond the file counts as its end.
    pub(crate) fn new(file: &'a InputFile, at: u64, end: u64) -> Window<'a> {
        Window { file, at, end: end.min(file.len_bytes()) }
    }
}

impl Read for Window<'_> {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let left = self.end.saturating_sub(self.at);
        let n = buf.len().min(usize::try_from(left).unwrap_or(usize::MAX));
        self.file.read_exact_at(&mut buf[..n], self.at).map_err(io::Error::other)?;
        self.at += n as u64;
        Ok(n)
    }
}

impl Seek for Window<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let target = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.end.checked_add_signed(by),
        };
        self.at = target.ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}
