//! What the tests of faults share: small scans whose builds have many tasks, runs of the command
//! under tools that break the world around it, and what must hold afterwards.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::{Bench, Run};

/// Builds the map of [`tiny`]'s or [`small`]'s scan.
pub const BUILD: &str = "build a.octree --leaf-capacity 10 --threads 2 --progress off";

/// The same on one thread, with a commit for each task: its calls come in one order.
pub const EACH: &str =
    "build a.octree --leaf-capacity 10 --threads 1 --checkpoint 0 --progress off";

/// Calls that change what is on a disk.
pub const WRITE_LIKE: [&str; 12] = [
    "write",
    "pwrite64",
    "fsync",
    "fdatasync",
    "rename",
    "renameat",
    "renameat2",
    "unlink",
    "unlinkat",
    "rmdir",
    "mkdir",
    "ftruncate",
];

/// How much of a slow test is asked for: nothing, what a night has time for, or all.
pub fn slow() -> Option<bool> {
    std::env::var("PVMAP_SLOW_TESTS").ok().map(|value| value == "all")
}

/// A folder with `a.octree`, of a room of so many points, and `right.vmap`.
fn octree_of(n_points: u32) -> Bench {
    let bench = Bench::new();
    bench.line(&format!("scene furnished --points {n_points} -o a.ply")).ok();
    bench.line("ingest a.ply").ok();
    bench.line(&format!("{BUILD} -o right.vmap")).ok();
    bench
}

/// A build of some twenty tasks, whose calls can be tried one by one.
pub fn tiny() -> Bench {
    octree_of(300)
}

/// A build of some hundreds of tasks.
pub fn small() -> Bench {
    octree_of(3_000)
}

/// A build that takes about a second or more: in a cave nearly every pair is looked at.
pub fn long() -> Bench {
    let bench = Bench::new();
    bench.line("scene cave --points 50k -o a.ply").ok();
    bench.line("ingest a.ply").ok();
    bench
}

/// Demands that nothing of the map is there, or all of it.
#[track_caller]
pub fn absent_or_right(bench: &Bench, context: &str) {
    if bench.path("a.vmap").exists() {
        assert!(bench.read("a.vmap") == bench.read("right.vmap"), "a wrong map: {context}");
    }
}

/// Demands that the map is not wrong now, that the same command finishes it, and that nothing else
/// is left then; the map is removed.
#[track_caller]
pub fn recovers(bench: &Bench, context: &str) {
    absent_or_right(bench, context);
    let run = bench.line(BUILD);
    assert_eq!(run.code, 0, "{context}: {}", run.stderr);
    assert!(bench.read("a.vmap") == bench.read("right.vmap"), "not the same bytes: {context}");
    assert_eq!(bench.names(), ["a.octree", "a.ply", "a.vmap", "right.vmap"], "{context}");
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
}

/// Says aloud that a test is skipped for want of something.
pub fn skipped(test: &str, want: &str) {
    eprintln!("skipped: {test}: {want}");
}

/// Says whether a tool does its work here, and aloud where it does not.
pub fn has(test: &str, tool: &[&str]) -> bool {
    let mut command = Command::new(tool[0]);
    command.args(&tool[1..]).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let works = command.status().is_ok_and(|s| s.success());
    if !works {
        skipped(test, &format!("{} does not work here", tool.join(" ")));
    }
    works
}

pub fn has_strace(test: &str) -> bool {
    has(test, &["strace", "-f", "-e", "inject=getppid:error=EIO", "true"])
}

/// Prepares a run of the command behind another, which gets these words.
pub fn behind(bench: &Bench, tool: &[&str], line: &str) -> Command {
    let mut command = Command::new(tool[0]);
    command.args(&tool[1..]).arg(env!("CARGO_BIN_EXE_pvmap")).args(line.split_whitespace());
    command.current_dir(bench.path("")).stdin(Stdio::null());
    command
}

/// Runs the command with faults in its system calls, several between spaces:
/// `write:error=EIO:when=3`.
pub fn inject(bench: &Bench, faults: &str, line: &str) -> Run {
    let names: Vec<&str> = faults.split(' ').map(|f| f.split(':').next().unwrap()).collect();
    let mut tool = vec!["strace", "-f", "-qq", "-o", "/dev/null", "-e"];
    let trace = format!("trace={}", names.join(","));
    let injected: Vec<String> = faults.split(' ').map(|f| format!("inject={f}")).collect();
    tool.push(&trace);
    injected.iter().for_each(|fault| tool.extend(["-e", fault]));
    Run::of(behind(bench, &tool, line))
}

