//! The most memory a job holds.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use pvmap::memory;

/// How often memory is looked at: the shortest builds last some ten milliseconds.
const TICK: Duration = Duration::from_millis(1);

/// Runs a job while another thread looks at the anonymous memory of this process; gives the most
/// seen.
pub(crate) fn peak_bytes_of<T>(job: impl FnOnce() -> T) -> (T, u64) {
    let peak_bytes = AtomicU64::new(0);
    let look = &|| peak_bytes.fetch_max(memory::rss_anon_bytes().unwrap_or(0), Ordering::Relaxed);
    // Also a job that panics drops `running`, and the other thread ends.
    let (running, ended) = channel::<()>();
    let done = std::thread::scope(|scope| {
        let _running = running;
        scope.spawn(move || {
            while ended.recv_timeout(TICK) == Err(RecvTimeoutError::Timeout) {
                look();
            }
        });
        let done = job();
        look();
        done
    });
    (done, peak_bytes.into_inner())
}
