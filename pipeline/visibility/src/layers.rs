//! What an approximate build decides instead of all leaf pairs. Source: DESIGN.md [D-6]; defined in
//! full in `pipeline/README.md`.
//!
//! **Opening angle** (Barnes & Hut 1986; the well-separated lists of the fast multipole method,
//! Greengard & Rokhlin 1987). From afar a node is as good as its leaves. A [`Layer`] is the tree
//! cut off at a level: nodes of that level become leaves, *units*, with a surfel put together from
//! those under them. Each pair of nodes goes to the coarsest layer whose cells, from the nearest
//! centroid of the other node, are seen under the opening angle at most; there it is decided
//! exactly, [V-1] to [V-4], with the layer's surfels as ends and as occluders. What is VISIBLE
//! there is a link of the map. The last layer is the tree itself, in which near pairs are decided
//! as ever. Units have no rectangles [F-22]: with profile `oriented` all but the last layer block
//! as with `patch`.
//!
//! **Form factor.** Node pairs are left out whose leaves' form factors, cos·cos·area/(π·d²) (the
//! far field of Goral et al. 1984), are all below a least one: the map says that they do not see
//! each other. The bound is conservative: no leaf pair that reaches the least one is left out.

use std::borrow::Cow;
use std::f64::consts::PI;

use pvmap_geometry::disc::Profile;
use pvmap_geometry::{Box3, normal};
use pvmap_store::memory::require;
use pvmap_store::runs::Pair;
use pvmap_store::{StoreError, Watch};
use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::{Fraction, Node, Spacing, Split, Surfel, Tree};

use crate::fractions;
use crate::shares::fixed_bytes;
use crate::tasks::n_leaf_pairs;

/// What may be left out or seen coarsely; 0 for nothing.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Approximation {
    /// Side of a cell over its distance up to which it is not opened, 0…1.
    pub opening_angle: f64,
    /// Form factor below which leaf pairs may be left out, 0…1.
    pub min_form_factor: f64,
    /// Exchange below which a node pair is tried by a sample, 0…1. [F-26]
    pub min_exchange: f64,
}

impl Approximation {
    /// Says whether the pairs to start from are sorted into layers.
    pub fn is_layered(&self) -> bool {
        self.opening_angle > 0.0 || self.min_form_factor > 0.0
    }
}

/// A tree and the pairs of its nodes that are decided in it.
#[derive(Debug)]
pub struct Layer<'a> {
    /// The tree, or what is left of it.
    pub tree: Cow<'a, Tree>,
    /// The pairs to decide; a node with itself stands for all siblings under it.
    pub starts: Vec<Pair>,
    /// For each node here that of the whole tree, rising; empty for the whole tree.
    nodes: Vec<u32>,
}

