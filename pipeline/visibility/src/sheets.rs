//! Sheets: subtrees whose surfels lie along one surface, the pieces that walls and statues are made
//! of. [`crate::screen`] asks them about the segments of a block.
//!
//! A sheet looks along the axis w that its normals are nearest to; u and v are the others, and all
//! places are taken from an integer place near its middle, which is exact in f32. What it knows of
//! its surfels stands in a raster over (u, v), made when it is first asked.

use std::ops::Range;
use std::sync::OnceLock;

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_geometry::{Box3, Rect};
use pvmap_store::{StoreError, Watch};
use pvmap_vmap::Tree;

use crate::bounds::{self, Bounds};
use crate::lanes::{WIDER, dot32, greater, less};
use crate::packets::UNIT;
use crate::surface::{Patch, Surface};

/// Most and least surfels of a sheet.
pub(crate) const MAX_SURFELS: usize = 64;
const MIN_SURFELS: usize = 4;
/// Cells along a side of a raster: eight for each surfel of a full sheet.
pub(crate) const SIDE: usize = 1 << SIDE_BITS;
pub(crate) const SIDE_BITS: u32 = 6;
/// Finer cells along a side of a cell, by which it is seen what is covered.
const SPLIT: usize = 2;
const FINE: usize = SIDE * SPLIT;
/// What the distances of a raster are counted in: parts of a cell.
pub(crate) const UNITS: f32 = 16.0;
/// What is added to the distances of a raster.
pub(crate) const MIDWAY: u32 = 1 << 15;
/// No surfel.
pub(crate) const NOBODY: u32 = 0xffff;
/// How far off a place of a crossing can be.
pub(crate) const PLACE_SLACK: f32 = 4.0;
/// How far the box of a sheet goes beyond all places at which its surfels can block: no whole
/// number, so that no centroid is on its faces.
const BEYOND: f32 = 4.5;
/// How high over its surface surfels of a sheet may block, in sides of a surfel.
const HIGHEST: f32 = 0.1;

/// A subtree whose surfels lie along one surface.
#[derive(Debug)]
pub struct Sheet {
    surfels: Range<u32>,
    /// u, v and w.
    pub(crate) axes: [usize; 3],
    /// An integer place near its middle, along its axes.
    pub(crate) middle: [f32; 3],
    /// Around every place at which a surfel can block, from the middle.
    pub(crate) low: [f32; 3],
    pub(crate) high: [f32; 3],
    pub(crate) surface: Surface,
    /// The same for a plane.
    pub(crate) plane: Surface,
    /// Steps of a side of a cell of the raster.
    pub(crate) cell: f32,
    detail: OnceLock<Box<Detail>>,
}

/// What a sheet knows of its surfels, made when it is first asked.
#[derive(Debug)]
pub(crate) struct Detail {
    /// For each cell, rows along u: above, a distance in 1/16 cells, rounded down, with 2^15
    /// added; below, the surfel whose centroid is nearest among those that can block in the cell.
    /// A positive distance is that to the nearest place at which a surfel can block. Of a negative
    /// one, all that is as near to a place of the cell lies on one surfel.
    pub(crate) raster: [u32; SIDE * SIDE],
    pub(crate) plates: Plates,
}

/// The surfels of a sheet along its axes, from its middle, a lane each.
#[derive(Debug)]
pub(crate) struct Plates {
    pub(crate) centroid: [[f32; MAX_SURFELS]; 3],
    /// Of length 1.
    pub(crate) normal: [[f32; MAX_SURFELS]; 3],
    /// Rounded inward.
    pub(crate) radius: [f32; MAX_SURFELS],
    /// The box that limits the disc, from its centroid.
    pub(crate) low: [[f32; MAX_SURFELS]; 3],
    pub(crate) high: [[f32; MAX_SURFELS]; 3],
}

/// All sheets of a tree; by default there are none.
#[derive(Debug, Default)]
pub struct Sheets {
    /// The sheet of each family, or [`NO_SHEET`].
    of_family: Vec<u32>,
    sheets: Vec<Sheet>,
}

const NO_SHEET: u32 = u32::MAX;

