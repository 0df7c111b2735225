//! The fast multipole method against the direct sum.

use std::collections::BTreeMap;

use fastrand::Rng;
use pvmap_light::{Balanced, Element, Elements, Exchange, Hierarchy, Kernel, Scene, solve};

use crate::common::{box_room, element, face, links, minus, most, octree, sphere};

/// By how much an order may be off: 10 q^-p, q = 3 + √8 for what is three half widths away.
fn bound(order: usize) -> f64 {
    10.0 * (3.0 + 8f64.sqrt()).powi(-(order as i32))
}

/// Two crowds of elements that face each other across a gap, all of which see each other.
fn crowds(rng: &mut Rng, n: usize, gap: f64, scale: f64) -> Vec<Element> {
    let one = |i: usize| {
        let side = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        let place =
            [rng.f64(), rng.f64(), rng.f64() + if i.is_multiple_of(2) { 0.0 } else { 1.0 + gap }];
        let normal = [rng.f64() - 0.5, rng.f64() - 0.5, 5.0 * side];
        let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
        let area = (1.0 + rng.f64()) / n as f64 * scale * scale;
        element(place.map(|v| v * scale), normal.map(|v| v / length), area)
    };
    (0..n).map(one).collect()
}

/// A scene, its tree and links, and what all of it sends.
struct Case {
    elements: Elements,
    tree: Hierarchy,
    links: Vec<(u32, u32)>,
    exitance: Vec<f64>,
}

impl Case {
    fn new(scene: Vec<Element>, sees: impl Fn(&Element, &Element) -> bool) -> Case {
        let (scene, tree) = octree(scene);
        let links = links(&tree, &|i: usize, j: usize| sees(&scene[i], &scene[j]));
        let mut rng = Rng::with_seed(scene.len() as u64);
        let exitance = scene.iter().map(|_| rng.f64()).collect();
        Case { elements: Elements::new(scene).unwrap(), tree, links, exitance }
    }

    fn direct(&self) -> Exchange {
        let (elements, tree) = (self.elements.clone(), self.tree.clone());
        Exchange::direct(elements, tree, self.links.as_slice(), Kernel::default()).unwrap()
    }

    fn multipole(&self, order: usize) -> Exchange {
        let (elements, tree) = (self.elements.clone(), self.tree.clone());
        let links = self.links.as_slice();
        Exchange::multipole(elements, tree, links, Kernel::default(), order).unwrap()
    }

    /// The largest error of the flux a unit of area, of the largest that there is.
    fn error(&self, order: usize) -> f64 {
        let irradiance = |exchange: &Exchange| -> Vec<f64> {
            let flux = exchange.apply(&self.exitance).unwrap();
            flux.iter().zip(self.elements.areas()).map(|(flux, area)| flux / area).collect()
        };
        let exact = irradiance(&self.direct());
        let found = irradiance(&self.multipole(order));
        let off = most(exact.iter().zip(&found).map(|(a, b)| (a - b).abs()));
        off / most(exact.iter().copied())
    }
}

fn faces(a: &Element, b: &Element) -> bool {
    face(a, b)
}

/// A room with a ball in it, which hides what is behind it.
fn room_with_ball(n: usize) -> Case {
    let mut scene = box_room(n);
    scene.extend(sphere([0.5, 0.4, 0.6], 0.2, n * n, 1.0));
    Case::new(scene, |a, b| {
        let (d, c) = (minus(b.position, a.position), minus([0.5, 0.4, 0.6], a.position));
        let along = |u: [f64; 3], v: [f64; 3]| u.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
        let t = (along(c, d) / along(d, d)).clamp(0.0, 1.0);
        let x = [0, 1, 2].map(|i| c[i] - t * d[i]);
        face(a, b) && along(x, x) >= 0.04 - 1e-9
    })
}

#[test]
fn orders_are_right_within_their_bounds() {
    let mut rng = Rng::with_seed(6);
    let cases = [
        Case::new(crowds(&mut rng, 1200, 1.0, 1.0), faces),
        Case::new(crowds(&mut rng, 1200, 4.0, 1.0), faces),
        room_with_ball(14),
    ];
    for (which, case) in cases.iter().enumerate() {
        for order in 1..=7 {
            let (found, bound) = (case.error(order), bound(order));
            assert!(found <= bound, "case {which}, order {order}: {found:e} > {bound:e}");
        }
        let stats = case.multipole(3).stats();
        assert!(stats.n_far > 0, "case {which}: nothing was far: {stats:?}");
    }
}

