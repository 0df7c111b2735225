//! The two passes over the discs, band of rows by band of rows.
//!
//! A block of splats is read and projected in parallel, then every band draws the discs that touch
//! it, in their order: the result depends on no number of threads. The first pass keeps the least
//! depth at each pixel, the second adds up the colours of the discs within a tolerance of it. What
//! fades out beyond the rim of a nearer surface is kept apart and laid over what is behind it.

use rayon::prelude::*;

use crate::camera::Camera;
use crate::color::{Rgb, encode, srgb};
use crate::disc::{Disc, Look, Row};
use crate::error::RenderError;
use crate::picture::Picture;
use crate::source::{CHUNK_SPLATS, Source, chunks};

/// Rows of a band: small enough that many threads find work, large enough that few discs lie in
/// two.
const BAND_ROWS: usize = 16;
/// Splats held at once.
const BLOCK_SPLATS: u64 = 32 * CHUNK_SPLATS;
/// What a disc weighs at its rim; 1 more at its middle.
const RIM_WEIGHT: f32 = 1e-3;

/// How a picture looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Style {
    /// Where nothing is, sRGB.
    pub background: [u8; 3],
    /// Leaves out one-sided discs that are turned away, so that one looks into closed rooms.
    pub cull_back: bool,
    /// How much darker a disc is that is seen from its edge, 0…1: a lamp at the camera.
    pub shade: f32,
}

/// Draws a picture; `tell` gets the number of splats gone through, in all twice as many as there
/// are, and says whether to go on.
///
/// # Errors
/// Where the source cannot be read, or `tell` says no.
pub fn render(
    source: &dyn Source,
    camera: &Camera,
    style: &Style,
    tell: &mut dyn FnMut(u64) -> bool,
) -> Result<Picture, RenderError> {
    let size = camera.size();
    let (width, height) = (size.width_px as usize, size.height_px as usize);
    let mut bands: Vec<Band> =
        (0..height).step_by(BAND_ROWS).map(|first| Band::new(first, width, height)).collect();
    let look = Look { cull_back: style.cull_back, shade: style.shade };
    for pass in [Band::sound as fn(&mut Band, &Disc), Band::blend] {
        for first in (0..source.n_splats()).step_by(BLOCK_SPLATS as usize) {
            let block = first..source.n_splats().min(first + BLOCK_SPLATS);
            let n_read = block.end - block.start;
            let read = |range| Chunk::read(source, range, camera, look, bands.len());
            let drawn: Vec<Chunk> =
                chunks(block).into_par_iter().map(read).collect::<Result<_, _>>()?;
            bands.par_iter_mut().for_each(|band| {
                for chunk in &drawn {
                    for &disc in &chunk.of_band[band.first_row / BAND_ROWS] {
                        pass(band, &chunk.discs[disc as usize]);
                    }
                }
            });
            if !tell(n_read) {
                return Err(RenderError::Stopped);
            }
        }
    }
    let background = srgb(style.background);
    let mut picture = Picture::new(size);
    picture
        .rows_mut(BAND_ROWS)
        .zip(bands.par_iter())
        .for_each(|((pixels, depths), band)| band.develop(background, pixels, depths));
    Ok(picture)
}

/// Some discs, and which of them touch each band.
struct Chunk {
    discs: Vec<Disc>,
    of_band: Vec<Vec<u32>>,
}

impl Chunk {
    fn read(
        source: &dyn Source,
        range: std::ops::Range<u64>,
        camera: &Camera,
        look: Look,
        n_bands: usize,
    ) -> Result<Chunk, RenderError> {
        let mut splats = Vec::with_capacity((range.end - range.start) as usize);
        source.read(range, &mut splats)?;
        let discs: Vec<Disc> =
            splats.iter().filter_map(|splat| Disc::of(splat, camera, look)).collect();
        let mut of_band = vec![Vec::new(); n_bands];
        for (i, disc) in (0..).zip(&discs) {
            let [from, to] = disc.rows.map(usize::from);
            for band in &mut of_band[from / BAND_ROWS..=(to - 1) / BAND_ROWS] {
                band.push(i);
            }
        }
        Ok(Chunk { discs, of_band })
    }
}

/// Colours weighed and added up.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    color: Rgb,
    weight: f32,
}

