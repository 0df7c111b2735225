//! What defects of a scan cost: scans of one scene, each with one thing wrong with it, and the same
//! settings on all of them.
//!
//! A [`Defect`] is a kind and how much of it; a [`Case`] is a scan that has it, or the scan as it
//! is, with the rows of its settings. [`table`] writes cases as text and CSV, [`plot`] draws error
//! against each defect, a line a setting.

pub mod plot;
pub mod table;

use pvmap_scene::Defects;

use super::{Row, Subject};

/// A way in which scans are worse, or better, than a plain one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DefectKind {
    /// How many points there are.
    Density,
    /// How far they are off their surfaces.
    Noise,
    /// How many times denser they are at one end of the scene than at the other.
    Unevenness,
    /// What share of them is missing, in holes.
    Holes,
    /// What share of them has no normal.
    NoNormals,
    /// What share of them has a normal of the wrong sign.
    FlippedNormals,
}

impl DefectKind {
    /// All of them, in the order they are told.
    pub const ALL: [DefectKind; 6] = [
        DefectKind::Density,
        DefectKind::Noise,
        DefectKind::Unevenness,
        DefectKind::Holes,
        DefectKind::NoNormals,
        DefectKind::FlippedNormals,
    ];

    /// Gives the word of a column or key.
    pub fn word(self) -> &'static str {
        match self {
            DefectKind::Density => "points",
            DefectKind::Noise => "noise",
            DefectKind::Unevenness => "uneven",
            DefectKind::Holes => "holes",
            DefectKind::NoNormals => "no normals",
            DefectKind::FlippedNormals => "flipped normals",
        }
    }

    /// Says in a few words what a value of it is.
    pub fn words(self) -> &'static str {
        match self {
            DefectKind::Density => "density: points",
            DefectKind::Noise => "noise along the normal, standard deviation",
            DefectKind::Unevenness => "uneven: densest over thinnest",
            DefectKind::Holes => "holes: points missing",
            DefectKind::NoNormals => "normals missing",
            DefectKind::FlippedNormals => "normals of the wrong sign",
        }
    }

    /// Writes a value: 100 k, 3 mm, 16, 5 %.
    pub fn label(self, value: f64) -> String {
        // Digits that a product adds say nothing.
        let plain = |v: f64| format!("{}", (v * 1e6).round() / 1e6);
        match self {
            DefectKind::Density if value >= 1e6 => format!("{} M", plain(value / 1e6)),
            DefectKind::Density if value >= 1e4 => format!("{} k", plain(value / 1e3)),
            DefectKind::Density => plain(value),
            DefectKind::Noise => format!("{} mm", plain(value * 1e3)),
            DefectKind::Unevenness => plain(value),
            DefectKind::Holes | DefectKind::NoNormals | DefectKind::FlippedNormals => {
                format!("{} %", plain(value * 100.0))
            }
        }
    }

    /// Gives the value of a scan as it is, of so many points.
    pub fn plain_value(self, n_points: u64) -> f64 {
        match self {
            DefectKind::Density => n_points as f64,
            DefectKind::Unevenness => 1.0,
            _ => 0.0,
        }
    }

    /// Gives values that are worth a look, for scans of so many points.
    pub fn usual(self, n_points: u64) -> Vec<f64> {
        let n = n_points as f64;
        match self {
            DefectKind::Density => [n / 8.0, n / 4.0, n / 2.0, n * 2.0].map(f64::round).into(),
            DefectKind::Noise => vec![0.001, 0.003, 0.01, 0.03],
            DefectKind::Unevenness => vec![4.0, 16.0, 64.0],
            DefectKind::Holes => vec![0.02, 0.1, 0.3],
            DefectKind::NoNormals => vec![0.1, 0.5, 1.0],
            DefectKind::FlippedNormals => vec![0.01, 0.05, 0.2],
        }
    }
}

/// A kind of defect, and how much of it: points, metres, times or a share, 0…1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Defect {
    /// In which way.
    pub kind: DefectKind,
    /// How much.
    pub value: f64,
}

impl Defect {
    /// Gives what it is called: "50 k points", "noise 3 mm".
    pub fn name(&self) -> String {
        let label = self.kind.label(self.value);
        match self.kind {
            DefectKind::Density => format!("{label} points"),
            kind => format!("{} {label}", kind.word()),
        }
    }

    /// Gives how many points are scanned instead of `n_points`, and with which defects.
    pub fn apply(&self, n_points: u64) -> (u64, Defects) {
        let (mut n, mut defects) = (n_points, Defects::default());
        match self.kind {
            DefectKind::Density => n = self.value as u64,
            DefectKind::Noise => defects.noise_m = self.value,
            DefectKind::Unevenness => defects.unevenness = self.value,
            DefectKind::Holes => defects.missing = self.value,
            DefectKind::NoNormals => defects.without_normal = self.value,
            DefectKind::FlippedNormals => defects.flipped = self.value,
        }
        (n, defects)
    }
}

/// A scan and what its settings gave.
#[derive(Debug, Clone)]
pub struct Case {
    /// What is wrong with it; nothing with the first.
    pub defect: Option<Defect>,
    /// Its points and pairs.
    pub subject: Subject,
    /// The settings.
    pub rows: Vec<Row>,
}

impl Case {
    /// Gives what the scan is called.
    pub fn name(&self) -> String {
        self.defect.map_or_else(|| "as it is".to_owned(), |defect| defect.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_named_with_their_units() {
        for (kind, value, name) in [
            (DefectKind::Density, 50_000.0, "50 k points"),
            (DefectKind::Density, 1_500_000.0, "1.5 M points"),
            (DefectKind::Density, 900.0, "900 points"),
            (DefectKind::Noise, 0.003, "noise 3 mm"),
            (DefectKind::Noise, 0.0005, "noise 0.5 mm"),
            (DefectKind::Unevenness, 16.0, "uneven 16"),
            (DefectKind::Holes, 0.07, "holes 7 %"),
            (DefectKind::NoNormals, 1.0, "no normals 100 %"),
            (DefectKind::FlippedNormals, 0.001, "flipped normals 0.1 %"),
        ] {
            assert_eq!(Defect { kind, value }.name(), name);
        }
    }

    #[test]
    fn a_defect_changes_one_thing() {
        for kind in DefectKind::ALL {
            let none = Defect { kind, value: kind.plain_value(1000) }.apply(1000);
            let none = (none.0, Defects { unevenness: 0.0, ..none.1 });
            assert_eq!(none, (1000, Defects::default()), "{kind:?}");
            for value in kind.usual(1000) {
                let (n, defects) = Defect { kind, value }.apply(1000);
                assert_eq!(n != 1000, kind == DefectKind::Density, "{kind:?}");
                assert_eq!(defects != Defects::default(), kind != DefectKind::Density, "{kind:?}");
            }
        }
    }
}
