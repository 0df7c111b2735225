//! The pieces that builds spend their time in: `cargo bench --bench micro [-- PART OF A NAME]`.
//!
//! A furnished room of 60 000 points, cut into some thousand leaves: the exact predicate, the
//! refinement of candidates against a shaft, the leaf kernel on whole blocks of leaf pairs beside
//! the same in plain floats (`support/plain.rs`), and the codec of links. At the end stands what
//! the kernel's proven bounds and its fallback to integers cost: its time over that of plain
//! floats. Run as a test, each once.

use std::hint::black_box;
use std::sync::LazyLock;
use std::time::Instant;

use divan::Bencher;
use divan::counter::ItemsCount;
use fastrand::Rng;
use pvmap::geometry::disc;
use pvmap::vmap::links::{self, LinkEncoder};
use pvmap::vmap::records::LinkBlock;
use pvmap_visibility::interaction::sibling_pairs;
use pvmap_visibility::pairs::Decider;

mod support {
    pub(crate) mod blocks;
    pub(crate) mod plain;
    pub(crate) mod room;
}

use support::blocks::Blocks;
use support::room::{PROFILE, Room};

static ROOM: LazyLock<Room> = LazyLock::new(Room::furnished);

/// Links of the room's map, sorted.
static LINKS: LazyLock<Vec<(u32, u32)>> = LazyLock::new(|| {
    let mut decider = Decider::new(ROOM.scene());
    let mut found = Vec::new();
    for (a, b) in sibling_pairs(&ROOM.tree) {
        let mut below = Vec::new();
        decider.decide(a, b, &mut below);
        found.extend(below);
    }
    found.sort_unstable();
    found
});

const N_TRIPLES: usize = 4096;
/// Rounds of the comparison; its figures are medians.
const N_ROUNDS: usize = 31;

fn main() {
    let is_bench = std::env::args().any(|a| a == "--bench");
    let is_whole = std::env::args().skip(1).all(|a| a.starts_with('-'));
    divan::main();
    if is_whole {
        compare(if is_bench { N_ROUNDS } else { 1 });
    }
}

/// One segment and one disc, decided by integers. Source: DESIGN.md [V-2].
#[divan::bench]
fn exact_predicate(bencher: Bencher) {
    let mut rng = Rng::with_seed(1);
    let mut any = || ROOM.discs[rng.usize(..ROOM.discs.len())];
    let triples: Vec<_> = (0..N_TRIPLES).map(|_| [any(), any(), any()]).collect();
    let is_blocked = |[a, b, k]: &[disc::Disc; 3]| disc::blocks(PROFILE, a, b, k);
    bencher
        .counter(ItemsCount::new(triples.len()))
        .bench_local(|| black_box(&triples).iter().filter(|t| is_blocked(t)).count());
}

/// From the whole tree down to the leaves that may block a block's segments; items are candidates.
#[divan::bench]
fn shaft_refinement(bencher: Bencher) {
    let mut blocks = Blocks::new(&ROOM);
    let n_candidates = blocks.refine_all();
    bencher.counter(ItemsCount::new(n_candidates)).bench_local(|| blocks.refine_all());
}

/// Whole blocks, by the filtered kernel; items are leaf pairs.
#[divan::bench]
fn leaf_blocks_filtered(bencher: Bencher) {
    let mut blocks = Blocks::new(&ROOM);
    let n_pairs = blocks.n_pairs();
    bencher.counter(ItemsCount::new(n_pairs)).bench_local(|| blocks.decide_filtered());
}

/// The same by plain floats.
#[divan::bench]
fn leaf_blocks_plain(bencher: Bencher) {
    let mut blocks = Blocks::new(&ROOM);
    let n_pairs = blocks.n_pairs();
    bencher.counter(ItemsCount::new(n_pairs)).bench_local(|| blocks.decide_plain());
}

#[divan::bench]
fn links_encode(bencher: Bencher) {
    bencher.counter(ItemsCount::new(LINKS.len())).bench_local(|| encode(black_box(&LINKS)));
}

#[divan::bench]
fn links_decode(bencher: Bencher) {
    let frames = encode(&LINKS);
    let decoded = |(block, frame): &(LinkBlock, Vec<u8>)| {
        links::decode("links", block, frame, 0).expect("just encoded").len()
    };
    bencher
        .counter(ItemsCount::new(LINKS.len()))
        .bench_local(|| black_box(&frames).iter().map(decoded).sum::<usize>());
}

fn encode(links: &[(u32, u32)]) -> Vec<(LinkBlock, Vec<u8>)> {
    let mut encoder = LinkEncoder::new().expect("zstd starts");
    let mut frames: Vec<_> =
        links.iter().filter_map(|&link| encoder.push(link).expect("zstd compresses")).collect();
    frames.extend(encoder.finish().expect("zstd compresses"));
    frames
}

/// Prints what the filter costs. The three take turns, so that a busy machine slows all alike.
fn compare(n_rounds: usize) {
    let mut blocks = Blocks::new(&ROOM);
    let (n_filtered, n_plain) = (blocks.decide_filtered(), blocks.decide_plain());
    let mut seconds = [const { Vec::new() }; 3];
    let ways = [Blocks::decide_filtered, Blocks::decide_plain, Blocks::prepare_all];
    for _ in 0..n_rounds {
        for (times, way) in seconds.iter_mut().zip(ways) {
            let started = Instant::now();
            black_box(way(&mut blocks));
            times.push(started.elapsed().as_secs_f64());
        }
    }
    let [filtered, plain, common] = seconds.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    let counts = blocks.counts();
    let exact = 100.0 * counts.n_exact as f64 / counts.n_tests.max(1) as f64;
    println!("\nfiltered kernel over plain floats, medians of {n_rounds}:");
    println!("  whole blocks                {:.2}", filtered / plain);
    println!("  less facing and candidates  {:.2}", (filtered - common) / (plain - common));
    println!("  settled by integers         {exact:.4} % of tests");
    println!("  visible pairs               {n_filtered} (plain floats say {n_plain})");
}
