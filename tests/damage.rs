//! Damaged and hostile artifacts: every one is noticed, none brings a panic, a wrong answer or a
//! huge allocation. Source: DESIGN.md [D-12]; rows F42-F50 of the catalogue of faults.
//!
//! A plain run flips every bit and cuts at every byte for `verify`, and asks questions of a sample
//! of the damaged files; where PVMAP_SLOW_TESTS is set it asks all of them.

mod common;
#[path = "common/seal.rs"]
mod seal;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use fastrand::Rng;
use pvmap::query::{Located, Map, PairAnswer, Place, QueryError, Snap};
use pvmap::vmap::frame::FrameRecord;
use pvmap::vmap::links::{LinkLists, put_varint};
use pvmap::vmap::tree::{Nodes, RoutingKey};
use pvmap::vmap::{FormatError, Kind, MapSummary, MapView, Node, OctreeView, Surfel};
use pvmap::{BuildConfig, Error, Limits, Quiet};
use rayon::prelude::*;

use crate::common::{LIMITS, build_with, ingest_with, is_slow_run, room_cloud};
use crate::seal::{Parts, ROW, put, reseal_head};

/// Sections of each artifact, `sums` among them.
const N_MAP_SECTIONS: usize = 9;
const N_OCTREE_SECTIONS: usize = 10;
const BLOCK: usize = 65_536;

/// A sound octree and a sound map of it, each at most 64 KiB.
struct Sound {
    octree: Vec<u8>,
    map: Vec<u8>,
    answers: Vec<Answer>,
}

static SOUND: LazyLock<Sound> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let (octree, map) = artifacts(folder.path(), 900, &small_config());
    assert!(octree.len() <= BLOCK && map.len() <= BLOCK, "{} {}", octree.len(), map.len());
    let answers = ask(&map).into_iter().map(Result::unwrap).collect();
    Sound { octree, map, answers }
});

fn small_config() -> BuildConfig {
    BuildConfig { max_level: 5, leaf_capacity: 8, ..BuildConfig::default() }
}

/// Makes an octree of the furnished room and a map.
fn artifacts(folder: &Path, n_points: u64, config: &BuildConfig) -> (Vec<u8>, Vec<u8>) {
    let scan = folder.join("room.las");
    room_cloud(n_points).write_las(&scan, 0.0001, [0.0; 3]);
    let octree = ingest_with(&[scan], folder, &LIMITS, |_| {});
    let map = build_with(&octree, config, &LIMITS);
    (std::fs::read(octree.join("points.pvo")).unwrap(), map)
}

/// One thing a map says.
#[derive(Debug, Clone, PartialEq)]
enum Answer {
    Head(MapSummary, FrameRecord),
    Text(String),
    Node(Node),
    Surfel(Surfel),
    Links(LinkLists),
    Place(Result<Located, String>),
    Pair(PairAnswer),
}

/// What a map answers to all that the small sound map can be asked, in one order; only an error
/// of opening makes it short.
fn ask(bytes: &[u8]) -> Vec<Result<Answer, QueryError>> {
    let map = match Map::open(bytes) {
        Ok(map) => map,
        Err(error) => return vec![Err(error)],
    };
    let view = map.view();
    let mut answers = vec![Ok(Answer::Head(*view.summary(), *view.frame()))];
    answers.push(view.config().map(|text| Answer::Text(text.to_owned())).map_err(Into::into));
    answers.push(view.crs().map(|crs| Answer::Text(format!("{crs:?}"))).map_err(Into::into));
    answers.extend((0..view.n_nodes()).map(|id| Ok(Answer::Node(view.node(id)?))));
    answers.extend((0..view.summary().n_surfels).map(|id| Ok(Answer::Surfel(view.surfel(id)?))));
    answers.extend((0..view.n_link_blocks()).map(|i| Ok(Answer::Links(view.link_lists(i)?))));
    let located: Vec<_> = places().map(|p| map.locate(&p, Snap::Within(1.0))).collect();
    answers.extend(located.iter().cloned().map(|found| match found {
        Err(QueryError::Format(e)) => Err(e.into()),
        found => Ok(Answer::Place(found.map_err(|e| e.to_string()))),
    }));
    for (i, a) in located.iter().enumerate() {
        for b in &located[i..] {
            let (Ok(a), Ok(b)) = (a, b) else { continue };
            answers.push(map.pair(a, b).map(Answer::Pair));
        }
    }
    answers
}

