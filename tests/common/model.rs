//! A map by its definitions, slow and obvious: [V-1]…[V-5] word by word on the surfels and nodes
//! of a file. Nothing here comes from the rooms that make maps.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]

use std::collections::BTreeSet;

use pvmap::geometry::disc::Profile;
use pvmap::geometry::{GridPoint, Rect};
use pvmap::vmap::tree::RoutingKey;
use pvmap::vmap::{Node, Spacing, Split, Surfel, Tree};

pub type Vector = [i128; 3];

/// What [V-1] and [V-2] need of a surfel, and what the checks of the cut compare.
#[derive(Debug, Clone)]
pub struct Disc {
    pub centroid: Vector,
    pub normal: Vector,
    pub two_sided: bool,
    pub radius2: i128,
    /// The closed cell, [g0, g0 + side].
    pub cell: (Vector, Vector),
    pub patch: (Vector, Vector),
    /// Axes of length 2^14 with the least and the greatest offset along them, for `oriented`.
    pub rect: Option<[(Vector, [i128; 2]); 2]>,
    pub half_spacing: i128,
    pub n_points: u64,
    pub bin: i8,
    pub node: usize,
}

/// What a pair of nodes is. [V-4]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    Visible,
    Invisible,
    Partial,
}

/// A tree and who sees whom in it.
#[derive(Debug, Clone)]
pub struct Model {
    pub nodes: Vec<Node>,
    pub surfels: Vec<Disc>,
    stored: Vec<Surfel>,
    rects: Vec<Rect>,
    pub n_points: Vec<u64>,
    pub children: Vec<Vec<usize>>,
    /// The surfels under each node.
    pub leaves: Vec<Vec<usize>>,
    /// Who sees whom, symmetric.
    pub sees: Vec<Vec<bool>>,
    /// How many leaf pairs face each other and are blocked.
    pub n_blocked: u64,
    /// Visible pairs in the first rows and columns of `sees`.
    counts: Vec<Vec<u64>>,
}

impl Model {
    pub fn new(nodes: &[Node], surfels: &[Surfel], rects: &[Rect], profile: Profile) -> Model {
        let of = |(i, surfel)| disc(surfel, rects.get(i));
        let discs: Vec<Disc> = surfels.iter().enumerate().map(of).collect();
        let mut children = vec![Vec::new(); nodes.len()];
        for (id, node) in nodes.iter().enumerate().skip(1) {
            children[node.parent as usize].push(id);
        }
        let mut leaves = vec![Vec::new(); nodes.len()];
        for (s, disc) in discs.iter().enumerate() {
            let mut id = disc.node;
            leaves[id].push(s);
            while id != 0 {
                id = nodes[id].parent as usize;
                leaves[id].push(s);
            }
        }
        for (id, node) in nodes.iter().enumerate() {
            assert_eq!(children[id].is_empty(), node.split == Split::Leaf, "node {id}");
            let range = node.first_surfel as usize..node.end_surfel as usize;
            assert!(leaves[id].iter().copied().eq(range), "surfels of node {id}");
        }
        let n = discs.len();
        let mut sees = vec![vec![false; n]; n];
        let mut n_blocked = 0;
        for a in 0..n {
            for b in a + 1..n {
                let facing = face(&discs[a], &discs[b]);
                let is_blocked =
                    || (0..n).any(|k| k != a && k != b && blocks(profile, &discs, (a, b), k));
                let blocked = facing && is_blocked();
                n_blocked += u64::from(blocked);
                sees[a][b] = facing && !blocked;
                sees[b][a] = sees[a][b];
            }
        }
        let model = Model {
            nodes: nodes.to_vec(),
            surfels: discs,
            stored: surfels.to_vec(),
            rects: rects.to_vec(),
            n_points: nodes.iter().map(|n| n.n_points).collect(),
            children,
            leaves,
            sees: Vec::new(),
            n_blocked,
            counts: Vec::new(),
        };
        model.with_matrix(sees.into_iter())
    }

    /// Gives the same tree with other eyes.
    pub fn with_matrix(&self, rows: impl Iterator<Item = Vec<bool>>) -> Model {
        let sees: Vec<Vec<bool>> = rows.collect();
        let n = sees.len();
        let mut counts = vec![vec![0; n + 1]; n + 1];
        for x in 0..n {
            for y in 0..n {
                counts[x + 1][y + 1] =
                    counts[x][y + 1] + counts[x + 1][y] - counts[x][y] + u64::from(sees[x][y]);
            }
        }
        Model { sees, counts, ..self.clone() }
    }

