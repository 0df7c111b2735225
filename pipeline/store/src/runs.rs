//! Sorted runs: pairs of ids that were sorted in memory, put away packed, and merged at the end.
//! As much as the limit allows is held, the rest goes to one temporary file. Runs that must outlive
//! the process are saved to files with names ([`saved`]).

use std::cell::{Cell, OnceCell};
use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::StoreError;

pub mod saved;

/// A pair of ids; pairs are ordered by their first id, then the second.
pub type Pair = (u32, u32);

/// The longest a piece of a run can be.
const PIECE_BYTES: usize = 1 << 16;
/// Runs that are merged at once: with a piece of each, 16 MiB.
const MAX_FAN_IN: usize = 256;
/// Pairs moved between two words about it.
const PAIRS_TOLD: u64 = 1 << 16;
/// The longest a packed pair can be: two varints of five bytes.
const MAX_PAIR_BYTES: usize = 10;

/// Runs that may be larger than memory.
#[derive(Debug)]
pub struct Runs {
    shelf: Shelf,
    runs: Vec<Run>,
}

/// Pieces of whole packed pairs, in order.
#[derive(Debug, Default)]
struct Run {
    pieces: VecDeque<Piece>,
    n_pairs: u64,
}

#[derive(Debug)]
enum Piece {
    Held(Vec<u8>),
    OnDisk(Extent),
}

/// A piece in a file: the temporary one, or one with a name.
#[derive(Debug)]
struct Extent {
    file: Option<Arc<Path>>,
    offset_bytes: u64,
    len_bytes: usize,
    crc: u32,
}

impl Runs {
    /// Makes an empty set that holds at most `limit_bytes` in memory; a temporary file without a
    /// name is made in `folder` when it is needed, and ends with the process.
    pub fn new(folder: &Path, limit_bytes: u64) -> Runs {
        let shelf = Shelf {
            folder: folder.to_path_buf(),
            file: OnceCell::new(),
            file_bytes: Cell::new(0),
            saved_bytes: 0,
            held_bytes: Cell::new(0),
            limit_bytes,
        };
        Runs { shelf, runs: Vec::new() }
    }

    /// Counts the pairs.
    pub fn n_pairs(&self) -> u64 {
        self.runs.iter().map(|run| run.n_pairs).sum()
    }

    /// Gives the bytes that went to disk so far.
    pub fn spilled_bytes(&self) -> u64 {
        self.shelf.file_bytes.get() + self.shelf.saved_bytes
    }

    /// Says whether a run of these pairs would be held in memory.
    pub fn has_room_for(&self, pairs: &[Pair]) -> bool {
        let mut before = (0, 0);
        let packed =
            pairs.iter().map(|&pair| n_packed_bytes(std::mem::replace(&mut before, pair), pair));
        self.shelf.held_bytes.get() + packed.sum::<u64>() <= self.shelf.limit_bytes
    }

    /// Puts away a run: pairs that rise strictly.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn push(&mut self, pairs: &[Pair]) -> Result<(), StoreError> {
        let mut packer = Packer::new(|bytes: &[u8]| self.shelf.keep(bytes));
        pairs.iter().try_for_each(|&pair| packer.put(pair))?;
        let run = packer.finish()?;
        self.runs.extend((run.n_pairs > 0).then_some(run));
        Ok(())
    }

    /// Counts the pairs that [`Self::narrow`] moves, each as often as it does.
    pub fn n_pairs_to_narrow(&self) -> u64 {
        let mut lengths: VecDeque<u64> = self.runs.iter().map(|run| run.n_pairs).collect();
        let mut n_moved = 0;
        while lengths.len() > MAX_FAN_IN {
            let merged = lengths.drain(..MAX_FAN_IN).sum();
            n_moved += merged;
            lengths.push_back(merged);
        }
        n_moved
    }

    /// Merges runs into longer ones until they are few enough to be merged at once; `each` gets the
    /// number of pairs moved, again and again.
    ///
    /// # Errors
    /// Where the disk or `each` fails.
    pub fn narrow<E: From<StoreError>>(
        &mut self,
        mut each: impl FnMut(u64) -> Result<(), E>,
    ) -> Result<(), E> {
        while self.runs.len() > MAX_FAN_IN {
            let group = self.runs.drain(..MAX_FAN_IN).collect();
            let mut packer = Packer::new(|bytes: &[u8]| self.shelf.keep(bytes));
            let mut n_told = 0;
            merge_runs(&self.shelf, group, |pair| {
                packer.put(pair)?;
                let n_new = packer.run.n_pairs - n_told;
                if n_new == PAIRS_TOLD {
                    n_told += n_new;
                    each(n_new)?;
                }
                Ok::<_, E>(())
            })?;
            let run = packer.finish()?;
            each(run.n_pairs - n_told)?;
            self.runs.push(run);
        }
        Ok(())
    }

    /// Walks all pairs of all runs in order. A pair that stands in two runs comes twice.
    ///
    /// # Errors
    /// Where the disk or `each` fails.
    pub fn merge<E: From<StoreError>>(
        mut self,
        each: impl FnMut(Pair) -> Result<(), E>,
    ) -> Result<(), E> {
        self.narrow(|_| Ok::<_, E>(()))?;
        merge_runs(&self.shelf, self.runs, each)
    }
}

