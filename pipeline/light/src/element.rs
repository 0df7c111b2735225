//! What light sees of a surface: elements with a place, a normal and an area.

use pvmap_vmap::MapView;
use rayon::prelude::*;

use crate::area::areas_grid2;
use crate::error::LightError;
use crate::material::check_each;
use crate::number::Number;

/// A piece of surface that has one radiosity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Element {
    /// Its place, in any unit of length.
    pub position: [f64; 3],
    /// The normal of its face, of length 1; zero where it has none and takes no part in light.
    pub normal: [f64; 3],
    /// Its area, in that unit squared, above 0.
    pub area: f64,
    /// Whether the side of its face is unknown: light comes and goes on both, with one radiosity,
    /// and no more of it than one face can have.
    pub two_sided: bool,
}

/// The numbers of one element: place, normal, area, and 1 for two-sided, else 0.
pub(crate) type Record<T> = [T; 8];

/// The number of a record that is the area.
pub(crate) const AREA: usize = 6;

/// An array for each number of elements.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Columns<T>(pub(crate) [Vec<T>; 8]);

impl<T: Number> Columns<T> {
    /// Gives the numbers of an element.
    #[inline(always)]
    pub(crate) fn record(&self, index: usize) -> Record<T> {
        let [x, y, z, u, v, w, area, sides] = &self.0;
        let normal = [u[index], v[index], w[index]];
        [x[index], y[index], z[index], normal[0], normal[1], normal[2], area[index], sides[index]]
    }
}

/// All elements of a scene.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Elements {
    pub(crate) columns: Columns<f64>,
}

/// How much longer or shorter than 1 a normal may be.
const LENGTH_TOLERANCE: f64 = 1e-3;

impl Elements {
    /// Checks and keeps elements, their places as differences from the lowest corner of them all:
    /// far from the origin nothing is lost beyond what was lost before.
    ///
    /// # Errors
    /// Where a number is not finite, an area is not above 0 or a normal is neither zero nor of
    /// length 1.
    pub fn new(elements: impl IntoIterator<Item = Element>) -> Result<Elements, LightError> {
        let checked = elements.into_iter().enumerate().map(|(index, one)| check(index, one));
        let checked: Vec<Element> = checked.collect::<Result<_, _>>()?;
        let lower = |a: [f64; 3], e: &Element| [0, 1, 2].map(|i| a[i].min(e.position[i]));
        let corner = checked.iter().fold([f64::INFINITY; 3], lower);
        let mut all = Elements::default();
        for element in checked {
            let position = [0, 1, 2].map(|i| element.position[i] - corner[i]);
            all.push(Element { position, ..element });
        }
        Ok(all)
    }

    /// Makes an element of every surfel of a map, in their order.
    ///
    /// Places are measured from the lowest corner of the scan's cube, in world units: where the
    /// scan lies in the world changes no bit. Normals have length 1.
    ///
    /// # Errors
    /// Where the map is damaged.
    pub fn of_map(map: &MapView<'_>) -> Result<Elements, LightError> {
        Elements::with_areas(map, &areas_grid2(map)?)
    }

    /// Does the same with areas that are known, in square grid steps, as [`areas_grid2`] gives
    /// them.
    ///
    /// # Errors
    /// Where the map is damaged, or there is not an area above 0 for each surfel.
    pub fn with_areas(map: &MapView<'_>, areas: &[f64]) -> Result<Elements, LightError> {
        let step = map.frame().frame.unit();
        let n = map.summary().n_surfels;
        check_each(n as usize, "the area", "above 0", areas, |a| a > 0.0 && a.is_finite())?;
        let element = |id: u32| {
            let surfel = map.surfel(id)?;
            let normal = surfel.normal.map(f64::from);
            let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
            let unit = |v: f64| if length > 0.0 { v / length } else { 0.0 };
            let position = surfel.centroid.map(|v| f64::from(v) * step);
            // A scan of one place has no extent; any area will do for what sees nothing.
            let area = areas[id as usize] * if step > 0.0 { step * step } else { 1.0 };
            let two_sided = surfel.two_sided;
            Ok::<_, LightError>(Element { position, normal: normal.map(unit), area, two_sided })
        };
        let elements = (0..n).into_par_iter().map(element);
        let mut all = Elements::default();
        elements.collect::<Result<Vec<_>, _>>()?.into_iter().for_each(|one| all.push(one));
        Ok(all)
    }

    fn push(&mut self, element: Element) {
        let ([x, y, z], [u, v, w]) = (element.position, element.normal);
        let two_sided = f64::from(u8::from(element.two_sided));
        let record = [x, y, z, u, v, w, element.area, two_sided];
        self.columns.0.iter_mut().zip(record).for_each(|(column, v)| column.push(v));
    }

    /// Counts them.
    pub fn len(&self) -> usize {
        self.areas().len()
    }

    /// Says whether there are none.
    pub fn is_empty(&self) -> bool {
        self.areas().is_empty()
    }

    /// Gives one of them, `index` < [`Elements::len`], its place as it is kept.
    pub fn get(&self, index: usize) -> Element {
        let [x, y, z, u, v, w, area, two_sided] = self.columns.record(index);
        Element { position: [x, y, z], normal: [u, v, w], area, two_sided: two_sided > 0.0 }
    }

    /// Gives their areas.
    pub fn areas(&self) -> &[f64] {
        &self.columns.0[AREA]
    }

    /// Gives their numbers in another precision, places and areas in a unit of so many of the
    /// length that they are in.
    pub(crate) fn in_units<T: Number>(&self, unit: f64) -> Columns<T> {
        let powers = [-1, -1, -1, 0, 0, 0, -2, 0];
        let column = |i: usize| self.columns.0[i].iter().map(move |v| v * unit.powi(powers[i]));
        Columns([0, 1, 2, 3, 4, 5, 6, 7].map(|i| column(i).map(T::of).collect()))
    }

    /// Counts those without a normal, which take no part.
    pub fn n_without_normal(&self) -> usize {
        (0..self.len()).filter(|&i| self.get(i).normal == [0.0; 3]).count()
    }
}

/// Passes on an element that can be one.
fn check(index: usize, element: Element) -> Result<Element, LightError> {
    let wrong = |what: String| Err(LightError::Element { index, what });
    let Element { position, normal, area, .. } = element;
    if !position.iter().all(|v| v.is_finite()) {
        return wrong(format!("its place {position:?} is not finite"));
    }
    if !(area > 0.0 && area < f64::INFINITY) {
        return wrong(format!("its area is {area}; it must be above 0"));
    }
    let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
    let is_unit = (length - 1.0).abs() <= LENGTH_TOLERANCE;
    if normal != [0.0; 3] && !is_unit {
        return wrong(format!("its normal has length {length}; it must be 1, or 0 for none"));
    }
    Ok(element)
}
