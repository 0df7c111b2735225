//! Numbers a surfel, to colour by.

use std::path::Path;

use pvmap::Error;
use pvmap::render::Values;
use pvmap::rows::Rows;
use pvmap::vmap::tree::Nodes;
use pvmap::vmap::{FormatError, MapView};

/// Gives the level of every surfel's cell.
pub(super) fn levels(view: &MapView<'_>, path: &Path) -> Result<Values, Error> {
    let level = |id| Ok(f32::from(view.surfel(id)?.level));
    let of: Result<_, FormatError> = (0..view.summary().n_surfels).map(level).collect();
    Ok(Values::new(of.map_err(|e| Error::artifact(path, e))?))
}

/// Counts the surfels that every surfel sees.
pub(super) fn sees_counts(view: &MapView<'_>, path: &Path) -> Result<Values, Error> {
    let counts = counts_of(view).map_err(|e| Error::artifact(path, e))?;
    Ok(Values::new(counts.into_iter().map(|n| n as f32).collect()))
}

/// Adds up, link by link, what each side sees of the other: at a node's first surfel the count
/// rises, past its last it falls.
fn counts_of(view: &MapView<'_>) -> Result<Vec<i64>, FormatError> {
    let mut changes = vec![0i64; view.summary().n_surfels as usize + 1];
    for block in 0..view.n_link_blocks() {
        for (a, b) in view.link_lists(block)?.iter() {
            let (a, b) = (view.node(a)?, view.node(b)?);
            for (near, far) in [(&a, &b), (&b, &a)] {
                let n = i64::from(far.end_surfel) - i64::from(far.first_surfel);
                let ends = [(near.first_surfel, n), (near.end_surfel, -n)];
                for (at, change) in ends {
                    if let Some(sum) = changes.get_mut(at as usize) {
                        *sum += change;
                    }
                }
            }
        }
    }
    changes.pop();
    let mut sum = 0;
    changes.iter_mut().for_each(|change| {
        sum += *change;
        *change = sum;
    });
    Ok(changes)
}

/// Reads a column of a table: by the column `surfel`, or a row a surfel in order. An empty cell
/// is no number.
pub(super) fn scalars(file: &Path, column: &str, n_surfels: u32) -> Result<Values, Error> {
    let mut rows = Rows::open(file)?;
    let name = rows.name().display().to_string();
    let find = |wanted: &str| rows.header().iter().position(|h| h == wanted);
    let at = find(column).ok_or_else(|| {
        let header: Vec<&str> = rows.header().iter().collect();
        Error::Data(format!("{name}: no column {column}; there are {}", header.join(", ")))
    })?;
    let id_at = find("surfel");
    let mut of = vec![f32::NAN; n_surfels as usize];
    let mut next = 0u64;
    while let Some(row) = rows.read()? {
        let line = rows.line();
        let refuse = |what: String| Error::Data(format!("{name}: line {line}: {what}"));
        let cell = row.get(at).unwrap_or_default();
        let value = match cell {
            "" => f32::NAN,
            cell => cell
                .parse::<f32>()
                .map_err(|_| refuse(format!("{column} is {cell:?}, expected a number")))?,
        };
        let id = match id_at.map(|at| row.get(at).unwrap_or_default()) {
            Some(cell) => cell
                .parse::<u64>()
                .map_err(|_| refuse(format!("surfel is {cell:?}, expected an id")))?,
            None => next,
        };
        next += 1;
        let slot = usize::try_from(id).ok().and_then(|id| of.get_mut(id));
        let slot = slot.ok_or_else(|| {
            refuse(format!("surfel {id}, the map has {n_surfels}: is it another map's table?"))
        })?;
        *slot = value;
    }
    if id_at.is_none() && next != u64::from(n_surfels) {
        let what = format!("{next} rows, the map has {n_surfels} surfels; add a column surfel");
        return Err(Error::Data(format!("{name}: {what}")));
    }
    Ok(Values::new(of))
}
