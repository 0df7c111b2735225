//! From a place in the world to the surfel that stands there. Source: DESIGN.md [V-8].

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use pvmap_geometry::disc::Profile;
use pvmap_geometry::normal::{self, Normal};
use pvmap_geometry::{Box3, Frame, GridPoint, grid};
use pvmap_vmap::tree::{Nodes, RoutingKey, route};
use pvmap_vmap::{FormatError, Node, Surfel};

use crate::error::QueryError;
use crate::map::{Map, points_box};

/// A place somebody asks about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// World coordinates, in the units of the scan.
    pub position: [f64; 3],
    /// Direction of any length, to choose the side of an edge or thin wall.
    pub normal: Option<[f32; 3]>,
}

/// How far a surfel may be from a place and still answer for it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Snap {
    /// Four times the half spacing of the surfel found.
    #[default]
    FourHalfSpacings,
    /// So many world units, 0 or more.
    Within(f64),
}

/// The surfel that answers for a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Located {
    /// Its id.
    pub surfel: u32,
    /// Its leaf.
    pub node: u32,
    /// World units from the place to the surfel's patch box (profile `paper`: to the box of its
    /// points), 0 inside.
    pub distance: f64,
}

/// A place on the grid, with its quantised normal.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target {
    pub(crate) g: GridPoint,
    pub(crate) normal: Option<Normal>,
}

/// Leads a position onto the grid.
fn grid_of(frame: &Frame, position: [f64; 3]) -> Result<GridPoint, QueryError> {
    frame.grid_of_query(position).map_err(|_| QueryError::OutsideCube {
        place: position,
        min: frame.world_of_real([0.0; 3]),
        max: frame.world_of_real([f64::from(grid::GRID_MAX); 3]),
    })
}

/// Leads a place onto the grid.
pub(crate) fn target_of(frame: &Frame, place: &Place) -> Result<Target, QueryError> {
    let Place { position, normal } = *place;
    let g = grid_of(frame, position)?;
    let quantised = match normal {
        None => None,
        Some(normal) => {
            let no_direction = QueryError::Normal { place: position, normal };
            Some(normal::quantise(normal).ok_or(no_direction)?)
        }
    };
    Ok(Target { g, normal: quantised })
}

/// How well a surfel answers for a place, the best first: [V-8]'s order word by word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Fit {
    /// Squared distance to its box, grid steps².
    distance2: u64,
    /// n_k·n, |n_k·n| where the surfel is two-sided, 0 without a normal.
    along: Reverse<i64>,
    /// |n_k·(g - c_k)|.
    off_plane: u64,
    surfel: u32,
}

/// What says how well a surfel answers for a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Answering {
    /// The box that distances are taken to.
    around: Box3,
    centroid: [u32; 3],
    normal: Normal,
    two_sided: bool,
    half_spacing: u32,
}

impl Answering {
    pub(crate) fn of(surfel: &Surfel, profile: Profile) -> Answering {
        let around = match profile {
            Profile::Patch | Profile::Oriented => surfel.patch,
            Profile::Paper => points_box(surfel),
        };
        let Surfel { centroid, normal, two_sided, half_spacing, .. } = *surfel;
        Answering { around, centroid, normal, two_sided, half_spacing }
    }
}

/// A surfel with its leaf and its fit.
#[derive(Debug, Clone, Copy)]
struct Found {
    fit: Fit,
    node: u32,
    half_spacing: u32,
}

