//! `lights.toml`: what it may say, where a fault stands, and what surfels get of it.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use fastrand::Rng;
use pvmap::light::{Elements, Lamp, Sky};
use pvmap::lights::{Assigned, EXAMPLE, Lights, majority_classes};
use pvmap::vmap::octree::FILE_NAME;
use pvmap::vmap::tree::{Nodes, route};
use pvmap::vmap::{MapView, OctreeView};
use pvmap::{BuildConfig, Error, NormalsFrom, Quiet};

use crate::common::{LIMITS, build_with, ingest_with, room_cloud};

#[test]
fn the_example_is_read_and_its_text_says_the_same() {
    let lights = Lights::parse(EXAMPLE).unwrap();
    let text = lights.to_text();
    assert!(!text.contains('#'), "no comment and no sRGB: {text}");
    let again = Lights::parse(&text).unwrap();
    assert_eq!(again, lights);
    assert_eq!(again.to_text(), text);
    assert!(!lights.needs_classes());
    assert!(Lights::parse("[[glow]]\nclass = 6\nflux = 1").unwrap().needs_classes());
    assert!(Lights::parse("[[material]]\nclass = 2\nalbedo = 1").unwrap().needs_classes());
    assert_ne!(
        lights,
        Lights::parse(&EXAMPLE.replace("elevation = 35", "elevation = 36")).unwrap()
    );
}

#[test]
fn what_the_example_has_commented_out_is_right_too() {
    // Words have a blank behind the #.
    let all = EXAMPLE.replace("\n#[", "\n[");
    let lines = all.lines().map(|line| match line.strip_prefix('#') {
        Some(rule) if rule.starts_with(|c: char| c.is_ascii_lowercase()) => rule,
        _ => line,
    });
    let all = lines.collect::<Vec<_>>().join("\n");
    let text = Lights::parse(&all).unwrap().to_text();
    let n = |header: &str| text.matches(header).count();
    let kinds = ["[albedo]", "[sun]", "[sky]", "[[point]]", "[[spot]]", "[[area]]"];
    assert!(kinds.iter().all(|kind| n(kind) == 1), "{text}");
    assert_eq!((n("[[glow]]"), n("[[material]]")), (3, 2), "{text}");
}

/// A text of random rules, and how many.
fn random_text(rng: &mut Rng) -> String {
    let mut text = String::new();
    // Of any size, in all digits.
    let number = |rng: &mut Rng| (rng.f64() - 0.5) * 10f64.powi(rng.i32(-12..12));
    let vector = |rng: &mut Rng| [0; 3].map(|_| number(rng));
    let shown = |rng: &mut Rng, most: f64| match rng.u8(..4) {
        0 => format!("{}", rng.u8(..2)),
        1 => format!("\"#{:06x}\"", rng.u32(..1 << 24)),
        2 => format!("{:?}", rng.f64() * most.min(1.0)),
        _ => format!("{:?}", [0; 3].map(|_| rng.f64() * most)),
    };
    let power = |rng: &mut Rng, density: &'static str| {
        let key = if rng.bool() { density } else { "flux" };
        format!("{key} = {}\n", shown(rng, 1e6))
    };
    let selection = |rng: &mut Rng| match rng.u8(..6) {
        0 => {
            let (low, size) = (vector(rng), vector(rng).map(f64::abs));
            let [a, b, c] = low;
            let [d, e, f] = [0, 1, 2].map(|i| low[i] + size[i]);
            format!("box = {:?}\n", [a, b, c, d, e, f])
        }
        1 => {
            let [x, y, z] = vector(rng);
            format!("sphere = {:?}\n", [x, y, z, rng.f64() + 1e-9])
        }
        2 => format!("class = {}\n", rng.u8(..)),
        3 => format!("color = {}\nwithin = {:?}\n", shown(rng, 1.0), rng.f64()),
        4 => format!("near = {:?}\n", vector(rng)),
        _ => "all = true\n".to_owned(),
    };
    match rng.u8(..3) {
        0 => {}
        1 => text += &format!("[albedo]\nfrom = {}\n", shown(rng, 1.0)),
        _ => {
            let (exposure, missing) = (rng.f64() + 0.1, shown(rng, 1.0));
            text += &format!("[albedo]\nexposure = {exposure:?}\nmissing = {missing}\n");
        }
    }
    for _ in 0..rng.u8(..3) {
        text += &format!("[[glow]]\n{}{}", selection(rng), power(rng, "exitance"));
        let (on, ks, kt) = (selection(rng), rng.f64() / 3.0, rng.f64() / 3.0);
        text += &format!("[[material]]\n{on}specular = {ks:?}\ntransmissive = {kt:?}\n");
        text += &format!("[[material]]\nalbedo = {}\n{}", shown(rng, 1.0), selection(rng));
        text += &format!("[[point]]\nposition = {:?}\n{}", vector(rng), power(rng, "intensity"));
        let aim = if rng.bool() { "target" } else { "direction" };
        let (position, to, angle) = (vector(rng), vector(rng), 1.0 + rng.f64());
        text += &format!("[[spot]]\nposition = {position:?}\n{aim} = {to:?}\nangle = {angle:?}\n");
        text += &power(rng, "intensity");
        // Not of any size: those would be all but parallel to an axis, and so to each other.
        let side = |rng: &mut Rng| [0; 3].map(|_| rng.f64() - 0.5);
        let (corner, sides) = (vector(rng), [side(rng), side(rng)]);
        text += &format!("[[area]]\ncorner = {corner:?}\nsides = {sides:?}\n");
        text += &power(rng, "exitance");
    }
    if rng.bool() {
        let angles = (360.0 * rng.f64(), 90.0 * rng.f64());
        text += &format!("[sun]\nazimuth = {:?}\nelevation = {:?}\n", angles.0, angles.1);
        text += &format!("irradiance = {}\n", shown(rng, 1e3));
        text += &format!("[sky]\nradiance = {}\nup = {:?}\n", shown(rng, 1e3), vector(rng));
    }
    text
}

