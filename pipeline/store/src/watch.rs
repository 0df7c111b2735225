//! The line between a running stage and whoever waits for it: progress out, "stop" in.

use crate::StoreError;

/// Hears how far a stage is and may ask it to stop. Stages call it from any thread and go on when
/// it returns: it must be quick, and wait for no other thread.
pub trait Watch: Sync {
    /// A stage begins: its name, how many units it has in all (if known) and what a unit is.
    fn stage(&self, name: &'static str, total: Option<u64>, unit: &'static str);

    /// `n` more units are done.
    fn advance(&self, n: u64);

    /// Something the person should know; the run goes on.
    fn warn(&self, message: &str);

    /// Something good to know; the run goes on.
    fn note(&self, _message: &str) {}

    /// Of the chunk tasks of this stage so many are done, and found so many links.
    fn tasks(&self, _n_done: u64, _n_total: u64, _n_links: u64) {}

    /// Says whether the run was asked to stop.
    fn is_stopped(&self) -> bool;

    /// Turns a wish to stop into an error; stages call it at least every 100 ms.
    ///
    /// # Errors
    /// [`StoreError::Interrupted`] when the run was asked to stop.
    fn check(&self) -> Result<(), StoreError> {
        if self.is_stopped() { Err(StoreError::Interrupted) } else { Ok(()) }
    }
}

/// Nobody is listening and nobody will stop it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quiet;

impl Watch for Quiet {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}
    fn advance(&self, _n: u64) {}
    fn warn(&self, _message: &str) {}
    fn is_stopped(&self) -> bool {
        false
    }
}
