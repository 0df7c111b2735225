//! Sorted runs: pairs of ids that were sorted in memory, put away packed, and merged at the end.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use crate::StoreError;

/// A pair of ids; pairs are ordered by their first id, then the second.
pub type Pair = (u32, u32);

/// Bytes of a run that are read at once while merging.
const READ_BYTES: usize = 1 << 16;
/// Runs that are merged at once: with one buffer each, 16 MiB.
const MAX_FAN_IN: usize = 256;
/// The longest a packed pair can be: two varints of five bytes.
const MAX_PAIR_BYTES: usize = 10;

/// Runs in one temporary file without a name.
#[derive(Debug)]
pub struct Runs {
    folder: PathBuf,
    file: Option<File>,
    runs: Vec<Run>,
    end_bytes: u64,
}

#[derive(Debug, Clone, Copy)]
struct Run {
    offset_bytes: u64,
    len_bytes: u64,
}

impl Runs {
    /// Makes an empty set; its file is made in `folder` when it is needed.
    pub fn new(folder: &Path) -> Runs {
        Runs { folder: folder.to_path_buf(), file: None, runs: Vec::new(), end_bytes: 0 }
    }

    /// Gives the bytes on disk.
    pub fn spilled_bytes(&self) -> u64 {
        self.end_bytes
    }

    /// Puts away a run: pairs that rise strictly.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn push(&mut self, pairs: &[Pair]) -> Result<(), StoreError> {
        let mut writer = self.writer()?;
        for &pair in pairs {
            writer.put(pair)?;
        }
        writer.finish()
    }

    /// Walks all pairs of all runs and of `rest` (which rises too) in order. A pair that stands in
    /// two runs comes twice.
    ///
    /// # Errors
    /// Where the disk or `each` fails.
    pub fn merge<E: From<StoreError>>(
        mut self,
        rest: &[Pair],
        mut each: impl FnMut(Pair) -> Result<(), E>,
    ) -> Result<(), E> {
        while self.runs.len() > MAX_FAN_IN {
            let group: Vec<Run> = self.runs.drain(..MAX_FAN_IN).collect();
            let mut cursors = self.cursors(&group)?;
            let source = self.file()?.try_clone().map_err(|e| self.fail(e))?;
            let folder = self.folder.clone();
            let mut writer = self.writer()?;
            merge_cursors(&source, &folder, &mut cursors, &[], |pair| writer.put(pair))?;
            writer.finish()?;
        }
        if self.runs.is_empty() {
            return rest.iter().try_for_each(|&pair| each(pair));
        }
        let mut cursors = self.cursors(&self.runs)?;
        let source = self.file.as_ref().expect("a run was written, so there is a file");
        merge_cursors(source, &self.folder, &mut cursors, rest, each)
    }

    fn cursors(&self, runs: &[Run]) -> Result<Vec<Cursor>, StoreError> {
        Ok(runs.iter().map(|&run| Cursor::new(run)).collect())
    }

    fn fail(&self, e: std::io::Error) -> StoreError {
        StoreError::io(&self.folder, "use a temporary file in", e)
    }

    fn file(&mut self) -> Result<&File, StoreError> {
        if self.file.is_none() {
            let made = tempfile::tempfile_in(&self.folder).map_err(|e| self.fail(e))?;
            self.file = Some(made);
        }
        Ok(self.file.as_ref().expect("made above"))
    }

    fn writer(&mut self) -> Result<RunWriter<'_>, StoreError> {
        self.file()?;
        let start = self.end_bytes;
        Ok(RunWriter { runs: self, start, buffer: Vec::with_capacity(READ_BYTES), before: (0, 0) })
    }
}

struct RunWriter<'a> {
    runs: &'a mut Runs,
    start: u64,
    buffer: Vec<u8>,
    before: Pair,
}

