//! What `info --quality` and `ingest` say of the points of a scan and of their normals.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::fmt::Write as _;

use cli_common::{Bench, Run, info, ply_header, room};

/// Writes a floor of `n` by `n` points a hundredth apart, each with the normal that `normal` gives.
fn write_floor(bench: &Bench, n: u32, normal: impl Fn(u32) -> [f64; 3]) {
    let mut text = ply_header(n * n, &["x", "y", "z", "nx", "ny", "nz"]);
    for i in 0..n * n {
        let [x, y] = [i % n, i / n].map(|v| f64::from(v) / 100.0);
        let [nx, ny, nz] = normal(i);
        writeln!(text, "{x} {y} 0 {nx} {ny} {nz}").unwrap();
    }
    bench.write("floor.ply", text);
}

fn ingest(bench: &Bench, flags: &str) -> Run {
    bench.line(&format!("ingest floor.ply --overwrite {flags}")).ok()
}

#[test]
fn n33_normals_that_contradict_the_points_are_trusted_told_and_replaced_where_asked() {
    let bench = Bench::new();
    let warning = ["floor.octree", "contradict", "90°", "--normals estimate"];
    let stored = || {
        bench.with_octree("floor.octree", |octree| {
            let points = octree.points(0, octree.summary().n_points).unwrap();
            points.iter().map(|p| p.unwrap().key.normal).collect::<Vec<_>>()
        })
    };
    // Along the floor instead of across it, every one another way.
    write_floor(&bench, 60, |i| [f64::from(i).sin(), f64::from(i).cos(), 0.0]);
    let run = ingest(&bench, "").warns(&warning);
    assert!(run.stdout.contains("\n  angles    90.0° "), "{}", run.stdout);
    assert!(stored().iter().all(|n| n[2] == 0), "the file is trusted");
    bench.line("info floor.octree --quality").ok().warns(&warning);
    let found = info(&bench, "floor.octree --quality");
    let angles = &found["quality"]["angles_percent"];
    assert_eq!((&angles["to_15"], &angles["to_90"]), (&0.0.into(), &100.0.into()), "{angles}");
    assert_eq!(found["quality"]["contradicts_points"], true);
    // `--normals estimate` is the way out, and has no normals of the file to compare.
    let run = ingest(&bench, "--normals estimate");
    assert!(!run.stderr.contains("warning") && !run.stdout.contains("angles"), "{}", run.stderr);
    assert!(stored().iter().all(|n| *n == [0, 0, 1 << 14]));
    let found = info(&bench, "floor.octree --quality");
    assert!(found["quality"].get("angles_percent").is_none(), "{found}");
    // 40° off are no contradiction, and neither are a third that lie.
    write_floor(&bench, 60, |_| [0.0, 40f64.to_radians().sin(), 40f64.to_radians().cos()]);
    assert!(!ingest(&bench, "").stderr.contains("warning"));
    write_floor(&bench, 60, |i| if i % 3 == 0 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] });
    assert!(!ingest(&bench, "").stderr.contains("warning"));
    let found = info(&bench, "floor.octree --quality");
    let share = found["quality"]["angles_percent"]["to_90"].as_f64().unwrap();
    assert!((share - 33.33).abs() < 0.1, "{share}");
}

#[test]
fn what_was_planted_is_told() {
    // One side of a floor a hundredth apart, every tenth normal turned over, every twentieth away.
    let bench = Bench::new();
    write_floor(&bench, 100, |i| match (i * 7 + i / 100 * 3) % 20 {
        0 => [0.0; 3],
        3 | 9 => [0.0, 0.0, -1.0],
        _ => [0.0, 0.0, 1.0],
    });
    ingest(&bench, "--normals file");
    let found = &info(&bench, "floor.octree --quality --sample 1M")["quality"];
    let number = |key: &str| found[key].as_f64().unwrap();
    assert_eq!(number("sampled"), 10_000.0);
    assert_eq!(number("without_normal_percent"), 5.0);
    assert!((number("turned_percent") - 100.0 * 2.0 / 19.0).abs() < 1e-9, "{found}");
    assert!((number("unevenness") - 1.0).abs() < 1e-3 && number("thickness_of_spacing") < 1e-3);
    assert!((found["spacing"]["p50"].as_f64().unwrap() - 0.01).abs() < 1e-5);
    assert_eq!(number("coincident_percent"), 0.0);
}

