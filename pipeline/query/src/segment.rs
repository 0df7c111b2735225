//! Segments and rays on the grid against the surfels of the tree, exactly. Source: DESIGN.md [V-2].

use pvmap_geometry::disc::{self, Disc, Profile, segment_meets};
use pvmap_geometry::{Box3, Rect};
use pvmap_vmap::{FormatError, Node, Surfel};

use crate::map::Map;

/// How far outside the cube, in its sides, a place in the air may be: what is farther is brought
/// nearer along its line. Then differences are at most 2^23 an axis, and of the products in
/// [`disc::blocks`] the largest, (s - h)²·d², is below 2^125 even for normals of 2^14·√3.
const SIDE: f64 = (1u32 << 22) as f64;

/// The longest component of a ray's direction.
const REACH: f64 = (1u32 << 21) as f64;

/// A ray o + t·d with t > 0, on the grid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GridRay {
    pub(crate) origin: [i32; 3],
    pub(crate) direction: [i32; 3],
    /// A place on it beyond the cube and all patch boxes: none is 2^24 from the lowest corner, the
    /// origin is at most 2^23 from it, and one component of this way is 2^25.
    far: [i32; 3],
}

/// Where a ray hits: at o + (h/s)·d, h and s above 0.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crossing {
    pub(crate) h: i64,
    pub(crate) s: i64,
}

impl Crossing {
    /// Gives h/s; both are below 2^53, so this is the one rounding.
    pub(crate) fn t(&self) -> f64 {
        self.h as f64 / self.s as f64
    }

    /// Says whether it comes before another.
    pub(crate) fn is_before(&self, other: &Crossing) -> bool {
        i128::from(self.h) * i128::from(other.s) < i128::from(other.h) * i128::from(self.s)
    }
}

impl GridRay {
    /// Puts a ray on the grid: from a real place in grid steps, along a direction that is one.
    ///
    /// The origin is rounded down as points are [D-1]; of the direction the longest component
    /// becomes 2^21, the others are rounded. A ray that begins farther than a cube's side outside
    /// the cube begins where it, not rounded yet, comes that near; none if it never does. The
    /// second value is how many grid steps it was moved on.
    pub(crate) fn new(origin: [f64; 3], direction: [f64; 3]) -> Option<(GridRay, f64)> {
        let longest = direction.iter().fold(0.0f64, |most, v| most.max(v.abs()));
        let d = direction.map(|v| v / longest * REACH);
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for i in 0..3 {
            let (low, high) = (-SIDE - origin[i], 2.0 * SIDE - 1.0 - origin[i]);
            if d[i] == 0.0 {
                if low > 0.0 || high < 0.0 {
                    return None;
                }
            } else {
                let (near, far) = if d[i] > 0.0 { (low, high) } else { (high, low) };
                (enter, leave) = (enter.max(near / d[i]), leave.min(far / d[i]));
            }
        }
        if enter > leave {
            return None;
        }
        let origin = [0, 1, 2].map(|i| {
            let moved = if enter > 0.0 { origin[i] + enter * d[i] } else { origin[i] };
            moved.floor().clamp(-SIDE, 2.0 * SIDE - 1.0) as i32
        });
        let moved = enter * d.map(|v| v * v).iter().sum::<f64>().sqrt();
        let direction = d.map(|v| v.round() as i32);
        let far = [0, 1, 2].map(|i| origin[i] + 16 * direction[i]);
        Some((GridRay { origin, direction, far }, moved))
    }

    /// Says whether the ray meets a closed box, exactly.
    pub(crate) fn meets(&self, limit: &Box3) -> bool {
        segment_meets(self.origin, self.far, limit)
    }

    /// Gives a t that is no later than any at which the ray, which meets the box, is in it.
    pub(crate) fn earliest(&self, limit: &Box3) -> f64 {
        let entry = (0..3).filter(|&i| self.direction[i] != 0).map(|i| {
            let d = self.direction[i];
            let near = if d > 0 { limit.min[i] } else { limit.max[i] };
            // Whole numbers: the quotient is the one rounding.
            (f64::from(near) - f64::from(self.origin[i])) / f64::from(d)
        });
        entry.fold(0.0, f64::max) * (1.0 - f64::EPSILON * 4.0)
    }

    /// Finds where the ray hits a surfel's disc: [V-2] with the ray in place of the segment.
    ///
    /// Sizes: |w| ≤ 2^23 and |d| ≤ 2^21 an axis and |n| < 2^15, so h < 2^39 and s < 2^37; h·d, s·w
    /// and x·s are below 2^61 and fit i64, as do their sums, whose squares stay below 2^124.
    pub(crate) fn hits(&self, profile: Profile, k: &Disc) -> Option<Crossing> {
        let d = self.direction.map(i64::from);
        let w = [0, 1, 2].map(|i| i64::from(k.centroid[i]) - i64::from(self.origin[i]));
        let dot = |v: [i64; 3]| (0..3).map(|i| i64::from(k.normal[i]) * v[i]).sum::<i64>();
        let (mut s, mut h) = (dot(d), dot(w));
        if s < 0 {
            (s, h) = (-s, -h);
        }
        if s == 0 || h <= 0 {
            return None;
        }
        let e = [0, 1, 2].map(|i| h * d[i] - s * w[i]);
        if !is_within(e, k.radius2, s) {
            return None;
        }
        let is_in_box = || {
            (0..3).all(|i| {
                let x = i64::from(self.origin[i]) * s + h * d[i];
                i64::from(k.limit.min[i]) * s <= x && x <= i64::from(k.limit.max[i]) * s
            })
        };
        let is_limited = match profile {
            Profile::Paper => self.meets(&k.limit),
            Profile::Patch => is_in_box(),
            Profile::Oriented => is_in_box() && k.rect.holds(e, s),
        };
        is_limited.then_some(Crossing { h, s })
    }

