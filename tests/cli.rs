//! How the command behaves: exit codes, messages, configuration, outputs, signals.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use cli_common::{
    Bench, LAS_BOUNDS, Run, floor, info, noise_ply, patch, room, room_ply, write_las,
};
use serde_json::Value;

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
        "demo --points 0",
        "scene castle -o a.ply",
        "build a.octree --max-level many",
    ] {
        let run = bench.line(line).exits(2);
        assert!(!run.stderr.is_empty(), "{line}");
    }
    for (line, words) in [
        ("ingest a.ply --lenint", &["--lenint", "tip:", "'--lenient'"][..]),
        ("query a.vmap pair 1,2,3", &["not provided: <X2,Y2,Z2>"]),
        ("ingest a.ply --normals many", &["'many'", "possible values: auto"]),
        ("build --max-level 0", &["--max-level", "1..=21"]),
        ("build --memory 1MiB", &["--memory", "64MiB"]),
        ("build --threads 1025", &["--threads", "1024"]),
        ("ingest a.ply --threads 100000", &["--threads", "1024"]),
    ] {
        bench.line(line).fails(2, words);
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
    bench.write("large.toml", "#".repeat((1 << 20) + 1));
    bench.line("build --config large.toml").fails(78, &["large.toml", "larger than 1 MiB"]);
    bench.line("build --config /dev/zero").fails(78, &["/dev/zero", "no such configuration"]);
    let presets = "accurate, depth8, paper, preview";
    bench.line("build --config depth80").fails(78, &["depth80", presets]);
    for (line, words) in [
        ("max_level = 0", ["max_level = 0", "1 to 21"]),
        ("memory = \"1MiB\"", ["memory", "64MiB"]),
        ("threads = 1025", ["threads = 1025", "at most 1024"]),
    ] {
        bench.write("range.toml", line);
        bench.line("build --config range.toml").fails(78, &words);
    }
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
    assert!(depth8.contains("max_spread = 10") && !config("--max-spread 0").contains("max_spread"));
    assert_eq!(config("--config depth8"), depth8);
    assert_eq!(config("--config depth8.toml --threads 1 --memory 64MiB"), depth8);
    assert_ne!(config("--config preview"), depth8);
    let paper = config("--config paper.toml");
    assert_eq!(config("--config paper"), paper);
    assert_eq!(config("--tree paper --profile paper --max-spread 0"), paper);

    // A file stands before a preset of its name, a folder does not; a flag stands before both.
    std::fs::create_dir(bench.path("paper")).unwrap();
    assert_eq!(config("--config paper"), paper);
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
    let sound = text.lines().nth(1).unwrap();
    let twice = format!("{text}{sound}\n");
    let last = format!("lines 2 and {}:", twice.lines().count());
    let build = "build --config plan/plan.toml -o planned.vmap";
    for (list, code, words) in [
        (&*twice, 65, ["pairs.csv", &last]),
        (
            &*format!("node_a,node_b\n{sound}\n1,99999999\n"),
            65,
            ["line 3: ", "99999999 does not exist"],
        ),
        (&*format!("node_a,node_b\n{sound}\n0,1\n"), 65, ["line 3: ", "holds node 1"]),
        ("node_a,node_b\n1,2\n\n3\n", 65, ["line 4: ", "1 columns"]),
        ("node_a,node_b\n1,x\n", 65, ["line 2: ", "\"x\" is no node id"]),
        ("node_a\n1\n", 65, ["line 1: ", "no column node_b"]),
    ] {
        bench.write("plan/pairs.csv", list);
        bench.line(build).fails(code, &words);
    }
    std::fs::remove_file(bench.path("plan/pairs.csv")).unwrap();
    bench.line(build).fails(66, &["plan/pairs.csv", "no such file"]);
    bench.write("plan/plan.toml", "[interaction]\nlist = \"/dev/zero\"\n");
    bench.line(build).fails(66, &["/dev/zero", "not a regular file"]);
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
fn f32_an_output_is_a_file_of_its_own() {
    use std::os::unix::fs::{FileTypeExt, symlink};
    let bench = room();
    let fifo = |name: &str| {
        let made = std::process::Command::new("mkfifo").arg(bench.path(name)).status().unwrap();
        assert!(made.success());
    };
    ["fifo", "fifo.las", "fifo.ply"].into_iter().for_each(fifo);
    std::fs::create_dir(bench.path("folder")).unwrap();
    std::fs::create_dir(bench.path("folder.laz")).unwrap();
    let before = bench.names();
    for (line, word) in [
        ("build -o fifo", "a FIFO"),
        ("build -o folder", "a folder"),
        ("build -o folder/new/", "slash"),
        ("build -o /dev/null", "a device"),
        ("build -o /dev/full", "a device"),
        ("build -o /dev/stdout", "/dev/stdout"),
        ("ingest room.ply -o fifo", "a FIFO"),
        ("ingest room.ply -o fifo --overwrite", "a FIFO"),
        ("ingest room.ply -o /dev/null --overwrite", "a device"),
        ("ingest room.ply -o room.vmap --overwrite", "a file"),
        ("scene empty --points 10 -o fifo.las", "a FIFO"),
        ("scene empty --points 10 -o fifo.ply", "a FIFO"),
        ("scene empty --points 10 -o folder.laz", "a folder"),
        ("export room.vmap --links folder", "a folder"),
    ] {
        bench.line(line).fails(73, &[word]);
    }
    bench.line("export room.vmap --links /dev/full").fails(74, &["/dev/full", "no space"]);
    assert_eq!(bench.names(), before);
    assert!(bench.path("fifo").metadata().unwrap().file_type().is_fifo());

    // A link is followed, and stays.
    let old = bench.read("room.vmap");
    symlink("room.vmap", bench.path("link.vmap")).unwrap();
    bench.line("build --max-level 3 -o link.vmap").ok();
    assert!(bench.path("link.vmap").is_symlink() && bench.read("room.vmap") != old);
    symlink("nowhere", bench.path("broken.vmap")).unwrap();
    bench.line("build -o broken.vmap").fails(73, &["broken.vmap", "leads nowhere"]);
}

#[test]
fn f32_what_is_not_pvmaps_own_is_never_replaced() {
    let bench = room();
    for folder in ["docs", "scans"] {
        std::fs::create_dir(bench.path(folder)).unwrap();
        bench.write(format!("{folder}/thesis"), "precious");
    }
    std::fs::copy(bench.path("room.ply"), bench.path("scans/room.ply")).unwrap();
    std::os::unix::fs::symlink("docs", bench.path("link")).unwrap();
    // A map that somebody keeps in the octree's folder.
    bench.line("build room.octree -o room.octree/kept.vmap").ok();
    let scan = bench.read("room.ply");
    for line in [
        "ingest room.ply -o docs --overwrite",
        "ingest room.ply -o link --overwrite",
        "ingest scans/room.ply -o scans --overwrite",
        "ingest room.ply --overwrite",
    ] {
        bench.line(line).fails(73, &["other things", "another name"]);
    }
    bench.line("build room.octree -o scans/room.ply").fails(73, &["not a visibility map"]);
    bench.line("build room.octree -o docs/thesis").fails(73, &["not a visibility map"]);
    assert_eq!(bench.read("docs/thesis"), b"precious");
    assert_eq!(bench.read("scans/thesis"), b"precious");
    assert!(bench.read("scans/room.ply") == scan && bench.read("room.octree/kept.vmap") != scan);
    bench.write("empty.vmap", "");
    bench.line("build room.octree -o empty.vmap").ok();
}

#[test]
fn f32_a_table_may_go_to_standard_output() {
    let bench = room();
    bench.line("export room.vmap --nodes N.csv --links L.csv").ok();
    for (table, file) in [("--nodes", "N.csv"), ("--links", "L.csv")] {
        for place in ["-", "/dev/stdout"] {
            let run = bench.line(&format!("export room.vmap {table} {place}")).ok();
            assert!(run.stdout.as_bytes() == bench.read(file), "{table} {place}");
            assert_eq!(run.stderr, "");
        }
    }
    // A redirected file is written to where it is, not begun anew.
    bench.write("all.csv", "kept\n");
    let mut command = bench.command(["export", "room.vmap", "--nodes", "/dev/stdout"]);
    let all = std::fs::File::options().append(true).open(bench.path("all.csv")).unwrap();
    assert!(command.stdout(all).status().unwrap().success());
    assert_eq!(bench.read("all.csv"), [&b"kept\n"[..], &bench.read("N.csv")].concat());
    for places in ["--nodes - --links -", "--nodes N.csv --links ./N.csv"] {
        bench.line(&format!("export room.vmap {places}")).fails(2, &["two tables"]);
    }
    assert_eq!(
        bench.names(),
        ["L.csv", "N.csv", "all.csv", "room.octree", "room.ply", "room.vmap"]
    );
}

#[test]
fn a_demo_replaces_nothing() {
    let bench = Bench::new();
    bench.write("room.ply", "mine");
    let small = "demo --points 2000 --pairs 10 --progress off";
    bench.line(&format!("{small} --keep room")).fails(73, &["room.ply", "another name"]);
    assert_eq!(bench.read("room.ply"), b"mine");
    let run = bench.line(&format!("{small} --keep other")).ok();
    for word in
        ["leaves N", "leaf pairs", "links", "fewer than N²", "agree with truth", "visibility"]
    {
        assert!(run.stdout.contains(word), "no {word} in: {}", run.stdout);
    }
    assert_eq!(bench.names(), ["other.octree", "other.ply", "other.vmap", "room.ply"]);
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
fn d10_progress_as_json_lines() {
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
    let mut command = bench.stoppable(line.split_whitespace());
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
    bench.write("a.ply", noise_ply(200_000));
    bench.line("ingest a.ply").ok();
    bench.line("build --max-level 1").ok();
    let old = bench.read("a.vmap");
    for (signal, code, after_ms) in [("INT", 130, 100), ("TERM", 143, 700), ("HUP", 129, 2000)] {
        let run = stop(&bench, "build --progress off", signal, after_ms);
        let run = run.fails(code, &["interrupted"]);
        assert!(run.elapsed < Duration::from_secs(2), "{:?} after {after_ms} ms", run.elapsed);
        let mut names = bench.names();
        let is_kept = names.pop_if(|name| name == "a.vmap.build").is_some();
        assert_eq!(names, ["a.octree", "a.ply", "a.vmap"], "after {after_ms} ms");
        let word =
            if is_kept { "tasks are kept in a.vmap.build" } else { "nothing was left behind" };
        assert!(run.stderr.contains(word), "{}", run.stderr);
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
fn f09_a_terminal_that_closes_stops_nothing_under_nohup() {
    let bench = Bench::new();
    let mut command = std::process::Command::new("sh");
    command.current_dir(bench.path("")).stdout(Stdio::piped()).stderr(Stdio::piped());
    let scene = format!(
        "trap '' HUP; exec {} scene empty --points 2M -o a.las --progress off",
        env!("CARGO_BIN_EXE_pvmap")
    );
    let child = command.args(["-c", &scene]).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(200));
    interrupt(&child, "HUP");
    Run::watch(child, Instant::now()).ok();
    assert_eq!(bench.names(), ["a.las"]);
}

#[test]
fn exit_130_a_query_that_waits_for_rows_can_be_stopped() {
    let bench = room();
    let mut command = bench.stoppable("query room.vmap pairs -".split(' '));
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
        "export room.vmap --links -",
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
