//! Chance without state: hashes of a key and an index, and a bijection on 0…n-1.

/// Stirs 64 bits so that each bit of the result hangs on each bit given; a bijection.
///
/// Source: the output function of splitmix64 (Steele, Lea and Flood 2014).
#[inline]
pub(crate) fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Gives the `index`-th 64 random bits of the sequence `key`.
#[inline]
pub(crate) fn bits(key: u64, index: u64) -> u64 {
    // The golden ratio's bits are splitmix64's own step from one index to the next.
    mix(mix(key).wrapping_add(index.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// Gives two independent numbers in the open interval (0, 1) from 64 random bits.
#[inline]
pub(crate) fn unit_pair(bits: u64) -> [f64; 2] {
    // Half a step up, so that neither end is hit and no sample lies on the rim of a surface.
    let open = |half: u64| (half as f64 + 0.5) / (1u64 << 32) as f64;
    [open(bits >> 32), open(bits & 0xffff_ffff)]
}

/// Gives the `index`-th number of the sequence `key` in the open interval (low, high).
pub(crate) fn between(key: u64, index: u64, low: f64, high: f64) -> f64 {
    low + (high - low) * unit_pair(bits(key, index))[0]
}

/// A permutation of 0…n-1 that is computed, not stored.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Permutation {
    n: u64,
    /// Ones in the bits that the places below n need.
    mask: u64,
    /// Half those bits, at least 1: how far a round folds the upper half onto the lower.
    fold: u32,
    keys: [u64; 4],
}

impl Permutation {
    /// Draws a permutation of 0…n-1 by its key.
    pub(crate) fn new(n: u64, key: u64) -> Permutation {
        let width = u64::BITS - n.saturating_sub(1).leading_zeros();
        Permutation {
            n,
            mask: if n <= 1 { 0 } else { u64::MAX >> (u64::BITS - width) },
            fold: width.div_ceil(2).max(1),
            keys: [0, 1, 2, 3].map(|round| bits(key, round)),
        }
    }

    /// Gives where `place` goes; `place` < n.
    #[inline]
    pub(crate) fn of(&self, place: u64) -> u64 {
        debug_assert!(place < self.n);
        // The rounds permute 0…2^width-1, fewer than 2n places; walking their cycle until it is
        // below n again permutes 0…n-1, with fewer than two steps on average.
        let mut x = place;
        loop {
            x = self.stir(x);
            if x < self.n {
                return x;
            }
        }
    }

    /// Permutes 0…2^width-1: adding, multiplying by an odd number and folding are bijections.
    #[inline]
    fn stir(&self, mut x: u64) -> u64 {
        for key in self.keys {
            x = x.wrapping_add(key).wrapping_mul(key | 1) & self.mask;
            x ^= x >> self.fold;
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_permutation_hits_every_place_once() {
        for n in [1u64, 2, 3, 4, 5, 63, 64, 65, 1000, 4097] {
            let p = Permutation::new(n, 7);
            let mut hits: Vec<u64> = (0..n).map(|i| p.of(i)).collect();
            hits.sort_unstable();
            assert_eq!(hits, (0..n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_permutation_leaves_no_order_behind() {
        let n = 100_000u64;
        let p = Permutation::new(n, 1);
        let far = (1..n).filter(|&i| p.of(i).abs_diff(p.of(i - 1)) > n / 100).count();
        // Two random places of n are nearer than n/100 in about 2 % of the cases.
        assert!((97_500..98_500).contains(&far), "{far}");
        assert_ne!(p.of(5), Permutation::new(n, 2).of(5));
    }

    #[test]
    fn unit_numbers_stay_inside_and_fill_the_interval() {
        assert!(unit_pair(0)[0] > 0.0 && unit_pair(u64::MAX)[1] < 1.0);
        let mean = (0..10_000).map(|i| unit_pair(bits(3, i))[1]).sum::<f64>() / 1e4;
        assert!((mean - 0.5).abs() < 0.015, "{mean}");
    }
}
