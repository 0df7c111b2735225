//! What sees what in a point scan: the facade over the rooms of `pipeline/`.
//!
//! [`ingest()`] streams scan files into a sorted octree, [`build()`] cuts it and makes its visibility
//! map, [`query`] answers from the map. The rooms know nothing of each other beyond the artifacts;
//! what joins them, the configuration and the command line live here.
//!
//! ```no_run
//! use pvmap::{BuildConfig, IngestRequest, Limits, Quiet};
//!
//! # fn main() -> Result<(), pvmap::Error> {
//! let limits = Limits::default();
//! pvmap::ingest(&IngestRequest::new(["grotto.las".into()], "grotto.octree".into()), &limits, &Quiet)?;
//! pvmap::build("grotto.octree".as_ref(), "grotto.vmap".as_ref(), &BuildConfig::default(), &limits, &Quiet)?;
//! # Ok(())
//! # }
//! ```

mod build;
pub mod config;
mod error;
mod ingest;
mod limits;
pub mod scenes;

pub use build::{Built, build, open_octree};
pub use config::BuildConfig;
pub use error::Error;
pub use ingest::{IngestRequest, Ingested, default_output as default_octree, ingest, is_input};
pub use limits::{Limits, Size, parse_memory};
pub use pvmap_geometry as geometry;
pub use pvmap_octree::ingest::{NormalsFrom, Orientation};
pub use pvmap_query as query;
pub use pvmap_scan as scan;
pub use pvmap_scene as scene;
pub use pvmap_store::{AtomicFile, Mapped, Quiet, StoreError, Watch, memory};
pub use pvmap_vmap as vmap;
