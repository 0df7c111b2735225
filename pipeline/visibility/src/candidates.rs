//! Candidate occluders of a node pair: the nodes that may hold a blocker, fewer and smaller as the
//! pair shrinks. What is dropped is proved not to block any segment of the pair.
//!
//! Nodes are asked together with their siblings, a lane each ([`Family`]).

use std::ops::Range;
use std::path::Path;

use multiversion::multiversion;
use pvmap_geometry::Box3;
use pvmap_geometry::shaft::Shaft;
use pvmap_store::{StoreError, Table};
use pvmap_vmap::Tree;

use crate::bounds::Bounds;
use crate::lanes::{all_bits, bits, greater, less, mask_of};
use crate::sheets::Sheets;

/// Children of a node at most.
const MAX_CHILDREN: usize = 8;

/// What the culling asks of the children of a node: it is asked some hundred million times.
#[derive(Debug, Clone, Copy)]
pub struct Family {
    /// Of every place at which a surfel under the child can block.
    low: [[i32; MAX_CHILDREN]; 3],
    high: [[i32; MAX_CHILDREN]; 3],
    /// Least and greatest of each component of the normals under it.
    least: [[i16; MAX_CHILDREN]; 3],
    greatest: [[i16; MAX_CHILDREN]; 3],
    /// Bounds of n·c over the surfels under it.
    offset: [[f64; MAX_CHILDREN]; 2],
    /// The family of each child, of a leaf the surfel.
    below: [u32; MAX_CHILDREN],
    /// Their level, one for all.
    level: u8,
    /// Children that are leaves, and children under which some surfel can block, a bit each.
    leaves: u8,
    blockers: u8,
    /// Children that are sheets.
    sheets: u8,
}

impl Family {
    const EMPTY: Family = Family {
        low: [[0; MAX_CHILDREN]; 3],
        high: [[0; MAX_CHILDREN]; 3],
        least: [[0; MAX_CHILDREN]; 3],
        greatest: [[0; MAX_CHILDREN]; 3],
        offset: [[0.0; MAX_CHILDREN]; 2],
        below: [0; MAX_CHILDREN],
        level: 0,
        leaves: 0,
        blockers: 0,
        sheets: 0,
    };

    fn set(&mut self, k: usize, below: u32, bounds: &Bounds) {
        self.below[k] = below;
        if !bounds.can_block() {
            return;
        }
        let (least, greatest) = bounds.normals();
        for i in 0..3 {
            self.low[i][k] = bounds.blockers.min[i];
            self.high[i][k] = bounds.blockers.max[i];
            self.least[i][k] = least[i];
            self.greatest[i][k] = greatest[i];
        }
        let (near, far) = bounds.offsets();
        (self.offset[0][k], self.offset[1][k]) = (near as f64, far as f64);
        self.blockers |= 1 << k;
    }

    #[inline(always)]
    fn box_of(&self, k: usize) -> Box3 {
        Box3 {
            min: [self.low[0][k], self.low[1][k], self.low[2][k]],
            max: [self.high[0][k], self.high[1][k], self.high[2][k]],
        }
    }
}

/// Some children of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kept {
    family: u32,
    /// A bit a child.
    children: u8,
}

/// Makes the families of all inner nodes, the root's first, in node order; in a file of `folder`
/// where one is given.
///
/// # Errors
/// Those of [`Table::new`].
pub fn families(
    tree: &Tree,
    bounds: &[Bounds],
    sheets: &Sheets,
    folder: Option<&Path>,
) -> Result<Table<Family>, StoreError> {
    let n_nodes = tree.nodes.len();
    let mut of_node = Table::new(n_nodes, 0, folder)?;
    let mut n_families = 0;
    for (family, node) in of_node.iter_mut().zip(&tree.nodes) {
        *family = n_families;
        n_families += u32::from(!node.is_leaf());
    }
    let mut families = Table::new(n_families as usize, Family::EMPTY, folder)?;
    let inner = (0..n_nodes as u32).filter(|&id| !tree.nodes[id as usize].is_leaf());
    for (id, family) in inner.zip(families.iter_mut()) {
        for (k, child) in tree.children(id).enumerate() {
            let node = &tree.nodes[child as usize];
            let below = if node.is_leaf() { node.first_surfel } else { of_node[child as usize] };
            family.set(k, below, &bounds[child as usize]);
            family.level = node.level;
            let is_sheet = !node.is_leaf() && sheets.of_family(below).is_some();
            family.leaves |= u8::from(node.is_leaf()) << k;
            family.sheets |= u8::from(is_sheet) << k;
        }
    }
    Ok(families)
}

