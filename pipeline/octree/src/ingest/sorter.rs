//! The external sort: records into buckets by splitters, buckets into the sorted section.
//!
//! A key is 128 bits: the Morton code above the point's ordinal (source, record). Keys are unique,
//! so the order of the output depends on nothing else, and a bucket of coincident points can be
//! split like any other.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use pvmap_geometry::{Frame, PointBatch, morton};
use pvmap_store::{Spill, StoreError, Watch};
use pvmap_vmap::octree::Placement;
use rayon::prelude::*;

use super::layout::{Bounds, Layout};
use crate::OctreeError;

/// A Morton code above an ordinal.
type Key = u128;

/// Most buckets of one pass; more would make the buffers of the workers too small.
const MAX_BUCKETS: u64 = 1024;
/// No bucket need be larger: it should sort within the cache of a core, more or less.
const GOOD_BUCKET_BYTES: u64 = 8 << 20;
/// Sorting a bucket holds its records, a 16-byte entry each, and the records in order.
const SORT_FACTOR: f64 = 3.0;
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
    pub(crate) fn new(memory_bytes: u64, n_threads: u64) -> Shares {
        Shares {
            hold_bytes: memory_bytes * 45 / 100,
            buffer_bytes: memory_bytes / 10,
            bucket_bytes: (memory_bytes as f64 * 0.25 / SORT_FACTOR / n_threads as f64) as u64,
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
        Pass { splitters, spill, buffer_bytes }
    }

    /// Makes one bucket without order, for records whose keys cannot be known yet.
    pub(crate) fn unordered(folder: &std::path::Path, shares: &Shares) -> Pass {
        let spill = Spill::new(folder, 1, shares.hold_bytes);
        let buffer_bytes =
            (shares.buffer_bytes / shares.n_threads).clamp(1 << 10, 256 << 10) as usize;
        Pass { splitters: Vec::new(), spill, buffer_bytes }
    }

    pub(crate) fn spilled_bytes(&self) -> u64 {
        self.spill.spilled_bytes()
    }

    fn buffers(&self) -> Buffers<'_> {
        Buffers { pass: self, buffers: vec![Vec::new(); self.splitters.len() + 1], last: 0 }
    }
}

/// The buffers of one worker, one a bucket.
#[derive(Debug)]
struct Buffers<'a> {
    pass: &'a Pass,
    buffers: Vec<Vec<u8>>,
    /// The bucket of the record before: scans are coherent, so it is tried first.
    last: usize,
}