    /// Counts the visible leaf pairs, each once.
    pub fn n_visible(&self) -> u64 {
        self.counts[self.sees.len()][self.sees.len()] / 2
    }

    /// Gives the status of two disjoint nodes.
    pub fn status(&self, a: usize, b: usize) -> Status {
        let range = |id: usize| {
            let surfels = &self.leaves[id];
            (surfels[0], surfels[surfels.len() - 1] + 1)
        };
        let ((a0, a1), (b0, b1)) = (range(a), range(b));
        let c = &self.counts;
        match c[a1][b1] + c[a0][b0] - c[a0][b1] - c[a1][b0] {
            0 => Status::Invisible,
            n if n == ((a1 - a0) * (b1 - b0)) as u64 => Status::Visible,
            _ => Status::Partial,
        }
    }

    /// Lists the unordered pairs of distinct siblings.
    pub fn sibling_pairs(&self) -> Vec<(usize, usize)> {
        let pairs_of = |list: &Vec<usize>| {
            let list = list.clone();
            let pairs = list.clone().into_iter().flat_map(move |a| {
                list.clone().into_iter().filter(move |&b| a < b).map(move |b| (a, b))
            });
            pairs.collect::<Vec<_>>()
        };
        self.children.iter().flat_map(pairs_of).collect()
    }

    /// Gives the links that [V-5] defines from pairs to start with.
    pub fn links_from(&self, starts: &[(usize, usize)]) -> BTreeSet<(usize, usize)> {
        let mut links = BTreeSet::new();
        let mut open = starts.to_vec();
        while let Some((a, b)) = open.pop() {
            match self.status(a, b) {
                Status::Visible => assert!(links.insert((a.min(b), a.max(b)))),
                Status::Invisible => {}
                Status::Partial => {
                    let kids_b = self.kids(b);
                    let all = self.kids(a).into_iter();
                    open.extend(all.flat_map(|x| kids_b.iter().map(move |&y| (x, y))));
                }
            }
        }
        links
    }

    /// Gives the children of a node, of a leaf the leaf.
    pub fn kids(&self, id: usize) -> Vec<usize> {
        if self.children[id].is_empty() { vec![id] } else { self.children[id].clone() }
    }

    /// Says whether no leaf is under both.
    pub fn are_disjoint(&self, a: usize, b: usize) -> bool {
        self.leaves[a].iter().all(|s| !self.leaves[b].contains(s))
    }

    /// Walks all pairs of nodes a < b without a common leaf.
    pub fn disjoint_pairs(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let n = self.nodes.len();
        let after = |a: usize| self.leaves[a][self.leaves[a].len() - 1];
        (0..n).flat_map(move |a| {
            (a + 1..n).filter(move |&b| self.leaves[b][0] > after(a)).map(move |b| (a, b))
        })
    }

    /// Walks the leaf pairs of two disjoint nodes, a below b.
    pub fn leaf_pairs(&self, a: usize, b: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let others = &self.leaves[b];
        let all = self.leaves[a].iter();
        all.flat_map(move |&x| others.iter().map(move |&y| (x.min(y), x.max(y))))
    }

    /// Counts the points of the cell that a quadrant leaf shares, 0 for other nodes.
    pub fn points_of_quadrants(&self, id: usize) -> u64 {
        match self.nodes.get(self.nodes[id].parent as usize) {
            Some(parent) if parent.split == Split::Quadrants => parent.n_points,
            _ => 0,
        }
    }

    /// Lists the surfels that block between two places of two different leaves, by the words of
    /// nothing where they do not face each other. Each end is a leaf, the place and the
    /// normal given with it, quantised.
    pub fn blockers(
        &self,
        profile: Profile,
        ends: [(usize, GridPoint, Option<Vector>); 2],
    ) -> Option<Vec<usize>> {
        let mut discs = self.surfels.clone();
        for (surfel, g, normal) in ends {
            let disc = &mut discs[surfel];
            disc.centroid = g.map(i128::from);
            let Some(n) = normal else { continue };
            let (along, n2, m2) = (dot(n, disc.normal), dot(n, n), dot(disc.normal, disc.normal));
            // cos² 30° = 3/4.
            let is_within_30 = 4 * along * along >= 3 * n2 * m2;
            if is_within_30 && along != 0 && (along > 0 || disc.two_sided) {
                disc.normal = n;
            }
        }
        let [(a, ..), (b, ..)] = ends;
        let others = (0..discs.len()).filter(|&k| k != a && k != b);
        let blocking = others.filter(|&k| blocks(profile, &discs, (a, b), k));
        face(&discs[a], &discs[b]).then(|| blocking.collect())
    }

