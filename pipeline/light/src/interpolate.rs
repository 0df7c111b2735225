//! Irradiance at places between surfels: smooth along a surface, and from no other surface.
//!
//! At a place x of normal n, H = Σ w_j H_j / Σ w_j over the surfels j whose reach holds x. The
//! weight w_j falls smoothly to 0 with the distance of x from the centroid of j, at two spacings of
//! j; with the distance of x from its plane, at half a spacing; and with the angle between n and
//! its normal, at 30°. Where nobody's reach holds x it has what its own surfel has.

use pvmap_geometry::GridPoint;
use pvmap_vmap::MapView;

use crate::error::LightError;
use crate::vector::{dot, sub};

/// Spacings of surfels, the roots of their areas, that one reaches from its centroid. With fewer a
/// place may be in the reach of one alone and surfels show as blocks; with more shadows get wider.
const REACH: f64 = 2.0;
/// Spacings that a place may be off the plane of a surfel.
const HALF_THICKNESS: f64 = 0.5;
/// The cosine of the largest angle between normals on one surface, 30°: DESIGN.md §3 cuts leaves of
/// wider ones.
const LEAST_COS: f64 = 0.866_025_403_784_438_6;
/// Bits of a grid coordinate.
const GRID_BITS: u32 = 22;

/// The irradiance of the surfels of a map, to be asked for anywhere on their surfaces. It holds
/// some 100 bytes a surfel.
#[derive(Debug)]
pub struct Irradiance {
    surfels: Vec<Neighbour>,
    /// From the finest cells to the coarsest.
    layers: Vec<Layer>,
}

/// A surfel as places near it see it, in grid steps.
#[derive(Debug, Clone, Copy)]
struct Neighbour {
    centroid: [f32; 3],
    /// Of length 1, or zero.
    normal: [f32; 3],
    two_sided: bool,
    /// The root of its area.
    spacing: f32,
    irradiance: [f32; 3],
}

/// The surfels whose reach is at most half a side of the layer's cells, by the cells it meets: at
/// most eight.
#[derive(Debug)]
struct Layer {
    /// Log2 of the side.
    bits: u32,
    /// Cells, rising.
    cells: Vec<u64>,
    /// Where the surfels of each begin, and where those of the last end.
    starts: Vec<u32>,
    /// Rising in each cell.
    surfels: Vec<u32>,
}

impl Irradiance {
    /// Takes the area of each surfel of a map, in square grid steps, and its irradiance, red, green
    /// and blue, in their order.
    ///
    /// # Errors
    /// Where there are not as many values as surfels, or the map is damaged.
    pub fn new(
        map: &MapView<'_>,
        areas: &[f64],
        irradiance: &[[f32; 3]],
    ) -> Result<Irradiance, LightError> {
        let expected = map.summary().n_surfels as usize;
        for (what, found) in [("the area", areas.len()), ("irradiance", irradiance.len())] {
            if found != expected {
                return Err(LightError::Count { what, found, expected });
            }
        }
        let mut surfels = Vec::with_capacity(expected);
        for ((id, area), &irradiance) in (0..).zip(areas).zip(irradiance) {
            let surfel = map.surfel(id)?;
            surfels.push(Neighbour {
                centroid: surfel.centroid.map(|v| v as f32),
                normal: unit(surfel.normal.map(f32::from)),
                two_sided: surfel.two_sided,
                // Places are whole steps: a surface is at least as thick as one.
                spacing: area.sqrt().max(2.0) as f32,
                irradiance,
            });
        }
        let mut by_bits: Vec<Vec<(u64, u32)>> = vec![Vec::new(); GRID_BITS as usize + 1];
        for (id, lit) in (0..).zip(&surfels).filter(|(_, lit)| lit.normal != [0.0; 3]) {
            let bits = lit.layer_bits();
            by_bits[bits as usize].extend(lit.cells(bits).map(|cell| (cell, id)));
        }
        let layers = (0..).zip(by_bits).filter(|(_, entries)| !entries.is_empty());
        let layers = layers.map(|(bits, entries)| Layer::new(bits, entries)).collect();
        Ok(Irradiance { surfels, layers })
    }

