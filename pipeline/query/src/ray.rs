//! The first surfel that a ray hits.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use pvmap_geometry::Box3;
use pvmap_geometry::disc::Profile;
use pvmap_vmap::{Node, Surfel};

use crate::error::QueryError;
use crate::locate::Located;
use crate::map::Map;
use crate::segment::{Crossing, GridRay};

/// What a ray hits first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// The surfel.
    pub surfel: u32,
    /// Its leaf.
    pub node: u32,
    /// World units from the origin to the hit.
    pub distance: f64,
    /// Where, in world units.
    pub place: [f64; 3],
    /// The surfel's normal, of length 1; on the side that was hit if it has two.
    pub normal: [f64; 3],
}

/// What a ray hits, and what it took to find out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RayAnswer {
    /// The first surfel hit, if any.
    pub hit: Option<Hit>,
    /// Nodes that the ray meets and that were opened.
    pub n_nodes: u64,
    /// Surfels that were tested.
    pub n_surfels: u64,
}

/// The best hit so far.
#[derive(Debug, Clone, Copy)]
struct Best {
    crossing: Crossing,
    surfel: Surfel,
    id: u32,
}

/// A node that waits, the one first that may be hit first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Waiting {
    /// The bits of a t of 0 or more, which rise with it.
    earliest: u64,
    id: u32,
}

/// Farther away a float does not tell the steps of the grid from each other, nor the units of most
/// scans.
const FARTHEST: f64 = (1u64 << 50) as f64;

impl Map<'_> {
    /// Finds the first surfel that a ray hits.
    ///
    /// With `from`, the surfel that the origin lies on, the first of those that it sees is
    /// looked for: the map has settled what can be hit, whatever the ray passes within the leaf's
    /// own neighbourhood. Else the ray starts in the air and the first surfel of all is it.
    ///
    /// Exact on the grid: origin and direction are rounded to it (the direction so that its longest
    /// component is 2^21 steps), and a surfel is hit where [V-2] says that it blocks, with the ray
    /// in place of the segment; at the same t the lowest id is first. Only distance and place are
    /// floats.
    ///
    /// # Errors
    /// Where the origin is no place, the direction none, or the map damaged.
    pub fn ray(
        &self,
        origin: [f64; 3],
        direction: [f64; 3],
        from: Option<&Located>,
    ) -> Result<RayAnswer, QueryError> {
        let frame = &self.view().frame().frame;
        let steps = frame.steps_of_query(origin);
        if !origin.iter().chain(&steps).all(|v| v.abs() <= FARTHEST) {
            return Err(QueryError::NoPlace(origin));
        }
        let is_direction = direction.iter().all(|v| v.is_finite()) && direction != [0.0; 3];
        if !is_direction {
            return Err(QueryError::Direction(direction));
        }
        let own = match from {
            Some(from) => Some((from, self.leaf_of(from)?.1)),
            None => None,
        };
        let mut answer = RayAnswer { hit: None, n_nodes: 0, n_surfels: 0 };
        let started = GridRay::new(steps, direction).filter(|_| frame.extent() > 0.0);
        let Some((ray, moved)) = started else { return Ok(answer) };
        let Some(best) = self.first_hit(&ray, own, &mut answer)? else { return Ok(answer) };
        let t = best.crossing.t();
        // A place on the grid stands for the middle of its step.
        let place = frame.world_of_real(ray.at(t).map(|v| v + 0.5));
        answer.hit = Some(Hit {
            surfel: best.id,
            node: best.surfel.node,
            distance: (t * ray.step_grid() + moved) * frame.unit(),
            place,
            normal: normal_of(&best.surfel, &ray),
        });
        Ok(answer)
    }

    fn first_hit(
        &self,
        ray: &GridRay,
        own: Option<(&Located, Surfel)>,
        answer: &mut RayAnswer,
    ) -> Result<Option<Best>, QueryError> {
        let mut best: Option<Best> = None;
        let mut open = BinaryHeap::new();
        let wait = |id: u32, node: &Node| {
            let earliest = ray.earliest(&self.hit_box(node)).to_bits();
            let meets = ray.meets(&self.blocking_box(node));
            meets.then_some((Reverse(Waiting { earliest, id }), *node))
        };
        open.extend(self.root()?.and_then(|root| wait(0, &root)).map(Entry));
        while let Some(Entry((Reverse(Waiting { earliest, id }), node))) = open.pop() {
            // Both are off by less than this factor says.
            let latest = |best: &Best| best.crossing.t() * (1.0 + f64::EPSILON * 4.0);
            if best.as_ref().is_some_and(|best| f64::from_bits(earliest) > latest(best)) {
                break;
            }
            answer.n_nodes += 1;
            if node.is_leaf() {
                answer.n_surfels += 1;
                let surfel = self.surfel_of(id, &node)?;
                let found = self.hit_of(ray, node.first_surfel, surfel, best.as_ref(), own)?;
                best = found.or(best);
            }
            for child in self.children(id, node) {
                let (child_id, child) = child?;
                open.extend(wait(child_id, &child).map(Entry));
            }
        }
        Ok(best)
    }

    /// Gives the hit of a surfel, if there is one before the best so far.
    fn hit_of(
        &self,
        ray: &GridRay,
        id: u32,
        surfel: Surfel,
        best: Option<&Best>,
        own: Option<(&Located, Surfel)>,
    ) -> Result<Option<Best>, QueryError> {
        let found = ray.hits(self.profile(), &self.blocking_disc(id, &surfel)?);
        let Some(crossing) = found else { return Ok(None) };
        if let Some(best) = best {
            let (before, after) =
                (crossing.is_before(&best.crossing), best.crossing.is_before(&crossing));
            if after || !before && best.id < id {
                return Ok(None);
            }
        }
        if let Some((from, own)) = &own {
            let spared = self.profile() != Profile::Paper && ray.is_near(&crossing, own);
            let there = Located { surfel: id, node: surfel.node, distance: 0.0 };
            if from.surfel == id || spared || !self.pair(from, &there)?.visible {
                return Ok(None);
            }
        }
        Ok(Some(Best { crossing, surfel, id }))
    }

    /// Gives a box that holds every place where surfels of a node can be hit.
    fn hit_box(&self, node: &Node) -> Box3 {
        match self.profile() {
            Profile::Patch | Profile::Oriented => node.reach(),
            // A disc is as wide as its farthest point is away, at most a cell's diagonal.
            Profile::Paper => {
                let cell = node.cell();
                cell.grown(2 * (cell.max[0] - cell.min[0]))
            }
        }
    }
}

/// A waiting node in the heap, ordered by what is waited for alone.
struct Entry((Reverse<Waiting>, Node));

impl PartialEq for Entry {
    fn eq(&self, other: &Entry) -> bool {
        self.0.0 == other.0.0
    }
}

impl Eq for Entry {}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Entry) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Entry {
    fn cmp(&self, other: &Entry) -> std::cmp::Ordering {
        self.0.0.cmp(&other.0.0)
    }
}

/// Gives a surfel's normal at length 1, towards the ray's origin if it has two sides.
fn normal_of(surfel: &Surfel, ray: &GridRay) -> [f64; 3] {
    let n = surfel.normal.map(f64::from);
    let along: f64 = (0..3).map(|i| n[i] * f64::from(ray.direction[i])).sum();
    let sign = if surfel.two_sided && along > 0.0 { -1.0 } else { 1.0 };
    let length = n.iter().map(|v| v * v).sum::<f64>().sqrt();
    n.map(|v| sign * v / length)
}
