//! Rows of a table that may be as long as it likes, but not a row of it.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use csv::{ByteRecord, StringRecord};
use pvmap_store::{InputFile, StoreError};

use crate::Error;

/// The longest a row may be: twelve numbers take 300 bytes, the rest is for columns of others.
const MAX_ROW_BYTES: u64 = 1 << 16;

/// Bytes read at a time.
const BUFFER_BYTES: usize = 1 << 16;

/// The rows of a CSV file or of standard input, with the header row read. A row may have any number
/// of columns.
pub struct Rows {
    reader: csv::Reader<Guard<Box<dyn Read + Send>>>,
    header: StringRecord,
    path: PathBuf,
    /// How long the file is, where it is one.
    len_bytes: Option<u64>,
    /// The row read last.
    row: ByteRecord,
    /// The line on which it begins.
    line: u64,
}

/// Some rows as they stand in the table, cell behind cell.
#[derive(Debug, Default)]
pub struct RowBlock {
    text: Vec<u8>,
    /// Where each cell ends.
    cell_ends: Vec<u32>,
    /// How many cells there are up to the end of each row.
    row_ends: Vec<u32>,
}

/// A row of a block.
#[derive(Debug, Clone, Copy)]
pub struct Row<'b> {
    block: &'b RowBlock,
    first_cell: u32,
    end_cell: u32,
}

impl RowBlock {
    fn push(&mut self, row: &ByteRecord) {
        let start = self.text.len() as u32;
        self.text.extend_from_slice(row.as_slice());
        let mut end = start;
        self.cell_ends.extend(row.iter().map(|cell| {
            end += cell.len() as u32;
            end
        }));
        self.row_ends.push(self.cell_ends.len() as u32);
    }

    /// Counts the rows.
    pub fn len(&self) -> usize {
        self.row_ends.len()
    }

    /// Says whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.row_ends.is_empty()
    }

    /// Gives a row.
    pub fn row(&self, i: usize) -> Row<'_> {
        let end_of = |i: usize| self.row_ends[i];
        let first_cell = i.checked_sub(1).map_or(0, end_of);
        Row { block: self, first_cell, end_cell: end_of(i) }
    }

    /// Counts the bytes it takes.
    fn held_bytes(&self) -> usize {
        self.text.len() + 4 * (self.cell_ends.len() + self.row_ends.len())
    }
}

impl<'b> Row<'b> {
    /// Gives a cell with its blanks; none where the row has fewer.
    pub fn get(&self, i: usize) -> Option<&'b [u8]> {
        let cell = u32::try_from(i).ok().and_then(|i| self.first_cell.checked_add(i));
        let cell = cell.filter(|&cell| cell < self.end_cell)? as usize;
        let ends = &self.block.cell_ends;
        let start = cell.checked_sub(1).map_or(0, |before| ends[before]);
        Some(&self.block.text[start as usize..ends[cell] as usize])
    }
}

impl std::fmt::Debug for Rows {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Rows").field("path", &self.path).field("line", &self.line).finish()
    }
}

impl Rows {
    /// Opens a file, or standard input for `-`, and reads the header row.
    ///
    /// # Errors
    /// Where it cannot be opened or the header row cannot be read.
    pub fn open(path: &Path) -> Result<Rows, Error> {
        if path.as_os_str() == "-" {
            return Rows::of(Box::new(io::stdin()), Path::new("standard input"));
        }
        if path.is_dir() {
            return Err(StoreError::NotAFile { path: path.to_path_buf() }.into());
        }
        let file = File::open(path).map_err(|e| StoreError::io(path, "open", e))?;
        let len_bytes = file.metadata().ok().filter(|found| found.is_file()).map(|f| f.len());
        Ok(Rows { len_bytes, ..Rows::of(Box::new(file), path)? })
    }

    /// Opens a file, whatever its name, and reads the header row.
    ///
    /// # Errors
    /// Where it is no file or cannot be opened, or the header row cannot be read.
    pub fn of_file(path: &Path) -> Result<Rows, Error> {
        Rows::of(Box::new(InputFile::open(path)?), path)
    }

