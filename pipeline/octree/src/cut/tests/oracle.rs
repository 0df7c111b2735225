//! The tree as DESIGN.md §3 words it: recursion over vectors of points, wide integers, no haste.

use std::collections::{BTreeMap, BTreeSet};

use pvmap_geometry::disc::Profile;
use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Box3, Rect, morton};
use pvmap_vmap::records::NO_PARENT;
use pvmap_vmap::{Node, Shape, Spacing, Split, Surfel, Tree};

use super::TestPoint;
use crate::cut::CutOptions;

/// Cuts a cloud in any order.
pub(super) fn cut_slowly(cloud: &[TestPoint], depths: &[u32], options: &CutOptions) -> Tree {
    let mut oracle = Oracle { options: *options, depths: depths.to_vec(), tree: Tree::default() };
    let all: Vec<TestPoint> = cloud.to_vec();
    if all.is_empty() {
        return oracle.tree;
    }
    let whole = Cell { level: 0, corner: [0; 3], bin: -1 };
    match options.shape {
        Shape::Paper => oracle.octree(&all, whole, NO_PARENT, 0),
        Shape::Binned => {
            let bins = group(&all, |p| bin_of(p) as u8);
            let root = oracle.open(whole, NO_PARENT, 0, Split::Bins);
            for (&bin, points) in &bins {
                let bin_cell = Cell { bin: bin as i8, ..whole };
                oracle.octree(points, bin_cell, root, bin);
            }
            oracle.close(root, all.len());
        }
    }
    oracle.finish()
}

#[derive(Clone, Copy)]
struct Cell {
    level: u8,
    corner: [u32; 3],
    bin: i8,
}

struct Oracle {
    options: CutOptions,
    depths: Vec<u32>,
    tree: Tree,
}

impl Oracle {
    fn octree(&mut self, points: &[TestPoint], cell: Cell, parent: u32, slot: u8) {
        let fits = points.len() as u64 <= self.options.leaf_capacity
            && !is_spread(points, self.options.max_spread);
        if fits || cell.level == self.options.max_level {
            return self.leaf(points, cell, parent, slot);
        }
        let id = self.open(cell, parent, slot, Split::Octants);
        let level = cell.level + 1;
        let side = 1 << (22 - level);
        let octant_of = |p: &TestPoint| {
            let upper = [0, 1, 2].map(|i| u8::from(p.g[i] - cell.corner[i] >= side));
            upper[0] + 2 * upper[1] + 4 * upper[2]
        };
        for (octant, points) in group(points, octant_of) {
            let corner = [0, 1, 2].map(|i| cell.corner[i] + u32::from(octant >> i & 1) * side);
            let child = Cell { level, corner, ..cell };
            self.octree(&points, child, id, octant);
        }
        self.close(id, points.len());
    }

    fn leaf(&mut self, points: &[TestPoint], cell: Cell, parent: u32, slot: u8) {
        let quadrants = group(points, |p| match cell.bin {
            0..=5 => quadrant_of(p, cell.bin as usize / 2),
            _ => 0,
        });
        if !(0..=5).contains(&cell.bin) || !any_strays(points) || quadrants.len() == 1 {
            return self.surfel(points, cell, parent, slot);
        }
        let id = self.open(cell, parent, slot, Split::Quadrants);
        for (&quadrant, points) in &quadrants {
            self.surfel(points, cell, id, quadrant);
        }
        self.close(id, points.len());
    }

    fn surfel(&mut self, points: &[TestPoint], cell: Cell, parent: u32, slot: u8) {
        let id = self.open(cell, parent, slot, Split::Leaf);
        let centroid = [0, 1, 2].map(|i| mean(points.iter().map(|p| p.g[i])).expect("a point"));
        let distance2 = |p: &TestPoint| -> i128 {
            (0..3).map(|i| square(i128::from(p.g[i]) - i128::from(centroid[i]))).sum()
        };
        let (normal, two_sided) = self.normal(points);
        let lit: Vec<[u16; 3]> = points.iter().filter_map(|p| self.light(p)).collect();
        let color = [0, 1, 2].map(|i| mean(lit.iter().map(|c| u32::from(c[i]))).unwrap_or(0));
        self.tree.surfels.push(Surfel {
            centroid,
            normal,
            two_sided,
            half_spacing: 0,
            radius2: points.iter().map(distance2).max().expect("a point") as u64,
            n_points: points.len() as u64,
            first_code: code_of(cell.corner),
            patch: points.iter().fold(Box3::EMPTY, |b, p| b.join(&Box3::at(p.g.map(|v| v as i32)))),
            color: (!lit.is_empty()).then_some(color.map(|c| c as u16)),
            level: cell.level,
            bin: cell.bin,
            node: id,
        });
        if self.options.profile == Profile::Oriented {
            self.tree.rects.push(rect_of(points, centroid, normal));
        }
        self.close(id, points.len());
    }

