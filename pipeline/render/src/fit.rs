//! Views that hold the whole of a source.
//!
//! What a picture must hold is known by how far the middles of splats reach in a few directions,
//! which one pass over the source finds: no box around them, of which the corners are mostly empty.

use std::ops::Range;

use pvmap_geometry::Frame;
use rayon::prelude::*;

use crate::camera::{Camera, Lens, Size, View, grid_of};
use crate::error::RenderError;
use crate::source::{Source, chunks};
use crate::vector::{Vector, add_scaled, cross, direction, dot};

/// The share of a picture that is left free on each side.
const MARGIN: f64 = 0.04;

/// From which side a default view looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// From the front, above and a little to the right.
    Corner,
    /// Along the horizontal axis that comes towards the viewer, seen from where up is up.
    Front,
    /// The other way.
    Back,
    /// From the left.
    Left,
    /// From the right.
    Right,
    /// From above.
    Top,
    /// From below.
    Bottom,
}

impl View {
    /// Looks at all splats of a source from a side, as near as they fit into the picture: also at
    /// those that are turned away, as which these are is known only once the eye is. An
    /// orthographic lens keeps its width if that is more than 0, else gets one that fits.
    ///
    /// # Errors
    /// Where `up` is no direction, and those of reading.
    pub fn fitting(
        source: &dyn Source,
        side: Side,
        up: [f64; 3],
        lens: Lens,
        size: Size,
        frame: &Frame,
    ) -> Result<View, RenderError> {
        let (back, picture_up) = axes(side, up)?;
        let right = direction(cross(picture_up, back)).ok_or(RenderError::NoUp)?;
        let upward = cross(back, right);
        let aspect = f64::from(size.width_px) / f64::from(size.height_px);
        let free = 1.0 - 2.0 * MARGIN;
        // How far the edges of the picture move apart for each step away from the eye.
        let slope = match lens {
            Lens::Perspective { fov_deg } => (fov_deg.to_radians() / 2.0).tan() * free,
            Lens::Orthographic { .. } => 0.0,
        };
        let (across, along) = (slope * aspect, slope);
        // Outwards through the four edges, then to the eye and away from it.
        let outwards = [
            add_scaled(right, back, across),
            add_scaled(right.map(|v| -v), back, across),
            add_scaled(upward, back, along),
            add_scaled(upward.map(|v| -v), back, along),
            back,
            back.map(|v| -v),
        ];
        let [east, west, north, south, near, far] = reach(source, outwards)?;
        let middle = (near - far) / 2.0;
        // Of a scan of one place any distance will do.
        let (distance, lens) = match lens {
            // The planes through the eye touch the splats: on each axis that says how far it is.
            Lens::Perspective { .. } => {
                let away = |reach: f64, slope: f64| reach / (2.0 * slope) - middle;
                (away(east + west, across).max(away(north + south, along)), lens)
            }
            Lens::Orthographic { width } if width > 0.0 => (2.0 * (near - middle), lens),
            Lens::Orthographic { .. } => {
                let steps = (east + west).max((north + south) * aspect).max(1.0);
                let width = steps * grid_of(frame).1 / free;
                (2.0 * (near - middle), Lens::Orthographic { width })
            }
        };
        let (x, y) = ((east - west) / 2.0, (north - south) / 2.0);
        let target = add_scaled(add_scaled(right.map(|v| v * x), upward, y), back, middle);
        let eye = add_scaled(target, back, distance.max(near - middle) + 1.0);
        let (origin, unit) = grid_of(frame);
        let [eye, target] = [eye, target].map(|g| add_scaled(origin, g, unit));
        Ok(View { eye, target, up: picture_up, lens })
    }

    /// Gives the width with which an orthographic picture from here holds all splats of a source;
    /// its middle stays where the view has it.
    ///
    /// # Errors
    /// Where there is no such view, and those of reading.
    pub fn fitting_width(
        &self,
        source: &dyn Source,
        size: Size,
        frame: &Frame,
    ) -> Result<f64, RenderError> {
        let lens = Lens::Orthographic { width: 1.0 };
        let camera = Camera::new(&View { lens, ..*self }, size, frame)?;
        let [right, down] = camera.across();
        let outwards = [right, right.map(|v| -v), down, down.map(|v| -v)];
        let [east, west, south, north] = reach(source, outwards)?;
        let [x, y, _] = camera.place_of([0.0; 3]);
        let aspect = f64::from(size.width_px) / f64::from(size.height_px);
        let (wide, high) = ((east + x).max(west - x), (south + y).max(north - y));
        let steps = wide.max(high * aspect).max(1.0);
        Ok(2.0 * steps * grid_of(frame).1 / (1.0 - 2.0 * MARGIN))
    }
}

/// Says how far the middles of splats reach in some directions, in grid steps from the grid's
/// origin; one place where there are no splats.
fn reach<const N: usize>(
    source: &dyn Source,
    directions: [Vector; N],
) -> Result<[f64; N], RenderError> {
    let of_chunk = |range: Range<u64>| {
        let mut splats = Vec::new();
        source.read(range, &mut splats)?;
        let mut most = [f64::NEG_INFINITY; N];
        for splat in &splats {
            let centre = splat.centre.map(f64::from);
            for (most, direction) in most.iter_mut().zip(directions) {
                *most = most.max(dot(direction, centre));
            }
        }
        Ok(most)
    };
    let join = |a: [f64; N], b: [f64; N]| std::array::from_fn(|i| a[i].max(b[i]));
    let found: Option<Result<[f64; N], RenderError>> = chunks(0..source.n_splats())
        .into_par_iter()
        .map(of_chunk)
        .reduce_with(|a, b| Ok(join(a?, b?)));
    let found = found.transpose()?;
    // A source may have splats and draw none of them.
    Ok(found.filter(|most| most[0].is_finite()).unwrap_or([0.0; N]))
}

/// Gives the direction from the middle to the eye, and what is up in the picture.
fn axes(side: Side, up: [f64; 3]) -> Result<(Vector, Vector), RenderError> {
    let up = direction(up).ok_or(RenderError::NoUp)?;
    // Surveyors have z up and y away from them; modellers y up and z towards them.
    let front = if up[2].abs() > 0.7 { [0.0, -1.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let right = direction(cross(up, front)).ok_or(RenderError::NoUp)?;
    let front = cross(right, up);
    let minus = |v: Vector| v.map(|v| -v);
    let corner = add_scaled(add_scaled(front, right, 0.45), up, 0.55);
    Ok(match side {
        Side::Corner => (direction(corner).ok_or(RenderError::NoUp)?, up),
        Side::Front => (front, up),
        Side::Back => (minus(front), up),
        Side::Left => (minus(right), up),
        Side::Right => (right, up),
        Side::Top => (up, minus(front)),
        Side::Bottom => (minus(up), front),
    })
}
