//! Why a question has no answer.

use pvmap_vmap::FormatError;

/// What is wrong with a question or with the map it was put to; coordinates are world units.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum QueryError {
    /// The place is not in the cube of the scan. [V-8]
    #[error(
        "{} lies outside the scan's cube ({} to {}); give a place inside it, in the scan's units",
        commas(place),
        commas(&min.map(twelve_digits)),
        commas(&max.map(twelve_digits))
    )]
    OutsideCube {
        /// The place asked for.
        place: [f64; 3],
        /// The cube's lowest corner.
        min: [f64; 3],
        /// The cube's highest corner.
        max: [f64; 3],
    },
    /// The nearest surfel is beyond the snap limit. [V-8]
    #[error(
        "no surface at {}: the nearest is {} away, {} is allowed; move the place or raise the snap \
         distance",
        commas(place),
        // So much more that, rounded, it is a limit that would do.
        four_digits(nearest * 1.001),
        four_digits(*limit)
    )]
    NoSurface {
        /// The place asked for.
        place: [f64; 3],
        /// Distance to the nearest surfel.
        nearest: f64,
        /// The snap limit.
        limit: f64,
    },
    /// The map is that of a scan without points.
    #[error("the map has no surfels because its scan has no points; ask a map of another scan")]
    Empty,
    /// The normal of a place is no direction.
    #[error(
        "the normal {} at {} is zero or not finite; give a direction or leave the normal out",
        commas(normal),
        commas(place)
    )]
    Normal {
        /// The place asked for.
        place: [f64; 3],
        /// The normal given.
        normal: [f32; 3],
    },
    /// The snap distance is no distance.
    #[error("the snap distance {0} is negative or not a number; give one of 0 or more")]
    SnapDistance(f64),
    /// Δ of the point-exact test is no distance. [V-7]
    #[error("the distance {0} to occluders is negative or not a number; give one of 0 or more")]
    Delta(f64),
    /// The octree has no points.
    #[error("the octree has no points; ask one of another scan")]
    NoPoints,
    /// The map was made from another octree. [D-8]
    #[error(
        "the map was not made from this octree: its points are others; give the octree it was \
         built from, or build a map of this one"
    )]
    OtherOctree,
    /// The radius of a ball is none.
    #[error("the radius {0} is negative or not a number; give one of 0 or more")]
    Radius(f64),
    /// No surfel lies in a part of the scan that was asked about.
    #[error("no surfel's centre lies {0}; make it larger or move it")]
    NothingThere(String),
    /// A direction is none.
    #[error("the direction {} is zero or not finite; give one that leads somewhere", commas(.0))]
    Direction([f64; 3]),
    /// A place is none.
    #[error("the place {} is not finite; give three numbers", commas(.0))]
    NoPlace([f64; 3]),
    /// The map cannot be read.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The octree cannot be read.
    #[error(transparent)]
    Octree(FormatError),
    /// Whoever asked has heard enough.
    #[error("stopped before there was an answer")]
    Stopped,
}

/// Whom an error concerns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// How the question was put; another place does not help.
    Usage,
    /// This place; others may have an answer.
    Place,
    /// The map file.
    Map,
    /// The octree, or that it is not the map's.
    Octree,
    /// Nobody: the question was withdrawn.
    Stopped,
}

impl QueryError {
    /// Says whom the error concerns.
    pub fn kind(&self) -> ErrorKind {
        match self {
            QueryError::Normal { .. }
            | QueryError::SnapDistance(_)
            | QueryError::Delta(_)
            | QueryError::Radius(_)
            | QueryError::Direction(_)
            | QueryError::NoPlace(_) => ErrorKind::Usage,
            QueryError::NoPoints | QueryError::OtherOctree | QueryError::Octree(_) => {
                ErrorKind::Octree
            }
            QueryError::OutsideCube { .. }
            | QueryError::NoSurface { .. }
            | QueryError::NothingThere(_) => ErrorKind::Place,
            QueryError::Empty | QueryError::Format(_) => ErrorKind::Map,
            QueryError::Stopped => ErrorKind::Stopped,
        }
    }
}

/// Writes a vector as the command line takes it: `x,y,z`.
pub(crate) fn commas<T: std::fmt::Display>(v: &[T; 3]) -> String {
    format!("{},{},{}", v[0], v[1], v[2])
}

/// Drops what summing floats leaves behind: a tenth of a micrometre at 100 km.
fn twelve_digits(v: f64) -> f64 {
    format!("{v:.11e}").parse().unwrap_or(v)
}

/// Writes a distance in four digits.
fn four_digits(v: f64) -> String {
    let rounded = format!("{v:.3e}").parse::<f64>();
    rounded.unwrap_or(v).to_string()
}
