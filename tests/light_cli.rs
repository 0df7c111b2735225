//! `pvmap light` as it is typed: what it prints and when, what it refuses, and that pictures keep
//! to its plan.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, room};
use pvmap::lights::{EXAMPLE, Lights};

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
