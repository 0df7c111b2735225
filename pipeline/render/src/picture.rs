//! The finished picture: marks, a legend, the PNG.

use std::io::Write;

use rayon::prelude::*;

use crate::camera::{Camera, Size};
use crate::color::{Rgb, encode, ramp, srgb};
use crate::error::RenderError;
use crate::font::{ADVANCE, ROWS, glyph};

/// A mark's radius is this share of the picture's height, but at least [`MIN_MARK_PX`].
const MARK_SHARE: f64 = 1.0 / 90.0;
const MIN_MARK_PX: f64 = 4.0;
/// The rim around a mark, a share of its radius.
const MARK_RIM: f64 = 0.3;
const RIM: [u8; 3] = [20, 20, 24];
/// Rows of the picture for each dot of a legend's digits.
const ROWS_A_DOT: usize = 270;

/// An sRGB picture of eight bits.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    size: Size,
    rgb: Vec<u8>,
    depths: Vec<f32>,
}

impl Picture {
    pub(crate) fn new(size: Size) -> Picture {
        let n = size.width_px as usize * size.height_px as usize;
        Picture { size, rgb: vec![0; 3 * n], depths: vec![f32::INFINITY; n] }
    }

    /// Hands out colours and depths, some rows at a time.
    pub(crate) fn rows_mut(
        &mut self,
        n_rows: usize,
    ) -> impl IndexedParallelIterator<Item = (&mut [u8], &mut [f32])> {
        let n = n_rows * self.size.width_px as usize;
        self.rgb.par_chunks_mut(3 * n).zip(self.depths.par_chunks_mut(n))
    }

