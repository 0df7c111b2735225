//! The solver: what it refuses, what it keeps exact, and where its light goes.

use fastrand::Rng;
use pvmap_light::{
    Balanced, Exchange, FluxBalance, Kernel, LightError, Method, Operator, Scene, Solution,
    SolveOptions, solve,
};

use crate::common::{box_room, closed_solution, element, exchange_where, most, open_exchange};

const OPTIONS: SolveOptions =
    SolveOptions { method: Method::ConjugateGradients, tolerance: 1e-10, max_iterations: 100_000 };

/// A room with one wall that shines and colours that differ.
fn lit_room() -> (Exchange, Vec<f64>, Vec<f64>) {
    let room = box_room(5);
    let emission = (0..room.len()).map(|i| if i < 25 { 1.0 } else { 0.0 }).collect();
    let albedo = (0..room.len()).map(|i| 0.1 + 0.8 * (i % 7) as f64 / 6.0).collect();
    (open_exchange(&room, Kernel::default()), emission, albedo)
}

fn off(a: &[f64], b: &[f64]) -> f64 {
    most(a.iter().zip(b).map(|(a, b)| (a / b - 1.0).abs()))
}

#[test]
fn n74_what_may_not_converge_is_refused_before_it_begins() {
    let (exchange, emission, _) = lit_room();
    let n = emission.len();
    // Rows of the raw kernel add up to 1.2: at an albedo of 0.9 light would grow.
    let room = box_room(5);
    let raw = open_exchange(&room, Kernel::new(0.0).unwrap());
    let refused = solve(&raw, &emission, &vec![0.9; n], &OPTIONS).unwrap_err();
    assert!(matches!(refused, LightError::NoFiniteSolution { reflected } if reflected > 1.0));
    // The bound holds for what is left after many bounces.
    let closed = Balanced::new(&exchange, Scene::Closed, 1e-10, 200).unwrap();
    let mut light = emission;
    let sum = |v: &[f64]| v.iter().sum::<f64>();
    for _ in 0..20 {
        let before = sum(&light);
        let flux = closed.apply(&light).unwrap();
        light = flux.iter().zip(closed.areas()).map(|(flux, area)| 0.9 * flux / area).collect();
        assert!(sum(&light) <= 0.9 * (1.0 + 1e-9) * before);
    }
}

/// The largest eigenvalue of (ρ/A) G, which has none below 0 of that size: power iteration.
fn largest_eigenvalue(operator: &impl Operator, albedo: &[f64]) -> f64 {
    let mut light = vec![1.0; albedo.len()];
    let mut eigenvalue = 0.0;
    for _ in 0..500 {
        let flux = operator.apply(&light).unwrap();
        let rows = flux.iter().zip(operator.areas()).zip(albedo);
        let next: Vec<f64> = rows.map(|((flux, area), rho)| rho * flux / area).collect();
        eigenvalue = most(next.iter().copied());
        light = next.iter().map(|v| v / eigenvalue).collect();
    }
    eigenvalue
}

#[test]
fn n74_no_eigenvalue_is_above_the_bound_that_is_told() {
    let (exchange, emission, albedo) = lit_room();
    let n = emission.len();
    let closed = Balanced::new(&exchange, Scene::Closed, 1e-10, 200).unwrap();
    let roofless: Vec<_> = box_room(5).into_iter().filter(|e| e.normal[2] >= 0.0).collect();
    let open_room = open_exchange(&roofless, Kernel::default());
    let open = Balanced::new(&open_room, Scene::Open, 1e-6, 500).unwrap();
    let all = vec![0.9; n];
    // Where all reflect alike and nothing escapes the bound is the eigenvalue.
    for (operator, albedo, least) in
        [(&closed, &all, 0.9), (&closed, &albedo, 0.5), (&open, &all, 0.5), (&open, &albedo, 0.3)]
    {
        let n = operator.areas().len();
        let told = solve(operator, &emission[..n], &albedo[..n], &OPTIONS).unwrap().reflected;
        let found = largest_eigenvalue(operator, &albedo[..n]);
        assert!(found <= told * (1.0 + 1e-9) && told < 1.0, "{found} > {told}");
        assert!(found >= least * (1.0 - 1e-9), "{found} < {least}");
    }
    let dark = solve(&closed, &vec![0.0; n], &all, &OPTIONS).unwrap();
    assert_eq!(dark.reflected, 0.0);
}

#[test]
fn n76_without_reflection_radiosity_is_emission_to_the_bit() {
    let (exchange, emission, _) = lit_room();
    let found = solve(&exchange, &emission, &vec![0.0; emission.len()], &OPTIONS).unwrap();
    assert_eq!((found.exitance, found.iterations), (emission, 0));
    assert!(found.irradiance.iter().any(|&h| h > 0.0));
}

