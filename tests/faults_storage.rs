//! What a build does when the disk breaks: rows F18-F35 of the catalogue of faults. Each run ends
//! with its exit code and leaves no wrong map; the same command finishes it when all is well.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use std::process::Command;
use std::time::Instant;

use cli_common::faults::{
    BUILD, EACH, absent_or_right, behind, calls, has, has_strace, has_tmpfs, in_tmpfs, inject,
    is_root, n_link_files, recovers, skipped, slow, small, start, tiny, wait_for,
};
use cli_common::{Bench, Run, room, room_ply};

/// Every so many places a fault is tried at: all of them at night.
fn stride(few: usize) -> usize {
    if slow().is_some() { 1 } else { few }
}

/// Builds in a file system with these options, then again with room enough; gives the first code.
fn build_in(bench: &Bench, options: &str) -> i32 {
    let script = format!(
        "$PVMAP {EACH} -o m/a.vmap; code=$?; ls m; echo; \
         if test -f m/a.vmap; then cmp m/a.vmap right.vmap || exit 99; fi; \
         mount -o remount,size=64m,nr_inodes=10000 m && $PVMAP {EACH} -o m/a.vmap || exit 98; \
         cmp m/a.vmap right.vmap || exit 97; test \"$(ls m)\" = a.vmap || exit 96; exit $code"
    );
    let run = in_tmpfs(bench, options, &script);
    let (_, line) = run.stderr.split_once("pvmap: ").unwrap_or_default();
    if run.code == 74 {
        assert!(line.contains("no space left") || line.contains("MiB of disk"), "{}", run.stderr);
        assert!(line.contains("free some"), "{}", run.stderr);
    }
    assert!([0, 74].contains(&run.code), "{options}: {run:?}");
    run.code
}

#[test]
fn f18_a_disk_that_is_full_at_any_point() {
    if !has_tmpfs("f18") {
        return;
    }
    let bench = small();
    let mut codes = Vec::new();
    for kib in (64..=4096).step_by(64 * stride(9)) {
        codes.push(build_in(&bench, &format!("size={kib}k")));
    }
    assert!(codes.contains(&74) && codes.contains(&0), "{codes:?}");
    assert!(codes.is_sorted_by(|a, b| a >= b), "{codes:?}");
}

#[test]
fn f18_no_space_at_every_write() {
    if !has_strace("f18") {
        return;
    }
    let bench = tiny();
    let calls = calls(&bench, EACH);
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
    let mut n_full = 0;
    for name in ["write", "pwrite64"] {
        for i in (1..=calls[name]).step_by(stride(13)) {
            let fault = format!("{name}:error=ENOSPC:when={i}");
            let run = inject(&bench, &fault, EACH);
            assert!([0, 74].contains(&run.code), "{fault}: {run:?}");
            n_full += u32::from(run.code == 74);
            recovers(&bench, &fault);
        }
    }
    assert!(n_full > 2);
}

#[test]
fn f19_a_disk_without_inodes() {
    if !has_tmpfs("f19") {
        return;
    }
    let bench = tiny();
    let codes: Vec<i32> =
        (2..14).map(|n| build_in(&bench, &format!("size=64m,nr_inodes={n}"))).collect();
    assert!(codes.contains(&74), "{codes:?}");
}

#[test]
fn f20_no_space_only_when_it_is_synced() {
    if !has_strace("f20") {
        return;
    }
    let bench = tiny();
    let calls = calls(&bench, EACH);
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
    for (name, error) in [("fsync", "ENOSPC"), ("fsync", "EDQUOT"), ("fdatasync", "ENOSPC")] {
        let mut n_full = 0;
        for i in (1..=calls[name]).step_by(stride(9)) {
            // From then on: what is tried again fails again.
            let fault = format!("{name}:error={error}:when={i}+");
            let run = inject(&bench, &fault, EACH);
            run.fails(74, &["no space left"]);
            n_full += 1;
            recovers(&bench, &fault);
        }
        assert!(n_full > 1, "{name}");
    }
}

#[test]
fn f21_a_disk_that_cannot_hold_the_tree() {
    if !has_tmpfs("f21") {
        return;
    }
    let bench = small();
    let script = format!("$PVMAP {EACH} -o m/a.vmap; code=$?; ls m; exit $code");
    let run = in_tmpfs(&bench, "size=32k", &script);
    assert_eq!(run.stdout, "", "nothing is begun");
    run.fails(74, &["MiB of disk", "are left"]);
}

