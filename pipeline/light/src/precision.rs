//! The numbers that kernels read, in the precision that they compute in.

use crate::element::{Columns, Elements};
use crate::fmm::station::Place;

/// Places, and of single precision the numbers of elements.
#[derive(Debug)]
pub(crate) enum Precision {
    /// Lengths in a unit of the scene's size.
    Single { columns: Columns<f32>, places: Vec<Place<f32>>, unit: f64 },
    /// The numbers of elements as they are.
    Double { places: Vec<Place<f64>> },
}

/// The highest order whose grids err by more than single precision does.
const MAX_SINGLE_ORDER: usize = 5;
/// The least side of an element, as a share of the scene's size, whose place single precision
/// gives well enough: to 2^-9 of that side.
const MIN_SINGLE_SIDE: f64 = 1.0 / (1 << 15) as f64;

impl Precision {
    /// Takes single precision where grids err by more. `grids` are places with what softens their
    /// exchange, c times an area.
    pub(crate) fn of(
        elements: &Elements,
        (order, regularisation): (usize, f64),
        grids: impl Iterator<Item = ([f64; 3], f64)>,
    ) -> Precision {
        let of_element = |i| {
            let element = elements.get(i);
            (element.position, regularisation * element.area)
        };
        let all = (0..elements.len()).map(of_element).chain(grids);
        let size = elements.columns.0[..3].iter().flatten().fold(0.0, |a, &b| f64::max(a, b));
        let least = elements.areas().iter().fold(f64::INFINITY, |a, &b| a.min(b));
        if order > MAX_SINGLE_ORDER || least.sqrt() < MIN_SINGLE_SIDE * size {
            let places = all.map(|([x, y, z], softening)| [x, y, z, softening]).collect();
            return Precision::Double { places };
        }
        let unit = power_below(size);
        let place = |([x, y, z], softening): ([f64; 3], f64)| {
            [x / unit, y / unit, z / unit, softening / (unit * unit)].map(|v| v as f32)
        };
        let places = all.map(place).collect();
        Precision::Single { columns: elements.in_units(unit), places, unit }
    }

    /// Counts the bytes held.
    pub(crate) fn held_bytes(&self) -> usize {
        match self {
            Precision::Single { columns, places, .. } => {
                columns.0.iter().map(|column| size_of_val(&column[..])).sum::<usize>()
                    + size_of_val(&places[..])
            }
            Precision::Double { places } => size_of_val(&places[..]),
        }
    }
}

/// Gives the largest power of two that is no larger than a number above 0; of others 1.
pub(crate) fn power_below(v: f64) -> f64 {
    if v >= f64::MIN_POSITIVE { f64::from_bits(v.to_bits() & f64::INFINITY.to_bits()) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::power_below;

    #[test]
    fn powers_of_two_are_found_exactly() {
        for (v, power) in [(1.0, 1.0), (1.9, 1.0), (2.0, 2.0), (0.3, 0.25), (1e300, 2f64.powi(996))]
        {
            assert_eq!(power_below(v), power, "{v}");
        }
        assert_eq!([0.0, -3.0, 1e-310, f64::NAN].map(power_below), [1.0; 4]);
    }
}
