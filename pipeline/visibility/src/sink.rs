//! Where the links of tasks go until they are written: into buffers, one for each thread;
//! from there as sorted runs into memory; and from there, with the tasks they belong to, to disk.
//! The last happens when memory is full, when it was long ago, and when the run has to end.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use pvmap_store::StoreError;
use pvmap_store::runs::{Pair, Runs};

use crate::journal::Journal;
use crate::pairs::Status;

/// Tasks that wait for a commit, at most: so many take 2 MiB.
const MAX_WAITING: usize = 1 << 18;

/// The links of whole tasks, in no order, and which tasks those are.
#[derive(Debug, Default)]
pub(crate) struct Found {
    pub(crate) links: Vec<Pair>,
    pub(crate) tasks: Vec<(u32, Status)>,
    /// The commit up to which it was emptied.
    epoch: u64,
}

/// What was taken by now.
#[derive(Debug)]
pub(crate) struct Taken {
    /// Sorted runs of links.
    pub(crate) runs: Runs,
    /// The status of each task that is done.
    pub(crate) statuses: Vec<Option<Status>>,
    pub(crate) journal: Journal,
    /// Tasks whose links are in `runs` but not committed.
    waiting: Vec<(u32, Status)>,
    /// Why a commit did not come about. What then is on disk and what in memory is not known, so
    /// nothing is taken and nothing committed any more.
    failure: Option<StoreError>,
}

impl Taken {
    /// Makes durable all that came here so far, and `more`.
    fn commit(&mut self, more: &[Pair]) -> Result<(), StoreError> {
        self.journal.commit(&mut self.runs, more, &mut self.waiting)
    }

    /// Does something that writes, unless that failed before. Who fails is told to stop; the reason
    /// is kept for [`Sink::failure`].
    fn write(
        &mut self,
        step: impl FnOnce(&mut Taken) -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        if self.failure.is_none() {
            self.failure = step(self).err();
        }
        if self.failure.is_some() { Err(StoreError::Interrupted) } else { Ok(()) }
    }
}

/// Collects what deciders find.
#[derive(Debug)]
pub(crate) struct Sink {
    taken: Mutex<Taken>,
    /// Links a buffer keeps before it is sorted and put away.
    full_links: usize,
    checkpoint: Duration,
    started: Instant,
    /// When the next commit is due: nanoseconds from the start.
    due: AtomicU64,
    /// Commits so far: a buffer that was not emptied since the last is emptied for the next.
    epoch: AtomicU64,
}

impl Sink {
    pub(crate) fn new(
        runs: Runs,
        statuses: Vec<Option<Status>>,
        journal: Journal,
        full_links: usize,
        checkpoint: Duration,
    ) -> Sink {
        let sink = Sink {
            taken: Mutex::new(Taken {
                runs,
                statuses,
                journal,
                waiting: Vec::new(),
                failure: None,
            }),
            full_links,
            checkpoint,
            started: Instant::now(),
            due: AtomicU64::new(0),
            epoch: AtomicU64::new(0),
        };
        sink.set_due();
        sink
    }

    /// Makes a buffer that a task can fill by half after others have filled the other half.
    pub(crate) fn new_buffer(&self) -> Found {
        Found { links: Vec::with_capacity(2 * self.full_links), ..Found::default() }
    }

    /// Takes what a decider found so far where that is much, or a commit is due. A task is done.
    pub(crate) fn take_when_due(&self, found: &mut Found) -> Result<(), StoreError> {
        if self.is_due() {
            found.links.sort_unstable();
            let mut taken = self.lock();
            // Another thread may have been quicker.
            let is_due = self.is_due();
            self.put(&mut taken, found)?;
            return if is_due { self.commit(&mut taken) } else { Ok(()) };
        }
        let is_full = found.links.len() >= self.full_links || found.tasks.len() >= MAX_WAITING;
        if is_full || found.epoch != self.epoch.load(Ordering::Relaxed) {
            self.take(found)
        } else {
            Ok(())
        }
    }

    /// Takes what a decider found.
    pub(crate) fn take(&self, found: &mut Found) -> Result<(), StoreError> {
        found.links.sort_unstable();
        self.put(&mut self.lock(), found)
    }

    /// Makes durable what was taken.
    pub(crate) fn commit_all(&self) -> Result<(), StoreError> {
        self.commit(&mut self.lock())
    }

    /// Gives the reason for which nothing is taken any more.
    pub(crate) fn failure(&self) -> Option<StoreError> {
        self.lock().failure.take()
    }

    /// Gives what was taken by now.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn into_taken(self) -> Taken {
        self.taken.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts sorted links away.
    fn put(&self, taken: &mut Taken, found: &mut Found) -> Result<(), StoreError> {
        let mut is_committed = false;
        taken.write(|taken| {
            taken.waiting.extend_from_slice(&found.tasks);
            if taken.runs.has_room_for(&found.links) {
                taken.runs.push(&found.links)
            } else {
                is_committed = true;
                taken.commit(&found.links)
            }
        })?;
        if is_committed {
            self.set_due();
        }
        for (task, status) in found.tasks.drain(..) {
            taken.statuses[task as usize] = Some(status);
        }
        found.links.clear();
        found.epoch = self.epoch.load(Ordering::Relaxed);
        if taken.waiting.len() >= MAX_WAITING { self.commit(taken) } else { Ok(()) }
    }

    fn commit(&self, taken: &mut Taken) -> Result<(), StoreError> {
        taken.write(|taken| taken.commit(&[]))?;
        self.epoch.fetch_add(1, Ordering::Relaxed);
        self.set_due();
        Ok(())
    }

    fn is_due(&self) -> bool {
        self.started.elapsed().as_nanos() >= u128::from(self.due.load(Ordering::Relaxed))
    }

    fn set_due(&self) {
        let due = self.started.elapsed().saturating_add(self.checkpoint).as_nanos();
        self.due.store(u64::try_from(due).unwrap_or(u64::MAX), Ordering::Relaxed);
    }
}
