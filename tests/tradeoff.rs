//! What accuracy costs: the command that sweeps the settings of a build.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::process::Stdio;
use std::time::Duration;

use cli_common::{Bench, Run, XYZ, count_of_class, info, interrupted, noise_ply, ply_header};
use pvmap::accuracy::ScanPoints;
use pvmap::query::Map;
use pvmap::query::exact::{Exact, ExactOptions};
use pvmap::tradeoff::{Sample, Truth};
use pvmap::vmap::OctreeView;
use pvmap::{Mapped, Quiet};
use serde_json::Value;

/// A packed room of 10 000 points, its exact triangles and its octree.
fn packed() -> Bench {
    let bench = Bench::new();
    bench.line("scene cornell --packed --points 10k -o p.ply --truth p.mesh.ply").ok();
    bench.line("ingest p.ply").ok();
    bench
}

fn json(run: &Run) -> Value {
    serde_json::from_str(&run.stdout).unwrap()
}

/// Takes away what differs from run to run.
fn steady(mut answer: Value) -> Value {
    answer["recommended"].take();
    for row in answer["settings"].as_array_mut().unwrap() {
        for key in [
            "build_seconds",
            "visibility_seconds",
            "cpu_seconds",
            "peak_rss_anon_bytes",
            "query_seconds",
            "on_front",
        ] {
            assert!(!row[key].is_null(), "{key} of {row}");
            row[key].take();
        }
    }
    answer
}

#[test]
fn counts_are_those_of_pvmap_accuracy() {
    let bench = packed();
    let line = "tradeoff p.octree --truth p.mesh.ply --pairs 9k --seed 3 --leaf-capacity 50,400 \
                --profile patch,paper --json";
    let found = json(&bench.line(line).ok());
    let rows = found["settings"].as_array().unwrap();
    let names: Vec<_> = rows.iter().map(|r| r["setting"].as_str().unwrap()).collect();
    assert_eq!(names, ["depth8", "capacity 400", "profile paper", "profile paper, capacity 400"]);
    assert_eq!((&found["judge"], &found["pairs"]), (&"triangles".into(), &9000.into()));
    for row in rows {
        let [capacity, profile] = [&row["leaf_capacity"], &row["profile"]];
        let profile = profile.as_str().unwrap();
        bench.line(&format!("build p.octree --leaf-capacity {capacity} --profile {profile}")).ok();
        let asked = "accuracy p.vmap --truth p.mesh.ply --octree p.octree --pairs 9k --seed 3";
        let accuracy = json(&bench.line(&format!("{asked} --json")).ok());
        let facing = &accuracy["ways"][0]["agree_facing"];
        let n = |value: &Value| value.as_u64().unwrap();
        assert_eq!(row["error"]["of"], facing["of"]);
        assert_eq!(n(&row["error"]["n"]), n(&facing["of"]) - n(&facing["n"]), "{row}");
        assert_eq!(found["facing"], accuracy["facing"]);
        let wrong = ["wrongly_visible", "wrongly_invisible"].map(|key| n(&row[key]["n"]));
        assert_eq!(n(&row["error"]["n"]), wrong[0] + wrong[1]);
        // Pairs that do not face each other in truth are wrongly visible at most.
        assert_eq!(wrong[1], n(&accuracy["ways"][0]["wrongly_invisible"]["n"]));
        assert!(wrong[0] <= n(&accuracy["ways"][0]["wrongly_visible"]["n"]));
        let map = info(&bench, "p.vmap");
        assert_eq!((&row["leaves"], &row["links"]), (&map["surfels"], &map["links"]));
        assert_eq!(n(&row["map_bytes"]), bench.read("p.vmap").len() as u64);
    }
    assert!(rows.iter().any(|r| r["error"]["n"] != rows[0]["error"]["n"]), "{found}");
}

