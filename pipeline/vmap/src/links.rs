//! The codec of the link section: sorted pairs to compressed frames and back. [F-17]…[F-19]

use zstd::bulk::{Compressor, Decompressor};
use zstd::zstd_safe::CParameter;

use crate::error::FormatError;
use crate::records::LinkBlock;

/// The most a frame may decompress to; no file can make a reader allocate more.
pub const MAX_CONTENT_BYTES: usize = 32_768;
/// A frame is closed once its content has this size. A question decodes some frames whole: larger
/// ones make it slower (four times at 64 KiB), smaller ones make the file larger (3 % against 64
/// KiB).
const TARGET_CONTENT_BYTES: usize = 16_384;
/// zstd level: 3 is where the ratio of delta-coded ids flattens out.
const LEVEL: i32 = 3;

/// Turns links in rising order into frames.
pub struct LinkEncoder {
    compressor: Compressor<'static>,
    content: Vec<u8>,
    /// The open list: its node and its partners so far.
    list: Option<(u32, Vec<u32>)>,
    list_bytes: usize,
    block: Option<LinkBlock>,
    last_node: u32,
    offset_bytes: u64,
}

impl std::fmt::Debug for LinkEncoder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LinkEncoder").field("offset_bytes", &self.offset_bytes).finish()
    }
}

impl LinkEncoder {
    /// Starts an empty link section.
    ///
    /// # Errors
    /// Where zstd cannot allocate.
    pub fn new() -> std::io::Result<LinkEncoder> {
        let mut compressor = Compressor::new(LEVEL)?;
        compressor.set_parameter(CParameter::ChecksumFlag(true))?;
        Ok(LinkEncoder {
            compressor,
            content: Vec::with_capacity(MAX_CONTENT_BYTES),
            list: None,
            list_bytes: 0,
            block: None,
            last_node: 0,
            offset_bytes: 0,
        })
    }

    /// Adds a link, greater than the one before; gives a finished frame now and then.
    ///
    /// # Errors
    /// Where zstd fails.
    pub fn push(&mut self, (a, b): (u32, u32)) -> std::io::Result<Option<(LinkBlock, Vec<u8>)>> {
        debug_assert!(a < b, "a link is (a, b) with a < b");
        if self.list.as_ref().is_some_and(|&(node, _)| node != a) {
            self.close_list();
        }
        let full = self.content.len() + self.list_bytes >= TARGET_CONTENT_BYTES;
        let frame = if full { self.finish_block()? } else { None };
        let block = self.block.get_or_insert(LinkBlock {
            first: (a, b),
            last: (a, b),
            offset_bytes: self.offset_bytes,
            len_bytes: 0,
            content_bytes: 0,
            n_links: 0,
            crc: 0,
        });
        debug_assert!(block.n_links == 0 || block.last < (a, b), "links rise strictly");
        block.last = (a, b);
        block.n_links += 1;
        let (_, partners) = self.list.get_or_insert((a, Vec::new()));
        partners.push(b);
        // Five bytes are the longest varint of 32 bits: an upper bound keeps frames small enough.
        self.list_bytes += 5;
        Ok(frame)
    }

    /// Closes the section; gives the last frame, if any.
    ///
    /// # Errors
    /// Where zstd fails.
    pub fn finish(mut self) -> std::io::Result<Option<(LinkBlock, Vec<u8>)>> {
        self.finish_block()
    }

    fn close_list(&mut self) {
        let Some((node, partners)) = self.list.take() else {
            return;
        };
        put_varint(&mut self.content, node - self.last_node);
        put_varint(&mut self.content, partners.len() as u32);
        let mut before = node;
        for b in partners {
            put_varint(&mut self.content, b - before - 1);
            before = b;
        }
        self.last_node = node;
        self.list_bytes = 0;
    }

