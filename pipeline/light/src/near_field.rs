//! Pairs of elements so near that their middles do not stand for them.

use std::f64::consts::PI;

use rayon::prelude::*;

use crate::element::{Element, Elements};
use crate::error::LightError;
use crate::fmm::bounds::Bounds;
use crate::hierarchy::{Hierarchy, Links};
use crate::kernel::Kernel;
use crate::vector::{add, beside, norm, scale, sub};

/// Linked pairs nearer than so many radii of the larger one are near.
const NEAR_RADII: f64 = 3.0;
/// Places along a side of an element in the quadrature.
const PLACES: usize = 3;

/// How much more two elements exchange than their middles say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Correction {
    pub(crate) elements: [u32; 2],
    pub(crate) exchange: f64,
}

/// Corrections by element, both ways.
#[derive(Debug, Clone, Default)]
pub(crate) struct Corrections {
    starts: Vec<usize>,
    entries: Vec<(u32, f64)>,
}

/// Finds the linked pairs that are near and exchange more than `share` of the smaller one's area,
/// the lower element first, in the order of the links.
pub(crate) fn near_pairs(
    elements: &Elements,
    hierarchy: &Hierarchy,
    links: &(impl Links + ?Sized),
    kernel: Kernel,
    share: f64,
) -> Result<Vec<[u32; 2]>, LightError> {
    let bounds = Bounds::of_all(elements, hierarchy);
    let walk = Walk { elements, hierarchy, bounds: &bounds, kernel, share };
    let block = |index| {
        let mut pairs = Vec::new();
        for (a, b) in links.block(index)? {
            hierarchy.check_link((a, b))?;
            walk.descend(a, b, &mut pairs);
        }
        Ok::<_, LightError>(pairs)
    };
    let blocks = (0..links.n_blocks()).into_par_iter().map(block);
    Ok(blocks.collect::<Result<Vec<_>, _>>()?.concat())
}

struct Walk<'a> {
    elements: &'a Elements,
    hierarchy: &'a Hierarchy,
    bounds: &'a [Bounds],
    kernel: Kernel,
    share: f64,
}

impl Walk<'_> {
    fn descend(&self, a: u32, b: u32, pairs: &mut Vec<[u32; 2]>) {
        let (of_a, of_b) = (&self.bounds[a as usize], &self.bounds[b as usize]);
        if of_a.is_empty() || of_b.is_empty() {
            return;
        }
        let largest = |of: &Bounds| of.area().0 + of.area().1;
        if !is_near(of_a.distance2(of_b), largest(of_a).max(largest(of_b))) {
            return;
        }
        let is_leaf = [a, b].map(|node| self.hierarchy.is_leaf(node));
        match is_leaf {
            [true, true] => self.leaves(a, b, pairs),
            [false, _] if is_leaf[1] || of_a.half_width() >= of_b.half_width() => {
                self.hierarchy.children(a).for_each(|child| self.descend(child, b, pairs));
            }
            _ => self.hierarchy.children(b).for_each(|child| self.descend(a, child, pairs)),
        }
    }

    fn leaves(&self, a: u32, b: u32, pairs: &mut Vec<[u32; 2]>) {
        let [i, j] = [a, b].map(|node| self.hierarchy.node(node).elements.0);
        let [at_i, at_j] = [i, j].map(|id| self.elements.get(id as usize));
        let apart = norm(sub(at_i.position, at_j.position));
        let exchange = self.kernel.exchange(self.elements, i as usize, j as usize);
        let is_much = exchange > self.share * at_i.area.min(at_j.area);
        if is_near(apart * apart, at_i.area.max(at_j.area)) && is_much {
            pairs.push([i.min(j), i.max(j)]);
        }
    }
}

fn is_near(distance2: f64, area: f64) -> bool {
    distance2 < NEAR_RADII * NEAR_RADII * area / PI
}

/// Computes what near pairs exchange by quadrature: squares of the elements' areas, three by three
/// pieces each, as far beyond what their middles say.
pub(crate) fn corrections(
    elements: &Elements,
    kernel: Kernel,
    pairs: &[[u32; 2]],
) -> Result<Vec<Correction>, LightError> {
    let one = |&[i, j]: &[u32; 2]| {
        let [a, b] = [i, j].map(|id| elements.get(id as usize));
        let pieces = Elements::new(pieces(&a).chain(pieces(&b)))?;
        let n = PLACES * PLACES;
        let rows = (0..n).flat_map(|k| (n..2 * n).map(move |l| (k, l)));
        let fine: f64 = rows.map(|(k, l)| kernel.exchange(&pieces, k, l)).sum();
        let coarse = kernel.exchange(elements, i as usize, j as usize);
        Ok(Correction { elements: [i, j], exchange: fine.min(a.area.min(b.area)) - coarse })
    };
    pairs.par_iter().map(one).collect()
}

/// Cuts an element's square into pieces, left and right of its middle alike.
fn pieces(element: &Element) -> impl Iterator<Item = Element> + use<> {
    let (element, side) = (*element, element.area.sqrt() / PLACES as f64);
    let [u, v] = beside(element.normal);
    let places = (0..PLACES).flat_map(|a| (0..PLACES).map(move |b| (a, b)));
    places.map(move |(a, b)| {
        let off = |k: usize| (k as f64 - (PLACES - 1) as f64 / 2.0) * side;
        let moved = add(scale(u, off(a)), scale(v, off(b)));
        Element { position: add(element.position, moved), area: side * side, ..element }
    })
}

impl Corrections {
    /// Sorts corrections by element, both ways.
    pub(crate) fn of(n_elements: usize, all: &[Correction]) -> Corrections {
        let mut rows: Vec<(u32, u32, f64)> = Vec::with_capacity(2 * all.len());
        for &Correction { elements: [i, j], exchange } in all {
            rows.extend([(i, j, exchange), (j, i, exchange)]);
        }
        rows.sort_unstable_by_key(|&(i, j, _)| (i, j));
        let starts = (0..=n_elements).map(|id| rows.partition_point(|row| (row.0 as usize) < id));
        let starts = starts.collect();
        Corrections { starts, entries: rows.into_iter().map(|(_, j, by)| (j, by)).collect() }
    }

    /// Sums what an element gets beyond the exchange of middles.
    pub(crate) fn flux(&self, element: usize, b: &[f64]) -> f64 {
        let Some(range) = self.starts.get(element..element + 2) else { return 0.0 };
        self.entries[range[0]..range[1]].iter().map(|&(j, by)| by * b[j as usize]).sum()
    }

    /// Counts the pairs.
    pub(crate) fn n_pairs(&self) -> u64 {
        self.entries.len() as u64 / 2
    }

    pub(crate) fn held_bytes(&self) -> usize {
        self.starts.capacity() * size_of::<usize>()
            + self.entries.capacity() * size_of::<(u32, f64)>()
    }
}
