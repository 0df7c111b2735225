//! The Cornell rooms: a closed cube of 5.5 m from the origin; x to the right, y to the back, z up.

use crate::paint::Paint;
use crate::scene::Surface;
use crate::shape::Shape;
use crate::vector::Vector;

/// The room's side, as of the box that stood in Cornell.
const SIDE_M: f64 = 5.5;

const WHITE: Paint = Paint::Plain([222, 218, 208]);
const RED: Paint = Paint::Plain([186, 38, 32]);
const GREEN: Paint = Paint::Plain([42, 150, 58]);
const PINK: Paint = Paint::Plain([236, 152, 170]);
const BLUE: Paint = Paint::Plain([92, 128, 200]);

/// The gap between the packed room's box and the walls and ceiling.
const PACKED_GAP_M: f64 = 0.5;

/// The furnished room's box: middle of its foot, half its side, height.
const BOX_FOOT_M: [f64; 2] = [1.9, 3.6];
const BOX_HALF_M: f64 = 0.8;
const BOX_HEIGHT_M: f64 = 3.2;
/// Cosine and sine of its turn about z, 16.26°: exact fractions of a Pythagorean triple.
const BOX_TURN: [f64; 2] = [24.0 / 25.0, 7.0 / 25.0];

/// The furnished room's sphere stands on the floor before the box, to its right.
const SPHERE_RADIUS_M: f64 = 0.9;
const SPHERE_CENTRE_M: Vector = [3.9, 1.8, SPHERE_RADIUS_M];

/// The longest side of a statue, where it fits and nothing else is asked for.
pub(crate) const STATUE_M: f64 = 3.0;
/// How far statues stay from the walls, the ceiling and half way from each other.
const STATUE_GAP_M: f64 = 0.25;
/// The most statues in a room: an eleventh would leave nothing of their parts but the gaps.
pub(crate) const MOST_STATUES: usize = 10;
/// What statues are made of, one after the other: grey stone, weathered bronze, sandstone.
const STATUES: [Paint; 3] =
    [Paint::Plain([168, 160, 150]), Paint::Plain([112, 138, 124]), Paint::Plain([206, 172, 122])];

/// Gives the middle of the foot of statue `i` of `n` ≤ [`MOST_STATUES`], and the sides of the
/// space it may fill, all above 0.
pub(crate) fn place_of_statue(i: usize, n: usize) -> ([f64; 2], Vector) {
    let part_m = SIDE_M / n as f64;
    let space_m = [part_m - 2.0 * STATUE_GAP_M, SIDE_M - 2.0 * STATUE_GAP_M, SIDE_M - STATUE_GAP_M];
    ([part_m * (i as f64 + 0.5), 0.5 * SIDE_M], space_m)
}

/// Gives the paint of statue `i`.
pub(crate) fn paint_of_statue(i: usize) -> Paint {
    STATUES[i % STATUES.len()]
}

/// Builds the empty room.
pub(crate) fn empty() -> Vec<Surface> {
    let mut room = vec![paint(Shape::Quad(level(FLOOR, 0.0)), WHITE)];
    room.extend(walls());
    room
}

/// Builds the room packed to capacity with one large box.
pub(crate) fn packed() -> Vec<Surface> {
    let (near, far) = (PACKED_GAP_M, SIDE_M - PACKED_GAP_M);
    let foot = [[near, near], [far, near], [far, far], [near, far]];
    with_box(foot, SIDE_M - PACKED_GAP_M)
}

/// Builds the room with a sphere and a turned box.
pub(crate) fn furnished() -> Vec<Surface> {
    let [cos, sin] = BOX_TURN;
    let foot = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, y]| {
        [
            BOX_FOOT_M[0] + BOX_HALF_M * (cos * x - sin * y),
            BOX_FOOT_M[1] + BOX_HALF_M * (sin * x + cos * y),
        ]
    });
    let mut room = with_box(foot, BOX_HEIGHT_M);
    let sphere = Shape::Sphere { centre: SPHERE_CENTRE_M, radius_m: SPHERE_RADIUS_M };
    room.push(paint(sphere, PINK));
    room
}

/// The room's corners in plan, counter-clockwise as seen from above.
const FLOOR: [[f64; 2]; 4] = [[0.0, 0.0], [SIDE_M, 0.0], [SIDE_M, SIDE_M], [0.0, SIDE_M]];

