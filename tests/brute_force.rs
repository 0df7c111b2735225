//! Maps against brute force: every link, every status and every leaf of random small trees,
//! recomputed from the surfels and nodes of the finished file by the words of DESIGN.md.
//!
//! 200 trees in a plain run, 2 000 where PVMAP_SLOW_TESTS is set.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
#[path = "common/model.rs"]
mod model;

use std::collections::BTreeSet;
use std::ops::AddAssign;
use std::path::Path;

use fastrand::Rng;
use pvmap::geometry::Positions;
use pvmap::geometry::disc::Profile;
use pvmap::query::{Located, Map};
use pvmap::vmap::{MapView, OctreeView, Shape, Spacing, Split};
use pvmap::{BuildConfig, Error, Limits, NormalsFrom, Orientation, Quiet};

use crate::common::{
    Cloud, build_with, contents, ingest_with, is_slow_run, on_threads, random_cloud, rects,
};
use crate::model::{Leaf, Model, Status, holds_point};

/// What the trees of a run had in them: a test of nothing must not pass.
#[derive(Debug, Default, Clone, Copy)]
struct Seen {
    leaf_pairs: u64,
    visible: u64,
    blocked: u64,
    links: u64,
    links_above_leaves: u64,
    links_of_a_leaf_and_more: u64,
    partial: u64,
    partial_by_partial_alone: u64,
    node_pairs: u64,
    two_sided: u64,
    one_sided: u64,
    zero_normals: u64,
    quadrants: u64,
}

impl AddAssign for Seen {
    fn add_assign(&mut self, other: Seen) {
        self.leaf_pairs += other.leaf_pairs;
        self.visible += other.visible;
        self.blocked += other.blocked;
        self.links += other.links;
        self.links_above_leaves += other.links_above_leaves;
        self.links_of_a_leaf_and_more += other.links_of_a_leaf_and_more;
        self.partial += other.partial;
        self.partial_by_partial_alone += other.partial_by_partial_alone;
        self.node_pairs += other.node_pairs;
        self.two_sided += other.two_sided;
        self.one_sided += other.one_sided;
        self.zero_normals += other.zero_normals;
        self.quadrants += other.quadrants;
    }
}

/// Writes a cloud as LAS, single PLY or double PLY.
fn write(rng: &mut Rng, mut cloud: Cloud, folder: &Path) -> std::path::PathBuf {
    let Positions::Lattice(steps) = &cloud.positions else { unreachable!("made on a lattice") };
    match rng.u8(..3) {
        0 => {
            let path = folder.join("scan.las");
            let scale = [0.001, 0.01, 0.25, 1.0][rng.usize(..4)];
            cloud.write_las(&path, scale, [0.0, 512_345.25, -3.0]);
            path
        }
        format => {
            let path = folder.join("scan.ply");
            cloud.positions = match format {
                1 => Positions::Single(steps.iter().map(|p| p.map(|c| c as f32 * 0.1)).collect()),
                _ => Positions::Double(
                    steps.iter().map(|p| p.map(|c| f64::from(c) * 0.001 + 1e5)).collect(),
                ),
            };
            cloud.write_ply(&path);
            path
        }
    }
}

/// Makes an octree of a random cloud.
fn random_octree(rng: &mut Rng, folder: &Path, limits: &Limits) -> std::path::PathBuf {
    let mut cloud = random_cloud(rng);
    if rng.u8(..8) == 0 {
        cloud.normals = None;
    }
    let normals = match rng.u8(..8) {
        0 => NormalsFrom::None,
        1 | 2 => NormalsFrom::Estimate,
        3 => NormalsFrom::Auto,
        _ if cloud.has_normals() => NormalsFrom::File,
        _ => NormalsFrom::Auto,
    };
    let orientation = match rng.u8(..4) {
        0 => Orientation::Up,
        1 => Orientation::Sensors(vec![[rng.f64(), rng.f64() + 512_345.0, 0.5]]),
        _ => Orientation::Unknown,
    };
    let scan = write(rng, cloud, folder);
    ingest_with(&[scan], folder, limits, |request| {
        request.normals = normals;
        request.orientation = orientation;
    })
}

