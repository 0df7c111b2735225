//! Visible fractions against their definition [F-24]…[F-26], recomputed from the nodes and surfels
//! of the file by rational arithmetic.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
#[path = "common/model.rs"]
mod model;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use pvmap::geometry::disc::Profile;
use pvmap::query::{Located, Map};
use pvmap::vmap::{Fraction, MapView, Spacing, Surfel};
use pvmap::{Approximation, BuildConfig, Limits};

use crate::common::{LIMITS, build_with, contents, ingest_with, room_cloud};
use crate::model::{Model, Status};

const SMALL: Limits = Limits { threads: 1, memory_bytes: 64 << 20 };

fn octree_of(n_points: u64, folder: &Path) -> PathBuf {
    let scan = folder.join("scan.ply");
    room_cloud(n_points).write_ply(&scan);
    ingest_with(&[scan], folder, &LIMITS, |_| {})
}

fn config_of(profile: Profile, fractions: bool, min_exchange: f64) -> BuildConfig {
    let approximation = Approximation { min_exchange, ..Approximation::default() };
    BuildConfig {
        max_level: 6,
        leaf_capacity: 6,
        profile,
        fractions,
        approximation,
        ..BuildConfig::default()
    }
}

/// Free segments by nodes, the lower first.
type Fractions = BTreeMap<(u32, u32), u8>;

fn fractions(view: &MapView<'_>) -> Fractions {
    let pairs = view.fractions().unwrap();
    let lists = (0..pairs.n_blocks()).map(|i| pairs.lists(i).unwrap());
    let all = lists.flat_map(|lists| lists.iter().collect::<Vec<_>>());
    let read = |pair| Fraction::of_pair(pair).unwrap();
    all.map(read).map(|Fraction { a, b, n_free }| ((a, b), n_free)).collect()
}

fn model_of(view: &MapView<'_>, profile: Profile) -> Model {
    let (nodes, surfels, _) = contents(view);
    Model::new(&nodes, &surfels, &common::rects(view), profile)
}

/// The places of [F-25], in floats but for what is rounded.
fn places(surfel: &Surfel) -> [[u32; 3]; 4] {
    let c = surfel.centroid.map(|v| v as i128);
    let n = surfel.normal.map(i128::from);
    if n == [0; 3] {
        return [surfel.centroid; 4];
    }
    let cross = |a: [i128; 3], b: [i128; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let scaled = |v: [i128; 3]| {
        let length = v.iter().map(|&x| (x as f64).powi(2)).sum::<f64>().sqrt();
        v.map(|x| (x as f64 / length * 16384.0).round() as i128)
    };
    // The largest component of n, the lowest of equals; the axis after it.
    let after = (0..3).rev().max_by_key(|&i| n[i].abs()).unwrap();
    let a = (after + 1) % 3;
    let n2: i128 = n.iter().map(|v| v * v).sum();
    let e = scaled([0, 1, 2].map(|i| if i == a { n2 } else { 0 } - n[a] * n[i]));
    let f = scaled(cross(n, e));
    let h = surfel.half_spacing as i128;
    let box_of = [0, 1, 2]
        .map(|i| [i128::from(surfel.patch.min[i]) + h, i128::from(surfel.patch.max[i]) - h]);
    let radius = (surfel.radius2 as f64).sqrt().floor() as i128;
    [(1, 1), (1, -1), (-1, 1), (-1, -1)].map(|(p, q)| {
        let v = [0, 1, 2].map(|i| p * e[i] + q * f[i]);
        let mut t = 3 * radius / 8;
        for i in (0..3).filter(|&i| v[i] != 0) {
            let end = box_of[i][usize::from(v[i] > 0)];
            t = t.min((end - c[i]) * 16384 / v[i] / 2);
        }
        let t = t.max(0);
        [0, 1, 2].map(|i| {
            let away = (v[i] * t) as f64 / 16384.0;
            (c[i] + away.round() as i128).clamp(0, (1 << 22) - 1) as u32
        })
    })
}

/// Tries pairs as [F-26] says.
struct Oracle<'a> {
    model: &'a Model,
    profile: Profile,
    surfels: &'a [Surfel],
    n_tried: u64,
    found: Fractions,
}

