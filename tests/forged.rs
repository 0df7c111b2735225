//! Forged artifacts: nonsense under right checksums, as a hostile program would write it. None
//! brings a panic or a huge allocation, and what breaks a rule of FORMAT.md is refused.
//! Source: DESIGN.md [D-12]; rows F47-F49 of the catalogue of faults.
//!
//! Where PVMAP_SLOW_TESTS is set, more of them.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
#[path = "common/seal.rs"]
mod seal;
#[path = "common/sound.rs"]
mod sound;

use std::sync::LazyLock;

use fastrand::Rng;
use pvmap::geometry::disc::Profile;
use pvmap::query::Map;
use pvmap::vmap::links::{LinkEncoder, put_varint};
use pvmap::vmap::records::Record;
use pvmap::vmap::tree::Nodes;
use pvmap::vmap::{FormatError, Kind, MapView};
use pvmap::{BuildConfig, Error};
use rayon::prelude::*;

use crate::common::{is_slow_run, on_threads};
use crate::seal::{Parts, ROW, put, reseal_head};
use crate::sound::{
    BLOCK, Folder, N_MAP_SECTIONS, N_OCTREE_SECTIONS, SOUND, artifacts, ask, check_answers,
    exit_code, points_of, small_config, verify_map, verify_octree,
};

