//! The leaf kernel as one would write it without promises: sixteen segments at a time in f64, no
//! margins, no integers. What it says is right but for ties. It culls by boxes, as the filtered
//! kernel does in its own way, so that the two do comparable work.

use multiversion::multiversion;
use pvmap::geometry::Box3;
use pvmap::geometry::disc::Disc;

/// Segments at a time.
const WIDTH: usize = 16;

/// Sixteen segments, a lane each. Lanes that are not used repeat the first.
struct Packet {
    near: [[f64; WIDTH]; 3],
    far: [[f64; WIDTH]; 3],
    /// Squared, around each end.
    spared: [[f64; WIDTH]; 2],
    around: Box3,
    n: usize,
}

/// A disc.
struct Plate {
    normal: [f64; 3],
    centroid: [f64; 3],
    radius2: f64,
    low: [f64; 3],
    high: [f64; 3],
}

/// Counts the open pairs of a block that none of the discs blocks. The block's rows and columns
/// are consecutive discs from `firsts` on; `open` has a bit a column for each row.
pub(crate) fn n_visible(
    discs: &[Disc],
    firsts: [u32; 2],
    open: &[u64],
    list: &[(u32, Box3)],
) -> u64 {
    let mut pairs = Vec::new();
    for (row, &open) in open.iter().enumerate() {
        let columns = (0..64).filter(|column| open >> column & 1 == 1);
        pairs.extend(columns.map(|c| (firsts[0] as usize + row, firsts[1] as usize + c)));
    }
    let plates: Vec<Plate> = list.iter().map(|&(id, _)| plate(&discs[id as usize])).collect();
    pairs.chunks(WIDTH).map(|pairs| n_open(&packet(discs, pairs), list, &plates)).sum()
}

fn packet(discs: &[Disc], pairs: &[(usize, usize)]) -> Packet {
    let first = Box3::at(discs[pairs[0].0].centroid);
    let mut packet = Packet {
        near: [[0.0; WIDTH]; 3],
        far: [[0.0; WIDTH]; 3],
        spared: [[0.0; WIDTH]; 2],
        around: first,
        n: pairs.len(),
    };
    for k in 0..WIDTH {
        let (a, b) = pairs[if k < pairs.len() { k } else { 0 }];
        let [a, b] = [&discs[a], &discs[b]];
        for i in 0..3 {
            packet.near[i][k] = f64::from(a.centroid[i]);
            packet.far[i][k] = f64::from(b.centroid[i]);
        }
        (packet.spared[0][k], packet.spared[1][k]) = (a.radius2 as f64, b.radius2 as f64);
        let ends = Box3::at(a.centroid).join(&Box3::at(b.centroid));
        packet.around = packet.around.join(&ends);
    }
    packet
}

fn plate(disc: &Disc) -> Plate {
    Plate {
        normal: disc.normal.map(f64::from),
        centroid: disc.centroid.map(f64::from),
        radius2: disc.radius2 as f64,
        low: disc.limit.min.map(f64::from),
        high: disc.limit.max.map(f64::from),
    }
}

/// Counts the segments that no disc blocks.
#[multiversion(targets = "simd")]
fn n_open(packet: &Packet, list: &[(u32, Box3)], plates: &[Plate]) -> u64 {
    let mut blocked = [false; WIDTH];
    for ((_, reach), plate) in list.iter().zip(plates) {
        if reach.meet(&packet.around).is_empty() {
            continue;
        }
        let mut all = true;
        for k in 0..WIDTH {
            blocked[k] |= is_blocked(packet, k, plate);
            all &= blocked[k];
        }
        if all {
            return 0;
        }
    }
    blocked[..packet.n].iter().map(|&b| u64::from(!b)).sum()
}

/// [V-2] in floats, profile `patch`.
#[inline(always)]
fn is_blocked(packet: &Packet, k: usize, plate: &Plate) -> bool {
    let p = [packet.near[0][k], packet.near[1][k], packet.near[2][k]];
    let q = [packet.far[0][k], packet.far[1][k], packet.far[2][k]];
    let d = minus(q, p);
    let (h, s) = (dot(plate.normal, minus(plate.centroid, p)), dot(plate.normal, d));
    // Parallel: infinite or NaN, and no comparison with it is true.
    let t = h / s;
    let x = [p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]];
    let (from, to) = (minus(x, p), minus(x, q));
    let off = minus(x, plate.centroid);
    let mut inside = (t > 0.0) & (t < 1.0) & (dot(off, off) <= plate.radius2);
    for i in 0..3 {
        inside &= (plate.low[i] <= x[i]) & (x[i] <= plate.high[i]);
    }
    inside & (dot(from, from) > packet.spared[0][k]) & (dot(to, to) > packet.spared[1][k])
}

#[inline(always)]
fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
