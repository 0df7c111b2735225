//! What is seen of all points on the way, which decides how they can be written.

/// What was seen of all points on the way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// The largest class, 0 without.
    pub class_max: u8,
    /// The least and the greatest GPS time; `None` without any number.
    pub gps_time: Option<(f64, f64)>,
    /// The intensities, where the octree has them as f32.
    pub intensity: Option<Intensities>,
}

/// The range of intensities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intensities {
    /// The least of those that are finite, infinite without any.
    pub least: f32,
    /// The greatest of them.
    pub most: f32,
    /// Whether all are whole numbers.
    pub are_whole: bool,
}

impl Intensities {
    pub(super) fn of(value: f32) -> Intensities {
        if value.is_finite() {
            Intensities { least: value, most: value, are_whole: value.fract() == 0.0 }
        } else {
            Intensities { least: f32::INFINITY, most: f32::NEG_INFINITY, are_whole: false }
        }
    }

    fn join(self, other: Intensities) -> Intensities {
        Intensities {
            least: self.least.min(other.least),
            most: self.most.max(other.most),
            are_whole: self.are_whole && other.are_whole,
        }
    }
}

impl Seen {
    pub(super) const NOTHING: Seen = Seen { class_max: 0, gps_time: None, intensity: None };

    pub(super) fn join(self, other: Seen) -> Seen {
        let gps_time = match (self.gps_time, other.gps_time) {
            (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
            (a, b) => a.or(b),
        };
        let intensity = match (self.intensity, other.intensity) {
            (Some(a), Some(b)) => Some(a.join(b)),
            (a, b) => a.or(b),
        };
        Seen { class_max: self.class_max.max(other.class_max), gps_time, intensity }
    }
}
