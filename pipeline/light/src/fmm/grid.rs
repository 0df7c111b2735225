//! The grids of Chebyshev nodes that stand for the elements of large nodes.

use crate::element::Elements;
use crate::fmm::bounds::Bounds;
use crate::fmm::chebyshev::{self, MAX_ORDER};
use crate::fmm::walk::SEPARATION;
use crate::hierarchy::Hierarchy;

/// The most places of a grid.
const MAX_PLACES: usize = MAX_ORDER * MAX_ORDER * MAX_ORDER;

/// Weights between the nodes of two orders on one axis: `[to][from]`.
type Weights = [[f64; MAX_ORDER]; MAX_ORDER];

/// A grid over a box.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Grid {
    centre: [f64; 3],
    half: [f64; 3],
    /// Nodes on each axis; no grid where there is none.
    counts: [u8; 3],
}

/// The grids of all nodes that have one, their places one after another in preorder.
#[derive(Debug, Clone, Default)]
pub(crate) struct Grids {
    grids: Vec<Grid>,
    /// Where the places of each node start; one more than there are nodes.
    starts: Vec<usize>,
    pub(crate) places: [Vec<f64>; 3],
}

impl Grid {
    /// Makes the grid of an order over a box: of that order along its longest side, of lower ones
    /// along shorter sides, where they err no more.
    fn of(bounds: &Bounds, order: usize) -> Grid {
        let half = bounds.half();
        let longest = bounds.half_width();
        let count = |side: f64| {
            // An axis of half length h errs as q^-p, q the sum of the half axes of the ellipse that
            // reaches the nearest source.
            let enough = decay(SEPARATION).powi(order as i32);
            let q = decay(SEPARATION * longest / side);
            let least = (1..order).find(|&p| q.powi(p as i32) >= enough);
            if side > 0.0 { least.unwrap_or(order) } else { 1 }
        };
        Grid { centre: bounds.centre(), half, counts: half.map(|side| count(side) as u8) }
    }

    fn counts(&self) -> [usize; 3] {
        self.counts.map(usize::from)
    }

    /// Counts its places.
    pub(crate) fn len(&self) -> usize {
        self.counts().iter().product()
    }

    /// Gives the coordinates of its nodes on an axis.
    fn coordinate(&self, axis: usize, m: usize) -> f64 {
        self.centre[axis] + self.half[axis] * chebyshev::nodes(self.counts()[axis])[m]
    }

    /// Gives the weights of the nodes on an axis for a coordinate.
    #[inline]
    fn weights(&self, axis: usize, x: f64) -> [f64; MAX_ORDER] {
        let half = self.half[axis];
        let u = if half > 0.0 { (x - self.centre[axis]) / half } else { 0.0 };
        // Only an element without a normal, which sends and gets nothing, lies outside the box.
        let u = u.clamp(-1.0, 1.0);
        chebyshev::weights(self.counts()[axis], u)
    }

    /// Adds the vector of an element to the places (P2M).
    #[inline]
    pub(crate) fn gather(&self, x: [f64; 3], vector: [f64; 3], moments: &mut [&mut [f64]; 3]) {
        self.each(x, |place, w| {
            for (moments, v) in moments.iter_mut().zip(vector) {
                moments[place] += w * v;
            }
        });
    }

    /// Gives the field at a place (L2P).
    #[inline]
    pub(crate) fn field_at(&self, x: [f64; 3], local: &[&[f64]; 3]) -> [f64; 3] {
        let mut field = [0.0; 3];
        self.each(x, |place, w| {
            for (sum, local) in field.iter_mut().zip(local) {
                *sum += w * local[place];
            }
        });
        field
    }

    /// Walks its places with their weights for x.
    #[inline]
    fn each(&self, x: [f64; 3], mut with: impl FnMut(usize, f64)) {
        let [nx, ny, nz] = self.counts();
        let [wx, wy, wz] = [0, 1, 2].map(|axis| self.weights(axis, x[axis]));
        for a in 0..nx {
            for b in 0..ny {
                let w = wx[a] * wy[b];
                for c in 0..nz {
                    with((a * ny + b) * nz + c, w * wz[c]);
                }
            }
        }
    }

    /// Adds the moments of a grid within this one (M2M).
    pub(crate) fn gather_grid(&self, child: &Grid, from: &[&[f64]; 3], to: &mut [&mut [f64]; 3]) {
        let weights = self.weights_of(child);
        for (from, to) in from.iter().zip(to) {
            contract(&weights, child.counts(), self.counts(), from, to);
        }
    }