#[test]
fn canonical_texts_are_read_as_what_they_were_written_of() {
    let mut rng = Rng::with_seed(6);
    for _ in 0..500 {
        let text = random_text(&mut rng);
        let lights = Lights::parse(&text).unwrap_or_else(|e| panic!("{e}\n{text}"));
        let canonical = lights.to_text();
        let again = Lights::parse(&canonical).unwrap_or_else(|e| panic!("{e}\n{canonical}"));
        assert_eq!(again, lights, "{text}\n{canonical}");
        assert_eq!(again.to_text(), canonical);
    }
}

#[test]
fn every_fault_is_told_with_line_and_column() {
    let glow = "[[glow]]\nall = true\n";
    let material = "[[material]]\nall = true\n";
    let point = "[[point]]\nposition = [0, 0, 0]\n";
    let spot = "[[spot]]\nposition = [1, 2, 3]\nflux = 1\n";
    let area = "[[area]]\ncorner = [0, 0, 0]\nflux = 1\n";
    for (before, text, at, what) in [
        ("", "[albedo", "1:8", "expected"),
        ("", "a = 1\n", "1:1", "unknown key `a`"),
        ("", "[sund]\n", "1:2", "`sund`; the nearest known is `sun`"),
        (glow, "exitence = 1", "3:1", "`exitence`; the nearest known is `exitance`"),
        (glow, "flux = 1\nexitance = 1", "4:12", "beside"),
        (glow, "", "1:1", "this [[glow]] has neither `exitance` nor `flux`"),
        (glow, "exitance = 1e308", "3:12", "at most 1e30"),
        (glow, "flux = -1", "3:8", "flux = -1: it must be 0 or more"),
        (glow, "flux = [1, nan, 1]", "3:12", "flux = nan: it must be a finite number"),
        (glow, "flux = 1e999", "3:8", "finite number"),
        (glow, "flux = [1, 2]", "3:8", "[red, green, blue]"),
        (glow, "flux = \"#12345\"", "3:8", "#rrggbb"),
        (glow, "flux = true", "3:8", "a number"),
        (glow, "flux = 1\nclass = 6", "4:9", "`class` beside `all`"),
        ("", "[[glow]]\nflux = 1", "1:1", "this [[glow]] has none of `box`, `sphere`"),
        ("", "[glow]\nflux = 1", "1:1", "write [[glow]], with two brackets"),
        ("", "glow = 3\n", "1:8", "write [[glow]], with two brackets"),
        ("", "[[sky]]\nradiance = 1", "1:1", "`sky` is there once: write [sky]"),
        ("", "[[glow]]\nall = false\nflux = 1", "2:7", "true"),
        ("", "[[glow]]\nclass = 256\nflux = 1", "2:9", "0 to 255"),
        ("", "[[glow]]\nclass = 6.0\nflux = 1", "2:9", "0 to 255"),
        ("", "[[glow]]\nbox = [0, 0, 0, 1, 1]\nflux = 1", "2:7", "[x0, y0, z0, x1, y1, z1]"),
        ("", "[[glow]]\nbox = [0, 2, 0, 1, 1, 1]\nflux = 1", "2:7", "lowest corner first"),
        ("", "[[glow]]\nsphere = [0, 0, 0, 0]\nflux = 1", "2:10", "above 0"),
        ("", "[[glow]]\nnear = [0, 0, inf]\nflux = 1", "2:15", "finite"),
        ("", "[[glow]]\ncolor = 0.5\nflux = 1", "2:9", "`within` is missing"),
        ("", "[[glow]]\ncolor = 1.5\nwithin = 1\nflux = 1", "2:9", "0 to 1"),
        (glow, "within = 0.1\nflux = 1", "3:10", "leave it out"),
        ("", "[albedo]\nfrom = \"photo\"", "2:8", "colour"),
        ("", "[albedo]\nfrom = 1.1", "2:8", "0 to 1"),
        ("", "[albedo]\nfrom = 0.5\nmax = 0.9", "3:7", "leave it out"),
        ("", "[albedo]\nmax = 1", "2:7", "below 1"),
        ("", "[albedo]\nexposure = 0", "2:12", "above 0"),
        ("", "[albedo]\nmissing = -0.1", "2:11", "0 to 1"),
        (material, "", "1:1", "nothing is said"),
        (material, "albedo = 2", "3:10", "0 to 1"),
        (material, "refraction = 0.9", "3:14", "1 to 10"),
        (material, "refraction = 1e300", "3:14", "1 to 10"),
        (material, "albedo = 0.5\nspecular = 0.3\ntransmissive = 0.3", "5:16", "at most 1"),
        (material, "specular = 0.7\ntransmissive = 0.6", "4:16", "at most 1"),
        ("", "[[point]]\nflux = 1", "1:1", "`position` is missing"),
        (point, "flux = 1\nintensity = 1", "4:13", "`intensity` beside `flux`"),
        (point, "flux = -1e-9", "3:8", "0 or more"),
        (spot, "angle = 10\n", "1:1", "neither `direction` nor `target`"),
        (spot, "direction = [0, 0, 0]\nangle = 10", "4:13", "but 0"),
        (spot, "target = [1, 2, 3]\nangle = 10", "4:10", "elsewhere"),
        (spot, "target = [1, 2, 0]\nangle = 0", "5:9", "at most 180"),
        (spot, "target = [1, 2, 0]\nangle = 181", "5:9", "at most 180"),
        (spot, "target = [1, 2, 0]\nangle = 1e-200", "1:1", "above 1e30"),
        (spot, "target = [1, 2, 0]", "1:1", "`angle` is missing"),
        (area, "sides = [[0.1, 0.2, 0.3], [0.3, 0.6, 0.9]]", "4:9", "parallel"),
        (area, "sides = [[0, 0, 0], [1, 0, 0]]", "4:10", "but 0"),
        (area, "sides = [[1, 0, 0]]", "4:9", "[[x, y, z], [x, y, z]]"),
        ("", "[sun]\nirradiance = 1", "1:1", "this [sun] has neither `direction` nor `azimuth`"),
        ("", "[sun]\nazimuth = 400\nelevation = 0\nirradiance = 1", "2:11", "-360 to 360"),
        ("", "[sun]\nazimuth = 0\nelevation = 91\nirradiance = 1", "3:13", "-90 to 90"),
        ("", "[sun]\nazimuth = 0\nirradiance = 1", "1:1", "`elevation` is missing"),
        ("", "[sun]\ndirection = [0, 0, 1]\nelevation = 9", "3:13", "beside"),
        ("", "[sky]\nradiance = 1\nup = [0, 0, 0]", "3:6", "but 0"),
        ("", "[sky]\n", "1:1", "`radiance` is missing"),
        ("# é, two bytes and one column\n", "é = 1", "2:1", "expected"),
    ] {
        let text = format!("{before}{text}");
        let error = match Lights::parse(&text) {
            Err(error) => error,
            Ok(_) => panic!("was read: {text}"),
        };
        let message = error.to_string();
        assert_eq!(error.exit_code(), 78, "{message}");
        assert!(message.starts_with(&format!("{at}: ")), "{text}\n{message}, not {at}");
        assert!(message.contains(what) && message.lines().count() == 1, "{text}\n{message}");
    }
}