impl<'a> Layer<'a> {
    /// Makes the layer that is the whole tree.
    pub fn all(tree: &'a Tree, starts: Vec<Pair>) -> Layer<'a> {
        Layer { tree: Cow::Borrowed(tree), starts, nodes: Vec::new() }
    }

    /// Gives how its discs block in a build of this profile.
    pub fn profile(&self, profile: Profile) -> Profile {
        match profile {
            Profile::Oriented if !self.nodes.is_empty() => Profile::Patch,
            profile => profile,
        }
    }

    /// Gives the bytes of what it holds besides its tree.
    pub fn lists_bytes(&self) -> u64 {
        (self.starts.capacity() * size_of::<Pair>() + self.nodes.capacity() * size_of::<u32>())
            as u64
    }

    /// Gives the node of the whole tree.
    fn whole_node(&self, id: u32) -> u32 {
        self.nodes.get(id as usize).copied().unwrap_or(id)
    }

    /// Gives the pair of the whole tree, in the same order.
    pub fn whole(&self, (a, b): Pair) -> Pair {
        (self.whole_node(a), self.whole_node(b))
    }

    /// Makes pairs of the whole tree of pairs of the layer, links or with visible fractions.
    pub fn make_whole(&self, pairs: &mut [Pair]) {
        if !self.nodes.is_empty() {
            pairs.iter_mut().for_each(|pair| {
                *pair = match fractions::unmarked(*pair) {
                    None => self.whole(*pair),
                    Some(Fraction { a, b, n_free }) => {
                        let (a, b) = self.whole((a, b));
                        fractions::marked(Fraction { a, b, n_free })
                    }
                }
            });
        }
    }
}

/// A pair is handed to its layer once its nodes are at most so many levels above the layer's: some
/// 64 units each, which are decided together.
const LEVELS_ABOVE: u8 = 3;

/// A pair is handed on to see what below it has too small a form factor while it has more than one
/// in so many of all leaf pairs: the list of pairs has some millions of entries at most.
const FORM_FACTOR_PARTS: u64 = 1 << 18;

/// Nodes or node pairs between two looks at whether to stop: some 10 ms.
const LOOK_EVERY: usize = 4096;

/// Bytes a node and a start take while pairs are sorted; a list may have as much room to grow.
const NODE_BYTES: u64 = (size_of::<Extent>() + 2 * size_of::<u32>()) as u64;
const START_BYTES: u64 = 2 * size_of::<Pair>() as u64;

/// Sorts the pairs to decide into layers, the coarsest first, the tree itself last.
///
/// # Errors
/// Where sorting them needs more than a quarter of the memory, the trees of the layers need more
/// than there is, or the run is asked to stop.
pub fn layers<'a>(
    tree: &'a Tree,
    starts: &[Pair],
    approximation: &Approximation,
    spacing: Spacing,
    memory_bytes: u64,
    watch: &dyn Watch,
) -> Result<Vec<Layer<'a>>, StoreError> {
    let need_bytes = tree.nodes.len() as u64 * NODE_BYTES;
    let have_bytes = memory_bytes / 4;
    require("the layers of an approximate build", need_bytes, have_bytes)?;
    let n_pairs = starts.iter().map(|&pair| n_leaf_pairs(tree, pair)).sum();
    watch.stage("layers", Some(n_pairs), "pairs");
    let deepest = tree.nodes.iter().map(|node| node.level).max().unwrap_or(0);
    let n_leaves = tree.surfels.len() as u64;
    let mut sorter = Sorter {
        tree,
        approximation: *approximation,
        extents: extents(tree, spacing),
        deepest,
        part: n_leaves * n_leaves.saturating_sub(1) / 2 / FORM_FACTOR_PARTS,
        of_level: vec![Vec::new(); usize::from(deepest) + 1],
        n_starts: 0,
        most_starts: (have_bytes - need_bytes) / START_BYTES,
        n_sorted: 0,
        n_settled: 0,
        watch,
    };
    starts.iter().try_for_each(|&(a, b)| sorter.sort(a, b))?;
    watch.advance(sorter.n_settled);
    let Sorter { mut of_level, extents, n_starts, .. } = sorter;
    drop(extents);
    let near = of_level.pop().unwrap_or_default();
    let mut held_bytes = fixed_bytes(tree) + n_starts * size_of::<Pair>() as u64;
    let mut layers = Vec::new();
    let n_coarse = of_level.iter().filter(|starts| !starts.is_empty()).count();
    watch.stage("coarser trees", Some((n_coarse * tree.nodes.len()) as u64), "nodes");
    for (starts, level) in of_level.into_iter().zip(0..).filter(|(starts, _)| !starts.is_empty()) {
        let have_bytes = memory_bytes.saturating_sub(held_bytes);
        let layer = cut_off(tree, level, starts, have_bytes, watch)?;
        held_bytes += fixed_bytes(&layer.tree) + (layer.nodes.len() * size_of::<u32>()) as u64;
        layers.push(layer);
    }
    layers.push(Layer::all(tree, near));
    Ok(layers)
}

/// What is known of the leaves under a node.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extent {
    /// Of the centroids.
    pub(crate) centroids: Box3,
    /// Least and greatest of each component of the normals.
    normals: [[i16; 3]; 2],
    /// Whether some leaf may look anywhere: it is two-sided, or has no normal.
    any_side: bool,
    /// The largest leaf's area, grid steps².
    area: f64,
}

impl Extent {
    const NOTHING: Extent = Extent {
        centroids: Box3::EMPTY,
        normals: [[i16::MAX; 3], [i16::MIN; 3]],
        any_side: false,
        area: 0.0,
    };

