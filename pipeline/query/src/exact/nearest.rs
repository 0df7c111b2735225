//! From a place in the world to the point of the scan that stands for it.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::ops::ControlFlow;

use pvmap_geometry::morton;
use pvmap_vmap::FormatError;

use super::cells::{Cell, Cells, FEW_POINTS, Open};
use super::{Exact, StoredPoint};
use crate::error::QueryError;
use crate::locate::{Place, Target, target_of};

/// The point of the scan nearest to a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// The point.
    pub point: StoredPoint,
    /// World units from the place to it, both on the grid.
    pub distance: f64,
}

/// How well a point stands for a place, the best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Fit {
    /// Squared distance, grid steps².
    distance2: u64,
    /// n·(normal given), its size where the point's side is unknown; 0 without a normal.
    along: Reverse<i64>,
    index: u64,
}

/// The best points so far.
#[derive(Debug, Default)]
struct Best {
    /// Of all.
    any: Option<(Fit, StoredPoint)>,
    /// Of those whose normal agrees with the one given.
    agreeing: Option<(Fit, StoredPoint)>,
}

impl Exact<'_, '_> {
    /// Finds the point of the scan that stands for a place: the nearest; of equally near ones the
    /// one whose normal goes best with the place's, then the first of the octree.
    ///
    /// With a normal, the nearest point that faces its way (n·normal > 0; either side of a point of
    /// unknown side) is preferred to any other that is nearer by up to Δ: so a place on one face of
    /// a thin wall gets a point of that face, and where no point faces its way the nearest is near.
    ///
    /// # Errors
    /// Where the place is outside the cube, its normal is no direction, the scan has no points or
    /// what is read of the octree is damaged. How far the point may be is for the caller to say.
    pub fn nearest(&self, place: &Place) -> Result<Nearest, QueryError> {
        let frame = &self.octree.frame().frame;
        let (distance2, point) = self.nearest_to(&target_of(frame, place)?)?;
        // Below 2^46, so the float is exact before the root.
        Ok(Nearest { point, distance: (distance2 as f64).sqrt() * frame.unit() })
    }

    /// Finds the point that stands for a place of the grid, and its squared distance.
    pub(super) fn nearest_to(&self, target: &Target) -> Result<(u64, StoredPoint), QueryError> {
        let best = self.best(target).map_err(QueryError::Octree)?;
        let (fit, point) = self.choose(&best).ok_or(QueryError::NoPoints)?;
        Ok((fit.distance2, point))
    }

    /// Gives the agreeing point, or the nearest where that is farther by more than Δ.
    fn choose(&self, best: &Best) -> Option<(Fit, StoredPoint)> {
        let limit2 = self.limit2(best);
        best.agreeing.filter(|(fit, _)| fit.distance2 <= limit2).or(best.any)
    }

    /// Gives the greatest squared distance of an agreeing point that is preferred to the nearest.
    fn limit2(&self, best: &Best) -> u64 {
        let Some((any, _)) = best.any else { return u64::MAX };
        // The root rounded up: a point as near as the nearest is always allowed.
        let root = any.distance2.isqrt();
        let root = root + u64::from(root * root < any.distance2);
        (root + u64::from(self.options.delta_grid)).pow(2)
    }

    /// Looks into cells, the nearest first, until those left are too far.
    fn best(&self, target: &Target) -> Result<Best, FormatError> {
        let g = target.g.map(|v| v as i32);
        let mut best = Best::default();
        let mut cells = Cells::new(self.octree);
        let mut open: BinaryHeap<Open> =
            cells.root().into_iter().map(|cell| Open { least2: 0, cell }).collect();
        let mut parts = Vec::new();
        while let Some(Open { least2, cell }) = open.pop() {
            let known2 = best.agreeing.map_or(u64::MAX, |(fit, _)| fit.distance2);
            // Not `>=`: among points at the same distance the rest of the order decides.
            if least2 > known2.min(self.limit2(&best)) {
                break;
            }
            if cell.n_points() > FEW_POINTS && cell.level < morton::MAX_LEVEL {
                cells.divide(&cell, &mut parts, |_| true)?;
                let nearer = |cell: Cell| Open { least2: cell.bounds().distance2(g), cell };
                open.extend(parts.drain(..).map(nearer));
                continue;
            }
            let _ = cells.each(&cell, |point| {
                best.judge(target, point);
                ControlFlow::Continue(())
            })?;
        }
        Ok(best)
    }
}

impl Best {
    /// Keeps a point if it is better than those before.
    fn judge(&mut self, target: &Target, point: &StoredPoint) {
        let steps = |i: usize| u64::from(target.g[i].abs_diff(point.g[i]));
        let given = target.normal.unwrap_or_default();
        let along: i64 = (0..3).map(|i| i64::from(given[i]) * i64::from(point.normal[i])).sum();
        let along = if point.oriented { along } else { along.abs() };
        let fit = Fit {
            distance2: (0..3).map(|i| steps(i).pow(2)).sum(),
            along: Reverse(along),
            index: point.index,
        };
        let keep = |best: &mut Option<(Fit, StoredPoint)>| {
            if best.is_none_or(|(other, _)| fit < other) {
                *best = Some((fit, *point));
            }
        };
        keep(&mut self.any);
        if target.normal.is_none() || along > 0 {
            keep(&mut self.agreeing);
        }
    }
}