    /// Gives the tree as the rooms know it.
    pub fn tree(&self) -> Tree {
        let (nodes, surfels) = (self.nodes.clone(), self.stored.clone());
        Tree { nodes, surfels, rects: self.rects.clone() }
    }
}

fn disc(s: &Surfel, rect: Option<&Rect>) -> Disc {
    let wide = |v: [i32; 3]| v.map(i128::from);
    // The cell's corner from its Morton code, bit by bit: bit 3·i + axis is bit i + 1 of the axis.
    let corner = [0, 1, 2].map(|axis| {
        (0..21).map(|i| ((s.first_code >> (3 * i + axis) & 1) as i128) << (i + 1)).sum::<i128>()
    });
    let side = 1i128 << (22 - s.level);
    Disc {
        centroid: s.centroid.map(i128::from),
        normal: s.normal.map(i128::from),
        two_sided: s.two_sided,
        radius2: i128::from(s.radius2),
        cell: (corner, corner.map(|c| c + side)),
        patch: (wide(s.patch.min), wide(s.patch.max)),
        rect: rect.map(|rect| {
            [0, 1].map(|i| {
                (rect.axes[i].map(i128::from), [rect.low[i], rect.high[i]].map(i128::from))
            })
        }),
        half_spacing: i128::from(s.half_spacing),
        n_points: s.n_points,
        bin: s.bin,
        node: s.node as usize,
    }
}

fn minus(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: Vector, b: Vector) -> i128 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// [V-1].
fn face(a: &Disc, b: &Disc) -> bool {
    let d = minus(b.centroid, a.centroid);
    let (at_a, at_b) = (dot(a.normal, d), dot(b.normal, d));
    let a_faces = a.normal == [0; 3] || at_a > 0 || (a.two_sided && at_a != 0);
    let b_faces = b.normal == [0; 3] || at_b < 0 || (b.two_sided && at_b != 0);
    d != [0; 3] && a_faces && b_faces
}

/// [V-2], x and all distances as fractions over the denominator s.
fn blocks(profile: Profile, discs: &[Disc], (a, b): (usize, usize), k: usize) -> bool {
    let (a, b, k) = (&discs[a], &discs[b], &discs[k]);
    let d = minus(b.centroid, a.centroid);
    let mut s = dot(k.normal, d);
    let mut h = dot(k.normal, minus(k.centroid, a.centroid));
    if s < 0 {
        (s, h) = (-s, -h);
    }
    if !(0 < h && h < s) {
        return false;
    }
    // x = x_over_s / s.
    let x_over_s = [0, 1, 2].map(|i| a.centroid[i] * s + h * d[i]);
    let distance2_over_s2 = |c: Vector| {
        let off = minus(x_over_s, c.map(|v| v * s));
        dot(off, off)
    };
    if distance2_over_s2(k.centroid) > k.radius2 * s * s {
        return false;
    }
    match profile {
        Profile::Paper => meets(a.centroid, d, k.cell),
        Profile::Patch | Profile::Oriented => {
            let off = minus(x_over_s, k.centroid.map(|v| v * s));
            let mut rect = k.rect.iter().flatten();
            (0..3).all(|i| k.patch.0[i] * s <= x_over_s[i] && x_over_s[i] <= k.patch.1[i] * s)
                && distance2_over_s2(a.centroid) > a.radius2 * s * s
                && distance2_over_s2(b.centroid) > b.radius2 * s * s
                && rect.all(|&(axis, [low, high])| {
                    let along = dot(axis, off);
                    (low << 14) * s <= along && along <= (high << 14) * s
                })
        }
    }
}

