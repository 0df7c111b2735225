//! `pvmap light` as it is typed: what it prints and when, what it refuses, and that pictures keep
//! to its plan.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::f64::consts::PI;

use cli_common::{Bench, MIB, ply_header, room, room_ply};
use pvmap::LitMap;
use pvmap::lights::{EXAMPLE, Lights};
use pvmap::render::{Size, held_bytes, held_bytes_glossy};
use pvmap::vmap::LightView;

/// What shines in the room, whose corners are at -1 and 1.
const LAMP: &str = "[albedo]\nfrom = 0.5\n[[point]]\nposition = [0, 0, 0.5]\nflux = 10\n";

fn lit(lights: &str) -> Bench {
    let bench = room();
    bench.write("lights.toml", lights);
    bench
}

#[test]
fn a_plan_fits_in_a_hundred_columns_and_says_what_it_would_cost() {
    let glass = "[[material]]\nbox = [-1, -1, -1, 0, 0, -1]\ntransmissive = 0.5\nspecular = 0.1\n";
    let bench = lit(&format!("{LAMP}{glass}"));
    let stdout = bench.line("light room.vmap --lights lights.toml --plan").ok().stdout;
    assert!(stdout.lines().all(|line| line.chars().count() <= 100), "{stdout}");
    assert!(!stdout.contains("e0") && !stdout.contains("e1"), "no bound above 1: {stdout}");
    let seconds = |effect: &str| {
        let line = stdout.lines().find(|line| line.starts_with(effect)).unwrap();
        let mut rest = line[effect.len()..].split_whitespace();
        rest.find_map(|word| word.parse::<f64>().ok().filter(|_| word.contains('.'))).unwrap()
    };
    for effect in ["caustics", "refraction", "diffuse-specular-diffuse"] {
        assert!(seconds(effect) > 0.0, "{effect}: {stdout}");
    }
    assert!(!bench.path("room.light").exists(), "--plan makes nothing");
}

#[test]
fn what_cannot_work_is_refused_before_it_costs_anything() {
    let bench = lit(LAMP);
    let light = "light room.vmap --lights lights.toml";
    bench.line(&format!("{light} -o -")).fails(2, &["-: a light file is not written from front"]);
    bench.write("notes.txt", "my own");
    let run = bench.line(&format!("{light} -o notes.txt")).fails(73, &["not a light file"]);
    assert_eq!(run.stdout, "", "refused before it was planned");
    let run = bench.line(&format!("{light} -o no/where.light")).fails(73, &["no/where.light"]);
    assert_eq!(run.stdout, "", "refused before it was planned");
    bench.line(&format!("{light} --error 1e-7")).fails(2, &["--error 1e-7: ", "or --direct"]);
    bench.line(&format!("{light} --error 1e-10")).fails(2, &["no share from 1e-9"]);
    let both = format!("{light} --force sky --no color --no sky");
    bench.line(&both).fails(2, &["--force sky and --no sky"]);
    bench.write("class.toml", "# lamps\n[[glow]]\nclass = 6\nflux = 1\n");
    let by_class = "light room.vmap --lights class.toml";
    bench.line(by_class).fails(2, &["class.toml:2:1: ", "--octree NAME.octree"]);
    assert_eq!(bench.names().iter().filter(|name| name.contains("pvmap-")).count(), 0);
    bench.line(light).ok();
    let run = bench.line("light room.light --lights lights.toml");
    run.fails(65, &["room.light", "this is the light of a map"]);
}

#[test]
fn what_is_noticed_is_told_without_progress_too() {
    let bench = lit("");
    let light = "light room.vmap --lights lights.toml";
    let run = bench.line(&format!("{light} --progress off")).ok();
    let run = run.warns(&["lights.toml: nothing shines"]);
    assert!(run.stdout.contains("nothing shines or arrives"), "{}", run.stdout);
    assert!(run.stdout.contains("surfels send each other none"), "{}", run.stdout);
    for odd in ["1 channels", "0.0e0", "0 iterations"] {
        assert!(!run.stdout.contains(odd), "{odd}: {}", run.stdout);
    }
    bench.write("lights.toml", "[sun]\nazimuth = 0\nelevation = -10\nirradiance = 1\n");
    let run = bench.line(&format!("{light} --progress off")).ok();
    run.warns(&["the sun is below the horizon"]);
    // A lamp outside: what arrives is what the walls' backs let through, and that is nothing.
    bench.write("lights.toml", LAMP.replace("0.5]", "50]"));
    let run = bench.line(&format!("{light} --progress off")).ok();
    run.warns(&["lamps give 10.0000, ", " arrives ("]);
}

