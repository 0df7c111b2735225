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

use crate::block::BlockDecider;
use crate::bounds::{self, Bounds, Facing};
use crate::candidates::{self, Corridor, Depth, Family, Kept, refine};
use crate::ends::MAX_ENDS;
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
}

impl Scene<'_> {
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
                links.truncate(self.from);
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
        let are_sheets = !scene.sheets.is_empty();
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
mod tests {
    use super::*;
    use crate::candidates::families;
    use crate::interaction::sibling_pairs;
    use crate::layers::Layer;
    use crate::tasks::{Plan, PlanLimits, Plans, n_leaf_pairs, target_of};
    use fastrand::Rng;
    use pvmap_geometry::{Box3, disc, morton, normal};
    use pvmap_store::{Quiet, Table};
    use pvmap_vmap::records::NO_PARENT;
    use pvmap_vmap::{Node, Split};

    /// A tree over discs in leaf order, one a leaf.
    struct Grown {
        tree: Tree,
        discs: Vec<Disc>,
        /// Whether the root's children are bins.
        is_binned: bool,
        /// No leaf is above this level: it makes chains of single children.
        least_level: u8,
    }

    impl Grown {
        fn new(mut discs: Vec<Disc>, is_binned: bool, least_level: u8) -> Grown {
            let key = |d: &Disc| (if is_binned { bin(d) } else { 0 }, code(d));
            discs.sort_by_key(key);
            discs.dedup_by_key(|d| key(d));
            let all = 0..discs.len() as u32;
            let mut grown = Grown { tree: Tree::default(), discs, is_binned, least_level };
            grown.add(all, NO_PARENT, 0);
            grown
        }

        fn add(&mut self, surfels: Range<u32>, parent: u32, level: u8) {
            let id = self.tree.nodes.len() as u32;
            let is_bins = id == 0 && self.is_binned;
            let is_leaf = !is_bins && surfels.len() == 1 && level >= self.least_level;
            self.tree.nodes.push(Node {
                parent,
                end: 0,
                first_surfel: surfels.start,
                end_surfel: surfels.end,
                n_points: surfels.len() as u64,
                first_code: 0,
                level,
                bin: -1,
                split: if is_leaf { Split::Leaf } else { Split::Octants },
                slot: 0,
                overhang: 0,
            });
            let mut rest = surfels;
            while !is_leaf && !rest.is_empty() {
                let slot = |s: u32| match &self.discs[s as usize] {
                    disc if is_bins => bin(disc),
                    disc => morton::octant(code(disc), level + 1),
                };
                let end = rest.clone().find(|&s| slot(s) != slot(rest.start)).unwrap_or(rest.end);
                self.add(rest.start..end, id, if is_bins { 0 } else { level + 1 });
                rest.start = end;
            }
            self.tree.nodes[id as usize].end = self.tree.nodes.len() as u32;
        }
    }

    fn bin(disc: &Disc) -> u8 {
        normal::bin(disc.normal, !disc.two_sided)
    }

    fn code(disc: &Disc) -> u64 {
        morton::encode(disc.centroid.map(|c| c as u32))
    }

    /// Draws discs of a room with furniture, of walls that face each other with or without a
    /// screen between, or of noise; in a corner of the cube, the far one now and then.
    fn random_discs(rng: &mut Rng, n: usize) -> Vec<Disc> {
        let (kind, n_steps) = (rng.u8(..3), 1 << rng.u32(4..9));
        let step = 1 << rng.u32(1..=22 - u32::ilog2(n_steps as u32));
        let origin = if rng.bool() { 0 } else { (1 << 22) - n_steps * step };
        let (screen, two_sided) = (rng.u8(..3), rng.u8(..4));
        let disc = |_| {
            let mut p = [0; 3].map(|_| rng.i32(0..n_steps));
            let mut n = [0; 3].map(|_| rng.i64(-9..=9));
            let axis = if kind == 0 { rng.usize(..3) } else { 0 };
            let place = rng.u8(..if kind == 0 { 8 } else { 16 });
            if kind < 2 {
                n = [0; 3];
                (p[axis], n[axis]) = match place {
                    0 => (n_steps / 2, if rng.bool() { 1 } else { -1 }),
                    _ if place.is_multiple_of(2) => (0, 1),
                    _ => (n_steps - 1, -1),
                };
                if place == 0 {
                    let by = if screen == 0 { 31 } else { i32::from(screen) };
                    p[(axis + 1) % 3] /= by;
                }
            }
            let centroid = p.map(|c| origin + c * step);
            let r = rng.u64(0..=step as u64 * if kind == 0 { 4 } else { 2 });
            let normal = normal::rescale(n);
            Disc {
                centroid,
                normal,
                two_sided: two_sided > rng.u8(1..4),
                radius2: r * r,
                limit: Box3::at(centroid).grown(rng.i32(1..=step * 2)),
                rect: bounds::tests::rect(rng, normal, step * 2),
            }
        };
        (0..n).map(disc).collect()
    }

