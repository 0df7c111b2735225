//! The online cutter: Morton-sorted points of one bin in, nodes in preorder and surfels out.

use std::ops::Range;

use pvmap_geometry::disc::Profile;
use pvmap_geometry::{Rect, morton};
use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::{Node, Shape, Split, Surfel};

use super::budget::{Blocks, Budget};
use super::leaf::LeafPoints;
use super::points::{LeafPoint, Reader};
use super::{checked_id, spread};
use crate::OctreeError;

/// What every cutter of a tree goes by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rules {
    pub(super) max_level: u8,
    pub(super) leaf_capacity: u64,
    pub(super) max_spread: u16,
    pub(super) shape: Shape,
    pub(super) profile: Profile,
    /// Points that a cutter may hold; a cell of more is read again when they are needed.
    pub(super) max_held: usize,
}

/// The tree of a cutter.
#[derive(Debug)]
pub(super) struct Part {
    pub(super) nodes: Blocks<Node>,
    pub(super) surfels: Blocks<Surfel>,
    /// Of each surfel, for profile `oriented`.
    pub(super) rects: Blocks<Rect>,
}

/// Builds the octree of one bin (of all points in `paper`) while its points come in.
///
/// The cells above the last point that have more points than a leaf are *open*: their nodes are
/// written, their ends are not. Below the deepest open one is the *pending* cell, of which all
/// points so far could be a leaf. A point outside it settles it; one too many opens it, and then
/// its points come in once more, one level down.
pub(super) struct Cutter<'a> {
    reader: &'a Reader<'a>,
    rules: Rules,
    budget: &'a Budget,
    bin: i8,
    tree: Part,
    /// Node ids of the open cells, root first.
    open: Vec<u32>,
    pending: Cell,
}

/// The cell whose fate is open.
#[derive(Debug, Default)]
struct Cell {
    level: u8,
    codes: Range<u64>,
    /// From its first point in the octree to its last; points of other bins may lie between.
    indices: Range<u64>,
    n_points: u64,
    /// All of its points, or none if they are too many to hold.
    held: Vec<LeafPoint>,
}

impl Cell {
    fn add(&mut self, point: &LeafPoint, max_held: usize) {
        if self.n_points == 0 {
            self.indices.start = point.index;
        }
        self.indices.end = point.index + 1;
        if self.is_held() && self.held.len() < max_held {
            self.held.push(*point);
        } else {
            self.held = Vec::new();
        }
        self.n_points += 1;
    }

    fn is_held(&self) -> bool {
        self.held.len() as u64 == self.n_points
    }

    /// Gives which child of its parent the cell is, if it is one of `bin`.
    fn slot(&self, bin: i8) -> u8 {
        match self.level {
            0 => bin.max(0) as u8,
            level => morton::octant(self.codes.start, level),
        }
    }
}

