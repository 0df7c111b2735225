//! Rows of a PLY body, whatever their form, as packed rows of scalars.

use std::io::{BufReader, Read};

use pvmap_store::InputFile;

use super::header::{Element, Encoding, Header, PropertyKind, Scalar, read_line};
use super::vertex::{VertexLayout, whole};
use crate::bytes::Window;
use crate::error::{ScanError, escaped};

/// Rows of a list-bearing binary element, one after the other.
#[derive(Debug)]
pub(crate) struct ListedRows<'a> {
    file: &'a InputFile,
    input: BufReader<Window<'a>>,
    at: u64,
    is_big: bool,
}

impl<'a> ListedRows<'a> {
    /// Starts at a row.
    pub(crate) fn new(file: &'a InputFile, at: u64, encoding: Encoding) -> ListedRows<'a> {
        let input = BufReader::new(Window::new(file, at, file.len_bytes()));
        ListedRows { file, input, at, is_big: encoding == Encoding::Big }
    }

    /// Gives where the next row begins.
    pub(crate) fn offset(&self) -> u64 {
        self.at
    }

    /// Reads row `record` of `element` and appends its scalars to `packed`.
    pub(crate) fn read(
        &mut self,
        element: &Element,
        record: u64,
        packed: &mut Vec<u8>,
    ) -> Result<(), ScanError> {
        let end = self.file.len_bytes();
        for p in &element.properties {
            let problem = match p.kind {
                PropertyKind::Scalar(kind) => {
                    let mut bytes = [0; 8];
                    self.take(&mut bytes[..kind.n_bytes()])
                        .map(|()| packed.extend_from_slice(&bytes[..kind.n_bytes()]))
                }
                PropertyKind::List(index, kind) => self.skip_list(index, kind),
            };
            problem.map_err(|problem| {
                let what =
                    format!("{} of {}: {problem} (the file has {end})", p.name, element.name);
                ScanError::record(self.file.path(), record, what)
            })?;
        }
        Ok(())
    }

    fn take(&mut self, bytes: &mut [u8]) -> Result<(), String> {
        self.input.read_exact(bytes).map_err(|e| format!("byte {}: {e}", self.at))?;
        self.at += bytes.len() as u64;
        Ok(())
    }

    /// Steps over a list, whose length must lie within the file (F63).
    fn skip_list(&mut self, index: Scalar, kind: Scalar) -> Result<(), String> {
        let mut bytes = [0; 8];
        self.take(&mut bytes[..index.n_bytes()])?;
        let n = whole(&bytes, index, self.is_big);
        let left = self.file.len_bytes() - self.at;
        // A length is at most 2^32, a number 8 bytes: no overflow.
        let n_bytes = u64::try_from(n).ok().map(|n| n * kind.n_bytes() as u64);
        match n_bytes.filter(|&b| b <= left) {
            Some(n_bytes) => {
                self.input.seek_relative(n_bytes as i64).map_err(|e| e.to_string())?;
                self.at += n_bytes;
                Ok(())
            }
            None => Err(format!("byte {}: a list of length {n}", self.at)),
        }
    }
}

/// Rows of a text body, a line each.
#[derive(Debug)]
pub(crate) struct TextRows<'a> {
    file: &'a InputFile,
    input: BufReader<Window<'a>>,
    line: Vec<u8>,
    /// The number of `line`, from 1.
    number: u64,
    newline: u8,
    at: u64,
}

impl<'a> TextRows<'a> {
    /// Starts at a line: the body's first, or the one that [`TextRows::place`] gave.
    pub(crate) fn new(file: &'a InputFile, header: &Header, (at, line): (u64, u64)) -> Self {
        let input = BufReader::new(Window::new(file, at, file.len_bytes()));
        let newline = header.newline;
        TextRows { file, input, line: Vec::new(), number: line - 1, newline, at }
    }

    /// Gives where the next line begins, and its number.
    pub(crate) fn place(&self) -> (u64, u64) {
        (self.at, self.number + 1)
    }

    /// Gives the line that was read last, with its end.
    pub(crate) fn line(&self) -> &[u8] {
        &self.line
    }

    /// Goes to the next line that is not blank.
    pub(crate) fn advance(&mut self, wanted: &str) -> Result<(), ScanError> {
        loop {
            self.number += 1;
            let n = read_line(&mut self.input, self.newline, &mut self.line)
                .map_err(|problem| ScanError::line(self.file.path(), self.number, problem))?;
            self.at += n;
            if n == 0 {
                let problem = format!("the file ends, expected {wanted}");
                return Err(ScanError::line(self.file.path(), self.number, problem));
            }
            if !self.line.trim_ascii().is_empty() {
                return Ok(());
            }
        }
    }