/// Runs a script in a small file system of its own, named `m`, that is gone afterwards. `PVMAP` is
/// the command.
pub fn in_tmpfs(bench: &Bench, options: &str, script: &str) -> Run {
    std::fs::create_dir_all(bench.path("m")).unwrap();
    let script = format!("mount -t tmpfs -o {options} none m && {script}");
    let mut command = Command::new("unshare");
    command.args(unshare()).args(["sh", "-c", &script]).stdin(Stdio::null());
    command.current_dir(bench.path("")).env("PVMAP", env!("CARGO_BIN_EXE_pvmap"));
    let run = Run::of(command);
    std::fs::remove_dir(bench.path("m")).unwrap();
    run
}

/// Says whether file systems can be mounted here.
pub fn has_tmpfs(test: &str) -> bool {
    let mut tool = vec!["unshare"];
    tool.extend(unshare());
    tool.extend(["sh", "-c", "mount -t tmpfs none /tmp"]);
    has(test, &tool)
}

/// Roots mount in a namespace of their own; others become root in one of theirs.
fn unshare() -> &'static [&'static str] {
    if is_root() { &["-m"] } else { &["-Urm"] }
}

pub fn is_root() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("Uid:"));
    line.is_some_and(|l| l.split_whitespace().nth(1) == Some("0"))
}

/// Counts the calls of a run that write: by name, most in a thread, as strace counts them.
pub fn calls(bench: &Bench, line: &str) -> BTreeMap<String, u32> {
    let trace = format!("trace={}", WRITE_LIKE.join(","));
    let log = tempfile::NamedTempFile::new().unwrap();
    let name = log.path().display().to_string();
    Run::of(behind(bench, &["strace", "-f", "-qq", "-o", &name, "-e", &trace], line)).ok();
    let mut counts: BTreeMap<(String, String), u32> = BTreeMap::new();
    for line in std::fs::read_to_string(log.path()).unwrap().lines() {
        let Some((thread, call)) = line.split_once(' ') else { continue };
        if let Some((name, _)) = call.trim_start().split_once('(')
            && WRITE_LIKE.contains(&name)
        {
            *counts.entry((thread.to_owned(), name.to_owned())).or_default() += 1;
        }
    }
    let mut most = BTreeMap::new();
    for ((_, name), n) in counts {
        let entry = most.entry(name).or_insert(0);
        *entry = n.max(*entry);
    }
    most
}

/// Starts a build in the background.
pub fn start(bench: &Bench, line: &str) -> Child {
    let mut command = bench.stoppable(line.split_whitespace());
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Sends a signal.
pub fn send(child: &Child, signal: &str) {
    let kill = format!("kill -{signal} {}", child.id());
    assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success());
}

/// Kills a process and waits for its end.
pub fn kill(mut child: Child) -> Run {
    child.kill().unwrap();
    Run::watch(child, Instant::now())
}

/// Waits until something is so, or half a minute.
#[track_caller]
pub fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    let started = Instant::now();
    while !is_so() {
        assert!(started.elapsed() < Duration::from_secs(30), "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Counts the files of links in the work folder.
pub fn n_link_files(bench: &Bench) -> usize {
    names_in(&bench.path("a.vmap.build")).iter().filter(|n| n.starts_with("links-")).count()
}

/// Lists a folder, sorted; nothing where there is none.
pub fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> =
        entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Gives the length of the journal; 0 where there is none.
pub fn journal_bytes(bench: &Bench) -> u64 {
    std::fs::metadata(bench.path("a.vmap.build/journal")).map_or(0, |m| m.len())
}

/// Leaves a build that was killed when it had committed about so many files of links.
pub fn killed_after(bench: &Bench, n_files: usize) {
    let child = start(bench, &format!("{BUILD} --checkpoint 0"));
    wait_for("files of links", || n_link_files(bench) >= n_files);
    kill(child).exits(137);
    assert!(bench.path("a.vmap.build").is_dir());
}

/// Copies a folder of files, in place of what was there.
pub fn copy_folder(from: &Path, to: &Path) {
    // Where there was nothing there is nothing to remove.
    let _ = std::fs::remove_dir_all(to);
    std::fs::create_dir_all(to).unwrap();
    for name in names_in(from) {
        std::fs::copy(from.join(&name), to.join(&name)).unwrap();
    }
}
