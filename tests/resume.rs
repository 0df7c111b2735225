//! A build that is killed, stopped or torn goes on where it was, and ends with the same bytes. Rows
//! F01-F17 of the catalogue of faults. Source: DESIGN.md [D-8], [D-9].
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::time::{Duration, Instant};

use cli_common::faults::{
    BUILD, EACH, absent_or_right, calls, copy_folder, has_strace, inject, journal_bytes, kill,
    killed_after, long, n_link_files, names_in, recovers, send, slow, small, start, tiny, wait_for,
};
use cli_common::{Bench, Run};

/// Says how many of a test's rounds to do: a few, what a night has time for, or all.
fn rounds(few: u32, night: u32, all: u32) -> u32 {
    match slow() {
        None => few,
        Some(false) => night,
        Some(true) => all,
    }
}

#[test]
fn f01_killed_at_any_time_it_ends_with_the_same_bytes() {
    let bench = small();
    let n_kills = rounds(15, 300, 1000);
    let mut random = fastrand::Rng::with_seed(1);
    let (mut n_killed, mut n_finished, mut n_resumed) = (0, 0, 0);
    while n_killed < n_kills {
        // Threads, memory and checkpoints are others each time.
        let line = format!(
            "build a.octree --leaf-capacity 10 --progress plain --threads {} --memory {}MiB \
             --checkpoint {}",
            random.u32(1..4),
            random.u32(64..200),
            [0, 0, 0, 1][random.usize(..4)]
        );
        let child = start(&bench, &line);
        std::thread::sleep(Duration::from_millis(random.u64(..400)));
        let run = kill(child);
        n_resumed += u32::from(run.stderr.contains("resuming: "));
        match run.code {
            0 => n_finished += 1,
            _ => n_killed += 1,
        }
        absent_or_right(&bench, &line);
        if run.code == 0 || random.u32(..8) == 0 {
            recovers(&bench, &line);
        }
    }
    recovers(&bench, "the last");
    eprintln!("{n_killed} killed, {n_finished} finished before that, {n_resumed} resumed");
    assert!(n_resumed > n_kills / 10, "only {n_resumed} runs had anything to go on with");
}

#[test]
fn f01_visible_fractions_are_gone_on_with() {
    let bench = small();
    let build = "build a.octree --leaf-capacity 10 --fractions --min-exchange 1e-7 --checkpoint 0 \
                 --progress plain";
    bench.line(&format!("{build} --threads 1 -o whole.vmap")).ok();
    let mut random = fastrand::Rng::with_seed(3);
    let mut n_resumed = 0;
    for _ in 0..12 {
        let child = start(&bench, &format!("{build} -o again.vmap"));
        std::thread::sleep(Duration::from_millis(random.u64(50..300)));
        let run = kill(child);
        n_resumed += u32::from(run.stderr.contains("resuming: "));
        if run.code == 0 {
            break;
        }
    }
    bench.line(&format!("{build} -o again.vmap")).ok();
    assert!(bench.read("again.vmap") == bench.read("whole.vmap"));
    assert!(n_resumed > 0, "no run had anything to go on with");
}

#[test]
fn f02_killed_at_every_call_that_writes() {
    if !has_strace("f02") {
        return;
    }
    let bench = tiny();
    let calls = calls(&bench, EACH);
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
    let all: Vec<(&String, u32)> =
        calls.iter().flat_map(|(name, &n)| (1..=n).map(move |i| (name, i))).collect();
    assert!(all.len() > 100, "{calls:?}");
    let stride = if slow().is_some() { 1 } else { 19 };
    let mut n_killed = 0;
    for (name, i) in all.into_iter().step_by(stride) {
        let run = inject(&bench, &format!("{name}:signal=KILL:when={i}"), EACH);
        n_killed += u32::from(run.code == 137);
        assert!([0, 137].contains(&run.code), "{run:?}");
        recovers(&bench, &format!("killed at {name} {i}"));
    }
    eprintln!("killed {n_killed} times");
    assert!(n_killed > 5);
}

