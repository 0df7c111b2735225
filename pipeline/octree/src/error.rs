//! What can go wrong between a scan and a tree.

use pvmap_store::StoreError;
use pvmap_vmap::FormatError;

/// A failure of the octree stages.
#[derive(Debug, thiserror::Error)]
pub enum OctreeError {
    /// The disk, the budget or a wish to stop.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The artifact that was read is damaged.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// A tree has more nodes than ids.
    #[error(
        "the tree has more than 2^32 - 2 nodes; use a larger leaf_capacity or a lower max_level"
    )]
    TooManyNodes,
    /// Points were lost on the way: a bug.
    #[error(
        "source {source_index}: {n_read} points were read and {n_taken} arrived; \
         please report this bug"
    )]
    Lost {
        /// Which source.
        source_index: u32,
        /// Points its reader handed over.
        n_read: u64,
        /// Points that arrived.
        n_taken: u64,
    },
    /// Sources were given whose positions a batch does not have.
    #[error("source {source_index}: its batches do not have the columns its header promised")]
    Columns {
        /// Which source.
        source_index: u32,
    },
}
