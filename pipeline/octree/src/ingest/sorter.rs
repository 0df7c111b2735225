//! The external sort: records into buckets by splitters, buckets into the sorted section.
//!
//! A key is 128 bits: the Morton code above the point's ordinal (source, record). Keys are unique,
//! so the order of the output depends on nothing else, and a bucket of coincident points can be
//! split like any other.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use pvmap_geometry::block::BLOCK_POINTS;
use pvmap_geometry::{Frame, GridBlock, PointBatch, morton};
use pvmap_store::{Spill, StoreError, Watch};
use pvmap_vmap::octree::{NORMAL_BYTES, Placement};

use super::layout::{Bounds, Layout};
use super::order::order;
use super::records::{SLACK_BYTES, copy_record, in_steps};
use super::turns::Turns;
use crate::OctreeError;

/// A Morton code above an ordinal.
type Key = u128;

/// Most buckets of one pass; more would make the buffers of the workers too small.
const MAX_BUCKETS: u64 = 1024;
/// No bucket need be larger: it should sort within the cache of a core, more or less.
const GOOD_BUCKET_BYTES: u64 = 2 << 20;
/// Bytes that sorting holds for a record beside the record: its code, its normal row, its place in
/// the order and a share of the drawers.
const SORT_BYTES: u64 = 8 + NORMAL_BYTES as u64 + 8 + 2;
/// The level of the octree in whose cells buckets are looked up: its table fits the nearest cache.
const COARSE_LEVEL: u8 = 4;
const N_COARSE_CELLS: u64 = 1 << (3 * COARSE_LEVEL);
/// Keys that choose the splitters of a bucket that is split again.
const N_RESAMPLE: usize = 8192;

/// How a memory budget is shared out.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shares {
    /// Records held in memory instead of on disk.
    pub(crate) hold_bytes: u64,
    /// Buffers of all workers.
    pub(crate) buffer_bytes: u64,
    /// The largest bucket that is sorted in one piece.
    pub(crate) bucket_bytes: u64,
    pub(crate) n_threads: u64,
}

impl Shares {
    pub(crate) fn new(memory_bytes: u64, n_threads: u64, record_bytes: u64) -> Shares {
        // A quarter of the memory is for buckets while they are sorted, one on each thread.
        let n_records = memory_bytes / 4 / n_threads / (record_bytes + SORT_BYTES);
        Shares {
            hold_bytes: memory_bytes * 45 / 100,
            buffer_bytes: memory_bytes / 10,
            bucket_bytes: n_records * record_bytes,
            n_threads,
        }
    }

    fn n_buckets(&self, total_bytes: u64) -> u64 {
        // Half of what fits: quantile splitters of a sample are off by some percent.
        let good = (self.bucket_bytes / 2).clamp(1, GOOD_BUCKET_BYTES);
        total_bytes.div_ceil(good).clamp(self.n_threads * 4, MAX_BUCKETS)
    }
}

/// One pass of distributing records into buckets.
#[derive(Debug)]
pub(crate) struct Pass {
    splitters: Vec<Key>,
    /// For every coarse cell, and one more: the splitters in cells before it.
    before: Vec<u32>,
    spill: Spill,
    buffer_bytes: usize,
}

impl Pass {
    /// Makes buckets whose splitters are quantiles of `sample`, which it sorts.
    pub(crate) fn new(
        folder: &std::path::Path,
        sample: &mut [Key],
        total_bytes: u64,
        hold_bytes: u64,
        shares: &Shares,
    ) -> Pass {
        sample.sort_unstable();
        let n = shares.n_buckets(total_bytes) as usize;
        let mut splitters: Vec<Key> =
            (1..n).filter_map(|i| sample.get(i * sample.len() / n).copied()).collect();
        splitters.dedup();
        let n_buffers = (splitters.len() as u64 + 1) * shares.n_threads;
        let buffer_bytes = (shares.buffer_bytes / n_buffers).clamp(1 << 10, 256 << 10) as usize;
        let spill = Spill::new(folder, splitters.len() + 1, hold_bytes);
        let in_cells_before =
            |cell: u64| splitters.partition_point(|&s| coarse_cell(s) < cell) as u32;
        let before = (0..=N_COARSE_CELLS).map(in_cells_before).collect();
        Pass { splitters, before, spill, buffer_bytes }
    }

