//! What is known of all surfels under a node at once, and what follows for pairs of nodes.
//!
//! All bounds are intervals of integers below 2^41, so arithmetic in i64 is exact and every
//! conclusion is a proof: [`Facing::Unsure`] is the only answer that says nothing.

use std::path::Path;

use pvmap_geometry::Box3;
use pvmap_geometry::disc::{self, Disc, Profile};
use pvmap_store::{StoreError, Table};
use pvmap_vmap::Tree;
use rayon::prelude::*;

use crate::fractions;

/// Bounds of the surfels of a subtree.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Of the centroids, and of the other places at which segments may end.
    pub centroids: Box3,
    /// Of every place at which a surfel can block; empty if none can.
    pub blockers: Box3,
    /// Of the normals that are not zero: least and greatest of each component.
    normal_min: [i16; 3],
    normal_max: [i16; 3],
    /// Of n·c over the surfels whose normal is not zero.
    offset_min: i64,
    offset_max: i64,
    /// Whether some surfel has no normal, is two-sided, or is neither.
    some_zero: bool,
    some_two_sided: bool,
    some_one_sided: bool,
}

/// Whether surfels look along directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Facing {
    /// Every surfel looks along every one of the directions.
    All,
    /// No surfel looks along any of them.
    Never,
    /// Neither was proved.
    Unsure,
}

impl Bounds {
    const NOTHING: Bounds = Bounds {
        centroids: Box3::EMPTY,
        blockers: Box3::EMPTY,
        normal_min: [i16::MAX; 3],
        normal_max: [i16::MIN; 3],
        offset_min: i64::MAX,
        offset_max: i64::MIN,
        some_zero: false,
        some_two_sided: false,
        some_one_sided: false,
    };

    /// Bounds a single surfel.
    pub fn of_disc(disc: &Disc) -> Bounds {
        let centroids = Box3::at(disc.centroid);
        if disc.normal == [0; 3] {
            return Bounds { centroids, some_zero: true, ..Bounds::NOTHING };
        }
        let half = disc::half_sides(disc.normal, disc.radius2);
        let c = disc.centroid;
        let around =
            Box3 { min: [0, 1, 2].map(|i| c[i] - half[i]), max: [0, 1, 2].map(|i| c[i] + half[i]) };
        let offset = (0..3).map(|i| i64::from(disc.normal[i]) * i64::from(c[i])).sum();
        Bounds {
            centroids,
            // `paper` asks only that the segment meets the cell while the crossing is on the
            // disc, so there the disc's box stands alone.
            blockers: around,
            normal_min: disc.normal,
            normal_max: disc.normal,
            offset_min: offset,
            offset_max: offset,
            some_zero: false,
            some_two_sided: disc.two_sided,
            some_one_sided: !disc.two_sided,
        }
    }

    /// Bounds the surfels of both.
    pub fn join(&self, other: &Bounds) -> Bounds {
        Bounds {
            centroids: self.centroids.join(&other.centroids),
            blockers: self.blockers.join(&other.blockers),
            normal_min: [0, 1, 2].map(|i| self.normal_min[i].min(other.normal_min[i])),
            normal_max: [0, 1, 2].map(|i| self.normal_max[i].max(other.normal_max[i])),
            offset_min: self.offset_min.min(other.offset_min),
            offset_max: self.offset_max.max(other.offset_max),
            some_zero: self.some_zero || other.some_zero,
            some_two_sided: self.some_two_sided || other.some_two_sided,
            some_one_sided: self.some_one_sided || other.some_one_sided,
        }
    }

    /// Says whether some surfel can block at all.
    pub fn can_block(&self) -> bool {
        self.some_one_sided || self.some_two_sided
    }

    /// Bounds n·(x - c) over the surfels with a normal and the places x of a box.
    #[inline]
    fn side_of(&self, places: &Box3) -> (i64, i64) {
        let (low, high) = self.along(|i| (i64::from(places.min[i]), i64::from(places.max[i])));
        (low - self.offset_max, high - self.offset_min)
    }

