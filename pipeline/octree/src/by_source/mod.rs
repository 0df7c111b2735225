//! The way back: the points of an octree in the order of their sources and records, each with a
//! number that the caller gives it on the way.
//!
//! One pass over the sorted points puts them into buckets of (source, record), in memory while the
//! budget allows and in a nameless temporary file beyond it; then each bucket is put in order and
//! handed over. While one is handed over, the next is put in order by a thread of its own, where
//! there is more than one. The order, and so every byte made of it, is that of the scans.
//!
//! Use: [`BySource::gather`], then [`BySource::each`].

mod columns;
mod seen;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::sync::{Mutex, PoisonError};

use pvmap_geometry::PointBatch;
use pvmap_geometry::normal::Normal;
use pvmap_store::{Spill, StoreError, Watch};
use pvmap_vmap::OctreeView;
use pvmap_vmap::bytes::{FieldReader, FieldWriter};
use pvmap_vmap::octree::{CODE_STRIDE, Point};

use crate::OctreeError;
use crate::ingest::Turns;
use columns::Columns;
pub use seen::{Intensities, Seen};

/// Points that a thread takes at a time.
const BLOCK_POINTS: u64 = 4 * CODE_STRIDE;
/// Most points of a batch that is handed over.
const BATCH_POINTS: usize = 16_384;
/// Most buckets of one pass; more would make the buffers of the threads too small.
const MAX_BUCKETS: u64 = 1024;
/// No bucket need be larger.
const GOOD_BUCKET_BYTES: u64 = 8 << 20;
/// A buffer of less makes the disk jump from place to place.
const LEAST_BUFFER_BYTES: u64 = 64 << 10;
/// A buffer of more is of no use, unless there are very many extents.
const GOOD_BUFFER_BYTES: u64 = 256 << 10;
const MOST_BUFFER_BYTES: u64 = 8 << 20;
/// What an extent takes in the list of its bucket, which grows by doubling.
const EXTENT_BYTES: u64 = 64;
/// The number behind each record.
const TAG_BYTES: usize = 4;
/// Bytes that putting in order holds for a point beside its row: its key and its place.
const SORT_BYTES: u64 = size_of::<(u64, u32)>() as u64;

/// How a memory budget is shared out: 45 % to points held, 10 % to buffers, 30 % to the two
/// buckets at hand; the rest is for whoever takes the points.
#[derive(Debug, Clone, Copy)]
struct Shares {
    hold_bytes: u64,
    buffer_bytes: u64,
    /// The list of what went to disk; beyond it, that is taken from the points held.
    extent_bytes: u64,
    /// Points of a bucket that is put in order in one piece.
    bucket_points: u64,
    record_bytes: usize,
    row_bytes: u64,
}

impl Shares {
    fn new(octree: &OctreeView<'_>, with: With, memory_bytes: u64) -> Shares {
        let record_bytes = octree.schema().record_bytes();
        let row_bytes = (record_bytes + TAG_BYTES + with.n_bytes()) as u64;
        let bucket_bytes = (memory_bytes * 15 / 100).min(2 * GOOD_BUCKET_BYTES);
        Shares {
            hold_bytes: memory_bytes * 45 / 100,
            buffer_bytes: memory_bytes / 10,
            extent_bytes: memory_bytes / 20,
            bucket_points: (bucket_bytes / (row_bytes + SORT_BYTES)).clamp(1, 1 << 31),
            record_bytes,
            row_bytes,
        }
    }
}

/// What comes with each point beside its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum With {
    /// Nothing.
    Numbers,
    /// Its normal in the octree.
    Normals,
}

impl With {
    fn n_bytes(self) -> usize {
        if self == With::Normals { size_of::<Normal>() } else { 0 }
    }
}

/// Which points are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Which {
    /// All.
    All,
    /// Those of one source, by its number.
    Of(u32),
}

impl Which {
    fn has(self, source: u32) -> bool {
        self == Which::All || self == Which::Of(source)
    }

    fn n_points(self, octree: &OctreeView<'_>) -> u64 {
        match self {
            Which::All => octree.summary().n_points,
            Which::Of(i) => octree.sources().get(i as usize).map_or(0, |s| s.n_stored),
        }
    }
}

/// What came with the points of a batch, in their order.
#[derive(Debug, Default)]
pub struct Tags {
    /// Their numbers.
    pub numbers: Vec<u32>,
    /// Their normals, of length 2^14 or zero, where they were asked for.
    pub normals: Vec<Normal>,
}