#[test]
fn f22_a_scan_that_cannot_be_read() {
    if !has_strace("f22") {
        return;
    }
    let bench = Bench::new();
    bench.line("scene furnished --points 20000 -o b.las").ok();
    let mut n_failed = 0;
    for name in ["pread64", "read"] {
        for i in 1..8 {
            // Of the reads at the start some are of libraries: there it does not come up.
            let run = inject(
                &bench,
                &format!("{name}:error=EIO:when={i}"),
                "ingest b.las --overwrite --progress off",
            );
            if run.stderr.contains("b.las") {
                n_failed += 1;
                run.fails(74, &["b.las", "os error 5"]);
            }
        }
    }
    assert!(n_failed > 1);
}

#[test]
fn f23_an_error_at_every_write() {
    if !has_strace("f23") {
        return;
    }
    let bench = tiny();
    let calls = calls(&bench, EACH);
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
    let mut n_failed = 0;
    for name in ["write", "pwrite64", "ftruncate", "mkdir", "rename"] {
        for i in (1..=calls.get(name).copied().unwrap_or(0)).step_by(stride(11)) {
            let fault = format!("{name}:error=EIO:when={i}");
            let run = inject(&bench, &fault, EACH);
            // One that was to be the answer on standard output, or that started a lock.
            assert!([0, 73, 74].contains(&run.code), "{fault}: {run:?}");
            n_failed += u32::from(run.code != 0);
            recovers(&bench, &fault);
        }
    }
    assert!(n_failed > 4);
}

#[test]
fn f24_a_sync_that_fails_once() {
    if !has_strace("f24") {
        return;
    }
    let bench = tiny();
    let mut codes = Vec::new();
    for i in 1..=10 {
        let fault = format!("fsync:error=EIO:when={i}");
        let run = inject(&bench, &fault, EACH);
        assert!([0, 74].contains(&run.code), "{fault}: {run:?}");
        codes.push(run.code);
        recovers(&bench, &fault);
    }
    // Files are written anew; folders and the map itself are not.
    assert!(codes.contains(&0) && codes.contains(&74), "{codes:?}");
    // Twice in a row is the end of it.
    for i in 1..=10 {
        let fault = format!("fsync:error=EIO:when={i}+");
        inject(&bench, &fault, EACH).fails(74, &["os error 5"]);
        recovers(&bench, &fault);
    }
}

#[test]
fn f25_calls_that_are_interrupted() {
    if !has_strace("f25") {
        return;
    }
    let bench = tiny();
    // The first reads of a program are those of its libraries, by a loader that knows no EINTR.
    for (calls, first) in [
        ("write", 2),
        ("pwrite64", 2),
        ("read,pread64", 12),
        ("fsync,fdatasync", 2),
        ("openat", 12),
    ] {
        let fault = format!("{calls}:error=EINTR:when={first}+3");
        inject(&bench, &fault, EACH).ok();
        absent_or_right(&bench, &fault);
        std::fs::remove_file(bench.path("a.vmap")).unwrap();
    }
}

/// A library that lets every call read or write at most 7 bytes of what it was asked for.
const SHORT: &str = "
#define _GNU_SOURCE
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>
static size_t most(size_t n) { static size_t i; i++; return n < 1 + i % 7 ? n : 1 + i % 7; }
ssize_t write(int f, const void *b, size_t n) { return syscall(SYS_write, f, b, most(n)); }
ssize_t read(int f, void *b, size_t n) { return syscall(SYS_read, f, b, most(n)); }
ssize_t pwrite64(int f, const void *b, size_t n, off_t o)
{ return syscall(SYS_pwrite64, f, b, most(n), o); }
ssize_t pread64(int f, void *b, size_t n, off_t o)
{ return syscall(SYS_pread64, f, b, most(n), o); }
";