/// Where pieces are kept.
#[derive(Debug)]
struct Shelf {
    folder: PathBuf,
    file: OnceCell<File>,
    file_bytes: Cell<u64>,
    saved_bytes: u64,
    held_bytes: Cell<u64>,
    limit_bytes: u64,
}

impl Shelf {
    /// Keeps a piece, in memory while the limit allows.
    fn keep(&self, bytes: &[u8]) -> Result<Piece, StoreError> {
        let held_bytes = self.held_bytes.get() + bytes.len() as u64;
        if held_bytes <= self.limit_bytes {
            self.held_bytes.set(held_bytes);
            return Ok(Piece::Held(bytes.to_vec()));
        }
        let offset_bytes = self.file_bytes.get();
        let written = self.file()?.write_all_at(bytes, offset_bytes);
        written.map_err(|e| StoreError::own(&self.folder, "write a temporary file in", e))?;
        self.file_bytes.set(offset_bytes + bytes.len() as u64);
        let (len_bytes, crc) = (bytes.len(), crc32fast::hash(bytes));
        Ok(Piece::OnDisk(Extent { file: None, offset_bytes, len_bytes, crc }))
    }

    /// Moves a piece into a buffer and releases what it held.
    fn take(&self, piece: Piece, buffer: &mut Vec<u8>) -> Result<(), StoreError> {
        match piece {
            Piece::Held(bytes) => {
                self.held_bytes.set(self.held_bytes.get() - bytes.len() as u64);
                *buffer = bytes;
                Ok(())
            }
            Piece::OnDisk(extent) => {
                buffer.resize(extent.len_bytes, 0);
                self.read(&extent, buffer)
            }
        }
    }

    /// Reads a piece back. A file with a name is opened for each, 64 KiB at a time: there may be
    /// more of them than a process may have open.
    fn read(&self, extent: &Extent, buffer: &mut [u8]) -> Result<(), StoreError> {
        let (path, read) = match &extent.file {
            Some(path) => {
                let opened = File::open(path);
                (&**path, opened.and_then(|f| f.read_exact_at(buffer, extent.offset_bytes)))
            }
            None => {
                let read = self.file()?.read_exact_at(buffer, extent.offset_bytes);
                (&*self.folder, read)
            }
        };
        read.map_err(|e| StoreError::own(path, "read a temporary file", e))?;
        if crc32fast::hash(buffer) != extent.crc {
            return Err(StoreError::Damaged { path: path.to_path_buf() });
        }
        Ok(())
    }

    fn file(&self) -> Result<&File, StoreError> {
        if let Some(file) = self.file.get() {
            return Ok(file);
        }
        let made = tempfile::tempfile_in(&self.folder)
            .map_err(|e| StoreError::own(&self.folder, "make a temporary file in", e))?;
        Ok(self.file.get_or_init(|| made))
    }
}

/// Packs pairs into the pieces of a run.
struct Packer<F> {
    keep: F,
    run: Run,
    buffer: Vec<u8>,
    before: Pair,
}

impl<F: FnMut(&[u8]) -> Result<Piece, E>, E> Packer<F> {
    /// Starts a run whose pieces `keep` takes.
    fn new(keep: F) -> Packer<F> {
        let buffer = Vec::with_capacity(PIECE_BYTES);
        Packer { keep, run: Run::default(), buffer, before: (0, 0) }
    }