/// Says whether the segment from `a` along `d` meets a closed box: the share of it inside all
/// three slabs, as fractions, is not empty.
fn meets(a: Vector, d: Vector, (min, max): (Vector, Vector)) -> bool {
    // Fractions (n, m), m > 0.
    let (mut first, mut last) = ((0, 1), (1, 1));
    let less = |p: (i128, i128), q: (i128, i128)| p.0 * q.1 < q.0 * p.1;
    for i in 0..3 {
        let (low, high) = (min[i] - a[i], max[i] - a[i]);
        if d[i] == 0 {
            if low > 0 || high < 0 {
                return false;
            }
            continue;
        }
        let (enter, leave) =
            if d[i] > 0 { ((low, d[i]), (high, d[i])) } else { ((-high, -d[i]), (-low, -d[i])) };
        if less(first, enter) {
            first = enter;
        }
        if less(leave, last) {
            last = leave;
        }
    }
    !less(last, first)
}

/// Says whether a leaf is a point's by §3 of DESIGN.md: cell, bin and, in quadrant leaves, signs.
pub fn holds_point(model: &Model, surfel: usize, key: &RoutingKey) -> bool {
    let disc = &model.surfels[surfel];
    let (corner, beyond) = disc.cell;
    let g = key.g.map(i128::from);
    if !(0..3).all(|i| corner[i] <= g[i] && g[i] < beyond[i]) {
        return false;
    }
    if disc.bin < 0 {
        return true;
    }
    let (bin, normal) = bin_of(key);
    if bin != disc.bin {
        return false;
    }
    let node = &model.nodes[disc.node];
    if model.nodes[node.parent as usize].split != Split::Quadrants {
        return true;
    }
    let axis = bin as usize / 2;
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    node.slot == u8::from(normal[u] < 0) + 2 * u8::from(normal[v] < 0)
}

/// Gives a point's bin, and its normal as the `binned` tree sees it.
fn bin_of(key: &RoutingKey) -> (i8, Vector) {
    let n = key.normal.map(i128::from);
    if n == [0; 3] {
        return (6, n);
    }
    let largest = n.iter().map(|c| c.abs()).max().unwrap();
    let axis = n.iter().position(|c| c.abs() == largest).unwrap();
    let negative = n[axis] < 0;
    match key.oriented {
        true => (2 * axis as i8 + i8::from(negative), n),
        false => (2 * axis as i8, if negative { n.map(|c| -c) } else { n }),
    }
}

/// The points of one leaf.
#[derive(Debug, Clone, Default)]
pub struct Leaf {
    pub points: Vec<RoutingKey>,
}

impl Leaf {
    /// Gives the least and the largest coordinates.
    fn bounds(&self) -> (GridPoint, GridPoint) {
        let all = |i: usize| self.points.iter().map(move |p| p.g[i]);
        ([0, 1, 2].map(|i| all(i).min().unwrap_or(0)), [0, 1, 2].map(|i| all(i).max().unwrap_or(0)))
    }

    /// Gives the product of the two longest sides (+1) of its points' box.
    fn area(&self) -> u128 {
        let (min, max) = self.bounds();
        let mut sides = [0, 1, 2].map(|i| u128::from(max[i] - min[i]) + 1);
        sides.sort_unstable();
        sides[1] * sides[2]
    }

    /// Gives h where it has points enough: max(1, isqrt(e1·e2/m) div 2).
    fn half_spacing(&self) -> Option<i128> {
        let area = self.area() / self.points.len().max(1) as u128;
        (self.points.len() >= 4).then(|| (area.isqrt() as i128 / 2).max(1))
    }

