//! What was measured of one build.

use serde::{Deserialize, Serialize};

/// A build: what went in, what came out, what it took.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    /// The scene's name.
    pub(crate) scene: String,
    /// Leaves asked for; the cut comes near that.
    pub(crate) size: u64,
    pub(crate) points: u64,
    pub(crate) leaves: u64,
    /// Each pair once.
    pub(crate) leaf_pairs: u64,
    /// Each pair once.
    pub(crate) links: u64,
    pub(crate) map_bytes: u64,
    /// From the first pair decided to the last.
    pub(crate) visibility_seconds: f64,
    /// From the octree to the finished map.
    pub(crate) build_seconds: f64,
    pub(crate) peak_rss_anon_bytes: u64,
    pub(crate) temporary_bytes: u64,
    /// Tests of sixteen segments against a disc.
    pub(crate) tests: u64,
    /// Segments that only integers settled.
    pub(crate) exact: u64,
    /// Of a whole `pvmap build`, where they were counted.
    pub(crate) instructions: Option<u64>,
}
