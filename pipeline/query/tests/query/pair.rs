//! `pair` against the links themselves: every leaf pair of random trees. [V-5], [V-6]

use crate::common::{About, Cut, Parts, grow, random_links, random_points, siblings};
use fastrand::Rng;
use pvmap_query::{Link, Located, Map, PairAnswer};
use pvmap_vmap::{Shape, Tree};

fn at(tree: &Tree, surfel: u32) -> Located {
    Located { surfel, node: tree.surfels[surfel as usize].node, distance: 0.0 }
}

/// What every leaf pair must answer, from the links by brute force; row a, column b.
fn answers(tree: &Tree, links: &[(u32, u32)]) -> Vec<PairAnswer> {
    let n = tree.surfels.len();
    let mut table = vec![PairAnswer { visible: false, link: None }; n * n];
    for &(x, y) in links {
        for (x, y) in [(x, y), (y, x)] {
            let (a, b) = (&tree.nodes[x as usize], &tree.nodes[y as usize]);
            let surfels = ((a.first_surfel, a.end_surfel), (b.first_surfel, b.end_surfel));
            let link = Link { nodes: (x, y), n_points: (a.n_points, b.n_points), surfels };
            for s in a.first_surfel..a.end_surfel {
                for t in b.first_surfel..b.end_surfel {
                    let cell = &mut table[s as usize * n + t as usize];
                    assert!(!cell.visible, "the test's links cover a pair twice");
                    *cell = PairAnswer { visible: true, link: Some(link) };
                }
            }
        }
    }
    for s in 0..n {
        table[s * n + s] = PairAnswer { visible: true, link: None };
    }
    table
}

/// Replaces some pairs of siblings by others that cover no more: one side is cut into its
/// children, or the pair is left out.
fn given_pairs(rng: &mut Rng, tree: &Tree) -> Vec<(u32, u32)> {
    let cut = |rng: &mut Rng, (a, b): (u32, u32)| match rng.u8(..4) {
        0 => Vec::new(),
        1 => tree.kids(b).map(|y| (a, y)).collect(),
        2 => tree.kids(a).map(|x| (x, b)).collect(),
        _ => vec![(a, b)],
    };
    let once: Vec<_> = siblings(tree).into_iter().flat_map(|pair| cut(rng, pair)).collect();
    once.into_iter().flat_map(|pair| cut(rng, pair)).collect()
}

#[test]
fn v6_every_leaf_pair_has_the_answer_of_its_link() {
    let mut rng = Rng::with_seed(1);
    let mut n_visible = 0;
    for round in 0..120 {
        let shape = if round % 2 == 0 { Shape::Binned } else { Shape::Paper };
        let cut = Cut {
            shape,
            leaf_capacity: rng.usize(..6),
            max_level: rng.u8(1..=21),
            few: 1 << rng.u32(..20),
        };
        let n_points = rng.usize(2..150);
        let tree = grow(&random_points(&mut rng, n_points), cut);
        let given = round % 3 == 0;
        let starts = if given { given_pairs(&mut rng, &tree) } else { siblings(&tree) };
        let deeper = rng.u8(100..);
        let links = random_links(&mut rng, &tree, &starts, deeper);
        let file = Parts::new(&tree, &links, About { given, ..About::default() }).seal();
        let map = Map::open(&file).unwrap();
        assert_eq!(map.view().verify(), Ok(()));

        let n = tree.surfels.len() as u32;
        let table = answers(&tree, &links);
        let questions: Vec<(Located, Located)> =
            (0..n * n).map(|i| (at(&tree, i / n), at(&tree, i % n))).collect();
        let expected: Vec<_> = table.iter().map(|&answer| Ok(answer)).collect();
        assert_eq!(map.pairs(&questions), expected, "round {round}, all at once");
        for (answer, (a, b)) in table.iter().copied().zip(questions.iter().copied()) {
            assert_eq!(map.pair(&a, &b), Ok(answer), "round {round}, surfels {a:?} {b:?}");
            n_visible += u32::from(answer.visible);
        }
        assert_eq!(map.keep(1 << 30), Ok(true));
        assert_eq!(map.pairs(&questions), expected, "round {round}, from memory");
    }
    assert!(n_visible > 10_000, "the random maps say nothing: {n_visible} visible pairs");
}

#[test]
fn d11_frames_beyond_the_cache_are_decoded_again() {
    let mut rng = Rng::with_seed(2);
    let cut = Cut { shape: Shape::Paper, leaf_capacity: 0, max_level: 21, few: 1 };
    let tree = grow(&random_points(&mut rng, 500), cut);
    let links = random_links(&mut rng, &tree, &siblings(&tree), 255);
    let file = Parts::new(&tree, &links, About { links_per_frame: 12, ..About::default() }).seal();
    let map = Map::open(&file).unwrap();
    assert!(map.view().links().n_blocks() > 2400, "twice the frames that are kept");
    std::thread::scope(|scope| {
        for thread in 0..4 {
            let (map, tree, links) = (&map, &tree, &links);
            scope.spawn(move || {
                let mut rng = Rng::with_seed(thread);
                for _ in 0..20_000 {
                    let (x, y) = links[rng.usize(..links.len())];
                    let leaf = |id: u32| tree.nodes[id as usize].first_surfel;
                    let answer = map.pair(&at(tree, leaf(y)), &at(tree, leaf(x))).unwrap();
                    assert_eq!(answer.link.unwrap().nodes, (y, x));
                }
            });
        }
    });
}
