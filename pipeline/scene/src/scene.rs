//! A scene: its surfaces and what is precomputed over them.

use crate::bvh::{self, Bvh};
use crate::kind::{SceneError, SceneKind};
use crate::mesh::Mesh;
use crate::paint::Paint;
use crate::random::bits;
use crate::shape::Shape;
use crate::vector::Vector;
use crate::{cave, rooms};

/// A piece of surface with its paint.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface {
    pub(crate) shape: Shape,
    pub(crate) paint: Paint,
}

/// A scene, in metres, z up. Its parts are pure functions of kind, seed and statues.
///
/// The rooms are closed cubes of 5.5 m from the origin (x to the right, y to the back), the same
/// for every seed; the cave's shape comes from its seed. [`Scene::points`] samples the surfaces,
/// [`Scene::sees`] tells the truth about two samples, [`Scene::sees_points`] about any two places
/// close to the surfaces.
#[derive(Debug)]
pub struct Scene {
    pub(crate) surfaces: Vec<Surface>,
    /// Where the room's surfaces end, then each statue's.
    group_ends: Vec<usize>,
    /// What share of all points each surface and those before it have; the last is 1.
    pub(crate) shares: Vec<f64>,
    pub(crate) bvh: Bvh,
    /// The longest side of the box around the scene.
    pub(crate) extent_m: f64,
    /// What the points' chance hangs on.
    pub(crate) key: u64,
}

/// Boxes of the tree are grown by this share of the extent. Coordinates are rounded at 2^-53 of
/// themselves, so sums and products of a few stay a million times below it.
const BOX_MARGIN: f64 = 1e-9;

impl Scene {
    /// What a scene holds for each triangle, at most, while it is built and after.
    pub const TRIANGLE_BYTES: u64 = (size_of::<Surface>()
        + size_of::<(Vector, Vector)>()
        + size_of::<f64>()
        + bvh::SURFACE_BYTES) as u64;

    /// Builds the scene.
    pub fn new(kind: SceneKind, seed: u64) -> Scene {
        let key = bits(seed, kind as u64);
        let surfaces = match kind {
            SceneKind::Empty => rooms::empty(),
            SceneKind::Packed => rooms::packed(),
            SceneKind::Furnished => rooms::furnished(),
            SceneKind::Cave => cave::surfaces(key),
        };
        Scene::of_surfaces(surfaces, Vec::new(), key)
    }

    /// Builds the empty Cornell room with statues in a row on its floor, from left to right. They
    /// must stand upright already ([`Mesh::upright`]).
    ///
    /// Each statue has an equal part of the room's width and keeps 0.25 m away from its borders,
    /// so that no two touch. Its longest side is `size_m` or, without one, 3 m or as much as fits.
    /// The floor below is sampled like the rest.
    ///
    /// # Errors
    /// [`SceneError::TooMany`] for more than ten, [`SceneError::TooLarge`] where one does not fit.
    pub fn with_statues(
        seed: u64,
        statues: Vec<Mesh>,
        size_m: Option<f64>,
    ) -> Result<Scene, SceneError> {
        let n = statues.len();
        if n > rooms::MOST_STATUES {
            return Err(SceneError::TooMany { n_statues: n, most: rooms::MOST_STATUES });
        }
        let mut surfaces = rooms::empty();
        // A list that grows is copied.
        surfaces.reserve_exact(statues.iter().map(|statue| statue.triangles().len()).sum());
        let mut group_ends = vec![surfaces.len()];
        for (i, statue) in statues.into_iter().enumerate() {
            let (foot_m, space_m) = rooms::place_of_statue(i, n);
            let most_m = statue.fit_m(space_m);
            let size_m = size_m.unwrap_or(rooms::STATUE_M.min(most_m));
            if size_m > most_m {
                return Err(SceneError::TooLarge { statue: i + 1, size_m, most_m });
            }
            let paint = rooms::paint_of_statue(i);
            let placed = statue.placed(foot_m, size_m);
            surfaces.extend(placed.shapes().map(|shape| Surface { shape, paint }));
            group_ends.push(surfaces.len());
        }
        Ok(Scene::of_surfaces(surfaces, group_ends, bits(seed, SceneKind::Empty as u64)))
    }

    /// Takes a mesh for a scene, as it is: its triangles' front is where the void is.
    pub fn of_mesh(mesh: &Mesh, seed: u64) -> Scene {
        let paint = rooms::paint_of_statue(0);
        let surfaces = mesh.shapes().map(|shape| Surface { shape, paint }).collect();
        Scene::of_surfaces(surfaces, Vec::new(), bits(seed, SceneKind::ALL.len() as u64))
    }

    fn of_surfaces(surfaces: Vec<Surface>, mut group_ends: Vec<usize>, key: u64) -> Scene {
        let boxes: Vec<_> = surfaces.iter().map(|s| s.shape.bounds()).collect();
        let side = |i: usize| {
            let min = boxes.iter().map(|b| b.0[i]).fold(f64::INFINITY, f64::min);
            boxes.iter().map(|b| b.1[i]).fold(f64::NEG_INFINITY, f64::max) - min
        };
        let extent_m = side(0).max(side(1)).max(side(2));
        let bvh = Bvh::new(&boxes, BOX_MARGIN * extent_m);
        if group_ends.is_empty() {
            group_ends.push(surfaces.len());
        }
        Scene { shares: shares(&surfaces), surfaces, group_ends, bvh, extent_m, key }
    }

    /// Counts the parts that points can be shared out to: the room, then each statue.
    pub fn n_parts(&self) -> usize {
        self.group_ends.len()
    }

    /// Gives the least and the greatest x of the surfaces.
    pub(crate) fn x_range(&self) -> [f64; 2] {
        let bounds = || self.surfaces.iter().map(|s| s.shape.bounds());
        let low = bounds().map(|b| b.0[0]).fold(f64::INFINITY, f64::min);
        [low, bounds().map(|b| b.1[0]).fold(f64::NEG_INFINITY, f64::max)]
    }

    /// Counts the surfaces.
    pub fn n_surfaces(&self) -> usize {
        self.surfaces.len()
    }

    /// Shares points out in proportion to `n_points`, one for the room and one for each statue,
    /// instead of by area; within a part the area decides. So many in all are sampled exactly so.
    ///
    /// # Panics
    /// Where there are not as many numbers as [`Scene::n_parts`].
    #[must_use]
    pub fn shared_out(mut self, n_points: &[u64]) -> Scene {
        assert_eq!(n_points.len(), self.n_parts(), "a number for the room and for each statue");
        let total = n_points.iter().sum::<u64>() as f64;
        if total == 0.0 {
            return self;
        }
        let (mut first, mut before) = (0, 0);
        for (&end, &n) in self.group_ends.iter().zip(n_points) {
            let of_part = shares(&self.surfaces[first..end]);
            for (share, of_part) in self.shares[first..end].iter_mut().zip(of_part) {
                *share = (before as f64 + n as f64 * of_part) / total;
            }
            (first, before) = (end, before + n);
        }
        self
    }
}

/// Adds up the areas from the first surface on, as shares of the whole.
fn shares(surfaces: &[Surface]) -> Vec<f64> {
    let mut sum = 0.0;
    let mut shares: Vec<f64> = Vec::with_capacity(surfaces.len());
    for surface in surfaces {
        sum += surface.shape.area();
        shares.push(sum);
    }
    // The last becomes sum / sum, exactly 1.
    shares.iter_mut().for_each(|share| *share /= sum);
    shares
}
