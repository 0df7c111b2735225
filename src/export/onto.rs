//! One scan of an octree read again from its own file, and all of it written with the new fields.
//!
//! The octree has of a record what a map needs. Here the file itself gives the records, and the
//! octree says of each that it is the one it took in: at the same place on the grid.

use std::path::Path;

use pvmap_geometry::{Frame, PointBatch, Positions};
use pvmap_octree::OctreeError;
use pvmap_octree::by_source::{BySource, Which};
use pvmap_scan::{
    PositionKind, ReadOptions, Rewrite, RewriteOptions, ScalarField, Source as ScanSource,
};
use pvmap_store::{ClosedFile, Watch};
use pvmap_vmap::{OctreeView, Source};

use super::begin::{LAS_SOFTWARE, PLY_COMMENT};
use super::fields::Values;
use super::lattice::world;
use super::output::{Kind, PointsFile};
use crate::Error;

/// How a source says that it is a PLY.
const PLY_FORMAT: u32 = 3;
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
    pub(super) fn open(path: &Path, octree: &OctreeView<'_>, kind: Kind) -> Result<Scan, Error> {
        // An octree of cut files was made of what is there.
        let lenient = octree.summary().n_missing > 0;
        let options = ReadOptions { skip_invalid: true, lenient };
        let file = ScanSource::open(path, 0, options)?;
        let is_ply = !matches!(file.info().kind, PositionKind::Lattice { .. });
        if is_ply != (kind == Kind::Ply) {
            let (path, as_what) = (path.display(), if is_ply { ".ply" } else { ".las or .laz" });
            let message = format!("{path}: --scan writes it again as {as_what}, as it is one");
            return Err(Error::Usage(message));
        }
        let index = choose(&file, octree)?;
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
        let rewrite = Rewrite::begin(&self.file, &input, options)?;
        for warning in self.file.info().warnings.iter().chain(rewrite.warnings()) {
            watch.warn(&format!("{}: {warning}", path.display()));
        }
        let mut onto = Onto { scan: self, rewrite, n_columns: fields.len(), next: 0, n_empty: 0 };
        points.each(|batch, tags| {
            onto.write(batch, &values.columns(batch, &tags.numbers, &tags.normals))
        })?;
        while onto.next_block(u64::MAX, &[], |_| None)? > 0 {
            watch.check()?;
        }
        if onto.n_empty > 0 {
            let (n, path) = (onto.n_empty, path.display());
            watch.warn(&format!("{path}: {n} records have no place; their new fields are 0"));
        }
        Ok((onto.next, onto.rewrite.close()?))
    }
}

/// Finds the one source of an octree that a scan can be: of its kind and with as many records; of
/// several such the one of its name.
fn choose(scan: &ScanSource, octree: &OctreeView<'_>) -> Result<u32, Error> {
    let (info, sources) = (scan.info(), octree.sources());
    let is_ply = !matches!(info.kind, PositionKind::Lattice { .. });
    let fits = |s: &Source| {
        let least = s.n_stored.saturating_add(s.n_invalid);
        // Which source the missing ones are of is not stored.
        let most = least.saturating_add(octree.summary().n_missing);
        (s.format == PLY_FORMAT) == is_ply && (least..=most).contains(&info.n_points)
    };
    let mut found: Vec<u32> = (0..).zip(sources).filter(|(_, s)| fits(s)).map(|s| s.0).collect();
    let names: Result<Vec<String>, _> = sources.iter().map(|s| octree.source_name(s)).collect();
    let names = names.map_err(OctreeError::from)?;
    let named = info.path.file_name().unwrap_or_default().to_string_lossy();
    if found.len() > 1 {
        found.retain(|&i| names[i as usize] == named);
    }
    let (shown, n) = (info.path.display(), info.n_points);
    let listed = |found: &mut dyn Iterator<Item = usize>| -> String {
        let line = |i: usize| {
            let n_records = sources[i].n_stored.saturating_add(sources[i].n_invalid);
            format!("{} ({n_records})", names[i])
        };
        let all: Vec<String> = found.map(line).collect();
        let more = if all.len() > MOST_NAMED { ", ..." } else { "" };
        format!("{}{more}", all[..all.len().min(MOST_NAMED)].join(", "))
    };
    match found.as_slice() {
        [one] => Ok(*one),
        [] if (0..).zip(sources).any(|(_, s): (u32, _)| fits(s)) => Err(Error::Data(format!(
            "{shown}: several scans of the octree have its {n} records and none its name; give it \
             the name it was taken in by: {}",
            listed(&mut (0..sources.len()).filter(|&i| fits(&sources[i])))
        ))),
        [] => Err(Error::Data(format!(
            "{shown}: is no scan that the octree was made of: it has {n} records, those have: {}",
            listed(&mut (0..sources.len()))
        ))),
        _ => Err(Error::Data(format!(
            "{shown}: the octree was made of several scans of this name and its {n} records; give \
             them names of their own and pvmap ingest them again"
        ))),
    }
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
}

impl Onto<'_> {
    /// Writes the records up to the last point of a batch, which have its values.
    fn write(&mut self, batch: &PointBatch, values: &[Vec<f64>]) -> Result<(), Error> {
        let places = match &batch.positions {
            Positions::Lattice(steps) => world(steps, &self.scan.row),
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
                let (n, record) = (self.next, batch.records[done]);
                let what = format!("it ends after {n} records, in the octree it has record");
                return Err(self.scan.other(&format!("{what} {record}")));
            }
        }
        Ok(())
    }

    /// Writes some of the next records, up to `n`; gives their number. `point` says of a record,
    /// one after another, which row of `values` it has and where the octree has it.
    fn next_block(
        &mut self,
        n: u64,
        values: &[Vec<f64>],
        mut point: impl FnMut(u64) -> Option<(usize, [f64; 3])>,
    ) -> Result<u64, Error> {
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
                        let what = format!("record {record} at {x},{y},{z} is not in the octree");
                        return Err(self.scan.other(&what));
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
        match (positions, self.file.info().kind) {
            (Positions::Lattice(steps), PositionKind::Lattice { scale, offset }) => {
                world(steps, &Source { scale, offset, ..self.row })
            }
            (Positions::Lattice(steps), _) => world(steps, &self.row),
            (Positions::Single(places), _) => places.iter().map(|x| x.map(f64::from)).collect(),
            (Positions::Double(places), _) => places.clone(),
        }
    }

    /// Refuses a record that is elsewhere on the grid than the point of the octree.
    fn require_same(&self, record: u64, here: [f64; 3], there: [f64; 3]) -> Result<(), Error> {
        let grid = |place| self.frame.grid_of_query(place).ok();
        // The same file has the same numbers: the grid is asked where it was converted.
        if here == there || (grid(here).is_some() && grid(here) == grid(there)) {
            return Ok(());
        }
        let ([x, y, z], [a, b, c]) = (here, there);
        let what = format!("record {record} is at {x},{y},{z}, in the octree at {a},{b},{c}");
        Err(self.other(&what))
    }

    fn other(&self, what: &str) -> Error {
        let path = self.file.info().path.display();
        Error::Data(format!("{path}: is not the scan that the octree was made of: {what}"))
    }
}