    /// Adds this grid's field to that of a grid within it (L2L), the transpose.
    pub(crate) fn spread_grid(&self, child: &Grid, from: &[&[f64]; 3], to: &mut [&mut [f64]; 3]) {
        let gathering = self.weights_of(child);
        let mut weights = [[[0.0; MAX_ORDER]; MAX_ORDER]; 3];
        for axis in 0..3 {
            for m in 0..MAX_ORDER {
                for k in 0..MAX_ORDER {
                    weights[axis][m][k] = gathering[axis][k][m];
                }
            }
        }
        for (from, to) in from.iter().zip(to) {
            contract(&weights, self.counts(), child.counts(), from, to);
        }
    }

    /// Gives the weights of these nodes for those of a grid within, by axis.
    fn weights_of(&self, child: &Grid) -> [Weights; 3] {
        let mut weights = [[[0.0; MAX_ORDER]; MAX_ORDER]; 3];
        for axis in 0..3 {
            for k in 0..child.counts()[axis] {
                let column = self.weights(axis, child.coordinate(axis, k));
                for (row, w) in weights[axis].iter_mut().zip(column) {
                    row[k] = w;
                }
            }
        }
        weights
    }
}

/// By how much the error falls with each order for a source so many half widths from the centre:
/// q = d + √(d² - 1).
pub(crate) fn decay(distance: f64) -> f64 {
    distance + (distance * distance - 1.0).sqrt()
}

/// Adds a product of weights on three axes, one axis after another.
fn contract(w: &[Weights; 3], n: [usize; 3], m: [usize; 3], from: &[f64], to: &mut [f64]) {
    let [nx, ny, nz] = n;
    let [mx, my, mz] = m;
    let (mut first, mut second) = ([0.0; MAX_PLACES], [0.0; MAX_PLACES]);
    for i in 0..mx {
        for x in 0..nx {
            let w = w[0][i][x];
            for rest in 0..ny * nz {
                first[i * ny * nz + rest] += w * from[x * ny * nz + rest];
            }
        }
        for j in 0..my {
            for y in 0..ny {
                let w = w[1][j][y];
                for z in 0..nz {
                    second[(i * my + j) * nz + z] += w * first[(i * ny + y) * nz + z];
                }
            }
            for k in 0..mz {
                let row = &second[(i * my + j) * nz..][..nz];
                let sum: f64 = row.iter().zip(&w[2][k]).map(|(v, w)| v * w).sum();
                to[(i * my + j) * mz + k] += sum;
            }
        }
    }
}

impl Grids {
    /// Makes those of an order for every node that holds more elements than its grid has places,
    /// and whose parent has one.
    pub(crate) fn of(
        elements: &Elements,
        hierarchy: &Hierarchy,
        bounds: &[Bounds],
        order: usize,
    ) -> Grids {
        debug_assert_eq!(elements.len(), hierarchy.n_elements(), "a leaf an element");
        let mut all = Grids::default();
        for id in 0..hierarchy.n_nodes() {
            let node = hierarchy.node(id);
            let n_elements = (node.elements.1 - node.elements.0) as usize;
            let is_below = id == 0 || all.grids[node.parent as usize].len() > 0;
            let around = &bounds[id as usize];
            let grid = match is_below && !around.is_empty() {
                true => Some(Grid::of(around, order)).filter(|grid| grid.len() < n_elements),
                false => None,
            };
            all.push(grid.unwrap_or_default());
        }
        all.starts.push(all.places[0].len());
        all
    }

    fn push(&mut self, grid: Grid) {
        self.starts.push(self.places[0].len());
        let [nx, ny, nz] = grid.counts();
        for place in 0..grid.len() {
            let at = [place / (ny * nz), place / nz % ny, place % nz];
            debug_assert!(at[0] < nx, "places in the order of `each`");
            for axis in 0..3 {
                self.places[axis].push(grid.coordinate(axis, at[axis]));
            }
        }
        self.grids.push(grid);
    }

    /// Gives the grid of a node, if it has one.
    #[inline]
    pub(crate) fn get(&self, node: u32) -> Option<&Grid> {
        self.grids.get(node as usize).filter(|grid| grid.counts[0] > 0)
    }

    /// Gives where the places of a node start; with the number of nodes, how many there are.
    #[inline]
    pub(crate) fn start(&self, node: u32) -> usize {
        self.starts[node as usize]
    }

    /// Counts all places.
    pub(crate) fn n_places(&self) -> usize {
        self.places[0].len()
    }

    /// Counts the grids.
    pub(crate) fn n_grids(&self) -> usize {
        self.grids.iter().filter(|grid| grid.counts[0] > 0).count()
    }

    /// Counts the bytes held.
    pub(crate) fn held_bytes(&self) -> usize {
        self.grids.capacity() * (size_of::<Grid>() + size_of::<usize>())
            + self.places.iter().map(|axis| axis.capacity() * size_of::<f64>()).sum::<usize>()
    }
}
