use super::*;
use crate::bounds::{self, tests::rect};
use fastrand::Rng;
use pvmap_geometry::{Box3, disc, normal};

/// Draws surfels along a surface: a grid of them, each a little off, some of them left out.
fn sheet_discs(rng: &mut Rng) -> Vec<Disc> {
    let step = 1 << rng.u32(9..=16);
    let side = rng.i32(2..=8);
    let origin = [0; 3].map(|_| rng.i32(0..=(1 << 22) - 12 * step));
    let w = rng.usize(..3);
    let [p, q, a, b, c] = [0; 5].map(|_| rng.f64() * 2.0 - 1.0);
    let bend = [0.0, 0.02, 0.1][rng.usize(..3)] / f64::from(step);
    let rough = [0.0, 1.0, 0.02 * f64::from(step)][rng.usize(..3)];
    let (keep, reach) = (rng.u8(4..=9), 0.4 + 0.6 * rng.f64());
    let two_sided = rng.bool();
    let mut discs = Vec::new();
    for i in 0..side * side {
        if rng.u8(..9) > keep {
            continue;
        }
        let at = |k: i32| f64::from(k * step + rng_small(i, step));
        let (u, v) = (at(i % side + 2), at(i / side + 2));
        let (x, y) = (u - 6.0 * f64::from(step), v - 6.0 * f64::from(step));
        let height = p * x + q * y + bend * (a * x * x + b * x * y + c * y * y);
        let slope_u = p + bend * (2.0 * a * x + b * y);
        let slope_v = q + bend * (b * x + 2.0 * c * y);
        let off = rough * (rng.f64() - 0.5);
        let mut centroid = [0; 3];
        let mut n = [0i64; 3];
        let places = [u, v, height + off + 6.0 * f64::from(step)];
        let slopes = [-slope_u, -slope_v, 1.0];
        for (k, axis) in [(w + 1) % 3, (w + 2) % 3, w].into_iter().enumerate() {
            centroid[axis] = (origin[axis] + places[k] as i32).clamp(0, (1 << 22) - 1);
            n[axis] = (slopes[k] * 1e6) as i64;
        }
        let radius = reach * f64::from(step);
        // Patches reach farther to one side than to the other, and some surfels have no normal.
        let mut limit = Box3::at(centroid).grown((radius * 0.9) as i32 + 1);
        let axis = rng.usize(..3);
        limit.max[axis] -= (radius * rng.f64() * 0.9) as i32;
        let normal = if rng.u8(..32) == 0 { [0; 3] } else { normal::rescale(n) };
        discs.push(Disc {
            centroid,
            normal,
            two_sided,
            radius2: (radius * radius) as u64,
            limit,
            rect: rect(rng, normal, radius as i32),
        });
    }
    discs
}

/// A shift of a surfel within its cell, the same each time.
fn rng_small(i: i32, step: i32) -> i32 {
    (i.wrapping_mul(0x9e37) & 0xff) * step / 1024
}

/// Draws ends: surfels of the sheet, places near it, and places anywhere.
fn ends(rng: &mut Rng, discs: &mut Vec<Disc>, n_sheet: usize) -> std::ops::Range<u32> {
    let first = discs.len() as u32;
    let (kind, near) = (rng.u8(..3), discs[rng.usize(..n_sheet)]);
    let spread = 1 << rng.u32(4..=21);
    for _ in 0..rng.usize(1..=64) {
        let disc = match kind {
            0 => discs[rng.usize(..n_sheet)],
            _ => {
                let middle = if kind == 1 { near.centroid } else { [1 << 21; 3] };
                let shift = |c: i32| (c + rng.i32(-spread..=spread)).clamp(0, (1 << 22) - 1);
                let centroid = middle.map(shift);
                // From nearly none to many times that of the sheet's surfels.
                let radius2 = near.radius2 << rng.u32(..8) >> (2 * rng.u32(..8));
                Disc { centroid, radius2: radius2.min((1 << 46) - 1), ..near }
            }
        };
        discs.push(disc);
    }
    first..discs.len() as u32
}

#[test]
fn v2_a_sheet_never_contradicts_its_surfels() {
    let mut rng = Rng::with_seed(6);
    let (mut n_sheets, mut n_blocked, mut n_left, mut n_unsure) = (0, 0, 0, 0);
    let n_trials = if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { 60_000 } else { 3_000 };
    for _ in 0..n_trials {
        let mut discs = sheet_discs(&mut rng);
        let profile = [Profile::Paper, Profile::Patch, Profile::Oriented][rng.usize(..3)];
        let n_sheet = discs.len();
        if n_sheet == 0 {
            continue;
        }
        let bounds = bounds::of_group(&discs, profile);
        let Some(sheet) = Sheet::new(0..n_sheet as u32, &discs, &bounds) else { continue };
        n_sheets += 1;
        let sides = [0, 1].map(|_| {
            let mut side = Ends::NONE;
            let surfels = ends(&mut rng, &mut discs, n_sheet);
            side.load(&discs, surfels, profile);
            side
        });
        let [rows, columns] = &sides;
        let all = u64::MAX >> (64 - columns.len());
        let asked: Vec<u64> = (0..rows.len()).map(|_| all & !(rng.u64(..) & rng.u64(..))).collect();
        let mut open = asked.clone();
        let mut screen = Screen::default();
        screen.ask(&sheet, &discs, profile, [rows, columns], &mut open);
        for (row, asked) in asked.iter().enumerate() {
            for column in bits(*asked) {
                let (a, b) = (rows.disc(row, &discs), columns.disc(column, &discs));
                let is_end = |k: &Disc| k.centroid == a.centroid || k.centroid == b.centroid;
                let mut members = discs[..n_sheet].iter().filter(|k| !is_end(k));
                let is_blocked = members.any(|k| disc::blocks(profile, &a, &b, k));
                let is_open = open[row] >> column & 1 == 1;
                let is_unsure = screen.unsure[row] >> column & 1 == 1;
                assert!(!is_unsure || is_open, "unsure and closed");
                assert!(is_open || is_blocked, "{profile:?} {sheet:?} {a:?} {b:?} closed");
                assert!(!is_open || is_unsure || !is_blocked, "{sheet:?} {a:?} {b:?} left alone");
                n_blocked += usize::from(!is_open);
                n_left += usize::from(is_open && !is_unsure);
                n_unsure += usize::from(is_unsure);
            }
        }
    }
    let found = format!("{n_sheets} sheets: {n_blocked} blocked, {n_left} left, {n_unsure} unsure");
    eprintln!("{found}");
    assert!(n_sheets > 1_000 && n_blocked > 50_000 && n_left > 100_000, "{found}");
}
