//! The rules of `lights.toml` laid onto the surfels of a map.

use pvmap_geometry::Frame;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_light::{Channel, Elements, Gloss, Lamp, Materials, Sky};
use pvmap_query::QueryError;
use pvmap_vmap::{MapView, Surfel};

use super::parse::{MAX_LIGHT, SHARE_TOLERANCE};
use super::rules::{Albedo, Glow, LampRule, Material, Power, Rgb, Selection, Sun, Vector};
use super::{Lights, Mark, without_classes};
use crate::Error;

/// What lights a scan, surfel by surfel.
#[derive(Debug, Clone, PartialEq)]
pub struct Assigned {
    /// What each surfel emits, reflects, mirrors and lets through.
    pub materials: Materials,
    /// Added lights, in world units: points, spots, areas, then the sun.
    pub lamps: Vec<Lamp>,
    /// The sky.
    pub sky: Option<Sky>,
    /// What each glow was found to be, in their order.
    pub glows: Vec<Glowing>,
    /// What is worth telling, a line each: colours that are missing, surfels that cannot shine.
    pub notes: Vec<String>,
}

/// A part of the scan that shines, as it was found: whole surfels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glowing {
    /// Surfels that shine.
    pub n_surfels: usize,
    /// Their area, square world units.
    pub area: f64,
    /// What they emit by this rule: red, green and blue.
    pub flux: [f64; 3],
}

/// The surfels that rules select from.
struct Surfels<'a> {
    frame: &'a Frame,
    all: Vec<Surfel>,
    classes: Option<&'a [u8]>,
}

/// What surfels are made of, before it is what the light room takes.
struct Made {
    albedo: Vec<Rgb>,
    origin: Vec<Origin>,
    /// Share mirrored, share let through, index of refraction (0 where it is not said).
    gloss: Vec<[f64; 3]>,
}

/// Where an albedo comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Origin {
    /// A rule, or the scan as it is.
    Given,
    /// The scan, brighter than may be.
    Cut,
    /// The scan has no colour there.
    Missing,
}

impl Lights {
    /// Gives every surfel of a map what the rules say, in their order.
    ///
    /// A box and a sphere hold surfels by their centroids, on the grid as in [`pvmap_query`]: the
    /// corners of a box are whole steps, rounded down as points are. `elements` are those of the
    /// map; surfels without a normal do not shine. `classes` has the class of each surfel, for
    /// rules by class.
    ///
    /// # Errors
    /// Where a rule selects no surfel, a glow none that can shine, a rule by class has no classes,
    /// materials mirror and let through more than arrives, a flux is too much for its area, the
    /// counts differ or the map is damaged.
    pub fn assign(
        &self,
        map: &MapView<'_>,
        elements: &Elements,
        classes: Option<&[u8]>,
    ) -> Result<Assigned, Error> {
        let n = map.summary().n_surfels;
        let counts = [Some(elements.len()), classes.map(<[u8]>::len)];
        if let Some(found) = counts.into_iter().flatten().find(|&found| found != n as usize) {
            return Err(Error::Usage(format!("{found} values for the map's {n} surfels")));
        }
        let all = (0..n).map(|id| map.surfel(id)).collect::<Result<Vec<_>, _>>();
        let all = all.map_err(|e| Error::Query(QueryError::Format(e)))?;
        let surfels = Surfels { frame: &map.frame().frame, all, classes };
        let mut notes = Vec::new();
        let made = self.made(&surfels, &mut notes)?;
        let (emission, glows) = self.emission(&surfels, elements, &mut notes)?;
        let rules = &self.rules;
        let sun = rules.sun.iter().map(Sun::lamp);
        let lamps: Vec<Lamp> = rules.lamps.iter().map(LampRule::lamp).chain(sun).collect();
        let sky = self.sky();
        let is_lit = |color: &Rgb| color.iter().any(|&v| v > 0.0);
        let is_sky_lit = sky.is_some_and(|sky| is_lit(&sky.radiance));
        if !emission.iter().any(is_lit)
            && !lamps.iter().any(|lamp| is_lit(&lamp.color()))
            && !is_sky_lit
        {
            notes.push("nothing shines; give a [[glow]], a lamp, [sun] or [sky]".to_owned());
        }
        let up = sky.map_or([0.0, 0.0, 1.0], |sky| sky.up);
        let is_down = |to: &Vector| (0..3).map(|i| to[i] * up[i]).sum::<f64>() < 0.0;
        let mut suns = lamps.iter().filter_map(|lamp| match lamp {
            Lamp::Sun { direction, .. } => Some(direction),
            _ => None,
        });
        if suns.any(is_down) {
            notes.push("the sun is below the horizon, and shines from below".to_owned());
        }
        let is_glossy = made.gloss.iter().any(|g| g[0] > 0.0 || g[1] > 0.0);
        let as_gloss = |g: &[f64; 3]| Gloss {
            specular: g[0] as f32,
            transmissive: g[1] as f32,
            refraction: g[2] as f32,
        };
        let channel = |i: usize| Channel {
            emission: emission.iter().map(|color| color[i]).collect(),
            albedo: made.albedo.iter().map(|color| color[i]).collect(),
        };
        let gloss = if is_glossy { made.gloss.iter().map(as_gloss).collect() } else { Vec::new() };
        let materials = Materials { channels: [0, 1, 2].map(channel), gloss };
        Ok(Assigned { materials, lamps, sky, glows, notes })
    }