    fn normal(&self, points: &[TestPoint]) -> (Normal, bool) {
        let with: Vec<&TestPoint> = points.iter().filter(|p| p.normal != [0; 3]).collect();
        let sizes = [0, 1, 2].map(|a| with.iter().map(|p| i128::from(p.normal[a]).abs()).sum());
        let axis = largest(sizes);
        let canonical = |p: &TestPoint| match self.options.shape {
            Shape::Binned => signed_by(p.normal, largest(wide(p.normal))),
            Shape::Paper => signed_by(p.normal, axis),
        };
        let unoriented = with.iter().any(|p| !p.oriented);
        let known = |p: &TestPoint| match p.oriented {
            true => p.normal,
            false => canonical(p),
        };
        let sum = total(with.iter().map(|p| known(p)));
        let limit = square((with.len() as i128) << 14);
        if 100 * dot(sum, sum) < limit {
            return (rescaled(total(with.iter().map(|p| canonical(p)))), true);
        }
        (rescaled(sum), unoriented)
    }

    fn light(&self, p: &TestPoint) -> Option<[u16; 3]> {
        let full = match self.depths[p.source as usize] {
            0 => return None,
            8 => 255.0,
            _ => 65535.0,
        };
        Some(p.color.map(|v| {
            let c = f64::from(v) / full;
            let light = match c <= 0.04045 {
                true => c / 12.92,
                false => ((c + 0.055) / 1.055).powf(2.4),
            };
            (light * 65535.0).round() as u16
        }))
    }

    fn open(&mut self, cell: Cell, parent: u32, slot: u8, split: Split) -> u32 {
        self.tree.nodes.push(Node {
            parent,
            end: 0,
            first_surfel: self.tree.surfels.len() as u32,
            end_surfel: 0,
            n_points: 0,
            first_code: code_of(cell.corner),
            level: cell.level,
            bin: cell.bin,
            split,
            slot,
            overhang: 0,
        });
        self.tree.nodes.len() as u32 - 1
    }

    fn close(&mut self, id: u32, n_points: usize) {
        let end = self.tree.nodes.len() as u32;
        let node = &mut self.tree.nodes[id as usize];
        node.end = end;
        node.end_surfel = self.tree.surfels.len() as u32;
        node.n_points = n_points as u64;
    }

    fn finish(mut self) -> Tree {
        let half_spacings = match self.options.spacing {
            Spacing::Leaf => self.tree.surfels.iter().map(own_half_spacing).collect(),
            Spacing::Neighbors => half_spacings_around(&self.tree),
        };
        let mut own: Vec<u32> = half_spacings.iter().copied().flatten().collect();
        own.sort();
        let lower_median = match own.len() {
            0 => 1,
            n if n % 2 == 1 => own[n / 2],
            n => own[n / 2 - 1],
        };
        for (s, half_spacing) in self.tree.surfels.iter_mut().zip(half_spacings) {
            s.half_spacing = half_spacing.unwrap_or(lower_median);
            let h = s.half_spacing as i32;
            s.patch.min = s.patch.min.map(|v| v - h);
            s.patch.max = s.patch.max.map(|v| v + h);
            if self.options.profile != Profile::Paper {
                let (h, far2) = (i128::from(h), i128::from(s.radius2));
                let far = root(far2) + i128::from(root(far2).pow(2) < far2);
                s.radius2 = match self.options.spacing {
                    Spacing::Leaf => far2.max(h * h),
                    Spacing::Neighbors => ((far + h) * (far + h)).min((1 << 46) - 1),
                } as u64;
            }
        }
        for (rect, s) in self.tree.rects.iter_mut().zip(&self.tree.surfels) {
            if s.normal != [0; 3] {
                let margin = (3 * s.half_spacing as i32 + 1) / 2;
                rect.low = rect.low.map(|v| v - margin);
                rect.high = rect.high.map(|v| v + margin);
            }
        }
        for node in &mut self.tree.nodes {
            let (low, side) = (morton::decode(node.first_code), 1 << (22 - node.level));
            for s in &self.tree.surfels[node.first_surfel as usize..node.end_surfel as usize] {
                for (i, low) in low.into_iter().enumerate() {
                    let below = low as i32 - s.patch.min[i];
                    let above = s.patch.max[i] - (low as i32 + side);
                    node.overhang = node.overhang.max(below.max(above).max(0) as u32);
                }
            }
        }
        self.tree
    }
}