#[test]
fn f25_short_reads_and_writes() {
    let bench = Bench::new();
    bench.write("short.c", SHORT);
    let mut compile = Command::new("cc");
    compile.current_dir(bench.path("")).args(["-shared", "-fPIC", "-o", "short.so", "short.c"]);
    if !compile.status().is_ok_and(|s| s.success()) {
        return skipped("f25", "no C compiler");
    }
    let library = bench.path("short.so");
    bench.write("a.ply", room_ply(20));
    let build = "build a.octree --leaf-capacity 10 --checkpoint 0 --progress off";
    for (folder, is_short) in [("plain", false), ("short", true)] {
        std::fs::create_dir(bench.path(folder)).unwrap();
        std::fs::copy(bench.path("a.ply"), bench.path(folder).join("a.ply")).unwrap();
        for line in ["ingest a.ply", build] {
            let mut command = bench.command(line.split_whitespace());
            command.current_dir(bench.path(folder));
            if is_short {
                command.env("LD_PRELOAD", &library);
            }
            Run::of(command).ok();
        }
    }
    assert!(bench.read("plain/a.vmap") == bench.read("short/a.vmap"));
    let points = pvmap::vmap::octree::FILE_NAME;
    let octree = |folder: &str| bench.read(format!("{folder}/a.octree/{points}"));
    assert!(octree("plain") == octree("short"));
}

#[test]
fn f26_writes_that_are_not_done() {
    if !has_strace("f26") {
        return;
    }
    let bench = tiny();
    let calls = calls(&bench, EACH);
    std::fs::remove_file(bench.path("a.vmap")).unwrap();
    let mut codes = Vec::new();
    for name in ["write", "pwrite64"] {
        for i in (1..=calls[name]).step_by(stride(7)) {
            // The first byte is said to be written and is not.
            let lie = format!("{name}:retval=1:when={i}");
            let run = inject(&bench, &lie, EACH);
            assert!([0, 74].contains(&run.code), "{lie}: {run:?}");
            codes.push(run.code);
            recovers(&bench, &lie);
            // And the run is killed, so that the next has to notice.
            let killed = format!("{lie} fdatasync:signal=KILL:when=9");
            inject(&bench, &killed, EACH);
            recovers(&bench, &killed);
        }
    }
    assert!(codes.contains(&74), "{codes:?}");
}

#[test]
fn f27_files_that_may_not_grow() {
    if !has("f27", &["prlimit", "--fsize=1000", "true"]) {
        return;
    }
    let bench = small();
    let whole = bench.read("right.vmap").len();
    let mut codes = Vec::new();
    for n_bytes in (0..whole + 8192).step_by(4096 * stride(3)) {
        let tool = ["prlimit", &format!("--fsize={n_bytes}")];
        let run = Run::of(behind(&bench, &tool, BUILD));
        assert!([0, 74].contains(&run.code), "{n_bytes}: {run:?}");
        codes.push(run.code);
        recovers(&bench, &format!("files of at most {n_bytes} bytes"));
    }
    assert!(codes.is_sorted_by(|a, b| a >= b) && codes.contains(&74), "{codes:?}");
}

#[test]
fn f28_few_files_may_be_open() {
    if !has("f28", &["prlimit", "--nofile=64", "true"]) {
        return;
    }
    let bench = small();
    for n_files in [4, 6, 8, 10, 12, 16, 32, 64] {
        let tool = ["prlimit", &format!("--nofile={n_files}")];
        let run = Run::of(behind(&bench, &tool, &format!("{BUILD} --checkpoint 0")));
        let is_enough = n_files >= 32;
        assert!(run.code == 0 || !is_enough, "{n_files}: {run:?}");
        // Less than a program needs to be started at all.
        assert!([0, 70, 74, 127].contains(&run.code), "{n_files}: {run:?}");
        recovers(&bench, &format!("{n_files} files"));
    }
}

#[test]
fn f29_a_folder_that_cannot_be_written() {
    let bench = tiny();
    bench.line(&format!("{BUILD} -o none/a.vmap")).fails(73, &["none/a.vmap", "does not exist"]);
    bench.line(&format!("{BUILD} -o a.ply/a.vmap")).fails(73, &["a.ply/a.vmap"]);
    std::fs::create_dir(bench.path("closed")).unwrap();
    let line = format!("{BUILD} -o closed/a.vmap");
    if has("f29", &["chattr", "-V", "-i", &bench.path("closed").display().to_string()]) && is_root()
    {
        let chattr =
            |flag: &str| Command::new("chattr").arg(flag).arg(bench.path("closed")).status();
        assert!(chattr("+i").unwrap().success());
        let run = bench.line(&line);
        assert!(chattr("-i").unwrap().success());
        run.fails(77, &["closed/a.vmap", "permission"]);
    }
    if has_tmpfs("f29") {
        let run = in_tmpfs(
            &bench,
            "size=1m",
            &format!("mount -o remount,ro m; $PVMAP {BUILD} -o m/a.vmap"),
        );
        run.fails(73, &["m/a.vmap", "read-only"]);
    }
    assert_eq!(std::fs::read_dir(bench.path("closed")).unwrap().count(), 0);
}

