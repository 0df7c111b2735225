//! What `pvmap query` answers beyond pairs: visible-from, sees-count, region, ray, shadow.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, Run, room};
use pvmap::vmap::MapView;
use serde_json::Value;

fn json(run: &Run) -> Value {
    serde_json::from_str(&run.stdout).unwrap()
}

fn cells(text: &str, column: usize) -> Vec<String> {
    let rows = text.lines().skip(1);
    rows.map(|l| l.split(',').nth(column).unwrap().to_owned()).collect()
}

#[test]
fn what_a_place_sees_is_what_pairs_say() {
    let bench = room();
    let table = bench.line("query room.vmap visible-from -0.5,-0.5,-1").ok().stdout;
    assert!(table.starts_with("surfel,x,y,z,points\n"), "{table}");
    let seen = json(&bench.line("query room.vmap visible-from -0.5,-0.5,-1 --json").ok());
    let ids: Vec<u64> = cells(&table, 0).iter().map(|id| id.parse().unwrap()).collect();
    assert_eq!(seen["seen"], ids.len());
    let n_points: u64 = cells(&table, 4).iter().map(|n| n.parse::<u64>().unwrap()).sum();
    assert_eq!(seen["points"], n_points);
    let in_ranges: Vec<u64> =
        seen["ranges"].as_array().unwrap().iter().fold(Vec::new(), |mut all, range| {
            all.extend(range[0].as_u64().unwrap()..=range[1].as_u64().unwrap());
            all
        });
    assert_eq!(in_ranges, ids);
    // The counts of all surfels leave out a surfel's own.
    let counts = bench.line("query room.vmap sees-count").ok().stdout;
    let own = seen["surfel"].as_u64().unwrap() as usize;
    assert_eq!(cells(&counts, 4)[own], (ids.len() - 1).to_string());
    let n_pairs: u64 = cells(&counts, 4).iter().map(|n| n.parse::<u64>().unwrap()).sum();
    let visible = bench.with_map("room.vmap", |view: &MapView<'_>| view.summary().n_visible_pairs);
    assert_eq!(u128::from(n_pairs), 2 * visible);
    let lines = bench.line("query room.vmap sees-count --json").ok().stdout;
    assert_eq!(lines.lines().count(), cells(&counts, 0).len());
    // All centres but those on the same wall, by another way.
    let rows: String = table.lines().skip(1).fold("x1,y1,z1,x2,y2,z2\n".into(), |mut rows, l| {
        let cells: Vec<&str> = l.split(',').collect();
        rows += &format!("-0.5,-0.5,-1,{},{},{}\n", cells[1], cells[2], cells[3]);
        rows
    });
    bench.write("rows.csv", rows);
    let pairs = bench.line("query room.vmap pairs rows.csv").ok().stdout;
    assert!(cells(&pairs, 0).iter().all(|v| v == "1"), "{pairs}");
    bench.write("places.csv", "x,y,z\n-0.5,-0.5,-1\n0,0,0\n");
    let rows = bench.line("query room.vmap visible-from --rows places.csv").ok().stdout;
    assert_eq!(cells(&rows, 2)[0], ids.len().to_string());
    assert!(rows.lines().nth(2).unwrap().starts_with(",,,,,\"no surface at 0,0,0"), "{rows}");
}

#[test]
fn what_is_seen_from_the_air_is_what_a_lamp_there_lights() {
    let bench = Bench::new();
    bench.line("scene furnished --points 8k -o room.ply").ok();
    bench.line("ingest room.ply").ok();
    bench.line("build").ok();
    let table = bench.line("query room.vmap visible-from 1.5,1.2,1.1 --air").ok().stdout;
    assert!(table.starts_with("surfel,x,y,z,points\n"), "{table}");
    let seen = cells(&table, 0);
    let all = bench.line("query room.vmap sees-count").ok().stdout;
    let mut rows = "x,y,z\n".to_owned();
    for line in all.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        rows += &format!("{},{},{}\n", cells[1], cells[2], cells[3]);
    }
    bench.write("rows.csv", rows);
    let lit = "query room.vmap shadow --rows rows.csv --light 1.5,1.2,1.1 --air";
    let lit = cells(&bench.line(lit).ok().stdout, 0);
    let ids = cells(&all, 0);
    assert!((ids.len() / 4..ids.len()).contains(&seen.len()), "{} of {}", seen.len(), ids.len());
    for (id, light) in ids.iter().zip(&lit) {
        assert_eq!(seen.contains(id), light == "lit", "surfel {id}");
    }
    let answer = json(&bench.line("query room.vmap visible-from 1.5,1.2,1.1 --air --json").ok());
    assert_eq!(answer["seen"], seen.len());
    assert!(answer["surfel"].is_null(), "{answer}");
    bench.write("places.csv", "x,y,z\n1.5,1.2,1.1\n0,0,inf\n");
    let rows = bench.line("query room.vmap visible-from --rows places.csv --air").ok().stdout;
    let expected = format!(",,{},{},", seen.len(), answer["points"]);
    assert!(rows.lines().nth(1).unwrap().starts_with(&expected), "{rows}");
    assert!(rows.lines().nth(2).unwrap().starts_with(",,,,,\""), "{rows}");
    bench.line("query room.vmap visible-from 0,0,0 --air --snap 1").exits(2);
}

