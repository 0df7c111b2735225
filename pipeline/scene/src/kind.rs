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

/// What can go wrong with a scene: only its name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SceneError {
    /// No scene has that name.
    #[error("{name:?}: no such scene; give one of empty, packed, furnished, cave")]
    UnknownName {
        /// The name asked for.
        name: String,
    },
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