impl Tags {
    fn of(rows: &[&[u8]], record_bytes: usize, with: With) -> Tags {
        let normal_at = record_bytes + TAG_BYTES;
        let normal = |r: &&[u8]| FieldReader::new(&r[normal_at..]).three(FieldReader::i16);
        let normals = match with {
            With::Numbers => Vec::new(),
            With::Normals => rows.iter().map(normal).collect(),
        };
        Tags {
            numbers: rows.iter().map(|r| FieldReader::new(&r[record_bytes..]).u32()).collect(),
            normals,
        }
    }
}

/// Gives the bytes that [`BySource::gather`] writes to its temporary file, about.
pub fn temporary_bytes(
    octree: &OctreeView<'_>,
    (which, with): (Which, With),
    memory_bytes: u64,
) -> u64 {
    let (shares, n_points) = (Shares::new(octree, with, memory_bytes), which.n_points(octree));
    let plan = Plan::new(n_points, u64::MAX, rayon::current_num_threads(), &shares);
    let all = n_points.saturating_mul(shares.row_bytes);
    let spilled = all.saturating_sub(shares.hold_bytes.saturating_sub(plan.beyond_bytes));
    // A bucket that is too large is distributed once more while the first file stays.
    let is_again = n_points / plan.n_buckets > shares.bucket_points;
    spilled.saturating_add(if is_again { all / plan.n_buckets } else { 0 })
}

/// All points of an octree with their numbers, on the way to the order of their sources.
pub struct BySource<'a> {
    octree: &'a OctreeView<'a>,
    columns: Columns,
    with: With,
    n_points: u64,
    shares: Shares,
    n_threads: usize,
    folder: &'a Path,
    pass: Pass,
    seen: Seen,
    watch: &'a dyn Watch,
}

