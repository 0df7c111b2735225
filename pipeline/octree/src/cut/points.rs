//! The points as the cut sees them, read from the octree in ranges.

use std::ops::Range;

use pvmap_geometry::morton;
use pvmap_store::Watch;
use pvmap_vmap::octree::{CODE_STRIDE, Point};
use pvmap_vmap::tree::RoutingKey;
use pvmap_vmap::{OctreeView, Shape};
use rayon::prelude::*;

use super::color::Colors;
use crate::OctreeError;

/// Blocks of [`CODE_STRIDE`] points in a window where memory allows: 12 MiB of them, enough work
/// for every thread between two meetings.
const MAX_BLOCKS: u64 = 64;

/// What cells and surfels are made from.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeafPoint {
    /// Place in the octree.
    pub(super) index: u64,
    /// Morton code of the position.
    pub(super) code: u64,
    /// Position and normal.
    pub(super) key: RoutingKey,
    /// Colour in linear light, full scale 65535.
    pub(super) color: Option<[u16; 3]>,
    /// Which cutter takes it: its bin, -1 in `paper`.
    pub(super) bin: i8,
}

/// Reads the points of an octree, any range as often as needed.
pub(super) struct Reader<'a> {
    octree: &'a OctreeView<'a>,
    colors: Option<Colors>,
    shape: Shape,
    watch: &'a dyn Watch,
}

impl<'a> Reader<'a> {
    /// Reads points for a tree of `shape`.
    pub(super) fn new(octree: &'a OctreeView<'a>, shape: Shape, watch: &'a dyn Watch) -> Self {
        Reader { octree, colors: Colors::of(octree), shape, watch }
    }

    /// Visits the points of a range in order.
    ///
    /// # Errors
    /// Where a block is damaged or the run was asked to stop, and those of `visit`.
    pub(super) fn each(
        &self,
        range: Range<u64>,
        mut visit: impl FnMut(LeafPoint) -> Result<(), OctreeError>,
    ) -> Result<(), OctreeError> {
        for first in range.clone().step_by(CODE_STRIDE as usize) {
            self.watch.check()?;
            let points = self.octree.points(first, CODE_STRIDE.min(range.end - first))?;
            for (index, point) in (first..).zip(points.iter()) {
                visit(self.leaf_point(index, &point?))?;
            }
        }
        Ok(())
    }

    #[inline]
    fn leaf_point(&self, index: u64, point: &Point<'_>) -> LeafPoint {
        LeafPoint {
            index,
            code: morton::encode(point.key.g),
            key: point.key,
            color: self.colors.as_ref().and_then(|c| c.linear(point.record)),
            bin: match self.shape {
                Shape::Paper => -1,
                Shape::Binned => point.key.bin() as i8,
            },
        }
    }

    /// Names a point whose Morton code is less than that of a point before it.
    pub(super) fn unsorted(&self, index: u64) -> OctreeError {
        let record_bytes = self.octree.schema().record_bytes();
        match self.octree.file().section("points", record_bytes as u32) {
            Err(error) => error.into(),
            Ok(section) => {
                section.broken(index * record_bytes as u64, "points are not in Morton order").into()
            }
        }
    }
}

/// A run of decoded points that moves over the octree from front to back.
pub(super) struct Window {
    blocks: Vec<Vec<LeafPoint>>,
    at: Range<u64>,
    n_total: u64,
}

impl Window {
    /// Starts before the first of `n_total` points; holds at most `memory_bytes`, or one block.
    pub(super) fn new(memory_bytes: u64, n_total: u64) -> Window {
        let block_bytes = CODE_STRIDE * size_of::<LeafPoint>() as u64;
        let n_blocks = (memory_bytes / block_bytes).clamp(1, MAX_BLOCKS);
        Window {
            blocks: vec![Vec::new(); n_blocks.min(n_total.div_ceil(CODE_STRIDE)) as usize],
            at: 0..0,
            n_total,
        }
    }

    /// Decodes the next points; says whether there were any.
    ///
    /// # Errors
    /// Those of [`Reader::each`].
    pub(super) fn advance(&mut self, reader: &Reader<'_>) -> Result<bool, OctreeError> {
        let first = self.at.end;
        let end = (first + self.blocks.len() as u64 * CODE_STRIDE).min(self.n_total);
        let decode = |(i, block): (usize, &mut Vec<LeafPoint>)| {
            let start = (first + i as u64 * CODE_STRIDE).min(end);
            let range = start..(start + CODE_STRIDE).min(end);
            block.clear();
            block.reserve_exact((range.end - range.start) as usize);
            reader.each(range, |point| {
                block.push(point);
                Ok(())
            })
        };
        self.blocks.par_iter_mut().enumerate().try_for_each(decode)?;
        self.at = first..end;
        Ok(first < end)
    }

    /// Gives the decoded points, in order.
    pub(super) fn blocks(&self) -> &[Vec<LeafPoint>] {
        &self.blocks
    }

    /// Counts them.
    pub(super) fn n_points(&self) -> u64 {
        self.at.end - self.at.start
    }
}