#[test]
fn faults_of_a_file_name_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("lights.toml");
    assert_eq!(Lights::read(&path).unwrap_err().exit_code(), 66);
    std::fs::write(&path, "[sky]\nradiance = -1\n").unwrap();
    let error = Lights::read(&path).unwrap_err();
    let expected = "lights.toml:2:12: radiance = -1: it must be 0 or more, at most 1e30";
    assert!(error.to_string().ends_with(expected) && error.exit_code() == 78, "{error}");
    std::fs::write(&path, vec![b'#'; (1 << 20) + 1]).unwrap();
    assert!(Lights::read(&path).unwrap_err().to_string().contains("larger than 1 MiB"));
    std::fs::write(&path, EXAMPLE).unwrap();
    assert_eq!(Lights::read(&path).unwrap(), Lights::parse(EXAMPLE).unwrap());
}

/// Side of the hall.
const SIDE: usize = 20;

/// A floor, dark grey, of class 2, and a ceiling that faces it, the half with x < 10 of class 6
/// and of the colour #ffcc88, the other without colour of its own: white.
fn hall(folder: &Path, normals: NormalsFrom) -> (Vec<u8>, PathBuf) {
    let mut rows = String::new();
    for (z, nz) in [(0, 1), (10, -1)] {
        for i in 0..SIDE * SIDE {
            let (x, y) = (i % SIDE, i / SIDE);
            let (class, color) = match (z, x < SIDE / 2) {
                (0, _) => (2, "64 64 64"),
                (_, true) => (6, "255 204 136"),
                _ => (2, "255 255 255"),
            };
            writeln!(rows, "{x} {y} {z} 0 0 {nz} {color} {class}").unwrap();
        }
    }
    scan(folder, &rows, normals, 4)
}

