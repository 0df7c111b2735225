//! `visible_from` and `sees_counts` against every leaf pair.

use fastrand::Rng;
use pvmap_query::{Light, Located, Map, QueryError, SurfelSet};
use pvmap_vmap::container::BLOCK_BYTES;
use pvmap_vmap::{Shape, Tree};

use crate::common::{About, Cut, Parts, grow, random_links, random_points, siblings};
use crate::sound::maps;

fn at(tree: &Tree, surfel: u32) -> Located {
    Located { surfel, node: tree.surfels[surfel as usize].node, distance: 0.0 }
}

fn ids(set: &SurfelSet) -> Vec<u32> {
    set.ids().collect()
}

#[test]
fn v5_what_a_leaf_sees_is_what_the_predicates_say() {
    let (mut n_seen, mut n_hidden) = (0, 0);
    for sound in maps(21, 24) {
        let map = Map::open(&sound.file).unwrap();
        assert_eq!(map.view().verify(), Ok(()));
        assert_eq!(map.sees_counts(&|| false), Err(QueryError::Stopped));
        let counts = map.sees_counts(&|| true).unwrap();
        for a in 0..sound.n_surfels() {
            if a == sound.n_surfels() / 2 {
                assert_eq!(map.keep(1 << 30), Ok(true));
            }
            let found = map.visible_from(&at(&sound.tree, a)).unwrap();
            let expected: Vec<u32> = (0..sound.n_surfels()).filter(|&b| sound.sees(a, b)).collect();
            assert_eq!(ids(&found.surfels), expected, "surfel {a}");
            assert_eq!(found.surfels.len(), counts[a as usize] + 1, "surfel {a}");
            let points = |&b: &u32| sound.tree.surfels[b as usize].n_points;
            assert_eq!(found.n_points, expected.iter().map(points).sum::<u64>());
            n_seen += expected.len();
            n_hidden += sound.n_surfels() as usize - expected.len();
        }
    }
    assert!(n_seen > 100_000 && n_hidden > 100_000, "{n_seen} seen, {n_hidden} hidden");
}

#[test]
fn v5_what_a_leaf_sees_is_what_its_links_cover() {
    let mut rng = Rng::with_seed(22);
    for round in 0..60 {
        let shape = if round % 2 == 0 { Shape::Binned } else { Shape::Paper };
        let leaf_capacity = rng.usize(..6);
        let cut = Cut { shape, leaf_capacity, max_level: rng.u8(1..=21), few: 1 << rng.u32(..20) };
        let mut tree = grow(&random_points(&mut rng, 120), cut);
        // These links know nothing of facing: nor may the surfels.
        tree.surfels.iter_mut().for_each(|s| s.two_sided = true);
        let given = round % 3 == 0;
        let deeper = rng.u8(100..);
        let links = random_links(&mut rng, &tree, &siblings(&tree), deeper);
        let links_per_frame = rng.usize(1..60);
        let about = About { given, links_per_frame, ..About::default() };
        let file = Parts::new(&tree, &links, about).seal();
        let map = Map::open(&file).unwrap();
        let counts = map.sees_counts(&|| true).unwrap();
        let n = tree.surfels.len() as u32;
        for a in 0..n {
            if a == n / 2 {
                assert_eq!(map.keep(1 << 30), Ok(true));
            }
            let found = map.visible_from(&at(&tree, a)).unwrap().surfels;
            let sees = |b: u32| map.pair(&at(&tree, a), &at(&tree, b)).unwrap().visible;
            assert_eq!(ids(&found), (0..n).filter(|&b| sees(b)).collect::<Vec<_>>(), "{round}");
            assert_eq!(found.len(), counts[a as usize] + 1);
        }
    }
}

