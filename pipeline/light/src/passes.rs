//! The passes of an exchange: up the tree, and down again.
//!
//! Up, each grid gathers the vectors n_j A_j b_j of its elements. Down, each node adds to its own
//! field that of its partners, hands it to its children, and the leaves make flux of it and add
//! what they exchange one by one. A subtree's places and elements are ranges, so that subtrees are
//! computed side by side, each into its own part of the arrays. Several b are taken at once: the
//! exchange of two places is the same for all of them.

use std::array::from_fn;

use rayon::prelude::*;

use crate::element::Columns;
use crate::exchange::{Exchange, Far};
use crate::fmm::grid::{Between, Grid, Vectors};
use crate::fmm::station::{Place, of_elements};
use crate::fmm::translate::{self, Source, translate};
use crate::kernel::{Block, receive};
use crate::number::Number;
use crate::precision::power_below;

/// Elements that are worth a task of their own.
const MIN_TASK: u32 = 512;

/// What the passes read.
pub(crate) struct Passes<'a, T, const C: usize> {
    exchange: &'a Exchange,
    columns: &'a Columns<T>,
    places: &'a [Place<T>],
    unit: f64,
    b: [&'a [f64]; C],
    /// Powers of two by which b is divided, so that it fits any precision.
    scale: [f64; C],
    scaled: [Vec<T>; C],
    /// n_j A_j b_j of each element and what the grids have gathered; empty without grids.
    sources: Vec<Source<T, C>>,
}

/// What the way down writes for a subtree.
struct Below<'m, T, const C: usize> {
    /// The field at the places of its grids.
    local: &'m mut [Vectors<T, C>],
    /// The field at its elements.
    field: &'m mut [Vectors<T, C>],
    /// The flux that arrives at its elements.
    flux: &'m mut [[f64; C]],
}

/// What one thread works with.
struct Bench<T, const C: usize> {
    block: Block<T, C>,
    columns: translate::Columns<T, C>,
    between: Between<T, C>,
}

impl<T: Number, const C: usize> Bench<T, C> {
    fn new() -> Bench<T, C> {
        Bench {
            block: Block::default(),
            columns: translate::Columns::default(),
            between: Between::new(),
        }
    }
}

impl<'a, T: Number, const C: usize> Passes<'a, T, C> {
    /// Goes up. Columns and places are in a unit of length of so many of that of the elements.
    pub(crate) fn new(
        exchange: &'a Exchange,
        (columns, places, unit): (&'a Columns<T>, &'a [Place<T>], f64),
        b: [&'a [f64]; C],
    ) -> Passes<'a, T, C> {
        let largest = |b: &[f64]| b.iter().fold(0.0, |most: f64, b| most.max(b.abs()));
        let scale = b.map(|b| power_below(largest(b)));
        let scaled = from_fn(|c| b[c].par_iter().map(|b| T::of(b / scale[c])).collect());
        let sources = Vec::new();
        let mut passes = Passes { exchange, columns, places, unit, b, scale, scaled, sources };
        if let Some(far) = &exchange.far {
            let (of_elements, of_grids) = places.split_at(exchange.elements.len());
            let source = |(j, &place)| Source { place, vectors: passes.vectors_of(j) };
            let mut sources = Vec::with_capacity(places.len());
            sources.par_extend(of_elements.par_iter().enumerate().map(source));
            passes.sources = sources;
            let mut moments = vec![[[T::default(); 3]; C]; far.grids.n_places()];
            passes.gather(far, 0, &mut moments, &mut Between::new());
            let gathered = of_grids.par_iter().zip(moments);
            let source = |(&place, vectors)| Source { place, vectors };
            passes.sources.par_extend(gathered.map(source));
        }
        passes
    }

    /// Gives n A b of an element.
    fn vectors_of(&self, j: usize) -> Vectors<T, C> {
        let [.., u, v, w, area, _] = self.columns.record(j);
        self.scaled.each_ref().map(|b| [u, v, w].map(|n| n * (area * b[j])))
    }

    /// Gives the flux that arrives at each element.
    pub(crate) fn run(&self) -> [Vec<f64>; C] {
        let n_elements = self.exchange.elements.len();
        let nothing = [[T::default(); 3]; C];
        let far = self.exchange.far.as_ref();
        let mut flux = vec![[0.0; C]; n_elements];
        let mut local = vec![nothing; far.map_or(0, |far| far.grids.n_places())];
        let mut field = vec![nothing; if far.is_some() { n_elements } else { 0 }];
        if n_elements > 0 {
            let below = Below { local: &mut local, field: &mut field, flux: &mut flux };
            self.spread(0, below, &mut Bench::new());
        }
        from_fn(|channel| flux.par_iter().map(|flux| flux[channel]).collect())
    }

