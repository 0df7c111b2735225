//! Whether light escapes from a scene.

use std::f64::consts::{FRAC_1_SQRT_2, PI, SQRT_2};

use pvmap_store::Watch;
use rayon::prelude::*;

use crate::error::{LightError, check};
use crate::incident::{Air, FAR, N_DIRECTIONS, cosine_directions};
use crate::lighting::Lighting;
use crate::plan::Outlook;
use crate::sum::sum;
use crate::vector::{add, beside, dot, norm, scale, sub};

use super::N_LOOKED_FROM;

/// The share of directions that lead out below which a scene is closed but for these.
const CLOSED: f64 = 1e-2;
/// The part of the error asked for that the count of directions may make, and from how many
/// elements it is looked for that at the most.
const OFF: f64 = 0.25;
const MOST_LOOKED_FROM: usize = 4096;
/// The share of directions that lead out, through gaps between patches or not, above which these
/// are not told apart: the scene is open in any case.
const OPEN: f64 = 0.5;
/// Half the width of what counts as a gap, in radii of an element.
const GAP_RADII: f64 = 0.5;
/// Rays around one that leads out, and how many of them have to go on where it does: at the edge of
/// an opening two do.
const N_AROUND: usize = 4;
const LEAST_FREE: usize = 2;

/// Directions from one face of an element, and those of them that lead out.
struct Look {
    element: u32,
    normal: [f64; 3],
    leading_out: Vec<[f64; 3]>,
}

impl Lighting<'_> {
    /// Looks for ways out, and says whether the scene counts as closed but for these. What it has
    /// wrong of them makes less than the error that is asked for, if not too many looks are needed.
    pub(super) fn outlook(&self, watch: &dyn Watch) -> Result<Outlook, LightError> {
        let often = self.times_out();
        let first = self.look_out(N_LOOKED_FROM, watch)?;
        let off = OFF * self.options.error / often;
        let wanted = first.open_share / (off * off);
        if wanted <= first.n_directions as f64 || !first.is_closed {
            return Ok(first);
        }
        // `as` cuts what is too much.
        let n_elements = (wanted / N_DIRECTIONS as f64).ceil() as usize;
        self.look_out(n_elements.min(MOST_LOOKED_FROM), watch)
    }

    /// Gives how many times the share that leads out is missing in all light.
    fn times_out(&self) -> f64 {
        let rho = self.max_albedo();
        if rho < 1.0 { rho / (1.0 - rho) } else { f64::INFINITY }
    }

    fn look_out(&self, n_elements: usize, watch: &dyn Watch) -> Result<Outlook, LightError> {
        let air = Air::new(self.map, &self.elements);
        let looks = self.some(n_elements).into_iter().flat_map(|id| self.faces(id));
        let mut looks: Vec<Look> = looks.collect();
        looks.par_iter_mut().try_for_each(|look| {
            check(watch)?;
            self.look(&air, look)
        })?;
        let n_directions = (looks.len() * N_DIRECTIONS) as u64;
        let outlook = |open_share: f64| {
            let doubt =
                if open_share > 0.0 { (self.times_out() * open_share).min(1.0) } else { 0.0 };
            Outlook { open_share, n_directions, is_closed: open_share < CLOSED, doubt }
        };
        let all = self.open_share(&looks);
        if all >= OPEN {
            return Ok(outlook(all));
        }
        let half = GAP_RADII * self.usual_radius();
        looks.par_iter_mut().try_for_each(|look| {
            check(watch)?;
            let from = self.elements.get(look.element as usize).position;
            let is_way = |&direction: &[f64; 3]| {
                let face = (look.element, look.normal);
                Ok((!is_gap(&air, face, (from, direction), half)?).then_some(direction))
            };
            let ways = look.leading_out.iter().map(is_way).collect::<Result<Vec<_>, LightError>>();
            look.leading_out = ways?.into_iter().flatten().collect();
            Ok::<_, LightError>(())
        })?;
        Ok(outlook(self.open_share(&looks)))
    }

    /// Gives the faces of an element from which it is looked: both where its side is not known,
    /// none where it has no normal.
    fn faces(&self, id: u32) -> impl Iterator<Item = Look> {
        let element = self.elements.get(id as usize);
        let normals = [element.normal, scale(element.normal, -1.0)];
        let n_faces = match element.normal {
            [0.0, 0.0, 0.0] => 0,
            _ => 1 + usize::from(element.two_sided),
        };
        let look = move |normal| Look { element: id, normal, leading_out: Vec::new() };
        normals.into_iter().take(n_faces).map(look)
    }

    /// Finds the directions that lead out.
    fn look(&self, air: &Air<'_>, look: &mut Look) -> Result<(), LightError> {
        let from = self.elements.get(look.element as usize).position;
        for direction in cosine_directions(look.normal, look.element) {
            let far = add(from, scale(direction, FAR * air.extent()));
            if air.is_open(look.element, far)? {
                look.leading_out.push(direction);
            }
        }
        Ok(())
    }

    /// Gives the share of directions that lead out. Of two faces that count which sees more of the
    /// scene: the other one is the back of a wall.
    fn open_share(&self, looks: &[Look]) -> f64 {
        let rows = || {
            looks.chunk_by(|a, b| a.element == b.element).map(|faces| {
                let n_open = faces.iter().map(|face| face.leading_out.len()).min().unwrap_or(0);
                (self.elements.areas()[faces[0].element as usize], n_open)
            })
        };
        let open = sum(rows().map(|(area, n_open)| area * n_open as f64 / N_DIRECTIONS as f64));
        let looked = sum(rows().map(|(area, _)| area));
        if looked > 0.0 { open / looked } else { 1.0 }
    }

    /// Gives the radius of a disc as large as the element that a place of the scene lies on, on
    /// average.
    fn usual_radius(&self) -> f64 {
        let areas = || self.elements.areas().iter();
        let (all, squares) = (sum(areas().copied()), sum(areas().map(|area| area * area)));
        if all > 0.0 { (squares / all / PI).sqrt() } else { 0.0 }
    }
}