#[test]
fn segments_have_rows_of_their_own() {
    let bench = packed();
    let line = "tradeoff p.octree --truth p.mesh.ply --pairs 9k --seed 3 --leaf-capacity 50,400";
    let plain = json(&bench.line(&format!("{line} --json")).ok());
    let run = bench.line(&format!("{line} --segment --json --svg p.svg --csv p.csv")).ok();
    let found = json(&run);
    let rows = found["settings"].as_array().unwrap();
    let names: Vec<_> = rows.iter().map(|r| r["setting"].as_str().unwrap()).collect();
    assert_eq!(names, ["depth8", "depth8, segments", "capacity 400", "capacity 400, segments"]);
    for (pair, alone) in rows.chunks(2).zip(plain["settings"].as_array().unwrap()) {
        assert_eq!((&pair[0]["mode"], &pair[1]["mode"]), (&"exact".into(), &"segments".into()));
        for key in ["leaves", "links", "map_bytes", "build_seconds", "peak_rss_anon_bytes"] {
            assert_eq!(pair[0][key], pair[1][key], "{key}");
        }
        assert_eq!(pair[0]["error"], alone["error"], "leaves answer as without --segment");
        assert_eq!(pair[0]["error"]["of"], pair[1]["error"]["of"]);
        let capacity = &pair[1]["leaf_capacity"];
        bench.line(&format!("build p.octree --leaf-capacity {capacity}")).ok();
        let asked = "accuracy p.vmap --truth p.mesh.ply --octree p.octree --pairs 9k --seed 3";
        let way = &json(&bench.line(&format!("{asked} --json")).ok())["ways"][1];
        assert_eq!(way["name"], "segments");
        assert_eq!(pair[1]["wrongly_invisible"]["n"], way["wrongly_invisible"]["n"]);
        let n = |value: &Value| value.as_u64().unwrap();
        let agree = &way["agree_facing"];
        assert_eq!(n(&pair[1]["error"]["n"]), n(&agree["of"]) - n(&agree["n"]));
    }
    let [svg, csv] = ["p.svg", "p.csv"].map(|name| String::from_utf8(bench.read(name)).unwrap());
    assert!(svg.contains("capacity 400, segments") && svg.contains("profile, segments<"), "{svg}");
    assert!(csv.contains("\n\"depth8, segments\",segments,binned,"), "{csv}");
}

#[test]
fn the_same_seed_asks_the_same_pairs() {
    let bench = Bench::new();
    let line = "tradeoff furnished --points 5k --pairs 3k --leaf-capacity 50,400 --json --seed";
    let answer = |seed: u32, threads: u32| {
        steady(json(&bench.line(&format!("{line} {seed} --threads {threads}")).ok()))
    };
    let one = answer(1, 1);
    assert_eq!(one["judge"], "geometry");
    assert_eq!(one["settings"].as_array().unwrap().len(), 2);
    assert_eq!(one, answer(1, 2));
    assert_ne!(one["settings"], answer(2, 2)["settings"]);
    assert_eq!(bench.names(), [""; 0], "maps and scenes are temporary");
}

#[test]
fn pairs_without_truth_are_judged_by_the_points() {
    let bench = packed();
    bench.line("build p.octree").ok();
    let file = pvmap::open_octree(&bench.path("p.octree")).unwrap();
    let view = OctreeView::open(&file).unwrap();
    let (truth, options) = Truth::of_points(&view, 1 << 28, &Quiet).unwrap();
    // Near is what is near for `pvmap query MAP pair --exact`.
    let map_file = Mapped::open(&bench.path("p.vmap")).unwrap();
    assert_eq!(options, ExactOptions::usual(&Map::open(&map_file).unwrap()).unwrap());
    let path = bench.path("p.octree");
    let points = ScanPoints::new(&view, &path).unwrap();
    let sample = Sample::draw(&truth, &points, (700, 5), &Quiet).unwrap();
    let exact = Exact::new(&view, options);
    let mut rng = fastrand::Rng::with_seed(5);
    let mut drawn = || exact.point(rng.u64(..10_000)).unwrap();
    let verdicts: Vec<_> = (0..700).map(|_| exact.pair(&drawn(), &drawn()).unwrap()).collect();
    let count = |is: fn(&pvmap::query::exact::Verdict) -> bool| {
        verdicts.iter().filter(|v| is(v)).count() as u64
    };
    assert_eq!((sample.n_drawn(), sample.n_left_out()), (700, 0));
    assert_eq!(sample.n_facing(), count(|v| v.faces));
    assert_eq!(sample.n_visible(), count(|v| v.visible));
    assert!(sample.n_visible() > 50 && sample.n_visible() < sample.n_facing());
}

