//! The passes over the discs, band of rows by band of rows.
//!
//! A block of splats is read and projected in parallel, then every band draws the discs that touch
//! it, in their order: the result depends on no number of threads. The first pass keeps the least
//! depth at each pixel, the second adds up the colours of the discs within a tolerance of it. What
//! fades out beyond the rim of a nearer surface is kept apart and laid over what is behind it.
//! A third pass, on demand, finds the pixels of what mirrors or lets light through.
//! Projected discs are kept between the passes as far as the memory goes; the others are read and
//! projected again.

use rayon::prelude::*;

use crate::camera::{Camera, Size};
use crate::color::{Rgb, encode, srgb};
use crate::disc::{Disc, Look, NOT_GLOSSY, Row};
use crate::error::RenderError;
use crate::picture::Picture;
use crate::source::{CHUNK_SPLATS, Source, Splat, chunks};

/// Rows of a band: small enough that many threads find work, large enough that few discs lie in
/// two.
const BAND_ROWS: usize = 16;
/// Splats held at once.
const BLOCK_SPLATS: u64 = 32 * CHUNK_SPLATS;
/// Columns of a tile: a band of them as high as wide is passed over at once by what lies behind.
const TILE_COLUMNS: usize = BAND_ROWS;
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

/// Gives the bytes that a picture of a size holds while it is drawn, at least.
pub fn held_bytes(size: Size) -> u64 {
    let n_pixels = u64::from(size.width_px) * u64::from(size.height_px);
    // What is added up, and the depth there and in the picture, and its colours.
    let of_pixel = size_of::<Pixel>() + 2 * size_of::<f32>() + 3;
    // Splats as they are read, as discs, and as numbers in the lists of two bands each.
    let of_splat = size_of::<Splat>() + size_of::<Disc>() + 2 * size_of::<u32>();
    n_pixels * of_pixel as u64 + BLOCK_SPLATS * of_splat as u64
}

/// Gives the bytes that a picture of a size holds while it is drawn by [`render_glossy`], at most.
pub fn held_bytes_glossy(size: Size) -> u64 {
    let n_pixels = u64::from(size.width_px) * u64::from(size.height_px);
    held_bytes(size) + n_pixels * (size_of::<GlossyPixel>() + size_of::<Glossy>()) as u64
}

/// Draws a picture, holding about `memory_bytes` or, where that is more, [`held_bytes`]; `tell`
/// gets the number of splats gone through, in all twice as many as there are, and says whether to
/// go on. The picture is the same for any memory.
///
/// # Errors
/// Where the source cannot be read, or `tell` says no.
pub fn render(
    source: &dyn Source,
    camera: &Camera,
    style: &Style,
    memory_bytes: u64,
    tell: &mut dyn FnMut(u64) -> bool,
) -> Result<Picture, RenderError> {
    let passes = [Band::sound, Band::blend];
    Ok(draw(&passes, source, (camera, style), memory_bytes, tell)?.0)
}

/// Draws a picture as [`render`] does, and finds the pixels at which what is nearest mirrors or
/// lets light through, in their order; `tell` gets three times the number of splats.
///
/// # Errors
/// As there.
pub fn render_glossy(
    source: &dyn Source,
    camera: &Camera,
    style: &Style,
    memory_bytes: u64,
    tell: &mut dyn FnMut(u64) -> bool,
) -> Result<(Picture, Vec<Glossy>), RenderError> {
    let passes = [Band::sound, Band::blend, Band::find_glossy];
    let (picture, bands) = draw(&passes, source, (camera, style), memory_bytes, tell)?;
    Ok((picture, bands.iter().flat_map(Band::glossy).collect()))
}

/// What a band does with a disc.
type Pass = fn(&mut Band, &Disc);

