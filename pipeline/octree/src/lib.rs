//! From batches of points to the sorted artifact, and from there to a tree of surfels.
//!
//! [`ingest`] takes batches from any thread and sorts them by (Morton code, source, record) within
//! a memory budget; [`normals`] estimates what the scan does not bring and gives it a side;
//! [`cut`] cuts the sorted points into leaves at the level and capacity a build asks for. One
//! ingest serves every cut. [`by_source`] is the way back to the order of the scans. The room
//! reads no scan format and knows nothing of visibility.
//!
//! Start reading at [`ingest::Ingest`] and [`cut::cut`].

pub mod by_source;
pub mod cut;
pub mod error;
pub mod ingest;
pub mod normals;

pub use error::OctreeError;