    /// Adds up what glows emit: exitance by surfel, and what each of them is.
    fn emission(
        &self,
        surfels: &Surfels<'_>,
        elements: &Elements,
        notes: &mut Vec<String>,
    ) -> Result<(Vec<Rgb>, Vec<Glowing>), Error> {
        let mut emission = vec![[0.0; 3]; surfels.all.len()];
        let mut glows = Vec::new();
        for (i, (Glow { on, power }, mark)) in
            self.rules.glows.iter().zip(&self.glows_at).enumerate()
        {
            let refuse = |what: String| Err(Error::Config(format!("{}{what}", mark.prefix)));
            let selected = surfels.some_selected(on, mark, &format!("glow {}", i + 1))?;
            let (shining, dark): (Vec<usize>, Vec<usize>) =
                selected.into_iter().partition(|&id| surfels.all[id].normal != [0; 3]);
            let (n_dark, n) = (dark.len(), dark.len() + shining.len());
            if shining.is_empty() {
                let what = format!("none of the {n} surfels of glow {} has a normal", i + 1);
                return refuse(format!("{what}, so none can shine; select others"));
            }
            if n_dark > 0 {
                let (line, what) = (mark.line, "surfels have no normal and do not shine");
                notes.push(format!("glow {} (line {line}): {n_dark} of {n} {what}", i + 1));
            }
            let area: f64 = shining.iter().map(|&id| elements.areas()[id]).sum();
            let exitance = power.over(area);
            let flux = exitance.map(|v| v * area);
            glows.push(Glowing { n_surfels: shining.len(), area, flux });
            for id in shining {
                emission[id] = [0, 1, 2].map(|c| emission[id][c] + exitance[c]);
                if emission[id].iter().any(|&v| v > MAX_LIGHT) {
                    let what = match power {
                        Power::Flux(_) => format!("its flux over an area of {area}"),
                        Power::Density(_) => "its exitance".to_owned(),
                    };
                    return refuse(format!("{what} is too much to compute with; give less"));
                }
            }
        }
        Ok((emission, glows))
    }

