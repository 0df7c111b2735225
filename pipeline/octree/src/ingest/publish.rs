//! From sorted buckets to the closed file: points, normals, codes and the small sections.

use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use pvmap_geometry::normal::{Normal, quantise};
use pvmap_store::sections::{Scattered, Section};
use pvmap_store::{SectionFile, StoreError};
use pvmap_vmap::OctreeSummary;
use pvmap_vmap::bytes::FieldReader;
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::frame::{CrsKind, FrameRecord};
use pvmap_vmap::octree::{
    CODE_STRIDE, FILE_NAME, NORMAL_BYTES, PointNormal, SECTIONS, close_octree, digest_of,
};
use pvmap_vmap::records::Record;
use pvmap_vmap::tree::RoutingKey;

use super::orient::OrientInFrame;
use super::sorter::{Pass, Sorting};
use super::{IngestOptions, IngestReport, SourcePlan};
use crate::OctreeError;
use crate::normals::{self, Estimate, KnownPoint, Sign, SortedPoints, Wanted};

/// Everything that is known once all batches are in.
pub(crate) struct Job<'a> {
    pub(crate) options: &'a IngestOptions,
    pub(crate) sorting: &'a Sorting<'a>,
    pub(crate) plans: &'a [SourcePlan],
    pub(crate) n_points: u64,
    /// Points whose source brought a usable normal.
    pub(crate) n_normals: u64,
}

/// How the normal rows come about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Rows {
    /// There are none.
    Absent,
    /// From the records, as they are sorted.
    FromRecords,
    /// In a pass over the sorted points.
    Estimated(Wanted),
}

/// Counts that need every point's normal.
#[derive(Debug, Default)]
struct Tally {
    digest: Mutex<u128>,
    n_file: AtomicU64,
    n_estimated: AtomicU64,
    n_oriented: AtomicU64,
}

