//! A file made of sections: aligned, checksummed block by block, written in any order, whole or
//! not at all. What the head of such a file says is the format's business.

use std::io::{self, Write};
use std::path::Path;
use std::sync::Mutex;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use crc32fast::Hasher;

use crate::output::{AtomicFile, ClosedFile};
use crate::{StoreError, WorkFolder};

/// Bytes under one checksum.
pub const BLOCK_BYTES: usize = 65_536;
/// Sections start at multiples of this.
const ALIGN_BYTES: u64 = 64;
/// From one sync of a file that is being written to the next: some hundred megabytes at the best.
const SYNC_PAUSE: Duration = Duration::from_millis(100);

/// Where a section went and the CRC-32 of each of its blocks.
#[derive(Debug, Clone)]
pub struct Section {
    /// From the start of the file.
    pub offset_bytes: u64,
    /// Without padding.
    pub len_bytes: u64,
    /// One a block of 65 536 bytes.
    pub sums: Vec<u32>,
}

/// A file of sections that is being written.
#[derive(Debug)]
pub struct SectionFile {
    file: AtomicFile,
    end_bytes: u64,
}

impl SectionFile {
    /// Starts a file, leaving room for a head of `head_bytes`.
    ///
    /// # Errors
    /// Those of [`AtomicFile::create`].
    pub fn create(path: &Path, head_bytes: u64) -> Result<SectionFile, StoreError> {
        Ok(SectionFile { file: AtomicFile::create(path)?, end_bytes: head_bytes })
    }

    /// Starts the output of a work folder, leaving room for a head of `head_bytes`.
    ///
    /// # Errors
    /// Those of [`AtomicFile::create_in`].
    pub fn create_in(
        work: &WorkFolder,
        name: &str,
        head_bytes: u64,
    ) -> Result<SectionFile, StoreError> {
        Ok(SectionFile { file: AtomicFile::create_in(work, name)?, end_bytes: head_bytes })
    }