#[test]
fn a_reference_is_not_called_truth() {
    let bench = packed();
    let line = "tradeoff ./p.octree --pairs 1k --max-level 3 --csv t.csv --svg t.svg";
    let run = bench.line(line).ok();
    let drawn = String::from_utf8(bench.read("t.svg")).unwrap();
    assert!(drawn.contains(">p.octree: what accuracy costs<"), "a path in the title: {drawn}");
    let answer = json(&bench.line("tradeoff p.ply --pairs 1k --max-level 3 --json").ok());
    assert_eq!(answer["judge"], "reference");
    for told in [run.stdout, String::from_utf8(bench.read("t.svg")).unwrap()] {
        assert!(told.contains("reference (not truth)"), "{told}");
        assert!(!told.contains("truth: "), "{told}");
    }
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    assert!(csv.contains(",reference,") && !csv.contains("truth"), "{csv}");
    let run = bench.line("tradeoff empty --points 2k --pairs 1k --max-level 3").ok();
    assert!(run.stdout.contains("truth: the exact geometry"), "{}", run.stdout);
}

#[test]
fn outputs_have_a_row_and_a_mark_for_every_setting() {
    let bench = packed();
    // A name that would break XML and CSV.
    let scan = "a<b>&\"c,.ply";
    std::fs::rename(bench.path("p.ply"), bench.path(scan)).unwrap();
    bench.write("a<&.toml", "max_level = 3\n");
    let run = bench.run([
        "tradeoff",
        scan,
        "--pairs",
        "2k",
        "--config",
        "preview",
        "--config",
        "paper",
        "--leaf-capacity",
        "20,80,320",
        "--csv",
        "t.csv",
        "--svg",
        "t.svg",
        "--want",
        "time=1h",
    ]);
    let stdout = run.ok().stdout;
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert_eq!(count_of_class(&svg, "setting"), 6);
    assert_eq!(count_of_class(&svg, "chosen"), 1);
    assert!(svg.contains("a&lt;b&gt;&amp;&quot;c,.ply"), "{svg}");
    let bytes = bench.read("t.csv");
    let mut csv = csv::Reader::from_reader(bytes.as_slice());
    let header = csv.headers().unwrap().clone();
    let rows: Vec<_> = csv.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 6);
    let cell = |row: &csv::StringRecord, name: &str| {
        row[header.iter().position(|h| h == name).unwrap()].to_owned()
    };
    for row in &rows {
        let number = |name: &str| cell(row, name).parse::<f64>().unwrap();
        let [low, error, high] = ["error_low", "error", "error_high"].map(number);
        assert!(0.0 < low && low < error && error < high && high < 1.0, "{row:?}");
        let both = number("wrongly_visible") + number("wrongly_invisible");
        assert!((both - error).abs() < 3e-7, "{row:?}");
        assert!(number("build_seconds") >= number("visibility_seconds"));
        assert!(number("peak_rss_anon_bytes") > 1e6 && number("query_seconds") > 0.0);
        // The table says the same.
        let name = cell(row, "setting");
        let star = if cell(row, "on_front") == "true" { '*' } else { ' ' };
        let begins = format!("{star} {name} ");
        let line = stdout.lines().find(|l| l.starts_with(&begins)).unwrap();
        assert!(line.contains(&cell(row, "links")), "{line}");
        assert!(line.contains(&format!(" {:.2} (", 100.0 * error)), "{line}");
    }
    let name_of = |row| cell(row, "setting");
    let names: Vec<_> = rows.iter().map(name_of).collect();
    assert_eq!(names[..2], ["preview, capacity 20", "preview, capacity 80"]);
    // Own files are replaced, others are not.
    let run = bench.run([
        "tradeoff", scan, "--pairs", "1k", "--config", "a<&.toml", "--csv", "t.csv", "--svg",
        "t.svg",
    ]);
    run.ok();
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert_eq!(count_of_class(&svg, "setting"), 1);
    let csv = bench.line("tradeoff p.octree --pairs 1k --max-level 3 --csv -").ok().stdout;
    assert_eq!(csv.lines().count(), 2, "{csv}");
}

