//! Points on their way from a reader to the octree: one source, many records, a column each.

/// Where the points of a batch are, exactly as the source stores them.
#[derive(Debug, Clone, PartialEq)]
pub enum Positions {
    /// LAS: whole lattice steps; world = X · scale + offset of the source.
    Lattice(Vec<[i32; 3]>),
    /// PLY with `float` coordinates, in world units.
    Single(Vec<[f32; 3]>),
    /// PLY with `double` or integer coordinates, in world units.
    Double(Vec<[f64; 3]>),
}

impl Positions {
    /// Counts the points.
    pub fn len(&self) -> usize {
        match self {
            Positions::Lattice(v) => v.len(),
            Positions::Single(v) => v.len(),
            Positions::Double(v) => v.len(),
        }
    }

    /// Says whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Says whether all coordinates of the points from number `from` on are finite.
    pub fn is_finite_from(&self, from: usize) -> bool {
        match self {
            Positions::Lattice(_) => true,
            Positions::Single(v) => all(&v[from..], |x| x.is_finite()),
            Positions::Double(v) => all(&v[from..], |x| x.is_finite()),
        }
    }

    /// Keeps the first `n` points.
    pub fn truncate(&mut self, n: usize) {
        match self {
            Positions::Lattice(v) => v.truncate(n),
            Positions::Single(v) => v.truncate(n),
            Positions::Double(v) => v.truncate(n),
        }
    }

    /// Finds the least and the greatest coordinate along each axis, as stored (lattice steps are
    /// exact in f64); `None` without points.
    pub fn bounds(&self) -> Option<([f64; 3], [f64; 3])> {
        match self {
            Positions::Lattice(v) => {
                bounds(v).map(|(min, max)| (min.map(f64::from), max.map(f64::from)))
            }
            Positions::Single(v) => {
                bounds(v).map(|(min, max)| (min.map(f64::from), max.map(f64::from)))
            }
            Positions::Double(v) => bounds(v),
        }
    }
}

/// Says whether all numbers are good, without a branch for each.
#[inline(always)]
fn all<T: Copy>(points: &[[T; 3]], is_good: impl Fn(T) -> bool) -> bool {
    points.as_flattened().iter().fold(true, |good, &x| good & is_good(x))
}

/// Points looked at together: their twelve numbers are whole vectors.
const BOUNDS_LANES: usize = 4;

/// Finds the bounds of points of which none is NaN.
fn bounds<T: PartialOrd + Copy>(points: &[[T; 3]]) -> Option<([T; 3], [T; 3])> {
    let first = *points.first()?;
    let (mut min, mut max) = ([first; BOUNDS_LANES], [first; BOUNDS_LANES]);
    let grow = |min: &mut [T; 3], max: &mut [T; 3], x: &[T; 3]| {
        for i in 0..3 {
            min[i] = if x[i] < min[i] { x[i] } else { min[i] };
            max[i] = if x[i] > max[i] { x[i] } else { max[i] };
        }
    };
    let (groups, rest) = points.as_chunks::<BOUNDS_LANES>();
    for group in groups {
        for k in 0..BOUNDS_LANES {
            grow(&mut min[k], &mut max[k], &group[k]);
        }
    }
    for x in rest {
        grow(&mut min[0], &mut max[0], x);
    }
    let (mut low, mut high) = (first, first);
    for x in min.iter().chain(&max) {
        grow(&mut low, &mut high, x);
    }
    Some((low, high))
}

/// Return strength, exactly as the source stores it.
#[derive(Debug, Clone, PartialEq)]
pub enum Intensity {
    /// LAS, and PLY integers up to 16 bits.
    U16(Vec<u16>),
    /// PLY floats and wider integers.
    F32(Vec<f32>),
}

/// Points of one source in record order: a structure of arrays.
///
/// Every column that is present has exactly [`PointBatch::len`] rows. Coordinates are finite; a
/// reader that drops a record leaves a gap in `records`.
#[derive(Debug, Clone, PartialEq)]
pub struct PointBatch {
    /// Which source of the ingest, in the order the user named them.
    pub source: u32,
    /// Each point's record number in its source, from 0, strictly rising.
    pub records: Vec<u64>,
    /// Each point's place.
    pub positions: Positions,
    /// Red, green, blue as stored: 0…65535, or 0…255 where the source has 8-bit colour.
    pub color: Option<Vec<[u16; 3]>>,
    /// Return strength.
    pub intensity: Option<Intensity>,
    /// ASPRS class.
    pub classification: Option<Vec<u8>>,
    /// GPS time, seconds as the source counts them.
    pub gps_time: Option<Vec<f64>>,
    /// Normals of any length; a point without one has [0, 0, 0] or something not finite.
    pub normal: Option<Vec<[f32; 3]>>,
}

impl PointBatch {
    /// Counts the points.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Says whether the batch is empty.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_of_any_number_of_points() {
        assert_eq!(Positions::Single(Vec::new()).bounds(), None);
        for n in 1..20 {
            let points: Vec<[i32; 3]> = (0..n).map(|i| [i, -i * i, i32::MIN + i]).collect();
            let end = f64::from(n - 1);
            let low = f64::from(i32::MIN);
            let expected = ([0.0, -end * end, low], [end, 0.0, low + end]);
            assert_eq!(Positions::Lattice(points).bounds(), Some(expected));
        }
    }
}
