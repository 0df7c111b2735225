//! A furnished room cut into leaves, ready to be decided.

use pvmap::geometry::disc::{Disc, Profile};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::octree::FILE_NAME;
use pvmap::vmap::{OctreeView, Shape, Spacing, Tree};
use pvmap::{IngestRequest, Limits, Mapped, Quiet};
use pvmap_octree::cut::{CutMemory, CutOptions, cut};
use pvmap_store::Table;
use pvmap_visibility::bounds::{self, Bounds};
use pvmap_visibility::candidates::{self, Family};
use pvmap_visibility::sheets::Sheets;
use pvmap_visibility::{fractions, pairs};

const N_POINTS: u64 = 60_000;
pub(crate) const PROFILE: Profile = Profile::Patch;
const CUT: CutOptions = CutOptions {
    max_level: 8,
    leaf_capacity: 24,
    max_spread: 0,
    shape: Shape::Binned,
    profile: PROFILE,
    spacing: Spacing::Leaf,
};

/// What pairs are decided from.
#[derive(Debug)]
pub(crate) struct Room {
    pub(crate) tree: Tree,
    pub(crate) discs: Vec<Disc>,
    pub(crate) bounds: Table<Bounds>,
    pub(crate) families: Table<Family>,
    /// None: it is the kernel that is measured.
    sheets: Sheets,
}

impl Room {
    /// Makes it.
    pub(crate) fn furnished() -> Room {
        let folder = tempfile::tempdir().expect("the temporary folder can be written");
        let [scan, octree] = ["s.ply", "s.octree"].map(|name| folder.path().join(name));
        let (limits, scene) = (Limits::default(), Scene::new(SceneKind::Furnished, 1));
        let request = SceneRequest { n_points: N_POINTS, shuffle: false };
        scenes::write(&scene, &request, &scan, &limits, &Quiet).expect("the scan can be written");
        pvmap::ingest(&IngestRequest::new([scan], octree.clone()), &limits, &Quiet)
            .expect("the octree can be written");
        let file = Mapped::open(&octree.join(FILE_NAME)).expect("just written");
        let view = OctreeView::open(&file).expect("just written");
        let memory = CutMemory { points_bytes: 1 << 26, tree_bytes: 1 << 28 };
        let tree = cut(&view, &CUT, memory, &Quiet).expect("just written");
        let discs: Vec<Disc> =
            (0..tree.surfels.len() as u32).map(|s| tree.disc(s, PROFILE)).collect();
        let bounds = bounds::of_tree(&tree, &discs, PROFILE, false, None).expect("in memory");
        let sheets = Sheets::default();
        let families = candidates::families(&tree, &bounds, &sheets, None).expect("in memory");
        Room { tree, discs, bounds, families, sheets }
    }

    /// Gives it as deciders take it.
    pub(crate) fn scene(&self) -> pairs::Scene<'_> {
        let Room { tree, discs, bounds, families, sheets } = self;
        pairs::Scene {
            tree,
            discs,
            bounds,
            families,
            sheets,
            profile: PROFILE,
            tries: fractions::Tries::default(),
        }
    }
}
