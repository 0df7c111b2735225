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
use crate::kernel::{Blockers, Counts, End, Recent};

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
    recent: Recent,
    /// Gathered statuses that are not in use.
    spare: Vec<Gathered>,
    /// Leaf pairs of the pair at hand that are not settled yet.
    open: Vec<(u32, u32)>,
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
            spare: Vec::new(),
            open: Vec::new(),
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
        let Scene { tree, bounds, .. } = self.scene;
        let facing = bounds::facing(&bounds[a as usize], &bounds[b as usize]);
        if facing == Facing::Never {
            return Status::Invisible;
        }
        if self.ends_in_leaves(a) && self.ends_in_leaves(b) {
            return self.leaf_pairs(a, b, list, links);
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

    /// Says whether kids(A) are leaves.
    fn ends_in_leaves(&self, id: u32) -> bool {
        self.scene.tree.kids(id).all(|k| self.scene.tree.nodes[k as usize].is_leaf())
    }

    /// Refines a list for a pair; the caller gives the room back.
    fn refined(&mut self, a: u32, b: u32, depth: Depth, list: Range<usize>) -> Range<usize> {
        let Scene { bounds, occluders, .. } = self.scene;
        let start = self.candidates.len();
        let corridor = Corridor::new(&bounds[a as usize], &bounds[b as usize]);
        self.counts.n_candidates += refine(occluders, &corridor, depth, &mut self.candidates, list);
        start..self.candidates.len()
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

    /// Decides kids(A) × kids(B), all leaves. What discs of late memory block is settled first;
    /// only if something is left are candidates looked for.
    fn leaf_pairs(&mut self, a: u32, b: u32, list: Range<usize>, links: &mut Vec<Pair>) -> Status {
        let mut gathered = self.spare.pop().unwrap_or_default();
        self.open.clear();
        self.try_recent(a, b, &mut gathered);
        if !self.open.is_empty() {
            let refined = self.refined(a, b, Depth::Leaves, list);
            self.try_candidates(refined.clone(), &mut gathered);
            self.candidates.truncate(refined.start);
        }
        self.settle(gathered, links)
    }

    /// Settles leaf pairs that do not face each other or that a remembered disc blocks.
    fn try_recent(&mut self, a: u32, b: u32, gathered: &mut Gathered) {
        let Scene { tree, discs, profile, .. } = self.scene;
        let surfel = |node: u32| tree.nodes[node as usize].first_surfel;
        for x in tree.kids(a) {
            let from = End::new(discs, surfel(x));
            self.recent.blockers().start_at(&from);
            for y in tree.kids(b) {
                let to = End::new(discs, surfel(y));
                if !faces_both(&discs[from.id as usize], &discs[to.id as usize]) {
                    gathered.note(x, y, Status::Invisible);
                    continue;
                }
                self.counts.n_segments += 1;
                let remembered = self.recent.blockers();
                if remembered.find(profile, discs, &from, &to, &mut self.counts).is_some() {
                    self.counts.n_remembered += 1;
                    gathered.note(x, y, Status::Invisible);
                } else {
                    self.open.push((x, y));
                }
            }
        }
    }

    /// Settles the open leaf pairs against a list that holds all their blockers.
    fn try_candidates(&mut self, list: Range<usize>, gathered: &mut Gathered) {
        let Scene { tree, discs, profile, .. } = self.scene;
        let surfel = |node: u32| tree.nodes[node as usize].first_surfel;
        let ids = self.candidates[list].iter().map(|&node| surfel(node));
        self.blockers.load(profile, discs, ids);
        self.counts.n_loaded += self.blockers.len() as u64;
        let open = std::mem::take(&mut self.open);
        for group in open.chunk_by(|p, q| p.0 == q.0) {
            let from = End::new(discs, surfel(group[0].0));
            self.blockers.start_at(&from);
            for &(x, y) in group {
                let to = End::new(discs, surfel(y));
                let found = self.blockers.find(profile, discs, &from, &to, &mut self.counts);
                let status = match found {
                    None => Status::Visible,
                    Some(position) => {
                        self.recent.remember(profile, discs, self.blockers.id(position));
                        Status::Invisible
                    }
                };
                gathered.note(x, y, status);
            }
        }
        self.open = open;
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
