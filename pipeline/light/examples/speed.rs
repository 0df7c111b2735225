//! Times the exchange of a map: `cargo run --release -p pvmap-light --example speed MAP [ORDER…]`.
//!
//! For every order, 0 for the direct sum: processor seconds of all threads to make it, to apply it
//! once, to scale it ten times and to solve for an albedo of 0.7 and one lit element in a hundred;
//! what it holds; and how far flux and solution are from those of the first one, the largest and
//! the mean difference, of the largest and the mean.
#![allow(clippy::unwrap_used, reason = "an example fails where it unwraps nothing")]

use pvmap_light::{Balanced, Elements, Exchange, Hierarchy, Kernel, Scene, SolveOptions, solve};
use pvmap_vmap::MapView;

fn main() {
    let mut args = std::env::args().skip(1);
    let bytes = std::fs::read(args.next().unwrap()).unwrap();
    let map = MapView::open(&bytes).unwrap();
    let orders: Vec<usize> = args.map(|arg| arg.parse().unwrap()).collect();
    let (elements, hierarchy) = (Elements::of_map(&map).unwrap(), Hierarchy::of_map(&map).unwrap());
    let (n, n_pairs) = (elements.len(), map.summary().n_visible_pairs);
    let area: f64 = elements.areas().iter().sum();
    println!(
        "{n} elements of {area:.2} in all, {} links, {n_pairs} visible pairs",
        map.summary().n_links
    );
    let exitance: Vec<f64> = (0..n).map(|i| 1.0 + (i * 7919 % 101) as f64 / 100.0).collect();
    let emission: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i % 100 == 0))).collect();
    let mut reference: Option<[Vec<f64>; 2]> = None;
    for order in orders {
        let (elements, hierarchy) = (elements.clone(), hierarchy.clone());
        let mut clock = Clock::default();
        clock.lap();
        let exchange = match order {
            0 => Exchange::direct(elements, hierarchy, &map, Kernel::default()),
            _ => Exchange::multipole(elements, hierarchy, &map, Kernel::default(), order),
        };
        let exchange = exchange.unwrap();
        println!("order {order}: made in {:.2} s", clock.lap());
        println!("  {:?}", exchange.stats());
        let flux = exchange.apply(&exitance).unwrap();
        println!("  applied in {:.2} s", clock.lap());
        let areas = exchange.elements().areas();
        let irradiance: Vec<f64> = flux.iter().zip(areas).map(|(f, a)| f / a).collect();
        let balanced = Balanced::new(&exchange, Scene::Open, 0.0, 10).unwrap();
        println!("  rows within {:.1e} after {:.2} s", balanced.row_error(), clock.lap());
        let lit = solve(&balanced, &emission, &vec![0.7; n], &SolveOptions::default()).unwrap();
        println!("  {} iterations in {:.2} s, {:?}", lit.iterations, clock.lap(), lit.balance);
        match &reference {
            Some([flux, solution]) => {
                println!(
                    "  flux {}, solution {}",
                    off(&irradiance, flux),
                    off(&lit.irradiance, solution)
                );
            }
            None => reference = Some([irradiance, lit.irradiance]),
        }
    }
}

/// Says how far some values are from others.
fn off(found: &[f64], exact: &[f64]) -> String {
    let difference: Vec<f64> = found.iter().zip(exact).map(|(a, b)| (a - b).abs()).collect();
    let most = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    let sum = |values: &[f64]| values.iter().sum::<f64>();
    let (largest, mean) = (most(&difference) / most(exact), sum(&difference) / sum(exact));
    format!("off by {largest:.1e} (mean {mean:.1e})")
}

/// Processor seconds of all threads, in steps of 1/100.
#[derive(Default)]
struct Clock {
    before: f64,
}

impl Clock {
    /// Gives those since the last lap.
    fn lap(&mut self) -> f64 {
        let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
        // User and system time are the 14th and 15th field; the second may hold spaces.
        let fields = stat.rsplit(')').next().unwrap().split_whitespace().skip(11).take(2);
        let now = fields.map(|ticks| ticks.parse::<f64>().unwrap() / 100.0).sum();
        now - std::mem::replace(&mut self.before, now)
    }
}
