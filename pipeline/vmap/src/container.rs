//! The file around the sections: header, section table, block checksums. [F-2]…[F-5]

use std::sync::atomic::{AtomicU64, Ordering};

use xxhash_rust::xxh3::Xxh3;

use crate::bytes::{FieldReader, FieldWriter};
use crate::error::FormatError;

/// The first eight bytes of every artifact; a text-mode copy or a 7-bit channel breaks them.
pub const MAGIC: [u8; 8] = *b"\x89PVM\r\n\x1a\n";
/// Bytes of the header, and of each row of the section table; sections start at multiples.
pub const HEADER_BYTES: u64 = 64;
/// Bytes under one checksum.
pub const BLOCK_BYTES: u64 = 65_536;

const MAJOR: u16 = 1;
const MINOR: u16 = 0;
const OURS: &str = "1.0";
const SUMS: &str = "sums";
const MAX_SECTIONS: u32 = 32;
/// The section of rectangles, and the flag of `required` that a map has it. [F-22]
pub(crate) const RECTS: (&str, u64) = ("rects", 1);
/// The same of visible fractions. [F-24]
pub(crate) const FRACTIONS: (&str, u64) = ("fraction", 2);

/// Which artifact a file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A visibility map.
    Map,
    /// The sorted points of an octree.
    Octree,
    /// Light on the surfels of a map.
    Light,
}

impl Kind {
    /// Gives the first bytes of its files: [`MAGIC`] and a tag. [F-2]
    pub const fn start(self) -> &'static [u8; 12] {
        match self {
            Kind::Map => b"\x89PVM\r\n\x1a\nVMAP",
            Kind::Octree => b"\x89PVM\r\n\x1a\nOCTR",
            Kind::Light => b"\x89PVM\r\n\x1a\nLGHT",
        }
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Map => "a visibility map (.vmap)",
            Kind::Octree => "an octree",
            Kind::Light => "the light of a map (.light)",
        }
    }
}

/// A section as it was written: its place, its shape and the checksums of its blocks.
#[derive(Debug, Clone)]
pub struct Written {
    /// Name, at most eight ASCII bytes.
    pub name: &'static str,
    /// Place in the file, a multiple of 64.
    pub offset_bytes: u64,
    /// Length without padding.
    pub len_bytes: u64,
    /// Bytes of a record, 0 where records are not of one size.
    pub record_bytes: u32,
    /// CRC-32 of each block of 65 536 bytes.
    pub sums: Vec<u32>,
}

/// Header, table and `sums` of a finished file, with their places.
#[derive(Debug)]
pub struct Closing {
    /// Header and section table, for byte 0.
    pub head: Vec<u8>,
    /// The last section.
    pub sums: Vec<u8>,
    /// Where `sums` goes; the file ends with it.
    pub sums_offset_bytes: u64,
}

/// Gives the next multiple of 64.
pub fn align(offset_bytes: u64) -> u64 {
    offset_bytes.next_multiple_of(HEADER_BYTES)
}

/// Gives the length of header and table of a file with so many sections, `sums` not counted.
pub fn head_bytes(n_sections: usize) -> u64 {
    HEADER_BYTES * (n_sections as u64 + 2)
}

/// Makes what closes a file: header, table and `sums`, from its sections in file order.
pub fn close(kind: Kind, sections: &[Written]) -> Closing {
    let has = |name| sections.iter().any(|s| s.name == name);
    let flags = [RECTS, FRACTIONS].map(|(name, flag)| if has(name) { flag } else { 0 });
    let sums: Vec<u8> =
        sections.iter().flat_map(|s| &s.sums).flat_map(|c| c.to_le_bytes()).collect();
    let sums_offset_bytes =
        sections.last().map_or(head_bytes(0), |s| align(s.offset_bytes + s.len_bytes));
    let mut head = vec![0; head_bytes(sections.len()) as usize];
    let (header, table) = head.split_at_mut(HEADER_BYTES as usize);
    let mut first_block = 0;
    let mut row =
        |i: usize, name: &str, offset: u64, len: u64, record_bytes: u32, n_blocks: u64| {
            let at = i * HEADER_BYTES as usize;
            table[at..at + name.len()].copy_from_slice(name.as_bytes());
            let mut w = FieldWriter::new(&mut table[at + 8..at + 48]);
            w.u64(offset);
            w.u64(len);
            w.u64(if record_bytes == 0 { 0 } else { len / u64::from(record_bytes) });
            w.u32(record_bytes);
            w.u32(0);
            w.u64(first_block);
            first_block += n_blocks;
        };
    for (i, s) in sections.iter().enumerate() {
        row(i, s.name, s.offset_bytes, s.len_bytes, s.record_bytes, s.sums.len() as u64);
    }
    row(sections.len(), SUMS, sums_offset_bytes, sums.len() as u64, 4, 0);
    let mut w = FieldWriter::new(header);
    w.raw(kind.start());
    w.u16(MAJOR);
    w.u16(MINOR);
    w.u64(sums_offset_bytes + sums.len() as u64);
    w.u32(sections.len() as u32 + 1);
    w.u32(crc32fast::hash(table));
    let root = root_of(&header[..32], table, &sums);
    let mut w = FieldWriter::new(&mut header[32..]);
    w.u128(root);
    w.u64(flags.iter().sum());
    w.u32(crc32fast::hash(&sums));
    let crc = crc32fast::hash(&header[..60]);
    FieldWriter::new(&mut header[60..]).u32(crc);
    Closing { head, sums, sums_offset_bytes }
}

