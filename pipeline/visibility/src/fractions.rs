//! Visible fractions: which segments are tried between two nodes, and how what they say travels
//! with the links. Source: FORMAT.md [F-24]…[F-26].

use pvmap_geometry::Box3;
use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::normal::NORMAL_LENGTH;
use pvmap_geometry::rect::Moments;
use pvmap_store::runs::Pair;
use pvmap_vmap::{Fraction, Surfel, Tree};

use crate::exchange::Exchange;

/// Segments are tried from so many ends of a node to as many of the other.
pub const N_ENDS: usize = 4;

/// Which pairs are tried by a sample; by default none.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tries<'a> {
    /// Leaf pairs whose neighbours differ.
    pub fractions: bool,
    /// Node pairs of little exchange, instead of what is under them.
    pub exchange: Option<&'a Exchange>,
}

/// Marks the lower node of a pair with a visible fraction, so that all of these come behind all
/// links. The ids of nodes are below it.
pub const MARK: u32 = 1 << 31;

/// Makes a pair of numbers that can stand among links.
pub fn marked(fraction: Fraction) -> Pair {
    let (a, numbers) = fraction.to_pair();
    (a | MARK, numbers)
}

/// Reads a pair among links that is none.
pub fn unmarked((a, numbers): Pair) -> Option<Fraction> {
    if a & MARK == 0 { None } else { Fraction::of_pair((a & !MARK, numbers)) }
}

/// Takes back the links behind the first `from` of a list, but no visible fractions.
pub fn take_back(links: &mut Vec<Pair>, from: usize) {
    let mut n_kept = from;
    for i in from..links.len() {
        if links[i].0 & MARK != 0 {
            links[n_kept] = links[i];
            n_kept += 1;
        }
    }
    links.truncate(n_kept);
}

/// Gives the places of a surfel between which and those of another segments are tried. [F-25]
pub fn places(surfel: &Surfel) -> [[i32; 3]; N_ENDS] {
    let c = surfel.centroid.map(|v| v as i32);
    if surfel.normal == [0; 3] {
        return [c; N_ENDS];
    }
    let [e, f] = Moments::new(surfel.normal).axes().map(|axis| axis.map(i64::from));
    let points = surfel.patch.grown(-(surfel.half_spacing as i32));
    let most = (3 * surfel.radius2.isqrt() / 8) as i64;
    let sides = [(1, 1), (1, -1), (-1, 1), (-1, -1)];
    sides.map(|(u, v)| place([0, 1, 2].map(|i| u * e[i] + v * f[i]), c, &points, most))
}

/// Goes from `c` along v, half as far as the box reaches and at most `most`·|v|/2^14 steps.
fn place(v: [i64; 3], c: [i32; 3], points: &Box3, most: i64) -> [i32; 3] {
    let unit = i64::from(NORMAL_LENGTH);
    let reach = |i: usize| {
        let end = if v[i] > 0 { points.max[i] } else { points.min[i] };
        (v[i] != 0).then(|| i64::from(end - c[i]) * unit / v[i] / 2)
    };
    let t = (0..3).filter_map(reach).fold(most, i64::min).max(0);
    [0, 1, 2].map(|i| {
        let step = v[i] * t;
        let rounded = (2 * step.abs() + unit) / (2 * unit) * step.signum();
        (i64::from(c[i]) + rounded).clamp(0, i64::from(GRID_MAX)) as i32
    })
}

/// Gives the surfels of a node that stand for all of its leaves. [F-26]
pub fn representatives(tree: &Tree, id: u32) -> [u32; N_ENDS] {
    let node = &tree.nodes[id as usize];
    let n = u64::from(node.end_surfel - node.first_surfel);
    [0, 1, 2, 3].map(|i| node.first_surfel + ((2 * i + 1) * n / 8) as u32)
}
