//! What all questions need, in memory, for those who ask a great deal.

use crate::adjacency::Adjacency;
use crate::error::QueryError;
use crate::leaves::Leaves;
use crate::map::Map;

/// The most nodes that are kept: 64 MiB of their parents and of where their lists start, at the
/// most 104 MiB of leaves.
const MAX_NODES: u32 = 1 << 23;

/// Links and leaves in memory.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) adjacency: Adjacency,
    pub(crate) leaves: Leaves,
}

impl Map<'_> {
    /// Reads links and leaves into memory, where later questions find them several times faster:
    /// four bytes a link, eight a node, thirteen a surfel. Reads nothing where these are more than
    /// 16 million links or 8 million nodes; says whether they are in memory now. Threads are those
    /// of the current rayon pool.
    ///
    /// # Errors
    /// Where the map is damaged. Questions that need what is not damaged still have answers.
    pub fn keep(&self) -> Result<bool, QueryError> {
        if self.kept().is_none()
            && self.view().summary().n_nodes <= MAX_NODES
            && let Some(adjacency) = Adjacency::of(self.view())?
        {
            let leaves = Leaves::of(self)?;
            self.kept.get_or_init(|| Kept { adjacency, leaves });
        }
        Ok(self.kept().is_some())
    }

    /// Gives what is in memory.
    #[inline]
    pub(crate) fn kept(&self) -> Option<&Kept> {
        self.kept.get()
    }
}
