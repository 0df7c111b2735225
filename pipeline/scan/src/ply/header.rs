//! The header of a PLY file: lines within limits, then what `ply-rs` makes of them.
//!
//! The crate's parser wants UTF-8, plain names and newlines, has no limits and keeps the last of
//! two properties of one name. So lines are read here, comments are left out, names are reduced
//! to letters, digits and underscores, and duplicates are refused; the crate reads the rest.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{DefaultElement, PropertyType, ScalarType};
use pvmap_store::InputFile;

use crate::bytes::Window;
use crate::error::{ScanError, escaped};

/// Limits that no sane file comes near (F64).
pub(crate) const LINE_BYTES: u64 = 64 << 10;
const HEADER_BYTES: u64 = 1 << 20;
const MAX_NAMES: usize = 4096;

/// How the body is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encoding {
    /// A line of numbers a row.
    Ascii,
    /// Packed, least byte first.
    Little,
    /// Packed, greatest byte first.
    Big,
}

/// The type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// A column of an element.
#[derive(Debug, Clone)]
pub(crate) struct Property {
    pub(crate) name: String,
    pub(crate) kind: PropertyKind,
}

/// One number a row, or a list of them behind its length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PropertyKind {
    Scalar(Scalar),
    List(Scalar, Scalar),
}

/// A table of the body.
#[derive(Debug, Clone)]
pub(crate) struct Element {
    pub(crate) name: String,
    pub(crate) count: u64,
    pub(crate) properties: Vec<Property>,
}

/// A checked header.
#[derive(Debug, Clone)]
pub(crate) struct Header {
    pub(crate) encoding: Encoding,
    pub(crate) elements: Vec<Element>,
    /// Where the body begins.
    pub(crate) body_offset: u64,
    /// The number of its first line, from 1.
    pub(crate) body_line: u64,
    /// What ends a line: a newline, or a carriage return in files that have nothing else.
    pub(crate) newline: u8,
}

impl Scalar {
    /// Gives the bytes of a number.
    pub(crate) fn n_bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Says whether it is a whole number.
    pub(crate) fn is_whole(self) -> bool {
        !matches!(self, Scalar::F32 | Scalar::F64)
    }

    fn of(kind: &ScalarType) -> Scalar {
        match kind {
            ScalarType::Char => Scalar::I8,
            ScalarType::UChar => Scalar::U8,
            ScalarType::Short => Scalar::I16,
            ScalarType::UShort => Scalar::U16,
            ScalarType::Int => Scalar::I32,
            ScalarType::UInt => Scalar::U32,
            ScalarType::Float => Scalar::F32,
            ScalarType::Double => Scalar::F64,
        }
    }
}

impl Element {
    /// Gives the bytes of a binary row, or none where lists make rows differ.
    pub(crate) fn row_bytes(&self) -> Option<usize> {
        self.properties.iter().try_fold(0, |sum, p| match p.kind {
            PropertyKind::Scalar(kind) => Some(sum + kind.n_bytes()),
            PropertyKind::List(..) => None,
        })
    }

    /// Gives the least bytes that a row can take.
    pub(crate) fn least_bytes(&self, encoding: Encoding) -> u64 {
        let of = |p: &Property| match (encoding, p.kind) {
            // A digit and a blank.
            (Encoding::Ascii, _) => 2,
            (_, PropertyKind::Scalar(kind) | PropertyKind::List(kind, _)) => kind.n_bytes() as u64,
        };
        self.properties.iter().map(of).sum()
    }
}

impl Header {
    /// Reads and checks the header.
    pub(crate) fn read(file: &InputFile) -> Result<Header, ScanError> {
        let lines = Lines::read(file)?;
        let path = file.path();
        let broken = |problem: String| ScanError::header(path, "PLY header", problem);
        let mut reader = Reader::new(lines.text.as_bytes());
        let parsed = Parser::<DefaultElement>::new().read_header(&mut reader).map_err(|e| {
            // The parser counts the lines it was given, from 1; comments were left out.
            match e.line().and_then(|l| lines.numbers.get(l.saturating_sub(1))) {
                Some(&number) => ScanError::line(path, number, lines.describe(number)),
                None => broken(e.to_string().lines().next().unwrap_or_default().to_owned()),
            }
        })?;
        if parsed.version.major != 1 {
            return Err(broken(format!("version {:?}, expected 1.0", parsed.version)));
        }
        let elements = parsed.elements.into_iter().map(|(name, element)| Element {
            name,
            count: element.count as u64,
            properties: element.properties.into_iter().map(property).collect(),
        });
        let elements: Vec<Element> = elements.collect();
        for element in &elements {
            for p in &element.properties {
                if matches!(p.kind, PropertyKind::List(index, _) if !index.is_whole()) {
                    let (e, p) = (&element.name, &p.name);
                    return Err(broken(format!("list {p} of {e} is counted in fractions")));
                }
            }
        }
        Ok(Header {
            encoding: match parsed.encoding {
                ply_rs::ply::Encoding::Ascii => Encoding::Ascii,
                ply_rs::ply::Encoding::BinaryLittleEndian => Encoding::Little,
                ply_rs::ply::Encoding::BinaryBigEndian => Encoding::Big,
            },
            elements,
            body_offset: lines.n_bytes,
            body_line: lines.n_lines + 1,
            newline: lines.newline,
        })
    }
}