fn root_of(header_start: &[u8], table: &[u8], sums: &[u8]) -> u128 {
    let mut hash = Xxh3::new();
    hash.update(header_start);
    hash.update(table);
    hash.update(sums);
    hash.digest128()
}

/// A section of an open file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Section {
    /// Name.
    pub name: String,
    /// Place in the file.
    pub offset_bytes: u64,
    /// Length without padding.
    pub len_bytes: u64,
    /// Number of records, 0 where they are not of one size.
    pub n_records: u64,
    /// Bytes of a record, 0 where they are not of one size.
    pub record_bytes: u32,
    first_block: u64,
}

impl Section {
    fn n_blocks(&self) -> u64 {
        if self.name == SUMS { 0 } else { self.len_bytes.div_ceil(BLOCK_BYTES) }
    }

    /// Names a broken rule at a place in this section.
    pub fn broken(&self, at_bytes: u64, what: impl Into<String>) -> FormatError {
        FormatError::Broken {
            section: self.name.clone(),
            offset_bytes: self.offset_bytes.saturating_add(at_bytes),
            what: what.into(),
        }
    }
}

/// An open file: its header and table are checked, its blocks are checked when first touched.
#[derive(Debug)]
pub struct Container<'a> {
    bytes: &'a [u8],
    sections: Vec<Section>,
    minor: u16,
    required: u64,
    root: u128,
    sums_crc: u32,
    /// A bit a block that was found good; bit 0 of a further word says so of `sums`.
    checked: Vec<AtomicU64>,
    sums_checked: AtomicU64,
}

impl<'a> Container<'a> {
    /// Opens the bytes of a whole file by header and table alone.
    ///
    /// # Errors
    /// Where they are not those of a file of this kind, of a version that can be read, of the
    /// stated length, or header or table are damaged.
    pub fn open(bytes: &'a [u8], kind: Kind) -> Result<Container<'a>, FormatError> {
        let header = read_header(bytes, kind)?;
        let table_end = HEADER_BYTES as usize * (header.n_sections as usize + 1);
        let table = bytes
            .get(HEADER_BYTES as usize..table_end)
            .ok_or(FormatError::Length { expected: table_end as u64, found: bytes.len() as u64 })?;
        if crc32fast::hash(table) != header.table_crc {
            let section = "section table".to_owned();
            return Err(FormatError::Checksum { section, offset_bytes: HEADER_BYTES });
        }
        let sections = read_table(table, bytes.len() as u64)?;
        let n_blocks: u64 = sections.iter().map(Section::n_blocks).sum();
        let n_words = n_blocks.div_ceil(64) as usize;
        Ok(Container {
            bytes,
            sections,
            minor: header.minor,
            required: header.required,
            root: header.root,
            sums_crc: header.sums_crc,
            checked: (0..n_words).map(|_| AtomicU64::new(0)).collect(),
            sums_checked: AtomicU64::new(0),
        })
    }

    /// Gives the sections in file order.
    pub fn sections(&self) -> &[Section] {
        &self.sections
    }

    /// Gives the format version of the file.
    pub fn version(&self) -> (u16, u16) {
        (MAJOR, self.minor)
    }

    /// Gives the flags that a reader must know.
    pub(crate) fn required(&self) -> u64 {
        self.required
    }

    /// Gives the 16 bytes that name the whole content.
    pub fn root(&self) -> u128 {
        self.root
    }

    /// Finds a section.
    ///
    /// # Errors
    /// Where there is none of that name, or its records are of another size.
    pub fn section(&self, name: &str, record_bytes: u32) -> Result<&Section, FormatError> {
        let found = self.sections.iter().find(|s| s.name == name);
        let section = found.ok_or_else(|| FormatError::Broken {
            section: "section table".to_owned(),
            offset_bytes: HEADER_BYTES,
            what: format!("section {name} is missing"),
        })?;
        if section.record_bytes != record_bytes {
            let found = section.record_bytes;
            return Err(section.broken(0, format!("records of {found} bytes, not {record_bytes}")));
        }
        Ok(section)
    }

    /// Gives a range of a section's bytes, checking the blocks it touches for the first time.
    ///
    /// # Errors
    /// Where the range leaves the section or a block is damaged.
    #[inline]
    pub fn read(
        &self,
        section: &Section,
        at_bytes: u64,
        len_bytes: u64,
    ) -> Result<&'a [u8], FormatError> {
        let end = at_bytes.checked_add(len_bytes).filter(|&end| end <= section.len_bytes);
        let Some(end) = end else {
            return Err(section.broken(at_bytes, "points past the end of the section"));
        };
        if len_bytes > 0 {
            for block in at_bytes / BLOCK_BYTES..=(end - 1) / BLOCK_BYTES {
                self.check_block(section, block)?;
            }
        }
        let start = (section.offset_bytes + at_bytes) as usize;
        Ok(&self.bytes[start..start + len_bytes as usize])
    }

