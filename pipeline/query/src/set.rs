//! Sets of surfels as ranges of their ids: a subtree is a range, so what a link covers is one.

use std::ops::Range;

/// Surfels, as disjoint ranges of ids that rise and do not touch.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SurfelSet {
    ranges: Vec<Range<u32>>,
    n_surfels: u32,
}

impl SurfelSet {
    /// Makes the set of all surfels in some ranges, which may come in any order and overlap.
    pub fn of(mut ranges: Vec<Range<u32>>) -> SurfelSet {
        ranges.retain(|r| !r.is_empty());
        ranges.sort_unstable_by_key(|r| r.start);
        ranges.dedup_by(|next, last| {
            let touches = next.start <= last.end;
            if touches {
                last.end = last.end.max(next.end);
            }
            touches
        });
        // Disjoint ranges of u32: their lengths add up to less than 2^32.
        let n_surfels = ranges.iter().map(|r| r.end - r.start).sum();
        SurfelSet { ranges, n_surfels }
    }

    /// Gives the ranges, rising; there is a gap between any two.
    pub fn ranges(&self) -> &[Range<u32>] {
        &self.ranges
    }

    /// Says whether a surfel is in the set.
    pub fn contains(&self, id: u32) -> bool {
        let i = self.ranges.partition_point(|r| r.end <= id);
        self.ranges.get(i).is_some_and(|r| r.start <= id)
    }

    /// Walks the ids, rising.
    pub fn ids(&self) -> impl Iterator<Item = u32> + '_ {
        self.ranges.iter().cloned().flatten()
    }

    /// Counts the surfels.
    pub fn len(&self) -> u32 {
        self.n_surfels
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.n_surfels == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_join_where_they_touch() {
        let set = SurfelSet::of(vec![9..12, 3..5, 5..6, 7..7, 10..11, 0..1]);
        assert_eq!(set.ranges(), [0..1, 3..6, 9..12]);
        assert_eq!(set.len(), 7);
        assert_eq!(set.ids().collect::<Vec<_>>(), [0, 3, 4, 5, 9, 10, 11]);
        for id in 0..14 {
            assert_eq!(set.contains(id), set.ids().any(|i| i == id), "{id}");
        }
        assert!(SurfelSet::of(Vec::new()).is_empty());
    }
}
