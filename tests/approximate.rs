//! Approximate maps against their own definition (`pipeline/README.md`), recomputed from the nodes
//! and surfels of the file: far pairs in coarser trees, and small form factors left out. [D-6]
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::collections::BTreeSet;
use std::path::Path;

use pvmap::geometry::disc::{self, Disc, Profile};
use pvmap::geometry::{Box3, Rect, normal};
use pvmap::query::{Located, Map};
use pvmap::vmap::{MapView, Node, Spacing, Surfel};
use pvmap::{Approximation, BuildConfig, Limits};

use crate::common::{Cloud, LIMITS, build_with, contents, ingest_with, room_cloud};

const SMALL: Limits = Limits { threads: 1, memory_bytes: 64 << 20 };

fn octree_of(cloud: &Cloud, folder: &Path) -> std::path::PathBuf {
    let scan = folder.join("scan.ply");
    cloud.write_ply(&scan);
    ingest_with(&[scan], folder, &LIMITS, |_| {})
}

fn config_of(opening_angle: f64, min_form_factor: f64) -> BuildConfig {
    let approximation = Approximation { opening_angle, min_form_factor, min_exchange: 0.0 };
    BuildConfig { max_level: 6, leaf_capacity: 6, approximation, ..BuildConfig::default() }
}

/// The tree of a map file.
struct Tree {
    nodes: Vec<Node>,
    surfels: Vec<Surfel>,
    rects: Vec<Rect>,
}

impl Tree {
    fn children(&self, id: u32) -> Vec<u32> {
        let end = self.nodes[id as usize].end;
        let after = |&child: &u32| Some(self.nodes[child as usize].end).filter(|&next| next < end);
        std::iter::successors(Some(id + 1).filter(|&first| first < end), after).collect()
    }

    fn kids(&self, id: u32) -> Vec<u32> {
        let children = self.children(id);
        if children.is_empty() { vec![id] } else { children }
    }

    fn leaves(&self, id: u32) -> &[Surfel] {
        let node = &self.nodes[id as usize];
        &self.surfels[node.first_surfel as usize..node.end_surfel as usize]
    }

    /// Gives the box of the centroids under a node.
    fn centroids(&self, id: u32) -> Box3 {
        let boxes = self.leaves(id).iter().map(|leaf| Box3::at(leaf.centroid.map(|v| v as i32)));
        boxes.fold(Box3::EMPTY, |all, one| all.join(&one))
    }

    /// Gives the disc of a node as a leaf of the tree cut off at a level, if it is one there.
    fn unit(&self, id: u32, level: u8, profile: Profile) -> Option<Disc> {
        let node = &self.nodes[id as usize];
        let leaves = self.leaves(id);
        if node.is_leaf() {
            let rect = self.rects.get(node.first_surfel as usize);
            return Some(pvmap::vmap::tree::disc_of(&leaves[0], rect, profile));
        }
        let n: i128 = leaves.iter().map(|leaf| i128::from(leaf.n_points)).sum();
        let weighed = |of: &dyn Fn(&Surfel) -> i128| -> i128 {
            leaves.iter().map(|leaf| of(leaf) * i128::from(leaf.n_points)).sum()
        };
        let sum = [0, 1, 2].map(|i| weighed(&|leaf| i128::from(leaf.normal[i])) as i64);
        let together = normal::rescale(sum);
        let dot = |a: [i16; 3], b: [i16; 3]| -> f64 {
            (0..3).map(|i| f64::from(a[i]) * f64::from(b[i])).sum()
        };
        // Not beyond 45°: cos² at least one half.
        let is_along = |leaf: &Surfel| {
            let along = dot(leaf.normal, together);
            along > 0.0
                && 2.0 * along * along >= dot(leaf.normal, leaf.normal) * dot(together, together)
        };
        if node.level < level || !leaves.iter().all(is_along) {
            return None;
        }
        let centroid =
            [0, 1, 2].map(|i| (2 * weighed(&|l| i128::from(l.centroid[i])) + n).div_euclid(2 * n));
        let reach = |leaf: &Surfel| {
            let apart = |i: usize| (i128::from(leaf.centroid[i]) - centroid[i]).pow(2) as u64;
            ceil_root((0..3).map(apart).sum()) + ceil_root(leaf.radius2)
        };
        let radius = leaves.iter().map(reach).max().unwrap();
        let cell = Surfel { first_code: node.first_code, level: node.level, ..leaves[0] }.cell();
        let patches = leaves.iter().fold(Box3::EMPTY, |all, leaf| all.join(&leaf.patch));
        Some(Disc {
            centroid: centroid.map(|v| v as i32),
            normal: together,
            two_sided: leaves.iter().any(|leaf| leaf.two_sided),
            radius2: radius * radius,
            limit: if profile == Profile::Paper { cell } else { patches },
            rect: Rect::NONE,
        })
    }