    /// Makes one bucket without order, for records whose keys cannot be known yet.
    pub(crate) fn unordered(folder: &std::path::Path, shares: &Shares) -> Pass {
        let spill = Spill::new(folder, 1, shares.hold_bytes);
        let buffer_bytes =
            (shares.buffer_bytes / shares.n_threads).clamp(1 << 10, 256 << 10) as usize;
        let before = vec![0; N_COARSE_CELLS as usize + 1];
        Pass { splitters: Vec::new(), before, spill, buffer_bytes }
    }

    pub(crate) fn spilled_bytes(&self) -> u64 {
        self.spill.spilled_bytes()
    }

    fn buffers(&self) -> Buffers<'_> {
        // Zeroes of the system: a buffer that is never used takes no memory.
        let buffer = |_| Buffer { bytes: vec![0; self.buffer_bytes + SLACK_BYTES], n_bytes: 0 };
        let buffers = (0..=self.splitters.len()).map(buffer).collect();
        Buffers { pass: self, buffers }
    }

    /// Gives the bucket of a key: the splitters up to it. Most coarse cells have none of their
    /// own, so a look at the table says it all.
    #[inline(always)]
    fn bucket_of(&self, key: Key) -> usize {
        let cell = coarse_cell(key) as usize;
        let (first, end) = (self.before[cell] as usize, self.before[cell + 1] as usize);
        if first == end {
            return first;
        }
        first + self.splitters[first..end].partition_point(|&s| s <= key)
    }
}

/// The buffers of one worker, one a bucket.
#[derive(Debug)]
struct Buffers<'a> {
    pass: &'a Pass,
    buffers: Vec<Buffer>,
}

/// Records on their way to a bucket.
#[derive(Debug)]
struct Buffer {
    bytes: Vec<u8>,
    n_bytes: usize,
}

impl Buffers<'_> {
    /// Puts records, which have [`SLACK_BYTES`] behind them, into their buckets. `key` gives the
    /// key of record `i`.
    fn put_all(
        &mut self,
        records: &[u8],
        record_bytes: usize,
        key: impl Fn(usize) -> Key,
    ) -> Result<(), StoreError> {
        in_steps!(record_bytes, self.put_steps::<N>(records, record_bytes, key))
    }

    fn put_steps<const N: usize>(
        &mut self,
        records: &[u8],
        record_bytes: usize,
        key: impl Fn(usize) -> Key,
    ) -> Result<(), StoreError> {
        let n_records = (records.len() - SLACK_BYTES) / record_bytes;
        for (i, at) in (0..n_records).zip((0..).step_by(record_bytes)) {
            let bucket = self.pass.bucket_of(key(i));
            let buffer = &mut self.buffers[bucket];
            if buffer.n_bytes + record_bytes > self.pass.buffer_bytes {
                self.pass.spill.append(bucket, &buffer.bytes[..buffer.n_bytes])?;
                buffer.n_bytes = 0;
            }
            let to = &mut buffer.bytes[buffer.n_bytes..];
            copy_record::<N>(&records[at..], to, record_bytes);
            buffer.n_bytes += record_bytes;
        }
        Ok(())
    }

    fn finish(self) -> Result<(), StoreError> {
        let full = self.buffers.iter().enumerate().filter(|(_, b)| b.n_bytes > 0);
        full.into_iter().try_for_each(|(i, b)| self.pass.spill.append(i, &b.bytes[..b.n_bytes]))
    }
}

/// What the workers of an ingest saw.
#[derive(Debug, Clone, Default)]
pub(crate) struct Seen {
    pub(crate) bounds: Option<Bounds>,
    /// A source each, in order.
    pub(crate) sources: Vec<SeenSource>,
    pub(crate) sample: Sample,
}

/// Records drawn evenly from all that passed, for choosing splitters.
#[derive(Debug, Clone)]
pub(crate) struct Sample {
    pub(crate) records: Vec<u8>,
    every: u64,
    n_passed: u64,
}

impl Default for Sample {
    fn default() -> Sample {
        Sample { records: Vec::new(), every: 1, n_passed: 0 }
    }
}