#[test]
fn f03_killed_while_it_goes_on_again_and_again() {
    let bench = small();
    let mut grown = vec![0];
    while !bench.path("a.vmap").exists() {
        assert!(grown.len() < 2000, "it does not end");
        let mut child = start(&bench, &format!("{BUILD} --checkpoint 0"));
        let before = journal_bytes(&bench);
        // After at least one more commit; several on the way, or this would take long.
        wait_for("a commit", || {
            journal_bytes(&bench) > before + 3000 || child.try_wait().unwrap().is_some()
        });
        let run = kill(child);
        if run.code == 137 && bench.path("a.vmap.build/journal").exists() {
            grown.push(journal_bytes(&bench));
        }
    }
    assert!(grown.is_sorted(), "the journal shrank: {grown:?}");
    assert!(grown.len() > 3, "{grown:?}");
    absent_or_right(&bench, "killed again and again");
}

#[test]
fn f04_killed_between_the_links_and_their_record() {
    if !has_strace("f04") {
        return;
    }
    let bench = tiny();
    // A commit syncs its links and the folder, then the record: at the second the links have their
    // name, and the journal is as it was.
    let (mut n_orphans, mut before) = (0, (0, 0));
    for i in 1..=12 {
        let fault = format!("fsync:signal=KILL:when={i}");
        inject(&bench, &fault, EACH).exits(137);
        let files = names_in(&bench.path("a.vmap.build"));
        let is_whole = |n: &&String| n.starts_with("links-") && !n.ends_with(".part");
        let now = (files.iter().filter(is_whole).count(), journal_bytes(&bench).max(16));
        n_orphans += u32::from(i > 1 && now.0 > before.0 && now.1 == before.1);
        before = now;
        recovers(&bench, &fault);
    }
    assert!(n_orphans > 1, "no kill left links without a record");
}

#[test]
fn f05_a_torn_journal() {
    let bench = tiny();
    killed_after(&bench, 6);
    let (work, folder) = (bench.path("a.vmap.build"), tempfile::tempdir().unwrap());
    let kept = folder.path().join("kept");
    copy_folder(&work, &kept);
    let n_bytes = journal_bytes(&bench);
    let stride = if slow().is_some() { 1 } else { 23 };
    for cut in (0..=n_bytes).step_by(stride) {
        copy_folder(&kept, &work);
        let journal = std::fs::File::options().write(true).open(work.join("journal")).unwrap();
        journal.set_len(cut).unwrap();
        recovers(&bench, &format!("{cut} of {n_bytes} bytes"));
        // Or overwritten from there on.
        copy_folder(&kept, &work);
        let bytes = std::fs::read(kept.join("journal")).unwrap();
        let torn = bytes.iter().enumerate().map(|(i, b)| if i < cut as usize { *b } else { 0x5a });
        std::fs::write(work.join("journal"), torn.collect::<Vec<u8>>()).unwrap();
        recovers(&bench, &format!("{cut} of {n_bytes} bytes, then others"));
    }
    // A plan that is torn, too: then it starts anew, and says so.
    copy_folder(&kept, &work);
    let plan = std::fs::read(kept.join("plan")).unwrap();
    std::fs::write(work.join("plan"), &plan[..plan.len() - 1]).unwrap();
    bench.line(BUILD).ok().warns(&["plan is damaged", "anew"]);
}

/// What a power cut may have left of a file that was not synced: nothing, a part, as many zeroes,
/// or blocks of 512 bytes of which some were written.
fn left_of(bytes: &[u8]) -> [Vec<u8>; 4] {
    let half = bytes[..bytes.len() / 2].to_vec();
    let blocks = bytes.chunks(512).enumerate();
    let torn = blocks.flat_map(|(i, b)| if i % 2 == 1 { b.to_vec() } else { vec![0; b.len()] });
    [Vec::new(), half, vec![0; bytes.len()], torn.collect()]
}

