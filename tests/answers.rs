//! What `pvmap query` answers, and how it takes rows.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::io::Write;
use std::process::Stdio;
use std::time::Instant;

use cli_common::{Bench, MIB, Run, info, ply_header, room};
use serde_json::Value;

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
fn a_pair() {
    let bench = room();
    let yes = bench.line("query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1").exits(0);
    assert!(yes.stdout.starts_with("yes\n") && yes.stdout.contains("nodes"), "{}", yes.stdout);
    assert!(yes.stdout.contains("\n  distances "), "{}", yes.stdout);
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

    // Any threads; how far a file is is told, and of rows from elsewhere nothing.
    let told = bench.line("query room.vmap pairs rows.csv --threads 3 --progress json").ok();
    assert_eq!(told.stdout, run.stdout);
    let bytes = bench.read("rows.csv").len();
    let last: Value = serde_json::from_str(told.stderr.lines().last().unwrap()).unwrap();
    assert_eq!((&last["stage"], &last["done"]), (&"table".into(), &bytes.into()));
    let mut command = bench.command("query room.vmap pairs - --progress json".split(' '));
    command.stdin(std::fs::File::open(bench.path("rows.csv")).unwrap());
    let untold = Run::of(command).ok();
    assert_eq!((untold.stdout, untold.stderr.as_str()), (run.stdout, ""));
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
    bench.line("query wall.vmap pair 10,10,0 10,10,10 --normal1 0,0,0").fails(2, &["normal"]);
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
    // What is no text is no number where one is read; elsewhere it is nobody's matter.
    bench.write(
        "rows.csv",
        b"//X1,y1,z1,x2,y2,z2,who\n0,0,\xff,0,0,0,a\n-0.5,-0.5,-1,0.5,0.5,1,M\xfcller\n",
    );
    let answers = bench.line("query room.vmap pairs rows.csv").ok().stdout;
    let lines: Vec<&str> = answers.lines().collect();
    assert!(lines[1].starts_with(",,,,,\"z1 is ") && lines[2].starts_with("1,"), "{answers}");
    // No rows, no answers.
    bench.write("rows.csv", "x1,y1,z1,x2,y2,z2\n");
    assert_eq!(bench.line("query room.vmap pairs rows.csv").ok().stdout.lines().count(), 1);
    bench.line("query room.vmap pairs none.csv").fails(66, &["none.csv"]);
}

#[test]
fn a_row_without_end_is_refused_with_its_line() {
    let bench = room();
    let header = "x1,y1,z1,x2,y2,z2\n-0.5,-0.5,-1,0.5,0.5,1\n";
    // Endless digits, and an endless quoted cell of many lines.
    for (start, more) in [("", "1"), ("\"", "1,2,3,4,5,6\n")] {
        let mut command = bench.command(["query", "room.vmap", "pairs", "-"]);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut rows = child.stdin.take().unwrap();
        let writer = std::thread::spawn(move || {
            let more = more.repeat(1 << 16);
            rows.write_all((header.to_owned() + start).as_bytes()).unwrap();
            // Until nobody reads any more.
            while rows.write_all(more.as_bytes()).is_ok() {}
        });
        let run = Run::watch(child, Instant::now())
            .fails(65, &["standard input: line 3: ", "65536 bytes"]);
        writer.join().unwrap();
        assert!(run.anon_bytes < 32 * MIB, "{} MiB", run.anon_bytes / MIB);
        // The row before it was answered.
        assert_eq!(column(&run.stdout, "visible"), ["1"]);
    }
    bench.line("query room.vmap pairs /dev/zero").fails(65, &["/dev/zero: line 1: "]);
    let long = format!(
        "x1,y1,z1,x2,y2,z2,note\r\n{0},\r\n{0},{1}\r\n",
        "0,0,-1,0,0,1",
        "n".repeat(70_000)
    );
    bench.write("long.csv", long);
    bench.line("query room.vmap pairs long.csv").fails(65, &["long.csv: line 3: "]);
    bench.line("query room.vmap pairs .").fails(66, &["not a regular file"]);
}

#[test]
fn f42_a_query_that_meets_a_flipped_block_names_it_and_others_are_answered() {
    let bench = room();
    let (name, at) = bench.with_map("room.vmap", |view| {
        let section = view.file().sections().iter().find(|s| s.name == "surfels").unwrap();
        (section.name.clone(), section.offset_bytes)
    });
    let mut map = bench.read("room.vmap");
    map[at as usize + 5] ^= 4;
    bench.write("flipped.vmap", map);
    let place = format!("byte {at}");
    bench.line("query flipped.vmap pair -0.5,-0.5,-1 0.5,0.5,1").fails(65, &[&name, &place]);
    bench.line("verify flipped.vmap").fails(65, &["flipped.vmap", &name, &place]);
    bench.line("export flipped.vmap --surfels S.csv").fails(65, &[&name]);
    assert!(!bench.path("S.csv").exists());
    // What does not touch that block still answers.
    bench.line("export flipped.vmap --nodes N.csv --links L.csv").ok();
    bench.line("info flipped.vmap").ok().warns(&["flipped.vmap", &name, &place]);
}

#[test]
fn a_row_has_its_answer_while_the_next_is_not_there_yet() {
    use std::io::{BufRead, BufReader, Write};
    let bench = room();
    let mut command = bench.command(["query", "room.vmap", "pairs", "-"]);
    command.stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut rows = child.stdin.take().unwrap();
    let mut answers = BufReader::new(child.stdout.take().unwrap()).lines();
    rows.write_all(b"x1,y1,z1,x2,y2,z2\n").unwrap();
    for _ in 0..3 {
        rows.write_all(b"-0.5,-0.5,-1,0.5,0.5,1\n").unwrap();
        let mut line = answers.next().unwrap().unwrap();
        if line.starts_with("visible") {
            line = answers.next().unwrap().unwrap();
        }
        assert!(line.starts_with("1,"), "{line}");
    }
    drop(rows);
    assert!(child.wait().unwrap().success());
}
