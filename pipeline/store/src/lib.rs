//! Every door to the disk, and the limits a run has to keep.
//!
//! Inputs are opened and read here ([`input`]), finished files are mapped ([`map`]), artifacts are
//! written beside their final name and appear whole ([`output`]), what does not fit in memory is
//! spilled ([`spill`]). The memory budget of a run and its line to the person who waits for it are
//! here too ([`budget`], [`watch`]), because every stage that touches the disk needs both. The
//! room knows nothing of points, nodes or links: it moves bytes. It never prints.
//!
//! Start reading at [`output::AtomicFile`].

pub mod error;
pub mod input;
pub mod output;
pub mod watch;

pub use error::StoreError;
pub use input::InputFile;
pub use output::AtomicFile;
pub use watch::{Quiet, Watch};
