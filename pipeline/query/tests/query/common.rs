//! Small maps made in memory: random points, a tree over them, random links, a sealed file.

use std::collections::BTreeMap;

use fastrand::Rng;
use pvmap_geometry::disc::Profile;
use pvmap_geometry::normal::{self, Normal};
use pvmap_geometry::{Box3, Frame, GridPoint, Rect, morton};
use pvmap_vmap::container::{BLOCK_BYTES, Written, align, head_bytes};
use pvmap_vmap::frame::{CrsKind, FrameRecord};
use pvmap_vmap::links::LinkEncoder;
use pvmap_vmap::map::{close_map, section_names};
use pvmap_vmap::records::{LinkBlock, NO_PARENT, Record};
use pvmap_vmap::tree::{fill_overhangs, root_node};
use pvmap_vmap::{MapConfig, MapSummary, Node, Shape, Spacing, Split, Surfel, Tree};

/// A sample with an oriented normal, or [0; 3] without one.
pub(crate) type Sample = (GridPoint, Normal);

/// How a tree is cut.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cut {
    pub(crate) shape: Shape,
    pub(crate) leaf_capacity: usize,
    pub(crate) max_level: u8,
    /// Half spacing of leaves with fewer than four points.
    pub(crate) few: u32,
}

/// Gives points in clumps of random width, the cube's corners among them.
pub(crate) fn random_points(rng: &mut Rng, n: usize) -> Vec<Sample> {
    let clumps: Vec<(GridPoint, u32)> =
        (0..4).map(|_| ([0; 3].map(|_| rng.u32(..1 << 22)), 1 << rng.u32(1..22))).collect();
    let point = |i: usize, rng: &mut Rng| {
        let (middle, width) = clumps[i % clumps.len()];
        let g = middle.map(|m| (m + rng.u32(..width)).min((1 << 22) - 1));
        let n = [0; 3].map(|_| rng.f32() - 0.5);
        (g, normal::quantise(n).filter(|_| rng.u8(..8) > 0).unwrap_or_default())
    };
    let mut points: Vec<Sample> = (0..n).map(|i| point(i, rng)).collect();
    points[0].0 = [0; 3];
    points[n - 1].0 = [(1 << 22) - 1; 3];
    points
}

/// Cuts points into a tree.
pub(crate) fn grow(points: &[Sample], cut: Cut) -> Tree {
    let mut tree = Tree::default();
    if !points.is_empty() {
        let root = Node { split: Split::Leaf, ..root_node(cut.shape, 0) };
        add(&mut tree, points, cut, root);
        fill_overhangs(&mut tree);
    }
    tree
}

fn add(tree: &mut Tree, points: &[Sample], cut: Cut, mut node: Node) {
    let id = tree.nodes.len() as u32;
    node.split = split_of(points, cut, &node);
    node.first_surfel = tree.surfels.len() as u32;
    node.n_points = points.len() as u64;
    tree.nodes.push(node);
    if node.is_leaf() {
        tree.surfels.push(surfel(points, cut, &node, id));
    }
    let mut groups: BTreeMap<u8, Vec<Sample>> = BTreeMap::new();
    for &(g, n) in points {
        let slot = match node.split {
            Split::Leaf => break,
            Split::Octants => morton::octant(morton::encode(g), node.level + 1),
            Split::Quadrants => normal::quadrant(n, node.bin as usize / 2),
            Split::Bins => normal::bin(n, true),
        };
        groups.entry(slot).or_default().push((g, n));
    }
    for (slot, group) in groups {
        let mut child = Node { parent: id, slot, ..node };
        match node.split {
            Split::Octants => {
                child.level += 1;
                child.first_code =
                    morton::cell_range(morton::encode(group[0].0), child.level).start;
            }
            Split::Bins => child.bin = slot as i8,
            Split::Quadrants | Split::Leaf => {}
        }
        add(tree, &group, cut, child);
    }
    tree.nodes[id as usize].end = tree.nodes.len() as u32;
    tree.nodes[id as usize].end_surfel = tree.surfels.len() as u32;
}