fn property((name, def): (String, ply_rs::ply::PropertyDef)) -> Property {
    let kind = match &def.data_type {
        PropertyType::Scalar(kind) => PropertyKind::Scalar(Scalar::of(kind)),
        PropertyType::List(index, kind) => PropertyKind::List(Scalar::of(index), Scalar::of(kind)),
    };
    Property { name, kind }
}

/// The lines of a header that mean something, made plain.
struct Lines {
    text: String,
    /// The number in the file of each line of `text`.
    numbers: Vec<u64>,
    n_bytes: u64,
    n_lines: u64,
    newline: u8,
}

impl Lines {
    fn read(file: &InputFile) -> Result<Lines, ScanError> {
        let mut reader = BufReader::new(Window::new(file, 0, HEADER_BYTES));
        let mut lines = Lines {
            text: String::new(),
            numbers: Vec::new(),
            n_bytes: 0,
            n_lines: 0,
            newline: newline(&mut reader).map_err(|e| lost(file.path(), &e))?,
        };
        let mut names = Names::default();
        let mut line = Vec::new();
        loop {
            let n = read_line(&mut reader, lines.newline, &mut line)
                .map_err(|problem| ScanError::line(file.path(), lines.n_lines + 1, problem))?;
            if n == 0 {
                let problem = format!("no end_header within {} bytes", lines.n_bytes);
                return Err(ScanError::header(file.path(), "PLY header", problem));
            }
            lines.n_bytes += n;
            lines.n_lines += 1;
            let words: Vec<&[u8]> =
                line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty()).collect();
            if matches!(words.first(), Some(&b"comment") | Some(&b"obj_info")) {
                continue;
            }
            let plain = names
                .plain(&words)
                .map_err(|problem| ScanError::line(file.path(), lines.n_lines, problem))?;
            lines.text.push_str(&plain);
            lines.text.push('\n');
            lines.numbers.push(lines.n_lines);
            if plain == "end_header" {
                return Ok(lines);
            }
        }
    }

    /// Says that a line of the file means nothing.
    fn describe(&self, number: u64) -> String {
        let i = self.numbers.iter().position(|&n| n == number).unwrap_or_default();
        let line = self.text.lines().nth(i).unwrap_or_default();
        format!("\"{}\" has no meaning in a PLY header", escaped(line.as_bytes(), 60))
    }
}

/// The names met so far, to refuse duplicates.
#[derive(Default)]
struct Names {
    elements: Vec<String>,
    properties: Vec<String>,
}

impl Names {
    /// Joins the words of a line, its name reduced to what every parser reads.
    fn plain(&mut self, words: &[&[u8]]) -> Result<String, String> {
        let mut words: Vec<String> =
            words.iter().map(|w| String::from_utf8_lossy(w).into_owned()).collect();
        let taken = match words.first().map(String::as_str) {
            Some("element") if words.len() == 3 => {
                self.properties.clear();
                words[1] = plain_name(&words[1]);
                Some((&mut self.elements, words[1].clone()))
            }
            Some("property") if words.len() > 2 => {
                let last = words.len() - 1;
                words[last] = plain_name(&words[last]);
                Some((&mut self.properties, words[last].clone()))
            }
            _ => None,
        };
        if let Some((names, name)) = taken {
            if names.contains(&name) {
                return Err(format!(
                    "a second {} named {}",
                    words[0],
                    escaped(name.as_bytes(), 60)
                ));
            }
            if names.len() == MAX_NAMES {
                return Err(format!("more than {MAX_NAMES} of {}", words[0]));
            }
            names.push(name);
        }
        Ok(words.join(" "))
    }
}

/// Reduces a name to letters, digits and underscores ("Dip (°)" is a name some programs write).
fn plain_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// Finds out what ends the first line, "ply", without taking it.
fn newline(reader: &mut impl BufRead) -> std::io::Result<u8> {
    let start = reader.fill_buf()?;
    let end = start.iter().position(|b| matches!(b, b'\r' | b'\n')).unwrap_or_default();
    let is_cr_only = start.get(end) == Some(&b'\r') && start.get(end + 1) != Some(&b'\n');
    Ok(if is_cr_only { b'\r' } else { b'\n' })
}

/// Reads a line with its end; gives its bytes, 0 at the end of the stream.
pub(crate) fn read_line(
    reader: &mut impl BufRead,
    newline: u8,
    line: &mut Vec<u8>,
) -> Result<u64, String> {
    line.clear();
    let n = reader
        .take(LINE_BYTES + 1)
        .read_until(newline, line)
        .map_err(|e| format!("cannot be read: {e}"))? as u64;
    if n > LINE_BYTES { Err(format!("longer than {LINE_BYTES} bytes")) } else { Ok(n) }
}

/// Names a failure of the disk while text is read.
fn lost(path: &Path, source: &std::io::Error) -> ScanError {
    ScanError::header(path, "PLY header", format!("cannot be read: {source}"))
}