/// Places on the walls of the room, and one in the middle of the air.
fn places() -> impl Iterator<Item = Place> {
    let mut rng = Rng::with_seed(1);
    (0..8).map(move |i| {
        let mut position = [0; 3].map(|_| 0.1 + 5.3 * rng.f64());
        if i > 0 {
            position[i % 3] = if i % 2 == 0 { 0.01 } else { 5.49 };
        }
        Place { position, normal: (i % 4 == 1).then_some([0.0, 0.0, 1.0]) }
    })
}

/// Demands that each answer is that of the sound map, or an error that names the damage.
fn check_answers(bytes: &[u8], what: &str) {
    let found = ask(bytes);
    let is_error = |a: &Result<Answer, QueryError>| matches!(a, Err(QueryError::Format(_)));
    if found.len() != SOUND.answers.len() {
        // Pairs of places that were not found are not asked.
        assert!(found.iter().any(is_error), "{what}: fewer answers, no error");
    }
    // Up to the pairs every answer has its place in the list.
    let n_pairs = SOUND.answers.iter().filter(|a| matches!(a, Answer::Pair(_))).count();
    let aligned = if found.len() == SOUND.answers.len() { 0 } else { n_pairs };
    for (found, sound) in found.iter().zip(&SOUND.answers[..SOUND.answers.len() - aligned]) {
        assert!(is_error(found) || found.as_ref() == Ok(sound), "{what}: {found:?}, not {sound:?}");
    }
}

fn verify_map(bytes: &[u8]) -> Result<(), FormatError> {
    MapView::open(bytes)?.verify()
}

fn verify_octree(bytes: &[u8]) -> Result<(), FormatError> {
    OctreeView::open(bytes)?.verify()
}

fn exit_code(error: FormatError) -> u8 {
    Error::artifact(Path::new("a.vmap"), error).exit_code()
}

/// Calls `check` with every single-bit flip of a file, on all threads; the number of the bit
/// comes with it.
fn flip_all(file: &[u8], check: impl Fn(&[u8], usize) + Sync) {
    (0..file.len()).into_par_iter().for_each_init(
        || file.to_vec(),
        |flipped, byte| {
            for bit in 0..8 {
                flipped[byte] ^= 1 << bit;
                check(flipped, 8 * byte + bit);
                flipped[byte] ^= 1 << bit;
            }
        },
    );
}

#[test]
fn f42_every_flip_of_a_map_is_found_and_none_answers_wrongly() {
    let every = if is_slow_run() { 1 } else { 97 };
    flip_all(&SOUND.map, |flipped, bit| {
        let found = verify_map(flipped).expect_err("a flip that verify does not see");
        assert_eq!(exit_code(found), 65, "bit {bit}");
        if bit % every == 0 {
            check_answers(flipped, &format!("bit {bit}"));
        }
    });
}

#[test]
fn f42_every_flip_of_an_octree_is_found() {
    let every = if is_slow_run() { 1 } else { 41 };
    let sound = points_of(&SOUND.octree).unwrap();
    flip_all(&SOUND.octree, |flipped, bit| {
        let found = verify_octree(flipped).expect_err("a flip that verify does not see");
        assert_eq!(exit_code(found), 65, "bit {bit}");
        if bit % every == 0 {
            let found = points_of(flipped);
            assert!(found.is_err() || found.as_ref() == Ok(&sound), "bit {bit}");
        }
    });
}

/// Everything a build takes from an octree.
type Points = (Vec<(RoutingKey, Vec<u8>)>, FrameRecord, String);

fn points_of(bytes: &[u8]) -> Result<Points, FormatError> {
    let view = OctreeView::open(bytes)?;
    let points = view.points(0, view.summary().n_points)?;
    let rows = points.iter().map(|p| p.map(|p| (p.key, p.record.to_vec())));
    Ok((rows.collect::<Result<_, _>>()?, *view.frame(), format!("{:?}", view.crs()?)))
}

/// An octree folder of any bytes, and the map it would become.
struct Folder {
    octree: PathBuf,
    map: PathBuf,
    _folder: tempfile::TempDir,
}

impl Folder {
    fn new() -> Folder {
        let folder = tempfile::tempdir().unwrap();
        let (octree, map) = (folder.path().join("a.octree"), folder.path().join("a.vmap"));
        std::fs::create_dir(&octree).unwrap();
        Folder { octree, map, _folder: folder }
    }

