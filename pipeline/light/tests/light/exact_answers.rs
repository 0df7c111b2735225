//! The closed forms of light: what radiosity must be where it can be written down.

use std::f64::consts::PI;

use fastrand::Rng;
use pvmap_light::{
    Balanced, Element, Elements, Kernel, LightError, Operator, Scene, SolveOptions, solve,
};

use crate::common::{
    Vector, box_room, closed_solution, disc, dot, element, exchange_where, form_factor, minus,
    most, open_exchange, random_box, row_shares, sphere, square,
};

const X: Vector = [1.0, 0.0, 0.0];
const Y: Vector = [0.0, 1.0, 0.0];
const Z: Vector = [0.0, 0.0, 1.0];

fn is_near(found: f64, expected: f64, relative: f64) {
    let off = (found / expected - 1.0).abs();
    assert!(off <= relative, "{found}, not {expected}: off by {off:e}, allowed {relative:e}");
}

/// The element under a square light, or both squares, facing each other at a distance.
fn facing_squares(distance: f64, n: usize) -> [Vec<Element>; 2] {
    [square([0.0; 3], X, Y, n), square([0.0, 0.0, distance], Y, X, n)]
}

#[test]
fn answer_1_parallel_squares() {
    let cases = [(1.0, 0.199825), (0.5, 0.415253), (2.0, 0.068590), (0.1, 0.826995)];
    for (distance, expected) in cases {
        let n = 40;
        let [a, b] = facing_squares(distance, n);
        // Half the regularised area is 0.35 A of π r², the rest the rule of the midpoint.
        let size = 1.0 / n as f64 / distance;
        is_near(form_factor(Kernel::default(), &a, &b), expected, 0.5 * size * size + 1e-5);
    }
}

#[test]
fn answer_2_perpendicular_squares_with_a_common_edge() {
    let n = 40;
    let (floor, wall) = (square([0.0; 3], X, Y, n), square([0.0; 3], Y, Z, n));
    let f = form_factor(Kernel::default(), &floor, &wall);
    is_near(f, 0.200044, 1.0 / n as f64);
    let [_, roof] = facing_squares(1.0, n);
    let parallel = form_factor(Kernel::default(), &floor, &roof);
    is_near(parallel + 4.0 * f, 1.0, 1.0 / n as f64);
}

#[test]
fn answer_3_coaxial_discs() {
    let cases = [(1.0, 1.0, 1.0, 0.381966), (1.0, 1.0, 0.1, 0.904875), (0.5, 1.0, 1.0, 0.468871)];
    for (r1, r2, h, expected) in cases {
        let n = 3000;
        let (a, b) = (disc(r1, 0.0, n, 1.0), disc(r2, h, n, -1.0));
        let size2 = PI * r2 * r2 / n as f64 / (h * h);
        is_near(form_factor(Kernel::default(), &a, &b), expected, 0.25 * size2 + 1e-3);
    }
}

#[test]
fn answer_4_an_element_under_a_square_and_under_a_disc() {
    let n = 100;
    let light = square([0.0, 0.0, 1.0], Y, X, n);
    let under = |place: Vector| vec![element(place, Z, 1e-6)];
    let bound = 1.0 / (n * n) as f64 + 1e-5;
    is_near(form_factor(Kernel::default(), &under([0.0; 3]), &light), 0.138532, bound);
    is_near(form_factor(Kernel::default(), &under([0.5, 0.5, 0.0]), &light), 0.239456, bound);
    for (a, h) in [(1.0, 1.0), (0.3, 2.0)] {
        let light = disc(a, h, 10_000, -1.0);
        let exact = a * a / (a * a + h * h);
        is_near(form_factor(Kernel::default(), &under([0.0; 3]), &light), exact, 1e-3);
    }
}

