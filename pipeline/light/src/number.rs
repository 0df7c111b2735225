//! Kernels are written once for both precisions.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// Numbers that are computed side by side.
pub(crate) const LANES: usize = 16;

/// A number of single or double precision.
pub(crate) trait Number:
    Copy
    + Default
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + AddAssign
    + Div<Output = Self>
    + Mul<Output = Self>
    + Neg<Output = Self>
    + Sub<Output = Self>
{
    /// Gives the nearest number.
    fn of(v: f64) -> Self;

    /// Gives the same number in double precision.
    fn wide(self) -> f64;
}

impl Number for f32 {
    #[inline(always)]
    fn of(v: f64) -> f32 {
        v as f32
    }

    #[inline(always)]
    fn wide(self) -> f64 {
        f64::from(self)
    }
}

impl Number for f64 {
    #[inline(always)]
    fn of(v: f64) -> f64 {
        v
    }

    #[inline(always)]
    fn wide(self) -> f64 {
        self
    }
}

/// Gives a lane's worth of numbers; there are that many from `first` on.
#[inline(always)]
pub(crate) fn lanes<T>(column: &[T], first: usize) -> &[T; LANES] {
    match column[first..].first_chunk() {
        Some(chunk) => chunk,
        None => unreachable!("columns are filled up to whole lanes"),
    }
}

/// Adds up what the lanes hold, one after another.
#[inline(always)]
pub(crate) fn across<T: Number>(sums: &[T; LANES]) -> T {
    let mut all = T::default();
    for lane in 0..LANES {
        all += sums[lane];
    }
    all
}

/// Copies a span of a column to `to`, all lanes of it where there are as many: what is beyond the
/// span is overwritten later.
#[inline(always)]
pub(crate) fn copy_lanes<T: Copy>(column: &[T], (first, end): (usize, usize), to: &mut [T]) {
    match (column[first..].first_chunk::<LANES>(), to.first_chunk_mut::<LANES>()) {
        (Some(from), Some(to)) => *to = *from,
        _ => to[..end - first].copy_from_slice(&column[first..end]),
    }
}