    /// Fills the moments of a subtree, the children before their parent.
    fn gather(
        &self,
        far: &Far,
        node: u32,
        moments: &mut [Vectors<T, C>],
        between: &mut Between<T, C>,
    ) {
        let tree = &self.exchange.hierarchy;
        let n_own = far.grids.start(node + 1) - far.grids.start(node);
        let (own, rest) = moments.split_at_mut(n_own);
        if !rest.is_empty() {
            self.gather_siblings(far, node + 1, tree.node(node).end, rest);
        }
        let (mut finer, mut above) = (None, own);
        for grid in far.grids.of_node(node) {
            let (to, next) = above.split_at_mut(grid.len());
            match finer {
                None if grid.is_full() => {
                    for child in tree.children(node) {
                        let at = far.grids.start(child) - far.grids.start(node) - n_own;
                        match far.grids.full(child) {
                            Some(within) => {
                                grid.gather_grid(within, &rest[at..at + within.len()], to, between);
                            }
                            None => self.gather_elements(grid, child, to),
                        }
                    }
                }
                None => self.gather_elements(grid, node, to),
                Some((within, from)) => grid.gather_grid(within, from, to, between),
            }
            (finer, above) = (Some((grid, &*to)), next);
        }
    }
    /// Gathers what a node's elements send.
    fn gather_elements(&self, grid: &Grid, node: u32, moments: &mut [Vectors<T, C>]) {
        let (first, end) = self.exchange.hierarchy.node(node).elements;
        for j in first as usize..end as usize {
            grid.gather(self.position(j), &self.sources[j].vectors, moments);
        }
    }

    fn position(&self, j: usize) -> [f64; 3] {
        let [x, y, z, ..] = &self.exchange.elements.columns.0;
        [x[j], y[j], z[j]]
    }

    /// Gathers siblings, nodes `first`…`end`, some side by side.
    fn gather_siblings(&self, far: &Far, first: u32, end: u32, moments: &mut [Vectors<T, C>]) {
        let middle = self.end_of_task(first, end);
        if middle == end {
            return self.gather_each(far, first, end, moments);
        }
        let (head, tail) = moments.split_at_mut(far.grids.start(middle) - far.grids.start(first));
        rayon::join(
            || self.gather_each(far, first, middle, head),
            || self.gather_siblings(far, middle, end, tail),
        );
    }

