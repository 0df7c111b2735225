//! What sees what in a point scan: the facade over the rooms of `pipeline/`.
//!
//! [`ingest()`] streams scan files into a sorted octree, [`build()`] cuts it and makes its
//! visibility map, [`query`] answers from the map. The rooms know nothing of each other beyond the
//! artifacts; what joins them, the configuration and the command line live here.
//!
//! # Threads and memory
//!
//! [`ingest()`] and [`build()`] each start [`Limits::threads`] threads of their own (0: as many as
//! the machine has), end them, and keep to [`Limits::memory_bytes`] alone: two at a time take
//! twice of both. Call them from plain threads. A worker of another rayon pool that calls one
//! does not sleep while it waits: it takes up the next job of its pool, so that a `par_iter` over
//! scans begins one ingest within another, deeper and deeper, each with threads and memory of its
//! own, and may run out of stack. To take in several scans at a time, share the machine out:
//!
//! ```no_run
//! # use pvmap::{IngestRequest, Limits, Quiet};
//! # let requests: Vec<IngestRequest> = Vec::new();
//! let limits = Limits { threads: 2, memory_bytes: 512 << 20 };
//! std::thread::scope(|scope| {
//!     for request in &requests {
//!         scope.spawn(|| pvmap::ingest(request, &limits, &Quiet));
//!     }
//! });
//! ```
//!
//! # Example
//!
//! ```no_run
//! use pvmap::{BuildConfig, IngestRequest, Limits, Quiet};
//!
//! # fn main() -> Result<(), pvmap::Error> {
//! let (limits, config) = (Limits::default(), BuildConfig::default());
//! let request = IngestRequest::new(["grotto.las".into()], "grotto.octree".into());
//! pvmap::ingest(&request, &limits, &Quiet)?;
//! pvmap::build("grotto.octree".as_ref(), "grotto.vmap".as_ref(), &config, &limits, &Quiet)?;
//! # Ok(())
//! # }
//! ```

pub mod accuracy;
mod build;
mod classes;
pub mod config;
mod error;
mod export;
mod figures;
mod ingest;
mod light_file;
mod light_map;
pub mod lights;
mod limits;
mod lit;
mod mirrors;
mod pairing;
pub mod rows;
pub mod scenes;
pub mod svg;
mod told;
pub mod tradeoff;

pub use build::{Built, Checkpoints, build, build_with, open_octree};
pub use classes::class_points;
pub use config::BuildConfig;
pub use error::Error;
pub use export::{
    ExportLight, ExportRequest, Exported, Made, PlaceAnswer, PointField, PointsFile, begin_file,
    begin_table, export_points, export_surfels, write_points, write_surfels,
};
pub use figures::in_digits;
pub use ingest::{IngestRequest, Ingested, default_output as default_octree, ingest, is_input};
pub use light_file::{LightChannel, LightContent, write_light};
pub use light_map::{LightDone, LightReport, LightRequest, light_map, light_map_telling};
pub use limits::{Limits, MAX_THREADS, Size, parse_memory};
pub use lit::{Exposure, LitMap, require_light};
pub use mirrors::{Gaze, Mirrors, left_out};
pub use pairing::require_pair;
pub use pvmap_geometry as geometry;
pub use pvmap_light as light;
pub use pvmap_octree::ingest::{NormalsFrom, Orientation};
pub use pvmap_query as query;
pub use pvmap_render as render;
pub use pvmap_scan as scan;
pub use pvmap_scene as scene;
pub use pvmap_store::map::exit_on_lost_pages;
pub use pvmap_store::output::{TableFile, folder_of, is_stdout};
pub use pvmap_store::{AtomicFile, ClosedFile, Mapped, Quiet, StoreError, Watch, memory};
pub use pvmap_visibility::{Approximation, VisibilityError};
pub use pvmap_vmap as vmap;
pub use told::{contradiction, quality, sees_counts, visible_from_air, wide_surfels};