#[test]
fn n67_answer_5_the_inside_of_a_sphere() {
    let n = 1000;
    let inside = sphere([0.0; 3], 2.0, n, -1.0);
    let elements = Elements::new(inside.iter().copied()).unwrap();
    // The raw kernel is 1/(4 π R²) for every pair, however near: A²/(16 π) of exchange.
    let raw = Kernel::new(0.0).unwrap();
    let exact = inside[0].area * inside[0].area / (16.0 * PI);
    for i in 0..n {
        for j in (0..n).filter(|&j| j != i) {
            let g = raw.exchange(&elements, i, j);
            assert!((g / exact - 1.0).abs() < 1e-12, "{i} {j}: {g:e}, not {exact:e}");
        }
    }
    let mut rng = Rng::with_seed(1);
    let emission: Vec<f64> = (0..n).map(|_| rng.f64()).collect();
    let mean = emission.iter().sum::<f64>() / n as f64;
    for (kernel, bound) in [(raw, 4e-3), (Kernel::default(), 2e-2)] {
        let exchange = open_exchange(&inside, kernel);
        let shares = row_shares(&exchange);
        assert!(shares.iter().all(|s| (s - 1.0).abs() < bound), "{:?}", &shares[..9]);
        let albedo = 0.8;
        let found = closed_solution(&exchange, &emission, &vec![albedo; n]);
        for (b, e) in found.exitance.iter().zip(&emission) {
            let exact = e + albedo * mean / (1.0 - albedo);
            assert!((b / exact - 1.0).abs() < bound, "{b}, not {exact}");
        }
    }
}

#[test]
fn n75_answer_6_a_closed_furnace() {
    let room = box_room(10);
    let n = room.len();
    for albedo in [0.3, 0.8, 0.99] {
        let exchange = open_exchange(&room, Kernel::default());
        let found = closed_solution(&exchange, &vec![1.0; n], &vec![albedo; n]);
        let exact = 1.0 / (1.0 - albedo);
        let off = most(found.exitance.iter().map(|b| (b / exact - 1.0).abs()));
        assert!(off <= 1e-6, "albedo {albedo}: off by {off:e}");
    }
}

#[test]
fn answer_7_two_spheres() {
    let cases = [(2.5, 0.044119), (3.0, 0.029590), (4.0, 0.016156), (10.0, 0.002513)];
    for (distance, expected) in cases {
        let n = 2000;
        let (a, b) = (sphere([0.0; 3], 1.0, n, 1.0), sphere([0.0, 0.0, distance], 1.0, n, 1.0));
        is_near(form_factor(Kernel::default(), &a, &b), expected, 5e-3);
    }
}

/// Says whether a segment crosses the unit sphere at the origin, from outside or on it.
fn crosses_sphere(a: Vector, b: Vector) -> bool {
    let d = minus(b, a);
    let t = (-dot(a, d) / dot(d, d)).clamp(0.0, 1.0);
    let x = [0, 1, 2].map(|i| a[i] + t * d[i]);
    dot(x, x) < 1.0 - 1e-9
}

#[test]
fn answer_8_concentric_spheres() {
    let (n1, n2) = (500, 1500);
    let mut both = sphere([0.0; 3], 1.0, n1, 1.0);
    both.extend(sphere([0.0; 3], 2.0, n2, -1.0));
    let sees = |i: usize, j: usize| !crosses_sphere(both[i].position, both[j].position);
    let exchange = exchange_where(&both, Kernel::default(), sees);
    let inner: Vec<f64> = (0..n1 + n2).map(|i| f64::from(u8::from(i < n1))).collect();
    let outer: Vec<f64> = inner.iter().map(|v| 1.0 - v).collect();
    let area = 16.0 * PI;
    let from_inner = exchange.apply(&inner).unwrap();
    let from_outer = exchange.apply(&outer).unwrap();
    is_near(from_inner[n1..].iter().sum::<f64>() / area, 0.25, 1e-2);
    is_near(from_outer[n1..].iter().sum::<f64>() / area, 0.75, 2e-2);

    // Grey exchange: emissivities 0.8 and 0.5 are albedos 0.2 and 0.5, the inner one is hot.
    let emission: Vec<f64> = inner.iter().map(|v| 0.8 * v).collect();
    let albedo: Vec<f64> = inner.iter().map(|&v| if v > 0.0 { 0.2 } else { 0.5 }).collect();
    let found = closed_solution(&exchange, &emission, &albedo);
    let net = found.exitance.iter().zip(&found.irradiance).take(n1).map(|(b, h)| b - h);
    is_near(net.sum::<f64>() / n1 as f64, 0.666667, 1e-2);
}

