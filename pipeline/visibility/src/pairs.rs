//! The recursion over node pairs: the paper's Algorithm 2, corrected. Source: DESIGN.md [V-4],
//! [V-5]; Goradia et al. 2007 §4.2.
//!
//! As printed, Algorithm 2 is wrong on adaptive trees: a leaf against an inner node has no child
//! pairs and comes out VISIBLE untested, and a pair whose child pairs are all PARTIAL comes out
//! INVISIBLE. Here a leaf stands for itself among the children, and PARTIAL is counted.

use std::ops::Range;

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_store::runs::Pair;
use pvmap_vmap::fraction::SEGMENTS;
use pvmap_vmap::{Fraction, Tree};

use crate::block::BlockDecider;
use crate::bounds::{self, Bounds, Facing};
use crate::candidates::{self, Corridor, Depth, Family, Kept, refine};
use crate::ends::MAX_ENDS;
use crate::fractions::{self, Tries, take_back};
use crate::kernel::Counts;
use crate::sheets::Sheets;

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
    /// The subtrees that lie along surfaces.
    pub sheets: &'a Sheets,
    /// How discs block.
    pub profile: Profile,
    /// What is tried by a sample.
    pub tries: Tries<'a>,
}

impl Scene<'_> {
    /// Says whether a pair is tried by a sample instead of being opened. [F-26]
    pub fn is_tried(&self, a: u32, b: u32) -> bool {
        let is_leaf = |id: u32| self.tree.nodes[id as usize].is_leaf();
        let exchange = self.tries.exchange;
        exchange.is_some_and(|exchange| exchange.is_below(a, b)) && !(is_leaf(a) && is_leaf(b))
    }

    /// Decides whether the surfels of two nodes face each other. Source: DESIGN.md [V-1].
    #[inline]
    pub fn facing(&self, a: u32, b: u32) -> Facing {
        bounds::facing(&self.bounds[a as usize], &self.bounds[b as usize])
    }
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
                take_back(links, self.from);
                Status::Visible
            }
            (false, false) => Status::Invisible,
            (false, true) => Status::Partial,
        }
    }
}

/// Leaf pairs that are decided together, at most.
const BLOCK_PAIRS: u32 = 1024;
/// The same where there are sheets.
const SHEET_BLOCK_PAIRS: u32 = 4096;

/// How many node pairs were settled in which way; together all the recursion looked at.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Settled {
    /// No leaf faces any.
    pub n_never_facing: u64,
    /// All face each other and nothing can be between.
    pub n_clear: u64,
    /// By all leaf pairs at once.
    pub n_blocks: u64,
    /// By child pairs.
    pub n_opened: u64,
    /// By a sample.
    pub n_tried: u64,
}

/// Decides node pairs on one thread; its buffers serve one pair after another.
#[derive(Debug)]
pub struct Decider<'a> {
    scene: Scene<'a>,
    /// Candidate lists of the open pairs, one behind the other.
    candidates: Vec<Kept>,
    block: BlockDecider<'a>,
    block_pairs: u32,
    counts: Counts,
    /// How pairs were settled so far.
    pub settled: Settled,
}

