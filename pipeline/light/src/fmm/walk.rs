//! Which pairs of nodes exchange light as wholes, and which element by element.

use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use crate::error::LightError;
use crate::fmm::bounds::{Bounds, Facing};
use crate::fmm::grid::{Grids, decay};
use crate::hierarchy::{Hierarchy, Links, Span};

/// How far from the centre of a grid, in half widths of its box, what it exchanges light with must
/// be. Boxes of one size that are two widths apart are just so far.
pub(crate) const SEPARATION: f64 = 3.0;

/// Pairs of nodes, each once, that hold every pair of elements under the links exactly once.
#[derive(Debug, Default)]
pub(crate) struct Pairs {
    /// To be taken element by element.
    pub(crate) near: Vec<(u32, u32)>,
    /// To be taken by their grids, and whether with the sign turned.
    pub(crate) far: Vec<(u32, u32, bool)>,
}

impl Pairs {
    /// Counts the bytes of pairs, by block and all together, and of their lists at both ends.
    fn bytes(&self) -> u64 {
        let near = 2 * size_of::<(u32, u32)>() + 2 * size_of::<Span>();
        let far = 2 * size_of::<(u32, u32, bool)>() + 2 * size_of::<u32>();
        (self.near.len() * near + self.far.len() * far) as u64
    }
}

/// What decides it.
pub(crate) struct Walk<'a> {
    pub(crate) hierarchy: &'a Hierarchy,
    pub(crate) bounds: &'a [Bounds],
    pub(crate) grids: &'a Grids,
    pub(crate) regularisation: f64,
    pub(crate) order: usize,
    /// Whether everything under a link faces each other.
    pub(crate) all_face: bool,
    /// Memory that the pairs and the lists that are made of them may take.
    pub(crate) limit_bytes: u64,
}

/// What becomes of a pair.
enum Verdict {
    Nothing,
    Near,
    Far { is_turned: bool },
    Split,
}

impl Walk<'_> {
    /// Goes through all links, each block for itself; the result is in the order of the blocks.
    pub(crate) fn pairs(&self, links: &(impl Links + ?Sized)) -> Result<Pairs, LightError> {
        let held = AtomicU64::new(0);
        let block = |index| {
            let mut pairs = Pairs::default();
            for (a, b) in links.block(index)? {
                self.hierarchy.check_link((a, b))?;
                self.descend(a, b, &mut pairs);
            }
            let bytes = pairs.bytes();
            let held_bytes = held.fetch_add(bytes, Ordering::Relaxed) + bytes;
            if held_bytes > self.limit_bytes {
                return Err(LightError::Memory { limit_bytes: self.limit_bytes });
            }
            Ok(pairs)
        };
        let blocks: Vec<Pairs> =
            (0..links.n_blocks()).into_par_iter().map(block).collect::<Result<_, _>>()?;
        let mut all = Pairs {
            near: Vec::with_capacity(blocks.iter().map(|pairs| pairs.near.len()).sum()),
            far: Vec::with_capacity(blocks.iter().map(|pairs| pairs.far.len()).sum()),
        };
        for pairs in blocks {
            all.near.extend(pairs.near);
            all.far.extend(pairs.far);
        }
        Ok(all)
    }

    fn descend(&self, a: u32, b: u32, pairs: &mut Pairs) {
        match self.verdict(a, b) {
            Verdict::Nothing => {}
            Verdict::Near => pairs.near.push((a, b)),
            Verdict::Far { is_turned } => pairs.far.push((a, b, is_turned)),
            Verdict::Split if self.splits_first(a, b) => {
                self.hierarchy.children(a).for_each(|child| self.descend(child, b, pairs));
            }
            Verdict::Split => {
                self.hierarchy.children(b).for_each(|child| self.descend(a, child, pairs));
            }
        }
    }

    fn verdict(&self, a: u32, b: u32) -> Verdict {
        let (of_a, of_b) = (&self.bounds[a as usize], &self.bounds[b as usize]);
        if of_a.is_empty() || of_b.is_empty() {
            return Verdict::Nothing;
        }
        if self.grids.get(a).is_none() && self.grids.get(b).is_none() {
            return Verdict::Near;
        }
        if !self.are_far(a, b) {
            return Verdict::Split;
        }
        match (self.side(of_a, of_b), self.side(of_b, of_a)) {
            (Side::Dark, _) | (_, Side::Dark) => Verdict::Nothing,
            (Side::Lit { is_turned: here }, Side::Lit { is_turned: there }) => {
                Verdict::Far { is_turned: here != there }
            }
            _ => Verdict::Split,
        }
    }

    /// Says whether two nodes may be joined by their grids: neither is too near to the other's
    /// centre, and what keeps near elements bounded is as good as the same for all of them.
    fn are_far(&self, a: u32, b: u32) -> bool {
        let (of_a, of_b) = (&self.bounds[a as usize], &self.bounds[b as usize]);
        let is_clear = |node: u32, of_node: &Bounds, other: &Bounds| {
            let distance = SEPARATION * of_node.half_width();
            let from_centre2 = other.distance2_from(of_node.centre());
            self.grids.get(node).is_none() || from_centre2 >= distance * distance
        };
        let distance2 = of_a.distance2(of_b);
        let ((area_a, off_a), (area_b, off_b)) = (of_a.area(), of_b.area());
        // π r² + c (A_i + A_j) is then off by no more than what order p errs by.
        let off = self.regularisation * (off_a + off_b);
        let is_even = off <= PI * distance2 * decay(SEPARATION).powi(-(self.order as i32));
        // The exchange of no pair exceeds the area of one of its elements.
        let is_wide = (area_a + off_a).max(area_b + off_b) <= PI * distance2;
        distance2 > 0.0 && is_even && is_wide && is_clear(a, of_a, of_b) && is_clear(b, of_b, of_a)
    }

    /// Says with which side the elements of a node face another.
    fn side(&self, node: &Bounds, other: &Bounds) -> Side {
        if self.all_face && node.is_one_sided() {
            return Side::Lit { is_turned: false };
        }
        match node.facing(other) {
            Facing::Front => Side::Lit { is_turned: false },
            Facing::Back if node.is_two_sided() => Side::Lit { is_turned: true },
            Facing::Back if node.is_one_sided() => Side::Dark,
            _ => Side::Unknown,
        }
    }

    /// Says whether the first of two nodes is to be split: the one with the larger box, but none
    /// without a grid.
    fn splits_first(&self, a: u32, b: u32) -> bool {
        let width = |node: u32| self.bounds[node as usize].half_width();
        match (self.grids.get(a), self.grids.get(b)) {
            (Some(_), Some(_)) => width(a) >= width(b),
            (first, _) => first.is_some(),
        }
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
