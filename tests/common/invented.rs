//! Light that nobody computed: values for the surfels of a map, written as a light file.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

use std::path::Path;

use pvmap::light::{Gloss, areas_grid2};
use pvmap::vmap::light::Factors;
use pvmap::vmap::{LightSummary, MapView};
use pvmap::{Error, LightChannel, LightContent, Quiet, write_light};

/// What is given and found for a surfel in one channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    pub emission: f64,
    pub albedo: f64,
    pub irradiance: f64,
}

/// Light by surfel and channel.
pub struct Invented {
    pub channels: Vec<Vec<Row>>,
    pub gloss: Option<Vec<Gloss>>,
    pub sky: Option<Vec<f64>>,
    pub factors: Vec<Factors>,
    pub summary: LightSummary,
    pub lights: String,
    pub plan: String,
}

impl Invented {
    /// Takes what `row` says of each surfel and channel of a map.
    pub fn of(map: &MapView<'_>, n_channels: usize, row: impl Fn(u32, usize) -> Row) -> Invented {
        let n = map.summary().n_surfels;
        let factors = |(s, area)| Factors { area, scale: 1.0 - f64::from(s) / 1e6 };
        let balance = |c| if c < n_channels { [8.0, 5.0, 3.0, 0.0] } else { [0.0; 4] };
        Invented {
            channels: (0..n_channels).map(|c| (0..n).map(|s| row(s, c)).collect()).collect(),
            gloss: None,
            sky: None,
            factors: (0..).zip(areas_grid2(map).unwrap()).map(factors).collect(),
            summary: LightSummary {
                map: map.file().root(),
                order: 3,
                iterations: 5,
                error_target: 0.01,
                operator_error: 1.2e-3,
                row_error: 1e-4,
                residual: 2e-3,
                exposure: 1.0,
                balance: [balance(0), balance(1), balance(2)],
                ..LightSummary::default()
            },
            lights: "[sky]\nradiance = 1.0\n".to_owned(),
            plan: "direct: on\nsky: off\n".to_owned(),
        }
    }

    pub fn write(&self, path: &Path) -> Result<u64, Error> {
        let column = |channel: &Vec<Row>, get: fn(&Row) -> f64| channel.iter().map(get).collect();
        let columns: Vec<[Vec<f64>; 3]> = self
            .channels
            .iter()
            .map(|c| {
                [column(c, |r| r.emission), column(c, |r| r.albedo), column(c, |r| r.irradiance)]
            })
            .collect();
        let channels: Vec<LightChannel<'_>> = columns
            .iter()
            .map(|[emission, albedo, irradiance]| LightChannel { emission, albedo, irradiance })
            .collect();
        let content = LightContent {
            summary: self.summary,
            lights: &self.lights,
            plan: &self.plan,
            channels: &channels,
            gloss: self.gloss.as_deref(),
            sky: self.sky.as_deref(),
            factors: &self.factors,
        };
        write_light(path, &content, &Quiet)
    }

    /// Gives the bytes of the file.
    pub fn bytes(&self) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.light");
        self.write(&path).unwrap();
        std::fs::read(path).unwrap()
    }
}
