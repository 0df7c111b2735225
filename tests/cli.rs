//! How the command behaves: exit codes, messages, configuration, signals, answers.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use cli_common::{Bench, LAS_BOUNDS, Run, XYZ, floor, patch, ply_header, room_ply, write_las};
use serde_json::Value;

/// A folder with `room.ply`, its octree and its map.
fn room() -> Bench {
    let bench = Bench::new();
    bench.write("room.ply", room_ply(40));
    bench.line("ingest room.ply").ok();
    bench.line("build").ok();
    bench
}

fn info(bench: &Bench, artifact: &str) -> Value {
    let run = bench.line(&format!("info {artifact} --json")).ok();
    serde_json::from_str(&run.stdout).unwrap()
}

#[test]
fn help_has_examples() {
    let bench = Bench::new();
    for command in ["ingest", "build", "query", "info", "verify", "export", "scene", "demo"] {
        let help = bench.line(&format!("{command} --help")).ok();
        assert!(help.stdout.contains(&format!("  pvmap {command}")), "{}", help.stdout);
        assert!(bench.line("--help").ok().stdout.contains(&format!("\n  {command} ")));
    }
    let pair = bench.line("query a.vmap pair --help").ok();
    assert!(pair.stdout.contains("  pvmap query grotto.vmap pair "), "{}", pair.stdout);
    let pairs = bench.line("query a.vmap pairs --help").ok();
    assert!(pairs.stdout.contains("x1 y1 z1 x2 y2 z2"), "{}", pairs.stdout);
    bench.line("--version").ok();
}

#[test]
fn exit_2_wrong_usage() {
    let bench = Bench::new();
    bench.write("a.ply", room_ply(4));
    bench.write("b.ply", room_ply(4));
    for line in [
        "",
        "dance",
        "ingest",
        "ingest a.ply --depth 8",
        "ingest a.ply --memory 63MiB",
        "ingest a.ply --sensor 1,2",
        "ingest a.ply --up --sensor 1,2,3",
        "query a.vmap pair 1,2,3",
        "query a.vmap pair 1,2,nan 4,5,6",
        "scene castle -o a.ply",
        "build a.octree --max-level many",
    ] {
        let run = bench.line(line).exits(2);
        assert!(!run.stderr.is_empty(), "{line}");
    }
    bench.line("ingest a.ply b.ply").fails(2, &["several scans", "-o NAME.octree"]);
    bench.line("build").fails(2, &["no *.octree here", "pvmap ingest"]);
    bench.line("scene empty -o a.obj").fails(2, &["a.obj", ".las, .laz or .ply"]);
    bench.line("export a.vmap").fails(2, &["--surfels"]);
    assert_eq!(bench.names(), ["a.ply", "b.ply"]);
}

#[test]
fn f50_exit_65_what_is_no_artifact() {
    let bench = room();
    let mut swapped = bench.read("room.vmap");
    swapped[..8].reverse();
    bench.write("swapped", swapped);
    bench.write("text", "a letter to a friend\n".repeat(100));
    bench.write("empty", "");
    std::fs::create_dir(bench.path("folder")).unwrap();
    for found in ["swapped", "text", "empty", "room.ply", "folder"] {
        for line in [
            format!("info {found}"),
            format!("verify {found}"),
            format!("export {found} --nodes N.csv"),
            format!("query {found} pair 0,0,1 0,0,-1"),
            format!("build {found}"),
        ] {
            bench.line(&line).fails(65, &[found]);
        }
    }
    // A map is no octree, and an octree is no map.
    bench.line("export room.octree --nodes N.csv").fails(65, &["octree"]);
    bench.line("query room.octree pair 0,0,1 0,0,-1").fails(65, &["octree"]);
    std::fs::create_dir(bench.path("false.octree")).unwrap();
    let file = std::path::Path::new("false.octree").join(pvmap::vmap::octree::FILE_NAME);
    bench.write(file, bench.read("room.vmap"));
    bench.line("build false.octree -o false.vmap").fails(65, &["false.octree"]);
    assert!(!bench.path("N.csv").exists() && !bench.path("false.vmap").exists());
}