impl Job<'_> {
    /// Sorts, writes and closes the file in its temporary folder.
    pub(crate) fn run(&self, pass: Pass) -> Result<IngestReport, OctreeError> {
        let path = self.sorting.folder.join(FILE_NAME);
        let mut file = SectionFile::create(&path, head_bytes(SECTIONS.len()))?;
        let layout = self.sorting.layout;
        // The summary is known last but stands first: its room is taken now.
        let room = file.whole(&[0; OctreeSummary::BYTES])?;
        let columns = file.whole(&layout.schema.to_bytes())?;
        let sources: Vec<u8> = layout.sources.iter().flat_map(Record::to_bytes).collect();
        let sources = file.whole(&sources)?;
        let names: Vec<u8> = self.plans.iter().flat_map(|p| p.name.clone()).collect();
        let names = file.whole(&names)?;
        let tally = Tally::default();
        let rows = self.rows();
        let (points, normals, codes) = self.write_points(&mut file, pass, rows, &tally)?;
        let frame = *self.sorting.placement.frame();
        let crs = self.plans.iter().find_map(|p| p.crs.clone());
        let (crs_kind, crs) = crs.unwrap_or((CrsKind::None, Vec::new()));
        let frame = file.whole(&FrameRecord { frame, crs_kind }.to_bytes())?;
        let crs = file.whole(&crs)?;
        let summary = self.summary(tally);
        let room = file.rewrite(&room, &summary.to_bytes())?;
        let record_bytes = layout.schema.record_bytes();
        let sections = [room, columns, sources, names, points, normals, codes, frame, crs];
        let sizes = [
            OctreeSummary::BYTES,
            32,
            192,
            0,
            record_bytes,
            NORMAL_BYTES,
            8,
            FrameRecord::BYTES,
            0,
        ];
        let written: Vec<Written> = sections
            .into_iter()
            .zip(SECTIONS)
            .zip(sizes)
            .map(|((section, name), size)| written(section, name, size as u32))
            .collect();
        let closing = close_octree(&written);
        let output_bytes = closing.sums_offset_bytes + closing.sums.len() as u64;
        file.finish(&closing.head, &closing.sums, closing.sums_offset_bytes)?;
        Ok(IngestReport {
            summary,
            output_bytes,
            temporary_bytes: self.sorting.spilled.load(Ordering::Relaxed),
            bounds_were_true: true,
        })
    }

    fn rows(&self) -> Rows {
        let from = self.options.normals;
        let file = from.uses_file() && self.n_normals > 0;
        match (file, from.estimates()) {
            _ if self.n_points == 0 => Rows::Absent,
            (true, true) if self.n_normals < self.n_points => Rows::Estimated(Wanted::Missing),
            (true, _) => Rows::FromRecords,
            (false, true) => Rows::Estimated(Wanted::All),
            (false, false) => Rows::Absent,
        }
    }

    fn write_points(
        &self,
        file: &mut SectionFile,
        pass: Pass,
        rows: Rows,
        tally: &Tally,
    ) -> Result<(Section, Section, Section), OctreeError> {
        let stride = self.sorting.layout.schema.record_bytes() as u64;
        let points = file.scattered(self.n_points * stride);
        let rows_bytes = if rows == Rows::Absent { 0 } else { self.n_points * NORMAL_BYTES as u64 };
        let normals = file.scattered(rows_bytes);
        let codes = Mutex::new(vec![0u64; self.n_points.div_ceil(CODE_STRIDE) as usize]);
        self.sorting.watch.stage("sort", Some(self.n_points), "points");
        self.sorting.sort(&pass, 0, &|first, sorted_codes, records| {
            file.scatter(&points, records, first * stride)?;
            note_codes(&mut codes.lock().unwrap_or_else(|e| e.into_inner()), first, sorted_codes);
            match rows {
                Rows::Estimated(_) => {}
                Rows::Absent => tally.add(self.keys(records, |_| PointNormal::default())),
                Rows::FromRecords => {
                    let rows = self.rows_of(records, tally);
                    file.scatter(&normals, &rows, first * NORMAL_BYTES as u64)?;
                }
            }
            Ok(())
        })?;
        drop(pass);
        let points = points.finish();
        if let Rows::Estimated(wanted) = rows {
            self.estimate(file, &points, &normals, wanted, tally)?;
        }
        let codes: Vec<u8> = codes
            .into_inner()
            .unwrap_or_else(|e| e.into_inner())
            .into_iter()
            .flat_map(u64::to_le_bytes)
            .collect();
        Ok((points, normals.finish(), file.whole(&codes)?))
    }

    /// Makes the normal rows of records whose source brings normals.
    fn rows_of(&self, records: &[u8], tally: &Tally) -> Vec<u8> {
        let n_points = records.len() / self.sorting.layout.schema.record_bytes();
        let mut rows = Vec::with_capacity(n_points * NORMAL_BYTES);
        let at = self.normal_at().expect("rows are made of records that have normals");
        tally.add(self.keys(records, |record| {
            let normal = Self::file_normal(record, at);
            let known = normal.is_some();
            let normal = normal.unwrap_or_default();
            let row = PointNormal { normal, oriented: known, from_source: known };
            rows.extend_from_slice(&row.to_bytes());
            row
        }));
        rows
    }

    /// Walks records with the normals they get.
    fn keys<'r>(
        &'r self,
        records: &'r [u8],
        mut normal: impl FnMut(&[u8]) -> PointNormal + 'r,
    ) -> impl Iterator<Item = (RoutingKey, PointNormal)> + 'r {
        records.chunks_exact(self.sorting.layout.schema.record_bytes()).map(move |record| {
            let g = self.sorting.placement.grid(record).expect("packed records name their source");
            let row = normal(record);
            (RoutingKey { g, normal: row.normal, oriented: row.oriented }, row)
        })
    }

    /// Reads the normal that the source of a record brought, given where in the record it is.
    fn file_normal(record: &[u8], at: usize) -> Option<Normal> {
        let mut fields = FieldReader::new(&record[at..]);
        quantise(fields.three(FieldReader::f32))
    }

    /// Gives where in a record the normal is.
    fn normal_at(&self) -> Option<usize> {
        self.sorting.layout.schema.column("normal").map(|c| c.offset)
    }

    fn estimate(
        &self,
        file: &SectionFile,
        points: &Section,
        normals: &Scattered,
        wanted: Wanted,
        tally: &Tally,
    ) -> Result<(), OctreeError> {
        let normal_at = self.normal_at().filter(|_| wanted == Wanted::Missing);
        let sorted = Sorted { job: self, file, points, normal_at };
        let side = self.options.orientation.in_frame(self.sorting.placement.frame());
        let budget = self.options.memory_bytes;
        let mut known = Vec::new();
        let mut rows = Vec::new();
        normals::estimate(&sorted, wanted, budget, self.sorting.watch, |first, found| {
            sorted.read(first..first + found.len() as u64, &mut known)?;
            rows.clear();
            tally.add(known.iter().zip(found).map(|(point, estimate)| {
                let row = finish_row(point, estimate, &side);
                rows.extend_from_slice(&row.to_bytes());
                (RoutingKey { g: point.g, normal: row.normal, oriented: row.oriented }, row)
            }));
            file.scatter(normals, &rows, first * NORMAL_BYTES as u64)
        })?;
        Ok(())
    }

    fn summary(&self, tally: Tally) -> OctreeSummary {
        let sources = &self.sorting.layout.sources;
        let n_invalid = sources.iter().map(|s| s.n_invalid).sum();
        OctreeSummary {
            n_points: self.n_points,
            n_read: self.n_points + n_invalid,
            n_invalid,
            n_normals_file: tally.n_file.into_inner(),
            n_normals_estimated: tally.n_estimated.into_inner(),
            n_oriented: tally.n_oriented.into_inner(),
            digest: tally.digest.into_inner().unwrap_or_else(|e| e.into_inner()),
            normals: self.options.normals.code(),
            orientation: self.options.orientation.code(),
        }
    }
}

