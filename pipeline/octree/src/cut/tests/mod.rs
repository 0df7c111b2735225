//! The cut against a slow obvious one, and the rows of the numeric catalogue that concern leaves.

mod named;
mod octree_file;
mod oracle;
mod random;
mod runs;

use pvmap_geometry::GridPoint;
use pvmap_geometry::disc::Profile;
use pvmap_geometry::normal::Normal;
use pvmap_store::Quiet;
use pvmap_vmap::{OctreeView, Shape, Spacing, Tree};

use super::{CutMemory, CutOptions, cut};
use octree_file::octree_file;

/// Memory that holds everything.
const PLENTY: u64 = 1 << 30;

/// Memory for any tree, and so much for points.
fn points_within(points_bytes: u64) -> CutMemory {
    CutMemory { points_bytes, tree_bytes: PLENTY }
}

/// A point of a test cloud.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct TestPoint {
    g: GridPoint,
    normal: Normal,
    oriented: bool,
    color: [u16; 3],
    source: u32,
}

impl TestPoint {
    fn at(g: GridPoint) -> TestPoint {
        TestPoint { g, normal: [0; 3], oriented: false, color: [0; 3], source: 0 }
    }

    fn facing(self, normal: Normal) -> TestPoint {
        TestPoint { normal, oriented: true, ..self }
    }

    fn two_sided(self, normal: Normal) -> TestPoint {
        TestPoint { normal, oriented: false, ..self }
    }
}

/// Options with profile `patch`.
fn options(shape: Shape, max_level: u8, leaf_capacity: u64) -> CutOptions {
    let (profile, spacing) = (Profile::Patch, Spacing::Leaf);
    CutOptions { max_level, leaf_capacity, max_spread: 0, shape, profile, spacing }
}

/// Cuts a cloud of which every source has 8-bit colour.
fn cut_cloud(cloud: &[TestPoint], options: &CutOptions) -> Tree {
    cut_within(cloud, options, PLENTY)
}

fn cut_within(cloud: &[TestPoint], options: &CutOptions, memory_bytes: u64) -> Tree {
    let bytes = octree_file(cloud, &[8]);
    let octree = OctreeView::open(&bytes).expect("a sound file");
    cut(&octree, options, points_within(memory_bytes), &Quiet).expect("a sound octree")
}