#[test]
fn f67_messages_about_any_name_are_one_line() {
    let bench = Bench::new();
    let name = "new\n line";
    bench.run(["info", name]).fails(66, &["no such file"]);
    bench.run(["build", name]).fails(66, &["no such file"]);
    bench.run(["ingest", name]).fails(66, &["no such file"]);
    bench.run(["build", "--config", name]).fails(78, &["no such configuration"]);
    bench.write(name, "a letter to a friend\n");
    bench.run(["info", name]).fails(65, &["not a pvmap file"]);
    bench.run(["ingest", name]).fails(65, &["not a LAS, LAZ or PLY file"]);
    bench.run(["ingest", name, "-o", name]).fails(2, &["the output is one of the inputs"]);
    bench.run(["build", "--config", name]).fails(78, &["line 1"]);
}

#[test]
fn exit_66_missing_input() {
    let bench = Bench::new();
    bench.write("a.ply", room_ply(4));
    for line in [
        "ingest none.las",
        "ingest a.ply none.las -o a.octree",
        "build none.octree",
        "info none.vmap",
        "verify none.vmap",
        "export none.vmap --nodes N.csv",
        "query none.vmap pair 1,2,3 4,5,6",
        "query none.vmap pairs none.csv",
    ] {
        bench.line(line).fails(66, &["none.", "no such file"]);
    }
    // A folder is no scan.
    bench.line("ingest .  -o a.octree").fails(66, &["not a regular file"]);
    assert_eq!(bench.names(), ["a.ply"]);
}

#[test]
fn exit_73_output_in_the_way() {
    let bench = room();
    let before = info(&bench, "room.octree");
    bench.line("ingest room.ply").fails(73, &["room.octree", "--overwrite"]);
    bench.line("ingest room.ply --normals none --overwrite").ok();
    assert_ne!(info(&bench, "room.octree"), before);
    bench.line("build").ok();

    bench.write("taken", "mine");
    bench.line("ingest room.ply -o taken --overwrite").fails(73, &["taken"]);
    assert_eq!(bench.read("taken"), b"mine");
    std::fs::create_dir(bench.path("folder")).unwrap();
    bench.line("build -o folder").fails(73, &["folder"]);
    for line in [
        "ingest room.ply -o missing/a.octree",
        "scene empty --points 10 -o missing/a.ply",
        "export room.vmap --nodes missing/N.csv",
        "build -o missing/a.vmap",
    ] {
        bench.line(line).fails(73, &["missing"]);
    }
    assert_eq!(bench.names(), ["folder", "room.octree", "room.ply", "room.vmap", "taken"]);
}

#[test]
fn exit_77_no_permission() {
    use std::os::unix::fs::PermissionsExt;
    let bench = Bench::new();
    bench.write("a.ply", room_ply(4));
    let allow = |mode| std::fs::Permissions::from_mode(mode);
    std::fs::set_permissions(bench.path("a.ply"), allow(0o000)).unwrap();
    if std::fs::File::open(bench.path("a.ply")).is_ok() {
        eprintln!("skipped: the superuser may read everything");
        return;
    }
    bench.line("ingest a.ply").fails(77, &["a.ply", "permission denied"]);
    std::fs::set_permissions(bench.path("a.ply"), allow(0o600)).unwrap();
    std::fs::create_dir(bench.path("closed")).unwrap();
    std::fs::set_permissions(bench.path("closed"), allow(0o500)).unwrap();
    bench.line("ingest a.ply -o closed/a.octree").fails(77, &["closed"]);
}

#[test]
fn exit_78_configuration() {
    let bench = room();
    bench.write("key.toml", "max_level = 3\nray = 1\n");
    bench.line("build --config key.toml").fails(78, &["key.toml", "line 2, column 1", "`ray`"]);
    bench.write("table.toml", "[interaction]\nlists = \"a\"\n");
    bench.line("build --config table.toml").fails(78, &["table.toml", "line 2, column 1"]);
    bench.write("value.toml", "max_level = 22\n");
    bench.line("build --config value.toml").fails(78, &["value.toml", "max_level = 22", "1 to 21"]);
    bench.line("build --config depth80").fails(78, &["depth80", "depth8, paper, preview"]);
    bench.line("build --max-level 0").fails(78, &["max_level = 0"]);
    bench.line("build --memory 1MiB").fails(78, &["memory", "64MiB"]);
}

