//! Surfels that are too wide for their points, against their definition.

use fastrand::Rng;
use pvmap_query::exact::ExactOptions;
use pvmap_query::{Map, QueryError, WideSurfels};
use pvmap_vmap::{Shape, Tree};

use crate::common::{About, Cut, Parts, grow, random_points};

fn sealed(tree: &Tree) -> Vec<u8> {
    Parts::new(tree, &[], About::default()).seal()
}

#[test]
fn surfels_are_wide_from_twenty_times_the_side_that_their_points_cover() {
    let mut rng = Rng::with_seed(90);
    let (mut n_none, mut n_at, mut n_few) = (0, 0, 0);
    for _ in 0..200 {
        let points = random_points(&mut rng, 60);
        let cut = Cut { shape: Shape::Binned, leaf_capacity: 8, max_level: 9, few: 50 };
        let mut tree = grow(&points, cut);
        let file = sealed(&tree);
        let spacing = ExactOptions::usual(&Map::open(&file).unwrap()).unwrap().delta_grid();
        // Discs below, at and above the bound, some of them alike.
        let chosen = rng.u8(..4);
        for surfel in &mut tree.surfels {
            let bound2 = 400 * surfel.n_points * u64::from(spacing).pow(2);
            // What a record has room for.
            let bound2 = bound2.min((1 << 48) - 2);
            surfel.radius2 = match rng.u8(..=chosen) {
                0 => bound2,
                1 => bound2 + 1,
                2 => bound2.max(1 << 44),
                _ => bound2 - 1,
            };
            n_at += u32::from(surfel.radius2 == bound2);
        }
        let is_wide = |i: &usize| {
            let surfel = &tree.surfels[*i];
            u128::from(surfel.radius2)
                > 400 * u128::from(surfel.n_points) * u128::from(spacing).pow(2)
        };
        let wide: Vec<usize> = (0..tree.surfels.len()).filter(is_wide).collect();
        let widest = wide.iter().max_by_key(|&&i| (tree.surfels[i].radius2, !i));
        let few = wide.iter().filter(|&&i| tree.surfels[i].n_points < 4).count() as u32;
        let expected = widest.map(|&widest| WideSurfels {
            n: wide.len() as u32,
            n_uncut: few,
            widest: widest as u32,
        });
        let file = sealed(&tree);
        let map = Map::open(&file).unwrap();
        assert_eq!(map.wide_surfels(&|_| true).unwrap(), expected);
        n_none += u32::from(expected.is_none());
        n_few += few;
    }
    assert!(n_none > 20 && n_at > 100 && n_few > 100, "{n_none} {n_at} {n_few}");
}

#[test]
fn whoever_asks_for_wide_surfels_can_stop_and_a_map_of_no_points_has_none() {
    let empty = sealed(&Tree::default());
    assert_eq!(Map::open(&empty).unwrap().wide_surfels(&|_| true).unwrap(), None);
    let points = random_points(&mut Rng::with_seed(91), 40);
    let cut = Cut { shape: Shape::Paper, leaf_capacity: 4, max_level: 9, few: 1 };
    let mut tree = grow(&points, cut);
    let row = tree.surfels[0];
    tree.surfels.resize(1 << 16, row);
    let file = sealed(&tree);
    let asked = Map::open(&file).unwrap().wide_surfels(&|_| false);
    assert_eq!(asked, Err(QueryError::Stopped));
}
