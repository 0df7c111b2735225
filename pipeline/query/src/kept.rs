//! What all questions need, in memory, for those who ask a great deal.

use crate::adjacency::Adjacency;
use crate::error::QueryError;
use crate::leaves::Leaves;
use crate::map::Map;

/// Leaves in memory, and links where they are not too many.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) adjacency: Option<Adjacency>,
    pub(crate) leaves: Leaves,
}

impl Map<'_> {
    /// Reads leaves and links into memory, where later questions find them several times faster,
    /// if they fit into so many bytes: at the most 250 a surfel, 8 a node, 5 a link. Of links that
    /// do not fit the leaves are kept alone; where neither fits nothing is read. Says whether all
    /// is in memory now. Threads are those of the current rayon pool.
    ///
    /// # Errors
    /// Where the map is damaged. Questions that need what is not damaged still have answers.
    pub fn keep(&self, memory_bytes: u64) -> Result<bool, QueryError> {
        let of_leaves = Leaves::held_bytes(self.view().summary().n_surfels.into());
        let of_all = of_leaves.saturating_add(Adjacency::held_bytes(self.view()));
        if self.kept().is_none() && of_leaves <= memory_bytes {
            let fits = of_all <= memory_bytes;
            let adjacency = if fits { Some(Adjacency::of(self.view())?) } else { None };
            let leaves = Leaves::of(self)?;
            self.kept.get_or_init(|| Kept { adjacency, leaves });
        }
        Ok(self.kept().is_some_and(|kept| kept.adjacency.is_some()))
    }

    /// Gives what is in memory.
    #[inline]
    pub(crate) fn kept(&self) -> Option<&Kept> {
        self.kept.get()
    }
}