#[test]
fn quality_is_asked_of_octrees() {
    let bench = room();
    bench.line("info room.vmap --quality").fails(2, &["room.vmap", "octree"]);
    bench.line("info room.octree --sample 5").fails(2, &["--quality"]);
    bench.line("info room.octree --quality --sample 0").fails(2, &["--sample"]);
    // What the head says is the same with it and without.
    let [head, all] = ["", " --quality"].map(|flag| bench.line(&format!("info room.octree{flag}")));
    assert!(all.stdout.starts_with(&head.stdout) && all.stdout.len() > head.stdout.len());
    // Points of none, and of one place.
    for (name, n) in [("none", 0), ("one", 1), ("same", 300)] {
        let text = ply_header(n, &["x", "y", "z"]) + &"1 2 3\n".repeat(n as usize);
        bench.write(format!("{name}.ply"), text);
        bench.line(&format!("ingest {name}.ply")).ok();
        let found = &info(&bench, &format!("{name}.octree --quality"))["quality"];
        assert!(found["spacing"].is_null() && found["thickness"].is_null(), "{found}");
        bench.line(&format!("info {name}.octree --quality")).ok();
    }
}

#[test]
fn holes_show_in_the_rim() {
    let bench = Bench::new();
    let rim = |options: &str| {
        bench.line(&format!("scene empty --points 60k {options} -o a.ply")).ok();
        bench.line("ingest a.ply --overwrite").ok();
        info(&bench, "a.octree --quality --sample 1M")["quality"]["rim_percent"].as_f64().unwrap()
    };
    // A closed room ends nowhere, however uneven its points are.
    assert!(rim("") < 0.3 && rim("--uneven 9") < 3.0, "{} {}", rim(""), rim("--uneven 9"));
    let [some, many] = ["--holes 5%", "--holes 20%"].map(rim);
    assert!(some > 1.0 && many > 3.0 * some, "{some} {many}");
}

/// Writes a floor of 150 by 150 points a hundredth apart, and strays over it, all facing up.
fn write_strays(bench: &Bench, strays: &[[f64; 3]]) {
    let n = 150;
    let names = ["x", "y", "z", "nx", "ny", "nz"];
    let mut text = ply_header(n * n + strays.len() as u32, &names);
    let floor = (0..n * n).map(|i| [f64::from(i % n) / 100.0, f64::from(i / n) / 100.0, 0.0]);
    for [x, y, z] in floor.chain(strays.iter().copied()) {
        writeln!(text, "{x} {y} {z} 0 0 1").unwrap();
    }
    bench.write("strays.ply", text);
    bench.line("ingest strays.ply --overwrite").ok();
}

#[test]
fn surfels_of_a_few_stray_points_are_named_with_what_cuts_them() {
    let bench = Bench::new();
    let wide = |flags: &str| {
        bench.line(&format!("build strays.octree {flags}")).ok();
        (info(&bench, "strays.vmap")["wide_surfels"].clone(), bench.line("info strays.vmap").ok())
    };
    // Four in a clump and two far away, in one eighth of the cube: a leaf, by number alone.
    let clump = [[0.05, 0.05, 0.8], [0.051, 0.05, 0.8], [0.05, 0.051, 0.8], [0.051, 0.051, 0.8]];
    let far = [[0.7, 0.7, 1.4], [0.65, 0.1, 1.3]];
    let strays: Vec<[f64; 3]> = clump.into_iter().chain(far).collect();
    write_strays(&bench, &strays);
    let (found, run) = wide("--max-spread 0");
    assert_eq!((&found["surfels"], &found["of_fewer_than_4_points"]), (&1.into(), &0.into()));
    assert_eq!((&found["widest"]["points"], &found["max_spread_to_try"]), (&6.into(), &10.into()));
    let mean = [0, 1, 2].map(|i| strays.iter().map(|p| p[i]).sum::<f64>() / 6.0);
    let away = |p: &[f64; 3]| (0..3).map(|i| (p[i] - mean[i]).powi(2)).sum::<f64>().sqrt();
    let radius = strays.iter().map(away).fold(0.0, f64::max);
    assert!((found["widest"]["radius"].as_f64().unwrap() - radius).abs() < 1e-5, "{found}");
    for (i, m) in mean.iter().enumerate() {
        assert!((found["widest"]["at"][i].as_f64().unwrap() - m).abs() < 1e-5, "{found}");
    }
    let line = run.stdout.lines().find(|line| line.starts_with("wide surfels ")).unwrap();
    assert!(line.contains(" 1 over 20 times ") && line.contains("6 points"), "{line}");
    assert!(line.contains("--max-spread 10"), "{line}");
    // The default cuts them, and then there is nothing to tell.
    for flags in ["", "--config preview", "--config quick"] {
        let (found, run) = wide(flags);
        assert!(found.is_null() && !run.stdout.contains("wide"), "{flags}: {found}");
    }
    // Of three points nobody can say that they are far apart.
    write_strays(&bench, &[clump[0], far[0], far[1]]);
    let (found, run) = wide("");
    assert_eq!((&found["surfels"], &found["of_fewer_than_4_points"]), (&1.into(), &1.into()));
    assert!(found["max_spread_to_try"].is_null(), "{found}");
    assert!(run.stdout.contains("no --max-spread cuts them"), "{}", run.stdout);
}
