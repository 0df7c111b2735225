//! Answers from a visibility map: what sees what, at places the user names.
//!
//! [`Map`] wraps the bytes of a whole map file. [`Map::locate`] leads a place in world units to
//! the surfel that stands there ([V-8]); [`Map::pair`] says whether two located places see each
//! other, and which link settles it ([V-6]); [`Map::pairs`] does so for many, far faster in a large
//! map. The room opens no file and prints nothing; it reads
//! only the blocks a question needs, trusts no byte of them, and a [`Map`] may be asked from many
//! threads at once. Decoded links are kept in a cache of fixed size (`frames`), so a batch of any
//! length takes bounded memory. [`exact::Exact`] puts the same question to the points of the
//! octree instead ([V-7]).
//!
//! Start reading at [`Map`], then [`Map::locate`] and [`Map::pair`].

mod batch;
mod error;
pub mod exact;
mod frames;
mod locate;
mod map;
mod pair;

pub use error::{ErrorKind, QueryError};
pub use locate::{Located, Place, Snap};
pub use map::Map;
pub use pair::{Link, PairAnswer};
