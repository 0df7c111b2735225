//! Generated surfaces, the pairs on them that see each other, and trees over them.

use std::f64::consts::{PI, TAU};

use fastrand::Rng;
use pvmap_light::{
    Balanced, Element, Elements, Exchange, Hierarchy, Kernel, Operator, Scene, Solution,
    SolveOptions, Subtree, solve,
};
use pvmap_vmap::records::NO_PARENT;

pub(crate) type Vector = [f64; 3];

pub(crate) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn minus(a: Vector, b: Vector) -> Vector {
    [0, 1, 2].map(|i| a[i] - b[i])
}

pub(crate) fn element(position: Vector, normal: Vector, area: f64) -> Element {
    Element { position, normal, area, two_sided: false }
}

/// n × n elements of the parallelogram at a corner with two perpendicular sides.
pub(crate) fn square(corner: Vector, u: Vector, v: Vector, n: usize) -> Vec<Element> {
    let normal = [1, 2, 0].map(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        u[j] * v[k] - u[k] * v[j]
    });
    let normal = [normal[2], normal[0], normal[1]];
    let size = dot(normal, normal).sqrt();
    let place = |i: usize| {
        let (a, b) = ((i / n) as f64 + 0.5, (i % n) as f64 + 0.5);
        [0, 1, 2].map(|axis| corner[axis] + (a * u[axis] + b * v[axis]) / n as f64)
    };
    let one = |i| element(place(i), normal.map(|v| v / size), size / (n * n) as f64);
    (0..n * n).map(one).collect()
}

/// The walls of the unit cube, n × n elements each, facing inward.
pub(crate) fn box_room(n: usize) -> Vec<Element> {
    let axes =
        |axis: usize| [0, 1, 2].map(|i| [i == axis, i == (axis + 1) % 3, i == (axis + 2) % 3]);
    let unit = |on: [bool; 3]| on.map(|on| f64::from(u8::from(on)));
    let mut walls = Vec::new();
    for axis in 0..3 {
        let rows = axes(axis);
        let [a, u, v] = [0, 1, 2].map(|k| unit([rows[0][k], rows[1][k], rows[2][k]]));
        walls.extend(square([0.0; 3], u, v, n));
        walls.extend(square(a, v, u, n));
    }
    walls
}

/// Elements at random on the walls of the unit cube, facing inward, all of one area.
pub(crate) fn random_box(rng: &mut Rng, n: usize) -> Vec<Element> {
    let one = |_| {
        let (axis, far) = (rng.usize(..3), rng.bool());
        let mut place = [0; 3].map(|_| rng.f64());
        let mut normal = [0.0; 3];
        place[axis] = if far { 1.0 } else { 0.0 };
        normal[axis] = if far { -1.0 } else { 1.0 };
        element(place, normal, 6.0 / n as f64)
    };
    (0..n).map(one).collect()
}

/// n elements of a sphere along a spiral, facing outward (1) or inward (-1).
pub(crate) fn sphere(centre: Vector, radius: f64, n: usize, side: f64) -> Vec<Element> {
    let one = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f64 / n as f64;
        let (angle, r) = (i as f64 * PI * (3.0 - 5f64.sqrt()), (1.0 - z * z).sqrt());
        let out = [r * angle.cos(), r * angle.sin(), z];
        let place = [0, 1, 2].map(|axis| centre[axis] + radius * out[axis]);
        element(place, out.map(|v| side * v), 4.0 * PI * radius * radius / n as f64)
    };
    (0..n).map(one).collect()
}

/// About n elements of a disc at some height, rings of equal area, facing up (1) or down (-1).
pub(crate) fn disc(radius: f64, height: f64, n: usize, side: f64) -> Vec<Element> {
    // A ring k of 2k + 1 pieces: k² within, (k + 1)² with it.
    let n_rings = (n as f64).sqrt().ceil() as usize;
    let area = PI * radius * radius / (n_rings * n_rings) as f64;
    let ring = |k: usize| {
        let (inner, outer) = (k as f64 / n_rings as f64, (k + 1) as f64 / n_rings as f64);
        let r =
            radius * ((inner * inner + outer * outer) / 2.0).sqrt() * if k > 0 { 1.0 } else { 0.0 };
        (0..2 * k + 1).map(move |i| {
            let angle = TAU * i as f64 / (2 * k + 1) as f64;
            element([r * angle.cos(), r * angle.sin(), height], [0.0, 0.0, side], area)
        })
    };
    (0..n_rings).flat_map(ring).collect()
}

/// Form factor from some elements to others that see all of them.
pub(crate) fn form_factor(kernel: Kernel, from: &[Element], to: &[Element]) -> f64 {
    let elements = Elements::new(from.iter().chain(to).copied()).unwrap();
    let row =
        |i| (from.len()..elements.len()).map(|j| kernel.exchange(&elements, i, j)).sum::<f64>();
    let area: f64 = from.iter().map(|e| e.area).sum();
    (0..from.len()).map(row).sum::<f64>() / area
}

/// All pairs of leaves of a flat tree that `sees` says see each other.
pub(crate) fn pairs(n: usize, sees: impl Fn(usize, usize) -> bool) -> Vec<(u32, u32)> {
    let after = |i: usize| (i + 1..n).map(move |j| (i, j));
    let seen = (0..n).flat_map(after).filter(|&(i, j)| sees(i, j));
    seen.map(|(i, j)| (i as u32 + 1, j as u32 + 1)).collect()
}

