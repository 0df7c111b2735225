//! Where the sampled surface ends: at holes, behind what hid it from the scanner, at the border.

/// Neighbours in other places that are needed to say anything.
const FEWEST_DIRECTIONS: usize = 8;
/// Cosine of the least angle without a neighbour at a rim: 120°. On a surface that is sampled
/// evenly, on a grid or with a point in each of its cells, no 15 neighbours leave it; of neighbours
/// at random they do so around one point of 18. With 90° these would be one of four.
const RIM_COS: f64 = -0.5;
/// Sines and cosines nearer than this are equal: on a lattice many are, but for rounding.
const HAIR: f64 = 1e-9;
/// Squared length, grid steps², below which a neighbour is before or behind the point and no more.
const LEAST_LENGTH2: f64 = 1e-6;

/// Says whether the neighbours of a point, seen in their plane, leave an angle of more than 120°
/// without any; `offsets` lead to them. Nothing where there are fewer than eight elsewhere.
///
/// Source: the angle criterion for boundary points (Linsen and Prautzsch 2001; Bendels, Schnabel
/// and Klein 2006; PCL's `BoundaryEstimation`).
pub(super) fn is_at_rim(offsets: &[[i64; 3]], normal: [f64; 3]) -> Option<bool> {
    let (u, v) = basis(normal);
    let flat = |d: &[i64; 3]| {
        let d = d.map(|x| x as f64);
        let along = |axis: [f64; 3]| (0..3).map(|i| d[i] * axis[i]).sum::<f64>();
        [along(u), along(v)]
    };
    let length2 = |c: &[f64; 2]| c[0] * c[0] + c[1] * c[1];
    let is_beside = |c: &[f64; 2]| length2(c) > LEAST_LENGTH2;
    let places: Vec<[f64; 2]> = offsets.iter().map(flat).filter(is_beside).collect();
    if places.len() < FEWEST_DIRECTIONS {
        return None;
    }
    // Whether `b` comes after `a` counterclockwise within 120°, by signs and a root alone.
    let follows = |a: &[f64; 2], b: &[f64; 2]| {
        let cross = a[0] * b[1] - a[1] * b[0];
        let dot = a[0] * b[0] + a[1] * b[1];
        let lengths = (length2(a) * length2(b)).sqrt();
        cross > HAIR * lengths && dot > (RIM_COS - HAIR) * lengths
    };
    let ends = |a: &[f64; 2]| !places.iter().any(|b| follows(a, b));
    Some(places.iter().any(ends))
}

/// Gives two directions across a unit vector and each other.
fn basis(n: [f64; 3]) -> ([f64; 3], [f64; 3]) {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [0, 1, 2].map(|i| a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3])
    };
    // The axis that it is least along.
    let least = (0..3).min_by(|&i, &j| n[i].abs().total_cmp(&n[j].abs())).unwrap_or(0);
    let mut axis = [0.0; 3];
    axis[least] = 1.0;
    let u = cross(n, axis);
    let length = u.iter().map(|v| v * v).sum::<f64>().sqrt();
    let u = u.map(|v| v / length);
    (u, cross(n, u))
}