impl Sheets {
    /// What a sheet takes at the most.
    pub(crate) const A_SHEET_BYTES: u64 = (size_of::<Sheet>() + size_of::<Detail>() + 32) as u64;

    /// Bytes for each inner node, which are not among those of the sheets.
    pub(crate) const A_FAMILY_BYTES: usize = size_of::<u32>();

    /// Finds the largest sheets of a tree where they pay: where three quarters of the surfels are
    /// in sheets. In a room all but the edges are; among trees and on statues asking them takes
    /// longer than it saves. Families are numbered as inner nodes are. Where `memory_bytes` do not
    /// hold all sheets, those of few surfels are left out.
    ///
    /// # Errors
    /// Where the run is asked to stop.
    pub fn new(
        tree: &Tree,
        discs: &[Disc],
        bounds: &[Bounds],
        memory_bytes: u64,
        watch: &dyn Watch,
    ) -> Result<Sheets, StoreError> {
        let (sheets, n_in_sheets) = Sheets::all(tree, discs, bounds, memory_bytes, watch)?;
        Ok(if 4 * n_in_sheets >= 3 * discs.len() { sheets } else { Sheets::default() })
    }

    /// Finds the largest sheets of any tree; also counts the surfels of all, those that are left
    /// out included.
    ///
    /// # Errors
    /// Where the run is asked to stop.
    pub(crate) fn all(
        tree: &Tree,
        discs: &[Disc],
        bounds: &[Bounds],
        memory_bytes: u64,
        watch: &dyn Watch,
    ) -> Result<(Sheets, usize), StoreError> {
        let max_sheets = usize::try_from(memory_bytes / Self::A_SHEET_BYTES).unwrap_or(usize::MAX);
        // There cannot be more of them.
        let n_most = discs.len() / MIN_SURFELS;
        let mut least = MIN_SURFELS;
        if n_most > max_sheets {
            let mut n_of = [0; MAX_SURFELS + 1];
            each_sheet(tree, discs, bounds, watch, |sheet| {
                n_of[sheet.as_ref().map_or(0, |s| s.surfels.len())] += 1;
            })?;
            let mut n_sheets = 0;
            let sizes = (MIN_SURFELS..=MAX_SURFELS).rev();
            let has_room = |&n: &usize| {
                let had_room = n_sheets < max_sheets;
                n_sheets += n_of[n];
                had_room
            };
            least = sizes.take_while(has_room).last().unwrap_or(MAX_SURFELS);
        }
        let mut sheets = Sheets {
            of_family: Vec::with_capacity(tree.nodes.len() - discs.len()),
            sheets: Vec::with_capacity(n_most.min(max_sheets)),
        };
        let mut n_in_sheets = 0;
        each_sheet(tree, discs, bounds, watch, |sheet| {
            let n_sheets = sheets.sheets.len();
            n_in_sheets += sheet.as_ref().map_or(0, |sheet| sheet.surfels.len());
            let fits = |sheet: &Sheet| n_sheets < max_sheets && sheet.surfels.len() >= least;
            let sheet = sheet.filter(fits);
            // There are fewer sheets than surfels.
            sheets.of_family.push(sheet.as_ref().map_or(NO_SHEET, |_| n_sheets as u32));
            sheets.sheets.extend(sheet);
        })?;
        Ok((sheets, n_in_sheets))
    }

    /// Says whether there is none.
    pub fn is_empty(&self) -> bool {
        self.sheets.is_empty()
    }

    /// Gives the sheet of a family.
    pub fn of_family(&self, family: u32) -> Option<&Sheet> {
        let sheet = self.of_family.get(family as usize)?;
        self.sheets.get(*sheet as usize)
    }
}

/// Visits all inner nodes in order, each with its sheet if it is the top of one. At a million
/// leaves that takes some ten seconds, so it looks at every node whether to stop.
fn each_sheet(
    tree: &Tree,
    discs: &[Disc],
    bounds: &[Bounds],
    watch: &dyn Watch,
    mut visit: impl FnMut(Option<Sheet>),
) -> Result<(), StoreError> {
    let mut covered = 0;
    for (id, node) in tree.nodes.iter().enumerate().filter(|(_, node)| !node.is_leaf()) {
        watch.check()?;
        let surfels = node.first_surfel..node.end_surfel;
        let fits = id >= covered && (MIN_SURFELS..=MAX_SURFELS).contains(&surfels.len());
        let sheet = if fits { Sheet::new(surfels, discs, &bounds[id]) } else { None };
        if sheet.is_some() {
            covered = node.end as usize;
        }
        visit(sheet);
    }
    Ok(())
}

