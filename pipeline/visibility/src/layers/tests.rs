//! The layers of random trees against all their leaf pairs, one by one.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use super::*;
use fastrand::Rng;
use pvmap_geometry::morton;
use pvmap_store::Quiet;
use pvmap_vmap::Shape;
use pvmap_vmap::tree::root_node;

/// Grows a plain octree over random leaves on a few slanted walls, 64 steps the smallest cell.
fn random_tree(rng: &mut Rng) -> Tree {
    let n = rng.usize(2..400);
    let wall = |rng: &mut Rng| {
        let normal = [0; 3].map(|_| rng.i64(-9..=9));
        let normal = if normal == [0; 3] { [0, 0, 1] } else { normal };
        (normal::rescale(normal), rng.u32(0..1 << 22))
    };
    let walls: Vec<_> = (0..3).map(|_| wall(rng)).collect();
    let mut leaves: Vec<Surfel> = (0..n).map(|_| random_leaf(rng, &walls)).collect();
    leaves.sort_by_key(|leaf| leaf.first_code);
    leaves.dedup_by_key(|leaf| leaf.first_code);
    let mut tree = Tree::default();
    grow(&mut tree, &leaves, NO_PARENT, 0);
    tree
}

const DEEPEST: u8 = 16;

fn random_leaf(rng: &mut Rng, walls: &[([i16; 3], u32)]) -> Surfel {
    let (normal, at) = walls[rng.usize(..walls.len())];
    let mut centroid = [0; 3].map(|_| rng.u32(0..1 << 22));
    centroid[rng.usize(..3)] = at;
    // Now and then one turned by much, or none.
    let normal = match rng.u8(..12) {
        0 => normal.map(|v| -v),
        1 => [0; 3],
        _ => normal,
    };
    let half_spacing = 1 << rng.u32(2..12);
    let first_code = morton::encode(centroid.map(|c| c >> 6 << 6));
    Surfel {
        centroid,
        normal,
        two_sided: rng.u8(..20) == 0,
        half_spacing,
        radius2: rng.u64(1..1 << 30),
        n_points: rng.u64(1..60),
        first_code,
        patch: Box3::at(centroid.map(|c| c as i32)).grown(half_spacing as i32),
        color: None,
        level: DEEPEST,
        bin: -1,
        node: 0,
    }
}

fn grow(tree: &mut Tree, leaves: &[Surfel], parent: u32, level: u8) {
    let id = tree.nodes.len() as u32;
    let is_leaf = leaves.len() == 1 || level == DEEPEST;
    let first_surfel = tree.surfels.len() as u32;
    tree.nodes.push(Node {
        parent,
        first_surfel,
        n_points: leaves.iter().map(|leaf| leaf.n_points).sum(),
        level,
        split: if is_leaf { Split::Leaf } else { Split::Octants },
        ..root_node(Shape::Paper, 0)
    });
    if is_leaf {
        tree.surfels.push(Surfel { node: id, level, ..leaves[0] });
    } else {
        let octant = |leaf: &Surfel| morton::octant(leaf.first_code, level + 1);
        for part in leaves.chunk_by(|a, b| octant(a) == octant(b)) {
            grow(tree, part, id, level + 1);
        }
    }
    let (end, end_surfel) = (tree.nodes.len() as u32, tree.surfels.len() as u32);
    let node = &mut tree.nodes[id as usize];
    (node.end, node.end_surfel) = (end, end_surfel);
}

fn sorted(tree: &Tree, angle: f64, form_factor: f64) -> Vec<Layer<'_>> {
    let what =
        Approximation { opening_angle: angle, min_form_factor: form_factor, min_exchange: 0.0 };
    layers(tree, &[(0, 0)], &what, Spacing::Leaf, 1 << 30, &Quiet).unwrap()
}

/// Lists the pairs of the layer's leaves that a start stands for.
fn leaf_pairs(tree: &Tree, (a, b): Pair) -> Vec<Pair> {
    let leaves = |id: u32| {
        let under = id..tree.nodes[id as usize].end;
        under.filter(|&id| tree.nodes[id as usize].is_leaf())
    };
    let all = leaves(a).flat_map(|x| leaves(b).map(move |y| (x, y)));
    all.filter(|(x, y)| a != b || x < y).collect()
}

fn surfel(tree: &Tree, id: u32) -> &Surfel {
    &tree.surfels[tree.nodes[id as usize].first_surfel as usize]
}

fn apart(a: &Surfel, b: &Surfel) -> f64 {
    let d = |i: usize| f64::from(a.centroid[i]) - f64::from(b.centroid[i]);
    (0..3).map(|i| d(i) * d(i)).sum::<f64>().sqrt()
}

