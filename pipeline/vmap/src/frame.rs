//! The frame record: the only place in an artifact that knows world units. Section 3 of FORMAT.md.

use pvmap_geometry::Frame;

use crate::bytes::{FieldReader, FieldWriter};
use crate::records::Record;

/// What the bytes of section `crs` are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CrsKind {
    /// There is no CRS.
    #[default]
    None,
    /// OGC well-known text.
    Wkt,
    /// GeoTIFF keys.
    GeoTiff,
}

/// A row of section `frame`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameRecord {
    /// From world units to the grid.
    pub frame: Frame,
    /// What section `crs` holds.
    pub crs_kind: CrsKind,
}

impl Record for FrameRecord {
    const BYTES: usize = 128;

    fn write(&self, w: &mut FieldWriter<'_>) {
        let crs_kind = self.crs_kind as u32;
        match self.frame {
            Frame::Lattice { scale, offset, min, extent } => {
                w.u32(0);
                w.u32(crs_kind);
                w.three(scale, FieldWriter::f64);
                w.three(offset, FieldWriter::f64);
                w.three(min, FieldWriter::i64);
                w.f64(extent);
            }
            Frame::World { min, extent } => {
                w.u32(1);
                w.u32(crs_kind);
                w.three([1.0; 3], FieldWriter::f64);
                w.three([0.0; 3], FieldWriter::f64);
                w.three(min, FieldWriter::f64);
                w.f64(extent);
            }
        }
    }

    fn read(r: &mut FieldReader<'_>) -> Option<FrameRecord> {
        let kind = r.u32();
        let crs_kind = match r.u32() {
            0 => CrsKind::None,
            1 => CrsKind::Wkt,
            2 => CrsKind::GeoTiff,
            _ => return None,
        };
        let scale = r.three(FieldReader::f64);
        let offset = r.three(FieldReader::f64);
        let frame = match kind {
            0 => Frame::Lattice { scale, offset, min: r.three(FieldReader::i64), extent: r.f64() },
            1 => Frame::World { min: r.three(FieldReader::f64), extent: r.f64() },
            _ => return None,
        };
        let finite = scale.iter().chain(&offset).all(|v| v.is_finite());
        (finite && frame.extent().is_finite() && frame.extent() >= 0.0)
            .then_some(FrameRecord { frame, crs_kind })
    }
}
