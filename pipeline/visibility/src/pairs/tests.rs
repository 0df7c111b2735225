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
        let (tree, discs) = (&grown.tree, &grown.discs);
        let bounds = bounds::of_tree(tree, discs, profile, false, folder).unwrap();
        let (sheets, _) = Sheets::all(tree, discs, &bounds, memory_bytes, &Quiet).unwrap();
        let families = families(&grown.tree, &bounds, &sheets, folder).unwrap();
        Stage { grown, profile, bounds, sheets, families }
    }

    fn scene(&self) -> Scene<'_> {
        let Stage { grown, profile, bounds, sheets, families } = self;
        let Grown { tree, discs, .. } = grown;
        let tries = Tries::default();
        Scene { tree, discs, bounds, families, sheets, profile: *profile, tries }
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
        let Settled { n_never_facing, n_clear, n_blocks, n_opened, n_tried: _ } = settled;
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
        let bounds = bounds::of_tree(&tree, &discs, Profile::Patch, false, None).unwrap();
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
