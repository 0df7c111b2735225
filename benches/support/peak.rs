//! The most memory a job holds.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use pvmap::memory;

/// How often memory is looked at: the shortest builds last some ten milliseconds.
const TICK: Duration = Duration::from_millis(1);

/// Runs a job while another thread looks at the anonymous memory of this process; gives the most
/// seen.
pub(crate) fn peak_bytes_of<T>(job: impl FnOnce() -> T) -> (T, u64) {
    let (is_done, peak_bytes) = (AtomicBool::new(false), AtomicU64::new(0));
    let look = || peak_bytes.fetch_max(memory::rss_anon_bytes().unwrap_or(0), Ordering::Relaxed);
    let done = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_done.load(Ordering::Relaxed) {
                look();
                std::thread::sleep(TICK);
            }
        });
        let done = job();
        look();
        is_done.store(true, Ordering::Relaxed);
        done
    });
    (done, peak_bytes.into_inner())
}
