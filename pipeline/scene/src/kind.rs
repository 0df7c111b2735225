//! The scenes there are, and their names.

use std::fmt;
use std::str::FromStr;

/// Which scene to generate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SceneKind {
    /// The Cornell room: six walls, the left one red, the right one green, the others white.
    Empty,
    /// The Cornell room packed to capacity with one large box.
    Packed,
    /// The Cornell room with a sphere and a turned box on its floor.
    Furnished,
    /// A cavern with columns and niches; its shape comes from the seed.
    Cave,
}

impl SceneKind {
    /// Every scene, in the order of the enum.
    pub const ALL: [SceneKind; 4] =
        [SceneKind::Empty, SceneKind::Packed, SceneKind::Furnished, SceneKind::Cave];

    /// Gives the name by which a user asks for the scene.
    pub fn name(self) -> &'static str {
        match self {
            SceneKind::Empty => "empty",
            SceneKind::Packed => "packed",
            SceneKind::Furnished => "furnished",
            SceneKind::Cave => "cave",
        }
    }
}

impl fmt::Display for SceneKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for SceneKind {
    type Err = SceneError;

    /// Finds the scene of that exact name.
    ///
    /// # Errors
    /// [`SceneError::UnknownName`] where there is none.
    fn from_str(name: &str) -> Result<SceneKind, SceneError> {
        SceneKind::ALL
            .into_iter()
            .find(|kind| kind.name() == name)
            .ok_or_else(|| SceneError::UnknownName { name: name.to_owned() })
    }
}

/// What can go wrong with a scene.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// No scene has that name.
    #[error("{name:?}: no such scene; give one of empty, packed, furnished, cave, cornell")]
    UnknownName {
        /// The name asked for.
        name: String,
    },
    /// A triangle has a corner that is not there.
    #[error("triangle {triangle} has corner {corner}, there are {n_corners}")]
    NoCorner {
        /// The triangle, from 0.
        triangle: usize,
        /// The index of its corner.
        corner: u32,
        /// How many corners there are.
        n_corners: usize,
    },
    /// A corner is nowhere.
    #[error("corner {corner} has a coordinate that is not finite or beyond 1e60")]
    NoPlace {
        /// The corner, from 0.
        corner: u32,
    },
    /// A mesh is nothing.
    #[error("not a mesh: none of its {n_triangles} triangles has an area")]
    NoArea {
        /// How many triangles there are.
        n_triangles: usize,
    },
    /// Statues have no room beside each other.
    #[error("{n_statues} statues, the room holds {most} side by side; give fewer --model")]
    TooMany {
        /// How many were given.
        n_statues: usize,
        /// How many there may be.
        most: usize,
    },
    /// A statue does not fit into its room.
    #[error(
        "statue {statue} does not fit {size_m} m long into the room, {most_m:.2} m is the most; \
         give --size less"
    )]
    TooLarge {
        /// Which statue, from 1.
        statue: usize,
        /// The longest side asked for.
        size_m: f64,
        /// The longest that fits.
        most_m: f64,
    },
    /// A sphere is no mesh.
    #[error("the scene has a sphere, which no triangles are")]
    Round,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back_to_their_scenes() {
        for kind in SceneKind::ALL {
            assert_eq!(kind.to_string().parse(), Ok(kind));
        }
    }

    #[test]
    fn an_unknown_name_is_answered_with_all_names() {
        let message = "Cave".parse::<SceneKind>().expect_err("names are lower case").to_string();
        for kind in SceneKind::ALL {
            assert!(message.contains(kind.name()), "{message}");
        }
    }
}
