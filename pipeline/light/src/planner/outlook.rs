//! Whether light escapes from a scene.

use pvmap_store::Watch;
use rayon::prelude::*;

use crate::error::{LightError, check};
use crate::incident::{Air, FAR, N_DIRECTIONS, cosine_directions};
use crate::lighting::Lighting;
use crate::plan::Outlook;
use crate::sum::sum;
use crate::vector::{add, beside, norm, scale, sub};

use super::N_LOOKED_FROM;

/// The share of directions that lead out below which a scene is closed but for these.
const CLOSED: f64 = 1e-2;
/// The part of the error asked for that the count of directions may make, and from how many
/// elements it is looked for that at the most.
const OFF: f64 = 0.25;
const MOST_LOOKED_FROM: usize = 4096;
/// Rays beside one that leads out, and how many of them have to lead out, too.
const N_BESIDE: usize = 4;
const LEAST_OPEN: usize = 1;
/// How far they are beside it where it leaves the cube, in radii of the element it comes from.
const BESIDE_RADII: f64 = 0.5;

impl Lighting<'_> {
    /// Looks for ways out, and says whether the scene counts as closed but for these. What it has
    /// wrong of them makes less than the error that is asked for, if not too many looks are needed.
    pub(super) fn outlook(&self, watch: &dyn Watch) -> Result<Outlook, LightError> {
        let rho = self.max_albedo();
        // How many times the share that leads out is missing in all light.
        let often = if rho < 1.0 { rho / (1.0 - rho) } else { f64::INFINITY };
        let first = self.look_out(N_LOOKED_FROM, watch)?;
        let off = OFF * self.options.error / often;
        let wanted = first.open_share / (off * off);
        let is_enough = wanted <= first.n_directions as f64 || first.open_share >= CLOSED;
        if is_enough {
            return Ok(first);
        }
        // `as` cuts what is too much.
        let n_elements = (wanted / N_DIRECTIONS as f64).ceil() as usize;
        self.look_out(n_elements.min(MOST_LOOKED_FROM), watch)
    }

    fn look_out(&self, n_elements: usize, watch: &dyn Watch) -> Result<Outlook, LightError> {
        let air = Air::new(self.map, &self.elements);
        let ids = self.some(n_elements);
        let looks = ids.par_iter().map(|&id| {
            check(watch)?;
            self.leading_out(&air, id)
        });
        let looks = looks.collect::<Result<Vec<_>, LightError>>()?;
        let rows = || {
            let areas = ids.iter().map(|&id| self.elements.areas()[id as usize]);
            areas.zip(&looks).filter(|(_, look)| look.1 > 0)
        };
        let seen = sum(rows().map(|(area, &(n_open, n))| area * n_open as f64 / n as f64));
        let looked = sum(rows().map(|(area, _)| area));
        let open_share = if looked > 0.0 { seen / looked } else { 1.0 };
        let n_directions = looks.iter().map(|look| look.1 as u64).sum();
        Ok(Outlook { open_share, n_directions, is_closed: open_share < CLOSED })
    }

    /// Counts the directions from an element that lead out, and those that were looked in.
    ///
    /// Where two walls meet their patches leave a gap, not as wide as one of them: what leads out
    /// there has rays beside it that do not.
    fn leading_out(&self, air: &Air<'_>, id: u32) -> Result<(usize, usize), LightError> {
        let element = self.elements.get(id as usize);
        if element.normal == [0.0; 3] {
            return Ok((0, 0));
        }
        let from = element.position;
        let far = FAR * air.extent();
        let (mut n_open, mut n) = (0, 0);
        for direction in cosine_directions(element.normal, id) {
            n += 1;
            if !air.is_open(id, add(from, scale(direction, far)))? {
                continue;
            }
            let leaves = way_out(from, direction, air.extent());
            let aside = BESIDE_RADII * (element.area / std::f64::consts::PI).sqrt();
            // Gaps lie along the axes, as do these two as a rule: between them one leaves a gap.
            let [u, v] = beside(direction).map(|v| scale(v, 0.5f64.sqrt() * aside));
            let sides: [[f64; 3]; N_BESIDE] =
                [add(u, v), sub(u, v), scale(add(u, v), -1.0), sub(v, u)];
            let mut n_beside = 0;
            for side in sides {
                let along = add(scale(direction, leaves), side);
                let along = scale(along, far / norm(along));
                n_beside += usize::from(air.is_open(id, add(from, along))?);
            }
            n_open += usize::from(n_beside >= LEAST_OPEN);
        }
        Ok((n_open, n))
    }
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