#[test]
fn configurations_presets_and_flags() {
    let bench = room();
    let config = |args: &str| {
        bench.line(&format!("build -o a.vmap {args}")).ok();
        info(&bench, "a.vmap")["config"].as_str().unwrap().to_owned()
    };
    let depth8 = config("");
    for key in ["max_level = 8", "leaf_capacity = 50", "tree = \"binned\"", "profile = \"patch\""] {
        assert!(depth8.contains(key), "{depth8}");
    }
    assert_eq!(config("--config depth8"), depth8);
    assert_eq!(config("--config depth8.toml --threads 1 --memory 64MiB"), depth8);
    assert_ne!(config("--config preview"), depth8);
    let paper = config("--config paper.toml");
    assert_eq!(config("--config paper"), paper);
    assert_eq!(config("--tree paper --profile paper"), paper);

    // A file stands before a preset of its name, and a flag before both.
    bench.write("paper.toml", "max_level = 3\ntree = \"paper\"\n");
    let mine = config("--config paper.toml");
    assert!(mine.contains("max_level = 3") && mine.contains("profile = \"patch\""), "{mine}");
    let flags = config("--config paper.toml --max-level 4 --tree binned --leaf-capacity 7");
    for key in ["max_level = 4", "leaf_capacity = 7", "tree = \"binned\"", "profile = \"patch\""] {
        assert!(flags.contains(key), "{flags}");
    }
}

#[test]
fn an_interaction_list_is_found_beside_its_configuration() {
    let bench = room();
    std::fs::create_dir(bench.path("plan")).unwrap();
    bench.write("plan/plan.toml", "[interaction]\nlist = \"pairs.csv\"\n");
    bench.line("export room.vmap --links L.csv").ok();
    let text = String::from_utf8(bench.read("L.csv")).unwrap();
    bench.write("plan/pairs.csv", &text);
    bench.line("build --config plan/plan.toml -o planned.vmap").ok();
    let count = |map: &str| info(&bench, map)["visible_pairs"].clone();
    assert_eq!(count("planned.vmap"), count("room.vmap"));
    let twice = format!("{text}{}\n", text.lines().nth(1).unwrap());
    bench.write("plan/pairs.csv", twice);
    let run = bench.line("build --config plan/plan.toml -o planned.vmap");
    assert!(run.code == 65 || run.code == 78, "{run:?}");
}

#[test]
fn build_finds_the_only_octree() {
    let bench = room();
    std::fs::remove_file(bench.path("room.vmap")).unwrap();
    let run = bench.line("build").ok();
    assert!(run.stdout.starts_with("room.vmap\n"), "{}", run.stdout);
    bench.line("ingest room.ply -o attic.octree").ok();
    bench.line("build").fails(2, &["several", "attic.octree, room.octree"]);
    bench.line("build attic.octree").ok();
    bench.line("build room.octree/").ok();
    assert_eq!(
        bench.names(),
        ["attic.octree", "attic.vmap", "room.octree", "room.ply", "room.vmap"]
    );
}

#[test]
fn f33_an_output_that_is_an_input() {
    let bench = room();
    std::fs::hard_link(bench.path("room.ply"), bench.path("linked.ply")).unwrap();
    std::os::unix::fs::symlink("room.ply", bench.path("soft.ply")).unwrap();
    let inputs = ["room.ply", "room.vmap", "room.octree"].map(|n| match n {
        "room.octree" => std::path::Path::new(n).join(pvmap::vmap::octree::FILE_NAME),
        n => n.into(),
    });
    let before = inputs.each_ref().map(|p| bench.read(p));
    let points = inputs[2].display();
    for line in [
        "ingest room.ply -o room.ply",
        "ingest room.ply -o linked.ply --overwrite",
        "ingest room.ply -o ./soft.ply --overwrite",
        &format!("build room.octree -o {points}"),
        "export room.vmap --surfels room.vmap",
        "export room.vmap --links ./room.vmap",
    ] {
        let run = bench.line(line);
        for (path, bytes) in inputs.iter().zip(&before) {
            assert!(bench.read(path) == *bytes, "{line}: {} was changed", path.display());
        }
        run.fails(2, &[]);
    }
}

#[test]
fn coordinates_may_begin_with_a_minus() {
    let bench = room();
    bench.line("ingest room.ply --normals estimate --sensor -0.5,-0.5,-0.5 --overwrite").ok();
    assert_eq!(info(&bench, "room.octree")["normals"]["oriented"], 3200);
    bench.line("ingest room.ply --normals estimate --sensor=-1,0,0 --overwrite").ok();
    bench.line("query room.vmap pair -0.5,-0.5,-1 -.25,-1,1").exits(0);
    bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,-1").exits(1);
    bench.line("query room.vmap pair -0.5,-0.5,-1 0,0,1 --normal2 -0,0,-1").exits(0);
}