/// So many leaves that a walk over all of them goes on by several threads.
#[test]
fn v5_walks_over_large_trees_find_what_pairs_find() {
    let mut rng = Rng::with_seed(25);
    let cut = Cut { shape: Shape::Binned, leaf_capacity: 1, max_level: 21, few: 100 };
    let mut tree = grow(&random_points(&mut rng, 20_000), cut);
    tree.surfels.iter_mut().for_each(|s| s.two_sided = true);
    let links = random_links(&mut rng, &tree, &siblings(&tree), 165);
    let file = Parts::new(&tree, &links, About::default()).seal();
    let map = Map::open(&file).unwrap();
    let n = tree.surfels.len() as u32;
    assert!(n > 10_000, "{n} leaves");
    // A pair needs a few blocks of many.
    let n_blocks = (file.len() / BLOCK_BYTES as usize) as u64;
    let before = map.view().file().n_blocks_read();
    map.pair(&at(&tree, 0), &at(&tree, n / 2)).unwrap();
    let n_read = map.view().file().n_blocks_read() - before;
    assert!(0 < n_read && 4 * n_read < n_blocks, "{n_read} of {n_blocks}");
    let asked: Vec<u32> = (0..12).map(|_| rng.u32(..n)).collect();
    let found: Vec<SurfelSet> =
        asked.iter().map(|&a| map.visible_from(&at(&tree, a)).unwrap().surfels).collect();
    assert_eq!(map.keep(1 << 30), Ok(true));
    let light: Vec<(u32, u64)> = (0..n).map(|b| (b, tree.surfels[b as usize].n_points)).collect();
    let n_points: u64 = light.iter().map(|l| l.1).sum();
    let light = map.light_source(&Light::Points(&light)).unwrap();
    for (&a, found) in asked.iter().zip(found) {
        let sees = |b: &u32| map.pair(&at(&tree, a), &at(&tree, *b)).unwrap().visible;
        let expected: Vec<u32> = (0..n).filter(sees).collect();
        assert_eq!(ids(&found), expected, "{a}");
        let shadow = map.shadow(&at(&tree, a), &Light::Source(&light)).unwrap();
        let seen: u64 = expected.iter().map(|&b| tree.surfels[b as usize].n_points).sum();
        assert!((shadow.reaches.share() - seen as f64 / n_points as f64).abs() < 1e-9, "{a}");
    }
}

#[test]
fn d11_what_the_first_leaf_sees_is_in_the_frames_of_the_nodes_over_it() {
    let mut rng = Rng::with_seed(23);
    let cut = Cut { shape: Shape::Paper, leaf_capacity: 0, max_level: 21, few: 1 };
    let tree = grow(&random_points(&mut rng, 500), cut);
    let links = random_links(&mut rng, &tree, &siblings(&tree), 255);
    let file = Parts::new(&tree, &links, About { links_per_frame: 12, ..About::default() }).seal();
    let map = Map::open(&file).unwrap();
    let leaf = at(&tree, 0);
    let over: Vec<u32> = (0..=leaf.node).collect();
    let needed = links.chunks(12).filter(|c| c.iter().any(|l| over.contains(&l.0))).count() as u64;
    assert!(map.view().links().n_blocks() > 20 * needed, "{needed}");
    map.visible_from(&leaf).unwrap();
    assert!(map.n_frames_decoded() <= needed, "{} of {needed}", map.n_frames_decoded());
    assert!(map.view().file().n_blocks_read() > 0);
}

#[test]
fn a_place_of_another_map_is_refused() {
    let sound = maps(24, 1).next().unwrap();
    let map = Map::open(&sound.file).unwrap();
    for (surfel, node) in [(0, 0), (1, sound.tree.surfels[0].node), (u32::MAX, u32::MAX)] {
        let strange = Located { surfel, node, distance: 0.0 };
        assert!(map.visible_from(&strange).is_err(), "{strange:?}");
        for keeps in [false, true] {
            assert!(!keeps || map.keep(1 << 30).unwrap());
            assert!(map.pair(&strange, &at(&sound.tree, 2)).is_err(), "{strange:?}");
            assert!(map.pair(&at(&sound.tree, 2), &strange).is_err(), "{strange:?}");
        }
    }
}
