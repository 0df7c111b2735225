//! What the points of a scan are like: how far apart they are, how noisy, where they end, and
//! whether their normals go with them. Measured at a sample of points, each with the 16 nearest of
//! all points.
//!
//! A sample is one point of each of so many equally long pieces of the octree's order, so that it
//! follows the points wherever they are, and is the same every time.

mod neighbours;
mod rim;

use pvmap_geometry::GridPoint;
use pvmap_geometry::normal::Normal;
use pvmap_geometry::plane::Moments;
use pvmap_vmap::{FormatError, OctreeView};
use rayon::prelude::*;

use self::neighbours::{K, Neighbourhood, Neighbours};
use self::rim::is_at_rim;
use crate::error::QueryError;

/// Degrees of a class of angles.
pub const CLASS_DEG: u32 = 15;
/// Classes of angles, which end at 90°: what of a normal is compared has no sign.
pub const N_CLASSES: usize = 6;
/// Normals of which half are further than this from their planes are not those of the points.
const CONTRADICTION_DEG: f64 = 45.0;
/// With fewer angles nothing is said of normals: a cube has 8 corners.
const FEWEST_ANGLES: u64 = 16;
/// Points that a plane passes through whatever they are.
const N_ON_ANY_PLANE: usize = 3;
/// Points between two questions whether to go on.
const PIECE: u64 = 256;

/// What a sample of points says; lengths are in the units of the scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Quality {
    /// Points that were looked at.
    pub n_sampled: u64,
    /// Those of them in whose place there is another point.
    pub n_coincident: u64,
    /// The distance to the nearest point in another place: 5, 50 and 95 of 100 points have at most
    /// this. None where all points are in one place.
    pub spacing: Option<[f64; 3]>,
    /// The median of how far points are from the plane through their neighbourhoods: in each the
    /// root of their squared distances from it over n - 3, which for noise across a plane is its
    /// standard deviation. What is curved or an edge has thickness, too. None without a plane.
    pub thickness: Option<f64>,
    /// Points of which can be said whether they are at a rim.
    pub n_inside_or_rim: u64,
    /// Those of them at a rim: their neighbours, seen in the plane through them, leave an angle of
    /// more than 120° without any. It is as long as the holes and borders of what was sampled.
    pub n_rim: u64,
    /// What of it concerns normals.
    pub normals: NormalQuality,
}

/// What a sample of points says of normals.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalQuality {
    /// How many normals of the file are at an angle of 0 to 15°, to 30° and so on to the normal of
    /// the plane through their neighbourhood, whatever their sides. Points without such a plane and
    /// normals that were estimated are left out.
    pub angles: [u64; N_CLASSES],
    /// The median of these angles, degrees; none where there is none.
    pub median_deg: Option<f64>,
    /// Points whose side is known and that have neighbours whose side is known.
    pub n_oriented: u64,
    /// Those of them that face away from more such neighbours (n·n' < 0) than they go with.
    pub n_turned: u64,
}

impl Quality {
    /// Gives how uneven the density is: the spacing that 95 of 100 points keep to over that of 5.
    pub fn unevenness(&self) -> Option<f64> {
        self.spacing.map(|[few, _, most]| most / few)
    }

    /// Gives the thickness as a part of the median spacing.
    pub fn thickness_of_spacing(&self) -> Option<f64> {
        Some(self.thickness? / self.spacing?[1])
    }
}

impl NormalQuality {
    /// Counts the normals of the file that were compared.
    pub fn n_angles(&self) -> u64 {
        self.angles.iter().sum()
    }

    /// Says whether the normals of the file are not those of the surfaces that the points show: the
    /// median angle is above 45°.
    pub fn contradict_points(&self) -> bool {
        let is_wide = self.median_deg.is_some_and(|median| median > CONTRADICTION_DEG);
        is_wide && self.n_angles() >= FEWEST_ANGLES
    }
}

/// What was seen of one point.
#[derive(Debug, Clone, Copy)]
struct Seen {
    is_coincident: bool,
    /// Squared distance to the nearest point in another place, grid steps².
    spacing2: Option<u64>,
    /// Grid steps.
    thickness: Option<f64>,
    /// Whether the surface ends here, as far as its points go.
    is_at_rim: Option<bool>,
    angle_deg: Option<f64>,
    /// Whether it faces away from its neighbours, where sides are known.
    is_turned: Option<bool>,
}

/// Looks at `n` points of an octree, or at all if it has fewer. `goes_on` hears of so many more,
/// from any thread of the current rayon pool, and says whether to go on.
///
/// # Errors
/// Where the octree is damaged, or `goes_on` said no.
pub fn measure(
    octree: &OctreeView<'_>,
    n: u64,
    goes_on: &(dyn Fn(u64) -> bool + Sync),
) -> Result<Quality, QueryError> {
    let n_points = octree.summary().n_points;
    let n = n.min(n_points);
    let piece = |first: u64| {
        let mut neighbours = Neighbours::new(octree);
        let end = n.min(first + PIECE);
        let points = (first..end).map(|i| look(octree, chosen(i, n, n_points), &mut neighbours));
        let seen = points.collect::<Result<Vec<Seen>, _>>().map_err(QueryError::Octree)?;
        if goes_on(end - first) { Ok(seen) } else { Err(QueryError::Stopped) }
    };
    let firsts = (0..n.div_ceil(PIECE)).into_par_iter().map(|i| i * PIECE);
    let seen: Vec<Vec<Seen>> = firsts.map(piece).collect::<Result<_, _>>()?;
    Ok(sum(&seen.concat(), octree.frame().frame.unit()))
}