#[test]
fn the_front_is_by_the_seconds_that_are_compared() {
    let bench = packed();
    let line = "tradeoff p.octree --truth p.mesh.ply --pairs 4k --leaf-capacity 10,100,1000 \
                --tree binned,paper --runs 2";
    for (flag, key) in [("", "build_seconds"), (" --cpu", "cpu_seconds")] {
        let answer = json(&bench.line(&format!("{line} --json{flag}")).ok());
        assert_eq!(answer["compared_by"], key);
        let rows = answer["settings"].as_array().unwrap();
        assert_eq!(rows.len(), 6);
        let figures = |row: &Value| [&row[key], &row["error"]["n"]].map(|v| v.as_f64().unwrap());
        // The system counts processor time in hundredths of a second.
        assert!(rows.iter().map(figures).any(|[seconds, _]| seconds > 0.0), "{answer}");
        for row in rows {
            let [seconds, n] = figures(row);
            let beats = |[s, m]: [f64; 2]| s <= seconds && m <= n && (s, m) != (seconds, n);
            assert_eq!(row["on_front"], !rows.iter().map(figures).any(beats), "{row}");
        }
    }
    let told = bench.line("tradeoff p.octree --pairs 500 --max-level 3 --cpu").ok().stdout;
    assert!(told.contains(" CPU s ") && !told.contains(" seconds "), "{told}");
}

#[test]
fn what_is_wanted_is_recommended() {
    let bench = packed();
    let line = "tradeoff p.octree --truth p.mesh.ply --pairs 4k --leaf-capacity 20,1000";
    let last = |want: &str| {
        let run = bench.line(&format!("{line} --want {want}")).ok();
        let rows = run.stdout.lines().filter(|l| l.contains(" MiB "));
        assert_eq!(rows.count(), 2);
        run.stdout.lines().last().unwrap().to_owned()
    };
    let told = last("time=10min");
    assert!(told.starts_with("recommended for time ≤ 600 s: capacity 20, error "), "{told}");
    let told = last("error=100%");
    assert!(told.starts_with("recommended for error ≤ 100 %: capacity "), "{told}");
    let told = last("error=0.0001%");
    assert!(
        told.starts_with("no setting is surely within error ≤ 0.0001 %; capacity 20 comes nearest"),
        "{told}"
    );
    let told = last("time=0s");
    assert!(told.starts_with("no setting is within time ≤ 0 s; capacity "), "{told}");
    let answer = json(&bench.line(&format!("{line} --want error=0 --json")).ok());
    assert_eq!(answer["recommended"]["setting"], "capacity 20");
    assert_eq!(answer["recommended"]["is_met"], false);
}

/// An octree whose fine maps take minutes.
fn noise(bench: &Bench) {
    bench.write("a.ply", noise_ply(100_000));
    bench.line("ingest a.ply").ok();
}

#[test]
fn what_takes_too_long_or_too_much_memory_is_told() {
    let bench = Bench::new();
    noise(&bench);
    let line = "tradeoff a.octree --pairs 1k --leaf-capacity 100000,50 --limit 2 --json \
                --csv t.csv --svg t.svg --want time=1h";
    // Standard output has the JSON, the files are written beside it.
    let answer = json(&bench.line(line).ok());
    let rows = answer["settings"].as_array().unwrap();
    assert_eq!(rows[0]["outcome"], "built");
    assert_eq!(rows[1]["outcome"], "stopped");
    assert!(rows[1]["error"].is_null() && rows[1]["on_front"] == false, "{answer}");
    assert_eq!(answer["recommended"]["setting"], "capacity 100000");
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert_eq!(count_of_class(&svg, "setting"), 1);
    assert!(svg.contains("depth8: stopped at 2 s"), "{svg}");
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    assert!(
        csv.contains("\ndepth8,exact,binned,patch,leaf,8,50,10,0,0,0,false,stopped,,,"),
        "{csv}"
    );

    let line = "tradeoff a.octree --pairs 1k --max-level 21 --leaf-capacity 0 --memory 64MiB";
    let run = bench.line(&format!("{line} --want error=1%")).ok();
    let row = run.stdout.lines().find(|l| l.contains("not built: ")).unwrap();
    assert!(row.contains("level 21, capacity 0") && row.contains("--memory"), "{row}");
    assert!(run.stdout.ends_with("nothing to recommend for error ≤ 1 %: no setting was built\n"));
}

