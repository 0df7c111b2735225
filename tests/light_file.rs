//! Light files: what is written is read, damage is found, forged values are refused, and what the
//! command says of them. Sections 2 and 6 of FORMAT.md; rows F42-F47 of the catalogue of faults.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod common;
#[path = "common/invented.rs"]
mod invented;
#[path = "common/seal.rs"]
mod seal;

use std::sync::LazyLock;

use fastrand::Rng;
use pvmap::Error;
use pvmap::light::Gloss;
use pvmap::vmap::{FormatError, Kind, LightView, MapView, OctreeView};
use rayon::prelude::*;

use crate::cli_common::{Bench, room};
use crate::common::is_slow_run;
use crate::invented::{Invented, Row};
use crate::seal::{Parts, put, reseal_head};

/// The octree and the map of a small room.
static ROOM: LazyLock<Bench> = LazyLock::new(room);

/// Sections of a light file with gloss and open sky, `sums` among them.
const N_SECTIONS: usize = 9;
/// Surfel 0 shines, others reflect some of what they get.
const EMISSION: f64 = 12.0;

fn row(surfel: u32, channel: usize) -> Row {
    let i = f64::from(surfel);
    Row {
        emission: if surfel == 0 { EMISSION } else { 0.0 },
        albedo: 0.2 + 0.2 * channel as f64,
        irradiance: 0.25 * i + channel as f64,
    }
}

/// Surfel 0 has none; what others scatter in blue, mirror and let through is 1.
fn gloss(surfel: usize) -> Gloss {
    match surfel {
        0 => Gloss::default(),
        i => Gloss { specular: 0.3, transmissive: 0.1, refraction: 1.0 + i as f32 / 128.0 },
    }
}

fn of_room(n_channels: usize) -> Invented {
    let mut light = ROOM.with_map("room.vmap", |map| Invented::of(map, n_channels, row));
    light.gloss = Some((0..light.factors.len()).map(gloss).collect());
    light.sky = Some(light.factors.iter().map(|f| f.scale / 2.0).collect());
    light
}

/// A sound file in three channels, of one block.
static SOUND: LazyLock<Vec<u8>> = LazyLock::new(|| of_room(3).bytes());

fn verify(bytes: &[u8]) -> Result<(), FormatError> {
    LightView::open(bytes)?.verify()
}

/// Demands that a file is refused as damaged, and gives what is said of it.
#[track_caller]
fn refused(bytes: &[u8], what: &str) -> String {
    let error = verify(bytes).expect_err(what);
    let told = error.to_string();
    let error = Error::artifact("a.light".as_ref(), error);
    assert_eq!(error.exit_code(), 65, "{what}: {told}");
    told
}

#[test]
fn format27_what_is_written_is_read() {
    for n_channels in [1, 3] {
        let written = of_room(n_channels);
        let bytes = written.bytes();
        assert!(bytes == written.bytes(), "the same bytes each time");
        let view = LightView::open(&bytes).unwrap();
        view.verify().unwrap();
        let root = ROOM.with_map("room.vmap", |map| map.file().root());
        let summary = view.summary();
        assert_eq!((summary.map, summary.n_surfels), (root, 128));
        assert_eq!(summary.n_channels as usize, n_channels);
        assert_eq!((view.lights(), view.plan()), (Ok(&*written.lights), Ok(&*written.plan)));
        for surfel in [0, 1, 77, 127] {
            let (given, found) = (view.given(surfel).unwrap(), view.found(surfel).unwrap());
            for channel in 0..3 {
                // With one channel all three are alike.
                let Row { emission, albedo, irradiance } = row(surfel, channel % n_channels);
                assert_eq!(given[channel].emission, emission as f32);
                assert_eq!(given[channel].albedo, albedo as f32);
                assert_eq!(found[channel].irradiance, irradiance as f32);
                let b = emission + albedo * irradiance;
                assert!((f64::from(found[channel].radiosity) - b).abs() <= 1e-6 * b, "{surfel}");
            }
            assert_eq!(view.gloss(surfel).unwrap(), Some(gloss(surfel as usize)));
            assert_eq!(view.factors(surfel).unwrap(), written.factors[surfel as usize]);
            let sky = view.sky(surfel).unwrap().unwrap();
            assert_eq!(sky, (written.factors[surfel as usize].scale / 2.0) as f32);
        }
        assert!(view.given(128).is_err() && view.factors(128).is_err(), "no such surfel");
    }
    let without = Invented { gloss: None, sky: None, ..of_room(1) }.bytes();
    let view = LightView::open(&without).unwrap();
    view.verify().unwrap();
    assert!(!view.has_sky() && !view.has_gloss());
    assert_eq!((view.sky(3), view.gloss(3)), (Ok(None), Ok(None)));
}