impl Oracle<'_> {
    fn is_leaf(&self, id: usize) -> bool {
        self.model.children[id].is_empty()
    }

    /// Goes down from a pair that is under no block, or under one.
    fn down(&mut self, a: usize, b: usize, is_in_block: bool) {
        let (n, m) = (self.model.leaves[a].len(), self.model.leaves[b].len());
        let is_block = n <= 64 && m <= 64 && n * m <= 1024;
        if self.is_leaf(a) && self.is_leaf(b) {
            if !is_in_block {
                self.try_leaves(a, b);
            }
            return;
        }
        let is_partial = self.model.status(a, b) == Status::Partial;
        if is_block && !is_partial {
            return;
        }
        for x in self.model.kids(a) {
            for y in self.model.kids(b) {
                if is_block && self.is_leaf(x) && self.is_leaf(y) {
                    self.try_leaves(x, y);
                } else {
                    self.down(x, y, is_block);
                }
            }
        }
    }

    fn try_leaves(&mut self, a: usize, b: usize) {
        let [x, y] = [a, b].map(|id| self.model.leaves[id][0]);
        let ends = |p: [u32; 3], q: [u32; 3]| [(x, p, None), (y, q, None)];
        let blockers = |p, q| self.model.blockers(self.profile, ends(p, q));
        if blockers(self.surfels[x].centroid, self.surfels[y].centroid).is_none() {
            return;
        }
        self.n_tried += 1;
        let (from, to) = (places(&self.surfels[x]), places(&self.surfels[y]));
        let segments = from.iter().flat_map(|&p| to.iter().map(move |&q| (p, q)));
        let is_free = |&(p, q): &([u32; 3], [u32; 3])| blockers(p, q).is_some_and(|k| k.is_empty());
        let n_free = segments.filter(is_free).count() as u8;
        if n_free != 16 * u8::from(self.model.sees[x][y]) {
            self.found.insert((a.min(b) as u32, a.max(b) as u32), n_free);
        }
    }
}

#[test]
fn format26_leaf_pairs_half_in_shadow_are_tried() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(500, folder.path());
    let (mut n_tried, mut n_between, mut n_turned) = (0, 0, 0);
    for profile in [Profile::Patch, Profile::Oriented, Profile::Paper] {
        for leaf_capacity in [0, 6] {
            let config = BuildConfig { leaf_capacity, ..config_of(profile, true, 0.0) };
            let bytes = build_with(&octree, &config, &SMALL);
            let view = MapView::open(&bytes).unwrap();
            view.verify().unwrap();
            let model = model_of(&view, profile);
            let (nodes, surfels, links) = contents(&view);
            let surfels = &surfels[..];
            let found = Fractions::new();
            let mut oracle = Oracle { model: &model, profile, surfels, n_tried: 0, found };
            model.sibling_pairs().into_iter().for_each(|(a, b)| oracle.down(a, b, false));
            assert!(fractions(&view) == oracle.found, "{profile:?}, capacity {leaf_capacity}");
            n_tried += oracle.n_tried;
            let is_visible = |&(a, b): &(u32, u32)| {
                let [x, y] = [a, b].map(|id| nodes[id as usize].first_surfel as usize);
                model.sees[x][y]
            };
            n_between += oracle.found.values().filter(|n| (1..16).contains(*n)).count();
            n_turned += oracle.found.iter().filter(|(ab, n)| (**n >= 8) != is_visible(ab)).count();
            // The links are those of a map without.
            let plain = build_with(&octree, &BuildConfig { fractions: false, ..config }, &SMALL);
            let plain = MapView::open(&plain).unwrap();
            assert!(plain.fractions().is_none());
            assert!(contents(&plain).2 == links);
        }
    }
    let told = format!("{n_tried} tried, {n_between} between, {n_turned} turned");
    assert!(n_tried > 5_000 && n_between > 500 && n_turned > 20, "{told}");
}

/// What bounds the exchange of a node.
struct Outline {
    centroids: [[f64; 2]; 3],
    normals: [[f64; 2]; 3],
    is_any: bool,
    area: f64,
}