#[test]
fn exit_130_a_stopped_sweep_tells_what_it_knows() {
    let bench = Bench::new();
    noise(&bench);
    let line = "tradeoff a.octree --pairs 1k --leaf-capacity 100000,50 --csv t.csv --svg t.svg \
                --progress plain";
    let run = interrupted(&bench, line, "2 of 2").exits(130);
    assert!(run.stdout.contains("* capacity 100000 "), "{}", run.stdout);
    assert!(!run.stdout.contains("depth8"), "{}", run.stdout);
    assert!(run.stderr.contains("interrupted; nothing was left behind"), "{}", run.stderr);
    assert_eq!(bench.names(), ["a.octree", "a.ply", "temporary"]);
    assert_eq!(std::fs::read_dir(bench.path("temporary")).unwrap().count(), 0);
}

#[test]
fn what_cannot_be_asked_is_refused_in_one_line() {
    let bench = packed();
    bench.write("other.csv", "a table of somebody\n");
    bench.write("broken.toml", "max_level = 99\n");
    bench.write("cut.ply", &bench.read("p.ply")[..5000]);
    bench.write("none.ply", ply_header(0, &XYZ));
    for (line, code, words) in [
        ("tradeoff furnishd", 66, &["furnishd", "nor a scene", "furnished"][..]),
        ("tradeoff p.octree --truth gone.ply", 66, &["gone.ply"]),
        ("tradeoff p.octree --truth p.ply", 65, &["p.ply"]),
        ("tradeoff cut.ply", 65, &["cut.ply"]),
        ("tradeoff none.ply", 65, &["no points"]),
        ("tradeoff p.octree --want soon", 2, &["soon", "error=0.5%"]),
        ("tradeoff p.octree --points 3k", 2, &["--points"]),
        ("tradeoff cave --truth p.mesh.ply", 2, &["--truth"]),
        ("tradeoff cave --points 0", 2, &["--points"]),
        ("tradeoff p.octree --pairs 0", 2, &["--pairs"]),
        ("tradeoff p.octree --pairs 11M", 2, &["--pairs", "10000000"]),
        ("tradeoff p.octree --max-level 8,22", 2, &["22"]),
        ("tradeoff p.octree --tree oak", 2, &["oak"]),
        ("tradeoff p.octree --config depth8,broken.toml", 78, &["broken.toml", "99"]),
        ("tradeoff p.octree --config gone.toml", 78, &["gone.toml"]),
        ("tradeoff p.octree --csv other.csv", 73, &["other.csv", "--overwrite"]),
        ("tradeoff p.octree --svg other.csv", 73, &["other.csv", "--overwrite"]),
        ("tradeoff p.octree --csv nowhere/t.csv", 73, &["nowhere/t.csv"]),
        ("tradeoff p.ply --csv p.ply --overwrite", 2, &["p.ply", "input"]),
        ("tradeoff p.octree --truth p.mesh.ply --svg p.mesh.ply --overwrite", 2, &["p.mesh.ply"]),
        ("tradeoff p.octree --json --csv -", 2, &["standard output"]),
        ("tradeoff p.octree --csv t.x --svg t.x", 2, &["one file"]),
    ] {
        bench.line(&format!("{line} --progress off")).fails(code, words);
    }
    let before = bench.read("other.csv");
    assert_eq!(before, b"a table of somebody\n");
    bench.line("tradeoff p.octree --pairs 500 --max-level 2 --csv other.csv --overwrite").ok();
    assert_ne!(bench.read("other.csv"), before);
}

/// Finds the process that another one started, if it runs.
fn child_of(parent: u32) -> Option<u32> {
    let pids = std::fs::read_dir("/proc").unwrap().flatten();
    let mut pids = pids.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    pids.find(|&pid| is_running(pid).is_some_and(|of| of == parent))
}

/// Gives the parent of a process that has not ended.
fn is_running(pid: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // Source: proc(5).
    let mut fields = stat.rsplit(')').next()?.split_whitespace();
    let state = fields.next()?;
    let parent = fields.next()?.parse().ok()?;
    (state != "Z").then_some(parent)
}

