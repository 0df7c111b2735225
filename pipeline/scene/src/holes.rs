//! Holes in a scan: balls around places of the surfaces, one after the other, until enough points
//! are gone.
//!
//! The balls are known before any point is, so no place is held: the points are gone through once
//! to count what each ball is the first to take, and once more for those that none takes.

use std::collections::HashMap;

use crate::kept::Kept;
use crate::vector::{Vector, distance2};

/// Balls that are laid out together at first; where they do not take enough, twice as many come
/// next. In a room so many take 97 % of the points.
const N_BALLS: u32 = 4096;

/// Balls in a grid of cells as wide as they are: each touches eight at most.
struct Balls {
    radius_m: f64,
    middles: Vec<Vector>,
    /// The balls that touch each cell, in order.
    of_cell: HashMap<[i64; 3], Vec<u32>>,
}

impl Balls {
    fn new(radius_m: f64, middles: Vec<Vector>) -> Balls {
        let mut balls = Balls { radius_m, middles, of_cell: HashMap::new() };
        for (ball, middle) in (0..).zip(&balls.middles) {
            let [low, high] = [-radius_m, radius_m].map(|by| balls.cell(middle.map(|v| v + by)));
            for x in low[0]..=high[0] {
                for y in low[1]..=high[1] {
                    for z in low[2]..=high[2] {
                        balls.of_cell.entry([x, y, z]).or_default().push(ball);
                    }
                }
            }
        }
        balls
    }

    fn cell(&self, place: Vector) -> [i64; 3] {
        place.map(|v| (v / (2.0 * self.radius_m)).floor() as i64)
    }

    /// Finds the first ball that a place is in.
    fn first(&self, place: Vector) -> Option<u32> {
        let radius2 = self.radius_m * self.radius_m;
        let mut near = self.of_cell.get(&self.cell(place))?.iter().copied();
        near.find(|&b| distance2(place, self.middles[b as usize]) <= radius2)
    }
}

/// Takes points away, a ball after the other, until there are `n_left` or fewer. `place_of` gives
/// the place of a point, `middle_of` that of a ball.
pub(crate) fn make_holes(
    mut kept: Kept,
    n_left: u64,
    radius_m: f64,
    place_of: impl Fn(u64) -> Vector,
    middle_of: impl Fn(u64) -> Vector,
) -> Kept {
    let (mut first_ball, mut n_balls) = (0, N_BALLS);
    while kept.len() > n_left {
        let last_ball = first_ball + u64::from(n_balls);
        let balls = Balls::new(radius_m, (first_ball..last_ball).map(&middle_of).collect());
        let ball_of = |i: u64| balls.first(place_of(i));
        let mut n_of = vec![0u64; n_balls as usize];
        for ball in (0..kept.len()).filter_map(|rank| ball_of(kept.at(rank))) {
            n_of[ball as usize] += 1;
        }
        // Balls after the one that took enough take nothing.
        let mut n = kept.len();
        let mut is_enough = |n_in: &u64| {
            n -= n_in;
            n <= n_left
        };
        let end = n_of.iter().position(&mut is_enough).map_or(n_balls, |ball| ball as u32 + 1);
        let numbers = (0..kept.len()).map(|rank| kept.at(rank));
        kept = numbers.filter(|&i| ball_of(i).is_none_or(|ball| ball >= end)).collect();
        (first_ball, n_balls) = (last_ball, n_balls.saturating_mul(2));
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{bits, unit_pair};

    /// Gives a place of the unit square, the same for the same number.
    fn place(sequence: u64, i: u64) -> Vector {
        let [x, y] = unit_pair(bits(sequence, i));
        [x - 0.5, y, 0.25]
    }

    #[test]
    fn holes_are_those_of_one_ball_after_the_other() {
        let n = 3000;
        for (radius_m, share) in [(0.04, 0.05), (0.04, 0.95), (0.3, 0.5), (1e-3, 0.03), (0.1, 1.0)]
        {
            let n_left = (n as f64 * (1.0 - share)) as u64;
            let (place_of, middle_of) = (|i| place(1, i), |ball| place(2, ball));
            let mut slowly: Vec<u64> = (0..n).collect();
            for ball in 0.. {
                if slowly.len() as u64 <= n_left {
                    break;
                }
                let middle = middle_of(ball);
                slowly.retain(|&i| distance2(place_of(i), middle) > radius_m * radius_m);
            }
            let kept = make_holes((0..n).collect(), n_left, radius_m, place_of, middle_of);
            assert_eq!(kept, slowly.into_iter().collect(), "radius {radius_m}, {share} missing");
        }
    }
}
