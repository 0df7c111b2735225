//! A tree of boxes over the surfaces of a scene, for the truth's two questions.

use crate::vector::{Vector, sub};

/// Surfaces a leaf holds at most: from 1 to 8 the cave answers equally fast, within 10 %.
const LEAF_SURFACES: usize = 4;

/// More than log2 of the most surfaces there can be: halving ends long before.
const MAX_DEPTH: usize = 64;

/// A binary tree of boxes in preorder.
#[derive(Debug, Clone)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    /// Surface indices, leaf by leaf.
    order: Vec<u32>,
}

/// What the tree holds for each surface.
pub(crate) const SURFACE_BYTES: usize = size_of::<Node>() + size_of::<u32>();

#[derive(Debug, Clone, Copy)]
struct Node {
    min: Vector,
    max: Vector,
    /// Leaf: where its surfaces begin in `order`. Inner node: its second child; the first is next.
    first: u32,
    /// Surfaces of a leaf; 0 for an inner node.
    count: u32,
}

impl Bvh {
    /// Builds the tree over surface boxes, (lowest, highest corner) each. Every box is grown by
    /// `margin_m`, which must exceed what rounding does to coordinates of this size.
    pub(crate) fn new(boxes: &[(Vector, Vector)], margin_m: f64) -> Bvh {
        let n = u32::try_from(boxes.len()).expect("a generated scene has fewer than 2^32 surfaces");
        // A list that grows is copied. A leaf has two surfaces or more, so fewer nodes do.
        let nodes = Vec::with_capacity(boxes.len().max(1));
        let mut bvh = Bvh { nodes, order: (0..n).collect() };
        let mut order = std::mem::take(&mut bvh.order);
        bvh.build(boxes, margin_m, &mut order, 0);
        bvh.order = order;
        bvh
    }

    /// Adds the node over `order`, whose first entry is number `first` of the whole.
    fn build(&mut self, boxes: &[(Vector, Vector)], margin_m: f64, order: &mut [u32], first: u32) {
        let mut min = [f64::INFINITY; 3];
        let mut max = [f64::NEG_INFINITY; 3];
        for &s in order.iter() {
            let (low, high) = boxes[s as usize];
            min = [0, 1, 2].map(|i| min[i].min(low[i] - margin_m));
            max = [0, 1, 2].map(|i| max[i].max(high[i] + margin_m));
        }
        let node = self.nodes.len();
        self.nodes.push(Node { min, max, first, count: order.len() as u32 });
        if order.len() <= LEAF_SURFACES {
            return;
        }
        let side = sub(max, min);
        let axis = (0..3).fold(0, |longest, i| if side[i] > side[longest] { i } else { longest });
        let middle = |s: u32| boxes[s as usize].0[axis] + boxes[s as usize].1[axis];
        let half = order.len() / 2;
        order.select_nth_unstable_by(half, |&a, &b| middle(a).total_cmp(&middle(b)));
        let (low, high) = order.split_at_mut(half);
        self.build(boxes, margin_m, low, first);
        let second = self.nodes.len() as u32;
        self.build(boxes, margin_m, high, first + half as u32);
        self.nodes[node].first = second;
        self.nodes[node].count = 0;
    }

    /// Says whether `holds` is true of any surface whose box the segment from p to q may meet.
    pub(crate) fn any_along(&self, p: Vector, q: Vector, holds: impl Fn(u32) -> bool) -> bool {
        let segment = Segment::new(p, q);
        let mut stack = [0u32; MAX_DEPTH];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let at = stack[depth];
            let node = &self.nodes[at as usize];
            if !segment.may_meet(node) {
                continue;
            }
            if node.count == 0 {
                (stack[depth], stack[depth + 1]) = (node.first, at + 1);
                depth += 2;
            } else if self.surfaces(node).iter().any(|&s| holds(s)) {
                return true;
            }
        }
        false
    }

    /// Gives the surface of the least squared distance ≤ `reach2`, the lowest index on ties.
    /// `distance2` gives a surface's squared distance from p, or nothing to pass over it.
    pub(crate) fn nearest(
        &self,
        p: Vector,
        reach2: f64,
        distance2: impl Fn(u32) -> Option<f64>,
    ) -> Option<u32> {
        let mut best: (f64, Option<u32>) = (reach2, None);
        let mut stack = [0u32; MAX_DEPTH];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let at = stack[depth];
            let node = &self.nodes[at as usize];
            if node.distance2(p) > best.0 {
                continue;
            }
            if node.count == 0 {
                let (mut near, mut far) = (at + 1, node.first);
                let away = |n: u32| self.nodes[n as usize].distance2(p);
                if away(far) < away(near) {
                    (near, far) = (far, near);
                }
                (stack[depth], stack[depth + 1]) = (far, near);
                depth += 2;
                continue;
            }
            for &s in self.surfaces(node) {
                let Some(d) = distance2(s) else { continue };
                if d < best.0 || d == best.0 && best.1.is_none_or(|b| s < b) {
                    best = (d, Some(s));
                }
            }
        }
        best.1
    }

    fn surfaces(&self, node: &Node) -> &[u32] {
        &self.order[node.first as usize..][..node.count as usize]
    }
}

impl Node {
    fn distance2(&self, p: Vector) -> f64 {
        let axis = |i: usize| (self.min[i] - p[i]).max(p[i] - self.max[i]).max(0.0);
        let d = [0, 1, 2].map(axis);
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    }
}

/// A segment by its middle and half its vector.
struct Segment {
    middle: Vector,
    half: Vector,
    abs: Vector,
}

impl Segment {
    fn new(p: Vector, q: Vector) -> Segment {
        let half = [0, 1, 2].map(|i| 0.5 * (q[i] - p[i]));
        let middle = [0, 1, 2].map(|i| 0.5 * (p[i] + q[i]));
        Segment { middle, half, abs: half.map(f64::abs) }
    }

    /// Says false only where one of the six separating axes of segment and box proves it; no
    /// division, so that a segment along an axis needs no care. The boxes' margin covers rounding.
    fn may_meet(&self, node: &Node) -> bool {
        let side = [0, 1, 2].map(|i| 0.5 * (node.max[i] - node.min[i]));
        let m = [0, 1, 2].map(|i| self.middle[i] - 0.5 * (node.max[i] + node.min[i]));
        if (0..3).any(|i| m[i].abs() > side[i] + self.abs[i]) {
            return false;
        }
        (0..3).all(|i| {
            let (u, v) = ((i + 1) % 3, (i + 2) % 3);
            let apart = (m[u] * self.half[v] - m[v] * self.half[u]).abs();
            apart <= side[u] * self.abs[v] + side[v] * self.abs[u]
        })
    }
}
