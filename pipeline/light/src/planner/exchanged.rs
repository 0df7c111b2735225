//! What surfels send each other: how exactly, by which lists, at which cost.

use std::sync::Arc;

use rayon::prelude::*;

use crate::error::LightError;
use crate::exchange::Exchange;
use crate::hierarchy::{Hierarchy, Links};
use crate::kernel::Kernel;
use crate::lighting::Lighting;

use super::Call;
use super::shining::Shining;

/// What grids of each order err by, at the most of all surfels of a furnished room, as shares of
/// the largest flux: measured, `examples/speed.rs`, and rounded up.
const ORDER_ERRORS: [f64; 8] = [f64::NAN, 0.5, 4e-2, 4e-3, 8e-4, 6e-5, 6e-6, 1e-6];
/// Processor seconds of a pair of elements, and of one between a place of a grid and another,
/// roughly: for costs that are said beforehand.
const PAIR_SECONDS: f64 = 1.5e-9;
/// Pairs of pieces of a pair that is taken by quadrature.
const QUADRATURE: f64 = 81.0;
/// Lists of grids cost as much as so many applications, roughly.
pub(super) const MAKING: f64 = 2.0;
/// Bytes held for an element, a node and a pair with a visible fraction, at the most: numbers in
/// both precisions, materials and incident light, what passes and solver hold of three channels.
const ELEMENT_BYTES: u64 = 128 + 12 * 8 + 3 * (8 + 24 + 24 + 8) + 3 * 6 * 8;
const NODE_BYTES: u64 = 24 + 128 + 72 + 20 + 160;
const FRACTION_BYTES: u64 = 12 + 2 * 16 + 2 * 12;

impl Lighting<'_> {
    pub(super) fn call_near_field(&self, near: &[[u32; 2]], shining: &Shining) -> Call {
        let Some([i, j]) = near.first() else {
            return Call::off("no linked pair is nearer than 3 radii and exchanges much");
        };
        let n = near.len();
        // The middles of a pair may be wrong by all that it exchanges; none sends more than the
        // brightest, but for what mirrors and lenses gather.
        let kernel = Kernel::default();
        let mut shares = vec![0.0; self.elements.len()];
        let mut all = 0.0;
        for ids in near {
            let [i, j] = ids.map(|id| id as usize);
            let exchanged = kernel.exchange(&self.elements, i, j);
            all += exchanged;
            [i, j].into_iter().for_each(|id| shares[id] += exchanged / self.elements.areas()[id]);
        }
        let gathered = match shining.all_thrown() {
            0.0 => 0.0,
            flux => flux * self.max_albedo() * shining.growth,
        };
        let most = shares.into_iter().fold(0.0, f64::max);
        let flux = 3.0 * 2.0 * all * shining.most * shining.growth + gathered * most;
        let what = format!("{n} pairs nearer than 3 radii, as {i} and {j}");
        Call::on(what, shining.lasting(flux))
            .if_worth(self.options.worth)
            .costing(QUADRATURE * n as f64 * PAIR_SECONDS)
    }

    pub(super) fn call_order(&self, exchanges: bool, shining: &Shining) -> (Call, Option<usize>) {
        if !exchanges {
            return (Call::off("no light is exchanged"), None);
        }
        let wanted = self.operator_tolerance();
        if self.options.is_direct {
            return (Call::off("pairs are taken one by one"), None);
        }
        let chosen = (1..ORDER_ERRORS.len() - 1).find(|&p| ORDER_ERRORS[p] <= wanted);
        let order = self.options.order.or(chosen).unwrap_or(ORDER_ERRORS.len() - 1);
        let usual = ORDER_ERRORS[order];
        let evidence = format!("p = {order}: exchange to {wanted:.0e} wanted, usual {usual:.0e}");
        // What the exchange is off by grows from bounce to bounce.
        let call = Call::on(evidence, ORDER_ERRORS[1] * shining.growth);
        (Call { is_on: order > 1, ..call }, Some(order))
    }

    /// Makes the exchange, with pairs that are taken by quadrature.
    pub(super) fn exchange(
        &self,
        hierarchy: &Hierarchy,
        order: Option<usize>,
        near: &[[u32; 2]],
    ) -> Result<Exchange, LightError> {
        let (limit_bytes, need_bytes) = (self.options.memory_bytes, self.held_bytes(hierarchy));
        let left = limit_bytes.checked_sub(need_bytes);
        let bytes = left.ok_or(LightError::Memory { limit_bytes, need_bytes })?;
        let spill = self.options.spill_folder.as_deref().map(|folder| (bytes, folder));
        let (elements, kernel) = (Arc::clone(&self.elements), Kernel::default());
        let links = self.map.view();
        let made = Exchange::within(elements, hierarchy.clone(), links, kernel, (order, spill))?;
        if near.is_empty() { Ok(made) } else { made.with_near_field(near) }
    }

    /// Gives the bytes that are held beside the lists of the exchange: elements, materials, what a
    /// solution iterates with, nodes with their bounds and grids, and fractions.
    fn held_bytes(&self, hierarchy: &Hierarchy) -> u64 {
        let n_fractions = self.map.view().summary().n_fractions;
        let (n_elements, n_nodes) = (self.elements.len() as u64, u64::from(hierarchy.n_nodes()));
        ELEMENT_BYTES * n_elements + NODE_BYTES * n_nodes + FRACTION_BYTES * n_fractions
    }

    /// Gives some elements, evenly spread over all.
    pub(crate) fn some(&self, n: usize) -> Vec<u32> {
        let all = self.elements.len();
        let n = n.min(all);
        (0..n).map(|k| (k as u64 * all as u64 / n as u64) as u32).collect()
    }
}

/// Finds the first link that joins one of some elements with one of others.
pub(super) fn first_link(
    links: &(impl Links + ?Sized),
    hierarchy: &Hierarchy,
    some: &[bool],
    others: &[bool],
) -> Result<Option<(u32, u32)>, LightError> {
    let [some, others] = [some, others].map(|which| {
        let counts = std::iter::once(0).chain(which.iter().scan(0u32, |n, &is_one| {
            *n += u32::from(is_one);
            Some(*n)
        }));
        counts.collect::<Vec<u32>>()
    });
    let has = |counts: &[u32], node: u32| {
        let (first, end) = hierarchy.node(node).elements;
        counts[end as usize] > counts[first as usize]
    };
    let joins =
        |&(a, b): &(u32, u32)| has(&some, a) && has(&others, b) || has(&some, b) && has(&others, a);
    let of_block = |index| match links.block(index) {
        Ok(pairs) => pairs.into_iter().find(joins).map(Ok),
        Err(e) => Some(Err(e)),
    };
    let found = (0..links.n_blocks()).into_par_iter().find_map_first(of_block).transpose()?;
    match found {
        Some(link) => Ok(Some(link)),
        None => {
            let partly = links.fractions()?.into_iter().map(|fraction| (fraction.a, fraction.b));
            Ok(partly.into_iter().find(joins))
        }
    }
}

/// Gives the processor seconds of one application, roughly.
pub(super) fn application_seconds(exchange: &Exchange) -> f64 {
    let stats = exchange.stats();
    (stats.n_near_pairs + stats.n_far_pairs) as f64 * PAIR_SECONDS
}
