//! Light shown: between surfels, in pictures and on points. Light files are of invented values.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
#[path = "common/invented.rs"]
mod invented;

use std::fmt::Write as _;

use cli_common::{Bench, Run, ply_header, room};
use invented::{Invented, Row};
use pvmap::geometry::PointBatch;
use pvmap::light::{Gloss, Irradiance, LightError, areas_grid2};
use pvmap::scan::{ReadOptions, Source};
use pvmap::vmap::MapView;

/// A surfel that reflects half of what arrives and does not shine.
fn plain(irradiance: f64) -> Row {
    Row { emission: 0.0, albedo: 0.5, irradiance }
}

/// Writes light for the map of a room, and says how many surfels it has.
fn light(bench: &Bench, name: &str, n_channels: usize, row: impl Fn(u32, usize) -> Row) -> u32 {
    bench.with_map("room.vmap", |map| {
        Invented::of(map, n_channels, row).write(&bench.path(name)).unwrap();
        map.summary().n_surfels
    })
}

/// Takes the irradiance of all surfels of a map.
fn lit_by(map: &MapView<'_>, irradiance: &[[f32; 3]]) -> Result<Irradiance, LightError> {
    Irradiance::new(map, &areas_grid2(map).unwrap(), irradiance)
}

/// Gives the places of all surfels of a map with their normals, and asks for light there.
fn surfels(map: &MapView<'_>) -> Vec<([u32; 3], [f32; 3])> {
    let one = |id| {
        let s = map.surfel(id).unwrap();
        (s.centroid, s.normal.map(|v| f32::from(v) / 16384.0))
    };
    (0..map.summary().n_surfels).map(one).collect()
}

/// A floor and a wall that stand in a corner at x = -1, coloured by halves: y below 0 is black
/// and white in turns, the rest is grey.
fn corner_ply() -> String {
    let names = ["x", "y", "z", "nx", "ny", "nz"];
    let colors = ["red", "green", "blue"].map(|c| format!("property uchar {c}\n")).concat();
    let n = 64;
    let header = ply_header(2 * n * n, &names).replace("end_header", &(colors + "end_header"));
    let mut text = header;
    for i in 0..n * n {
        let [u, v] = [i % n, i / n].map(|v| 2.0 * f64::from(v) / f64::from(n - 1) - 1.0);
        let turn = if (i + i / n) % 2 == 0 { 0 } else { 230 };
        let color = if v < 0.0 { turn } else { 128 };
        writeln!(text, "{u} {v} -1 0 0 1 {color} {color} {color}").unwrap();
        writeln!(text, "-1 {v} {} 1 0 0 {color} {color} {color}", u + 0.001).unwrap();
    }
    text
}

fn corner() -> Bench {
    let bench = Bench::new();
    bench.write("room.ply", corner_ply());
    bench.line("ingest room.ply").ok();
    bench.line("build").ok();
    bench
}

#[test]
fn light_of_one_value_has_it_everywhere() {
    let bench = corner();
    bench.with_map("room.vmap", |map| {
        let surfels = surfels(map);
        let lit = lit_by(map, &vec![[0.3, 7.0, 1e-6]; surfels.len()]).unwrap();
        for (id, &(place, normal)) in (0..).zip(&surfels) {
            for step in [0, 9_000, 40_000, 90_000] {
                let found = lit.at([place[0], place[1] + step, place[2]], normal, id);
                let off = [0.3f32, 7.0, 1e-6].map(f64::from);
                assert!((0..3).all(|i| (found[i] / off[i] - 1.0).abs() < 1e-12), "{found:?}");
            }
        }
        // Of one surfel alone, and of none in whose reach a place is, it is that to the bit.
        let far = lit.at([1 << 21, 1 << 21, 1 << 21], [0.0; 3], 5);
        assert_eq!(far, [0.3f32, 7.0, 1e-6].map(f64::from));
        assert!(lit_by(map, &[[1.0; 3]]).is_err(), "as many as surfels");
    });
    let one = Bench::new();
    let mut text = ply_header(9, &["x", "y", "z", "nx", "ny", "nz"]);
    (0..9).for_each(|i| writeln!(text, "{} {} 0 0 0 1", i % 3, i / 3).unwrap());
    one.write("room.ply", text);
    one.line("ingest room.ply").ok();
    one.line("build").ok();
    one.with_map("room.vmap", |map| {
        let alone = lit_by(map, &[[0.1, 0.2, 0.3]]).unwrap();
        let found = alone.at([7, 1 << 20, 0], [0.0, 0.0, 1.0], 0);
        assert_eq!(found, [0.1f32, 0.2, 0.3].map(f64::from));
    });
}