/// The list of a pair of which nothing is known yet: everything.
pub fn everything(families: &[Family], list: &mut Vec<Kept>) {
    list.clear();
    list.extend(families.first().map(|_| Kept { family: 0, children: u8::MAX }));
}

/// Gives the list of everything under a family.
pub fn all_of(family: u32) -> Kept {
    Kept { family, children: u8::MAX }
}

/// Walks the families of the sheets of a list.
pub fn sheets_of<'a>(families: &'a [Family], list: &'a [Kept]) -> impl Iterator<Item = u32> + 'a {
    list.iter().flat_map(|kept| {
        let family = &families[kept.family as usize];
        bits((kept.children & family.sheets).into()).map(|k| family.below[k])
    })
}

/// Walks the surfels of the leaves of a list, each with the box of all places at which it can
/// block.
pub fn blockers_of<'a>(
    families: &'a [Family],
    list: &'a [Kept],
) -> impl Iterator<Item = (u32, Box3)> {
    list.iter().flat_map(|kept| {
        let family = &families[kept.family as usize];
        bits((kept.children & family.leaves).into()).map(|k| (family.below[k], family.box_of(k)))
    })
}

/// The two ends of all segments of a pair, and what can lie between them.
#[derive(Debug)]
pub struct Corridor {
    /// The box of each end.
    ends: [Doubled; 2],
    shaft: Shaft,
}

impl Corridor {
    /// Spans the segments between two boxes of centroids.
    pub fn new(a: &Box3, b: &Box3) -> Corridor {
        Corridor { ends: [Doubled::new(a), Doubled::new(b)], shaft: Shaft::new(a, b) }
    }

    /// Finds the children under which some surfel may block a segment, a bit each: the others are
    /// off the shaft, or have all their planes beside both ends.
    #[inline(always)]
    fn admits(&self, family: &Family) -> u8 {
        let mut met = [0; MAX_CHILDREN];
        for k in 0..MAX_CHILDREN {
            met[k] = all_bits(!self.shaft.misses(&family.box_of(k)));
        }
        if mask_of(&met) as u8 & family.blockers == 0 {
            return 0;
        }
        let mut admitted = [0; MAX_CHILDREN];
        for k in 0..MAX_CHILDREN {
            let blockers = family.box_of(k);
            let (low_a, high_a) = beside(family, k, &blockers, &self.ends[0]);
            let (low_b, high_b) = beside(family, k, &blockers, &self.ends[1]);
            let above = (low_a >= 0.0) & (low_b >= 0.0);
            let below = (high_a <= 0.0) & (high_b <= 0.0);
            admitted[k] = all_bits(!(above | below)) & met[k];
        }
        mask_of(&admitted) as u8 & family.blockers
    }
}

/// Bounds n·(x - c), four times over, for the places x of an end and the planes under a child: by
/// n·c, which is sharp where the normals are alike, and by the directions from the child to the end
/// (every centroid is where its disc can block), which is sharp where they are not. Every number is
/// an integer below 2^44, so the f64 arithmetic is exact.
#[inline(always)]
fn beside(family: &Family, k: usize, blockers: &Box3, end: &Doubled) -> (f64, f64) {
    let from = Doubled::new(blockers);
    let away = Doubled {
        sum: [end.sum[0] - from.sum[0], end.sum[1] - from.sum[1], end.sum[2] - from.sum[2]],
        size: [end.size[0] + from.size[0], end.size[1] + from.size[1], end.size[2] + from.size[2]],
    };
    let (place, place_half) = along(family, k, end);
    let (direction, direction_half) = along(family, k, &away);
    let low = place - place_half - 4.0 * family.offset[1][k];
    let high = place + place_half - 4.0 * family.offset[0][k];
    (greater(low, direction - direction_half), less(high, direction + direction_half))
}

/// Bounds n·v, four times over, for the interval of normals under a child and a box of vectors;
/// gives the middle and the half range.
#[inline(always)]
fn along(family: &Family, k: usize, v: &Doubled) -> (f64, f64) {
    let (mut middle, mut half) = (0.0, 0.0);
    for i in 0..3 {
        let (low, high) = (f64::from(family.least[i][k]), f64::from(family.greatest[i][k]));
        let (n, spread) = (high + low, high - low);
        middle += n * v.sum[i];
        half += n.abs() * v.size[i] + spread * (v.sum[i].abs() + v.size[i]);
    }
    (middle, half)
}

