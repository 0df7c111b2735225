//! Rows N35…N65 of the numeric catalogue, where they concern two ends and what is between them.

use fastrand::Rng;
use pvmap_geometry::Rect;
use pvmap_geometry::bounds::Box3;
use pvmap_geometry::disc::{Disc, Profile, blocks, faces_both, segment_meets};

use crate::oracle::{blocks_by_fractions, check, clip, minus, vector};
use crate::{SIDE, cases, random_disc};

const PROFILES: [Profile; 3] = [Profile::Paper, Profile::Patch, Profile::Oriented];
/// No box limits it.
const ANYWHERE: Box3 = Box3 { min: [-SIDE; 3], max: [2 * SIDE; 3] };

/// A surfel of no size that looks everywhere.
fn end(centroid: [i32; 3]) -> Disc {
    let (normal, limit) = ([0; 3], Box3::at(centroid));
    Disc { centroid, normal, two_sided: true, radius2: 0, limit, rect: Rect::NONE }
}

fn disc(centroid: [i32; 3], normal: [i16; 3], radius: u64) -> Disc {
    let (radius2, limit) = (radius * radius, ANYWHERE);
    Disc { centroid, normal, two_sided: false, radius2, limit, rect: Rect::NONE }
}

/// Says whether a disc blocks, which all profiles and fractions must agree on.
fn is_blocked(a: &Disc, b: &Disc, k: &Disc) -> bool {
    check(a, b, k);
    let [paper, patch, oriented] = PROFILES.map(|profile| blocks(profile, a, b, k));
    assert_eq!([paper; 2], [patch, oriented], "{a:?} {b:?} {k:?}");
    paper
}

fn random_place(rng: &mut Rng) -> [i32; 3] {
    [0; 3].map(|_| rng.i32(0..SIDE))
}

#[test]
fn n35_a_parallel_plane_never_blocks() {
    let (a, b) = (end([0, 500, 500]), end([SIDE - 1, 500, 500]));
    for off in [-1, 1, 400] {
        assert!(!is_blocked(&a, &b, &disc([SIDE / 2, 500, 500 + off], [0, 0, 16384], 1000)));
    }
}

#[test]
fn n36_the_plane_that_holds_the_segment_never_blocks() {
    let (a, b) = (end([3, 7, 11]), end([3 + 4 * 9, 7 + 4 * 5, 11]));
    for normal in [[0, 0, 16384], [0, 0, -16384]] {
        assert!(!is_blocked(&a, &b, &disc([12, 12, 11], normal, 1000)));
    }
}

#[test]
fn n37_a_plane_nearly_parallel_has_the_verdict_of_fractions() {
    let mut rng = Rng::with_seed(37);
    let (mut n_near, mut n_blocked) = (0, 0);
    for _ in 0..cases(30_000) {
        let a = end(random_place(&mut rng));
        // Across (n_y, -n_x, 0), and a few steps more: |n·d| is of some steps and not of 2^36.
        let [nx, ny] = [0; 2].map(|_| rng.i16(8000..11000));
        let far = rng.i32(1..=200);
        let [x, y, z] = a.centroid;
        let shift = rng.i32(-1..=1);
        let b = end([x + far * i32::from(ny) + shift, y - far * i32::from(nx), z]);
        let t = rng.i32(1..1000);
        let on = [0, 1, 2].map(|i| {
            let d = i64::from(b.centroid[i] - a.centroid[i]);
            a.centroid[i] + (d * i64::from(t) / 1000) as i32
        });
        let k = disc([on[0] + rng.i32(-1..=1), on[1], on[2]], [nx, ny, 0], 1 << 20);
        let d = minus(&vector(b.centroid), &vector(a.centroid));
        let n = vector(k.normal.map(i32::from));
        let s = &n[0] * &d[0] + &n[1] * &d[1];
        n_near += usize::from(s.numer().bits() < 16);
        check(&a, &b, &k);
        n_blocked += usize::from(blocks(Profile::Paper, &a, &b, &k));
    }
    assert_eq!(n_near, cases(30_000));
    assert!(n_blocked > cases(30_000) / 10, "{n_blocked}");
}

#[test]
fn n38_the_ends_of_a_segment_are_not_between_them() {
    // h of s = n·d: 1, which is 1.5e-11 of the way, up to s - 1.
    let (a, b) = (end([0; 3]), end([SIDE - 1, 1, 0]));
    let n = [16384, -16383, 0];
    let s = i64::from(n[0]) * i64::from(SIDE - 1) + i64::from(n[1]);
    for (h, expected) in [(0, false), (1, true), (2, true), (s - 1, true), (s, false)] {
        // A place with n·w = h: 16384 (x + y) - 16383 y is 16384 x + y.
        let (x, y) = (h.div_euclid(16384), h.rem_euclid(16384));
        let centroid = [(x + y) as i32, y as i32, 0];
        let k = disc(centroid, n.map(|v| v as i16), 1 << 22);
        assert_eq!(is_blocked(&a, &b, &k), expected, "{h} of {s}");
    }
}

