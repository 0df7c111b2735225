//! From sorted buckets to the closed file: points, normals, codes and the small sections.

use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::Ordering;

use pvmap_geometry::block::{BLOCK_POINTS, NormalBlock};
use pvmap_geometry::normal::quantise;
use pvmap_geometry::{GridBlock, GridPoint};
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
use super::records::gather;
use super::sorter::{Bucket, Pass, Receive, Sorting};
use super::{Account, IngestOptions, IngestReport, SourcePlan};
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
    /// What became of the records, a source each.
    pub(crate) accounts: &'a [Account],
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

/// Bytes gathered, checksummed and written at a time: a few blocks, within a level-2 cache.
const PIECE_BYTES: usize = 256 << 10;

/// Sums over the points that need every point's place and normal.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    digest: u128,
    n_file: u64,
    n_estimated: u64,
    n_oriented: u64,
}

/// The large sections while the sorted points go into them.
struct Writing<'a> {
    job: &'a Job<'a>,
    file: &'a SectionFile,
    points: &'a Scattered,
    normals: &'a Scattered,
    codes: Mutex<Vec<u64>>,
    rows: Rows,
    tally: Mutex<Tally>,
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
        let (points, normals, codes, tally) = self.write_points(&mut file, pass, self.rows())?;
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
            bounds_were_wrong: false,
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
    ) -> Result<(Section, Section, Section, Tally), OctreeError> {
        let stride = self.sorting.layout.schema.record_bytes() as u64;
        let points = file.scattered(self.n_points * stride);
        let rows_bytes = if rows == Rows::Absent { 0 } else { self.n_points * NORMAL_BYTES as u64 };
        let normals = file.scattered(rows_bytes);
        self.sorting.watch.stage("sort", Some(self.n_points), "points");
        let codes = vec![0u64; self.n_points.div_ceil(CODE_STRIDE) as usize];
        let writing = Writing {
            job: self,
            file,
            points: &points,
            normals: &normals,
            codes: Mutex::new(codes),
            rows,
            tally: Mutex::default(),
        };
        file.sync_while(|| self.sorting.sort(&pass, 0, &writing))?;
        drop(pass);
        let Writing { codes, tally, .. } = writing;
        let codes = codes.into_inner().unwrap_or_else(|e| e.into_inner());
        let mut tally = tally.into_inner().unwrap_or_else(|e| e.into_inner());
        let points = points.finish();
        if let Rows::Estimated(wanted) = rows {
            tally = self.estimate(file, &points, &normals, wanted)?;
        }
        let codes: Vec<u8> = codes.into_iter().flat_map(u64::to_le_bytes).collect();
        Ok((points, normals.finish(), file.whole(&codes)?, tally))
    }

    /// Reads the normal that the source of a record brought, given where in the record it is.
    #[inline(always)]
    fn given_normal(record: &[u8], at: usize) -> [f32; 3] {
        FieldReader::new(&record[at..]).three(FieldReader::f32)
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
    ) -> Result<Tally, OctreeError> {
        let normal_at = self.normal_at().filter(|_| wanted == Wanted::Missing);
        let sorted = Sorted { job: self, file, points, normal_at };
        let side = self.options.orientation.in_frame(self.sorting.placement.frame());
        let budget = self.options.memory_bytes;
        let mut known = Vec::new();
        let mut rows = Vec::new();
        let mut tally = Tally::default();
        normals::estimate(&sorted, wanted, budget, self.sorting.watch, |first, found| {
            sorted.read(first..first + found.len() as u64, &mut known)?;
            rows.clear();
            for (point, estimate) in known.iter().zip(found) {
                let row = finish_row(point, estimate, &side);
                rows.extend_from_slice(&row.to_bytes());
                tally.add(point.g, &row);
            }
            file.scatter(normals, &rows, first * NORMAL_BYTES as u64)
        })?;
        Ok(tally)
    }

    fn summary(&self, tally: Tally) -> OctreeSummary {
        let sum = |count: fn(&Account) -> u64| self.accounts.iter().map(count).sum();
        OctreeSummary {
            n_points: self.n_points,
            n_read: sum(|a| a.n_read + a.n_invalid),
            n_invalid: sum(|a| a.n_invalid),
            n_missing: sum(|a| a.n_missing),
            n_beyond: sum(|a| a.n_beyond),
            n_normals_file: tally.n_file,
            n_normals_estimated: tally.n_estimated,
            n_oriented: tally.n_oriented,
            digest: tally.digest,
            normals: self.options.normals.code(),
            orientation: match tally.n_estimated {
                0 => 0,
                _ => self.options.orientation.code(),
            },
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

impl Receive for Writing<'_> {
    fn survey(&self, records: &[u8], codes: &mut Vec<u64>, rows: &mut Vec<[u8; NORMAL_BYTES]>) {
        let Sorting { layout, placement, .. } = self.job.sorting;
        let stride = layout.schema.record_bytes();
        let normal_at = self.job.normal_at().filter(|_| self.rows == Rows::FromRecords);
        codes.reserve_exact(records.len() / stride);
        rows.reserve_exact(normal_at.map_or(0, |_| records.len() / stride));
        let mut tally = Tally::default();
        let mut block = GridBlock::default();
        let mut normals = NormalBlock::default();
        for some in records.chunks(BLOCK_POINTS * stride) {
            let placed = placement.place(some, stride, &mut block);
            placed.expect("packed records name their source");
            codes.extend_from_slice(&block.codes()[..some.len() / stride]);
            match (self.rows, normal_at) {
                // Their normals come later, and the digest with them.
                (Rows::Estimated(_), _) => {}
                (_, Some(at)) => {
                    for (i, record) in some.chunks_exact(stride).enumerate() {
                        normals.set(i, Job::given_normal(record, at));
                    }
                    normals.quantise();
                    for i in 0..some.len() / stride {
                        let normal = normals.normal(i);
                        let known = normal != [0; 3];
                        let row = PointNormal { normal, oriented: known, from_source: known };
                        rows.push(row.to_bytes());
                        tally.add(block.grid(i), &row);
                    }
                }
                (_, None) => (0..some.len() / stride)
                    .for_each(|i| tally.add(block.grid(i), &PointNormal::default())),
            }
        }
        self.tally.lock().unwrap_or_else(|e| e.into_inner()).join(&tally);
    }

    fn write(&self, first: u64, bucket: &mut Bucket) -> Result<(), OctreeError> {
        let Bucket { records, codes, rows, order, piece } = bucket;
        let stride = self.job.sorting.layout.schema.record_bytes();
        let n_piece = (PIECE_BYTES / stride).max(1);
        for (indices, at) in order.chunks(n_piece).zip((first..).step_by(n_piece)) {
            gather(records, indices, stride, piece);
            self.file.scatter(self.points, piece, at * stride as u64)?;
            if !rows.is_empty() {
                piece.clear();
                indices.iter().for_each(|&i| piece.extend_from_slice(&rows[i as usize]));
                self.file.scatter(self.normals, piece, at * NORMAL_BYTES as u64)?;
            }
        }
        let mut index = self.codes.lock().unwrap_or_else(|e| e.into_inner());
        let mut at = first.next_multiple_of(CODE_STRIDE);
        while let Some(&i) = order.get((at - first) as usize) {
            index[(at / CODE_STRIDE) as usize] = codes[i as usize];
            at += CODE_STRIDE;
        }
        Ok(())
    }
}

impl Tally {
    #[inline(always)]
    fn add(&mut self, g: GridPoint, row: &PointNormal) {
        let key = RoutingKey { g, normal: row.normal, oriented: row.oriented };
        self.digest = self.digest.wrapping_add(digest_of(&key));
        let has = row.normal != [0; 3];
        self.n_file += u64::from(has && row.from_source);
        self.n_estimated += u64::from(has && !row.from_source);
        self.n_oriented += u64::from(has && row.oriented);
    }

    fn join(&mut self, other: &Tally) {
        self.digest = self.digest.wrapping_add(other.digest);
        self.n_file += other.n_file;
        self.n_estimated += other.n_estimated;
        self.n_oriented += other.n_oriented;
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
            let normal = self.normal_at.and_then(|at| quantise(Job::given_normal(record, at)));
            KnownPoint { g: g.expect("packed records name their source"), normal }
        }));
        Ok(())
    }
}