    /// Does the same, and skips lines that begin with `#`.
    ///
    /// # Errors
    /// Those of [`Rows::of_file`].
    pub fn of_commented_file(path: &Path) -> Result<Rows, Error> {
        Rows::with(Box::new(InputFile::open(path)?), path, Some(b'#'))
    }

    fn of(input: Box<dyn Read + Send>, path: &Path) -> Result<Rows, Error> {
        Rows::with(input, path, None)
    }

    fn with(input: Box<dyn Read + Send>, path: &Path, comment: Option<u8>) -> Result<Rows, Error> {
        let guard = Guard {
            input,
            comment,
            is_comment: false,
            n_given: 0,
            given: Vec::new(),
            is_waiting: false,
            row_start: 0,
            is_ahead: true,
            n_ends: 0,
        };
        let reader = csv::ReaderBuilder::new()
            .flexible(true)
            .has_headers(false)
            .comment(comment)
            .buffer_capacity(BUFFER_BYTES)
            .from_reader(guard);
        let (header, row) = (StringRecord::new(), ByteRecord::new());
        let (path, len_bytes) = (path.to_path_buf(), None);
        let mut rows = Rows { reader, header, path, len_bytes, row, line: 1 };
        rows.header = rows.read()?.unwrap_or_default();
        rows.header.trim();
        Ok(rows)
    }

    /// Gives what the rows are called in messages.
    pub fn name(&self) -> &Path {
        &self.path
    }

    /// Says how long the file is; none of what is no file.
    pub fn len_bytes(&self) -> Option<u64> {
        self.len_bytes
    }

    /// Counts the bytes of the rows read so far.
    pub fn n_bytes_read(&self) -> u64 {
        self.reader.position().byte()
    }

    /// Gives the header row; it is empty where there is none.
    pub fn header(&self) -> &StringRecord {
        &self.header
    }

    /// Gives the line on which the row read last begins, the first is 1.
    pub fn line(&self) -> u64 {
        self.line
    }

    /// Reads the next row, cells as they stand, with their blanks; none at the end.
    ///
    /// # Errors
    /// Where the row is too long or no text, or the disk fails; the error names its line.
    pub fn read(&mut self) -> Result<Option<StringRecord>, Error> {
        if !self.advance()? {
            return Ok(None);
        }
        let text = StringRecord::from_byte_record(self.row.clone());
        text.map(Some).map_err(|e| {
            let column = e.utf8_error().field() + 1;
            self.at_line(&format!("column {column}: this is not UTF-8 text"))
        })
    }

    /// Reads rows until they are so many, take so many bytes or the next is not there yet; says
    /// whether the table goes on.
    ///
    /// # Errors
    /// Where a row is too long or the disk fails; the error names its line. The rows before it are
    /// in the block.
    pub fn read_block(
        &mut self,
        n_rows: usize,
        n_bytes: usize,
        block: &mut RowBlock,
    ) -> Result<bool, Error> {
        while block.len() < n_rows && block.held_bytes() < n_bytes {
            if !self.advance()? {
                return Ok(false);
            }
            block.push(&self.row);
            let guard = self.reader.get_ref();
            if guard.is_waiting && self.reader.position().byte() == guard.n_given {
                break;
            }
        }
        Ok(true)
    }

    /// Goes to the next row; says whether there is one.
    fn advance(&mut self) -> Result<bool, Error> {
        let (start, line) = (self.reader.position().byte(), self.reader.position().line());
        self.reader.get_mut().begin_row(start);
        let read = self.reader.read_byte_record(&mut self.row);
        self.line = line + self.reader.get_ref().n_ends;
        let is_row = read.map_err(|e| match e.into_kind() {
            csv::ErrorKind::Io(e) if e.get_ref().is_some_and(|e| e.is::<RowTooLong>()) => {
                self.too_long()
            }
            csv::ErrorKind::Io(e) => StoreError::io(&self.path, "read", e).into(),
            // Rows of any length are taken and none is deserialised or sought.
            other => self.at_line(&format!("{other:?}")),
        })?;
        if self.reader.position().byte() - self.reader.get_ref().row_start > MAX_ROW_BYTES {
            return Err(self.too_long());
        }
        // Of a comment that the file ends in, without a line end, the parser makes an empty row.
        Ok(is_row && !self.reader.get_ref().is_comment)
    }

