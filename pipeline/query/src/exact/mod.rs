//! The point-exact refinement: do two points of the scan see each other, by its points alone?
//!
//! No map takes part: [`Exact`] asks the octree. `cells` are its cells with their points,
//! `occluders` walks those near a segment, `nearest` leads from a place to a point of the scan,
//! `visible_from` asks about every point or every surfel of a map, `disagreement` counts where the
//! answers of a map and of its points differ.
//! Source: Goradia et al. 2007 §3; DESIGN.md [V-7].

pub(crate) mod cells;
mod disagreement;
mod nearest;
mod occluders;
mod visible_from;

use std::num::NonZero;

use pvmap_geometry::disc::{Disc, faces_both};
use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Box3, Frame, GridPoint, Rect};
use pvmap_vmap::{MapView, OctreeView};
use rayon::prelude::*;

use self::cells::Cells;
pub use self::disagreement::{Disagreement, LocatedPair, compare};
pub use self::nearest::Nearest;
pub use self::visible_from::PointSet;
use crate::error::QueryError;
use crate::map::Map;

/// A greater Δ makes no difference: the cube's diagonal, below 1.74 · 2^22, is shorter, so that
/// every place of a segment is within Δ of its ends and nothing occludes. The square is below
/// 2^46, which the exact tests have room for.
const MAX_DELTA_GRID: u32 = (1 << 23) - 1;
/// Limits nothing: every place of a segment of the cube is inside.
const ANYWHERE: Box3 = Box3 { min: [0; 3], max: [1 << 22; 3] };

/// Checks that a map was made from an octree, by the digest it names, the number of its points and
/// where they lie: points that are alike but elsewhere have the same digest. [D-2], [D-8]
///
/// # Errors
/// [`QueryError::OtherOctree`] where it was not.
pub fn check_pair(map: &MapView<'_>, octree: &OctreeView<'_>) -> Result<(), QueryError> {
    let (of, from) = (map.summary(), octree.summary());
    let same = (of.digest, of.n_points) == (from.digest, from.n_points)
        && map.frame().frame == octree.frame().frame;
    same.then_some(()).ok_or(QueryError::OtherOctree)
}

/// What the user decides about the atomic test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExactOptions {
    delta_grid: u32,
    k: NonZero<u32>,
}

impl ExactOptions {
    /// Takes Δ in grid steps and K.
    pub fn new(delta_grid: u32, k: NonZero<u32>) -> ExactOptions {
        ExactOptions { delta_grid: delta_grid.min(MAX_DELTA_GRID), k }
    }

    /// Takes Δ in the units of a scan and K; Δ becomes the nearest whole number of grid steps.
    ///
    /// # Errors
    /// Where Δ is negative or not a number.
    pub fn in_units_of(frame: &Frame, delta: f64, k: NonZero<u32>) -> Result<Self, QueryError> {
        if delta.is_nan() || delta < 0.0 {
            return Err(QueryError::Delta(delta));
        }
        // `as` saturates; a scan of one place, of unit 0, has no segments to decide.
        Ok(ExactOptions::new((delta / frame.unit()).round() as u32, k))
    }

    /// Proposes Δ and K for the scan of a map: the median spacing of its points, 2h of a leaf,
    /// over some thousand leaves, and 2. A wall sampled evenly has π points within a spacing of a
    /// place; a place on its rim half as many, so that 2 neither tear the wall nor widen it.
    ///
    /// # Errors
    /// Where what is read of the map is damaged.
    pub fn usual(map: &Map<'_>) -> Result<ExactOptions, QueryError> {
        let of_leaf = |id| map.surfel(id).map(|surfel| surfel.half_spacing);
        Ok(ExactOptions::usual_of(map.view().summary().n_surfels, of_leaf)?)
    }

    /// Proposes what [`ExactOptions::usual`] does from the half spacing of each of `n_surfels`.
    ///
    /// # Errors
    /// Those of `half_spacing`.
    pub fn usual_of<E>(
        n_surfels: u32,
        half_spacing: impl FnMut(u32) -> Result<u32, E>,
    ) -> Result<ExactOptions, E> {
        let ids = (0..n_surfels).step_by((n_surfels / 1000).max(1) as usize);
        let mut halves = ids.map(half_spacing).collect::<Result<Vec<u32>, _>>()?;
        halves.sort_unstable();
        let median = halves.get(halves.len() / 2).copied().unwrap_or(0);
        Ok(ExactOptions::new(2 * median, NonZero::<u32>::MIN.saturating_add(1)))
    }

    /// Gives Δ in grid steps.
    pub fn delta_grid(&self) -> u32 {
        self.delta_grid
    }

    /// Gives K.
    pub fn k(&self) -> NonZero<u32> {
        self.k
    }
}

/// A point of the scan, as the octree stores it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoredPoint {
    index: u64,
    g: GridPoint,
    normal: Normal,
    oriented: bool,
}

impl StoredPoint {
    /// Gives its place in the order of the octree.
    pub fn index(&self) -> u64 {
        self.index
    }

    /// Gives its grid position.
    pub fn g(&self) -> GridPoint {
        self.g
    }

