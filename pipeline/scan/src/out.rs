//! The file that a scan is written again to.

use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use pvmap_store::{AtomicFile, ClosedFile, InputFile, StoreError, Watch};

use crate::bytes::BLOCK_BYTES;
use crate::error::ScanError;

/// Bytes that are written to the disk at a time.
const BUFFER_BYTES: usize = 1 << 20;

/// A file that is being written, with a name for errors.
pub(crate) struct Out {
    file: BufWriter<AtomicFile>,
    path: PathBuf,
}

impl Out {
    /// Begins a file.
    pub(crate) fn new(file: AtomicFile) -> Out {
        let path = file.path().to_path_buf();
        Out { file: BufWriter::with_capacity(BUFFER_BYTES, file), path }
    }

    /// Gives the name that it will have.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Appends bytes.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> Result<(), ScanError> {
        self.file.write_all(bytes).map_err(|e| lost(&self.path, e))
    }

    /// Appends bytes of an input, as many as `watch` is told; it may end that at any block.
    pub(crate) fn copy(
        &mut self,
        input: &InputFile,
        range: Range<u64>,
        watch: &dyn Watch,
    ) -> Result<(), ScanError> {
        let n_bytes = range.end.saturating_sub(range.start);
        let mut block = vec![0; (BLOCK_BYTES as u64).min(n_bytes) as usize];
        let mut at = range.start;
        while at < range.end {
            watch.check()?;
            let n = (block.len() as u64).min(range.end - at);
            let bytes = &mut block[..n as usize];
            input.read_exact_at(bytes, at)?;
            self.put(bytes)?;
            at += n;
            watch.advance(n);
        }
        Ok(())
    }

    /// Appends bytes of an input as a stage of their own, if there are any.
    pub(crate) fn copy_all(
        &mut self,
        stage: &'static str,
        input: &InputFile,
        range: Range<u64>,
        watch: &dyn Watch,
    ) -> Result<(), ScanError> {
        if range.start < range.end {
            watch.stage(stage, Some(range.end - range.start), "bytes");
        }
        self.copy(input, range, watch)
    }

    /// Gives where the next byte goes.
    pub(crate) fn position(&mut self) -> Result<u64, ScanError> {
        self.file.stream_position().map_err(|e| lost(&self.path, e))
    }

    /// Goes behind the last byte; gives where that is.
    pub(crate) fn seek_end(&mut self) -> Result<u64, ScanError> {
        self.file.seek(SeekFrom::End(0)).map_err(|e| lost(&self.path, e))
    }

    /// Completes the file with other bytes at its start, which has yet to get its name.
    pub(crate) fn close(self, start: &[u8]) -> Result<ClosedFile, ScanError> {
        let path = self.path;
        let file = self.file.into_inner().map_err(|e| lost(&path, e.into_error()))?;
        file.write_at(start, 0)?;
        Ok(file.close()?)
    }
}

/// Names a failure to write.
pub(crate) fn lost(path: &Path, e: io::Error) -> ScanError {
    StoreError::io(path, "write", e).into()
}

/// Says why something cannot be written.
pub(crate) fn refused(path: &Path, problem: impl Into<String>) -> ScanError {
    ScanError::Write { path: path.to_path_buf(), problem: problem.into() }
}

impl Write for Out {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.file.write(buf)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for Out {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}
