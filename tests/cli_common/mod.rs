//! What the tests of the command share: a working folder, runs of `pvmap` in it that are watched
//! from outside, and small scans.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

pub mod faults;

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use pvmap::geometry::{PointBatch, Positions};
use pvmap::scan::{LasOptions, LasWriter, MeshWriter};
use pvmap::vmap::{MapView, OctreeView};
use tempfile::TempDir;

pub const MIB: u64 = 1 << 20;

/// What [D-9] allows beside `--memory`: 16 MiB, and 2 MiB a thread.
pub const fn allowed_bytes(memory_bytes: u64, n_threads: u64) -> u64 {
    memory_bytes + 16 * MIB + n_threads * 2 * MIB
}

/// Two threads on every machine, so that what [D-9] allows is known.
pub const TWO_THREADS: [&str; 2] = ["--threads", "2"];

/// The folder of real files, or none (said aloud) where it is absent.
pub fn data(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(folder);
    if path.is_dir() {
        // The command runs in another folder.
        return path.canonicalize().ok();
    }
    eprintln!("skipped: no {}", path.display());
    None
}

/// Says whether slow tests are asked for, and aloud where they are not.
pub fn is_slow_asked_for() -> bool {
    let asked = std::env::var_os("PVMAP_SLOW_TESTS").is_some();
    if !asked {
        eprintln!("skipped: slow; set PVMAP_SLOW_TESTS=1 to run it");
    }
    asked
}

/// The folder one test works in; gone with the test.
pub struct Bench {
    folder: TempDir,
}

impl Bench {
    pub fn new() -> Bench {
        Bench { folder: tempfile::tempdir().unwrap() }
    }

    pub fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn write(&self, name: impl AsRef<Path>, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    pub fn read(&self, name: impl AsRef<Path>) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap()
    }