/// An exchange that is given as a table.
struct Table {
    areas: Vec<f64>,
    exchange: Vec<Vec<f64>>,
}

impl Operator for Table {
    fn areas(&self) -> &[f64] {
        &self.areas
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        let row = |row: &Vec<f64>| row.iter().zip(b).map(|(g, b)| g * b).sum();
        Ok(self.exchange.iter().map(row).collect())
    }
}

#[test]
fn answer_9_two_squares_that_light_each_other() {
    let [a, b] = facing_squares(1.0, 40);
    let f = form_factor(Kernel::default(), &a, &b);
    let table = Table { areas: vec![1.0; 2], exchange: vec![vec![0.0, f], vec![f, 0.0]] };
    let options = SolveOptions { tolerance: 1e-10, ..SolveOptions::default() };
    let found = solve(&table, &[1.0, 0.0], &[0.5, 0.8], &options).unwrap();
    is_near(found.exitance[0], 1.016231, 2e-5);
    is_near(found.exitance[1], 0.162455, 1e-3);
}

#[test]
fn answer_10_a_blocker_before_a_square_light() {
    let n = 96;
    let mut scene = vec![element([0.5, 0.5, 0.0], Z, 1e-6)];
    scene.extend(square([0.0, 0.0, 2.0], Y, X, n));
    let mut emission = vec![1.0; scene.len()];
    emission[0] = 0.0;
    for (side, expected) in [(0.0, 0.073478), (0.25, 0.053989), (0.5, 0.0)] {
        let sees = |i: usize, j: usize| {
            // Half way up, at a height of 1.
            let at = |axis: usize| 0.5 * (scene[i].position[axis] + scene[j].position[axis]) - 0.5;
            i == 0 && at(0).abs().max(at(1).abs()) > side / 2.0
        };
        let exchange = exchange_where(&scene, Kernel::default(), sees);
        let options = SolveOptions::default();
        let found = solve(&exchange, &emission, &vec![0.0; scene.len()], &options).unwrap();
        if expected > 0.0 {
            is_near(found.irradiance[0], expected, 1e-3);
        } else {
            assert_eq!(found.irradiance[0], 0.0);
        }
    }
}

#[test]
fn answer_11_an_integrating_sphere() {
    let (n, radius, albedo, flux) = (1000, 3.0, 0.9, 7.0);
    let inside = sphere([0.0; 3], radius, n, -1.0);
    let exchange = open_exchange(&inside, Kernel::default());
    let mut emission = vec![0.0; n];
    emission[0] = flux / inside[0].area;
    let found = closed_solution(&exchange, &emission, &vec![albedo; n]);
    let balanced = Balanced::new(&exchange, Scene::Closed, 1e-10, 200).unwrap();
    let direct = Operator::apply(&balanced, &emission).unwrap();
    let exact = flux * albedo / ((1.0 - albedo) * 4.0 * PI * radius * radius);
    for i in 1..n {
        let indirect = found.irradiance[i] - direct[i] / inside[i].area;
        assert!((indirect / exact - 1.0).abs() < 1e-2, "{i}: {indirect}, not {exact}");
    }
}

