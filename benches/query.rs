//! How fast answers are: `cargo bench --bench query [-- PART OF A NAME]`.
//!
//! A furnished room of 400 000 points and its map, asked in memory by one thread: places located,
//! pairs decided, what a place sees, regions, rays, and how much every surfel sees. Opening is
//! measured on that map with its section of links made 1 GB long by zeros, a sparse file: opening
//! reads the header, the table and a few small rows, and none of the links. At the end a table of
//! pairs goes through the command. Run as a test, with few points and each once.

use std::hint::black_box;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::LazyLock;
use std::time::Instant;

use divan::Bencher;
use divan::counter::ItemsCount;
use fastrand::Rng;
use pvmap::query::{Ball, Located, Map, Place, Snap};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::container::{BLOCK_BYTES, Written, align, head_bytes};
use pvmap::vmap::map::{SECTIONS, close_map};
use pvmap::{BuildConfig, IngestRequest, Limits, Mapped, Quiet};
use tempfile::TempDir;

/// Bytes of the map that is opened.
const LARGE_BYTES: u64 = 1 << 30;
const N_QUESTIONS: usize = 1 << 16;

/// The map in a folder that lives as long as it is needed.
struct Asked {
    _folder: TempDir,
    path: PathBuf,
    bytes: Mapped,
}

fn is_bench() -> bool {
    std::env::args().any(|a| a == "--bench")
}

static ASKED: LazyLock<Asked> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("the temporary folder can be written");
    let [scan, octree, path] = ["s.ply", "s.octree", "s.vmap"].map(|n| folder.path().join(n));
    let (limits, scene) = (Limits::default(), Scene::new(SceneKind::Furnished, 1));
    let n_points = if is_bench() { 400_000 } else { 20_000 };
    let request = SceneRequest { n_points, shuffle: false };
    scenes::write(&scene, &request, &scan, &limits, &Quiet).expect("the scan can be written");
    pvmap::ingest(&IngestRequest::new([scan], octree.clone()), &limits, &Quiet)
        .expect("the octree can be written");
    pvmap::build(&octree, &path, &BuildConfig::default(), &limits, &Quiet)
        .expect("the map can be written");
    let bytes = Mapped::open(&path).expect("just written");
    Asked { _folder: folder, path, bytes }
});

static MAP: LazyLock<Map<'static>> =
    LazyLock::new(|| Map::open(&ASKED.bytes).expect("just written"));

static KEPT: LazyLock<Map<'static>> = LazyLock::new(|| {
    let map = Map::open(&ASKED.bytes).expect("just written");
    assert!(map.keep(1 << 30).expect("just written"));
    map
});

/// Places of surfels, and the surfels.
static LOCATED: LazyLock<Vec<(Place, Located)>> = LazyLock::new(|| {
    let mut rng = Rng::with_seed(1);
    let view = MAP.view();
    let place = |_| {
        let surfel = view.surfel(rng.u32(..view.summary().n_surfels)).expect("just written");
        let position = view.frame().frame.world_of(surfel.centroid);
        let place = Place { position, normal: None };
        let located = MAP.locate(&place, Snap::Within(f64::INFINITY)).expect("in the room");
        (place, located)
    };
    (0..N_QUESTIONS).map(place).collect()
});

fn main() {
    let is_whole = std::env::args().skip(1).all(|a| a.starts_with('-'));
    divan::main();
    if is_whole {
        through_the_command(if is_bench() { 2_000_000 } else { 1000 });
    }
}

#[divan::bench]
fn locate(bencher: Bencher) {
    locate_on(bencher, &MAP);
}

#[divan::bench]
fn locate_kept(bencher: Bencher) {
    locate_on(bencher, &KEPT);
}

fn locate_on(bencher: Bencher, map: &Map<'_>) {
    let found = |at: &&(Place, Located)| {
        map.locate(&at.0, Snap::Within(f64::INFINITY)).is_ok_and(|l| l.surfel == at.1.surfel)
    };
    bencher
        .counter(ItemsCount::new(LOCATED.len()))
        .bench_local(|| assert_eq!(LOCATED.iter().filter(found).count(), LOCATED.len()));
}

/// The frames that hold the links have been decoded.
#[divan::bench]
fn pair(bencher: Bencher) {
    let pairs = || LOCATED.iter().zip(LOCATED.iter().rev());
    let visible = |(a, b): &(&(Place, Located), &(Place, Located))| {
        MAP.pair(&a.1, &b.1).expect("just written").visible
    };
    black_box(pairs().filter(visible).count());
    bencher
        .counter(ItemsCount::new(LOCATED.len()))
        .bench_local(|| black_box(pairs()).filter(visible).count());
}

