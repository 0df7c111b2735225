//! Rays at what mirrors and lets light through: where they go on, and what they hit next.

use std::f64::consts::PI;

use pvmap_query::Map;
use pvmap_vmap::light::Gloss;

use crate::element::Elements;
use crate::error::LightError;
use crate::incident::Air;
use crate::surroundings::{SAME_SURFACE, Surroundings};
use crate::vector::{add, beside, dot, norm, scale, sub};

/// Radii of an element within which normals around a place are averaged.
pub(crate) const SPREAD_RADII: f64 = 2.5;
/// Radii of an element within which a ray that leaves it does not hit its own surface.
const OWN_RADII: f64 = 2.0;
/// Radii by which a ray goes on behind a hit that is of its own surface, and at least so many steps
/// of the grid.
const STEP_RADII: f64 = 0.1;
const LEAST_STEPS: f64 = 4.0;
/// Radii by which rays are moved aside to see whether one slipped between two patches.
const ASIDE_RADII: f64 = 0.5;
/// A ray with less than this cosine to a surface is mirrored: of glass some 60 % is.
const GRAZING: f64 = 0.1;
/// Hits of its own surface that a ray passes one by one, at the most.
const MAX_PASSED: u32 = 32;

/// Surfaces as rays meet them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Optics<'a> {
    pub(crate) map: &'a Map<'a>,
    pub(crate) elements: &'a Elements,
    pub(crate) gloss: &'a [Gloss],
    pub(crate) surroundings: &'a Surroundings,
    /// Whether light goes through what lets it.
    pub(crate) refracts: bool,
}

/// How light goes on at a place: a direction of length 1, and the share of what arrives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Branch {
    pub(crate) direction: [f64; 3],
    pub(crate) share: f64,
}

impl Optics<'_> {
    /// Gives the share of light that an element mirrors or lets through.
    pub(crate) fn taken(&self, id: u32) -> f64 {
        let gloss = &self.gloss[id as usize];
        f64::from(gloss.specular) + self.through(gloss)
    }

    fn through(&self, gloss: &Gloss) -> f64 {
        if self.refracts { f64::from(gloss.transmissive) } else { 0.0 }
    }

    /// Says whether light along a direction arrives on the side of an element's normal.
    pub(crate) fn is_before(&self, id: u32, along: [f64; 3]) -> bool {
        dot(along, self.elements.get(id as usize).normal) <= 0.0
    }

    /// Says whether light along a direction arrives at the back of an element that has one side and
    /// lets none through.
    pub(crate) fn is_behind(&self, id: u32, along: [f64; 3]) -> bool {
        let element = self.elements.get(id as usize);
        let is_open = self.through(&self.gloss[id as usize]) > 0.0;
        !element.two_sided && !is_open && !self.is_before(id, along)
    }

    /// Gives how light along a direction of length 1 goes on at a place of an element: mirrored,
    /// and where some of it goes through refracted. The shares add up to [`Optics::taken`].
    ///
    /// Light is on the side of the element's normal if it `is_before` it, whatever the normals
    /// around say of a ray that grazes: so it never gets through what it is mirrored by.
    pub(crate) fn branches(
        &self,
        (id, is_before): (u32, bool),
        place: [f64; 3],
        along: [f64; 3],
    ) -> [Branch; 2] {
        let gloss = &self.gloss[id as usize];
        let normal = self.surroundings.normal_at(place, id, SPREAD_RADII);
        let facing = if is_before { normal } else { scale(normal, -1.0) };
        let cosine = (-dot(along, facing)).max(0.0);
        let mirrored = add(along, scale(facing, 2.0 * cosine));
        let through = self.through(gloss);
        let index = f64::from(gloss.refraction).max(1.0);
        // Normals look out of what is denser.
        let eta = if is_before { 1.0 / index } else { index };
        let (reflected, inner) = if cosine < GRAZING { (1.0, 0.0) } else { fresnel(cosine, eta) };
        let refracted = add(scale(along, eta), scale(facing, eta * cosine - inner));
        let [mirror, lens] =
            [f64::from(gloss.specular) + through * reflected, through * (1.0 - reflected)];
        [
            Branch { direction: mirrored, share: mirror },
            Branch { direction: refracted, share: lens },
        ]
    }

    /// Gives the element that a ray from a place of another hits first, and where.
    ///
    /// Patches of neighbours leave a thousandth of a surface open: a ray that hits nothing, or a
    /// back, goes with those beside it if three of four hit a face.
    pub(crate) fn next_hit(
        &self,
        of: u32,
        place: [f64; 3],
        direction: [f64; 3],
    ) -> Result<Option<(u32, [f64; 3])>, LightError> {
        let hit = self.hit_past_own(of, place, direction)?;
        let is_face = |hit: &(u32, [f64; 3])| !self.is_behind(hit.0, direction);
        if hit.as_ref().is_some_and(is_face) {
            return Ok(hit);
        }
        let aside = ASIDE_RADII * self.radius(of);
        let mut found = None;
        let mut n_faces = 0;
        // Gaps lie along the axes, as do these two as a rule: between them one leaves a gap.
        let [u, v] = beside(direction).map(|v| scale(v, 0.5f64.sqrt()));
        for side in [add(u, v), sub(u, v)].into_iter().flat_map(|v| [v, scale(v, -1.0)]) {
            let from = add(place, scale(side, aside));
            let near = self.hit_past_own(of, from, direction)?.filter(is_face);
            n_faces += u32::from(near.is_some());
            found = found.or(near);
        }
        Ok(if n_faces >= 3 { found } else { hit })
    }

    /// Gives what a ray from a place of an element hits beyond the surface around it.
    ///
    /// Discs of one surface overlap, so that a ray meets neighbours of where it starts: these it
    /// passes, but nothing else, however near that is.
    fn hit_past_own(
        &self,
        of: u32,
        place: [f64; 3],
        direction: [f64; 3],
    ) -> Result<Option<(u32, [f64; 3])>, LightError> {
        let air = Air::new(self.map, self.elements);
        let own = OWN_RADII * self.radius(of);
        let unit = self.map.view().frame().frame.unit();
        let step = (STEP_RADII * self.radius(of)).max(LEAST_STEPS * unit);
        let mut away = step;
        for _ in 0..MAX_PASSED {
            let from = add(place, scale(direction, away));
            let Some((hit, there)) = air.first_hit(from, direction)? else { return Ok(None) };
            let distance = norm(sub(there, place));
            if distance >= own || !self.is_same_surface(of, hit) {
                return Ok(Some((hit, there)));
            }
            away = distance.max(away) + step;
        }
        air.first_hit(add(place, scale(direction, own)), direction)
    }

    fn is_same_surface(&self, a: u32, b: u32) -> bool {
        let [a, b] = [a, b].map(|id| self.elements.get(id as usize));
        let along = dot(a.normal, b.normal);
        let along = if a.two_sided || b.two_sided { along.abs() } else { along };
        along >= SAME_SURFACE
    }

    /// Gives the radius of a disc with the area of an element.
    pub(crate) fn radius(&self, id: u32) -> f64 {
        (self.elements.areas()[id as usize] / PI).sqrt()
    }
}

