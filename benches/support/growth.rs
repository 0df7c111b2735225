//! Which figures of builds grow with the leaves.

use super::row::Row;

/// A figure whose growth is watched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Figure {
    Seconds,
    Instructions,
    Links,
    Memory,
}

impl Figure {
    pub(crate) const ALL: [Figure; 4] =
        [Figure::Seconds, Figure::Instructions, Figure::Links, Figure::Memory];

    /// Gives its name for a table.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Figure::Seconds => "seconds",
            Figure::Instructions => "instructions",
            Figure::Links => "links",
            Figure::Memory => "memory",
        }
    }

    /// Reads it from a row; `None` where it was not measured.
    pub(crate) fn of(self, row: &Row) -> Option<f64> {
        match self {
            Figure::Seconds => Some(row.visibility_seconds),
            Figure::Instructions => row.instructions.map(|n| n as f64),
            Figure::Links => Some(row.links as f64),
            Figure::Memory => Some(row.peak_rss_anon_bytes as f64),
        }
    }

    /// Gives (leaves, figure) of those rows that have both, by leaves.
    pub(crate) fn points(self, rows: &[&Row]) -> Vec<(f64, f64)> {
        let point = |row: &&Row| Some((row.leaves as f64, self.of(row)?));
        let mut points: Vec<(f64, f64)> =
            rows.iter().filter_map(point).filter(|p| p.0 > 0.0 && p.1 > 0.0).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points
    }
}

/// Gives the scenes of a table in the order of their first rows.
pub(crate) fn scenes(rows: &[Row]) -> Vec<&str> {
    let mut scenes: Vec<&str> = Vec::new();
    for row in rows {
        if !scenes.contains(&row.scene.as_str()) {
            scenes.push(&row.scene);
        }
    }
    scenes
}

/// Gives the rows of a scene.
pub(crate) fn of_scene<'a>(rows: &'a [Row], scene: &str) -> Vec<&'a Row> {
    rows.iter().filter(|row| row.scene == scene).collect()
}