    fn finish_block(&mut self) -> std::io::Result<Option<(LinkBlock, Vec<u8>)>> {
        self.close_list();
        self.last_node = 0;
        let Some(mut block) = self.block.take() else {
            return Ok(None);
        };
        let frame = self.compressor.compress(&self.content)?;
        block.len_bytes = frame.len() as u32;
        block.content_bytes = self.content.len() as u32;
        block.crc = crc32fast::hash(&frame);
        self.offset_bytes += frame.len() as u64;
        self.content.clear();
        Ok(Some((block, frame)))
    }
}

/// The links of one frame, ready to be asked.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LinkLists {
    /// The nodes that have a list here, rising.
    nodes: Vec<u32>,
    /// Where each node's partners start; one more than `nodes`.
    starts: Vec<u32>,
    /// The partners, rising within a list.
    partners: Vec<u32>,
}

impl LinkLists {
    /// Says whether (a, b) is one of these links.
    pub fn contains(&self, a: u32, b: u32) -> bool {
        self.partners_of(a).binary_search(&b).is_ok()
    }

    /// Gives the partners of a node in this frame.
    pub fn partners_of(&self, a: u32) -> &[u32] {
        match self.nodes.binary_search(&a) {
            Ok(i) => &self.partners[self.starts[i] as usize..self.starts[i + 1] as usize],
            Err(_) => &[],
        }
    }

    /// Walks the lists: each node with its partners, both rising.
    pub fn lists(&self) -> impl Iterator<Item = (u32, &[u32])> + '_ {
        let ends = self.starts.windows(2).map(|w| w[0] as usize..w[1] as usize);
        self.nodes.iter().zip(ends).map(|(&a, partners)| (a, &self.partners[partners]))
    }

    /// Walks all links in rising order.
    pub fn iter(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.lists().flat_map(|(a, partners)| partners.iter().map(move |&b| (a, b)))
    }

    /// Counts the links.
    pub fn len(&self) -> usize {
        self.partners.len()
    }

    /// Says whether there is no link.
    pub fn is_empty(&self) -> bool {
        self.partners.is_empty()
    }
}

/// Decompresses a frame and reads its lists, checking everything [F-18] says of them.
///
/// # Errors
/// Where a checksum differs, the content is not of the stated size or breaks a rule; the place
/// given is `at_bytes`, the frame's place in the file, in `section`.
pub fn decode(
    section: &str,
    block: &LinkBlock,
    frame: &[u8],
    at_bytes: u64,
) -> Result<LinkLists, FormatError> {
    let broken = |what: &str| FormatError::Broken {
        section: section.to_owned(),
        offset_bytes: at_bytes,
        what: what.to_owned(),
    };
    if crc32fast::hash(frame) != block.crc {
        let section = section.to_owned();
        return Err(FormatError::Checksum { section, offset_bytes: at_bytes });
    }
    let size = block.content_bytes as usize;
    if size > MAX_CONTENT_BYTES || u64::from(block.n_links) > size as u64 {
        return Err(broken("content larger than a frame may have"));
    }
    let mut decompressor = Decompressor::new().map_err(|_| broken("zstd could not start"))?;
    let content =
        decompressor.decompress(frame, size).map_err(|_| broken("not a whole zstd frame"))?;
    if content.len() != size {
        return Err(broken("content is not of the stated size"));
    }
    let lists = read_lists(&content, block.n_links as usize)
        .ok_or_else(|| broken("lists do not add up"))?;
    if lists.iter().next() != Some(block.first) || lists.iter().last() != Some(block.last) {
        return Err(broken("first and last link are not those of the index"));
    }
    Ok(lists)
}

