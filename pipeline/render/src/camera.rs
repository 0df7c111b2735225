//! Cameras: from the world to the screen.

use pvmap_geometry::Frame;

use crate::error::RenderError;
use crate::vector::{Vector, add_scaled, cross, direction, dot, sub};

/// The largest side of a picture.
pub const MAX_SIDE_PX: u32 = 1 << 14;
/// Up and ahead must differ by more than this (the sine of their angle).
const MIN_SINE: f64 = 1e-6;

/// A picture's width and height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Pixels a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

/// How what is seen becomes flat.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// As an eye sees: so many degrees from the picture's lower to its upper edge.
    Perspective {
        /// More than 0, at most 170.
        fov_deg: f64,
    },
    /// Without perspective: so many world units from the left to the right edge.
    Orthographic {
        /// More than 0.
        width: f64,
    },
}

/// Where a camera stands and looks, in world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Where it stands.
    pub eye: [f64; 3],
    /// What it looks at: the middle of the picture.
    pub target: [f64; 3],
    /// What is up in the picture, of any length.
    pub up: [f64; 3],
    /// How it projects.
    pub lens: Lens,
}

/// A camera that works: all in grid steps.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    eye: Vector,
    right: Vector,
    down: Vector,
    ahead: Vector,
    /// Pixels a unit of slope; orthographic: pixels a grid step.
    focal_px: f64,
    is_perspective: bool,
    size: Size,
    /// The frame's origin and step, to bring world units here.
    origin: Vector,
    unit: f64,
}

/// A place as a camera sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    /// Grid steps to the right, down and ahead of the eye.
    pub(crate) place: Vector,
    /// Pixels from the middle of the picture, right and down.
    pub(crate) offset_px: [f64; 2],
    /// The ray from the eye through the place; its third component is 1.
    pub(crate) ray: Vector,
}

impl Camera {
    /// Checks a view and prepares it.
    ///
    /// # Errors
    /// Where it is no view: see [`RenderError`].
    pub fn new(view: &View, size: Size, frame: &Frame) -> Result<Camera, RenderError> {
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&size.width_px) || !sides.contains(&size.height_px) {
            return Err(RenderError::Size(size.width_px, size.height_px));
        }
        // The lens first: from one that is none, a default view has no finite places.
        let (origin, unit) = grid_of(frame);
        let (is_perspective, focal_px) = match view.lens {
            Lens::Perspective { fov_deg } => {
                if !(fov_deg > 0.0 && fov_deg <= 170.0) {
                    return Err(RenderError::Fov(fov_deg));
                }
                (true, f64::from(size.height_px) / 2.0 / (fov_deg.to_radians() / 2.0).tan())
            }
            Lens::Orthographic { width } => {
                let focal_px = f64::from(size.width_px) / (width / unit);
                if !(width > 0.0 && focal_px.is_normal()) {
                    return Err(RenderError::Width(width));
                }
                (false, focal_px)
            }
        };
        let numbers = [view.eye, view.target, view.up];
        if !numbers.iter().flatten().all(|v| v.is_finite()) {
            return Err(RenderError::NotFinite);
        }
        let ahead = direction(sub(view.target, view.eye)).ok_or(RenderError::NoDirection)?;
        let up = direction(view.up).ok_or(RenderError::NoUp)?;
        let across = cross(ahead, up);
        if dot(across, across) < MIN_SINE * MIN_SINE {
            return Err(RenderError::NoUp);
        }
        let right = direction(across).ok_or(RenderError::NoUp)?;
        let down = cross(ahead, right);
        let eye = sub(view.eye, origin).map(|v| v / unit);
        Ok(Camera { eye, right, down, ahead, focal_px, is_perspective, size, origin, unit })
    }

    /// Gives the picture's size.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Gives the place, world units, that lies so many grid steps ahead of the eye in the middle of
    /// a pixel, and the direction, of any length, in which it is looked at.
    pub fn ray(&self, [x, y]: [u32; 2], depth: f32) -> ([f64; 3], [f64; 3]) {
        let half = [self.size.width_px, self.size.height_px].map(|side| f64::from(side) / 2.0);
        let offset = [f64::from(x) + 0.5 - half[0], f64::from(y) + 0.5 - half[1]];
        let slope = offset.map(|px| px / self.focal_px);
        let depth = f64::from(depth);
        let across =
            |by: f64| [0, 1, 2].map(|i| (self.right[i] * slope[0] + self.down[i] * slope[1]) * by);
        let (off, direction) = match self.is_perspective {
            true => (across(depth), add_scaled(across(1.0), self.ahead, 1.0)),
            false => (across(1.0), self.ahead),
        };
        let place = add_scaled(add_scaled(self.eye, off, 1.0), self.ahead, depth);
        (add_scaled(self.origin, place, self.unit), direction)
    }

    /// Gives pixels a unit of slope (perspective) or a grid step (orthographic).
    pub(crate) fn focal_px(&self) -> f64 {
        self.focal_px
    }

    pub(crate) fn is_perspective(&self) -> bool {
        self.is_perspective
    }

    /// Gives the directions of the picture's right and lower edge.
    pub(crate) fn across(&self) -> [Vector; 2] {
        [self.right, self.down]
    }

    /// Turns a direction into right, down, ahead.
    pub(crate) fn turn(&self, v: Vector) -> Vector {
        [dot(v, self.right), dot(v, self.down), dot(v, self.ahead)]
    }

    /// Turns a place of the grid into steps right, down and ahead of the eye.
    pub(crate) fn place_of(&self, g: Vector) -> Vector {
        self.turn(sub(g, self.eye))
    }

    /// Finds where such a place is in the picture; none where it is not before the eye.
    pub(crate) fn seen(&self, place: Vector) -> Option<Seen> {
        if place[2] <= 0.0 {
            return None;
        }
        let ray = match self.is_perspective {
            true => [place[0] / place[2], place[1] / place[2], 1.0],
            false => [0.0, 0.0, 1.0],
        };
        let on_plane = if self.is_perspective { ray } else { place };
        let offset_px = [on_plane[0] * self.focal_px, on_plane[1] * self.focal_px];
        Some(Seen { place, offset_px, ray })
    }

    /// Brings a place from right, down, ahead to the picture, as [`Camera::seen`] does.
    pub(crate) fn flat(&self, place: Vector) -> [f64; 2] {
        let per_depth = if self.is_perspective { 1.0 / place[2] } else { 1.0 };
        [place[0] * per_depth * self.focal_px, place[1] * per_depth * self.focal_px]
    }

    /// Brings a place of the world onto the grid.
    pub(crate) fn grid_of_world(&self, x: [f64; 3]) -> Vector {
        sub(x, self.origin).map(|v| v / self.unit)
    }

    /// Brings a length of the world onto the grid.
    pub(crate) fn steps_of(&self, length: f64) -> f64 {
        length / self.unit
    }
}

/// Gives the world place of grid step 0 and the length of a step; 1 where the scan is one point.
pub(crate) fn grid_of(frame: &Frame) -> (Vector, f64) {
    let unit = if frame.unit() > 0.0 { frame.unit() } else { 1.0 };
    (frame.world_of_real([0.0; 3]), unit)
}
