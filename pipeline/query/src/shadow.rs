//! Whether a light reaches a place: lit, penumbra, umbra.

use pvmap_geometry::Box3;
use pvmap_geometry::disc::faces_both;
use pvmap_vmap::Node;

use crate::between::Walk;
use crate::error::{QueryError, commas};
use crate::locate::Located;
use crate::map::Map;
use crate::part::{Holds, Part};
use crate::region::{Counted, Sight};
use crate::segment::{in_the_air, near_grid};
use crate::visible_from::is_behind;

/// What shines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Light<'l> {
    /// A surfel.
    Surfel(&'l Located),
    /// A place in the air, world units; it shines everywhere. One that is farther than a cube's
    /// side outside the cube is brought that near along its line to the surfel that it lights.
    Air([f64; 3]),
    /// The points of all surfels whose centroids lie in a box, world units: lowest and highest
    /// corner.
    Box([f64; 3], [f64; 3]),
    /// So many points of some surfels: ids, rising, with how many points of each.
    Points(&'l [(u32, u64)]),
    /// A light of many points that has been found before.
    Source(&'l LightSource),
}

/// A light of many points, found once and asked from many places.
#[derive(Debug)]
pub struct LightSource(Part);

impl PartialEq for LightSource {
    fn eq(&self, other: &LightSource) -> bool {
        std::ptr::eq(self, other)
    }
}

/// How much of a light reaches a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShadowAnswer {
    /// All of its points (lit), a share of them (penumbra), none (umbra).
    pub reaches: Sight,
    /// Surfels of the light; 0 for a light in the air.
    pub n_surfels: u32,
    /// Points of the light that count: 1 for a light in the air or a surfel.
    pub n_points: u64,
    /// What stands in the way of a light in the air; none where the place looks away from it, too.
    pub blocker: Option<u32>,
    /// Links that were counted.
    pub n_links: u64,
    /// Nodes that were looked at.
    pub n_nodes: u64,
}

impl Map<'_> {
    /// Says how much of a light reaches a located place.
    ///
    /// Of a light of many points it is the share of them that the place's surfel sees, by whole
    /// links; its own points it sees [V-6]. For a light in the air [V-1]…[V-3] decide, with the
    /// light's grid position as a surfel without a normal or a size.
    ///
    /// # Errors
    /// Where a light is no place or has no points, or the map is damaged.
    pub fn shadow(&self, place: &Located, light: &Light<'_>) -> Result<ShadowAnswer, QueryError> {
        match *light {
            Light::Surfel(lamp) => {
                let pair = self.pair(place, lamp)?;
                Ok(ShadowAnswer {
                    reaches: if pair.visible { Sight::All } else { Sight::None },
                    n_surfels: 1,
                    n_points: 1,
                    blocker: None,
                    n_links: u64::from(pair.link.is_some()),
                    n_nodes: 0,
                })
            }
            Light::Air(position) => self.shadow_from_air(place, position),
            Light::Box(..) | Light::Points(_) => {
                self.shadow_of_source(place, &self.light_source(light)?)
            }
            Light::Source(source) => self.shadow_of_source(place, source),
        }
    }

    /// Finds a light of many points: the surfels of a box, or points of surfels.
    ///
    /// # Errors
    /// Where the light has no points or is a single place, or the map is damaged.
    pub fn light_source(&self, light: &Light<'_>) -> Result<LightSource, QueryError> {
        let part = match *light {
            Light::Box(low, high) => self.part_in_box(low, high)?,
            Light::Points(points) => {
                let rises = points.is_sorted_by(|a, b| a.0 < b.0);
                let known = points.last().is_some_and(|p| p.0 < self.view().summary().n_surfels);
                if !rises || !known {
                    let what = "in the light, or its list does not rise";
                    return Err(QueryError::NothingThere(what.to_owned()));
                }
                Part::weighted(self, points)?
            }
            Light::Surfel(_) | Light::Air(_) | Light::Source(_) => {
                return Err(QueryError::NothingThere("in a light that is one place".to_owned()));
            }
        };
        Ok(LightSource(part))
    }

    fn shadow_from_air(
        &self,
        place: &Located,
        position: [f64; 3],
    ) -> Result<ShadowAnswer, QueryError> {
        let (_, surfel) = self.leaf_of(place)?;
        let steps = self.view().frame().frame.steps_of_query(position);
        if !position.iter().chain(&steps).all(|v| v.is_finite()) {
            return Err(QueryError::NoPlace(position));
        }
        let air = near_grid(steps, surfel.centroid);
        let disc = self.disc_of(place.surfel, &surfel)?;
        let mut n_nodes = 0;
        let lamp = in_the_air(air);
        let faces = faces_both(&disc, &lamp);
        let blocker = match faces {
            true => self.blocker([place.surfel; 2], &disc, &lamp, &mut n_nodes)?,
            false => None,
        };
        let reaches = if faces && blocker.is_none() { Sight::All } else { Sight::None };
        Ok(ShadowAnswer { reaches, n_surfels: 0, n_points: 1, blocker, n_links: 0, n_nodes })
    }

    fn shadow_of_source(
        &self,
        place: &Located,
        LightSource(light): &LightSource,
    ) -> Result<ShadowAnswer, QueryError> {
        let (leaf, surfel) = self.leaf_of(place)?;
        let own = Part::weighted(self, &[(place.surfel, 1)])?;
        let walk = Walk { map: self, from: &own, to: light, skip: &|_| false };
        let later = walk.run::<Counted>()?;
        // Links to earlier surfels stand in lists all over the light, but none behind the surfel.
        let behind = |node: &Node| !self.is_coarse() && is_behind(&surfel, &node.cell());
        let walk = Walk { map: self, from: light, to: &own, skip: &behind };
        let found = later.and(walk.run::<Counted>()?);
        let n_own = u128::from(light.n_points_under(&leaf));
        let n_visible = found.n_visible.saturating_add(n_own);
        Ok(ShadowAnswer {
            reaches: Sight::of(n_visible, light.n_points().into()),
            n_surfels: light.n_surfels(),
            n_points: light.n_points(),
            blocker: None,
            n_links: found.n_links,
            n_nodes: found.n_nodes,
        })
    }

    /// Makes the part of a box. The box ends at whole grid steps, rounded down as points are.
    fn part_in_box(&self, low: [f64; 3], high: [f64; 3]) -> Result<Part, QueryError> {
        let steps = |corner: [f64; 3]| {
            if corner.iter().any(|v| v.is_nan()) {
                return Err(QueryError::NoPlace(corner));
            }
            let steps = self.view().frame().frame.steps_of_query(corner);
            // A step outside the cube is as far out as any.
            Ok(steps.map(|v| v.floor().clamp(-1.0, f64::from(1 << 22)) as i32))
        };
        let limit = Box3 { min: steps(low)?, max: steps(high)? };
        let cell = |cell: &Box3| {
            let both = limit.meet(cell);
            if both.is_empty() {
                Holds::Nothing
            } else if both == *cell {
                Holds::All
            } else {
                Holds::Some
            }
        };
        let part = Part::of_space(self, cell, |c| !limit.meet(&Box3::at(c)).is_empty())?;
        if part.n_surfels() == 0 {
            let there = format!("in the box from {} to {}", commas(&low), commas(&high));
            return Err(QueryError::NothingThere(there));
        }
        Ok(part)
    }
}