#[test]
fn f18_a_commit_that_fails_is_not_taken_up_by_another_thread() {
    if !has_strace("f18") {
        return;
    }
    let bench = small();
    let line = EACH.replace("--threads 1", "--threads 3");
    let step = if slow().is_some() { 1 } else { 9 };
    let (mut n_failed, mut n_kept) = (0, 0);
    // Writes and syncs of links and of the journal: strace counts them for each thread.
    for when in (3..90).step_by(step) {
        for call in ["write", "fdatasync"] {
            let run = inject(&bench, &format!("{call}:error=ENOSPC:when={when}"), &line);
            let context = format!("{call} {when}");
            assert!(matches!(run.code, 0 | 74), "{context}: {} {}", run.code, run.stderr);
            n_failed += usize::from(run.code == 74);
            n_kept += usize::from(bench.path("a.vmap.build/journal").exists());
            recovers(&bench, &context);
        }
    }
    assert!(n_failed > 0 && n_kept > 0, "{n_failed} failed, {n_kept} left a journal");
}

#[test]
fn f30_the_name_cannot_be_given_at_the_end() {
    if !has_strace("f30") {
        return;
    }
    let bench = tiny();
    bench.write("old", bench.read("right.vmap"));
    for error in ["EACCES", "EROFS", "ENOSPC", "EIO"] {
        let fault = format!("renameat,renameat2:error={error}");
        inject(&bench, &fault, EACH).fails(74, &["a.vmap", "rename"]);
        let rerun = bench.line(&BUILD.replace("--progress off", "--progress plain")).ok();
        assert!(rerun.stderr.contains("resuming: "), "{fault}: {}", rerun.stderr);
        std::fs::remove_file(bench.path("a.vmap")).unwrap();
        inject(&bench, &fault, EACH).fails(74, &["a.vmap", "rename"]);
        std::fs::rename(bench.path("old"), bench.path("a.octree/old")).unwrap();
        recovers(&bench, &fault);
        std::fs::rename(bench.path("a.octree/old"), bench.path("old")).unwrap();
    }
}

#[test]
fn f31_a_work_folder_on_another_disk() {
    if !has_tmpfs("f31") {
        return;
    }
    let bench = tiny();
    let script = format!(
        "mkdir m/out m/out/a.vmap.build && mount -t tmpfs none m/out/a.vmap.build && \
         $PVMAP {BUILD} -o m/out/a.vmap"
    );
    in_tmpfs(&bench, "size=1m", &script).fails(73, &["a.vmap.build", "another disk"]);
}

#[test]
fn f34_a_disk_without_locks() {
    if !has_strace("f34") {
        return;
    }
    let bench = tiny();
    let lockless = |error: &str| format!("flock:error={error}");
    for error in ["ENOLCK", "EOPNOTSUPP", "ENOSYS"] {
        inject(&bench, &lockless(error), EACH).ok();
        recovers(&bench, error);
    }
    // The lock is a file then, which a second builder meets, and which outlives kill -9.
    let killed = format!("{} fdatasync:signal=KILL:when=4", lockless("ENOLCK"));
    inject(&bench, &killed, EACH).exits(137);
    let lock = bench.path("a.vmap.build/lock.exclusive");
    assert!(lock.exists());
    let run = inject(&bench, &lockless("ENOLCK"), EACH);
    run.fails(75, &["locked by process", "since", "if no such process runs, remove"]);
    std::fs::remove_file(lock).unwrap();
    inject(&bench, &lockless("ENOLCK"), EACH).ok();
    recovers(&bench, "without locks");
}

#[test]
fn f35_the_work_folder_is_removed_meanwhile() {
    let bench = small();
    let child = start(&bench, &format!("{BUILD} --checkpoint 0"));
    wait_for("commits", || n_link_files(&bench) > 3);
    let work = bench.path("a.vmap.build");
    while work.exists() {
        // It fails as long as new files appear in it.
        let _ = std::fs::remove_dir_all(&work);
    }
    Run::watch(child, Instant::now()).fails(74, &["a.vmap.build"]);
    recovers(&bench, "the folder was removed");
    // The octree may go, too: it is open.
    let bench = room();
    let old = bench.read("room.vmap");
    bench.line("build --checkpoint 0").ok();
    assert!(bench.read("room.vmap") == old);
}
