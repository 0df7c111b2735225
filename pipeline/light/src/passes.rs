//! The passes of an exchange: up the tree, and down again.
//!
//! Up, each grid gathers the vectors n_j A_j b_j of its elements. Down, each node adds to its own
//! field that of its partners, hands it to its children, and the leaves make flux of it and add
//! what they exchange one by one. A subtree's places and elements are ranges, so that subtrees are
//! computed side by side, each into its own part of the arrays.

use crate::exchange::{Exchange, Far};
use crate::fmm::translate::{Triple, translate};
use crate::kernel::{LANES, Sources};

/// Elements that are worth a task of their own.
const MIN_TASK: u32 = 512;
/// Targets for which sources are worth putting side by side.
const MIN_TARGETS: u32 = 4;
/// Sources one after another that are read where they are.
const MIN_IN_PLACE: usize = 4 * LANES;

/// A vector for every place or element of a subtree.
type TripleMut<'a> = [&'a mut [f64]; 3];

/// What the passes read.
pub(crate) struct Passes<'a> {
    exchange: &'a Exchange,
    b: &'a [f64],
    /// n_j A_j b_j of each element; empty without grids.
    vectors: [Vec<f64>; 3],
    /// What the grids have gathered.
    moments: [Vec<f64>; 3],
}

/// What the way down writes for a subtree.
struct Below<'m> {
    /// The field at the places of its grids.
    local: TripleMut<'m>,
    /// The field at its elements.
    field: TripleMut<'m>,
    /// The flux that arrives at its elements.
    flux: &'m mut [f64],
}