fn random_config(rng: &mut Rng) -> BuildConfig {
    let max_level = rng.u8(1..=6);
    BuildConfig {
        max_level,
        leaf_capacity: if rng.u8(..3) == 0 { 0 } else { rng.u64(1..=8) },
        max_spread: 2 * u16::from(max_level % 2),
        tree: if rng.bool() { Shape::Binned } else { Shape::Paper },
        profile: [Profile::Paper, Profile::Patch, Profile::Oriented][rng.usize(..3)],
        spacing: if rng.bool() { Spacing::Leaf } else { Spacing::Neighbors },
        ..BuildConfig::default()
    }
}

/// One random tree from a scan file to its map, all of it checked.
fn check_tree(seed: u64) -> Seen {
    let mut rng = Rng::with_seed(seed);
    let folder = tempfile::tempdir().unwrap();
    let limits = Limits { threads: rng.usize(1..=2), memory_bytes: 64 << 20 };
    let octree = random_octree(&mut rng, folder.path(), &limits);
    let config = random_config(&mut rng);
    let bytes = build_with(&octree, &config, &limits);
    let view = MapView::open(&bytes).unwrap();
    view.verify().unwrap();
    let (nodes, surfels, links) = contents(&view);
    let model = Model::new(&nodes, &surfels, &rects(&view), config.profile);
    let note = format!("seed {seed}, {config:?}");
    check_cut(&octree, &model, &config, &note);
    let starts = model.sibling_pairs();
    let expected = model.links_from(&starts);
    check_links(&model, &links, &expected, &note);
    check_answers(&bytes, &model, &links, &note);
    let summary = view.summary();
    assert_eq!(summary.n_links, links.len() as u64, "{note}");
    assert_eq!(summary.n_visible_pairs, u128::from(model.n_visible()), "{note}");
    census(&model, &links)
}

/// Compares the links, what they cover and the status of every pair of disjoint nodes.
fn check_links(
    model: &Model,
    links: &[(u32, u32)],
    expected: &BTreeSet<(usize, usize)>,
    note: &str,
) {
    let found: Vec<(usize, usize)> = links.iter().map(|&(a, b)| (a as usize, b as usize)).collect();
    assert!(found.iter().eq(expected), "wrong links: {note}");
    let n = model.surfels.len();
    let mut covered = vec![vec![0u32; n]; n];
    for &(a, b) in &found {
        for &x in &model.leaves[a] {
            for &y in &model.leaves[b] {
                covered[x][y] += 1;
                covered[y][x] += 1;
            }
        }
    }
    for (x, row) in covered.iter().enumerate() {
        for (y, &times) in row.iter().enumerate() {
            assert_eq!(times, u32::from(model.sees[x][y]), "leaves {x}, {y} covered: {note}");
        }
    }
    // The file has no statuses; those its links imply must be those of [V-4].
    let stated = model.with_matrix(covered.iter().map(|r| r.iter().map(|&c| c == 1).collect()));
    for (a, b) in model.disjoint_pairs() {
        assert_eq!(stated.status(a, b), model.status(a, b), "nodes {a}, {b}: {note}");
    }
}

/// Asks the query room for every leaf pair, both ways round.
fn check_answers(bytes: &[u8], model: &Model, links: &[(u32, u32)], note: &str) {
    let map = Map::open(bytes).unwrap();
    let at =
        |s: usize| Located { surfel: s as u32, node: model.surfels[s].node as u32, distance: 0.0 };
    for x in 0..model.surfels.len() {
        for y in 0..model.surfels.len() {
            let answer = map.pair(&at(x), &at(y)).unwrap();
            assert_eq!(answer.visible, x == y || model.sees[x][y], "leaves {x}, {y}: {note}");
            assert_eq!(answer.link.is_some(), x != y && answer.visible, "{note}");
            let Some(link) = answer.link else { continue };
            let (a, b) = link.nodes;
            assert!(links.binary_search(&(a.min(b), a.max(b))).is_ok(), "{note}");
            let (a, b) = (a as usize, b as usize);
            assert!(model.leaves[a].contains(&x) && model.leaves[b].contains(&y), "{note}");
            assert_eq!(link.n_points, (model.n_points[a], model.n_points[b]), "{note}");
        }
    }
}

