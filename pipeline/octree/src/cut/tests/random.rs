//! Thousands of random clouds: the cut is the slow obvious one whatever memory it has, and every
//! point routes to the leaf that counted it.

use fastrand::Rng;
use pvmap_geometry::disc::Profile;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::normal::{Normal, quantise};
use pvmap_store::Quiet;
use pvmap_vmap::Router;
use pvmap_vmap::tree::route;
use pvmap_vmap::{OctreeView, Shape, Spacing, Tree};

use super::octree_file::{key_of, octree_file};
use super::oracle::cut_slowly;
use super::{PLENTY, TestPoint, points_within};
use crate::cut::{CutOptions, cut};

const N_CLOUDS: u64 = 3000;
/// The colour depths of the three sources.
const DEPTHS: [u32; 3] = [0, 8, 16];

#[test]
fn any_cloud_is_cut_as_the_slow_way_cuts_it() {
    for seed in 0..N_CLOUDS {
        let mut rng = Rng::with_seed(seed);
        let cloud = random_cloud(&mut rng);
        let bytes = octree_file(&cloud, &DEPTHS);
        let octree = OctreeView::open(&bytes).expect("a sound file");
        if seed < 100 {
            octree.verify().expect("a sound file");
        }
        for options in random_options(&mut rng) {
            let expected = cut_slowly(&cloud, &DEPTHS, &options);
            for memory_bytes in [0, 3 << 10, 20 << 10, PLENTY] {
                let found = cut(&octree, &options, points_within(memory_bytes), &Quiet);
                let found = found.expect("a sound octree");
                assert_eq!(found, expected, "seed {seed}, {options:?}, {memory_bytes} bytes");
            }
            check_routes(&cloud, &expected);
        }
    }
}

/// Counts the points that route to each leaf.
pub(super) fn check_routes(cloud: &[TestPoint], tree: &Tree) {
    let mut n_routed = vec![0; tree.nodes.len()];
    let mut router = Router::new(tree);
    for point in cloud {
        let Ok(leaf) = route(tree, &key_of(point));
        let leaf = leaf.expect("a leaf for every point") as usize;
        n_routed[leaf] += 1;
        // What remembers the leaf before answers alike.
        assert_eq!(router.surfel_of(&key_of(point)), Ok(Some(tree.nodes[leaf].first_surfel)));
    }
    for surfel in &tree.surfels {
        assert_eq!(n_routed[surfel.node as usize], surfel.n_points);
    }
    let n_counted: u64 = tree.surfels.iter().map(|s| s.n_points).sum();
    assert_eq!(n_counted, cloud.len() as u64);
}

/// All shapes and profiles at a random capacity and level.
fn random_options(rng: &mut Rng) -> impl Iterator<Item = CutOptions> {
    let max_level = if rng.u8(..7) == 0 { 21 } else { rng.u8(1..=6) };
    // Only leaves of four points and more can be spread.
    let max_spread = [0, 1, 3][rng.usize(..3)];
    let leaf_capacity = rng.u64(0..=if max_spread > 0 { 20 } else { 5 });
    let spacing = if rng.bool() { Spacing::Leaf } else { Spacing::Neighbors };
    let both = [Shape::Paper, Shape::Binned];
    both.into_iter().flat_map(move |shape| {
        [Profile::Paper, Profile::Patch, Profile::Oriented].map(|profile| CutOptions {
            max_level,
            leaf_capacity,
            max_spread,
            shape,
            profile,
            spacing,
        })
    })
}

fn random_cloud(rng: &mut Rng) -> Vec<TestPoint> {
    let n_points = match rng.u8(..4) {
        0 => rng.usize(0..4),
        1 => rng.usize(0..20),
        _ => rng.usize(0..120),
    };
    // A few steps give coincident points; a far corner gives deep cells.
    let side = 1u32 << [1, 2, 4, 8, 16, 21, 22][rng.usize(..7)];
    let corner = [0; 3].map(|_| if rng.bool() { 0 } else { rng.u32(..=GRID_MAX - (side - 1)) });
    let style = rng.u8(..6);
    let main = random_direction(rng);
    let mut one = |_| {
        let (normal, oriented) = random_normal(rng, style, main);
        let source = rng.u32(..3);
        let full = if source == 1 { 255 } else { u16::MAX };
        TestPoint {
            g: corner.map(|c| c + rng.u32(..side)),
            normal,
            oriented,
            color: [0; 3].map(|_| rng.u16(..=full)),
            source,
        }
    };
    (0..n_points).map(&mut one).collect()
}

/// Styles: none, known side, unknown side, all three, the faces of a thin wall, near one direction.
fn random_normal(rng: &mut Rng, style: u8, main: Normal) -> (Normal, bool) {
    match style {
        0 => ([0; 3], false),
        1 => (random_direction(rng), true),
        2 => (random_direction(rng), false),
        3 if rng.u8(..4) == 0 => ([0; 3], false),
        3 => (random_direction(rng), rng.bool()),
        4 if rng.bool() => (main, true),
        4 => (main.map(|c| -c), true),
        _ => {
            let near = main.map(|c| f32::from(c) + (rng.f32() - 0.5) * 16384.0);
            (quantise(near).unwrap_or(main), rng.u8(..4) > 0)
        }
    }
}

/// Along an axis, with equal components, anywhere, or shorter than a normal should be.
fn random_direction(rng: &mut Rng) -> Normal {
    loop {
        let n = match rng.u8(..4) {
            0 => [0; 3].map(|_| f32::from(rng.i8(-1..=1))),
            1 => return [0; 3].map(|_| rng.i16(1..4) * if rng.bool() { 1 } else { -1 }),
            _ => [0; 3].map(|_| rng.f32() - 0.5),
        };
        if let Some(n) = quantise(n) {
            return n;
        }
    }
}