    fn of_leaf(leaf: &Surfel, spacing: Spacing) -> Extent {
        // A side of the square that a point has for itself, in half spacings [F-21].
        let side = match spacing {
            Spacing::Leaf => 2.0,
            Spacing::Neighbors => 8.0 / 3.0,
        };
        Extent {
            centroids: Box3::at(leaf.centroid.map(|v| v as i32)),
            normals: [leaf.normal; 2],
            any_side: leaf.two_sided || leaf.normal == [0; 3],
            area: leaf.n_points as f64 * (side * f64::from(leaf.half_spacing)).powi(2),
        }
    }

    fn join(&self, other: &Extent) -> Extent {
        let [(least, greatest), (low, high)] = [self, other].map(|e| (e.normals[0], e.normals[1]));
        Extent {
            centroids: self.centroids.join(&other.centroids),
            normals: [
                [0, 1, 2].map(|i| least[i].min(low[i])),
                [0, 1, 2].map(|i| greatest[i].max(high[i])),
            ],
            any_side: self.any_side || other.any_side,
            area: self.area.max(other.area),
        }
    }

    /// Gives the area of the largest leaf, grid steps².
    pub(crate) fn largest_area(&self) -> f64 {
        self.area
    }

    /// Bounds the cosine between a normal and a way to a centroid of another node, `near` steps
    /// long or longer.
    pub(crate) fn cosine(&self, other: &Extent, near: f64) -> f64 {
        if self.any_side {
            return 1.0;
        }
        let (from, to) = (&self.centroids, &other.centroids);
        let most = |i: usize| {
            let ways = [to.min[i] - from.max[i], to.max[i] - from.min[i]].map(f64::from);
            let parts = self.normals.map(|n| ways.map(|way| way * f64::from(n[i])));
            parts.as_flattened().iter().copied().fold(f64::NEG_INFINITY, f64::max)
        };
        // A normal is rounded to a length of 2^14, within a step.
        let length = f64::from(normal::NORMAL_LENGTH - 1) * near;
        ((0..3).map(most).sum::<f64>() / length).clamp(0.0, 1.0)
    }
}

/// Gives what is known of each node.
pub(crate) fn extents(tree: &Tree, spacing: Spacing) -> Vec<Extent> {
    let mut extents = vec![Extent::NOTHING; tree.nodes.len()];
    // Preorder backwards: children come before their parent.
    for (id, node) in tree.nodes.iter().enumerate().rev() {
        if node.is_leaf() {
            extents[id] = Extent::of_leaf(&tree.surfels[node.first_surfel as usize], spacing);
        }
        if node.parent != NO_PARENT {
            let parent = node.parent as usize;
            extents[parent] = extents[parent].join(&extents[id]);
        }
    }
    extents
}

/// Hands pairs to layers.
struct Sorter<'a> {
    tree: &'a Tree,
    approximation: Approximation,
    extents: Vec<Extent>,
    /// Level of the deepest leaf: that of the last layer.
    deepest: u8,
    /// Leaf pairs up to which a pair is not handed on for its form factor.
    part: u64,
    of_level: Vec<Vec<Pair>>,
    n_starts: u64,
    most_starts: u64,
    /// Node pairs looked at, and leaf pairs settled since the last look at whether to stop.
    n_sorted: usize,
    n_settled: u64,
    watch: &'a dyn Watch,
}