fn read_lists(mut content: &[u8], n_links: usize) -> Option<LinkLists> {
    let mut lists = LinkLists { partners: Vec::with_capacity(n_links), ..LinkLists::default() };
    let mut node = 0u32;
    while !content.is_empty() {
        let step = take_varint(&mut content)?;
        if step == 0 && !lists.nodes.is_empty() {
            return None;
        }
        node = node.checked_add(step)?;
        lists.nodes.push(node);
        lists.starts.push(lists.partners.len() as u32);
        let n = take_varint(&mut content)?;
        if n == 0 || n as usize > n_links - lists.partners.len() {
            return None;
        }
        let mut before = node;
        for _ in 0..n {
            before = before.checked_add(take_varint(&mut content)?)?.checked_add(1)?;
            lists.partners.push(before);
        }
    }
    lists.starts.push(lists.partners.len() as u32);
    (lists.partners.len() == n_links).then_some(lists)
}

/// Appends a LEB128 varint.
pub fn put_varint(out: &mut Vec<u8>, mut v: u32) {
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

/// Takes a LEB128 varint of at most 32 bits off the front; `None` where there is none.
pub fn take_varint(bytes: &mut &[u8]) -> Option<u32> {
    let mut v = 0u64;
    for (i, &byte) in bytes.iter().take(5).enumerate() {
        v |= u64::from(byte & 0x7f) << (7 * i);
        if byte < 0x80 {
            *bytes = &bytes[i + 1..];
            let shortest = i == 0 || byte != 0;
            return u32::try_from(v).ok().filter(|_| shortest);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encode(links: &[(u32, u32)]) -> Vec<(LinkBlock, Vec<u8>)> {
        let mut encoder = LinkEncoder::new().unwrap();
        let mut frames: Vec<_> = links.iter().filter_map(|&l| encoder.push(l).unwrap()).collect();
        frames.extend(encoder.finish().unwrap());
        frames
    }

    fn decode_all(frames: &[(LinkBlock, Vec<u8>)]) -> Vec<(u32, u32)> {
        frames
            .iter()
            .flat_map(|(b, f)| decode("links", b, f, 0).unwrap().iter().collect::<Vec<_>>())
            .collect()
    }

    proptest! {
        #[test]
        fn format17_links_come_back(
            set in prop::collection::btree_set((0u32..50, 51u32..1_000_000), 0..500),
        ) {
            let links: Vec<_> = set.into_iter().collect();
            prop_assert_eq!(decode_all(&encode(&links)), links);
        }

        #[test]
        fn varints_come_back(v: u32) {
            let mut bytes = Vec::new();
            put_varint(&mut bytes, v);
            let mut rest = bytes.as_slice();
            prop_assert_eq!(take_varint(&mut rest), Some(v));
            prop_assert!(rest.is_empty());
        }

        #[test]
        fn f47_hostile_content_never_panics(
            content in prop::collection::vec(any::<u8>(), 0..200),
            n in 0usize..300,
        ) {
            let _ = read_lists(&content, n);
        }
    }

    #[test]
    fn format18_a_long_list_goes_on_in_the_next_frame() {
        let links: Vec<_> = (0..200_000u32).map(|i| (7, 8 + 1000 * i)).collect();
        let frames = encode(&links);
        assert!(frames.len() > 1);
        assert!(frames.iter().all(|(b, _)| b.content_bytes as usize <= MAX_CONTENT_BYTES));
        assert_eq!(decode_all(&frames), links);
    }

    #[test]
    fn format18_a_varint_longer_than_needed_is_refused() {
        assert_eq!(take_varint(&mut [0x81, 0x00].as_slice()), None);
        assert_eq!(take_varint(&mut [0xff, 0xff, 0xff, 0xff, 0x7f].as_slice()), None);
        assert_eq!(take_varint(&mut [0x80].as_slice()), None);
    }

    #[test]
    fn f48_a_stated_size_beyond_the_limit_is_refused_before_allocation() {
        let (mut block, frame) = encode(&[(1, 2)]).remove(0);
        block.content_bytes = u32::MAX;
        assert!(matches!(decode("links", &block, &frame, 0), Err(FormatError::Broken { .. })));
        block.content_bytes = 4;
        assert!(matches!(decode("links", &block, &frame, 0), Err(FormatError::Broken { .. })));
    }
}