#[test]
fn f42_every_flip_of_a_light_file_is_found() {
    (0..SOUND.len()).into_par_iter().for_each_init(
        || SOUND.clone(),
        |flipped, byte| {
            for bit in 0..8 {
                flipped[byte] ^= 1 << bit;
                refused(flipped, &format!("byte {byte} bit {bit}"));
                flipped[byte] ^= 1 << bit;
            }
        },
    );
}

#[test]
fn f44_every_truncation_of_a_light_file_is_found_on_opening() {
    for len in 0..SOUND.len() {
        assert!(LightView::open(&SOUND[..len]).is_err(), "{len} bytes");
    }
    let longer = [&SOUND[..], &[0; 64]].concat();
    assert!(matches!(LightView::open(&longer), Err(FormatError::Length { .. })));
}

#[test]
fn f46_another_version_or_an_unknown_flag_of_a_light_file_exits_78() {
    for (at, n_bytes, value) in [(12, 2, 2), (14, 2, 1), (48, 8, 1), (48, 8, 2)] {
        let mut other = SOUND.clone();
        put(&mut other, at, value, n_bytes);
        reseal_head(&mut other, N_SECTIONS);
        let error = Error::artifact("a.light".as_ref(), verify(&other).unwrap_err());
        assert_eq!(error.exit_code(), 78, "{error}");
    }
}

#[test]
fn f50_one_kind_of_artifact_for_another_is_named() {
    let told = MapView::open(&SOUND).unwrap_err().to_string();
    assert!(told.contains("this is the light of a map (.light)"), "{told}");
    let told = OctreeView::open(&SOUND).unwrap_err().to_string();
    assert!(told.contains("the light of a map (.light), an octree is needed"), "{told}");
    let told = LightView::open(&ROOM.read("room.vmap")).unwrap_err().to_string();
    assert!(told.contains("this is a visibility map (.vmap), the light of a map"), "{told}");
}

/// Seals the sound file with a change, or panics where that changes nothing.
fn forged(change: impl FnOnce(&mut Parts)) -> Vec<u8> {
    let mut parts = Parts::of(&SOUND, Kind::Light);
    assert!(parts.seal() == *SOUND, "taking apart and sealing changes nothing");
    change(&mut parts);
    let forged = parts.seal();
    assert!(forged != *SOUND, "nothing was forged");
    forged
}

#[test]
fn format28_values_that_no_surfel_has_are_refused() {
    let [nan, infinite, negative, two] =
        [f32::NAN, f32::INFINITY, -1.0, 2.0].map(|v| u64::from(v.to_bits()));
    // A row of a surfel: three channels of two numbers.
    let cases = [
        ("given", 24 * 5, vec![nan, infinite, negative, two]),
        ("given", 24 * 5 + 4, vec![nan, infinite, negative, two]),
        ("given", 24 * 127 + 20, vec![nan, negative, two]),
        ("found", 24 * 5, vec![nan, infinite, negative, two]),
        ("found", 24 * 5 + 12, vec![nan, infinite, negative, two]),
        ("sky", 4 * 9, vec![nan, infinite, negative, two]),
    ];
    for (section, at, values) in cases {
        for value in values {
            let file = forged(|parts| put(parts.bytes_mut(section), at, value, 4));
            let told = refused(&file, &format!("{section} {at}"));
            assert!(told.contains(section) || told.contains("found"), "{told}");
        }
    }
    for value in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        for at in [0, 8] {
            let put_it = |parts: &mut Parts| {
                put(parts.bytes_mut("factors"), 16 * 3 + at, value.to_bits(), 8)
            };
            let file = forged(put_it);
            refused(&file, "factors");
            assert!(LightView::open(&file).unwrap().factors(3).is_err(), "a view gives none");
        }
    }
    // 1e-5 of the radiosity is left open; more is not.
    for (share, is_sound) in [(1.0 + 5e-6, true), (1.0 - 5e-6, true), (1.0001, false)] {
        let file = forged(|parts| {
            let bytes = parts.bytes_mut("found");
            let at = 24 * 100;
            let b = f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
            put(bytes, at, (b * share).to_bits().into(), 4);
        });
        assert_eq!(verify(&file).is_ok(), is_sound, "{share}");
    }
}