#[test]
fn light_of_another_surface_does_not_get_round_a_corner() {
    let bench = corner();
    bench.with_map("room.vmap", |map| {
        let surfels = surfels(map);
        let is_floor = |normal: [f32; 3]| normal[2] > 0.9;
        let values: Vec<_> =
            surfels.iter().map(|s| if is_floor(s.1) { [1.0; 3] } else { [9.0; 3] }).collect();
        let lit = lit_by(map, &values).unwrap();
        for (id, (place, normal)) in (0..).zip(&surfels) {
            let expected = if is_floor(*normal) { 1.0 } else { 9.0 };
            // Into the corner, on the surface.
            for share in [0, 1, 4] {
                let mut at = *place;
                let along = if is_floor(*normal) { 0 } else { 2 };
                at[along] = at[along] * share / 4;
                let found = lit.at(at, *normal, id);
                assert!((found[0] - expected).abs() < 1e-12, "{id}: {found:?}");
            }
        }
    });
}

#[test]
fn light_changes_smoothly_where_surfels_change_hard() {
    let bench = room();
    bench.with_map("room.vmap", |map| {
        let surfels = surfels(map);
        let floor: Vec<u32> =
            (0..).zip(&surfels).filter(|(_, s)| s.1[2] > 0.9).map(|(id, _)| id).collect();
        let mut rng = fastrand::Rng::with_seed(3);
        let values: Vec<_> = surfels.iter().map(|_| [rng.f32(); 3]).collect();
        let lit = lit_by(map, &values).unwrap();
        let own = |x: u32, y: u32| {
            let away = |&id: &u32| {
                let [cx, cy, _] = surfels[id as usize].0;
                u64::from(cx.abs_diff(x)).pow(2) + u64::from(cy.abs_diff(y)).pow(2)
            };
            floor.iter().copied().min_by_key(away).unwrap()
        };
        let n_steps = 4096;
        for y in [300_000, 2_000_000] {
            let at = |i: u32| {
                let x = i * ((1 << 22) / n_steps);
                lit.at([x, y, 0], [0.0, 0.0, 1.0], own(x, y))[0]
            };
            let line: Vec<f64> = (0..n_steps).map(at).collect();
            assert!(line.iter().all(|v| (0.0..=1.0).contains(v)));
            let range = line.iter().fold((1.0f64, 0.0f64), |r, &v| (r.0.min(v), r.1.max(v)));
            assert!(range.1 - range.0 > 0.2, "it does change: {range:?}");
            // Eight surfels of 512 steps each in a row; a block would be a jump of some tenths.
            let jump = line.windows(2).map(|w| (w[1] - w[0]).abs()).fold(0.0, f64::max);
            assert!(jump < 0.005, "{jump}");
        }
    });
}

/// A decoded picture.
fn png(bench: &Bench, name: &str) -> Vec<[u8; 3]> {
    let bytes = bench.read(name);
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    pixels.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect()
}

const FLOOR: &str = "--size 60x60 --camera 0,0,9,0,0,-1 --up 0,1,0 --ortho=1.5";

#[test]
fn pictures_have_the_light_of_surfels_without_shade() {
    let bench = room();
    light(&bench, "room.light", 3, |_, c| plain([0.2, 1.0, 2.4][c]));
    for octree in ["", "--octree room.octree"] {
        let line = format!("render room.vmap {octree} --light room.light {FLOOR} -o a.png");
        bench.line(&format!("{line} --exposure 1")).ok();
        // 0.1, 0.5 and 1.2 in sRGB.
        assert!(png(&bench, "a.png").iter().all(|&p| p == [89, 188, 255]), "{octree}");
        bench.line(&format!("{line} --exposure 0.5")).ok();
        assert!(png(&bench, "a.png").iter().all(|&p| p == [63, 137, 203]), "{octree}");
        // The brightest channel becomes 0.8.
        let run = bench.line(&line).ok();
        assert!(run.stderr.contains("--exposure 0.6667"), "{}", run.stderr);
        let auto = bench.read("a.png");
        bench.line(&format!("{line} --exposure 0.6667")).ok();
        assert!(auto == bench.read("a.png"), "what is said can be given again");
    }
}