    /// Gives all bytes of a section, checked.
    ///
    /// # Errors
    /// Where a block is damaged.
    pub fn read_all(&self, section: &Section) -> Result<&'a [u8], FormatError> {
        self.read(section, 0, section.len_bytes)
    }

    #[inline]
    fn check_block(&self, section: &Section, block: u64) -> Result<(), FormatError> {
        let bit = section.first_block + block;
        let word = &self.checked[(bit / 64) as usize];
        if word.load(Ordering::Acquire) >> (bit % 64) & 1 == 1 {
            return Ok(());
        }
        self.check_block_now(section, block)?;
        word.fetch_or(1 << (bit % 64), Ordering::Release);
        Ok(())
    }

    #[cold]
    fn check_block_now(&self, section: &Section, block: u64) -> Result<(), FormatError> {
        let sums = self.sums()?;
        let at = (section.first_block + block) as usize * 4;
        let expected = FieldReader::new(&sums[at..at + 4]).u32();
        let start = section.offset_bytes + block * BLOCK_BYTES;
        let end = (start + BLOCK_BYTES).min(section.offset_bytes + section.len_bytes);
        if crc32fast::hash(&self.bytes[start as usize..end as usize]) != expected {
            let section = section.name.clone();
            return Err(FormatError::Checksum { section, offset_bytes: start });
        }
        Ok(())
    }

    /// Gives section `sums`, checked once.
    fn sums(&self) -> Result<&'a [u8], FormatError> {
        let section = self.sections.last().expect("read_table requires `sums`");
        let start = section.offset_bytes as usize;
        let sums = &self.bytes[start..start + section.len_bytes as usize];
        if self.sums_checked.load(Ordering::Acquire) == 0 {
            if crc32fast::hash(sums) != self.sums_crc {
                let offset_bytes = section.offset_bytes;
                return Err(FormatError::Checksum { section: SUMS.to_owned(), offset_bytes });
            }
            self.sums_checked.store(1, Ordering::Release);
        }
        Ok(sums)
    }

    /// Counts the blocks read so far, each once: so much of the file was needed.
    pub fn n_blocks_read(&self) -> u64 {
        self.checked.iter().map(|word| u64::from(word.load(Ordering::Relaxed).count_ones())).sum()
    }

    /// Gives the length of the file.
    pub fn len_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    /// Checks every byte: all blocks, all padding, the root; `tell` gets the bytes of each block.
    /// [F-4]
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        let sums = self.sums()?;
        let table_end = HEADER_BYTES as usize * (self.sections.len() + 1);
        let table = &self.bytes[HEADER_BYTES as usize..table_end];
        if root_of(&self.bytes[..32], table, sums) != self.root {
            return Err(FormatError::Checksum { section: "header".to_owned(), offset_bytes: 32 });
        }
        let mut end = table_end;
        for section in &self.sections {
            let start = section.offset_bytes as usize;
            if self.bytes[end..start].iter().any(|&b| b != 0) {
                let section = format!("padding before {}", section.name);
                let what = "not zero".to_owned();
                return Err(FormatError::Broken { section, offset_bytes: end as u64, what });
            }
            for block in 0..section.n_blocks() {
                self.check_block(section, block)?;
                tell(BLOCK_BYTES.min(section.len_bytes - block * BLOCK_BYTES));
            }
            end = start + section.len_bytes as usize;
        }
        Ok(())
    }
}

/// Says which artifact the first bytes of a file belong to, if any.
pub fn kind_of(bytes: &[u8]) -> Option<Kind> {
    [Kind::Map, Kind::Octree, Kind::Light].into_iter().find(|k| bytes.starts_with(k.start()))
}

struct Header {
    minor: u16,
    required: u64,
    n_sections: u32,
    table_crc: u32,
    root: u128,
    sums_crc: u32,
}

