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
    /// Sources were given whose positions a batch does not have.
    #[error("source {source_index}: its batches do not have the columns its header promised")]
    Columns {
        /// Which source.
        source_index: u32,
    },
}
