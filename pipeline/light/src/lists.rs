//! A list of partners for every node.

use crate::hierarchy::{Hierarchy, Span};

/// Lists one after another, in the order of the nodes, or stations, they belong to.
#[derive(Debug, Clone, Default)]
pub(crate) struct Lists<T> {
    /// Where the list of each node starts; one more than there are nodes.
    starts: Vec<usize>,
    entries: Vec<T>,
}

impl<T: Copy + Ord + Default> Lists<T> {
    /// Sorts (node, entry) into lists, each rising.
    pub(crate) fn of<I: Iterator<Item = (u32, T)>>(
        n_nodes: usize,
        rows: impl Fn() -> I,
    ) -> Lists<T> {
        let mut starts = vec![0; n_nodes + 1];
        rows().for_each(|(node, _)| starts[node as usize + 1] += 1);
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut entries = vec![T::default(); starts.last().copied().unwrap_or(0)];
        let mut ends = starts.clone();
        for (node, entry) in rows() {
            let end = &mut ends[node as usize];
            entries[*end] = entry;
            *end += 1;
        }
        for bounds in starts.windows(2) {
            entries[bounds[0]..bounds[1]].sort_unstable();
        }
        Lists { starts, entries }
    }

    /// Gives the list of a node.
    #[inline]
    pub(crate) fn of_node(&self, node: u32) -> &[T] {
        &self.entries[self.starts[node as usize]..self.starts[node as usize + 1]]
    }

    /// Counts all entries.
    pub(crate) fn n_entries(&self) -> usize {
        self.entries.len()
    }

    /// Counts the bytes held.
    pub(crate) fn held_bytes(&self) -> usize {
        self.starts.capacity() * size_of::<usize>() + self.entries.capacity() * size_of::<T>()
    }
}

/// Lists for both nodes of each pair the elements of the other, ranges that touch as one.
pub(crate) fn of_spans<'p, I: Iterator<Item = &'p (u32, u32)>>(
    hierarchy: &Hierarchy,
    pairs: impl Fn() -> I,
) -> Lists<Span> {
    let elements = |node| hierarchy.node(node).elements;
    let both = |&(a, b): &(u32, u32)| [(a, elements(b)), (b, elements(a))];
    let mut lists = Lists::of(hierarchy.n_nodes() as usize, || pairs().flat_map(both));
    let mut n_kept = 0;
    let mut from = 0;
    for node in 0..hierarchy.n_nodes() as usize {
        let to = lists.starts[node + 1];
        let first = n_kept;
        for i in from..to {
            let span = lists.entries[i];
            match lists.entries[first..n_kept].last_mut() {
                Some(last) if last.1 == span.0 => last.1 = span.1,
                _ => {
                    lists.entries[n_kept] = span;
                    n_kept += 1;
                }
            }
        }
        lists.starts[node + 1] = n_kept;
        from = to;
    }
    lists.entries.truncate(n_kept);
    lists.entries.shrink_to_fit();
    lists
}