impl Sheet {
    /// Makes a sheet of surfels that lie along a surface.
    pub(crate) fn new(surfels: Range<u32>, discs: &[Disc], bounds: &Bounds) -> Option<Sheet> {
        let members = &discs[surfels.start as usize..surfels.end as usize];
        let members = || members.iter().filter(|d| d.normal != [0; 3]);
        let w = main_axis(members())?;
        let axes = [(w + 1) % 3, (w + 2) % 3, w];
        let reach = bounds.blockers;
        let middle = axes.map(|i| (reach.min[i] + reach.max[i]) / 2);
        let mut patches = Vec::with_capacity(surfels.len());
        for disc in members() {
            let centroid = [0, 1, 2].map(|i| f64::from(disc.centroid[axes[i]] - middle[i]));
            let normal = axes.map(|i| f64::from(disc.normal[i]));
            patches.push(Patch::new(centroid, normal, (disc.radius2 as f64).sqrt())?);
        }
        let low = [0, 1, 2].map(|i| (reach.min[axes[i]] - middle[i]) as f32 - BEYOND);
        let high = [0, 1, 2].map(|i| (reach.max[axes[i]] - middle[i]) as f32 + BEYOND);
        // Beyond it half steps are rounded away.
        if low.iter().chain(&high).any(|v| v.abs() >= (1u32 << 22) as f32) {
            return None;
        }
        let (wide, deep) = (high[0] - low[0], high[1] - low[1]);
        let side = (wide * deep / surfels.len() as f32).sqrt();
        let plane = Surface::plane(&patches, side.into())?;
        let curved = Surface::curved(&patches, side.into());
        let surface = curved.filter(|curved| curved.reach < plane.reach).unwrap_or(plane);
        (surface.reach < side * HIGHEST).then(|| Sheet {
            surfels,
            axes,
            middle: middle.map(|v| v as f32),
            low,
            high,
            surface,
            plane,
            cell: greater(wide, deep) / SIDE as f32,
            detail: OnceLock::new(),
        })
    }

    /// Gives what it knows of its surfels.
    pub(crate) fn detail(&self, discs: &[Disc], profile: Profile) -> &Detail {
        self.detail.get_or_init(|| {
            let members = &discs[self.surfels.start as usize..self.surfels.end as usize];
            let (raster, plates) = (self.raster(members, profile), self.plates(members, profile));
            Box::new(Detail { raster, plates })
        })
    }

    fn plates(&self, members: &[Disc], profile: Profile) -> Plates {
        let none = [[0.0; MAX_SURFELS]; 3];
        let (centroid, normal, low, high) = (none, none, none, none);
        let mut plates = Plates { centroid, normal, radius: [0.0; MAX_SURFELS], low, high };
        for (k, disc) in members.iter().enumerate() {
            for (i, &axis) in self.axes.iter().enumerate() {
                let c = disc.centroid[axis];
                plates.centroid[i][k] = c as f32 - self.middle[i];
                plates.normal[i][k] = f32::from(disc.normal[axis]) / (1u32 << 14) as f32;
                plates.low[i][k] = (disc.limit.min[axis] - c) as f32;
                plates.high[i][k] = (disc.limit.max[axis] - c) as f32;
            }
            plates.radius[k] = match profile {
                Profile::Paper | Profile::Patch => (disc.radius2 as f32).sqrt() / WIDER,
                // What is that near the centroid is within the rectangle.
                Profile::Oriented => {
                    less((disc.radius2 as f32).sqrt(), inner_radius(&disc.rect)) / WIDER
                }
            };
        }
        plates
    }