/// Goes down by exchange as [F-26] says: gives the tried node pairs and the visible leaf pairs.
struct ByExchange<'a> {
    model: &'a Model,
    surfels: &'a [Surfel],
    least: f64,
    /// (a, b) and the free segments.
    tried: Fractions,
    sees: BTreeSet<(usize, usize)>,
}

impl ByExchange<'_> {
    fn outline(&self, id: usize) -> Outline {
        let leaves: Vec<&Surfel> =
            self.model.leaves[id].iter().map(|&leaf| &self.surfels[leaf]).collect();
        let range = |of: &dyn Fn(&Surfel) -> f64| {
            let values = || leaves.iter().map(|leaf| of(leaf));
            [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)]
        };
        Outline {
            centroids: [0, 1, 2].map(|i| range(&|leaf| f64::from(leaf.centroid[i]))),
            normals: [0, 1, 2].map(|i| range(&|leaf| f64::from(leaf.normal[i]))),
            is_any: leaves.iter().any(|leaf| leaf.two_sided || leaf.normal == [0; 3]),
            area: leaves
                .iter()
                .map(|leaf| leaf.n_points as f64 * (2.0 * f64::from(leaf.half_spacing)).powi(2))
                .sum(),
        }
    }

    fn is_below(&self, a: usize, b: usize) -> bool {
        let [p, q, all] = [a, b, 0].map(|id| self.outline(id));
        let gap = |i: usize| {
            let ([p0, p1], [q0, q1]) = (p.centroids[i], q.centroids[i]);
            (q0 - p1).max(p0 - q1).max(0.0)
        };
        let near2: f64 = (0..3).map(|i| gap(i) * gap(i)).sum();
        let cosine = |from: &Outline, to: &Outline| {
            let most = |i: usize| {
                let ways = [
                    to.centroids[i][0] - from.centroids[i][1],
                    to.centroids[i][1] - from.centroids[i][0],
                ];
                let products = from.normals[i].map(|n| ways.map(|way| way * n));
                products.as_flattened().iter().copied().fold(f64::NEG_INFINITY, f64::max)
            };
            let along: f64 = (0..3).map(most).sum();
            if from.is_any { 1.0 } else { (along / (16383.0 * near2.sqrt())).clamp(0.0, 1.0) }
        };
        let exchange = cosine(&p, &q) * cosine(&q, &p) * p.area * q.area
            / (std::f64::consts::PI * near2 * all.area);
        near2 > 0.0 && exchange < self.least
    }

    fn down(&mut self, a: usize, b: usize) {
        let model = self.model;
        let faces = |x: usize, y: usize| {
            let [p, q] = [x, y].map(|leaf| self.surfels[leaf].centroid);
            model.blockers(Profile::Patch, [(x, p, None), (y, q, None)]).is_some()
        };
        let (rows, columns) = (&model.leaves[a], &model.leaves[b]);
        let (n, m) = (rows.len(), columns.len());
        let is_block = n <= 64 && m <= 64 && n * m <= 1024;
        if n * m == 1 || is_block && !self.is_below(a, b) {
            self.sees.extend(model.leaf_pairs(a, b).filter(|&(x, y)| model.sees[x][y]));
        } else if self.is_below(a, b) {
            let some = |leaves: &[usize]| [1, 3, 5, 7].map(|i| leaves[i * leaves.len() / 8]);
            let of_row = |&x: &usize| some(columns).iter().filter(|&&y| model.sees[x][y]).count();
            let n_free = some(rows).iter().map(of_row).sum::<usize>();
            if n_free >= 8 {
                self.sees.extend(model.leaf_pairs(a, b));
            }
            let any = rows.iter().any(|&x| columns.iter().any(|&y| faces(x, y)));
            if n_free > 0 {
                assert!(any, "a free segment between leaves that do not face each other");
                self.tried.insert((a.min(b) as u32, a.max(b) as u32), n_free as u8);
            }
        } else {
            for x in model.kids(a) {
                model.kids(b).into_iter().for_each(|y| self.down(x, y));
            }
        }
    }
}