    /// Builds a map of an octree of these bytes; after an error there is none.
    fn build(&self, octree: &[u8]) -> Result<Vec<u8>, Error> {
        std::fs::write(self.octree.join("points.pvo"), octree).unwrap();
        let limits = Limits { threads: 1, memory_bytes: 64 << 20 };
        let built = pvmap::build(&self.octree, &self.map, &small_config(), &limits, &Quiet);
        assert_eq!(built.is_ok(), self.map.exists());
        built?;
        let map = std::fs::read(&self.map).unwrap();
        std::fs::remove_file(&self.map).unwrap();
        Ok(map)
    }
}

#[test]
fn f42_a_flipped_octree_builds_the_same_map_or_none() {
    let n = if is_slow_run() { 5000 } else { 200 };
    (0..n).into_par_iter().for_each_init(Folder::new, |folder, seed| {
        let mut rng = Rng::with_seed(seed);
        let mut octree = SOUND.octree.clone();
        let bit = rng.usize(..8 * octree.len());
        octree[bit / 8] ^= 1 << (bit % 8);
        match folder.build(&octree) {
            Ok(map) => assert!(map == SOUND.map, "bit {bit}"),
            Err(error) => assert_eq!(error.exit_code(), 65, "bit {bit}: {error}"),
        }
    });
}

#[test]
fn f43_bursts_and_scattered_flips_are_found() {
    let n = if is_slow_run() { 1_000_000 } else { 20_000 };
    let n_bits = 8 * SOUND.map.len();
    (0..n).into_par_iter().for_each_init(
        || SOUND.map.clone(),
        |damaged, seed| {
            let mut rng = Rng::with_seed(seed);
            let bits: Vec<usize> = match rng.bool() {
                // Two or three anywhere.
                true => (0..rng.usize(2..=3)).map(|_| rng.usize(..n_bits)).collect(),
                // A burst: first and last of up to 32 bits, and any between.
                false => {
                    let (start, len) = (rng.usize(..n_bits - 32), rng.usize(2..=32));
                    let ends = [start, start + len - 1];
                    (start..start + len).filter(|b| ends.contains(b) || rng.bool()).collect()
                }
            };
            let flip = |file: &mut Vec<u8>| bits.iter().for_each(|b| file[b / 8] ^= 1 << (b % 8));
            flip(damaged);
            let changed = *damaged != SOUND.map;
            assert_eq!(verify_map(damaged).is_err(), changed, "bits {bits:?}");
            if seed % 64 == 0 {
                check_answers(damaged, &format!("bits {bits:?}"));
            }
            flip(damaged);
        },
    );
}

#[test]
fn f43_zeroed_doubled_and_swapped_pages_are_found() {
    let page = |i: usize| 4096 * i..(4096 * (i + 1)).min(SOUND.map.len());
    let n_pages = SOUND.map.len().div_ceil(4096);
    let mut damaged = Vec::new();
    for i in 0..n_pages {
        let mut zeroed = SOUND.map.clone();
        zeroed[page(i)].fill(0);
        damaged.push(zeroed);
        // The last page may be short: only whole ones change places.
        for j in (0..n_pages - 1).filter(|&j| j != i && i + 1 < n_pages) {
            let mut doubled = SOUND.map.clone();
            doubled[page(j)].copy_from_slice(&SOUND.map[page(i)]);
            let mut swapped = doubled.clone();
            swapped[page(i)].copy_from_slice(&SOUND.map[page(j)]);
            damaged.extend([doubled, swapped]);
        }
    }
    damaged.into_par_iter().enumerate().for_each(|(i, damaged)| {
        assert_eq!(verify_map(&damaged).is_err(), damaged != SOUND.map, "{i}");
        check_answers(&damaged, &format!("pages {i}"));
    });
}

