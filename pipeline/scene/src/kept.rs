//! Which of many points are kept: two bytes each, whatever there are in all.

/// Numbers in a row that share what is beyond 16 bits.
const BLOCK: u64 = 1 << 16;

/// Some of the numbers from 0 on, rising.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Kept {
    /// The lower 16 bits of each.
    low: Vec<u16>,
    /// How many come before each block.
    before: Vec<u64>,
}

impl FromIterator<u64> for Kept {
    /// Takes rising numbers.
    fn from_iter<I: IntoIterator<Item = u64>>(rising: I) -> Kept {
        let mut kept = Kept::default();
        for number in rising {
            while kept.before.len() as u64 <= number / BLOCK {
                kept.before.push(kept.len());
            }
            kept.low.push((number % BLOCK) as u16);
        }
        kept
    }
}

impl Kept {
    /// Counts them.
    pub(crate) fn len(&self) -> u64 {
        self.low.len() as u64
    }

    /// Gives the one of this rank.
    ///
    /// # Panics
    /// Where there are no more than `rank` of them.
    pub(crate) fn at(&self, rank: u64) -> u64 {
        let low = self.low[rank as usize];
        // The first block has nothing before it.
        let block = self.before.partition_point(|&before| before <= rank) - 1;
        block as u64 * BLOCK + u64::from(low)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_in_order_from_blocks_full_and_empty() {
        let steps = [1, 7, BLOCK - 1, BLOCK, BLOCK + 1, 5 * BLOCK, 1, 1, 3 * BLOCK - 1];
        for first in [0, 1, BLOCK - 1, BLOCK, 9 * BLOCK] {
            let rising: Vec<u64> = std::iter::once(first)
                .chain(steps.iter().cycle().take(200).scan(first, |number, step| {
                    *number += step;
                    Some(*number)
                }))
                .collect();
            let kept: Kept = rising.iter().copied().collect();
            let found: Vec<u64> = (0..kept.len()).map(|rank| kept.at(rank)).collect();
            assert_eq!(found, rising);
        }
        assert_eq!(Kept::from_iter([]).len(), 0);
    }

    #[test]
    fn two_bytes_each_and_little_more() {
        let kept: Kept = (0..10 * BLOCK).step_by(3).collect();
        let bytes = 2 * kept.low.len() + 8 * kept.before.len();
        assert!(bytes as f64 <= 2.01 * kept.len() as f64, "{bytes} for {}", kept.len());
    }
}