    /// Gathers siblings one after another.
    fn gather_each(&self, far: &Far, mut first: u32, end: u32, mut moments: &mut [Vectors<T, C>]) {
        let mut between = Between::new();
        while first < end {
            let next = self.exchange.hierarchy.node(first).end;
            let n_places = far.grids.start(next) - far.grids.start(first);
            let (head, tail) = moments.split_at_mut(n_places);
            self.gather(far, first, head, &mut between);
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
    fn spread(&self, node: u32, below: Below<'_, T, C>, bench: &mut Bench<T, C>) {
        let Below { local, field, flux } = below;
        let tree = &self.exchange.hierarchy;
        let first = tree.node(node).elements.0 as usize;
        let mut rest = local;
        if let Some(far) = &self.exchange.far {
            let n_own = far.grids.start(node + 1) - far.grids.start(node);
            let (own, below) = rest.split_at_mut(n_own);
            self.add_partners(far, node, own, field, bench);
            self.hand_down(far, node, own, (&mut *below, &mut *field), bench);
            rest = below;
        }
        self.add_near(node, flux, bench);
        if tree.is_leaf(node) {
            self.finish(first, field, &mut flux[0]);
        } else {
            let below = Below { local: rest, field, flux };
            self.spread_siblings(node + 1, tree.node(node).end, below, bench);
        }
    }

    /// Spreads to siblings, nodes `first`…`end`, some side by side.
    fn spread_siblings(
        &self,
        first: u32,
        end: u32,
        below: Below<'_, T, C>,
        bench: &mut Bench<T, C>,
    ) {
        let middle = self.end_of_task(first, end);
        if middle == end {
            return self.spread_each(first, end, below, bench);
        }
        let (head, tail) = self.split_below(first, middle, below);
        rayon::join(
            || self.spread_each(first, middle, head, bench),
            || self.spread_siblings(middle, end, tail, &mut Bench::new()),
        );
    }

    /// Spreads to siblings one after another.
    fn spread_each(
        &self,
        mut first: u32,
        end: u32,
        mut below: Below<'_, T, C>,
        bench: &mut Bench<T, C>,
    ) {
        while first < end {
            let next = self.exchange.hierarchy.node(first).end;
            if next == end {
                return self.spread(first, below, bench);
            }
            let (head, tail) = self.split_below(first, next, below);
            self.spread(first, head, bench);
            (first, below) = (next, tail);
        }
    }

    /// Splits what is below siblings from `first` on, before the sibling `middle`.
    fn split_below<'m>(
        &self,
        first: u32,
        middle: u32,
        below: Below<'m, T, C>,
    ) -> (Below<'m, T, C>, Below<'m, T, C>) {
        let start = |node| self.exchange.hierarchy.node(node).elements.0;
        let n_elements = (start(middle) - start(first)) as usize;
        let (n_places, n_field) = match &self.exchange.far {
            Some(far) => (far.grids.start(middle) - far.grids.start(first), n_elements),
            None => (0, 0),
        };
        let (local, local_rest) = below.local.split_at_mut(n_places);
        let (field, field_rest) = below.field.split_at_mut(n_field);
        let (flux, flux_rest) = below.flux.split_at_mut(n_elements);
        let rest = Below { local: local_rest, field: field_rest, flux: flux_rest };
        (Below { local, field, flux }, rest)
    }

    /// Adds to a node's stations the fields of their partners.
    fn add_partners(
        &self,
        far: &Far,
        node: u32,
        mut own: &mut [Vectors<T, C>],
        field: &mut [Vectors<T, C>],
        bench: &mut Bench<T, C>,
    ) {
        let first = of_elements(&far.grids, node);
        let mut add = |station: u32, to: &mut [Vectors<T, C>]| {
            let partners = (far.lists.of_node(station), far.parts.of_node(station));
            if !(partners.0.is_empty() && partners.1.is_empty()) {
                let targets = &self.places[far.stations.places(station)];
                let columns = &mut bench.columns;
                translate((&far.stations, partners), &self.sources, columns, targets, to);
            }
        };
        add(first, field);
        for (station, grid) in (first + 1..).zip(far.grids.of_node(node)) {
            let (to, next) = own.split_at_mut(grid.len());
            add(station, to);
            own = next;
        }
    }

    /// Hands the field of a node's grids down, from coarse to fine, and on to what is below it: the
    /// places of grids, and the field at elements.
    fn hand_down(
        &self,
        far: &Far,
        node: u32,
        own: &mut [Vectors<T, C>],
        (below, field): (&mut [Vectors<T, C>], &mut [Vectors<T, C>]),
        bench: &mut Bench<T, C>,
    ) {
        let tree = &self.exchange.hierarchy;
        let grids = far.grids.of_node(node);
        let mut at = own.len();
        for pair in grids.windows(2).rev() {
            let [fine, coarse] = pair else { unreachable!("windows of two") };
            let (finer, from) = own[..at].split_at_mut(at - coarse.len());
            at -= coarse.len();
            coarse.spread_grid(fine, from, &mut finer[at - fine.len()..], &mut bench.between);
        }
        let Some(grid) = grids.first() else { return };
        let from = &own[..grid.len()];
        if !grid.is_full() {
            return self.spread_to_elements(grid, (node, node), from, field);
        }
        let base = far.grids.start(node) + own.len();
        for child in tree.children(node) {
            match far.grids.full(child) {
                Some(within) => {
                    let at = far.grids.start(child) - base;
                    let to = &mut below[at..at + within.len()];
                    grid.spread_grid(within, from, to, &mut bench.between);
                }
                None => self.spread_to_elements(grid, (node, child), from, field),
            }
        }
    }

    /// Adds a grid's field to the elements of a child; `field` is that of the node's elements.
    fn spread_to_elements(
        &self,
        grid: &Grid,
        (node, child): (u32, u32),
        local: &[Vectors<T, C>],
        field: &mut [Vectors<T, C>],
    ) {
        let tree = &self.exchange.hierarchy;
        let base = tree.node(node).elements.0 as usize;
        let (first, end) = tree.node(child).elements;
        for i in first as usize..end as usize {
            grid.spread(self.position(i), local, &mut field[i - base]);
        }
    }

    /// Adds the flux that arrives at a node's elements one by one.
    fn add_near(&self, node: u32, flux: &mut [[f64; C]], bench: &mut Bench<T, C>) {
        let Exchange { hierarchy, kernel, near, near_parts, .. } = self.exchange;
        let from = (near.of_node(node), near_parts.of_node(node));
        if !(from.0.is_empty() && from.1.is_empty()) {
            let first = hierarchy.node(node).elements.0 as usize;
            let b = self.scaled.each_ref().map(|b| &b[..]);
            let c = T::of(kernel.regularisation());
            receive(c, self.columns, &b, from, &mut bench.block, first, flux);
        }
    }

    /// Makes flux of what has arrived at a leaf's element, in units of the elements, and adds what
    /// is beyond the exchange of middles.
    fn finish(&self, i: usize, field: &[Vectors<T, C>], flux: &mut [f64; C]) {
        let [.., u, v, w, area, _] = self.columns.record(i);
        for (channel, flux) in flux.iter_mut().enumerate() {
            if let Some(field) = field.first() {
                let [x, y, z] = field[channel];
                *flux -= (area * (u * x + v * y + w * z)).wide();
            }
            *flux *= self.scale[channel] * self.unit * self.unit;
            *flux += self.exchange.corrections.flux(i, self.b[channel]);
        }
    }
}