/// Lifts a plan to a height.
fn level(plan: [[f64; 2]; 4], z: f64) -> [Vector; 4] {
    plan.map(|[x, y]| [x, y, z])
}

fn paint(shape: Shape, paint: Paint) -> Surface {
    Surface { shape, paint }
}

/// Builds the ceiling and the front, right, back and left wall.
fn walls() -> Vec<Surface> {
    let [a, b, c, d] = level(FLOOR, SIDE_M);
    let mut walls = vec![paint(Shape::Quad([a, d, c, b]), WHITE)];
    for (side, color) in [WHITE, GREEN, WHITE, RED].into_iter().enumerate() {
        let [from, to, to_top, from_top] = upright(FLOOR, side, SIDE_M);
        walls.push(paint(Shape::Quad([to, from, from_top, to_top]), color));
    }
    walls
}

/// Builds the room with a box on that foot (counter-clockwise from above, its first corner
/// nearest to the room's first). The floor leaves out what the box stands on, as a scan would.
fn with_box(foot: [[f64; 2]; 4], height_m: f64) -> Vec<Surface> {
    let (outer, inner) = (level(FLOOR, 0.0), level(foot, 0.0));
    let mut room = Vec::new();
    for i in 0..4 {
        let next = (i + 1) % 4;
        for corners in [[outer[i], outer[next], inner[next]], [outer[i], inner[next], inner[i]]] {
            room.push(paint(Shape::Triangle(corners), WHITE));
        }
    }
    room.extend(walls());
    room.push(paint(Shape::Quad(level(foot, height_m)), BLUE));
    for side in 0..4 {
        room.push(paint(Shape::Quad(upright(foot, side, height_m)), BLUE));
    }
    room
}

/// Gives the face over one side of a plan, seen from outside the plan.
fn upright(plan: [[f64; 2]; 4], side: usize, height_m: f64) -> [Vector; 4] {
    let ([ax, ay], [bx, by]) = (plan[side], plan[(side + 1) % 4]);
    [[ax, ay, 0.0], [bx, by, 0.0], [bx, by, height_m], [ax, ay, height_m]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::polygonise::tests::assert_closed;

    #[test]
    fn the_rooms_are_closed() {
        for room in [empty(), packed(), furnished()] {
            assert_closed(room.iter().filter_map(|s| match &s.shape {
                Shape::Quad(corners) => Some(&corners[..]),
                Shape::Triangle(corners) | Shape::Smooth { corners, .. } => Some(&corners[..]),
                Shape::Sphere { .. } => None,
            }));
        }
    }

    #[test]
    fn areas_are_those_of_the_plan() {
        let area = |room: &[Surface]| room.iter().map(|s| s.shape.area()).sum::<f64>();
        let empty_m2 = 6.0 * SIDE_M * SIDE_M;
        assert!((area(&empty()) - empty_m2).abs() < 1e-9);
        // A box on the floor adds its sides: the top is what the floor loses.
        let packed_m2 = empty_m2 + 4.0 * 4.5 * 5.0;
        assert!((area(&packed()) - packed_m2).abs() < 1e-9);
        let sphere_m2 = 4.0 * std::f64::consts::PI * SPHERE_RADIUS_M * SPHERE_RADIUS_M;
        let furnished_m2 = empty_m2 + 4.0 * 2.0 * BOX_HALF_M * BOX_HEIGHT_M + sphere_m2;
        assert!((area(&furnished()) - furnished_m2).abs() < 1e-9);
    }

    #[test]
    fn nothing_touches_the_walls_or_each_other() {
        let foot_m = 2f64.sqrt() * BOX_HALF_M;
        for (middle, radius_m) in [(BOX_FOOT_M, foot_m), ([3.9, 1.8], SPHERE_RADIUS_M)] {
            for c in middle {
                assert!(c - radius_m > 0.3 && c + radius_m < SIDE_M - 0.3);
            }
        }
        let apart = [0, 1].map(|i| SPHERE_CENTRE_M[i] - BOX_FOOT_M[i]);
        let apart_m = (apart[0] * apart[0] + apart[1] * apart[1]).sqrt();
        assert!(apart_m > foot_m + SPHERE_RADIUS_M + 0.3);
    }
}