#[test]
fn format26_pairs_of_little_exchange_are_tried_and_not_opened() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(1500, folder.path());
    let mut n_tried = 0;
    for least in [1e-5, 1e-4, 1e-3, 1e-2] {
        let bytes = build_with(&octree, &config_of(Profile::Patch, false, least), &SMALL);
        let view = MapView::open(&bytes).unwrap();
        view.verify().unwrap();
        let model = model_of(&view, Profile::Patch);
        let (_, surfels, links) = contents(&view);
        let (tried, sees) = (Fractions::new(), BTreeSet::new());
        let mut oracle = ByExchange { model: &model, surfels: &surfels, least, tried, sees };
        model.sibling_pairs().into_iter().for_each(|(a, b)| oracle.down(a, b));
        assert!(fractions(&view) == oracle.tried, "{least}");
        let pairs = links.iter().flat_map(|&(a, b)| model.leaf_pairs(a as usize, b as usize));
        let both = |pairs: BTreeSet<(usize, usize)>| -> BTreeSet<(usize, usize)> {
            pairs.into_iter().map(|(x, y)| (x.min(y), x.max(y))).collect()
        };
        assert!(both(pairs.collect()) == both(oracle.sees), "{least}");
        n_tried += oracle.tried.len();
    }
    assert!(n_tried > 150, "{n_tried} tried");
}

#[test]
fn d8_threads_and_memory_do_not_show() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(8_000, folder.path());
    let angle = Approximation { opening_angle: 0.2, ..Approximation::default() };
    let layered = BuildConfig { approximation: angle, ..config_of(Profile::Patch, true, 0.0) };
    let neighbors =
        BuildConfig { spacing: Spacing::Neighbors, ..config_of(Profile::Oriented, true, 1e-6) };
    for config in [config_of(Profile::Patch, true, 0.0), layered, neighbors] {
        let bytes = build_with(&octree, &config, &SMALL);
        assert!(bytes == build_with(&octree, &config, &LIMITS), "{config:?}");
        let view = MapView::open(&bytes).unwrap();
        view.verify().unwrap();
        assert_eq!(view.summary().n_fractions, fractions(&view).len() as u64);
        assert!(view.summary().n_fractions > 1000);
    }
}

#[test]
fn fractions_are_answered_wherever_they_were_tried() {
    let folder = tempfile::tempdir().unwrap();
    let octree = octree_of(1500, folder.path());
    let angle = Approximation { opening_angle: 0.3, ..Approximation::default() };
    let layered = BuildConfig { approximation: angle, ..config_of(Profile::Patch, true, 0.0) };
    for config in [config_of(Profile::Patch, true, 1e-4), layered] {
        let bytes = build_with(&octree, &config, &LIMITS);
        let map = Map::open(&bytes).unwrap();
        let (nodes, surfels, _) = contents(map.view());
        let at = |s: u32| Located { surfel: s, node: surfels[s as usize].node, distance: 0.0 };
        let mut expected = BTreeMap::new();
        for ((a, b), n_free) in fractions(map.view()) {
            let leaves = |id: u32| nodes[id as usize].first_surfel..nodes[id as usize].end_surfel;
            for (x, y) in leaves(a).flat_map(|x| leaves(b).map(move |y| (x, y))) {
                assert_eq!(expected.insert((x, y), ((a, b), n_free)), None, "tried twice");
            }
        }
        let n = surfels.len() as u32;
        let questions: Vec<(Located, Located)> =
            (0..n).flat_map(|a| (0..n).map(move |b| (a, b))).map(|(a, b)| (at(a), at(b))).collect();
        let together = map.pairs_fractions(&questions);
        for ((a, b), answer) in questions.iter().zip(together).step_by(7) {
            let answer = answer.unwrap();
            assert_eq!(answer, map.pair_fraction(a, b).unwrap());
            assert_eq!(answer.by_leaves, map.pair(a, b).unwrap());
            let (low, high) = (a.surfel.min(b.surfel), a.surfel.max(b.surfel));
            match expected.get(&(low, high)) {
                Some(&((x, y), n_free)) => {
                    let tried = if a.surfel == low { (x, y) } else { (y, x) };
                    assert_eq!((answer.n_free, answer.tried), (n_free, Some(tried)));
                }
                None => {
                    let n_free = if answer.by_leaves.visible { 16 } else { 0 };
                    assert_eq!((answer.n_free, answer.tried), (n_free, None));
                }
            }
        }
    }
}
