//! What an eye sees in mirrors and through lenses: rays that are followed to what scatters light.

use std::sync::Arc;

use pvmap_query::Map;
use pvmap_vmap::light::Gloss;

use crate::element::{Elements, Record};
use crate::error::LightError;
use crate::fmm::bounds::Bounds;
use crate::hierarchy::{Hierarchy, Subtree};
use crate::incident::Air;
use crate::optics::{Optics, SPREAD_RADII};
use crate::surroundings::Surroundings;
use crate::vector::{add, norm, scale, sub};

/// Glossy surfaces that a ray meets at the most.
const MAX_DEPTH: u32 = 6;
/// Branches that bring less than this share of what is seen are not followed.
const LEAST_SHARE: f64 = 1.0 / 512.0;

/// Who may ask what is seen in what mirrors or lets light through.
#[derive(Debug)]
pub struct Glimpses<'a> {
    map: &'a Map<'a>,
    elements: Arc<Elements>,
    gloss: Vec<Gloss>,
    surroundings: Surroundings,
}

/// A place that a ray has come to, in world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenAt {
    /// The surfel.
    pub surfel: u32,
    /// Where on it.
    pub place: [f64; 3],
    /// The normal there, of length 1, as that of the surfel.
    pub normal: [f64; 3],
}

/// What is seen.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Glimpse {
    /// Red, green and blue, of what is seen times its share.
    pub light: [f64; 3],
    /// Rays that were traced.
    pub n_rays: u64,
}

/// A ray on its way.
#[derive(Debug, Clone, Copy)]
struct Ray {
    surfel: u32,
    place: [f64; 3],
    direction: [f64; 3],
    share: f64,
    depth: u32,
}

impl<'a> Glimpses<'a> {
    /// Takes a map whose discs close surfaces ([`Map::solid`]), its elements, and what each of its
    /// surfels mirrors and lets through.
    ///
    /// # Errors
    /// Where there are not as many values as surfels, or the map is damaged.
    pub fn new(
        map: &'a Map<'a>,
        elements: Elements,
        gloss: Vec<Gloss>,
    ) -> Result<Glimpses<'a>, LightError> {
        let elements = Arc::new(elements);
        let (found, expected) = (gloss.len(), elements.len());
        if found != expected {
            return Err(LightError::Count { what: "gloss", found, expected });
        }
        let hierarchy = Hierarchy::of_map(map.view())?;
        let surroundings = Surroundings::new(Arc::clone(&elements), hierarchy);
        Ok(Glimpses { map, elements, gloss, surroundings })
    }

    /// Gives the bytes held for a map of so many surfels and nodes, and while they are read, about.
    pub fn held_bytes(n_surfels: u32, n_nodes: u32) -> u64 {
        // An area more: those that elements are made with.
        let of_surfel = size_of::<Record<f64>>() + size_of::<Gloss>() + size_of::<f64>();
        let of_node = size_of::<Subtree>() + size_of::<Bounds>();
        u64::from(n_surfels) * of_surfel as u64 + u64::from(n_nodes) * of_node as u64
    }

    /// Says whether a surfel mirrors or lets light through.
    pub fn is_glossy(&self, surfel: u32) -> bool {
        self.gloss.get(surfel as usize).is_some_and(Gloss::is_any)
    }

    /// Gives what is seen by way of a place of a glossy surfel, looked at along a direction of any
    /// length; without what that surfel scatters itself. `radiosity` gives what a place scatters
    /// and emits, `sky` what comes from a direction in which nothing is, as an exitance.
    ///
    /// Both ways of a ray that is split are followed, through 6 surfaces at the most and while they
    /// bring 1/512 of what is seen.
    ///
    /// # Errors
    /// Where the map is damaged.
    ///
    /// Source: light.md §3, 6.
    pub fn look(
        &self,
        (surfel, place, direction): (u32, [f64; 3], [f64; 3]),
        radiosity: &dyn Fn(&SeenAt) -> [f64; 3],
        sky: &dyn Fn([f64; 3]) -> [f64; 3],
    ) -> Result<Glimpse, LightError> {
        let mut seen = Glimpse::default();
        let length = norm(direction);
        let is_one = self.is_glossy(surfel) && length > 0.0 && length.is_finite();
        if !is_one {
            return Ok(seen);
        }
        let origin = Air::new(self.map, &self.elements).origin();
        let optics = self.optics();
        let direction = scale(direction, 1.0 / length);
        let first = Ray { surfel, place: sub(place, origin), direction, share: 1.0, depth: 0 };
        let mut open = vec![first];
        let add_light = |seen: &mut Glimpse, light: [f64; 3], share: f64| {
            seen.light = add(seen.light, scale(light, share));
        };
        while let Some(ray) = open.pop() {
            // An eye sees faces; at the rim of a ball their normals may be off.
            let is_face = ray.depth == 0 && !self.elements.get(ray.surfel as usize).two_sided;
            let is_before = is_face || optics.is_before(ray.surfel, ray.direction);
            for branch in optics.branches((ray.surfel, is_before), ray.place, ray.direction) {
                let (share, direction) = (ray.share * branch.share, branch.direction);
                if share < LEAST_SHARE {
                    continue;
                }
                seen.n_rays += 1;
                let Some((surfel, place)) = optics.next_hit(ray.surfel, ray.place, direction)?
                else {
                    add_light(&mut seen, sky(direction), share);
                    continue;
                };
                if optics.is_behind(surfel, direction) {
                    continue;
                }
                // Glass scatters where its normal looks; from within nothing is seen of that.
                let is_facing = optics.is_before(surfel, direction);
                if is_facing || self.elements.get(surfel as usize).two_sided {
                    let normal = self.surroundings.normal_at(place, surfel, SPREAD_RADII);
                    let at = SeenAt { surfel, place: add(place, origin), normal };
                    add_light(&mut seen, radiosity(&at), share);
                }
                if self.is_glossy(surfel) && ray.depth + 1 < MAX_DEPTH {
                    open.push(Ray { surfel, place, direction, share, depth: ray.depth + 1 });
                }
            }
        }
        Ok(seen)
    }

    fn optics(&self) -> Optics<'_> {
        Optics {
            map: self.map,
            elements: &self.elements,
            gloss: &self.gloss,
            surroundings: &self.surroundings,
            refracts: true,
        }
    }
}