#[test]
fn n76_where_nothing_is_reflected_radiosity_is_emission_to_the_bit() {
    let (exchange, emission, mut albedo) = lit_room();
    albedo.iter_mut().step_by(3).for_each(|rho| *rho = 0.0);
    let found = closed_solution(&exchange, &emission, &albedo);
    for i in 0..emission.len() {
        assert_eq!(found.exitance[i] == emission[i], albedo[i] == 0.0, "{i}");
    }
}

#[test]
fn n77_a_closed_room_that_absorbs_nothing_has_no_solution() {
    let (exchange, emission, _) = lit_room();
    let n = emission.len();
    let closed = Balanced::new(&exchange, Scene::Closed, 1e-10, 200).unwrap();
    let refused = solve(&closed, &emission, &vec![1.0; n], &OPTIONS).unwrap_err();
    assert!(matches!(refused, LightError::NoFiniteSolution { .. }), "{refused}");
    // Conjugate gradients take some iterations where bounces take thousands: E/(1 - ρ) = 1000.
    let found = solve(&closed, &vec![1.0; n], &vec![0.999; n], &OPTIONS).unwrap();
    assert!(most(found.exitance.iter().map(|b| (b / 1e3 - 1.0).abs())) < 1e-5);
    assert!(found.iterations < 20, "{} iterations", found.iterations);
    let options = SolveOptions { method: Method::Jacobi, tolerance: 1e-6, ..OPTIONS };
    let bounces = solve(&closed, &vec![1.0; n], &vec![0.999; n], &options).unwrap();
    assert!(bounces.iterations > 10_000, "{} iterations", bounces.iterations);
}

#[test]
fn n77_an_open_scene_may_absorb_nothing() {
    let room: Vec<_> = box_room(5).into_iter().filter(|e| e.normal[2] >= 0.0).collect();
    let n = room.len();
    let exchange = open_exchange(&room, Kernel::default());
    let open = Balanced::new(&exchange, Scene::Open, 1e-6, 500).unwrap();
    let found = solve(&open, &vec![1.0; n], &vec![1.0; n], &OPTIONS).unwrap();
    let balance = found.balance;
    assert_eq!(balance.absorbed, 0.0);
    assert!((balance.escaped / balance.emitted - 1.0).abs() < 1e-9, "{balance:?}");
}

#[test]
fn n78_values_out_of_range_are_named() {
    let (exchange, emission, albedo) = lit_room();
    for (wrong, what) in
        [(-0.1, "albedo"), (1.1, "albedo"), (f64::NAN, "albedo"), (255.0, "albedo")]
    {
        let mut values = albedo.clone();
        values[7] = wrong;
        let error = solve(&exchange, &emission, &values, &OPTIONS).unwrap_err().to_string();
        assert!(error.contains(what) && error.contains("element 7"), "{error}");
    }
    for wrong in [-1.0, f64::NAN, f64::INFINITY] {
        let mut values = emission.clone();
        values[9] = wrong;
        let error = solve(&exchange, &values, &albedo, &OPTIONS).unwrap_err();
        assert!(matches!(error, LightError::Value { what: "emission", index: 9, .. }), "{error}");
    }
    let error = solve(&exchange, &emission[1..], &albedo, &OPTIONS).unwrap_err();
    assert!(matches!(error, LightError::Count { what: "emission", .. }), "{error}");
    for tolerance in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = SolveOptions { tolerance, ..OPTIONS };
        assert!(solve(&exchange, &emission, &albedo, &options).is_err(), "{tolerance}");
    }
    assert!(Balanced::new(&exchange, Scene::Open, f64::NAN, 1).is_err());
}

#[test]
fn n79_without_an_emitter_all_is_dark_and_one_is_enough() {
    let (exchange, mut emission, albedo) = lit_room();
    emission.fill(0.0);
    let dark = solve(&exchange, &emission, &albedo, &OPTIONS).unwrap();
    assert!(dark.exitance.iter().chain(&dark.irradiance).all(|v| v.to_bits() == 0));
    assert_eq!((dark.iterations, dark.residual), (0, 0.0));
    emission[3] = 1e-30;
    let lit = solve(&exchange, &emission, &albedo, &OPTIONS).unwrap();
    assert!(lit.exitance.iter().all(|&b| b > 0.0));
}

#[test]
fn n81_a_weak_emitter_beside_a_strong_one_is_kept() {
    let (exchange, strong, albedo) = lit_room();
    let strong: Vec<f64> = strong.iter().map(|e| 1e12 * e).collect();
    let mut weak = vec![0.0; strong.len()];
    weak[100] = 1.0;
    let both: Vec<f64> = strong.iter().zip(&weak).map(|(a, b)| a + b).collect();
    let [strong, weak, both] = [&strong, &weak, &both].map(|e| {
        let options = SolveOptions { tolerance: 1e-16, ..OPTIONS };
        closed(&exchange, e, &albedo, &options).exitance
    });
    // What the weak one adds is some 1e-13 of the rest, doubles have 1e-16: the element itself,
    // and on the whole where the strong one's light is faintest, has it.
    let added = both[100] - strong[100];
    assert!((added / weak[100] - 1.0).abs() < 1e-3, "{added}, not {}", weak[100]);
}