impl Sample {
    fn offer(&mut self, record: &[u8]) {
        if self.n_passed.is_multiple_of(self.every) {
            self.records.extend_from_slice(record);
            if self.records.len() >= 2 * N_RESAMPLE * record.len() {
                let thinned = self.records.chunks_exact(record.len()).step_by(2).flatten();
                self.records = thinned.copied().collect();
                self.every *= 2;
            }
        }
        self.n_passed += 1;
    }
}

/// What was seen of one source.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SeenSource {
    pub(crate) n_points: u64,
    /// The largest colour value.
    pub(crate) color_max: u16,
    /// Points with a usable normal.
    pub(crate) n_normals: u64,
}

impl Seen {
    pub(crate) fn join(&mut self, other: &Seen) {
        self.bounds = match (self.bounds, other.bounds) {
            (Some(a), Some(b)) => Some(a.join(b)),
            (a, b) => a.or(b),
        };
        self.sources.resize(self.sources.len().max(other.sources.len()), SeenSource::default());
        for (a, b) in self.sources.iter_mut().zip(&other.sources) {
            a.n_points += b.n_points;
            a.color_max = a.color_max.max(b.color_max);
            a.n_normals += b.n_normals;
        }
        self.sample.records.extend_from_slice(&other.sample.records);
    }
}

/// Takes batches on one thread.
#[derive(Debug)]
pub struct Worker<'a> {
    layout: &'a Layout,
    frame: Option<Frame>,
    buffers: Buffers<'a>,
    seen: Seen,
    total: &'a Mutex<Seen>,
    packed: Vec<u8>,
    codes: Vec<u64>,
}

impl<'a> Worker<'a> {
    pub(crate) fn new(
        layout: &'a Layout,
        frame: Option<Frame>,
        pass: &'a Pass,
        total: &'a Mutex<Seen>,
    ) -> Worker<'a> {
        let sources = vec![SeenSource::default(); layout.sources.len()];
        let seen = Seen { sources, ..Seen::default() };
        Worker {
            layout,
            frame,
            buffers: pass.buffers(),
            seen,
            total,
            packed: Vec::new(),
            codes: Vec::new(),
        }
    }

    /// Takes a batch of points.
    ///
    /// # Errors
    /// Where the batch is not what its source promised, or the disk fails.
    pub fn push(&mut self, batch: &PointBatch) -> Result<(), OctreeError> {
        if batch.is_empty() {
            return Ok(());
        }
        self.layout.pack(batch, &mut self.packed)?;
        self.look_at(batch);
        match &self.frame {
            Some(frame) => self.layout.codes_of(frame, batch, &mut self.codes),
            None => {
                self.codes.clear();
                self.codes.resize(batch.len(), 0);
            }
        }
        let source = u64::from(batch.source) << 40;
        let record_bytes = self.layout.schema.record_bytes();
        let key = |i: usize| key(self.codes[i], source | batch.records[i]);
        Ok(self.buffers.put_all(&self.packed, record_bytes, key)?)
    }

    fn look_at(&mut self, batch: &PointBatch) {
        let here = self.layout.bounds_of(batch);
        self.seen.bounds = match (self.seen.bounds, here) {
            (Some(a), Some(b)) => Some(a.join(b)),
            (a, b) => a.or(b),
        };
        let source = &mut self.seen.sources[batch.source as usize];
        source.n_points += batch.len() as u64;
        let colors = batch.color.iter().flat_map(|c| c.as_flattened());
        source.color_max = colors.fold(source.color_max, |max, &c| max.max(c));
        for &n in batch.normal.iter().flatten() {
            source.n_normals += u64::from(pvmap_geometry::normal::is_direction(n));
        }
        // A thousandth of the points is plenty; every 61st keeps the stride off a scanner's rows.
        let record_bytes = self.layout.schema.record_bytes();
        let records = &self.packed[..batch.len() * record_bytes];
        for record in records.chunks_exact(record_bytes).step_by(61) {
            self.seen.sample.offer(record);
        }
    }

    /// Hands over what is still in the buffers.
    ///
    /// # Errors
    /// Where the disk fails.
    pub fn finish(self) -> Result<(), OctreeError> {
        self.buffers.finish()?;
        self.total.lock().unwrap_or_else(|e| e.into_inner()).join(&self.seen);
        Ok(())
    }
}

