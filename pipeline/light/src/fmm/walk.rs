//! Which pairs of nodes exchange light as wholes, and which element by element.

use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use crate::error::LightError;
use crate::fmm::bounds::Bounds;
use crate::fmm::grid::Grids;
use crate::fmm::station::{self, Partner};
use crate::hierarchy::{Hierarchy, Links, Span};

/// Blocks of links whose pairs are held at once where not all are.
const BLOCKS_AT_ONCE: u64 = 16;
/// Elements of a node that are taken one by one at the most; there are more under some that have no
/// full grid, and parts of them face another node or do not.
const MAX_NEAR: u32 = 12;

/// Pairs, each once, that hold every pair of elements under the links exactly once.
#[derive(Debug, Default)]
pub(crate) struct Pairs {
    /// Nodes to be taken element by element.
    near: Vec<(u32, u32)>,
    /// Stations to be taken as wholes.
    far: Vec<(u32, Partner)>,
}

impl Pairs {
    /// Walks the elements of near nodes that either end sees.
    pub(crate) fn near<'p>(
        &'p self,
        tree: &'p Hierarchy,
    ) -> impl Iterator<Item = (u32, Span)> + 'p {
        let elements = |node| tree.node(node).elements;
        self.near.iter().flat_map(move |&(a, b)| [(a, elements(b)), (b, elements(a))])
    }

    /// Walks the partner of either end of far pairs.
    pub(crate) fn far(&self) -> impl Iterator<Item = (u32, Partner)> + '_ {
        let both =
            |&(a, b): &(u32, Partner)| [(a, b), (b.station(), Partner::new(a, b.is_turned()))];
        self.far.iter().flat_map(both)
    }

    /// Counts the bytes of pairs, and of their lists at both ends.
    fn bytes(&self) -> u64 {
        let near = size_of::<(u32, u32)>() + 2 * size_of::<Span>();
        let far = size_of::<(u32, Partner)>() + 2 * size_of::<Partner>();
        (self.near.len() * near + self.far.len() * far) as u64
    }
}

/// What decides it.
pub(crate) struct Walk<'a> {
    pub(crate) hierarchy: &'a Hierarchy,
    pub(crate) bounds: &'a [Bounds],
    pub(crate) grids: &'a Grids,
    pub(crate) regularisation: f64,
    /// What the grids may err by.
    pub(crate) error: f64,
    /// Whether everything under a link faces each other.
    pub(crate) all_face: bool,
}

/// What becomes of a pair.
enum Verdict {
    Nothing,
    Near,
    Far(u32, Partner),
    Split,
}