#[test]
fn f06_a_power_cut_loses_what_was_not_synced() {
    if !has_strace("f06") {
        return;
    }
    let bench = tiny();
    let work = bench.path("a.vmap.build");
    let synced = |name: &str| name == "plan" || name == "journal" || name == "lock";
    let (mut n_states, mut n_lost) = (0, 0);
    // Each kill is at a sync: what it was to make durable is in doubt, and what is without record.
    for i in (1..=60).step_by(if slow().is_some() { 1 } else { 11 }) {
        for cut in 0..4 {
            let run = inject(&bench, &format!("fsync,fdatasync:signal=KILL:when={i}"), EACH);
            assert!([0, 137].contains(&run.code), "{run:?}");
            n_states += 1;
            let journal = std::fs::read(work.join("journal")).unwrap_or_default();
            let n_files = names_in(&work).iter().filter(|n| n.starts_with("links-")).count();
            for name in names_in(&work) {
                // The last file of links may have no record yet; those before it have.
                let is_last = name == format!("links-{:05}", n_files.saturating_sub(1));
                if synced(&name)
                    || name.starts_with("links-") && !name.ends_with(".part") && !is_last
                {
                    continue;
                }
                let bytes = std::fs::read(work.join(&name)).unwrap();
                std::fs::write(work.join(&name), &left_of(&bytes)[cut]).unwrap();
                n_lost += 1;
            }
            // The end of the journal, too: its last record was perhaps not synced.
            if cut > 0 && journal.len() > 48 {
                let (old, new) = journal.split_at(journal.len() - 32);
                let left = [old, &left_of(new)[cut][..]].concat();
                std::fs::write(work.join("journal"), left).unwrap();
            }
            recovers(&bench, &format!("power cut at sync {i}, {cut}"));
        }
    }
    assert!(n_states > 20 && n_lost > 10, "{n_states} {n_lost}");
}

#[test]
fn f07_a_journal_that_grew_without_its_bytes() {
    let bench = tiny();
    for n_zeroes in [1, 7, 8, 512, 4096] {
        killed_after(&bench, 4);
        let journal = bench.path("a.vmap.build/journal");
        let file = std::fs::File::options().write(true).open(&journal).unwrap();
        file.set_len(journal_bytes(&bench) + n_zeroes).unwrap();
        recovers(&bench, &format!("{n_zeroes} zeroes at its end"));
    }
    // Records that are there while what they name is not.
    for name in ["links-00001", "plan"] {
        killed_after(&bench, 4);
        std::fs::remove_file(bench.path("a.vmap.build").join(name)).unwrap();
        recovers(&bench, &format!("{name} is gone"));
        killed_after(&bench, 4);
        std::fs::write(bench.path("a.vmap.build").join(name), "").unwrap();
        let run = bench.line(BUILD).ok().warns(&["a.vmap.build"]);
        assert!(run.stderr.contains("decided again") || run.stderr.contains("anew"));
        absent_or_right(&bench, name);
        std::fs::remove_file(bench.path("a.vmap")).unwrap();
    }
}

#[test]
fn f08_stopped_by_a_signal_it_keeps_what_is_done() {
    let bench = long();
    let make_old = "build a.octree --max-level 1 --leaf-capacity 10";
    bench.line(make_old).ok();
    let old = bench.read("a.vmap");
    let begun = Instant::now();
    bench.line("build a.octree -o whole.vmap").ok();
    let whole = begun.elapsed();
    let mut random = fastrand::Rng::with_seed(8);
    let (mut n_kept, mut before) = (0, 0);
    let n_rounds = rounds(5, 40, 200);
    for i in 0.. {
        // How far it gets in so much time depends on the machine: some have to be caught at work.
        if i >= n_rounds && (n_kept > 1 || i >= n_rounds + 60) {
            break;
        }
        let (signal, code) = [("INT", 130), ("TERM", 143), ("HUP", 129)][i as usize % 3];
        let child = start(&bench, "build a.octree --progress plain");
        // Before that it may not yet listen.
        let least = Duration::from_millis(100);
        std::thread::sleep(least + whole.saturating_sub(least).mul_f64(random.f64()));
        let asked = Instant::now();
        send(&child, signal);
        let run = Run::watch(child, asked);
        if run.code == 0 {
            // It had little left to do; the next begins anew.
            bench.line(make_old).ok();
            before = 0;
            continue;
        }
        let run = run.exits(code);
        assert!(run.elapsed < Duration::from_secs(2), "{:?}", run.elapsed);
        assert!(bench.read("a.vmap") == old);
        assert!(run.stderr.contains("interrupted; "), "{}", run.stderr);
        if let Some((n_done, _)) = kept_of(&run) {
            // What was done stays done.
            assert!(n_done >= before, "{n_done} of {before} tasks: {}", run.stderr);
            assert_eq!(run.stderr.contains("resuming: "), before > 0, "{}", run.stderr);
            (before, n_kept) = (n_done, n_kept + 1);
            let files = names_in(&bench.path("a.vmap.build"));
            assert!(files.contains(&"journal".to_owned()), "{files:?}");
        }
    }
    assert!(n_kept > 1, "nothing was kept");
}