#[inline(always)]
fn key(code: u64, ordinal: u64) -> Key {
    u128::from(code) << 64 | u128::from(ordinal)
}

/// Gives the number of the coarse cell a key lies in: the upper bits of its code.
#[inline(always)]
fn coarse_cell(key: Key) -> u64 {
    (key >> 64) as u64 >> (3 * (morton::MAX_LEVEL - COARSE_LEVEL))
}

/// Sorts buckets and hands their records over in order.
pub(crate) struct Sorting<'a> {
    pub(crate) layout: &'a Layout,
    pub(crate) placement: &'a Placement,
    pub(crate) folder: &'a std::path::Path,
    pub(crate) shares: Shares,
    pub(crate) watch: &'a dyn Watch,
    /// Bytes that further passes wrote to disk.
    pub(crate) spilled: AtomicU64,
}

/// Whom records are sorted for. Several threads call it, with buckets in any order.
pub(crate) trait Receive: Sync {
    /// Meets the records of a bucket before they are sorted: appends the Morton code of each to
    /// `codes` and, where there are to be normal rows, its row to `rows`.
    fn survey(&self, records: &[u8], codes: &mut Vec<u64>, rows: &mut Vec<[u8; NORMAL_BYTES]>);

    /// Gets a sorted bucket, the first point of which is number `first` of all.
    fn write(&self, first: u64, bucket: &mut Bucket) -> Result<(), OctreeError>;
}

/// One bucket being sorted. Threads keep it from bucket to bucket: fresh memory is slow.
#[derive(Debug, Default)]
pub(crate) struct Bucket {
    /// The records as they came, and [`SLACK_BYTES`] behind them.
    pub(crate) records: Vec<u8>,
    /// The Morton code and the normal row of each record.
    pub(crate) codes: Vec<u64>,
    pub(crate) rows: Vec<[u8; NORMAL_BYTES]>,
    /// The indices of the records in the order of their keys.
    pub(crate) order: Vec<u64>,
    /// Room to put a piece of the output in.
    pub(crate) piece: Vec<u8>,
}