#[test]
fn every_leaf_pair_is_decided_once_and_cells_are_seen_under_the_angle() {
    let (mut n_units, mut n_coarse) = (0, 0);
    for seed in 0..60 {
        let rng = &mut Rng::with_seed(seed);
        let tree = random_tree(rng);
        let angle = [1e-9, 0.05, 0.2, 1.0][seed as usize % 4];
        let n = tree.surfels.len();
        let mut times = vec![0u8; n * n];
        let layers = sorted(&tree, angle, 0.0);
        for layer in &layers {
            for pair in layer.starts.iter().flat_map(|&start| leaf_pairs(&layer.tree, start)) {
                let whole = layer.whole(pair);
                for (x, y) in leaf_pairs(&tree, whole) {
                    let [x, y] = [x, y].map(|id| tree.nodes[id as usize].first_surfel as usize);
                    times[x * n + y] += 1;
                    times[y * n + x] += 1;
                }
                let nodes = [whole.0, whole.1].map(|id| &tree.nodes[id as usize]);
                for node in nodes.into_iter().filter(|node| !node.is_leaf()) {
                    // From the leaves of the other node.
                    let other = nodes.iter().find(|other| other.first_surfel != node.first_surfel);
                    let others = other.map(|o| o.first_surfel as usize..o.end_surfel as usize);
                    let side = f64::from(1u32 << (22 - node.level));
                    for k in others.unwrap() {
                        for i in node.first_surfel..node.end_surfel {
                            let (a, b) = (&tree.surfels[i as usize], &tree.surfels[k]);
                            assert!(side <= angle * apart(a, b) * (1.0 + 1e-12), "tree {seed}");
                        }
                    }
                    n_units += 1;
                }
            }
        }
        n_coarse += layers.len() - 1;
        for a in 0..n {
            for b in 0..n {
                assert_eq!(times[a * n + b], u8::from(a != b), "tree {seed}, {a} and {b}");
            }
        }
    }
    assert!(n_units > 10_000 && n_coarse > 30, "{n_units} units, {n_coarse} coarse layers");
}

#[test]
fn a_unit_is_what_its_leaves_are_together() {
    let mut n_units = 0;
    for seed in 0..40 {
        let tree = random_tree(&mut Rng::with_seed(seed));
        for layer in sorted(&tree, 0.5, 0.0) {
            for (id, node) in (0..).zip(&layer.tree.nodes) {
                let whole = &tree.nodes[layer.whole_node(id) as usize];
                assert_eq!((node.level, node.n_points), (whole.level, whole.n_points));
                let leaves = &tree.surfels[whole.first_surfel as usize..whole.end_surfel as usize];
                if !node.is_leaf() || leaves.len() == 1 {
                    continue;
                }
                n_units += 1;
                let unit = surfel(&layer.tree, id);
                assert_eq!((unit.node, unit.n_points), (id, whole.n_points));
                for leaf in leaves {
                    let dot = |a: [i16; 3], b: [i16; 3]| -> f64 {
                        (0..3).map(|i| f64::from(a[i]) * f64::from(b[i])).sum()
                    };
                    let lengths =
                        (dot(leaf.normal, leaf.normal) * dot(unit.normal, unit.normal)).sqrt();
                    assert!(dot(leaf.normal, unit.normal) >= lengths * (0.5f64.sqrt() - 1e-9));
                    let far = apart(leaf, unit) + (leaf.radius2 as f64).sqrt();
                    assert!(far * far <= unit.radius2 as f64 * (1.0 + 1e-12));
                    assert_eq!(unit.patch.join(&leaf.patch), unit.patch);
                    assert!(unit.two_sided || !leaf.two_sided);
                }
            }
        }
    }
    assert!(n_units > 500, "{n_units}");
}

#[test]
fn no_leaf_pair_of_a_large_form_factor_is_left_out() {
    let (mut n_left_out, mut n_kept) = (0, 0);
    for seed in 0..40 {
        let tree = random_tree(&mut Rng::with_seed(seed));
        let least = [1e-7, 1e-5, 1e-3][seed as usize % 3];
        let layers = sorted(&tree, 0.0, least);
        assert_eq!(layers.len(), 1);
        let n = tree.surfels.len();
        let mut is_kept = vec![false; n * n];
        for (x, y) in layers[0].starts.iter().flat_map(|&start| leaf_pairs(&tree, start)) {
            let [x, y] = [x, y].map(|id| tree.nodes[id as usize].first_surfel as usize);
            (is_kept[x * n + y], is_kept[y * n + x]) = (true, true);
        }
        for a in 0..n {
            for b in (0..n).filter(|&b| b != a) {
                let (near, far) = (&tree.surfels[a], &tree.surfels[b]);
                let d = [0, 1, 2].map(|i| f64::from(far.centroid[i]) - f64::from(near.centroid[i]));
                let length = apart(near, far);
                let cosine = |s: &Surfel, sign: f64| match s.two_sided || s.normal == [0; 3] {
                    true => 1.0,
                    false => {
                        let n = s.normal.map(f64::from);
                        let dot: f64 = (0..3).map(|i| sign * n[i] * d[i]).sum();
                        let of_normal = n.iter().map(|v| v * v).sum::<f64>().sqrt();
                        (dot / (length * of_normal)).max(0.0)
                    }
                };
                let side = 2.0 * f64::from(far.half_spacing);
                let area = far.n_points as f64 * side * side;
                let factor = cosine(near, 1.0) * cosine(far, -1.0) * area / (PI * length * length);
                assert!(is_kept[a * n + b] || factor < least, "tree {seed}: {factor}");
                (n_kept, n_left_out) = match is_kept[a * n + b] {
                    true => (n_kept + 1, n_left_out),
                    false => (n_kept, n_left_out + 1),
                };
            }
        }
    }
    assert!(n_left_out > 10_000 && n_kept > 10_000, "{n_left_out} left out, {n_kept} kept");
}