    /// Gives the irradiance at a place on the surface of surfel `own`, red, green and blue; the
    /// normal has length 1, or is zero where it is not known. A normal that is far from that of
    /// `own` is noise: its own is taken.
    pub fn at(&self, place: GridPoint, normal: [f32; 3], own: u32) -> [f64; 3] {
        let Some(own) = self.surfels.get(own as usize) else { return [0.0; 3] };
        let place = place.map(f64::from);
        let is_noise = own.alignment(normal.map(f64::from)) <= 0.0;
        let normal = if is_noise { own.normal } else { normal }.map(f64::from);
        let (mut sum, mut weights) = ([0.0; 3], 0.0);
        for layer in &self.layers {
            for &id in layer.at(place) {
                let lit = &self.surfels[id as usize];
                let weight = lit.weight(place, normal);
                if weight > 0.0 {
                    weights += weight;
                    (0..3).for_each(|i| sum[i] += weight * f64::from(lit.irradiance[i]));
                }
            }
        }
        match weights > 0.0 {
            true => sum.map(|v| v / weights),
            false => own.irradiance.map(f64::from),
        }
    }
}

impl Neighbour {
    fn reach(&self) -> f64 {
        REACH * f64::from(self.spacing)
    }

    /// Gives log2 of the side of the cells of its layer.
    fn layer_bits(&self) -> u32 {
        let bits = (2.0 * self.reach()).log2().ceil();
        // `as` keeps what is not finite within the range.
        (bits as u32).min(GRID_BITS)
    }

    /// Gives the cells, of a side of so many bits, that its reach meets.
    fn cells(&self, bits: u32) -> impl Iterator<Item = u64> + use<> {
        let reach = self.reach();
        // `as` brings what is below the grid to 0.
        let side = |v: f64| (v as u32).min((1 << GRID_BITS) - 1) >> bits;
        let low = self.centroid.map(|c| side(f64::from(c) - reach));
        let high = self.centroid.map(|c| side(f64::from(c) + reach));
        let [x, y, z] = [0, 1, 2].map(|i| low[i]..=high[i]);
        z.flat_map(move |z| {
            let x = x.clone();
            y.clone().flat_map(move |y| x.clone().map(move |x| key([x, y, z])))
        })
    }

    /// Gives 0 where a normal is 30° or more from its own, growing to 1 where they are the same.
    fn alignment(&self, normal: [f64; 3]) -> f64 {
        let cos = dot(self.normal.map(f64::from), normal);
        let cos = if self.two_sided { cos.abs() } else { cos };
        smooth((cos - LEAST_COS) / (1.0 - LEAST_COS))
    }

    /// Gives its weight at a place.
    fn weight(&self, place: [f64; 3], normal: [f64; 3]) -> f64 {
        let away = sub(place, self.centroid.map(f64::from));
        let near = 1.0 - dot(away, away) / (self.reach() * self.reach());
        if near <= 0.0 {
            return 0.0;
        }
        let height = dot(away, self.normal.map(f64::from));
        let thickness = HALF_THICKNESS * f64::from(self.spacing);
        let flat = 1.0 - height * height / (thickness * thickness);
        if flat <= 0.0 {
            return 0.0;
        }
        near * near * flat * flat * self.alignment(normal)
    }
}

impl Layer {
    fn new(bits: u32, mut entries: Vec<(u64, u32)>) -> Layer {
        entries.sort_unstable();
        let (mut cells, mut starts) = (Vec::new(), Vec::new());
        for (start, cell) in (0..).zip(entries.iter().map(|entry| entry.0)) {
            if cells.last() != Some(&cell) {
                cells.push(cell);
                starts.push(start);
            }
        }
        starts.push(entries.len() as u32);
        Layer { bits, cells, starts, surfels: entries.into_iter().map(|entry| entry.1).collect() }
    }

    /// Gives the surfels whose reach meets the cell of a place.
    fn at(&self, place: [f64; 3]) -> &[u32] {
        match self.cells.binary_search(&key(place.map(|v| v as u32 >> self.bits))) {
            Ok(i) => &self.surfels[self.starts[i] as usize..self.starts[i + 1] as usize],
            Err(_) => &[],
        }
    }
}

/// Gives one number for a cell: sides are at least 8 steps, so that coordinates have at most 19
/// bits.
fn key([x, y, z]: [u32; 3]) -> u64 {
    u64::from(x) | u64::from(y) << 20 | u64::from(z) << 40
}

/// Gives 0 up to 0, 1 from 1 on, and between them a curve without a corner.
fn smooth(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn unit(n: [f32; 3]) -> [f32; 3] {
    let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 { n.map(|v| v / length) } else { n }
}
