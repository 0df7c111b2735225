//! The light that arrives from lamps and from the sky.
//!
//! Lamps are no part of a map, so nothing is known of what they see: segments are tried through its
//! surfels. What is irradiated without anything in between is exact, for point lights and spots all
//! over an element, for areas and the sun at its middle; what stands in between is found at the
//! middle of each element, for one place of a point light and for many of an area.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use pvmap_query::{Light, Located, Map, Sight};
use pvmap_store::Watch;
use rayon::prelude::*;

use crate::element::{Element, Elements};
use crate::error::{LightError, check};
use crate::lamp::{Lamp, Sky};
use crate::polygon::{Cone, irradiance_of_polygon, solid_angle, solid_angle_within};
use crate::section::Section;
use crate::sum::sum;
use crate::vector::{add, beside, cross, dot, norm, scale, sub};

/// Elements that are done at a time.
const CHUNK: usize = 256;
/// Places of an area light along a side, in the middles of as many equal parts, where some see and
/// some not; and those of them that are tried at first. The outermost are among these: an edge that
/// all of them are on one side of leaves half a part beyond at the most.
const FINE: usize = 12;
const COARSE: [usize; 4] = [0, 4, 7, 11];
/// Directions to the sky along a side of the square that they are drawn from.
const SKY: usize = 8;
pub(crate) const N_DIRECTIONS: usize = SKY * SKY;
/// Rays from lamps that say how much of their light arrives at the least, of all lamps together and
/// of one.
const N_RAYS: usize = 1 << 14;
const LEAST_RAYS: usize = 1 << 10;
/// What arrives is left as it is where it is short of what they bring by no more than this.
const LEAST_SHORT: f64 = 0.02;
/// The share of its section with its cell that an element's points cover where it has all of it.
const MIN_COVERED: f64 = 0.8;
/// The golden angle, which no number of turns comes near to a circle of.
pub(crate) const GOLDEN: f64 = PI * (3.0 - 2.236_067_977_499_79);
/// What 1 is to the plastic number and to its square: steps that spread pairs of numbers evenly.
pub(crate) const PLASTIC: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];
/// How far off the sun and the sky are, in sides of the scan's cube.
pub(crate) const FAR: f64 = 4.0;

/// Who may ask what lies between a lamp and an element.
pub(crate) struct Air<'a> {
    map: &'a Map<'a>,
    elements: &'a Elements,
    /// Where the corner of the cube lies in the world: elements are measured from there.
    origin: [f64; 3],
    extent: f64,
}

/// What arrives from lamps or from the sky.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Incident {
    /// Flux an area of each element: red, green, blue.
    pub(crate) irradiance: [Vec<f64>; 3],
    /// Segments that were tried.
    pub(crate) n_segments: u64,
    /// Segments that were blocked.
    pub(crate) n_blocked: u64,
}

/// The sky over each element.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct OpenSky {
    /// Share of what an element's face could get from all around that comes from open sky, 0…1.
    pub(crate) share: Vec<f32>,
    /// Segments that were tried.
    pub(crate) n_segments: u64,
}

/// Squares of the lattice over an element whose middles see the sky.
#[derive(Debug, Default)]
pub(crate) struct OpenSquares {
    normal: [f64; 3],
    up: [f64; 3],
    open: Vec<[usize; 2]>,
}

impl OpenSquares {
    /// Gives a direction to the open sky, each alike by the light that a face gets from there;
    /// `next` gives numbers of 0…1. Straight up where nothing is open.
    pub(crate) fn direction(&self, mut next: impl FnMut() -> f64) -> [f64; 3] {
        let at = (next() * self.open.len() as f64) as usize;
        let Some(square) = self.open.get(at) else { return self.up };
        let mut within = |k: usize| (k as f64 + next()) / SKY as f64;
        let place = [within(square[0]), within(square[1])];
        let direction = cosine_direction(self.normal, place);
        // Of a square on the horizon a part is below it.
        let height = dot(direction, self.up);
        match height < 0.0 {
            true => sub(direction, scale(self.up, 2.0 * height)),
            false => direction,
        }
    }
}

/// What one element gets.
#[derive(Debug, Clone, Copy, Default)]
struct Row {
    irradiance: [f64; 3],
    n_segments: u64,
    n_blocked: u64,
}