/// Says whether what leads out is a gap between patches, somewhere on its way no wider than twice
/// `half`: of rays around it that are so far from it there, most end about there.
///
/// Where two walls meet, or leaves have few points, patches leave gaps.
fn is_gap(
    air: &Air<'_>,
    (id, normal): (u32, [f64; 3]),
    (from, direction): ([f64; 3], [f64; 3]),
    half: f64,
) -> Result<bool, LightError> {
    // Gaps lie along the axes, as do these two as a rule: between them each ray leaves a gap.
    let [u, v] = beside(direction).map(|v| scale(v, half));
    let around: [[f64; 3]; N_AROUND] = [add(u, v), sub(u, v), scale(add(u, v), -1.0), sub(v, u)];
    let mut distance = way_out(from, direction, air.extent());
    while half > 0.0 && distance >= half {
        let is_last = distance < 2.0 * half;
        let (mut n_free, mut n_ends) = (0, 0);
        for side in around {
            let along = add(scale(direction, distance), side);
            let at = |times: f64| add(from, scale(along, times * distance / norm(along)));
            if air.is_open(id, at(SQRT_2))? {
                n_free += 1;
            } else if is_last || dot(along, normal) <= 0.0 || air.is_open(id, at(FRAC_1_SQRT_2))? {
                // What goes into the element's own surface does so at no distance.
                n_ends += 1;
            }
            if n_free >= LEAST_FREE {
                break;
            }
        }
        if n_ends > N_AROUND - LEAST_FREE {
            return Ok(true);
        }
        distance *= 0.5;
    }
    Ok(false)
}

/// Gives how far it is along a direction to the faces of the cube, from its lowest corner at 0.
fn way_out(from: [f64; 3], direction: [f64; 3], extent: f64) -> f64 {
    let to_face = |axis: usize| match direction[axis] {
        0.0 => f64::INFINITY,
        along if along > 0.0 => (extent - from[axis]) / along,
        along => -from[axis] / along,
    };
    (0..3).map(to_face).fold(extent, f64::min).max(0.0)
}