    /// Lists the leaves of the tree cut off at a level, under a node.
    fn units(&self, id: u32, level: u8, profile: Profile) -> Vec<(u32, Disc)> {
        match self.unit(id, level, profile) {
            Some(disc) => vec![(id, disc)],
            None => {
                let below = self.children(id).into_iter();
                below.flat_map(|child| self.units(child, level, profile)).collect()
            }
        }
    }
}

/// Rounds a root up, by way of a float and its neighbours.
fn ceil_root(v: u64) -> u64 {
    let near = (v as f64).sqrt() as u64;
    (near.saturating_sub(2)..near + 3).find(|r| r * r >= v).unwrap()
}

/// Who sees whom by the definition: pairs of surfels, each once.
struct Oracle<'a> {
    tree: &'a Tree,
    config: &'a BuildConfig,
    deepest: u8,
    /// The answers of the tree itself where they are known.
    exact: Option<&'a BTreeSet<(u32, u32)>>,
    sees: BTreeSet<(u32, u32)>,
    left_out: BTreeSet<(u32, u32)>,
    n_coarse: u64,
}

impl<'a> Oracle<'a> {
    fn ask(
        tree: &'a Tree,
        config: &'a BuildConfig,
        exact: Option<&'a BTreeSet<(u32, u32)>>,
    ) -> Oracle<'a> {
        let deepest = tree.nodes.iter().map(|node| node.level).max().unwrap();
        let (sees, left_out) = Default::default();
        let mut oracle = Oracle { tree, config, deepest, exact, sees, left_out, n_coarse: 0 };
        oracle.all(0, false);
        oracle
    }

    /// Says whether something under a pair may be left out: it has more than a 2^18th of all pairs.
    fn is_large(&self, n_pairs: u64) -> bool {
        let n = self.tree.surfels.len() as u64;
        let is_asked = self.config.approximation.min_form_factor > 0.0;
        is_asked && n_pairs > n * (n - 1) / 2 / (1 << 18)
    }

    /// Says that no two leaves under a pair have the least form factor, by the boxes of their
    /// centroids and normals.
    fn is_negligible(&self, a: u32, b: u32) -> bool {
        let (tree, [near2, _]) = (self.tree, self.distances2(a, b));
        let [p, q] = [a, b].map(|id| tree.centroids(id));
        let cosine = |id: u32, from: &Box3, to: &Box3| {
            let leaves = tree.leaves(id);
            if leaves.iter().any(|leaf| leaf.two_sided || leaf.normal == [0; 3]) {
                return 1.0;
            }
            let most = |i: usize| {
                let ways = [to.min[i] - from.max[i], to.max[i] - from.min[i]];
                let of = |leaf: &Surfel| ways.map(|way| f64::from(way) * f64::from(leaf.normal[i]));
                leaves.iter().flat_map(of).fold(f64::MIN, f64::max)
            };
            ((most(0) + most(1) + most(2)) / (16383.0 * near2.sqrt())).clamp(0.0, 1.0)
        };
        let cosines = cosine(a, &p, &q) * cosine(b, &q, &p);
        let leaves = tree.leaves(a).iter().chain(tree.leaves(b));
        let area = leaves.map(|leaf| area(leaf, self.config.spacing)).fold(0.0, f64::max);
        let least = self.config.approximation.min_form_factor;
        near2 > 0.0 && cosines * area < least * std::f64::consts::PI * near2
    }

    fn level_at(&self, distance2: f64) -> u8 {
        let angle = self.config.approximation.opening_angle;
        let is_far = |level: u8| f64::from(1u32 << (22 - level)) <= angle * distance2.sqrt();
        (1..self.deepest).find(|&level| is_far(level)).unwrap_or(self.deepest)
    }

    /// Decides all siblings under a node.
    fn all(&mut self, id: u32, is_near: bool) {
        let [_, far2] = self.distances2(id, id);
        let level = self.tree.nodes[id as usize].level;
        let n = self.tree.leaves(id).len() as u64;
        let is_open = self.is_large(n * (n - 1) / 2) || self.level_at(far2) < self.deepest;
        let is_near = is_near || level + 3 >= self.deepest || !is_open;
        let children = self.tree.children(id);
        for (i, &a) in children.iter().enumerate() {
            for &b in &children[i + 1..] {
                if is_near { self.decide(a, b, self.deepest) } else { self.pair(a, b) }
            }
            self.all(a, is_near);
        }
    }

    /// Gives the squares of the least and the greatest distance of the centroids' boxes.
    fn distances2(&self, a: u32, b: u32) -> [f64; 2] {
        let (p, q) = (self.tree.centroids(a), self.tree.centroids(b));
        [false, true].map(|is_far| {
            let along = |i: usize| {
                let (low, high) = (q.min[i] - p.max[i], p.min[i] - q.max[i]);
                f64::from(if is_far { -low.min(high) } else { low.max(high).max(0) })
            };
            (0..3).map(|i| along(i) * along(i)).sum::<f64>()
        })
    }

    fn pair(&mut self, a: u32, b: u32) {
        let tree = self.tree;
        let [near2, far2] = self.distances2(a, b);
        if self.config.approximation.min_form_factor > 0.0 && self.is_negligible(a, b) {
            self.left_out.extend(leaf_pairs(&tree.nodes, (a, b)));
            return;
        }
        let [x, y] = [a, b].map(|id| &tree.nodes[id as usize]);
        let below = x.level.max(y.level);
        let level = self.level_at(near2).max(below + 1).min(self.deepest);
        let n_pairs = tree.leaves(a).len() * tree.leaves(b).len();
        let is_open = self.is_large(n_pairs as u64) || self.level_at(far2) < level;
        let is_settled = below + 3 >= level || !is_open;
        if !is_settled && !x.is_leaf() && !y.is_leaf() {
            for x in tree.kids(a) {
                tree.kids(b).into_iter().for_each(|y| self.pair(x, y));
            }
        } else {
            self.decide(a, b, level);
        }
    }

    /// Decides a pair in the tree cut off at a level.
    fn decide(&mut self, a: u32, b: u32, level: u8) {
        let tree = self.tree;
        if let Some(exact) = self.exact.filter(|_| level == self.deepest) {
            let pairs = leaf_pairs(&tree.nodes, (a, b)).into_iter();
            self.sees.extend(pairs.filter(|pair| exact.contains(pair)));
            return;
        }
        let profile = match self.config.profile {
            Profile::Oriented if level < self.deepest => Profile::Patch,
            profile => profile,
        };
        let others = tree.units(0, level, profile);
        for (a, from) in tree.units(a, level, profile) {
            for (b, to) in tree.units(b, level, profile) {
                let mut rest = others.iter().filter(|(k, _)| *k != a && *k != b);
                let mut is_blocked = || rest.any(|(_, k)| disc::blocks(profile, &from, &to, k));
                if disc::faces_both(&from, &to) && !is_blocked() {
                    self.sees.extend(leaf_pairs(&tree.nodes, (a, b)));
                }
                let is_unit = |id: u32| !tree.nodes[id as usize].is_leaf();
                self.n_coarse += u64::from(is_unit(a) || is_unit(b));
            }
        }
    }
}