    fn raster(&self, members: &[Disc], profile: Profile) -> [u32; SIDE * SIDE] {
        let (mut nearest, mut names) = ([f32::INFINITY; SIDE * SIDE], [NOBODY; SIDE * SIDE]);
        let mut depths = vec![0.0; FINE * FINE];
        for (k, disc) in members.iter().enumerate().filter(|(_, d)| d.normal != [0; 3]) {
            let reach = bounds::of_leaf(disc, profile).blockers;
            if reach.is_empty() {
                continue;
            }
            let (iu, iv) = (self.cells(&reach, 0), self.cells(&reach, 1));
            let c = self.on_raster(disc).map(|c| c / self.cell - 0.5);
            for v in iv.clone() {
                for u in iu.clone() {
                    let (at, away) = (v * SIDE + u, (u as f32 - c[0]).hypot(v as f32 - c[1]));
                    if away < nearest[at] {
                        (nearest[at], names[at]) = (away, k as u32);
                    }
                }
            }
            self.deepen(disc, profile, iu, iv, &mut depths);
        }
        let steps = steps_to(&names);
        let mut raster = [0; SIDE * SIDE];
        for (at, cell) in raster.iter_mut().enumerate() {
            let mut depth = f32::INFINITY;
            for i in 0..SPLIT * SPLIT {
                let (u, v) = (at % SIDE * SPLIT + i % SPLIT, at / SIDE * SPLIT + i / SPLIT);
                depth = less(depth, depths[v * FINE + u]);
            }
            let within = (depth / self.cell * UNITS) as u32;
            // Between two cells is one step less than from one to the other.
            let outside = u32::from(steps[at].saturating_sub(1)) * UNITS as u32;
            *cell = (MIDWAY + outside - within.min(MIDWAY - 1)) << 16 | names[at];
        }
        raster
    }

    /// Gives the centroid of a disc along u and v, from the corner of the raster.
    fn on_raster(&self, disc: &Disc) -> [f32; 2] {
        let c = |i: usize| disc.centroid[self.axes[i]] as f32 - self.middle[i] - self.low[i];
        [c(0), c(1)]
    }

    /// Gives the cells along u or v that a box touches.
    fn cells(&self, reach: &Box3, i: usize) -> Range<usize> {
        let at = |g: f32| {
            let cells = (g - self.middle[i] - self.low[i]) / self.cell;
            (cells.max(0.0) as usize).min(SIDE - 1)
        };
        let (min, max) = (reach.min[self.axes[i]] as f32, reach.max[self.axes[i]] as f32);
        at(min - PLACE_SLACK)..at(max + PLACE_SLACK) + 1
    }

    /// Notes for each fine cell of some cells how far around all its places, along u and v, the
    /// plane of a disc is on the disc and within its limit, if that is farther than noted.
    fn deepen(
        &self,
        disc: &Disc,
        profile: Profile,
        iu: Range<usize>,
        iv: Range<usize>,
        depths: &mut [f32],
    ) {
        let n = self.axes.map(|i| f32::from(disc.normal[i]));
        let [p, q] = [-n[0] / n[2], -n[1] / n[2]];
        let radius = (disc.radius2 as f32).sqrt() / WIDER;
        // How much farther from the centroid, and higher, a step along u and v can lead.
        let stretch = (2.0 * (1.0 + p * p + q * q)).sqrt() * WIDER;
        let climb = greater(p.abs() + q.abs(), 1.0 / 1024.0);
        let fine = self.cell / SPLIT as f32;
        let low = self.axes.map(|i| (disc.limit.min[i] - disc.centroid[i]) as f32);
        let high = self.axes.map(|i| (disc.limit.max[i] - disc.centroid[i]) as f32);
        let is_cut = profile == Profile::Oriented;
        // Along the axes of the rectangle, and how far a step along u and v can lead there.
        let cut = disc.rect.axes.map(|axis| self.axes.map(|i| f32::from(axis[i]) * UNIT));
        let lead = cut
            .map(|[x, y, w]| greater((x + w * p).abs() + (y + w * q).abs(), 1.0 / 1024.0) * WIDER);
        let c = self.on_raster(disc);
        for v in iv.start * SPLIT..iv.end * SPLIT {
            let y = (v as f32 + 0.5) * fine - c[1];
            for u in iu.start * SPLIT..iu.end * SPLIT {
                let x = (u as f32 + 0.5) * fine - c[0];
                let w = p * x + q * y;
                let flat = less(less(x - low[0], high[0] - x), less(y - low[1], high[1] - y));
                let round = (radius - (x * x + y * y + w * w).sqrt() * WIDER) / stretch;
                let upright = (less(w - low[2], high[2] - w) - PLACE_SLACK) / climb;
                let mut depth = less(less(flat, round), upright);
                if is_cut {
                    for (i, axis) in cut.iter().enumerate() {
                        let along = dot32(*axis, [x, y, w]);
                        let (low, high) = (disc.rect.low[i] as f32, disc.rect.high[i] as f32);
                        let within = less(along - low, high - along) - PLACE_SLACK;
                        depth = less(depth, within / lead[i]);
                    }
                }
                depth -= fine / 2.0 + PLACE_SLACK;
                let noted = &mut depths[v * FINE + u];
                *noted = greater(*noted, depth);
            }
        }
    }
}

