//! The cave: a noise-displaced cavern with columns and niches.

use crate::noise::Noise;
use crate::paint::Paint;
use crate::polygonise::Lattice;
use crate::random::{between, bits};
use crate::scene::Surface;
use crate::shape::Shape;
use crate::vector::{Vector, length, sub};

/// Half axes of the hall, an ellipsoid around `HALL_CENTRE_M`.
const HALL_M: Vector = [11.0, 8.5, 5.5];
const HALL_CENTRE_M: Vector = [14.4, 12.0, 3.0];
/// Height of the floor before the noise.
const FLOOR_M: f64 = 1.5;
/// How far the noise moves the hall's walls and the columns' flanks, at most.
const WALL_NOISE_M: f64 = 1.0;
const FLANK_NOISE_M: f64 = 0.2;
/// Columns stand in a grid, one a box of that many by that many.
const COLUMN_GRID: [u64; 2] = [3, 2];
/// A column's radius at its waist, and by how much it is wider at the floor and at the ceiling.
const COLUMN_WAIST_M: [f64; 2] = [0.5, 0.9];
const COLUMN_FLARE_M: f64 = 0.7;
/// Niches: round hollows in the wall at about the height of a statue.
const N_NICHES: u64 = 9;
const NICHE_RADIUS_M: [f64; 2] = [1.1, 1.8];

/// The lattice that the field is polygonised on: from the origin, beyond all rock that is seen.
const CELL_M: f64 = 0.3;
const N_CELLS: [usize; 3] = [96, 80, 35];

/// Builds the surfaces of the cave: a closed mesh of some 110 000 triangles, normals into the void.
/// Here and there a crumb of rock floats or a bubble is shut in, each closed too (0.1 % of all).
pub(crate) fn surfaces(key: u64) -> Vec<Surface> {
    let cave = Field::new(key);
    let paint = Paint::Rock(Noise::new(bits(key, 1)));
    Lattice::new([0.0; 3], CELL_M, N_CELLS, |p| cave.at(p))
        .triangles()
        .into_iter()
        .map(|corners| Surface { shape: Shape::Triangle(corners), paint })
        .collect()
}

/// Where the cave is void and where it is rock.
#[derive(Debug)]
struct Field {
    noise: Noise,
    columns: Vec<Column>,
    /// Centre and radius of each niche.
    niches: Vec<(Vector, f64)>,
}

/// An upright hourglass of rock.
#[derive(Debug, Clone, Copy)]
struct Column {
    x_m: f64,
    y_m: f64,
    waist_m: f64,
}

impl Field {
    fn new(key: u64) -> Field {
        Field {
            noise: Noise::new(bits(key, 2)),
            columns: columns(bits(key, 3)),
            niches: niches(bits(key, 4)),
        }
    }

    /// Gives about the distance in metres to the nearest rock: positive in the void, negative in
    /// the rock.
    fn at(&self, p: Vector) -> f64 {
        let in_hall = [0, 1, 2].map(|i| (p[i] - HALL_CENTRE_M[i]) / HALL_M[i]);
        let mut hall = (1.0 - length(in_hall)) * HALL_M[2];
        for &(centre, radius_m) in &self.niches {
            hall = hall.max(radius_m - length(sub(p, centre)));
        }
        hall = hall.min(p[2] - FLOOR_M);
        let rough = self.noise.octaves(p.map(|v| v * 0.45), 4);
        let mut void = hall + WALL_NOISE_M * rough;
        for column in &self.columns {
            void = void.min(column.distance(p) + FLANK_NOISE_M * rough);
        }
        void
    }
}

impl Column {
    /// Gives the level distance from the flank, negative inside.
    fn distance(&self, p: Vector) -> f64 {
        let from_waist = (p[2] - HALL_CENTRE_M[2] - 1.0) / HALL_M[2];
        let radius_m = self.waist_m + COLUMN_FLARE_M * from_waist * from_waist;
        length([p[0] - self.x_m, p[1] - self.y_m, 0.0]) - radius_m
    }
}

/// Draws the columns: one in the inner half of each box of a grid over the middle of the hall.
fn columns(key: u64) -> Vec<Column> {
    let [nx, ny] = COLUMN_GRID;
    (0..nx * ny)
        .map(|i| {
            let place = |axis: usize, n: u64, step: u64| {
                let at = step as f64 + between(key, 3 * i + axis as u64, 0.25, 0.75);
                HALL_CENTRE_M[axis] + (2.0 * at / n as f64 - 1.0) * 0.7 * HALL_M[axis]
            };
            Column {
                x_m: place(0, nx, i % nx),
                y_m: place(1, ny, i / nx),
                waist_m: between(key, 3 * i + 2, COLUMN_WAIST_M[0], COLUMN_WAIST_M[1]),
            }
        })
        .collect()
}