#[test]
fn n39_the_rim_belongs_to_a_disc() {
    let mut rng = Rng::with_seed(39);
    for _ in 0..cases(10_000) {
        // Across the z axis, so that the crossing is a place of the grid.
        let [x, y, z] = random_place(&mut rng).map(|v| v / 2 + 1000);
        let (a, b) = (end([x, y, z - 500]), end([x, y, z + 700]));
        let [u, v] = [0; 2].map(|_| rng.i32(-900..=900));
        let far2 = (u * u + v * v) as u64;
        for (radius2, expected) in
            [(far2, true), (far2 + 1, true), (far2.wrapping_sub(1), far2 == 0)]
        {
            let k = Disc { radius2, ..disc([x + u, y + v, z], [0, 0, 16384], 0) };
            if radius2 < 1 << 46 {
                assert_eq!(is_blocked(&a, &b, &k), expected, "{u} {v}");
            }
        }
    }
}

#[test]
fn n40_the_discs_of_the_ends_never_block() {
    let mut rng = Rng::with_seed(40);
    for _ in 0..cases(100_000) {
        let size = 1 << rng.u32(2..=22);
        let [a, b] = [0; 2].map(|_| random_disc(&mut rng, size));
        for profile in PROFILES {
            assert!(!blocks(profile, &a, &b, &a) && !blocks(profile, &a, &b, &b));
        }
    }
}

#[test]
fn n42_edge_on_is_not_facing() {
    let a = disc([100; 3], [0, 0, 16384], 10);
    let b = end([5000, 300, 100]);
    assert!(!faces_both(&a, &b) && !faces_both(&b, &a));
    let two_sided = Disc { two_sided: true, ..a };
    assert!(!faces_both(&two_sided, &b) && !faces_both(&b, &two_sided));
    // A step up, and it is.
    let above = end([5000, 300, 101]);
    assert!(faces_both(&a, &above) && faces_both(&above, &a));
}

#[test]
fn n43_a_place_does_not_face_itself() {
    let k = disc([9; 3], [0, 16384, 0], 1000);
    for a in [end([9; 3]), k] {
        assert!(!faces_both(&a, &a));
        check(&a, &a, &k);
        assert!(PROFILES.iter().all(|&profile| !blocks(profile, &a, &a, &k)));
    }
}

#[test]
fn n44_a_verdict_is_the_same_from_both_ends() {
    let mut rng = Rng::with_seed(44);
    for _ in 0..cases(1_000_000) {
        let size = 1 << rng.u32(2..=22);
        let [a, b, k] = [0; 3].map(|_| random_disc(&mut rng, size));
        assert_eq!(faces_both(&a, &b), faces_both(&b, &a));
        for profile in PROFILES {
            assert_eq!(blocks(profile, &a, &b, &k), blocks(profile, &b, &a, &k));
        }
    }
}

#[test]
fn n54_an_occluder_survives_all_rejections() {
    // Across the middle of a segment; then each reason of the paper's Figures 5 and 6 alone.
    let (a, b) = (end([1000, 1000, 0]), end([1000, 1000, 2000]));
    let k = disc([1010, 1000, 1000], [0, 0, 16384], 20);
    assert!(is_blocked(&a, &b, &k));
    let parallel = Disc { normal: [16384, 0, 0], ..k };
    let [before, behind] = [-5, 2005].map(|z| disc([1010, 1000, z], k.normal, 20));
    let aside = disc([1021, 1000, 1000], k.normal, 20);
    for rejected in [parallel, before, behind, aside] {
        assert!(!is_blocked(&a, &b, &rejected), "{rejected:?}");
    }
    // The cell is not met (`paper`), the patch is not (`patch`), an end's own disc is too near.
    let away = Disc { limit: Box3::at([1500; 3]).grown(10), ..k };
    assert!(PROFILES.iter().all(|&profile| !blocks(profile, &a, &b, &away)));
    let wide = Disc { radius2: 1000 * 1000, ..a };
    assert!(blocks(Profile::Paper, &wide, &b, &k) && !blocks(Profile::Patch, &wide, &b, &k));
    check(&wide, &b, &k);
}