/// How often each ordered pair is taken.
fn coverage(exchange: &Exchange) -> BTreeMap<(u32, u32), u32> {
    let mut times = BTreeMap::new();
    for one in exchange.interactions() {
        for i in one.targets.0..one.targets.1 {
            for j in one.sources.0..one.sources.1 {
                *times.entry((i, j)).or_default() += 1;
            }
        }
    }
    times
}

#[test]
fn every_ordered_pair_under_a_link_is_taken_exactly_once() {
    let case = room_with_ball(7);
    let exact = coverage(&case.direct());
    let linked: usize = case
        .links
        .iter()
        .map(|&(a, b)| {
            let size = |node| case.tree.node(node).elements.1 - case.tree.node(node).elements.0;
            2 * (size(a) * size(b)) as usize
        })
        .sum();
    assert_eq!(exact.len(), linked);
    assert!(exact.values().all(|&times| times == 1));
    for order in 1..=7 {
        assert_eq!(coverage(&case.multipole(order)), exact, "order {order}");
    }
}

/// Elements some of which have two sides, in a cloud: cosines change their signs under links.
fn foliage(n: usize) -> Case {
    let mut rng = Rng::with_seed(7);
    let one = |i: usize| {
        let normal = [0; 3].map(|_| rng.f64() - 0.5);
        let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
        let mut leaf = element(
            [0; 3].map(|_| rng.f64()),
            normal.map(|v| v / length),
            (0.5 + rng.f64()) / n as f64,
        );
        leaf.two_sided = !i.is_multiple_of(3);
        leaf
    };
    Case::new((0..n).map(one).collect(), faces)
}

#[test]
fn n73_two_sided_elements_are_split_where_a_cosine_changes_its_sign() {
    let case = foliage(800);
    // A wall of two-sided elements that turn their backs to another.
    let wall = |z: f64, up: f64| {
        (0..400).map(move |i| {
            let (x, y) = (f64::from(i / 20) / 20.0, f64::from(i % 20) / 20.0);
            let two_sided = true;
            Element { two_sided, ..element([x, y, z], [0.0, 0.0, up], 1.0 / 400.0) }
        })
    };
    let backs = Case::new(wall(0.0, -1.0).chain(wall(1.5, 1.0)).collect(), faces);
    let turned = Case::new(wall(0.0, -1.0).chain(wall(1.5, -1.0)).collect(), faces);
    for (which, case) in [&case, &backs, &turned].into_iter().enumerate() {
        for order in [1, 3, 5] {
            let (found, bound) = (case.error(order), bound(order));
            assert!(found <= bound, "case {which}, order {order}: {found:e} > {bound:e}");
        }
    }
    for case in [&backs, &turned] {
        assert!(case.multipole(3).stats().n_far > 0, "walls are far from each other");
    }
}

#[test]
fn elements_without_a_normal_change_nothing() {
    // Far outside the boxes of those that have one.
    let mut rng = Rng::with_seed(13);
    let mut scene = crowds(&mut rng, 600, 1.0, 1.0);
    scene.extend((0..20).map(|_| element([0; 3].map(|_| 6.0 * rng.f64() - 3.0), [0.0; 3], 0.01)));
    let case = Case::new(scene, faces);
    for order in [1, 3, 5] {
        let (found, bound) = (case.error(order), bound(order));
        assert!(found <= bound, "order {order}: {found:e} > {bound:e}");
    }
    let flux = case.multipole(3).apply(&case.exitance).unwrap();
    let without = (0..flux.len()).filter(|&i| case.elements.get(i).normal == [0.0; 3]);
    let without: Vec<f64> = without.map(|i| flux[i]).collect();
    assert_eq!(without, [0.0; 20]);
}

#[test]
fn links_of_coarse_maps_may_hold_pairs_that_do_not_face() {
    // All see all, says the link: what does not face exchanges nothing all the same.
    let case = room_with_ball(9);
    let everything =
        Case::new((0..case.elements.len()).map(|i| case.elements.get(i)).collect(), |_, _| true);
    for order in [2, 4] {
        let (found, bound) = (everything.error(order), bound(order));
        assert!(found <= bound, "order {order}: {found:e} > {bound:e}");
    }
}

