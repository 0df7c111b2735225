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
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::path::Path;
use std::sync::mpsc::sync_channel;
use std::sync::{Mutex, PoisonError};

use pvmap_geometry::PointBatch;
use pvmap_store::{Spill, StoreError, Watch};
use pvmap_vmap::OctreeView;
use pvmap_vmap::octree::{CODE_STRIDE, Point};

use crate::OctreeError;
use crate::ingest::Turns;
use columns::Columns;

/// Points that a thread takes at a time.
const BLOCK_POINTS: u64 = 4 * CODE_STRIDE;
/// Most points of a batch that is handed over.
const BATCH_POINTS: usize = 16_384;
/// Most buckets of one pass; more would make the buffers of the threads too small.
const MAX_BUCKETS: u64 = 1024;
/// No bucket need be larger.
const GOOD_BUCKET_BYTES: u64 = 8 << 20;
/// The number behind each record.
const TAG_BYTES: usize = 4;
/// Bytes that putting in order holds for a point beside its row: its key and its place.
const SORT_BYTES: u64 = size_of::<(u64, u32)>() as u64;

/// What was seen of all points on the way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// The largest class, 0 without.
    pub class_max: u8,
    /// The least and the greatest GPS time; `None` without any number.
    pub gps_time: Option<(f64, f64)>,
}

impl Seen {
    const NOTHING: Seen = Seen { class_max: 0, gps_time: None };

    fn join(self, other: Seen) -> Seen {
        let gps_time = match (self.gps_time, other.gps_time) {
            (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
            (a, b) => a.or(b),
        };
        Seen { class_max: self.class_max.max(other.class_max), gps_time }
    }
}

/// How a memory budget is shared out: 45 % to points held, 10 % to buffers, 30 % to the two
/// buckets at hand; the rest is for whoever takes the points.
#[derive(Debug, Clone, Copy)]
struct Shares {
    hold_bytes: u64,
    buffer_bytes: u64,
    /// Points of a bucket that is put in order in one piece.
    bucket_points: u64,
    row_bytes: u64,
}

impl Shares {
    fn new(memory_bytes: u64, record_bytes: usize) -> Shares {
        let row_bytes = (record_bytes + TAG_BYTES) as u64;
        let bucket_bytes = (memory_bytes * 15 / 100).min(2 * GOOD_BUCKET_BYTES);
        Shares {
            hold_bytes: memory_bytes * 45 / 100,
            buffer_bytes: memory_bytes / 10,
            bucket_points: (bucket_bytes / (row_bytes + SORT_BYTES)).clamp(1, 1 << 31),
            row_bytes,
        }
    }
}

/// Gives the bytes that [`BySource::gather`] writes to its temporary file, about.
pub fn temporary_bytes(octree: &OctreeView<'_>, memory_bytes: u64) -> u64 {
    let shares = Shares::new(memory_bytes, octree.schema().record_bytes());
    let all = octree.summary().n_points.saturating_mul(shares.row_bytes);
    all.saturating_sub(shares.hold_bytes)
}

/// All points of an octree with their numbers, on the way to the order of their sources.
pub struct BySource<'a> {
    octree: &'a OctreeView<'a>,
    columns: Columns,
    shares: Shares,
    folder: &'a Path,
    pass: Pass,
    seen: Seen,
    watch: &'a dyn Watch,
}