/// Ingests points, rows of `x y z nx ny nz red green blue class`, and builds their map.
fn scan(folder: &Path, rows: &str, normals: NormalsFrom, level: u8) -> (Vec<u8>, PathBuf) {
    let n = rows.lines().count();
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {n}\n");
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        writeln!(text, "property float {name}").unwrap();
    }
    for name in ["red", "green", "blue", "classification"] {
        writeln!(text, "property uchar {name}").unwrap();
    }
    let path = folder.join("hall.ply");
    std::fs::write(&path, format!("{text}end_header\n{rows}")).unwrap();
    let octree = ingest_with(&[path], folder, &LIMITS, |request| request.normals = normals);
    let config = BuildConfig { max_level: level, leaf_capacity: 4, ..BuildConfig::default() };
    (build_with(&octree, &config, &LIMITS), octree.join(FILE_NAME))
}

/// The hall and the classes of its surfels.
struct Hall {
    bytes: Vec<u8>,
    classes: Vec<u8>,
}

impl Hall {
    fn new() -> Hall {
        let folder = tempfile::tempdir().unwrap();
        let (bytes, octree) = hall(folder.path(), NormalsFrom::Auto);
        let classes = classes(&bytes, &octree);
        Hall { bytes, classes }
    }

    fn map(&self) -> MapView<'_> {
        MapView::open(&self.bytes).unwrap()
    }

    fn assign(&self, text: &str) -> Result<Assigned, Error> {
        let map = self.map();
        let elements = Elements::of_map(&map).unwrap();
        let assigned = Lights::parse(text).unwrap().assign(&map, &elements, Some(&self.classes))?;
        assigned.materials.check(&elements).unwrap();
        Ok(assigned)
    }

    fn places(&self) -> Vec<[f64; 3]> {
        let map = self.map();
        let n = map.summary().n_surfels;
        let frame = map.frame().frame;
        (0..n).map(|id| frame.world_of(map.surfel(id).unwrap().centroid)).collect()
    }

    /// Which surfels a selection makes shine.
    fn lit_by(&self, selection: &str) -> Vec<bool> {
        let assigned = self.assign(&format!("[[glow]]\n{selection}\nexitance = 2")).unwrap();
        let [red, ..] = &assigned.materials.channels;
        assert!(red.emission.iter().all(|&e| e == 0.0 || e == 2.0));
        red.emission.iter().map(|&e| e > 0.0).collect()
    }
}

