//! Pictures of scans: discs in, a PNG out.
//!
//! Every surfel of a map ([`MapSplats`]) or point of an octree ([`OctreeSplats`]) is a splat, a
//! flat piece of surface: a patch or a disc. A [`Paint`] colours both alike. [`render`] draws them
//! as seen by a [`Camera`] in two passes over the [`Source`]: the first finds the nearest surface
//! at every pixel, the second blends the splats that lie on it, so that surfaces have no speckle
//! and edges are soft. [`render_glossy`] says besides at which pixels one looks into what mirrors
//! or lets light through, for those who follow rays. [`Picture`] takes marks and legends and writes
//! the PNG. The source is read
//! in blocks, and projected splats are kept as far as a budget allows, so what is held is known
//! before, whatever the size of the scan; the bytes are the same for any threads and memory. The
//! room opens no file, decides no visibility and prints nothing.
//!
//! Start reading at [`render`], then `disc.rs`: how a splat covers pixels.

mod camera;
mod canvas;
mod color;
mod disc;
mod error;
mod fit;
mod font;
mod map;
mod octree;
mod paint;
mod picture;
mod source;
mod vector;

pub use camera::{Camera, Lens, MAX_SIDE_PX, Size, View};
pub use canvas::{Glossy, Style, held_bytes, held_bytes_glossy, render, render_glossy};
pub use color::{BINS, Rgb, VIOLET, encode, encode_wide, gray, linear, ramp, srgb};
pub use error::RenderError;
pub use fit::Side;
pub use map::MapSplats;
pub use octree::OctreeSplats;
pub use paint::{ColorOf, IsGlossy, Paint, Sample, Seen};
pub use picture::Picture;
pub use source::{Clipped, ColorBy, Shape, Source, Splat, Values};
