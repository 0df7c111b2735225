//! Rows N06…N53 of the numeric catalogue, where they concern leaves.

use fastrand::Rng;
use pvmap_geometry::disc::{Disc, Profile, blocks, faces_both};
use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::normal::NORMAL_LENGTH;
use pvmap_geometry::{Box3, GridPoint, Rect, morton};
use pvmap_vmap::tree::disc_of;
use pvmap_vmap::{Shape, Split, Surfel, Tree};

use super::oracle::cut_slowly;
use super::{CutOptions, TestPoint, cut_cloud, cut_within, options};

const SHAPES: [Shape; 2] = [Shape::Paper, Shape::Binned];
const UP: [i16; 3] = [0, 0, NORMAL_LENGTH as i16];
const DOWN: [i16; 3] = [0, 0, -NORMAL_LENGTH as i16];

fn check(cloud: &[TestPoint], options: &CutOptions) -> Tree {
    let tree = cut_cloud(cloud, options);
    assert_eq!(tree, cut_slowly(cloud, &[8], options), "{options:?}");
    tree
}

fn is_slow_run() -> bool {
    std::env::var_os("PVMAP_SLOW_TESTS").is_some()
}

/// Points on a square grid at z, facing `normal`.
fn sheet(n_side: u32, step: u32, z: u32, normal: [i16; 3]) -> Vec<TestPoint> {
    let places = (0..n_side * n_side).map(|i| [i % n_side * step, i / n_side * step, z]);
    places.map(|g| TestPoint::at(g).facing(normal)).collect()
}

#[test]
fn n06_copies_beyond_the_capacity_end_at_the_last_level() {
    // A million where slow tests are asked for. No flag says that the leaf is overfull: that it has
    // more points than `leaf_capacity` does.
    let k = if is_slow_run() { 1_000_000 } else { 100_000 };
    let cloud = vec![TestPoint::at([77, 1 << 20, GRID_MAX]).facing(UP); k];
    for shape in SHAPES {
        for memory_bytes in [0, 1 << 20, 1 << 30] {
            let tree = cut_within(&cloud, &options(shape, 21, 50), memory_bytes);
            let n_bins = tree.nodes.iter().filter(|n| n.split == Split::Bins).count();
            assert_eq!((tree.nodes.len() - n_bins, tree.surfels.len()), (22, 1));
            assert_eq!(tree.surfels[0].n_points, k as u64);
            assert_eq!(tree.surfels[0].centroid, [77, 1 << 20, GRID_MAX]);
        }
    }
}

#[test]
fn n07_equal_points_are_one_leaf_of_radius_zero() {
    for shape in SHAPES {
        let options = CutOptions { profile: Profile::Paper, ..options(shape, 8, 50) };
        let tree = check(&[TestPoint::at([0; 3]); 7], &options);
        assert_eq!((tree.surfels.len(), tree.surfels[0].radius2), (1, 0));
    }
}

#[test]
fn n08_no_point_gives_no_node_and_one_point_one_leaf() {
    for shape in SHAPES {
        let options = options(shape, 8, 50);
        assert_eq!(check(&[], &options), Tree::default());
        let tree = check(&[TestPoint::at([5; 3]).facing(DOWN)], &options);
        let splits: Vec<Split> = tree.nodes.iter().map(|n| n.split).collect();
        match shape {
            Shape::Paper => assert_eq!(splits, [Split::Leaf]),
            Shape::Binned => assert_eq!(splits, [Split::Bins, Split::Leaf]),
        }
        assert_eq!(tree.surfels[0].bin, if shape == Shape::Paper { -1 } else { 5 });
    }
}

#[test]
fn n09_a_line_is_cut_as_brute_force_does() {
    // Two extents are zero: along an axis, then across a face of the cube and all of it.
    for step in [[0, 0, 1], [0, 1, 1], [1, 1, 1]] {
        let place = |i: u32| step.map(|s: u32| s * (i * 10_007 % (GRID_MAX + 1)));
        let cloud: Vec<_> = (0..400).map(|i| TestPoint::at(place(i)).facing(UP)).collect();
        for shape in SHAPES {
            assert!(check(&cloud, &options(shape, 21, 3)).surfels.len() > 100);
        }
    }
}

