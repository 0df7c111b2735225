//! What the points around one place see of those around another, by whole links.

use pvmap_geometry::Box3;
use pvmap_vmap::{FormatError, Node};

use crate::between::{Tally, Walk};
use crate::error::{QueryError, commas};
use crate::map::Map;
use crate::part::{Holds, Part};

/// The surfels whose centroids lie within a distance of a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// World coordinates of its middle, in the cube of the scan.
    pub middle: [f64; 3],
    /// World units, 0 or more.
    pub radius: f64,
}

/// How much of one thing another sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sight {
    /// All of it.
    All,
    /// Some of it: the share of point pairs, above 0 and below 1.
    Part(f64),
    /// None of it.
    None,
}

/// What two regions see of each other, and what it took to find out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegionAnswer {
    /// How many of the pairs see each other: a point of one region, a point of the other. Points
    /// of one surfel see each other. [V-6]
    pub sight: Sight,
    /// Surfels in each region.
    pub n_surfels: [u32; 2],
    /// Points in each region: all those of its surfels.
    pub n_points: [u64; 2],
    /// Pairs of points that see each other.
    pub n_visible: u128,
    /// Links that were counted.
    pub n_links: u64,
    /// Nodes whose links were looked at.
    pub n_nodes: u64,
}

impl Sight {
    /// Gives the share, 0 to 1.
    pub fn share(&self) -> f64 {
        match *self {
            Sight::All => 1.0,
            Sight::Part(share) => share,
            Sight::None => 0.0,
        }
    }

    /// Makes the answer from counts.
    pub(crate) fn of(n_visible: u128, n_all: u128) -> Sight {
        // Above 0 and below 1, even where rounding says otherwise.
        let share = (n_visible as f64 / n_all as f64).clamp(f64::MIN_POSITIVE, 1.0 - f64::EPSILON);
        match n_visible {
            0 => Sight::None,
            n if n >= n_all => Sight::All,
            _ => Sight::Part(share),
        }
    }
}

impl Map<'_> {
    /// Says which of the points in one ball see which in another.
    ///
    /// A surfel is in a ball if |c - g|² ≤ (radius / unit)², rounded down, for its centroid c and
    /// the grid position g of the middle [D-1]: integers. A link that covers surfels of both balls
    /// is counted at once, however many they are.
    ///
    /// # Errors
    /// Where a middle is outside the cube, a radius is none, a ball is empty or the map damaged.
    pub fn region(&self, one: &Ball, other: &Ball) -> Result<RegionAnswer, QueryError> {
        let (x, y) = (self.part_in_ball(one)?, self.part_in_ball(other)?);
        let mut found = self.pairs_between(&x, &y)?;
        found.n_visible = found.n_visible.saturating_add(self.own_pairs(&x, &y)?);
        let n_all = u128::from(x.n_points()) * u128::from(y.n_points());
        Ok(RegionAnswer {
            sight: Sight::of(found.n_visible, n_all),
            n_surfels: [x.n_surfels(), y.n_surfels()],
            n_points: [x.n_points(), y.n_points()],
            n_visible: found.n_visible,
            n_links: found.n_links,
            n_nodes: found.n_nodes,
        })
    }

    /// Counts the pairs that links between two parts settle.
    pub(crate) fn pairs_between(&self, x: &Part, y: &Part) -> Result<Counted, FormatError> {
        let walk = |from, to| Walk { map: self, from, to, skip: &|_| false };
        let found = walk(x, y).run::<Counted>()?;
        let back = walk(y, x).run::<Counted>()?;
        Ok(found.and(back))
    }

    fn part_in_ball(&self, ball: &Ball) -> Result<Part, QueryError> {
        let Ball { middle, radius } = *ball;
        if radius.is_nan() || radius < 0.0 {
            return Err(QueryError::Radius(radius));
        }
        let g = self.grid_of(middle)?.map(|v| v as i32);
        // `as` saturates; in a cube without size all distances are 0.
        let radius2 = (radius / self.view().frame().frame.unit()).powi(2).floor() as u64;
        let cell = |cell: &Box3| {
            if cell.distance2(g) > radius2 {
                Holds::Nothing
            } else if farthest2(cell, g) <= radius2 {
                Holds::All
            } else {
                Holds::Some
            }
        };
        let part = Part::of_space(self, cell, |c| Box3::at(c).distance2(g) <= radius2)?;
        if part.n_surfels() == 0 {
            let there = format!("within {radius} of {}", commas(&middle));
            return Err(QueryError::NothingThere(there));
        }
        Ok(part)
    }

    /// Counts the pairs of points within one surfel of both parts. [V-6]
    fn own_pairs(&self, x: &Part, y: &Part) -> Result<u128, FormatError> {
        let (mut sum, mut j) = (0u128, 0);
        for run in x.runs() {
            while y.runs().get(j).is_some_and(|other| other.end <= run.start) {
                j += 1;
            }
            for other in y.runs()[j..].iter().take_while(|other| other.start < run.end) {
                for id in run.start.max(other.start)..run.end.min(other.end) {
                    let n = u128::from(self.surfel(id)?.n_points);
                    sum = sum.saturating_add(n * n);
                }
            }
        }
        Ok(sum)
    }
}

/// What walks between two parts have counted.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Counted {
    /// Pairs of points.
    pub(crate) n_visible: u128,
    pub(crate) n_links: u64,
    pub(crate) n_nodes: u64,
}

impl Counted {
    pub(crate) fn and(self, other: Counted) -> Counted {
        Counted {
            n_visible: self.n_visible.saturating_add(other.n_visible),
            n_links: self.n_links + other.n_links,
            n_nodes: self.n_nodes + other.n_nodes,
        }
    }
}

impl Tally for Counted {
    fn link(&mut self, walk: &Walk<'_, '_>, from: &Node, to: &Node) {
        let n = |part: &Part, node| u128::from(part.n_points_under(node));
        self.n_visible = self.n_visible.saturating_add(n(walk.from, from) * n(walk.to, to));
        self.n_links += 1;
    }

    fn look(&mut self) {
        self.n_nodes += 1;
    }

    fn join(&mut self, later: Counted) {
        *self = self.and(later);
    }
}

/// Gives the squared distance from a place to the farthest corner of a box.
fn farthest2(cell: &Box3, g: [i32; 3]) -> u64 {
    (0..3)
        .map(|i| {
            let low = (i64::from(g[i]) - i64::from(cell.min[i])).unsigned_abs();
            let high = (i64::from(g[i]) - i64::from(cell.max[i])).unsigned_abs();
            low.max(high).pow(2)
        })
        .sum()
}