#[test]
fn format33_gloss_that_no_surfel_has_is_refused() {
    let [nan, infinite, negative, half] = [f32::NAN, f32::INFINITY, -0.1, 0.5];
    // 12 bytes a surfel: mirrored, let through, the index of refraction.
    for (at, values) in [
        (12 * 5, vec![nan, infinite, negative, 0.301, 2.0]),
        (12 * 5 + 4, vec![nan, infinite, negative, 0.101]),
        (12 * 127 + 8, vec![nan, infinite, -1.5, half, 0.999]),
    ] {
        for value in values {
            let file = forged(|parts| put(parts.bytes_mut("gloss"), at, value.to_bits().into(), 4));
            assert!(refused(&file, &format!("{value} at {at}")).contains("gloss"));
        }
    }
    // 0 stands for 1, and 1e-5 of the sum is left open.
    for (at, value) in [(12 * 5 + 8, 0.0f32), (12 * 5, 0.300_005), (12 * 5, 0.0)] {
        let file = forged(|parts| put(parts.bytes_mut("gloss"), at, value.to_bits().into(), 4));
        verify(&file).unwrap();
    }
}

#[test]
fn format31_flux_that_comes_from_nowhere_is_refused() {
    let flux = |channel: usize, which: usize, value: f64| {
        forged(|parts| {
            let at = 72 + 32 * channel + 8 * which;
            put(parts.bytes_mut("summary"), at, value.to_bits(), 8);
        })
    };
    // Of 8 that are emitted 2e-3 may be wrong.
    verify(&flux(1, 1, 5.015)).unwrap();
    verify(&flux(1, 1, 4.985)).unwrap();
    for file in [flux(0, 1, 5.02), flux(2, 2, 2.98), flux(1, 0, 8.1)] {
        assert!(refused(&file, "flux").contains("flux is lost or gained"));
    }
    for value in [f64::NAN, f64::INFINITY, -1.0] {
        for which in [0, 1, 3] {
            refused(&flux(0, which, value), "a flux that is no amount");
        }
    }
    // Rows may add up to a little too much.
    verify(&flux(0, 2, 2.99)).unwrap();
}

#[test]
fn format27_a_summary_that_is_none_is_refused_on_opening() {
    // Map, surfels, channels; then errors and the exposure.
    for (at, value, n_bytes) in [
        (16, 127, 4),
        (16, 129, 4),
        (20, 0, 4),
        (20, 1, 4),
        (20, 2, 4),
        (20, 4, 4),
        (32, f64::NAN.to_bits(), 8),
        (40, f64::INFINITY.to_bits(), 8),
        (48, (-1.0f64).to_bits(), 8),
        (56, f64::NAN.to_bits(), 8),
        (64, (-1.0f64).to_bits(), 8),
        (170, 1, 1),
    ] {
        let file = forged(|parts| put(parts.bytes_mut("summary"), at, value, n_bytes));
        assert!(LightView::open(&file).is_err(), "{value:#x} at {at}");
    }
    for section in ["given", "gloss", "found", "sky", "factors"] {
        let file = forged(|parts| parts.bytes_mut(section).truncate(24 * 5));
        assert!(LightView::open(&file).is_err(), "too few rows of {section}");
    }
    // A grey file has no flux of a second channel.
    let mut grey = Parts::of(&of_room(1).bytes(), Kind::Light);
    put(grey.bytes_mut("summary"), 72 + 32, 1.0f64.to_bits(), 8);
    assert!(LightView::open(&grey.seal()).is_err());
}

#[test]
fn format32_texts_that_are_none_are_refused() {
    let text =
        |name: &'static str, bytes: &[u8]| forged(|parts| *parts.bytes_mut(name) = bytes.to_vec());
    refused(&text("lights", &[b'a', 0xff]), "no UTF-8");
    refused(&text("plan", &[0xc3]), "no UTF-8");
    refused(&text("plan", b"direct: on"), "a line without an end");
    verify(&text("plan", b"")).unwrap();
}

