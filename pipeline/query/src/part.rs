//! A part of the scan that a question is about: its surfels and the nodes over them.

use std::ops::Range;

use pvmap_geometry::Box3;
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Node, Surfel};

use crate::map::Map;

/// How a cell lies to a part of space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Holds {
    All,
    Some,
    Nothing,
}

/// Some surfels, in runs that are whole subtrees, and the nodes over and under those.
#[derive(Debug, Default)]
pub(crate) struct Part {
    /// Node ids, disjoint and rising; every node with a surfel of the part is among them.
    nodes: Vec<Range<u32>>,
    /// Surfel ids, disjoint and rising.
    runs: Vec<Range<u32>>,
    /// Surfels, and points, in front of each run; one more than `runs`.
    before: Vec<(u32, u64)>,
}

impl Part {
    /// Makes the part of the whole scan.
    pub(crate) fn whole(map: &Map<'_>) -> Result<Part, FormatError> {
        let mut part = Part { before: vec![(0, 0)], ..Part::default() };
        if let Some(root) = map.root()? {
            part.push_node(0..root.end);
            part.push_run(map, 0, &root)?;
        }
        Ok(part)
    }

    /// Makes the part of one leaf: the nodes are the way down to it.
    pub(crate) fn leaf(map: &Map<'_>, surfel: u32) -> Result<Part, FormatError> {
        Part::chosen(
            map,
            |node| {
                let has = (node.first_surfel..node.end_surfel).contains(&surfel);
                if has { Holds::Some } else { Holds::Nothing }
            },
            |_, id| id == surfel,
        )
    }

    /// Makes the part of the surfels whose centroids lie in a part of space: `cell` says how a
    /// closed box lies to it, `centroid` whether it holds a place.
    pub(crate) fn of_space(
        map: &Map<'_>,
        cell: impl Fn(&Box3) -> Holds,
        centroid: impl Fn([i32; 3]) -> bool,
    ) -> Result<Part, FormatError> {
        // A mean of points never leaves their cell.
        let inside = |surfel: &Surfel, _| centroid(surfel.centroid.map(|v| v as i32));
        Part::chosen(map, |node| cell(&node.cell()), inside)
    }

    /// Makes the part of some surfels, rising, that count so many points each.
    pub(crate) fn weighted(map: &Map<'_>, surfels: &[(u32, u64)]) -> Result<Part, FormatError> {
        let has = |ids: Range<u32>| {
            surfels.get(surfels.partition_point(|s| s.0 < ids.start)).is_some_and(|s| s.0 < ids.end)
        };
        let of_node = |node: &Node| {
            if has(node.first_surfel..node.end_surfel) { Holds::Some } else { Holds::Nothing }
        };
        let mut part = Part::chosen(map, of_node, |_, id| has(id..id + 1))?;
        let mut sum = 0u64;
        for (run, before) in part.runs.iter().zip(&mut part.before[1..]) {
            let i = surfels.partition_point(|s| s.0 < run.start);
            sum = sum.saturating_add(surfels[i].1);
            before.1 = sum;
        }
        Ok(part)
    }

    /// Makes the part of the surfels that two rules choose: one for nodes, one for leaves of nodes
    /// that hold `Some`.
    pub(crate) fn chosen(
        map: &Map<'_>,
        of_node: impl Fn(&Node) -> Holds,
        of_surfel: impl Fn(&Surfel, u32) -> bool,
    ) -> Result<Part, FormatError> {
        let mut part = Part { before: vec![(0, 0)], ..Part::default() };
        let mut open: Vec<(u32, Node)> = map.root()?.map(|root| (0, root)).into_iter().collect();
        while let Some((id, node)) = open.pop() {
            match of_node(&node) {
                Holds::Nothing => {}
                Holds::All => {
                    part.push_node(id..node.end);
                    part.push_run(map, id, &node)?;
                }
                Holds::Some if node.is_leaf() => {
                    if of_surfel(&map.surfel_of(id, &node)?, node.first_surfel) {
                        part.push_node(id..node.end);
                        part.push_run(map, id, &node)?;
                    }
                }
                Holds::Some => {
                    part.push_node(id..id + 1);
                    let from = open.len();
                    for child in map.children(id, node) {
                        open.push(child?);
                    }
                    // The first child is looked at first, so that ids rise.
                    open[from..].reverse();
                }
            }
        }
        Ok(part)
    }

    fn push_node(&mut self, ids: Range<u32>) {
        match self.nodes.last_mut() {
            Some(last) if last.end == ids.start => last.end = ids.end,
            _ => self.nodes.push(ids),
        }
    }

    fn push_run(&mut self, map: &Map<'_>, id: u32, node: &Node) -> Result<(), FormatError> {
        let (n_surfels, n_points) = self.before.last().copied().unwrap_or_default();
        let end = self.runs.last().map_or(0, |run| run.end);
        let n_all = n_points.checked_add(node.n_points);
        let (true, Some(n_all)) = (end <= node.first_surfel, n_all) else {
            return Err(map.broken_node(id, "has surfels or points that are not its own"));
        };
        self.runs.push(node.first_surfel..node.end_surfel);
        self.before.push((n_surfels + (node.end_surfel - node.first_surfel), n_all));
        Ok(())
    }

    /// Gives the runs of surfels.
    pub(crate) fn runs(&self) -> &[Range<u32>] {
        &self.runs
    }

    /// Counts the surfels.
    pub(crate) fn n_surfels(&self) -> u32 {
        self.before.last().map_or(0, |b| b.0)
    }

    /// Counts the points.
    pub(crate) fn n_points(&self) -> u64 {
        self.before.last().map_or(0, |b| b.1)
    }

    /// Counts the surfels with ids below one.
    pub(crate) fn n_below(&self, surfel: u32) -> u32 {
        let i = self.runs.partition_point(|run| run.end <= surfel);
        let cut = self.runs.get(i).map_or(0, |run| surfel.saturating_sub(run.start));
        self.before.get(i).map_or(0, |b| b.0) + cut
    }

    /// Counts the surfels under a node.
    pub(crate) fn n_under(&self, node: &Node) -> u32 {
        self.n_below(node.end_surfel) - self.n_below(node.first_surfel)
    }

    /// Counts the points under a node. Runs are whole subtrees: the node is in one or holds its
    /// own.
    pub(crate) fn n_points_under(&self, node: &Node) -> u64 {
        let i = self.runs.partition_point(|run| run.end <= node.first_surfel);
        let own = node.first_surfel..node.end_surfel;
        let is_in = |run: &Range<u32>| run.start <= own.start && own.end <= run.end;
        if self.runs.get(i).is_some_and(|run| is_in(run) && *run != own) {
            return node.n_points;
        }
        let j = self.runs.partition_point(|run| run.start < node.end_surfel);
        self.before[j].1.saturating_sub(self.before[i].1)
    }

    /// Gives the first node from an id on.
    pub(crate) fn node_from(&self, id: u32) -> Option<u32> {
        let i = self.nodes.partition_point(|ids| ids.end <= id);
        self.nodes.get(i).map(|ids| ids.start.max(id))
    }
}

/// Reads a node that a link names, and refuses one that does not come after the other side.
pub(crate) fn far_node(map: &Map<'_>, near: &Node, far: u32) -> Result<Node, FormatError> {
    let node = map.view().node(far)?;
    if node.first_surfel < near.end_surfel {
        return Err(map.broken_node(far, "is linked to a node that it lies over or before"));
    }
    Ok(node)
}
