//! Models in the Cornell room: the scan, the exact triangles beside it, and what the command says
//! of a map that was made of it.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod vectors;

use std::collections::HashMap;
use std::path::Path;

use cli_common::{Bench, data, is_slow_asked_for, needle};
use pvmap::accuracy::{Drawn, ScanPoints, Way, compare, draw_place};
use pvmap::query::{Located, Map, Place, Snap};
use pvmap::scan::MeshWriter;
use pvmap::scene::{Mesh, Scene, SceneKind, Up};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::OctreeView;
use pvmap::vmap::octree::Placement;
use pvmap::{Limits, Quiet};
use serde_json::Value;
use vectors::{cross, dot, sub};

fn write_mesh(path: &Path, corners: &[[f64; 3]], triangles: &[[u32; 3]]) {
    let colors = vec![[0; 3]; triangles.len()];
    MeshWriter::create(path).unwrap().finish(corners, triangles, &colors).unwrap();
}

fn read_mesh(path: &Path) -> Mesh {
    scenes::read_mesh(path, 1 << 30).unwrap().mesh
}

fn two_needles(folder: &Path) -> Scene {
    let path = folder.join("needle.ply");
    needle(&path);
    let model = || read_mesh(&path).upright(Up::Y);
    Scene::with_statues(1, vec![model(), model()], None).unwrap()
}

fn triangles_of(mesh: &Mesh) -> Vec<[[f64; 3]; 3]> {
    mesh.triangles().iter().map(|t| t.map(|c| mesh.corners()[c as usize])).collect()
}

#[test]
fn the_scan_is_the_same_bytes_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let scene = two_needles(folder.path());
    let bytes = |threads| {
        let path = folder.path().join(format!("{threads}.ply"));
        let limits = Limits { threads, ..Limits::default() };
        // More than a block of points.
        let request = SceneRequest { n_points: 300_000, shuffle: threads == 8 };
        scenes::write(&scene, &request, &path, &limits, &Quiet).unwrap();
        std::fs::read(path).unwrap()
    };
    let one = bytes(1);
    assert!(one == bytes(2) && one == bytes(3));
    assert!(one != bytes(8), "that one is shuffled");
}

#[test]
fn truth_comes_back_as_it_was_and_its_triangles_hold_all_points() {
    let bench = Bench::new();
    needle(&bench.path("needle.ply"));
    let line = "scene cornell --model needle.ply --model needle.ply --points 3k -o two.ply \
                --truth two.mesh.ply";
    bench.line(line).ok();
    let found = read_mesh(&bench.path("two.mesh.ply"));
    let (expected, colors) = two_needles(bench.path("").as_path()).mesh().unwrap();
    assert_eq!(found, expected);
    assert_eq!(colors.len(), 12 + 2 * 24);
    // A rerun writes the same bytes.
    let before = [bench.read("two.ply"), bench.read("two.mesh.ply")];
    bench.line(line).ok();
    assert!(before == [bench.read("two.ply"), bench.read("two.mesh.ply")]);

    let triangles = triangles_of(&found);
    let holds = |[a, b, c]: &[[f64; 3]; 3], p: [f64; 3]| {
        let normal = cross(sub(*b, *a), sub(*c, *a));
        let size = dot(normal, normal).sqrt();
        // The file holds f32, whose last bit is worth 5e-7 m here.
        let inside = |from, to| dot(normal, cross(sub(to, from), sub(p, from))) > -1e-5 * size;
        (dot(normal, sub(p, *a)) / size).abs() < 1e-6
            && inside(*a, *b)
            && inside(*b, *c)
            && inside(*c, *a)
    };
    bench.line("ingest two.ply").ok();
    bench.with_octree("two.octree", |view: &OctreeView<'_>| {
        let placement = Placement::new(view.schema(), view.frame().frame, view.sources());
        assert_eq!(view.summary().n_points, 3000);
        for point in view.points(0, 3000).unwrap().iter() {
            let p = placement.world(point.unwrap().record).unwrap();
            assert!(triangles.iter().any(|t| holds(t, p)), "{p:?}");
        }
    });
}