    fn put(&mut self, pair: Pair) -> Result<(), E> {
        let (step, second) = steps(self.before, pair);
        put_varint(&mut self.buffer, step);
        put_varint(&mut self.buffer, second);
        self.before = pair;
        self.run.n_pairs += 1;
        if self.buffer.len() > PIECE_BYTES - MAX_PAIR_BYTES { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<(), E> {
        if !self.buffer.is_empty() {
            self.run.pieces.push_back((self.keep)(&self.buffer)?);
            self.buffer.clear();
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Run, E> {
        self.flush()?;
        Ok(self.run)
    }
}

/// A place in a run.
struct Cursor {
    /// What lies beyond the buffer.
    pieces: VecDeque<Piece>,
    buffer: Vec<u8>,
    at: usize,
    before: Pair,
}

impl Cursor {
    fn new(run: Run) -> Cursor {
        Cursor { pieces: run.pieces, buffer: Vec::new(), at: 0, before: (0, 0) }
    }

    fn next(&mut self, shelf: &Shelf) -> Result<Option<Pair>, StoreError> {
        if self.at == self.buffer.len() {
            let Some(piece) = self.pieces.pop_front() else { return Ok(None) };
            shelf.take(piece, &mut self.buffer)?;
            self.at = 0;
        }
        let step = take_varint(&self.buffer, &mut self.at);
        let second = take_varint(&self.buffer, &mut self.at);
        let (a, b) = self.before;
        self.before = if step == 0 { (a, b + second) } else { (a + step, second) };
        Ok(Some(self.before))
    }
}

/// Merges by a heap of the next pair of each run.
fn merge_runs<E: From<StoreError>>(
    shelf: &Shelf,
    runs: Vec<Run>,
    mut each: impl FnMut(Pair) -> Result<(), E>,
) -> Result<(), E> {
    let mut cursors: Vec<Cursor> = runs.into_iter().map(Cursor::new).collect();
    let mut heap = BinaryHeap::with_capacity(cursors.len());
    for (i, cursor) in cursors.iter_mut().enumerate() {
        heap.extend(cursor.next(shelf)?.map(|pair| Reverse((pair, i))));
    }
    while let Some(mut top) = heap.peek_mut() {
        let Reverse((pair, i)) = *top;
        each(pair)?;
        match cursors[i].next(shelf)? {
            // Replacing the top in place costs one sift instead of a pop and a push.
            Some(next) => *top = Reverse((next, i)),
            None => {
                std::collections::binary_heap::PeekMut::pop(top);
            }
        }
    }
    Ok(())
}

/// Gives what is stored of a pair that follows another.
fn steps(before: Pair, pair: Pair) -> (u32, u32) {
    let step = pair.0 - before.0;
    // Within a list the partners rise too; the first of a list stands as it is.
    (step, if step == 0 { pair.1 - before.1 } else { pair.1 })
}

fn n_packed_bytes(before: Pair, pair: Pair) -> u64 {
    let (step, second) = steps(before, pair);
    [step, second].map(|v| u64::from((32 - v.leading_zeros()).max(1).div_ceil(7))).iter().sum()
}

fn put_varint(out: &mut Vec<u8>, mut v: u32) {
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

fn take_varint(bytes: &[u8], at: &mut usize) -> u32 {
    let mut v = 0;
    let mut shift = 0;
    loop {
        let byte = bytes[*at];
        *at += 1;
        v |= u32::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return v;
        }
        shift += 7;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn merged(runs: Runs) -> Vec<Pair> {
        let mut merged = Vec::new();
        let each = |pair| {
            merged.push(pair);
            Ok::<_, StoreError>(())
        };
        runs.merge(each).unwrap();
        merged
    }

    #[test]
    fn runs_merge_in_order_held_or_not() {
        let folder = tempfile::tempdir().unwrap();
        let pair = |i: u32| (i / 300, (i % 300).pow(3));
        let n = 200_000;
        let expected: Vec<Pair> = (0..n).map(pair).collect();
        // More runs than one merge can take, so that some are merged twice.
        for (n_runs, limit_bytes) in
            [(600, 0), (600, 100_000), (600, u64::MAX), (3, 0), (3, 100_000), (3, u64::MAX)]
        {
            let mut runs = Runs::new(folder.path(), limit_bytes);
            for r in 0..n_runs {
                let run: Vec<Pair> = (0..n).filter(|i| i % n_runs == r).map(pair).collect();
                let (n_held, has_room) = (runs.shelf.held_bytes.get(), runs.has_room_for(&run));
                runs.push(&run).unwrap();
                let is_held = runs.spilled_bytes() == 0;
                assert!(has_room == is_held || n_held < limit_bytes);
                assert!(runs.shelf.held_bytes.get() <= limit_bytes);
            }
            assert_eq!(runs.n_pairs(), u64::from(n));
            let is_held = runs.spilled_bytes() == 0;
            assert_eq!(is_held, limit_bytes == u64::MAX, "{n_runs} runs, {limit_bytes} bytes");
            assert_eq!(runs.shelf.file.get().is_none(), is_held);
            let (n_moved, mut n_told) = (runs.n_pairs_to_narrow(), 0);
            let told = runs.narrow(|n| {
                n_told += n;
                Ok::<_, StoreError>(())
            });
            told.unwrap();
            assert_eq!((n_told, n_moved > 0), (n_moved, n_runs == 600));
            assert!(merged(runs) == expected, "{n_runs} runs, {limit_bytes} bytes");
        }
    }

    #[test]
    fn no_runs_give_no_pairs() {
        let folder = tempfile::tempdir().unwrap();
        let mut runs = Runs::new(folder.path(), 0);
        runs.push(&[]).unwrap();
        assert_eq!(merged(runs), []);
    }

    #[test]
    fn the_largest_steps_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let pairs = [(1, 2), (1, u32::MAX), (u32::MAX, 0)];
        let mut runs = Runs::new(folder.path(), 0);
        runs.push(&pairs).unwrap();
        assert_eq!(merged(runs), pairs);
    }
}
