//! Scan files and batches of points: LAS, LAZ and PLY in, the same out.
//!
//! [`Source::open`] looks at a file's first bytes (never at its name), checks every size and count
//! against the file before any third-party decoder sees it, and says in [`SourceInfo`] what the
//! scan holds. [`Source::read`] then streams any range of records as
//! [`pvmap_geometry::PointBatch`]es; [`Source::parts`] says where to cut so that several threads
//! can read at once. [`LasWriter`] and [`PlyWriter`] are the way back; [`Rewrite`] writes a file
//! again with all that it has and numbers behind each record. [`read_mesh`] and [`MeshWriter`] are
//! for triangles.
//!
//! The room keeps every coordinate and attribute as the file stores it: no grid, no sorting, no
//! normal estimation. It never allocates by an unchecked word of the file, never holds more than
//! a batch and a chunk, and whatever the bytes say the answer is points or a [`ScanError`].
//!
//! Start reading at [`source`]; a format's own rules are in `las` and `ply`.

mod bytes;
pub mod error;
mod field;
mod las;
mod out;
mod ply;
mod rewrite;
pub mod source;

pub use error::{ErrorKind, ScanError};
pub use field::{FieldKind, ScalarField};
pub use las::laz::is_decoding;
pub use las::write::{LasContent, LasOptions, LasWriter};
pub use ply::mesh::{MeshData, MeshMemory, MeshWriter, read_mesh};
pub use ply::write::{PlyColumns, PlyExtras, PlyWriter};
pub use rewrite::{Rewrite, RewriteOptions};
pub use source::{
    ColorRange, Columns, Crs, IntensityKind, PositionKind, ReadOptions, ReadReport, Source,
    SourceInfo, StoredBounds,
};
