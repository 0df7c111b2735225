//! What can go wrong while a map is built.

use pvmap_store::StoreError;

/// A failure of the visibility stage.
#[derive(Debug, thiserror::Error)]
pub enum VisibilityError {
    /// The disk, the budget or a wish to stop.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// zstd could not compress a block of links.
    #[error("compressing links failed: {0}")]
    Compress(#[source] std::io::Error),
    /// A given interaction pair names a node that does not exist.
    #[error("interaction pair {row}: node {node} does not exist, the tree has {n_nodes} nodes")]
    NoSuchNode {
        /// Which pair, from 0.
        row: usize,
        /// The node named.
        node: u32,
        /// Nodes of the tree.
        n_nodes: u32,
    },
    /// A given interaction pair is a node and itself or its descendant.
    #[error("interaction pair {row}: node {node_a} holds node {node_b}; a pair needs two subtrees")]
    Nested {
        /// Which pair, from 0.
        row: usize,
        /// One node.
        node_a: u32,
        /// The other.
        node_b: u32,
    },
    /// Two given interaction pairs cover the same leaf pairs. [V-5]
    #[error("interaction pairs {first} and {second} cover the same leaf pairs; remove one")]
    CoveredTwice {
        /// One of them, from 0.
        first: usize,
        /// The other.
        second: usize,
    },
}