/// Warm: links and leaves are in memory.
#[divan::bench]
fn pair_kept(bencher: Bencher) {
    let map = &KEPT;
    let pairs = || LOCATED.iter().zip(LOCATED.iter().rev());
    let visible = |(a, b): &(&(Place, Located), &(Place, Located))| {
        map.pair(&a.1, &b.1).expect("just written").visible
    };
    bencher
        .counter(ItemsCount::new(LOCATED.len()))
        .bench_local(|| black_box(pairs()).filter(visible).count());
}

#[divan::bench]
fn visible_from(bencher: Bencher) {
    let mut next = LOCATED.iter().cycle();
    bencher.bench_local(|| {
        let (_, from) = next.next().expect("endless");
        MAP.visible_from(from).expect("just written").surfels.len()
    });
}

#[divan::bench]
fn sees_counts(bencher: Bencher) {
    bencher.bench_local(|| MAP.sees_counts(&|| true).expect("just written").len());
}

#[divan::bench]
fn region(bencher: Bencher) {
    let mut next = LOCATED.iter().cycle();
    bencher.bench_local(|| {
        let mut ball = || Ball { middle: next.next().expect("endless").0.position, radius: 0.5 };
        MAP.region(&ball(), &ball()).expect("surfels are there").n_links
    });
}

#[divan::bench]
fn ray_from_the_air(bencher: Bencher) {
    let middle = MAP.view().frame().frame.world_of([1 << 21; 3]);
    let mut next = LOCATED.iter().cycle();
    bencher.bench_local(|| {
        let to = next.next().expect("endless").0.position;
        let way = [0, 1, 2].map(|i| to[i] - middle[i]);
        MAP.ray(middle, way, None).expect("a direction").hit
    });
}

/// A map of 1 GB.
static LARGE: LazyLock<(TempDir, PathBuf)> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("the temporary folder can be written");
    let path = folder.path().join("large.vmap");
    let mut file = std::fs::File::create(&path).expect("the temporary folder can be written");
    let zeros = crc32fast::hash(&[0; BLOCK_BYTES as usize]);
    let (mut at, mut table) = (head_bytes(SECTIONS.len()), Vec::new());
    for (name, section) in SECTIONS.iter().zip(MAP.view().file().sections()) {
        at = align(at);
        let bytes = MAP.view().file().read_all(section).expect("just written");
        let is_links = *name == "links";
        let len_bytes = if is_links { LARGE_BYTES } else { bytes.len() as u64 };
        let sums = match is_links {
            true => vec![zeros; LARGE_BYTES.div_ceil(BLOCK_BYTES) as usize],
            false => bytes.chunks(BLOCK_BYTES as usize).map(crc32fast::hash).collect(),
        };
        let record_bytes = section.record_bytes;
        table.push(Written { name, offset_bytes: at, len_bytes, record_bytes, sums });
        if !is_links {
            write_at(&mut file, at, bytes);
        }
        at += len_bytes;
    }
    let closing = close_map(&table);
    write_at(&mut file, closing.sums_offset_bytes, &closing.sums);
    write_at(&mut file, 0, &closing.head);
    (folder, path)
});

fn write_at(file: &mut std::fs::File, at: u64, bytes: &[u8]) {
    use std::io::Seek;
    file.seek(std::io::SeekFrom::Start(at)).expect("a file on a disk");
    file.write_all(bytes).expect("the temporary folder can be written");
}

#[divan::bench]
fn open_1_gb(bencher: Bencher) {
    let path = &LARGE.1;
    bencher.bench_local(|| {
        let bytes = Mapped::open(path).expect("just written");
        Map::open(&bytes).expect("just written").view().file().len_bytes()
    });
}

/// Prints how many rows of a table a second `pvmap query … pairs` answers.
fn through_the_command(n_rows: usize) {
    let rows = ASKED.path.with_extension("csv");
    let mut text = String::from("x1,y1,z1,x2,y2,z2\n");
    let mut rng = Rng::with_seed(2);
    for _ in 0..n_rows {
        let [[x, y, z], [u, v, w]] = [(); 2].map(|()| LOCATED[rng.usize(..N_QUESTIONS)].0.position);
        text += &format!("{x:.6},{y:.6},{z:.6},{u:.6},{v:.6},{w:.6}\n");
    }
    std::fs::write(&rows, text).expect("the temporary folder can be written");
    let started = Instant::now();
    let answered = Command::new(env!("CARGO_BIN_EXE_pvmap"))
        .args(["query".as_ref(), ASKED.path.as_os_str(), "pairs".as_ref(), rows.as_os_str()])
        .stderr(Stdio::inherit())
        .output()
        .expect("pvmap can be started");
    let rate = n_rows as f64 / started.elapsed().as_secs_f64();
    let answers = String::from_utf8(answered.stdout).expect("answers are text");
    let n_answers = answers.lines().filter(|line| line.starts_with(['0', '1'])).count();
    assert_eq!((answered.status.success(), n_answers), (true, n_rows), "each row has its answer");
    println!("\npvmap query MAP pairs ROWS.csv: {:.2} M rows/s", rate / 1e6);
}