#[test]
fn the_truth_counted_is_that_of_all_triangles_one_by_one() {
    let folder = tempfile::tempdir().unwrap();
    let truth = Scene::of_mesh(&two_needles(folder.path()).mesh().unwrap().0, 1);
    let triangles = triangles_of(&truth.mesh().unwrap().0);
    // Möller and Trumbore 1997: where on the segment a triangle is met.
    let meets = |[a, b, c]: &[[f64; 3]; 3], p: [f64; 3], d: [f64; 3]| {
        let (ab, ac) = (sub(*b, *a), sub(*c, *a));
        let across = cross(d, ac);
        let scale = dot(ab, across);
        let u = dot(sub(p, *a), across) / scale;
        let along = cross(sub(p, *a), ab);
        let (v, t) = (dot(d, along) / scale, dot(ac, along) / scale);
        u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 && t < 1.0
    };
    let lifted = |p: &Place| {
        let n = p.normal.unwrap();
        [0, 1, 2].map(|i| p.position[i] + 1e-9 * f64::from(n[i]))
    };
    let mut counts = [0; 2];
    let answer = |a: &Place, b: &Place| {
        let d = sub(b.position, a.position);
        let cosine = |p: &Place| dot(p.normal.unwrap().map(f64::from), d);
        let faces = cosine(a) > 0.0 && cosine(b) < 0.0;
        let (p, q) = (lifted(a), lifted(b));
        let sees = faces && !triangles.iter().any(|t| meets(t, p, sub(q, p)));
        counts[0] += u64::from(faces);
        counts[1] += u64::from(sees);
        Ok(sees.into())
    };
    let mut ways = [Way { name: "one by one", answer: Box::new(answer) }];
    let mut draw = |rng: &mut fastrand::Rng| Ok(draw_place(&truth, rng));
    let found = compare(&truth, (20_000, 3), &mut draw, &mut ways, &Quiet).unwrap();
    drop(ways);
    assert_eq!(found.tallies[0].n_agreeing(), 20_000);
    assert_eq!([found.n_facing, found.n_visible], counts);
    assert!(found.n_visible > 5_000 && found.n_facing > found.n_visible + 500, "{found:?}");
}

fn accuracy(bench: &Bench, line: &str) -> Value {
    let run = bench.line(&format!("accuracy {line} --json")).ok();
    serde_json::from_str(&run.stdout).unwrap()
}

#[test]
fn an_empty_room_is_answered_right_but_for_pairs_of_one_leaf() {
    let bench = Bench::new();
    bench.line("scene cornell --points 20k -o room.ply --truth room.mesh.ply").ok();
    bench.line("scene empty --points 20k -o empty.ply").ok();
    assert!(bench.read("room.ply") == bench.read("empty.ply"));
    bench.line("ingest room.ply").ok();
    bench.line("build room.octree").ok();
    let asked = "room.vmap --truth room.mesh.ply --pairs 20k";
    for line in [asked.to_owned(), format!("{asked} --octree room.octree")] {
        let found = accuracy(&bench, &line);
        assert_eq!((&found["pairs"], &found["left_out"]), (&20_000.into(), &0.into()));
        assert_eq!((&found["triangles"], &found["facing"]), (&12.into(), &found["visible"]));
        // Five of six pairs are on two walls.
        let share = found["visible"].as_f64().unwrap() / 20_000.0;
        assert!((share - 5.0 / 6.0).abs() < 0.01, "{share}");
        let leaves = &found["ways"][0];
        let agree = &leaves["agree"];
        // What is wrong are pairs of one leaf, which see each other by [V-6]. Measured were 0.15 %
        // with 20 000 points; more points are smaller leaves.
        assert!(agree["share"].as_f64().unwrap() > 0.998, "{found}");
        assert_eq!(leaves["agree_facing"]["share"], 1.0, "{found}");
        assert_eq!(leaves["wrongly_invisible"]["n"], 0, "{found}");
        assert!(agree["low"].as_f64() < agree["share"].as_f64(), "{found}");
    }
    let run = bench.line(&format!("accuracy {asked} --seed 2")).ok();
    for words in ["20000 pairs of places on room.mesh.ply (seed 2)", "agree, facing", "leaves"] {
        assert!(run.stdout.contains(words), "{}", run.stdout);
    }
}