#[test]
fn n74_it_is_told_what_a_bounce_leaves_at_the_most() {
    let bench = lit(&format!("{LAMP}[[material]]\nbox = [-1, -1, -1, 1, 1, -1]\nalbedo = 0.8\n"));
    let light = "light room.vmap --lights lights.toml";
    let told = bench.line(light).ok().stdout;
    assert!(told.contains("; a bounce leaves at most 80.00 % of it\n"), "{told}");
    let told = bench.line(&format!("{light} --no bounces")).ok().stdout;
    assert!(!told.contains("a bounce leaves"), "{told}");
}

#[test]
fn flux_is_told_by_channel() {
    let bench = lit("[albedo]\nfrom = 0.5\n[[glow]]\nall = true\nexitance = [1, 0, 2]\n");
    let stdout = bench.line("light room.vmap --lights lights.toml").ok().stdout;
    let flux = |name: &str| -> f64 {
        let line = stdout.lines().find(|line| line.contains(name)).unwrap();
        let (_, after) = line.split_once(name).unwrap();
        after.split_whitespace().next().unwrap().parse().unwrap()
    };
    assert!((flux(" blue ") / flux(" red ") - 2.0).abs() < 1e-5, "{stdout}");
    assert!(stdout.contains("green nothing shines or arrives"), "{stdout}");
    assert!(stdout.contains("three channels"), "{stdout}");
}

#[test]
fn the_example_can_be_had_from_the_command() {
    let bench = Bench::new();
    let run = bench.line("light --example").ok();
    assert_eq!(run.stdout, EXAMPLE);
    Lights::parse(&run.stdout).unwrap();
    bench.line("light").fails(2, &["<NAME.vmap>", "--lights"]);
    bench.line("light a.vmap").fails(2, &["--lights"]);
}

#[test]
fn pictures_keep_to_the_plan_of_their_light() {
    let gloss = "[[material]]\nbox = [-1, -1, -1, 1, 1, -0.9]\n";
    let bench = lit(&format!("{LAMP}{gloss}albedo = 0.1\nspecular = 0.8\n"));
    let picture = |light: &str, render: &str| {
        bench.line(&format!("light room.vmap --lights lights.toml {light}")).ok();
        let camera = "--size 40x40 --camera 0,-0.5,0.5,0,0.5,-1 --exposure 1";
        let run = format!("render room.vmap --light room.light {camera} -o a.png {render}");
        let run = bench.line(&run).ok();
        (bench.read("a.png"), run.stderr)
    };
    let (mirrored, told) = picture("", "");
    assert!(told.contains("mirrors: "), "{told}");
    let (without, _) = picture("", "--no-mirrors");
    assert!(mirrored != without, "something is seen in the mirror");
    let (unwanted, told) = picture("--no mirror-view", "");
    assert!(unwanted == without, "the plan leaves mirrors out");
    assert!(told.contains("planned without mirror-view"), "{told}");
    let (with, _) = picture("--no refraction", "");
    assert!(with == mirrored, "nothing lets light through");
    // Now the floor is of glass.
    let glass = "albedo = 0.1\ntransmissive = 0.8\nrefraction = 1.5\n";
    bench.write("lights.toml", format!("{LAMP}{gloss}{glass}"));
    let (through, _) = picture("--no caustics", "");
    let (without, told) = picture("--no caustics --no refraction", "");
    assert!(through != without && told.contains("planned without refraction"), "{told}");
}

/// Numbers behind a word of what is printed, up to the next that is none.
fn number_after(text: &str, word: &str) -> f64 {
    let (_, after) = text.split_once(word).unwrap_or_else(|| panic!("no {word:?} in: {text}"));
    let number = after.split_whitespace().next().unwrap().trim_end_matches(',');
    number.parse().unwrap_or_else(|_| panic!("{number:?} behind {word:?} in: {text}"))
}

/// The irradiance of all surfels, one number each.
fn irradiance(bench: &Bench, light: &str) -> Vec<f64> {
    let bytes = bench.read(light);
    let light = LightView::open(&bytes).unwrap();
    let of = |id| f64::from(light.found(id).unwrap()[0].irradiance);
    (0..light.summary().n_surfels).map(of).collect()
}

