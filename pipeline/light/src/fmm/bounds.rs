//! What is known of all elements of a node: where they lie, how large they are, where they face.

use rayon::prelude::*;

use crate::element::Elements;
use crate::hierarchy::Hierarchy;

/// Bounds over the elements of a node that have a normal; the others take no part.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    /// The box of their places.
    pub(crate) low: [f64; 3],
    pub(crate) high: [f64; 3],
    /// The box of their normals.
    normal_low: [f64; 3],
    normal_high: [f64; 3],
    /// The range of n·x.
    offset: (f64, f64),
    /// The range of their areas.
    area: (f64, f64),
    has_one_sided: bool,
    has_two_sided: bool,
}

const INFINITE: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);

impl Bounds {
    const NONE: Bounds = Bounds {
        low: [INFINITE.0; 3],
        high: [INFINITE.1; 3],
        normal_low: [INFINITE.0; 3],
        normal_high: [INFINITE.1; 3],
        offset: INFINITE,
        area: INFINITE,
        has_one_sided: false,
        has_two_sided: false,
    };

    /// Finds those of every node.
    pub(crate) fn of_all(elements: &Elements, hierarchy: &Hierarchy) -> Vec<Bounds> {
        let leaf = |id| match hierarchy.is_leaf(id) {
            true => Bounds::of(elements, hierarchy.node(id).elements.0 as usize),
            false => Bounds::NONE,
        };
        let mut all: Vec<Bounds> = (0..hierarchy.n_nodes()).into_par_iter().map(leaf).collect();
        // Backwards in preorder children come before their parent.
        for id in (0..hierarchy.n_nodes()).rev().filter(|&id| !hierarchy.is_leaf(id)) {
            let join = |sum: Bounds, child| sum.join(&all[child as usize]);
            all[id as usize] = hierarchy.children(id).fold(Bounds::NONE, join);
        }
        all
    }

    fn of(elements: &Elements, index: usize) -> Bounds {
        let element = elements.get(index);
        let (x, n) = (element.position, element.normal);
        if n == [0.0; 3] {
            return Bounds::NONE;
        }
        let offset = n[0] * x[0] + n[1] * x[1] + n[2] * x[2];
        Bounds {
            low: x,
            high: x,
            normal_low: n,
            normal_high: n,
            offset: (offset, offset),
            area: (element.area, element.area),
            has_one_sided: !element.two_sided,
            has_two_sided: element.two_sided,
        }
    }

    fn join(&self, other: &Bounds) -> Bounds {
        let least = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|i| a[i].min(b[i]));
        let most = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|i| a[i].max(b[i]));
        let both = |a: (f64, f64), b: (f64, f64)| (a.0.min(b.0), a.1.max(b.1));
        Bounds {
            low: least(self.low, other.low),
            high: most(self.high, other.high),
            normal_low: least(self.normal_low, other.normal_low),
            normal_high: most(self.normal_high, other.normal_high),
            offset: both(self.offset, other.offset),
            area: both(self.area, other.area),
            has_one_sided: self.has_one_sided || other.has_one_sided,
            has_two_sided: self.has_two_sided || other.has_two_sided,
        }
    }

    /// Says whether no element takes part.
    pub(crate) fn is_empty(&self) -> bool {
        !(self.has_one_sided || self.has_two_sided)
    }

    /// Says whether all of them have one face only.
    pub(crate) fn is_one_sided(&self) -> bool {
        !self.has_two_sided
    }

    /// Says whether all of them have two.
    pub(crate) fn is_two_sided(&self) -> bool {
        !self.has_one_sided
    }

    /// Gives the middle of the box.
    pub(crate) fn centre(&self) -> [f64; 3] {
        [0, 1, 2].map(|i| 0.5 * (self.low[i] + self.high[i]))
    }

    /// Gives half the sides of the box.
    pub(crate) fn half(&self) -> [f64; 3] {
        [0, 1, 2].map(|i| 0.5 * (self.high[i] - self.low[i]))
    }

    /// Gives half the longest side.
    pub(crate) fn half_width(&self) -> f64 {
        self.half().into_iter().fold(0.0, f64::max)
    }

    /// Gives the middle of the areas and how far they are from it at the most.
    pub(crate) fn area(&self) -> (f64, f64) {
        let (low, high) = self.area;
        (0.5 * (low + high), 0.5 * (high - low))
    }

    /// Gives the squared distance of a place from the box.
    pub(crate) fn distance2_from(&self, x: [f64; 3]) -> f64 {
        let beyond = |i: usize| (self.low[i] - x[i]).max(x[i] - self.high[i]).max(0.0);
        (0..3).map(|i| beyond(i) * beyond(i)).sum()
    }

    /// Gives the squared distance between two boxes.
    pub(crate) fn distance2(&self, other: &Bounds) -> f64 {
        let gap =
            |i: usize| (self.low[i] - other.high[i]).max(other.low[i] - self.high[i]).max(0.0);
        (0..3).map(|i| gap(i) * gap(i)).sum()
    }

    /// Gives the least and the most that a place of a box can be above the planes of these
    /// elements: n·(x - y).
    pub(crate) fn heights(&self, other: &Bounds) -> (f64, f64) {
        let (mut least, mut most) = (-self.offset.1, -self.offset.0);
        for i in 0..3 {
            let ends = [self.normal_low[i], self.normal_high[i]]
                .map(|n| [n * other.low[i], n * other.high[i]]);
            let all = [ends[0][0], ends[0][1], ends[1][0], ends[1][1]];
            least += all.into_iter().fold(INFINITE.0, f64::min);
            most += all.into_iter().fold(INFINITE.1, f64::max);
        }
        (least, most)
    }
}