/// Cells of `step` around a corner of theirs.
fn cells_around(corner: [i32; 3], step: i32) -> impl Iterator<Item = Box3> {
    (0..8).map(move |i| {
        let min = [0, 1, 2].map(|axis| corner[axis] - step * (i >> axis & 1));
        Box3 { min, max: min.map(|v| v + step) }
    })
}

/// Counts the cells around a corner that a segment meets, as fractions do.
fn n_met(a: [i32; 3], b: [i32; 3], corner: [i32; 3], step: i32) -> usize {
    let met = |cell: &Box3| {
        let d = minus(&vector(b), &vector(a));
        let expected = clip(&vector(a), &d, &vector(cell.min), &vector(cell.max));
        assert_eq!(segment_meets(a, b, cell), expected, "{a:?} {b:?} {cell:?}");
        assert_eq!(segment_meets(b, a, cell), expected, "{a:?} {b:?} {cell:?}");
        expected
    };
    cells_around(corner, step).filter(met).count()
}

/// Collects the cells of level 8 that a segment of the cube meets, by halving from the root down: a
/// cell that is not met has no part that is.
fn cells_met(meets: &dyn Fn(&Box3) -> bool, cell: Box3, met: &mut Vec<[i32; 3]>) {
    let side = cell.max[0] - cell.min[0];
    if !meets(&cell) {
        return;
    }
    if side == SIDE / 256 {
        met.push(cell.min.map(|v| v / side));
        return;
    }
    let half = side / 2;
    for octant in 0..8 {
        let min = [0, 1, 2].map(|axis| cell.min[axis] + half * (octant >> axis & 1));
        cells_met(meets, Box3 { min, max: min.map(|v| v + half) }, met);
    }
}

#[test]
fn n56_random_segments_meet_the_cells_that_fractions_say() {
    // The row counts what a walk by floats misses. Cells are met or not by integers, and nobody
    // walks: the set of 256³ cells is that of fractions, from either end.
    let mut rng = Rng::with_seed(56);
    let root = Box3 { min: [0; 3], max: [SIDE; 3] };
    let mut n_met = 0;
    for _ in 0..cases(400) {
        let [a, b] = [0; 2].map(|_| random_place(&mut rng));
        let d = minus(&vector(b), &vector(a));
        let exact = |cell: &Box3| clip(&vector(a), &d, &vector(cell.min), &vector(cell.max));
        let [mut expected, mut there, mut back] = [const { Vec::new() }; 3];
        cells_met(&exact, root, &mut expected);
        cells_met(&|cell| segment_meets(a, b, cell), root, &mut there);
        cells_met(&|cell| segment_meets(b, a, cell), root, &mut back);
        assert!(there == expected && back == expected, "{a:?} {b:?}");
        n_met += expected.len();
    }
    assert!(n_met > 100 * cases(400), "{n_met}");
}

#[test]
fn n57_a_diagonal_meets_all_cells_that_it_touches() {
    let corner = [1 << 21; 3];
    let (a, b) = (corner.map(|v| v - 100), corner.map(|v| v + 100));
    assert_eq!(n_met(a, b, corner, 1 << 10), 8);
    // A step aside at one end: it misses the vertex.
    let aside = [b[0] + 1, b[1], b[2]];
    assert!((2..8).contains(&n_met(a, aside, corner, 1 << 10)));
}

#[test]
fn n58_in_a_face_both_cells_are_met() {
    let corner = [1 << 20; 3];
    let (a, b) = ([corner[0], corner[1] + 3, corner[2] + 5], [corner[0], corner[1] + 700, 1 << 19]);
    assert_eq!(n_met(a, [b[0], b[1], corner[2] + 9], corner, 1 << 10), 2);
    assert_eq!(n_met(a, b, corner, 1 << 10), 4);
}

#[test]
fn n59_along_an_edge_four_cells_are_met_and_through_a_vertex_eight() {
    let corner = [4096, 8192, 12288];
    let [x, y, z] = corner;
    assert_eq!(n_met([x, y, z + 1], [x, y, z + 900], corner, 1024), 4);
    assert_eq!(n_met([x, y, z - 7], [x, y, z + 900], corner, 1024), 8);
}

#[test]
fn n60_on_the_face_of_a_slab_and_along_it() {
    let cell = Box3 { min: [64; 3], max: [128; 3] };
    for (off, expected) in [(63, false), (64, true), (128, true), (129, false)] {
        assert_eq!(segment_meets([0, 100, off], [500, 100, off], &cell), expected, "{off}");
        // A single place.
        assert_eq!(segment_meets([70, 100, off], [70, 100, off], &cell), expected, "{off}");
    }
}

