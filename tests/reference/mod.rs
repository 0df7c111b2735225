//! What a path tracer says of light in the Cornell rooms: a table a room, made by `cornell.py`,
//! whose head says how.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

use pvmap::scene::SceneKind;

/// The part of the ceiling, at z = 5.5, that glows: x0, y0, x1, y1.
pub const LAMP: [f64; 4] = [2.1, 2.225, 3.4, 3.275];
/// Flux an area of the lamp, in each channel.
pub const EXITANCE: f64 = 10.0;

/// A row: irradiance at a place of a floor or wall.
#[derive(Debug, Clone)]
pub struct Reference {
    /// `empty-grey` and `furnished-grey` (all albedos 0.7), `furnished-scan` (as painted).
    pub scene: String,
    pub position: [f64; 3],
    /// Of length 1.
    pub normal: [f32; 3],
    /// The part that comes straight from the lamp, alike in all channels.
    pub direct: f64,
    /// All of it: red, green, blue.
    pub irradiance: [f64; 3],
    /// Standard error of the irradiance, as a share; the largest of the three channels.
    pub error: f64,
}

impl Reference {
    /// Gives the room that the row's scene is made of.
    pub fn room(&self) -> SceneKind {
        match self.scene.split_once('-').unwrap().0 {
            "empty" => SceneKind::Empty,
            "furnished" => SceneKind::Furnished,
            other => panic!("no room is called {other}"),
        }
    }
}

/// The tables, by what is lit.
const TABLES: [(&str, &[u8]); 3] = [
    ("empty-grey", include_bytes!("empty-grey.csv")),
    ("furnished-grey", include_bytes!("furnished-grey.csv")),
    ("furnished-scan", include_bytes!("furnished-scan.csv")),
];

/// Reads the tables: 256 rows a scene, of the same places in the same order.
pub fn reference() -> Vec<Reference> {
    let rows = TABLES.into_iter().flat_map(|(scene, table)| {
        let reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(table);
        reader.into_deserialize().map(|row| {
            let (position, normal, direct, irradiance, error) = row.unwrap();
            let scene = scene.to_owned();
            Reference { scene, position, normal, direct, irradiance, error }
        })
    });
    rows.collect()
}
