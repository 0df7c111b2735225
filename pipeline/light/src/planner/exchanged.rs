//! What surfels send each other: how exactly, by which lists, at which cost.

use std::f64::consts::PI;
use std::sync::Arc;

use rayon::prelude::*;

use crate::error::LightError;
use crate::exchange::Exchange;
use crate::hierarchy::{Hierarchy, Links};
use crate::kernel::Kernel;
use crate::lighting::Lighting;
use crate::material::Channel;
use crate::near_field::Correction;
use crate::sum::sum;

use super::Call;
use super::shining::Shining;

/// What grids of each order err by, at the most of all surfels of a furnished room, as shares of
/// the largest flux: measured, `examples/speed.rs`, and rounded up.
const ORDER_ERRORS: [f64; 8] = [f64::NAN, 0.5, 4e-2, 4e-3, 8e-4, 6e-5, 6e-6, 1e-6];
/// What grids of order 1 err by in all, as a share of what is exchanged. Source:
/// catalogue/light.md §2, end to end against the direct sum.
const FIRST_ORDER: f64 = 0.18;
/// How many times the mean of reflected light elements next to each other have, at the most: it is
/// smooth.
const UNEVEN: f64 = 4.0;
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
    /// Calls for quadrature by what it changes: of the light that shines first what it does, and of
    /// all that is reflected then no more than at the element whose exchange it changes most, nor
    /// than if the elements that it changes had [`UNEVEN`] times their part of that light.
    pub(super) fn call_near_field(&self, near: &[Correction], shining: &Shining) -> Call {
        let Some(Correction { elements: [i, j], .. }) = near.first() else {
            return Call::off("no linked pair is nearer than 3 radii and exchanges much");
        };
        let n = near.len();
        let mut changed = vec![0.0; self.elements.len()];
        for &Correction { elements, exchange } in near {
            elements.iter().for_each(|&id| changed[id as usize] += exchange.abs());
        }
        let rows = || changed.iter().enumerate().filter(|row| *row.1 > 0.0);
        let first = sum(rows().map(|(id, by)| by * self.first_exitance(id, shining)));
        let areas = self.elements.areas();
        let most = rows().map(|(id, by)| by / areas[id]).fold(0.0, f64::max);
        let part = UNEVEN * sum(rows().map(|(_, by)| *by)) / sum(areas.iter().copied());
        let reflected = if shining.growth > 1.0 { most.min(part) * shining.growth } else { 0.0 };
        // What mirrors and lenses gather may all arrive where most is changed.
        let gathered = match shining.all_thrown() {
            0.0 => 0.0,
            flux => flux * self.max_albedo() * shining.growth,
        };
        let what = format!("{n} pairs nearer than 3 radii, as {i} and {j}");
        Call::on(what, shining.lasting(first + gathered * most) + reflected)
            .if_worth(self.options.worth)
            .costing(QUADRATURE * n as f64 * PAIR_SECONDS)
    }

    /// Gives what an element emits and reflects of the light of lamps and sky, were nothing in
    /// between: flux an area, the three channels together.
    fn first_exitance(&self, id: usize, shining: &Shining) -> f64 {
        let sky = self.sky.map_or([0.0; 3], |sky| sky.radiance);
        let channels = self.materials.channels.iter().enumerate();
        let of_channel = |(index, channel): (usize, &Channel)| {
            let arriving = shining.from_lamps[index][id] + PI * sky[index];
            channel.emission[id] + channel.albedo[id] * arriving
        };
        channels.map(of_channel).sum()
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
        let call = Call::on(evidence, FIRST_ORDER * shining.growth);
        (Call { is_on: order > 1, ..call }, Some(order))
    }

    /// Makes the exchange, with pairs that are taken by quadrature.
    pub(super) fn exchange(
        &self,
        hierarchy: &Hierarchy,
        order: Option<usize>,
        near: &[Correction],
    ) -> Result<Exchange, LightError> {
        let (limit_bytes, need_bytes) = (self.options.memory_bytes, self.held_bytes(hierarchy));
        let left = limit_bytes.checked_sub(need_bytes);
        let bytes = left.ok_or(LightError::Memory { limit_bytes, need_bytes })?;
        let spill = self.options.spill_folder.as_deref().map(|folder| (bytes, folder));
        let (elements, kernel) = (Arc::clone(&self.elements), Kernel::default());
        let links = self.map.view();
        let made = Exchange::within(elements, hierarchy.clone(), links, kernel, (order, spill))?;
        Ok(if near.is_empty() { made } else { made.with_near_field(near) })
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
