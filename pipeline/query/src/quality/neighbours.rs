//! The points nearest to a place, found in the cells of the octree.

use std::collections::BinaryHeap;
use std::ops::ControlFlow;

use pvmap_geometry::{GridPoint, morton};
use pvmap_vmap::{FormatError, OctreeView};

use crate::exact::StoredPoint;
use crate::exact::cells::{Cells, FEW_POINTS, Open};

/// Points of a neighbourhood, as many as those that normals are estimated from. [D-5]
pub(super) const K: usize = 16;

/// Of a cell that cannot be divided so many points are looked at: a million copies of one point
/// say no more than these.
const MOST_OF_A_CODE: u64 = 4096;

/// The [`K`] points nearest to a place, the point there being one of them.
#[derive(Debug, Default)]
pub(super) struct Neighbourhood {
    g: GridPoint,
    /// In the order of (distance², g, index); coincident points count each.
    nearest: Vec<(u64, StoredPoint)>,
    n_same_place: u64,
    spacing2: u64,
}

impl Neighbourhood {
    fn new(g: GridPoint) -> Neighbourhood {
        let nearest = Vec::with_capacity(K + 1);
        Neighbourhood { g, nearest, n_same_place: 0, spacing2: u64::MAX }
    }

    /// Walks the points, the nearest first.
    pub(super) fn points(&self) -> impl ExactSizeIterator<Item = &StoredPoint> {
        self.nearest.iter().map(|(_, point)| point)
    }

    /// Counts the points at the place itself.
    pub(super) fn n_same_place(&self) -> u64 {
        self.n_same_place
    }

    /// Gives the squared distance to the nearest point in another place.
    pub(super) fn spacing2(&self) -> Option<u64> {
        (self.spacing2 < u64::MAX).then_some(self.spacing2)
    }

    /// Gives the squared distance beyond which no point changes anything.
    fn reach2(&self) -> u64 {
        match self.nearest.last() {
            Some(&(last2, _)) if self.nearest.len() == K => last2.max(self.spacing2),
            _ => u64::MAX,
        }
    }

    fn offer(&mut self, point: &StoredPoint) {
        let steps = |i: usize| u64::from(self.g[i].abs_diff(point.g()[i]));
        let d2 = (0..3).map(|i| steps(i).pow(2)).sum();
        match d2 {
            0 => self.n_same_place += 1,
            _ => self.spacing2 = self.spacing2.min(d2),
        }
        let key = |d2: u64, p: &StoredPoint| (d2, p.g(), p.index());
        let own = key(d2, point);
        let at = self.nearest.partition_point(|(d2, p)| key(*d2, p) < own);
        if at < K {
            self.nearest.insert(at, (d2, *point));
            self.nearest.truncate(K);
        }
    }
}

/// The way to neighbourhoods of an octree, one after another.
#[derive(Debug)]
pub(super) struct Neighbours<'v, 'a> {
    octree: &'v OctreeView<'a>,
    open: BinaryHeap<Open>,
}

impl<'v, 'a> Neighbours<'v, 'a> {
    pub(super) fn new(octree: &'v OctreeView<'a>) -> Neighbours<'v, 'a> {
        Neighbours { octree, open: BinaryHeap::new() }
    }

    /// Finds the neighbourhood of a place that has a point: looks into cells, the nearest first,
    /// until those left are too far.
    pub(super) fn around(&mut self, g: GridPoint) -> Result<Neighbourhood, FormatError> {
        let mut near = Neighbourhood::new(g);
        let mut cells = Cells::new(self.octree);
        let place = g.map(|v| v as i32);
        self.open.clear();
        self.open.extend(cells.root().map(|cell| Open { least2: 0, cell }));
        let mut parts = Vec::new();
        while let Some(Open { least2, cell }) = self.open.pop() {
            let reach2 = near.reach2();
            // Not `>=`: among points at the same distance the rest of the order decides.
            if least2 > reach2 {
                break;
            }
            if cell.n_points() > FEW_POINTS && cell.level < morton::MAX_LEVEL {
                cells.divide(&cell, &mut parts, |bounds| bounds.distance2(place) <= reach2)?;
                let open = parts.drain(..).map(|cell| {
                    let least2 = cell.bounds().distance2(place);
                    Open { least2, cell }
                });
                self.open.extend(open);
                continue;
            }
            let mut left = MOST_OF_A_CODE;
            let _ = cells.each(&cell, |point| {
                near.offer(point);
                left -= 1;
                if left == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            })?;
        }
        Ok(near)
    }
}