/// Reads how many tasks a stopped run kept, and of how many.
fn kept_of(run: &Run) -> Option<(u64, u64)> {
    let (_, rest) = run.stderr.split_once("interrupted; ")?;
    let mut words = rest.split(' ');
    let n_done = words.next()?.parse().ok()?;
    Some((n_done, words.nth(1)?.parse().ok()?))
}

#[test]
fn f08_a_second_signal_stops_at_once() {
    let bench = long();
    // A quick machine is done sooner.
    for wait_ms in [300, 150, 70, 30, 10] {
        let child = start(&bench, "build a.octree --progress off");
        std::thread::sleep(Duration::from_millis(wait_ms));
        // Stopped, it takes both together.
        for signal in ["STOP", "INT", "INT", "CONT"] {
            send(&child, signal);
        }
        let run = Run::watch(child, Instant::now());
        if run.code != 0 {
            run.exits(130);
            return assert!(!bench.path("a.vmap").exists());
        }
        std::fs::remove_file(bench.path("a.vmap")).unwrap();
    }
    panic!("it was never caught at work");
}

#[test]
fn f10_suspended_for_a_while() {
    let bench = small();
    let child = start(&bench, &format!("{BUILD} --checkpoint 0"));
    wait_for("a commit", || n_link_files(&bench) > 2);
    send(&child, "STOP");
    std::thread::sleep(Duration::from_secs(if slow().is_some() { 5 } else { 1 }));
    send(&child, "CONT");
    Run::watch(child, Instant::now()).ok();
    recovers(&bench, "suspended");
}

#[test]
fn f13_a_deep_tree_on_a_small_stack() {
    let bench = Bench::new();
    // Two clusters of points as close as a grid allows: cells go down to the last level.
    let mut text = cli_common::ply_header(4000, &["x", "y", "z"]);
    for i in 0..4000 {
        let v = f64::from(i % 2000) * 1e-6 + if i < 2000 { 0.0 } else { 1.0 };
        text += &format!("{v} {v} {v}\n");
    }
    bench.write("a.ply", text);
    bench.line("ingest a.ply --normals none").ok();
    let build = "build a.octree --max-level 21 --leaf-capacity 1 --tree paper --progress off";
    bench.line(&format!("{build} -o right.vmap")).ok();
    let mut command = std::process::Command::new("sh");
    let limited = format!("ulimit -s 256; exec {} {build} -o a.vmap", env!("CARGO_BIN_EXE_pvmap"));
    command.current_dir(bench.path("")).args(["-c", &limited]);
    Run::of(command).ok();
    absent_or_right(&bench, "a small stack");
}

