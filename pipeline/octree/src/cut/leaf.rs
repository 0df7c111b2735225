//! The points of one leaf, and the surfel that stands for them.

use std::ops::Range;

use pvmap_geometry::normal::{self, NORMAL_LENGTH, Normal};
use pvmap_geometry::rect::Moments;
use pvmap_geometry::{Box3, GridPoint, Rect};
use pvmap_vmap::{Shape, Surfel};

use super::points::{LeafPoint, Reader};
use crate::OctreeError;

/// The points of a leaf, to be gone through as often as needed.
#[derive(Clone)]
pub(super) struct LeafPoints<'a> {
    place: Place<'a>,
    bin: i8,
    /// Only the points of this quadrant of the bin, 0…5.
    quadrant: Option<u8>,
}

#[derive(Clone)]
enum Place<'a> {
    Held(&'a [LeafPoint]),
    /// The points of the bin in a range of the octree.
    Stored(&'a Reader<'a>, Range<u64>),
}

/// Integer sums over the points of a leaf: any order gives the same.
struct Sums {
    n_points: u64,
    /// Points with a normal, and those of them whose side is not known.
    n_normals: u64,
    n_unoriented: u64,
    /// Over |n_a| of each axis.
    normal_sizes: [i64; 3],
    g: [u64; 3],
    bounds: Box3,
    n_colors: u64,
    color: [u64; 3],
}

impl<'a> LeafPoints<'a> {
    /// Takes points of `bin` in memory.
    pub(super) fn held(points: &'a [LeafPoint], bin: i8) -> LeafPoints<'a> {
        LeafPoints { place: Place::Held(points), bin, quadrant: None }
    }

    /// Takes the points of `bin` in a range of the octree.
    pub(super) fn stored(reader: &'a Reader<'a>, indices: Range<u64>, bin: i8) -> LeafPoints<'a> {
        LeafPoints { place: Place::Stored(reader, indices), bin, quadrant: None }
    }

