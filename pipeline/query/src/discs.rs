//! All discs in memory, under a tree of the boxes in which they block.

use pvmap_geometry::Box3;
use pvmap_geometry::disc::{self, Disc, Profile, half_sides, segment_meets};
use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, MapView};
use rayon::prelude::*;

use crate::map::Map;

/// A node of the tree: all that is below it stands before `end`.
#[derive(Debug, Clone, Copy)]
struct Bound {
    /// Holds every place at which a disc below blocks.
    limit: Box3,
    end: u32,
    /// The surfel of a leaf; elsewhere that of the first leaf below.
    surfel: u32,
}

/// The discs of a map.
#[derive(Debug)]
pub(crate) struct Discs {
    profile: Profile,
    /// In the order of their surfels.
    discs: Vec<Disc>,
    /// In the order of the nodes: preorder.
    bounds: Vec<Bound>,
}

/// Gives a box that holds every place at which a disc blocks: with profile `paper` it may reach
/// beyond the cell, which the segment has to meet besides. [V-2]
fn limit_of(profile: Profile, k: &Disc) -> Box3 {
    if k.normal == [0; 3] {
        return Box3::EMPTY;
    }
    let half = half_sides(k.normal, k.radius2);
    let around = Box3 {
        min: [0, 1, 2].map(|i| k.centroid[i] - half[i]),
        max: [0, 1, 2].map(|i| k.centroid[i] + half[i]),
    };
    match profile {
        Profile::Patch | Profile::Oriented => around.meet(&k.limit),
        Profile::Paper => around,
    }
}

impl Discs {
    /// Says how much memory a map takes here at the most.
    pub(crate) fn held_bytes(view: &MapView<'_>) -> u64 {
        let of_discs = u64::from(view.summary().n_surfels) * size_of::<Disc>() as u64;
        let of_bounds = u64::from(view.n_nodes()) * size_of::<Bound>() as u64;
        // Threads make pieces that are then joined.
        2 * (of_discs + of_bounds)
    }

    /// Reads all surfels.
    pub(crate) fn of(map: &Map<'_>) -> Result<Discs, FormatError> {
        let (view, profile) = (map.view(), map.profile());
        map.root()?;
        let ids = 0..view.summary().n_surfels;
        let disc = |id: u32| map.disc_of(id, &map.surfel(id)?);
        let discs: Vec<Disc> = ids.into_par_iter().map(disc).collect::<Result<_, _>>()?;
        let bound = |id: u32| {
            let node = view.node(id)?;
            // What is below a node is what its end says, or leaves would be passed over.
            map.children(id, node).try_for_each(|child| child.map(drop))?;
            let limit = match node.is_leaf() {
                true => {
                    map.surfel_of(id, &node)?;
                    limit_of(profile, &discs[node.first_surfel as usize])
                }
                false => Box3::EMPTY,
            };
            Ok(Bound { limit, end: node.end, surfel: node.first_surfel })
        };
        let mut bounds: Vec<Bound> =
            (0..view.n_nodes()).into_par_iter().map(bound).collect::<Result<_, FormatError>>()?;
        // Backwards in preorder all that is below a node comes before it; a parent has a lower id.
        for id in (1..view.n_nodes()).rev() {
            let limit = bounds[id as usize].limit;
            let above = &mut bounds[view.parent(id)? as usize].limit;
            *above = above.join(&limit);
        }
        Ok(Discs { profile, discs, bounds })
    }

    /// Gives the disc of a surfel.
    #[inline]
    pub(crate) fn disc(&self, surfel: u32) -> &Disc {
        &self.discs[surfel as usize]
    }

    /// Finds the first surfel that blocks between two discs, apart from two of them.
    pub(crate) fn blocker(&self, ends: [&Disc; 2], spared: [u32; 2]) -> Option<u32> {
        let [a, b] = ends;
        let mut next = 0;
        while let Some(bound) = self.bounds.get(next) {
            if !segment_meets(a.centroid, b.centroid, &bound.limit) {
                next = bound.end as usize;
                continue;
            }
            next += 1;
            let is_leaf = bound.end as usize == next;
            if is_leaf
                && !spared.contains(&bound.surfel)
                && disc::blocks(self.profile, a, b, self.disc(bound.surfel))
            {
                return Some(bound.surfel);
            }
        }
        None
    }
}