/// Gives the rectangle without its margin: [F-22] as it stands.
fn rect_of(points: &[TestPoint], centroid: [u32; 3], normal: Normal) -> Rect {
    if normal == [0; 3] {
        return Rect { axes: [[0; 3]; 2], low: [0; 2], high: [0; 2] };
    }
    let n = wide(normal);
    let after = (largest(n) + 1) % 3;
    let unit = [0, 1, 2].map(|i| i128::from(i == after));
    let x = rescaled([0, 1, 2].map(|i| dot(n, n) * unit[i] - n[after] * n[i]));
    let y = rescaled(cross(n, wide(x)));
    let offset = |p: &TestPoint| [0, 1, 2].map(|i| i128::from(p.g[i]) - i128::from(centroid[i]));
    let at: Vec<[i128; 2]> =
        points.iter().map(|p| [dot(wide(x), offset(p)), dot(wide(y), offset(p))]).collect();
    let sum = |of: fn(&[i128; 2]) -> i128| at.iter().map(of).sum::<i128>();
    let (mut p, mut q) = (sum(|a| a[0] * a[0] - a[1] * a[1]), sum(|a| 2 * a[0] * a[1]));
    while p.abs() >= 1 << 30 || q.abs() >= 1 << 30 {
        (p, q) = (p.div_euclid(2), q.div_euclid(2));
    }
    let r = root(p * p + q * q);
    let [c, s] = match (p, q) {
        (0, 0) => [1, 0],
        _ if p >= 0 => [r + p, q],
        _ => [q, r - p],
    };
    let u = rescaled([0, 1, 2].map(|i| c * i128::from(x[i]) + s * i128::from(y[i])));
    let axes = [u, rescaled(cross(n, wide(u)))];
    let along = |axis: Normal| points.iter().map(move |p| dot(wide(axis), offset(p)));
    let low = axes.map(|axis| along(axis).map(|v| v.div_euclid(1 << 14)).min().unwrap_or(0));
    let high = axes.map(|axis| along(axis).map(|v| -(-v).div_euclid(1 << 14)).max().unwrap_or(0));
    Rect { axes, low: low.map(|v| v.min(0) as i32), high: high.map(|v| v.max(0) as i32) }
}