    /// Takes those of a quadrant only.
    pub(super) fn of_quadrant(&self, quadrant: u8) -> LeafPoints<'a> {
        LeafPoints { quadrant: Some(quadrant), ..self.clone() }
    }

    /// Finds the quadrants into which a leaf of bins 0…5 is split: those of its points if one of
    /// them is more than 30° from the sum of the normals and they are not all in one, else none.
    ///
    /// # Errors
    /// Those of [`Reader::each`].
    ///
    /// Source: DESIGN.md §3.
    pub(super) fn stray_quadrants(&self) -> Result<Vec<u8>, OctreeError> {
        if !(0..=5).contains(&self.bin) {
            return Ok(Vec::new());
        }
        let sum = self.sum(|p| p.key.binned_normal())?;
        let (mut strays, mut has) = (false, [false; 4]);
        self.each(|p| {
            strays |= normal::strays(p.key.binned_normal(), sum);
            has[self.quadrant_of(p)] = true;
        })?;
        let quadrants: Vec<u8> = (0..4).filter(|&q| has[usize::from(q)]).collect();
        let splits = strays && quadrants.len() > 1;
        Ok(if splits { quadrants } else { Vec::new() })
    }

    /// Gives where the points are.
    ///
    /// # Errors
    /// Those of [`Reader::each`].
    pub(super) fn places(&self) -> Result<Vec<GridPoint>, OctreeError> {
        let mut places = Vec::new();
        self.each(|p| places.push(p.key.g))?;
        Ok(places)
    }

    /// Makes the surfel of a leaf of at least one point.
    ///
    /// Its patch box and R² are those of the points alone, and its half spacing is 0, until
    /// [`spacing::fill`](super::spacing::fill) has seen the whole tree. The caller fills in cell
    /// and node.
    ///
    /// # Errors
    /// Those of [`Reader::each`].
    ///
    /// Source: DESIGN.md §3.
    pub(super) fn surfel(&self, shape: Shape) -> Result<Surfel, OctreeError> {
        let sums = self.sums()?;
        let mean = |sum: u64, n: u64| (2 * sum + n) / (2 * n);
        // A mean lies between the least and the largest, so it has their width.
        let centroid = sums.g.map(|sum| mean(sum, sums.n_points) as u32);
        let color = sums.color.map(|sum| mean(sum, sums.n_colors.max(1)) as u16);
        let (normal, two_sided) = self.normal(shape, &sums)?;
        Ok(Surfel {
            centroid,
            normal,
            two_sided,
            half_spacing: 0,
            radius2: self.farthest2(centroid)?,
            n_points: sums.n_points,
            first_code: 0,
            patch: sums.bounds,
            color: (sums.n_colors > 0).then_some(color),
            level: 0,
            bin: self.bin,
            node: 0,
        })
    }

    /// Makes the rectangle of the leaf's surfel, as far as its points reach, until
    /// [`spacing::fill`](super::spacing::fill) makes it wider; none without a normal.
    ///
    /// # Errors
    /// Those of [`Reader::each`].
    ///
    /// Source: [F-22].
    pub(super) fn rect(&self, surfel: &Surfel) -> Result<Rect, OctreeError> {
        if surfel.normal == [0; 3] {
            return Ok(Rect::NONE);
        }
        let offset = |p: &LeafPoint| {
            [0, 1, 2].map(|i| i64::from(p.key.g[i]) - i64::from(surfel.centroid[i]))
        };
        let mut moments = Moments::new(surfel.normal);
        self.each(|p| moments.add(offset(p)))?;
        let mut rect = Rect::along(moments.axes());
        self.each(|p| rect.hold(offset(p)))?;
        Ok(rect)
    }

    /// Averages the normals; says whether the leaf is two-sided.
    fn normal(&self, shape: Shape, sums: &Sums) -> Result<(Normal, bool), OctreeError> {
        let axis = normal::dominant_axis(sums.normal_sizes);
        let canonical = |p: &LeafPoint| match shape {
            Shape::Binned => normal::canonical_binned(p.key.normal),
            Shape::Paper => normal::canonical(p.key.normal, axis),
        };
        let mut sum = self.sum(|p| match p.key.oriented {
            true => p.key.normal,
            false => canonical(p),
        })?;
        // |Σn| < 0.1·Σ|n|, squared; both sides stay below 2^105.
        let size2: i128 = sum.iter().map(|&v| i128::from(v) * i128::from(v)).sum();
        let length = i128::from(sums.n_normals) * i128::from(NORMAL_LENGTH);
        let cancels = 100 * size2 < length * length;
        if cancels {
            sum = self.sum(canonical)?;
        }
        Ok((normal::rescale(sum), cancels || sums.n_unoriented > 0))
    }

    /// Finds the squared distance of the farthest point.
    fn farthest2(&self, from: GridPoint) -> Result<u64, OctreeError> {
        let mut farthest = 0;
        self.each(|p| {
            let d = [0, 1, 2].map(|i| u64::from(p.key.g[i].abs_diff(from[i])));
            farthest = farthest.max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        })?;
        Ok(farthest)
    }

    /// Adds up a normal of each point: 2^34 points reach 2^48.
    fn sum(&self, of: impl Fn(&LeafPoint) -> Normal) -> Result<[i64; 3], OctreeError> {
        let mut sum = [0; 3];
        self.each(|p| {
            let n = of(p);
            (0..3).for_each(|i| sum[i] += i64::from(n[i]));
        })?;
        Ok(sum)
    }

    fn sums(&self) -> Result<Sums, OctreeError> {
        let mut sums = Sums {
            n_points: 0,
            n_normals: 0,
            n_unoriented: 0,
            normal_sizes: [0; 3],
            g: [0; 3],
            bounds: Box3::EMPTY,
            n_colors: 0,
            color: [0; 3],
        };
        self.each(|p| sums.add(p))?;
        Ok(sums)
    }

    fn each(&self, mut visit: impl FnMut(&LeafPoint)) -> Result<(), OctreeError> {
        match self.quadrant {
            None => self.each_of_cell(visit),
            Some(quadrant) => self.each_of_cell(|p| {
                if self.quadrant_of(p) == usize::from(quadrant) {
                    visit(p);
                }
            }),
        }
    }

    fn each_of_cell(&self, mut visit: impl FnMut(&LeafPoint)) -> Result<(), OctreeError> {
        match &self.place {
            Place::Held(points) => {
                points.iter().for_each(visit);
                Ok(())
            }
            Place::Stored(reader, indices) => reader.each(indices.clone(), |p| {
                if p.bin == self.bin {
                    visit(&p);
                }
                Ok(())
            }),
        }
    }

    fn quadrant_of(&self, point: &LeafPoint) -> usize {
        usize::from(point.key.quadrant(self.bin as u8))
    }
}

impl Sums {
    fn add(&mut self, point: &LeafPoint) {
        let key = &point.key;
        let has_normal = key.normal != [0; 3];
        self.n_points += 1;
        self.n_normals += u64::from(has_normal);
        self.n_unoriented += u64::from(has_normal && !key.oriented);
        self.bounds = self.bounds.join(&Box3::at(key.g.map(|v| v as i32)));
        for i in 0..3 {
            self.normal_sizes[i] += i64::from(key.normal[i].unsigned_abs());
            self.g[i] += u64::from(key.g[i]);
        }
        if let Some(color) = point.color {
            self.n_colors += 1;
            (0..3).for_each(|i| self.color[i] += u64::from(color[i]));
        }
    }
}
