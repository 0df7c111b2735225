//! Rows N35…N65 of the numeric catalogue, where they concern two ends and what is between them.

use fastrand::Rng;
use pvmap_geometry::bounds::Box3;
use pvmap_geometry::disc::{Disc, Profile, blocks, faces_both, segment_meets};

use crate::oracle::{blocks_by_fractions, check, clip, minus, vector};
use crate::{SIDE, cases, random_disc};

const PROFILES: [Profile; 2] = [Profile::Paper, Profile::Patch];
/// No box limits it.
const ANYWHERE: Box3 = Box3 { min: [-SIDE; 3], max: [2 * SIDE; 3] };

/// A surfel of no size that looks everywhere.
fn end(centroid: [i32; 3]) -> Disc {
    Disc { centroid, normal: [0; 3], two_sided: true, radius2: 0, limit: Box3::at(centroid) }
}

fn disc(centroid: [i32; 3], normal: [i16; 3], radius: u64) -> Disc {
    Disc { centroid, normal, two_sided: false, radius2: radius * radius, limit: ANYWHERE }
}

/// Says whether a disc blocks, which both profiles and fractions must agree on.
fn is_blocked(a: &Disc, b: &Disc, k: &Disc) -> bool {
    check(a, b, k);
    let [paper, patch] = PROFILES.map(|profile| blocks(profile, a, b, k));
    assert_eq!(paper, patch, "{a:?} {b:?} {k:?}");
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
                    Disc { centroid, normal, limit, ..*disc }
                };
                let [a, b, k] = [a, b, k].map(turn);
                let found =
                    PROFILES.map(|profile| (blocks(profile, &a, &b, &k), faces_both(&a, &b)));
                assert_eq!(found, expected, "{axes:?} {mirrors} {a:?} {b:?} {k:?}");
            }
        }
    }
}

#[test]
fn n48_a_wider_disc_blocks_no_less() {
    let mut rng = Rng::with_seed(48);
    for _ in 0..cases(100_000) {
        let size = 1 << rng.u32(2..=22);
        let [a, b, k] = [0; 3].map(|_| random_disc(&mut rng, size));
        let wide = Disc { radius2: k.radius2 * 2, limit: k.limit.grown(3), ..k };
        for profile in PROFILES {
            if blocks(profile, &a, &b, &k) {
                assert!(blocks(profile, &a, &b, &wide), "{profile:?} {a:?} {b:?} {k:?}");
                assert!(blocks_by_fractions(profile, &a, &b, &wide));
            }
        }
    }
}
