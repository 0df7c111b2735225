//! Blocks of leaf pairs of a room, decided by the filtered kernel and by plain floats.

use fastrand::Rng;
use pvmap::geometry::Box3;
use pvmap_visibility::bounds::{Facing, facing};
use pvmap_visibility::candidates::{Corridor, Depth, Kept, blockers_of, everything, refine};
use pvmap_visibility::ends::Ends;
use pvmap_visibility::kernel::Counts;
use pvmap_visibility::pairs::{Decider, Status};

use super::plain;
use super::room::{PROFILE, Room};

/// Blocks that are decided.
const N_BLOCKS: usize = 256;
/// Leaves of a side: the blocks of a build have at most 1024 pairs.
const SIDE: std::ops::RangeInclusive<u32> = 9..=32;

/// Pairs of nodes that a decider decides leaf pair by leaf pair.
#[derive(Debug)]
pub(crate) struct Blocks<'a> {
    room: &'a Room,
    pairs: Vec<(u32, u32)>,
    sides: [Box<Ends>; 2],
    open: Vec<u64>,
    candidates: Vec<Kept>,
    discs: Vec<(u32, Box3)>,
    counts: Counts,
}

impl<'a> Blocks<'a> {
    /// Draws blocks whose leaves may face each other.
    pub(crate) fn new(room: &'a Room) -> Blocks<'a> {
        let nodes = &room.tree.nodes;
        let fits = |&id: &u32| {
            let node = &nodes[id as usize];
            SIDE.contains(&(node.end_surfel - node.first_surfel))
        };
        let sides: Vec<u32> = (0..nodes.len() as u32).filter(fits).collect();
        let mut rng = Rng::with_seed(2);
        let mut pairs = Vec::new();
        while pairs.len() < N_BLOCKS {
            let [a, b] = [0; 2].map(|_| sides[rng.usize(..sides.len())]);
            let is_apart = nodes[a as usize].end <= b;
            let faces = || facing(&room.bounds[a as usize], &room.bounds[b as usize]);
            if is_apart && faces() != Facing::Never {
                pairs.push((a, b));
            }
        }
        Blocks {
            room,
            pairs,
            sides: [Box::new(Ends::NONE), Box::new(Ends::NONE)],
            open: Vec::new(),
            candidates: Vec::new(),
            discs: Vec::new(),
            counts: Counts::default(),
        }
    }

    /// Counts the leaf pairs.
    pub(crate) fn n_pairs(&self) -> u64 {
        self.pairs.iter().map(|&(a, b)| self.n_leaves(a) * self.n_leaves(b)).sum()
    }

    fn n_leaves(&self, id: u32) -> u64 {
        let node = &self.room.tree.nodes[id as usize];
        u64::from(node.end_surfel - node.first_surfel)
    }

    /// What the kernel did so far.
    pub(crate) fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Decides all blocks as a build does, but for the memory of discs that blocked lately: each
    /// has a decider of its own. Gives how many leaf pairs are visible.
    pub(crate) fn decide_filtered(&mut self) -> u64 {
        let (mut n_visible, mut links) = (0, Vec::new());
        for i in 0..self.pairs.len() {
            let (a, b) = self.pairs[i];
            let mut decider = Decider::new(self.room.scene());
            links.clear();
            if decider.decide(a, b, &mut links) == Status::Visible {
                links.push((a, b));
            }
            self.counts.add(&decider.counts());
            n_visible +=
                links.iter().map(|&(a, b)| self.n_leaves(a) * self.n_leaves(b)).sum::<u64>();
        }
        n_visible
    }

    /// Decides all blocks by plain floats. Gives how many leaf pairs are visible.
    pub(crate) fn decide_plain(&mut self) -> u64 {
        let mut n_visible = 0;
        for i in 0..self.pairs.len() {
            if self.prepare(i) > 0 {
                let [rows, columns] = self.firsts(i);
                let discs = &self.room.discs;
                n_visible += plain::n_visible(discs, [rows, columns], &self.open, &self.discs);
            }
        }
        n_visible
    }

    /// Does what both ways have in common, for all blocks; gives how many pairs face each other.
    pub(crate) fn prepare_all(&mut self) -> u64 {
        (0..self.pairs.len()).map(|i| self.prepare(i)).sum()
    }

    /// Refines the candidates of all blocks; gives how many were looked at.
    pub(crate) fn refine_all(&mut self) -> u64 {
        let bounds = &self.room.bounds;
        let ends = |&(a, b): &(u32, u32)| [a, b].map(|id| bounds[id as usize].centroids);
        let ends: Vec<[Box3; 2]> = self.pairs.iter().map(ends).collect();
        ends.iter().map(|ends| self.refine(ends)).sum()
    }

    /// Finds who faces whom in a block, and the discs that may be between those who do.
    fn prepare(&mut self, i: usize) -> u64 {
        let (a, b) = self.pairs[i];
        let Room { tree, discs, .. } = self.room;
        for (side, id) in self.sides.iter_mut().zip([a, b]) {
            let node = &tree.nodes[id as usize];
            side.load(discs, node.first_surfel..node.end_surfel, PROFILE);
        }
        let [rows, columns] = &self.sides;
        rows.faces(columns, &mut self.open);
        let (mut open_rows, mut open_columns) = (0, 0);
        for (row, &open) in self.open.iter().enumerate() {
            open_rows |= u64::from(open != 0) << row;
            open_columns |= open;
        }
        self.discs.clear();
        if open_rows != 0 {
            let ends = [rows.box_of(open_rows), columns.box_of(open_columns)];
            self.refine(&ends);
            self.discs.extend(blockers_of(&self.room.families, &self.candidates));
        }
        self.open.iter().map(|open| u64::from(open.count_ones())).sum()
    }

    fn refine(&mut self, ends: &[Box3; 2]) -> u64 {
        let families = &self.room.families;
        everything(families, &mut self.candidates);
        let (corridor, all) = (Corridor::new(&ends[0], &ends[1]), 0..self.candidates.len());
        let n = refine(families, &corridor, Depth::Leaves, &mut self.candidates, all.clone());
        self.candidates.drain(all);
        n
    }

    /// Gives the first surfel of the rows and of the columns.
    fn firsts(&self, i: usize) -> [u32; 2] {
        let (a, b) = self.pairs[i];
        [a, b].map(|id| self.room.tree.nodes[id as usize].first_surfel)
    }
}
