//! An artifact taken apart and put together again under right checksums, as a hostile program
//! would do it. Sections 2 of FORMAT.md.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]

use pvmap::geometry::disc::Profile;
use pvmap::vmap::container::{BLOCK_BYTES, Section, Written, align, close, head_bytes};
use pvmap::vmap::map::section_names;
use pvmap::vmap::{Container, Kind};
use xxhash_rust::xxh3::Xxh3;

/// Bytes of the header, and of a row of the section table.
pub const ROW: usize = 64;

/// The sections of a file, without `sums`.
#[derive(Debug, Clone)]
pub struct Parts {
    kind: Kind,
    /// Name, bytes of a record, content.
    pub sections: Vec<(&'static str, u32, Vec<u8>)>,
}

impl Parts {
    /// Takes a sound file apart.
    pub fn of(bytes: &[u8], kind: Kind) -> Parts {
        let file = Container::open(bytes, kind).unwrap();
        let names = match kind {
            Kind::Map => section_names(Profile::Oriented, true),
            Kind::Octree => pvmap::vmap::octree::SECTIONS.to_vec(),
            Kind::Light => pvmap::vmap::light::section_names(true, true),
        };
        let known = |s: &Section| names.iter().copied().find(|&name| name == s.name);
        let rows = file.sections().iter().filter_map(|s| Some((known(s)?, s)));
        let sections = rows
            .map(|(name, s)| (name, s.record_bytes, file.read_all(s).unwrap().to_vec()))
            .collect();
        Parts { kind, sections }
    }

    /// Gives the content of a section.
    pub fn bytes_mut(&mut self, name: &str) -> &mut Vec<u8> {
        let found = self.sections.iter_mut().find(|s| s.0 == name);
        &mut found.unwrap_or_else(|| panic!("no section {name}")).2
    }

    /// Puts the file together, with the checksums of what it now holds.
    pub fn seal(&self) -> Vec<u8> {
        let mut file = vec![0; head_bytes(self.sections.len()) as usize];
        let mut table = Vec::new();
        for (name, record_bytes, content) in &self.sections {
            file.resize(align(file.len() as u64) as usize, 0);
            table.push(Written {
                name,
                offset_bytes: file.len() as u64,
                len_bytes: content.len() as u64,
                record_bytes: *record_bytes,
                sums: content.chunks(BLOCK_BYTES as usize).map(crc32fast::hash).collect(),
            });
            file.extend_from_slice(content);
        }
        let closing = close(self.kind, &table);
        file[..closing.head.len()].copy_from_slice(&closing.head);
        file.resize(closing.sums_offset_bytes as usize, 0);
        file.extend_from_slice(&closing.sums);
        file
    }
}

/// Sets a u64 or a part of it.
pub fn put(bytes: &mut [u8], at: usize, value: u64, n_bytes: usize) {
    bytes[at..at + n_bytes].copy_from_slice(&value.to_le_bytes()[..n_bytes]);
}

/// Computes the checksums of header and section table anew: `table_crc`, `root`, `header_crc`.
pub fn reseal_head(file: &mut [u8], n_sections: usize) {
    let table = ROW..ROW * (n_sections + 1);
    let row = table.end - ROW;
    let word = |at: usize| u64::from_le_bytes(file[at..at + 8].try_into().unwrap());
    let (sums_at, sums_len) = (word(row + 8), word(row + 16));
    let end = sums_at.saturating_add(sums_len).min(file.len() as u64);
    let sums = file[sums_at.min(end) as usize..end as usize].to_vec();
    let crc = crc32fast::hash(&file[table.clone()]);
    put(file, 28, crc.into(), 4);
    let mut root = Xxh3::new();
    root.update(&file[..32]);
    root.update(&file[table]);
    root.update(&sums);
    file[32..48].copy_from_slice(&root.digest128().to_le_bytes());
    put(file, 56, crc32fast::hash(&sums).into(), 4);
    let crc = crc32fast::hash(&file[..60]);
    put(file, 60, crc.into(), 4);
}