#[test]
fn f43_swapped_blocks_of_a_larger_map_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let config = BuildConfig { max_level: 7, leaf_capacity: 4, ..BuildConfig::default() };
    let (_, map) = artifacts(folder.path(), 20_000, &config);
    let view = MapView::open(&map).unwrap();
    let whole = |s: &&pvmap::vmap::container::Section| s.len_bytes as usize > 2 * BLOCK;
    let large: Vec<_> = view.file().sections().iter().filter(whole).collect();
    assert!(large.len() >= 2, "nodes and surfels fill some blocks");
    for section in large {
        let start = section.offset_bytes as usize;
        let (first, second) = (start..start + BLOCK, start + BLOCK..start + 2 * BLOCK);
        let mut swapped = map.clone();
        swapped[first.clone()].copy_from_slice(&map[second.clone()]);
        swapped[second].copy_from_slice(&map[first]);
        let error = verify_map(&swapped).unwrap_err();
        let named = format!("checksum of {} differs at byte {start}", section.name);
        assert!(error.to_string().contains(&named), "{error}");
        // What lies beyond still answers.
        let damaged = MapView::open(&swapped).unwrap();
        assert!(damaged.file().read(section, 0, 1).is_err(), "{}", section.name);
        assert!(damaged.file().read(section, section.len_bytes - 1, 1).is_ok(), "{}", section.name);
    }
}

#[test]
fn f44_every_truncation_is_found_on_opening() {
    for len in 0..SOUND.map.len() {
        let error = MapView::open(&SOUND.map[..len]).unwrap_err();
        assert!(matches!(ask(&SOUND.map[..len])[..], [Err(QueryError::Format(_))]), "{len}");
        assert_eq!(exit_code(error), 65, "{len} bytes");
    }
    for len in 0..SOUND.octree.len() {
        let error = OctreeView::open(&SOUND.octree[..len]).unwrap_err();
        assert_eq!(exit_code(error), 65, "{len} bytes");
    }
}

#[test]
fn f45_trailing_garbage_is_found_on_opening() {
    let tails = [vec![0], vec![0; 64], vec![0xff; 4096], SOUND.map.clone()];
    for tail in tails {
        let error = MapView::open(&[&SOUND.map[..], &tail].concat()).unwrap_err();
        assert!(matches!(error, FormatError::Length { .. }), "{error}");
        assert_eq!(exit_code(error), 65);
        let error = OctreeView::open(&[&SOUND.octree[..], &tail].concat()).unwrap_err();
        assert!(matches!(error, FormatError::Length { .. }), "{error}");
    }
}

#[test]
fn f46_another_version_or_an_unknown_flag_exits_78() {
    // Place, bytes, value: major, minor, required.
    let patches =
        [(12, 2, 0), (12, 2, 2), (12, 2, 65_535), (14, 2, 1), (48, 8, 1), (48, 8, 1 << 63)];
    let folder = Folder::new();
    for (at, n_bytes, value) in patches {
        let mut map = SOUND.map.clone();
        put(&mut map, at, value, n_bytes);
        reseal_head(&mut map, N_MAP_SECTIONS);
        let error = MapView::open(&map).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("1.0") || at == 48, "{message}");
        assert!(message.contains("use a newer one"), "{message}");
        assert_eq!(exit_code(error), 78, "{message}");
        let error = Error::from(Map::open(&map).unwrap_err());
        assert_eq!(error.exit_code(), 78, "a query: {error}");
        let mut octree = SOUND.octree.clone();
        put(&mut octree, at, value, n_bytes);
        reseal_head(&mut octree, N_OCTREE_SECTIONS);
        let error = folder.build(&octree).unwrap_err();
        assert_eq!(error.exit_code(), 78, "a build: {error}");
    }
}

/// Values that break sums, products and casts.
const EXTREMES: [u64; 12] = [
    0,
    1,
    63,
    64,
    1 << 22,
    1 << 31,
    u32::MAX as u64,
    1 << 62,
    1 << 63,
    u64::MAX - 63,
    u64::MAX - 1,
    u64::MAX,
];

#[test]
fn f47_a_hostile_section_table_is_refused() {
    for (file, n, verify) in [
        (&SOUND.map, N_MAP_SECTIONS, verify_map as fn(&[u8]) -> Result<(), FormatError>),
        (&SOUND.octree, N_OCTREE_SECTIONS, verify_octree),
    ] {
        // Fields of a row: name, offset, length, records, bytes of a record, reserved, first block.
        let fields =
            [(0, 8), (8, 8), (16, 8), (24, 8), (32, 4), (36, 4), (40, 8), (48, 8), (56, 8)];
        let last_block = (ROW * n + 40, 8);
        let rows = (1..=n).flat_map(|row| fields.map(|(at, len)| (ROW * row + at, len)));
        // Which block of `sums` holds the checksum of `sums` itself, no rule says.
        for (at, len) in rows.chain([(24, 4)]).filter(|&field| field != last_block) {
            let old = u64::from_le_bytes(file[at..at + 8].try_into().unwrap());
            let near = [old.wrapping_add(1), old.wrapping_sub(1), old.wrapping_add(64)];
            for value in EXTREMES.into_iter().chain(near) {
                let mut hostile = file.clone();
                put(&mut hostile, at, value, len);
                if hostile == *file {
                    continue;
                }
                reseal_head(&mut hostile, n);
                let error = verify(&hostile).expect_err(&format!("{value:#x} at {at}"));
                assert_eq!(exit_code(error), 65, "{value:#x} at {at}");
            }
        }
    }
}