    /// Writes a section that is at hand.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn whole(&mut self, bytes: &[u8]) -> Result<Section, StoreError> {
        let offset_bytes = self.take(bytes.len() as u64);
        self.file.write_at(bytes, offset_bytes)?;
        let sums = bytes.chunks(BLOCK_BYTES).map(crc32fast::hash).collect();
        Ok(Section { offset_bytes, len_bytes: bytes.len() as u64, sums })
    }

    /// Takes room for a section whose length is known and whose parts come in any order.
    pub fn scattered(&mut self, len_bytes: u64) -> Scattered {
        let offset_bytes = self.take(len_bytes);
        let n_blocks = len_bytes.div_ceil(BLOCK_BYTES as u64) as usize;
        let sums = Sums { whole: vec![0; n_blocks], pieces: Vec::new(), n_written: 0 };
        Scattered { offset_bytes, len_bytes, sums: Mutex::new(sums) }
    }

    /// Writes a part of a scattered section at its place in the section, from any thread. Parts do
    /// not overlap.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn scatter(&self, to: &Scattered, bytes: &[u8], at_bytes: u64) -> Result<(), StoreError> {
        assert!(at_bytes + bytes.len() as u64 <= to.len_bytes, "a part leaves its section");
        self.file.write_at(bytes, to.offset_bytes + at_bytes)?;
        to.note(bytes, at_bytes);
        Ok(())
    }

    /// Writes a section again, in its room and of the same length.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn rewrite(&mut self, section: &Section, bytes: &[u8]) -> Result<Section, StoreError> {
        assert_eq!(section.len_bytes, bytes.len() as u64, "a section keeps its length");
        self.file.write_at(bytes, section.offset_bytes)?;
        let sums = bytes.chunks(BLOCK_BYTES).map(crc32fast::hash).collect();
        Ok(Section { sums, ..section.clone() })
    }

    /// Starts a section that is written from front to back.
    pub fn stream(&mut self) -> SectionWriter<'_> {
        let offset_bytes = self.end_bytes.next_multiple_of(ALIGN_BYTES);
        SectionWriter {
            file: self,
            offset_bytes,
            len_bytes: 0,
            block: Vec::with_capacity(BLOCK_BYTES),
            sums: Vec::new(),
        }
    }

    /// Runs a job that scatters parts, while a thread of its own makes durable what is written so
    /// far: closing the file then has little left to wait for.
    ///
    /// # Errors
    /// Those of the job, and where the disk fails.
    pub fn sync_while<T, E: From<StoreError>>(
        &self,
        job: impl FnOnce() -> Result<T, E>,
    ) -> Result<T, E> {
        let (job_ended, ended) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            let syncing = scope.spawn(move || {
                // The channel closes when the job returns or panics.
                while ended.recv_timeout(SYNC_PAUSE) == Err(RecvTimeoutError::Timeout) {
                    // The system tells of a failure once: it must not get lost here.
                    self.file.sync_written()?;
                }
                Ok(())
            });
            let result = job();
            drop(job_ended);
            let synced: Result<(), StoreError> = syncing.join().expect("syncing does not panic");
            let value = result?;
            synced?;
            Ok(value)
        })
    }

    /// Reads back bytes of a section that is finished while the file is not.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn read_at(&self, buf: &mut [u8], offset_bytes: u64) -> Result<(), StoreError> {
        self.file.read_at(buf, offset_bytes)
    }

    /// Reads a finished section back and compares its checksums: a disk may say that it wrote what
    /// it did not.
    ///
    /// # Errors
    /// Where the disk fails, or a block is not what was written.
    pub fn check(&self, section: &Section) -> Result<(), StoreError> {
        let mut block = vec![0; BLOCK_BYTES.min(section.len_bytes as usize)];
        let mut left_bytes = section.len_bytes;
        for (i, &sum) in (0..).zip(&section.sums) {
            let now = &mut block[..left_bytes.min(BLOCK_BYTES as u64) as usize];
            self.file.read_at(now, section.offset_bytes + i * BLOCK_BYTES as u64)?;
            if crc32fast::hash(now) != sum {
                return Err(StoreError::Damaged { path: self.file.path().to_path_buf() });
            }
            left_bytes -= now.len() as u64;
        }
        Ok(())
    }

    /// Writes the head and the last bytes of the file, and gives it its name.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn finish(
        self,
        head: &[u8],
        tail: &[u8],
        tail_offset_bytes: u64,
    ) -> Result<(), StoreError> {
        self.close(head, tail, tail_offset_bytes)?.publish(false)
    }

    /// Writes the head and the last bytes of the file and makes it durable.
    ///
    /// # Errors
    /// Where the disk fails, or what was written does not read back.
    pub fn close(
        self,
        head: &[u8],
        tail: &[u8],
        tail_offset_bytes: u64,
    ) -> Result<ClosedFile, StoreError> {
        for (bytes, offset_bytes) in [(head, 0), (tail, tail_offset_bytes)] {
            self.file.write_at(bytes, offset_bytes)?;
            let mut found = vec![0; bytes.len()];
            self.file.read_at(&mut found, offset_bytes)?;
            if found != bytes {
                return Err(StoreError::Damaged { path: self.file.path().to_path_buf() });
            }
        }
        self.file.close()
    }

    fn take(&mut self, len_bytes: u64) -> u64 {
        let offset_bytes = self.end_bytes.next_multiple_of(ALIGN_BYTES);
        self.end_bytes = offset_bytes + len_bytes;
        offset_bytes
    }
}

/// A section that is written from front to back.
#[derive(Debug)]
pub struct SectionWriter<'a> {
    file: &'a mut SectionFile,
    offset_bytes: u64,
    len_bytes: u64,
    block: Vec<u8>,
    sums: Vec<u32>,
}

impl SectionWriter<'_> {
    /// Adds bytes.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn append(&mut self, mut bytes: &[u8]) -> Result<(), StoreError> {
        while !bytes.is_empty() {
            let (now, later) = bytes.split_at(bytes.len().min(BLOCK_BYTES - self.block.len()));
            self.block.extend_from_slice(now);
            bytes = later;
            if self.block.len() == BLOCK_BYTES {
                self.flush_block()?;
            }
        }
        Ok(())
    }

    /// Ends the section.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn finish(mut self) -> Result<Section, StoreError> {
        self.start_next()
    }

    /// Ends the section and starts the next.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn start_next(&mut self) -> Result<Section, StoreError> {
        if !self.block.is_empty() {
            self.flush_block()?;
        }
        let (offset_bytes, len_bytes) = (self.offset_bytes, self.len_bytes);
        self.file.end_bytes = offset_bytes + len_bytes;
        self.offset_bytes = self.file.end_bytes.next_multiple_of(ALIGN_BYTES);
        self.len_bytes = 0;
        Ok(Section { offset_bytes, len_bytes, sums: std::mem::take(&mut self.sums) })
    }

    fn flush_block(&mut self) -> Result<(), StoreError> {
        self.file.file.write_at(&self.block, self.offset_bytes + self.len_bytes)?;
        self.sums.push(crc32fast::hash(&self.block));
        self.len_bytes += self.block.len() as u64;
        self.block.clear();
        Ok(())
    }
}