impl Sorter<'_> {
    /// Sorts the leaf pairs under a pair, of a node with itself those of siblings under it;
    /// recurses at most 24 deep.
    fn sort(&mut self, a: u32, b: u32) -> Result<(), StoreError> {
        let tree = self.tree;
        let level = tree.nodes[a as usize].level.max(tree.nodes[b as usize].level);
        let [from, to] = [a, b].map(|id| &self.extents[id as usize]);
        let (near2, far2) = (nearest2(&from.centroids, &to.centroids), farthest2(from, to));
        let n_pairs = n_leaf_pairs(tree, (a, b));
        self.n_sorted += 1;
        if self.n_sorted.is_multiple_of(LOOK_EVERY) {
            self.watch.check()?;
            self.watch.advance(std::mem::take(&mut self.n_settled));
        }
        if n_pairs == 0 || (a != b && self.is_negligible(from, to, near2)) {
            self.n_settled += n_pairs;
            return Ok(());
        }
        // Quadrants are as deep as the node they are of: it must not be a unit.
        let of_layer = if a == b { self.deepest } else { self.level_at(near2).max(level + 1) };
        let is_leaf = tree.nodes[a as usize].is_leaf() || tree.nodes[b as usize].is_leaf();
        // Below, some pairs may be left out, or be farther and go to a coarser layer.
        let is_open = (self.approximation.min_form_factor > 0.0 && n_pairs > self.part)
            || self.level_at(far2) < of_layer;
        if is_leaf || !is_open || level.saturating_add(LEVELS_ABOVE) >= of_layer {
            self.n_starts += 1;
            let (need, have) = (self.n_starts * START_BYTES, self.most_starts * START_BYTES);
            require("the pairs of an approximate build", need, have)?;
            self.of_level[usize::from(of_layer.min(self.deepest))].push((a, b));
            self.n_settled += n_pairs;
            return Ok(());
        }
        let all = tree.kids(a).flat_map(|x| tree.kids(b).map(move |y| (x, y)));
        all.filter(|(x, y)| a != b || x <= y).try_for_each(|(x, y)| self.sort(x, y))
    }

    /// Gives the coarsest level whose cells are seen under the angle at most from so far away.
    fn level_at(&self, distance2: f64) -> u8 {
        let side = self.approximation.opening_angle * distance2.sqrt();
        (1..self.deepest).find(|&l| f64::from(1u32 << (22 - l)) <= side).unwrap_or(self.deepest)
    }

    /// Says that no leaf pair has as large a form factor as is asked for.
    fn is_negligible(&self, a: &Extent, b: &Extent, near2: f64) -> bool {
        let least = self.approximation.min_form_factor;
        least > 0.0 && near2 > 0.0 && {
            let cosines = a.cosine(b, near2.sqrt()) * b.cosine(a, near2.sqrt());
            cosines * a.area.max(b.area) < least * PI * near2
        }
    }
}

/// Gives the squared distance of two boxes.
pub(crate) fn nearest2(a: &Box3, b: &Box3) -> f64 {
    let gap = |i: usize| f64::from((b.min[i] - a.max[i]).max(a.min[i] - b.max[i]).max(0));
    (0..3).map(|i| gap(i) * gap(i)).sum()
}

/// Gives the squared distance of the two places of two boxes that are farthest apart.
fn farthest2(a: &Extent, b: &Extent) -> f64 {
    let (a, b) = (&a.centroids, &b.centroids);
    let most = |i: usize| f64::from((b.max[i] - a.min[i]).max(a.max[i] - b.min[i]));
    (0..3).map(|i| most(i) * most(i)).sum()
}

/// Cuts a tree off at a level.
///
/// # Errors
/// Where what is left of the tree needs more memory than it may take, or the run is asked to stop.
fn cut_off(
    tree: &Tree,
    level: u8,
    starts: Vec<Pair>,
    memory_bytes: u64,
    watch: &dyn Watch,
) -> Result<Layer<'static>, StoreError> {
    // Counted first, so that nothing has spare room or is begun that does not fit.
    let (mut n_nodes, mut n_surfels) = (0, 0);
    for (_, unit) in left_of(tree, level) {
        look(n_nodes, watch)?;
        n_nodes += 1;
        n_surfels += usize::from(unit.is_some());
    }
    let of_nodes = n_nodes * (size_of::<Node>() + size_of::<u32>());
    let places = tree.nodes.len() * size_of::<u32>();
    let need_bytes = (of_nodes + n_surfels * size_of::<Surfel>() + places) as u64;
    require("the coarser trees of an approximate build", need_bytes, memory_bytes)?;
    let mut nodes: Vec<u32> = Vec::with_capacity(n_nodes);
    let mut cut = Tree {
        nodes: Vec::with_capacity(n_nodes),
        surfels: Vec::with_capacity(n_surfels),
        ..Tree::default()
    };
    let mut place = vec![u32::MAX; tree.nodes.len()];
    let mut n_told = 0;
    for (at, unit) in left_of(tree, level) {
        if look(nodes.len(), watch)? {
            watch.advance((at - std::mem::replace(&mut n_told, at)) as u64);
        }
        let (id, node) = (nodes.len() as u32, &tree.nodes[at]);
        place[at] = id;
        nodes.push(at as u32);
        cut.nodes.push(Node {
            parent: if node.parent == NO_PARENT { NO_PARENT } else { place[node.parent as usize] },
            first_surfel: cut.surfels.len() as u32,
            split: if unit.is_some() { Split::Leaf } else { node.split },
            ..*node
        });
        cut.surfels.extend(unit.map(|surfel| Surfel { node: id, ..surfel }));
    }
    watch.advance((tree.nodes.len() - n_told) as u64);
    for id in 0..nodes.len() {
        // A subtree ends where the first node is that is not under it.
        let end = nodes.partition_point(|&node| node < cut.nodes[id].end);
        let after = cut.nodes.get(end).map_or(cut.surfels.len() as u32, |node| node.first_surfel);
        (cut.nodes[id].end, cut.nodes[id].end_surfel) = (end as u32, after);
    }
    let starts = starts.into_iter().map(|(a, b)| (place[a as usize], place[b as usize])).collect();
    Ok(Layer { tree: Cow::Owned(cut), starts, nodes })
}

