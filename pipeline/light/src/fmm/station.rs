//! What exchanges light as a whole: the elements of a node, or one of its grids.

use std::ops::Range;

use crate::fmm::grid::Grids;
use crate::hierarchy::Hierarchy;

/// A place in some unit of length, and what softens its exchange, in that unit squared.
pub(crate) type Place<T> = [T; 4];

/// A station for the elements of each node, before those for its grids, from fine to coarse. Their
/// places are the elements, and after all of these the places of the grids.
#[derive(Debug, Clone)]
pub(crate) struct Stations {
    nodes: Vec<u32>,
    /// Where the places of each start and end: a map has 32 bits for elements.
    places: Vec<(u32, u32)>,
}

/// What a station exchanges light with: another one, its number doubled, and 1 more where it is
/// seen with the sign turned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(crate) struct Partner(u32);

/// The most stations whose numbers can be doubled.
pub(crate) const MAX_STATIONS: u64 = 1 << 31;

impl Partner {
    pub(crate) fn new(station: u32, is_turned: bool) -> Partner {
        Partner(station << 1 | u32::from(is_turned))
    }

    /// Gives its station.
    #[inline]
    pub(crate) fn station(self) -> u32 {
        self.0 >> 1
    }

    /// Says whether the sign of what is exchanged with it is turned.
    pub(crate) fn is_turned(self) -> bool {
        self.0 & 1 == 1
    }

    /// Gives the sign of what is exchanged with it.
    #[inline]
    pub(crate) fn sign(self) -> f64 {
        if self.is_turned() { -1.0 } else { 1.0 }
    }
}

/// Gives the station of a node's elements.
#[inline]
pub(crate) fn of_elements(grids: &Grids, node: u32) -> u32 {
    node + grids.first(node)
}

impl Stations {
    /// Numbers those of all nodes.
    pub(crate) fn of(hierarchy: &Hierarchy, grids: &Grids) -> Stations {
        let mut all = Stations { nodes: Vec::new(), places: Vec::new() };
        for node in 0..hierarchy.n_nodes() {
            all.nodes.push(node);
            all.places.push(hierarchy.node(node).elements);
            for index in 0..grids.of_node(node).len() {
                let range = grids.range(node, index);
                let place = |at: usize| (hierarchy.n_elements() + at) as u32;
                all.nodes.push(node);
                all.places.push((place(range.start), place(range.end)));
            }
        }
        all
    }

    /// Counts them.
    pub(crate) fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Gives the node of a station.
    #[inline]
    pub(crate) fn node(&self, station: u32) -> u32 {
        self.nodes[station as usize]
    }

    /// Gives the places of a station.
    #[inline(always)]
    pub(crate) fn places(&self, station: u32) -> Range<usize> {
        let (first, end) = self.places[station as usize];
        first as usize..end as usize
    }

    /// Counts the bytes held.
    pub(crate) fn held_bytes(&self) -> usize {
        self.nodes.capacity() * size_of::<u32>() + self.places.capacity() * size_of::<(u32, u32)>()
    }
}