impl Write for SectionWriter<'_> {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.append(buf).map_err(io::Error::other)?;
        Ok(buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A section whose parts come in any order.
#[derive(Debug)]
pub struct Scattered {
    offset_bytes: u64,
    len_bytes: u64,
    sums: Mutex<Sums>,
}

#[derive(Debug)]
struct Sums {
    /// CRC of each block that was written in one piece.
    whole: Vec<u32>,
    /// Parts of blocks: start in the section, length, CRC.
    pieces: Vec<(u64, u64, u32)>,
    n_written: u64,
}

impl Scattered {
    /// Notes the checksums of a part that was written.
    fn note(&self, bytes: &[u8], at_bytes: u64) {
        let mut found = Vec::new();
        let mut rest = bytes;
        let mut at = at_bytes;
        while !rest.is_empty() {
            let room = BLOCK_BYTES - (at % BLOCK_BYTES as u64) as usize;
            let (now, later) = rest.split_at(rest.len().min(room));
            found.push((at, now.len() as u64, crc32fast::hash(now)));
            at += now.len() as u64;
            rest = later;
        }
        let mut sums = self.sums.lock().unwrap_or_else(|e| e.into_inner());
        for piece in found {
            if piece.1 == BLOCK_BYTES as u64 {
                sums.whole[(piece.0 / BLOCK_BYTES as u64) as usize] = piece.2;
            } else {
                sums.pieces.push(piece);
            }
        }
        sums.n_written += bytes.len() as u64;
    }

    /// Ends the section: joins the checksums of blocks that came in pieces.
    pub fn finish(self) -> Section {
        let Sums { mut whole, mut pieces, n_written } =
            self.sums.into_inner().unwrap_or_else(|e| e.into_inner());
        assert_eq!(n_written, self.len_bytes, "every byte of a section is written once");
        pieces.sort_unstable();
        for block in pieces.chunk_by(|a, b| a.0 / BLOCK_BYTES as u64 == b.0 / BLOCK_BYTES as u64) {
            let mut joined = Hasher::new();
            for &(_, len, crc) in block {
                joined.combine(&Hasher::new_with_initial_len(crc, len));
            }
            whole[(block[0].0 / BLOCK_BYTES as u64) as usize] = joined.finalize();
        }
        Section { offset_bytes: self.offset_bytes, len_bytes: self.len_bytes, sums: whole }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_in_any_order_have_the_sums_of_the_whole() {
        let folder = tempfile::tempdir().unwrap();
        let bytes: Vec<u8> = (0..300_000u32).map(|i| (i.wrapping_mul(i) >> 7) as u8).collect();
        let mut file = SectionFile::create(&folder.path().join("f"), 100).unwrap();
        let whole = file.whole(&bytes).unwrap();
        assert_eq!(whole.offset_bytes, 128);
        let scattered = file.scattered(bytes.len() as u64);
        for part in bytes.chunks(7777).enumerate().collect::<Vec<_>>().into_iter().rev() {
            file.scatter(&scattered, part.1, part.0 as u64 * 7777).unwrap();
        }
        assert_eq!(scattered.finish().sums, whole.sums);
        let mut stream = file.stream();
        bytes.chunks(1234).for_each(|c| stream.append(c).unwrap());
        let streamed = stream.finish().unwrap();
        assert_eq!(streamed.sums, whole.sums);
        file.finish(&[1; 100], &[2; 3], streamed.offset_bytes + streamed.len_bytes).unwrap();
        let read = std::fs::read(folder.path().join("f")).unwrap();
        let at = streamed.offset_bytes as usize;
        assert_eq!(read[at..at + bytes.len()], bytes[..]);
        assert_eq!(read[100..128], [0; 28]);
    }
}