    /// Lays materials over the albedo of the scan.
    fn made(&self, surfels: &Surfels<'_>, notes: &mut Vec<String>) -> Result<Made, Error> {
        let of_scan = surfels.all.iter().map(|surfel| base_albedo(&self.rules.albedo, surfel));
        let (albedo, origin): (Vec<Rgb>, Vec<Origin>) = of_scan.unzip();
        let mut made = Made { gloss: vec![[0.0; 3]; albedo.len()], albedo, origin };
        for (i, (rule, mark)) in self.rules.materials.iter().zip(&self.materials_at).enumerate() {
            for id in surfels.some_selected(&rule.on, mark, &format!("material {}", i + 1))? {
                made.lay(id, rule);
                let [specular, transmissive, _] = made.gloss[id];
                let sum = specular + transmissive;
                if sum > 1.0 + SHARE_TOLERANCE {
                    return Err(Error::Config(format!(
                        "{}material {} over those before it: specular + transmissive is {sum} at \
                         surfel {id}: it must be at most 1",
                        mark.prefix,
                        i + 1
                    )));
                }
            }
        }
        made.tell_origins(&self.rules.albedo, notes);
        let n_dimmed = made.dim();
        if n_dimmed > 0 {
            notes
                .push(format!("{n_dimmed} surfels: albedo lowered to 1 - specular - transmissive"));
        }
        Ok(made)
    }
}

impl Made {
    /// Lays a material over what a surfel is made of.
    fn lay(&mut self, id: usize, rule: &Material) {
        let Material { albedo, specular, transmissive, refraction, .. } = *rule;
        if let Some(albedo) = albedo {
            (self.albedo[id], self.origin[id]) = (albedo, Origin::Given);
        }
        let said = [specular, transmissive, refraction];
        self.gloss[id] = [0, 1, 2].map(|i| said[i].unwrap_or(self.gloss[id][i]));
    }

    /// Notes how many colours the scan lacks, and how many are too bright.
    fn tell_origins(&self, rule: &Albedo, notes: &mut Vec<String>) {
        let Albedo::Scan { max, missing, .. } = *rule else { return };
        let count = |which| self.origin.iter().filter(|&&origin| origin == which).count();
        let (n, n_missing, n_cut) = (self.origin.len(), count(Origin::Missing), count(Origin::Cut));
        if n_missing > 0 {
            let [r, g, b] = missing;
            let missing = if r == g && g == b { format!("{r}") } else { format!("{missing:?}") };
            // Files have fields of zeros where a scanner took no pictures.
            let black = "a scan that is black all over counts as without";
            notes.push(format!(
                "{n_missing} of {n} surfels have no colour ({black}): albedo {missing}"
            ));
        }
        if n_cut > 0 {
            notes.push(format!("{n_cut} of {n} surfels are brighter than albedo {max}: cut to it"));
        }
    }

    /// Lowers albedos to what gloss leaves for them, in their colour; counts these.
    fn dim(&mut self) -> usize {
        let mut n_dimmed = 0;
        for (albedo, [specular, transmissive, _]) in self.albedo.iter_mut().zip(&self.gloss) {
            let room = (1.0 - specular - transmissive).max(0.0);
            let most = albedo.iter().fold(0.0, |most: f64, v| most.max(*v));
            if most > room + SHARE_TOLERANCE {
                *albedo = albedo.map(|v| v * (room / most));
                n_dimmed += 1;
            }
        }
        n_dimmed
    }
}

/// Gives the albedo that a surfel has without a material.
fn base_albedo(rule: &Albedo, surfel: &Surfel) -> (Rgb, Origin) {
    let (exposure, max, missing) = match *rule {
        Albedo::Constant(color) => return (color, Origin::Given),
        Albedo::Scan { exposure, max, missing } => (exposure, max, missing),
    };
    let Some(color) = color_of(surfel) else { return (missing, Origin::Missing) };
    let exposed = color.map(|v| v * exposure);
    let is_cut = exposed.iter().any(|&v| v > max);
    (exposed.map(|v| v.min(max)), if is_cut { Origin::Cut } else { Origin::Given })
}

/// Gives a surfel's mean colour in linear light, 0 to 1.
fn color_of(surfel: &Surfel) -> Option<Rgb> {
    surfel.color.map(|color| color.map(|v| f64::from(v) / 65535.0))
}

/// Gives how far two colours are from each other.
fn color_distance(a: Rgb, b: Rgb) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