/// A box by the sum and the difference of its corners: twice its middle, twice its half sides.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Doubled {
    /// max + min, an axis each.
    sum: [f64; 3],
    /// max - min, an axis each.
    size: [f64; 3],
}

impl Doubled {
    /// Doubles a box. Its corners are below 2^24.
    #[inline(always)]
    fn new(b: &Box3) -> Doubled {
        // As floats from the start: whole numbers that may overflow are not added in vectors.
        let low = [f64::from(b.min[0]), f64::from(b.min[1]), f64::from(b.min[2])];
        let high = [f64::from(b.max[0]), f64::from(b.max[1]), f64::from(b.max[2])];
        Doubled {
            sum: [high[0] + low[0], high[1] + low[1], high[2] + low[2]],
            size: [high[0] - low[0], high[1] - low[1], high[2] - low[2]],
        }
    }
}

/// How far candidates are opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// To the cells of this level: about the size of the pair at hand.
    Level(u8),
    /// To leaves and sheets.
    Sheets,
    /// To leaves.
    Leaves,
}

/// Refines a list for a smaller pair: drops what cannot block, opens what is larger than `depth`
/// asks, and appends the rest to `list` (the old list is `list[from]`). Gives the nodes tested.
#[multiversion(targets = "simd")]
pub fn refine(
    families: &[Family],
    corridor: &Corridor,
    depth: Depth,
    list: &mut Vec<Kept>,
    from: Range<usize>,
) -> u64 {
    let mut n_tested = 0;
    // What is opened waits here; a tree is at most 24 deep, each level leaves at most 7 behind.
    let mut opened = [0u32; 8 * 24];
    for i in from {
        let Kept { family: root, children } = list[i];
        let (mut id, mut asked, mut n_opened) = (root, children, 0);
        loop {
            let family = &families[id as usize];
            n_tested += u64::from(asked.count_ones());
            let admitted = corridor.admits(family) & asked;
            let ends = match depth {
                Depth::Level(level) if family.level > level => u8::MAX,
                Depth::Level(_) | Depth::Sheets => family.leaves | family.sheets,
                Depth::Leaves => family.leaves,
            };
            let kept = admitted & ends;
            if kept != 0 {
                list.push(Kept { family: id, children: kept });
            }
            // The last child is opened first: push them backwards.
            let mut open = admitted & !kept;
            while open != 0 {
                let k = 7 - open.leading_zeros() as usize;
                open &= !(1 << k);
                opened[n_opened] = family.below[k];
                n_opened += 1;
            }
            if n_opened == 0 {
                break;
            }
            n_opened -= 1;
            (id, asked) = (opened[n_opened], u8::MAX);
        }
    }
    n_tested
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bounds;
    use fastrand::Rng;
    use pvmap_geometry::disc::{self, Disc, Profile};

    /// A family with one child, over a disc each: enough of a tree to cull a group.
    fn family(discs: &[Disc], profile: Profile) -> (Family, Bounds) {
        let bound = bounds::of_group(discs, profile);
        let mut family = Family::EMPTY;
        family.set(5, 1, &bound);
        (family, bound)
    }

    #[test]
    fn v2_what_a_corridor_excludes_never_blocks() {
        let mut rng = Rng::with_seed(4);
        let (mut n_proofs, mut n_blocked) = ([0; 2], [0; 2]);
        for i in 0..200_000 {
            let size = [16, 1 << 22][i % 2];
            let [a, b, k] = [0; 3].map(|_| bounds::tests::group(&mut rng, size));
            for profile in [Profile::Paper, Profile::Patch, Profile::Oriented] {
                let [(_, bound_a), (_, bound_b)] = [&a, &b].map(|g| family(g, profile));
                let (children, _) = family(&k, profile);
                let is_excluded =
                    Corridor::new(&bound_a.centroids, &bound_b.centroids).admits(&children) == 0;
                let mut segments = a.iter().flat_map(|x| b.iter().map(move |y| (x, y)));
                let is_blocked =
                    segments.any(|(x, y)| k.iter().any(|k| disc::blocks(profile, x, y, k)));
                assert!(!(is_excluded && is_blocked), "{profile:?} {a:?} {b:?} {k:?}");
                n_proofs[i % 2] += usize::from(is_excluded);
                n_blocked[i % 2] += usize::from(is_blocked);
            }
        }
        let found = format!("{n_proofs:?} excluded, {n_blocked:?} blocked");
        assert!(n_proofs.into_iter().chain(n_blocked).all(|n| n > 5_000), "{found}");
    }
}