#[test]
fn what_cannot_be_a_scene_is_told_in_one_line() {
    let bench = Bench::new();
    needle(&bench.path("needle.ply"));
    let whole = bench.read("needle.ply");
    bench.write("text.ply", "a letter to a friend\n");
    bench.write("short.ply", &whole[..whole.len() - 9]);
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                end_header\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n";
    bench.write("flat.ply", text);
    bench.write("lost.ply", text.replace("3 0 1 2", "3 0 1 9"));
    bench.write("huge.ply", text.replace("face 1", "face 9000000000"));
    bench.write("cloud.ply", cli_common::room_ply(4));
    for (model, code, words) in [
        ("missing.ply", 66, &["missing.ply"][..]),
        ("text.ply", 65, &["text.ply", "PLY header"]),
        ("short.ply", 65, &["short.ply", "ends before the last of 24 rows of face"]),
        ("flat.ply", 65, &["flat.ply", "none of its 1 triangles has an area"]),
        ("lost.ply", 65, &["lost.ply", "triangle 0 has corner 9, there are 3"]),
        ("huge.ply", 65, &["huge.ply", "declares 9000000000 of face"]),
        ("cloud.ply", 65, &["cloud.ply", "no element face"]),
    ] {
        bench.line(&format!("scene cornell --model {model} -o a.ply")).fails(code, words);
        bench.line(&format!("accuracy a.vmap --truth {model}")).fails(66, &["a.vmap"]);
    }
    for (line, words) in [
        ("scene empty --model needle.ply -o a.ply", &["--model", "cornell"][..]),
        ("scene cornell --packed --model needle.ply -o a.ply", &["--packed", "--model"]),
        ("scene cornell --model needle.ply --size 5.3 -o a.ply", &["needle.ply", "5.25 m"]),
        ("scene cornell --model needle.ply --size 0 -o a.ply", &["--size"]),
        ("scene cornell --model needle.ply --up x -o a.ply", &["--up", "neither y nor z"]),
        ("scene cornell --model needle.ply --points 1,2,3 -o a.ply", &["3 numbers", "1 or 2"]),
        ("scene cornell --model needle.ply -o needle.ply", &["needle.ply", "inputs"]),
        ("scene cornell -o a.ply --truth a.ply", &["a.ply", "one file"]),
        ("scene furnished -o a.ply --truth b.ply", &["b.ply", "sphere"]),
        ("scene empty -o a.ply --points 2000000M", &["--points", "at most 1099511627776"]),
        ("scene cornell --points 400000M,1 -o a.ply", &["2 numbers", "expected 1"]),
    ] {
        bench.line(line).fails(2, words);
    }
    let eleven = " --model needle.ply".repeat(11);
    let words = ["needle.ply", "11 statues, the room holds 10"];
    bench.line(&format!("scene cornell{eleven} -o a.ply")).fails(2, &words);
    assert!(!bench.path("a.ply").exists());
}

#[test]
fn a_truth_that_cannot_be_written_leaves_no_scan_alone() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("folder.ply")).unwrap();
    bench.write("old.ply", "before");
    for (truth, code) in [("nowhere/b.ply", 73), ("folder.ply", 73)] {
        bench
            .line(&format!("scene cornell --points 100 -o a.ply --truth {truth}"))
            .fails(code, &[truth]);
        bench
            .line(&format!("scene cornell --points 100 -o old.ply --truth {truth}"))
            .fails(code, &[truth]);
    }
    bench.line("scene cornell --points 100 -o nowhere/a.ply --truth b.ply").fails(73, &["a.ply"]);
    assert!(!bench.path("a.ply").exists() && !bench.path("b.ply").exists());
    assert_eq!(bench.read("old.ply"), b"before");
}

#[test]
fn triangles_count_against_the_memory_and_flat_faces_are_told() {
    let bench = Bench::new();
    // 300 000 triangles of three corners.
    let mut text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n\
                    property float y\nproperty float z\nelement face 300000\n\
                    property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
        .to_owned();
    text += &"3 0 1 2\n".repeat(299_998);
    text += "2 0 1\n0\n";
    bench.write("many.ply", text);
    bench.line("scene empty --points 100 -o a.ply").ok();
    bench.line("ingest a.ply").ok();
    bench.line("build a.octree").ok();
    let scene = "scene cornell --points 100 -o b.ply --model many.ply";
    let ask = "accuracy a.vmap --pairs 10 --truth many.ply";
    let words = ["--memory", "triangles"];
    for line in [scene, ask] {
        bench.line(&format!("{line} --memory 64MiB")).fails(78, &words);
    }
    // One alone would fit.
    bench.line(&format!("{scene} --model many.ply --memory 120MiB")).fails(78, &words);
    let run = bench.line(&format!("{scene} --memory 120MiB")).ok();
    run.warns(&["many.ply: 2 faces of fewer than three corners"]);
}