/// Gives the share of unpolarised light that is reflected, and the cosine of the rest behind the
/// surface; 1 and 0 where all is.
fn fresnel(cosine: f64, eta: f64) -> (f64, f64) {
    let sin2 = eta * eta * (1.0 - cosine * cosine);
    if sin2 >= 1.0 {
        return (1.0, 0.0);
    }
    let inner = (1.0 - sin2).sqrt();
    let across = (eta * cosine - inner) / (eta * cosine + inner);
    let along = (cosine - eta * inner) / (cosine + eta * inner);
    (0.5 * (across * across + along * along), inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vector::cross;

    #[test]
    fn glass_reflects_four_per_cent_ahead_and_all_at_a_slant() {
        let (ahead, inner) = fresnel(1.0, 1.0 / 1.5);
        assert!((ahead - 0.04).abs() < 1e-15 && inner == 1.0);
        // Out of the glass beyond 41.8°.
        assert_eq!(fresnel(42f64.to_radians().cos(), 1.5), (1.0, 0.0));
        assert!(fresnel(41f64.to_radians().cos(), 1.5).0 < 1.0);
        assert!((fresnel(1e-9, 1.0 / 1.5).0 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn brewster_light_of_one_polarisation_is_not_reflected() {
        let cosine = (1.0 / (1.0 + 1.5f64 * 1.5)).sqrt();
        let (reflected, inner) = fresnel(cosine, 1.0 / 1.5);
        let across = (cosine / 1.5 - inner) / (cosine / 1.5 + inner);
        assert!((reflected - 0.5 * across * across).abs() < 1e-15);
    }

    #[test]
    fn a_mirrored_direction_has_the_same_slant() {
        let (along, normal) = ([0.6, 0.0, -0.8], [0.0, 0.0, 1.0]);
        let mirrored = add(along, scale(normal, -2.0 * dot(along, normal)));
        assert_eq!(mirrored, [0.6, 0.0, 0.8]);
        assert_eq!(cross(mirrored, along), cross([0.6, 0.0, 0.8], along));
    }
}