#[test]
fn f47_a_hostile_light_file_under_right_checksums_never_panics() {
    let n = if is_slow_run() { 100_000 } else { 4000 };
    let parts = Parts::of(&SOUND, Kind::Light);
    let refused = (0..n).into_par_iter().filter(|&seed| {
        let mut rng = Rng::with_seed(seed);
        let mut parts = parts.clone();
        for _ in 0..rng.usize(1..4) {
            let i = rng.usize(..parts.sections.len());
            let bytes = &mut parts.sections[i].2;
            let at = rng.usize(..bytes.len());
            let end = (at + rng.usize(1..40)).min(bytes.len());
            bytes[at..end].iter_mut().for_each(|b| *b = rng.u8(..));
            if rng.u8(..8) == 0 {
                bytes.truncate(at);
            }
        }
        let hostile = parts.seal();
        if let Ok(view) = LightView::open(&hostile) {
            for surfel in 0..view.summary().n_surfels.min(200) {
                let _ = (view.given(surfel), view.found(surfel), view.sky(surfel));
                let _ = view.gloss(surfel);
            }
        }
        verify(&hostile).is_err()
    });
    let refused = refused.count() as u64;
    assert!(refused > n / 2, "{refused} of {n} refused");
}

#[test]
fn what_cannot_be_stored_is_named_and_nothing_is_left() {
    let bench = Bench::new();
    let path = bench.path("a.light");
    for (change, named) in [
        (Row { irradiance: f64::NAN, ..row(3, 0) }, "light of surfel 3"),
        (Row { irradiance: 1e39, ..row(3, 0) }, "light of surfel 3"),
        (Row { emission: -1.0, ..row(3, 0) }, "emission and albedo of surfel 3"),
        (Row { albedo: 1.5, ..row(3, 0) }, "emission and albedo of surfel 3"),
    ] {
        let mut light = of_room(1);
        light.channels[0][3] = change;
        let error = light.write(&path).unwrap_err();
        assert_eq!(error.exit_code(), 65);
        assert!(error.to_string().contains(named), "{error}");
    }
    let mut light = of_room(1);
    light.gloss.as_mut().unwrap()[7].refraction = 0.5;
    assert!(light.write(&path).unwrap_err().to_string().contains("gloss of surfel 7"));
    let mut light = of_room(1);
    light.factors[9].scale = 0.0;
    assert!(light.write(&path).unwrap_err().to_string().contains("factors of surfel 9"));
    assert!(bench.names().is_empty(), "{:?}", bench.names());
    bench.write("a.light", "my own notes");
    let error = of_room(1).write(&path).unwrap_err();
    assert_eq!(error.exit_code(), 73, "{error}");
    assert_eq!(bench.read("a.light"), b"my own notes");
    std::fs::remove_file(&path).unwrap();
    of_room(1).write(&path).unwrap();
    of_room(3).write(&path).unwrap();
    assert!(bench.read("a.light") == *SOUND, "a light file is replaced");
}

#[test]
fn info_and_verify_know_light_files() {
    let bench = Bench::new();
    bench.write("room.light", &*SOUND);
    bench.write("grey.light", of_room(1).bytes());
    for (name, line) in [
        ("info_light", "info room.light"),
        ("info_light_json", "info room.light --json"),
        ("info_light_grey", "info grey.light"),
    ] {
        // The root of the map is that of its bytes, which other changes change.
        let root = ROOM.with_map("room.vmap", |map| format!("{:032x}", map.file().root()));
        let told = bench.line(line).ok().stdout;
        assert!(told.contains(&root), "{told}");
        insta::assert_snapshot!(name, told.replace(&root, "ROOT"));
    }
    let told = bench.line("verify room.light").ok().stdout;
    assert_eq!(told, "room.light: sound\n");
    let mut damaged = SOUND.clone();
    damaged[700] ^= 1;
    bench.write("damaged.light", damaged);
    bench.line("verify damaged.light").fails(65, &["damaged.light", "checksum"]);
    bench.line("info room.light --quality").fails(2, &["is light", "give the octree"]);
    bench.line("query room.light pair 0,0,1 0,0,-1").fails(65, &["the light of a map"]);
    bench.line("build room.light").fails(65, &["not an octree"]);
}
