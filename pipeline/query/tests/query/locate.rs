//! `locate` against a look at every leaf, for random places. [V-8]

use crate::common::{About, Cut, Parts, frame, grow, random_points};
use fastrand::Rng;
use pvmap_geometry::disc::Profile;
use pvmap_geometry::{Frame, GridPoint, grid, normal};
use pvmap_query::{ErrorKind, Located, Map, Place, QueryError, Snap};
use pvmap_vmap::container::BLOCK_BYTES;
use pvmap_vmap::records::Record;
use pvmap_vmap::tree::{RoutingKey, route};
use pvmap_vmap::{Shape, Surfel, Tree};

/// The answer without a snap limit, by [V-8]'s words: (surfel, squared distance in grid steps).
fn brute_force(tree: &Tree, profile: Profile, g: GridPoint, n: Option<[f32; 3]>) -> (u32, u64) {
    let n = n.map(|n| normal::quantise(n).unwrap());
    let here = g.map(|v| v as i32);
    let distance2 = |s: &Surfel| match profile {
        Profile::Patch | Profile::Oriented => s.patch.distance2(here),
        Profile::Paper => s.patch.grown(-(s.half_spacing as i32)).distance2(here),
    };
    if let Some(normal) = n {
        let side = |oriented| {
            let Ok(leaf) = route(tree, &RoutingKey { g, normal, oriented });
            leaf
        };
        let leaf = side(true).or_else(|| side(false));
        if let Some(leaf) = leaf {
            let surfel = tree.nodes[leaf as usize].first_surfel;
            return (surfel, distance2(&tree.surfels[surfel as usize]));
        }
    }
    let dot = |a: [i16; 3], b: [i64; 3]| (0..3).map(|i| i64::from(a[i]) * b[i]).sum::<i64>();
    let rank = |&id: &u32| {
        let s = &tree.surfels[id as usize];
        let off = [0, 1, 2].map(|i| i64::from(g[i]) - i64::from(s.centroid[i]));
        let along = n.map_or(0, |n| dot(s.normal, n.map(i64::from)));
        let along = if s.two_sided { along.abs() } else { along };
        (distance2(s), -along, dot(s.normal, off).abs(), id)
    };
    let all = 0..tree.surfels.len() as u32;
    let in_cell = |id: &u32| tree.surfels[*id as usize].cell().distance2(here) == 0;
    let found = all.clone().filter(in_cell).min_by_key(rank).or(all.min_by_key(rank)).unwrap();
    (found, distance2(&tree.surfels[found as usize]))
}

/// Gives a place worth asking about: anywhere, near a point, or on the corner of a leaf's cell.
fn random_place(rng: &mut Rng, tree: &Tree) -> GridPoint {
    let surfel = &tree.surfels[rng.usize(..tree.surfels.len())];
    let in_cube = |v: i64| v.clamp(0, i64::from(grid::GRID_MAX)) as u32;
    match rng.u8(..3) {
        0 => [0; 3].map(|_| rng.u32(..1 << 22)),
        1 => {
            let width = 1 << rng.u32(1..20);
            surfel.centroid.map(|c| in_cube(i64::from(c) + rng.i64(-width..width)))
        }
        _ => {
            let cell = surfel.cell();
            [0, 1, 2].map(|i| in_cube((if rng.bool() { cell.min[i] } else { cell.max[i] }).into()))
        }
    }
}

#[test]
fn v8_the_surfel_found_is_the_best_of_all() {
    let mut rng = Rng::with_seed(3);
    for round in 0..60 {
        let shape = if round % 2 == 0 { Shape::Binned } else { Shape::Paper };
        let profile = if round / 2 % 2 == 0 { Profile::Patch } else { Profile::Paper };
        let cut = Cut {
            shape,
            leaf_capacity: rng.usize(..8),
            max_level: rng.u8(1..=21),
            few: 1 << rng.u32(..20),
        };
        let n_points = rng.usize(2..400);
        let tree = grow(&random_points(&mut rng, n_points), cut);
        let file = Parts::new(&tree, &[], About { profile, ..About::default() }).seal();
        let map = Map::open(&file).unwrap();
        let frame = frame();
        for i in 0..400 {
            // The same from memory.
            if i == 200 {
                assert_eq!(map.keep(1 << 30), Ok(true));
            }
            let position = frame.world_of(random_place(&mut rng, &tree));
            // Leaving the cube by rounding is another test's matter.
            let Ok(g) = frame.grid_of_query(position) else { continue };
            let normal = rng.bool().then(|| [0; 3].map(|_| rng.f32() - 0.5));
            let (surfel, distance2) = brute_force(&tree, profile, g, normal);
            let expected = Located {
                surfel,
                node: tree.surfels[surfel as usize].node,
                distance: (distance2 as f64).sqrt() * frame.unit(),
            };
            let place = Place { position, normal };
            assert_eq!(map.locate(&place, Snap::Within(f64::INFINITY)), Ok(expected));
            check_limits(&map, &place, &expected, &tree.surfels[surfel as usize]);
        }
    }
}

/// The found surfel answers up to the limit, and not beyond.
fn check_limits(map: &Map<'_>, place: &Place, expected: &Located, surfel: &Surfel) {
    let distance = expected.distance;
    assert_eq!(map.locate(place, Snap::Within(distance)), Ok(*expected));
    if distance > 0.0 {
        let limit = distance * 0.999;
        let error = map.locate(place, Snap::Within(limit)).unwrap_err();
        let place = place.position;
        assert_eq!(error, QueryError::NoSurface { place, nearest: distance, limit });
        assert_eq!(error.kind(), ErrorKind::Place);
    }
    let four = 4.0 * f64::from(surfel.half_spacing) * map.view().frame().frame.unit();
    let near = map.locate(place, Snap::default());
    assert_eq!(near.is_ok(), distance <= four * (1.0 + 1e-12));
}