    /// Bounds n·(x - c) by the directions from centroids to places: better than [`Self::side_of`]
    /// where normals differ and the node is small.
    #[inline]
    fn side_by_direction(&self, places: &Box3) -> (i64, i64) {
        self.along(|i| {
            let (low, high) = (self.centroids.min[i], self.centroids.max[i]);
            (i64::from(places.min[i]) - i64::from(high), i64::from(places.max[i]) - i64::from(low))
        })
    }

    /// Bounds n·v over the normals and an interval of v an axis.
    #[inline(always)]
    fn along(&self, v: impl Fn(usize) -> (i64, i64)) -> (i64, i64) {
        let mut sum = (0, 0);
        for i in 0..3 {
            let (n0, n1) = (i64::from(self.normal_min[i]), i64::from(self.normal_max[i]));
            let (v0, v1) = v(i);
            let products = [n0 * v0, n0 * v1, n1 * v0, n1 * v1];
            sum.0 += products.into_iter().fold(i64::MAX, i64::min);
            sum.1 += products.into_iter().fold(i64::MIN, i64::max);
        }
        sum
    }

    /// Decides whether these surfels look at the centroids of others. Source: DESIGN.md [V-1].
    pub fn looks_at(&self, others: &Box3) -> Facing {
        let apart = self.centroids.meet(others).is_empty();
        if !self.can_block() {
            // Without a normal a surfel looks everywhere, but not at its own place.
            return if apart { Facing::All } else { Facing::Unsure };
        }
        let (a, b) = (self.side_of(others), self.side_by_direction(others));
        let (low, high) = (a.0.max(b.0), a.1.min(b.1));
        if low > 0 || (high < 0 && !self.some_one_sided) {
            return if apart || !self.some_zero { Facing::All } else { Facing::Unsure };
        }
        let blind = if self.some_two_sided { low == 0 && high == 0 } else { high <= 0 };
        if blind && !self.some_zero { Facing::Never } else { Facing::Unsure }
    }

    /// Gives the least and the greatest of each component of the normals that are not zero.
    pub(crate) fn normals(&self) -> ([i16; 3], [i16; 3]) {
        (self.normal_min, self.normal_max)
    }

    /// Gives the least and the greatest n·c of the surfels whose normal is not zero.
    pub(crate) fn offsets(&self) -> (i64, i64) {
        (self.offset_min, self.offset_max)
    }
}

/// Decides whether the surfels of two nodes face each other. Source: DESIGN.md [V-1].
pub fn facing(a: &Bounds, b: &Bounds) -> Facing {
    match (a.looks_at(&b.centroids), b.looks_at(&a.centroids)) {
        (Facing::Never, _) | (_, Facing::Never) => Facing::Never,
        (Facing::All, Facing::All) => Facing::All,
        _ => Facing::Unsure,
    }
}

/// Bounds every node of a tree, in node order; in a file of `folder` where one is given. With
/// `are_tried` segments may end at the places of [F-25], too.
///
/// # Errors
/// Those of [`Table::new`].
pub fn of_tree(
    tree: &Tree,
    discs: &[Disc],
    profile: Profile,
    are_tried: bool,
    folder: Option<&Path>,
) -> Result<Table<Bounds>, StoreError> {
    let mut bounds = Table::new(tree.nodes.len(), Bounds::NOTHING, folder)?;
    let leaves = bounds.par_iter_mut().zip(&tree.nodes).filter(|(_, node)| node.is_leaf());
    leaves.for_each(|(leaf, node)| {
        let id = node.first_surfel as usize;
        *leaf = of_leaf(&discs[id], profile);
        if are_tried {
            let places = fractions::places(&tree.surfels[id]).map(Box3::at);
            leaf.centroids = places.iter().fold(leaf.centroids, |all, place| all.join(place));
        }
    });
    // Preorder backwards: children come before their parent.
    for id in (1..tree.nodes.len()).rev() {
        let parent = tree.nodes[id].parent as usize;
        bounds[parent] = bounds[parent].join(&bounds[id]);
    }
    Ok(bounds)
}

/// Bounds a group of surfels; of none, nothing.
#[cfg(test)]
pub(crate) fn of_group(discs: &[Disc], profile: Profile) -> Bounds {
    discs.iter().map(|d| of_leaf(d, profile)).fold(Bounds::NOTHING, |a, b| a.join(&b))
}

