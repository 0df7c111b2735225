//! The 16 points nearest to a place, exactly: by (distance², g), each position with its points.

use pvmap_geometry::GridPoint;
use pvmap_geometry::normal::Normal;
use pvmap_geometry::plane::Moments;

use super::K;

/// Marks a neighbour that is not in the tile.
pub(super) const ELSEWHERE: u32 = u32::MAX;

/// A position of the neighbourhood.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbour {
    /// Squared distance to the place asked about: below 2^46.
    pub(super) d2: u64,
    pub(super) g: GridPoint,
    /// Points there; at least one is among the 16.
    pub(super) count: u32,
    /// Its number in the tile, or [`ELSEWHERE`].
    pub(super) position: u32,
}

/// The nearest positions that were offered so far.
#[derive(Debug, Default)]
pub(super) struct Neighbours {
    /// In the order of (distance², g) when offered, else as they were pushed.
    entries: Vec<Neighbour>,
    n_points: u32,
}

impl Neighbours {
    /// Forgets everything.
    pub(super) fn clear(&mut self) {
        self.entries.clear();
        self.n_points = 0;
    }

    /// Gives the positions that have points among the 16.
    pub(super) fn entries(&self) -> &[Neighbour] {
        &self.entries
    }

    /// Says whether there are 16 points.
    pub(super) fn is_full(&self) -> bool {
        self.n_points >= K as u32
    }

    /// Gives the squared distance beyond which an offer is in vain: that of the 16th point.
    #[inline]
    pub(super) fn reach2(&self) -> u64 {
        if self.is_full() {
            self.entries.iter().map(|e| e.d2).max().unwrap_or(u64::MAX)
        } else {
            u64::MAX
        }
    }

    /// Adds the next of the nearest, unless there are 16 points; ties come in the order of g.
    #[inline]
    pub(super) fn push(&mut self, neighbour: Neighbour) {
        let count = neighbour.count.min(K as u32 - self.n_points);
        if count > 0 {
            self.n_points += count;
            self.entries.push(Neighbour { count, ..neighbour });
        }
    }

    /// Readies what was pushed for further offers.
    pub(super) fn sort(&mut self) {
        self.entries.sort_unstable_by_key(|e| (e.d2, e.g));
    }

    /// Considers more points at some position; the same position may be offered in parts.
    #[inline]
    pub(super) fn offer(&mut self, neighbour: Neighbour) {
        let key = |n: &Neighbour| (n.d2, n.g);
        let at = match self.entries.last() {
            Some(last) if self.is_full() && key(&neighbour) > key(last) => return,
            _ => self.entries.partition_point(|e| key(e) < key(&neighbour)),
        };
        // Beyond 16 more points at a position say nothing, and the count must not overflow.
        let count = neighbour.count.min(K as u32);
        match self.entries.get_mut(at) {
            Some(same) if same.g == neighbour.g => same.count += count,
            _ => self.entries.insert(at, Neighbour { count, ..neighbour }),
        }
        self.n_points += count;
        while let Some(last) = self.entries.last()
            && self.n_points - last.count >= K as u32
        {
            self.n_points -= last.count;
            self.entries.pop();
        }
        if let Some(last) = self.entries.last_mut() {
            let surplus = self.n_points.saturating_sub(K as u32);
            last.count -= surplus;
            self.n_points -= surplus;
        }
    }

    /// Gives the normal of the plane through the 16 points nearest to `g`.
    pub(super) fn normal(&self, g: GridPoint) -> Option<Normal> {
        let mut moments = Moments::default();
        for e in &self.entries {
            let d = [0, 1, 2].map(|i| i64::from(e.g[i]) - i64::from(g[i]));
            moments.add(d, i64::from(e.count));
        }
        moments.normal()
    }
}