#[test]
fn the_exposure_looks_at_what_does_not_shine() {
    let bench = room();
    // Half of the floor glows, a hundred times as bright.
    let n = light(&bench, "room.light", 1, |s, _| match s % 4 {
        0 => Row { emission: 100.0, albedo: 0.5, irradiance: 1.0 },
        1 => plain(0.0),
        _ => plain(4.0),
    });
    assert!(n >= 100, "{n}");
    let line = format!("render room.vmap --light room.light {FLOOR} -o a.png");
    let run = bench.line(&line).ok();
    assert!(run.stderr.contains("--exposure 0.4\n"), "{}", run.stderr);
    light(&bench, "lamps.light", 1, |_, _| Row { emission: 100.0, albedo: 0.0, irradiance: 1.0 });
    let run = bench.line(&line.replace("room.light", "lamps.light")).ok();
    assert!(run.stderr.contains("--exposure 0.008\n"), "{}", run.stderr);
    light(&bench, "dark.light", 1, |_, _| plain(0.0));
    let run = bench.line(&line.replace("room.light", "dark.light")).ok();
    assert!(run.stderr.contains("--exposure 1\n"), "{}", run.stderr);
    assert!(png(&bench, "a.png").iter().all(|&p| p == [0; 3]));
}

#[test]
fn a_mirror_in_a_picture_shows_what_is_seen_in_it() {
    let bench = room();
    // The lower plate mirrors half and scatters nothing, the upper shines.
    let row = |is_floor: bool, c: usize| match is_floor {
        true => Row { emission: 0.0, albedo: 0.0, irradiance: 1.0 },
        false => Row { emission: [1.0, 2.0, 4.0][c], albedo: 0.0, irradiance: 0.0 },
    };
    bench.with_map("room.vmap", |map| {
        let surfels = surfels(map);
        let is_floor = |id: u32| surfels[id as usize].1[2] > 0.9;
        let mirror = Gloss { specular: 0.5, ..Gloss::default() };
        let gloss = |id| if is_floor(id) { mirror } else { Gloss::default() };
        let light = Invented::of(map, 3, |id, c| row(is_floor(id), c));
        light.write(&bench.path("plain.light")).unwrap();
        let gloss = (0..surfels.len() as u32).map(gloss).collect();
        Invented { gloss: Some(gloss), ..light }.write(&bench.path("room.light")).unwrap();
    });
    let line = |light: &str, more: &str| {
        let camera = "--camera=0,-0.5,0.9,0,0,-1 --fov 20 --size 40x40 --exposure 0.2";
        bench.line(&format!("render room.vmap --light {light} {camera} -o a.png {more}")).ok()
    };
    let run = line("room.light", "");
    assert!(run.stderr.contains("mirrors: 1600 pixels, 1600 rays"), "{}", run.stderr);
    let shown = png(&bench, "a.png");
    // 0.2 of half of 1, 2 and 4 in sRGB, and of π, the sky of radiance 1 past the plate's edge.
    let is_either = |pixel: &[u8; 3]| [[89, 124, 170], [152; 3]].contains(pixel);
    assert!(shown.iter().all(is_either) && shown[20] == [152; 3]);
    // On a lattice a ray in a hundred slips between patches.
    let n_plate = shown[800..].iter().filter(|pixel| **pixel == [89, 124, 170]).count();
    assert!(n_plate >= 790, "{n_plate} of 800");
    for threads in [1, 2, 8] {
        line("room.light", &format!("--threads {threads}"));
        assert!(png(&bench, "a.png") == shown, "{threads} threads");
    }
    for (light, more) in [("room.light", "--no-mirrors"), ("plain.light", "")] {
        let run = line(light, more);
        assert!(!run.stderr.contains("mirrors"), "no ray is followed: {}", run.stderr);
        assert!(png(&bench, "a.png").iter().all(|&pixel| pixel == [0; 3]));
    }
    bench.line("render room.vmap --no-mirrors -o a.png").fails(2, &["--light"]);
}

