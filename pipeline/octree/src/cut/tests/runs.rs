//! The run around the cut: threads, windows, progress, wishes to stop, damaged files, speed.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use fastrand::Rng;
use pvmap_geometry::normal::quantise;
use pvmap_store::{Quiet, StoreError, Watch};
use pvmap_vmap::{FormatError, OctreeView, Shape};

use super::octree_file::{file_in_order, octree_file};
use super::oracle::cut_slowly;
use super::random::check_routes;
use super::{PLENTY, TestPoint, options, points_within};
use crate::OctreeError;
use crate::cut::budget::BLOCK_ITEMS;
use crate::cut::{CutMemory, checked_id, cut};

/// Points on the walls of a room with some noise, normals a little off theirs.
fn room(n_points: usize, seed: u64) -> Vec<TestPoint> {
    let mut rng = Rng::with_seed(seed);
    let side = 1 << 22;
    let mut point = |_| {
        let wall = rng.usize(..6);
        let (axis, is_far) = (wall / 2, wall % 2 == 1);
        let mut g = [0; 3].map(|_| rng.u32(..side));
        g[axis] = if is_far { side - 1 - rng.u32(..64) } else { rng.u32(..64) };
        let mut n = [0; 3].map(|_| 0.1 * (rng.f32() - 0.5));
        n[axis] = if is_far { -1.0 } else { 1.0 };
        TestPoint {
            color: [0; 3].map(|_| rng.u16(..256)),
            ..TestPoint::at(g).facing(quantise(n).expect("a direction"))
        }
    };
    (0..n_points).map(&mut point).collect()
}

#[test]
fn threads_and_windows_change_nothing() {
    let cloud = room(50_000, 1);
    let bytes = octree_file(&cloud, &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound file");
    for shape in [Shape::Paper, Shape::Binned] {
        let options = options(shape, 8, 50);
        let expected = cut_slowly(&cloud, &[8], &options);
        check_routes(&cloud, &expected);
        for n_threads in [1, 2, 3, 8] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build();
            for memory_bytes in [0, 1 << 20, PLENTY] {
                let run = || cut(&octree, &options, points_within(memory_bytes), &Quiet);
                let tree = pool.as_ref().expect("a pool").install(run);
                assert_eq!(tree.expect("a sound octree"), expected);
            }
        }
    }
}

#[derive(Default)]
struct Listener {
    total: AtomicU64,
    n_done: AtomicU64,
    n_checks: AtomicU64,
    stop_after: u64,
}

impl Watch for Listener {
    fn stage(&self, name: &'static str, total: Option<u64>, unit: &'static str) {
        assert_eq!((name, unit), ("cut", "points"));
        self.total.store(total.expect("known"), Ordering::Relaxed);
    }

    fn advance(&self, n: u64) {
        self.n_done.fetch_add(n, Ordering::Relaxed);
    }

    fn warn(&self, message: &str) {
        panic!("{message}");
    }

    fn is_stopped(&self) -> bool {
        self.n_checks.fetch_add(1, Ordering::Relaxed) >= self.stop_after
    }
}