fn classes(bytes: &[u8], octree: &Path) -> Vec<u8> {
    let map = MapView::open(bytes).unwrap();
    let points = std::fs::read(octree).unwrap();
    majority_classes(&map, Path::new("a.vmap"), &points, octree, &Quiet).unwrap()
}

#[test]
fn glows_shine_where_their_selection_says() {
    let hall = Hall::new();
    let places = hall.places();
    let of =
        |is_in: &dyn Fn([f64; 3]) -> bool| places.iter().map(|&p| is_in(p)).collect::<Vec<_>>();
    let half = |p: [f64; 3]| p[2] > 5.0 && p[0] < 9.6;
    assert!(of(&half).contains(&true));
    assert_eq!(hall.lit_by("all = true"), vec![true; places.len()]);
    // Faces of a box belong to it, though the grid rounds them down.
    assert_eq!(hall.lit_by("box = [-9, -9, 0, 99, 99, 0]"), of(&|p| p[2] < 5.0));
    assert_eq!(hall.lit_by("box = [-9, -9, 10, 99, 99, 10]"), of(&|p| p[2] > 5.0));
    let near = |p: [f64; 3]| p[0].powi(2) + p[1].powi(2) + p[2].powi(2);
    assert_eq!(hall.lit_by("sphere = [0, 0, 0, 6.03]"), of(&|p| near(p) < 6.03 * 6.03));
    assert_eq!(hall.lit_by("class = 6"), of(&half));
    // The number of a colour is the very one that surfels of that colour have.
    assert_eq!(hall.lit_by("color = \"#ffcc88\"\nwithin = 0"), of(&half));
    assert_eq!(hall.lit_by("color = [1, 1, 1]\nwithin = 0"), of(&|p| p[2] > 5.0 && p[0] > 9.6));
    let one = hall.lit_by("near = [-1000, -1000, -3]");
    let nearest = (0..places.len()).min_by(|&a, &b| near(places[a]).total_cmp(&near(places[b])));
    assert_eq!(one, (0..places.len()).map(|i| Some(i) == nearest).collect::<Vec<_>>());
}

#[test]
fn of_equally_near_surfels_the_first_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let rows = "0 4 0 0 0 1 9 9 9 1\n4 0 0 0 0 1 9 9 9 1\n\
                4 4 0 0 0 1 9 9 9 1\n";
    let (bytes, octree) = scan(folder.path(), &rows.repeat(2), NormalsFrom::Auto, 4);
    let hall = Hall { classes: classes(&bytes, &octree), bytes };
    assert_eq!(hall.lit_by("box = [0, 0, 0, 4, 4, 0]"), [true; 3]);
    // In Morton order (4, 0) comes before (0, 4), and both before (4, 4).
    assert_eq!(hall.lit_by("near = [0, 0, -7]"), [true, false, false]);
    assert_eq!(hall.lit_by("near = [-1, 0, 0]"), [false, true, false]);
    assert_eq!(hall.lit_by("near = [1e300, 1e300, 0]"), [false, false, true]);
}

#[test]
fn flux_is_spread_over_areas_and_light_adds_up() {
    let hall = Hall::new();
    let elements = Elements::of_map(&hall.map()).unwrap();
    let text = "albedo.from = 0.5\n[[glow]]\nclass = 6\nflux = [100, 50, 0]\n\
                [[glow]]\nclass = 6\nexitance = 3\n";
    let assigned = hall.assign(text).unwrap();
    let area: f64 =
        (0..elements.len()).filter(|&i| hall.classes[i] == 6).map(|i| elements.areas()[i]).sum();
    for (channel, flux) in assigned.materials.channels.iter().zip([100.0, 50.0, 0.0]) {
        let sum: f64 = channel.emission.iter().zip(elements.areas()).map(|(e, a)| e * a).sum();
        let expected = flux + 3.0 * area;
        assert!((sum - expected).abs() <= 1e-12 * expected, "{sum}, {expected}");
    }
    assert_eq!(assigned.notes, [] as [&str; 0]);
    let n_shining = hall.classes.iter().filter(|&&class| class == 6).count();
    for (glow, flux) in assigned.glows.iter().zip([[100.0, 50.0, 0.0], [3.0 * area; 3]]) {
        assert!(
            glow.n_surfels == n_shining && (glow.area - area).abs() <= 1e-12 * area,
            "{glow:?}"
        );
        assert!((0..3).all(|c| (glow.flux[c] - flux[c]).abs() <= 1e-12 * flux[c]), "{glow:?}");
    }
    assert_eq!(assigned.glows.len(), 2);
    assert_eq!(hall.assign(text).unwrap(), assigned);
    let again = Lights::parse(text).unwrap().to_text();
    assert_eq!(hall.assign(&again).unwrap(), assigned);
}

