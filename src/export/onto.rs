//! One scan of an octree read again from its own file, and all of it written with the new fields.
//!
//! The octree has of a record what a map needs. Here the file itself gives the records, and the
//! octree says of each that it is the one it took in: at the same place on the grid.

use std::path::Path;

use pvmap_geometry::{Frame, PointBatch, Positions};
use pvmap_octree::OctreeError;
use pvmap_octree::by_source::{BySource, Which};
use pvmap_scan::{
    PositionKind, ReadOptions, Rewrite, RewriteOptions, ScalarField, ScanError,
    Source as ScanSource,
};
use pvmap_store::{ClosedFile, Watch};
use pvmap_vmap::bytes::FieldReader;
use pvmap_vmap::schema::ColumnType;
use pvmap_vmap::{OctreeView, Source};

use super::begin::{LAS_SOFTWARE, PLY_COMMENT};
use super::fields::Values;
use super::lattice::world;
use super::output::{Kind, PointsFile};
use crate::Error;

/// How a source says that it is a PLY.
const PLY_FORMAT: u32 = 3;
/// Records of a scan that are looked through for the first that has a place.
const FIRST_RECORDS: u64 = 1 << 14;
/// Points of an octree that are looked through before the run is asked whether to stop.
const BLOCK_POINTS: u64 = 1 << 16;
/// Most scans of an octree that a message names.
const MOST_NAMED: usize = 5;

/// A scan file that is one of an octree's.
pub(super) struct Scan {
    file: ScanSource,
    index: u32,
    row: Source,
    frame: Frame,
}

impl Scan {
    /// Opens a scan and finds which of the octree's it is.
    pub(super) fn open(
        path: &Path,
        octree: &OctreeView<'_>,
        kind: Kind,
        watch: &dyn Watch,
    ) -> Result<Scan, Error> {
        // Ingest may have taken the part of it that is there. Every record is held against the
        // octree, so nothing goes wrong where it did not.
        let options = ReadOptions { skip_invalid: true, lenient: true };
        let file = ScanSource::open(path, 0, options)?;
        for warning in &file.info().warnings {
            watch.warn(&format!("{}: {warning}", path.display()));
        }
        let is_ply = !matches!(file.info().kind, PositionKind::Lattice { .. });
        if is_ply != (kind == Kind::Ply) {
            let (path, as_what) = (path.display(), if is_ply { ".ply" } else { ".las or .laz" });
            let message = format!("{path}: --scan writes it again as {as_what}, as it is one");
            return Err(Error::Usage(message));
        }
        let index = choose(&file, octree, watch)?;
        let row = octree.sources()[index as usize];
        Ok(Scan { file, index, row, frame: octree.frame().frame })
    }

    /// Says which points of the octree are its.
    pub(super) fn which(&self) -> Which {
        Which::Of(self.index)
    }

    /// Gives names that its records have for what they have.
    pub(super) fn names(&self) -> Vec<String> {
        self.file.names()
    }

    /// Gives the bytes of the output, about, if it is not compressed.
    pub(super) fn rewritten_bytes(&self, fields: &[ScalarField]) -> u64 {
        self.file.rewritten_bytes(fields)
    }

    /// Gives the memory that reading and writing the records hold.
    pub(super) fn coder_bytes(&self, kind: Kind, fields: &[ScalarField]) -> u64 {
        self.file.coder_bytes(kind == Kind::Laz, fields)
    }