#[test]
fn n71_the_multipole_operator_is_symmetric() {
    let case = room_with_ball(9);
    let mut rng = Rng::with_seed(8);
    for order in 1..=7 {
        let exchange = case.multipole(order);
        let n = case.elements.len();
        let [a, b] = [0, 1].map(|_| (0..n).map(|_| rng.f64()).collect::<Vec<f64>>());
        let product = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
        let there = product(&a, &exchange.apply(&b).unwrap());
        let back = product(&b, &exchange.apply(&a).unwrap());
        // Up to order 5 sums are made in single precision.
        let rounding = if order <= 5 { 1e-6 } else { 1e-13 };
        assert!((there / back - 1.0).abs() < rounding, "order {order}: {there} and {back}");
    }
}

#[test]
fn n75_a_closed_furnace_by_every_order() {
    let case = room_with_ball(9);
    let n = case.elements.len();
    for order in 1..=7 {
        let exchange = case.multipole(order);
        let closed = Balanced::new(&exchange, Scene::Closed, 1e-9, 500).unwrap();
        let found = solve(&closed, &vec![1.0; n], &vec![0.8; n], &Default::default()).unwrap();
        let off = most(found.exitance.iter().map(|b| (b / 5.0 - 1.0).abs()));
        assert!(off < 1e-3 && off <= bound(order), "order {order}: {off:e}");
    }
}

#[test]
fn n84_boxes_of_any_size_are_alike() {
    let errors = [1e-3, 1.0, 1e3].map(|scale| {
        let case = Case::new(crowds(&mut Rng::with_seed(9), 400, 1.0, scale), faces);
        [3, 7].map(|order| case.error(order))
    });
    for order in 0..2 {
        // Cubes of the tree have one size, so that trees differ a little.
        assert!(errors[0][order] <= bound([3, 7][order]), "{errors:?}");
        assert!(errors[2][order] <= bound([3, 7][order]), "{errors:?}");
    }
}

#[test]
fn n85_the_error_falls_with_the_order_as_its_bound_does() {
    let case = Case::new(crowds(&mut Rng::with_seed(10), 1500, 4.0, 1.0), faces);
    let logs: Vec<f64> = (1..=5).map(|order| case.error(order).ln()).collect();
    // A line through (p, ln error): its slope is -ln q or steeper.
    let mean = logs.iter().sum::<f64>() / 5.0;
    let slope =
        (1..=5).zip(&logs).map(|(p, log)| (f64::from(p) - 3.0) * (log - mean)).sum::<f64>() / 10.0;
    let expected = -(3.0 + 8f64.sqrt()).ln();
    assert!(slope <= 0.9 * expected, "slope {slope}, not {expected}: {logs:?}");
}

#[test]
fn n86_a_scene_far_from_the_origin_is_the_same_scene() {
    // On a lattice of 1/1024 a million is added without loss; so are the tree's cubes.
    let mut rng = Rng::with_seed(11);
    let snapped = |v: f64| (v * 1024.0).round() / 1024.0;
    let scene: Vec<Element> = crowds(&mut rng, 600, 1.0, 1.0)
        .iter()
        .map(|e| Element { position: e.position.map(snapped), ..*e })
        .collect();
    let near = Case::new(scene, faces);
    let moved = (0..near.elements.len()).map(|i| {
        let e = near.elements.get(i);
        Element { position: e.position.map(|v| v + 1e6), ..e }
    });
    let moved = Elements::new(moved).unwrap();
    for order in [2, 5] {
        let far = Exchange::multipole(
            moved.clone(),
            near.tree.clone(),
            near.links.as_slice(),
            Kernel::default(),
            order,
        );
        let far = far.unwrap().apply(&near.exitance).unwrap();
        let here = near.multipole(order).apply(&near.exitance).unwrap();
        assert!(far == here, "order {order}");
    }
}

#[test]
fn n87_light_below_nothing_is_cut_off_and_told() {
    let case = room_with_ball(9);
    let n = case.elements.len();
    let emission: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i % 50 == 0))).collect();
    for order in 1..=4 {
        let exchange = case.multipole(order);
        let open = Balanced::new(&exchange, Scene::Open, 1e-6, 200).unwrap();
        let found = solve(&open, &emission, &vec![0.5; n], &Default::default()).unwrap();
        let balance = found.balance;
        assert!(found.exitance.iter().zip(&emission).all(|(b, e)| b >= e));
        assert!(found.irradiance.iter().all(|&h| h >= 0.0));
        let share = balance.clipped / balance.emitted;
        assert!((0.0..bound(order)).contains(&share), "order {order}: {share:e}");
    }
}