#[test]
fn the_points_answer_beside_the_surfels() {
    let bench = Bench::new();
    bench.line("scene furnished --points 20k -o a.ply --seed 3").ok();
    bench.line("ingest a.ply").ok();
    bench.line("build a.octree").ok();
    bench.line("scene empty --points 3k -o b.ply").ok();
    bench.line("ingest b.ply").ok();
    // Two walls of the room, with nothing between and with the box between.
    let mut n_exit = [0; 2];
    let mut rows = "x1,y1,z1,x2,y2,z2\n".to_owned();
    for i in 0..40 {
        let (u, v) = (0.3 + 0.12 * f64::from(i), 0.2 + 0.1 * f64::from(i % 7));
        let (a, b) = (format!("{u},0,{v}"), format!("{},5.5,{v}", 5.2 - u / 2.0));
        let run = bench.line(&format!("query a.vmap pair {a} {b} --exact --snap 1"));
        let said = json(&bench.line(&format!("query a.vmap pair {a} {b} --exact --snap 1 --json")));
        assert_eq!(said["exact"]["visible"], run.code == 0, "{said} {run:?}");
        assert_eq!(said["visible"], run.code == 0, "{said} {run:?}");
        let leaves = if said["leaves"] == true { "yes" } else { "no" };
        assert!(run.stdout.contains(&format!("\n  leaves    say {leaves}\n")), "{said} {run:?}");
        assert!(run.stdout.contains("\n  leaves    say ") && run.code < 2, "{run:?}");
        n_exit[run.code as usize] += 1;
        rows += &format!("{a},{b}\n");
    }
    assert!(n_exit.iter().all(|&n| n > 2), "{n_exit:?} say yes and no");
    bench.write("rows.csv", rows);
    let table = bench.line("query a.vmap pairs rows.csv --exact --snap 1 --octree a.octree").ok();
    let n_yes = cells(&table.stdout, 0).iter().filter(|v| *v == "1").count();
    assert_eq!(n_yes, n_exit[0], "{}", table.stdout);
    let differing = |l: &&str| l.split(',').next() != l.split(',').nth(5);
    let n = table.stdout.lines().skip(1).filter(differing).count();
    assert!(table.stderr.contains(&format!("disagree in {n} of 40 pairs")), "{}", table.stderr);
    // With so many witnesses asked for nothing hides anything.
    let line = "query a.vmap pairs rows.csv --exact --snap 1 --delta 0.01 --k 1000000";
    let table = bench.line(line).ok().stdout;
    assert_eq!(cells(&table, 0).iter().filter(|v| *v == "1").count(), 40, "{table}");
    let rows = bench.line(&format!("{line} --json")).ok().stdout;
    let said: Vec<Value> = rows.lines().map(|row| serde_json::from_str(row).unwrap()).collect();
    assert!(said.iter().all(|row| row["visible"] == true && row["leaves"].is_boolean()), "{rows}");
    let of_other = "query a.vmap pair 1,0,1 1,5.5,1 --snap 1 --exact --octree b.octree";
    bench.line(of_other).fails(65, &["a.vmap", "not built from", "b.octree"]);
    bench.line("query a.vmap pair 1,0,1 1,5.5,1 --delta 1").fails(2, &["--exact"]);
    bench.line("query a.vmap pair 1,0,1 1,5.5,1 --exact --delta=-1").fails(2, &["-1"]);
    bench.line("query a.vmap pairs rows.csv --snap -1").fails(2, &["--snap", "no distance"]);
}

