//! The bytes that the trees of all cutters may take together, counted before they are taken, and
//! the lists that take them: a block at a time, so that nothing moves while they grow.

use std::ops::{Index, IndexMut};
use std::sync::atomic::{AtomicU64, Ordering};

use pvmap_store::StoreError;
use pvmap_store::table::Stack;

/// Items of a block: 80 KiB of nodes, 176 KiB of surfels, 56 KiB of rectangles.
pub(super) const BLOCK_ITEMS: usize = 1 << 11;

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

    /// Takes room for a block.
    fn take_block<T>(&self) -> Result<(), StoreError> {
        let bytes = (BLOCK_ITEMS * size_of::<T>()) as u64;
        let need_bytes = self.taken_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let what = "the nodes and surfels of this tree";
        pvmap_store::memory::require(what, need_bytes, self.total_bytes)
    }
}

/// A list in blocks.
#[derive(Debug)]
pub(super) struct Blocks<T: Copy> {
    blocks: Vec<Stack<T>>,
}

impl<T: Copy> Blocks<T> {
    /// Makes an empty list.
    pub(super) fn new() -> Blocks<T> {
        Blocks { blocks: Vec::new() }
    }

    /// Counts the items.
    #[inline]
    pub(super) fn len(&self) -> usize {
        self.blocks.last().map_or(0, |last| (self.blocks.len() - 1) * BLOCK_ITEMS + last.len())
    }

    /// Appends an item; its room is taken from `budget`.
    ///
    /// # Errors
    /// Where that is more than is left.
    pub(super) fn push(&mut self, budget: &Budget, item: T) -> Result<(), StoreError> {
        if let Some(last) = self.blocks.last_mut().filter(|last| !last.is_full()) {
            last.push(item);
            return Ok(());
        }
        budget.take_block::<T>()?;
        let mut block = Stack::new(BLOCK_ITEMS);
        block.push(item);
        self.blocks.push(block);
        Ok(())
    }

    /// Moves the items to the end of a vector that has room for them: block by block, so that
    /// the pages it comes to use are no more than those that were given back, and one block.
    pub(super) fn move_to(self, to: &mut Vec<T>, change: impl Fn(T) -> T) {
        for block in self.blocks {
            to.extend(block.iter().map(|&item| change(item)));
        }
    }
}

impl<T: Copy> Index<u32> for Blocks<T> {
    type Output = T;

    fn index(&self, at: u32) -> &T {
        &self.blocks[at as usize / BLOCK_ITEMS][at as usize % BLOCK_ITEMS]
    }
}

impl<T: Copy> IndexMut<u32> for Blocks<T> {
    fn index_mut(&mut self, at: u32) -> &mut T {
        &mut self.blocks[at as usize / BLOCK_ITEMS][at as usize % BLOCK_ITEMS]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn d9_growth_is_counted_and_ends_with_the_budget() {
        let budget = Budget::new(3 * 8 * BLOCK_ITEMS as u64 + 5);
        let mut list = Blocks::new();
        let refused = (0u64..).find_map(|i| list.push(&budget, i).err());
        assert!(matches!(refused, Some(StoreError::Budget { .. })));
        assert_eq!(list.len(), 3 * BLOCK_ITEMS);
        list[5000] += 7;
        let mut moved = Vec::with_capacity(list.len());
        list.move_to(&mut moved, |item| item + 1);
        assert!((1..).zip(&moved).all(|(i, &item)| item == if i == 5001 { i + 7 } else { i }));
        assert_eq!(moved.len(), moved.capacity());
    }
}