#[test]
fn n10_a_sheet_in_a_cell_face_is_in_the_upper_cells() {
    let z = 1 << 20;
    for shape in SHAPES {
        let tree = check(&sheet(40, 100_000, z, UP), &options(shape, 6, 1));
        for surfel in &tree.surfels {
            assert!(surfel.level >= 2);
            assert_eq!(surfel.cell().min[2], z as i32);
        }
    }
}

#[test]
fn n11_the_far_corner_is_in_the_last_cell() {
    let cloud = [[0; 3], [GRID_MAX; 3]].map(|g| TestPoint::at(g).facing(UP));
    for shape in SHAPES {
        for max_level in [1, 8, 21] {
            let tree = check(&cloud, &options(shape, max_level, 1));
            let far = tree.surfels.last().expect("two leaves");
            let last = (1u64 << 63) - 1;
            assert!(morton::cell_range(far.first_code, far.level).contains(&last));
        }
    }
}

#[test]
fn n21_copies_far_out_have_themselves_as_centroid() {
    let g = [GRID_MAX, 4_100_003, 1];
    for n in [1, 2, 3, 7, 1000] {
        for shape in SHAPES {
            let tree = check(&vec![TestPoint::at(g).facing(UP); n], &options(shape, 3, 0));
            assert_eq!(tree.surfels[0].centroid, g);
        }
    }
    // The row's million; sums of integers have no digits to lose.
    let n = if is_slow_run() { 1_000_000 } else { 100_000 };
    let tree = cut_cloud(&vec![TestPoint::at(g).facing(UP); n], &options(Shape::Paper, 3, 0));
    assert_eq!((tree.surfels[0].centroid, tree.surfels[0].n_points), (g, n as u64));
}

#[test]
fn n22_a_centroid_lies_in_its_own_cell() {
    // Points that hug the upper faces of cells of 64 steps, and those of the cells above them.
    let mut rng = Rng::with_seed(22);
    let hug = |rng: &mut Rng| (rng.u32(1..40) * 64 + rng.u32(..2)) - 1;
    let point = |rng: &mut Rng| TestPoint::at([0; 3].map(|_| hug(rng))).facing(UP);
    let cloud: Vec<TestPoint> = (0..3000).map(|_| point(&mut rng)).collect();
    for shape in SHAPES {
        let tree = check(&cloud, &options(shape, 16, 1));
        for s in &tree.surfels {
            let cell = morton::cell_range(s.first_code, s.level);
            assert!(cell.contains(&morton::encode(s.centroid)));
        }
    }
}

#[test]
fn n23_a_lone_point_blocks_within_its_half_spacing() {
    // Sheets of 4x4 points 64 steps apart give h = isqrt(193·193/16) div 2 = 24.
    let mut cloud = sheet(4, 64, 0, UP);
    let lone = [2_000_000, 2_000_000, 2_000_000];
    cloud.push(TestPoint::at(lone).facing(UP));
    let tree = check(&cloud, &options(Shape::Binned, 8, 16));
    let surfel = *tree.surfels.last().expect("the lone point");
    assert_eq!((surfel.n_points, surfel.half_spacing, surfel.radius2), (1, 24, 576));
    for (away, is_hit) in [(0, true), (24, true), (25, false)] {
        assert_eq!(blocks_a_vertical_line(&surfel, away), is_hit, "{away}");
    }
    let paper = CutOptions { profile: Profile::Paper, ..options(Shape::Binned, 8, 16) };
    assert_eq!(check(&cloud, &paper).surfels.last().expect("one").radius2, 0);
}

/// Does the surfel stand between two places above and below it, so many steps along x away?
fn blocks_a_vertical_line(surfel: &Surfel, away: u32) -> bool {
    let end = |dz: i32| {
        let c = surfel.centroid.map(|v| v as i32);
        Disc {
            centroid: [c[0] + away as i32, c[1], c[2] + dz],
            normal: [0; 3],
            two_sided: false,
            radius2: 0,
            limit: Box3::EMPTY,
            rect: Rect::NONE,
        }
    };
    let profile = Profile::Patch;
    blocks(profile, &end(-1000), &end(1000), &disc_of(surfel, None, profile))
}