#[test]
fn n81_emitters_of_any_strength_are_kept_where_light_is_reflected_a_thousand_times() {
    let (exchange, strong, _) = lit_room();
    let n = strong.len();
    let strong: Vec<f64> = strong.iter().map(|e| 1e12 * e).collect();
    let mut weak = vec![0.0; n];
    weak[100] = 1.0;
    let both: Vec<f64> = strong.iter().zip(&weak).map(|(a, b)| a + b).collect();
    let options = SolveOptions { tolerance: 1e-8, ..OPTIONS };
    let [strong, weak, both] =
        [&strong, &weak, &both].map(|e| closed(&exchange, e, &vec![0.999; n], &options));
    for one in [&strong, &weak, &both] {
        let FluxBalance { emitted, absorbed, .. } = one.balance;
        assert!((absorbed / emitted - 1.0).abs() <= 1e-6, "{:?}", one.balance);
    }
    let sum = strong.exitance.iter().zip(&weak.exitance).map(|(a, b)| a + b).collect::<Vec<_>>();
    assert!(off(&both.exitance, &sum) <= 1e-6, "{:e}", off(&both.exitance, &sum));
}

#[test]
fn n81_a_weak_emitter_in_a_room_of_its_own_is_kept() {
    let room = box_room(5);
    let n = room.len();
    let beside = room.iter().map(|e| {
        let [x, y, z] = e.position;
        element([x + 3.0, y, z], e.normal, e.area)
    });
    let rooms: Vec<_> = room.iter().copied().chain(beside).collect();
    let exchange = exchange_where(&rooms, Kernel::default(), |i, j| (i < n) == (j < n));
    let alone = open_exchange(&room, Kernel::default());
    let lamp: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i < 25))).collect();
    let strong: Vec<f64> = lamp.iter().map(|e| 1e12 * e).collect();
    for weak in [0.1, 0.5, 0.999] {
        let albedo = [vec![0.7; n], vec![weak; n]];
        let own = closed(&alone, &lamp, &albedo[1], &OPTIONS).exitance;
        for method in [Method::ConjugateGradients, Method::Jacobi] {
            let options = SolveOptions { method, ..OPTIONS };
            let weak_of = |strong: &[f64]| {
                let emission = [strong, &lamp].concat();
                let found = closed(&exchange, &emission, &albedo.concat(), &options);
                off(&found.exitance[n..], &own)
            };
            let [alone, beside] = [weak_of(&vec![0.0; n]), weak_of(&strong)];
            assert!(alone <= 1e-7, "albedo {weak}, {method:?}: {alone:e}");
            assert!(beside <= 1e-6, "albedo {weak}, {method:?}: {beside:e} beside a strong one");
        }
    }
}

fn closed(exchange: &Exchange, e: &[f64], rho: &[f64], options: &SolveOptions) -> Solution {
    let balanced = Balanced::new(exchange, Scene::Closed, 1e-12, 400).unwrap();
    solve(&balanced, e, rho, options).unwrap()
}

#[test]
fn n82_light_adds_up() {
    let (exchange, first, albedo) = lit_room();
    let mut rng = Rng::with_seed(4);
    let second: Vec<f64> = first.iter().map(|_| rng.f64()).collect();
    let (alpha, beta) = (2.5, 0.3);
    let both: Vec<f64> = first.iter().zip(&second).map(|(a, b)| alpha * a + beta * b).collect();
    let options = SolveOptions { tolerance: 1e-13, ..OPTIONS };
    let [first, second, both] =
        [&first, &second, &both].map(|e| closed(&exchange, e, &albedo, &options).exitance);
    let sum: Vec<f64> = first.iter().zip(&second).map(|(a, b)| alpha * a + beta * b).collect();
    assert!(off(&sum, &both) < 1e-11, "{:e}", off(&sum, &both));
}