/// Decides what the children of a node are; `node.split` is still that of its parent.
fn split_of(points: &[Sample], cut: Cut, node: &Node) -> Split {
    if node.parent == NO_PARENT && cut.shape == Shape::Binned {
        return Split::Bins;
    }
    if node.split == Split::Quadrants {
        return Split::Leaf;
    }
    if points.len() > cut.leaf_capacity && node.level < cut.max_level {
        return Split::Octants;
    }
    let sum = sum_of(points);
    let strays = points.iter().any(|&(_, n)| normal::strays(n, sum));
    let quadrant = |&(_, n): &Sample| normal::quadrant(n, node.bin as usize / 2);
    let several =
        (0..6).contains(&node.bin) && points.iter().any(|p| quadrant(p) != quadrant(&points[0]));
    if strays && several { Split::Quadrants } else { Split::Leaf }
}

fn sum_of(points: &[Sample]) -> [i64; 3] {
    let add = |s: [i64; 3], n: Normal| [0, 1, 2].map(|i| s[i] + i64::from(n[i]));
    points.iter().fold([0; 3], |s, &(_, n)| add(s, n))
}

fn surfel(points: &[Sample], cut: Cut, node: &Node, id: u32) -> Surfel {
    let m = points.len() as u64;
    let around =
        points.iter().fold(Box3::EMPTY, |b, &(g, _)| b.join(&Box3::at(g.map(|v| v as i32))));
    let mut sides = [0, 1, 2].map(|i| (around.max[i] - around.min[i]) as u64 + 1);
    sides.sort_unstable();
    let dense = ((sides[1] * sides[2] / m).isqrt() / 2).max(1) as u32;
    let half_spacing = if m < 4 { cut.few } else { dense };
    let sum = |i: usize| points.iter().map(|&(g, _)| u64::from(g[i])).sum::<u64>();
    let centroid = [0, 1, 2].map(|i| ((2 * sum(i) + m) / (2 * m)) as u32);
    Surfel {
        centroid,
        normal: normal::rescale(sum_of(points)),
        two_sided: false,
        half_spacing,
        radius2: 1,
        n_points: m,
        first_code: node.first_code,
        patch: around.grown(half_spacing as i32),
        color: None,
        level: node.level,
        bin: node.bin,
        node: id,
    }
}

/// Gives links that cover each leaf pair at most once, in order: from each start pair down, both
/// sides at once, a pair is a link, is nothing, or (`deeper` of 256) is looked into.
pub(crate) fn random_links(
    rng: &mut Rng,
    tree: &Tree,
    starts: &[(u32, u32)],
    deeper: u8,
) -> Vec<(u32, u32)> {
    let mut links = Vec::new();
    let mut open = starts.to_vec();
    while let Some((a, b)) = open.pop() {
        let both_leaves = [a, b].iter().all(|&id| tree.nodes[id as usize].is_leaf());
        if !both_leaves && rng.u8(..) <= deeper {
            let kids_b: Vec<u32> = tree.kids(b).collect();
            open.extend(tree.kids(a).flat_map(|x| kids_b.iter().map(move |&y| (x, y))));
        } else if rng.bool() {
            links.push((a.min(b), a.max(b)));
        }
    }
    links.sort_unstable();
    links
}

/// Lists all pairs of siblings.
pub(crate) fn siblings(tree: &Tree) -> Vec<(u32, u32)> {
    let of = |id| {
        let kids: Vec<u32> = tree.children(id).collect();
        let pairs = |i: usize| kids[i + 1..].iter().map(|&b| (kids[i], b)).collect::<Vec<_>>();
        (0..kids.len()).flat_map(pairs).collect::<Vec<_>>()
    };
    (0..tree.nodes.len() as u32).flat_map(of).collect()
}

