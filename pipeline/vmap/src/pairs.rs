//! Sorted pairs in compressed frames, with an index of the frames: the links of a map [F-17], and
//! its pairs with visible fractions [F-24].

use crate::bytes::FieldReader;
use crate::container::{Container, Section};
use crate::error::FormatError;
use crate::links::{self, LinkLists};
use crate::map::record;
use crate::records::{LinkBlock, Record};

/// Where pairs lie in a file.
#[derive(Debug)]
pub(crate) struct PairSections {
    frames: Section,
    index: Section,
}

impl PairSections {
    /// Finds the frames and their index by their names.
    pub(crate) fn of(file: &Container<'_>, names: [&str; 2]) -> Result<PairSections, FormatError> {
        let frames = file.section(names[0], 0)?.clone();
        let index = file.section(names[1], LinkBlock::BYTES as u32)?.clone();
        Ok(PairSections { frames, index })
    }
}

/// Pairs (a, b), a < b, in rising order, read frame by frame.
#[derive(Debug, Clone, Copy)]
pub struct Pairs<'m, 'a> {
    file: &'m Container<'a>,
    sections: &'m PairSections,
}

impl<'m, 'a> Pairs<'m, 'a> {
    pub(crate) fn new(file: &'m Container<'a>, sections: &'m PairSections) -> Pairs<'m, 'a> {
        Pairs { file, sections }
    }

    /// Counts the frames.
    pub fn n_blocks(&self) -> u64 {
        self.sections.index.n_records
    }

    /// Gives the bytes of all frames.
    pub fn len_bytes(&self) -> u64 {
        self.sections.frames.len_bytes
    }

    /// Reads a row of the index.
    ///
    /// # Errors
    /// Where there is no such row or its block is damaged.
    pub fn block(&self, i: u64) -> Result<LinkBlock, FormatError> {
        record(self.file, &self.sections.index, i)
    }

    /// Decodes a frame, checking it.
    ///
    /// # Errors
    /// Where the frame or its row of the index is damaged.
    pub fn lists(&self, i: u64) -> Result<LinkLists, FormatError> {
        let block = self.block(i)?;
        let frames = &self.sections.frames;
        let frame = self.file.read(frames, block.offset_bytes, block.len_bytes.into())?;
        let at_bytes = frames.offset_bytes.saturating_add(block.offset_bytes);
        links::decode(&frames.name, &block, frame, at_bytes)
    }

    /// Reads the first pair of a frame, and nothing else of its row.
    ///
    /// # Errors
    /// Where there is no such row or its block is damaged.
    pub fn first(&self, i: u64) -> Result<(u32, u32), FormatError> {
        self.pair_at(i, LinkBlock::FIRST_AT)
    }

    /// Finds the first frame that ends with (a, b) or a later pair; `n_blocks` where there is none.
    ///
    /// # Errors
    /// Where a touched block of the index is damaged.
    pub fn block_from(&self, a: u32, b: u32) -> Result<u64, FormatError> {
        let (mut low, mut high) = (0, self.n_blocks());
        while low < high {
            let middle = low + (high - low) / 2;
            if self.pair_at(middle, LinkBlock::LAST_AT)? < (a, b) {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        Ok(low)
    }

    /// Reads one of the pairs that a row of the index names.
    #[inline]
    fn pair_at(&self, i: u64, at_bytes: u64) -> Result<(u32, u32), FormatError> {
        let at = i.saturating_mul(LinkBlock::BYTES as u64).saturating_add(at_bytes);
        let mut r = FieldReader::new(self.file.read(&self.sections.index, at, 8)?);
        Ok((r.u32(), r.u32()))
    }

    /// Checks that frames and pairs are in order and as many as is said; `each` checks a pair, or
    /// says what is wrong with it.
    pub(crate) fn verify(
        &self,
        n_expected: u64,
        mut each: impl FnMut(u32, u32) -> Result<Option<String>, FormatError>,
        tell: &mut dyn FnMut(u64),
    ) -> Result<(), FormatError> {
        let PairSections { frames, index } = self.sections;
        let (mut n_pairs, mut end, mut before) = (0u64, 0, None);
        for i in 0..index.n_records {
            let block = self.block(i)?;
            let at = i * LinkBlock::BYTES as u64;
            if block.offset_bytes != end || before.is_some_and(|b| b >= block.first) {
                return Err(index.broken(at, "frames are not in order"));
            }
            for (a, b) in self.lists(i)?.iter() {
                if let Some(what) = each(a, b)? {
                    return Err(index.broken(at, what));
                }
            }
            n_pairs += u64::from(block.n_links);
            end += u64::from(block.len_bytes);
            before = Some(block.last);
            tell(block.len_bytes.into());
        }
        if end != frames.len_bytes || n_pairs != n_expected {
            return Err(frames.broken(end, "frames do not fill the section"));
        }
        Ok(())
    }
}