#[test]
fn progress_as_json_lines() {
    let bench = Bench::new();
    // A header with wrong bounds makes for a second pass, which must not count points twice.
    write_las(&bench.path("a.las"), 1_200_000, floor(1100));
    patch(&bench.path("a.las"), LAS_BOUNDS, &1f64.to_le_bytes());
    for line in [
        "ingest a.las a.las -o a.octree --normals none --memory 64MiB --progress json",
        "--progress json build --max-level 5",
    ] {
        let run = bench.line(line).ok();
        let lines: Vec<Value> =
            run.stderr.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let stages: Vec<&Value> = lines.iter().filter(|l| l["ended"] == true).collect();
        assert!(!stages.is_empty(), "{}", run.stderr);
        for stage in stages {
            assert!(stage["stage"].is_string() && stage["unit"].is_string(), "{stage}");
            for key in ["done", "seconds", "rate", "rss_anon_bytes"] {
                assert!(stage[key].is_number(), "{key} of {stage}");
            }
            if let Some(total) = stage["total"].as_u64() {
                assert_eq!(stage["done"], total, "{stage}");
            }
        }
        let n_warnings = lines.iter().filter(|l| l["warning"].is_string()).count();
        assert_eq!(n_warnings > 0, line.starts_with("ingest"), "{}", run.stderr);
    }
    let run = bench.line("build --progress off").ok();
    assert_eq!(run.stderr, "");
}

/// Starts a run, asks it to stop after a while, and waits for it: how it ended, and how long that
/// took.
fn stop(bench: &Bench, line: &str, signal: &str, after_ms: u64) -> Run {
    let mut command = bench.command(line.split_whitespace());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child: Child = command.spawn().unwrap();
    std::thread::sleep(Duration::from_millis(after_ms));
    assert!(child.try_wait().unwrap().is_none(), "over before it could be stopped: {line}");
    let asked = Instant::now();
    interrupt(&child, signal);
    Run::watch(child, asked)
}

fn interrupt(child: &Child, signal: &str) {
    let kill = format!("kill -{signal} {}", child.id());
    assert!(std::process::Command::new("sh").args(["-c", &kill]).status().unwrap().success());
}

#[test]
fn exit_130_and_143_a_stopped_ingest_leaves_nothing() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), 6_000_000, floor(2500));
    for (signal, code, after_ms) in
        [("INT", 130, 50), ("TERM", 143, 150), ("INT", 130, 600), ("TERM", 143, 1500)]
    {
        let run = stop(&bench, "ingest a.las --memory 64MiB --progress off", signal, after_ms);
        let run = run.fails(code, &["interrupted", "nothing was left behind"]);
        assert!(run.elapsed < Duration::from_secs(2), "{:?} after {after_ms} ms", run.elapsed);
        assert_eq!(bench.names(), ["a.las"], "after {after_ms} ms");
    }
}

#[test]
fn exit_130_and_143_a_stopped_build_keeps_the_old_map() {
    let bench = Bench::new();
    // Points amid the air: next to nothing can be settled high up, so this would take minutes.
    let mut random = fastrand::Rng::with_seed(7);
    let mut text = ply_header(200_000, &XYZ);
    for _ in 0..200_000 {
        text.extend((0..3).map(|_| format!("{} ", random.f32())).chain(["\n".to_owned()]));
    }
    bench.write("a.ply", text);
    bench.line("ingest a.ply").ok();
    bench.line("build --max-level 1").ok();
    let old = bench.read("a.vmap");
    for (signal, code, after_ms) in [("INT", 130, 100), ("TERM", 143, 700), ("INT", 130, 2000)] {
        let run = stop(&bench, "build --progress off", signal, after_ms);
        let run = run.fails(code, &["interrupted"]);
        assert!(run.elapsed < Duration::from_secs(2), "{:?} after {after_ms} ms", run.elapsed);
        assert_eq!(bench.names(), ["a.octree", "a.ply", "a.vmap"], "after {after_ms} ms");
        assert!(bench.read("a.vmap") == old);
    }
}

#[test]
fn exit_130_and_143_a_stopped_scene_leaves_nothing() {
    let bench = Bench::new();
    for (signal, code, ending) in [("INT", 130, "las"), ("TERM", 143, "laz"), ("INT", 130, "ply")] {
        let line = format!("scene cave --points 200M -o a.{ending} --progress off");
        let run = stop(&bench, &line, signal, 800).fails(code, &["interrupted"]);
        assert!(run.elapsed < Duration::from_secs(2), "{:?}", run.elapsed);
        assert_eq!(bench.names(), [""; 0]);
    }
}

