//! The recursion over node pairs: the paper's Algorithm 2, corrected. Source: DESIGN.md [V-4],
//! [V-5]; Goradia et al. 2007 §4.2.
//!
//! As printed, Algorithm 2 is wrong on adaptive trees: a leaf against an inner node has no child
//! pairs and comes out VISIBLE untested, and a pair whose child pairs are all PARTIAL comes out
//! INVISIBLE. Here a leaf stands for itself among the children, and PARTIAL is counted.

use std::ops::Range;

use pvmap_geometry::disc::{Disc, Profile, faces_both};
use pvmap_store::runs::Pair;
use pvmap_vmap::Tree;

use crate::bounds::{self, Bounds, Facing};
use crate::candidates::{Corridor, Depth, Occluder, refine};
use crate::kernel::{Blockers, Counts, End};

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
    /// Every node as the culling sees it.
    pub occluders: &'a [Occluder],
    /// How discs block.
    pub profile: Profile,
}

/// The statuses of a pair's child pairs, gathered.
#[derive(Debug, Default)]
pub struct Gathered {
    visible: Vec<Pair>,
    n_others: usize,
    some_partial: bool,
}

impl Gathered {
    /// Notes the status of a child pair.
    pub fn note(&mut self, a: u32, b: u32, status: Status) {
        match status {
            Status::Visible => self.visible.push((a.min(b), a.max(b))),
            Status::Invisible => self.n_others += 1,
            Status::Partial => {
                self.n_others += 1;
                self.some_partial = true;
            }
        }
    }

    /// Gives the status of the pair; if it is PARTIAL its visible child pairs become links.
    pub fn settle(&self, links: &mut Vec<Pair>) -> Status {
        if self.n_others == 0 {
            return Status::Visible;
        }
        if self.visible.is_empty() && !self.some_partial {
            return Status::Invisible;
        }
        links.extend_from_slice(&self.visible);
        Status::Partial
    }
}

/// Decides node pairs on one thread; its buffers serve one pair after another.
#[derive(Debug)]
pub struct Decider<'a> {
    scene: Scene<'a>,
    /// Candidate lists of the open pairs, one behind the other.
    candidates: Vec<u32>,
    blockers: Blockers,
    /// Gathered statuses that are not in use.
    spare: Vec<Gathered>,
    /// Where in the list the last blocker was: the next segment is likely to meet it too.
    last_blocker: usize,
    /// What the kernel did so far.
    pub counts: Counts,
}

impl<'a> Decider<'a> {
    /// Makes a decider.
    pub fn new(scene: Scene<'a>) -> Decider<'a> {
        Decider {
            scene,
            candidates: Vec::new(),
            blockers: Blockers::default(),
            spare: Vec::new(),
            last_blocker: 0,
            counts: Counts::default(),
        }
    }

    /// Decides a pair of disjoint subtrees from scratch; links go to `links` in no order.
    pub fn decide(&mut self, a: u32, b: u32, links: &mut Vec<Pair>) -> Status {
        self.candidates.clear();
        self.candidates.push(0);
        self.pair(a, b, 0..1, links)
    }

    /// Decides a pair given a list that holds all its blockers.
    fn pair(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        self.counts.n_node_pairs += 1;
        let Scene { tree, bounds, occluders, .. } = self.scene;
        let (bound_a, bound_b) = (&bounds[a as usize], &bounds[b as usize]);
        let facing = bounds::facing(bound_a, bound_b);
        if facing == Facing::Never {
            return Status::Invisible;
        }
        let (node_a, node_b) = (&tree.nodes[a as usize], &tree.nodes[b as usize]);
        let last = self.ends_in_leaves(a) && self.ends_in_leaves(b);
        let depth = match last {
            true => Depth::Leaves,
            false => Depth::Level(node_a.level.max(node_b.level)),
        };
        let start = self.candidates.len();
        let corridor = Corridor::new(bound_a, bound_b);
        self.counts.n_candidates += refine(occluders, &corridor, depth, &mut self.candidates, list);
        let refined = start..self.candidates.len();
        let status = if refined.is_empty() && facing == Facing::All {
            Status::Visible
        } else if last {
            self.leaf_pairs(a, b, refined, links)
        } else {
            self.child_pairs(a, b, refined, links)
        };
        self.candidates.truncate(start);
        status
    }

    /// Says whether kids(A) are leaves.
    fn ends_in_leaves(&self, id: u32) -> bool {
        self.scene.tree.kids(id).all(|k| self.scene.tree.nodes[k as usize].is_leaf())
    }

    fn child_pairs(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        let tree = self.scene.tree;
        let mut gathered = self.spare.pop().unwrap_or_default();
        for x in tree.kids(a) {
            for y in tree.kids(b) {
                let status = self.pair(x, y, list.clone(), links);
                gathered.note(x, y, status);
            }
        }
        self.settle(gathered, links)
    }

    /// Decides kids(A) × kids(B), all leaves, against one list of leaves.
    fn leaf_pairs(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        let Scene { tree, discs, profile, .. } = self.scene;
        let surfel = |node: u32| tree.nodes[node as usize].first_surfel;
        let ids = self.candidates[list].iter().map(|&node| surfel(node));
        self.blockers.load(discs, ids);
        let mut gathered = self.spare.pop().unwrap_or_default();
        for x in tree.kids(a) {
            let from = End::new(discs, surfel(x));
            self.blockers.start_at(&from);
            for y in tree.kids(b) {
                let to = End::new(discs, surfel(y));
                let visible = faces_both(&discs[from.id as usize], &discs[to.id as usize])
                    && !self.is_blocked(profile, &from, &to);
                let status = if visible { Status::Visible } else { Status::Invisible };
                gathered.note(x, y, status);
            }
        }
        self.settle(gathered, links)
    }

    fn is_blocked(&mut self, profile: Profile, from: &End, to: &End) -> bool {
        let hint = self.last_blocker;
        let found = self.blockers.find(profile, self.scene.discs, from, to, hint, &mut self.counts);
        if let Some(k) = found {
            self.last_blocker = k;
        }
        found.is_some()
    }

    fn settle(&mut self, mut gathered: Gathered, links: &mut Vec<Pair>) -> Status {
        let status = gathered.settle(links);
        gathered.visible.clear();
        gathered.n_others = 0;
        gathered.some_partial = false;
        self.spare.push(gathered);
        status
    }
}