impl<'a> Air<'a> {
    pub(crate) fn new(map: &'a Map<'a>, elements: &'a Elements) -> Air<'a> {
        let frame = &map.view().frame().frame;
        Air { map, elements, origin: frame.world_of_real([0.0; 3]), extent: frame.extent() }
    }

    /// Gives the side of the cube.
    pub(crate) fn extent(&self) -> f64 {
        self.extent
    }

    /// Gives what arrives from all lamps; without `tests`, as if nothing were in between.
    ///
    /// Patches of an edge or of a curved surface cover some directions twice or not at all. If
    /// light `is_bounded`, no more arrives from a lamp than it gives, and no less than rays bring.
    pub(crate) fn lamps(
        &self,
        lamps: &[Lamp],
        (tests, is_bounded): (bool, bool),
        watch: &dyn Watch,
    ) -> Result<Incident, LightError> {
        let nothing = vec![0.0; self.elements.len()];
        let irradiance = [0, 1, 2].map(|_| nothing.clone());
        let mut incident = Incident { irradiance, ..Incident::default() };
        let n_rays = (N_RAYS / lamps.len().max(1)).max(LEAST_RAYS);
        for lamp in lamps {
            let rows = self.each(watch, |id| {
                let mut row = Row::default();
                self.add(lamp, id, tests, &mut row)?;
                Ok(row)
            })?;
            let by = if is_bounded { self.correction(lamp, &rows, n_rays)? } else { 1.0 };
            for (channel, irradiance) in incident.irradiance.iter_mut().enumerate() {
                let more = rows.iter().map(|row| by * row.irradiance[channel]);
                irradiance.iter_mut().zip(more).for_each(|(all, more)| *all += more);
            }
            incident.n_segments += rows.iter().map(|row| row.n_segments).sum::<u64>();
            incident.n_blocked += rows.iter().map(|row| row.n_blocked).sum::<u64>();
        }
        Ok(incident)
    }

    /// Gives what the light of a lamp is to be multiplied with: no more can arrive than it gives,
    /// and no less than rays from it bring, of which some pass between patches.
    fn correction(&self, lamp: &Lamp, rows: &[Row], n_rays: usize) -> Result<f64, LightError> {
        let areas = self.elements.areas();
        let in_all = |color: [f64; 3]| color.iter().sum::<f64>();
        let given = lamp.flux().map_or(0.0, in_all);
        let arrives = sum(areas.iter().zip(rows).map(|(area, row)| area * in_all(row.irradiance)));
        let share = arrives / given;
        // Of the sun nobody knows what it gives, and in one place there is nothing to meet.
        let is_known = share > 0.0 && share < f64::INFINITY && self.extent > 0.0;
        if !is_known || share >= 1.0 {
            return Ok(if is_known { 1.0 / share } else { 1.0 });
        }
        let met = self.share_met(lamp, n_rays)?;
        // Three times the standard error of as many rays at random; these are spread evenly.
        let doubt = 3.0 * ((1.0 - met) * met / n_rays as f64).sqrt();
        let is_short = share < (1.0 - LEAST_SHORT) * met - doubt;
        Ok(if is_short { met / share } else { 1.0 })
    }

    /// Gives the share of a lamp's light that meets the face of an element, by rays spread evenly
    /// over all that it sends out.
    fn share_met(&self, lamp: &Lamp, n_rays: usize) -> Result<f64, LightError> {
        let meets = |k: usize| {
            let Some((from, direction)) = lamp.ray(k, n_rays) else { return Ok(false) };
            let hit = self.first_hit(sub(from, self.origin), direction)?;
            let faces = |id: u32| {
                let element = self.elements.get(id as usize);
                cosine(&element, scale(direction, -1.0)) > 0.0
            };
            Ok::<_, LightError>(hit.is_some_and(|(id, _)| faces(id)))
        };
        let met = (0..n_rays).into_par_iter().map(meets).collect::<Result<Vec<bool>, _>>()?;
        Ok(met.iter().filter(|is_met| **is_met).count() as f64 / n_rays as f64)
    }

    /// Tries some elements, and says of each what arrives from lamps, how many segments that took
    /// and how many of them were blocked.
    pub(crate) fn try_lamps(
        &self,
        lamps: &[Lamp],
        ids: &[u32],
        watch: &dyn Watch,
    ) -> Result<Vec<([f64; 3], u64, u64)>, LightError> {
        let tries = ids.par_iter().map(|&id| {
            check(watch)?;
            let mut row = Row::default();
            for lamp in lamps {
                self.add(lamp, id, true, &mut row)?;
            }
            Ok((row.irradiance, row.n_segments, row.n_blocked))
        });
        tries.collect()
    }

    /// Gives how much of the sky each element sees.
    pub(crate) fn sky(&self, up: [f64; 3], watch: &dyn Watch) -> Result<OpenSky, LightError> {
        let rows = self.each(watch, |id| self.sky_over(id, Some(up)))?;
        Ok(OpenSky {
            share: rows.iter().map(|row| row.0).collect(),
            n_segments: rows.iter().map(|row| row.1).sum(),
        })
    }

    /// Gives how much of the sky an element sees, and how many segments it took; without `up`, how
    /// much of all that is around.
    pub(crate) fn sky_over(&self, id: u32, up: Option<[f64; 3]>) -> Result<(f32, u64), LightError> {
        let element = self.elements.get(id as usize);
        let Some(normal) = turned(&element, up) else { return Ok((0.0, 0)) };
        let (mut n_open, mut n_segments) = (0u32, 0);
        for direction in cosine_directions(normal, id) {
            if up.is_some_and(|up| dot(direction, up) <= 0.0) {
                continue;
            }
            n_segments += 1;
            let far = add(element.position, scale(direction, FAR * self.extent));
            n_open += u32::from(self.is_open(id, far)?);
        }
        Ok((n_open as f32 / N_DIRECTIONS as f32, n_segments))
    }

    /// Gives the parts of the sky that are open over an element.
    pub(crate) fn squares(&self, id: u32, up: [f64; 3]) -> Result<OpenSquares, LightError> {
        let element = self.elements.get(id as usize);
        let Some(normal) = turned(&element, Some(up)) else { return Ok(OpenSquares::default()) };
        let mut squares = OpenSquares { normal, up, open: Vec::new() };
        let middle = |k: usize| (k as f64 + 0.5) / SKY as f64;
        for square in squares_of_sky() {
            let direction = cosine_direction(normal, square.map(middle));
            let far = add(element.position, scale(direction, FAR * self.extent));
            if dot(direction, up) > 0.0 && self.is_open(id, far)? {
                squares.open.push(square);
            }
        }
        Ok(squares)
    }

    /// Gives what an element gets from one lamp: flux an area, by channel.
    pub(crate) fn of_lamp(&self, lamp: &Lamp, id: u32) -> Result<[f64; 3], LightError> {
        let mut row = Row::default();
        self.add(lamp, id, true, &mut row)?;
        Ok(row.irradiance)
    }

    /// Gives the element that a ray hits first, and where.
    pub(crate) fn first_hit(
        &self,
        from: [f64; 3],
        direction: [f64; 3],
    ) -> Result<Option<(u32, [f64; 3])>, LightError> {
        let answer = self.map.ray(add(from, self.origin), direction, None)?;
        Ok(answer.hit.map(|hit| (hit.surfel, sub(hit.place, self.origin))))
    }

    /// Gives where elements are measured from, in the world.
    pub(crate) fn origin(&self) -> [f64; 3] {
        self.origin
    }

    /// Computes a value for each element, many at once.
    fn each<T: Send>(
        &self,
        watch: &dyn Watch,
        of: impl Fn(u32) -> Result<T, LightError> + Sync,
    ) -> Result<Vec<T>, LightError> {
        let n = self.elements.len();
        let chunk = |range: Range<usize>| {
            check(watch)?;
            let rows: Vec<T> = range.clone().map(|id| of(id as u32)).collect::<Result<_, _>>()?;
            watch.advance(range.len() as u64);
            Ok::<_, LightError>(rows)
        };
        let starts = (0..n).into_par_iter().step_by(CHUNK);
        let rows = starts.map(|at| chunk(at..n.min(at + CHUNK))).collect::<Result<Vec<_>, _>>()?;
        Ok(rows.into_iter().flatten().collect())
    }

    /// Adds what an element gets from a lamp.
    fn add(&self, lamp: &Lamp, id: u32, tests: bool, row: &mut Row) -> Result<(), LightError> {
        let element = self.elements.get(id as usize);
        let (cosine, color) = self.unblocked(lamp, id, &element)?;
        if cosine <= 0.0 {
            return Ok(());
        }
        let share = if tests { self.share_of(lamp, id, &element, row)? } else { 1.0 };
        for channel in 0..3 {
            row.irradiance[channel] += share * cosine * color[channel];
        }
        Ok(())
    }

    /// Gives what an element would get from a lamp if nothing were in between: a factor, and the
    /// lamp's colour that it multiplies.
    fn unblocked(
        &self,
        lamp: &Lamp,
        id: u32,
        element: &Element,
    ) -> Result<(f64, [f64; 3]), LightError> {
        Ok(match *lamp {
            Lamp::Point { position, intensity } => {
                (self.of_point(position, None, id, element)?, intensity)
            }
            Lamp::Spot { position, direction, angle, intensity } => {
                let cone = Cone { axis: direction, angle };
                (self.of_point(position, Some(cone), id, element)?, intensity)
            }
            Lamp::Area { corner, sides: [u, v], exitance } => {
                let corner = sub(sub(corner, self.origin), element.position);
                let front = cross(u, v);
                // It does not shine backwards.
                if dot(corner, front) >= 0.0 {
                    return Ok((0.0, exitance));
                }
                let corners = [corner, add(corner, u), add(add(corner, u), v), add(corner, v)];
                let of_side = |normal| irradiance_of_polygon(&corners, normal);
                let ahead = of_side(element.normal);
                let behind =
                    if element.two_sided { of_side(scale(element.normal, -1.0)) } else { 0.0 };
                (ahead.max(behind), exitance)
            }
            Lamp::Sun { direction, irradiance } => (cosine(element, direction), irradiance),
        })
    }

    /// Gives what an element gets on average from a place of intensity 1, in all directions or in a
    /// cone: the solid angle of its outline over the outline's area. So elements that cover what is
    /// around get what is sent out, whether the place is next to one or a cone narrower than it.
    fn of_point(
        &self,
        place: [f64; 3],
        cone: Option<Cone>,
        id: u32,
        element: &Element,
    ) -> Result<f64, LightError> {
        let to = sub(sub(place, self.origin), element.position);
        if cosine(element, to) <= 0.0 {
            return Ok(0.0);
        }
        let step = self.map.view().frame().frame.unit();
        let outline = self.outline(id)?;
        let area = outline.area() * step * step;
        let from_lamp = |corner: [f64; 3]| sub(scale(corner, step), add(element.position, to));
        let angles = outline.triangles().map(|corners| {
            let triangle = corners.map(from_lamp);
            cone.map_or_else(|| solid_angle(triangle), |cone| solid_angle_within(triangle, &cone))
        });
        if area > 0.0 {
            return Ok(angles.sum::<f64>() / area);
        }
        // A lone point on a face of its cell, seen edge-on. No more arrives than what goes into
        // half of all directions.
        let is_within = cone.is_none_or(|cone| cone.off(scale(to, -1.0)) <= cone.angle);
        let bounded = (cosine(element, to) / dot(to, to)).min(TAU / element.area);
        Ok(if is_within { bounded } else { 0.0 })
    }

    /// Gives where an element lies on its plane, in grid steps: all of its cell, as cells leave no
    /// gaps; or where its points are and half a spacing around, if that is much less.
    fn outline(&self, id: u32) -> Result<Section, LightError> {
        let surfel = self.map.view().surfel(id)?;
        let (centroid, normal) = (surfel.centroid.map(f64::from), surfel.normal.map(f64::from));
        let cell = surfel.cell();
        let [all, own] =
            [cell, cell.meet(&surfel.patch)].map(|limit| Section::new(centroid, normal, &limit));
        Ok(if own.area() >= MIN_COVERED * all.area() { all } else { own })
    }

    /// Gives the share of a lamp's light that reaches an element.
    fn share_of(
        &self,
        lamp: &Lamp,
        id: u32,
        element: &Element,
        row: &mut Row,
    ) -> Result<f64, LightError> {
        let mut is_open = |place: [f64; 3]| {
            let is_open = self.is_open(id, sub(place, self.origin))?;
            row.n_segments += 1;
            row.n_blocked += u64::from(!is_open);
            Ok::<_, LightError>(is_open)
        };
        let (corner, [u, v]) = match *lamp {
            Lamp::Point { position, .. } | Lamp::Spot { position, .. } => {
                return Ok(f64::from(u8::from(is_open(position)?)));
            }
            Lamp::Sun { direction, .. } => {
                let here = add(element.position, self.origin);
                let far = add(here, scale(direction, FAR * self.extent));
                return Ok(f64::from(u8::from(is_open(far)?)));
            }
            Lamp::Area { corner, sides, .. } => (corner, sides),
        };
        let front = cross(u, v);
        let mut share = |parts: &[usize]| {
            let (mut open, mut all) = (0.0, 0.0);
            for (&a, &b) in parts.iter().flat_map(|a| parts.iter().map(move |b| (a, b))) {
                let at = |k: usize| (k as f64 + 0.5) / FINE as f64;
                let place = add(corner, add(scale(u, at(a)), scale(v, at(b))));
                let to = sub(sub(place, self.origin), element.position);
                let r2 = dot(to, to);
                let weight = cosine(element, to) * -dot(to, front) / (r2 * r2.sqrt());
                if weight > 0.0 {
                    all += weight;
                    open += if is_open(place)? { weight } else { 0.0 };
                }
            }
            Ok::<_, LightError>(if all > 0.0 { open / all } else { 0.0 })
        };
        let coarse = share(&COARSE)?;
        let all: [usize; FINE] = std::array::from_fn(|k| k);
        if coarse == 0.0 || coarse == 1.0 { Ok(coarse) } else { share(&all) }
    }

    /// Says whether a place, measured from the cube's corner, sees an element.
    pub(crate) fn is_open(&self, id: u32, place: [f64; 3]) -> Result<bool, LightError> {
        if self.extent == 0.0 {
            // All of the scan is one place, and nothing of it stands elsewhere.
            return Ok(true);
        }
        let node = self.map.view().surfel(id)?.node;
        let here = Located { surfel: id, node, distance: 0.0 };
        let answer = self.map.shadow(&here, &Light::Air(add(place, self.origin)))?;
        Ok(answer.reaches != Sight::None)
    }
}

impl Incident {
    /// Adds a sky: π times its radiance of the share that is open.
    pub(crate) fn add_sky(&mut self, sky: &Sky, open: &OpenSky) {
        for (channel, radiance) in sky.radiance.into_iter().enumerate() {
            for (irradiance, share) in self.irradiance[channel].iter_mut().zip(&open.share) {
                *irradiance += PI * radiance * f64::from(*share);
            }
        }
    }
}

/// Gives the cosine at an element towards something, 0 where it faces away.
fn cosine(element: &Element, to: [f64; 3]) -> f64 {
    let length = norm(to);
    let cosine = if length > 0.0 { dot(element.normal, to) / length } else { 0.0 };
    if element.two_sided { cosine.abs() } else { cosine.max(0.0) }
}

/// Gives an element's normal; of two faces that which looks up. None where there is none.
fn turned(element: &Element, up: Option<[f64; 3]>) -> Option<[f64; 3]> {
    let normal = element.normal;
    let is_down = element.two_sided && up.is_some_and(|up| dot(normal, up) < 0.0);
    (normal != [0.0; 3]).then(|| if is_down { scale(normal, -1.0) } else { normal })
}

/// Gives directions around a normal, each for the same share of what a face gets from all around:
/// a spiral of places on the disc under the half sphere, each with the same area.
///
/// Another element, `id`, has it turned and its places moved along it. Where all had the same
/// directions, an edge in the sky would show as steps all over a plane, an eight-armed star around
/// a tower; as it is, it is noise, and that of neighbours cancels.
pub(crate) fn cosine_directions(normal: [f64; 3], id: u32) -> impl Iterator<Item = [f64; 3]> {
    let [tangent, other] = beside(normal);
    let [turn, start] = PLASTIC.map(|step| (f64::from(id) * step).fract());
    (0..N_DIRECTIONS).map(move |k| {
        let radius = ((k as f64 + start) / N_DIRECTIONS as f64).sqrt();
        let (sin, cos) = (TAU * turn + GOLDEN * k as f64).sin_cos();
        let height = (1.0 - radius * radius).sqrt();
        let along = add(scale(tangent, radius * cos), scale(other, radius * sin));
        add(along, scale(normal, height))
    })
}

fn squares_of_sky() -> impl Iterator<Item = [usize; 2]> {
    (0..SKY).flat_map(|a| (0..SKY).map(move |b| [a, b]))
}

/// Gives the direction around a normal that belongs to a place of the unit square.
fn cosine_direction(normal: [f64; 3], [a, b]: [f64; 2]) -> [f64; 3] {
    let [tangent, other] = beside(normal);
    let (radius, angle) = (a.sqrt(), TAU * b);
    let (sin, cos) = angle.sin_cos();
    let height = (1.0 - radius * radius).max(0.0).sqrt();
    let along = add(scale(tangent, radius * cos), scale(other, radius * sin));
    add(along, scale(normal, height))
}
