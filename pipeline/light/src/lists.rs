//! A list of partners for every node.

use std::path::Path;

use pvmap_store::{StoreError, Table};

use crate::hierarchy::Span;

/// Lists one after another, in the order of the nodes, or stations, they belong to.
#[derive(Debug)]
pub(crate) struct Lists<T: Copy> {
    /// Where each list starts; one more than there are lists.
    starts: Vec<usize>,
    entries: Table<T>,
}

/// How long each list will be.
#[derive(Debug, Clone)]
pub(crate) struct Lengths(Vec<usize>);

/// Lists in the making.
#[derive(Debug)]
pub(crate) struct Filling<T: Copy> {
    lists: Lists<T>,
    /// Where the next entry of each list goes.
    ends: Vec<usize>,
}

impl Lengths {
    pub(crate) fn new(n_lists: usize) -> Lengths {
        Lengths(vec![0; n_lists])
    }

    /// Counts an entry.
    pub(crate) fn add(&mut self, list: u32) {
        self.0[list as usize] += 1;
    }

    /// Gives where each list starts, and where the last one ends.
    fn starts(&self) -> Vec<usize> {
        let ends = self.0.iter().scan(0, |end, length| {
            *end += length;
            Some(*end)
        });
        std::iter::once(0).chain(ends).collect()
    }

    /// Makes room for the entries, in a nameless file of a folder or in memory where none is given.
    pub(crate) fn fill<T: Copy + Default>(
        &self,
        folder: Option<&Path>,
    ) -> Result<Filling<T>, StoreError> {
        let starts = self.starts();
        let entries = Table::new(starts[starts.len() - 1], T::default(), folder)?;
        Ok(Filling { ends: starts.clone(), lists: Lists { starts, entries } })
    }
}

impl<T: Copy + Ord> Filling<T> {
    /// Adds an entry that was counted.
    pub(crate) fn put(&mut self, list: u32, entry: T) {
        let end = &mut self.ends[list as usize];
        self.lists.entries[*end] = entry;
        *end += 1;
    }

    /// Sorts each list.
    pub(crate) fn done(mut self) -> Lists<T> {
        for bounds in self.lists.starts.windows(2) {
            self.lists.entries[bounds[0]..bounds[1]].sort_unstable();
        }
        self.lists
    }
}

impl<T: Copy + Ord + Default> Lists<T> {
    /// Sorts (list, entry) into lists in memory, each rising.
    pub(crate) fn of<I: Iterator<Item = (u32, T)>>(
        n_lists: usize,
        rows: impl Fn() -> I,
    ) -> Result<Lists<T>, StoreError> {
        let mut lengths = Lengths::new(n_lists);
        rows().for_each(|(list, _)| lengths.add(list));
        let mut filling = lengths.fill(None)?;
        rows().for_each(|(list, entry)| filling.put(list, entry));
        Ok(filling.done())
    }
}

impl<T: Copy> Lists<T> {
    /// Gives a list.
    #[inline]
    pub(crate) fn of_node(&self, node: u32) -> &[T] {
        &self.entries[self.starts[node as usize]..self.starts[node as usize + 1]]
    }

    /// Counts all entries.
    pub(crate) fn n_entries(&self) -> usize {
        self.entries.len()
    }

    /// Counts the bytes of lists, wherever they are.
    pub(crate) fn bytes(&self) -> usize {
        self.starts.capacity() * size_of::<usize>() + self.entries.len() * size_of::<T>()
    }
}

impl Lists<Span> {
    /// Makes one range of those of a list that touch.
    pub(crate) fn merged(&self, folder: Option<&Path>) -> Result<Lists<Span>, StoreError> {
        let n_lists = self.starts.len() - 1;
        let mut lengths = Lengths::new(n_lists);
        self.each_merged(|list, _| lengths.add(list));
        let mut filling = lengths.fill(folder)?;
        self.each_merged(|list, span| filling.put(list, span));
        Ok(filling.lists)
    }

    /// Walks the ranges that those of each list make.
    fn each_merged(&self, mut with: impl FnMut(u32, Span)) {
        for list in 0..self.starts.len() as u32 - 1 {
            let mut open: Option<Span> = None;
            for &span in self.of_node(list) {
                open = match open {
                    Some(last) if last.1 == span.0 => Some((last.0, span.1)),
                    last => {
                        last.into_iter().for_each(|last| with(list, last));
                        Some(span)
                    }
                };
            }
            open.into_iter().for_each(|last| with(list, last));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_in_a_file_are_as_those_in_memory() {
        let rows = [(2, (5, 7)), (0, (9, 12)), (2, (7, 8)), (2, (0, 5)), (0, (2, 4)), (3, (1, 2))];
        let folder = std::env::temp_dir();
        let lists = [None, Some(&folder)].map(|folder| {
            let folder = folder.map(|folder| folder.as_path());
            let mut lengths = Lengths::new(4);
            rows.iter().for_each(|row| lengths.add(row.0));
            let mut filling = lengths.fill(folder).unwrap();
            rows.iter().for_each(|&(list, span)| filling.put(list, span));
            filling.done().merged(folder).unwrap()
        });
        let expected: [&[Span]; 4] = [&[(2, 4), (9, 12)], &[], &[(0, 8)], &[(1, 2)]];
        for lists in lists {
            assert_eq!([0, 1, 2, 3].map(|list| lists.of_node(list)), expected);
            assert_eq!(lists.n_entries(), 4);
        }
    }
}
