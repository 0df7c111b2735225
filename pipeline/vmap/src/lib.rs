//! The byte layout of the three artifacts: bytes in, bytes out.
//!
//! `FORMAT.md` beside this crate says what every byte means; the code follows it sentence by
//! sentence. [`container`] is the file around the sections, [`records`] the fixed rows, [`schema`]
//! the columns of point records, [`tree`] the nodes and surfels with the routing of points to
//! leaves, [`config`] the keys of a build, [`links`] the codec of sorted pairs in blocks and
//! [`pairs`] how they are read, [`fraction`] pairs with visible fractions; [`map`], [`octree`] and
//! [`light`] are the views a reader gets of a whole file. The room opens no file and trusts no
//! byte: a view checks each block when it is first touched, and no input makes it panic, answer
//! wrongly or allocate what the file does not hold.
//!
//! Start reading at `FORMAT.md`, then [`map::MapView`].

pub mod bytes;
pub mod config;
pub mod container;
pub mod error;
pub mod fraction;
pub mod frame;
pub mod light;
pub mod links;
pub mod map;
pub mod octree;
pub mod pairs;
pub mod records;
pub mod router;
pub mod schema;
pub mod tree;

pub use config::MapConfig;
pub use container::{Container, Kind};
pub use error::FormatError;
pub use fraction::Fraction;
pub use light::{LightSummary, LightView};
pub use map::MapView;
pub use octree::OctreeView;
pub use pairs::Pairs;
pub use records::{MapSummary, Node, OctreeSummary, Source, Split, Surfel};
pub use router::Router;
pub use tree::{Shape, Spacing, Tree};