fn read_header(bytes: &[u8], kind: Kind) -> Result<Header, FormatError> {
    let Some(header) = bytes.get(..HEADER_BYTES as usize).filter(|h| h.starts_with(&MAGIC)) else {
        return Err(FormatError::NotOurs { found: describe(bytes) });
    };
    let damaged =
        |offset_bytes| FormatError::Checksum { section: "header".to_owned(), offset_bytes };
    if crc32fast::hash(&header[..60]) != FieldReader::new(&header[60..]).u32() {
        return Err(damaged(0));
    }
    let found = kind_of(bytes).ok_or(damaged(8))?;
    if found != kind {
        return Err(FormatError::WrongKind { found: found.name(), wanted: kind.name() });
    }
    let mut r = FieldReader::new(&header[12..]);
    let (major, minor) = (r.u16(), r.u16());
    let (file_bytes, n_sections, table_crc) = (r.u64(), r.u32(), r.u32());
    let (root, required, sums_crc) = (r.u128(), r.u64(), r.u32());
    if major != MAJOR || minor > MINOR {
        return Err(FormatError::Version { major, minor, ours: OURS });
    }
    let known = match kind {
        Kind::Map => RECTS.1 | FRACTIONS.1,
        Kind::Octree | Kind::Light => 0,
    };
    if required & !known != 0 {
        return Err(FormatError::Required { flags: required });
    }
    if file_bytes != bytes.len() as u64 {
        return Err(FormatError::Length { expected: file_bytes, found: bytes.len() as u64 });
    }
    if !(1..=MAX_SECTIONS).contains(&n_sections) {
        let what = format!("{n_sections} sections, 1 to {MAX_SECTIONS} are possible");
        return Err(FormatError::Broken { section: "header".to_owned(), offset_bytes: 24, what });
    }
    Ok(Header { minor, required, n_sections, table_crc, root, sums_crc })
}

/// Reads the section table and checks that the sections tile the file.
fn read_table(table: &[u8], file_bytes: u64) -> Result<Vec<Section>, FormatError> {
    let mut sections: Vec<Section> = Vec::new();
    let mut end = HEADER_BYTES + table.len() as u64;
    let mut n_blocks = 0u64;
    for (i, row) in table.chunks_exact(HEADER_BYTES as usize).enumerate() {
        let broken = |what: String| FormatError::Broken {
            section: "section table".to_owned(),
            offset_bytes: HEADER_BYTES * (i as u64 + 1),
            what,
        };
        let name = row[..8].split(|&b| b == 0).next().unwrap_or_default();
        let name = String::from_utf8_lossy(name).into_owned();
        let mut r = FieldReader::new(&row[8..]);
        let (offset_bytes, len_bytes, n_records) = (r.u64(), r.u64(), r.u64());
        let (record_bytes, reserved, first_block) = (r.u32(), r.u32(), r.u64());
        if reserved != 0 || !r.rest_is_zero() {
            return Err(broken("reserved bytes are not zero".to_owned()));
        }
        if offset_bytes != align(end) || len_bytes > file_bytes.saturating_sub(offset_bytes) {
            return Err(broken(format!(
                "{name} at {offset_bytes}, {len_bytes} bytes: out of place"
            )));
        }
        let counted = match record_bytes {
            0 => n_records == 0,
            size => n_records.checked_mul(size.into()) == Some(len_bytes),
        };
        if !counted {
            return Err(broken(format!(
                "{name}: {n_records} records do not make {len_bytes} bytes"
            )));
        }
        end = offset_bytes + len_bytes;
        let section =
            Section { name, offset_bytes, len_bytes, n_records, record_bytes, first_block };
        if section.name != SUMS && first_block != n_blocks {
            return Err(broken(format!("first block {first_block}, not {n_blocks}")));
        }
        n_blocks += section.n_blocks();
        sections.push(section);
    }
    let fits = |s: &Section| s.name == SUMS && s.len_bytes == 4 * n_blocks && end == file_bytes;
    if !sections.last().is_some_and(fits) {
        let what = "the last section is not the checksums of all others".to_owned();
        let section = "section table".to_owned();
        return Err(FormatError::Broken { section, offset_bytes: HEADER_BYTES, what });
    }
    Ok(sections)
}

/// Says what a file that is not ours looks like.
fn describe(bytes: &[u8]) -> String {
    match bytes {
        [] => "an empty file".to_owned(),
        b if b.starts_with(b"LASF") => "a LAS or LAZ scan; ingest it first".to_owned(),
        b if b.starts_with(b"ply") => "a PLY file; ingest it first".to_owned(),
        b if b.starts_with(&MAGIC) => format!("its first {} bytes only", b.len()),
        b => format!("first bytes {:02x?}", &b[..b.len().min(8)]),
    }
}
