//! The pairs a build starts from: the siblings of every node, or a list the user gives.
//! Source: DESIGN.md [V-5].

use std::collections::HashMap;

use pvmap_store::runs::Pair;
use pvmap_vmap::Tree;
use pvmap_vmap::records::NO_PARENT;

use crate::error::{PairFault, VisibilityError};

/// Bytes for each given pair while the list is checked: the list as it was read, with room to
/// grow, as it is handed on and as it is checked; a hash map at least 7/16 full; its sides.
pub const GIVEN_BYTES: usize =
    4 * size_of::<Pair>() + 3 * size_of::<(Pair, usize)>() + 2 * size_of::<Side>();

/// Lists every unordered pair of distinct siblings, at every inner node.
pub fn sibling_pairs(tree: &Tree) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for id in 0..tree.nodes.len() as u32 {
        let children: Vec<u32> = tree.children(id).collect();
        for (i, &a) in children.iter().enumerate() {
            pairs.extend(children[i + 1..].iter().map(|&b| (a, b)));
        }
    }
    pairs
}

/// Checks given pairs and puts each in order: nodes exist, their subtrees are disjoint, and no
/// leaf pair is covered twice.
///
/// # Errors
/// The first pair that names no node or nested ones; else the first that overlaps another. Pairs
/// are named by their positions.
pub fn checked_pairs(tree: &Tree, given: &[Pair]) -> Result<Vec<Pair>, VisibilityError> {
    let n_nodes = tree.nodes.len() as u32;
    let mut pairs = Vec::with_capacity(given.len());
    for (row, &(a, b)) in given.iter().enumerate() {
        if let Some(node) = [a, b].into_iter().find(|&n| n >= n_nodes) {
            let fault = PairFault::NoSuchNode { node, n_nodes };
            return Err(VisibilityError::Interaction { rows: vec![row], fault });
        }
        let (low, high) = (a.min(b), a.max(b));
        if high < tree.nodes[low as usize].end {
            let fault = PairFault::Nested { node_a: low, node_b: high };
            return Err(VisibilityError::Interaction { rows: vec![row], fault });
        }
        pairs.push((low, high));
    }
    let overlaps = Overlaps::new(tree, &pairs);
    let rows = pairs.iter().enumerate().filter_map(|(row, &pair)| {
        let other = overlaps.of(row, pair)?;
        Some((row.min(other), row.max(other)))
    });
    if let Some((first, second)) = rows.min() {
        let (rows, fault) = (vec![first, second], PairFault::CoveredTwice);
        return Err(VisibilityError::Interaction { rows, fault });
    }
    drop(overlaps);
    pairs.sort_unstable();
    Ok(pairs)
}

/// A side of a pair, the other side, and which pair.
type Side = (u32, u32, usize);

/// Finds pairs that cover the same leaf pairs: those of which each side holds, or lies in, a side
/// of the other. Either one pair's sides hold both of the other's, or the two cross: each holds
/// one side of the other.
struct Overlaps<'a> {
    tree: &'a Tree,
    rows: HashMap<Pair, usize>,
    sides: Vec<Side>,
}

impl Overlaps<'_> {
    fn new<'a>(tree: &'a Tree, pairs: &[Pair]) -> Overlaps<'a> {
        let mut rows = HashMap::with_capacity(pairs.len());
        let mut sides = Vec::with_capacity(2 * pairs.len());
        for (row, &(a, b)) in pairs.iter().enumerate() {
            rows.entry((a, b)).or_insert(row);
            sides.extend([(a, b, row), (b, a, row)]);
        }
        sides.sort_unstable();
        Overlaps { tree, rows, sides }
    }

    /// Finds a pair that overlaps one: an equal one before it, one that holds it, or one across.
    fn of(&self, row: usize, (a, b): Pair) -> Option<usize> {
        let corners = above(self.tree, a)
            .flat_map(|x| above(self.tree, b).map(move |y| (x.min(y), x.max(y))));
        let mut holding = corners.filter_map(|pair| self.rows.get(&pair).copied());
        holding
            .find(|&other| other != row)
            .or_else(|| self.across(a, b))
            .or_else(|| self.across(b, a))
    }

    /// Finds a pair of which one side holds `up` and the other lies in `down`.
    fn across(&self, up: u32, down: u32) -> Option<usize> {
        let under = down + 1..self.tree.nodes[down as usize].end;
        above(self.tree, up).skip(1).find_map(|holder| {
            let at = self.sides.partition_point(|s| (s.0, s.1) < (holder, under.start));
            let &(side, other, row) = self.sides.get(at)?;
            (side == holder && other < under.end).then_some(row)
        })
    }
}

/// Walks from a node up to the root, the node first.
fn above(tree: &Tree, node: u32) -> impl Iterator<Item = u32> + '_ {
    std::iter::successors(Some(node), |&id| {
        Some(tree.nodes[id as usize].parent).filter(|&p| p != NO_PARENT)
    })
}

#[cfg(test)]
mod tests {
    use pvmap_vmap::records::Node;
    use pvmap_vmap::tree::{Shape, root_node};

    use super::*;

    /// Two children of the root, 1 and 4, with two leaves each.
    fn tree() -> Tree {
        let node = |(parent, end)| Node { parent, end, ..root_node(Shape::Paper, 0) };
        let nodes = [(NO_PARENT, 7), (0, 4), (1, 3), (1, 4), (0, 7), (4, 6), (4, 7)];
        Tree { nodes: nodes.map(node).to_vec(), ..Tree::default() }
    }

    fn rows_at_fault(given: &[Pair]) -> Option<(Vec<usize>, PairFault)> {
        match checked_pairs(&tree(), given) {
            Ok(pairs) => {
                assert!(pairs.is_sorted() && pairs.len() == given.len());
                None
            }
            Err(VisibilityError::Interaction { rows, fault }) => Some((rows, fault)),
            Err(e) => panic!("{e}"),
        }
    }

    #[test]
    fn v5_the_first_pair_at_fault_is_named() {
        let twice = |first, second| Some((vec![first, second], PairFault::CoveredTwice));
        assert_eq!(sibling_pairs(&tree()), [(1, 4), (2, 3), (5, 6)]);
        assert_eq!(rows_at_fault(&sibling_pairs(&tree())), None);
        assert_eq!(rows_at_fault(&[(2, 5), (6, 3), (3, 5), (2, 6)]), None);
        let fault = PairFault::NoSuchNode { node: 7, n_nodes: 7 };
        assert_eq!(rows_at_fault(&[(2, 5), (7, 3), (8, 9)]), Some((vec![1], fault)));
        let fault = PairFault::Nested { node_a: 1, node_b: 3 };
        assert_eq!(rows_at_fault(&[(3, 1), (0, 0)]), Some((vec![0], fault)));
        // The same, one held by the other, and two that cross.
        assert_eq!(rows_at_fault(&[(2, 3), (2, 5), (5, 2), (3, 2)]), twice(0, 3));
        assert_eq!(rows_at_fault(&[(2, 3), (2, 5), (1, 4), (3, 5)]), twice(1, 2));
        assert_eq!(rows_at_fault(&[(1, 4), (2, 3), (3, 6)]), twice(0, 2));
        assert_eq!(rows_at_fault(&[(2, 3), (1, 5), (2, 4)]), twice(1, 2));
    }
}