/// Checks the tree from outside: each point is in exactly one leaf, whose surfel is its points'.
fn check_cut(octree: &Path, model: &Model, config: &BuildConfig, note: &str) {
    let file = pvmap::open_octree(octree).unwrap();
    let octree = OctreeView::open(&file).unwrap();
    octree.verify().unwrap();
    let n_points = octree.summary().n_points;
    let mut leaves = vec![Leaf::default(); model.surfels.len()];
    let all = octree.points(0, n_points).unwrap();
    for point in all.iter() {
        let key = point.unwrap().key;
        let homes: Vec<usize> =
            (0..leaves.len()).filter(|&s| holds_point(model, s, &key)).collect();
        assert_eq!(homes.len(), 1, "homes {homes:?} of {key:?}: {note}");
        leaves[homes[0]].points.push(key);
        let node = pvmap::vmap::tree::route(&model.tree(), &key).unwrap();
        assert_eq!(node, Some(model.surfels[homes[0]].node as u32), "{note}");
    }
    let half_spacings = model.half_spacings(&leaves, config.spacing);
    for ((leaf, surfel), h) in leaves.iter().zip(&model.surfels).zip(half_spacings) {
        leaf.check(surfel, h, (config.profile, config.spacing), note);
    }
    for (id, node) in model.nodes.iter().enumerate() {
        let points: u64 = model.leaves[id].iter().map(|&s| leaves[s].points.len() as u64).sum();
        assert_eq!(node.n_points, points, "node {id}: {note}");
        let is_full = points > config.leaf_capacity && node.level < config.max_level;
        let places = model.leaves[id].iter().flat_map(|&s| leaves[s].points.iter().map(|p| p.g));
        let is_spread =
            node.level < config.max_level && is_spread(places.collect(), config.max_spread);
        match node.split {
            Split::Octants => assert!(is_full || is_spread, "node {id}: {note}"),
            Split::Leaf | Split::Quadrants => {
                let in_cell = model.points_of_quadrants(id).max(points);
                let was_full = in_cell > config.leaf_capacity && node.level < config.max_level;
                assert!(!was_full, "node {id}: {note}");
                let is_quadrant = in_cell > points;
                assert!(is_quadrant || !is_spread, "node {id}: {note}");
            }
            Split::Bins => assert!(id == 0 && config.tree == Shape::Binned, "{note}"),
        }
    }
}

/// Says whether places are spread thin, by the words of pipeline/README.md.
fn is_spread(places: BTreeSet<[u32; 3]>, most: u16) -> bool {
    let n = places.len();
    if most == 0 || n < 4 {
        return false;
    }
    let d2 = |a: &[u32; 3], b: &[u32; 3]| {
        (0..3).map(|i| u128::from(a[i].abs_diff(b[i])).pow(2)).sum::<u128>()
    };
    let nearest = |a| places.iter().filter(|b| *b != a).map(|b| d2(a, b)).min().unwrap();
    let mut near: Vec<u128> = places.iter().map(nearest).collect();
    near.sort_unstable();
    let s = (9 * near[(n - 1) / 2] / 4).isqrt();
    let mut sides = [0, 1, 2].map(|i| {
        let axis = || places.iter().map(move |p| u128::from(p[i]));
        axis().max().unwrap() - axis().min().unwrap()
    });
    sides.sort_unstable();
    (sides[1] + s) * (sides[2] + s) > u128::from(most) * n as u128 * s * s
}