    /// Says whether a crossing lies in the ball of a surfel, which is not hidden by what is that
    /// near it. [V-2] (iii)
    pub(crate) fn is_near(&self, crossing: &Crossing, surfel: &Surfel) -> bool {
        let Crossing { h, s } = *crossing;
        let v = [0, 1, 2].map(|i| {
            let off = i64::from(self.origin[i]) - i64::from(surfel.centroid[i]);
            s * off + h * i64::from(self.direction[i])
        });
        is_within(v, surfel.radius2, s)
    }

    /// Gives a place on the ray in grid steps.
    pub(crate) fn at(&self, t: f64) -> [f64; 3] {
        [0, 1, 2].map(|i| f64::from(self.origin[i]) + t * f64::from(self.direction[i]))
    }

    /// Gives the length of its direction in grid steps.
    pub(crate) fn step_grid(&self) -> f64 {
        self.direction.map(|v| f64::from(v).powi(2)).iter().sum::<f64>().sqrt()
    }
}

/// Decides |v|² ≤ r2·s²: with r2 < 2^48 and s < 2^37 the right side is below 2^122.
fn is_within(v: [i64; 3], r2: u64, s: i64) -> bool {
    let square = |v: i64| i128::from(v) * i128::from(v);
    v.iter().map(|&v| square(v)).sum::<i128>() <= i128::from(r2) * square(s)
}

impl Map<'_> {
    /// Gives the box in which a node's surfels block. [F-20]
    pub(crate) fn blocking_box(&self, node: &Node) -> Box3 {
        match self.profile() {
            Profile::Patch | Profile::Oriented => node.reach(),
            Profile::Paper => node.cell(),
        }
    }

    /// Finds the first surfel that blocks between two discs, apart from two of them.
    pub(crate) fn blocker(
        &self,
        spared: [u32; 2],
        a: &Disc,
        b: &Disc,
        n_nodes: &mut u64,
    ) -> Result<Option<u32>, FormatError> {
        let mut open: Vec<(u32, Node)> = self.root()?.map(|root| (0, root)).into_iter().collect();
        while let Some((id, node)) = open.pop() {
            if !segment_meets(a.centroid, b.centroid, &self.blocking_box(&node)) {
                continue;
            }
            *n_nodes += 1;
            if node.is_leaf() && !spared.contains(&node.first_surfel) {
                let k = self.blocking_disc(node.first_surfel, &self.surfel_of(id, &node)?)?;
                let is_blocked = match self.is_solid() {
                    true => disc::blocks(self.profile(), &beside(a, &k), &beside(b, &k), &k),
                    false => disc::blocks(self.profile(), a, b, &k),
                };
                if is_blocked {
                    return Ok(Some(node.first_surfel));
                }
            }
            let from = open.len();
            for child in self.children(id, node) {
                open.push(child?);
            }
            // The first child is looked at first, so that ids rise.
            open[from..].reverse();
        }
        Ok(None)
    }
}

/// Gives an end as a surfel may block it: what stands across it, more than 60° off its normal, is
/// not its own neighbourhood, however near. [V-2] (iii)
fn beside(end: &Disc, k: &Disc) -> Disc {
    let [n, m] = [end.normal, k.normal].map(|n| n.map(i64::from));
    let dot = |a: [i64; 3], b: [i64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let along = dot(n, m);
    let is_turned = along < 0 && !(end.two_sided || k.two_sided);
    let is_across = is_turned || 4 * along * along < dot(n, n) * dot(m, m);
    if is_across { Disc { radius2: 0, ..*end } } else { *end }
}

/// Makes the disc of a place in the air: it looks everywhere and nothing is too near it to block.
pub(crate) fn in_the_air(place: [i32; 3]) -> Disc {
    let (normal, limit) = ([0; 3], Box3::at(place));
    Disc { centroid: place, normal, two_sided: true, radius2: 0, limit, rect: Rect::NONE }
}

/// Rounds a place down to the grid; one farther than a cube's side outside the cube is brought that
/// near first, along its line to `towards`, which is in the cube.
pub(crate) fn near_grid(place: [f64; 3], towards: [u32; 3]) -> [i32; 3] {
    let mut share = 1.0f64;
    for i in 0..3 {
        let (from, way) = (f64::from(towards[i]), place[i] - f64::from(towards[i]));
        let limit = if way > 0.0 { 2.0 * SIDE - 1.0 - from } else { -SIDE - from };
        if way.abs() > limit.abs() {
            share = share.min(limit / way);
        }
    }
    [0, 1, 2].map(|i| {
        let from = f64::from(towards[i]);
        let at = if share < 1.0 { from + share * (place[i] - from) } else { place[i] };
        at.floor().clamp(-SIDE, 2.0 * SIDE - 1.0) as i32
    })
}
