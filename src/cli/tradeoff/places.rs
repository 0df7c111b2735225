//! Tables of places whose irradiance is known.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;

use pvmap::Error;
use pvmap::rows::{Row, RowBlock, Rows};
use pvmap::tradeoff::light::KnownPlace;

use super::super::columns::{Columns, Header, numbers};

/// The most places of a table: each map is asked for all of them, again and again.
const MOST_PLACES: usize = 1_000_000;

const EXPECTED: &str = "x,y,z,nx,ny,nz and irradiance, or red,green,blue";

/// Where the numbers of a place stand.
struct Found {
    position: Columns<3>,
    normal: Columns<3>,
    irradiance: Light,
}

enum Light {
    /// The mean of red, green and blue.
    Mean(Columns<1>),
    Colors(Columns<3>),
}

/// Reads places and the irradiance there: columns x, y, z, nx, ny, nz and irradiance, or red,
/// green, blue; others are ignored, and so are lines that begin with `#`.
///
/// # Errors
/// Where the table cannot be read, lacks a column or has no places, a number is none, a normal is
/// no direction, a place is dark, or has two values; with file and line.
pub(super) fn read(path: &Path) -> Result<Vec<KnownPlace>, Error> {
    let mut rows = Rows::of_commented_file(path)?;
    let refuse = |what: String| Error::Data(format!("{}: {what}", path.display()));
    let found = Found::new(&Header(rows.header())).map_err(refuse)?;
    let (mut places, mut lines) = (Vec::new(), HashMap::new());
    loop {
        let mut block = RowBlock::default();
        rows.read_block(1, usize::MAX, &mut block)?;
        if block.is_empty() {
            break;
        }
        let line = rows.line();
        let at_line = |what: String| refuse(format!("line {line}: {what}"));
        let place = found.place(block.row(0)).map_err(at_line)?;
        let KnownPlace { position, normal, irradiance, .. } = place;
        let key = (position.map(f64::to_bits), normal.map(f32::to_bits));
        match lines.entry(key) {
            Entry::Vacant(entry) => drop(entry.insert((line, irradiance))),
            Entry::Occupied(entry) if entry.get().1 != irradiance => {
                let first = entry.get().0;
                let what = "with another irradiance; give the rows of one light only";
                return Err(at_line(format!("this place stands on line {first}, too, {what}")));
            }
            Entry::Occupied(_) => {}
        }
        places.push(place);
        if places.len() > MOST_PLACES {
            return Err(at_line(format!("more than {MOST_PLACES} places; give fewer")));
        }
    }
    if places.is_empty() { Err(refuse("no places in it".to_owned())) } else { Ok(places) }
}

impl Found {
    fn new(header: &Header<'_>) -> Result<Found, String> {
        let mean = header.all_or_none(["irradiance"], EXPECTED)?;
        let colors = header.all_or_none(["red", "green", "blue"], EXPECTED)?;
        let irradiance = match (mean, colors) {
            (Some(mean), None) => Light::Mean(mean),
            (None, Some(colors)) => Light::Colors(colors),
            (None, None) => {
                return Err(format!("no column irradiance; the header row is {EXPECTED}"));
            }
            (Some(_), Some(_)) => {
                let both = "columns irradiance and red, green, blue";
                return Err(format!("{both}; the header row is {EXPECTED}"));
            }
        };
        Ok(Found {
            position: header.all(["x", "y", "z"], EXPECTED)?,
            normal: header.all(["nx", "ny", "nz"], EXPECTED)?,
            irradiance,
        })
    }

    fn place(&self, row: Row<'_>) -> Result<KnownPlace, String> {
        let position = finite(row, &self.position)?;
        let [x, y, z] = finite(row, &self.normal)?;
        let length = x.hypot(y).hypot(z);
        if length == 0.0 || !length.is_finite() {
            return Err(format!("the normal {x},{y},{z} is no direction"));
        }
        let (irradiance, is_mean) = match &self.irradiance {
            Light::Mean(column) => ([finite(row, column)?[0]; 3], true),
            Light::Colors(columns) => (finite(row, columns)?, false),
        };
        if irradiance.iter().any(|&v| v < 0.0) || irradiance == [0.0; 3] {
            let what = "it must be above 0, for errors are shares of it";
            let told = match &self.irradiance {
                Light::Mean(_) => irradiance[0].to_string(),
                Light::Colors(_) => irradiance.map(|v| v.to_string()).join(","),
            };
            return Err(format!("the irradiance is {told}: {what}"));
        }
        let normal = [x, y, z].map(|v| (v / length) as f32);
        Ok(KnownPlace { position, normal, irradiance, is_mean })
    }
}

/// Reads numbers that are no infinity and no NaN.
fn finite<const N: usize>(row: Row<'_>, columns: &Columns<N>) -> Result<[f64; N], String> {
    let values = numbers(row, columns)?;
    match values.iter().zip(columns).find(|(v, _)| !v.is_finite()) {
        Some((v, (_, name))) => Err(format!("{name} is {v}, expected a number")),
        None => Ok(values),
    }
}
