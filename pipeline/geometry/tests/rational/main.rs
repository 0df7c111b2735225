//! The leaf-pair test against exact rational arithmetic, on random and on adversarial cases, and
//! rows of the numeric catalogue that concern it (`named`).

mod named;
mod oracle;

use fastrand::Rng;
use pvmap_geometry::Rect;
use pvmap_geometry::bounds::Box3;
use pvmap_geometry::disc::{Disc, Profile, blocks};
use pvmap_geometry::grid::{Frame, GridPoint};

use crate::oracle::check;

/// Steps of the grid a side.
const SIDE: i32 = 1 << 22;

/// Draws a disc with its centroid in a cube at the origin, at one of its corners now and then. Its
/// radius is up to the cube's diagonal; its box may leave the cube by a quarter.
fn random_disc(rng: &mut Rng, size: i32) -> Disc {
    let far = rng.u8(..8) == 0;
    let centroid = [0; 3].map(|_| match (far, rng.bool()) {
        (false, _) => rng.i32(0..size),
        (true, is_last) => i32::from(is_last) * (size - 1),
    });
    let normal = [0; 3].map(|_| rng.i32(-16384..=16384));
    let normal = pvmap_geometry::normal::rescale(normal.map(i64::from));
    let width = size as u64;
    let radius2 = match rng.u8(..4) {
        0 => rng.u64(0..=3 * width * width),
        _ => rng.u64(0..=width / 4).pow(2),
    };
    let limit = match rng.u8(..4) {
        0 => {
            let corners = [0; 3].map(|_| [0; 2].map(|_| rng.i32(-size / 4..=size + size / 4)));
            let (min, max) = (corners.map(|[a, b]| a.min(b)), corners.map(|[a, b]| a.max(b)));
            Box3 { min, max }
        }
        _ => Box3::at(centroid).grown(rng.i32(1..=1 + size / 8)),
    };
    let axes = [0; 2].map(|_| [0; 3].map(|_| rng.i64(-9..=9)));
    let mut bound = || [0; 2].map(|_| rng.i32(0..=1 + size / 8));
    let (low, high) = (bound().map(|v| -v), bound());
    let rect = Rect { axes: axes.map(pvmap_geometry::normal::rescale), low, high };
    Disc { centroid, normal, two_sided: rng.bool(), radius2, limit, rect }
}

/// Moves discs of a cube at the origin to the far corner of the grid: what a large offset of the
/// scan comes to where the frame is not the scan's own.
fn move_far(size: i32, discs: &mut [Disc; 3]) {
    for disc in discs {
        let moved = |v: [i32; 3]| v.map(|c| c + SIDE - size);
        disc.centroid = moved(disc.centroid);
        disc.limit = Box3 { min: moved(disc.limit.min), max: moved(disc.limit.max) };
    }
}

/// Puts `k` where the verdict hangs on one unit: on the rim, at an end, in the segment's plane.
fn adversarial(rng: &mut Rng) -> [Disc; 3] {
    let size = 1 << rng.u32(3..=22);
    let (mut a, mut b, mut k) =
        (random_disc(rng, size), random_disc(rng, size), random_disc(rng, size));
    let axis = rng.usize(0..3);
    match rng.u32(0..7) {
        // A segment along an axis through a disc across it, at the rim to the step.
        0 => {
            let (p, w) = (a.centroid, rng.i32(0..=size / 4));
            b.centroid = p;
            b.centroid[axis] = (p[axis] + rng.i32(2..=size)).min(size - 1);
            k.centroid = p;
            k.centroid[axis] = (p[axis] + b.centroid[axis]) / 2;
            k.centroid[(axis + 1) % 3] = (p[(axis + 1) % 3] + w).min(size - 1);
            k.normal = [0; 3];
            k.normal[axis] = 16384;
            let w = (k.centroid[(axis + 1) % 3] - p[(axis + 1) % 3]) as i64;
            k.radius2 = (w * w + rng.i64(-1..=1)).max(0) as u64;
            k.limit = Box3::at(k.centroid).grown(w as i32 + rng.i32(-1..=1).max(0));
        }
        // The plane passes through an end.
        1 => k.centroid = a.centroid,
        2 => k.centroid = b.centroid,
        // The plane is parallel to the segment, or holds it.
        3 => {
            b.centroid[axis] = a.centroid[axis];
            k.normal = [0; 3];
            k.normal[axis] = 16384;
            if rng.bool() {
                k.centroid[axis] = a.centroid[axis];
            }
        }
        // The crossing lies at the edge of an end's own disc, or of the limit box.
        4 => {
            let d2: i64 = (0..3).map(|i| i64::from(b.centroid[i] - a.centroid[i]).pow(2)).sum();
            k.centroid = [0, 1, 2].map(|i| (a.centroid[i] + b.centroid[i]).div_euclid(2));
            a.radius2 = (d2 / 4 + rng.i64(-2..=2)).max(0) as u64;
            k.limit = Box3::at(k.centroid).grown(rng.i32(0..=1));
            k.radius2 = rng.u64(0..=3);
        }
        // The crossing lies at the edge of the rectangle, whose axes are those of the grid.
        5 => {
            k.centroid = [0, 1, 2].map(|i| i32::midpoint(a.centroid[i], b.centroid[i]));
            k.centroid[axis] += rng.i32(-3..=3);
            k.rect.axes = [[0; 3]; 2];
            k.rect.axes[0][axis] = 16384;
            k.rect.axes[1][(axis + 1) % 3] = -16384;
            (k.rect.low, k.rect.high) = ([-rng.i32(0..=3); 2], [rng.i32(0..=3); 2]);
        }
        // Everything in one corner: many ties.
        _ => {
            for disc in [&mut a, &mut b, &mut k] {
                *disc = random_disc(rng, 4);
                disc.normal = [0; 3].map(|_| rng.i16(-1..=1) * 16384);
            }
        }
    }
    let mut discs = [a, b, k];
    if rng.bool() {
        move_far(size, &mut discs);
    }
    discs
}