#[test]
fn light_of_another_map_and_other_nonsense_is_refused() {
    let bench = room();
    light(&bench, "room.light", 1, |_, _| plain(1.0));
    bench.line("build --config preview -o other.vmap").ok();
    let root = |map: &str| bench.with_map(map, |map| format!("{:032x}", map.file().root()));
    let (of_light, of_other) = (root("room.vmap"), root("other.vmap"));
    let words = ["room.light", "other.vmap", &of_light, &of_other, "pvmap light"];
    bench.line("render other.vmap --light room.light -o a.png").fails(65, &words);
    let export = "export other.vmap --octree room.octree --points a.las --light room.light";
    bench.line(&format!("{export} --field radiosity")).fails(65, &words);
    bench.line("render room.vmap --light room.vmap -o a.png").fails(65, &["visibility map"]);
    bench.line("render room.octree --light room.light -o a.png").fails(2, &["needs surfels"]);
    bench.line("render room.vmap --exposure 2 -o a.png").fails(2, &["--light"]);
    for exposure in ["0", "-1", "nan", "inf", "much"] {
        let line = format!("render room.vmap --light room.light -o a.png --exposure={exposure}");
        bench.line(&line).fails(2, &["above 0, or auto"]);
    }
    let both = "render room.vmap --light room.light --color-by normal -o a.png";
    bench.line(both).fails(2, &["cannot be used with"]);
    bench.line("render room.vmap --light room.light -o room.light").fails(2, &["the inputs"]);
    let export = "export room.vmap --points a.las";
    for field in ["radiosity", "irradiance", "sky-view"] {
        bench.line(&format!("{export} --field {field}")).fails(2, &[field, "--light NAME.light"]);
    }
    let light = "--light room.light";
    bench.line(&format!("{export} {light} --field leaf")).fails(2, &["--field radiosity"]);
    let words = ["room.light", "no open sky", "--force sky"];
    bench.line(&format!("{export} {light} --field sky-view")).fails(65, &words);
    assert!(!bench.path("a.las").exists() && !bench.path("a.png").exists());
}

/// Reads a file of points.
fn read(bench: &Bench, name: &str) -> PointBatch {
    let source = Source::open(&bench.path(name), 0, ReadOptions::default()).unwrap();
    let n = source.info().n_points;
    let mut all = None;
    source
        .read(0..n, n as usize, |batch| {
            all = Some(batch.clone());
            Ok::<(), pvmap::scan::ScanError>(())
        })
        .unwrap();
    all.unwrap()
}

/// Gives the rows of a binary PLY of an export by the names of its numbers.
fn rows(bench: &Bench, name: &str, wanted: &[&str]) -> Vec<Vec<f64>> {
    let bytes = bench.read(name);
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let head = String::from_utf8_lossy(&bytes[..at]).into_owned();
    let properties: Vec<(usize, &str, &str)> = head
        .lines()
        .filter_map(|l| l.strip_prefix("property "))
        .scan(0, |offset, line| {
            let (kind, name) = line.split_once(' ').unwrap();
            let at = *offset;
            *offset += match kind {
                "double" => 8,
                "float" | "uint" => 4,
                "ushort" => 2,
                _ => 1,
            };
            Some((at, kind, name))
        })
        .collect();
    let last = properties.last().unwrap();
    let n_bytes = last.0 + if last.1 == "float" { 4 } else { 1 };
    let number = |row: &[u8], name: &str| {
        let (at, kind, _) = properties.iter().find(|p| p.2 == name).unwrap_or_else(|| {
            panic!("no {name} in {head}");
        });
        match *kind {
            "float" => f64::from(f32::from_le_bytes(row[*at..at + 4].try_into().unwrap())),
            _ => f64::from(row[*at]),
        }
    };
    let of = |row: &[u8]| wanted.iter().map(|name| number(row, name)).collect();
    bytes[at..].chunks_exact(n_bytes).map(of).collect()
}

fn export(bench: &Bench, words: &str) -> Run {
    bench.line(&format!("export room.vmap --light room.light {words}"))
}

#[test]
fn points_get_the_light_that_leaves_them_and_the_colour_of_it() {
    let bench = corner();
    light(&bench, "room.light", 3, |_, c| Row {
        emission: 0.25,
        albedo: 0.5,
        irradiance: [0.5, 1.0, 2.0][c],
    });
    export(&bench, "--points a.ply --field radiosity --field irradiance --exposure 0.4").ok();
    let names = ["y", "radiosity_red", "radiosity_green", "radiosity_blue", "irradiance_blue"];
    let light = rows(&bench, "a.ply", &[&names[..], &["red", "green", "blue"]].concat());
    assert_eq!(light.len(), 2 * 64 * 64);
    let grey: Vec<_> = light.iter().filter(|row| row[0] > 0.3).collect();
    for row in &grey {
        for (found, expected) in row[1..5].iter().zip([0.5, 0.75, 1.25, 2.0]) {
            // The scan's colour is even here, and so is the albedo.
            assert!((found - expected).abs() < 0.01 * expected, "{row:?}");
        }
        // 0.2, 0.3 and 0.5 in sRGB.
        for (found, expected) in row[5..].iter().zip([124.0, 149.0, 188.0]) {
            assert!((found - expected).abs() <= 1.0, "{row:?}");
        }
    }
    // The texture of the scan is sharp: black points have no light but what they emit.
    let black = light.iter().filter(|row| row[0] < -0.3 && row[1] == 0.25).count();
    let bright = light.iter().filter(|row| row[0] < -0.3 && row[1] > 0.6).count();
    assert!(black > 1000 && bright > 1000, "{black} {bright}");
    assert!(light.iter().all(|row| row[4] == 2.0), "irradiance knows no texture");
    // Nothing reflects more than what arrives.
    assert!(light.iter().all(|row| row[3] <= 2.25 + 1e-6));
}