#[test]
fn f15_what_differs_is_named() {
    let bench = small();
    killed_after(&bench, 3);
    for (change, words) in [
        ("--max-level 7", ["max_level", "8", "7", "--restart"]),
        ("--profile paper", ["profile", "patch", "paper", "--restart"]),
        ("--tree paper", ["tree", "binned", "paper", "--restart"]),
    ] {
        bench.line(&format!("{BUILD} {change}")).fails(78, &words);
        assert!(n_link_files(&bench) >= 3, "{change}: what is there stays");
    }
    let (work, folder) = (bench.path("a.vmap.build"), tempfile::tempdir().unwrap());
    let kept = folder.path().join("kept");
    copy_folder(&work, &kept);
    let other = bench.line(&format!("{BUILD} --restart --max-level 7")).ok();
    assert!(other.stdout.starts_with("a.vmap\n"));
    assert!(bench.read("a.vmap") != bench.read("right.vmap"));
    assert!(!work.exists());

    // Another scan in the octree's place.
    copy_folder(&kept, &work);
    std::fs::rename(bench.path("a.octree"), bench.path("b.octree")).unwrap();
    bench.line("scene furnished --points 3001 -o b.ply").ok();
    bench.line("ingest b.ply -o a.octree").ok();
    bench.line(BUILD).fails(78, &["octree", "--restart"]);
    // Another version of the program.
    let plan = std::fs::read(kept.join("plan")).unwrap();
    let version = env!("CARGO_PKG_VERSION").as_bytes();
    let at = plan.windows(version.len()).position(|w| w == version).unwrap();
    let mut other = plan.clone();
    other[at] += 1;
    let n = other.len() - 8;
    let sum = xxhash_rust::xxh3::xxh3_64(&other[..n]);
    other[n..].copy_from_slice(&sum.to_le_bytes());
    std::fs::write(work.join("plan"), &other).unwrap();
    let head = xxhash_rust::xxh3::xxh3_64(&other);
    let mut journal = std::fs::read(kept.join("journal")).unwrap();
    journal[8..16].copy_from_slice(&head.to_le_bytes());
    std::fs::write(work.join("journal"), journal).unwrap();
    bench.line(BUILD).fails(78, &["version of pvmap", env!("CARGO_PKG_VERSION")]);
}

#[test]
fn f16_what_a_finished_run_left_is_recognised() {
    let bench = tiny();
    let (work, folder) = (bench.path("a.vmap.build"), tempfile::tempdir().unwrap());
    let kept = folder.path().join("kept");
    if has_strace("f16") {
        // Killed at the first removal after the map got its name.
        let fault = "unlink,unlinkat:signal=KILL:when=1";
        inject(&bench, fault, &format!("{BUILD} --checkpoint 0")).exits(137);
        assert!(bench.read("a.vmap") == bench.read("right.vmap"));
        assert!(work.join("journal").exists());
        copy_folder(&work, &kept);
        // Another configuration is no contradiction: that build is over.
        bench.line(&format!("{BUILD} --max-level 7")).ok();
        assert!(!work.exists());
        std::fs::remove_file(bench.path("a.vmap")).unwrap();
        copy_folder(&kept, &work);
        recovers(&bench, "finished but not removed");
    }
    // Files without a plan, and a folder with nothing, are of no use to anybody.
    std::fs::create_dir(&work).unwrap();
    recovers(&bench, "an empty folder");
    std::fs::create_dir(&work).unwrap();
    for name in ["lock", "links-00003", "links-00004.part", "map.part", "plan.part", "journal"] {
        std::fs::write(work.join(name), "left").unwrap();
    }
    recovers(&bench, "files of no use");
    // What is not a build's is not touched.
    std::fs::create_dir(&work).unwrap();
    std::fs::write(work.join("thesis"), "precious").unwrap();
    for _ in 0..3 {
        bench.line(BUILD).fails(73, &["a.vmap.build", "not of a build"]);
    }
    assert_eq!(names_in(&work), ["thesis"]);
    std::fs::remove_dir_all(&work).unwrap();
    std::fs::write(&work, "a file").unwrap();
    bench.line(BUILD).fails(73, &["a.vmap.build", "no folder"]);
}

#[test]
fn f17_resumed_elsewhere_with_other_threads() {
    let bench = small();
    killed_after(&bench, 4);
    // Another machine: another path, other threads, other memory.
    let other = Bench::new();
    for name in ["a.octree", "a.vmap.build"] {
        copy_folder(&bench.path(name), &other.path(name));
    }
    let line = "build a.octree --leaf-capacity 10 --threads 3 --memory 64MiB --progress plain";
    let run = other.line(line).ok();
    assert!(run.stderr.contains("resuming: "), "{}", run.stderr);
    assert!(other.read("a.vmap") == bench.read("right.vmap"));
    assert_eq!(other.names(), ["a.octree", "a.vmap"]);
}
