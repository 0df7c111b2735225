//! What all questions need, in memory, for those who ask a great deal.

use crate::adjacency::Adjacency;
use crate::error::QueryError;
use crate::leaves::Leaves;
use crate::map::Map;

/// The most nodes that are kept: 32 MiB of their parents and of where their lists start, some
/// 400 MiB of leaves.
const MAX_NODES: u32 = 1 << 22;

/// Leaves in memory, and links where they are not too many.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) adjacency: Option<Adjacency>,
    pub(crate) leaves: Leaves,
}

impl Map<'_> {
    /// Reads leaves and links into memory, where later questions find them several times faster:
    /// some hundred bytes a surfel, eight a node, five a link. Leaves out links that are more than
    /// 16 million, and reads nothing of more than 4 million nodes; says whether all is in memory
    /// now. Threads are those of the current rayon pool.
    ///
    /// # Errors
    /// Where the map is damaged. Questions that need what is not damaged still have answers.
    pub fn keep(&self) -> Result<bool, QueryError> {
        if self.kept().is_none() && self.view().summary().n_nodes <= MAX_NODES {
            let (leaves, adjacency) = (Leaves::of(self)?, Adjacency::of(self.view())?);
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