fn census(model: &Model, links: &[(u32, u32)]) -> Seen {
    let n = model.surfels.len() as u64;
    let is_leaf = |id: u32| model.nodes[id as usize].split == Split::Leaf;
    let count =
        |f: &dyn Fn(&model::Disc) -> bool| model.surfels.iter().filter(|s| f(s)).count() as u64;
    let pairs: Vec<_> = model.disjoint_pairs().collect();
    let is_partial = |&(a, b): &(usize, usize)| model.status(a, b) == Status::Partial;
    let has_only_partial = |&(a, b): &(usize, usize)| {
        let kids_b = model.kids(b);
        model.kids(a).iter().all(|&x| kids_b.iter().all(|&y| is_partial(&(x, y))))
    };
    let zero = count(&|s| s.normal == [0; 3]);
    let two_sided = count(&|s| s.normal != [0; 3] && s.two_sided);
    Seen {
        leaf_pairs: n * n.saturating_sub(1) / 2,
        visible: model.n_visible(),
        blocked: model.n_blocked,
        links: links.len() as u64,
        links_above_leaves: links.iter().filter(|&&(a, b)| !(is_leaf(a) && is_leaf(b))).count()
            as u64,
        links_of_a_leaf_and_more: links.iter().filter(|&&(a, b)| is_leaf(a) != is_leaf(b)).count()
            as u64,
        partial: pairs.iter().filter(|pair| is_partial(pair)).count() as u64,
        partial_by_partial_alone: pairs.iter().filter(|pair| has_only_partial(pair)).count() as u64,
        node_pairs: pairs.len() as u64,
        two_sided,
        one_sided: n - zero - two_sided,
        zero_normals: zero,
        quadrants: model.nodes.iter().filter(|n| n.split == Split::Quadrants).count() as u64,
    }
}

#[test]
fn v1_to_v5_n50_n51_maps_are_brute_force() {
    let n = if is_slow_run() { 2000 } else { 200 };
    let mut seen = Seen::default();
    on_threads(n, check_tree).into_iter().for_each(|tree| seen += tree);
    eprintln!("{n} trees: {seen:?}");
    assert!(seen.visible > 10 * n && seen.blocked > 10 * n, "{seen:?}");
    assert!(seen.links_above_leaves > n && seen.partial > 10 * n, "{seen:?}");
    assert!(seen.links_of_a_leaf_and_more > n && seen.partial_by_partial_alone > 0, "{seen:?}");
    assert!(seen.two_sided > n && seen.one_sided > n && seen.zero_normals > n / 2, "{seen:?}");
    assert!(seen.quadrants > n / 20, "{seen:?}");
}

/// Draws node pairs that cover nothing twice; in every other list one more, which mostly does.
fn random_pairs(rng: &mut Rng, model: &Model) -> Vec<(u32, u32)> {
    let disjoint: Vec<_> = model.disjoint_pairs().collect();
    let mut pairs: Vec<(u32, u32)> = Vec::new();
    let mut covered = BTreeSet::new();
    for _ in 0..rng.usize(..12) {
        let Some(&(a, b)) = rng.choice(&disjoint) else { break };
        if model.leaf_pairs(a, b).all(|pair| !covered.contains(&pair)) {
            covered.extend(model.leaf_pairs(a, b));
            pairs.push(if rng.bool() { (a as u32, b as u32) } else { (b as u32, a as u32) });
        }
    }
    if rng.bool() {
        let more = one_more(rng, model, &pairs);
        pairs.insert(rng.usize(..=pairs.len()), more);
    }
    pairs
}

/// Draws a pair of any nodes, or one whose sides are near those of a pair that is there: the same,
/// both above, both below, or one above and one below.
fn one_more(rng: &mut Rng, model: &Model, pairs: &[(u32, u32)]) -> (u32, u32) {
    let n_nodes = model.nodes.len() as u32;
    let Some(&(a, b)) = rng.choice(pairs).filter(|_| rng.u8(..4) > 0) else {
        return (rng.u32(..=n_nodes), rng.u32(..n_nodes));
    };
    let mut near = |id: u32| match (rng.u8(..3), &model.children[id as usize][..]) {
        (0, children @ [_, ..]) => children[rng.usize(..children.len())] as u32,
        (1, _) if id > 0 => model.nodes[id as usize].parent,
        _ => id,
    };
    let (a, b) = (near(a), near(b));
    if rng.bool() { (a, b) } else { (b, a) }
}