/// Sets bytes of a random section to something else: an extreme, one bit, or noise.
fn spoil(rng: &mut Rng, parts: &mut Parts) {
    let i = rng.usize(..parts.sections.len());
    let bytes = &mut parts.sections[i].2;
    if bytes.is_empty() {
        return;
    }
    let at = rng.usize(..bytes.len());
    match rng.u8(..4) {
        0 => bytes[at] ^= 1 << rng.u8(..8),
        1 | 2 => {
            let at = at / 4 * 4;
            let len = (bytes.len() - at).min(if rng.bool() { 4 } else { 8 });
            put(bytes, at, EXTREMES[rng.usize(..EXTREMES.len())], len);
        }
        _ => {
            let end = (at + rng.usize(1..40)).min(bytes.len());
            bytes[at..end].iter_mut().for_each(|b| *b = rng.u8(..));
        }
    }
}

#[test]
fn f47_a_hostile_map_under_right_checksums_never_panics() {
    let n = if is_slow_run() { 100_000 } else { 4000 };
    let parts = Parts::of(&SOUND.map, Kind::Map);
    assert!(parts.seal() == SOUND.map, "taking apart and sealing changes nothing");
    let refused = (0..n).into_par_iter().map(|seed| {
        let mut rng = Rng::with_seed(seed);
        let mut parts = parts.clone();
        (0..rng.usize(1..4)).for_each(|_| spoil(&mut rng, &mut parts));
        let hostile = parts.seal();
        for error in ask(&hostile).into_iter().filter_map(Result::err) {
            assert_eq!(Error::from(error).exit_code(), 65, "seed {seed}");
        }
        u64::from(verify_map(&hostile).is_err())
    });
    let refused: u64 = refused.sum();
    assert!(refused > n / 2, "{refused} of {n} refused");
}

#[test]
fn f47_a_hostile_octree_under_right_checksums_never_panics_a_build() {
    let n = if is_slow_run() { 20_000 } else { 1000 };
    let parts = Parts::of(&SOUND.octree, Kind::Octree);
    assert!(parts.seal() == SOUND.octree, "taking apart and sealing changes nothing");
    (0..n).into_par_iter().for_each_init(Folder::new, |folder, seed| {
        let mut rng = Rng::with_seed(seed);
        let mut parts = parts.clone();
        (0..rng.usize(1..3)).for_each(|_| spoil(&mut rng, &mut parts));
        let hostile = parts.seal();
        // Seeing it as unsound or not, `verify` comes back.
        let _ = verify_octree(&hostile);
        match folder.build(&hostile) {
            Ok(map) => verify_map(&map).unwrap_or_else(|e| panic!("seed {seed}: {e}")),
            Err(error) => assert_eq!(error.exit_code(), 65, "seed {seed}: {error}"),
        }
    });
}

#[test]
fn f47_a_hostile_tree_is_refused() {
    let sound = Parts::of(&SOUND.map, Kind::Map);
    let n_nodes = MapView::open(&SOUND.map).unwrap().n_nodes() as usize;
    // Fields of the 40-byte row of a node: all but the reserved.
    let fields = [(0, 4), (4, 4), (8, 4), (12, 4), (16, 8), (24, 8), (32, 1), (33, 1), (34, 1)];
    for id in [0, 1, 2, n_nodes / 2, n_nodes - 1] {
        for (at, len) in fields {
            for value in EXTREMES.into_iter().chain([7, 22, 255, id as u64]) {
                let mut parts = sound.clone();
                put(parts.bytes_mut("nodes"), 40 * id + at, value, len);
                let hostile = parts.seal();
                if hostile == SOUND.map {
                    continue;
                }
                let _ = ask(&hostile);
                let error = verify_map(&hostile);
                let error = error.expect_err(&format!("node {id}: {value:#x} at {at}"));
                assert_eq!(exit_code(error), 65);
            }
        }
    }
}