#[test]
fn n61_a_step_aside_over_the_whole_cube_counts() {
    let mut rng = Rng::with_seed(61);
    let mut n_met = [0; 2];
    for _ in 0..cases(100_000) {
        let y = rng.i32(1..SIDE - 1);
        let (a, b) = ([0, y, 77], [SIDE - 1, y + 1, 77]);
        let x = rng.i32(0..SIDE - 10);
        // It passes the upper face at the far end only.
        let cell = Box3 { min: [x, y + 1, 70], max: [x + 9, y + 5, 80] };
        let d = minus(&vector(b), &vector(a));
        let expected = clip(&vector(a), &d, &vector(cell.min), &vector(cell.max));
        assert_eq!(segment_meets(a, b, &cell), expected);
        let end = Box3 { min: [SIDE - 2 - x.min(5), y + 1, 70], max: [SIDE, y + 5, 80] };
        n_met[usize::from(segment_meets(a, b, &end))] += 1;
    }
    assert_eq!(n_met, [0, cases(100_000)]);
}

#[test]
fn n62_an_end_on_a_boundary_meets_the_cells_on_both_sides() {
    let corner = [1 << 20, 5 << 12, 7 << 13];
    let [x, y, z] = corner;
    let step = 1 << 12;
    // On a corner of eight cells, an edge of four and a face of two, whichever way it leads.
    for sign in [-1, 1] {
        let toward = |d: [i32; 3]| [0, 1, 2].map(|i| corner[i] + sign * d[i]);
        assert_eq!(n_met(corner, toward([900, 500, 100]), corner, step), 8);
        assert_eq!(n_met([x, y, z + 9], toward([-900, -500, 9 * sign]), corner, step), 4);
        let near = [x, y + 50, z + 9];
        assert_eq!(n_met(near, [x - sign * 700, y + 60, z + 11], corner, step), 2);
    }
    // A segment of one place, too.
    assert_eq!(n_met(corner, corner, corner, step), 8);
}

#[test]
fn n65_no_float_decides_whether_a_box_is_met() {
    // The row is about slab tests in floats. A box is met or not by integers; that no float may
    // miss one is what random segments and boxes show, most of which hang on a step.
    let mut rng = Rng::with_seed(65);
    for _ in 0..cases(100_000) {
        let size = 1 << rng.u32(2..=22);
        let [a, b] = [0; 2].map(|_| [0; 3].map(|_| rng.i32(0..size)));
        let at = [0, 1, 2].map(|i| i32::midpoint(a[i], b[i]) + rng.i32(-2..=2));
        let cell = Box3::at(at).grown(rng.i32(0..=2));
        let d = minus(&vector(b), &vector(a));
        let expected = clip(&vector(a), &d, &vector(cell.min), &vector(cell.max));
        assert_eq!(segment_meets(a, b, &cell), expected, "{a:?} {b:?} {cell:?}");
    }
}

#[test]
fn n47_cube_symmetries_change_no_verdict() {
    let mut rng = Rng::with_seed(47);
    let axes = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    for _ in 0..cases(20_000) {
        let size = 1 << rng.u32(2..=22);
        let discs = [0; 3].map(|_| random_disc(&mut rng, size));
        let [a, b, k] = &discs;
        let expected = PROFILES.map(|profile| (blocks(profile, a, b, k), faces_both(a, b)));
        for axes in axes {
            for mirrors in 0..8 {
                let turned = |v: [i32; 3]| {
                    [0, 1, 2].map(|i| v[axes[i]] * if mirrors >> i & 1 == 0 { 1 } else { -1 })
                };
                let turn = |disc: &Disc| {
                    let [p, q] = [disc.limit.min, disc.limit.max].map(turned);
                    let min = [0, 1, 2].map(|i| p[i].min(q[i]));
                    let max = [0, 1, 2].map(|i| p[i].max(q[i]));
                    let normal = turned(disc.normal.map(i32::from)).map(|v| v as i16);
                    let (centroid, limit) = (turned(disc.centroid), Box3 { min, max });
                    let axes = disc.rect.axes.map(|axis| turned(axis.map(i32::from)));
                    let rect = Rect { axes: axes.map(|axis| axis.map(|v| v as i16)), ..disc.rect };
                    Disc { centroid, normal, limit, rect, ..*disc }
                };
                let [a, b, k] = [a, b, k].map(turn);
                let found =
                    PROFILES.map(|profile| (blocks(profile, &a, &b, &k), faces_both(&a, &b)));
                assert_eq!(found, expected, "{axes:?} {mirrors} {a:?} {b:?} {k:?}");
            }
        }
    }
}

