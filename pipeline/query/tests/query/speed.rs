//! How fast warm answers are: a small run as a test, the real one with `PVMAP_SLOW_TESTS=1`:
//! `PVMAP_SLOW_TESTS=1 cargo test --release -p pvmap-query speed -- --nocapture`.

use std::time::Instant;

use fastrand::Rng;
use pvmap_query::{Located, Map, Place, Snap};
use pvmap_vmap::{Shape, Tree};

use crate::common::{About, Cut, Parts, frame, grow, random_links, random_points, siblings};

#[test]
fn speed_of_warm_answers() {
    let slow = std::env::var_os("PVMAP_SLOW_TESTS").is_some();
    let (n_points, n_asked) = if slow { (50_000, 1_000_000) } else { (500, 1_000) };
    let mut rng = Rng::with_seed(10);
    let cut = Cut { shape: Shape::Binned, leaf_capacity: 1, max_level: 8, few: 100 };
    let tree = grow(&random_points(&mut rng, n_points), cut);
    let links = random_links(&mut rng, &tree, &siblings(&tree), 165);
    let file = Parts::new(&tree, &links, About::default()).seal();
    let map = Map::open(&file).unwrap();
    let n_blocks = map.view().n_link_blocks();
    println!("{} leaves, {} links in {n_blocks} frames", tree.surfels.len(), links.len());

    let pairs: Vec<[u32; 2]> =
        (0..n_asked).map(|_| [0; 2].map(|_| rng.u32(..tree.surfels.len() as u32))).collect();
    let ask = |[a, b]: [u32; 2]| map.pair(&at(&tree, a), &at(&tree, b)).unwrap().visible;
    let n_visible = pairs.iter().filter(|&&pair| ask(pair)).count();
    let warm = rate(n_asked, || assert_eq!(pairs.iter().filter(|&&p| ask(p)).count(), n_visible));
    println!("pair: {n_visible} of {n_asked} visible, {:.2} M/s warm", warm / 1e6);

    for with_normal in [true, false] {
        let places: Vec<Place> = pairs
            .iter()
            .map(|&[a, _]| {
                let surfel = &tree.surfels[a as usize];
                let normal = with_normal.then(|| surfel.normal.map(f32::from));
                let normal = normal.filter(|n| *n != [0.0; 3]);
                Place { position: frame().world_of(surfel.centroid), normal }
            })
            // The last grid step's middle is beyond the cube.
            .filter(|place| frame().grid_of_query(place.position).is_ok())
            .collect();
        let locate = |place| map.locate(place, Snap::Within(f64::INFINITY)).is_ok();
        let found = rate(places.len(), || assert!(places.iter().all(locate)));
        println!("locate (normal: {with_normal}): {:.2} M/s warm", found / 1e6);
    }
}

fn at(tree: &Tree, surfel: u32) -> Located {
    Located { surfel, node: tree.surfels[surfel as usize].node, distance: 0.0 }
}

/// Gives how many of `n` answers come a second.
fn rate(n: usize, work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    n as f64 / start.elapsed().as_secs_f64()
}