#[test]
fn exit_130_a_query_that_waits_for_rows_can_be_stopped() {
    let bench = room();
    let mut command = bench.command("query room.vmap pairs -".split(' '));
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    // Held open: more rows may come at any time.
    let rows = child.stdin.take();
    std::thread::sleep(Duration::from_millis(300));
    interrupt(&child, "INT");
    for _ in 0..200 {
        if child.try_wait().unwrap().is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let ended = child.try_wait().unwrap();
    drop(rows);
    let code = child.wait().unwrap().code();
    assert!(ended.is_some(), "it did not stop within 2 s; then it ended with {code:?}");
    assert_eq!(code, Some(130));
}

#[test]
fn a_reader_that_has_seen_enough_is_no_error() {
    let bench = room();
    let row = "-0.5,-0.5,-1,0.5,0.5,1\n";
    bench.write("rows.csv", format!("x1,y1,z1,x2,y2,z2\n{}", row.repeat(50_000)));
    for line in [
        "--help",
        "info room.vmap",
        "info room.octree --json",
        "verify room.vmap",
        "query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1",
        "query room.vmap pairs rows.csv",
        "query room.vmap pairs rows.csv --json",
        "build",
    ] {
        let mut command = bench.command(line.split_whitespace());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        drop(child.stdout.take());
        let run = Run::watch(child, Instant::now());
        assert_eq!((run.code, run.stderr.as_str()), (0, ""), "{line}");
    }
}

#[test]
fn a_pair() {
    let bench = room();
    let yes = bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1").exits(0);
    assert!(yes.stdout.starts_with("yes\n") && yes.stdout.contains("nodes"), "{}", yes.stdout);
    let no = bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,-1").exits(1);
    assert!(no.stdout.starts_with("no\n") && no.stderr.is_empty(), "{no:?}");
    for (places, visible) in [("-0.5,-0.5,-1 0.5,0.5,1", true), ("-0.5,-0.5,-1 0.5,0.5,-1", false)]
    {
        let line = format!("query room.vmap pair {places} --json");
        let run = bench.line(&line).exits(i32::from(!visible));
        let answer: Value = serde_json::from_str(&run.stdout).unwrap();
        assert_eq!(answer["visible"], visible);
        assert!(answer["surfel1"].is_u64() && answer["surfel2"].is_u64(), "{answer}");
        assert_eq!(answer["link"].is_null(), !visible, "{answer}");
    }
    bench.line("query room.vmap pair 0,0,-1 0,0,7").fails(65, &["0,0,7", "outside"]);
    bench.line("query room.vmap pair 0,0,-1 0,0,0").fails(65, &["no surface at 0,0,0"]);
    bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,-0.5 --snap 0.6").exits(1);
}

/// Rows of a pairs table as columns by name, and its text.
fn table(text: &str) -> Vec<Vec<(String, String)>> {
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let names = reader.headers().unwrap().clone();
    let named = |row: csv::StringRecord| {
        names.iter().zip(&row).map(|(n, v)| (n.to_owned(), v.to_owned())).collect()
    };
    reader.records().map(|row| named(row.unwrap())).collect()
}

fn column(text: &str, name: &str) -> Vec<String> {
    let value = |row: Vec<(String, String)>| row.into_iter().find(|(n, _)| n == name).unwrap().1;
    table(text).into_iter().map(value).collect()
}

#[test]
fn a_table_of_pairs() {
    let bench = room();
    bench.write(
        "rows.csv",
        "z2,y2,x2,id,x1,y1,z1\n1,.5,.5,a,-.5,-.5,-1\n-1,.5,.5,b,-.5,-.5,-1\n1,0,0,c,0,0,-1\n",
    );
    let run = bench.line("query room.vmap pairs rows.csv").ok();
    assert!(run.stdout.starts_with("visible,surfel1,surfel2"), "{}", run.stdout);
    assert_eq!(column(&run.stdout, "visible"), ["1", "0", "1"]);
    let (one, two) = (column(&run.stdout, "surfel1"), column(&run.stdout, "surfel2"));
    assert_eq!(one[0], one[1]);
    assert!(one.iter().chain(&two).all(|s| s.parse::<u32>().is_ok()), "{}", run.stdout);

    let mut command = bench.command("query room.vmap pairs -".split(' '));
    command.stdin(std::fs::File::open(bench.path("rows.csv")).unwrap());
    assert_eq!(Run::of(command).ok().stdout, run.stdout);

    let json = bench.line("query room.vmap pairs rows.csv --json").ok();
    let lines: Vec<Value> = json.stdout.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let visible: Vec<bool> = lines.iter().map(|l| l["visible"].as_bool().unwrap()).collect();
    assert_eq!(visible, [true, false, true]);
}

#[test]
fn rows_without_an_answer_say_why_and_the_others_are_answered() {
    let bench = room();
    let rows = [
        "0,0,-1,0,0,1",
        "0,0,-1,0,0,9",
        "0,0,-1,0,0,0",
        "0,0,-1,nan,0,1",
        "0,0,-1,\"one, \"\"two\"\"\",0,1",
        "0,0,-1",
        "0,0,-1,0,0,1",
    ];
    bench.write("rows.csv", format!("x1,y1,z1,x2,y2,z2\n{}\n", rows.join("\n")));
    let run = bench.line("query room.vmap pairs rows.csv").ok();
    assert_eq!(column(&run.stdout, "visible"), ["1", "", "", "", "", "", "1"]);
    let errors = column(&run.stdout, "error");
    assert!(errors[0].is_empty() && errors[6].is_empty(), "{errors:?}");
    for (error, word) in errors[1..].iter().zip(["outside", "no surface", "", "two", ""]) {
        assert!(!error.is_empty() && error.contains(word), "{errors:?}");
    }
    let json = bench.line("query room.vmap pairs rows.csv --json").ok();
    let lines: Vec<Value> = json.stdout.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(lines.len(), rows.len());
    assert_eq!(lines.iter().filter(|l| l["error"].is_string()).count(), 5);
}

#[test]
fn normals_choose_the_side_of_a_thin_wall() {
    let bench = Bench::new();
    // Two sheets back to back at z = 0, below them a floor, above them a ceiling.
    let mut text = ply_header(4 * 400, &["x", "y", "z", "nx", "ny", "nz"]);
    for (z, nz) in [(-10, 1), (0, -1), (0, 1), (10, -1)] {
        text.extend((0..400).map(|i| format!("{} {} {z} 0 0 {nz}\n", i % 20, i / 20)));
    }
    bench.write("wall.ply", text);
    bench.line("ingest wall.ply").ok();
    bench.line("build").ok();
    let header = "x1,y1,z1,nx1,ny1,nz1,x2,y2,z2,nx2,ny2,nz2";
    let rows = "10,10,0,0,0,1,10,10,10,0,0,-1\n10,10,0,0,0,-1,10,10,10,0,0,-1\n";
    bench.write("rows.csv", format!("{header}\n{rows}10,10,-10,,,,10,10,10,,,\n"));
    let run = bench.line("query wall.vmap pairs rows.csv").ok();
    assert_eq!(column(&run.stdout, "visible"), ["1", "0", "0"]);
    bench.line("query wall.vmap pair 10,10,0 10,10,10 --normal1 0,0,1").exits(0);
    bench.line("query wall.vmap pair 10,10,0 10,10,10 --normal1 0,0,-1").exits(1);
    bench.line("query wall.vmap pair 10,10,0 10,10,10 --normal1 0,0,0").fails(65, &["normal"]);
}

#[test]
fn tables_that_cannot_be_read() {
    let bench = room();
    for (rows, words) in [
        ("", "x1"),
        ("x1,y1,z1,x2,y2\n0,0,0,0,0\n", "no column z2"),
        ("a letter to a friend\n", "no column"),
        ("x1,y1,z1,x2,y2,z2,nx1\n", "ny1"),
    ] {
        bench.write("rows.csv", rows);
        bench.line("query room.vmap pairs rows.csv").fails(65, &["rows.csv", words]);
    }
    bench.write("rows.csv", b"x1,y1,z1,x2,y2,z2\n0,0,\xff,0,0,0\n");
    bench.line("query room.vmap pairs rows.csv").fails(65, &["rows.csv", "2"]);
    // No rows, no answers.
    bench.write("rows.csv", "x1,y1,z1,x2,y2,z2\n");
    assert_eq!(bench.line("query room.vmap pairs rows.csv").ok().stdout.lines().count(), 1);
    bench.line("query room.vmap pairs none.csv").fails(66, &["none.csv"]);
}
