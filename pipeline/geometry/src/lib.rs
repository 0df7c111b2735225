//! Integer geometry: everything that decides what sees what.
//!
//! The room holds the grid of [D-1] and the Morton code ([`grid`], [`morton`]; many points at once:
//! [`block`]), the points that flow through the pipeline ([`batch`]), normals as integers
//! ([`normal`]) and the plane that gives one where there is none ([`plane`]), boxes ([`bounds`]),
//! the exact leaf-pair test of [V-1]…[V-3] ([`disc`]), the rectangles that cut its discs
//! ([`rect`]) and the shafts that cull its candidates ([`shaft`]). It never opens a file, never
//! allocates by an input's word, never prints, and beyond the three operations of [D-1] no float
//! decides anything: where a float is used as a filter its error bound is proven beside it and
//! integers settle the rest.
//!
//! Start reading at [`grid::Frame`] (from a scan's coordinates to the grid) or at
//! [`disc::blocks`] (does this surfel stand between those two?).

pub mod batch;
pub mod block;
pub mod bounds;
pub mod disc;
pub mod grid;
pub mod morton;
pub mod normal;
pub mod plane;
pub mod rect;
pub mod shaft;

pub use batch::{Intensity, PointBatch, Positions};
pub use block::GridBlock;
pub use bounds::Box3;
pub use grid::{Frame, GridPoint};
pub use rect::Rect;