impl RunWriter<'_> {
    fn put(&mut self, pair: Pair) -> Result<(), StoreError> {
        let step = pair.0 - self.before.0;
        put_varint(&mut self.buffer, step);
        // Within a list the partners rise too; the first of a list stands as it is.
        put_varint(&mut self.buffer, if step == 0 { pair.1 - self.before.1 } else { pair.1 });
        self.before = pair;
        if self.buffer.len() > READ_BYTES - MAX_PAIR_BYTES { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<(), StoreError> {
        let file = self.runs.file.as_ref().expect("the writer was made with a file");
        file.write_all_at(&self.buffer, self.runs.end_bytes).map_err(|e| self.runs.fail(e))?;
        self.runs.end_bytes += self.buffer.len() as u64;
        self.buffer.clear();
        Ok(())
    }

    fn finish(mut self) -> Result<(), StoreError> {
        self.flush()?;
        let len_bytes = self.runs.end_bytes - self.start;
        if len_bytes > 0 {
            self.runs.runs.push(Run { offset_bytes: self.start, len_bytes });
        }
        Ok(())
    }
}

/// A place in a run, with the bytes around it.
struct Cursor {
    run: Run,
    buffer: Vec<u8>,
    at: usize,
    before: Pair,
}

impl Cursor {
    fn new(run: Run) -> Cursor {
        Cursor { run, buffer: Vec::new(), at: 0, before: (0, 0) }
    }

    fn next(&mut self, file: &File, folder: &Path) -> Result<Option<Pair>, StoreError> {
        if self.buffer.len() - self.at < MAX_PAIR_BYTES && self.run.len_bytes > 0 {
            self.buffer.drain(..self.at);
            self.at = 0;
            let kept = self.buffer.len();
            let n = (READ_BYTES - kept).min(self.run.len_bytes.try_into().unwrap_or(usize::MAX));
            self.buffer.resize(kept + n, 0);
            file.read_exact_at(&mut self.buffer[kept..], self.run.offset_bytes)
                .map_err(|e| StoreError::io(folder, "read a temporary file in", e))?;
            self.run.offset_bytes += n as u64;
            self.run.len_bytes -= n as u64;
        }
        if self.at == self.buffer.len() {
            return Ok(None);
        }
        let step = take_varint(&self.buffer, &mut self.at);
        let second = take_varint(&self.buffer, &mut self.at);
        let (a, b) = self.before;
        self.before = if step == 0 { (a, b + second) } else { (a + step, second) };
        Ok(Some(self.before))
    }
}

/// Merges by a heap of the next pair of each run.
fn merge_cursors<E: From<StoreError>>(
    file: &File,
    folder: &Path,
    cursors: &mut [Cursor],
    rest: &[Pair],
    mut each: impl FnMut(Pair) -> Result<(), E>,
) -> Result<(), E> {
    let mut heap = BinaryHeap::with_capacity(cursors.len() + 1);
    for (i, cursor) in cursors.iter_mut().enumerate() {
        heap.extend(cursor.next(file, folder)?.map(|pair| Reverse((pair, i))));
    }
    let mut rest = rest.iter().copied();
    heap.extend(rest.next().map(|pair| Reverse((pair, usize::MAX))));
    while let Some(mut top) = heap.peek_mut() {
        let Reverse((pair, i)) = *top;
        each(pair)?;
        let next = if i == usize::MAX { rest.next() } else { cursors[i].next(file, folder)? };
        match next {
            // Replacing the top in place costs one sift instead of a pop and a push.
            Some(next) => *top = Reverse((next, i)),
            None => {
                std::collections::binary_heap::PeekMut::pop(top);
            }
        }
    }
    Ok(())
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

    #[test]
    fn runs_merge_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let mut runs = Runs::new(folder.path());
        let pair = |i: u32| (i / 300, (i % 300).pow(3));
        let n = 200_000;
        // More runs than one merge can take, so that some are merged twice.
        for r in 0..600 {
            let run: Vec<Pair> = (0..n).filter(|i| i % 601 == r).map(pair).collect();
            runs.push(&run).unwrap();
        }
        let rest: Vec<Pair> = (0..n).filter(|i| i % 601 == 600).map(pair).collect();
        let mut merged = Vec::new();
        runs.merge(&rest, |p| {
            merged.push(p);
            Ok::<_, StoreError>(())
        })
        .unwrap();
        assert_eq!(merged, (0..n).map(pair).collect::<Vec<_>>());
    }

    #[test]
    fn no_runs_give_the_rest() {
        let folder = tempfile::tempdir().unwrap();
        let mut merged = Vec::new();
        let rest = [(1, 2), (1, u32::MAX), (u32::MAX, 0)];
        let each = |p| {
            merged.push(p);
            Ok::<_, StoreError>(())
        };
        Runs::new(folder.path()).merge(&rest, each).unwrap();
        assert_eq!(merged, rest);
    }
}