#[test]
fn the_crowd_of_a_pair() {
    let bench = room();
    let run = bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1").exits(0);
    assert!(run.stdout.contains("\n  crowd     surfels "), "{}", run.stdout);
    assert!(run.stdout.contains("\n  cells     "), "{}", run.stdout);
    let answer = json(&bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1 --json").exits(0));
    for (side, name) in ["surfel1", "surfel2"].into_iter().enumerate() {
        let range = &answer["link"]["surfels"][side];
        let own = answer[name].as_u64().unwrap();
        assert!(range[0].as_u64().unwrap() <= own && own <= range[1].as_u64().unwrap());
    }
    assert_eq!(answer["link"]["cells"].as_array().unwrap().len(), 2);
}

#[test]
fn regions() {
    let bench = room();
    let all = bench.line("query room.vmap region -0.5,-0.5,-1 0.3 0.5,0.5,1 0.3").ok().stdout;
    assert!(all.starts_with("all\n  fraction  1 of"), "{all}");
    let none = json(&bench.line("query room.vmap region 0,0,-1 0.3 .5,.5,-1 0.3 --json").ok());
    assert_eq!((none["sees"].as_str(), none["fraction"].as_f64()), (Some("none"), Some(0.0)));
    bench.line("query room.vmap region 0,0,-1 -1 0,0,1 1").fails(2, &["radius -1"]);
    bench.line("query room.vmap region 0,0,-9 1 0,0,1 1").fails(65, &["outside"]);
    bench.line("query room.vmap region 0,0,0 0.01 0,0,1 1").fails(65, &["no surfel's centre"]);
    bench.line("query room.vmap region 0,0,0 0.01").exits(2);
    let rows = "x1,y1,z1,r1,x2,y2,z2,r2\n-.5,-.5,-1,.3,.5,.5,1,.3\n0,0,0,.01,0,0,1,1\n";
    bench.write("rows.csv", rows);
    let table = bench.line("query room.vmap region --rows rows.csv").ok().stdout;
    assert_eq!(cells(&table, 0), ["all", ""]);
    let lines = bench.line("query room.vmap region --rows rows.csv --json").ok().stdout;
    assert!(lines.lines().nth(1).unwrap().contains("error"), "{lines}");
}

#[test]
fn rays() {
    let bench = room();
    let from_floor = json(&bench.line("query room.vmap ray 0.3,0.3,-1 0,0,1 --json").ok());
    assert!(from_floor["from"].is_u64(), "{from_floor}");
    let hit = &from_floor["hit"];
    assert!((hit["distance"].as_f64().unwrap() - 2.0).abs() < 0.01, "{hit}");
    assert!((hit["normal"][2].as_f64().unwrap() + 1.0).abs() < 0.01, "{hit}");
    let from_air = bench.line("query room.vmap ray 0.3,0.3,0 0,0,-2").ok().stdout;
    assert!(from_air.starts_with("hit\n") && from_air.contains("from      the air"), "{from_air}");
    let out = bench.line("query room.vmap ray 0.3,0.3,5 0,0,1").ok().stdout;
    assert!(out.starts_with("nothing\n"), "{out}");
    bench.line("query room.vmap ray 0.3,0.3,5 0,0,0").fails(2, &["direction 0,0,0"]);
    bench.write("rows.csv", "x,y,z,dx,dy,dz\n.3,.3,-1,0,0,1\n.3,.3,0,0,0,0\n9,9,9,1,0,0\n");
    let table = bench.line("query room.vmap ray --rows rows.csv").ok().stdout;
    assert_eq!(cells(&table, 0), ["1", "", "0"]);
    assert!(table.lines().all(|l| l.contains("error") || l.matches(',').count() >= 10), "{table}");
}

#[test]
fn shadows() {
    let bench = room();
    let ask = |light: &str| bench.line(&format!("query room.vmap shadow 0.3,0.3,-1 {light}"));
    // A lamp in the air, one on the ceiling, one behind the ceiling.
    assert!(ask("--light 0,0,0.5").ok().stdout.starts_with("lit\n"));
    let lamp = ask("--light 0,0,1").ok().stdout;
    assert!(lamp.starts_with("lit\n") && lamp.contains("\n  lamp      on surfel "), "{lamp}");
    let lamp = ask("--light 0,0,1 --air").ok().stdout;
    assert!(lamp.contains("\n  lamp      in the air\n"), "{lamp}");
    let hidden = json(&ask("--light 0,0,1.9 --json").ok());
    assert_eq!(hidden["light"], "umbra");
    assert!(hidden["blocker"].is_u64(), "{hidden}");
    // All of the ceiling, none of the floor, some of both.
    assert!(ask("--light-box -1,-1,0.99,1,1,1.01").ok().stdout.starts_with("lit\n"));
    let floor = ask("--light-box -1,-1,-1.1,0,0,-0.9").ok().stdout;
    assert!(floor.starts_with("umbra\n"), "{floor}");
    let both = json(&ask("--light-box -1,-1,-2,1,1,2 --json").ok());
    assert_eq!(both["light"], "penumbra");
    ask("").fails(2, &["no light"]);
    ask("--light-box 1,1,1,0,0,0").exits(2);
    ask("--light-box 5,5,5,6,6,6").fails(65, &["in the box"]);
    ask("--class 3").exits(2);
    ask("--class 3 --octree room.octree").fails(65, &["room.octree", "no classes"]);
    bench.write("rows.csv", "x,y,z,lx,ly,lz\n.3,.3,-1,0,0,.5\n.3,.3,-1,0,0,1.9\n.3,.3,-1,,,\n");
    let table = bench.line("query room.vmap shadow --rows rows.csv").ok().stdout;
    assert_eq!(cells(&table, 0), ["lit", "umbra", ""]);
    let table = bench.line("query room.vmap shadow --rows rows.csv --light 0,0,.5").ok().stdout;
    assert_eq!(cells(&table, 0), ["lit", "umbra", "lit"]);
}

#[test]
fn a_class_shines() {
    let bench = Bench::new();
    // A floor of class 2 and a ceiling that faces it, one half of it of class 6.
    let mut text = "ply\nformat ascii 1.0\nelement vertex 3200\n".to_owned();
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        text += &format!("property float {name}\n");
    }
    text += "property uchar classification\nend_header\n";
    for (z, nz) in [(0, 1), (20, -1)] {
        for i in 0..1600 {
            let class = if z > 0 && i % 40 < 20 { 6 } else { 2 };
            text += &format!("{} {} {z} 0 0 {nz} {class}\n", i % 40, i / 40);
        }
    }
    bench.write("hall.ply", text);
    bench.line("ingest hall.ply").ok();
    bench.line("build").ok();
    let ask = |place: &str, class: u8| {
        let line = format!("query hall.vmap shadow {place} --octree hall.octree --class {class}");
        bench.line(&line)
    };
    assert!(ask("20,20,0", 6).ok().stdout.starts_with("lit\n"));
    assert!(ask("20,20,20", 6).ok().stdout.contains(" points in "));
    let some = ask("20,20,0", 2).ok().stdout;
    // Of 2400 points 800 are above, and those of the place's own surfel.
    assert!(some.starts_with("penumbra\n  share     0.3"), "{some}");
    ask("20,20,0", 9).fails(65, &["hall.octree", "no point has class 9"]);
    let other = String::from_utf8(bench.read("hall.ply")).unwrap();
    bench.write("other.ply", other.replacen("39 39 20 ", "39 38 20 ", 1));
    bench.line("ingest other.ply").ok();
    bench
        .line("query hall.vmap shadow 20,20,0 --octree other.octree --class 2")
        .fails(65, &["another octree"]);
}