#[test]
fn n24_duplicates_have_radius_zero_then_half_spacing() {
    let cloud = vec![TestPoint::at([1001, 7, 65_537]).facing(UP); 50];
    for shape in SHAPES {
        let paper = CutOptions { profile: Profile::Paper, ..options(shape, 8, 50) };
        assert_eq!(check(&cloud, &paper).surfels[0].radius2, 0);
        // Sides of one step: h = max(1, 0).
        assert_eq!(check(&cloud, &options(shape, 8, 50)).surfels[0].radius2, 1);
    }
}

#[test]
fn n27_a_thin_wall_is_two_sided() {
    let mut cloud = sheet(5, 10, 100, UP);
    cloud.extend(sheet(5, 10, 101, DOWN));
    let tree = check(&cloud, &options(Shape::Paper, 8, 50));
    assert_eq!(tree.surfels.len(), 1);
    assert_eq!((tree.surfels[0].normal, tree.surfels[0].two_sided), (UP, true));
    // It blocks from either side what a wall of one side would, and is seen from both.
    for normal in [UP, DOWN] {
        let one_sided = check(&sheet(5, 10, 100, normal), &options(Shape::Paper, 8, 50));
        for away in [0, 10, 20, 30, 100] {
            let expected = blocks_a_vertical_line(&one_sided.surfels[0], away);
            assert_eq!(blocks_a_vertical_line(&tree.surfels[0], away), expected, "{away}");
            assert_eq!(expected, away <= 20, "{away}");
        }
        let wall = disc_of(&tree.surfels[0], None, Profile::Patch);
        let [x, y, z] = wall.centroid;
        let eye = Disc { normal: [0; 3], centroid: [x, y, z + 50 * i32::from(normal[2])], ..wall };
        assert!(faces_both(&eye, &wall) && faces_both(&wall, &eye));
    }
    // Bins keep the faces apart.
    let tree = check(&cloud, &options(Shape::Binned, 8, 50));
    let faces: Vec<_> = tree.surfels.iter().map(|s| (s.normal, s.two_sided)).collect();
    assert_eq!(faces, [(UP, false), (DOWN, false)]);
}

#[test]
fn n30_signs_of_unoriented_normals_change_nothing() {
    let mut rng = Rng::with_seed(30);
    let direction = |rng: &mut Rng| [0; 3].map(|_| rng.i16(-9000..=9000));
    let place = |rng: &mut Rng| -> GridPoint { [0; 3].map(|_| rng.u32(..1 << 12)) };
    let cloud: Vec<TestPoint> =
        (0..400).map(|_| TestPoint::at(place(&mut rng)).two_sided(direction(&mut rng))).collect();
    let flipped: Vec<TestPoint> = cloud
        .iter()
        .map(|p| match rng.bool() {
            true => p.two_sided(p.normal.map(|c| -c)),
            false => *p,
        })
        .collect();
    for shape in SHAPES {
        let options = options(shape, 12, 6);
        let tree = check(&cloud, &options);
        assert_eq!(tree, cut_cloud(&flipped, &options));
        assert!(tree.surfels.iter().all(|s| s.two_sided && s.normal != [0; 3]));
    }
}

#[test]
fn n31_foliage_is_a_disc_of_two_sides() {
    // The row wants a ball. A surfel is a disc whatever its points are; in a leaf of the plain tree
    // whose normals look everywhere DESIGN's canonical sum gives it one, and both its sides count.
    let mut rng = Rng::with_seed(31);
    let mut cloud = Vec::new();
    for _ in 0..200 {
        let normal = [0; 3].map(|_| rng.i16(-9000..=9000));
        for normal in [normal, normal.map(|c| -c)] {
            cloud.push(TestPoint::at([0; 3].map(|_| rng.u32(..500))).facing(normal));
        }
    }
    let tree = check(&cloud, &options(Shape::Paper, 8, 1000));
    assert_eq!(tree.surfels.len(), 1);
    assert!(tree.surfels[0].two_sided && tree.surfels[0].normal != [0; 3]);
    // Bins and quadrants part them first: what is left looks one way and has one side.
    let tree = check(&cloud, &options(Shape::Binned, 8, 1000));
    assert!(tree.surfels.len() > 6);
    assert!(tree.surfels.iter().all(|s| !s.two_sided && s.normal != [0; 3]));
}