/// Goes through the splats once a pass.
fn draw(
    passes: &[Pass],
    source: &dyn Source,
    (camera, style): (&Camera, &Style),
    memory_bytes: u64,
    tell: &mut dyn FnMut(u64) -> bool,
) -> Result<(Picture, Vec<Band>), RenderError> {
    let size = camera.size();
    let (width, height) = (size.width_px as usize, size.height_px as usize);
    let mut bands: Vec<Band> =
        (0..height).step_by(BAND_ROWS).map(|first| Band::new(first, width, height)).collect();
    let look = Look { cull_back: style.cull_back, shade: style.shade };
    let n_bands = bands.len();
    let read = |range| Chunk::read(source, range, camera, look, n_bands);
    let mut kept = Vec::new();
    let held_bytes = if passes.len() > 2 { held_bytes_glossy(size) } else { held_bytes(size) };
    let mut spare_bytes = memory_bytes.saturating_sub(held_bytes);
    let last = passes.len() - 1;
    for (round, &pass) in passes.iter().enumerate() {
        let is_first = kept.is_empty();
        for (i, first) in (0..source.n_splats()).step_by(BLOCK_SPLATS as usize).enumerate() {
            let block = first..source.n_splats().min(first + BLOCK_SPLATS);
            let n_read = block.end - block.start;
            let held = kept.get_mut(i).and_then(Option::take);
            let is_kept = held.is_some();
            let drawn: Vec<Chunk> = match held {
                Some(drawn) => drawn,
                None => chunks(block).into_par_iter().map(read).collect::<Result<_, _>>()?,
            };
            bands.par_iter_mut().for_each(|band| band.draw(&drawn, pass));
            if is_first {
                let n_bytes = drawn.iter().map(Chunk::n_bytes).sum();
                let rest = spare_bytes.checked_sub(n_bytes);
                spare_bytes = rest.unwrap_or(spare_bytes);
                kept.push(rest.is_some().then_some(drawn));
            } else if is_kept && round < last {
                kept[i] = Some(drawn);
            }
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
    Ok((picture, bands))
}

/// Some discs, and which of them touch each band.
struct Chunk {
    discs: Vec<Disc>,
    /// Discs by band, in their order in each.
    by_band: Vec<u32>,
    /// Where each band begins there, and the end.
    starts: Vec<u32>,
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
        let mut discs = Vec::with_capacity(splats.len());
        discs.extend(splats.iter().filter_map(|splat| Disc::of(splat, camera, look)));
        let bands_of = |disc: &Disc| {
            let [from, to] = disc.rows.map(usize::from);
            from / BAND_ROWS..(to - 1) / BAND_ROWS + 1
        };
        let mut starts = vec![0; n_bands + 1];
        for disc in &discs {
            bands_of(disc).for_each(|band| starts[band + 1] += 1);
        }
        for band in 0..n_bands {
            starts[band + 1] += starts[band];
        }
        let mut next = starts.clone();
        let mut by_band = vec![0; starts[n_bands] as usize];
        for (i, disc) in (0..).zip(&discs) {
            for band in bands_of(disc) {
                by_band[next[band] as usize] = i;
                next[band] += 1;
            }
        }
        Ok(Chunk { discs, by_band, starts })
    }

    /// Walks the discs that touch a band.
    fn of_band(&self, band: usize) -> impl Iterator<Item = &Disc> {
        let range = self.starts[band] as usize..self.starts[band + 1] as usize;
        self.by_band[range].iter().map(|&i| &self.discs[i as usize])
    }

    fn n_bytes(&self) -> u64 {
        let n_numbers = self.by_band.capacity() + self.starts.capacity();
        (self.discs.capacity() * size_of::<Disc>() + n_numbers * size_of::<u32>()) as u64
    }
}

/// A pixel at which what is nearest mirrors or lets light through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glossy {
    /// Its column and row, from the upper left.
    pub pixel: [u32; 2],
    /// The surfel of the splat that weighs most there.
    pub surfel: u32,
    /// How far ahead of the eye the surface is, grid steps: see [`Camera::ray`].
    pub depth: f32,
    /// Share of the pixel's colour that is of such splats, more than 0 to 1.
    pub share: f32,
}

/// What has been added up of glossy splats at a pixel.
#[derive(Debug, Clone, Copy)]
struct GlossyPixel {
    weight: f32,
    /// Depths, weighed.
    depth: f32,
    /// The surfel of the splat that weighs most, and how much.
    surfel: u32,
    most: f32,
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

impl GlossyPixel {
    fn add(&mut self, disc: &Disc, depth: f32, weight: f32) {
        self.weight += weight;
        self.depth += weight * depth;
        if weight > self.most {
            (self.surfel, self.most) = (disc.glossy, weight);
        }
    }
}

/// Gives what a disc weighs where it has such a share.
#[inline(always)]
fn weight_of(disc: &Disc, share2: f32) -> f32 {
    let inner = 1.0 - share2;
    (inner * inner + RIM_WEIGHT) * disc.weight
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
    /// The greatest of them in each tile, as of the last block.
    tiles: Vec<f32>,
    pixels: Vec<Pixel>,
    /// Of each pixel; empty where nothing is glossy.
    glossy: Vec<GlossyPixel>,
}

impl Band {
    fn new(first_row: usize, width: usize, height: usize) -> Band {
        let n_rows = BAND_ROWS.min(height - first_row);
        let n = n_rows * width;
        // Sides are at most 2^14, their halves exact.
        let corner = [width, height].map(|side| 0.5 - side as f32 / 2.0);
        let (depths, pixels) = (vec![f32::INFINITY; n], vec![Pixel::default(); n]);
        let tiles = vec![f32::INFINITY; width.div_ceil(TILE_COLUMNS)];
        Band { first_row, n_rows, width, corner, depths, tiles, pixels, glossy: Vec::new() }
    }