#[test]
fn v8_a_stored_point_leads_to_its_own_leaf() {
    let mut rng = Rng::with_seed(4);
    let cut = Cut { shape: Shape::Binned, leaf_capacity: 3, max_level: 12, few: 9 };
    let points = random_points(&mut rng, 3000);
    let tree = grow(&points, cut);
    let file = Parts::new(&tree, &[], About::default()).seal();
    let map = Map::open(&file).unwrap();
    for (g, n) in points.into_iter().filter(|p| p.1 != [0; 3]) {
        let position = frame().world_of(g);
        let Ok(g) = frame().grid_of_query(position) else { continue };
        let given = n.map(f32::from);
        let normal = normal::quantise(given).unwrap();
        let side = |oriented| {
            let Ok(leaf) = route(&tree, &RoutingKey { g, normal, oriented });
            leaf
        };
        let leaf = side(true).or_else(|| side(false));
        let found = map.locate(&Place { position, normal: Some(given) }, Snap::Within(1e9));
        assert_eq!(found.unwrap().node, leaf.unwrap());
    }
}

#[test]
fn v8_what_cannot_be_located_says_why() {
    let points = [([0; 3], [0, 0, 1 << 14]), ([(1 << 22) - 1; 3], [0, 0, 1 << 14])];
    let cut = Cut { shape: Shape::Binned, leaf_capacity: 1, max_level: 8, few: 2 };
    let frame = Frame::of_world([10.0; 3], [12.0; 3]);
    let tree = grow(&points, cut);
    let file = Parts::new(&tree, &[], About { frame, ..About::default() }).seal();
    let map = Map::open(&file).unwrap();
    let ask = |position, normal, snap| map.locate(&Place { position, normal }, snap).unwrap_err();
    for x in [9.99, 12.01, f64::NAN, f64::INFINITY] {
        let error = ask([x, 11.0, 11.0], None, Snap::default());
        assert!(matches!(error, QueryError::OutsideCube { .. }), "{error}");
        assert!(error.to_string().ends_with(
            ",11,11 lies outside the scan's cube (10,10,10 to 12,12,12); \
             give a place inside it, in the scan's units"
        ));
    }
    for normal in [[0.0; 3], [f32::NAN, 1.0, 0.0], [f32::INFINITY, 0.0, 0.0]] {
        let error = ask([11.0; 3], Some(normal), Snap::default());
        assert!(matches!(error, QueryError::Normal { .. }), "{error}");
        assert_eq!(error.kind(), ErrorKind::Usage);
    }
    for limit in [-1.0, f64::NAN] {
        assert_eq!(ask([11.0; 3], None, Snap::Within(limit)).kind(), ErrorKind::Usage);
    }
    let error = ask([11.0; 3], None, Snap::default());
    assert!(matches!(error, QueryError::NoSurface { .. }), "{error}");
}

#[test]
fn a_scan_without_points_has_no_surface() {
    let file = Parts::new(&Tree::default(), &[], About::default()).seal();
    let map = Map::open(&file).unwrap();
    let position = frame().world_of([5; 3]);
    let error = map.locate(&Place { position, normal: None }, Snap::default()).unwrap_err();
    assert_eq!(error, QueryError::Empty);
}

#[test]
fn d11_a_place_in_no_cell_touches_few_blocks() {
    let mut rng = Rng::with_seed(4);
    let cut = Cut { shape: Shape::Paper, leaf_capacity: 1, max_level: 21, few: 1 };
    let points: Vec<_> = (0..8000)
        .map(|_| ([0; 3].map(|_| rng.u32(..1 << 22)), normal::quantise([0.0, 0.0, 1.0]).unwrap()))
        .collect();
    let tree = grow(&points, cut);
    let file = Parts::new(&tree, &[], About::default()).seal();
    let whole = Map::open(&file).unwrap();
    let section = whole.view().file().section("surfels", Surfel::BYTES as u32).unwrap();
    let blocks: Vec<u64> = (0..section.len_bytes).step_by(BLOCK_BYTES as usize).collect();
    assert!(blocks.len() > 10);
    let holds = |s: &Surfel, g: GridPoint| s.cell().distance2(g.map(|v| v as i32)) == 0;
    let (mut n_places, mut n_touched) = (0, 0);
    while n_places < 20 {
        let g = [0; 3].map(|_| rng.u32(..1 << 22));
        if tree.surfels.iter().any(|s| holds(s, g)) {
            continue;
        }
        let place = Place { position: frame().world_of(g), normal: None };
        let anywhere = Snap::Within(f64::INFINITY);
        let right = whole.locate(&place, anywhere).unwrap();
        for block in &blocks {
            let mut broken = file.clone();
            broken[(section.offset_bytes + block) as usize] ^= 1;
            match Map::open(&broken).unwrap().locate(&place, anywhere) {
                Ok(found) => assert_eq!(found, right),
                Err(_) => n_touched += 1,
            }
        }
        n_places += 1;
    }
    assert!(n_touched <= 3 * n_places, "{n_touched} blocks of surfels for {n_places} places");
}