impl<'a> BySource<'a> {
    /// Takes all points and the number that `tag` gives each. Every thread of the current rayon
    /// pool makes a tagger; it gets points in Morton order, whole blocks of them. What is not held
    /// in `memory_bytes` goes to a temporary file in `folder`.
    ///
    /// # Errors
    /// Where the octree is damaged, the disk fails or the run is asked to stop, and those of the
    /// taggers.
    pub fn gather<E, T>(
        octree: &'a OctreeView<'a>,
        folder: &'a Path,
        memory_bytes: u64,
        tag: impl Fn() -> T + Sync,
        watch: &'a dyn Watch,
    ) -> Result<BySource<'a>, E>
    where
        E: From<OctreeError> + Send,
        T: FnMut(&Point<'_>) -> Result<u32, E>,
    {
        let n_points = octree.summary().n_points;
        let columns = Columns::of(octree).map_err(OctreeError::from)?;
        let shares = Shares::new(memory_bytes, octree.schema().record_bytes());
        let pass = Pass::new(folder, 0..columns.n_keys(), n_points, shares.hold_bytes, &shares);
        let seen = Mutex::new(Seen::NOTHING);
        watch.stage("distribute", Some(n_points), "points");
        Turns::run(n_points.div_ceil(BLOCK_POINTS) as usize, |turns| {
            let (mut tag, mut here) = (tag(), Seen::NOTHING);
            let mut buffers = pass.buffers(&shares);
            while let Some(turn) = turns.take() {
                watch.check().map_err(OctreeError::from)?;
                let first = turn as u64 * BLOCK_POINTS;
                let n = BLOCK_POINTS.min(n_points - first);
                let points = octree.points(first, n).map_err(OctreeError::from)?;
                for (point, index) in points.iter().zip(first..) {
                    let point = point.map_err(OctreeError::from)?;
                    let key = columns.checked_key(octree, index, point.record);
                    let key = key.map_err(OctreeError::from)?;
                    here = here.join(columns.seen(point.record));
                    let tag = tag(&point)?;
                    buffers.put(key, &[point.record, &tag.to_le_bytes()])?;
                }
                watch.advance(n);
            }
            let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
            *seen = seen.join(here);
            Ok::<_, E>(buffers.finish()?)
        })?;
        let seen = seen.into_inner().unwrap_or_else(PoisonError::into_inner);
        Ok(BySource { octree, columns, shares, folder, pass, seen, watch })
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
    /// sources gave them, and the number of each point.
    ///
    /// # Errors
    /// Where two points are of one record, the disk fails or the run is asked to stop, and those
    /// of `visit`.
    pub fn each<E: From<OctreeError>>(
        self,
        mut visit: impl FnMut(&PointBatch, &[u32]) -> Result<(), E>,
    ) -> Result<(), E> {
        self.watch.stage("write", Some(self.octree.summary().n_points), "points");
        if rayon::current_num_threads() == 1 {
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
            if n_points <= self.shares.bucket_points || keys.end - keys.start == 1 {
                take(self.sorted(pass, bucket).map_err(E::from)?)?;
                continue;
            }
            let parts = Pass::new(self.folder, keys, n_points, 0, &self.shares);
            let mut buffers = parts.buffers(&self.shares);
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
            return Err(self.columns.broken(self.octree, 0, "two points of one record").into());
        }
        Ok(Piece { rows, order })
    }

    fn hand_over<E: From<OctreeError>>(
        &self,
        piece: &Piece,
        visit: &mut impl FnMut(&PointBatch, &[u32]) -> Result<(), E>,
    ) -> Result<(), E> {
        let row_bytes = self.shares.row_bytes as usize;
        let row = |&(_, i): &(u64, u32)| &piece.rows[i as usize * row_bytes..][..row_bytes];
        let source = |entry: &(u64, u32)| self.columns.source(row(entry));
        for same in piece.order.chunk_by(|a, b| source(a) == source(b)) {
            for some in same.chunks(BATCH_POINTS) {
                self.watch.check().map_err(OctreeError::from)?;
                let rows: Vec<&[u8]> = some.iter().map(row).collect();
                let batch = self.columns.batch(&rows);
                visit(&batch, &rows.iter().map(|row| tag_of(row)).collect::<Vec<u32>>())?;
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

fn tag_of(row: &[u8]) -> u32 {
    let (_, tag) = row.split_last_chunk().expect("a row ends in its number");
    u32::from_le_bytes(*tag)
}

/// One pass of distributing points into buckets of as many keys each.
struct Pass {
    keys: Range<u64>,
    bucket_keys: u64,
    spill: Spill,
}

impl Pass {
    fn new(
        folder: &Path,
        keys: Range<u64>,
        n_points: u64,
        hold_bytes: u64,
        shares: &Shares,
    ) -> Pass {
        // Half of what fits: where records are missing, others stand closer.
        let n = n_points.div_ceil((shares.bucket_points / 2).max(1)).clamp(1, MAX_BUCKETS);
        let bucket_keys = (keys.end - keys.start).div_ceil(n).max(1);
        let n_buckets = (keys.end - keys.start).div_ceil(bucket_keys).max(1);
        let spill = Spill::new(folder, n_buckets as usize, hold_bytes);
        Pass { keys, bucket_keys, spill }
    }

    fn keys_of(&self, bucket: usize) -> Range<u64> {
        let start = self.keys.start + bucket as u64 * self.bucket_keys;
        start..start.saturating_add(self.bucket_keys).min(self.keys.end)
    }

    fn buffers(&self, shares: &Shares) -> Buffers<'_> {
        let n = self.spill.n_buckets();
        let n_buffers = (n * rayon::current_num_threads().max(1)) as u64;
        let most = (shares.buffer_bytes / n_buffers).clamp(1 << 10, 256 << 10) as usize;
        Buffers { pass: self, most, buffers: vec![Vec::new(); n] }
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
