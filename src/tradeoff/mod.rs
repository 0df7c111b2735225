//! What accuracy costs: the settings of a build, measured on one octree and held against a truth.
//!
//! A [`Setting`] is a configuration with a short name; a [`Sweep`] is a list of them. A [`Sample`]
//! is pairs of points that face each other, drawn and judged once, so that all maps are asked about
//! the same pairs and differences are of settings, not of the draw. What a build took and how often
//! its map was wrong is a [`Row`]; [`forecast`] what
//! is known of it before; [`pareto`] says which rows no other beats, and which to take.
//! [`table`] writes rows as text and CSV, [`plot`] draws them. [`defects`] does the same for scans
//! of one scene that are worse and worse, [`light`] for the light of the maps.
//!
//! Here no map is built: whoever measures a build gives it a process of its own (`pvmap tradeoff`
//! runs `pvmap build`), so that its peak of memory is its own. Start reading at [`Sample::draw`].

pub mod defects;
pub mod forecast;
pub mod light;
pub mod pareto;
pub mod plot;
mod row;
mod sample;
mod setting;
pub mod table;

pub use row::{Built, Outcome, Row, Share};
pub use sample::{Sample, Truth};
pub use setting::{Axes, Setting, Sweep};

/// What a sweep is about, as it is told over its rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Subject {
    /// The scene or the file.
    pub name: String,
    /// Points of its octree.
    pub n_points: u64,
    /// What the pairs were drawn from.
    pub seed: u64,
    /// Pairs drawn.
    pub n_drawn: u64,
    /// Those with a place on none of the truth's surfaces, counted nowhere else.
    pub n_left_out: u64,
    /// Those that face each other, which all maps were asked about.
    pub n_facing: u64,
    /// Those of these that see each other.
    pub n_visible: u64,
    /// What judged them.
    pub judge: Judge,
    /// Which seconds are compared.
    pub clock: Clock,
}

/// Which seconds of a build are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// Those that went by.
    Wall,
    /// Those of processors, of all threads together: they tell less of what else was running.
    Processor,
}

impl Clock {
    /// Gives the column of the CSV that is compared.
    pub fn column(self) -> &'static str {
        match self {
            Clock::Wall => "build_seconds",
            Clock::Processor => "cpu_seconds",
        }
    }
}

/// What says whether two points see each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Judge {
    /// The surfaces of a generated scene.
    Geometry,
    /// A mesh that was given.
    Triangles,
    /// The points of the octree: a reference and not the truth. [V-7]
    Reference,
}

impl Judge {
    /// Says what it is, in a few words.
    pub fn words(self) -> &'static str {
        match self {
            Judge::Geometry => "truth: the exact geometry of the scene",
            Judge::Triangles => "truth: the exact triangles",
            Judge::Reference => "reference (not truth): the point-exact test of the octree",
        }
    }

    /// Gives the word of a column or key.
    pub fn word(self) -> &'static str {
        match self {
            Judge::Geometry => "geometry",
            Judge::Triangles => "triangles",
            Judge::Reference => "reference",
        }
    }
}