#[test]
fn a_build_ends_with_the_sweep_that_started_it() {
    let bench = Bench::new();
    noise(&bench);
    std::fs::create_dir(bench.path("temporary")).unwrap();
    let mut command = bench.command(["tradeoff", "a.octree", "--pairs", "1k", "--progress", "off"]);
    command.args(["--leaf-capacity", "50"]).env("TMPDIR", bench.path("temporary"));
    let mut sweep = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let patience = |what: &str, mut found: Box<dyn FnMut() -> bool + '_>| {
        let begun = std::time::Instant::now();
        while !found() {
            assert!(begun.elapsed() < Duration::from_secs(60), "{what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let mut build = None;
    patience(
        "no build",
        Box::new(|| {
            build = child_of(sweep.id());
            build.is_some()
        }),
    );
    let build = build.unwrap();
    std::thread::sleep(Duration::from_millis(500));
    assert!(is_running(build).is_some());
    // No signal that could be handed on.
    sweep.kill().unwrap();
    sweep.wait().unwrap();
    patience("the build goes on", Box::new(|| is_running(build).is_none()));
}

#[test]
fn settings_of_one_tree_are_built_once() {
    let bench = packed();
    // With so large leaves no cell is cut as far as either level.
    let line = "tradeoff p.octree --truth p.mesh.ply --pairs 2k --leaf-capacity 2000 \
                --max-level 7,9 --profile patch,paper --csv t.csv";
    let answer = json(&bench.line(&format!("{line} --json")).ok());
    let rows = answer["settings"].as_array().unwrap();
    let outcomes: Vec<_> = rows.iter().map(|row| row["outcome"].as_str().unwrap()).collect();
    assert_eq!(outcomes, ["built", "same", "built", "same"]);
    let [first, second] = ["level 7, capacity 2000", "profile paper, level 7, capacity 2000"];
    assert_eq!(rows[1]["why_not"], format!("as {first}"));
    assert_eq!(rows[3]["why_not"], format!("as {second}"));
    assert!(rows[1]["error"].is_null() && rows[1]["on_front"] == false);
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    assert_eq!(csv.matches(",same,,,").count(), 2, "{csv}");
    // They are what they are told to be.
    for level in [7, 9] {
        let build = format!("build p.octree --leaf-capacity 2000 --max-level {level}");
        bench.line(&format!("{build} -o {level}.vmap")).ok();
        bench.line(&format!("export {level}.vmap --links {level}.csv")).ok();
    }
    assert_eq!(bench.read("7.csv"), bench.read("9.csv"));
    assert_eq!(info(&bench, "7.vmap")["links"], rows[0]["links"]);
}

#[test]
fn what_would_take_far_too_long_is_not_begun() {
    let bench = Bench::new();
    noise(&bench);
    // The first takes a second or so, the last would take an hour.
    let line = "tradeoff a.octree --pairs 1k --leaf-capacity 100,1 --max-level 21 --limit 20";
    let begun = std::time::Instant::now();
    let run = bench.line(&format!("{line} --progress plain")).ok();
    let row = run.stdout.lines().find(|l| l.contains("capacity 1 ")).unwrap();
    assert!(row.contains("not begun: some ") && row.ends_with(" expected"), "{row}");
    assert!(begun.elapsed() < Duration::from_secs(90), "{:?}", begun.elapsed());
}

#[test]
fn committed_tables_have_the_columns_that_are_written() {
    use pvmap::tradeoff::defects::table::CSV_HEADER as DEFECTS;
    use pvmap::tradeoff::table::CSV_HEADER as SETTINGS;
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/tradeoff");
    for name in ["furnished", "bunny", "cave", "defects-furnished"] {
        let table = std::fs::read_to_string(folder.join(format!("{name}.csv"))).unwrap();
        let header = if name.starts_with("defects") { DEFECTS.as_str() } else { SETTINGS };
        assert_eq!(table.lines().next(), Some(header), "{name}");
    }
    let lights = std::fs::read_to_string(folder.with_file_name("light/cornell.csv")).unwrap();
    assert_eq!(lights.lines().next(), Some(pvmap::tradeoff::light::table::CSV_HEADER));
}