/// Turns an estimate into the row that is stored: kept normals are the file's, estimated ones get
/// their side from the neighbours, else from what the user knows.
fn finish_row(point: &KnownPoint, estimate: &Estimate, side: &OrientInFrame) -> PointNormal {
    if point.normal.is_some() {
        return PointNormal { normal: estimate.normal, oriented: true, from_source: true };
    }
    let (normal, oriented) = match estimate.sign {
        Sign::Known => (estimate.normal, true),
        Sign::Unknown => side.orient(point.g, estimate.normal),
    };
    PointNormal { normal, oriented: oriented && normal != [0; 3], from_source: false }
}

impl Tally {
    fn add(&self, points: impl Iterator<Item = (RoutingKey, PointNormal)>) {
        let (mut digest, mut n_file, mut n_estimated, mut n_oriented) = (0u128, 0, 0, 0);
        for (key, row) in points {
            digest = digest.wrapping_add(digest_of(&key));
            let has = row.normal != [0; 3];
            n_file += u64::from(has && row.from_source);
            n_estimated += u64::from(has && !row.from_source);
            n_oriented += u64::from(has && row.oriented);
        }
        let mut total = self.digest.lock().unwrap_or_else(|e| e.into_inner());
        *total = total.wrapping_add(digest);
        self.n_file.fetch_add(n_file, Ordering::Relaxed);
        self.n_estimated.fetch_add(n_estimated, Ordering::Relaxed);
        self.n_oriented.fetch_add(n_oriented, Ordering::Relaxed);
    }
}

/// Notes the codes of every [`CODE_STRIDE`]th point.
fn note_codes(index: &mut [u64], first: u64, codes: &[u64]) {
    let mut at = first.next_multiple_of(CODE_STRIDE);
    while at < first + codes.len() as u64 {
        index[(at / CODE_STRIDE) as usize] = codes[(at - first) as usize];
        at += CODE_STRIDE;
    }
}

fn written(section: Section, name: &'static str, record_bytes: u32) -> Written {
    let Section { offset_bytes, len_bytes, sums } = section;
    Written { name, offset_bytes, len_bytes, record_bytes, sums }
}

/// The sorted points of a file that is not closed yet.
struct Sorted<'a> {
    job: &'a Job<'a>,
    file: &'a SectionFile,
    points: &'a Section,
    /// Where normals of the records are, if they count; else all are to be estimated.
    normal_at: Option<usize>,
}

impl SortedPoints for Sorted<'_> {
    fn len(&self) -> u64 {
        self.job.n_points
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<KnownPoint>) -> Result<(), StoreError> {
        let stride = self.job.sorting.layout.schema.record_bytes();
        let mut bytes = vec![0; (range.end - range.start) as usize * stride];
        let at = self.points.offset_bytes + range.start * stride as u64;
        self.file.read_at(&mut bytes, at)?;
        out.clear();
        out.extend(bytes.chunks_exact(stride).map(|record| {
            let g = self.job.sorting.placement.grid(record);
            let normal = self.normal_at.and_then(|at| Job::file_normal(record, at));
            KnownPoint { g: g.expect("packed records name their source"), normal }
        }));
        Ok(())
    }
}
