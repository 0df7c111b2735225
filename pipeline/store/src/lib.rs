//! Every door to the disk, and the limits a run has to keep.
//!
//! Inputs are opened and read here ([`input`]), finished files are mapped ([`map`]), artifacts are
//! written beside their final name and appear whole ([`output`], [`sections`]), what does not fit
//! in memory is spilled ([`spill`], [`runs`]) or mapped ([`table`]). A run that can be resumed
//! works in a folder of its own ([`work`]), locked, with a log of what is done ([`log`]). What a
//! run holds in memory ([`memory`]) and its line to the person who waits for it ([`watch`]) are
//! here too, because every stage that touches the disk needs both. The room knows nothing of
//! points, nodes or links: it moves bytes. It never prints.
//!
//! Start reading at [`output::AtomicFile`].

pub mod error;
pub mod input;
mod lock;
pub mod log;
pub mod map;
pub mod memory;
pub mod output;
pub mod runs;
pub mod sections;
pub mod spill;
pub mod table;
pub mod watch;
pub mod work;

pub use error::StoreError;
pub use input::InputFile;
pub use log::Log;
pub use map::Mapped;
pub use output::{AtomicFile, AtomicFolder, ClosedFile, TableFile};
pub use sections::SectionFile;
pub use spill::Spill;
pub use table::Table;
pub use watch::{Quiet, Watch};
pub use work::WorkFolder;