#[test]
fn how_much_surfels_see_of_each_other_is_told_where_the_map_knows() {
    let bench = Bench::new();
    bench.line("scene furnished --points 20k -o room.ply").ok();
    bench.line("ingest room.ply").ok();
    bench.line("build room.octree --max-level 5 -o plain.vmap").ok();
    bench.line("build room.octree --max-level 5 --fractions -o room.vmap").ok();
    let run = bench.line("query plain.vmap pair 1,1,0 1,2,0 --fraction").exits(2);
    assert!(run.stderr.contains("pvmap build --fractions"), "{}", run.stderr);
    let places = bench.line("query room.vmap sees-count").ok().stdout;
    let normals = bench.line("export room.vmap --surfels -").ok().stdout;
    let column = |table: &str, name: &str| {
        let names = table.lines().next().unwrap();
        cells(table, names.split(',').position(|c| c == name).unwrap())
    };
    let columns = [(&places, ["x", "y", "z"]), (&normals, ["nx", "ny", "nz"])]
        .map(|(table, names)| names.map(|name| column(table, name)))
        .concat();
    let cell = |i: usize| columns.iter().map(|column| column[i].clone()).collect::<Vec<_>>();
    let n = columns[0].len();
    let mut rows = "x1,y1,z1,nx1,ny1,nz1,x2,y2,z2,nx2,ny2,nz2\n".to_owned();
    let asked: Vec<(usize, usize)> =
        (0..20).flat_map(|i| (0..n).map(move |j| (i * n / 20, j))).collect();
    asked
        .iter()
        .for_each(|&(i, j)| rows += &format!("{},{}\n", cell(i).join(","), cell(j).join(",")));
    bench.write("rows.csv", rows);
    let table = bench.line("query room.vmap pairs rows.csv --fraction").ok().stdout;
    assert!(table.starts_with("visible,surfel1,surfel2,distance1,distance2,fraction,error\n"));
    let plain = bench.line("query plain.vmap pairs rows.csv").ok().stdout;
    assert_eq!(cells(&table, 0), cells(&plain, 0), "links stay as they are");
    let fractions: Vec<f64> = cells(&table, 5).iter().map(|f| f.parse().unwrap()).collect();
    assert!(fractions.iter().all(|f| (0.0..=1.0).contains(f) && (16.0 * f).fract() == 0.0));
    let some = fractions.iter().position(|&f| f > 0.0 && f < 1.0).expect("a pair half in shadow");
    let (i, j) = asked[some];
    let [from, to] = [i, j].map(cell);
    let [a, b] = [&from, &to].map(|place| place[..3].join(","));
    let [n1, n2] = [&from, &to].map(|place| place[3..].join(","));
    let line = format!("query room.vmap pair {a} {b} --normal1 {n1} --normal2 {n2} --fraction");
    let answer = json(&bench.line(&format!("{line} --json")));
    assert_eq!(answer["fraction"], fractions[some]);
    let tried = answer["tried"].as_array().unwrap();
    let said = bench.line(&line).stdout;
    let words = format!(
        "  fraction  {}: {} of 16 segments between nodes {} and {}\n",
        fractions[some],
        16.0 * fractions[some],
        tried[0],
        tried[1]
    );
    assert!(said.contains(&words), "{said}");
    let info = json(&bench.line("info room.vmap --json").ok());
    assert!(info["visible_fractions"].as_u64().unwrap() > 100, "{info}");
    assert!(json(&bench.line("info plain.vmap --json").ok())["visible_fractions"].is_null());
}
