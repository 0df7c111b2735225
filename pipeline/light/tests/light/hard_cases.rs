//! Scenes that go wrong elsewhere: copies, thin walls, gaps, areas of all sizes.

use fastrand::Rng;
use pvmap_light::{Balanced, Element, Kernel, Scene, SolveOptions, solve};

use crate::common::{
    box_room, closed_solution, element, exchange_where, most, open_exchange, square,
};

const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];

/// Radiosity of a closed room of E = 1 and an albedo of 0.8, off from 5 at the most.
fn furnace_error(room: &[Element], sees: impl Fn(usize, usize) -> bool) -> f64 {
    let exchange = exchange_where(room, Kernel::default(), sees);
    let n = room.len();
    let found = closed_solution(&exchange, &vec![1.0; n], &vec![0.8; n]);
    most(found.exitance.iter().map(|b| (b / 5.0 - 1.0).abs()))
}

#[test]
fn duplicates_and_two_scans_of_one_wall() {
    let mut room = box_room(6);
    room.extend_from_within(..40);
    assert!(furnace_error(&room, |_, _| true) < 1e-6);
    // The second scan a thousandth before the first, of other density.
    let mut room = box_room(6);
    room.extend(square([0.0, 0.0, 1e-3], X, Y, 9));
    assert!(furnace_error(&room, |_, _| true) < 1e-6);
}

#[test]
fn thin_walls_back_to_back_exchange_nothing() {
    // A wall in the middle of a room, its faces a thousandth apart: each half is a room.
    let mut room = box_room(6);
    let n_walls = room.len();
    room.extend(square([0.0, 0.0, 0.5005], X, Y, 6));
    room.extend(square([0.0, 0.0, 0.4995], Y, X, 6));
    let is_above = |i: usize| room[i].position[2] > 0.5;
    let sees = |i: usize, j: usize| is_above(i) == is_above(j);
    assert!(furnace_error(&room, sees) < 1e-6);
    let exchange = exchange_where(&room, Kernel::default(), sees);
    let above: Vec<f64> = (0..room.len()).map(|i| f64::from(u8::from(is_above(i)))).collect();
    let flux = exchange.apply(&above).unwrap();
    for i in (0..room.len()).filter(|&i| !is_above(i)) {
        assert_eq!(flux[i], 0.0, "{i} of {n_walls}");
    }
}

#[test]
fn a_gap_far_smaller_than_an_element() {
    // Plates face to face, 1/1000 apart, elements of 1/10: what leaves one arrives at the other.
    let mut plates = square([0.0; 3], X, Y, 10);
    plates.extend(square([0.0, 0.0, 1e-3], Y, X, 10));
    let exchange = open_exchange(&plates, Kernel::default());
    let open = Balanced::new(&exchange, Scene::Open, 1e-9, 500).unwrap();
    let lit: Vec<f64> = (0..200).map(|i| if i < 100 { 1.0 } else { 0.0 }).collect();
    let options = SolveOptions::default();
    let found = solve(&open, &lit, &[0.9; 200], &options).unwrap();
    let balance = found.balance;
    assert!(found.exitance.iter().all(|b| b.is_finite() && *b <= 1.0 / (1.0 - 0.9) + 1e-6));
    assert!(balance.absorbed > 0.9 * balance.emitted, "{balance:?}");
}

#[test]
fn isolated_elements_stay_dark() {
    let mut room = box_room(4);
    room.push(element([9.0; 3], [1.0, 0.0, 0.0], 1.0));
    let n = room.len();
    let exchange = exchange_where(&room, Kernel::default(), |_, j| j < n - 1);
    let emission: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i < 16))).collect();
    let found = closed_solution(&exchange, &emission, &vec![0.5; n]);
    assert_eq!((found.exitance[n - 1], found.irradiance[n - 1]), (0.0, 0.0));
    assert!(found.exitance[..n - 1].iter().all(|&b| b > 0.0));
}

#[test]
fn areas_spread_over_six_orders() {
    let mut rng = Rng::with_seed(5);
    let mut room = box_room(8);
    let spread: Vec<f64> = room.iter().map(|_| 10f64.powf(-6.0 * rng.f64())).collect();
    room.iter_mut().zip(&spread).for_each(|(e, s)| e.area *= s);
    let exchange = open_exchange(&room, Kernel::default());
    let n = room.len();
    let closed = Balanced::new(&exchange, Scene::Closed, 1e-9, 10_000).unwrap();
    assert!(closed.row_error() <= 1e-9, "{}", closed.row_error());
    let options = SolveOptions { tolerance: 1e-9, ..SolveOptions::default() };
    let found = solve(&closed, &vec![1.0; n], &vec![0.8; n], &options).unwrap();
    let off = most(found.exitance.iter().map(|b| (b / 5.0 - 1.0).abs()));
    assert!(off < 1e-6, "{off:e}");
}

#[test]
fn small_and_large_units_are_alike() {
    for scale in [1e-6, 1e6] {
        let mut room = box_room(5);
        for e in &mut room {
            e.position = e.position.map(|v| v * scale);
            e.area *= scale * scale;
        }
        assert!(furnace_error(&room, |_, _| true) < 1e-6, "{scale}");
    }
}