#[test]
fn n88_any_number_of_threads_gives_the_same_bits() {
    let case = room_with_ball(12);
    for order in [0, 3] {
        let exchange = if order == 0 { case.direct() } else { case.multipole(order) };
        let flux = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let flux = pool.install(|| exchange.apply(&case.exitance).unwrap());
            flux.iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        };
        let one = flux(1);
        for threads in [2, 7, 64] {
            assert!(flux(threads) == one, "order {order}, {threads} threads");
        }
    }
}

#[test]
fn several_at_once_are_each_as_alone() {
    let case = room_with_ball(9);
    let mut rng = Rng::with_seed(14);
    let n = case.elements.len();
    // Of sizes that single precision would not hold side by side.
    let b =
        [1e-30, 1.0, 1e40, 3.0].map(|size| (0..n).map(|_| size * rng.f64()).collect::<Vec<_>>());
    for exchange in [case.direct(), case.multipole(3), case.multipole(5)] {
        let alone: Vec<Vec<f64>> = b.iter().map(|b| exchange.apply(b).unwrap()).collect();
        for together in 1..=4 {
            let b: Vec<&[f64]> = b[..together].iter().map(|b| &b[..]).collect();
            assert!(exchange.apply_each(&b).unwrap() == alone[..together], "{together}");
        }
    }
    assert!(case.direct().apply_each(&[&b[0], &b[1][1..]]).is_err());
}

#[test]
fn grids_of_lower_order_stand_for_what_is_far() {
    // Two walls of 400 elements each, 10 of their widths apart: one place each is enough.
    let wall = |z: f64, up: f64| {
        (0..400).map(move |i| {
            let (x, y) = (f64::from(i / 20) / 20.0, f64::from(i % 20) / 20.0);
            element([x, y, z], [0.0, 0.0, up], 1.0 / 400.0)
        })
    };
    for (distance, n_places) in [(2.0, 9), (10.0, 4), (60.0, 1)] {
        let case = Case::new(wall(0.0, 1.0).chain(wall(distance, -1.0)).collect(), faces);
        let exchange = case.multipole(3);
        let stats = exchange.stats();
        assert_eq!(stats.n_near_pairs, 0, "{distance}: {stats:?}");
        assert!(case.error(3) <= bound(3), "{distance}");
        assert_eq!(stats.n_far_pairs / stats.n_far as u64, n_places * n_places, "{distance}");
    }
}

#[test]
fn what_is_held_is_told() {
    let case = room_with_ball(12);
    let direct = case.direct().stats();
    assert_eq!((direct.n_far, direct.n_grids, direct.n_places), (0, 0, 0));
    let stats = case.multipole(2).stats();
    assert!(stats.n_near_pairs < direct.n_near_pairs && stats.n_far > 0, "{stats:?}");
    assert!(stats.n_places >= stats.n_grids && stats.n_places <= 8 * stats.n_grids, "{stats:?}");
    assert!(stats.held_bytes > 128 * case.elements.len());
}

#[test]
fn trees_and_links_that_cannot_be_are_refused() {
    let case = room_with_ball(4);
    let make = |links: &[(u32, u32)], order: usize| {
        let (elements, tree) = (case.elements.clone(), case.tree.clone());
        Exchange::multipole(elements, tree, links, Kernel::default(), order)
    };
    let n_nodes = case.tree.n_nodes();
    for link in [(0, 1), (5, 5), (7, 3), (1, n_nodes), (1, u32::MAX)] {
        assert!(make(&[link], 3).is_err(), "{link:?}");
    }
    for order in [0, 8, 100] {
        assert!(make(&case.links, order).is_err(), "{order}");
    }
    let few = Elements::new([case.elements.get(0)]).unwrap();
    assert!(
        Exchange::direct(few, case.tree.clone(), case.links.as_slice(), Kernel::default()).is_err()
    );
}

#[test]
fn n90_bytes_do_not_depend_on_what_the_processor_has() {
    // Sums of bits, made on a processor with AVX-512 and, in valgrind, on one with AVX2: nothing is
    // contracted, and no function of a platform's library has a part in it.
    let case = Case::new(crowds(&mut Rng::with_seed(12), 600, 4.0, 1.0), faces);
    let sum = |exchange: &Exchange| {
        let flux = exchange.apply(&case.exitance).unwrap();
        flux.iter().fold(0u64, |sum, v| sum.rotate_left(5) ^ v.to_bits())
    };
    let sums = [case.direct(), case.multipole(3), case.multipole(6)].map(|e| sum(&e));
    assert_eq!(sums, [0x0fe67b4470995002, 0x776cb9dbbcd13c4c, 0x91e41c1e47838a62], "{sums:#018x?}");
}
