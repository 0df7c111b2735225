//! Which side an estimated normal has: what is known beyond the points. Source: DESIGN.md [D-5].

use pvmap_geometry::normal::{NORMAL_LENGTH, Normal};
use pvmap_geometry::{Frame, GridPoint};

/// |n_z| below so many hundredths of the length says nothing of up and down.
const UP_PERCENT: i32 = 17;

/// What orients estimated normals.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Orientation {
    /// Nothing: they stay two-sided.
    #[default]
    Unknown,
    /// Where the scanner stood, world units: the nearest place saw the point.
    Sensors(Vec<[f64; 3]>),
    /// The surface is seen from above.
    Up,
}

impl Orientation {
    /// Gives the code of `orientation` in FORMAT.md.
    pub(crate) fn code(&self) -> u32 {
        match self {
            Orientation::Unknown => 0,
            Orientation::Sensors(_) => 1,
            Orientation::Up => 2,
        }
    }

    /// Prepares for one frame: sensors in grid steps, with the fraction kept.
    pub(crate) fn in_frame(&self, frame: &Frame) -> OrientInFrame {
        match self {
            Orientation::Unknown => OrientInFrame::Unknown,
            Orientation::Up => OrientInFrame::Up,
            Orientation::Sensors(places) => {
                let origin = frame.world_of_real([0.0; 3]);
                let unit = frame.unit();
                let place = |s: &[f64; 3]| [0, 1, 2].map(|i| (s[i] - origin[i]) / unit);
                OrientInFrame::Sensors(places.iter().map(place).collect())
            }
        }
    }
}

/// [`Orientation`] on the grid of one scan.
#[derive(Debug)]
pub(crate) enum OrientInFrame {
    Unknown,
    Sensors(Vec<[f64; 3]>),
    Up,
}

impl OrientInFrame {
    /// Gives a normal its side if that is known.
    pub(crate) fn orient(&self, g: GridPoint, n: Normal) -> (Normal, bool) {
        let side = match self {
            OrientInFrame::Unknown => 0.0,
            OrientInFrame::Up if 100 * i32::from(n[2]).abs() < UP_PERCENT * NORMAL_LENGTH => 0.0,
            OrientInFrame::Up => f64::from(n[2]),
            OrientInFrame::Sensors(places) => toward_nearest(places, g, n),
        };
        if side < 0.0 { (n.map(|v| -v), true) } else { (n, side > 0.0) }
    }
}

/// n · (s - g) for the sensor s nearest to g, the first on ties.
fn toward_nearest(places: &[[f64; 3]], g: GridPoint, n: Normal) -> f64 {
    let mut best = (f64::INFINITY, 0.0);
    for s in places {
        let d = [0, 1, 2].map(|i| s[i] - f64::from(g[i]));
        let distance2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        if distance2 < best.0 {
            let n = n.map(f64::from);
            best = (distance2, n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
        }
    }
    // A frame without extent has no directions.
    if best.1.is_finite() { best.1 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn d5_the_nearest_sensor_decides() {
        let frame = Frame::of_world([0.0; 3], [8.0; 3]);
        let orientation = Orientation::Sensors(vec![[1.0, 1.0, 4.0], [7.0, 7.0, -3.0]]);
        let on_grid = orientation.in_frame(&frame);
        let middle = |x: f64, y: f64, z: f64| frame.grid_of_query([x, y, z]).unwrap();
        assert_eq!(on_grid.orient(middle(1.0, 1.0, 0.0), [0, 0, -5]), ([0, 0, 5], true));
        assert_eq!(on_grid.orient(middle(7.0, 7.0, 0.0), [0, 0, 5]), ([0, 0, -5], true));
    }

    #[test]
    fn d5_up_leaves_steep_walls_unoriented() {
        let up = OrientInFrame::Up;
        assert_eq!(up.orient([0; 3], [16000, 0, -3000]), ([-16000, 0, 3000], true));
        assert_eq!(up.orient([0; 3], [16100, 0, -2784]), ([16100, 0, -2784], false));
        // 0.17 of 16384 is 2785.28.
        assert_eq!(up.orient([0; 3], [16145, 0, -2785]), ([16145, 0, -2785], false));
        assert_eq!(up.orient([0; 3], [16145, 0, -2786]), ([-16145, 0, 2786], true));
    }
}