#[test]
fn a_map_is_asked_of_its_own_truth_and_octree() {
    let bench = Bench::new();
    bench.line("scene cornell --points 3k -o room.ply --truth room.mesh.ply").ok();
    bench.line("ingest room.ply").ok();
    bench.line("build room.octree").ok();
    bench.line("scene cave --points 3k -o cave.ply").ok();
    bench.line("ingest cave.ply").ok();
    let line = "accuracy room.vmap --truth room.mesh.ply --octree cave.octree";
    bench.line(line).fails(65, &["room.vmap", "cave.octree", "not built from"]);
    bench.line("accuracy room.vmap --truth room.ply").fails(65, &["room.ply", "not a mesh"]);
    bench.line("accuracy room.vmap --truth none.ply").fails(66, &["none.ply"]);
    bench.line("accuracy room.octree --truth room.mesh.ply").fails(65, &["room.octree"]);
    let far = [[900.0, 0.0, 0.0], [901.0, 0.0, 0.0], [900.0, 1.0, 0.0]];
    write_mesh(&bench.path("far.ply"), &far, &[[0, 1, 2]]);
    for octree in ["", " --octree room.octree"] {
        let line = format!("accuracy room.vmap --truth far.ply --pairs 100{octree}");
        bench.line(&line).fails(65, &["far.ply", "none of the pairs"]);
    }
}

/// What leaves say of all pairs of points, each with itself and both ways round, against the
/// triangles.
#[derive(Debug, Default)]
struct AllPairs {
    n: f64,
    said_visible: f64,
    wrongly_visible: f64,
    wrongly_invisible: f64,
}

/// Asks every pair of leaves once, and the triangles about every pair of their points.
fn all_pairs(map: &Map<'_>, truth: &Scene, points: &[Drawn]) -> AllPairs {
    let locate = |drawn: &Drawn| map.locate(&drawn.place, Snap::Within(f64::INFINITY)).unwrap();
    let located: Vec<Located> = points.iter().map(locate).collect();
    let mut verdicts = HashMap::new();
    let mut found = AllPairs::default();
    for (a, p) in located.iter().zip(points) {
        for (b, q) in located.iter().zip(points) {
            let verdict = verdicts.entry((a.surfel, b.surfel));
            let says = *verdict.or_insert_with(|| map.pair(a, b).unwrap().visible);
            let sees = truth.sees(&p.sample.unwrap(), &q.sample.unwrap());
            found.n += 1.0;
            found.said_visible += f64::from(u8::from(says));
            found.wrongly_visible += f64::from(u8::from(says && !sees));
            found.wrongly_invisible += f64::from(u8::from(sees && !says));
        }
    }
    found
}

#[test]
fn n55_what_accuracy_tells_is_the_rate_over_all_pairs_of_points() {
    // "Every point sees every point" is more than a verdict between the centres of two leaves can
    // promise. How often it does not hold is told, from a sample; here it is counted.
    let bench = Bench::new();
    needle(&bench.path("needle.ply"));
    let models = "--model needle.ply --model needle.ply";
    bench.line(&format!("scene cornell {models} --points 1500 -o r.ply --truth r.mesh.ply")).ok();
    bench.line("ingest r.ply").ok();
    bench.line("build r.octree --leaf-capacity 8").ok();
    let truth = Scene::of_mesh(&read_mesh(&bench.path("r.mesh.ply")), 1);
    let all = bench.with_octree("r.octree", |octree| {
        let points = ScanPoints::new(octree, Path::new("r.octree")).unwrap();
        let points: Vec<Drawn> = (0..1500).map(|i| points.at(&truth, i).unwrap()).collect();
        all_pairs(&Map::open(&bench.read("r.vmap")).unwrap(), &truth, &points)
    });
    assert!(
        all.wrongly_visible > 0.005 * all.n && all.wrongly_invisible > 0.005 * all.n,
        "{all:?}"
    );
    let rates = [
        ("wrongly_visible", all.wrongly_visible / all.n),
        ("wrongly_invisible", all.wrongly_invisible / all.n),
        ("visible_wrong", all.wrongly_visible / all.said_visible),
    ];
    eprintln!("{all:?}, {rates:?}");
    // Of 60 intervals that hold the rate 95 times of 100 fewer than 51 do once in 3000 times.
    let mut n_held = 0;
    for seed in 0..20 {
        let line = "r.vmap --truth r.mesh.ply --octree r.octree --pairs 4000 --seed";
        let found = accuracy(&bench, &format!("{line} {seed}"));
        for (name, rate) in rates {
            let told = &found["ways"][0][name];
            let [low, share, high] =
                ["low", "share", "high"].map(|key| told[key].as_f64().unwrap());
            assert!(low < share && share < high && high - low < 0.05, "{told}");
            n_held += u32::from(low <= rate && rate <= high);
        }
    }
    eprintln!("{n_held} of 60 intervals hold the rate");
    assert!(n_held >= 51, "{n_held}");
}

