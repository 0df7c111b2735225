//! The grids of Chebyshev nodes that stand for the elements of nodes.

use std::ops::Range;

use crate::element::Elements;
use crate::fmm::bounds::Bounds;
use crate::fmm::chebyshev::{self, MAX_ORDER};
use crate::hierarchy::Hierarchy;
use crate::number::Number;

/// How far from the centre of a grid of full order, in half widths of its box, what it exchanges
/// light with must be. Boxes of one size that are two widths apart are just so far.
const SEPARATION: f64 = 3.0;
/// Grids of lower order that would have to be farther away are not worth their moments.
const MAX_SEPARATION: f64 = 128.0;

/// Weights between the nodes of two orders on one axis: `[to][from]`.
type Weights = [[f64; MAX_ORDER]; MAX_ORDER];

/// A vector for each channel.
pub(crate) type Vectors<T, const C: usize> = [[T; 3]; C];

/// A grid over a box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Grid {
    centre: [f64; 3],
    half: [f64; 3],
    /// Nodes on each axis.
    counts: [u8; 3],
    /// The distance that it needs, in half widths of its box.
    separation: f64,
}

/// The grids of all nodes, those of a node from fine to coarse. A full one has the order that was
/// asked for; lower orders err no more for what is farther away.
#[derive(Debug, Clone)]
pub(crate) struct Grids {
    grids: Vec<Grid>,
    /// The first grid of each node; one more than there are nodes.
    first: Vec<u32>,
    /// Where the places of each grid start; one more than there are grids.
    starts: Vec<usize>,
}

impl Grid {
    /// Makes the grid over a box that errs by `error` for what is so many half widths away.
    fn of(bounds: &Bounds, (order, error): (usize, f64), separation: f64) -> Grid {
        let half = bounds.half();
        let longest = bounds.half_width();
        let count = |side: f64| {
            // An axis of half length h errs as q^-p, q the sum of the half axes of the ellipse that
            // reaches the nearest source.
            let q = decay(separation * longest / side);
            let least = (1..order).find(|&p| q.powi(-(p as i32)) <= error);
            if side > 0.0 { least.unwrap_or(order) } else { 1 }
        };
        let counts = half.map(|side| count(side) as u8);
        Grid { centre: bounds.centre(), half, counts, separation }
    }

    /// Gives how far away, in half widths of its box, what it exchanges light with must be.
    pub(crate) fn separation(&self) -> f64 {
        self.separation
    }

    /// Says whether it has the order that was asked for: those of children are gathered in it.
    #[inline]
    pub(crate) fn is_full(&self) -> bool {
        self.separation == SEPARATION
    }

    fn counts(&self) -> [usize; 3] {
        self.counts.map(usize::from)
    }

    /// Counts its places.
    pub(crate) fn len(&self) -> usize {
        self.counts().iter().product()
    }