/// Replaces the first link frame; `change` gets its row of the index: 40 bytes, offsets [F-19].
fn with_frame(frame: &[u8], change: impl FnOnce(&mut [u8])) -> Vec<u8> {
    let mut parts = Parts::of(&SOUND.map, Kind::Map);
    let index = parts.bytes_mut("linkidx");
    assert_eq!(index.len(), 40, "the small map has one frame");
    put(index, 24, frame.len() as u64, 4);
    put(index, 36, crc32fast::hash(frame).into(), 4);
    change(index);
    *parts.bytes_mut("links") = frame.to_vec();
    parts.seal()
}

/// Gives the first link frame of the small map and what it holds.
fn sound_frame() -> (Vec<u8>, Vec<u8>) {
    let frame = Parts::of(&SOUND.map, Kind::Map).bytes_mut("links").clone();
    let content = zstd::bulk::decompress(&frame, BLOCK * 2).unwrap();
    (frame, content)
}

fn check_refused(hostile: &[u8], what: &str) {
    let error = verify_map(hostile).expect_err(what);
    assert_eq!(exit_code(error), 65, "{what}");
    let view = MapView::open(hostile).unwrap();
    assert!(view.link_lists(0).is_err(), "{what}");
    check_answers(hostile, what);
}

#[test]
fn f47_a_hostile_link_index_is_refused() {
    let (frame, _) = sound_frame();
    // First and last link, offset, length, content, links.
    for (at, len) in [(0, 4), (4, 4), (8, 4), (12, 4), (16, 8), (24, 4), (28, 4), (32, 4)] {
        for value in EXTREMES {
            let hostile = with_frame(&frame, |row| put(row, at, value, len));
            if hostile != SOUND.map {
                let what = format!("{value:#x} at {at}");
                let error = verify_map(&hostile).expect_err(&what);
                assert_eq!(exit_code(error), 65, "{what}");
                let _ = ask(&hostile);
            }
        }
    }
}

/// Peak of the memory this process ever held, bytes.
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib = line.and_then(|l| l.split_whitespace().next()?.parse::<u64>().ok());
    kib.unwrap_or(0) << 10
}

#[test]
fn f48_a_bomb_is_refused_without_unpacking_it() {
    let mut bomb = zstd::Encoder::new(Vec::new(), 3).unwrap();
    let zeros = vec![0; 1 << 20];
    for _ in 0..1024 {
        std::io::Write::write_all(&mut bomb, &zeros).unwrap();
    }
    let bomb = bomb.finish().unwrap();
    assert!(bomb.len() < 1 << 20, "{} bytes hold 1 GiB", bomb.len());
    let before = peak_bytes();
    for content_bytes in [0, 1, 100, 131_072, 131_073, 1 << 30, u32::MAX.into()] {
        for n_links in [1, 100, 131_072, u32::MAX.into()] {
            let hostile = with_frame(&bomb, |row| {
                put(row, 28, content_bytes, 4);
                put(row, 32, n_links, 4);
            });
            check_refused(&hostile, &format!("{content_bytes} bytes, {n_links} links"));
        }
    }
    // The other tests of this file run beside it, each with some copies of 64 KiB files.
    assert!(peak_bytes() - before < 256 << 20, "{} bytes more", peak_bytes() - before);
}

#[test]
fn f48_a_frame_that_wants_a_window_of_2_gib_is_no_danger() {
    let (_, content) = sound_frame();
    // Magic, no flags, window 2^(10 + 21), one last raw block.
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, 21 << 3];
    frame.extend_from_slice(&((content.len() as u32) << 3 | 1).to_le_bytes()[..3]);
    frame.extend_from_slice(&content);
    let before = peak_bytes();
    let hostile = with_frame(&frame, |_| {});
    check_answers(&hostile, "a wide window");
    assert!(peak_bytes() - before < 256 << 20, "{} bytes more", peak_bytes() - before);
}

