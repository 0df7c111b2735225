//! What a build does when its process is ill-treated: rows F11, F12, F51 and F70-F72 of the
//! catalogue of faults. Kills and signals are in `resume.rs`.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use cli_common::faults::{
    BUILD, absent_or_right, behind, copy_folder, has, kill, killed_after, long, n_link_files,
    recovers, skipped, slow, small, start, tiny, wait_for,
};
use cli_common::{Bench, Run};
use pvmap::{BuildConfig, Checkpoints, Error, Limits, Quiet, StoreError, Watch};

/// A memory control group of this test; gone with it.
struct Group(PathBuf);

impl Group {
    fn new(limit_bytes: u64) -> std::io::Result<Group> {
        let name = format!("/sys/fs/cgroup/memory/pvmap-{}-{limit_bytes}", std::process::id());
        let group = Group(PathBuf::from(name));
        std::fs::create_dir(&group.0)?;
        std::fs::write(group.0.join("memory.limit_in_bytes"), limit_bytes.to_string())?;
        Ok(group)
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir(&self.0);
    }
}

#[test]
fn f11_killed_for_want_of_memory() {
    let bench = long();
    let line = "build a.octree --max-level 4 --progress off";
    bench.line(&format!("{line} -o right.vmap")).ok();
    for mib in [64, 32, 16, 12, 8, 6, 4] {
        let group = match Group::new(mib << 20) {
            Ok(group) => group,
            Err(e) => return skipped("f11", &format!("no memory control groups: {e}")),
        };
        let script = format!(
            "echo $$ > {}/cgroup.procs && exec {} {line} --checkpoint 0",
            group.0.display(),
            env!("CARGO_BIN_EXE_pvmap")
        );
        let mut command = Command::new("sh");
        command.current_dir(bench.path("")).args(["-c", &script]);
        let run = Run::of(command);
        absent_or_right(&bench, &format!("{mib} MiB"));
        if run.code == 137 {
            bench.line(line).ok();
            return absent_or_right(&bench, "with more memory");
        }
        run.ok();
    }
    skipped("f11", "4 MiB were enough");
}

/// Panics when so many tasks are told of, as a bug in one would.
struct Panicking {
    n_left: AtomicU64,
    n_after: AtomicU64,
}

impl Watch for Panicking {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}
    fn advance(&self, _n: u64) {}
    fn warn(&self, _message: &str) {}
    fn is_stopped(&self) -> bool {
        false
    }
    fn tasks(&self, _n_done: u64, _n_total: u64, _n_links: u64) {
        match self.n_left.load(Ordering::Relaxed) {
            0 => self.n_after.fetch_add(1, Ordering::Relaxed),
            _ => self.n_left.fetch_sub(1, Ordering::Relaxed),
        };
        assert!(self.n_left.load(Ordering::Relaxed) > 0, "a task went wrong");
    }
}

/// Hears what is said of a build that goes on.
#[derive(Default)]
struct Listening(std::sync::Mutex<Vec<String>>);

impl Watch for Listening {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}
    fn advance(&self, _n: u64) {}
    fn warn(&self, message: &str) {
        panic!("{message}");
    }
    fn is_stopped(&self) -> bool {
        false
    }
    fn note(&self, message: &str) {
        self.0.lock().unwrap().push(message.to_owned());
    }
}

