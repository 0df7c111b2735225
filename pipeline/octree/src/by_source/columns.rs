//! Point records taken apart again: where they came from, and the columns they were packed from.

use std::ops::Range;

use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_vmap::bytes::FieldReader;
use pvmap_vmap::records::Record;
use pvmap_vmap::schema::{Column, ColumnType};
use pvmap_vmap::{FormatError, OctreeView, Source};

use super::Which;
use super::seen::{Intensities, Seen};

/// Where the columns are, and which keys the records of each source have.
#[derive(Debug)]
pub(super) struct Columns {
    position: Column,
    record: Column,
    source: Option<Column>,
    normal: Option<Column>,
    color: Option<Column>,
    intensity: Option<Column>,
    class: Option<Column>,
    gps_time: Option<Column>,
    /// The first key of each source, and the end.
    starts: Vec<u64>,
}

impl Columns {
    /// Finds the columns of an octree.
    ///
    /// # Errors
    /// Where its sources have more records than can be counted.
    pub(super) fn of(octree: &OctreeView<'_>) -> Result<Columns, FormatError> {
        let schema = octree.schema();
        let broken = |what: &str| match octree.file().section("sources", Source::BYTES as u32) {
            Ok(section) => section.broken(0, what),
            Err(e) => e,
        };
        let mut starts = vec![0u64];
        for source in octree.sources() {
            // Which source the missing ones are of is not stored.
            let sum = [source.n_stored, source.n_invalid, octree.summary().n_missing];
            let end = sum.iter().try_fold(starts[starts.len() - 1], |a, &b| a.checked_add(b));
            starts.push(end.ok_or_else(|| broken("more records than can be"))?);
        }
        Ok(Columns {
            // A schema begins with these two.
            position: schema.columns()[0],
            record: schema.columns()[1],
            source: schema.column("source"),
            normal: schema.column("normal"),
            color: schema.column("color"),
            intensity: schema.column("intensity"),
            class: schema.column("class"),
            gps_time: schema.column("gps_time"),
            starts,
        })
    }

    /// Gives the keys there can be; none of a source that is not.
    pub(super) fn keys_of(&self, which: Which) -> Range<u64> {
        let start = |i: usize| self.starts.get(i).copied();
        match which {
            Which::All => 0..self.starts.last().copied().unwrap_or(0),
            Which::Of(i) => {
                let i = i as usize;
                start(i).zip(start(i.saturating_add(1))).map_or(0..0, |(a, b)| a..b)
            }
        }
    }

    /// Gives the source of a record.
    pub(super) fn source(&self, record: &[u8]) -> u32 {
        self.source.map_or(0, |c| at(record, c).u32())
    }

    fn number(&self, record: &[u8]) -> u64 {
        match self.record.kind {
            ColumnType::U64 => at(record, self.record).u64(),
            _ => at(record, self.record).u32().into(),
        }
    }

    /// Gives the place of a record in the order of all, which [`Self::checked_key`] has checked.
    pub(super) fn key(&self, record: &[u8]) -> u64 {
        self.starts[self.source(record) as usize] + self.number(record)
    }

    /// Gives the place of point `index` in the order of all.
    ///
    /// # Errors
    /// Where its source has no such record.
    pub(super) fn checked_key(
        &self,
        octree: &OctreeView<'_>,
        index: u64,
        record: &[u8],
    ) -> Result<u64, FormatError> {
        let source = self.source(record) as usize;
        let (start, end) = (self.starts.get(source), self.starts.get(source.saturating_add(1)));
        let key = start.and_then(|start| start.checked_add(self.number(record)));
        match (key, end) {
            (Some(key), Some(&end)) if key < end => Ok(key),
            _ => Err(self.broken(octree, index, "a record that its source does not have")),
        }
    }

    /// Names a broken rule of a point.
    pub(super) fn broken(&self, octree: &OctreeView<'_>, index: u64, what: &str) -> FormatError {
        let record_bytes = octree.schema().record_bytes();
        match octree.file().section("points", record_bytes as u32) {
            Ok(section) => section.broken(index * record_bytes as u64, what),
            Err(e) => e,
        }
    }

    /// Looks at what decides how the points can be written.
    pub(super) fn seen(&self, record: &[u8]) -> Seen {
        let gps_time = self.gps_time.map(|c| at(record, c).f64()).filter(|t| !t.is_nan());
        let intensity = self.intensity.filter(|c| c.kind == ColumnType::F32);
        Seen {
            class_max: self.class.map_or(0, |c| at(record, c).u8()),
            gps_time: gps_time.map(|t| (t, t)),
            intensity: intensity.map(|c| Intensities::of(at(record, c).f32())),
        }
    }

    /// Makes a batch of records of one source.
    pub(super) fn batch(&self, records: &[&[u8]]) -> PointBatch {
        let rows = || records.iter().copied();
        let all = |c: Option<Column>| c.map(|c| rows().map(move |r| at(r, c)));
        PointBatch {
            source: records.first().map_or(0, |r| self.source(r)),
            records: rows().map(|r| self.number(r)).collect(),
            positions: self.positions(records),
            color: all(self.color)
                .map(|fields| fields.map(|mut f| f.three(FieldReader::u16)).collect()),
            intensity: self.intensity.map(|c| match c.kind {
                ColumnType::U16 => Intensity::U16(rows().map(|r| at(r, c).u16()).collect()),
                _ => Intensity::F32(rows().map(|r| at(r, c).f32()).collect()),
            }),
            classification: all(self.class).map(|fields| fields.map(|mut f| f.u8()).collect()),
            gps_time: all(self.gps_time).map(|fields| fields.map(|mut f| f.f64()).collect()),
            normal: all(self.normal)
                .map(|fields| fields.map(|mut f| f.three(FieldReader::f32)).collect()),
        }
    }

    fn positions(&self, records: &[&[u8]]) -> Positions {
        let rows = records.iter().map(|r| at(r, self.position));
        match self.position.kind {
            ColumnType::F32x3 => {
                Positions::Single(rows.map(|mut f| f.three(FieldReader::f32)).collect())
            }
            ColumnType::F64x3 => {
                Positions::Double(rows.map(|mut f| f.three(FieldReader::f64)).collect())
            }
            _ => Positions::Lattice(rows.map(|mut f| f.three(FieldReader::i32)).collect()),
        }
    }
}

#[inline(always)]
fn at(record: &[u8], column: Column) -> FieldReader<'_> {
    FieldReader::new(&record[column.offset..])
}