/// Looks now and then whether to stop; says whether it did.
fn look(n_done: usize, watch: &dyn Watch) -> Result<bool, StoreError> {
    let is_due = n_done.is_multiple_of(LOOK_EVERY);
    if is_due {
        watch.check()?;
    }
    Ok(is_due)
}

/// Walks what is left of a tree that is cut off at a level, in preorder: ids of the whole tree, of
/// leaves and units with their surfel.
fn left_of(tree: &Tree, level: u8) -> impl Iterator<Item = (usize, Option<Surfel>)> + '_ {
    let mut next = 0;
    std::iter::from_fn(move || {
        let (at, node) = (next, tree.nodes.get(next)?);
        let unit = unit_of(tree, node, level);
        next = if unit.is_some() { node.end as usize } else { at + 1 };
        Some((at, unit))
    })
}

/// Gives the surfel that stands for a node in the layer of a level: a leaf's own, or one put
/// together from the leaves under a node of that level or below. None where a leaf has no normal or
/// one more than 45° from their sum: such a node is opened.
fn unit_of(tree: &Tree, node: &Node, level: u8) -> Option<Surfel> {
    let leaves = &tree.surfels[node.first_surfel as usize..node.end_surfel as usize];
    if node.is_leaf() {
        return leaves.first().copied();
    }
    if node.level < level {
        return None;
    }
    let (mut sum, mut place) = ([0i64; 3], [0u128; 3]);
    for leaf in leaves {
        for i in 0..3 {
            sum[i] += i64::from(leaf.normal[i]) * leaf.n_points as i64;
            place[i] += u128::from(leaf.centroid[i]) * u128::from(leaf.n_points);
        }
    }
    let normal = normal::rescale(sum);
    let dot = |n: [i16; 3], m: [i16; 3]| (0..3).map(|i| i64::from(n[i]) * i64::from(m[i])).sum();
    let is_along = |leaf: &Surfel| {
        let along: i64 = dot(leaf.normal, normal);
        along > 0 && 2 * along * along >= dot(leaf.normal, leaf.normal) * dot(normal, normal)
    };
    if !leaves.iter().all(is_along) {
        return None;
    }
    let n = u128::from(node.n_points);
    let centroid = place.map(|v| ((2 * v + n) / (2 * n)) as u32);
    let root_up = |v: u64| v.isqrt() + u64::from(v.isqrt().pow(2) < v);
    let reach = |leaf: &Surfel| {
        let apart2 = (0..3).map(|i| u64::from(leaf.centroid[i].abs_diff(centroid[i])).pow(2)).sum();
        root_up(apart2) + root_up(leaf.radius2)
    };
    let radius = leaves.iter().map(reach).max()?;
    let first = leaves.first()?;
    Some(Surfel {
        centroid,
        normal,
        two_sided: leaves.iter().any(|leaf| leaf.two_sided),
        radius2: (radius * radius).min(MOST_RADIUS2),
        n_points: node.n_points,
        first_code: node.first_code,
        patch: leaves.iter().fold(Box3::EMPTY, |all, leaf| all.join(&leaf.patch)),
        level: node.level,
        bin: node.bin,
        ..*first
    })
}

/// The largest R² of the kernels, which is beyond the cube's diagonal.
const MOST_RADIUS2: u64 = (1 << 46) - 1;

#[cfg(test)]
mod tests;