#[test]
fn what_a_glow_has_is_told_with_its_plan() {
    let glow = "[albedo]\nfrom = 0.5\n[[glow]]\nbox = [-0.4, -0.4, 1, 0.41, 0.37, 1]\n";
    let bench = lit(&format!("{glow}exitance = 10\n"));
    let light = "light room.vmap --lights lights.toml";
    let planned = bench.line(&format!("{light} --plan")).ok().stdout;
    let (n, area) = (number_after(&planned, "\nglow 1:"), number_after(&planned, ", area"));
    let flux = number_after(&planned, ", flux");
    assert!(n > 1.0 && (flux / area - 10.0).abs() < 1e-2, "{planned}");
    // The box has 0.6237 of area; its surfels are whole ones.
    assert!((area / 0.6237 - 1.0).abs() > 0.02, "{planned}");
    let run = bench.line(light).ok().stdout;
    assert!(run.starts_with(&planned), "{planned}{run}");
    let emitted = number_after(&run, "  flux      ");
    assert!((emitted / flux - 1.0).abs() < 1e-3, "{run}");
    bench.write("lights.toml", format!("{glow}flux = [1e-12, 0, 2e7]\n"));
    let run = bench.line(light).ok().stdout;
    assert!(run.contains(", flux [1.000e-12, 0, 20000000]"), "{run}");
    assert!((number_after(&run, " red ") / 1e-12 - 1.0).abs() < 1e-5, "{run}");
}

#[test]
fn a_picture_of_light_stays_within_its_memory() {
    let gloss = "[[material]]\nbox = [-1, -1, -1, 1, 1, -0.9]\nspecular = 0.5\nalbedo = 0.5\n";
    let bench = lit(&format!("{LAMP}{gloss}"));
    bench.line("light room.vmap --lights lights.toml").ok();
    let n_surfels = bench.with_map("room.vmap", |map| map.summary().n_surfels);
    // The largest that fits, but with the light of all surfels no more.
    let largest = |bytes: fn(Size) -> u64| {
        let sizes = (1..9000).map(|height_px| Size { width_px: 400, height_px });
        sizes.take_while(|&size| bytes(size) <= 64 * MIB).last().unwrap()
    };
    let render = |size: Size, options: &str| {
        let Size { width_px, height_px } = size;
        bench.line(&format!(
            "render room.vmap --memory 64MiB --size {width_px}x{height_px} -o a.png {options}"
        ))
    };
    let rows = |height_px| held_bytes(Size { width_px: 400, height_px });
    assert!(LitMap::held_bytes(n_surfels) > rows(2) - rows(1), "{n_surfels} surfels");
    let size = largest(held_bytes);
    render(size, "").ok();
    let words = ["the light of the map", "--memory"];
    render(size, "--light room.light --no-mirrors").fails(78, &words);
    let size = largest(held_bytes_glossy);
    render(size, "--light room.light --no-mirrors").ok();
    render(size, "--light room.light").fails(78, &words);
}

#[test]
fn a_sky_that_the_plan_leaves_out_is_in_no_mirror() {
    // The floor mirrors what is seen past the ceiling.
    let gloss = "[[material]]\nbox = [-1, -1, -1, 1, 1, -0.9]\nalbedo = 0.1\nspecular = 0.8\n";
    let bench = room();
    let picture = |name: &str, lights: &str, options: &str| {
        bench.write("lights.toml", lights);
        bench.line(&format!("light room.vmap --lights lights.toml -o {name} {options}")).ok();
        let camera = "--size 40x40 --camera 0,-3,0,0,0,-1 --exposure 0.3";
        let run = bench.line(&format!("render room.vmap --light {name} {camera} -o a.png")).ok();
        (bench.read("a.png"), run.stderr)
    };
    let (without, told) = picture("a.light", &format!("{LAMP}{gloss}"), "");
    assert!(!told.contains("planned without"), "{told}");
    let lights = format!("{LAMP}{gloss}[sky]\nradiance = 1\n");
    let (with, _) = picture("b.light", &lights, "");
    assert!(with != without, "the sky is seen in the mirror");
    let (unwanted, told) = picture("c.light", &lights, "--no sky");
    assert!(unwanted == without, "the plan leaves the sky out");
    assert!(told.contains("planned without sky"), "{told}");
}

#[test]
fn sides_that_are_not_known_are_told() {
    let bench = lit(LAMP);
    bench.write("bare.ply", room_ply(20).replace("nx", "u").replace("ny", "v").replace("nz", "w"));
    for (sensor, is_known) in [("", false), ("--sensor 0,0,0", true)] {
        bench.line(&format!("ingest bare.ply {sensor} -o a.octree --overwrite")).ok();
        bench.line("build a.octree -o bare.vmap").ok();
        let run = bench.line("light bare.vmap --lights lights.toml --plan").ok();
        let words = ["bare.vmap: ", " have no known side", "--sensor x,y,z"];
        match is_known {
            true => assert!(!run.stderr.contains(words[1]), "{}", run.stderr),
            false => drop(run.warns(&words)),
        }
    }
    let run = bench.line("light room.vmap --lights lights.toml --plan").ok();
    assert!(!run.stderr.contains("no known side"), "{}", run.stderr);
}