    /// Walks its places.
    pub(crate) fn places(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        let [_, ny, nz] = self.counts();
        (0..self.len()).map(move |place| {
            let at = [place / (ny * nz), place / nz % ny, place % nz];
            [0, 1, 2].map(|axis| self.coordinate(axis, at[axis]))
        })
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

    /// Adds the vectors of an element to the places (P2M).
    #[inline]
    pub(crate) fn gather<T: Number, const C: usize>(
        &self,
        x: [f64; 3],
        vectors: &Vectors<T, C>,
        moments: &mut [Vectors<T, C>],
    ) {
        self.each(x, |place, w| add_scaled(&mut moments[place], T::of(w), vectors));
    }

    /// Adds the field at a place (L2P).
    #[inline]
    pub(crate) fn spread<T: Number, const C: usize>(
        &self,
        x: [f64; 3],
        local: &[Vectors<T, C>],
        field: &mut Vectors<T, C>,
    ) {
        self.each(x, |place, w| add_scaled(field, T::of(w), &local[place]));
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
    pub(crate) fn gather_grid<T: Number, const C: usize>(
        &self,
        within: &Grid,
        from: &[Vectors<T, C>],
        to: &mut [Vectors<T, C>],
        between: &mut Between<T, C>,
    ) {
        between.contract(&self.weights_of(within), (within.counts(), self.counts()), from, to);
    }

    /// Adds this grid's field to that of a grid within it (L2L), the transpose.
    pub(crate) fn spread_grid<T: Number, const C: usize>(
        &self,
        within: &Grid,
        from: &[Vectors<T, C>],
        to: &mut [Vectors<T, C>],
        between: &mut Between<T, C>,
    ) {
        let gathering = self.weights_of(within);
        let mut weights = [[[0.0; MAX_ORDER]; MAX_ORDER]; 3];
        for axis in 0..3 {
            for m in 0..MAX_ORDER {
                for k in 0..MAX_ORDER {
                    weights[axis][m][k] = gathering[axis][k][m];
                }
            }
        }
        between.contract(&weights, (self.counts(), within.counts()), from, to);
    }

    /// Gives the weights of these nodes for those of a grid within, by axis.
    fn weights_of(&self, within: &Grid) -> [Weights; 3] {
        let mut weights = [[[0.0; MAX_ORDER]; MAX_ORDER]; 3];
        for axis in 0..3 {
            for k in 0..within.counts()[axis] {
                let column = self.weights(axis, within.coordinate(axis, k));
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
fn decay(distance: f64) -> f64 {
    distance + (distance * distance - 1.0).sqrt()
}

/// Gives the share by which the exchange of two grids of an order may err: q^-p.
pub(crate) fn error_of(order: usize) -> f64 {
    decay(SEPARATION).powi(-(order as i32))
}

/// What there is between two grids while one axis after another is changed.
pub(crate) struct Between<T, const C: usize>([Vec<Vectors<T, C>>; 2]);

impl<T: Number, const C: usize> Between<T, C> {
    pub(crate) fn new() -> Between<T, C> {
        Between([Vec::new(), Vec::new()])
    }

    /// Adds a product of weights on three axes.
    fn contract(
        &mut self,
        w: &[Weights; 3],
        ([nx, ny, nz], [mx, my, mz]): ([usize; 3], [usize; 3]),
        from: &[Vectors<T, C>],
        to: &mut [Vectors<T, C>],
    ) {
        let [first, second] = &mut self.0;
        let nothing = [[T::default(); 3]; C];
        first.clear();
        first.resize(mx * ny * nz, nothing);
        second.clear();
        second.resize(mx * my * nz, nothing);
        for i in 0..mx {
            for x in 0..nx {
                let w = T::of(w[0][i][x]);
                for rest in 0..ny * nz {
                    add_scaled(&mut first[i * ny * nz + rest], w, &from[x * ny * nz + rest]);
                }
            }
            for j in 0..my {
                for y in 0..ny {
                    let w = T::of(w[1][j][y]);
                    for z in 0..nz {
                        let from = &first[(i * ny + y) * nz + z];
                        add_scaled(&mut second[(i * my + j) * nz + z], w, from);
                    }
                }
                for k in 0..mz {
                    for z in 0..nz {
                        let w = T::of(w[2][k][z]);
                        add_scaled(
                            &mut to[(i * my + j) * mz + k],
                            w,
                            &second[(i * my + j) * nz + z],
                        );
                    }
                }
            }
        }
    }
}

/// Adds w v.
#[inline(always)]
pub(crate) fn add_scaled<T: Number, const C: usize>(
    to: &mut Vectors<T, C>,
    w: T,
    v: &Vectors<T, C>,
) {
    for (to, v) in to.as_flattened_mut().iter_mut().zip(v.as_flattened()) {
        *to += w * *v;
    }
}

impl Grids {
    /// Makes none.
    pub(crate) fn none(hierarchy: &Hierarchy) -> Grids {
        let first = vec![0; hierarchy.n_nodes() as usize + 1];
        Grids { grids: Vec::new(), first, starts: vec![0] }
    }

    /// Makes a full grid for every node that holds more elements than that has places, and whose
    /// parent has one; and those of lower orders that have fewer places still.
    pub(crate) fn of(
        elements: &Elements,
        hierarchy: &Hierarchy,
        bounds: &[Bounds],
        order: usize,
    ) -> Grids {
        debug_assert_eq!(elements.len(), hierarchy.n_elements(), "a leaf an element");
        let error = error_of(order);
        // A grid of a lower order k errs no more where q^-k is as little.
        let needed = |k: usize| {
            let mut distances =
                (1..).map(|half| 0.5 * f64::from(half)).skip_while(|&d| d < SEPARATION);
            distances.find(|&d| d > MAX_SEPARATION || decay(d).powi(-(k as i32)) <= error)
        };
        let orders = (1..=order).rev().filter_map(|k| Some((k, needed(k)?)));
        let orders: Vec<(usize, f64)> = orders.filter(|&(_, d)| d <= MAX_SEPARATION).collect();
        let mut all = Grids { grids: Vec::new(), first: vec![0], starts: vec![0] };
        for id in 0..hierarchy.n_nodes() {
            let node = hierarchy.node(id);
            let around = &bounds[id as usize];
            let mut n_places = (node.elements.1 - node.elements.0) as usize;
            let may_be_full = id == 0 || all.full(node.parent).is_some();
            for &(k, separation) in &orders {
                if around.is_empty() || k == order && !may_be_full {
                    continue;
                }
                let grid = Grid::of(around, (k, error), separation);
                if grid.len() < n_places {
                    n_places = grid.len();
                    all.starts.push(all.n_places() + n_places);
                    all.grids.push(grid);
                }
            }
            // Fewer than elements, of which there are 32 bits.
            all.first.push(all.grids.len() as u32);
        }
        all
    }

    /// Gives the grids of a node, from fine to coarse.
    #[inline]
    pub(crate) fn of_node(&self, node: u32) -> &[Grid] {
        &self.grids[self.first[node as usize] as usize..self.first[node as usize + 1] as usize]
    }

    /// Gives the full grid of a node, if it has one.
    #[inline]
    pub(crate) fn full(&self, node: u32) -> Option<&Grid> {
        self.of_node(node).first().filter(|grid| grid.is_full())
    }

    /// Gives the first grid of a node, or where it would be.
    #[inline]
    pub(crate) fn first(&self, node: u32) -> u32 {
        self.first[node as usize]
    }

    /// Gives where the places of a node's grids start; with the number of nodes, how many there
    /// are.
    #[inline]
    pub(crate) fn start(&self, node: u32) -> usize {
        self.starts[self.first[node as usize] as usize]
    }

    /// Gives the places of a node's `index`-th grid among all.
    #[inline]
    pub(crate) fn range(&self, node: u32, index: usize) -> Range<usize> {
        let grid = self.first[node as usize] as usize + index;
        self.starts[grid]..self.starts[grid + 1]
    }

    /// Counts all places.
    pub(crate) fn n_places(&self) -> usize {
        self.starts.last().copied().unwrap_or(0)
    }

    /// Counts the grids.
    pub(crate) fn n_grids(&self) -> usize {
        self.grids.len()
    }

    /// Counts the bytes held.
    pub(crate) fn held_bytes(&self) -> usize {
        self.grids.capacity() * size_of::<Grid>()
            + self.first.capacity() * size_of::<u32>()
            + self.starts.capacity() * size_of::<usize>()
    }
}
