//! What is drawn: discs, read a range at a time.

use std::ops::Range;

use pvmap_geometry::Frame;

use crate::camera::grid_of;
use crate::color::Rgb;
use crate::error::RenderError;
use crate::vector::sub;

/// Splats read at once by a thread.
pub(crate) const CHUNK_SPLATS: u64 = 4096;

/// A piece of a surface, in grid steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// Its middle.
    pub centre: [f32; 3],
    /// Of length 1, or zero: then it faces the camera.
    pub normal: [f32; 3],
    /// How far it reaches from its middle.
    pub shape: Shape,
    /// What may lie so much deeper and be of the same surface.
    pub noise: f32,
    /// Whether both faces count.
    pub two_sided: bool,
    /// In linear light, 0…1.
    pub color: Rgb,
    /// The surfel it belongs to, where that mirrors or lets light through.
    pub glossy: Option<u32>,
}

/// What a splat cuts out of its plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A disc of this radius, more than 0.
    Round(f32),
    /// What of its plane lies in a box: its least and its greatest corner from the middle, each
    /// number less or more than 0. A disc where there is no normal.
    Box([[f32; 3]; 2]),
    /// What of its plane lies in an ellipsoid with these half axes along x, y and z, each more than
    /// 0. A disc where there is no normal.
    Ellipse([f32; 3]),
}

/// Splats that can be read in any order, from many threads at once.
pub trait Source: Sync {
    /// Counts them.
    fn n_splats(&self) -> u64;

    /// Says whether they should have the scan's colours, and it has none.
    ///
    /// # Errors
    /// Where what they are read from is damaged.
    fn is_gray(&self) -> Result<bool, RenderError> {
        Ok(false)
    }

    /// Reads a range of them, in order, to the end of `out`.
    ///
    /// # Errors
    /// Where what they are read from is damaged.
    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError>;
}

/// The splats of a source whose middles are in a box.
pub struct Clipped<'a> {
    source: Box<dyn Source + 'a>,
    corners: [[f32; 3]; 2],
}

impl<'a> Clipped<'a> {
    /// Takes those between two corners in world units, whichever is the greater on an axis.
    pub fn new(source: Box<dyn Source + 'a>, corners: [[f64; 3]; 2], frame: &Frame) -> Self {
        let (origin, unit) = grid_of(frame);
        let [a, b] = corners.map(|corner| sub(corner, origin).map(|v| (v / unit) as f32));
        let corners = [[0, 1, 2].map(|i| a[i].min(b[i])), [0, 1, 2].map(|i| a[i].max(b[i]))];
        Clipped { source, corners }
    }
}

impl Source for Clipped<'_> {
    fn n_splats(&self) -> u64 {
        self.source.n_splats()
    }

    fn is_gray(&self) -> Result<bool, RenderError> {
        self.source.is_gray()
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError> {
        let mut all = Vec::new();
        self.source.read(range, &mut all)?;
        let [low, high] = self.corners;
        let is_in = |splat: &Splat| (0..3).all(|i| (low[i]..=high[i]).contains(&splat.centre[i]));
        out.extend(all.into_iter().filter(is_in));
        Ok(())
    }
}

/// What decides a splat's colour.
#[derive(Debug, Clone)]
pub enum ColorBy {
    /// The scan's colour, grey where there is none.
    Rgb,
    /// The normal: x, y, z as red, green, blue.
    Normal,
    /// The bin, a colour each.
    Bin,
    /// A number each surfel.
    Values(Values),
}

/// A number each surfel, and the ends of the colour ramp.
#[derive(Debug, Clone)]
pub struct Values {
    /// By surfel id; NaN where there is none.
    pub of: Vec<f32>,
    /// The dark end.
    pub min: f32,
    /// The bright end.
    pub max: f32,
}

impl Values {
    /// Takes numbers with a ramp from the least to the greatest of them.
    pub fn new(of: Vec<f32>) -> Values {
        let finite = || of.iter().copied().filter(|v| v.is_finite());
        let (min, max) = (finite().reduce(f32::min), finite().reduce(f32::max));
        Values { min: min.unwrap_or(0.0), max: max.unwrap_or(0.0), of }
    }

    /// Gives where on the ramp a surfel's number is, 0…1; none where it has no number.
    pub(crate) fn share(&self, surfel: usize) -> Option<f32> {
        let value = self.of.get(surfel).copied().filter(|v| v.is_finite())?;
        let width = self.max - self.min;
        Some(if width > 0.0 { ((value - self.min) / width).clamp(0.0, 1.0) } else { 0.5 })
    }
}

/// Cuts `range` into what a thread reads at once.
pub(crate) fn chunks(range: Range<u64>) -> Vec<Range<u64>> {
    let starts = range.clone().step_by(CHUNK_SPLATS as usize);
    starts.map(|at| at..range.end.min(at + CHUNK_SPLATS)).collect()
}