/// Gives the area that a surfel stands for, grid steps².
fn area(surfel: &Surfel, spacing: Spacing) -> f64 {
    let side = if spacing == Spacing::Leaf { 2.0 } else { 8.0 / 3.0 };
    surfel.n_points as f64 * (side * f64::from(surfel.half_spacing)).powi(2)
}

/// Lists the pairs of surfels under a pair of nodes, the lower first.
fn leaf_pairs(nodes: &[Node], (a, b): (u32, u32)) -> Vec<(u32, u32)> {
    let leaves = |id: u32| nodes[id as usize].first_surfel..nodes[id as usize].end_surfel;
    let pair = |x: u32, y: u32| (x.min(y), x.max(y));
    leaves(a).flat_map(|x| leaves(b).map(move |y| pair(x, y))).collect()
}

/// Lists the pairs of surfels that a map says see each other.
fn visible(view: &MapView<'_>) -> BTreeSet<(u32, u32)> {
    let (nodes, _, links) = contents(view);
    let all = links.iter().flat_map(|&link| leaf_pairs(&nodes, link));
    let (mut found, mut n) = (BTreeSet::new(), 0);
    all.for_each(|pair| {
        n += 1;
        found.insert(pair);
    });
    assert_eq!(found.len(), n, "no pair is covered twice");
    found
}

#[test]
fn far_pairs_are_decided_in_coarser_trees() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(&room_cloud(350), folder.path());
    let (mut n_coarse, mut n_left_out) = (0, 0);
    for profile in [Profile::Patch, Profile::Oriented, Profile::Paper] {
        for (angle, least) in [(0.1, 0.0), (0.3, 0.0), (1.0, 0.0), (0.3, 1e-2)] {
            let config = BuildConfig { profile, leaf_capacity: 0, ..config_of(angle, least) };
            let bytes = build_with(&octree, &config, &SMALL);
            let view = MapView::open(&bytes).unwrap();
            view.verify().unwrap();
            let (nodes, surfels, _) = contents(&view);
            let tree = Tree { nodes, surfels, rects: common::rects(&view) };
            let oracle = Oracle::ask(&tree, &config, None);
            assert!(visible(&view) == oracle.sees, "{profile:?}, angle {angle}");
            n_coarse += oracle.n_coarse;
            n_left_out += oracle.left_out.len();
        }
    }
    assert!(n_coarse > 1000, "{n_coarse} pairs with a unit");
    assert!(n_left_out > 1000, "{n_left_out} pairs left out");
}