    /// Gives its size.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Gives the colour of a pixel, counted from the upper left.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let at = 3 * (y as usize * self.size.width_px as usize + x as usize);
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }

    /// Says whether anything of the scan is at a pixel, its soft edges aside.
    pub fn is_covered(&self, x: u32, y: u32) -> bool {
        self.depths[y as usize * self.size.width_px as usize + x as usize].is_finite()
    }

    /// Adds linear light to a pixel.
    pub fn add_light(&mut self, [x, y]: [u32; 2], light: Rgb) {
        let at = 3 * (y as usize * self.size.width_px as usize + x as usize);
        let own = srgb(self.pixel(x, y));
        let sum = [0, 1, 2].map(|i| (own[i] + light[i]).clamp(0.0, 1.0));
        self.rgb[at..at + 3].copy_from_slice(&encode(sum));
    }

    /// Marks a place of the world with a dot, or with a ring where it is hidden: where it lies
    /// deeper than what is in the picture by more than `slack`, world units. Says whether it is in
    /// the picture.
    pub fn mark(&mut self, camera: &Camera, place: [f64; 3], slack: f64, color: [u8; 3]) -> bool {
        let place = camera.place_of(camera.grid_of_world(place));
        let Some(seen) = camera.seen(place) else { return false };
        let (width, height) = (f64::from(self.size.width_px), f64::from(self.size.height_px));
        let middle = [seen.offset_px[0] + width / 2.0, seen.offset_px[1] + height / 2.0];
        if !(0.0..width).contains(&middle[0]) || !(0.0..height).contains(&middle[1]) {
            return false;
        }
        let at = middle[1] as usize * self.size.width_px as usize + middle[0] as usize;
        // The depths have the noise of their surface in them; a step is for their rounding.
        let is_hidden = seen.place[2] > f64::from(self.depths[at]) + camera.steps_of(slack) + 1.0;
        let radius = (height * MARK_SHARE).max(MIN_MARK_PX);
        let rim = radius * (1.0 + MARK_RIM);
        let reach = |i: usize, side: f64| {
            let (low, high) = (middle[i] - rim - 1.0, middle[i] + rim + 2.0);
            low.clamp(0.0, side) as u32..high.clamp(0.0, side) as u32
        };
        for y in reach(1, height) {
            for x in reach(0, width) {
                let (dx, dy) = (f64::from(x) + 0.5 - middle[0], f64::from(y) + 0.5 - middle[1]);
                let away = (dx * dx + dy * dy).sqrt();
                let share = |radius: f64| (radius + 0.5 - away).clamp(0.0, 1.0);
                let hole = if is_hidden { share(radius * (1.0 - 2.0 * MARK_RIM)) } else { 0.0 };
                self.lay(x, y, RIM, share(rim) * (1.0 - hole));
                self.lay(x, y, color, share(radius) * (1.0 - hole));
            }
        }
        true
    }

    /// Draws the colour ramp at the lower left, with the numbers at its ends. A picture too small
    /// for it stays as it is.
    pub fn legend(&mut self, min: f32, max: f32) {
        let dot = (self.size.height_px as usize / ROWS_A_DOT).max(1);
        let bar = (50 * dot, 6 * dot);
        let edge = 6 * dot;
        let text_rows = ROWS * dot;
        let (width, height) = (self.size.width_px as usize, self.size.height_px as usize);
        let numbers = [min, max].map(short);
        let text_width = |text: &str| text.len() * ADVANCE * dot;
        let needed = (bar.0 + 2 * edge).max(text_width(&numbers[0]) + text_width(&numbers[1]));
        if width < needed + edge || height < bar.1 + text_rows + 3 * edge {
            return;
        }
        let top = height - edge - bar.1;
        // A plate under bar and digits keeps them legible on any scan.
        let plate = (edge / 2, top - text_rows - 3 * dot);
        for y in plate.1..height - edge / 2 {
            for x in plate.0..(edge + needed - edge).min(width) {
                self.lay(x as u32, y as u32, [255; 3], 0.8);
            }
        }
        for x in 0..bar.0 {
            let color = encode(ramp(x as f32 / (bar.0 - 1) as f32));
            (top..top + bar.1).for_each(|y| self.lay((edge + x) as u32, y as u32, color, 1.0));
        }
        let line = top - text_rows - dot;
        self.print(&numbers[0], edge, line, dot);
        let right = (edge + bar.0 + dot).saturating_sub(text_width(&numbers[1]));
        self.print(&numbers[1], right.max(edge + text_width(&numbers[0]) + dot), line, dot);
    }

    fn print(&mut self, text: &str, left: usize, top: usize, dot: usize) {
        for (i, c) in text.chars().enumerate() {
            for (row, bits) in glyph(c).into_iter().enumerate() {
                for column in (0..3).filter(|column| bits >> (2 - column) & 1 == 1) {
                    let x0 = left + (i * ADVANCE + column) * dot;
                    let y0 = top + row * dot;
                    for (x, y) in (0..dot * dot).map(|k| (x0 + k % dot, y0 + k / dot)) {
                        if x < self.size.width_px as usize {
                            self.lay(x as u32, y as u32, RIM, 1.0);
                        }
                    }
                }
            }
        }
    }

    /// Lays a share of a colour over a pixel.
    fn lay(&mut self, x: u32, y: u32, color: [u8; 3], share: f64) {
        let at = 3 * (y as usize * self.size.width_px as usize + x as usize);
        for (under, over) in self.rgb[at..at + 3].iter_mut().zip(color) {
            let (from, to) = (f64::from(*under), f64::from(over));
            *under = (from + (to - from) * share).round() as u8;
        }
    }

    /// Writes it as a PNG.
    ///
    /// # Errors
    /// Where `out` does not take it.
    pub fn write_png(&self, out: impl Write) -> Result<(), RenderError> {
        let mut encoder = png::Encoder::new(out, self.size.width_px, self.size.height_px);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header().map_err(of_png)?;
        writer.write_image_data(&self.rgb).map_err(of_png)?;
        Ok(writer.finish().map_err(of_png)?)
    }
}

/// Keeps what the disk said.
fn of_png(e: png::EncodingError) -> std::io::Error {
    match e {
        png::EncodingError::IoError(e) => e,
        other => std::io::Error::other(other),
    }
}

/// Writes a number in few characters.
fn short(v: f32) -> String {
    let size = v.abs();
    if v == 0.0 || (1e-3..1e6).contains(&size) {
        let digits = if size >= 1000.0 || v.fract() == 0.0 { 0 } else { 3 };
        format!("{v:.digits$}")
    } else {
        format!("{v:.1e}")
    }
}
