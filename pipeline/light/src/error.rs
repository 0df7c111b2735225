//! Why a scene cannot be lit.

use pvmap_query::QueryError;
use pvmap_store::{StoreError, Watch};
use pvmap_vmap::FormatError;

/// A failure of the light stage.
#[derive(Debug, thiserror::Error)]
pub enum LightError {
    /// An element has a number it cannot have.
    #[error("element {index}: {what}")]
    Element {
        /// Which.
        index: usize,
        /// What is wrong with it.
        what: String,
    },
    /// There are not as many values as elements.
    #[error("{found} values of {what} for {expected} elements; give one each")]
    Count {
        /// Of what.
        what: &'static str,
        /// Given.
        found: usize,
        /// Needed.
        expected: usize,
    },
    /// A value is out of range.
    #[error("{what} of element {index} is {value}; it must be {range}")]
    Value {
        /// Of what.
        what: &'static str,
        /// Whose.
        index: usize,
        /// What it is.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// A setting of the computation is out of range.
    #[error("{what} is {value}; it must be {range}")]
    Setting {
        /// Which.
        what: &'static str,
        /// What it is.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// The nodes are no tree over the elements, or a link joins what it may not.
    #[error("node {node} {what}")]
    Tree {
        /// Where.
        node: u32,
        /// Which rule it breaks.
        what: &'static str,
    },
    /// Light would be reflected for ever.
    #[error(
        "no finite solution: of what arrives, {reflected} is reflected to where it came from, and \
         nothing escapes; lower the albedo below 1"
    )]
    NoFiniteSolution {
        /// max ρ_i Σ_j G_ij / A_i.
        reflected: f64,
    },
    /// A residual is no number.
    #[error(
        "the residual is {residual} after {iterations} iterations: a bug, or a broken operator"
    )]
    NotFinite {
        /// What it is.
        residual: f64,
        /// Done until then.
        iterations: usize,
    },
    /// The tolerance was not met.
    #[error(
        "after {iterations} iterations the residual is {residual}, not {tolerance}; allow more \
         iterations or a larger tolerance"
    )]
    NotConverged {
        /// Done.
        iterations: usize,
        /// Reached.
        residual: f64,
        /// Asked for.
        tolerance: f64,
    },
    /// A scaling was found for another exchange.
    #[error(
        "the scale was found for other light: with it what surfels get from all is off by \
         {off:.1e}, not {row_error:.1e}; leave --scale-of out"
    )]
    OtherScaling {
        /// The mean at some surfels.
        off: f64,
        /// What it was said to be.
        row_error: f64,
    },
    /// The map cannot be read.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The map does not answer.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// There are more elements than the memory holds.
    #[error(
        "memory = {} MiB: light of so many surfels takes {} MiB, its lists on disk; raise \
         --memory, or build the map with a lower max_level or a larger leaf_capacity",
        limit_bytes >> 20,
        need_bytes.div_ceil(1 << 20)
    )]
    Memory {
        /// What there is for them, in bytes.
        limit_bytes: u64,
        /// What they take.
        need_bytes: u64,
    },
    /// What does not fit the memory cannot be written to disk.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The run was asked to stop.
    #[error("stopped")]
    Stopped,
}

/// Turns a wish to stop into an error.
pub(crate) fn check(watch: &dyn Watch) -> Result<(), LightError> {
    if watch.is_stopped() { Err(LightError::Stopped) } else { Ok(()) }
}