/// Makes a room with models, its octree and its map, and says what share of pairs each way answers
/// as the triangles do, in percent.
fn agreement(bench: &Bench, models: &str, n_points: u32, build: &str, asked: &str) -> Vec<f64> {
    let room = format!("{models} --points {n_points} -o r.ply --truth r.mesh.ply");
    bench.line(&format!("scene cornell{room}")).ok();
    bench.line("ingest r.ply --overwrite").ok();
    bench.line(&format!("build r.octree {build}")).ok();
    let line = format!("r.vmap --truth r.mesh.ply --octree r.octree {asked}");
    let found = accuracy(bench, &line);
    assert_eq!(found["left_out"], 0, "{found}");
    let ways = found["ways"].as_array().unwrap();
    let shares = ways.iter().map(|way| {
        assert_eq!((&way["refused"], &way["far"]), (&0.into(), &0.into()), "{found}");
        100.0 * way["agree"]["share"].as_f64().unwrap()
    });
    let shares: Vec<f64> = shares.collect();
    eprintln!("{models} {n_points} points {build}: {shares:.2?} % agree");
    shares
}

#[test]
fn rooms_with_the_papers_statues() {
    let Some(folder) = data("stanford") else { return };
    let model = |name: &str| format!(" --model {}", folder.join(name).display());
    let bunny = model("bunny_bun_zipper.ply");
    let two = model("dragon_vrip_res3.ply.gz") + &model("armadillo_43k.ply");
    let ask = |models: &str, build: &str| {
        agreement(&Bench::new(), models, 30_000, build, "--pairs 20k")[0]
    };
    assert!(ask(&bunny, "") > 95.0);
    let plain = ask(&two, "--max-spread 0");
    assert!(plain > 88.0);
    // Limbs are thin, and so are the leaves that are cut further, some of them by default.
    let [by_default, cut_further] = ["", "--max-spread 3"].map(|build| ask(&two, build));
    assert!(cut_further > plain + 0.5, "{plain} {cut_further}");
    assert!(plain <= by_default && by_default < cut_further, "{by_default}");
}

#[test]
fn rooms_of_the_readme() {
    let (Some(folder), true) = (data("stanford"), is_slow_asked_for()) else { return };
    let model = |name: &str| format!(" --model {}", folder.join(name).display());
    let two = model("dragon_vrip.ply.gz") + &model("armadillo_43k.ply");
    // Measured: surfels 98.78, 98.45 and 97.06 %, points 99.65, 99.65 and 99.32 %, surfels with
    // --max-spread 3 98.87, 98.79 and 97.91 %. Of 100 000 pairs a tenth of a percent is chance.
    for (models, least) in [
        (model("bunny_bun_zipper.ply"), [98.65, 99.55, 98.75]),
        (model("happy_buddha_50k.ply"), [98.3, 99.5, 98.6]),
        (two, [96.8, 99.2, 97.7]),
    ] {
        let bench = Bench::new();
        let plain = agreement(&bench, &models, 400_000, "", "--exact");
        let cut_further = agreement(&bench, &models, 400_000, "--max-spread 3", "");
        let found = [plain[0], plain[1], cut_further[0]];
        assert!(found.iter().zip(least).all(|(f, l)| *f > l), "{models}: {found:?}, {least:?}");
    }
}

#[test]
fn the_packed_room_has_its_truth() {
    let bench = Bench::new();
    bench.line("scene cornell --packed --points 500 -o a.ply --truth a.mesh.ply").ok();
    bench.line("scene packed --points 500 -o b.ply").ok();
    assert!(bench.read("a.ply") == bench.read("b.ply"));
    let (mesh, _) = Scene::new(SceneKind::Packed, 1).mesh().unwrap();
    assert_eq!(read_mesh(&bench.path("a.mesh.ply")), mesh);
}
