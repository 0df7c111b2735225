//! `pvmap render` over the binary: pictures, and cameras that are none.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::fmt::Write as _;
use std::process::Stdio;

use cli_common::{Bench, room};

/// A decoded PNG: width, height and three bytes a pixel.
struct Png(u32, u32, Vec<u8>);

impl Png {
    fn of(bytes: &[u8]) -> Png {
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!(info.color_type, png::ColorType::Rgb);
        Png(info.width, info.height, pixels)
    }

    /// Counts the pixels of some kind.
    fn count(&self, is_it: impl Fn([u8; 3]) -> bool) -> usize {
        self.2.chunks_exact(3).filter(|p| is_it([p[0], p[1], p[2]])).count()
    }
}

fn is_violet([r, g, b]: [u8; 3]) -> bool {
    b > 120 && r > g && b > r + 30
}

fn is_cyan([r, g, b]: [u8; 3]) -> bool {
    r < 60 && g > 150 && b > 150
}

fn picture(bench: &Bench, line: &str) -> Png {
    bench.line(&format!("render {line} -o out.png")).ok();
    Png::of(&bench.read("out.png"))
}

#[test]
fn pictures_of_maps_and_octrees() {
    let bench = room();
    for artifact in ["room.vmap", "room.octree"] {
        let whole = picture(&bench, &format!("{artifact} --size 200x150"));
        assert_eq!((whole.0, whole.1), (200, 150));
        let n = whole.count(|p| p != [255; 3]);
        assert!((2_000..29_000).contains(&n), "{n}");
        // The floor's middle, and not the ceiling that lies before it.
        let from_above = format!("{artifact} --size 90x90 --camera 0,0,9,0,0,-1 --up 0,1,0");
        let floor = picture(&bench, &format!("{from_above} --ortho=1.5 --background #000000"));
        assert_eq!(floor.count(|p| p == [0; 3]), 0);
        let narrow = picture(&bench, &format!("{from_above} --ortho=4 --background 000000"));
        let share = narrow.count(|p| p != [0; 3]) as f64 / 8100.0;
        assert!((0.22..0.34).contains(&share), "{share}");
        for view in ["front", "back", "left", "right", "top", "bottom"] {
            for lens in ["--ortho", "--fov 20"] {
                let line = format!("{artifact} --view {view} {lens} --size 64x48 --cull none");
                let n = picture(&bench, &line).count(|p| p != [255; 3]);
                assert!(n > 60, "{line}: {n}");
            }
        }
    }
}

#[test]
fn colours_are_those_asked_for() {
    let bench = room();
    let from_above =
        "room.vmap --size 90x90 --camera 0,0,9,0,0,-1 --up 0,1,0 --ortho=1.5 --shade 0";
    let middle = |by: &str| {
        let png = picture(&bench, &format!("{from_above} {by}"));
        let at = 3 * (45 * 90 + 45);
        [png.2[at], png.2[at + 1], png.2[at + 2]]
    };
    // The floor faces +z: half red and green, full blue; bin 4.
    assert_eq!(middle("--color-by normal"), [128, 128, 255]);
    assert_eq!(middle("--color-by bin"), [106, 152, 233]);
    assert_eq!(middle("--color-by rgb"), [205; 3]);
    // All see as many, and are at one level: the middle of the ramp.
    assert_eq!(middle("--color-by sees-count"), middle("--color-by level"));
    let n_surfels = bench.with_map("room.vmap", |view| view.summary().n_surfels);
    let mut rows = String::from("surfel,light\n");
    (0..n_surfels).rev().for_each(|id| writeln!(rows, "{id},{}", id % 2).unwrap());
    bench.write("a.csv", &rows);
    let ends = picture(&bench, "room.vmap --color-by scalar --scalar a.csv:light --size 300x200");
    assert!(ends.count(|p| p == [61, 4, 89]) > 0, "the dark end of the bar");
    bench.write("b.csv", "light\n1\n2\n");
    bench.write("c.csv", "surfel,light\n0,1\n4000000,2\n");
    bench.write("d.csv", "surfel,light\n0,bright\n");
    let scalar = |of: &str| {
        let line = format!("render room.vmap --color-by scalar --scalar {of} -o out.png");
        bench.line(&line)
    };
    scalar("b.csv:light").fails(65, &["b.csv", "2 rows", "column surfel"]);
    scalar("b.csv:heat").fails(65, &["b.csv", "no column heat", "light"]);
    scalar("c.csv:light").fails(65, &["c.csv", "line 3", "4000000"]);
    scalar("d.csv:light").fails(65, &["d.csv", "line 2", "bright"]);
    scalar("e.csv:light").fails(66, &["e.csv"]);
    bench.write("f.csv", "surfel,light\n3,1\n5,2\n3,1\n");
    scalar("f.csv:light").fails(65, &["f.csv", "line 4", "surfel 3 again"]);
    bench.write("g.csv", "surfel,light\n3,1\n5,2\n6,\n");
    let run = scalar("g.csv:light").ok();
    assert!(run.stderr.contains(&format!("{} of {n_surfels} surfels", n_surfels - 2)), "{run:?}");
    // Ends of the colours that are given: all is brighter than the brightest, or darker.
    let of = |range: &str| middle(&format!("--color-by level --range {range}"));
    assert_eq!((of("-5,0.5"), of("50,60")), ([242, 226, 82], [61, 4, 89]));
}