impl Sum {
    #[inline(always)]
    fn add(&mut self, color: Rgb, weight: f32) {
        for i in 0..3 {
            self.color[i] += color[i] * weight;
        }
        self.weight += weight;
    }

    fn mean(&self) -> Rgb {
        self.color.map(|v| v / self.weight)
    }
}

/// What has been added up for a pixel.
#[derive(Debug, Clone, Copy, Default)]
struct Pixel {
    /// The nearest surface.
    surface: Sum,
    /// What fades out in front of it.
    fringe: Sum,
    /// How much of it that covers.
    covered: f32,
}

/// Some rows of the picture.
struct Band {
    first_row: usize,
    n_rows: usize,
    width: usize,
    /// The middle of the picture's first pixel, from its middle.
    corner: [f32; 2],
    /// The depth to which discs belong to the nearest surface; infinite where nothing is.
    depths: Vec<f32>,
    pixels: Vec<Pixel>,
}

impl Band {
    fn new(first_row: usize, width: usize, height: usize) -> Band {
        let n_rows = BAND_ROWS.min(height - first_row);
        let n = n_rows * width;
        // Sides are at most 2^14, their halves exact.
        let corner = [width, height].map(|side| 0.5 - side as f32 / 2.0);
        let (depths, pixels) = (vec![f32::INFINITY; n], vec![Pixel::default(); n]);
        Band { first_row, n_rows, width, corner, depths, pixels }
    }

    /// Walks the pixels a disc may cover, row by row: the offset from its middle, what is held of
    /// the pixel.
    #[inline(always)]
    fn walk(&mut self, disc: &Disc, mut visit: impl FnMut(&Row<'_>, f32, &mut f32, &mut Pixel)) {
        let [top, bottom] = disc.rows.map(usize::from);
        let [left, right] = disc.columns.map(usize::from);
        let end = self.first_row + self.n_rows;
        for y in top.max(self.first_row)..bottom.min(end) {
            let row = disc.row(y as f32 + self.corner[1]);
            let start = (y - self.first_row) * self.width;
            let depths = &mut self.depths[start + left..start + right];
            let pixels = &mut self.pixels[start + left..start + right];
            for ((x, depth), pixel) in (left..).zip(depths).zip(pixels) {
                visit(&row, row.offset(x as f32 + self.corner[0]), depth, pixel);
            }
        }
    }

    /// First pass: how near is the nearest surface?
    fn sound(&mut self, disc: &Disc) {
        self.walk(disc, |row, dx, depth, _| {
            let farther = row.farther(dx);
            let to = row.depth(dx, farther) + disc.tolerance;
            if to < *depth && row.share2(dx, farther) <= 1.0 {
                *depth = to;
            }
        });
    }

    /// Second pass: what colour has it?
    fn blend(&mut self, disc: &Disc) {
        self.walk(disc, |row, dx, depth, pixel| {
            let farther = row.farther(dx);
            let at = row.depth(dx, farther);
            if at > *depth {
                return;
            }
            let share2 = row.share2(dx, farther);
            if share2 <= 1.0 {
                let inner = 1.0 - share2;
                pixel.surface.add(disc.color, (inner * inner + RIM_WEIGHT) * disc.weight);
            } else if at + 2.0 * disc.tolerance < *depth {
                // Nearer than the nearest surface by more than it is thick: an edge before it.
                let share = row.fringe(dx, farther);
                if share > 0.0 {
                    pixel.fringe.add(disc.color, share);
                    pixel.covered = pixel.covered.max(share);
                }
            }
        });
    }

    /// Turns sums into colours: three bytes a pixel.
    fn develop(&self, background: Rgb, pixels: &mut [u8], depths: &mut [f32]) {
        depths.copy_from_slice(&self.depths);
        for (out, pixel) in pixels.chunks_exact_mut(3).zip(&self.pixels) {
            let weight = pixel.surface.weight;
            let behind = if weight > 0.0 { pixel.surface.mean() } else { background };
            let color = match pixel.covered {
                0.0 => behind,
                share => {
                    let front = pixel.fringe.mean();
                    [0, 1, 2].map(|i| behind[i] + (front[i] - behind[i]) * share)
                }
            };
            out.copy_from_slice(&encode(color));
        }
    }
}