impl<'a> Passes<'a> {
    pub(crate) fn new(exchange: &'a Exchange, b: &'a [f64]) -> Passes<'a> {
        let mut passes = Passes { exchange, b, vectors: zeros(0), moments: zeros(0) };
        if let Some(far) = &exchange.far {
            let elements = &exchange.elements;
            let scaled = |axis: usize| {
                let rows = elements.normal[axis].iter().zip(&elements.area).zip(b);
                rows.map(|((n, area), b)| n * (area * b)).collect()
            };
            passes.vectors = [0, 1, 2].map(scaled);
            let mut moments = zeros(far.grids.n_places());
            passes.gather(far, 0, all_mut(&mut moments));
            passes.moments = moments;
        }
        passes
    }

    /// Gives the flux that arrives at each element.
    pub(crate) fn run(&self) -> Vec<f64> {
        let n_elements = self.exchange.elements.len();
        let n_places = self.exchange.far.as_ref().map_or(0, |far| far.grids.n_places());
        let mut flux = vec![0.0; n_elements];
        let mut local = zeros(n_places);
        let mut field = zeros(if self.exchange.far.is_some() { n_elements } else { 0 });
        if n_elements > 0 {
            let (local, field) = (all_mut(&mut local), all_mut(&mut field));
            self.spread(0, Below { local, field, flux: &mut flux });
        }
        flux
    }

    /// Fills the moments of a subtree, the children before their parent.
    fn gather(&self, far: &Far, node: u32, moments: TripleMut<'_>) {
        let Some(grid) = far.grids.get(node) else {
            return;
        };
        let (mut own, mut rest) = split(moments, grid.len());
        let tree = &self.exchange.hierarchy;
        self.gather_siblings(far, node + 1, tree.node(node).end, rest.each_mut().map(|v| &mut **v));
        let elements = &self.exchange.elements;
        for child in tree.children(node) {
            if let Some(below) = far.grids.get(child) {
                let at = far.grids.start(child) - far.grids.start(node) - grid.len();
                let from = rest.each_ref().map(|v| &v[at..at + below.len()]);
                grid.gather_grid(below, &from, &mut own);
            } else {
                let (first, end) = tree.node(child).elements;
                for j in first as usize..end as usize {
                    let place = elements.position.each_ref().map(|v| v[j]);
                    grid.gather(place, self.vectors.each_ref().map(|v| v[j]), &mut own);
                }
            }
        }
    }

    /// Gathers siblings, nodes `first`…`end`, some side by side.
    fn gather_siblings(&self, far: &Far, first: u32, end: u32, moments: TripleMut<'_>) {
        let middle = self.end_of_task(first, end);
        if middle == end {
            return self.gather_each(far, first, end, moments);
        }
        let (head, tail) = split(moments, far.grids.start(middle) - far.grids.start(first));
        rayon::join(
            || self.gather_each(far, first, middle, head),
            || self.gather_siblings(far, middle, end, tail),
        );
    }

    /// Gathers siblings one after another.
    fn gather_each(&self, far: &Far, mut first: u32, end: u32, mut moments: TripleMut<'_>) {
        while first < end {
            let next = self.exchange.hierarchy.node(first).end;
            let (head, tail) = split(moments, far.grids.start(next) - far.grids.start(first));
            self.gather(far, first, head);
            (first, moments) = (next, tail);
        }
    }

    /// Gives where the first of some siblings end that together are worth a task; `end` where they
    /// are all there are.
    fn end_of_task(&self, first: u32, end: u32) -> u32 {
        let tree = &self.exchange.hierarchy;
        let (mut middle, mut n_elements) = (first, 0);
        while middle < end && n_elements < MIN_TASK {
            let node = tree.node(middle);
            n_elements += node.elements.1 - node.elements.0;
            middle = node.end;
        }
        middle
    }

    /// Fills field and flux of a subtree.
    fn spread(&self, node: u32, below: Below<'_>) {
        let Below { local, mut field, flux } = below;
        let tree = &self.exchange.hierarchy;
        let grid = self.exchange.far.as_ref().and_then(|far| far.grids.get(node));
        let (mut own, mut rest) = split(local, grid.map_or(0, |grid| grid.len()));
        if let Some(far) = &self.exchange.far {
            let target = if grid.is_some() { &mut own } else { &mut field };
            self.add_partners(far, node, target);
            if let Some(grid) = grid {
                let from = own.each_ref().map(|v| &**v);
                let base = far.grids.start(node) + grid.len();
                for child in tree.children(node) {
                    if let Some(within) = far.grids.get(child) {
                        let at = far.grids.start(child) - base;
                        let mut to = rest.each_mut().map(|v| &mut v[at..at + within.len()]);
                        grid.spread_grid(within, &from, &mut to);
                    } else {
                        self.add_field(node, child, &from, &mut field);
                    }
                }
            }
        }
        self.add_near(node, flux);
        if tree.is_leaf(node) {
            self.add_field_at(tree.node(node).elements.0 as usize, &field, &mut flux[0]);
        } else {
            self.spread_siblings(node + 1, tree.node(node).end, Below { local: rest, field, flux });
        }
    }

    /// Spreads to siblings, nodes `first`…`end`, some side by side.
    fn spread_siblings(&self, first: u32, end: u32, below: Below<'_>) {
        let middle = self.end_of_task(first, end);
        if middle == end {
            return self.spread_each(first, end, below);
        }
        let (head, tail) = self.split_below(first, middle, below);
        rayon::join(
            || self.spread_each(first, middle, head),
            || self.spread_siblings(middle, end, tail),
        );
    }

    /// Spreads to siblings one after another.
    fn spread_each(&self, mut first: u32, end: u32, mut below: Below<'_>) {
        while first < end {
            let next = self.exchange.hierarchy.node(first).end;
            if next == end {
                return self.spread(first, below);
            }
            let (head, tail) = self.split_below(first, next, below);
            self.spread(first, head);
            (first, below) = (next, tail);
        }
    }

    /// Splits what is below siblings from `first` on, before the sibling `middle`.
    fn split_below<'m>(&self, first: u32, middle: u32, below: Below<'m>) -> (Below<'m>, Below<'m>) {
        let start = |node| self.exchange.hierarchy.node(node).elements.0;
        let n_elements = (start(middle) - start(first)) as usize;
        let (n_places, n_field) = match &self.exchange.far {
            Some(far) => (far.grids.start(middle) - far.grids.start(first), n_elements),
            None => (0, 0),
        };
        let (local, local_rest) = split(below.local, n_places);
        let (field, field_rest) = split(below.field, n_field);
        let (flux, flux_rest) = below.flux.split_at_mut(n_elements);
        let rest = Below { local: local_rest, field: field_rest, flux: flux_rest };
        (Below { local, field, flux }, rest)
    }

    /// Adds the fields of a node's partners.
    fn add_partners(&self, far: &Far, node: u32, field: &mut TripleMut<'_>) {
        let softening = self.exchange.kernel.regularisation();
        let to = self.places(far, node);
        for partner in far.lists.of_node(node) {
            let from = partner.node();
            let areas = far.areas[node as usize] + far.areas[from as usize];
            let sources = (self.places(far, from), self.vectors_of(far, from));
            translate(to, sources, softening * areas, partner.sign(), field);
        }
    }

    /// Adds a grid's field to the elements of a child without one; `field` is that of the node's
    /// elements.
    fn add_field(&self, node: u32, child: u32, local: &Triple<'_>, field: &mut TripleMut<'_>) {
        let tree = &self.exchange.hierarchy;
        let base = tree.node(node).elements.0 as usize;
        let Some(grid) = self.exchange.far.as_ref().and_then(|far| far.grids.get(node)) else {
            return;
        };
        let (first, end) = tree.node(child).elements;
        for i in first as usize..end as usize {
            let place = self.exchange.elements.position.each_ref().map(|v| v[i]);
            for (field, v) in field.iter_mut().zip(grid.field_at(place, local)) {
                field[i - base] += v;
            }
        }
    }

    /// Adds the flux that arrives at a node's elements one by one.
    fn add_near(&self, node: u32, flux: &mut [f64]) {
        let Exchange { elements, hierarchy, kernel, near, shares, .. } = self.exchange;
        let (ranges, shares) = (near.of_node(node), shares.of_node(node));
        if ranges.is_empty() && shares.is_empty() {
            return;
        }
        let (first, end) = hierarchy.node(node).elements;
        if end - first < MIN_TARGETS {
            for (flux, i) in flux.iter_mut().zip(first as usize..) {
                *flux += kernel.row(elements, i, ranges, self.b);
                *flux += kernel.row_of_shares(elements, i, shares, self.b);
            }
            return;
        }
        let targets = &elements.records[first as usize..end as usize];
        let mut sources = Sources::new();
        let whole = ranges.iter().map(|&span| (span, 1.0));
        let parts = shares.iter().map(|share| (share.elements, share.part()));
        for ((from, to), part) in whole.chain(parts) {
            let (mut from, to) = (from as usize, to as usize);
            if part == 1.0 && to - from >= MIN_IN_PLACE {
                let end = to - (to - from) % LANES;
                kernel.send(elements, from..end, self.b, (targets, flux));
                from = end;
            }
            for j in from..to {
                if sources.push(elements, j, part * self.b[j]) {
                    sources.send(kernel, targets, flux);
                }
            }
        }
        sources.send(kernel, targets, flux);
    }

    /// Adds what arrives at a leaf's element by grids, and what is beyond the exchange of middles.
    fn add_field_at(&self, i: usize, field: &TripleMut<'_>, flux: &mut f64) {
        let Exchange { elements, corrections, .. } = self.exchange;
        *flux += corrections.flux(i, self.b);
        if self.exchange.far.is_some() {
            let along = (0..3).map(|axis| elements.normal[axis][i] * field[axis][0]);
            *flux -= elements.area[i] * along.sum::<f64>();
        }
    }

    /// Gives the places of a node: those of its grid, else of its elements.
    fn places<'s>(&'s self, far: &'s Far, node: u32) -> Triple<'s> {
        self.part(far, node, &far.grids.places, &self.exchange.elements.position)
    }

    /// Gives the vectors at those places.
    fn vectors_of<'s>(&'s self, far: &'s Far, node: u32) -> Triple<'s> {
        self.part(far, node, &self.moments, &self.vectors)
    }

    fn part<'s>(
        &'s self,
        far: &'s Far,
        node: u32,
        of_grids: &'s [Vec<f64>; 3],
        of_elements: &'s [Vec<f64>; 3],
    ) -> Triple<'s> {
        if let Some(grid) = far.grids.get(node) {
            let start = far.grids.start(node);
            return of_grids.each_ref().map(|v| &v[start..start + grid.len()]);
        }
        let (first, end) = self.exchange.hierarchy.node(node).elements;
        of_elements.each_ref().map(|v| &v[first as usize..end as usize])
    }
}

fn zeros(n: usize) -> [Vec<f64>; 3] {
    [0, 1, 2].map(|_| vec![0.0; n])
}

fn all_mut(arrays: &mut [Vec<f64>; 3]) -> TripleMut<'_> {
    arrays.each_mut().map(Vec::as_mut_slice)
}

/// Splits all three arrays at one place.
fn split(arrays: TripleMut<'_>, at: usize) -> (TripleMut<'_>, TripleMut<'_>) {
    let [x, y, z] = arrays.map(|v| v.split_at_mut(at));
    ([x.0, y.0, z.0], [x.1, y.1, z.1])
}
