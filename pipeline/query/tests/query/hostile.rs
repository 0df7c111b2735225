//! Files that are nonsense under right checksums: errors or answers, never a panic or a hang.

use crate::common::{About, Cut, Parts, frame, grow, random_links, random_points, siblings};
use crate::sound::rect;
use fastrand::Rng;
use pvmap_geometry::disc::Profile;
use pvmap_query::{Ball, Light, Map, Place, QueryError, RegionAnswer, Sight, Snap};
use pvmap_vmap::{FormatError, MapView, Shape};

/// A binned tree of single points.
const BINNED: Cut = Cut { shape: Shape::Binned, leaf_capacity: 1, max_level: 21, few: 1000 };

/// What a file answers, each answer as text.
type Answers = Vec<Result<String, QueryError>>;

/// Asks a file all there is to ask about six places; the same seed asks the same.
fn ask(file: &[u8], seed: u64) -> Answers {
    let mut rng = Rng::with_seed(seed);
    let map = match Map::open(file) {
        Ok(map) => map,
        Err(error) => return vec![Err(error); 6 + 36 * 3 + 6 * 3 + 1],
    };
    if rng.bool() {
        // What is damaged is not kept.
        let _ = map.keep(1 << 30);
    }
    let place = |rng: &mut Rng| Place {
        position: frame().world_of([0; 3].map(|_| rng.u32(..1 << 22))),
        normal: rng.bool().then(|| [0; 3].map(|_| rng.f32() - 0.5)),
    };
    let places: Vec<Place> = (0..6).map(|_| place(&mut rng)).collect();
    let located: Vec<_> =
        places.iter().map(|p| map.locate(p, Snap::Within(f64::INFINITY))).collect();
    let mut answers: Answers = located.iter().cloned().map(text).collect();
    for (p, a) in places.iter().zip(&located) {
        for (q, b) in places.iter().zip(&located) {
            let both = a.clone().and_then(|a| Ok((a, b.clone()?)));
            answers.push(both.and_then(|(a, b)| text(map.pair(&a, &b))));
            let way = [0, 1, 2].map(|i| q.position[i] - p.position[i] + 0.01);
            answers.push(text(map.ray(p.position, way, a.as_ref().ok())));
            let ball = |place: &Place| Ball { middle: place.position, radius: 1000.0 };
            answers.push(text(map.region(&ball(p), &ball(q)).map(counts_of)));
        }
        answers.push(a.clone().and_then(|a| text(map.visible_from(&a))));
        answers.push(text(map.visible_from_air(p.position, &|_| true)));
        let box_light = Light::Box(p.position.map(|v| v - 900.0), p.position.map(|v| v + 900.0));
        for light in [Light::Air(p.position), box_light] {
            answers.push(a.clone().and_then(|a| text(map.shadow(&a, &light))));
        }
    }
    answers.push(text(map.sees_counts(&|| true)));
    answers
}

/// An error of the map, or what else was answered.
fn text<T: std::fmt::Debug>(answer: Result<T, QueryError>) -> Result<String, QueryError> {
    match answer {
        Err(e @ QueryError::Format(_)) => Err(e),
        other => Ok(format!("{other:?}")),
    }
}

/// What of a region's answer does not tell what it took.
fn counts_of(answer: RegionAnswer) -> (Sight, [u32; 2], u128) {
    (answer.sight, answer.n_surfels, answer.n_visible)
}

fn parts(rng: &mut Rng, given: bool) -> Parts {
    let shape = if rng.bool() { Shape::Binned } else { Shape::Paper };
    let profile = [Profile::Patch, Profile::Paper, Profile::Oriented][rng.usize(..3)];
    let cut = Cut { shape, leaf_capacity: 2, max_level: 9, few: 1000 };
    let mut tree = grow(&random_points(rng, 60), cut);
    if profile == Profile::Oriented {
        tree.rects = tree.surfels.iter().map(rect).collect();
    }
    let links = random_links(rng, &tree, &siblings(&tree), 200);
    let links_per_frame = rng.usize(1..50);
    Parts::new(&tree, &links, About { profile, given, links_per_frame, ..About::default() })
}

/// Sets bytes of a section to something else: one bit, one field, or a run of noise.
fn spoil(rng: &mut Rng, bytes: &mut [u8]) {
    if bytes.is_empty() {
        return;
    }
    let at = rng.usize(..bytes.len());
    match rng.u8(..4) {
        0 => bytes[at] ^= 1 << rng.u8(..8),
        1 => {
            let extreme = [0u64, 1, u64::MAX, 1 << 63, 1 << 31, 1 << 22, (1 << 24) - 1];
            let field = extreme[rng.usize(..extreme.len())].to_le_bytes();
            let at = at / 4 * 4;
            let len = (bytes.len() - at).min(if rng.bool() { 4 } else { 8 });
            bytes[at..at + len].copy_from_slice(&field[..len]);
        }
        2 => bytes[at] = rng.u8(..),
        _ => {
            let end = (at + rng.usize(..40)).min(bytes.len());
            bytes[at..end].iter_mut().for_each(|b| *b = rng.u8(..));
        }
    }
}