/// The direct exchange between elements all of which see each other.
pub(crate) fn open_exchange(elements: &[Element], kernel: Kernel) -> Exchange {
    exchange_where(elements, kernel, |_, _| true)
}

/// The direct exchange between elements where some see each other.
pub(crate) fn exchange_where(
    elements: &[Element],
    kernel: Kernel,
    sees: impl Fn(usize, usize) -> bool,
) -> Exchange {
    let n = elements.len();
    let (tree, links) = (Hierarchy::flat(n as u32), pairs(n, sees));
    let elements = Elements::new(elements.iter().copied()).unwrap();
    Exchange::direct(elements, tree, links.as_slice(), kernel).unwrap()
}

/// Row sums of an operator as shares of the areas.
pub(crate) fn row_shares(operator: &impl Operator) -> Vec<f64> {
    let sums = operator.row_sums().unwrap();
    sums.iter().zip(operator.areas()).map(|(sum, area)| sum / area).collect()
}

/// Radiosity to 1e-10 in a closed scene balanced to 1e-10.
pub(crate) fn closed_solution(exchange: &Exchange, emission: &[f64], albedo: &[f64]) -> Solution {
    let balanced = Balanced::new(exchange, Scene::Closed, 1e-10, 200).unwrap();
    assert!(balanced.row_error() <= 1e-10, "{}", balanced.row_error());
    let options = SolveOptions { tolerance: 1e-10, ..SolveOptions::default() };
    solve(&balanced, emission, albedo, &options).unwrap()
}

pub(crate) fn most(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().fold(0.0, |most, v| if v > most || v.is_nan() { v } else { most })
}

/// An octree over elements: boxes halved until they hold one; the elements in leaf order.
pub(crate) fn octree(mut elements: Vec<Element>) -> (Vec<Element>, Hierarchy) {
    let mut nodes = Vec::new();
    let (low, width) = ([-4.0; 3], 8.0);
    grow(&mut elements, 0, NO_PARENT, (low, width), &mut nodes);
    let hierarchy = Hierarchy::new(nodes).unwrap();
    (elements, hierarchy)
}

fn grow(
    elements: &mut [Element],
    first: u32,
    parent: u32,
    (low, width): (Vector, f64),
    nodes: &mut Vec<Subtree>,
) {
    let id = nodes.len();
    let span = (first, first + elements.len() as u32);
    nodes.push(Subtree { parent, end: 0, elements: span });
    if elements.len() > 1 {
        let half = width / 2.0;
        let octant = |e: &Element| {
            (0..3).map(|i| usize::from(e.position[i] >= low[i] + half) << i).sum::<usize>()
        };
        // In one place, or as good as: cut by number.
        let by_number = width < 1e-9;
        let middle = elements.len() / 2;
        elements.sort_by_key(octant);
        let mut start = 0;
        while start < elements.len() {
            let slot = octant(&elements[start]);
            let same = elements[start..].iter().take_while(|e| octant(e) == slot).count();
            let count = if by_number { middle.max(1).min(elements.len() - start) } else { same };
            let corner = [0, 1, 2].map(|i| low[i] + if slot >> i & 1 == 1 { half } else { 0.0 });
            let at = first + start as u32;
            grow(&mut elements[start..start + count], at, id as u32, (corner, half), nodes);
            start += count;
        }
    }
    nodes[id].end = nodes.len() as u32;
}

/// The links of a tree by the rule [V-5] over siblings: pairs all of whose leaves see each other.
pub(crate) fn links(tree: &Hierarchy, sees: &impl Fn(usize, usize) -> bool) -> Vec<(u32, u32)> {
    let mut found = Vec::new();
    for id in 0..tree.n_nodes() {
        let children: Vec<u32> = tree.children(id).collect();
        for (k, &a) in children.iter().enumerate() {
            children[k + 1..].iter().for_each(|&b| link(tree, sees, (a, b), &mut found));
        }
    }
    found.sort_unstable();
    found
}

fn link(
    tree: &Hierarchy,
    sees: &impl Fn(usize, usize) -> bool,
    (a, b): (u32, u32),
    found: &mut Vec<(u32, u32)>,
) {
    let elements =
        |node: u32| tree.node(node).elements.0 as usize..tree.node(node).elements.1 as usize;
    let n_pairs = elements(a).len() * elements(b).len();
    let n_seen: usize = elements(a).map(|i| elements(b).filter(|&j| sees(i, j)).count()).sum();
    let kids = |node: u32| match tree.is_leaf(node) {
        true => vec![node],
        false => tree.children(node).collect(),
    };
    if n_seen == n_pairs {
        found.push((a, b));
    } else if n_seen > 0 {
        for x in kids(a) {
            kids(b).into_iter().for_each(|y| link(tree, sees, (x, y), found));
        }
    }
}

/// Says whether two elements face each other.
pub(crate) fn face(a: &Element, b: &Element) -> bool {
    let d = minus(b.position, a.position);
    let lit = |e: &Element, along: f64| along > 0.0 || e.two_sided && along != 0.0;
    lit(a, dot(a.normal, d)) && lit(b, -dot(b.normal, d))
}