    /// A random tree and all that is known of it.
    struct Stage {
        grown: Grown,
        profile: Profile,
        bounds: Table<Bounds>,
        sheets: Sheets,
        families: Table<Family>,
    }

    impl Stage {
        /// Grows a tree over at most `n` random discs.
        fn random(rng: &mut Rng, n: usize) -> Stage {
            let grown = Grown::new(random_discs(rng, n), rng.bool(), rng.u8(0..6));
            let profile = [Profile::Paper, Profile::Patch, Profile::Oriented][rng.usize(..3)];
            let folder = Some(std::env::temp_dir()).filter(|_| n.is_multiple_of(4));
            let folder = folder.as_deref();
            // For all sheets, or for one.
            let memory_bytes = if n % 8 == 1 { Sheets::A_SHEET_BYTES } else { u64::MAX };
            let bounds = bounds::of_tree(&grown.tree, &grown.discs, profile, folder).unwrap();
            let (tree, discs) = (&grown.tree, &grown.discs);
            let (sheets, _) = Sheets::all(tree, discs, &bounds, memory_bytes, &Quiet).unwrap();
            let families = families(&grown.tree, &bounds, &sheets, folder).unwrap();
            Stage { grown, profile, bounds, sheets, families }
        }

        fn scene(&self) -> Scene<'_> {
            let Stage { grown, profile, bounds, sheets, families } = self;
            let Grown { tree, discs, .. } = grown;
            Scene { tree, discs, bounds, families, sheets, profile: *profile }
        }
    }

    /// Says of all leaf pairs whether they are visible: [V-1]…[V-3] as they stand.
    fn brute_force(discs: &[Disc], profile: Profile) -> Vec<Vec<bool>> {
        let sees = |a: usize, b: usize| {
            let mut others = (0..discs.len()).filter(|&k| k != a && k != b);
            disc::faces_both(&discs[a], &discs[b])
                && !others.any(|k| disc::blocks(profile, &discs[a], &discs[b], &discs[k]))
        };
        let mut table = vec![vec![false; discs.len()]; discs.len()];
        for a in 0..discs.len() {
            for b in a + 1..discs.len() {
                table[a][b] = sees(a, b);
                table[b][a] = table[a][b];
            }
        }
        table
    }

    /// Gives the status of a pair and the links below it: [V-4] and [V-5] as they stand.
    fn expected(tree: &Tree, sees: &[Vec<bool>], (a, b): Pair, links: &mut Vec<Pair>) -> Status {
        let leaves = |id: u32| {
            let node = &tree.nodes[id as usize];
            node.first_surfel as usize..node.end_surfel as usize
        };
        let rows = sees[leaves(a)].iter();
        let n_visible: usize = rows.map(|row| row[leaves(b)].iter().filter(|v| **v).count()).sum();
        if n_visible == 0 {
            return Status::Invisible;
        }
        if n_visible == leaves(a).len() * leaves(b).len() {
            return Status::Visible;
        }
        for (x, y) in tree.kids(a).flat_map(|x| tree.kids(b).map(move |y| (x, y))) {
            if expected(tree, sees, (x, y), links) == Status::Visible {
                links.push((x.min(y), x.max(y)));
            }
        }
        Status::Partial
    }

    #[test]
    fn d6_every_way_to_settle_a_pair_is_brute_force() {
        let n_trees = if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { 2000 } else { 120 };
        for block_pairs in [1, 4, 16, BLOCK_PAIRS, SHEET_BLOCK_PAIRS] {
            let mut settled = Settled::default();
            let (mut n_statuses, mut counts) = ([0; 3], Counts::default());
            for seed in 0..n_trees {
                let rng = &mut Rng::with_seed(seed);
                let n = rng.usize(20..200);
                let stage = Stage::random(rng, n);
                let (scene, tree) = (stage.scene(), &stage.grown.tree);
                let sees = brute_force(scene.discs, scene.profile);
                // One decider for all pairs, as in a build: what it remembers is tried too.
                let mut decider = Decider::with_blocks_of(block_pairs, scene);
                for (a, b) in sibling_pairs(tree) {
                    let [mut found, mut right] = [Vec::new(), Vec::new()];
                    let status = decider.decide(a, b, &mut found);
                    assert_eq!(status, expected(tree, &sees, (a, b), &mut right), "{seed} {a} {b}");
                    found.sort_unstable();
                    right.sort_unstable();
                    assert_eq!(found, right, "tree {seed}, blocks of {block_pairs}, {a} and {b}");
                    n_statuses[status as usize] += 1;
                }
                settled.n_never_facing += decider.settled.n_never_facing;
                settled.n_clear += decider.settled.n_clear;
                settled.n_blocks += decider.settled.n_blocks;
                settled.n_opened += decider.settled.n_opened;
                counts.add(&decider.counts());
            }
            assert!(counts.n_by_sheets > 100 && counts.n_unsure > 100, "{counts:?}");
            eprintln!("blocks of {block_pairs}: {settled:?}, {n_statuses:?} pairs of each status");
            let Settled { n_never_facing, n_clear, n_blocks, n_opened } = settled;
            let ways = [n_never_facing, n_clear, n_blocks, n_opened];
            // A tree of some hundred leaves is settled whole in blocks of the usual size.
            let n_least = if block_pairs < BLOCK_PAIRS { 1000 } else { 0 };
            assert!(ways.into_iter().chain(n_statuses).all(|n| n >= n_least), "a way not tried");
        }
    }

    #[test]
    fn sheets_are_asked_where_most_surfels_are_in_them() {
        let rng = &mut Rng::with_seed(7);
        let step = 1 << 16;
        let disc = |centroid: [i32; 3], normal| Disc {
            centroid,
            normal,
            two_sided: false,
            radius2: 1 << 32,
            limit: Box3::at(centroid).grown(step / 2),
            rect: pvmap_geometry::Rect::NONE,
        };
        let wall = |i: i32| {
            disc([step, (2 * (i % 16) + 1) * step, (2 * (i / 16) + 1) * step], [1 << 14, 0, 0])
        };
        for (n_others, memory_bytes, are_asked) in [
            (0, u64::MAX, true),
            (60, u64::MAX, true),
            (150, u64::MAX, false),
            // What counts is what there is, not what there is room for.
            (60, Sheets::A_SHEET_BYTES, true),
            (60, 0, false),
        ] {
            let other = |_| {
                let normal = [0; 3].map(|_| rng.i64(-9..=9));
                disc([0; 3].map(|_| rng.i32(4..60) * step), normal::rescale(normal))
            };
            let discs = (0..256).map(wall).chain((0..n_others).map(other)).collect();
            let Grown { tree, discs, .. } = Grown::new(discs, true, 0);
            let bounds = bounds::of_tree(&tree, &discs, Profile::Patch, None).unwrap();
            let sheets = Sheets::new(&tree, &discs, &bounds, memory_bytes, &Quiet).unwrap();
            assert_eq!(!sheets.is_empty(), are_asked, "{n_others} others, {memory_bytes} bytes");
        }
    }

    #[test]
    fn d7_no_leaf_pair_is_tested_twice() {
        for seed in 0..60 {
            let rng = &mut Rng::with_seed(seed);
            let n = rng.usize(20..300);
            let stage = Stage::random(rng, n);
            for block_pairs in [1, 16, BLOCK_PAIRS] {
                let mut decider = Decider::with_blocks_of(block_pairs, stage.scene());
                for (a, b) in sibling_pairs(&stage.grown.tree) {
                    decider.decide(a, b, &mut Vec::new());
                }
                let n = stage.scene().discs.len() as u64;
                let n_tested = decider.counts().n_segments;
                assert!(n_tested <= n * (n - 1) / 2, "tree {seed}: {n_tested} of {n} leaves");
            }
        }
    }

    #[test]
    fn d6_tasks_put_together_are_brute_force() {
        let (mut n_above, mut n_tasks) = (0, 0);
        for seed in 0..48 {
            let rng = &mut Rng::with_seed(seed);
            // Only large trees are cut where the tasks are of the usual size.
            let (n, task_links) = match seed % 8 {
                0 => (700, u64::MAX),
                i => (rng.usize(20..200), [1, 9, 80, 700][i as usize % 4]),
            };
            let stage = Stage::random(rng, n);
            let (scene, tree) = (stage.scene(), &stage.grown.tree);
            let all = sibling_pairs(tree);
            // All siblings in one, or each as if the user had given it.
            let starts = if seed % 3 == 0 { all.clone() } else { vec![(0, 0)] };
            let limits = PlanLimits { task_links, memory_bytes: 1 << 30 };
            let n_pairs = starts.iter().map(|&pair| n_leaf_pairs(tree, pair)).sum();
            let target = target_of(n_pairs, &limits);
            let plan = Plan::new(&scene, &starts, target, limits.memory_bytes).unwrap();
            let mut decider = Decider::new(scene);
            let [mut found, mut right] = [Vec::new(), Vec::new()];
            let decided = plan.tasks.iter().map(|&(a, b)| decider.decide(a, b, &mut found));
            let statuses: Vec<Option<Status>> = decided.map(Some).collect();
            let n_below = found.len();
            found.extend(plan.combine(&statuses));
            n_above += found.len() - n_below;
            n_tasks += plan.tasks.iter().filter(|task| !starts.contains(task)).count();
            let sees = brute_force(scene.discs, scene.profile);
            for &pair in &all {
                if expected(tree, &sees, pair, &mut right) == Status::Visible {
                    right.push(pair);
                }
            }
            found.sort_unstable();
            right.sort_unstable();
            assert!(found == right, "tree {seed}: {} links, not {}", found.len(), right.len());
        }
        eprintln!("{n_tasks} tasks that are no start, {n_above} links above tasks");
        assert!(n_tasks > 1000 && n_above > 1000, "{n_tasks} {n_above}");
    }

    #[test]
    fn plans_of_more_than_they_may_have_in_all_are_refused() {
        let stage = Stage::random(&mut Rng::with_seed(8), 700);
        let (scene, tree) = (stage.scene(), &stage.grown.tree);
        let (target, limits) = (9, PlanLimits { task_links: 9, memory_bytes: 1 << 30 });
        let plan = |n_layers: usize, n_planned: u32| {
            let layers: Vec<Layer<'_>> =
                (0..n_layers).map(|_| Layer::all(tree, vec![(0, 0)])).collect();
            let scenes = vec![scene; n_layers];
            Plans::of_at_most(n_planned, &scenes, &layers, target, &limits).map(|p| p.n_tasks())
        };
        let (mut too_few, mut n_of_one) = (0, 1 << 20);
        while n_of_one - too_few > 1 {
            let n = (too_few + n_of_one) / 2;
            *if plan(1, n).is_ok() { &mut n_of_one } else { &mut too_few } = n;
        }
        let n_tasks = plan(1, n_of_one).unwrap();
        assert!(n_of_one > 100 && plan(3, 3 * n_of_one - 1).is_err());
        assert_eq!(plan(3, 3 * n_of_one).unwrap(), 3 * n_tasks);
    }
}