fn cross(a: [i128; 3], b: [i128; 3]) -> [i128; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Gives the half spacing around each leaf by going through all nodes.
fn half_spacings_around(tree: &Tree) -> Vec<Option<u32>> {
    let around = |leaf: u32| {
        let over = |n: &&Node| (n.first_surfel..n.end_surfel).contains(&leaf);
        let mut over: Vec<&Node> =
            tree.nodes.iter().filter(over).filter(|n| n.split != Split::Bins).collect();
        over.sort_by_key(|n| n.n_points);
        let found = over.iter().find(|n| n.n_points >= 16).or(over.last());
        let node = found.expect("a leaf is under itself");
        &tree.surfels[node.first_surfel as usize..node.end_surfel as usize]
    };
    let stands_for = |e1e2: i128, m: i128| e1e2 * (m + 1) * (m + 1) / ((m - 1) * (m - 1));
    let half_spacing = |leaf: u32| {
        let leaves = around(leaf);
        let n_all: u64 = leaves.iter().map(|s| s.n_points).sum();
        if n_all < 4 {
            return None;
        }
        let (mut area, mut n) = (0, 0);
        for s in leaves.iter().filter(|s| s.n_points > 2) {
            area += stands_for(longest_sides(&s.patch), s.n_points.into());
            n += i128::from(s.n_points);
        }
        if n == 0 {
            n = n_all.into();
            let all = leaves.iter().map(|s| s.patch).reduce(|a, b| a.join(&b));
            area = stands_for(longest_sides(&all.expect("it has leaves")), n);
        }
        Some(root(9 * area / (64 * n)).max(1) as u32)
    };
    (0..tree.surfels.len() as u32).map(half_spacing).collect()
}

/// Gives h by the box of the leaf's own points, if they are four.
fn own_half_spacing(s: &Surfel) -> Option<u32> {
    let area = longest_sides(&s.patch) / i128::from(s.n_points);
    (s.n_points >= 4).then(|| (root(area) / 2).max(1) as u32)
}

/// Gives e1·e2 of a box.
fn longest_sides(bounds: &Box3) -> i128 {
    let mut e = [0, 1, 2].map(|i| i128::from(bounds.max[i] - bounds.min[i] + 1));
    e.sort_by_key(|&v| -v);
    e[0] * e[1]
}

fn group(points: &[TestPoint], by: impl Fn(&TestPoint) -> u8) -> BTreeMap<u8, Vec<TestPoint>> {
    let mut groups: BTreeMap<u8, Vec<TestPoint>> = BTreeMap::new();
    for p in points {
        groups.entry(by(p)).or_default().push(*p);
    }
    groups
}

fn bin_of(p: &TestPoint) -> usize {
    if p.normal == [0; 3] {
        return 6;
    }
    let axis = largest(wide(p.normal));
    match p.oriented && p.normal[axis] < 0 {
        true => 2 * axis + 1,
        false => 2 * axis,
    }
}

fn seen(p: &TestPoint) -> Normal {
    match p.oriented {
        true => p.normal,
        false => signed_by(p.normal, largest(wide(p.normal))),
    }
}

fn quadrant_of(p: &TestPoint, axis: usize) -> u8 {
    let n = seen(p);
    let (u, v) = ([1, 2, 0][axis], [2, 0, 1][axis]);
    u8::from(n[u] < 0) + 2 * u8::from(n[v] < 0)
}

fn any_strays(points: &[TestPoint]) -> bool {
    let m = total(points.iter().map(seen));
    points.iter().any(|p| {
        let n = wide(seen(p));
        dot(n, m) < 0 || 4 * square(dot(n, m)) < 3 * dot(n, n) * dot(m, m)
    })
}

/// Makes the component along `axis` positive; where it is zero, the first that is not.
fn signed_by(n: Normal, axis: usize) -> Normal {
    let first = [n[axis], n[0], n[1], n[2]].into_iter().find(|&c| c != 0);
    match first {
        Some(c) if c < 0 => n.map(|v| -v),
        _ => n,
    }
}

fn largest(v: [i128; 3]) -> usize {
    let top = v.iter().map(|c| c.abs()).max().expect("three");
    v.iter().position(|c| c.abs() == top).expect("one of them")
}

fn rescaled(sum: [i128; 3]) -> Normal {
    let norm2 = dot(sum, sum);
    if norm2 == 0 {
        return [0; 3];
    }
    sum.map(|v| {
        // The largest q with q - 1/2 ≤ |v|·2^14/|s|.
        let reaches = |q: i128| square(2 * q - 1) * norm2 <= square(v << 15);
        let (mut low, mut high) = (0, 1 << 15);
        while high - low > 1 {
            let middle = (low + high) / 2;
            if reaches(middle) { low = middle } else { high = middle }
        }
        (low * v.signum()) as i16
    })
}

fn root(v: i128) -> i128 {
    let (mut low, mut high) = (0, 1 << 40);
    while high - low > 1 {
        let middle = (low + high) / 2;
        if middle * middle <= v { low = middle } else { high = middle }
    }
    low
}

fn mean(values: impl Iterator<Item = u32>) -> Option<u32> {
    let (sum, n) = values.fold((0i128, 0i128), |(s, n), v| (s + i128::from(v), n + 1));
    (n > 0).then(|| (2 * sum + n).div_euclid(2 * n) as u32)
}

fn code_of(corner: [u32; 3]) -> u64 {
    let bits = (0..63).map(|b| u64::from(corner[b % 3] >> (b / 3 + 1) & 1) << b);
    bits.sum()
}

fn total(normals: impl Iterator<Item = Normal>) -> [i128; 3] {
    normals.fold([0; 3], |s, n| [0, 1, 2].map(|i| s[i] + i128::from(n[i])))
}

fn wide(n: Normal) -> [i128; 3] {
    n.map(i128::from)
}

fn dot(a: [i128; 3], b: [i128; 3]) -> i128 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn square(v: i128) -> i128 {
    v * v
}

/// Says whether the box of few places is many times larger than what they cover.
fn is_spread(points: &[TestPoint], most: u16) -> bool {
    let places: BTreeSet<[u32; 3]> = points.iter().map(|p| p.g).collect();
    let m = places.len();
    if most == 0 || m < 4 || points.len() > 4096 {
        return false;
    }
    let of = |p: &[u32; 3]| p.map(i128::from);
    let mut near: Vec<i128> = places
        .iter()
        .map(|a| {
            let others = places.iter().filter(|b| *b != a);
            let d2 = |b| (0..3).map(|i| square(of(a)[i] - of(b)[i])).sum();
            others.map(d2).min().expect("three others")
        })
        .collect();
    near.sort_unstable();
    let s = root(9 * near[(m - 1) / 2] / 4);
    let mut e = [0, 1, 2].map(|i| {
        let axis = || places.iter().map(|p| of(p)[i]);
        axis().max().expect("four") - axis().min().expect("four")
    });
    e.sort_unstable();
    (e[2] + s) * (e[1] + s) > i128::from(most) * m as i128 * s * s
}