#[test]
fn n34_no_disc_is_wider_than_its_cell() {
    // Two points of one normal in far corners of a cell, and two who are alone.
    let mut cloud = vec![TestPoint::at([0; 3]).facing(UP), TestPoint::at([4000; 3]).facing(UP)];
    cloud.push(TestPoint::at([1 << 21, 0, 0]).facing(UP));
    cloud.push(TestPoint::at([GRID_MAX; 3]).facing(UP));
    for shape in SHAPES {
        for max_level in [8, 9, 10] {
            let tree = check(&cloud, &options(shape, max_level, 2));
            for surfel in &tree.surfels {
                let side = u64::from(GRID_MAX + 1) >> surfel.level;
                let h = u64::from(surfel.half_spacing);
                assert!(surfel.radius2 <= (3 * side * side).max(h * h), "{surfel:?}");
                let (patch, cell) = (surfel.patch, surfel.cell().grown(h as i32));
                assert_eq!(patch.meet(&cell), patch, "{surfel:?}");
            }
        }
    }
}

#[test]
fn n32_the_order_of_coincident_points_changes_nothing() {
    let mut rng = Rng::with_seed(32);
    let mut cloud: Vec<TestPoint> = (0..300)
        .map(|_| TestPoint {
            g: [0; 3].map(|_| rng.u32(..6)),
            normal: [0; 3].map(|_| rng.i16(-9000..=9000)),
            oriented: rng.bool(),
            color: [0; 3].map(|_| rng.u16(..256)),
            source: 0,
        })
        .collect();
    for shape in SHAPES {
        let options = options(shape, 21, 5);
        let tree = check(&cloud, &options);
        for _ in 0..100 {
            rng.shuffle(&mut cloud);
            assert_eq!(cut_cloud(&cloud, &options), tree);
        }
    }
}

#[test]
fn n52_leaves_of_level_2_and_20_follow_one_rule() {
    // Cells of level 20 are 4 steps wide, those of level 2 2^20.
    let places = [
        [0, 0, 0],
        [1 << 20, 0, 0],
        [3 << 20, 3 << 20, 3 << 20],
        [(3 << 20) + 4, 3 << 20, 3 << 20],
    ];
    let cloud = places.map(|g| TestPoint::at(g).facing(UP));
    for shape in SHAPES {
        let tree = check(&cloud, &options(shape, 21, 1));
        let levels: Vec<u8> = tree.surfels.iter().map(|s| s.level).collect();
        assert_eq!(levels, [2, 2, 20, 20]);
    }
}

#[test]
fn n53_a_root_may_be_the_one_leaf() {
    let tree = check(&sheet(5, 10, 0, UP), &options(Shape::Paper, 8, 50));
    assert_eq!((tree.nodes.len(), tree.surfels.len()), (1, 1));
    assert!(tree.nodes[0].is_leaf());
    assert_eq!(tree.nodes[0].end_surfel, 1);
}

#[test]
fn stray_normals_split_a_leaf_into_quadrants() {
    // 45° to both sides of +z about y: each is 45° from the sum.
    let tilt = |x: i16| [x, 0, 11585];
    let cloud = [
        TestPoint::at([1, 1, 1]).facing(tilt(11584)),
        TestPoint::at([2, 1, 1]).facing(tilt(-11584)),
    ];
    let tree = check(&cloud, &options(Shape::Binned, 8, 50));
    let splits: Vec<(Split, u8)> = tree.nodes.iter().map(|n| (n.split, n.slot)).collect();
    let quadrants = [(Split::Leaf, 0), (Split::Leaf, 1)];
    assert_eq!(splits[..2], [(Split::Bins, 0), (Split::Quadrants, 4)]);
    assert_eq!(splits[2..], quadrants);
    assert!(tree.nodes[1..].iter().all(|n| n.level == 0 && n.bin == 4));
}