/// Turns a vector by a random rotation: three angles about the axes.
fn turned_by(angles: [f64; 3], v: [f64; 3]) -> [f64; 3] {
    let mut v = v;
    for (axis, angle) in angles.into_iter().enumerate() {
        let (sin, cos) = angle.sin_cos();
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        (v[i], v[j]) = (v[i] * cos - v[j] * sin, v[i] * sin + v[j] * cos);
    }
    v
}

/// How far a verdict on three discs is from another, at the least: grid steps from the crossing to
/// the ends, to the planes of facing and to the rim, less what rounding on the grid may move them.
fn margin(a: &Disc, b: &Disc, k: &Disc) -> f64 {
    let real = |v: [i32; 3]| v.map(f64::from);
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    let (ca, cb, ck) = (real(a.centroid), real(b.centroid), real(k.centroid));
    let d = [0, 1, 2].map(|i| cb[i] - ca[i]);
    let n = k.normal.map(|v| f64::from(v) / 16384.0);
    let (s, h) = (dot(n, d), dot(n, [0, 1, 2].map(|i| ck[i] - ca[i])));
    let length = dot(d, d).sqrt();
    let slope = (s / length).abs();
    let t = h / s;
    let x = [0, 1, 2].map(|i| ca[i] + t * d[i]);
    let off = [0, 1, 2].map(|i| x[i] - ck[i]);
    let ends = (t.min(1.0 - t) * length).abs();
    let rim = (dot(off, off).sqrt() - (k.radius2 as f64).sqrt()).abs();
    // A place moves by a step, a normal by 2^-14: over the distance to the disc that moves the
    // crossing along the segment, the more the flatter it is.
    let far = dot(off, off).sqrt().max(length);
    let moved = (3.0 + 4.0 * far / 16384.0) / slope;
    let ok = ends.min(rim) - moved;
    if ok.is_nan() { f64::NEG_INFINITY } else { ok }
}

#[test]
fn n47_rotations_change_a_verdict_only_within_a_step_of_the_grid() {
    let mut rng = Rng::with_seed(470);
    let (mut n_clear, mut n_blocked) = (0, 0);
    let n = cases(100_000);
    for _ in 0..n {
        // Within the ball that the cube holds, so that no rotation leads out.
        let mut place = || [0; 3].map(|_| SIDE / 2 + rng.i32(-SIDE / 4..SIDE / 4));
        let (a, b) = (end(place()), end(place()));
        let n: [f64; 3] = [0; 3].map(|_| rng.f64() - 0.5);
        let middle = [0, 1, 2].map(|i| i32::midpoint(a.centroid[i], b.centroid[i]));
        let aside = middle.map(|v| v + rng.i32(-SIDE / 16..SIDE / 16));
        let length = n.iter().map(|v| v * v).sum::<f64>().sqrt();
        let unit = |n: [f64; 3]| n.map(|v| (v / length * 16384.0).round() as i16);
        let k = disc(aside, unit(n), rng.u64(1..1 << 18));
        if margin(&a, &b, &k) <= 0.0 {
            continue;
        }
        n_clear += 1;
        let expected = is_blocked(&a, &b, &k);
        n_blocked += u32::from(expected);
        let angles = [0; 3].map(|_| rng.f64() * 6.3);
        let half = f64::from(SIDE / 2);
        let turn = |disc: &Disc| {
            let off = disc.centroid.map(|v| f64::from(v) - half);
            let centroid = turned_by(angles, off).map(|v| (v + half).round() as i32);
            Disc { centroid, limit: ANYWHERE, ..*disc }
        };
        let (a, b, k) =
            (turn(&a), turn(&b), Disc { normal: unit(turned_by(angles, n)), ..turn(&k) });
        assert_eq!(is_blocked(&a, &b, &k), expected, "{a:?} {b:?} {k:?}");
    }
    assert!(n_clear > n / 2 && n_blocked > 1000.min(n as u32 / 20), "{n_clear} {n_blocked} of {n}");
}

#[test]
fn n48_a_wider_disc_blocks_no_less() {
    let mut rng = Rng::with_seed(48);
    for _ in 0..cases(100_000) {
        let size = 1 << rng.u32(2..=22);
        let [a, b, k] = [0; 3].map(|_| random_disc(&mut rng, size));
        let wide =
            Disc { radius2: k.radius2 * 2, limit: k.limit.grown(3), rect: k.rect.grown(2), ..k };
        for profile in PROFILES {
            if blocks(profile, &a, &b, &k) {
                assert!(blocks(profile, &a, &b, &wide), "{profile:?} {a:?} {b:?} {k:?}");
                assert!(blocks_by_fractions(profile, &a, &b, &wide));
            }
        }
    }
}
