//! The recursion over node pairs: the paper's Algorithm 2, corrected. Source: DESIGN.md [V-4],
//! [V-5]; Goradia et al. 2007 §4.2.
//!
//! As printed, Algorithm 2 is wrong on adaptive trees: a leaf against an inner node has no child
//! pairs and comes out VISIBLE untested, and a pair whose child pairs are all PARTIAL comes out
//! INVISIBLE. Here a leaf stands for itself among the children, and PARTIAL is counted.

use std::ops::Range;

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_store::runs::Pair;
use pvmap_vmap::Tree;

use crate::bounds::{self, Bounds, Facing};
use crate::candidates::{self, Corridor, Depth, Family, Kept, refine};
use crate::kernel::{Blockers, Counts, Recent};
use crate::lanes::{Ends, Tile, WIDTH};

/// What all leaf pairs of a node pair have in common. Source: DESIGN.md [V-4].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Every leaf pair is visible.
    Visible,
    /// None is.
    Invisible,
    /// Some are.
    Partial,
}

/// What every pair is decided from.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// Nodes and surfels.
    pub tree: &'a Tree,
    /// The surfels as the profile sees them.
    pub discs: &'a [Disc],
    /// Bounds of every node.
    pub bounds: &'a [Bounds],
    /// All nodes as the culling sees them.
    pub families: &'a [Family],
    /// How discs block.
    pub profile: Profile,
}

/// The statuses of a pair's child pairs, gathered. Links found below go to the one list of links;
/// if in the end all child pairs are VISIBLE those of this pair are taken back.
#[derive(Debug)]
pub struct Gathered {
    /// Length of the list of links before this pair.
    from: usize,
    all_visible: bool,
    any_visible: bool,
}

impl Gathered {
    /// Starts a pair.
    pub fn new(links: &[Pair]) -> Gathered {
        Gathered { from: links.len(), all_visible: true, any_visible: false }
    }

    /// Notes the status of a child pair.
    #[inline]
    pub fn note(&mut self, a: u32, b: u32, status: Status, links: &mut Vec<Pair>) {
        match status {
            Status::Visible => links.push((a.min(b), a.max(b))),
            Status::Invisible | Status::Partial => self.all_visible = false,
        }
        self.any_visible |= status != Status::Invisible;
    }

    /// Gives the status of the pair.
    #[inline]
    pub fn settle(&self, links: &mut Vec<Pair>) -> Status {
        match (self.all_visible, self.any_visible) {
            (true, _) => {
                links.truncate(self.from);
                Status::Visible
            }
            (false, false) => Status::Invisible,
            (false, true) => Status::Partial,
        }
    }
}

/// Leaves of a side of a block at most: the bits of a mask.
const MAX_SIDE: u32 = u64::BITS;
/// Leaf pairs that are decided together, at most.
const BLOCK_PAIRS: u32 = 1024;

/// Decides node pairs on one thread; its buffers serve one pair after another.
#[derive(Debug)]
pub struct Decider<'a> {
    scene: Scene<'a>,
    /// Candidate lists of the open pairs, one behind the other.
    candidates: Vec<Kept>,
    blockers: Blockers,
    recent: Recent,
    /// The rows and the columns of the block at hand, by eights.
    sides: [Vec<Ends>; 2],
    /// For each row of the block, a bit a column that nothing has blocked yet.
    open: Vec<u64>,
    /// What it took so far.
    pub counts: Counts,
}