#[test]
fn f12_a_panic_in_a_task() {
    let bench = small();
    let [octree, map] = ["a.octree", "a.vmap"].map(|name| bench.path(name));
    let limits = Limits { threads: 2, memory_bytes: 1 << 30 };
    let config = BuildConfig { leaf_capacity: 10, ..BuildConfig::default() };
    let watch = Panicking { n_left: AtomicU64::new(200), n_after: AtomicU64::new(0) };
    let failed = pvmap::build(&octree, &map, &config, &limits, &watch).unwrap_err();
    assert_eq!(failed.exit_code(), 70);
    assert!(failed.to_string().contains("a task went wrong"), "{failed}");
    // The other thread may have been at a task; it began no other.
    let n_after = watch.n_after.load(Ordering::Relaxed);
    assert!(n_after <= 4, "{n_after} tasks after the panic");
    assert!(!map.exists() && bench.path("a.vmap.build/journal").exists());
    let heard = Listening::default();
    let built = pvmap::build(&octree, &map, &config, &limits, &heard).unwrap();
    let heard = heard.0.into_inner().unwrap();
    let report = &built.report;
    let said = format!("resuming: {} of {} tasks are done", report.n_tasks_resumed, report.n_tasks);
    assert_eq!(heard, [said]);
    assert!(report.n_tasks_resumed >= 190 && report.n_tasks > 400, "{report:?}");
    absent_or_right(&bench, "after a panic");
}

/// Asks to stop after so many tasks.
struct Stopping(AtomicU64);

impl Watch for Stopping {
    fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}
    fn advance(&self, _n: u64) {}
    fn warn(&self, message: &str) {
        panic!("{message}");
    }
    fn is_stopped(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
    fn tasks(&self, _n_done: u64, _n_total: u64, _n_links: u64) {
        let less = |n: u64| Some(n.saturating_sub(1));
        let _ = self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less);
    }
}

#[test]
fn d8_d9_stopped_after_any_number_of_tasks() {
    let bench = tiny();
    let [octree, map] = ["a.octree", "a.vmap"].map(|name| bench.path(name));
    let config = BuildConfig { leaf_capacity: 10, ..BuildConfig::default() };
    let right = bench.read("right.vmap");
    for every in [Duration::ZERO, Duration::from_secs(10), Duration::MAX] {
        let checkpoints = Checkpoints { every, restart: false };
        for n_tasks in 1..20 {
            // A few tasks in each run, on one thread or several, until it is done.
            let mut n_runs = 0;
            loop {
                n_runs += 1;
                let limits = Limits { threads: 1 + n_runs % 3, memory_bytes: 64 << 20 };
                let watch = Stopping(AtomicU64::new(n_tasks + 1));
                match pvmap::build_with(&octree, &map, &config, &limits, &checkpoints, &watch) {
                    Ok(_) => break,
                    Err(e) => assert_eq!(e.exit_code(), 130, "{e}"),
                }
                assert!(n_runs < 200, "{n_tasks} tasks a run do not end");
            }
            assert!(std::fs::read(&map).unwrap() == right, "{n_tasks} tasks a run");
            std::fs::remove_file(&map).unwrap();
        }
    }
    // Nothing is kept where nothing was done.
    let nothing = Stopping(AtomicU64::new(0));
    let limits = Limits { threads: 2, memory_bytes: 64 << 20 };
    let stopped = pvmap::build(&octree, &map, &config, &limits, &nothing).unwrap_err();
    assert_eq!(stopped.exit_code(), 130);
    assert!(!bench.path("a.vmap.build").exists());
}