#[test]
fn progress_adds_up_and_a_wish_to_stop_is_heard() {
    let bytes = octree_file(&room(20_000, 2), &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound file");
    let options = options(Shape::Binned, 8, 50);
    let run = |listener: &Listener| cut(&octree, &options, points_within(0), listener);
    let patient = Listener { stop_after: u64::MAX, ..Listener::default() };
    run(&patient).expect("a sound octree");
    assert_eq!(patient.total.into_inner(), 20_000);
    assert_eq!(patient.n_done.into_inner(), 20_000);
    for stop_after in [0, 3, 100] {
        let hasty = Listener { stop_after, ..Listener::default() };
        let stopped = run(&hasty).expect_err("a wish to stop");
        assert!(matches!(stopped, OctreeError::Store(StoreError::Interrupted)));
    }
}

#[test]
fn d9_a_tree_larger_than_its_memory_is_refused() {
    let bytes = octree_file(&room(20_000, 5), &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound file");
    for shape in [Shape::Paper, Shape::Binned] {
        let within = |tree_bytes| {
            let memory = CutMemory { points_bytes: 0, tree_bytes };
            cut(&octree, &options(shape, 21, 1), memory, &Quiet)
        };
        let tree = within(PLENTY).expect("room for it");
        let tree_bytes = (tree.nodes.len() * 40 + tree.surfels.len() * 88) as u64;
        let n_parts = if shape == Shape::Paper { 1 } else { 7 };
        let blocks_bytes = n_parts * (40 + 88) * BLOCK_ITEMS as u64;
        within(tree_bytes + blocks_bytes).expect("its size, and the last block of each list");
        for too_little in [0, tree_bytes / 2, tree_bytes - 1] {
            let refused = within(too_little).expect_err("no room for it");
            assert!(matches!(refused, OctreeError::Store(StoreError::Budget { .. })), "{refused}");
        }
    }
}

#[test]
fn points_out_of_order_are_refused() {
    let mut cloud: Vec<TestPoint> = (0..9000).map(|i| TestPoint::at([2 * i, 0, 0])).collect();
    cloud.swap(100, 8000);
    let bytes = file_in_order(&cloud, &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound frame around them");
    for shape in [Shape::Paper, Shape::Binned] {
        for memory_bytes in [0, PLENTY] {
            let refused = cut(&octree, &options(shape, 21, 1), points_within(memory_bytes), &Quiet);
            let refused = refused.expect_err("points are not sorted");
            let OctreeError::Format(FormatError::Broken { section, what, .. }) = refused else {
                panic!("{refused}");
            };
            assert_eq!(
                (section.as_str(), what.as_str()),
                ("points", "points are not in Morton order")
            );
        }
    }
}

#[test]
fn a_flipped_bit_is_found() {
    let sound = octree_file(&room(3000, 3), &[8]);
    let view = OctreeView::open(&sound).expect("a sound file");
    for name in ["points", "normals"] {
        let section = view.file().sections().iter().find(|s| s.name == name);
        let at = section.expect("a section").offset_bytes as usize + 1000;
        let mut bytes = sound.clone();
        bytes[at] ^= 4;
        let octree = OctreeView::open(&bytes).expect("only points are damaged");
        let refused = cut(&octree, &options(Shape::Binned, 8, 50), points_within(PLENTY), &Quiet);
        let refused = refused.expect_err("damage");
        assert!(matches!(refused, OctreeError::Format(FormatError::Checksum { .. })));
    }
}

#[test]
fn ids_end_below_what_ends_and_parents_need() {
    assert_eq!(checked_id(0).expect("the first"), 0);
    let last = u32::MAX as usize - 2;
    assert_eq!(checked_id(last).expect("the last"), u32::MAX - 2);
    for beyond in [last + 1, last + 2, usize::MAX] {
        assert!(matches!(checked_id(beyond), Err(OctreeError::TooManyNodes)));
    }
}

/// Prints the rate on 5 M points: `cargo test --release -p pvmap-octree cut_speed -- --ignored
/// --nocapture`.
#[test]
#[ignore = "takes a minute; prints a figure"]
fn cut_speed() {
    let cloud = room(5_000_000, 4);
    let bytes = octree_file(&cloud, &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound file");
    octree.verify().expect("a sound file");
    for shape in [Shape::Paper, Shape::Binned] {
        for n_threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build();
            let pool = pool.expect("a pool");
            for memory_bytes in [64 << 20, PLENTY] {
                let start = Instant::now();
                let run =
                    || cut(&octree, &options(shape, 8, 50), points_within(memory_bytes), &Quiet);
                let tree = pool.install(run).expect("a sound octree");
                let seconds = start.elapsed().as_secs_f64();
                eprintln!(
                    "{shape:?}, {n_threads} threads, {} MiB: {:.1} M points/s, {} nodes, {} leaves",
                    memory_bytes >> 20,
                    cloud.len() as f64 / seconds / 1e6,
                    tree.nodes.len(),
                    tree.surfels.len(),
                );
            }
        }
    }
}
