//! Surfels that are far wider than what their points cover: a few stray points in one leaf.

use crate::error::QueryError;
use crate::exact::ExactOptions;
use crate::map::Map;

/// So many times wider than its points cover is too wide: of an even sample a sheet has 0.7, a row
/// of n points √n / 2, and no leaf of the generated scenes, as they are built by default, has 20.
pub const WIDE_TIMES: u32 = 20;
/// A leaf of fewer points is never cut for its spread: they show no spacing of their own.
pub const LEAST_CUT: u64 = 4;
/// Surfels between two questions whether to go on.
const PIECE: u32 = 1 << 16;

/// What there is of such surfels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WideSurfels {
    /// How many.
    pub n: u32,
    /// Those of them of fewer than [`LEAST_CUT`] points.
    pub n_uncut: u32,
    /// The one of the greatest radius, the first of equals.
    pub widest: u32,
}

impl Map<'_> {
    /// Counts the surfels of radius R > 20·√n·s, with n their points and s the median spacing of
    /// the map, the Δ of [`ExactOptions::usual`]: discs that hide what their points are too few to
    /// hide. None where there are no such. Reads all surfels; `goes_on` hears of so many more and
    /// says whether to go on.
    ///
    /// # Errors
    /// Where a surfel is damaged, or `goes_on` said no.
    pub fn wide_surfels(
        &self,
        goes_on: &dyn Fn(u64) -> bool,
    ) -> Result<Option<WideSurfels>, QueryError> {
        let n_surfels = self.view().summary().n_surfels;
        let spacing = ExactOptions::usual(self)?.delta_grid();
        let covered2 = u128::from(WIDE_TIMES * WIDE_TIMES) * u128::from(spacing).pow(2);
        let mut found: Option<(WideSurfels, u64)> = None;
        for id in 0..n_surfels {
            if id % PIECE == PIECE - 1 && !goes_on(PIECE.into()) {
                return Err(QueryError::Stopped);
            }
            let surfel = self.view().surfel(id)?;
            // 2^9 · 2^46 · n: a count of points is below 2^48.
            if u128::from(surfel.radius2) <= covered2 * u128::from(surfel.n_points) {
                continue;
            }
            let none = (WideSurfels { n: 0, n_uncut: 0, widest: id }, 0);
            let (wide, radius2) = found.get_or_insert(none);
            wide.n += 1;
            wide.n_uncut += u32::from(surfel.n_points < LEAST_CUT);
            if surfel.radius2 > *radius2 {
                (wide.widest, *radius2) = (id, surfel.radius2);
            }
        }
        Ok(found.map(|(wide, _)| wide))
    }
}
