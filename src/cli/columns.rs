//! Columns of tables, found by name, and numbers in them.

use csv::StringRecord;
use pvmap::rows::Row;

/// The names of a table's columns.
pub(super) struct Header<'r>(pub(super) &'r StringRecord);

/// Columns by place and name.
pub(super) type Columns<const N: usize> = [(usize, &'static str); N];

impl Header<'_> {
    fn find(&self, name: &str) -> Result<Option<usize>, String> {
        // PDAL writes X, CloudCompare //X in front.
        let is_it = |h: &str| h.trim_start_matches("//").eq_ignore_ascii_case(name);
        let mut found = self.0.iter().enumerate().filter(|(_, h)| is_it(h));
        match (found.next(), found.next()) {
            (_, Some(_)) => Err(format!("column {name} stands twice in the header row")),
            (first, None) => Ok(first.map(|(i, _)| i)),
        }
    }

    /// Finds columns that must be there; `expected` tells what the header row is.
    pub(super) fn all<const N: usize>(
        &self,
        names: [&'static str; N],
        expected: &str,
    ) -> Result<Columns<N>, String> {
        let mut columns = [(0, ""); N];
        for (column, name) in columns.iter_mut().zip(names) {
            let missing = || format!("no column {name}; the header row is {expected}");
            *column = (self.find(name)?.ok_or_else(missing)?, name);
        }
        Ok(columns)
    }

    /// Finds columns that are all there or none.
    pub(super) fn all_or_none<const N: usize>(
        &self,
        names: [&'static str; N],
        expected: &str,
    ) -> Result<Option<Columns<N>>, String> {
        for name in names {
            if self.find(name)?.is_some() {
                return self.all(names, expected).map(Some);
            }
        }
        Ok(None)
    }
}

/// Reads numbers of a row.
pub(super) fn numbers<const N: usize>(
    row: Row<'_>,
    columns: &Columns<N>,
) -> Result<[f64; N], String> {
    let mut values = [0.0; N];
    for (value, &(i, name)) in values.iter_mut().zip(columns) {
        let cell = row.get(i).unwrap_or_default().trim_ascii();
        let number = std::str::from_utf8(cell).ok().and_then(|text| text.parse::<f64>().ok());
        *value = number.ok_or_else(|| {
            format!("{name} is {:?}, expected a number", String::from_utf8_lossy(cell))
        })?;
    }
    Ok(values)
}

/// Reads numbers of a row that may leave all of them out.
pub(super) fn numbers_if_any<const N: usize>(
    row: Row<'_>,
    columns: &Option<Columns<N>>,
) -> Result<Option<[f64; N]>, String> {
    let is_there = |&(i, _): &(usize, _)| !row.get(i).unwrap_or_default().trim_ascii().is_empty();
    match columns {
        Some(columns) if columns.iter().any(is_there) => numbers(row, columns).map(Some),
        _ => Ok(None),
    }
}