#[test]
fn what_an_eye_sees_is_violet() {
    let bench = room();
    let from_above = "room.vmap --size 90x90 --camera 0,0,9,0,0,-1 --up 0,1,0 --ortho=1.5";
    // From the ceiling all of the floor, from the floor nothing of it.
    let seen = picture(&bench, &format!("{from_above} --visible-from 0,0,1"));
    assert!(seen.count(is_violet) > 8_000);
    assert!(seen.count(is_cyan) > 10, "the mark");
    let unseen = picture(&bench, &format!("{from_above} --visible-from 0.5,0.5,-1"));
    // The eye's own surfel alone.
    assert!(unseen.count(is_violet) < 1_500);
    let line = format!("render {from_above} -o out.png --visible-from");
    bench.line(&format!("{line} 7,7,7")).fails(65, &["outside", "7,7,7"]);
    bench.line(&format!("{line} 0,0,0")).fails(65, &["no surface"]);
}

#[test]
fn exit_2_what_is_no_picture() {
    let bench = room();
    let before = bench.names();
    for (line, words) in [
        ("room.vmap --camera 1,2,3,1,2,3", &["eye and target"][..]),
        ("room.vmap --camera 1,2,3,1,2,9", &["--up"]),
        ("room.vmap --camera 1,2,3,4,5", &["six numbers"]),
        ("room.vmap --camera 1,2,3,4,5,nan", &["six numbers"]),
        ("room.vmap --camera 1,2,3,4,5,6 --up 0,0,0", &["--up"]),
        ("room.vmap --camera 1,2,3,4,5,6 --view top", &["--camera", "--view"]),
        ("room.vmap --up 0,0,0", &["--up"]),
        ("room.vmap --fov 0", &["0 degrees", "170"]),
        ("room.vmap --fov 171", &["171", "170"]),
        ("room.vmap --fov 60 --ortho", &["--fov", "--ortho"]),
        ("room.vmap --ortho=-3", &["--ortho", "width"]),
        ("room.vmap --size 0x100", &["0x100"]),
        ("room.vmap --size 100000x2", &["16384"]),
        ("room.vmap --size big", &["big", "1280x720"]),
        ("room.vmap --shade 2", &["--shade", "0 to 1"]),
        ("room.vmap --radius 0", &["--radius"]),
        ("room.vmap --background blue", &["blue", "RRGGBB"]),
        ("room.vmap --color-by heat", &["heat", "possible values"]),
        ("room.vmap --color-by scalar", &["--scalar"]),
        ("room.vmap --scalar a.csv:b", &["--color-by scalar"]),
        ("room.vmap --color-by scalar --scalar a.csv", &["FILE.csv:NAME"]),
        ("room.octree --color-by level", &["level", ".vmap"]),
        ("room.octree --color-by sees-count", &[".vmap"]),
        ("room.vmap --range 1,2", &["--range", "sees-count"]),
        ("room.vmap --color-by level --range 2,1", &["MIN,MAX"]),
        ("room.vmap --clip 1,2,3", &["six numbers"]),
        ("room.vmap --normal 0,0,1", &["--visible-from"]),
        ("room.vmap --exact", &["--visible-from"]),
        ("room.octree --octree room.octree", &["--octree", ".vmap"]),
        ("room.octree --visible-from 0,0,1", &["--visible-from", ".vmap"]),
    ] {
        bench.line(&format!("render {line} -o out.png")).fails(2, words);
    }
    bench.line("render room.vmap").fails(2, &["--output"]);
    for (line, output) in [
        ("room.vmap", "room.vmap"),
        ("room.octree", "room.octree/points.pvo"),
        ("room.vmap --octree room.octree", "room.octree/points.pvo"),
        ("room.vmap --visible-from 0,0,1 --exact", "room.octree/points.pvo"),
    ] {
        let run = bench.line(&format!("render {line} -o {output}"));
        run.fails(2, &["one of the inputs"]);
    }
    bench.line("render room.vmap --size 16384x16384 -o out.png").fails(78, &["--size", "MiB"]);
    bench.line("render none.vmap -o out.png").fails(66, &["none.vmap"]);
    bench.line("render room.ply -o out.png").fails(65, &["room.ply"]);
    bench.line("render room.vmap -o none/out.png").fails(73, &["none/out.png"]);
    assert_eq!(bench.names(), before);
}