/// Gives the radius of a disc around the centroid that lies in a rectangle.
fn inner_radius(rect: &Rect) -> f32 {
    let sides = [-rect.low[0], -rect.low[1], rect.high[0], rect.high[1]];
    // An axis is longer than 2^14 by less than 1: each component is rounded.
    sides.into_iter().min().map_or(0.0, |steps| steps as f32 * (1.0 - 1.0 / 8192.0))
}

/// Finds the axis that normals are nearest to; of none, none.
fn main_axis<'a>(members: impl Iterator<Item = &'a Disc> + Clone) -> Option<usize> {
    let first = members.clone().next()?.normal;
    let mut sum = [0i64; 3];
    for disc in members {
        // Two-sided surfels may look either way.
        let along: i64 = (0..3).map(|i| i64::from(first[i]) * i64::from(disc.normal[i])).sum();
        for i in 0..3 {
            sum[i] += i64::from(disc.normal[i]) * along.signum();
        }
    }
    (0..3).max_by_key(|&i| sum[i].abs())
}

/// Finds for each cell how many steps of a king away the nearest with a name is.
fn steps_to(names: &[u32; SIDE * SIDE]) -> [u16; SIDE * SIDE] {
    const FAR: u16 = SIDE as u16;
    let mut steps = [0; SIDE * SIDE];
    for (steps, name) in steps.iter_mut().zip(names) {
        *steps = if *name == NOBODY { FAR } else { 0 };
    }
    // Down and right, then up and left: each sees the four neighbours it has passed.
    for is_back in [false, true] {
        for i in 0..SIDE * SIDE {
            let at = if is_back { SIDE * SIDE - 1 - i } else { i };
            let back = if is_back { 1 } else { -1 };
            let mut least = steps[at];
            for (du, dv) in [(back, 0), (-1, back), (0, back), (1, back)] {
                let u = (at % SIDE).checked_add_signed(du).filter(|&u| u < SIDE);
                let v = (at / SIDE).checked_add_signed(dv).filter(|&v| v < SIDE);
                if let (Some(u), Some(v)) = (u, v) {
                    least = least.min(steps[v * SIDE + u] + 1);
                }
            }
            steps[at] = least;
        }
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;
    use pvmap_vmap::Shape;
    use pvmap_vmap::tree::root_node;

    /// Asks to stop from the start.
    struct Stopped;

    impl Watch for Stopped {
        fn stage(&self, _name: &'static str, _total: Option<u64>, _unit: &'static str) {}
        fn advance(&self, _n: u64) {}
        fn warn(&self, _message: &str) {}
        fn is_stopped(&self) -> bool {
            true
        }
    }

    #[test]
    fn looking_for_sheets_stops_when_asked() {
        let mut tree = Tree { nodes: vec![root_node(Shape::Binned, 0)], ..Tree::default() };
        tree.nodes[0].end = 1;
        let found = Sheets::new(&tree, &[], &[], u64::MAX, &Stopped);
        assert!(matches!(found, Err(StoreError::Interrupted)));
    }
}
