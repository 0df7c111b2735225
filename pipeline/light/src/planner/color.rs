//! Whether one channel does for three.

use std::f64::consts::PI;

use crate::lighting::{Lighting, mean};
use crate::sum::sum;

use super::Call;
use super::shining::Shining;

/// What is wrong of a colour if it is taken for grey, the three channels together.
fn apart(color: [f64; 3]) -> f64 {
    let mean = mean(color);
    color.iter().map(|v| (v - mean).abs()).sum()
}

impl Lighting<'_> {
    /// Calls for colour by the flux that would have the wrong one: of what is emitted and arrives,
    /// and of what is reflected of it.
    pub(super) fn call_color(&self, shining: &Shining, exchanges: bool) -> Call {
        if shining.flux == 0.0 {
            return Call::off("nothing shines");
        }
        let areas = self.elements.areas();
        let ids = || 0..areas.len();
        let channels = &self.materials.channels;
        let emission = |id: usize| [0, 1, 2].map(|c: usize| channels[c].emission[id]);
        let albedo = |id: usize| [0, 1, 2].map(|c: usize| channels[c].albedo[id]);
        let lamps = |id: usize| [0, 1, 2].map(|c: usize| shining.from_lamps[c][id]);
        let sky = self.sky.map_or([0.0; 3], |sky| sky.radiance.map(|l| PI * l));
        let whole_sky: f64 = sky.iter().sum();
        let part = |v: f64, of: f64| if of > 0.0 { v / of } else { 0.0 };

        let glowing = sum(ids().map(|id| areas[id] * apart(emission(id))));
        let of_lamps = sum(ids().map(|id| areas[id] * apart(lamps(id))));
        let of_sky = shining.of_sky * part(apart(sky), whole_sky);

        // Of what arrives, wherever it comes from, an albedo sends on that much too much or little.
        let most = ids().map(|id| apart(albedo(id))).fold(0.0, f64::max);
        let on = |arriving: &dyn Fn(usize) -> f64| {
            let colored = ids().filter(|&id| apart(albedo(id)) > 0.0);
            sum(colored.map(|id| areas[id] * apart(albedo(id)) * arriving(id)))
        };
        let by_lamps = on(&|id| lamps(id).into_iter().fold(0.0, f64::max));
        let by_sky = on(&|_| sky.into_iter().fold(0.0, f64::max)).min(most * shining.of_sky);
        // No element gets more than the brightest sends, and all together what is sent.
        let brightest = shining.most * shining.growth;
        let by_others = match exchanges && most > 0.0 {
            false => 0.0,
            true => on(&|_| brightest).min(most * shining.flux * shining.growth),
        };
        // What mirrors and lenses gather may all arrive where the colour is.
        let by_gloss = match most > 0.0 {
            false => 0.0,
            true => most * shining.all_thrown() * shining.growth,
        };

        let wrong = glowing + of_lamps + of_sky + by_lamps + by_sky + by_others + by_gloss;
        let evidence = match wrong {
            0.0 => "light and surfaces are grey".to_owned(),
            _ => {
                let by = |part: f64| 100.0 * part / shining.flux;
                let light = by(glowing + of_lamps + of_sky);
                let largest = |of: &dyn Fn(usize) -> f64| {
                    ids().max_by(|&a, &b| of(a).total_cmp(&of(b))).unwrap_or(0)
                };
                let painted = format!("albedo of surfel {}", largest(&|id| apart(albedo(id))));
                match (most > 0.0, light > 0.0) {
                    (true, false) => painted,
                    (false, _) => format!("{light:.2} % of the light has a colour"),
                    (true, true) => format!("{painted}, {light:.2} % of the light"),
                }
            }
        };
        Call::on(evidence, shining.lasting(wrong)).if_worth(self.options.worth)
    }
}