#[test]
fn f51_less_memory_than_the_tasks_need() {
    let bench = Bench::new();
    bench.line("scene furnished --points 200k -o a.ply").ok();
    bench.line("ingest a.ply").ok();
    let line = "build a.octree --leaf-capacity 10 --progress off";
    let child = start(&bench, &format!("{line} --threads 2 --checkpoint 0"));
    wait_for("a commit", || n_link_files(&bench) > 0);
    kill(child).exits(137);
    // The buffers of so many threads do not hold what these tasks may find.
    let words = ["the tasks of the build to go on with", "at least", "MiB; give it more"];
    let run = bench.line(&format!("{line} --threads 24 --memory 64MiB")).fails(78, &words);
    let least: u64 =
        run.stderr.split("at least ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!(n_link_files(&bench) > 0, "what is there stays");
    let started = start(&bench, &format!("{line} --threads 24 --memory {}MiB", 2 * least + 64));
    wait_for("commits", || n_link_files(&bench) > 0);
    std::thread::sleep(Duration::from_millis(300));
    assert!([0, 137].contains(&kill(started).code));
    // Nor can a tree be built in less than it takes.
    let config = BuildConfig { leaf_capacity: 1, ..BuildConfig::default() };
    let limits = Limits { threads: 2, memory_bytes: 1 << 20 };
    let [octree, map] = [bench.path("a.octree"), bench.path("b.vmap")];
    let refused = pvmap::build(&octree, &map, &config, &limits, &Quiet).unwrap_err();
    assert_eq!(refused.exit_code(), 78);
    assert!(refused.to_string().contains("at least"), "{refused}");
    assert!(!bench.path("b.vmap.build").exists());
}

#[test]
fn f70_no_clock_decides_bytes() {
    let bench = tiny();
    for (zone, checkpoint) in [("UTC", 0), ("Asia/Kolkata", 1), ("no/where", 4_000_000_000u32)] {
        let mut command = bench.command(BUILD.split_whitespace());
        command.args(["--checkpoint", &checkpoint.to_string()]).env("TZ", zone);
        Run::of(command).ok();
        recovers(&bench, zone);
    }
    // A clock that has jumped: the plan and the journal hold no times, and files of the year 1970
    // or 2106 are as good as others.
    killed_after(&bench, 3);
    for name in ["plan", "journal", "lock", "links-00000"] {
        let path = bench.path("a.vmap.build").join(name);
        let file = std::fs::File::options().write(true).open(path).unwrap();
        let time = if name == "plan" { 0 } else { 4_294_967_296 };
        file.set_modified(std::time::UNIX_EPOCH + Duration::from_secs(time)).unwrap();
    }
    recovers(&bench, "times of files");
}

#[test]
fn f71_no_environment_and_closed_handles() {
    let bench = tiny();
    let mut command = bench.command(BUILD.split_whitespace());
    command.env_clear();
    Run::of(command).ok();
    recovers(&bench, "no environment");
    let mut command = bench.command(BUILD.split_whitespace());
    command.env("TMPDIR", "/nowhere").env("LANG", "xx_YY.nothing").env_remove("HOME");
    Run::of(command).ok();
    recovers(&bench, "a strange environment");
    let mut command = Command::new("sh");
    let closed =
        format!("exec {} {BUILD} --checkpoint 0 <&- >&- 2>&-", env!("CARGO_BIN_EXE_pvmap"));
    command.current_dir(bench.path("")).args(["-c", &closed]);
    Run::of(command).ok();
    recovers(&bench, "closed handles");
}

#[test]
fn f72_memory_that_is_not_given() {
    if !has("f72", &["prlimit", "--data=100000000", "true"]) {
        return;
    }
    let bench = small();
    killed_after(&bench, 5);
    let kept = bench.path("a.octree/kept");
    copy_folder(&bench.path("a.vmap.build"), &kept);
    let mut codes = std::collections::BTreeMap::new();
    let steps: u64 = if slow().is_some() { 200 } else { 24 };
    for step in 1..=steps {
        // From too little to begin with to enough.
        let n_bytes = (256 << 10) + step * (12 << 20) / steps;
        copy_folder(&kept, &bench.path("a.vmap.build"));
        let tool = ["prlimit", &format!("--data={n_bytes}")];
        let run = Run::of(behind(&bench, &tool, BUILD));
        // Below what the dynamic linker needs there is no pvmap yet.
        assert!([0, 70, 74, 127, 139].contains(&run.code), "{n_bytes}: {run:?}");
        *codes.entry(run.code).or_insert(0) += 1;
        recovers(&bench, &format!("{n_bytes} bytes of memory"));
    }
    eprintln!("exit codes: {codes:?}");
    assert!(codes.contains_key(&70) || codes.contains_key(&74), "{codes:?}");
}

#[test]
fn errors_of_a_build_have_their_codes() {
    let locked = StoreError::Locked { path: "a.vmap".into(), holder: "process 1".to_owned() };
    assert_eq!(Error::from(locked).exit_code(), 75);
    let damaged = StoreError::Damaged { path: "a.vmap.build/links-00001".into() };
    assert_eq!(Error::from(damaged).exit_code(), 74);
}
