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
