//! Ingest: batches in, the sorted artifact out. Source: DESIGN.md [D-3]…[D-5].
//!
//! One decode, one temporary write, one temporary read, one final write. Records are packed as
//! they arrive and go to buckets of Morton keys in the frame of the headers' bounds (`sorter`).
//! If the true bounds are those of the headers the buckets are final, else the packed records are
//! distributed once more. Each bucket is sorted in memory and written at its place; normals that
//! the scan does not bring are estimated over the sorted points; then the file is closed.
//!
//! Use: [`Ingest::new`], a [`Worker`] a thread that takes batches, [`Ingest::finish`].

mod layout;
mod order;
mod orient;
mod publish;
mod records;
mod sorter;
mod turns;

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::AtomicU64;

use pvmap_geometry::{Frame, PointBatch};
use pvmap_store::output::OnlyFile;
use pvmap_store::{AtomicFolder, StoreError, Watch, memory};
use pvmap_vmap::OctreeSummary;
use pvmap_vmap::container::Kind;
use pvmap_vmap::octree::{FILE_NAME, NORMAL_BYTES, Placement};

use crate::OctreeError;
use layout::Layout;
pub use layout::{ColorPlan, PositionPlan, SourcePlan};
pub use orient::Orientation;
pub use sorter::Worker;
use sorter::{Pass, Seen, Shares, Sorting, sample_keys};
pub use turns::Turns;

/// What an octree folder holds.
const POINTS: OnlyFile = OnlyFile { name: FILE_NAME, start: Kind::Octree.start() };

/// Where normals come from. Source: DESIGN.md [D-5].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NormalsFrom {
    /// The file where it has them, else estimated.
    #[default]
    Auto,
    /// The file alone.
    File,
    /// Estimated, whatever the file has.
    Estimate,
    /// Nowhere: no point has one.
    None,
}

impl NormalsFrom {
    fn uses_file(self) -> bool {
        matches!(self, NormalsFrom::Auto | NormalsFrom::File)
    }

    fn estimates(self) -> bool {
        matches!(self, NormalsFrom::Auto | NormalsFrom::Estimate)
    }

    fn code(self) -> u32 {
        self as u32
    }
}

/// What an ingest is asked for besides its sources.
#[derive(Debug, Clone)]
pub struct IngestOptions {
    /// The folder to make.
    pub output: PathBuf,
    /// Whether it may replace a folder of that name.
    pub overwrite: bool,
    /// Most anonymous memory to hold, less 16 MiB and 2 MiB a thread. [D-9]
    pub memory_bytes: u64,
    /// Where normals come from.
    pub normals: NormalsFrom,
    /// What gives estimated normals their side.
    pub orientation: Orientation,
}

/// What became of the records of a source, as its reader counts them. [D-4]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Account {
    /// Points handed over.
    pub n_read: u64,
    /// Records dropped because a coordinate was not finite.
    pub n_invalid: u64,
    /// Records that the header declares and a cut file does not hold.
    pub n_missing: u64,
    /// Records that the file holds beyond the header's count, not read.
    pub n_beyond: u64,
}

/// What an ingest did.
#[derive(Debug, Clone, PartialEq)]
pub struct IngestReport {
    /// The counts of the artifact.
    pub summary: OctreeSummary,
    /// Bytes of the finished file.
    pub output_bytes: u64,
    /// Bytes written to temporary files.
    pub temporary_bytes: u64,
    /// Whether the bounds that the headers declare were wrong, so that records were sorted anew.
    pub bounds_were_wrong: bool,
}

/// An ingest that takes batches.
pub struct Ingest<'w> {
    options: IngestOptions,
    layout: Layout,
    plans: Vec<SourcePlan>,
    folder: AtomicFolder,
    shares: Shares,
    guess: Option<Frame>,
    pass: Pass,
    seen: Mutex<Seen>,
    watch: &'w dyn Watch,
}