#[test]
fn n83_all_light_is_accounted_for() {
    let (exchange, emission, albedo) = lit_room();
    let roofless: Vec<_> = box_room(5).into_iter().filter(|e| e.normal[2] >= 0.0).collect();
    let open_room = open_exchange(&roofless, Kernel::default());
    let open = Balanced::new(&open_room, Scene::Open, 1e-6, 500).unwrap();
    let closed = Balanced::new(&exchange, Scene::Closed, 1e-12, 400).unwrap();
    let lit = [
        (solve(&closed, &emission, &albedo, &OPTIONS).unwrap(), 0.0),
        (solve(&open, &emission[..125], &albedo[..125], &OPTIONS).unwrap(), 0.05),
    ];
    for (found, least) in lit {
        let b = found.balance;
        let lost = (b.emitted - b.absorbed - b.escaped) / b.emitted;
        assert!(lost.abs() <= 1e-9, "{lost:e} of {b:?}");
        assert!(b.escaped >= least * b.emitted - 1e-9 && b.clipped == 0.0, "{b:?}");
    }
}

/// An operator that gives NaN after some applications.
struct Breaks<'a> {
    inner: &'a Exchange,
    left: std::cell::Cell<usize>,
}

impl Operator for Breaks<'_> {
    fn areas(&self) -> &[f64] {
        self.inner.elements().areas()
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        let mut flux = self.inner.apply(b)?;
        self.left.set(self.left.get().saturating_sub(1));
        if self.left.get() == 0 {
            flux[5] = f64::NAN;
        }
        Ok(flux)
    }
}

#[test]
fn n89_nan_is_not_converged() {
    let (exchange, emission, albedo) = lit_room();
    for method in [Method::ConjugateGradients, Method::Jacobi] {
        for left in 1..6 {
            let breaks = Breaks { inner: &exchange, left: left.into() };
            let options = SolveOptions { method, ..OPTIONS };
            let error = solve(&breaks, &emission, &albedo, &options).unwrap_err();
            let is_told =
                matches!(error, LightError::NotFinite { .. } | LightError::NoFiniteSolution { .. });
            assert!(is_told, "{method:?}, {left}: {error}");
        }
    }
}

/// An exchange that is not positive definite with albedos near 1: a row below 0.
struct Indefinite;

impl Operator for Indefinite {
    fn areas(&self) -> &[f64] {
        &[1.0, 1.0, 1.0]
    }

    fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        Ok(vec![
            1.5 * b[1] - 0.9 * b[2],
            1.5 * b[0] - 0.9 * b[2],
            -0.9 * (b[0] + b[1]) + 2.0 * b[2],
        ])
    }
}

#[test]
fn where_conjugate_gradients_break_down_bounces_go_on() {
    let options = SolveOptions { tolerance: 1e-6, max_iterations: 50, ..OPTIONS };
    let error = solve(&Indefinite, &[1.0, 0.0, 0.0], &[0.9; 3], &options).unwrap_err();
    // Bounces grow, too: what is told is that no solution was reached, never one that is none.
    assert!(matches!(error, LightError::NotConverged { .. }), "{error}");
}

#[test]
fn both_methods_find_the_same_light() {
    let (exchange, emission, albedo) = lit_room();
    let options = |method| SolveOptions { method, ..OPTIONS };
    let conjugate = solve(&exchange, &emission, &albedo, &options(Method::ConjugateGradients));
    let bounces = solve(&exchange, &emission, &albedo, &options(Method::Jacobi));
    let (conjugate, bounces) = (conjugate.unwrap(), bounces.unwrap());
    assert!(off(&conjugate.exitance, &bounces.exitance) < 1e-9);
    assert!(conjugate.iterations < bounces.iterations);
    assert_eq!((conjugate.method, bounces.method), (Method::ConjugateGradients, Method::Jacobi));
}

#[test]
fn too_few_iterations_are_told() {
    let (exchange, emission, albedo) = lit_room();
    let options = SolveOptions { max_iterations: 2, ..OPTIONS };
    let error = solve(&exchange, &emission, &albedo, &options).unwrap_err();
    assert!(matches!(error, LightError::NotConverged { iterations: 2, .. }), "{error}");
}

#[test]
fn n92_black_patches_cost_no_iterations() {
    // The tolerance is of the flux of all: dark corners are not solved for by themselves.
    let (exchange, emission, mut albedo) = lit_room();
    let options = SolveOptions { tolerance: 1e-6, ..OPTIONS };
    let plain = closed(&exchange, &emission, &albedo, &options).iterations;
    albedo.iter_mut().step_by(2).for_each(|rho| *rho = 1e-12);
    let black = closed(&exchange, &emission, &albedo, &options).iterations;
    assert!(black <= plain, "{black} iterations with black patches, {plain} without");
}

#[test]
fn one_element_shines_into_the_open() {
    let exchange = open_exchange(&[element([0.0; 3], [0.0, 0.0, 1.0], 2.0)], Kernel::default());
    let found = solve(&exchange, &[3.0], &[0.5], &OPTIONS).unwrap();
    assert_eq!((found.exitance, found.irradiance), (vec![3.0], vec![0.0]));
    assert_eq!((found.balance.emitted, found.balance.escaped), (6.0, 6.0));
}