#[test]
fn albedo_comes_from_the_scan_with_its_exposure_or_from_one_colour() {
    let hall = Hall::new();
    let albedo = |text: &str| {
        let found = hall.assign(text).unwrap();
        let channels = found.materials.channels.map(|channel| channel.albedo);
        let at = |i: usize| [0, 1, 2].map(|c: usize| channels[c][i]);
        ((0..hall.classes.len()).map(at).collect::<Vec<_>>(), found.notes)
    };
    let floor = hall.places().iter().position(|p| p[2] < 5.0).unwrap();
    let lamp = hall.classes.iter().position(|&class| class == 6).unwrap();
    let (plain, notes) = albedo("");
    // 64 in sRGB is 0.0513 of the light, 204 is 0.604, 136 is 0.246.
    assert!((plain[floor][0] - 0.05127).abs() < 1e-5, "{plain:?}");
    let expected = [0.95, 0.60383, 0.24620];
    assert!((0..3).all(|i| (plain[lamp][i] - expected[i]).abs() < 1e-5), "{:?}", plain[lamp]);
    let n_bright = plain.iter().filter(|color| color[0] == 0.95).count();
    let n = plain.len();
    let cut = format!("{n_bright} of {n} surfels are brighter than albedo 0.95: cut to it");
    assert_eq!(notes.len(), 2);
    assert!(notes[0] == cut && notes[1].starts_with("nothing shines;"), "{notes:?}");
    let (exposed, _) = albedo("[albedo]\nexposure = 2\nmax = 0.5");
    assert_eq!(exposed[floor], plain[floor].map(|v| 2.0 * v));
    assert!(exposed.iter().flatten().all(|&v| v <= 0.5));
    let (constant, notes) = albedo("[albedo]\nfrom = [0.1, 1, 0]");
    assert_eq!((constant, notes.len()), (vec![[0.1, 1.0, 0.0]; n], 1));
}

#[test]
fn surfels_without_a_colour_get_what_is_said_for_them() {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = room_cloud(500);
    cloud.colors = None;
    cloud.write_ply(&folder.path().join("scan.ply"));
    let scans = [folder.path().join("scan.ply")];
    let octree = ingest_with(&scans, folder.path(), &LIMITS, |_| ());
    let bytes = build_with(&octree, &BuildConfig::default(), &LIMITS);
    let hall = Hall { classes: Vec::new(), bytes };
    let (map, elements) = (hall.map(), Elements::of_map(&hall.map()).unwrap());
    let lights = Lights::parse("[albedo]\nmissing = 0.25\n[sky]\nradiance = 1").unwrap();
    let found = lights.assign(&map, &elements, None).unwrap();
    assert!(found.materials.channels.iter().flat_map(|c| &c.albedo).all(|&v| v == 0.25));
    let n = elements.len();
    let black = "a scan that is black all over counts as without";
    let expected = format!("{n} of {n} surfels have no colour ({black}): albedo 0.25");
    assert_eq!(found.notes, [expected]);
    let by_class = Lights::parse("\n[[glow]]\nclass = 6\nflux = 1").unwrap();
    let error = by_class.assign(&map, &elements, None).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().starts_with("2:1: "), "{error}");
    assert!(by_class.assign(&map, &elements, Some(&[6])).is_err(), "one class of {n}");
    let points = std::fs::read(octree.join(FILE_NAME)).unwrap();
    let error = majority_classes(&map, Path::new("a"), &points, Path::new("b"), &Quiet);
    assert!(error.unwrap_err().to_string().contains("b: its points have no classes"));
}