    /// Draws a block of discs in a pass.
    fn draw(&mut self, drawn: &[Chunk], pass: Pass) {
        let band = self.first_row / BAND_ROWS;
        drawn.iter().flat_map(|chunk| chunk.of_band(band)).for_each(|disc| pass(self, disc));
        let (depths, width) = (&self.depths, self.width);
        for (i, tile) in self.tiles.iter_mut().enumerate() {
            let columns = i * TILE_COLUMNS..width.min((i + 1) * TILE_COLUMNS);
            let rows = depths.chunks_exact(width).map(|row| &row[columns.clone()]);
            *tile = rows.flatten().copied().fold(f32::NEG_INFINITY, f32::max);
        }
    }

    /// Says whether no place of a disc that is not nearer than `least` can be seen.
    fn is_behind(&self, disc: &Disc, least: f32) -> bool {
        let [left, right] = disc.columns.map(usize::from);
        self.tiles[left / TILE_COLUMNS..=(right - 1) / TILE_COLUMNS].iter().all(|&t| least > t)
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
        if self.is_behind(disc, disc.nearest() + disc.tolerance) {
            return;
        }
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
        if self.is_behind(disc, disc.nearest()) {
            return;
        }
        self.walk(disc, |row, dx, depth, pixel| {
            let farther = row.farther(dx);
            let at = row.depth(dx, farther);
            if at > *depth {
                return;
            }
            let share2 = row.share2(dx, farther);
            if share2 <= 1.0 {
                pixel.surface.add(disc.color, weight_of(disc, share2));
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

    /// Third pass: which surfel does one look into?
    fn find_glossy(&mut self, disc: &Disc) {
        if disc.glossy == NOT_GLOSSY || self.is_behind(disc, disc.nearest()) {
            return;
        }
        let nothing = GlossyPixel { weight: 0.0, depth: 0.0, surfel: NOT_GLOSSY, most: 0.0 };
        self.glossy.resize(self.pixels.len(), nothing);
        let ([top, bottom], [left, right]) =
            (disc.rows.map(usize::from), disc.columns.map(usize::from));
        for y in top.max(self.first_row)..bottom.min(self.first_row + self.n_rows) {
            let row = disc.row(y as f32 + self.corner[1]);
            for x in left..right {
                let (i, dx) =
                    ((y - self.first_row) * self.width + x, row.offset(x as f32 + self.corner[0]));
                let farther = row.farther(dx);
                let (at, share2) = (row.depth(dx, farther), row.share2(dx, farther));
                if at <= self.depths[i] && share2 <= 1.0 {
                    self.glossy[i].add(disc, at, weight_of(disc, share2));
                }
            }
        }
    }

    /// Lists the pixels at which what is nearest is glossy.
    fn glossy(&self) -> impl Iterator<Item = Glossy> {
        let found = (0..).zip(&self.glossy).filter(|(_, found)| found.surfel != NOT_GLOSSY);
        found.map(|(i, found): (usize, &GlossyPixel)| Glossy {
            pixel: [(i % self.width) as u32, (self.first_row + i / self.width) as u32],
            surfel: found.surfel,
            depth: found.depth / found.weight,
            share: self.share_of(i, found),
        })
    }

    /// Gives the share of a pixel's colour that is of glossy splats: not of others on the same
    /// surface, nor of what fades out in front.
    fn share_of(&self, i: usize, found: &GlossyPixel) -> f32 {
        let pixel = &self.pixels[i];
        (found.weight / pixel.surface.weight).min(1.0) * (1.0 - pixel.covered)
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
