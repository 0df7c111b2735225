//! Numbered pieces of work, taken in turn by the threads of the current pool.

use std::sync::atomic::{AtomicUsize, Ordering};

/// Hands out the numbers below `n` to all threads, lowest first.
///
/// Unlike a parallel iterator it lets each thread keep its buffers from piece to piece, and the
/// pieces are done about in order, which is how the disk likes them.
#[derive(Debug)]
pub struct Turns {
    next: AtomicUsize,
    n: usize,
}

impl Turns {
    /// Runs `work` once on every thread of the current pool; it calls [`Turns::take`] until there
    /// is nothing left.
    ///
    /// # Errors
    /// One of those of `work`; after the first nothing more is handed out.
    pub fn run<E: Send>(n: usize, work: impl Fn(&Turns) -> Result<(), E> + Sync) -> Result<(), E> {
        let turns = Turns { next: AtomicUsize::new(0), n };
        let each = rayon::broadcast(|_| {
            work(&turns).inspect_err(|_| turns.next.store(turns.n, Ordering::Relaxed))
        });
        each.into_iter().collect()
    }

    /// Gives the next piece.
    pub fn take(&self) -> Option<usize> {
        let turn = self.next.fetch_add(1, Ordering::Relaxed);
        (turn < self.n).then_some(turn)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn every_piece_is_taken_once_and_an_error_ends_the_rest() {
        let taken = Mutex::new(Vec::new());
        let done = Turns::run(100, |turns| {
            while let Some(i) = turns.take() {
                taken.lock().unwrap().push(i);
            }
            Ok::<_, ()>(())
        });
        assert_eq!(done, Ok(()));
        let mut taken = taken.into_inner().unwrap();
        taken.sort_unstable();
        assert!(taken.into_iter().eq(0..100));
        let failed = Turns::run(usize::MAX / 2, |turns| {
            while let Some(i) = turns.take() {
                if i == 1000 {
                    return Err(i);
                }
            }
            Ok(())
        });
        assert_eq!(failed, Err(1000));
    }
}