impl Buffers<'_> {
    #[inline]
    fn put(&mut self, key: Key, record: &[u8]) -> Result<(), StoreError> {
        let splitters = &self.pass.splitters;
        let above = self.last == 0 || splitters[self.last - 1] <= key;
        let below = self.last == splitters.len() || key < splitters[self.last];
        if !(above && below) {
            self.last = splitters.partition_point(|&s| s <= key);
        }
        let buffer = &mut self.buffers[self.last];
        if buffer.len() + record.len() > self.pass.buffer_bytes {
            self.pass.spill.append(self.last, buffer)?;
            buffer.clear();
        }
        buffer.extend_from_slice(record);
        Ok(())
    }

    fn finish(self) -> Result<(), StoreError> {
        let full = self.buffers.iter().enumerate().filter(|(_, b)| !b.is_empty());
        full.into_iter().try_for_each(|(i, b)| self.pass.spill.append(i, b))
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
        let records = self.packed.chunks_exact(self.layout.schema.record_bytes());
        let Some(frame) = &self.frame else {
            return Ok(records.into_iter().try_for_each(|r| self.buffers.put(0, r))?);
        };
        self.layout.codes_of(frame, batch, &mut self.codes);
        let source = u64::from(batch.source) << 40;
        for ((record, &code), &number) in records.zip(&self.codes).zip(&batch.records) {
            self.buffers.put(key(code, source | number), record)?;
        }
        Ok(())
    }

    fn look_at(&mut self, batch: &PointBatch) {
        let here = self.layout.bounds_of(batch);
        self.seen.bounds = match (self.seen.bounds, here) {
            (Some(a), Some(b)) => Some(a.join(b)),
            (a, b) => a.or(b),
        };
        let source = &mut self.seen.sources[batch.source as usize];
        source.n_points += batch.len() as u64;
        for &[r, g, b] in batch.color.iter().flatten() {
            source.color_max = source.color_max.max(r.max(g).max(b));
        }
        for &n in batch.normal.iter().flatten() {
            source.n_normals += u64::from(pvmap_geometry::normal::is_direction(n));
        }
        // A thousandth of the points is plenty; every 61st keeps the stride off a scanner's rows.
        for record in self.packed.chunks_exact(self.layout.schema.record_bytes()).step_by(61) {
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

/// Gets the sorted records: the index of the first, their codes, their bytes.
pub(crate) type Emit<'a> = &'a (dyn Fn(u64, &[u64], &[u8]) -> Result<(), OctreeError> + Sync);

impl Sorting<'_> {
    fn key_of(&self, record: &[u8]) -> Key {
        key(self.code_of(record), self.layout.ordinal(record))
    }

    fn code_of(&self, record: &[u8]) -> u64 {
        let g = self.placement.grid(record);
        morton::encode(g.expect("packed records name their source"))
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
        (0..n).into_par_iter().try_for_each(|bucket| {
            let n_records = pass.spill.bucket_bytes(bucket) / stride as u64;
            self.redistribute(pass, bucket, &next)?;
            self.watch.advance(n_records);
            Ok::<_, OctreeError>(())
        })?;
        Ok(next)
    }

    fn redistribute(&self, from: &Pass, bucket: usize, to: &Pass) -> Result<(), OctreeError> {
        let mut buffers = to.buffers();
        let stride = self.layout.schema.record_bytes();
        from.spill.drain(bucket, |bytes| {
            self.watch.check()?;
            for record in bytes.chunks_exact(stride) {
                buffers.put(self.key_of(record), record)?;
            }
            Ok::<_, OctreeError>(())
        })?;
        Ok(buffers.finish()?)
    }

    /// Sorts every bucket of a pass; `emit` may be called from several threads, in any order.
    pub(crate) fn sort(&self, pass: &Pass, first: u64, emit: Emit<'_>) -> Result<(), OctreeError> {
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
            self.sort(&parts, starts[bucket], emit)?;
            self.spilled.fetch_add(parts.spilled_bytes(), Ordering::Relaxed);
        }
        fit.into_par_iter().try_for_each_init(Scratch::default, |scratch, bucket| {
            self.watch.check()?;
            self.sort_bucket(pass, bucket, starts[bucket], scratch, emit)
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
        bucket: usize,
        first: u64,
        scratch: &mut Scratch,
        emit: Emit<'_>,
    ) -> Result<(), OctreeError> {
        let stride = self.layout.schema.record_bytes();
        let Scratch { records, entries, sorted, codes } = scratch;
        records.clear();
        records.reserve_exact(pass.spill.bucket_bytes(bucket) as usize);
        pass.spill.take(bucket, records)?;
        entries.clear();
        entries.extend(
            records.chunks_exact(stride).zip(0u32..).map(|(record, i)| (self.code_of(record), i)),
        );
        entries.sort_unstable_by_key(|e| e.0);
        let ordinal = |i: u32| self.layout.ordinal(&records[i as usize * stride..][..stride]);
        for equal in entries.chunk_by_mut(|a, b| a.0 == b.0).filter(|run| run.len() > 1) {
            equal.sort_unstable_by_key(|e| ordinal(e.1));
        }
        sorted.clear();
        sorted.reserve_exact(records.len());
        for &(_, i) in entries.iter() {
            sorted.extend_from_slice(&records[i as usize * stride..][..stride]);
        }
        codes.clear();
        codes.extend(entries.iter().map(|e| e.0));
        emit(first, codes, sorted)?;
        self.watch.advance(entries.len() as u64);
        Ok(())
    }
}

/// What sorting a bucket needs, kept from bucket to bucket.
#[derive(Debug, Default)]
struct Scratch {
    records: Vec<u8>,
    entries: Vec<(u64, u32)>,
    sorted: Vec<u8>,
    codes: Vec<u64>,
}

/// Gives the sampled keys of a batch in a frame.
pub(crate) fn sample_keys(layout: &Layout, frame: &Frame, batch: &PointBatch, keys: &mut Vec<Key>) {
    let mut codes = Vec::new();
    layout.codes_of(frame, batch, &mut codes);
    let source = u64::from(batch.source) << 40;
    keys.extend(codes.iter().zip(&batch.records).map(|(&c, &r)| key(c, source | r)));
}