impl<'w> Ingest<'w> {
    /// Prepares to take batches of these sources. `samples` are a few thousand points from all
    /// over the sources; without them, or without declared bounds, records are packed twice.
    /// Threads are those of the current rayon pool.
    ///
    /// # Errors
    /// Where the output exists or cannot be made, or the disk has too little room.
    pub fn new(
        options: IngestOptions,
        plans: Vec<SourcePlan>,
        samples: &[PointBatch],
        watch: &'w dyn Watch,
    ) -> Result<Ingest<'w>, OctreeError> {
        let layout = Layout::new(&plans);
        let record_bytes = layout.schema.record_bytes() as u64;
        let n_threads = rayon::current_num_threads() as u64;
        let shares = Shares::new(options.memory_bytes, n_threads, record_bytes);
        let folder = AtomicFolder::create(&options.output, options.overwrite, POINTS)?;
        let n_declared: u64 = plans.iter().map(|p| p.n_declared).sum();
        let total_bytes = n_declared.saturating_mul(record_bytes);
        require_disk(folder.temp_path(), n_declared, total_bytes, shares.hold_bytes)?;
        let guess = layout.declared_bounds(&plans).map(|b| layout.frame(Some(b)));
        let guess = guess.filter(|_| !samples.is_empty());
        let pass = match &guess {
            None => Pass::unordered(folder.temp_path(), &shares),
            Some(frame) => {
                let mut keys = Vec::new();
                samples.iter().for_each(|batch| sample_keys(&layout, frame, batch, &mut keys));
                Pass::new(folder.temp_path(), &mut keys, total_bytes, shares.hold_bytes, &shares)
            }
        };
        let seen = Mutex::default();
        Ok(Ingest { options, layout, plans, folder, shares, guess, pass, seen, watch })
    }

    /// Makes a worker; any number of them may take batches at once.
    pub fn worker(&self) -> Worker<'_> {
        Worker::new(&self.layout, self.guess, &self.pass, &self.seen)
    }

    /// Sorts what was taken and makes the artifact. `accounts` says, a source each, what became of
    /// the records by its reader's own count; it is held against what the workers took. [D-4]
    ///
    /// # Errors
    /// Where a point was lost, the disk fails, the run is asked to stop or the budget is too small;
    /// nothing is left behind then.
    pub fn finish(self, accounts: &[Account]) -> Result<IngestReport, OctreeError> {
        let Ingest { options, mut layout, plans, folder, shares, guess, pass, seen, watch } = self;
        let seen = seen.into_inner().unwrap_or_else(|e| e.into_inner());
        let frame = layout.frame(seen.bounds);
        let n_points: u64 = seen.sources.iter().map(|s| s.n_points).sum();
        for (i, source) in layout.sources.iter_mut().enumerate() {
            let found = seen.sources.get(i).copied().unwrap_or_default();
            source.n_stored = found.n_points;
            let account = accounts.get(i).copied().unwrap_or_default();
            if account.n_read != found.n_points {
                return Err(OctreeError::Lost {
                    source_index: i as u32,
                    n_read: account.n_read,
                    n_taken: found.n_points,
                });
            }
            source.n_invalid = account.n_invalid;
            source.color_depth = plans[i].color.depth(found.color_max);
        }
        let placement = Placement::new(&layout.schema, frame, &layout.sources);
        let sorting = Sorting {
            layout: &layout,
            placement: &placement,
            folder: folder.temp_path(),
            shares,
            watch,
            spilled: AtomicU64::new(pass.spilled_bytes()),
        };
        let bounds_were_wrong = guess.is_some_and(|guess| guess != frame) && n_points > 0;
        let pass = if guess == Some(frame) || n_points == 0 {
            pass
        } else {
            watch.stage("distribute", Some(n_points), "points");
            let again = sorting.again(&pass, &seen.sample.records)?;
            sorting.spilled.fetch_add(again.spilled_bytes(), std::sync::atomic::Ordering::Relaxed);
            again
        };
        let job = publish::Job {
            options: &options,
            sorting: &sorting,
            plans: &plans,
            n_points,
            n_normals: seen.sources.iter().map(|s| s.n_normals).sum(),
            accounts,
        };
        let mut report = job.run(pass)?;
        report.bounds_were_wrong = bounds_were_wrong;
        folder.commit()?;
        Ok(report)
    }
}

/// Refuses before work when the estimate does not fit: the output, and what will be spilled.
fn require_disk(
    folder: &Path,
    n_points: u64,
    record_bytes: u64,
    hold_bytes: u64,
) -> Result<(), StoreError> {
    let output = record_bytes.saturating_add(n_points.saturating_mul(NORMAL_BYTES as u64));
    let spilled = record_bytes.saturating_sub(hold_bytes);
    memory::require_disk(&folder.join("points.pvo"), output.saturating_add(spilled))
}