/// Turns a vector by 0.3 about x, then by 1.1 about z.
fn turned(v: Vector) -> Vector {
    let ((s, c), (t, d)) = (0.3f64.sin_cos(), 1.1f64.sin_cos());
    let [x, y, z] = [v[0], c * v[1] - s * v[2], s * v[1] + c * v[2]];
    [d * x - t * y, t * x + d * y, z]
}

#[test]
fn answer_12_nothing_depends_on_units_place_names_or_cuts() {
    // On multiples of 1/8: moving by a whole number of a million loses nothing.
    let room = box_room(4);
    let n = room.len();
    let emission: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i < 16))).collect();
    let albedo: Vec<f64> = (0..n).map(|i| 0.5 + 0.4 * (i % 2) as f64).collect();
    let lit = |room: &[Element], emission: &[f64], albedo: &[f64]| {
        closed_solution(&open_exchange(room, Kernel::default()), emission, albedo).exitance
    };
    let plain = lit(&room, &emission, &albedo);
    let with = |change: &dyn Fn(&Element) -> Element| {
        lit(&room.iter().map(change).collect::<Vec<_>>(), &emission, &albedo)
    };
    let off = |other: &[f64]| most(other.iter().zip(&plain).map(|(a, b)| (a / b - 1.0).abs()));

    let scaled = |s: f64| {
        with(&|e| Element { position: e.position.map(|v| s * v), area: s * s * e.area, ..*e })
    };
    assert_eq!(scaled(1024.0), plain);
    for s in [1e-6, 1e6] {
        assert!(off(&scaled(s)) < 1e-12, "scale {s}: {:e}", off(&scaled(s)));
    }
    assert_eq!(with(&|e| Element { position: e.position.map(|v| v + 1e6), ..*e }), plain);
    let rotated = with(&|e| element(turned(e.position), turned(e.normal), e.area));
    assert!(off(&rotated) < 1e-12, "{:e}", off(&rotated));

    let backwards: Vec<Element> = room.iter().rev().copied().collect();
    let [e, a] = [&emission, &albedo].map(|v| v.iter().rev().copied().collect::<Vec<_>>());
    let mut other = lit(&backwards, &e, &a);
    other.reverse();
    assert!(off(&other) < 1e-12, "{:e}", off(&other));

    // One element as two halves in its place. Only what keeps near pairs bounded goes by areas.
    let mut split = room.clone();
    split[20].area /= 2.0;
    split.push(split[20]);
    let (mut e, mut a) = (emission.clone(), albedo.clone());
    e.push(e[20]);
    a.push(a[20]);
    for (c, bound) in [(0.0, 1e-8), (0.35, 1e-2)] {
        let lit = |room: &[Element], emission: &[f64], albedo: &[f64]| {
            let exchange = open_exchange(room, Kernel::new(c).unwrap());
            closed_solution(&exchange, emission, albedo).exitance
        };
        let (plain, other) = (lit(&room, &emission, &albedo), lit(&split, &e, &a));
        assert_eq!(other[20], other[n]);
        let off = most(other.iter().zip(&plain).map(|(a, b)| (a / b - 1.0).abs()));
        assert!(off < bound, "c = {c}: {off:e}");
    }
}

#[test]
fn random_points_in_a_box_have_the_one_radiosity() {
    let mut rng = Rng::with_seed(2);
    let room = random_box(&mut rng, 2000);
    let (emission, albedo) = (vec![1.0; room.len()], vec![0.8; room.len()]);
    let exchange = open_exchange(&room, Kernel::default());
    let found = closed_solution(&exchange, &emission, &albedo);
    let off = most(found.exitance.iter().map(|b| (b - 5.0).abs()));
    assert!(off <= 1e-3, "off by {off:e}");
    // What it is measured against: as the elements lie rows add up to something else.
    let shares = row_shares(&exchange);
    assert!(shares.iter().any(|s| (s - 1.0).abs() > 0.05), "nothing was to be scaled");
}