impl Surfels<'_> {
    /// Lists what a rule selects, rising.
    fn selected(&self, on: &Selection, mark: &Mark) -> Result<Vec<usize>, Error> {
        Ok(match *on {
            Selection::All => self.holding(|_| true),
            Selection::Box(low, high) => {
                let (low, high) = (self.steps(low), self.steps(high));
                self.holding(|s| {
                    let c = s.centroid.map(i128::from);
                    (0..3).all(|i| (low[i]..=high[i]).contains(&c[i]))
                })
            }
            Selection::Sphere(middle, radius) => {
                let middle = self.steps(middle);
                // `as` saturates; in a cube without size all distances are 0.
                let radius2 = (radius / self.frame.unit()).powi(2).floor() as i128;
                self.holding(|s| distance2(s, middle) <= radius2)
            }
            Selection::Color(color, within) => self.holding(|s| {
                color_of(s).is_some_and(|found| color_distance(found, color) <= within)
            }),
            Selection::Near(place) => {
                let place = self.steps(place);
                let nearest = self.all.iter().enumerate().min_by_key(|(_, s)| distance2(s, place));
                nearest.map(|(id, _)| id).into_iter().collect()
            }
            Selection::Class(class) => {
                let Some(classes) = self.classes else {
                    return Err(without_classes(mark));
                };
                (0..classes.len()).filter(|&id| classes[id] == class).collect()
            }
        })
    }

    /// Lists what a rule of this name selects, and refuses one that selects nothing: it would not
    /// do what is said.
    fn some_selected(&self, on: &Selection, mark: &Mark, name: &str) -> Result<Vec<usize>, Error> {
        let selected = self.selected(on, mark)?;
        if selected.is_empty() {
            let there = self.what_there_is(on);
            let what = format!("{}{name} selects no surfel; {there}", mark.prefix);
            return Err(Error::Config(what));
        }
        Ok(selected)
    }

    fn holding(&self, holds: impl Fn(&Surfel) -> bool) -> Vec<usize> {
        (0..self.all.len()).filter(|&id| holds(&self.all[id])).collect()
    }

    /// Leads a place of the world onto the grid, in whole steps; it may be outside the cube.
    fn steps(&self, place: Vector) -> [i128; 3] {
        // So far out that nothing is near, and squares still fit.
        let far = 2f64.powi(60);
        self.frame.steps_of_query(place).map(|v| v.floor().clamp(-far, far) as i128)
    }

    /// Says what a rule that selects nothing might have selected.
    fn what_there_is(&self, on: &Selection) -> String {
        if self.all.is_empty() {
            return "the map has none".to_owned();
        }
        match *on {
            Selection::Class(_) => {
                let mut found = self.classes.unwrap_or_default().to_vec();
                found.sort_unstable();
                found.dedup();
                let found: Vec<String> = found.iter().map(u8::to_string).collect();
                format!("most points of a surfel are of class {}", found.join(", "))
            }
            Selection::Color(color, _) => {
                let colors = self.all.iter().filter_map(color_of);
                match colors.map(|found| color_distance(found, color)).reduce(f64::min) {
                    Some(nearest) => format!("the nearest colour of one is {nearest:.4} away"),
                    None => "none has a colour".to_owned(),
                }
            }
            _ => {
                let corner = |fold: fn(u32, u32) -> u32, start: u32| {
                    let steps = [0, 1, 2].map(|i| {
                        self.all.iter().map(|s| s.centroid[i]).fold(start, fold).min(GRID_MAX)
                    });
                    let [x, y, z] = self.frame.world_of(steps).map(|v| format!("{v:.3}"));
                    format!("{x},{y},{z}")
                };
                let (low, high) = (corner(u32::min, u32::MAX), corner(u32::max, 0));
                format!("the scan's lie from {low} to {high}")
            }
        }
    }
}

/// Gives the squared distance of a surfel's centroid from a place, in grid steps.
fn distance2(surfel: &Surfel, place: [i128; 3]) -> i128 {
    (0..3).map(|i| (i128::from(surfel.centroid[i]) - place[i]).pow(2)).sum()
}
