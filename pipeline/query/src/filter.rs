//! A quick no for links that there are not.

/// Which links there may be: of a hundred that there are not it lets some four pass. A pair asks
/// for a dozen links, of which there is one at the most; what is not there costs one look here
/// instead of some ten along a list. Source: Putze, Sanders and Singler, "Cache-, Hash- and
/// Space-Efficient Bloom Filters", 2007: a blocked filter, with a word for a block.
#[derive(Debug)]
pub(crate) struct Filter {
    words: Vec<u64>,
}

/// Links that share a word of 64 bits, on average.
const LINKS_PER_WORD: usize = 8;

impl Filter {
    /// Makes it of all lists: where the list of each node starts, and the lists.
    pub(crate) fn of(starts: &[u32], partners: &[u32]) -> Filter {
        let mut filter = Filter { words: vec![0; partners.len() / LINKS_PER_WORD + 1] };
        for (a, list) in (0..).zip(starts.windows(2)) {
            for &b in &partners[list[0] as usize..list[1] as usize] {
                let (word, bits) = filter.place_of(a, b);
                filter.words[word] |= bits;
            }
        }
        filter
    }

    /// Says no where (a, b) is no link, mostly.
    #[inline]
    pub(crate) fn may_hold(&self, a: u32, b: u32) -> bool {
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
        assert!(n_passed < 6000, "{n_passed}");
    }
}
