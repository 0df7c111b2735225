//! Why there is no picture.

use pvmap_vmap::FormatError;

/// What is wrong with a camera or with what it should look at; coordinates are world units.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The camera looks at the place where it stands.
    #[error("the camera's eye and target are one place; move one of them")]
    NoDirection,
    /// Nothing says which way is up.
    #[error("the camera looks along its up direction; give another --up")]
    NoUp,
    /// A number of the camera is infinite or none at all.
    #[error("the camera's places must be finite numbers")]
    NotFinite,
    /// The angle of view is no angle a flat picture can have.
    #[error("an angle of view of {0} degrees; it must be more than 0 and at most 170")]
    Fov(f64),
    /// The width of an orthographic picture is none.
    #[error("a picture {0} wide; the width must be more than 0, in the scan's units")]
    Width(f64),
    /// A picture without pixels, or with more than anybody can look at.
    #[error("a picture of {0}x{1} pixels; each side must be 1 to 16384")]
    Size(u32, u32),
    /// The values to colour by are not one a surfel.
    #[error("{found} values to colour by, the map has {expected} surfels")]
    Values {
        /// How many there are.
        found: usize,
        /// How many surfels the map has.
        expected: u32,
    },
    /// The colours are those of surfels, and no map says which points belong to which.
    #[error("these colours are those of surfels: give a .vmap, as pvmap build makes it")]
    NoMap,
    /// The map says of a point of its octree that it has no leaf.
    #[error("damaged: a point of its octree has no leaf in it; build it anew")]
    NoLeaf,
    /// The map that says which surfels points belong to cannot be read.
    #[error(transparent)]
    Map(FormatError),
    /// The caller asked to stop.
    #[error("stopped")]
    Stopped,
    /// The artifact cannot be read.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The picture cannot be written.
    #[error(transparent)]
    Write(#[from] std::io::Error),
}

impl RenderError {
    /// Says whether another camera or another request would help.
    pub fn is_usage(&self) -> bool {
        match self {
            RenderError::NoDirection
            | RenderError::NoUp
            | RenderError::NotFinite
            | RenderError::Fov(_)
            | RenderError::Width(_)
            | RenderError::Size(..)
            | RenderError::Values { .. }
            | RenderError::NoMap => true,
            RenderError::NoLeaf
            | RenderError::Map(_)
            | RenderError::Stopped
            | RenderError::Format(_)
            | RenderError::Write(_) => false,
        }
    }
}
