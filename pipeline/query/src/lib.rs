//! Answers from a visibility map: what sees what, at places the user names.
//!
//! [`Map`] wraps the bytes of a whole map file. [`Map::locate`] leads a place in world units to
//! the surfel that stands there ([V-8]); [`Map::pair`] says whether two located places see each
//! other, and which link settles it ([V-6]); [`Map::pairs`] does so for many, far faster in a large
//! map. [`Map::pair_by_segment`] asks the segment between the places themselves, which is right
//! more often and takes longer; [`Map::pair_fraction`] gives how much two leaves see of each other.
//! [`Map::visible_from`] gives all that a place sees as a
//! [`SurfelSet`], [`Map::visible_from_air`] what a scanner there would see, [`Map::sees_counts`]
//! how much every surfel sees. [`Map::region`] weighs the points around two places against each
//! other, [`Map::ray`] finds what a ray hits first, [`Map::shadow`] how much of a light reaches a
//! place; [`exact::Exact`] asks the points of the octree whether two of them see each other
//! ([V-7]); [`quality::measure`] says what those points are like. The room opens no file and prints
//! nothing; it reads only the blocks a question needs, trusts no byte of them, and a [`Map`] may be
//! asked from many threads at once. Decoded links are kept in a cache of fixed size (`frames`), so
//! a batch of any length takes bounded memory; who asks a great deal calls [`Map::keep`] first.
//!
//! Start reading at [`Map`], then [`Map::locate`] and [`Map::pair`].

mod adjacency;
mod batch;
mod between;
mod by_segment;
mod discs;
mod error;
pub mod exact;
mod filter;
mod fraction;
mod frames;
mod kept;
mod leaves;
mod locate;
mod map;
mod pair;
mod part;
pub mod quality;
mod ray;
mod region;
mod sees_counts;
mod segment;
mod set;
mod shadow;
mod visible_from;
mod wide;

pub use by_segment::{SegmentAnswer, SettledBy, Spot};
pub use error::{ErrorKind, QueryError};
pub use fraction::FractionAnswer;
pub use locate::{Located, Place, Snap};
pub use map::Map;
pub use pair::{Link, PairAnswer};
pub use ray::{Hit, RayAnswer};
pub use region::{Ball, RegionAnswer, Sight};
pub use set::SurfelSet;
pub use shadow::{Light, LightSource, ShadowAnswer};
pub use visible_from::VisibleSet;
pub use wide::{LEAST_CUT, WIDE_TIMES, WideSurfels};
