//! What can go wrong while a map is built.

use std::path::PathBuf;

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
    /// A build that was begun is not the one that was asked for.
    #[error(
        "{}: an unfinished build has another {field} ({before}) than this one ({now}); \
         finish it as it was begun, or discard it with --restart", folder.display()
    )]
    Differs {
        /// Its work folder.
        folder: PathBuf,
        /// What differs.
        field: String,
        /// As the build was begun.
        before: String,
        /// As it was asked for now.
        now: String,
    },
    /// The run was asked to stop, and what it had done by then is kept.
    #[error(
        "interrupted; {n_done} of {n_tasks} tasks are kept in {}: the same command goes on from \
         there", folder.display()
    )]
    Stopped {
        /// The work folder.
        folder: PathBuf,
        /// Tasks that are done.
        n_done: u64,
        /// Tasks in all.
        n_tasks: u64,
    },
    /// A task panicked, which is a bug; what was done by then is kept.
    #[error("a bug: {0}")]
    Panicked(String),
    /// A map, or one with visible fractions [F-24], cannot have so many nodes.
    #[error(
        "{n_nodes} nodes, where such a map has at most {most}; lower max_level or raise \
         leaf_capacity"
    )]
    ManyNodes {
        /// Nodes of the tree.
        n_nodes: u64,
        /// The most that are possible.
        most: u32,
    },
    /// Given interaction pairs break a rule.
    #[error("interaction pairs {rows:?}: {fault}")]
    Interaction {
        /// Which pairs, from 0, rising: one, or two that cannot be together.
        rows: Vec<usize>,
        /// Which rule.
        fault: PairFault,
    },
}

/// What is wrong with given interaction pairs. [V-5]
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PairFault {
    /// One names a node that does not exist.
    #[error("node {node} does not exist, the tree has {n_nodes} nodes")]
    NoSuchNode {
        /// The node named.
        node: u32,
        /// Nodes of the tree.
        n_nodes: u32,
    },
    /// One is a node and itself or its descendant.
    #[error("node {node_a} holds node {node_b}; a pair needs two subtrees")]
    Nested {
        /// One node.
        node_a: u32,
        /// The other.
        node_b: u32,
    },
    /// Two cover the same leaf pairs.
    #[error("they cover the same leaf pairs; remove one")]
    CoveredTwice,
}