#[test]
fn the_same_bytes_for_any_threads_to_a_file_or_a_stream() {
    let bench = room();
    let line = "render room.vmap --color-by sees-count --visible-from 0,0,1 --size 320x200 -o";
    let words = |out: &'static str| line.split_whitespace().chain([out]);
    for (threads, out) in [("1", "a.png"), ("2", "b.png"), ("3", "c.png")] {
        let mut command = bench.command(words(out));
        assert!(command.env("RAYON_NUM_THREADS", threads).status().unwrap().success());
        assert!(bench.read(out) == bench.read("a.png"));
    }
    let stream = bench.command(words("-")).stderr(Stdio::null()).output().unwrap();
    assert!(stream.status.success());
    assert!(stream.stdout == bench.read("a.png"));
    // What was there is replaced.
    bench.write("a.png", "no picture");
    bench.run(words("a.png")).ok();
    assert!(bench.read("a.png") == bench.read("b.png"));
}

#[test]
fn scans_of_one_point_or_none() {
    let bench = Bench::new();
    let head = |n| cli_common::ply_header(n, &cli_common::XYZ);
    bench.write("one.ply", head(1) + "5 6 7\n");
    bench.write("none.ply", head(0));
    bench.write("same.ply", head(3) + "1 1 1\n1 1 1\n1 1 1\n");
    for name in ["one", "none", "same"] {
        bench.line(&format!("ingest {name}.ply")).ok();
        bench.line(&format!("build {name}.octree")).ok();
        for artifact in [format!("{name}.vmap"), format!("{name}.octree")] {
            for lens in ["--fov 40", "--ortho"] {
                let png = picture(&bench, &format!("{artifact} {lens} --size 50x40"));
                assert_eq!(png.count(|p| p != [255; 3]) > 0, name != "none", "{artifact}");
            }
        }
    }
}

#[test]
fn a_view_that_was_chosen_can_be_asked_for() {
    let bench = room();
    for view in ["--view corner", "--view top --ortho", "--view left --up 0,1,0"] {
        let line = format!("render room.vmap --size 90x60 {view} -o a.png");
        let run = bench.line(&line).ok();
        let (_, flags) = run.stderr.split_once("seen from here: ").unwrap();
        bench.line(&format!("render room.vmap --size 90x60 {} -o b.png", flags.trim())).ok();
        let [a, b] = ["a.png", "b.png"].map(|name| Png::of(&bench.read(name)));
        let n_other = a.2.iter().zip(&b.2).filter(|(a, b)| a.abs_diff(**b) > 8).count();
        assert!(n_other < 100, "{view} {n_other}");
    }
    // A camera's own: the floor is two wide, and in the picture from edge to edge.
    let from_above = "--size 90x90 --camera 0,0,9,0,0,-1 --up 0,1,0 --ortho --clip -2,-2,-2,2,2,0";
    let n = picture(&bench, &format!("room.octree {from_above}")).count(|p| p != [255; 3]);
    assert!((6_500..8_100).contains(&n), "{n}");
}

#[test]
fn fields_of_colour_that_nobody_filled_are_no_colour() {
    let bench = Bench::new();
    let mut text = cli_common::ply_header(1600, &["x", "y", "z"]);
    text = text.replace(
        "end_header",
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header",
    );
    for i in 0..1600 {
        writeln!(text, "{} {} 0 0 0 0", i % 40, i / 40).unwrap();
    }
    bench.write("black.ply", text);
    bench.line("ingest black.ply").ok();
    bench.line("build black.octree").ok();
    for artifact in ["black.octree", "black.vmap"] {
        let png = picture(&bench, &format!("{artifact} --view top --size 60x60"));
        assert!(png.count(|p| p[0] < 100) == 0, "{artifact}");
    }
    // The column stays.
    bench.line("export black.vmap --octree black.octree --points out.ply --field leaf").ok();
    assert!(String::from_utf8_lossy(&bench.read("out.ply")).contains("red"));
}
