//! Several at once: builders of one map, readers of a map that is replaced or cut short. Rows
//! F36-F41 of the catalogue of faults.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::io::Write;
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use cli_common::faults::{
    BUILD, behind, has, journal_bytes, kill, killed_after, long, recovers, slow, small, start,
    tiny, wait_for,
};
use cli_common::{Run, room};

#[test]
fn f36_a_second_builder_is_told_who_is_at_it() {
    let bench = long();
    let line = "build a.octree --checkpoint 0 --progress off";
    let first = start(&bench, line);
    wait_for("commits", || journal_bytes(&bench) > 100);
    let holder = format!("locked by process {} since 20", first.id());
    for _ in 0..3 {
        bench.line(line).fails(75, &["a.vmap", &holder, "UTC", "wait for it or stop it"]);
    }
    kill(first).exits(137);
    // Both at once, again and again: one does it, the other does too, later, or is told.
    let bench = tiny();
    for i in 0..if slow().is_some() { 100 } else { 20 } {
        let line = format!("{BUILD} --checkpoint {}", i % 2);
        let both = [start(&bench, &line), start(&bench, &line)];
        let codes = both.map(|child| Run::watch(child, Instant::now()).code);
        assert!(codes.contains(&0) && codes.iter().all(|c| [0, 75].contains(c)), "{codes:?}");
        recovers(&bench, "both at once");
    }
}

#[test]
fn f37_a_lock_dies_with_its_process() {
    let bench = small();
    for n_files in [1, 3] {
        killed_after(&bench, n_files);
        assert!(bench.path("a.vmap.build/lock").exists());
    }
    recovers(&bench, "the lock of a process that was killed");
}

#[test]
fn f38_a_reader_sees_the_old_map_or_the_new() {
    let bench = tiny();
    let lines = [BUILD.to_owned(), format!("{BUILD} --max-level 1")];
    let [one, other] = lines.each_ref().map(|line| {
        bench.line(line).ok();
        bench.read("a.vmap")
    });
    assert!(one != other);
    let (is_over, path) = (AtomicBool::new(false), bench.path("a.vmap"));
    let n_read = std::thread::scope(|scope| {
        let read = || {
            let mut n_read = 0;
            while !is_over.load(Ordering::Relaxed) {
                let first = pvmap::Mapped::open(&path).unwrap();
                let is_one = first[..] == one[..];
                assert!(is_one || first[..] == other[..], "neither the old nor the new");
                // What is mapped stays what it was, however often it is replaced.
                std::thread::yield_now();
                assert!(first[..] == if is_one { &one } else { &other }[..]);
                n_read += 1;
            }
            n_read
        };
        let readers = [scope.spawn(read), scope.spawn(read)];
        for i in 0..if slow().is_some() { 1000 } else { 40 } {
            bench.line(&lines[i % 2]).ok();
        }
        is_over.store(true, Ordering::Relaxed);
        readers.map(|reader| reader.join().unwrap())
    });
    assert!(n_read.iter().all(|&n: &u64| n > 0), "{n_read:?}");
}

#[test]
fn f39_a_map_that_is_cut_short_under_its_reader() {
    let bench = room();
    let whole = bench.read("room.vmap");
    let row = "-0.5,-0.5,-1,0.5,0.5,1\n";
    let mut codes = Vec::new();
    for n_bytes in [0, 4096, whole.len() / 2, whole.len() - 1] {
        bench.write("room.vmap", &whole);
        let mut command = bench.command("query room.vmap pairs -".split(' '));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut rows = child.stdin.take().unwrap();
        rows.write_all(b"x1,y1,z1,x2,y2,z2\n").unwrap();
        // It is open by now, and no link was looked up yet.
        std::thread::sleep(std::time::Duration::from_millis(300));
        let file = std::fs::File::options().write(true).open(bench.path("room.vmap")).unwrap();
        file.set_len(n_bytes as u64).unwrap();
        // Where it ends at once nobody reads on.
        let _ = rows.write_all(row.repeat(100).as_bytes());
        drop(rows);
        let run = Run::watch(child, Instant::now());
        assert!([0, 65, 74].contains(&run.code), "{n_bytes}: {run:?}");
        if run.code == 74 {
            assert!(run.stderr.contains("cut short while it was open"), "{}", run.stderr);
        }
        codes.push(run.code);
    }
    assert!(codes.contains(&74), "{codes:?}");
}

#[test]
fn f40_many_readers_with_few_handles() {
    if !has("f40", &["prlimit", "--nofile=16", "true"]) {
        return;
    }
    let bench = room();
    let readers: Vec<_> = (0..64)
        .map(|i| {
            let line = ["verify room.vmap", "query room.vmap pair -0.5,-0.5,-1 0.5,0.5,1"][i % 2];
            let mut command = behind(&bench, &["prlimit", "--nofile=16"], line);
            command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
        })
        .collect();
    for reader in readers {
        Run::watch(reader, Instant::now()).ok();
    }
}
