//! All links of a map in memory.

use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, MapView};
use rayon::prelude::*;

/// The most links that are kept: 64 MiB of them.
const MAX_LINKS: u64 = 1 << 24;
/// Frames decoded before their links are put away: some 10 MB.
const N_AT_ONCE: usize = 256;

/// Of each node its parent and the later nodes it is linked to.
#[derive(Debug)]
pub(crate) struct Adjacency {
    parents: Vec<u32>,
    /// Where each node's partners start; one more than there are nodes.
    starts: Vec<u32>,
    /// The partners, rising within a list.
    partners: Vec<u32>,
    filter: Filter,
}

impl Adjacency {
    /// Reads them all; none where they are too many.
    pub(crate) fn of(view: &MapView<'_>) -> Result<Option<Adjacency>, FormatError> {
        let (n_links, n_nodes) = (view.summary().n_links, view.n_nodes());
        if n_links > MAX_LINKS {
            return Ok(None);
        }
        let parents: Vec<u32> =
            (0..n_nodes).into_par_iter().map(|id| view.parent(id)).collect::<Result<_, _>>()?;
        let (mut starts, mut partners) = (vec![0; n_nodes as usize + 1], Vec::new());
        let frames: Vec<u64> = (0..view.n_link_blocks()).collect();
        for some in frames.chunks(N_AT_ONCE) {
            let decoded: Vec<_> = some.par_iter().map(|&i| view.link_lists(i)).collect();
            for lists in decoded {
                for (a, list) in lists?.lists() {
                    // A list may go on in the next frame: then this is its end so far.
                    if let Some(end) = starts.get_mut(a as usize + 1) {
                        partners.extend_from_slice(list);
                        *end = partners.len() as u32;
                    }
                }
                if partners.len() as u64 > MAX_LINKS {
                    return Ok(None);
                }
            }
        }
        // Nodes without a list end where the one before them does.
        let mut end = 0;
        for start in &mut starts {
            end = end.max(*start);
            *start = end;
        }
        let filter = Filter::of(&starts, &partners);
        Ok(Some(Adjacency { parents, starts, partners, filter }))
    }

    /// Gives the parent of a node; none where there is no such node.
    #[inline]
    pub(crate) fn parent(&self, id: u32) -> Option<u32> {
        self.parents.get(id as usize).copied()
    }

    /// Gives the later nodes that a node is linked to, rising.
    #[inline]
    pub(crate) fn partners_of(&self, a: u32) -> &[u32] {
        match self.starts.get(a as usize..a as usize + 2) {
            Some(&[start, end]) => &self.partners[start as usize..end as usize],
            _ => &[],
        }
    }

    /// Says whether (a, b), a < b, is a link.
    #[inline]
    pub(crate) fn contains(&self, (a, b): (u32, u32)) -> bool {
        self.filter.may_hold(a, b) && self.partners_of(a).binary_search(&b).is_ok()
    }
}

/// Which links there may be: of a hundred that there are not it lets some four pass. A pair asks
/// for a dozen links, of which there is one at the most; what is not there costs one look here
/// instead of some ten along a list. Source: Putze, Sanders and Singler, "Cache-, Hash- and
/// Space-Efficient Bloom Filters", 2007: a blocked filter, with a word for a block.
#[derive(Debug)]
struct Filter {
    words: Vec<u64>,
}

/// Links that share a word of 64 bits, on average.
const LINKS_PER_WORD: usize = 8;

impl Filter {
    /// Makes it of all lists.
    fn of(starts: &[u32], partners: &[u32]) -> Filter {
        let mut filter = Filter { words: vec![0; partners.len() / LINKS_PER_WORD + 1] };
        for (a, list) in (0..).zip(starts.windows(2)) {
            for &b in &partners[list[0] as usize..list[1] as usize] {
                let (word, bits) = filter.place_of(a, b);
                filter.words[word] |= bits;
            }
        }
        filter
    }

    #[inline]
    fn may_hold(&self, a: u32, b: u32) -> bool {
        let (word, bits) = self.place_of(a, b);
        self.words[word] & bits == bits
    }

    /// Gives the word of a link and its four bits there.
    #[inline]
    fn place_of(&self, a: u32, b: u32) -> (usize, u64) {
        // 2^64 over the golden ratio: the upper half of the product depends on all of the link.
        let mixed = (u128::from(a) << 32 | u128::from(b)) * 0x9e37_79b9_7f4a_7c15;
        let hash = (mixed ^ (mixed >> 64)) as u64;
        let word = ((u128::from(hash) * self.words.len() as u128) >> 64) as usize;
        let bits = (0..4).fold(0, |bits, i| bits | 1 << (hash >> (6 * i) & 63));
        (word, bits)
    }
}

#[cfg(test)]
mod tests {
    use fastrand::Rng;

    use super::*;

    #[test]
    fn the_filter_passes_every_link_and_few_others() {
        let mut rng = Rng::with_seed(1);
        let (mut starts, mut partners) = (vec![0], Vec::new());
        for a in 0..2000 {
            let mut list: Vec<u32> = (0..rng.u32(..100)).map(|_| rng.u32(a + 1..100_000)).collect();
            list.sort_unstable();
            partners.extend(list);
            starts.push(partners.len() as u32);
        }
        let filter = Filter::of(&starts, &partners);
        let list_of =
            |a: u32| &partners[starts[a as usize] as usize..starts[a as usize + 1] as usize];
        assert!((0..2000).all(|a| list_of(a).iter().all(|&b| filter.may_hold(a, b))));
        let others = (0..100_000).map(|_| (rng.u32(..2000), rng.u32(100_000..200_000)));
        let n_passed = others.filter(|&(a, b)| filter.may_hold(a, b)).count();
        assert!((1000..6000).contains(&n_passed), "{n_passed}");
    }
}