/// Bounds a leaf.
pub(crate) fn of_leaf(disc: &Disc, profile: Profile) -> Bounds {
    let bounds = Bounds::of_disc(disc);
    match profile {
        Profile::Paper => bounds,
        // The crossing lies in the patch box too.
        Profile::Patch | Profile::Oriented => {
            Bounds { blockers: bounds.blockers.meet(&disc.limit), ..bounds }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use fastrand::Rng;
    use pvmap_geometry::Rect;
    use pvmap_geometry::normal::{self, Normal};
    use pvmap_geometry::rect::Moments;

    fn disc(rng: &mut Rng, places: &Box3) -> Disc {
        let normal = normal::rescale([0; 3].map(|_| rng.i64(-1..=1) * rng.i64(0..=9)));
        let centroid = [0, 1, 2].map(|i| rng.i32(places.min[i]..=places.max[i]));
        let width = (0..3).fold(4, |width, i| width.max(places.max[i] - places.min[i]));
        let r = rng.u64(0..=width as u64);
        Disc {
            centroid,
            normal,
            two_sided: rng.u8(0..4) == 0,
            radius2: rng.u64(0..=r * r),
            limit: Box3::at(centroid).grown(rng.i32(1..=width)),
            rect: rect(rng, normal, width),
        }
    }

    /// A rectangle of any direction in a plane, whose sides are up to so many steps from the
    /// centroid; of any plane now and then.
    pub(crate) fn rect(rng: &mut Rng, normal: Normal, width: i32) -> Rect {
        let any = rng.u8(..4) == 0;
        let normal = if any { [0; 3].map(|_| rng.i16(-99..=99)) } else { normal };
        if normal == [0; 3] {
            return Rect::NONE;
        }
        let mut moments = Moments::new(normal::rescale(normal.map(i64::from)));
        moments.add([0; 3].map(|_| rng.i64(-99..=99)));
        let mut bound = || [0; 2].map(|_| rng.i32(1 + width / 2..=width.max(1 + width / 2)));
        let (low, high) = (bound().map(|v| -v), bound());
        Rect { low, high, ..Rect::along(moments.axes()) }
    }

    /// A few discs of some part of a cube, as large as that part or smaller; with alike normals
    /// now and then, so that intervals prove something.
    pub(crate) fn group(rng: &mut Rng, size: i32) -> Vec<Disc> {
        let width = 1 << rng.u32(size.ilog2() / 2..=size.ilog2());
        let min = [0; 3].map(|_| rng.i32(0..=size - width));
        let places = Box3 { min, max: min.map(|v| v + width - 1) };
        let first = disc(rng, &places);
        let alike = rng.bool();
        (0..rng.usize(1..5))
            .map(|_| {
                let other = disc(rng, &places);
                if alike {
                    Disc { normal: first.normal, two_sided: first.two_sided, ..other }
                } else {
                    other
                }
            })
            .collect()
    }

    fn bounds(discs: &[Disc]) -> Bounds {
        of_group(discs, Profile::Patch)
    }

    #[test]
    fn v1_facing_proofs_never_contradict_brute_force() {
        let mut rng = Rng::with_seed(1);
        let mut n_proofs = [[0; 2]; 2];
        for i in 0..200_000 {
            let size = [4, 1 << 22][i % 2];
            let (a, b) = (group(&mut rng, size), group(&mut rng, size));
            let mut pairs = a.iter().flat_map(|x| b.iter().map(move |y| disc::faces_both(x, y)));
            match facing(&bounds(&a), &bounds(&b)) {
                Facing::All => {
                    assert!(pairs.all(|f| f), "{a:?} {b:?}");
                    n_proofs[i % 2][0] += 1;
                }
                Facing::Never => {
                    assert!(!pairs.any(|f| f), "{a:?} {b:?}");
                    n_proofs[i % 2][1] += 1;
                }
                Facing::Unsure => {}
            }
        }
        assert!(n_proofs.as_flattened().iter().all(|&n| n > 1000), "{n_proofs:?}");
    }
}