/// Says whether [V-5] allows the pairs: nodes exist, subtrees are disjoint, nothing twice.
fn are_allowed(model: &Model, pairs: &[(u32, u32)]) -> bool {
    let mut covered = BTreeSet::new();
    pairs.iter().all(|&(a, b)| {
        let (a, b) = (a.min(b) as usize, a.max(b) as usize);
        b < model.nodes.len()
            && model.are_disjoint(a, b)
            && model.leaf_pairs(a, b).all(|pair| covered.insert(pair))
    })
}

/// One random tree with lists of random pairs; counts those allowed and those refused.
fn check_given(seed: u64) -> (u64, u64) {
    let mut rng = Rng::with_seed(seed);
    let folder = tempfile::tempdir().unwrap();
    let limits = Limits { threads: 2, memory_bytes: 64 << 20 };
    let octree = random_octree(&mut rng, folder.path(), &limits);
    let mut config = random_config(&mut rng);
    let whole = build_with(&octree, &config, &limits);
    let view = MapView::open(&whole).unwrap();
    let (nodes, surfels, _) = contents(&view);
    let model = Model::new(&nodes, &surfels, &rects(&view), config.profile);
    let (mut allowed, mut refused) = (0, 0);
    for _ in 0..12 {
        let pairs = random_pairs(&mut rng, &model);
        let note = format!("seed {seed}, {config:?}, {pairs:?}");
        config.interaction = Some(pairs.clone());
        let output = folder.path().join("given.vmap");
        let built = pvmap::build(&octree, &output, &config, &limits, &Quiet);
        if !are_allowed(&model, &pairs) {
            let error = built.expect_err(&note);
            assert!(matches!(error, Error::Visibility(_)), "{error}: {note}");
            assert_eq!(error.exit_code(), 65, "{note}");
            assert!(!output.exists(), "{note}");
            refused += 1;
            continue;
        }
        built.expect(&note);
        let bytes = std::fs::read(&output).unwrap();
        std::fs::remove_file(&output).unwrap();
        check_given_map(&bytes, &model, &pairs, &note);
        allowed += 1;
    }
    (allowed, refused)
}

fn check_given_map(bytes: &[u8], model: &Model, pairs: &[(u32, u32)], note: &str) {
    let view = MapView::open(bytes).unwrap();
    view.verify().unwrap();
    let (_, _, links) = contents(&view);
    let starts: Vec<(usize, usize)> =
        pairs.iter().map(|&(a, b)| (a.min(b) as usize, a.max(b) as usize)).collect();
    let expected = model.links_from(&starts);
    let found = links.iter().map(|&(a, b)| (a as usize, b as usize));
    assert!(found.eq(expected), "wrong links: {note}");
    // What no given pair covers is not known to be visible.
    let wanted: BTreeSet<_> = starts.iter().flat_map(|&(a, b)| model.leaf_pairs(a, b)).collect();
    let sees = (0..model.surfels.len()).map(|x| {
        let row = 0..model.surfels.len();
        row.map(|y| model.sees[x][y] && wanted.contains(&(x.min(y), x.max(y)))).collect()
    });
    check_answers(bytes, &model.with_matrix(sees), &links, note);
}

#[test]
fn v5_given_pairs_are_obeyed_or_refused() {
    let n = if is_slow_run() { 400 } else { 40 };
    let each = on_threads(n, |i| check_given(10_000 + i));
    let allowed: u64 = each.iter().map(|e| e.0).sum();
    let refused: u64 = each.iter().map(|e| e.1).sum();
    eprintln!("{n} trees: {allowed} lists obeyed, {refused} refused");
    assert!(allowed > 5 * n && refused > n, "{allowed} {refused}");
}