    /// Writes all records with the values of their points; gives their number.
    pub(super) fn write(
        &self,
        output: PointsFile,
        (points, values): (BySource<'_>, &Values),
        fields: &[ScalarField],
        watch: &dyn Watch,
    ) -> Result<(u64, ClosedFile), Error> {
        let path = output.path().to_path_buf();
        let (output, kind) = output.into_parts();
        let compressed = kind == Kind::Laz;
        let software = if kind == Kind::Ply { PLY_COMMENT } else { LAS_SOFTWARE };
        let options = RewriteOptions { output, compressed, fields, software };
        let input = self.file.reopen()?;
        let rewrite = Rewrite::begin(&self.file, &input, options, watch)?;
        for warning in rewrite.warnings() {
            watch.warn(&format!("{}: {warning}", path.display()));
        }
        let n_columns = fields.len();
        let mut onto = Onto { scan: self, rewrite, n_columns, next: 0, n_empty: 0, watch };
        points.each(|batch, tags| {
            onto.write(batch, &values.columns(batch, &tags.numbers, &tags.normals))
        })?;
        while onto.next_block(u64::MAX, &[], |_| None)? > 0 {}
        if onto.n_empty > 0 {
            let what = match onto.n_empty {
                1 => "1 record has no place; its new fields are 0".to_owned(),
                n => format!("{n} records have no place; their new fields are 0"),
            };
            watch.warn(&format!("{}: {what}", path.display()));
        }
        Ok((onto.next, onto.rewrite.close(watch)?))
    }
}

/// Finds the one source of an octree that a scan can be: of its kind and with as many records; of
/// several such the one of its name, and of several of its name the one whose first point it has.
fn choose(scan: &ScanSource, octree: &OctreeView<'_>, watch: &dyn Watch) -> Result<u32, Error> {
    let (info, sources) = (scan.info(), octree.sources());
    let is_ply = !matches!(info.kind, PositionKind::Lattice { .. });
    let fits = |s: &Source| {
        let least = s.n_stored.saturating_add(s.n_invalid);
        // Which source the missing ones are of is not stored.
        let most = least.saturating_add(octree.summary().n_missing);
        (s.format == PLY_FORMAT) == is_ply && (least..=most).contains(&info.n_points)
    };
    let fitting: Vec<u32> = (0..).zip(sources).filter(|(_, s)| fits(s)).map(|s| s.0).collect();
    let names: Result<Vec<String>, _> = sources.iter().map(|s| octree.source_name(s)).collect();
    let names = names.map_err(OctreeError::from)?;
    let name = info.path.file_name().unwrap_or_default().to_string_lossy();
    let is_named = |i: &u32| fitting.len() == 1 || names[*i as usize] == name;
    let named: Vec<u32> = fitting.iter().copied().filter(is_named).collect();
    let first = if named.len() > 1 { with_first_point(scan, octree, watch)? } else { None };
    let is_first = |i: &u32| first.as_ref().is_none_or(|first| first.contains(i));
    let found: Vec<u32> = named.iter().copied().filter(is_first).collect();
    if let [one] = found.as_slice() {
        return Ok(*one);
    }
    let (shown, n) = (info.path.display(), info.n_points);
    let listed = |found: &[u32]| -> String {
        let line = |&i: &u32| {
            let Source { n_stored, n_invalid, .. } = &sources[i as usize];
            format!("{} ({})", names[i as usize], n_stored.saturating_add(*n_invalid))
        };
        let some: Vec<String> = found.iter().take(MOST_NAMED).map(line).collect();
        let more = if found.len() > MOST_NAMED { ", ..." } else { "" };
        format!("{}{more}", some.join(", "))
    };
    let none = "is no scan that the octree was made of";
    let problem = if fitting.is_empty() {
        let all: Vec<u32> = (0..).zip(sources).map(|s| s.0).collect();
        format!("{none}: it has {n} records, those have: {}", listed(&all))
    } else if named.is_empty() {
        format!(
            "several scans of the octree have its {n} records and none its name; give it the name \
             it was taken in by: {}",
            listed(&fitting)
        )
    } else if found.is_empty() {
        format!("{none}: those of its name and its {n} records begin with another point")
    } else {
        format!(
            "the octree was made of several scans of this name, its {n} records and its first \
             point; give them names of their own and pvmap ingest them again"
        )
    };
    Err(Error::Data(format!("{shown}: {problem}")))
}

/// Gives the sources of an octree that have the first point of a scan where it is; none where no
/// point is near the start of the scan.
fn with_first_point(
    scan: &ScanSource,
    octree: &OctreeView<'_>,
    watch: &dyn Watch,
) -> Result<Option<Vec<u32>>, Error> {
    let mut first = None;
    let n = scan.info().n_points.min(FIRST_RECORDS);
    scan.read(0..n, n as usize, |batch| {
        let places = world_of(&batch.positions, scan.info().kind);
        let one = batch.records.first().copied().zip(places.first().copied());
        first = first.or(one);
        Ok::<(), ScanError>(())
    })?;
    let (schema, frame) = (octree.schema(), octree.frame().frame);
    let source = schema.column("source");
    let (Some((record, place)), Some(source), Some(at)) = (first, source, schema.column("record"))
    else {
        return Ok(None);
    };
    let Ok(grid) = frame.grid_of_query(place) else { return Ok(Some(Vec::new())) };
    let mut found = Vec::new();
    let n_points = octree.summary().n_points;
    for block in (0..n_points).step_by(BLOCK_POINTS as usize) {
        watch.check()?;
        let n = BLOCK_POINTS.min(n_points - block);
        let points = octree.points(block, n).map_err(OctreeError::from)?;
        for point in points.iter() {
            let point = point.map_err(OctreeError::from)?;
            let mut number = FieldReader::new(&point.record[at.offset..]);
            let is_wide = at.kind == ColumnType::U64;
            let number = if is_wide { number.u64() } else { u64::from(number.u32()) };
            if number == record && point.key.g == grid {
                found.push(FieldReader::new(&point.record[source.offset..]).u32());
            }
        }
    }
    Ok(Some(found))
}

/// The records of a scan on their way out, and the points of the octree that they are.
struct Onto<'a> {
    scan: &'a Scan,
    rewrite: Rewrite<'a>,
    n_columns: usize,
    /// The record that comes next.
    next: u64,
    /// Records without a point.
    n_empty: u64,
    watch: &'a dyn Watch,
}