impl<'a> BySource<'a> {
    /// Takes the points wanted, what shall come `with` them and the number that `tag` gives each.
    /// Every thread of the current rayon pool makes a tagger; it gets points in Morton order, of
    /// whole blocks. What is not held in `memory_bytes` goes to a temporary file in `folder`.
    ///
    /// # Errors
    /// Where the octree is damaged, the disk fails or the run is asked to stop, and those of the
    /// taggers.
    pub fn gather<E, T>(
        octree: &'a OctreeView<'a>,
        (which, with): (Which, With),
        (folder, memory_bytes): (&'a Path, u64),
        tag: impl Fn() -> T + Sync,
        watch: &'a dyn Watch,
    ) -> Result<BySource<'a>, E>
    where
        E: From<OctreeError> + Send,
        T: FnMut(&Point<'_>) -> Result<u32, E>,
    {
        let n_points = octree.summary().n_points;
        let columns = Columns::of(octree).map_err(OctreeError::from)?;
        let shares = Shares::new(octree, with, memory_bytes);
        let n_threads = rayon::current_num_threads();
        let (n_wanted, keys) = (which.n_points(octree), columns.keys_of(which));
        let plan = Plan::new(n_wanted, keys.end - keys.start, n_threads, &shares);
        let pass = Pass::new(folder, keys, shares.hold_bytes, plan);
        let seen = Mutex::new(Seen::NOTHING);
        watch.stage("distribute", Some(n_points), "points");
        Turns::run(n_points.div_ceil(BLOCK_POINTS) as usize, |turns| {
            let (mut tag, mut here) = (tag(), Seen::NOTHING);
            let mut buffers = pass.buffers();
            while let Some(turn) = turns.take() {
                watch.check().map_err(OctreeError::from)?;
                let first = turn as u64 * BLOCK_POINTS;
                let n = BLOCK_POINTS.min(n_points - first);
                let points = octree.points(first, n).map_err(OctreeError::from)?;
                for (point, index) in points.iter().zip(first..) {
                    let point = point.map_err(OctreeError::from)?;
                    let key = columns.checked_key(octree, index, point.record);
                    let key = key.map_err(OctreeError::from)?;
                    if !which.has(columns.source(point.record)) {
                        continue;
                    }
                    here = here.join(columns.seen(point.record));
                    let (tag, normal) = (tag(&point)?.to_le_bytes(), bytes_of(point.key.normal));
                    buffers.put(key, &[point.record, &tag, &normal[..with.n_bytes()]])?;
                }
                watch.advance(n);
            }
            let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
            *seen = seen.join(here);
            Ok::<_, E>(buffers.finish()?)
        })?;
        let seen = seen.into_inner().unwrap_or_else(PoisonError::into_inner);
        let n_points = n_wanted;
        Ok(BySource {
            octree,
            columns,
            with,
            n_points,
            shares,
            n_threads,
            folder,
            pass,
            seen,
            watch,
        })
    }

    /// Gives what was seen of the points.
    pub fn seen(&self) -> Seen {
        self.seen
    }

    /// Gives the bytes that went to disk.
    pub fn spilled_bytes(&self) -> u64 {
        self.pass.spill.spilled_bytes()
    }

    /// Hands over all points in the order of (source, record): batches as the readers of the
    /// sources gave them, and what came with each point.
    ///
    /// # Errors
    /// Where two points are of one record, the disk fails or the run is asked to stop, and those
    /// of `visit`.
    pub fn each<E: From<OctreeError>>(
        self,
        mut visit: impl FnMut(&PointBatch, &Tags) -> Result<(), E>,
    ) -> Result<(), E> {
        self.watch.stage("write", Some(self.n_points), "points");
        if self.n_threads == 1 {
            return self.walk(&self.pass, &mut |piece| self.hand_over(&piece, &mut visit));
        }
        // Without room in between: one piece is handed over, one is being put in order.
        let (send, receive) = sync_channel::<Piece>(0);
        std::thread::scope(|scope| {
            let sorter = scope.spawn(|| {
                // It goes with this thread: its end ends the other's wait.
                let send = send;
                self.walk(&self.pass, &mut |piece| {
                    // Where nobody takes pieces any more there is an error to tell already.
                    send.send(piece).map_err(|_| StoreError::Interrupted.into())
                })
            });
            let mut handed = Ok(());
            while let (true, Ok(piece)) = (handed.is_ok(), receive.recv()) {
                handed = self.hand_over(&piece, &mut visit);
            }
            drop(receive);
            let sorted: Result<(), OctreeError> =
                sorter.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            handed.and_then(|()| Ok(sorted?))
        })
    }

    /// Puts the buckets of a pass in order, one after another; those that are too large are
    /// distributed once more.
    fn walk<E: From<OctreeError>>(
        &self,
        pass: &Pass,
        take: &mut dyn FnMut(Piece) -> Result<(), E>,
    ) -> Result<(), E> {
        for bucket in 0..pass.spill.n_buckets() {
            self.watch.check().map_err(OctreeError::from)?;
            let n_points = pass.spill.bucket_bytes(bucket) / self.shares.row_bytes;
            if n_points == 0 {
                continue;
            }
            let keys = pass.keys_of(bucket);
            let n_keys = keys.end - keys.start;
            if n_points > n_keys {
                // More points than records: of a forged octree it could be all of them.
                return Err(E::from(self.twice()));
            }
            if n_points <= self.shares.bucket_points {
                take(self.sorted(pass, bucket).map_err(E::from)?)?;
                continue;
            }
            // This thread alone fills the parts.
            let plan = Plan::new(n_points, n_keys, 1, &self.shares);
            let parts = Pass::new(self.folder, keys, 0, plan);
            let mut buffers = parts.buffers();
            pass.spill.drain(bucket, |rows| {
                self.watch.check()?;
                let mut rows = rows.chunks_exact(self.shares.row_bytes as usize);
                rows.try_for_each(|row| buffers.put(self.columns.key(row), &[row]))
            })?;
            buffers.finish()?;
            self.walk(&parts, take)?;
        }
        Ok(())
    }

    fn sorted(&self, pass: &Pass, bucket: usize) -> Result<Piece, OctreeError> {
        let mut rows = Vec::new();
        pass.spill.take(bucket, &mut rows)?;
        let keys = rows.chunks_exact(self.shares.row_bytes as usize).map(|r| self.columns.key(r));
        let mut order: Vec<(u64, u32)> = keys.zip(0..).collect();
        order.sort_unstable();
        if order.windows(2).any(|w| w[0].0 == w[1].0) {
            return Err(self.twice());
        }
        Ok(Piece { rows, order })
    }

    fn twice(&self) -> OctreeError {
        self.columns.broken(self.octree, 0, "two points of one record").into()
    }

    fn hand_over<E: From<OctreeError>>(
        &self,
        piece: &Piece,
        visit: &mut impl FnMut(&PointBatch, &Tags) -> Result<(), E>,
    ) -> Result<(), E> {
        let row_bytes = self.shares.row_bytes as usize;
        let row = |&(_, i): &(u64, u32)| &piece.rows[i as usize * row_bytes..][..row_bytes];
        let source = |entry: &(u64, u32)| self.columns.source(row(entry));
        for same in piece.order.chunk_by(|a, b| source(a) == source(b)) {
            for some in same.chunks(BATCH_POINTS) {
                self.watch.check().map_err(OctreeError::from)?;
                let rows: Vec<&[u8]> = some.iter().map(row).collect();
                let batch = self.columns.batch(&rows);
                visit(&batch, &Tags::of(&rows, self.shares.record_bytes, self.with))?;
                self.watch.advance(some.len() as u64);
            }
        }
        Ok(())
    }
}

/// Points of a bucket in order.
struct Piece {
    rows: Vec<u8>,
    /// The key of each and where its row is.
    order: Vec<(u64, u32)>,
}

fn bytes_of(normal: Normal) -> [u8; size_of::<Normal>()] {
    let mut bytes = [0; size_of::<Normal>()];
    FieldWriter::new(&mut bytes).three(normal, FieldWriter::i16);
    bytes
}

/// How many buckets a pass has, and how large the buffers are through which threads fill them.
#[derive(Debug, Clone, Copy)]
struct Plan {
    n_buckets: u64,
    /// Bytes of a buffer that is full.
    buffer_bytes: u64,
    /// What the list of extents takes beyond its share.
    beyond_bytes: u64,
}

impl Plan {
    fn new(n_points: u64, n_keys: u64, n_threads: usize, shares: &Shares) -> Plan {
        let (n_threads, total) = (n_threads as u64, n_points.saturating_mul(shares.row_bytes));
        // A buffer becomes an extent: many small ones are slow, and their list is long.
        let extents = shares.extent_bytes / EXTENT_BYTES + 1;
        let least = total.div_ceil(extents).clamp(LEAST_BUFFER_BYTES, MOST_BUFFER_BYTES);
        let most = (shares.buffer_bytes / (least * n_threads)).clamp(2, MAX_BUCKETS);
        // Half of what fits: where records are missing, others stand closer.
        let wanted = n_points.div_ceil((shares.bucket_points / 2).max(1));
        let n_buckets = wanted.clamp(1, most).min(n_keys.max(1));
        let buffer_bytes = shares.buffer_bytes / (n_buckets * n_threads);
        // Tiny only where the whole budget is.
        let buffer_bytes = buffer_bytes.clamp(1 << 10, least.max(GOOD_BUFFER_BYTES));
        let n_extents = total / buffer_bytes + n_buckets * n_threads;
        let beyond_bytes = (n_extents * EXTENT_BYTES).saturating_sub(shares.extent_bytes);
        Plan { n_buckets, buffer_bytes, beyond_bytes }
    }
}

/// One pass of distributing points into buckets of as many keys each.
struct Pass {
    keys: Range<u64>,
    bucket_keys: u64,
    buffer_bytes: usize,
    spill: Spill,
}

impl Pass {
    fn new(folder: &Path, keys: Range<u64>, hold_bytes: u64, plan: Plan) -> Pass {
        let bucket_keys = (keys.end - keys.start).div_ceil(plan.n_buckets).max(1);
        let n_buckets = (keys.end - keys.start).div_ceil(bucket_keys).max(1);
        let hold_bytes = hold_bytes.saturating_sub(plan.beyond_bytes);
        let spill = Spill::new(folder, n_buckets as usize, hold_bytes);
        Pass { keys, bucket_keys, buffer_bytes: plan.buffer_bytes as usize, spill }
    }

    fn keys_of(&self, bucket: usize) -> Range<u64> {
        let start = self.keys.start + bucket as u64 * self.bucket_keys;
        start..start.saturating_add(self.bucket_keys).min(self.keys.end)
    }

    fn buffers(&self) -> Buffers<'_> {
        let buffers = vec![Vec::new(); self.spill.n_buckets()];
        Buffers { pass: self, most: self.buffer_bytes, buffers }
    }
}

/// The buffers of one thread, one a bucket.
struct Buffers<'a> {
    pass: &'a Pass,
    /// Bytes of a buffer that is full.
    most: usize,
    buffers: Vec<Vec<u8>>,
}

impl Buffers<'_> {
    /// Adds a row, given in pieces.
    fn put(&mut self, key: u64, row: &[&[u8]]) -> Result<(), OctreeError> {
        let bucket = ((key - self.pass.keys.start) / self.pass.bucket_keys) as usize;
        let buffer = &mut self.buffers[bucket];
        let n_bytes: usize = row.iter().map(|piece| piece.len()).sum();
        if buffer.is_empty() {
            buffer.reserve_exact(self.most.max(n_bytes));
        } else if buffer.len() + n_bytes > self.most {
            self.pass.spill.append(bucket, buffer)?;
            buffer.clear();
        }
        row.iter().for_each(|piece| buffer.extend_from_slice(piece));
        Ok(())
    }

    fn finish(self) -> Result<(), OctreeError> {
        let full = self.buffers.iter().enumerate().filter(|(_, b)| !b.is_empty());
        Ok(full.into_iter().try_for_each(|(i, b)| self.pass.spill.append(i, b))?)
    }
}
