//! Runs in a file with a name, which outlive the process that found them.
//!
//! | bytes | what |
//! |---|---|
//! | 4, for each piece | its length, little-endian |
//! | 4 | its CRC-32, little-endian |
//! | length | packed pairs |
//!
//! Which pieces make up a run is not in the file but in [`SavedRuns`], which a journal remembers.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::Path;
use std::sync::Arc;

use super::{Extent, PIECE_BYTES, Packer, Pair, Piece, Run, Runs};
use crate::StoreError;
use crate::work::write_whole;

/// What stands before a piece.
const PREFIX_BYTES: usize = 8;

/// What a file of runs holds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SavedRuns {
    /// Length of the file.
    pub n_bytes: u64,
    /// CRC-32 of the file.
    pub crc: u32,
    /// Bytes and pairs of each run.
    pub runs: Vec<(u64, u64)>,
}

impl Runs {
    /// Saves all runs that are held, and a run of `more` pairs that rise strictly, to a file that
    /// is durable before it gets its name. None where there is nothing to save.
    ///
    /// # Errors
    /// Where the disk fails or is full; then all is held as before.
    pub fn save(&mut self, path: &Path, more: &[Pair]) -> Result<Option<SavedRuns>, StoreError> {
        let is_held = |run: &Run| run.pieces.iter().all(|p| matches!(p, Piece::Held(_)));
        if more.is_empty() && !self.runs.iter().any(is_held) {
            return Ok(None);
        }
        let name: Arc<Path> = path.into();
        let (mut saved, mut moved) = (SavedRuns::default(), Vec::new());
        write_whole(path, |file| {
            moved.clear();
            let mut out = Saving::new(file, &name);
            for run in self.runs.iter().filter(|run| is_held(run)) {
                let held = run.pieces.iter().filter_map(|p| match p {
                    Piece::Held(bytes) => Some(bytes),
                    Piece::OnDisk(_) => None,
                });
                let pieces = held.map(|bytes| out.piece(bytes)).collect::<io::Result<_>>()?;
                out.end_run(run.n_pairs);
                moved.push(Run { pieces, n_pairs: run.n_pairs });
            }
            if !more.is_empty() {
                let mut packer = Packer::new(|bytes: &[u8]| out.piece(bytes));
                more.iter().try_for_each(|&pair| packer.put(pair))?;
                let run = packer.finish()?;
                out.end_run(run.n_pairs);
                moved.push(run);
            }
            saved = out.finish()?;
            Ok(())
        })?;
        self.runs.retain(|run| !is_held(run));
        self.runs.extend(moved);
        self.shelf.held_bytes.set(0);
        self.shelf.saved_bytes += saved.n_bytes;
        Ok(Some(saved))
    }

    /// Takes up the runs of a file. False, and nothing is taken up, where it cannot be read or is
    /// not what was saved.
    pub fn load(&mut self, path: &Path, saved: &SavedRuns) -> bool {
        match File::open(path).and_then(|file| read_runs(file, path.into(), saved)) {
            Ok(Some(runs)) => {
                self.runs.extend(runs);
                self.shelf.saved_bytes += saved.n_bytes;
                true
            }
            _ => false,
        }
    }
}

/// A file of runs that is being written.
struct Saving<'a> {
    out: BufWriter<&'a mut File>,
    name: &'a Arc<Path>,
    hasher: crc32fast::Hasher,
    saved: SavedRuns,
    run_bytes: u64,
}

impl Saving<'_> {
    fn new<'a>(file: &'a mut File, name: &'a Arc<Path>) -> Saving<'a> {
        let out = BufWriter::with_capacity(2 * PIECE_BYTES, file);
        let (hasher, saved) = (crc32fast::Hasher::new(), SavedRuns::default());
        Saving { out, name, hasher, saved, run_bytes: 0 }
    }

    fn piece(&mut self, bytes: &[u8]) -> io::Result<Piece> {
        let crc = crc32fast::hash(bytes);
        let len = (bytes.len() as u32).to_le_bytes();
        for part in [&len, &crc.to_le_bytes(), bytes] {
            self.hasher.update(part);
            self.out.write_all(part)?;
        }
        let offset_bytes = self.saved.n_bytes + PREFIX_BYTES as u64;
        let n_bytes = (PREFIX_BYTES + bytes.len()) as u64;
        self.saved.n_bytes += n_bytes;
        self.run_bytes += n_bytes;
        let file = Some(self.name.clone());
        Ok(Piece::OnDisk(Extent { file, offset_bytes, len_bytes: bytes.len(), crc }))
    }

    fn end_run(&mut self, n_pairs: u64) {
        self.saved.runs.push((std::mem::take(&mut self.run_bytes), n_pairs));
    }

    fn finish(mut self) -> io::Result<SavedRuns> {
        self.out.flush()?;
        Ok(SavedRuns { crc: self.hasher.finalize(), ..self.saved })
    }
}