impl<'a> Cutter<'a> {
    /// Starts with no points; its tree takes its bytes from `budget`.
    pub(super) fn new(
        reader: &'a Reader<'a>,
        rules: Rules,
        budget: &'a Budget,
        bin: i8,
    ) -> Cutter<'a> {
        Cutter {
            reader,
            rules,
            budget,
            bin,
            tree: Part { nodes: Blocks::new(), surfels: Blocks::new(), rects: Blocks::new() },
            open: Vec::new(),
            pending: Cell { codes: morton::cell_range(0, 0), ..Cell::default() },
        }
    }

    /// Takes those of the next points that are of its bin.
    ///
    /// # Errors
    /// Where the octree is damaged, the run was asked to stop, or ids or memory run out.
    pub(super) fn take(&mut self, points: &[LeafPoint]) -> Result<(), OctreeError> {
        let bin = self.bin;
        points.iter().filter(|p| p.bin == bin).try_for_each(|p| self.push(p))
    }

    /// Settles what is pending and gives the tree of the bin: its top node has no parent. Empty
    /// without points.
    ///
    /// # Errors
    /// Those of [`Cutter::take`].
    pub(super) fn finish(mut self) -> Result<Part, OctreeError> {
        self.settle()?;
        while let Some(id) = self.open.pop() {
            self.close(id);
        }
        Ok(self.tree)
    }

    fn push(&mut self, point: &LeafPoint) -> Result<(), OctreeError> {
        if !self.pending.codes.contains(&point.code) {
            if point.code < self.pending.codes.start {
                return Err(self.reader.unsorted(point.index));
            }
            self.settle()?;
            self.enter(point.code);
        }
        self.pending.add(point, self.rules.max_held);
        if self.pending.n_points > self.rules.leaf_capacity
            && self.pending.level < self.rules.max_level
        {
            self.split()?;
        }
        Ok(())
    }

    /// Makes the child of the deepest open cell around `code` pending, once others are closed.
    fn enter(&mut self, code: u64) {
        while let Some(&id) = self.open.last() {
            let node = &self.tree.nodes[id];
            if morton::cell_range(node.first_code, node.level).contains(&code) {
                self.pending.level = node.level + 1;
                self.pending.codes = morton::cell_range(code, node.level + 1);
                return;
            }
            self.open.pop();
            self.close(id);
        }
    }

    /// Opens the pending cell: its points come in again, one level down.
    fn split(&mut self) -> Result<(), OctreeError> {
        let cell = std::mem::take(&mut self.pending);
        let id = self.add_node(&cell, Split::Octants, cell.slot(self.bin))?;
        self.open.push(id);
        // No cell holds the codes of an empty range: the first point enters its own.
        self.pending.codes = cell.codes.start..cell.codes.start;
        if cell.is_held() {
            return cell.held.iter().try_for_each(|p| self.push(p));
        }
        let bin = self.bin;
        self.reader.each(cell.indices, |point| {
            if point.bin == bin {
                self.push(&point)?;
            }
            Ok(())
        })
    }

    /// Makes the pending cell a leaf, or quadrant leaves where its normals stray.
    fn settle(&mut self) -> Result<(), OctreeError> {
        // Dividing a cell settles all of its parts but the last, which is pending then.
        while self.is_spread()? {
            self.split()?;
        }
        let mut cell = std::mem::take(&mut self.pending);
        if cell.n_points > 0 {
            self.add_leaves(&cell, &self.points_of(&cell))?;
        }
        cell.held.clear();
        self.pending.held = cell.held;
        Ok(())
    }

    /// Says whether the pending cell has few points, and these are too far apart for one leaf.
    fn is_spread(&self) -> Result<bool, OctreeError> {
        let (cell, most) = (&self.pending, self.rules.max_spread);
        let may_be = most > 0
            && cell.level < self.rules.max_level
            && spread::N_POINTS.contains(&cell.n_points);
        Ok(may_be && spread::is_spread(self.points_of(cell).places()?, most))
    }

    fn points_of<'c>(&self, cell: &'c Cell) -> LeafPoints<'c>
    where
        'a: 'c,
    {
        match cell.is_held() {
            true => LeafPoints::held(&cell.held, self.bin),
            false => LeafPoints::stored(self.reader, cell.indices.clone(), self.bin),
        }
    }

    fn add_leaves(&mut self, cell: &Cell, points: &LeafPoints<'_>) -> Result<(), OctreeError> {
        let quadrants = points.stray_quadrants()?;
        if quadrants.is_empty() {
            return self.add_leaf(cell, cell.slot(self.bin), points);
        }
        let id = self.add_node(cell, Split::Quadrants, cell.slot(self.bin))?;
        self.open.push(id);
        for quadrant in quadrants {
            self.add_leaf(cell, quadrant, &points.of_quadrant(quadrant))?;
        }
        self.open.pop();
        self.close(id);
        Ok(())
    }

    fn add_leaf(
        &mut self,
        cell: &Cell,
        slot: u8,
        points: &LeafPoints<'_>,
    ) -> Result<(), OctreeError> {
        let id = self.add_node(cell, Split::Leaf, slot)?;
        let mut surfel = points.surfel(self.rules.shape)?;
        surfel.first_code = cell.codes.start;
        surfel.level = cell.level;
        surfel.node = id;
        self.tree.nodes[id].n_points = surfel.n_points;
        if self.rules.profile == Profile::Oriented {
            self.tree.rects.push(self.budget, points.rect(&surfel)?)?;
        }
        self.tree.surfels.push(self.budget, surfel)?;
        self.close(id);
        Ok(())
    }

    /// Writes a node below the deepest open one; its ends and points are still to come.
    fn add_node(&mut self, cell: &Cell, split: Split, slot: u8) -> Result<u32, OctreeError> {
        let id = checked_id(self.tree.nodes.len())?;
        // There are at most as many surfels as nodes.
        let first_surfel = self.tree.surfels.len() as u32;
        let node = Node {
            parent: self.open.last().copied().unwrap_or(NO_PARENT),
            end: id + 1,
            first_surfel,
            end_surfel: first_surfel,
            n_points: 0,
            first_code: cell.codes.start,
            level: cell.level,
            bin: self.bin,
            split,
            slot,
            overhang: 0,
        };
        self.tree.nodes.push(self.budget, node)?;
        Ok(id)
    }

    /// Ends the subtree of a node and counts its points to its parent.
    fn close(&mut self, id: u32) {
        // Every node of the subtree has got an id.
        let end = self.tree.nodes.len() as u32;
        let node = &mut self.tree.nodes[id];
        node.end = end;
        node.end_surfel = self.tree.surfels.len() as u32;
        let (parent, n_points) = (node.parent, node.n_points);
        if parent != NO_PARENT {
            self.tree.nodes[parent].n_points += n_points;
        }
    }
}