impl<'a> Decider<'a> {
    /// Makes a decider that decides up to 1024 leaf pairs at once, 4096 where there are sheets.
    pub fn new(scene: Scene<'a>) -> Decider<'a> {
        // What is tried must not depend on what memory the sheets had.
        let is_tried = scene.tries.fractions || scene.tries.exchange.is_some();
        let are_sheets = !scene.sheets.is_empty() && !is_tried;
        Decider::with_blocks_of(if are_sheets { SHEET_BLOCK_PAIRS } else { BLOCK_PAIRS }, scene)
    }

    /// Makes a decider that decides up to so many leaf pairs at once, at least 1. What it finds is
    /// the same for every size; with small blocks more is left to the proofs about node pairs.
    pub fn with_blocks_of(block_pairs: u32, scene: Scene<'a>) -> Decider<'a> {
        Decider {
            scene,
            candidates: Vec::new(),
            block: BlockDecider::new(scene),
            block_pairs: block_pairs.max(1),
            counts: Counts::default(),
            settled: Settled::default(),
        }
    }

    /// Gives what it took so far.
    pub fn counts(&self) -> Counts {
        let mut counts = self.counts;
        counts.add(&self.block.counts);
        counts
    }

    /// Decides a pair of disjoint subtrees from scratch; links go to `links` in no order. A node
    /// with itself stands for all pairs of siblings under it, which have no status of their own:
    /// those of them that are links go to `links`, too.
    pub fn decide(&mut self, a: u32, b: u32, links: &mut Vec<Pair>) -> Status {
        if a == b {
            self.siblings_under(a, links);
            return Status::Invisible;
        }
        candidates::everything(self.scene.families, &mut self.candidates);
        self.pair(a, b, 0..self.candidates.len(), links)
    }

    fn siblings_under(&mut self, top: u32, links: &mut Vec<Pair>) {
        let tree = self.scene.tree;
        for parent in top..tree.nodes[top as usize].end {
            for a in tree.children(parent) {
                let mut b = tree.nodes[a as usize].end;
                while b < tree.nodes[parent as usize].end {
                    if self.decide(a, b, links) == Status::Visible {
                        links.push((a, b));
                    }
                    b = tree.nodes[b as usize].end;
                }
            }
        }
    }

    /// Decides a pair given a list that holds all its blockers.
    fn pair(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        self.counts.n_node_pairs += 1;
        let Scene { tree, bounds, .. } = self.scene;
        let facing = self.scene.facing(a, b);
        if facing == Facing::Never {
            self.settled.n_never_facing += 1;
            return Status::Invisible;
        }
        if self.scene.is_tried(a, b) {
            self.settled.n_tried += 1;
            return self.try_nodes((a, b), list, links);
        }
        let (n_a, n_b) = (self.n_leaves(a), self.n_leaves(b));
        let is_block = n_a.max(n_b) <= MAX_ENDS as u32 && n_a * n_b <= self.block_pairs;
        if is_block && facing != Facing::All {
            return self.block((a, b), list, links);
        }
        let level = tree.nodes[a as usize].level.max(tree.nodes[b as usize].level);
        let ends = [a, b].map(|id| bounds[id as usize].centroids);
        let start = self.candidates.len();
        let corridor = Corridor::new(&ends[0], &ends[1]);
        let depth = if is_block { Depth::Sheets } else { Depth::Level(level) };
        let families = self.scene.families;
        self.counts.n_candidates += refine(families, &corridor, depth, &mut self.candidates, list);
        let refined = start..self.candidates.len();
        let status = if refined.is_empty() && facing == Facing::All {
            self.settled.n_clear += 1;
            Status::Visible
        } else if is_block {
            self.block((a, b), refined, links)
        } else {
            self.settled.n_opened += 1;
            self.child_pairs(a, b, refined, links)
        };
        self.candidates.truncate(start);
        status
    }

    fn block(&mut self, pair: Pair, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        self.settled.n_blocks += 1;
        self.block.decide(pair, &mut self.candidates, list, links)
    }

    /// Settles a pair by a sample: by the more of its segments, and how many these are is noted.
    fn try_nodes(&mut self, (a, b): Pair, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        let n_free = self.block.try_nodes((a, b), &mut self.candidates, list);
        if n_free > 0 {
            links.push(fractions::marked(Fraction { a: a.min(b), b: a.max(b), n_free }));
        }
        if n_free >= SEGMENTS / 2 { Status::Visible } else { Status::Invisible }
    }

    fn n_leaves(&self, id: u32) -> u32 {
        let node = &self.scene.tree.nodes[id as usize];
        node.end_surfel - node.first_surfel
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
}

#[cfg(test)]
mod tests;