impl Sorting<'_> {
    fn key_of(&self, record: &[u8]) -> Key {
        let g = self.placement.grid(record).expect("packed records name their source");
        key(morton::encode(g), self.layout.ordinal(record))
    }

    /// Distributes all records of a pass anew, by keys in the final frame.
    pub(crate) fn again(&self, pass: &Pass, sample: &[u8]) -> Result<Pass, OctreeError> {
        let stride = self.layout.schema.record_bytes();
        let mut sample: Vec<Key> = sample.chunks_exact(stride).map(|r| self.key_of(r)).collect();
        let n = pass.spill.n_buckets();
        let total: u64 = (0..n).map(|b| pass.spill.bucket_bytes(b)).sum();
        // The first pass holds up to its share until it is drained; the second starts on disk.
        let hold_bytes = self.shares.hold_bytes.saturating_sub(total.min(self.shares.hold_bytes));
        let next = Pass::new(self.folder, &mut sample, total, hold_bytes, &self.shares);
        Turns::run(n, |turns| {
            while let Some(bucket) = turns.take() {
                let n_records = pass.spill.bucket_bytes(bucket) / stride as u64;
                self.redistribute(pass, bucket, &next)?;
                self.watch.advance(n_records);
            }
            Ok::<_, OctreeError>(())
        })?;
        Ok(next)
    }

    fn redistribute(&self, from: &Pass, bucket: usize, to: &Pass) -> Result<(), OctreeError> {
        let mut buffers = to.buffers();
        let stride = self.layout.schema.record_bytes();
        let mut block = GridBlock::default();
        let (mut records, mut codes) = (Vec::new(), Vec::new());
        from.spill.drain(bucket, |bytes| {
            self.watch.check()?;
            codes.clear();
            for some in bytes.chunks(BLOCK_POINTS * stride) {
                let placed = self.placement.place(some, stride, &mut block);
                placed.expect("packed records name their source");
                codes.extend_from_slice(&block.codes()[..some.len() / stride]);
            }
            records.clear();
            records.extend_from_slice(bytes);
            records.resize(bytes.len() + SLACK_BYTES, 0);
            let key = |i: usize| key(codes[i], self.layout.ordinal(&bytes[i * stride..]));
            Ok::<_, OctreeError>(buffers.put_all(&records, stride, key)?)
        })?;
        Ok(buffers.finish()?)
    }

    /// Sorts every bucket of a pass.
    pub(crate) fn sort(
        &self,
        pass: &Pass,
        first: u64,
        to: &dyn Receive,
    ) -> Result<(), OctreeError> {
        let stride = self.layout.schema.record_bytes() as u64;
        let mut starts = vec![first];
        for bucket in 0..pass.spill.n_buckets() {
            starts.push(starts[bucket] + pass.spill.bucket_bytes(bucket) / stride);
        }
        // Buckets that do not fit are taken first and one after another: each uses the whole
        // budget while it is split.
        let large = |b: &usize| pass.spill.bucket_bytes(*b) > self.shares.bucket_bytes;
        let (over, fit): (Vec<usize>, Vec<usize>) = (0..pass.spill.n_buckets()).partition(large);
        for bucket in over {
            let mut sample = self.resample(pass, bucket)?;
            let n_bytes = pass.spill.bucket_bytes(bucket);
            let parts = Pass::new(self.folder, &mut sample, n_bytes, 0, &self.shares);
            self.redistribute(pass, bucket, &parts)?;
            self.sort(&parts, starts[bucket], to)?;
            self.spilled.fetch_add(parts.spilled_bytes(), Ordering::Relaxed);
        }
        Turns::run(fit.len(), |turns| {
            let mut scratch = Bucket::default();
            while let Some(turn) = turns.take() {
                self.watch.check()?;
                self.sort_bucket(pass, fit[turn], starts[fit[turn]], &mut scratch, to)?;
            }
            Ok(())
        })
    }

    /// Samples the keys of a bucket that is too large, putting its records back.
    fn resample(&self, pass: &Pass, bucket: usize) -> Result<Vec<Key>, OctreeError> {
        let stride = self.layout.schema.record_bytes();
        let n_records = pass.spill.bucket_bytes(bucket) as usize / stride;
        let step = (n_records / N_RESAMPLE).max(1);
        let mut keys = Vec::new();
        let mut i = 0;
        pass.spill.peek(bucket, |bytes| {
            for record in bytes.chunks_exact(stride) {
                if i % step == 0 {
                    keys.push(self.key_of(record));
                }
                i += 1;
            }
            Ok::<_, OctreeError>(())
        })?;
        Ok(keys)
    }

    fn sort_bucket(
        &self,
        pass: &Pass,
        number: usize,
        first: u64,
        bucket: &mut Bucket,
        to: &dyn Receive,
    ) -> Result<(), OctreeError> {
        let stride = self.layout.schema.record_bytes();
        let n_bytes = pass.spill.bucket_bytes(number) as usize;
        bucket.records.reserve_exact((n_bytes + SLACK_BYTES).saturating_sub(bucket.records.len()));
        pass.spill.take(number, &mut bucket.records)?;
        bucket.codes.clear();
        bucket.rows.clear();
        to.survey(&bucket.records, &mut bucket.codes, &mut bucket.rows);
        bucket.records.resize(n_bytes + SLACK_BYTES, 0);
        let ordinal = |i: usize| self.layout.ordinal(&bucket.records[i * stride..]);
        order(&bucket.codes, ordinal, &mut bucket.order);
        to.write(first, bucket)?;
        self.watch.advance((n_bytes / stride) as u64);
        Ok(())
    }
}

/// Gives the sampled keys of a batch in a frame.
pub(crate) fn sample_keys(layout: &Layout, frame: &Frame, batch: &PointBatch, keys: &mut Vec<Key>) {
    let mut codes = Vec::new();
    layout.codes_of(frame, batch, &mut codes);
    let source = u64::from(batch.source) << 40;
    keys.extend(codes.iter().zip(&batch.records).map(|(&c, &r)| key(c, source | r)));
}