    /// Gives its normal, zero without one.
    pub fn normal(&self) -> Normal {
        self.normal
    }

    /// Says whether the side of its normal is known.
    pub fn is_oriented(&self) -> bool {
        self.oriented
    }

    /// Gives the disc of radius Δ about it in its tangent plane.
    #[inline]
    fn disc(&self, delta2: u64) -> Disc {
        Disc {
            centroid: self.g.map(|v| v as i32),
            normal: self.normal,
            two_sided: !self.oriented,
            radius2: delta2,
            limit: ANYWHERE,
            rect: Rect::NONE,
        }
    }
}

/// Whether two points see each other, and what that was decided by.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// Whether they do: they face each other, and there are fewer than K occluders.
    pub visible: bool,
    /// Whether they face each other. If not, no occluder was looked for.
    pub faces: bool,
    /// The occluders found, a point of each place, as indices of the octree: no more than K,
    /// since the search ends with the K-th.
    pub occluders: Vec<u64>,
    /// What finding them took.
    pub work: Work,
}

/// What a question read of the octree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Work {
    /// Cells that were met.
    pub n_cells: u64,
    /// Points that were read, those looked at to find where a cell's points begin included.
    pub n_points: u64,
}

/// An octree whose points are asked one by one, from many threads at once if need be.
#[derive(Debug, Clone, Copy)]
pub struct Exact<'v, 'a> {
    octree: &'v OctreeView<'a>,
    options: ExactOptions,
}

impl<'v, 'a> Exact<'v, 'a> {
    /// Asks the points of an octree. Reads nothing yet.
    pub fn new(octree: &'v OctreeView<'a>, options: ExactOptions) -> Exact<'v, 'a> {
        Exact { octree, options }
    }

    /// Gives the octree that is asked.
    pub fn octree(&self) -> &'v OctreeView<'a> {
        self.octree
    }

    /// Gives what the user decided.
    pub fn options(&self) -> ExactOptions {
        self.options
    }

    /// Checks that a map was made from this octree, see [`check_pair`].
    ///
    /// # Errors
    /// [`QueryError::OtherOctree`] where it was not.
    pub fn require_map(&self, map: &Map<'_>) -> Result<(), QueryError> {
        check_pair(map.view(), self.octree)
    }

    /// Reads a point by its place in the order of the octree.
    ///
    /// # Errors
    /// Where there is none, or its block is damaged.
    pub fn point(&self, index: u64) -> Result<StoredPoint, QueryError> {
        Cells::new(self.octree).point(index).map_err(QueryError::Octree)
    }

    /// Decides whether two points of this octree see each other.
    ///
    /// With d = q - p on the grid: they face each other as surfels do ([V-1]: n_p·d > 0 and
    /// n_q·d < 0; a point of unknown side needs n·d ≠ 0 only, one without a normal nothing; two
    /// points of one place, d = 0, never do). A point c of normal n occludes if n·d ≠ 0, its
    /// tangent plane crosses the open segment at x = p + (n·(c - p) / n·d)·d, and |x - c| ≤ Δ:
    /// the paper's three reasons to reject a candidate, read backwards. The paper is silent about
    /// the ends; here |x - p| > Δ and |x - q| > Δ are needed as well, since a surface does not
    /// occlude its own neighbourhood ([V-2] iii). For the same reason a point of noise above an end
    /// does not count: one that knows its side, as the end e does, with a normal at most 30° from
    /// e's, that the segment, taken from e, passes from behind (n·d > 0), at an x that is no nearer
    /// to the other end and within Δ of e's tangent plane: |n_e·(x - e)| ≤ 2^14·Δ. Points without a
    /// normal occlude nothing.
    /// Occluders are counted by place: a point recorded twice is no second witness.
    ///
    /// Exact: the verdict of rational arithmetic on grid positions and quantised normals, over all
    /// points of the octree. It is symmetric, the list of occluders and the work included.
    ///
    /// Source: Goradia et al. 2007 §3; DESIGN.md [V-7].
    ///
    /// # Errors
    /// Where what is read of the octree is damaged.
    pub fn pair(&self, p: &StoredPoint, q: &StoredPoint) -> Result<Verdict, QueryError> {
        let delta2 = u64::from(self.options.delta_grid).pow(2);
        let ends = [p.disc(delta2), q.disc(delta2)];
        let mut verdict = Verdict {
            visible: false,
            faces: faces_both(&ends[0], &ends[1]),
            occluders: Vec::new(),
            work: Work::default(),
        };
        if verdict.faces {
            let found = occluders::find(self.octree, &ends, self.options);
            (verdict.occluders, verdict.work) = found.map_err(QueryError::Octree)?;
            verdict.visible = (verdict.occluders.len() as u64) < u64::from(self.options.k.get());
        }
        Ok(verdict)
    }

    /// Decides many pairs; the answers are those of [`Exact::pair`], in order. Each may hold K
    /// occluders, so ask in pieces where K is large. Threads are those of the current rayon pool.
    pub fn pairs(
        &self,
        questions: &[(StoredPoint, StoredPoint)],
    ) -> Vec<Result<Verdict, QueryError>> {
        questions.par_iter().map(|(p, q)| self.pair(p, q)).collect()
    }
}
