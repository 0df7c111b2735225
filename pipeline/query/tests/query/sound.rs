//! Small maps that are right: links of [V-5] by brute force over every leaf pair of [V-1]…[V-3].

use fastrand::Rng;
use pvmap_geometry::disc::{self, Disc, Profile};
use pvmap_geometry::rect::Moments;
use pvmap_geometry::{Rect, normal};
use pvmap_vmap::{Shape, Surfel, Tree};

use crate::common::{About, Cut, Parts, Sample, grow, siblings};

/// A map with the truth it was made from.
pub(crate) struct Sound {
    pub(crate) tree: Tree,
    pub(crate) profile: Profile,
    pub(crate) discs: Vec<Disc>,
    pub(crate) file: Vec<u8>,
    pub(crate) n_links: usize,
    visible: Vec<bool>,
}

impl Sound {
    /// Makes the map of some points.
    pub(crate) fn new(points: &[Sample], cut: Cut, profile: Profile) -> Sound {
        let mut tree = grow(points, cut);
        for surfel in &mut tree.surfels {
            let points = surfel.patch.grown(-(surfel.half_spacing as i32));
            let off = |i: usize| {
                let c = i64::from(surfel.centroid[i]);
                let [low, high] = [c - i64::from(points.min[i]), i64::from(points.max[i]) - c];
                low.max(high) as u64
            };
            let far2 = (0..3).map(|i| off(i) * off(i)).sum::<u64>();
            let h2 = u64::from(surfel.half_spacing).pow(2);
            surfel.radius2 = if profile == Profile::Paper { far2 } else { far2.max(h2) };
        }
        if profile == Profile::Oriented {
            tree.rects = tree.surfels.iter().map(rect).collect();
        }
        let discs: Vec<Disc> =
            (0..tree.surfels.len() as u32).map(|i| tree.disc(i, profile)).collect();
        let n = discs.len();
        let sees = |a: usize, b: usize| {
            let blocked = |k: usize| {
                k != a && k != b && disc::blocks(profile, &discs[a], &discs[b], &discs[k])
            };
            a == b || disc::faces_both(&discs[a], &discs[b]) && !(0..n).any(blocked)
        };
        let mut visible = vec![false; n * n];
        for (a, b) in (0..n).flat_map(|a| (a..n).map(move |b| (a, b))) {
            let sees = sees(a, b);
            (visible[a * n + b], visible[b * n + a]) = (sees, sees);
        }
        let mut map = Sound { tree, profile, discs, file: Vec::new(), n_links: 0, visible };
        let mut links = Vec::new();
        for (a, b) in siblings(&map.tree) {
            map.link(a, b, &mut links);
        }
        links.sort_unstable();
        let about = About { profile, links_per_frame: 40, ..About::default() };
        map.file = Parts::new(&map.tree, &links, about).seal();
        map.n_links = links.len();
        map
    }

    /// Says whether two surfels see each other; each sees itself. [V-6]
    pub(crate) fn sees(&self, a: u32, b: u32) -> bool {
        self.visible[a as usize * self.tree.surfels.len() + b as usize]
    }

    pub(crate) fn n_surfels(&self) -> u32 {
        self.tree.surfels.len() as u32
    }

    /// Adds the links of a pair: [V-5] word by word.
    fn link(&self, a: u32, b: u32, links: &mut Vec<(u32, u32)>) {
        let [x, y] = [a, b].map(|id| &self.tree.nodes[id as usize]);
        let pairs = |s| (y.first_surfel..y.end_surfel).map(move |t| (s, t));
        let all = || (x.first_surfel..x.end_surfel).flat_map(pairs);
        if all().all(|(s, t)| self.sees(s, t)) {
            links.push((a.min(b), a.max(b)));
        } else if all().any(|(s, t)| self.sees(s, t)) {
            for x in self.tree.kids(a) {
                for y in self.tree.kids(b) {
                    self.link(x, y, links);
                }
            }
        }
    }
}

/// Makes the rectangle of a surfel, narrower than its box, along directions in its plane.
pub(crate) fn rect(surfel: &Surfel) -> Rect {
    if surfel.normal == [0; 3] {
        return Rect::NONE;
    }
    let mut moments = Moments::new(surfel.normal);
    moments.add([1000, -700, 1900]);
    let wide = (0..3).map(|i| surfel.patch.max[i] - surfel.patch.min[i]).max();
    let steps = wide.map_or(1, |wide| wide / 3 + 1);
    Rect { low: [-steps, -1 - steps / 2], high: [steps; 2], ..Rect::along(moments.axes()) }
}

/// Gives points on the inner faces of a box, about k × k on each, with normals to the inside.
pub(crate) fn room(rng: &mut Rng, k: u32) -> Vec<Sample> {
    let last = (1 << 22) - 1;
    let mut points = Vec::new();
    for (face, cell) in (0..6).flat_map(|face| (0..k * k).map(move |cell| (face, cell))) {
        let (axis, high) = (face % 3, face / 3 == 1);
        let side = (1 << 22) / k;
        let mut g = [cell / k, cell % k, 0].map(|i| i * side + rng.u32(side / 4..side * 3 / 4));
        g[2] = if high { last } else { 0 };
        g.rotate_left(2 - axis);
        let mut normal = [0; 3];
        normal[axis] = if high { -(1 << 14) } else { 1 << 14 };
        points.push((g, normal));
    }
    points[0].0 = [0; 3];
    points.push(([last; 3], [-(1 << 14), 0, 0]));
    points
}

/// Gives points on some plates in the middle of the room, each of its own direction.
pub(crate) fn plates(rng: &mut Rng, n: usize) -> Vec<Sample> {
    let mut points = Vec::new();
    for _ in 0..3 {
        let middle = [0; 3].map(|_| rng.u32(1 << 20..3 << 20));
        let [u, v] = [0; 2].map(|_| [0; 3].map(|_| rng.i32(-(1 << 18)..1 << 18)));
        let f = |i: usize| {
            let [j, k] = [(i + 1) % 3, (i + 2) % 3];
            (f64::from(u[j]) * f64::from(v[k]) - f64::from(u[k]) * f64::from(v[j])) as f32
        };
        let Some(normal) = normal::quantise([f(0), f(1), f(2)]) else { continue };
        for _ in 0..n {
            let [p, q] = [0; 2].map(|_| rng.f64() * 2.0 - 1.0);
            let at = |i: usize| p * f64::from(u[i]) + q * f64::from(v[i]);
            points.push(([0, 1, 2].map(|i| (f64::from(middle[i]) + at(i)) as u32), normal));
        }
    }
    points
}

/// Gives maps of rooms, empty or with plates, of both shapes and profiles.
pub(crate) fn maps(seed: u64, n: usize) -> impl Iterator<Item = Sound> {
    let mut rng = Rng::with_seed(seed);
    (0..n).map(move |round| {
        let mut points = room(&mut rng, 6);
        if round % 4 != 0 {
            points.extend(plates(&mut rng, 25));
        }
        let shape = if round % 3 != 0 { Shape::Binned } else { Shape::Paper };
        let profile =
            [Profile::Patch, Profile::Paper, Profile::Oriented, Profile::Paper][round % 4];
        let leaf_capacity = rng.usize(3..6);
        let cut = Cut { shape, leaf_capacity, max_level: 5, few: 3 << 18 };
        Sound::new(&points, cut, profile)
    })
}