/// A small sound map of profile `oriented`.
static ORIENTED: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let config = BuildConfig { profile: Profile::Oriented, ..small_config() };
    artifacts(folder.path(), 900, &config).1
});

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
    let maps = [&SOUND.map, &*ORIENTED].map(|map| {
        let parts = Parts::of(map, Kind::Map);
        assert!(parts.seal() == *map, "taking apart and sealing changes nothing");
        parts
    });
    let refused = (0..n).into_par_iter().map(|seed| {
        let mut rng = Rng::with_seed(seed);
        let mut parts = maps[seed as usize % 2].clone();
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

/// Writes pairs as sections of frames and their index.
fn frames_of(pairs: &[(u32, u32)]) -> (Vec<u8>, Vec<u8>) {
    let mut encoder = LinkEncoder::new().unwrap();
    let mut frames: Vec<_> = pairs.iter().filter_map(|&p| encoder.push(p).unwrap()).collect();
    frames.extend(encoder.finish().unwrap());
    let index = frames.iter().flat_map(|(block, _)| block.to_bytes()).collect();
    (frames.into_iter().flat_map(|(_, frame)| frame).collect(), index)
}

#[test]
fn f24_fractions_that_no_map_has_are_refused() {
    verify_map(&SOUND.map).unwrap();
    let sound = Parts::of(&SOUND.map, Kind::Map);
    let view = MapView::open(&SOUND.map).unwrap();
    let found = view.fractions().unwrap();
    let pairs: Vec<(u32, u32)> = (0..found.n_blocks())
        .flat_map(|i| found.lists(i).unwrap().iter().collect::<Vec<_>>())
        .collect();
    let with = |pairs: &[(u32, u32)]| {
        let mut parts = sound.clone();
        let (frames, index) = frames_of(pairs);
        *parts.bytes_mut("fraction") = frames;
        *parts.bytes_mut("fracidx") = index;
        put(parts.bytes_mut("summary"), 56, pairs.len() as u64, 8);
        parts
    };
    assert!(with(&pairs).seal() == SOUND.map, "the same fractions are the same map");
    let refused = |parts: &Parts, what: &str| {
        let error = verify_map(&parts.seal()).expect_err(what);
        let told = error.to_string();
        assert_eq!(exit_code(error), 65, "{what}");
        told
    };
    let (a, numbers) = pairs[0];
    let n_nodes = view.summary().n_nodes;
    let leaf = (0..n_nodes).find(|&id| view.node(id).unwrap().is_leaf()).unwrap();
    let above = (a + 1..n_nodes).find(|&id| !view.node(id).unwrap().is_leaf()).unwrap();
    for (pair, told) in [
        ((a, numbers / 32 * 32 + 17), "more free segments"),
        ((a, numbers / 32 * 32 + 31), "more free segments"),
        ((a, numbers / 32 * 32 + (numbers + 1) % 16), "two visible fractions"),
        ((a, n_nodes * 32), "a node of no tree"),
        ((0, leaf * 32 + 8), "one below it"),
        ((a, above * 32 + 8), "no leaves"),
    ] {
        let mut more = pairs.clone();
        more.push(pair);
        more.sort_unstable();
        more.dedup();
        let said = refused(&with(&more), told);
        assert!(said.contains(told), "{said}");
    }
    let mut parts = with(&pairs);
    put(parts.bytes_mut("summary"), 56, pairs.len() as u64 + 1, 8);
    refused(&parts, "one more than there are");
    let mut parts = sound.clone();
    let config = parts.bytes_mut("config");
    *config = String::from_utf8(config.clone()).unwrap().replace("fractions = true\n", "").into();
    refused(&parts, "fractions that the configuration does not name");
    let mut parts = sound.clone();
    parts.sections.retain(|(name, ..)| !name.starts_with("frac"));
    refused(&parts, "a configuration that names fractions where there are none");
}

#[test]
fn f22_rectangles_that_no_map_has_are_refused() {
    verify_map(&ORIENTED).unwrap();
    let sound = Parts::of(&ORIENTED, Kind::Map);
    let refused = |change: &dyn Fn(&mut Parts)| {
        let mut parts = sound.clone();
        change(&mut parts);
        let error = verify_map(&parts.seal()).expect_err("no rectangle of a map");
        assert_eq!(exit_code(error), 65);
    };
    // A row: two axes, then the least and the greatest offset along each.
    let values: [(usize, usize, u64); 8] = [
        (0, 2, (1 << 14) + 1),
        (12, 4, 0),
        (12, 4, 1),
        (12, 4, (-(1i32 << 25)) as u32 as u64),
        (16, 4, 0),
        (16, 4, u32::MAX.into()),
        (24, 4, 1 << 25),
        (20, 4, 0),
    ];
    for (at, len, value) in values {
        refused(&|parts| put(parts.bytes_mut("rects"), 28 * 5 + at, value, len));
    }
    refused(&|parts| parts.bytes_mut("rects")[28 * 3..28 * 4].fill(0));
    refused(&|parts| parts.bytes_mut("rects").truncate(28));
    refused(&|parts| drop(parts.sections.pop()));
    let profile = |name: &'static str| {
        move |parts: &mut Parts| {
            let config = parts.bytes_mut("config");
            *config = String::from_utf8(config.clone()).unwrap().replace("oriented", name).into();
        }
    };
    refused(&profile("patch"));
    refused(&profile("tilted"));
    // Nor has a map of another profile a name of this.
    let mut parts = Parts::of(&SOUND.map, Kind::Map);
    let config = String::from_utf8(parts.bytes_mut("config").clone()).unwrap();
    *parts.bytes_mut("config") = config.replace("\"patch\"", "\"oriented\"").into();
    let hostile = parts.seal();
    assert_eq!(exit_code(verify_map(&hostile).unwrap_err()), 65);
    assert!(Map::open(&hostile).is_err(), "a query of rectangles that are not there");
}

#[test]
fn f47_a_hostile_octree_under_right_checksums_never_panics_a_build() {
    let n = if is_slow_run() { 20_000 } else { 1000 };
    let parts = Parts::of(&SOUND.octree, Kind::Octree);
    assert!(parts.seal() == SOUND.octree, "taking apart and sealing changes nothing");
    on_threads(n, |seed| {
        let folder = Folder::new();
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
    // The fields of the 40-byte row of a node.
    let small = [(32, 1), (33, 1), (34, 1), (35, 1), (36, 4)];
    let fields = [(0, 4), (4, 4), (8, 4), (12, 4), (16, 8), (24, 8)].into_iter().chain(small);
    for id in [0, 1, 2, n_nodes / 2, n_nodes - 1] {
        for (at, len) in fields.clone() {
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
    assert!(view.links().lists(0).is_err(), "{what}");
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
    for content_bytes in [0, 1, 100, 32_768, 32_769, 131_072, 1 << 30, u32::MAX.into()] {
        for n_links in [1, 100, 32_768, u32::MAX.into()] {
            let hostile = with_frame(&bomb, |row| {
                put(row, 28, content_bytes, 4);
                put(row, 32, n_links, 4);
            });
            check_refused(&hostile, &format!("{content_bytes} bytes, {n_links} links"));
        }
    }
    // The other tests of this file run beside it, each with some copies of 64 KiB files. The kernel
    // counts pages in batches: what it tells may even shrink a little.
    let more = peak_bytes().saturating_sub(before);
    assert!(more < 256 << 20, "{more} bytes more");
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
    for stated in [0, 1, n - 1, n + 1, 2 * n, 32_768] {
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
