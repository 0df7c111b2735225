//! Who sees whom: from a tree of surfels to the links of its visibility map.
//!
//! [`build()`] is the stage as a whole: it plans chunk tasks ([`tasks`]), decides each by the
//! recursion over node pairs ([`pairs`]: the paper's Algorithms 1 and 2 as corrected in [V-4] and
//! [V-5]), spills the links as sorted runs and writes the map. What makes it fast are proofs about
//! whole pairs: facing intervals ([`bounds`]) and shrinking lists of candidate occluders
//! ([`candidates`]); what is left is decided in blocks of leaf pairs ([`block`]): first by sheets
//! of surfels as wholes ([`sheets`], [`screen`]), then disc by disc ([`kernel`], [`packets`]),
//! exactly. What is done is noted in a [`journal`], and a build that ended before its time is taken
//! up where it ended. The room never asks how the tree came about, and approximates only where it
//! is told to ([`layers`]).
//!
//! Start reading at [`build::build`], then [`pairs`].

pub mod block;
pub mod bounds;
pub mod build;
pub mod candidates;
pub mod ends;
pub mod error;
pub mod exchange;
pub mod fractions;
pub mod interaction;
pub mod journal;
pub mod kernel;
mod lanes;
pub mod layers;
pub mod packets;
pub mod pairs;
mod pierce;
pub mod screen;
mod shares;
pub mod sheets;
mod sink;
mod surface;
pub mod tasks;
mod write;

pub use build::{BuildOptions, BuildReport, MapInput, build, open_work};
pub use error::VisibilityError;
pub use layers::Approximation;