impl<'a> Decider<'a> {
    /// Makes a decider.
    pub fn new(scene: Scene<'a>) -> Decider<'a> {
        Decider {
            scene,
            candidates: Vec::new(),
            blockers: Blockers::default(),
            recent: Recent::default(),
            sides: [Vec::new(), Vec::new()],
            open: Vec::new(),
            counts: Counts::default(),
        }
    }

    /// Decides a pair of disjoint subtrees from scratch; links go to `links` in no order.
    pub fn decide(&mut self, a: u32, b: u32, links: &mut Vec<Pair>) -> Status {
        candidates::everything(self.scene.families, &mut self.candidates);
        self.pair(a, b, 0..self.candidates.len(), links)
    }

    /// Decides a pair given a list that holds all its blockers.
    fn pair(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        self.counts.n_node_pairs += 1;
        let Scene { tree, bounds, .. } = self.scene;
        let facing = bounds::facing(&bounds[a as usize], &bounds[b as usize]);
        if facing == Facing::Never {
            return Status::Invisible;
        }
        let (n_a, n_b) = (self.n_leaves(a), self.n_leaves(b));
        if n_a.max(n_b) <= MAX_SIDE && n_a * n_b <= BLOCK_PAIRS {
            return self.block(a, b, list, links);
        }
        let level = tree.nodes[a as usize].level.max(tree.nodes[b as usize].level);
        let refined = self.refined(a, b, Depth::Level(level), list);
        let status = if refined.is_empty() && facing == Facing::All {
            Status::Visible
        } else {
            self.child_pairs(a, b, refined.clone(), links)
        };
        self.candidates.truncate(refined.start);
        status
    }

    fn n_leaves(&self, id: u32) -> u32 {
        let node = &self.scene.tree.nodes[id as usize];
        node.end_surfel - node.first_surfel
    }

    /// Refines a list for a pair; the caller gives the room back.
    fn refined(&mut self, a: u32, b: u32, depth: Depth, list: Range<usize>) -> Range<usize> {
        let Scene { bounds, families, .. } = self.scene;
        let start = self.candidates.len();
        let corridor = Corridor::new(&bounds[a as usize], &bounds[b as usize]);
        self.counts.n_candidates += refine(families, &corridor, depth, &mut self.candidates, list);
        start..self.candidates.len()
    }

    fn child_pairs(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        let tree = self.scene.tree;
        let mut gathered = Gathered::new(links);
        for x in tree.kids(a) {
            for y in tree.kids(b) {
                let status = self.pair(x, y, list.clone(), links);
                gathered.note(x, y, status, links);
            }
        }
        gathered.settle(links)
    }

    /// Decides all leaf pairs under a pair at once: rows are the leaves under `a`, columns those
    /// under `b`. What discs of late memory block is settled first; only if something is left are
    /// candidates looked for.
    fn block(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        self.load_block(a, b);
        if self.try_recent() {
            let refined = self.refined(a, b, Depth::Leaves, list);
            self.try_candidates(refined.clone());
            self.candidates.truncate(refined.start);
        }
        let first = [a, b].map(|id| self.scene.tree.nodes[id as usize].first_surfel);
        Block { tree: self.scene.tree, first, open: &self.open }.fold(a, b, links)
    }

    /// Loads the leaves of a block and opens the pairs that face each other.
    fn load_block(&mut self, a: u32, b: u32) {
        let Scene { tree, discs, .. } = self.scene;
        for (side, id) in self.sides.iter_mut().zip([a, b]) {
            let node = &tree.nodes[id as usize];
            let starts = (node.first_surfel..node.end_surfel).step_by(WIDTH);
            side.clear();
            side.extend(
                starts.map(|first| {
                    Ends::new(discs, first..node.end_surfel.min(first + WIDTH as u32))
                }),
            );
        }
        let [rows, columns] = &self.sides;
        self.open.clear();
        self.open.resize(rows.len() * WIDTH, 0);
        for (rows, open) in rows.iter().zip(self.open.chunks_mut(WIDTH)) {
            for (i, columns) in columns.iter().enumerate() {
                for (open, facing) in open.iter_mut().zip(rows.faces(columns)) {
                    *open |= facing << (i * WIDTH);
                }
            }
        }
    }

    /// Closes what a remembered disc blocks; says whether something is still open.
    fn try_recent(&mut self) -> bool {
        let Scene { discs, profile, .. } = self.scene;
        let counts = &mut self.counts;
        let blockers = self.recent.blockers();
        let mut n_left = 0;
        for_open_tiles(&self.sides, &mut self.open, |tile| {
            let n_open = tile.n_open();
            blockers.shoot(profile, discs, tile, counts);
            let left = tile.n_open();
            counts.n_segments += n_open;
            counts.n_remembered += n_open - left;
            n_left += left;
        });
        n_left > 0
    }

    /// Closes what a list blocks that holds all blockers of the block.
    fn try_candidates(&mut self, list: Range<usize>) {
        let Scene { tree, discs, bounds, families, profile } = self.scene;
        let surfel = |node: u32| tree.nodes[node as usize].first_surfel;
        let leaves = candidates::nodes_of(families, &self.candidates[list]);
        let reaches = leaves.map(|k| (surfel(k), bounds[k as usize].blockers));
        self.blockers.load(discs, reaches);
        self.counts.n_loaded += self.blockers.len() as u64;
        if self.blockers.is_empty() {
            return;
        }
        for_open_tiles(&self.sides, &mut self.open, |tile| {
            if let Some((id, reach)) = self.blockers.shoot(profile, discs, tile, &mut self.counts) {
                self.recent.remember(discs, id, &reach);
            }
        });
    }
}

/// Hands out the tiles of a block in which some segment is open.
fn for_open_tiles(sides: &[Vec<Ends>; 2], open: &mut [u64], mut shoot: impl FnMut(&mut Tile<'_>)) {
    let [rows, columns] = sides;
    for (rows, open) in rows.iter().zip(open.chunks_mut(WIDTH)) {
        for (i, columns) in columns.iter().enumerate() {
            let mut tile = Tile { rows, columns, open: [0; WIDTH] };
            for (lanes, open) in tile.open.iter_mut().zip(&*open) {
                *lanes = open >> (i * WIDTH) & 0xff;
            }
            if tile.open == [0; WIDTH] {
                continue;
            }
            let before = tile.open;
            shoot(&mut tile);
            for ((open, before), after) in open.iter_mut().zip(before).zip(tile.open) {
                *open &= !((before & !after) << (i * WIDTH));
            }
        }
    }
}

/// The decided leaf pairs of a block.
struct Block<'a> {
    tree: &'a Tree,
    /// The first surfel of the rows and of the columns.
    first: [u32; 2],
    /// The visible columns of each row, a bit each.
    open: &'a [u64],
}

impl Block<'_> {
    /// Makes statuses and links of the leaf pairs under a pair of nodes of the block.
    fn fold(&self, a: u32, b: u32, links: &mut Vec<Pair>) -> Status {
        let [rows, columns] = [(a, self.first[0]), (b, self.first[1])].map(|(id, first)| {
            let node = &self.tree.nodes[id as usize];
            (node.first_surfel - first) as usize..(node.end_surfel - first) as usize
        });
        let mask = (u64::MAX >> (u64::BITS as usize - columns.len())) << columns.start;
        let rows = &self.open[rows];
        if rows.iter().all(|open| open & mask == 0) {
            return Status::Invisible;
        }
        if rows.iter().all(|open| open & mask == mask) {
            return Status::Visible;
        }
        for x in self.tree.kids(a) {
            for y in self.tree.kids(b) {
                if self.fold(x, y, links) == Status::Visible {
                    links.push((x.min(y), x.max(y)));
                }
            }
        }
        Status::Partial
    }
}