#[test]
fn colours_have_sixteen_bits_in_a_las_and_stand_where_a_scan_has_none() {
    let bench = room();
    light(&bench, "room.light", 1, |_, _| plain(1.0));
    let says = export(&bench, "--points a.las --field radiosity --exposure 1").ok();
    assert!(says.stdout.contains("new fields: radiosity\n"), "{}", says.stdout);
    let points = read(&bench, "a.las");
    // 0.5 in sRGB of sixteen bits.
    assert!(points.color.unwrap().iter().all(|&c| c == [48_192; 3]));
    export(&bench, "--points a.laz --field radiosity --exposure 1").ok();
    assert!(read(&bench, "a.laz").color.unwrap().iter().all(|&c| c == [48_192; 3]));
    let says = export(&bench, "--points a.ply --field radiosity").ok();
    assert!(says.stderr.contains("--exposure 1.6"), "{}", says.stderr);
    assert!(read(&bench, "a.ply").color.unwrap().iter().all(|&c| c == [231; 3]));
    let gray = rows(&bench, "a.ply", &["radiosity", "red"]);
    assert!(gray.iter().all(|row| *row == [0.5, 231.0]));
    export(&bench, "--points b.ply --field irradiance").ok();
    assert!(read(&bench, "b.ply").color.is_none(), "irradiance is numbers alone");
}

#[test]
fn a_scan_written_again_has_the_numbers_and_keeps_its_colours() {
    let bench = corner();
    light(&bench, "room.light", 3, |_, c| plain(c as f64));
    export(&bench, "--scan room.ply --points a.ply --field radiosity --field leaf").ok();
    let text = String::from_utf8(bench.read("a.ply")).unwrap();
    let before = String::from_utf8(bench.read("room.ply")).unwrap();
    let names = "property float radiosity_red\nproperty float radiosity_green\n\
                 property float radiosity_blue\nproperty uint leaf\nend_header";
    assert!(text.contains(names), "{}", &text[..900]);
    let body = |text: &str| -> Vec<Vec<f64>> {
        let rows = text.split_once("end_header\n").unwrap().1.lines();
        rows.map(|l| l.split_whitespace().map(|v| v.parse().unwrap()).collect()).collect()
    };
    let (now, before) = (body(&text), body(&before));
    assert_eq!(now.len(), before.len());
    for (now, before) in now.iter().zip(&before) {
        assert_eq!(now[..9], before[..]);
        assert_eq!(now[9], 0.0);
        assert!(now[11] <= 2.0);
    }
}

#[test]
fn the_open_sky_of_a_surfel_is_that_of_its_points() {
    let bench = room();
    let n = bench.with_map("room.vmap", |map| {
        let mut light = Invented::of(map, 1, |_, _| plain(1.0));
        let n = map.summary().n_surfels;
        light.sky = Some((0..n).map(|s| f64::from(s) / f64::from(n)).collect());
        light.write(&bench.path("room.light")).unwrap();
        f64::from(n)
    });
    export(&bench, "--points a.ply --field sky-view").ok();
    export(&bench, "--points b.ply --field leaf --field sky-view").ok();
    let found = rows(&bench, "a.ply", &["sky_view"]);
    assert!(found.iter().any(|row| row[0] > 0.9) && found.iter().any(|row| row[0] < 0.1));
    assert!(found.iter().all(|row| ((row[0] * n).round() / n - row[0]).abs() < 1e-6));
}

#[test]
fn d8_threads_and_memory_change_no_byte_of_lit_points() {
    let bench = corner();
    light(&bench, "room.light", 3, |s, c| plain(f64::from(s % 7) + c as f64));
    let fields = "--field radiosity --field irradiance";
    export(&bench, &format!("--points a.laz --threads 1 {fields}")).ok();
    for more in ["--threads 2", "--threads 3 --memory 64MiB"] {
        export(&bench, &format!("--points b.laz {more} {fields}")).ok();
        assert!(bench.read("a.laz") == bench.read("b.laz"), "{more}");
    }
}