#[test]
fn d12_nonsense_under_right_checksums_never_panics() {
    let mut rng = Rng::with_seed(5);
    let n_rounds = if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { 300_000 } else { 1500 };
    let mut n_refused = 0;
    for round in 0..n_rounds {
        let mut parts = parts(&mut rng, round % 3 == 0);
        for _ in 0..rng.usize(1..4) {
            let i = rng.usize(..parts.sections.len());
            spoil(&mut rng, &mut parts.sections[i].2);
        }
        let file = parts.seal();
        n_refused += u32::from(ask(&file, rng.u64(..)).iter().any(Result::is_err));
    }
    assert!(n_refused > n_rounds / 6, "only {n_refused} of {n_rounds} spoilt files were noticed");
}

#[test]
fn d12_a_file_with_a_flipped_bit_answers_as_the_whole_one_or_not_at_all() {
    let mut rng = Rng::with_seed(6);
    let file = parts(&mut rng, false).seal();
    for _ in 0..1500 {
        let seed = rng.u64(..);
        let mut flipped = file.clone();
        flipped[rng.usize(..file.len())] ^= 1 << rng.u8(..8);
        let answers = ask(&flipped, seed).into_iter().zip(ask(&file, seed));
        for (found, expected) in answers {
            assert!(matches!(found, Err(QueryError::Format(_))) || found == expected, "{found:?}");
        }
    }
    for len in (0..file.len()).step_by(97) {
        assert!(matches!(Map::open(&file[..len]), Err(QueryError::Format(_))));
    }
}

#[test]
fn f47_a_way_up_that_never_ends_is_refused() {
    let mut rng = Rng::with_seed(7);
    let cut = Cut { shape: Shape::Paper, leaf_capacity: 0, max_level: 1, few: 1 };
    let tree = grow(&random_points(&mut rng, 400), cut);
    let mut chain = tree.clone();
    // Node i hangs under node i - 1, all the way; every subtree ends at the end.
    let n = chain.nodes.len() as u32;
    for id in 1..n {
        chain.nodes[id as usize].parent = id - 1;
    }
    let file = Parts::new(&chain, &[], About::default()).seal();
    assert!(ask(&file, 8).iter().any(Result::is_err));
}

/// Says what `verify` finds broken: the section, and what is wrong with it.
fn damage(file: &[u8]) -> Option<(String, String)> {
    match MapView::open(file).unwrap().verify() {
        Ok(()) => None,
        Err(FormatError::Broken { section, what, .. }) => Some((section, what)),
        Err(other) => panic!("{other}"),
    }
}

#[test]
fn a_map_without_a_profile_is_refused() {
    let mut rng = Rng::with_seed(9);
    let mut parts = parts(&mut rng, false);
    parts.bytes_mut("config").clear();
    assert!(matches!(Map::open(&parts.seal()), Err(QueryError::Format(_))));
}

#[test]
fn format14_verify_refuses_a_configuration_that_is_not_canonical() {
    let mut rng = Rng::with_seed(11);
    let tree = grow(&random_points(&mut rng, 40), BINNED);
    for given in [false, true] {
        let sound = Parts::new(&tree, &[], About { given, ..About::default() });
        assert_eq!(damage(&sound.seal()), None);
        let text = String::from_utf8(sound.clone().bytes_mut("config").clone()).unwrap();
        let lines: Vec<&str> = text.split_inclusive('\n').collect();
        let mut forged: Vec<String> = vec![
            text.to_uppercase(),
            text.replace("= ", "="),
            text.replace("max_level = 21", "max_level = 0"),
            text.replace("max_level = 21", "max_level = 22"),
            text.replace("max_level = 21", "max_level = 021"),
            text.replace("leaf_capacity = 1", "leaf_capacity = -1"),
            text.replace("leaf_capacity = 1", "leaf_capacity = 18446744073709551616"),
            text.replace("binned", "round"),
            text.replace("patch", "Patch"),
            text.trim_end().to_owned(),
            text.clone() + "\n",
            text.clone() + "threads = 2\n",
            text.clone() + "interaction_pairs = \"3\"\n",
            text.clone() + "interaction_pairs = \"3:5\"\n",
            lines.iter().rev().copied().collect(),
        ];
        // Without one of the keys, and with it twice. The pairs may be absent.
        for (i, line) in lines.iter().enumerate() {
            let rest = [&lines[..i], &lines[i + 1..]].concat().concat();
            forged.extend((i < 4).then_some(rest));
            forged.push(text.replace(line, &line.repeat(2)));
        }
        for config in forged {
            let mut parts = sound.clone();
            *parts.bytes_mut("config") = config.clone().into_bytes();
            let found = damage(&parts.seal()).unwrap_or_else(|| panic!("accepted: {config:?}"));
            assert_eq!(found.0, "config", "{config:?}: {found:?}");
        }
    }
}

#[test]
fn v5_verify_refuses_a_link_between_a_node_and_one_below_it() {
    let mut rng = Rng::with_seed(12);
    let tree = grow(&random_points(&mut rng, 40), BINNED);
    let mut n_nested = 0;
    for a in 0..tree.nodes.len() as u32 {
        let end = tree.nodes[a as usize].end;
        for b in (a + 1..tree.nodes.len() as u32).step_by(3) {
            let found = damage(&Parts::new(&tree, &[(a, b)], About::default()).seal());
            assert_eq!(found.is_some(), b < end, "{a} and {b}: {found:?}");
            assert!(found.is_none_or(|(_, what)| what.contains("below it")));
            n_nested += u32::from(b < end);
        }
    }
    assert!(n_nested > 50, "{n_nested}");
}