#[test]
fn f49_content_of_another_length_is_refused() {
    let (frame, content) = sound_frame();
    let n = content.len() as u64;
    for stated in [0, 1, n - 1, n + 1, 2 * n, 131_072] {
        let hostile = with_frame(&frame, |row| put(row, 28, stated, 4));
        check_refused(&hostile, &format!("{stated} bytes stated, {n} there"));
    }
    // A list more, a list less, half a varint, another frame behind.
    let mut longer = content.clone();
    [1, 1, 5].into_iter().for_each(|v| put_varint(&mut longer, v));
    let shorter = content[..content.len() / 2].to_vec();
    let torn = [&content[..], &[0x80]].concat();
    for content in [longer, shorter, torn, Vec::new()] {
        let packed = zstd::bulk::compress(&content, 3).unwrap();
        let hostile = with_frame(&packed, |row| put(row, 28, content.len() as u64, 4));
        check_refused(&hostile, &format!("{} bytes of lists", content.len()));
    }
    let twice = [&frame[..], &frame].concat();
    check_refused(&with_frame(&twice, |_| {}), "two frames in one");
}

#[test]
fn f50_what_is_no_artifact_is_named() {
    let mut swapped = SOUND.map.clone();
    swapped[..8].reverse();
    let noise: Vec<u8> = std::iter::repeat_with(|| 0x5a).take(4096).collect();
    for (bytes, named) in [
        (Vec::new(), "an empty file"),
        (b"LASF and so on".to_vec(), "a LAS or LAZ scan; ingest it first"),
        (b"ply\nformat ascii 1.0\n".to_vec(), "a PLY file; ingest it first"),
        (swapped, "0a, 1a"),
        (noise, "5a, 5a"),
        (SOUND.octree.clone(), "this is an octree, a visibility map"),
    ] {
        let error = MapView::open(&bytes).unwrap_err();
        assert!(error.to_string().contains(named), "{error}");
        assert_eq!(exit_code(error), 65);
    }
    let error = OctreeView::open(&SOUND.map).unwrap_err();
    assert!(error.to_string().contains("this is a visibility map"), "{error}");
    let folder = Folder::new();
    for bytes in [&b""[..], b"LASF", &SOUND.map] {
        let error = folder.build(bytes).unwrap_err();
        assert_eq!(error.exit_code(), 65, "{error}");
        assert!(error.to_string().contains("points.pvo"), "{error}");
    }
}

#[test]
fn f50_a_folder_or_a_file_where_the_other_belongs_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let map = folder.path().join("a.vmap");
    std::fs::create_dir(&map).unwrap();
    let error = Error::from(pvmap::Mapped::open(&map).unwrap_err());
    assert_eq!(error.exit_code(), 66, "{error}");
    assert!(error.to_string().contains("a.vmap: not a regular file"), "{error}");
    // An empty folder, and a scan, for an octree.
    let scan = folder.path().join("room.las");
    room_cloud(10).write_las(&scan, 0.0001, [0.0; 3]);
    for octree in [map, scan] {
        let output = folder.path().join("b.vmap");
        let built = pvmap::build(&octree, &output, &small_config(), &LIMITS, &Quiet);
        let error = built.expect_err("no octree");
        assert!([65, 66].contains(&error.exit_code()), "{}: {error}", error.exit_code());
    }
}

#[test]
fn f47_positions_and_frames_at_the_ends_of_their_types_never_overflow() {
    let sound = Parts::of(&SOUND.octree, Kind::Octree);
    let folder = Folder::new();
    // Least X of the frame, shift of the source, extent, scale, positions.
    let places = [
        ("frame", 56, 8),
        ("frame", 80, 8),
        ("frame", 8, 8),
        ("frame", 0, 4),
        ("sources", 80, 8),
        ("sources", 32, 8),
        ("sources", 16, 8),
        ("points", 0, 4),
        ("codes", 0, 8),
        ("normals", 0, 8),
    ];
    let floats = [f64::MAX, f64::MIN_POSITIVE, -1.0, f64::INFINITY, f64::NAN].map(f64::to_bits);
    for (name, at, len) in places {
        for value in EXTREMES.into_iter().chain(floats) {
            let mut parts = sound.clone();
            put(parts.bytes_mut(name), at, value, len);
            let hostile = parts.seal();
            let _ = verify_octree(&hostile);
            let _ = points_of(&hostile);
            if let Err(error) = folder.build(&hostile) {
                assert_eq!(error.exit_code(), 65, "{name} {at} {value:#x}: {error}");
            }
        }
    }
}
