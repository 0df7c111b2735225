//! Tables of what was measured: names of rows, and CSV.

use std::error::Error;
use std::path::Path;

use super::row::Row;

impl Row {
    /// Gives the segments that only integers settled over the tests of sixteen segments: no less
    /// than their share of all.
    pub(crate) fn exact_share(&self) -> f64 {
        self.exact as f64 / self.tests.max(1) as f64
    }

    /// Names the row.
    pub(crate) fn name(&self) -> String {
        format!("{} at {}", self.scene, self.size)
    }

    /// Says whether another row is of the same input.
    pub(crate) fn is_of_input_of(&self, other: &Row) -> bool {
        (&self.scene, self.size) == (&other.scene, other.size)
    }
}

/// Writes rows under a header.
///
/// # Errors
/// Where the file cannot be written.
pub(crate) fn write(path: &Path, rows: &[Row]) -> Result<(), Box<dyn Error>> {
    let mut writer = csv::Writer::from_path(path)?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.flush()?)
}

/// Reads rows that were written here.
///
/// # Errors
/// Where the file cannot be read or has other columns.
pub(crate) fn read(path: &Path) -> Result<Vec<Row>, Box<dyn Error>> {
    let named = |e: csv::Error| format!("{}: {e}", path.display());
    let mut reader = csv::Reader::from_path(path).map_err(named)?;
    let rows: Result<Vec<Row>, _> = reader.deserialize().collect();
    Ok(rows.map_err(named)?)
}