/// The figure is 10^6 random and 10^5 adversarial cases; a plain run does a tenth.
fn cases(full: usize) -> usize {
    if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { full } else { full / 10 }
}

#[test]
fn v2_random_cases_agree_with_fractions() {
    let mut rng = Rng::with_seed(2007);
    let mut n_blocked = 0;
    for _ in 0..cases(1_000_000) {
        let size = 1 << rng.u32(2..=22);
        let mut discs = [0; 3].map(|_| random_disc(&mut rng, size));
        if rng.bool() {
            move_far(size, &mut discs);
        }
        let [a, b, k] = discs;
        check(&a, &b, &k);
        n_blocked += usize::from(blocks(Profile::Paper, &a, &b, &k));
    }
    assert!(n_blocked > cases(1_000_000) / 100, "the cases hardly ever block: {n_blocked}");
}

#[test]
fn v2_adversarial_cases_agree_with_fractions() {
    let mut rng = Rng::with_seed(2007);
    for _ in 0..cases(100_000) {
        let [a, b, k] = adversarial(&mut rng);
        check(&a, &b, &k);
    }
}

/// Draws a lattice place of a scan of `width` steps a side, whose least X is `min`.
fn random_steps(rng: &mut Rng, min: [i64; 3], width: i64) -> [i64; 3] {
    min.map(|v| v + rng.i64(0..=width))
}

#[test]
fn v3_utm_offsets_change_no_verdict_and_agree_with_fractions() {
    let mut rng = Rng::with_seed(2007);
    let (scale, utm) = ([0.001; 3], [500_000.0, 5_000_000.0, 100.0]);
    // The same easting and northing as steps: a file with such coordinates and no offset.
    let utm_steps = [500_000_000, 5_000_000_000, 100_000];
    for _ in 0..cases(100_000) {
        let width = 1 << rng.u32(4..=24);
        let frame =
            |offset, min: [i64; 3]| Frame::of_lattice(scale, offset, min, min.map(|v| v + width));
        let [near, by_offset, by_steps] =
            [frame([0.0; 3], [0; 3]), frame(utm, [0; 3]), frame([0.0; 3], utm_steps)];
        let discs = [0; 3].map(|_| {
            let x = random_steps(&mut rng, [0; 3], width);
            let g = near.grid_of_lattice(x);
            let far = [0, 1, 2].map(|i| x[i] + utm_steps[i]);
            let world = |x: [i64; 3], offset: [f64; 3]| {
                [0, 1, 2].map(|i| x[i] as f64 * scale[i] + offset[i])
            };
            let places: [Result<GridPoint, _>; 4] = [
                Ok(by_offset.grid_of_lattice(x)),
                by_offset.grid_of_query(world(x, utm)),
                Ok(by_steps.grid_of_lattice(far)),
                by_steps.grid_of_query(world(far, [0.0; 3])),
            ];
            assert_eq!(places, [Ok(g); 4], "{x:?} of {width}");
            let centroid = g.map(|c| c as i32);
            let disc = random_disc(&mut rng, SIDE);
            Disc { centroid, limit: Box3::at(centroid).grown(rng.i32(1..=SIDE)), ..disc }
        });
        check(&discs[0], &discs[1], &discs[2]);
    }
}