/// What a map file is sealed from.
#[derive(Debug, Clone)]
pub(crate) struct Parts {
    /// Name, bytes a record, bytes; in file order.
    pub(crate) sections: Vec<(&'static str, u32, Vec<u8>)>,
}

/// What decides a map's sections besides tree and links.
#[derive(Debug, Clone, Copy)]
pub(crate) struct About {
    pub(crate) profile: Profile,
    /// Whether the map says that it was built from given pairs.
    pub(crate) given: bool,
    pub(crate) frame: Frame,
    pub(crate) links_per_frame: usize,
}

impl Default for About {
    fn default() -> About {
        let profile = Profile::Patch;
        About { profile, given: false, frame: frame(), links_per_frame: usize::MAX }
    }
}

impl Parts {
    /// Makes the sections of a map.
    pub(crate) fn new(tree: &Tree, links: &[(u32, u32)], about: About) -> Parts {
        let About { profile, given, frame, links_per_frame } = about;
        let mut frames: Vec<(LinkBlock, Vec<u8>)> = Vec::new();
        for links in links.chunks(links_per_frame) {
            let mut encoder = LinkEncoder::new().unwrap();
            frames.extend(links.iter().filter_map(|&l| encoder.push(l).unwrap()));
            frames.extend(encoder.finish().unwrap());
        }
        let mut offset_bytes = 0;
        for (block, bytes) in &mut frames {
            block.offset_bytes = offset_bytes;
            offset_bytes += bytes.len() as u64;
        }
        let summary = MapSummary {
            n_points: tree.nodes.first().map_or(0, |root| root.n_points),
            n_nodes: tree.nodes.len() as u32,
            n_surfels: tree.surfels.len() as u32,
            n_links: links.len() as u64,
            n_visible_pairs: links.iter().map(|&l| n_leaf_pairs(tree, l)).sum(),
            digest: 7,
            n_fractions: 0,
        };
        let config = MapConfig {
            max_level: 21,
            leaf_capacity: 1,
            max_spread: 0,
            shape: Shape::Binned,
            profile,
            spacing: Spacing::Leaf,
            interaction_pairs: given.then_some((3, 5)),
            opening_angle: 0.0,
            min_form_factor: 0.0,
            min_exchange: 0.0,
            fractions: false,
        };
        let frame = FrameRecord { frame, crs_kind: CrsKind::None };
        let contents = [
            (MapSummary::BYTES, summary.to_bytes()),
            (0, config.to_text().into_bytes()),
            (Node::BYTES, tree.nodes.iter().flat_map(Record::to_bytes).collect()),
            (Surfel::BYTES, tree.surfels.iter().flat_map(Record::to_bytes).collect()),
            (0, frames.iter().flat_map(|(_, bytes)| bytes.clone()).collect()),
            (LinkBlock::BYTES, frames.iter().flat_map(|(block, _)| block.to_bytes()).collect()),
            (FrameRecord::BYTES, frame.to_bytes()),
            (0, Vec::new()),
        ];
        let rects = (profile == Profile::Oriented)
            .then(|| (Rect::BYTES, tree.rects.iter().flat_map(Record::to_bytes).collect()));
        let names = section_names(profile, false).into_iter();
        let named = names.zip(contents.into_iter().chain(rects));
        Parts { sections: named.map(|(name, (size, bytes))| (name, size as u32, bytes)).collect() }
    }

    /// Gives a section's bytes.
    pub(crate) fn bytes_mut(&mut self, name: &str) -> &mut Vec<u8> {
        &mut self.sections.iter_mut().find(|s| s.0 == name).unwrap().2
    }

    /// Puts the sections into a file with right checksums.
    pub(crate) fn seal(&self) -> Vec<u8> {
        let mut file = vec![0; head_bytes(self.sections.len()) as usize];
        let mut table = Vec::new();
        for (name, record_bytes, bytes) in &self.sections {
            file.resize(align(file.len() as u64) as usize, 0);
            table.push(Written {
                name,
                offset_bytes: file.len() as u64,
                len_bytes: bytes.len() as u64,
                record_bytes: *record_bytes,
                sums: bytes.chunks(BLOCK_BYTES as usize).map(crc32fast::hash).collect(),
            });
            file.extend(bytes);
        }
        let closing = close_map(&table);
        file.resize(closing.sums_offset_bytes as usize, 0);
        file.extend(closing.sums);
        file[..closing.head.len()].copy_from_slice(&closing.head);
        file
    }
}

/// A frame in which one world unit is 1000 grid steps, on a lattice away from the origin.
pub(crate) fn frame() -> Frame {
    let steps = (1 << 22) - 1;
    Frame::of_lattice([0.001; 3], [500_000.0, -3.0, 0.0], [-7; 3], [-7 + steps; 3])
}

fn n_leaf_pairs(tree: &Tree, (a, b): (u32, u32)) -> u128 {
    let n = |id: u32| {
        let node = &tree.nodes[id as usize];
        u128::from(node.end_surfel - node.first_surfel)
    };
    n(a) * n(b)
}