    fn too_long(&self) -> Error {
        self.at_line(&format!(
            "a row of more than {MAX_ROW_BYTES} bytes; give one pair a line and close every quote"
        ))
    }

    fn at_line(&self, what: &str) -> Error {
        Error::Data(format!("{}: line {}: {what}", self.path.display(), self.line))
    }
}

/// Hands on bytes until a row takes too many: `csv` would hold them all.
///
/// The parser asks for more when it has worked through what it was given. So by then the row at
/// hand is known to be as long as what was given beyond its start.
struct Guard<R> {
    input: R,
    /// What lines begin with that are no rows.
    comment: Option<u8>,
    /// Whether such a line was begun.
    is_comment: bool,
    n_given: u64,
    /// The bytes given last.
    given: Vec<u8>,
    /// Whether those were fewer than asked for: whoever writes the rows may wait for answers.
    is_waiting: bool,
    /// Where the row at hand begins.
    row_start: u64,
    /// Whether only line ends and comments came since the row before.
    is_ahead: bool,
    /// Line ends in front of the row at hand.
    n_ends: u64,
}

impl<R> Guard<R> {
    /// Notes where the row before ended.
    fn begin_row(&mut self, start: u64) {
        (self.row_start, self.is_ahead, self.n_ends) = (start, true, 0);
        self.is_comment = false;
        let n_ahead = (self.n_given - start).min(self.given.len() as u64) as usize;
        let given = std::mem::take(&mut self.given);
        self.skip_ends(&given[given.len() - n_ahead..]);
        self.given = given;
    }

    /// Skips the line ends in front of a row: the second half of the row's before, blank lines, and
    /// comments with theirs.
    fn skip_ends(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.is_comment |= self.is_ahead && Some(byte) == self.comment;
            self.is_ahead &= self.is_comment || [b'\r', b'\n'].contains(&byte);
            self.is_comment &= byte != b'\n';
            if !self.is_ahead {
                break;
            }
            self.row_start += 1;
            self.n_ends += u64::from(byte == b'\n');
        }
    }
}

impl<R: Read> Read for Guard<R> {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        if self.n_given - self.row_start > MAX_ROW_BYTES {
            return Err(io::Error::other(RowTooLong));
        }
        let n = self.input.read(buf)?;
        self.n_given += n as u64;
        self.is_waiting = n < buf.len();
        self.skip_ends(&buf[..n]);
        self.given.clear();
        self.given.extend_from_slice(&buf[..n]);
        Ok(n)
    }
}

#[derive(Debug, thiserror::Error)]
#[error("a row is too long")]
struct RowTooLong;

#[cfg(test)]
mod tests {
    use super::*;

