//! Tables of questions: rows in, a line an answer, in order.

use std::io::{IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;
use std::sync::mpsc::sync_channel;

use pvmap::rows::{Row, RowBlock, Rows};
use pvmap::{Error, Watch};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::Outcome;
pub(super) use crate::cli::columns::{Columns, Header, numbers, numbers_if_any};

/// Rows answered at once, and their bytes where rows are long.
const BLOCK_ROWS: usize = 1 << 16;
const BLOCK_BYTES: usize = 16 << 20;
/// Answers that a thread writes at a time.
const PIECE: usize = 1 << 10;

/// Why a row has no answer: because of the row, or because of the map.
pub(super) enum RowError {
    Row(String),
    Map(Error),
}

impl From<String> for RowError {
    fn from(what: String) -> RowError {
        RowError::Row(what)
    }
}

/// A question that is put by many rows.
pub(super) trait Batch: Sync {
    type Answer: Send + Sync;

    /// The columns of the answers, the last of them `error`.
    const HEADER: &'static str;

    /// Says how many rows are answered at once: fewer where an answer is long or takes long.
    fn block_rows(&self) -> usize {
        BLOCK_ROWS
    }

    /// Answers some rows, in order.
    fn answers(&self, rows: &RowBlock) -> Vec<Result<Self::Answer, RowError>>;

    /// Writes an answer as cells, with a comma behind each.
    fn write(&self, answer: &Self::Answer, out: &mut Vec<u8>) -> std::io::Result<()>;

    /// Gives an answer as an object.
    fn object(&self, answer: &Self::Answer) -> Value;
}

/// Opens a table and finds its columns.
pub(super) fn open<T>(
    path: &Path,
    find: impl FnOnce(&Header<'_>) -> Result<T, String>,
) -> Result<(Rows, T), Error> {
    let rows = Rows::open(path)?;
    let columns = find(&Header(rows.header()))
        .map_err(|what| Error::Data(format!("{}: {what}", rows.name().display())))?;
    Ok((rows, columns))
}

/// Answers a table. Some rows are read while those before them are answered, by a thread of their
/// own: one of the pool would, waiting for rows, leave answers unwritten.
pub(super) fn answer<B: Batch>(
    mut rows: Rows,
    batch: &B,
    as_lines: bool,
    watch: &dyn Watch,
) -> Outcome {
    let mut out = super::stdout();
    // Of rows that come from elsewhere nobody knows how many they are. On a terminal answers would
    // stand where the bar is.
    let tells = rows.len_bytes().is_some() && !std::io::stdout().is_terminal();
    let n_rows = batch.block_rows();
    if tells {
        watch.stage("table", rows.len_bytes(), "bytes");
    }
    let mut n_bytes_told = 0;
    if !as_lines {
        writeln!(out, "{}", B::HEADER)?;
    }
    std::thread::scope(|scope| {
        let (sender, blocks) = sync_channel(1);
        // A receiver that is gone has nobody to write answers to.
        scope.spawn(move || while sender.send(next_block(&mut rows, n_rows)).is_ok() {});
        for Block { rows: block, n_bytes_read, ended } in blocks {
            write_block(batch, &block, as_lines, &mut out)?;
            if tells {
                watch.advance(n_bytes_read - n_bytes_told);
                n_bytes_told = n_bytes_read;
            }
            // The rows before one that cannot be read have their answers.
            match ended {
                Some(ended) => {
                    out.flush()?;
                    return Ok(ended?);
                }
                // Whoever writes rows one by one waits for the answer of each.
                None if block.len() < n_rows || n_rows < BLOCK_ROWS => out.flush()?,
                None => {}
            }
        }
        Ok(ExitCode::SUCCESS)
    })
}

/// Some rows of a table.
struct Block {
    rows: RowBlock,
    /// The bytes of these and of all before.
    n_bytes_read: u64,
    /// How the table ended with them, if it did: well, or with a row that cannot be read.
    ended: Option<Result<ExitCode, Error>>,
}

/// Reads some rows; at the end of the table also how it ended.
fn next_block(rows: &mut Rows, n_rows: usize) -> Block {
    let mut block = RowBlock::default();
    let ended = match rows.read_block(n_rows, BLOCK_BYTES, &mut block) {
        Ok(true) => None,
        Ok(false) => Some(Ok(ExitCode::SUCCESS)),
        Err(e) => Some(Err(e)),
    };
    Block { rows: block, n_bytes_read: rows.n_bytes_read(), ended }
}

/// Lines of answers, and what is wrong with the map where they end early.
type Piece = (Vec<u8>, Option<Error>);

fn write_block<B: Batch>(
    batch: &B,
    rows: &RowBlock,
    as_lines: bool,
    out: &mut impl Write,
) -> anyhow::Result<()> {
    let mut answers = batch.answers(rows);
    let pieces = answers.par_chunks_mut(PIECE);
    let written: Vec<Piece> = pieces.map(|piece| write_piece(batch, piece, as_lines)).collect();
    for (bytes, failed) in written {
        out.write_all(&bytes)?;
        if let Some(e) = failed {
            out.flush()?;
            return Err(e.into());
        }
    }
    Ok(())
}

fn write_piece<B: Batch>(
    batch: &B,
    answers: &mut [Result<B::Answer, RowError>],
    as_lines: bool,
) -> Piece {
    let mut out = Vec::with_capacity(answers.len() * 64);
    for answer in answers {
        let wrote = match answer {
            Err(RowError::Map(e)) => {
                let e = std::mem::replace(e, Error::Data(String::new()));
                return (out, Some(e));
            }
            Ok(answer) if as_lines => writeln!(out, "{}", batch.object(answer)),
            Ok(answer) => batch.write(answer, &mut out).and_then(|()| writeln!(out)),
            Err(RowError::Row(what)) if as_lines => writeln!(out, "{}", json!({ "error": what })),
            Err(RowError::Row(what)) => {
                let empty = ",".repeat(B::HEADER.matches(',').count());
                writeln!(out, "{empty}\"{}\"", what.replace('"', "\"\""))
            }
        };
        // A vector takes all that fits into memory.
        debug_assert!(wrote.is_ok(), "{wrote:?}");
    }
    (out, None)
}

/// Answers each row by itself.
pub(super) fn each<A: Send>(
    rows: &RowBlock,
    answer: impl Fn(Row<'_>) -> Result<A, RowError> + Sync + Send,
) -> Vec<Result<A, RowError>> {
    (0..rows.len()).into_par_iter().map(|i| answer(rows.row(i))).collect()
}