    /// Lists everything in the folder, hidden files too, sorted.
    pub fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.folder.path()).unwrap();
        let mut names: Vec<String> =
            entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Prepares a run of the command in this folder.
    pub fn command<A: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = A>) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_pvmap"));
        command.current_dir(self.folder.path()).args(args).stdin(Stdio::null());
        command
    }

    /// Prepares a run that can be stopped even where these tests run in the background of a shell,
    /// which makes what it starts ignore SIGINT.
    pub fn stoppable<A: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = A>) -> Command {
        let mut command = Command::new("env");
        command.args(["--default-signal=INT,TERM,HUP", env!("CARGO_BIN_EXE_pvmap")]);
        command.current_dir(self.folder.path()).args(args).stdin(Stdio::null());
        command
    }

    /// Runs the command to its end.
    pub fn run<A: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = A>) -> Run {
        Run::of(self.command(args))
    }

    /// Runs a line of words without spaces in them.
    pub fn line(&self, line: &str) -> Run {
        self.run(line.split_whitespace())
    }

    /// Counts the points of an octree in the folder.
    pub fn n_stored(&self, octree: &str) -> u64 {
        self.with_octree(octree, |view| view.summary().n_points)
    }

    /// Shows an octree in the folder to `look`.
    pub fn with_octree<T>(&self, octree: &str, look: impl FnOnce(&OctreeView<'_>) -> T) -> T {
        let mapped = pvmap::open_octree(&self.path(octree)).unwrap();
        look(&OctreeView::open(&mapped).unwrap())
    }

    /// Shows a map in the folder to `look`.
    pub fn with_map<T>(&self, map: &str, look: impl FnOnce(&MapView<'_>) -> T) -> T {
        look(&MapView::open(&self.read(map)).unwrap())
    }
}

/// A run that has ended, and what was seen of it from outside.
#[derive(Debug)]
pub struct Run {
    /// Its exit code; 128 + N where signal N ended it.
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
    /// Most anonymous memory seen, looking every millisecond.
    pub anon_bytes: u64,
    /// Most memory of any kind, as the system keeps count.
    pub rss_bytes: u64,
    pub elapsed: Duration,
}

impl Run {
    /// Starts a command and watches it to its end.
    pub fn of(mut command: Command) -> Run {
        let started = Instant::now();
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Run::watch(child, started)
    }

    /// Watches a command with piped output to its end.
    pub fn watch(mut child: Child, started: Instant) -> Run {
        let stdout = listen(child.stdout.take());
        let stderr = listen(child.stderr.take());
        let (mut anon_bytes, mut rss_bytes) = (0, 0);
        let status = loop {
            if let Some((anon, rss)) = memory_of(child.id()) {
                (anon_bytes, rss_bytes) = (anon.max(anon_bytes), rss.max(rss_bytes));
            }
            if let Some(status) = child.try_wait().unwrap() {
                break status;
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        let elapsed = started.elapsed();
        let signal = std::os::unix::process::ExitStatusExt::signal(&status);
        let code = status.code().or_else(|| signal.map(|s| 128 + s)).unwrap();
        let [stdout, stderr] = [stdout, stderr].map(|t| t.join().unwrap());
        Run { code, stdout, stderr, anon_bytes, rss_bytes, elapsed }
    }

    /// Demands an exit code.
    #[track_caller]
    pub fn exits(self, code: i32) -> Run {
        assert_eq!(self.code, code, "stdout: {}\nstderr: {}", self.stdout, self.stderr);
        self
    }

    /// Demands success.
    #[track_caller]
    pub fn ok(self) -> Run {
        self.exits(0)
    }

    /// Demands an exit code, one line that says why, and these words in it.
    #[track_caller]
    pub fn fails(self, code: i32, words: &[&str]) -> Run {
        let run = self.exits(code);
        let lines: Vec<&str> =
            run.stderr.lines().filter(|l| !l.starts_with("pvmap: warning: ")).collect();
        let [line] = lines.as_slice() else { panic!("more or less than one line: {run:?}") };
        assert!(line.starts_with("pvmap: error: "), "{line}");
        for word in words {
            assert!(line.contains(word), "no {word:?} in: {line}");
        }
        run
    }

    /// Demands a warning with these words in it.
    #[track_caller]
    pub fn warns(self, words: &[&str]) -> Run {
        let mut warnings = self.stderr.lines().filter_map(|l| l.strip_prefix("pvmap: warning: "));
        let found = warnings.any(|l| words.iter().all(|w| l.contains(w)));
        assert!(found, "no warning with {words:?} in: {}", self.stderr);
        self
    }

    /// Demands that it held no more than [D-9] allows two threads.
    #[track_caller]
    pub fn within(self, memory_mib: u64) -> Run {
        let allowed = allowed_bytes(memory_mib * MIB, 2);
        let (held, allowed) = (self.anon_bytes / MIB, allowed / MIB);
        assert!(held <= allowed, "{held} MiB held, {allowed} MiB allowed");
        self
    }
}

/// Runs a line with the folder `temporary` for what is temporary, and asks it to stop (SIGINT) a
/// while after it has said a word on stderr.
pub fn interrupted(bench: &Bench, line: &str, word: &str) -> Run {
    std::fs::create_dir(bench.path("temporary")).unwrap();
    let mut command = bench.stoppable(line.split_whitespace());
    command.env("TMPDIR", bench.path("temporary"));
    let started = Instant::now();
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    while !line.contains(word) {
        line.clear();
        assert!(said.read_line(&mut line).unwrap() > 0, "it ended");
    }
    std::thread::sleep(Duration::from_millis(300));
    let kill = format!("kill -INT {}", child.id());
    assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success());
    let rest = listen(Some(said));
    let run = Run::watch(child, started);
    Run { stderr: rest.join().unwrap(), ..run }
}

/// Reads a pipe to its end on a thread of its own.
fn listen(pipe: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<String> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        pipe.map(|mut pipe| pipe.read_to_end(&mut bytes).unwrap());
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// Reads RssAnon now and VmHWM of a running process, bytes.
fn memory_of(pid: u32) -> Option<(u64, u64)> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let field = |name: &str| {
        let line = status.lines().find_map(|l| l.strip_prefix(name))?;
        Some(line.split_whitespace().next()?.parse::<u64>().ok()? << 10)
    };
    Some((field("RssAnon:")?, field("VmHWM:")?))
}

/// Writes a LAS or LAZ file without normals, millimetre steps; `step` gives point `i`.
pub fn write_las(path: &Path, n_points: u64, step: impl Fn(u64) -> [i32; 3]) {
    let compressed = path.extension() == Some(OsStr::new("laz"));
    let (scale, offset) = ([0.001; 3], [0.0; 3]);
    let options = LasOptions { compressed, scale, offset, normals: false };
    let mut writer = LasWriter::create(path, options).unwrap();
    const BLOCK_POINTS: u64 = 1 << 16;
    for first in (0..n_points).step_by(BLOCK_POINTS as usize) {
        let records: Vec<u64> = (first..n_points.min(first + BLOCK_POINTS)).collect();
        let positions = Positions::Lattice(records.iter().map(|&i| step(i)).collect());
        writer.write(&batch(records, positions)).unwrap();
    }
    writer.finish().unwrap();
}

fn batch(records: Vec<u64>, positions: Positions) -> PointBatch {
    PointBatch {
        source: 0,
        records,
        positions,
        color: None,
        intensity: None,
        classification: None,
        gps_time: None,
        normal: None,
    }
}

/// Gives point `i` of a level floor of `n` × `n` points a centimetre apart.
pub fn floor(n: u64) -> impl Fn(u64) -> [i32; 3] {
    move |i| [(i % n * 10) as i32, (i / n * 10) as i32, 0]
}

/// Where a LAS header has its bounds: max and min, an axis at a time.
pub const LAS_BOUNDS: u64 = 179;

/// Writes bytes over others.
pub fn patch(path: &Path, at: u64, bytes: &[u8]) {
    use std::os::unix::fs::FileExt;
    let file = std::fs::File::options().write(true).open(path).unwrap();
    file.write_all_at(bytes, at).unwrap();
}

/// Gives a text PLY of a floor, z = -1, and a ceiling, z = 1, of `n` × `n` points each, x and y
/// from -1 to 1. Their normals face each other: a point of the one sees all of the other.
pub fn room_ply(n: u32) -> String {
    let mut text = ply_header(2 * n * n, &["x", "y", "z", "nx", "ny", "nz"]);
    for z in [-1, 1] {
        for i in 0..n * n {
            let [x, y] = [i % n, i / n].map(|v| 2.0 * f64::from(v) / f64::from(n - 1) - 1.0);
            writeln!(text, "{x} {y} {z} 0 0 {}", -z).unwrap();
        }
    }
    text
}

/// Gives the header of a text PLY whose vertices have `float` properties of these names.
pub fn ply_header(n_points: u32, names: &[&str]) -> String {
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {n_points}\n");
    for name in names {
        writeln!(text, "property float {name}").unwrap();
    }
    text + "end_header\n"
}

/// Gives a text PLY of points amid the air: next to nothing can be settled high up in their tree,
/// so that a fine map of them takes minutes.
pub fn noise_ply(n_points: u32) -> String {
    let mut random = fastrand::Rng::with_seed(7);
    let mut text = ply_header(n_points, &XYZ);
    for _ in 0..n_points {
        text.extend((0..3).map(|_| format!("{} ", random.f32())).chain(["\n".to_owned()]));
    }
    text
}

/// The properties of a point without attributes.
pub const XYZ: [&str; 3] = ["x", "y", "z"];

/// A folder with `room.ply`, its octree and its map.
pub fn room() -> Bench {
    let bench = Bench::new();
    bench.write("room.ply", room_ply(40));
    bench.line("ingest room.ply").ok();
    bench.line("build").ok();
    bench
}

/// What `pvmap info --json` says of an artifact.
pub fn info(bench: &Bench, artifact: &str) -> serde_json::Value {
    let run = bench.line(&format!("info {artifact} --json")).ok();
    serde_json::from_str(&run.stdout).unwrap()
}

/// A needle with eight sides and a notch half way up, its front outward, y up.
pub fn needle(path: &Path) {
    let ring = [[1.0, 0.0], [0.0, -1.0], [-1.0, 0.0], [0.0, 1.0]];
    let mut corners = vec![[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]];
    for (y, r) in [(1.0, 1.0), (2.0, 0.3), (3.0, 0.8)] {
        corners.extend(ring.map(|[x, z]| [x * r, y, z * r]));
    }
    let mut triangles = Vec::new();
    for i in 0..4 {
        let next = (i + 1) % 4;
        triangles.push([0, 2 + next, 2 + i]);
        triangles.push([1, 10 + i, 10 + next]);
        for ring in [2, 6] {
            let [a, b, c, d] = [ring + i, ring + next, ring + 4 + next, ring + 4 + i];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    let colors = vec![[0; 3]; triangles.len()];
    MeshWriter::create(path).unwrap().finish(&corners, &triangles, &colors).unwrap();
}

/// Demands that a text is well-formed as far as it goes without a document type; counts elements
/// of a class.
pub fn count_of_class(svg: &str, class: &str) -> usize {
    let mut open: Vec<&str> = Vec::new();
    let mut n = 0;
    for piece in svg.split('<').skip(1) {
        let (tag, letters) = piece.split_once('>').unwrap();
        for entity in letters.split('&').skip(1) {
            let name = entity.split_once(';').unwrap().0;
            assert!(["amp", "lt", "gt", "quot"].contains(&name), "{entity}");
        }
        if tag.starts_with("!--") {
            assert!(tag.ends_with("--"), "{tag}");
            continue;
        }
        assert!(tag.matches('"').count().is_multiple_of(2), "{tag}");
        n += usize::from(tag.contains(&format!("class=\"{class}\"")));
        match tag.strip_prefix('/') {
            Some(name) => assert_eq!(open.pop(), Some(name)),
            None if tag.ends_with('/') => {}
            None => open.push(tag.split_whitespace().next().unwrap()),
        }
    }
    assert!(open.is_empty(), "{open:?}");
    n
}