    /// Reads row `record` of the vertices and appends its scalars to `packed`, least byte first.
    pub(crate) fn read(
        &mut self,
        vertex: &Element,
        layout: &VertexLayout,
        record: u64,
        packed: &mut Vec<u8>,
    ) -> Result<(), ScanError> {
        self.advance(&format!("vertex {} of {}", record + 1, vertex.count))?;
        let start = packed.len();
        packed.resize(start + layout.row_bytes, 0);
        let row = &mut packed[start..];
        parse_row(&self.line, vertex, |i| layout.wanted[i], row).map_err(|problem| {
            packed.truncate(start);
            ScanError::line(self.file.path(), self.number, problem)
        })
    }

    /// Steps over row `record` of an element of which nothing is wanted, but that its lists and
    /// columns are what the header says (F63).
    pub(crate) fn skip(&mut self, element: &Element, record: u64) -> Result<(), ScanError> {
        self.advance(&format!("{} {} of {}", element.name, record + 1, element.count))?;
        parse_row(&self.line, element, |_| None, &mut [])
            .map_err(|problem| ScanError::line(self.file.path(), self.number, problem))
    }
}

/// Parses the wanted numbers of a row of text into a packed row: `wanted` says for each property
/// where its number goes.
fn parse_row(
    line: &[u8],
    element: &Element,
    wanted: impl Fn(usize) -> Option<usize>,
    packed: &mut [u8],
) -> Result<(), String> {
    let n_expected = element.properties.len();
    let mut words = line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
    for (i, p) in element.properties.iter().enumerate() {
        let too_few = || format!("{i} columns, expected {n_expected} ({} is missing)", p.name);
        let word = words.next().ok_or_else(too_few)?;
        match (p.kind, wanted(i)) {
            (PropertyKind::Scalar(kind), Some(at)) => {
                parse_number(word, kind, &mut packed[at..]).ok_or_else(|| {
                    format!("{} is \"{}\", expected a number", p.name, escaped(word, 40))
                })?;
            }
            (PropertyKind::Scalar(_), None) => {}
            (PropertyKind::List(..), _) => {
                let n: Option<u32> = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
                let n = n.ok_or_else(|| {
                    format!("{} is a list of length \"{}\"", p.name, escaped(word, 40))
                })?;
                // A line is at most 64 KiB, so the walk is short whatever the length says.
                for _ in 0..n {
                    words.next().ok_or_else(too_few)?;
                }
            }
        }
    }
    match words.count() {
        0 => Ok(()),
        n => Err(format!("{n} columns too many, expected {n_expected}")),
    }
}

/// Parses a number of the given type into its bytes, least first.
fn parse_number(word: &[u8], kind: Scalar, out: &mut [u8]) -> Option<()> {
    let text = std::str::from_utf8(word).ok()?;
    let n = kind.n_bytes();
    match kind {
        Scalar::F32 => {
            let value = text.parse().ok().or_else(|| is_nan(text).then_some(f32::NAN))?;
            out[..n].copy_from_slice(&value.to_le_bytes());
        }
        Scalar::F64 => {
            let value = text.parse().ok().or_else(|| is_nan(text).then_some(f64::NAN))?;
            out[..n].copy_from_slice(&value.to_le_bytes());
        }
        _ => {
            let whole = || text.parse::<f64>().ok().filter(|v| v.fract() == 0.0).map(|v| v as i64);
            let value: i64 = text.parse().ok().or_else(whole)?;
            let (low, high) = match kind {
                Scalar::I8 => (-128, 127),
                Scalar::U8 => (0, 255),
                Scalar::I16 => (-32768, 32767),
                Scalar::U16 => (0, 65535),
                Scalar::I32 => (i64::from(i32::MIN), i64::from(i32::MAX)),
                _ => (0, i64::from(u32::MAX)),
            };
            if !(low..=high).contains(&value) {
                return None;
            }
            out[..n].copy_from_slice(&value.to_le_bytes()[..n]);
        }
    }
    Some(())
}

/// Says whether a word is one of the ways C libraries spell "not a number" or "infinite" that Rust
/// does not read; as a coordinate both are invalid alike.
fn is_nan(text: &str) -> bool {
    let bare = text.trim_start_matches(['-', '+']).to_ascii_lowercase();
    bare.starts_with("nan(") || bare.starts_with("1.#") || bare == "snan"
}