#[test]
fn d9_what_does_not_fit_is_refused() {
    let tree = random_tree(&mut Rng::with_seed(1));
    let what = Approximation { opening_angle: 0.2, ..Approximation::default() };
    let of = |bytes| layers(&tree, &[(0, 0)], &what, Spacing::Leaf, bytes, &Quiet).map(|l| l.len());
    assert!(matches!(of(1 << 10), Err(StoreError::Budget { .. })));
    let nodes_only = 4 * (tree.nodes.len() as u64 * NODE_BYTES + START_BYTES);
    assert!(matches!(of(nodes_only), Err(StoreError::Budget { .. })));
    assert!(of(1 << 20).unwrap() > 1);
}

#[test]
fn d9_a_coarser_tree_that_does_not_fit_is_refused() {
    // No leaf has a normal: no node becomes a unit, and nothing is cut off.
    let mut tree = random_tree(&mut Rng::with_seed(1));
    tree.surfels.iter_mut().for_each(|leaf| leaf.normal = [0; 3]);
    let of = |bytes| cut_off(&tree, 3, Vec::new(), bytes, &Quiet);
    let records = tree.nodes.len() * size_of::<Node>() + tree.surfels.len() * size_of::<Surfel>();
    assert!(matches!(of(records as u64), Err(StoreError::Budget { .. })));
    let layer = of(2 * records as u64).unwrap();
    assert_eq!(layer.tree.nodes.len(), tree.nodes.len());
    assert_eq!(layer.tree.nodes.capacity(), tree.nodes.len());
    assert_eq!(layer.tree.surfels.capacity(), tree.surfels.len());
}

/// Adds up what is told, and asks to stop after so many looks.
struct Told {
    looks_left: AtomicU64,
    /// Name, total and how much of it is done.
    stages: Mutex<Vec<(&'static str, u64, u64)>>,
}

impl Told {
    fn new(n_looks: u64) -> Told {
        Told { looks_left: AtomicU64::new(n_looks), stages: Mutex::default() }
    }
}

impl Watch for Told {
    fn stage(&self, name: &'static str, total: Option<u64>, _unit: &'static str) {
        self.stages.lock().unwrap().push((name, total.unwrap(), 0));
    }

    fn advance(&self, n: u64) {
        self.stages.lock().unwrap().last_mut().unwrap().2 += n;
    }

    fn warn(&self, message: &str) {
        panic!("{message}");
    }

    fn is_stopped(&self) -> bool {
        let less = |left: u64| left.checked_sub(1);
        self.looks_left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_err()
    }
}

#[test]
fn d10_layers_tell_how_far_they_are_and_stop_at_every_look() {
    let tree = random_tree(&mut Rng::with_seed(3));
    let what = Approximation { opening_angle: 0.1, min_form_factor: 1e-12, min_exchange: 0.0 };
    let of = |told: &Told| layers(&tree, &[(0, 0)], &what, Spacing::Leaf, 1 << 30, told);
    let told = Told::new(u64::MAX);
    assert!(of(&told).unwrap().len() > 2);
    let stages = told.stages.into_inner().unwrap();
    assert_eq!(stages.iter().map(|stage| stage.0).collect::<Vec<_>>(), ["layers", "coarser trees"]);
    assert!(stages.iter().all(|&(_, total, done)| total > 0 && done == total), "{stages:?}");
    let n_looks = u64::MAX - told.looks_left.into_inner();
    let stage_of_look = |n: u64| {
        let told = Told::new(n);
        assert!(matches!(of(&told), Err(StoreError::Interrupted)), "look {n}");
        told.stages.into_inner().unwrap().len()
    };
    let stopped: Vec<usize> = (0..n_looks).map(stage_of_look).collect();
    assert!(stopped.starts_with(&[1]) && stopped.ends_with(&[2, 2]), "{stopped:?}");
    assert!(of(&Told::new(n_looks)).is_ok());
}