#[test]
fn later_materials_win_and_what_mirrors_scatters_less() {
    let hall = Hall::new();
    let text = "[[material]]\nall = true\nalbedo = [0.8, 0.4, 0.2]\n\
                [[material]]\nclass = 6\nspecular = 0.5\nrefraction = 1.5\n\
                [[point]]\nposition = [5, 5, 5]\nflux = 1\n";
    let found = hall.assign(text).unwrap();
    let n_glossy = hall.classes.iter().filter(|&&class| class == 6).count();
    assert_eq!(
        found.notes,
        [format!("{n_glossy} surfels: albedo lowered to 1 - specular - transmissive")]
    );
    for (i, &class) in hall.classes.iter().enumerate() {
        let albedo = [0, 1, 2].map(|c: usize| found.materials.channels[c].albedo[i]);
        let gloss = found.materials.gloss[i];
        let expected = if class == 6 { [0.5, 0.25, 0.125] } else { [0.8, 0.4, 0.2] };
        assert!((0..3).all(|c| (albedo[c] - expected[c]).abs() < 1e-15), "{albedo:?}");
        let expected = if class == 6 { (0.5, 0.0, 1.5) } else { (0.0, 0.0, 0.0) };
        assert_eq!((gloss.specular, gloss.transmissive, gloss.refraction), expected);
    }
    // Thirds fill the whole; nothing is lowered.
    let thirds = "[[material]]\nall = true\nalbedo = 0.7\nspecular = 0.3\n[sky]\nradiance = 1";
    assert!(hall.assign(thirds).unwrap().notes.is_empty());
    assert!(hall.assign("").unwrap().materials.gloss.is_empty());
    let both = "[[material]]\nall = true\nspecular = 0.7\n\
                [[material]]\nclass = 6\ntransmissive = 0.6\n";
    let error = hall.assign(both).unwrap_err();
    assert!(error.to_string().starts_with("4:1: material 2 over"), "{error}");
    assert_eq!(error.exit_code(), 78);
}