/// Reads where the pieces of a file are, and checks every byte of it.
fn read_runs(file: File, name: Arc<Path>, saved: &SavedRuns) -> io::Result<Option<Vec<Run>>> {
    if file.metadata()?.len() != saved.n_bytes {
        return Ok(None);
    }
    let mut file = BufReader::with_capacity(2 * PIECE_BYTES, file);
    let (mut hasher, mut runs) = (crc32fast::Hasher::new(), Vec::with_capacity(saved.runs.len()));
    let (mut at_bytes, mut piece) = (0, Vec::new());
    for &(run_bytes, n_pairs) in &saved.runs {
        let mut run = Run { n_pairs, ..Run::default() };
        let end_bytes = at_bytes + run_bytes.min(saved.n_bytes - at_bytes);
        while at_bytes < end_bytes {
            let mut prefix = [0; PREFIX_BYTES];
            file.read_exact(&mut prefix)?;
            hasher.update(&prefix);
            let [a, b, c, d, crc @ ..] = prefix;
            let len_bytes = u32::from_le_bytes([a, b, c, d]) as usize;
            let (offset_bytes, crc) = (at_bytes + PREFIX_BYTES as u64, u32::from_le_bytes(crc));
            at_bytes = offset_bytes + len_bytes as u64;
            if len_bytes > PIECE_BYTES || at_bytes > end_bytes {
                return Ok(None);
            }
            piece.resize(len_bytes, 0);
            file.read_exact(&mut piece)?;
            hasher.update(&piece);
            if crc32fast::hash(&piece) != crc {
                return Ok(None);
            }
            let file = Some(name.clone());
            run.pieces.push_back(Piece::OnDisk(Extent { file, offset_bytes, len_bytes, crc }));
        }
        runs.push(run);
    }
    Ok((at_bytes == saved.n_bytes && hasher.finalize() == saved.crc).then_some(runs))
}

#[cfg(test)]
mod tests {
    use super::super::tests::merged;
    use super::*;

    fn pairs(of: u32) -> Vec<Pair> {
        (0..60_000).map(|i| (i / 300, i % 300 * 8 + of)).collect()
    }

    #[test]
    fn saved_runs_are_taken_up_by_another_process() {
        let folder = tempfile::tempdir().unwrap();
        let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
        let mut runs = Runs::new(folder.path(), u64::MAX);
        assert_eq!(runs.save(&first, &[]).unwrap(), None);
        [0, 1, 2].iter().for_each(|&of| runs.push(&pairs(of)).unwrap());
        let saved_first = runs.save(&first, &pairs(3)).unwrap().unwrap();
        assert_eq!((saved_first.runs.len(), runs.shelf.held_bytes.get()), (4, 0));
        let saved_second = runs.save(&second, &pairs(4)).unwrap().unwrap();
        assert_eq!(runs.save(&second, &[]).unwrap(), None);
        assert_eq!(runs.spilled_bytes(), saved_first.n_bytes + saved_second.n_bytes);
        // What is not saved yet is merged with what is.
        runs.push(&pairs(5)).unwrap();
        let mut expected: Vec<Pair> = (0..6).flat_map(pairs).collect();
        expected.sort_unstable();
        assert!(merged(runs) == expected);

        let mut again = Runs::new(folder.path(), 0);
        assert!(again.load(&first, &saved_first) && again.load(&second, &saved_second));
        again.push(&pairs(5)).unwrap();
        assert!(merged(again) == expected);
    }

    #[test]
    fn f26_a_file_that_is_not_what_was_saved_is_not_taken_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs");
        let mut runs = Runs::new(folder.path(), u64::MAX);
        runs.push(&[(1, 2), (1, 3), (7, 9)]).unwrap();
        let saved = runs.save(&path, &[(4, 5)]).unwrap().unwrap();
        let good = std::fs::read(&path).unwrap();
        let is_taken_up = |bytes: &[u8], saved| {
            std::fs::write(&path, bytes).unwrap();
            Runs::new(folder.path(), 0).load(&path, saved)
        };
        assert!(is_taken_up(&good, &saved));
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(!is_taken_up(&bad, &saved), "bit {bit}");
        }
        for n_bytes in 0..good.len() {
            assert!(!is_taken_up(&good[..n_bytes], &saved), "{n_bytes} bytes");
        }
        assert!(!is_taken_up(&[&good[..], &[0]].concat(), &saved));
        std::fs::remove_file(&path).unwrap();
        assert!(!Runs::new(folder.path(), 0).load(&path, &saved));
    }

    #[test]
    fn f26_what_changes_after_it_was_saved_is_noticed_when_it_is_merged() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs");
        let mut runs = Runs::new(folder.path(), u64::MAX);
        runs.save(&path, &pairs(0)).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        let merged = runs.merge(|_| Ok::<_, StoreError>(()));
        assert!(matches!(merged, Err(StoreError::Damaged { path: p }) if p == path));
    }
}