impl Map<'_> {
    /// Finds the surfel that answers for a place.
    ///
    /// With a normal the place is routed as a stored point would be. Without one, or where no
    /// leaf takes such a point, the best leaf among those whose closed cell holds the place
    /// answers, else the best of all: least distance, then the normal closest to the given one,
    /// then the nearest plane, then the lowest id. The snap limit holds for a routed leaf too.
    ///
    /// # Errors
    /// Where the place is outside the cube, its normal is no direction, the snap limit is no
    /// distance or the surfel is beyond it, the map has no surfels or is damaged.
    pub fn locate(&self, place: &Place, snap: Snap) -> Result<Located, QueryError> {
        if let Snap::Within(distance) = snap
            && (distance.is_nan() || distance < 0.0)
        {
            return Err(QueryError::SnapDistance(distance));
        }
        let target = target_of(&self.view().frame().frame, place)?;
        let found = match self.routed(&target)? {
            Some(found) => found,
            None => match self.holding(&target)? {
                Some(found) => found,
                None => self.nearest(&target)?.ok_or(QueryError::Empty)?,
            },
        };
        self.within(place, snap, &found)
    }

    /// Finds the surfel that answers for a place, or none where the place is in the air: outside
    /// the cube or beyond the snap limit.
    ///
    /// # Errors
    /// Those of [`Map::locate`] that are about something else.
    pub fn surface_at(&self, place: &Place, snap: Snap) -> Result<Option<Located>, QueryError> {
        match self.locate(place, snap) {
            Ok(located) => Ok(Some(located)),
            Err(QueryError::OutsideCube { .. } | QueryError::NoSurface { .. }) => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Leads a position onto the grid.
    pub(crate) fn grid_of(&self, position: [f64; 3]) -> Result<GridPoint, QueryError> {
        grid_of(&self.view().frame().frame, position)
    }

    /// Finds the leaf that would hold a stored point like this one.
    fn routed(&self, target: &Target) -> Result<Option<Found>, FormatError> {
        let Some(normal) = target.normal else { return Ok(None) };
        // The side of a stored normal may be unknown; then it is stored with its canonical sign.
        for oriented in [true, false] {
            let key = RoutingKey { g: target.g, normal, oriented };
            if let Some(id) = route(self.view(), &key)? {
                let leaf = self.view().node(id)?;
                return self.judge(target, id, &leaf).map(Some);
            }
        }
        Ok(None)
    }

    /// Finds the best leaf among those whose closed cell holds the place.
    fn holding(&self, target: &Target) -> Result<Option<Found>, FormatError> {
        let Some(kept) = self.kept() else {
            return self.best(target, |node| holds(&node.cell(), target.g).then_some(0));
        };
        let found = kept.leaves.holding(target.g);
        let found = found.map(|(surfel, node, answering)| fit(target, node, surfel, answering));
        Ok(found.min_by_key(|found| found.fit))
    }

    /// Finds the best of all leaves.
    fn nearest(&self, target: &Target) -> Result<Option<Found>, FormatError> {
        let g = target.g.map(|v| v as i32);
        self.best(target, |node| {
            let around = match self.profile() {
                Profile::Patch | Profile::Oriented => node.reach(),
                // A box of points never leaves its cell.
                Profile::Paper => node.cell(),
            };
            Some(around.distance2(g))
        })
    }

    /// Finds the best leaf among those under nodes that have a bound: the least squared distance
    /// any leaf below can have. The nodes of least bound are opened first.
    fn best(
        &self,
        target: &Target,
        bound: impl Fn(&Node) -> Option<u64>,
    ) -> Result<Option<Found>, FormatError> {
        let mut best: Option<Found> = None;
        let mut open = BinaryHeap::new();
        open.extend(self.root()?.and_then(|root| bound(&root)).map(|b| Reverse((b, 0))));
        while let Some(Reverse((least, id))) = open.pop() {
            // Not `>=`: among leaves at the same distance the rest of the order decides.
            if best.is_some_and(|best| least > best.fit.distance2) {
                break;
            }
            let node = self.view().node(id)?;
            if node.is_leaf() {
                let found = self.judge(target, id, &node)?;
                best = best.into_iter().chain([found]).min_by_key(|found| found.fit);
            }
            for child in self.children(id, node) {
                let (child_id, child) = child?;
                open.extend(bound(&child).map(|b| Reverse((b, child_id))));
            }
        }
        Ok(best)
    }

    /// Says how well a leaf answers.
    fn judge(&self, target: &Target, id: u32, leaf: &Node) -> Result<Found, FormatError> {
        let answering = Answering::of(&self.surfel_of(id, leaf)?, self.profile());
        Ok(fit(target, id, leaf.first_surfel, &answering))
    }

    /// Lets a surfel answer if it is within the snap limit.
    fn within(&self, place: &Place, snap: Snap, found: &Found) -> Result<Located, QueryError> {
        let unit = self.view().frame().frame.unit();
        // Below 2^53, so the float is exact before the root.
        let distance = (found.fit.distance2 as f64).sqrt() * unit;
        let four = 4 * u64::from(found.half_spacing);
        let (near, limit) = match snap {
            Snap::FourHalfSpacings => (found.fit.distance2 <= four * four, four as f64 * unit),
            Snap::Within(limit) => (distance <= limit, limit),
        };
        if !near {
            let place = place.position;
            return Err(QueryError::NoSurface { place, nearest: distance, limit });
        }
        Ok(Located { surfel: found.fit.surfel, node: found.node, distance })
    }
}

/// Says how well a surfel answers.
fn fit(target: &Target, node: u32, surfel: u32, answering: &Answering) -> Found {
    let Answering { around, centroid, normal, two_sided, half_spacing } = *answering;
    let g = target.g.map(|v| v as i32);
    let off = [0, 1, 2].map(|i| i64::from(g[i]) - i64::from(centroid[i]));
    let along = dot(normal, target.normal.unwrap_or_default().map(i64::from));
    let fit = Fit {
        distance2: around.distance2(g),
        // The sign of a two-sided surfel's normal says nothing.
        along: Reverse(if two_sided { along.abs() } else { along }),
        off_plane: dot(normal, off).unsigned_abs(),
        surfel,
    };
    Found { fit, node, half_spacing }
}

/// Decides whether a closed cell holds a place.
fn holds(cell: &Box3, g: GridPoint) -> bool {
    (0..3).all(|i| (cell.min[i]..=cell.max[i]).contains(&(g[i] as i32)))
}

fn dot(n: Normal, v: [i64; 3]) -> i64 {
    (0..3).map(|i| i64::from(n[i]) * v[i]).sum()
}
