//! Damaged artifacts: flipped bits, lost and swapped pages, cuts, other versions, other files. Each
//! is noticed; none brings a panic or a wrong answer. Source: DESIGN.md [D-12]; rows F42-F46 and
//! F50 of the catalogue of faults.
//!
//! A plain run flips every bit and cuts at every byte for `verify`, and asks questions of a sample
//! of the damaged files; where PVMAP_SLOW_TESTS is set it asks all of them.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
#[path = "common/seal.rs"]
mod seal;
#[path = "common/sound.rs"]
mod sound;

use fastrand::Rng;
use pvmap::query::{Map, QueryError};
use pvmap::vmap::{FormatError, MapView, OctreeView};
use pvmap::{BuildConfig, Error, Quiet};
use rayon::prelude::*;

use crate::common::{LIMITS, is_slow_run, on_threads, room_cloud};
use crate::seal::{put, reseal_head};
use crate::sound::{
    BLOCK, Folder, N_MAP_SECTIONS, N_OCTREE_SECTIONS, SOUND, artifacts, ask, check_answers,
    exit_code, points_of, small_config, verify_map, verify_octree,
};

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

#[test]
fn f42_random_flips_of_a_larger_map_are_found() {
    let n = if is_slow_run() { 100_000 } else { 300 };
    let folder = tempfile::tempdir().unwrap();
    let config = BuildConfig { max_level: 7, leaf_capacity: 4, ..BuildConfig::default() };
    let (_, map) = artifacts(folder.path(), 20_000, &config);
    assert!(map.len() > 4 * BLOCK, "{} bytes", map.len());
    (0..n).into_par_iter().for_each_init(
        || map.clone(),
        |flipped, seed| {
            let bit = Rng::with_seed(seed).usize(..8 * map.len());
            flipped[bit / 8] ^= 1 << (bit % 8);
            let found = verify_map(flipped).expect_err("a flip that verify does not see");
            assert_eq!(exit_code(found), 65, "bit {bit}");
            flipped[bit / 8] ^= 1 << (bit % 8);
        },
    );
}

#[test]
fn f42_a_flipped_octree_builds_the_same_map_or_none() {
    let n = if is_slow_run() { 5000 } else { 200 };
    on_threads(n, |seed| {
        let folder = Folder::new();
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
        [(12, 2, 0), (12, 2, 2), (12, 2, 65_535), (14, 2, 1), (48, 8, 4), (48, 8, 1 << 63)];
    let folder = Folder::new();
    for (at, n_bytes, value) in patches {
        let mut map = SOUND.map.clone();
        put(&mut map, at, value, n_bytes);
        reseal_head(&mut map, N_MAP_SECTIONS);
        let error = MapView::open(&map).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("1.0") || at == 48, "{message}");
        assert!(message.contains("use a newer pvmap"), "{message}");
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
