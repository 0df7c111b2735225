//! The bytes that the trees of all cutters may take together: counted before they are taken.

use std::sync::atomic::{AtomicU64, Ordering};

use pvmap_store::StoreError;

/// Items of a vector's first room.
const FIRST_ITEMS: usize = 64;

/// A number of bytes that several threads take from.
#[derive(Debug)]
pub(super) struct Budget {
    total_bytes: u64,
    taken_bytes: AtomicU64,
}

impl Budget {
    /// Makes a budget of which nothing is taken.
    pub(super) fn new(total_bytes: u64) -> Budget {
        Budget { total_bytes, taken_bytes: AtomicU64::new(0) }
    }

    /// Takes room for more items.
    ///
    /// # Errors
    /// Where that is more than is left.
    pub(super) fn take<T>(&self, n_items: usize) -> Result<(), StoreError> {
        let bytes = (n_items * size_of::<T>()) as u64;
        let need_bytes = self.taken_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let what = "the nodes and surfels of this tree";
        pvmap_store::memory::require(what, need_bytes, self.total_bytes)
    }

    /// Appends to a vector all of whose room was taken from this budget.
    ///
    /// It grows by a half: while it moves it is there twice, 2.5 times as large as it was.
    ///
    /// # Errors
    /// Those of [`Budget::take`].
    pub(super) fn push<T>(&self, list: &mut Vec<T>, item: T) -> Result<(), StoreError> {
        let n_before = list.capacity();
        if list.len() == n_before {
            let n_more = (n_before / 2).max(FIRST_ITEMS);
            self.take::<T>(n_before + n_more)?;
            list.reserve_exact(n_more);
            self.give_back::<T>(n_before);
        }
        list.push(item);
        Ok(())
    }

    fn give_back<T>(&self, n_items: usize) {
        self.taken_bytes.fetch_sub((n_items * size_of::<T>()) as u64, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn d9_growth_is_counted_and_ends_with_the_budget() {
        let budget = Budget::new(1000 * 8);
        let mut list = Vec::new();
        let refused = (0u64..).find_map(|i| budget.push(&mut list, i).err());
        assert!(matches!(refused, Some(StoreError::Budget { have_bytes: 8000, .. })));
        // 64, 128, 192, 288, 432 items; with 432 there is no room for 648 more.
        assert_eq!((list.len(), list.capacity()), (432, 432));
    }
}
