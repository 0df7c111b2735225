//! Numbers a surfel, to colour by.

use std::path::Path;

use pvmap::Error;
use pvmap::render::Values;
use pvmap::rows::Rows;
use pvmap::vmap::{FormatError, MapView};

/// Gives the level of every surfel's cell.
pub(super) fn levels(view: &MapView<'_>, path: &Path) -> Result<Values, Error> {
    let level = |id| Ok(f32::from(view.surfel(id)?.level));
    let of: Result<_, FormatError> = (0..view.summary().n_surfels).map(level).collect();
    Ok(Values::new(of.map_err(|e| Error::artifact(path, e))?))
}

/// Reads a column of a table: by the column `surfel`, or a row a surfel in order. An empty cell
/// is no number. Gives how many surfels have none, too.
pub(super) fn scalars(file: &Path, column: &str, n_surfels: u32) -> Result<(Values, usize), Error> {
    let mut rows = Rows::open(file)?;
    let name = rows.name().display().to_string();
    let find = |wanted: &str| rows.header().iter().position(|h| h == wanted);
    let at = find(column).ok_or_else(|| {
        let header: Vec<&str> = rows.header().iter().collect();
        Error::Data(format!("{name}: no column {column}; there are {}", header.join(", ")))
    })?;
    let id_at = find("surfel");
    let mut of = vec![f32::NAN; n_surfels as usize];
    let mut is_told = vec![false; n_surfels as usize];
    let mut next = 0u64;
    while let Some(row) = rows.read()? {
        let line = rows.line();
        let refuse = |what: String| Error::Data(format!("{name}: line {line}: {what}"));
        let cell = row.get(at).unwrap_or_default().trim();
        let value = match cell {
            "" => f32::NAN,
            cell => cell
                .parse::<f32>()
                .map_err(|_| refuse(format!("{column} is {cell:?}, expected a number")))?,
        };
        let id = match id_at.map(|at| row.get(at).unwrap_or_default().trim()) {
            Some(cell) => cell
                .parse::<u64>()
                .map_err(|_| refuse(format!("surfel is {cell:?}, expected an id")))?,
            None => next,
        };
        next += 1;
        let slot = usize::try_from(id).ok().filter(|&id| id < of.len()).ok_or_else(|| {
            refuse(format!("surfel {id}, the map has {n_surfels}: is it another map's table?"))
        })?;
        if std::mem::replace(&mut is_told[slot], true) {
            return Err(refuse(format!("surfel {id} again; give each one once")));
        }
        of[slot] = value;
    }
    if id_at.is_none() && next != u64::from(n_surfels) {
        let what = format!("{next} rows, the map has {n_surfels} surfels; add a column surfel");
        return Err(Error::Data(format!("{name}: {what}")));
    }
    let n_without = of.iter().filter(|v| !v.is_finite()).count();
    Ok((Values::new(of), n_without))
}