impl Onto<'_> {
    /// Writes the records up to the last point of a batch, which have its values.
    fn write(&mut self, batch: &PointBatch, values: &[Vec<f64>]) -> Result<(), Error> {
        let places = match &batch.positions {
            Positions::Lattice(steps) => world(steps, self.scan.row.scale, self.scan.row.offset),
            positions => self.scan.world(positions),
        };
        let mut done = 0;
        while done < batch.len() {
            let n_wanted = (batch.records[batch.len() - 1] + 1).saturating_sub(self.next);
            let n = self.next_block(n_wanted, values, |record| {
                let is_next = batch.records.get(done) == Some(&record);
                done += usize::from(is_next);
                is_next.then(|| (done - 1, places[done - 1]))
            })?;
            if n == 0 {
                return Err(self.ended(batch.records[done]));
            }
        }
        Ok(())
    }

    /// Says why there is no record that the octree has.
    fn ended(&self, record: u64) -> Error {
        let (n, path) = (self.next, self.scan.file.info().path.display());
        match self.rewrite.stopped() {
            Some(problem) => Error::Data(format!(
                "{path}: record {n} cannot be read: {problem}; the octree has records behind it: \
                 export without --scan"
            )),
            None => {
                let what =
                    format!("it ends after {n} records, in the octree it has record {record}");
                self.scan.refuse(&what)
            }
        }
    }

    /// Writes some of the next records, up to `n`; gives their number. `point` says of a record,
    /// one after another, which row of `values` it has and where the octree has it.
    fn next_block(
        &mut self,
        n: u64,
        values: &[Vec<f64>],
        mut point: impl FnMut(u64) -> Option<(usize, [f64; 3])>,
    ) -> Result<u64, Error> {
        self.watch.check()?;
        let places = self.scan.world(&self.rewrite.read(n)?);
        // 0 says nothing of a record.
        let mut columns = vec![vec![0.0; places.len()]; self.n_columns];
        for ((i, place), record) in places.iter().enumerate().zip(self.next..) {
            match point(record) {
                Some((row, there)) => {
                    self.scan.require_same(record, *place, there)?;
                    columns.iter_mut().zip(values).for_each(|(c, v)| c[i] = v[row]);
                }
                None => {
                    if place.iter().all(|v| v.is_finite()) {
                        let [x, y, z] = place;
                        let what =
                            format!("record {record} at {x:?},{y:?},{z:?} is not in the octree");
                        return Err(self.scan.refuse(&what));
                    }
                    self.n_empty += 1;
                }
            }
        }
        if !places.is_empty() {
            self.rewrite.write(&columns)?;
        }
        self.next += places.len() as u64;
        Ok(places.len() as u64)
    }
}

impl Scan {
    /// Gives places of the scan in world units.
    fn world(&self, positions: &Positions) -> Vec<[f64; 3]> {
        world_of(positions, self.file.info().kind)
    }

    /// Refuses a record that is elsewhere on the grid than the point of the octree.
    fn require_same(&self, record: u64, here: [f64; 3], there: [f64; 3]) -> Result<(), Error> {
        let grid = |place| self.frame.grid_of_query(place).ok();
        // The same file has the same numbers: the grid is asked where it was converted.
        if here == there || (grid(here).is_some() && grid(here) == grid(there)) {
            return Ok(());
        }
        let ([x, y, z], [a, b, c]) = (here, there);
        let what =
            format!("record {record} is at {x:?},{y:?},{z:?}, in the octree at {a:?},{b:?},{c:?}");
        Err(self.refuse(&what))
    }

    fn refuse(&self, what: &str) -> Error {
        let path = self.file.info().path.display();
        Error::Data(format!("{path}: is not the scan that the octree was made of: {what}"))
    }
}

/// Gives places in world units, of a scan that stores them so.
fn world_of(positions: &Positions, kind: PositionKind) -> Vec<[f64; 3]> {
    match (positions, kind) {
        (Positions::Lattice(steps), PositionKind::Lattice { scale, offset }) => {
            world(steps, scale, offset)
        }
        // No other scan has steps.
        (Positions::Lattice(_), _) => Vec::new(),
        (Positions::Single(places), _) => places.iter().map(|x| x.map(f64::from)).collect(),
        (Positions::Double(places), _) => places.clone(),
    }
}
