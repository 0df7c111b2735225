//! The pairs a build starts from: the siblings of every node, or a list the user gives.
//! Source: DESIGN.md [V-5].

use std::collections::HashMap;

use pvmap_store::runs::Pair;
use pvmap_vmap::Tree;
use pvmap_vmap::records::NO_PARENT;

use crate::VisibilityError;

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
/// The first pair that breaks a rule, by its position.
pub fn checked_pairs(tree: &Tree, given: &[Pair]) -> Result<Vec<Pair>, VisibilityError> {
    let n_nodes = tree.nodes.len() as u32;
    let mut rows = HashMap::with_capacity(given.len());
    for (row, &(a, b)) in given.iter().enumerate() {
        if let Some(node) = [a, b].into_iter().find(|&n| n >= n_nodes) {
            return Err(VisibilityError::NoSuchNode { row, node, n_nodes });
        }
        let (low, high) = (a.min(b), a.max(b));
        if high < tree.nodes[low as usize].end {
            return Err(VisibilityError::Nested { row, node_a: low, node_b: high });
        }
        if let Some(first) = rows.insert((low, high), row) {
            return Err(VisibilityError::CoveredTwice { first, second: row });
        }
    }
    // Two pairs overlap exactly if each side of one holds or is held by a side of the other; then
    // one of the four corners of "ancestors of a" × "ancestors of b" is the other pair, or their
    // sides cross: an ancestor on one side and a descendant on the other. Looking up ancestor
    // pairs with each side free finds both.
    for (&(a, b), &row) in &rows {
        let found = above(tree, a)
            .flat_map(|x| above(tree, b).map(move |y| (x.min(y), x.max(y))))
            .filter(|&pair| pair != (a, b))
            .find_map(|pair| rows.get(&pair));
        if let Some(&other) = found {
            let (first, second) = (row.min(other), row.max(other));
            return Err(VisibilityError::CoveredTwice { first, second });
        }
    }
    crossing_pairs(tree, &rows)?;
    let mut pairs: Vec<Pair> = rows.into_keys().collect();
    pairs.sort_unstable();
    Ok(pairs)
}

/// Finds pairs (A, B), (C, D) where A holds C but D holds B.
fn crossing_pairs(tree: &Tree, rows: &HashMap<Pair, usize>) -> Result<(), VisibilityError> {
    // Each side of a pair, with the other: a crossing pair has one side above and one below.
    let mut partners: HashMap<u32, Vec<(u32, usize)>> = HashMap::new();
    for (&(a, b), &row) in rows {
        partners.entry(a).or_default().push((b, row));
        partners.entry(b).or_default().push((a, row));
    }
    partners.values_mut().for_each(|list| list.sort_unstable());
    for (&(a, b), &row) in rows {
        for (side, other) in [(a, b), (b, a)] {
            let below = tree.nodes[other as usize].end;
            for up in above(tree, side).skip(1) {
                let Some(list) = partners.get(&up) else { continue };
                // Partners of an ancestor that lie strictly under the other side.
                let at = list.partition_point(|&(node, _)| node <= other);
                if let Some(&(node, twin)) = list.get(at)
                    && node < below
                {
                    let (first, second) = (row.min(twin), row.max(twin));
                    return Err(VisibilityError::CoveredTwice { first, second });
                }
            }
        }
    }
    Ok(())
}

/// Walks from a node up to the root, the node first.
fn above(tree: &Tree, node: u32) -> impl Iterator<Item = u32> + '_ {
    std::iter::successors(Some(node), |&id| {
        Some(tree.nodes[id as usize].parent).filter(|&p| p != NO_PARENT)
    })
}