    /// Checks the surfel against the points.
    pub fn check(
        &self,
        surfel: &Disc,
        h: i128,
        (profile, spacing): (Profile, Spacing),
        note: &str,
    ) {
        let n = self.points.len() as i128;
        assert!(n > 0 && n == i128::from(surfel.n_points), "points: {note}");
        let sum = |i: usize| self.points.iter().map(|p| i128::from(p.g[i])).sum::<i128>();
        // Rounded half up: floor(mean + 1/2).
        let mean = [0, 1, 2].map(|i| (2 * sum(i) + n).div_euclid(2 * n));
        assert_eq!(surfel.centroid, mean, "centroid: {note}");
        assert_eq!(surfel.half_spacing, h, "half spacing: {note}");
        let (min, max) = self.bounds();
        let patch = (min.map(|c| i128::from(c) - h), max.map(|c| i128::from(c) + h));
        assert_eq!(surfel.patch, patch, "patch box: {note}");
        let far = self.points.iter().map(|p| {
            let off = minus(p.g.map(i128::from), mean);
            dot(off, off)
        });
        let radius2 = far.max().unwrap_or(0);
        let radius2 = match (profile, spacing) {
            (Profile::Paper, _) => radius2,
            (_, Spacing::Leaf) => radius2.max(h * h),
            (_, Spacing::Neighbors) => {
                let root = radius2.isqrt();
                (root + i128::from(root * root < radius2) + h).pow(2)
            }
        };
        assert_eq!(surfel.radius2, radius2, "radius: {note}");
        self.check_rect(surfel, profile, note);
        let has_normal = |p: &&RoutingKey| p.normal != [0; 3];
        let n_normals = self.points.iter().filter(has_normal).count();
        assert!(n_normals > 0 || surfel.normal == [0; 3], "normal of none: {note}");
        let n_unoriented = self.points.iter().filter(has_normal).filter(|p| !p.oriented).count();
        assert!(n_unoriented == 0 || surfel.two_sided, "one side of unoriented: {note}");
    }
}

impl Leaf {
    /// Checks that every point lies in the rectangle of its own surfel, if that has one, three
    /// halves of h from its sides, and some point no farther from each.
    fn check_rect(&self, surfel: &Disc, profile: Profile, note: &str) {
        let has_one = profile == Profile::Oriented && surfel.normal != [0; 3];
        let axes = surfel.rect.filter(|rect| rect[0].0 != [0; 3]);
        assert_eq!(axes.is_some(), has_one, "rectangle: {note}");
        for (axis, [low, high]) in axes.into_iter().flatten() {
            let margin = (3 * surfel.half_spacing + 1) / 2;
            let along = |p: &RoutingKey| dot(axis, minus(p.g.map(i128::from), surfel.centroid));
            let least = self.points.iter().map(along).min().unwrap_or(0).min(0);
            let most = self.points.iter().map(along).max().unwrap_or(0).max(0);
            let steps = |v: i128| v.div_euclid(1 << 14);
            assert_eq!((low, high), (steps(least) - margin, margin - steps(-most)), "{note}");
        }
    }
}

impl Model {
    /// Gives the half spacings of the leaves; where none is known it is the lower median of the
    /// others, 1 if there is none.
    pub fn half_spacings(&self, leaves: &[Leaf], spacing: Spacing) -> Vec<i128> {
        let known: Vec<Option<i128>> = match spacing {
            Spacing::Leaf => leaves.iter().map(Leaf::half_spacing).collect(),
            Spacing::Neighbors => {
                (0..leaves.len()).map(|leaf| self.spacing_around(leaves, leaf)).collect()
            }
        };
        let mut sorted: Vec<i128> = known.iter().copied().flatten().collect();
        sorted.sort_unstable();
        let median = sorted.get(sorted.len().saturating_sub(1) / 2).copied().unwrap_or(1);
        known.into_iter().map(|h| h.unwrap_or(median)).collect()
    }

    /// Gives 3/8 of the spacing in the smallest subtree around a leaf with 16 points, [F-21].
    fn spacing_around(&self, leaves: &[Leaf], leaf: usize) -> Option<i128> {
        let subtrees = self.nodes.iter().zip(&self.leaves);
        let around = subtrees.filter(|(n, held)| n.split != Split::Bins && held.contains(&leaf));
        let mut around: Vec<_> = around.map(|(_, held)| held).collect();
        around.sort_by_key(|held| held.len());
        let n_in = |held: &[usize]| held.iter().map(|&s| leaves[s].points.len()).sum::<usize>();
        let held = around.iter().find(|held| n_in(held) >= 16).or(around.last())?;
        let of = |l: &Leaf| {
            let m = l.points.len() as u128;
            (l.area() * (m + 1).pow(2) / (m - 1).pow(2), m)
        };
        let large = held.iter().map(|&s| &leaves[s]).filter(|l| l.points.len() >= 3).map(of);
        let (area, m) = large.fold((0, 0), |(area, m), (a, n)| (area + a, m + n));
        let together =
            Leaf { points: held.iter().flat_map(|&s| leaves[s].points.iter().copied()).collect() };
        let (area, m) = match m {
            _ if n_in(held) < 4 => return None,
            0 => of(&together),
            _ => (area, m),
        };
        Some(((9 * area / (64 * m)).isqrt() as i128).max(1))
    }
}
