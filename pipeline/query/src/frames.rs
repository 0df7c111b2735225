//! Link frames, decoded and kept for the next question.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use pvmap_vmap::links::LinkLists;
use pvmap_vmap::{FormatError, Fraction, MapView, Pairs};

use crate::adjacency::Adjacency;
use crate::map::Map;

/// Link frames kept. One of pvmap's own takes some 50 kB decoded, so all take some 50 MB. Of the
/// largest frames that [F-18] allows one takes 0.2 MB and all take 200 MB.
const N_SLOTS: usize = 1024;
/// What a frame takes at the most.
const FRAME_BYTES: u64 = 200_000;

/// A decoded link frame.
#[derive(Debug)]
struct LinkFrame {
    index: u64,
    first: (u32, u32),
    last: (u32, u32),
    lists: LinkLists,
}

/// The frames decoded last: frame i in slot i modulo their number.
#[derive(Debug)]
pub(crate) struct LinkFrames {
    slots: Box<[Mutex<Option<Arc<LinkFrame>>>]>,
    n_decoded: AtomicU64,
}

impl Default for LinkFrames {
    fn default() -> LinkFrames {
        LinkFrames::new(N_SLOTS)
    }
}

impl LinkFrames {
    fn new(n_slots: usize) -> LinkFrames {
        let slots = (0..n_slots).map(|_| Mutex::default()).collect();
        LinkFrames { slots, n_decoded: AtomicU64::new(0) }
    }

    /// Makes room for frames of so many bytes, one at the least.
    pub(crate) fn within(bytes: u64) -> LinkFrames {
        LinkFrames::new((bytes / FRAME_BYTES).clamp(1, N_SLOTS as u64) as usize)
    }

    /// Counts the frames decoded so far, those decoded again too.
    pub(crate) fn n_decoded(&self) -> u64 {
        self.n_decoded.load(Ordering::Relaxed)
    }

    /// Gives a frame, decoding it unless it is still here.
    fn get(&self, pairs: Pairs<'_, '_>, index: u64) -> Result<Arc<LinkFrame>, FormatError> {
        let slot = &self.slots[(index % self.slots.len() as u64) as usize];
        let kept = || slot.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(frame) = kept().as_ref().filter(|frame| frame.index == index) {
            return Ok(Arc::clone(frame));
        }
        // Decoded outside the lock: others may use the slot meanwhile, at worst twice the work.
        let block = pairs.block(index)?;
        let lists = pairs.lists(index)?;
        self.n_decoded.fetch_add(1, Ordering::Relaxed);
        let frame = Arc::new(LinkFrame { index, first: block.first, last: block.last, lists });
        *kept() = Some(Arc::clone(&frame));
        Ok(frame)
    }
}

/// What is wrong with a pair that no map has. [F-24]
const TOO_MANY: &str = "more free segments than were tried";

/// Looks links and visible fractions up, best in rising order: the frame of one is often that of
/// the next.
#[derive(Debug)]
pub(crate) struct Lookup<'m, 'a> {
    view: &'m MapView<'a>,
    /// All links, where they are in memory.
    all: Option<&'m Adjacency>,
    links: Cursor<'m, 'a>,
    /// Where the map has visible fractions.
    fractions: Option<Cursor<'m, 'a>>,
}

impl<'m, 'a> Lookup<'m, 'a> {
    pub(crate) fn new(map: &'m Map<'a>) -> Lookup<'m, 'a> {
        let view = map.view();
        let all = map.kept().and_then(|kept| kept.adjacency.as_ref());
        let links = Cursor::new(view.links(), &map.frames);
        let fractions = view.fractions().map(|pairs| Cursor::new(pairs, &map.fraction_frames));
        Lookup { view, all, links, fractions }
    }

    /// Gives the parent of a node.
    #[inline]
    pub(crate) fn parent(&self, id: u32) -> Result<u32, FormatError> {
        match self.all.and_then(|all| all.parent(id)) {
            Some(parent) => Ok(parent),
            None => self.view.parent(id),
        }
    }

    /// Says whether (a, b), a < b, is a link.
    pub(crate) fn contains(&mut self, (a, b): (u32, u32)) -> Result<bool, FormatError> {
        match self.all {
            Some(all) => Ok(all.contains((a, b))),
            None => self.links.contains((a, b)),
        }
    }

    /// Finds the least partner of `a` that is `from` or later, reading the one frame it is in.
    pub(crate) fn partner_from(&mut self, a: u32, from: u32) -> Result<Option<u32>, FormatError> {
        match self.all {
            Some(all) => Ok(least(all.partners_of(a), from)),
            None => self.links.partner_from(a, from),
        }
    }

    /// Gives the visible fraction of (a, b), a < b, where the map has one. [F-24]
    pub(crate) fn fraction(&mut self, (a, b): (u32, u32)) -> Result<Option<Fraction>, FormatError> {
        let Some(fractions) = &mut self.fractions else { return Ok(None) };
        let Some(numbers) = fractions.partner_from(a, Fraction::first_of(b))? else {
            return Ok(None);
        };
        let broken = || self.view.file().section("fraction", 0).map(|s| s.broken(0, TOO_MANY));
        match Fraction::of_pair((a, numbers)) {
            Some(found) => Ok(Some(found).filter(|fraction| fraction.b == b)),
            None => Err(broken()?),
        }
    }
}

/// Gives the least of rising partners that is `from` or later.
fn least(partners: &[u32], from: u32) -> Option<u32> {
    partners.get(partners.partition_point(|&b| b < from)).copied()
}

/// Sorted pairs and the frame of them that is at hand.
#[derive(Debug)]
struct Cursor<'m, 'a> {
    pairs: Pairs<'m, 'a>,
    frames: &'m LinkFrames,
    frame: Option<Arc<LinkFrame>>,
}

impl<'m, 'a> Cursor<'m, 'a> {
    fn new(pairs: Pairs<'m, 'a>, frames: &'m LinkFrames) -> Cursor<'m, 'a> {
        Cursor { pairs, frames, frame: None }
    }

    fn contains(&mut self, (a, b): (u32, u32)) -> Result<bool, FormatError> {
        if !self.is_at((a, b)) {
            let index = self.pairs.block_from(a, b)?;
            if index == self.pairs.n_blocks() || self.pairs.first(index)? > (a, b) {
                return Ok(false);
            }
            self.frame = Some(self.frames.get(self.pairs, index)?);
        }
        Ok(self.frame.as_ref().is_some_and(|f| f.lists.contains(a, b)))
    }

    fn partner_from(&mut self, a: u32, from: u32) -> Result<Option<u32>, FormatError> {
        if !self.is_at((a, from)) {
            let index = self.pairs.block_from(a, from)?;
            if index == self.pairs.n_blocks() {
                return Ok(None);
            }
            let first = self.pairs.first(index)?;
            if first >= (a, from) {
                // The index says it all.
                return Ok((first.0 == a).then_some(first.1));
            }
            self.frame = Some(self.frames.get(self.pairs, index)?);
        }
        Ok(self.frame.as_ref().and_then(|f| least(f.lists.partners_of(a), from)))
    }

    /// Says whether a pair would be in the frame at hand.
    fn is_at(&self, pair: (u32, u32)) -> bool {
        self.frame.as_ref().is_some_and(|f| f.first <= pair && pair <= f.last)
    }
}