    /// Gives a text in pieces of `step` bytes.
    fn pieces(text: &str, step: usize) -> Box<dyn Read + Send> {
        struct Pieces(io::Cursor<Vec<u8>>, usize);
        impl Read for Pieces {
            fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
                let n = buf.len().min(self.1);
                self.0.read(&mut buf[..n])
            }
        }
        Box::new(Pieces(io::Cursor::new(text.as_bytes().to_vec()), step))
    }

    /// Reads all rows of a text that comes in pieces of `step` bytes: their number, or the error.
    fn read(text: &str, step: usize) -> Result<usize, String> {
        let path = Path::new("rows.csv");
        let mut rows = Rows::of(pieces(text, step), path).map_err(|e| e.to_string())?;
        let mut n = 0;
        while rows.read().map_err(|e| e.to_string())?.is_some() {
            n += 1;
        }
        Ok(n)
    }

    fn row_of(len: usize) -> String {
        "1".repeat(len)
    }

    #[test]
    fn a_row_is_as_long_as_the_limit_or_refused_however_it_comes() {
        for step in [1, 5, 6, 1000, 4096, usize::MAX] {
            for (len, is_fine) in
                [(65_500, true), (65_535, true), (65_536, false), (200_000, false)]
            {
                let found = read(&format!("a,b\n1,2\n{}\n3,4\n", row_of(len)), step);
                match is_fine {
                    true => assert_eq!(found, Ok(3), "{len}"),
                    false => assert!(found.unwrap_err().starts_with("rows.csv: line 3: a row of")),
                }
            }
            // An open quote makes the rest of the file one row.
            let open = format!("a,b\n1,\"2\n{}", "3,4\n".repeat(1 << 20));
            assert!(read(&open, step).unwrap_err().starts_with("rows.csv: line 2: a row of"));
            for nl in ["\n", "\r\n", "\n\n", "\r\n\r\n"] {
                let text = ["a,b", "1,2", &row_of(70_000)].join(nl);
                let line = 1 + 2 * nl.matches('\n').count();
                let found = read(&text, step).unwrap_err();
                assert!(found.starts_with(&format!("rows.csv: line {line}: ")), "{nl:?}: {found}");
            }
            // Nor are many that are blank, before or behind.
            let blank = "\n".repeat(70_000);
            let text = format!("{blank}a,b\n{blank}1,2{blank}{}", row_of(70_000));
            assert!(read(&text, step).unwrap_err().starts_with("rows.csv: line 210002: "));
            assert_eq!(read(&format!("a,b\n1,2\n{blank}"), step), Ok(1));
            // Many short ones are no long one.
            assert_eq!(read(&format!("a,b\n{}", "3,4\n".repeat(1 << 18)), step), Ok(1 << 18));
        }
    }

    #[test]
    fn comments_are_no_rows_and_their_lines_count() {
        let text = "# a\n\n# b \"\na,b\r\n# c\r\n1,2\n#\n\n3,#4\n# d";
        for step in [1, 2, 3, 7, usize::MAX] {
            let mut rows =
                Rows::with(pieces(text, step), Path::new("rows.csv"), Some(b'#')).unwrap();
            assert_eq!((rows.header().as_slice(), rows.line()), ("ab", 4), "{step}");
            let mut found = Vec::new();
            while let Some(row) = rows.read().unwrap() {
                found.push((row.as_slice().to_owned(), rows.line()));
            }
            assert_eq!(found, [("12".to_owned(), 6), ("3#4".to_owned(), 9)], "{step}");
        }
        // Many of them are no long row.
        let text = format!("a,b\n{}1,2\n", "# of no use\n".repeat(10_000));
        let mut rows = Rows::with(pieces(&text, 4096), Path::new("r"), Some(b'#')).unwrap();
        assert!(rows.read().unwrap().is_some() && rows.line() == 10_002);
    }

    #[test]
    fn a_block_takes_no_more_than_it_may_whatever_its_rows_are() {
        // Cells without a letter take bytes, too.
        let text = format!("a,b\n{}", format!("{}\n", ",".repeat(1000)).repeat(500));
        let input = Box::new(io::Cursor::new(text.into_bytes()));
        let mut rows = Rows::of(input, Path::new("rows.csv")).unwrap();
        let (mut n_rows, mut n_blocks, mut goes_on) = (0, 0, true);
        while goes_on {
            let mut block = RowBlock::default();
            goes_on = rows.read_block(1 << 16, 100_000, &mut block).unwrap();
            assert!(block.held_bytes() < 100_000 + 4 * 1002, "{}", block.held_bytes());
            (n_rows, n_blocks) = (n_rows + block.len(), n_blocks + 1);
        }
        assert_eq!((n_rows, n_blocks >= 20), (500, true), "{n_blocks} blocks");
    }
}