#[test]
fn a_rule_without_a_surfel_says_what_there_is() {
    let hall = Hall::new();
    for (selection, what) in [
        ("box = [50, 0, 0, 60, 10, 10]", "the scan's lie from 0."),
        ("sphere = [0, 0, -50, 10]", "the scan's lie from 0."),
        ("class = 7", "are of class 2, 6"),
        ("color = \"#0000ff\"\nwithin = 0.1", "the nearest colour of one is 0.9"),
    ] {
        for (rule, says) in [("glow", "flux = 1"), ("material", "albedo = 0.1")] {
            let text = format!("# so\n[[{rule}]]\n{selection}\n{says}");
            let error = hall.assign(&text).unwrap_err();
            let message = error.to_string();
            let begin = format!("2:1: {rule} 1 selects no surfel; ");
            assert!(message.starts_with(&begin), "{message}");
            assert!(message.contains(what) && error.exit_code() == 78, "{message}");
        }
    }
    let too_much = "[[glow]]\nall = true\nexitance = 1e30\n".repeat(2);
    let error = hall.assign(&too_much).unwrap_err();
    assert!(error.to_string().contains("too much to compute with"), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let (bytes, octree) = self::hall(folder.path(), NormalsFrom::None);
    let dark = Hall { classes: classes(&bytes, &octree), bytes };
    let error = dark.assign("[[glow]]\nall = true\nflux = 1").unwrap_err();
    assert!(error.to_string().contains("has a normal, so none can shine"), "{error}");
}

#[test]
fn lamps_have_the_flux_that_is_said() {
    use std::f64::consts::PI;
    let hall = Hall::new();
    let text = "[[point]]\nposition = [1, 2, 3]\nflux = [4, 8, 12]\n\
                [[spot]]\nposition = [1, 2, 3]\ntarget = [1, 2, 1]\nangle = 90\nflux = 4\n\
                [[spot]]\nposition = [1, 2, 3]\ndirection = [0, 3, 4]\nangle = 60\nintensity = 4\n\
                [[area]]\ncorner = [0, 0, 5]\nsides = [[0, 2, 0], [3, 0, 0]]\nflux = 12\n\
                [sun]\nazimuth = 90\nelevation = 0\nirradiance = [3, 2, 1]\n\
                [sky]\nradiance = 0.5\nup = [0, 0, 2]\n";
    let found = hall.assign(text).unwrap();
    let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
    let [point, half, cone, area, sun] = found.lamps[..] else { panic!("{:?}", found.lamps) };
    assert!(matches!(point, Lamp::Point { intensity: [i, ..], .. } if near(i, 1.0 / PI)));
    let Lamp::Spot { direction, angle, intensity, .. } = half else { panic!("{half:?}") };
    assert_eq!((direction, angle), ([0.0, 0.0, -1.0], PI / 2.0));
    assert!(near(intensity[1], 2.0 / PI), "a half space has 2π");
    let Lamp::Spot { direction, angle, intensity, .. } = cone else { panic!("{cone:?}") };
    assert!(near(angle, PI / 3.0) && near(direction[1], 0.6) && near(direction[2], 0.8));
    assert_eq!(intensity, [4.0; 3]);
    // However narrow a cone is, and a single direction would be.
    for degrees in [1e-3, 1e-6, 1e-7, 1e-12] {
        let spot = "[[spot]]\nposition = [1, 2, 3]\ndirection = [0, 0, -1]\nflux = 10";
        let narrow = hall.assign(&format!("{spot}\nangle = {degrees:?}\n")).unwrap().lamps[0];
        assert!(near(narrow.flux().unwrap()[0], 10.0), "{degrees}: {narrow:?}");
    }
    assert!(matches!(area, Lamp::Area { exitance: [2.0, 2.0, 2.0], .. }));
    // East is +x.
    let expected = Lamp::Sun { direction: [1.0, 0.0, 0.0], irradiance: [3.0, 2.0, 1.0] };
    assert_eq!(sun, expected);
    assert_eq!(found.sky, Some(Sky { radiance: [0.5; 3], up: [0.0, 0.0, 1.0] }));
}

#[test]
fn the_class_of_a_surfel_is_that_of_most_points() {
    let mut rng = Rng::with_seed(3);
    let folder = tempfile::tempdir().unwrap();
    let mut rows = String::new();
    for i in 0..6_000 {
        let [x, y, z] = [0; 3].map(|_| rng.u32(..1000));
        let [a, b, c] = [0; 3].map(|_| rng.f32() - 0.5);
        // Few classes bring ties.
        writeln!(rows, "{x} {y} {z} {a} {b} {c} 1 2 3 {}", [0, 2, 6, 255][i % 7 % 4]).unwrap();
    }
    let (bytes, octree) = scan(folder.path(), &rows, NormalsFrom::Auto, 8);
    let map = MapView::open(&bytes).unwrap();
    let points = std::fs::read(&octree).unwrap();
    let view = OctreeView::open(&points).unwrap();
    let at = view.schema().column("class").unwrap().offset;
    let mut counts = BTreeMap::<(u32, u8), u32>::new();
    for point in view.points(0, 6_000).unwrap().iter() {
        let point = point.unwrap();
        let leaf = map.node(route(&map, &point.key).unwrap().unwrap()).unwrap();
        *counts.entry((leaf.first_surfel, point.record[at])).or_default() += 1;
    }
    let n = map.summary().n_surfels;
    assert!(n > 1_000, "{n}");
    let of = |surfel: u32| counts.range((surfel, 0)..=(surfel, 255));
    let best = |surfel| {
        let most = of(surfel).map(|(_, n)| *n).max().unwrap();
        of(surfel).find(|(_, n)| **n == most).unwrap().0.1
    };
    let expected: Vec<u8> = (0..n).map(best).collect();
    assert_eq!(classes(&bytes, &octree), expected);
}

#[test]
fn n78_colours_of_eight_bits_in_sixteen_are_as_bright_as_in_eight() {
    let cloud = room_cloud(3_000);
    let mut wide = cloud.clone();
    wide.colors.iter_mut().flatten().flatten().for_each(|v| *v *= 257);
    let albedo = |name: &str, write: &dyn Fn(&Path)| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        write(&path);
        let octree = ingest_with(&[path], folder.path(), &LIMITS, |_| ());
        let bytes = build_with(&octree, &BuildConfig::default(), &LIMITS);
        let (map, lights) = (MapView::open(&bytes).unwrap(), Lights::parse("").unwrap());
        let elements = Elements::of_map(&map).unwrap();
        lights.assign(&map, &elements, None).unwrap().materials.channels.map(|c| c.albedo)
    };
    let eight = albedo("a.ply", &|path| cloud.write_ply(path));
    assert!(eight[0].iter().any(|&v| v > 0.2), "all black");
    assert!(eight.iter().flatten().all(|&v| v <= 0.95));
    assert_eq!(albedo("a.las", &|path| cloud.write_las(path, 1.0, [0.0; 3])), eight);
    assert_eq!(albedo("b.las", &|path| wide.write_las(path, 1.0, [0.0; 3])), eight);
}
