//! A scene: its surfaces and what is precomputed over them.

use crate::bvh::Bvh;
use crate::kind::SceneKind;
use crate::paint::Paint;
use crate::random::bits;
use crate::shape::Shape;
use crate::{cave, rooms};

/// A piece of surface with its paint.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface {
    pub(crate) shape: Shape,
    pub(crate) paint: Paint,
}

/// A generated scene, in metres, z up. Its parts are pure functions of kind and seed.
///
/// The rooms are closed cubes of 5.5 m from the origin (x to the right, y to the back), the same
/// for every seed; the cave's shape comes from its seed. [`Scene::points`] samples the surfaces,
/// [`Scene::sees`] tells the truth about two samples, [`Scene::sees_points`] about any two places
/// close to the surfaces.
#[derive(Debug)]
pub struct Scene {
    pub(crate) surfaces: Vec<Surface>,
    /// What share of the whole area each surface and those before it have; the last is 1.
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
    /// Builds the scene.
    pub fn new(kind: SceneKind, seed: u64) -> Scene {
        let key = bits(seed, kind as u64);
        let surfaces = match kind {
            SceneKind::Empty => rooms::empty(),
            SceneKind::Packed => rooms::packed(),
            SceneKind::Furnished => rooms::furnished(),
            SceneKind::Cave => cave::surfaces(key),
        };
        let boxes: Vec<_> = surfaces.iter().map(|s| s.shape.bounds()).collect();
        let side = |i: usize| {
            let min = boxes.iter().map(|b| b.0[i]).fold(f64::INFINITY, f64::min);
            boxes.iter().map(|b| b.1[i]).fold(f64::NEG_INFINITY, f64::max) - min
        };
        let extent_m = side(0).max(side(1)).max(side(2));
        let bvh = Bvh::new(&boxes, BOX_MARGIN * extent_m);
        Scene { shares: shares(&surfaces), surfaces, bvh, extent_m, key }
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