#[test]
fn the_example_lights_rooms_and_grounds() {
    let bench = room();
    let example = bench.line("light --example").ok().stdout;
    bench.write("lights.toml", example);
    bench.line("scene empty --points 3000 -o closed.ply").ok();
    bench.line("ingest closed.ply").ok();
    bench.line("build closed.octree --max-level 4").ok();
    for name in ["room", "closed"] {
        let run = bench.line(&format!("light {name}.vmap --lights lights.toml")).ok();
        assert!(number_after(&run.stdout, " red ") > 0.0, "{}", run.stdout);
        let lit = irradiance(&bench, &format!("{name}.light"));
        let least = lit.iter().copied().fold(f64::INFINITY, f64::min);
        assert!(least > 0.005, "{name}: a surfel gets {least}");
    }
}

#[test]
fn a_scan_of_one_place_is_lit_from_outside() {
    let bench = Bench::new();
    let row = "2 3 4 0 0 1\n".repeat(5);
    bench.write("one.ply", ply_header(5, &["x", "y", "z", "nx", "ny", "nz"]) + &row);
    bench.line("ingest one.ply").ok();
    bench.line("build one.octree").ok();
    let sun = "[sun]\nazimuth = 0\nelevation = 90\nirradiance = 3\n";
    let point = "[[point]]\nposition = [2, 3, 6]\nintensity = 8\n";
    let lights = [(sun, 3.0), ("[sky]\nradiance = 0.5\n", PI / 2.0), (point, 2.0)];
    for (light, expected) in lights {
        bench.write("lights.toml", format!("[albedo]\nfrom = 0.5\n{light}"));
        bench.line("light one.vmap --lights lights.toml").ok();
        let found = irradiance(&bench, "one.light");
        assert!((found[0] / expected - 1.0).abs() < 1e-6, "{light}: {found:?}");
    }
}

#[test]
fn what_a_spot_gives_arrives_however_narrow_it_is() {
    let bench = room();
    for angle in ["1e-3", "1e-6", "1e-7"] {
        let spot = "[[spot]]\nposition = [0.01, 0.02, 0.5]\ndirection = [0.1, 0.2, -1]\nflux = 10";
        bench.write("lights.toml", format!("[albedo]\nfrom = 0\n{spot}\nangle = {angle}\n"));
        let run = bench.line("light room.vmap --lights lights.toml").ok();
        assert!(!run.stderr.contains("lamps give"), "{angle}: {}", run.stderr);
        let arrives = number_after(&run.stdout, "  flux      ");
        assert!((arrives / 10.0 - 1.0).abs() < 0.01, "{angle}: {}", run.stdout);
    }
    // Of so narrow a cone nothing is left to say of.
    let spot = "[[spot]]\nposition = [0, 0, 0.5]\ndirection = [0, 0, -1]\nintensity = 10";
    bench.write("lights.toml", format!("{spot}\nangle = 1e-200\n"));
    let run = bench.line("light room.vmap --lights lights.toml").ok();
    assert!(!run.stderr.contains("NaN") && !run.stdout.contains("NaN"), "{run:?}");
}

#[test]
fn a_plan_says_what_each_effect_is_worth_and_how_it_knows() {
    let bench = lit(LAMP);
    let plan = |options: &str| {
        let run = bench.line(&format!("light room.vmap --lights lights.toml --plan {options}"));
        // Evidence goes on in further lines.
        run.ok().stdout.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let planned = plan("");
    assert!(planned.contains(" direct on all "), "{planned}");
    // All light is 2 times what shines, half of it reflected.
    assert!(planned.contains(" bounces on ≤ 5e-1 "), "{planned}");
    let blind = plan("--no occlusion");
    assert!(blind.contains("segments to lamps are not tried"), "{blind}");
    assert!(!blind.contains("none of 0"), "{blind}");
    let all = ["occlusion on", " of all ", " segments to lamps blocked"];
    // It shines past the ceiling onto a half of the floor.
    bench.write("lights.toml", LAMP.replace("0, 0, 0.5]", "0, -1.5, 2]"));
    let beside = plan("");
    assert!(all.iter().all(|words| beside.contains(words)), "{beside}");
}