impl Walk<'_> {
    /// Finds all pairs, by block of links, if they and the lists that are made of them take no more
    /// than so many bytes.
    pub(crate) fn all(
        &self,
        links: &(impl Links + ?Sized),
        limit_bytes: u64,
    ) -> Result<Option<Vec<Pairs>>, LightError> {
        let held = AtomicU64::new(0);
        let block = |index| {
            // Nothing is found any more once there is no room.
            if held.load(Ordering::Relaxed) > limit_bytes {
                return Ok(Pairs::default());
            }
            let pairs = self.block(links, index)?;
            held.fetch_add(pairs.bytes(), Ordering::Relaxed);
            Ok(pairs)
        };
        let found = (0..links.n_blocks()).into_par_iter().map(block);
        let found = found.collect::<Result<Vec<Pairs>, LightError>>()?;
        Ok((held.into_inner() <= limit_bytes).then_some(found))
    }

    /// Hands on the pairs of all blocks in their order, holding those of few.
    pub(crate) fn each(
        &self,
        links: &(impl Links + ?Sized),
        mut take: impl FnMut(&Pairs),
    ) -> Result<(), LightError> {
        let n_blocks = links.n_blocks();
        for first in (0..n_blocks).step_by(BLOCKS_AT_ONCE as usize) {
            let some = first..n_blocks.min(first + BLOCKS_AT_ONCE);
            let found = some.into_par_iter().map(|index| self.block(links, index));
            found.collect::<Result<Vec<Pairs>, LightError>>()?.iter().for_each(&mut take);
        }
        Ok(())
    }

    /// Gives the pairs that two nodes make.
    pub(crate) fn pairs(&self, (a, b): (u32, u32)) -> Result<Pairs, LightError> {
        let mut pairs = Pairs::default();
        self.hierarchy.check_link((a, b))?;
        self.descend(a, b, &mut pairs);
        Ok(pairs)
    }

    fn block(&self, links: &(impl Links + ?Sized), index: u64) -> Result<Pairs, LightError> {
        let mut pairs = Pairs::default();
        for (a, b) in links.block(index)? {
            self.hierarchy.check_link((a, b))?;
            self.descend(a, b, &mut pairs);
        }
        Ok(pairs)
    }

    fn descend(&self, a: u32, b: u32, pairs: &mut Pairs) {
        match self.verdict(a, b) {
            Verdict::Nothing => {}
            Verdict::Near => pairs.near.push((a, b)),
            Verdict::Far(station, partner) => pairs.far.push((station, partner)),
            Verdict::Split if self.splits_first(a, b) => {
                self.hierarchy.children(a).for_each(|child| self.descend(child, b, pairs));
            }
            Verdict::Split => {
                self.hierarchy.children(b).for_each(|child| self.descend(a, child, pairs));
            }
        }
    }

    fn verdict(&self, a: u32, b: u32) -> Verdict {
        if self.bounds[a as usize].is_empty() || self.bounds[b as usize].is_empty() {
            return Verdict::Nothing;
        }
        match self.as_wholes(a, b) {
            Some(verdict) => verdict,
            None if self.is_open(a) || self.is_open(b) => Verdict::Split,
            None => Verdict::Near,
        }
    }

    /// Says what becomes of a pair without looking into it, where that is known and of use.
    fn as_wholes(&self, a: u32, b: u32) -> Option<Verdict> {
        if self.grids.of_node(a).is_empty() && self.grids.of_node(b).is_empty() {
            return None;
        }
        let (of_a, of_b) = (&self.bounds[a as usize], &self.bounds[b as usize]);
        let distance2 = of_a.distance2(of_b);
        let here = self.station(a, of_b)?;
        let there = self.station(b, of_a)?;
        let elements = |node| station::of_elements(self.grids, node);
        if (here, there) == (elements(a), elements(b)) || !self.is_even(of_a, of_b, distance2) {
            return None;
        }
        match (self.side(of_a, of_b, distance2), self.side(of_b, of_a, distance2)) {
            (Side::Dark, _) | (_, Side::Dark) => Some(Verdict::Nothing),
            (Side::Lit { is_turned: first }, Side::Lit { is_turned: second }) => {
                Some(Verdict::Far(here, Partner::new(there, first != second)))
            }
            _ => None,
        }
    }

    /// Gives the station that stands for a node in another's exchange with it: its coarsest grid
    /// whose centre is far enough from the other's box, or its elements; none where these are so
    /// many that the node is to be split.
    fn station(&self, node: u32, other: &Bounds) -> Option<u32> {
        let (elements, grids) = (station::of_elements(self.grids, node), self.grids.of_node(node));
        let around = &self.bounds[node as usize];
        let (half, distance2) = (around.half_width(), other.distance2_from(around.centre()));
        let is_clear = |separation: f64| distance2 >= (separation * half) * (separation * half);
        match grids.iter().rposition(|grid| is_clear(grid.separation())) {
            // A node has seven at the most.
            Some(index) => Some(elements + 1 + index as u32),
            None if self.grids.full(node).is_some() => None,
            None => Some(elements),
        }
    }

    /// Says whether what keeps near elements bounded is as good as the same for all pairs.
    fn is_even(&self, a: &Bounds, b: &Bounds, distance2: f64) -> bool {
        let ((area_a, off_a), (area_b, off_b)) = (a.area(), b.area());
        // π r² + c (A_i + A_j) is then off by no more than what order p errs by.
        let off = self.regularisation * (off_a + off_b);
        // The exchange of no pair exceeds the area of one of its elements.
        let is_wide = (area_a + off_a).max(area_b + off_b) <= PI * distance2;
        distance2 > 0.0 && is_wide && off <= PI * distance2 * self.error
    }

    /// Says with which side the elements of a node face another. Those that look no farther over
    /// their horizon, or below it, than what grids may err by count as not doing so.
    fn side(&self, node: &Bounds, other: &Bounds, distance2: f64) -> Side {
        if self.all_face && node.is_one_sided() {
            return Side::Lit { is_turned: false };
        }
        let (lowest, highest) = node.heights(other);
        // Of what comes from all around, directions whose cosine is less than ε bring ε².
        let slack = (0.5 * self.error * distance2).sqrt();
        if lowest > -slack {
            Side::Lit { is_turned: false }
        } else if highest < slack && node.is_two_sided() {
            Side::Lit { is_turned: true }
        } else if highest < slack && node.is_one_sided() {
            Side::Dark
        } else {
            Side::Unknown
        }
    }

    /// Says whether the first of two nodes is to be split: the one with the larger box of those
    /// that are looked into.
    fn splits_first(&self, a: u32, b: u32) -> bool {
        let width = |node: u32| self.bounds[node as usize].half_width();
        match (self.is_open(a), self.is_open(b)) {
            (true, true) => width(a) >= width(b),
            (first, _) => first,
        }
    }

    /// Says whether a node is looked into where it cannot be taken as a whole.
    fn is_open(&self, node: u32) -> bool {
        let (first, end) = self.hierarchy.node(node).elements;
        let has_grid = !self.grids.of_node(node).is_empty();
        self.grids.full(node).is_some() || has_grid && end - first > MAX_NEAR
    }
}

/// With which side elements face others.
enum Side {
    /// All with one that has light: turned where it is the back of two-sided ones.
    Lit {
        is_turned: bool,
    },
    /// All with the back of their one face.
    Dark,
    Unknown,
}