/// Draws the niches: their centres lie on the hall's wall, spread around it.
fn niches(key: u64) -> Vec<(Vector, f64)> {
    (0..N_NICHES)
        .map(|i| {
            // A round of the square's rim is spread evenly enough, and needs no sine.
            let round = 4.0 * (i as f64 + between(key, 3 * i, 0.2, 0.8)) / N_NICHES as f64;
            let along = 2.0 * round.fract() - 1.0;
            let [x, y] = match round as u64 {
                0 => [1.0, along],
                1 => [-along, 1.0],
                2 => [-1.0, -along],
                _ => [along, -1.0],
            };
            let to_rim = 1.0 / length([x, y, 0.0]);
            let centre = [
                HALL_CENTRE_M[0] + x * to_rim * HALL_M[0],
                HALL_CENTRE_M[1] + y * to_rim * HALL_M[1],
                FLOOR_M + between(key, 3 * i + 1, 0.8, 2.2),
            ];
            (centre, between(key, 3 * i + 2, NICHE_RADIUS_M[0], NICHE_RADIUS_M[1]))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::polygonise::tests::assert_closed;
    use crate::random::unit_pair;
    use crate::vector::add_scaled;
    use crate::{Scene, SceneKind};

    fn corners(surface: &Surface) -> &[Vector] {
        match &surface.shape {
            Shape::Triangle(corners) => corners,
            other => panic!("the cave is made of triangles, not of {other:?}"),
        }
    }

    #[test]
    fn the_cave_is_closed_whatever_the_seed() {
        for seed in 0..4 {
            let surfaces = surfaces(bits(seed, 9));
            assert!((50_000..150_000).contains(&surfaces.len()), "{}", surfaces.len());
            assert_closed(surfaces.iter().map(corners));
        }
    }

    #[test]
    fn the_lattice_holds_the_whole_cave() {
        // If the field were void at the border, the mesh would end in flat caps there.
        let far = [0, 1, 2].map(|i| (N_CELLS[i] as f64 - 1.5) * CELL_M);
        for seed in 0..20 {
            let cave = Field::new(bits(seed, 9));
            for i in 0..20_000 {
                let ([u, v], side) = (unit_pair(bits(seed, i)), i as usize % 6);
                let axis = side / 2;
                let mut p = [u * far[0], v * far[1], (u + v) * 0.5 * far[2]];
                p[(axis + 1) % 3] = u * far[(axis + 1) % 3];
                p[(axis + 2) % 3] = v * far[(axis + 2) % 3];
                p[axis] = if side.is_multiple_of(2) { 1.5 * CELL_M } else { far[axis] };
                assert!(cave.at(p) < 0.0, "seed {seed} is void at {p:?}");
            }
        }
    }

    #[test]
    fn nothing_is_seen_through_a_column() {
        let scene = Scene::new(SceneKind::Cave, 5);
        let points = scene.points(40_000).shuffled();
        let columns = columns(bits(scene.key, 3));
        let mut asked = 0;
        for i in (0..points.len()).step_by(2) {
            let (a, b) = (points.at(i), points.at(i + 1));
            let (a, b) = if i % 4 == 0 { (a, b) } else { (b, a) };
            for column in &columns {
                // Where the segment passes the column's axis, seen from above.
                let [dx, dy] = [0, 1].map(|k| b.position[k] - a.position[k]);
                let [ox, oy] = [column.x_m - a.position[0], column.y_m - a.position[1]];
                let t = (ox * dx + oy * dy) / (dx * dx + dy * dy);
                let miss = (ox * dy - oy * dx).abs() / (dx * dx + dy * dy).sqrt();
                if t > 0.0 && t < 1.0 && miss < 0.5 * COLUMN_WAIST_M[0] {
                    asked += 1;
                    assert!(!scene.sees(&a, &b), "{a:?} sees {b:?} through {column:?}");
                }
            }
        }
        assert!(asked > 500, "{asked}");
    }

    #[test]
    fn the_truth_follows_the_field() {
        let scene = Scene::new(SceneKind::Cave, 6);
        let field = Field::new(scene.key);
        let points = scene.points(20_000).shuffled();
        let (mut seen, mut hidden) = (0, 0);
        for i in (0..points.len()).step_by(2) {
            let (a, b) = (points.at(i), points.at(i + 1));
            let d = sub(b.position, a.position);
            let facing = |s: &crate::Sample, sign: f64| {
                sign * crate::vector::dot(s.normal.map(f64::from), d) > 0.3 * length(d)
            };
            if !facing(&a, 1.0) || !facing(&b, -1.0) {
                continue;
            }
            // The deepest rock on the way, a metre from the ends on, every 5 cm.
            let steps = (length(d) / 0.05) as usize;
            let ends = 20.min(steps / 2);
            let deepest = (ends..=steps - ends)
                .map(|s| field.at(add_scaled(a.position, s as f64 / steps as f64, d)))
                .fold(f64::INFINITY, f64::min);
            // The mesh follows the field to less than a cell.
            if scene.sees(&a, &b) {
                seen += 1;
                assert!(deepest > -CELL_M, "{a:?} sees {b:?} through {deepest} m of rock");
            } else if ends == 20 {
                hidden += 1;
                assert!(deepest < 1.0, "{a:?} does not see {b:?} though {deepest} m are free");
            }
        }
        assert!(seen > 500 && hidden > 500, "{seen} {hidden}");
    }
}