/// Gives the point that stands for piece `i` of `n`: one at random, as an even step would meet the
/// rows of a regular scan.
fn chosen(i: u64, n: u64, n_points: u64) -> u64 {
    let start = |i: u64| (u128::from(i) * u128::from(n_points) / u128::from(n)) as u64;
    // SplitMix64.
    let mut random = (i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    random = (random ^ random >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    random = (random ^ random >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    let (first, end) = (start(i), start(i + 1));
    first + (random ^ random >> 31) % (end - first)
}

fn look(
    octree: &OctreeView<'_>,
    index: u64,
    neighbours: &mut Neighbours<'_, '_>,
) -> Result<Seen, FormatError> {
    let points = octree.points(index, 1)?;
    let point = points.iter().next().expect("one was asked for")?;
    let near = neighbours.around(point.key.g)?;
    let offset = |g: GridPoint| [0, 1, 2].map(|i| i64::from(g[i]) - i64::from(point.key.g[i]));
    let offsets: Vec<[i64; 3]> = near.points().map(|other| offset(other.g())).collect();
    let mut moments = Moments::default();
    offsets.iter().for_each(|&d| moments.add(d, 1));
    let plane = moments.plane();
    let n_free = near.points().len().saturating_sub(N_ON_ANY_PLANE);
    let thickness = plane.filter(|_| n_free > 0).map(|p| (p.residual2 / n_free as f64).sqrt());
    let normal = point.key.normal.map(f64::from);
    let is_given = point.normal_from_source && normal != [0.0; 3];
    let angle_deg = plane.filter(|_| is_given).map(|plane| {
        let along: f64 = (0..3).map(|i| plane.normal[i] * normal[i]).sum();
        let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
        (along / length).abs().min(1.0).acos().to_degrees()
    });
    Ok(Seen {
        is_coincident: near.n_same_place() > 1,
        spacing2: near.spacing2(),
        thickness,
        is_at_rim: plane.and_then(|plane| is_at_rim(&offsets, plane.normal)),
        angle_deg,
        is_turned: point.key.oriented.then(|| is_turned(index, point.key.normal, &near)).flatten(),
    })
}

/// Says whether a point faces away from most of its neighbours; nothing where no other has a side.
fn is_turned(index: u64, normal: Normal, near: &Neighbourhood) -> Option<bool> {
    let mut others = near.points().filter(|p| p.index() != index && p.is_oriented()).peekable();
    others.peek()?;
    let along = |n: Normal| (0..3).map(|i| i64::from(normal[i]) * i64::from(n[i])).sum::<i64>();
    Some(others.map(|p| along(p.normal()).signum()).sum::<i64>() < 0)
}

fn sum(seen: &[Seen], unit: f64) -> Quality {
    let count = |f: &dyn Fn(&Seen) -> bool| seen.iter().filter(|s| f(s)).count() as u64;
    let sorted = |f: &dyn Fn(&Seen) -> Option<f64>| {
        let mut values: Vec<f64> = seen.iter().filter_map(f).collect();
        values.sort_unstable_by(f64::total_cmp);
        values
    };
    // Below 2^46, so the float is exact before the root.
    let spacings = sorted(&|s| s.spacing2.map(|d2| (d2 as f64).sqrt() * unit));
    let thicknesses = sorted(&|s| s.thickness.map(|t| t * unit));
    let angles_deg = sorted(&|s| s.angle_deg);
    let mut angles = [0; N_CLASSES];
    for angle in &angles_deg {
        angles[((*angle as u32 / CLASS_DEG) as usize).min(N_CLASSES - 1)] += 1;
    }
    Quality {
        n_sampled: seen.len() as u64,
        n_coincident: count(&|s| s.is_coincident),
        spacing: (!spacings.is_empty()).then(|| [5, 50, 95].map(|q| quantile(&spacings, q))),
        thickness: (!thicknesses.is_empty()).then(|| quantile(&thicknesses, 50)),
        n_inside_or_rim: count(&|s| s.is_at_rim.is_some()),
        n_rim: count(&|s| s.is_at_rim == Some(true)),
        normals: NormalQuality {
            angles,
            median_deg: (!angles_deg.is_empty()).then(|| quantile(&angles_deg, 50)),
            n_oriented: count(&|s| s.is_turned.is_some()),
            n_turned: count(&|s| s.is_turned == Some(true)),
        },
    }
}

/// Gives the least value that `percent` of the sorted ones do not exceed.
fn quantile(sorted: &[f64], percent: usize) -> f64 {
    sorted[(sorted.len() * percent).div_ceil(100).max(1) - 1]
}

const _: () = assert!(CLASS_DEG as usize * N_CLASSES == 90 && K > N_ON_ANY_PLANE);