#[test]
fn an_angle_under_which_nothing_is_seen_changes_no_link() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(&room_cloud(3000), folder.path());
    let [exact, none, coarse] = [0.0, 1e-9, 0.4].map(|angle| {
        let bytes = build_with(&octree, &config_of(angle, 0.0), &LIMITS);
        visible(&MapView::open(&bytes).unwrap())
    });
    assert!(exact == none && exact != coarse);
}

#[test]
fn all_ways_to_ask_know_links_of_nodes_that_are_not_equally_deep() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(&room_cloud(1500), folder.path());
    let bytes = build_with(&octree, &config_of(0.3, 0.0), &LIMITS);
    let expected = visible(&MapView::open(&bytes).unwrap());
    for is_kept in [false, true] {
        let map = Map::open(&bytes).unwrap();
        assert!(!is_kept || map.keep(1 << 30).unwrap());
        let (_, surfels, _) = contents(map.view());
        let at =
            |surfel: u32| Located { surfel, node: surfels[surfel as usize].node, distance: 0.0 };
        let n = surfels.len() as u32;
        for a in 0..n {
            for b in (a + 1..n).step_by(3) {
                let answer = map.pair(&at(a), &at(b)).unwrap().visible;
                assert_eq!(answer, expected.contains(&(a, b)), "{a} and {b}, kept: {is_kept}");
            }
            let set = map.visible_from(&at(a)).unwrap();
            let seen: BTreeSet<u32> = set.surfels.ids().filter(|&b| b != a).collect();
            let sees = |b: &u32| expected.contains(&(a.min(*b), a.max(*b)));
            assert_eq!(seen, (0..n).filter(sees).collect(), "from {a}, kept: {is_kept}");
        }
    }
}

#[test]
fn d8_threads_and_memory_do_not_show() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(&room_cloud(20_000), folder.path());
    for config in [config_of(0.15, 0.0), config_of(0.0, 1e-4), config_of(0.2, 1e-5)] {
        let bytes = build_with(&octree, &config, &SMALL);
        assert!(bytes == build_with(&octree, &config, &LIMITS), "{:?}", config.approximation);
    }
}

#[test]
fn pairs_of_small_form_factors_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(&room_cloud(8000), folder.path());
    let least = 3e-3;
    for spacing in [Spacing::Leaf, Spacing::Neighbors] {
        let of = |least: f64| {
            let config = BuildConfig { spacing, max_level: 10, ..config_of(0.0, least) };
            let bytes = build_with(&octree, &config, &LIMITS);
            (config, bytes)
        };
        let ((_, exact), (config, pruned)) = (of(0.0), of(least));
        let [all, some] = [&exact, &pruned].map(|bytes| visible(&MapView::open(bytes).unwrap()));
        let (nodes, surfels, _) = contents(&MapView::open(&exact).unwrap());
        assert!(surfels.len() > 1500, "{}: such that pairs are not handed on", surfels.len());
        let tree = Tree { nodes, surfels, rects: Vec::new() };
        let oracle = Oracle::ask(&tree, &config, Some(&all));
        assert!(some == oracle.sees, "{spacing:?}");
        let unhindered = |a: &Surfel, b: &Surfel| {
            let d = [0, 1, 2].map(|i| f64::from(b.centroid[i]) - f64::from(a.centroid[i]));
            let dot = |v: [f64; 3], w: [f64; 3]| (0..3).map(|i| v[i] * w[i]).sum::<f64>();
            let cosine = |n: [i16; 3]| dot(n.map(f64::from), d).abs() / dot(d, d).sqrt() / 16384.0;
            let area = area(a, spacing).max(area(b, spacing));
            cosine(a.normal) * cosine(b.normal) * area / (std::f64::consts::PI * dot(d, d))
        };
        assert!(some.is_subset(&all));
        let left_out: Vec<f64> = all
            .difference(&some)
            .map(|&(a, b)| unhindered(&tree.surfels[a as usize], &tree.surfels[b as usize]))
            .collect();
        let greatest = left_out.iter().copied().fold(0.0, f64::max);
        assert!(left_out.len() > 500 && some.len() > 500, "{} of {}", left_out.len(), all.len());
        assert!(greatest < least * 1.001, "{greatest}");
    }
}
