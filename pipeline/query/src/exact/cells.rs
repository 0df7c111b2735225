//! The cells of an octree, found in its sorted points: a cell's points are a range of them, whose
//! ends a binary search finds, first in section `codes` ([F-12]), then among 4096 points.

use std::ops::{ControlFlow, Range};

use pvmap_geometry::{Box3, morton};
use pvmap_vmap::octree::CODE_STRIDE;
use pvmap_vmap::{FormatError, OctreeView};

use super::{StoredPoint, Work};

/// A cell of so few points is searched, not divided: that costs what finding its parts would.
pub(crate) const FEW_POINTS: u64 = 64;

/// Bytes of a row of section `codes`.
const CODE_BYTES: u64 = 8;

/// A cell that has points.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Cell {
    pub(crate) level: u8,
    first_code: u64,
    points: Range<u64>,
}

impl Cell {
    pub(crate) fn n_points(&self) -> u64 {
        self.points.end - self.points.start
    }

    /// Gives the index of its first point.
    pub(crate) fn first_point(&self) -> u64 {
        self.points.start
    }

    /// Gives the length of a side in grid steps.
    pub(crate) fn side_grid(&self) -> u32 {
        side_grid(self.level)
    }

    /// Gives the box of all places that its points can have.
    pub(crate) fn bounds(&self) -> Box3 {
        box_of(self.first_code, self.level)
    }
}

/// A cell to look into, the nearest first, then the first in Morton order.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Open {
    pub(crate) least2: u64,
    pub(crate) cell: Cell,
}

impl Ord for Open {
    fn cmp(&self, other: &Open) -> std::cmp::Ordering {
        let key = |open: &Open| (open.least2, open.cell.first_point());
        // Reversed: a heap gives its greatest.
        key(other).cmp(&key(self))
    }
}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Open) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// The way to the cells and points of an octree; it counts what it reads.
#[derive(Debug)]
pub(crate) struct Cells<'v, 'a> {
    octree: &'v OctreeView<'a>,
    work: Work,
}

impl<'v, 'a> Cells<'v, 'a> {
    pub(crate) fn new(octree: &'v OctreeView<'a>) -> Cells<'v, 'a> {
        Cells { octree, work: Work::default() }
    }

    /// Gives what was read so far.
    pub(crate) fn work(&self) -> Work {
        self.work
    }

    /// Gives the whole cube, unless it has no points.
    pub(crate) fn root(&mut self) -> Option<Cell> {
        let n_points = self.octree.summary().n_points;
        self.work.n_cells += u64::from(n_points > 0);
        (n_points > 0).then_some(Cell { level: 0, first_code: 0, points: 0..n_points })
    }

    /// Puts the children of a cell that are wanted and have points on a stack, the first in Morton
    /// order on top; `is_wanted` gets the box of all places a child's points can have. The cell
    /// has a level below it.
    pub(crate) fn divide(
        &mut self,
        cell: &Cell,
        stack: &mut Vec<Cell>,
        mut is_wanted: impl FnMut(&Box3) -> bool,
    ) -> Result<(), FormatError> {
        let level = cell.level + 1;
        let n_codes = morton::cell_range(0, level).end;
        // The last child first. Its points end where the cell's do; those of the next end where
        // its own begin, if that was looked for.
        let mut end = Some(cell.points.end);
        for octant in (0..8).rev() {
            let first_code = cell.first_code + octant * n_codes;
            let known = end.take();
            if !is_wanted(&box_of(first_code, level)) {
                continue;
            }
            let end_here = match known {
                Some(end) => end,
                None => self.first_from(first_code + n_codes, cell.points.clone())?,
            };
            let start = match octant {
                0 => cell.points.start,
                _ => self.first_from(first_code, cell.points.start..end_here)?,
            };
            end = Some(start);
            if start < end_here {
                self.work.n_cells += 1;
                stack.push(Cell { level, first_code, points: start..end_here });
            }
        }
        Ok(())
    }

    /// Visits the points of a cell in order until `visit` ends it.
    ///
    /// # Errors
    /// Where a block is damaged or a point is not of the cell.
    pub(crate) fn each(
        &mut self,
        cell: &Cell,
        mut visit: impl FnMut(&StoredPoint) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, FormatError> {
        let codes = morton::cell_range(cell.first_code, cell.level);
        let (mut start, end) = (cell.points.start, cell.points.end);
        while start < end {
            // In pieces, so that blocks beyond the end of a search are not touched.
            let n = CODE_STRIDE.min(end - start);
            for (index, point) in (start..).zip(self.octree.points(start, n)?.iter()) {
                let key = point?.key;
                self.work.n_points += 1;
                if !codes.contains(&morton::encode(key.g)) {
                    return Err(self.unsorted(index));
                }
                let (g, normal, oriented) = (key.g, key.normal, key.oriented);
                if visit(&StoredPoint { index, g, normal, oriented }).is_break() {
                    return Ok(ControlFlow::Break(()));
                }
            }
            start += n;
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Reads a point.
    pub(crate) fn point(&mut self, index: u64) -> Result<StoredPoint, FormatError> {
        self.work.n_points += 1;
        let points = self.octree.points(index, 1)?;
        let Some(point) = points.iter().next() else { return Err(self.unsorted(index)) };
        let key = point?.key;
        Ok(StoredPoint { index, g: key.g, normal: key.normal, oriented: key.oriented })
    }

    /// Finds the first point of a range whose code is not below `code`; the end if there is none.
    fn first_from(&mut self, code: u64, range: Range<u64>) -> Result<u64, FormatError> {
        let (mut low, mut high) = (range.start, range.end);
        // Of these blocks the first point lies in the range.
        let (mut first, mut last) = (low.div_ceil(CODE_STRIDE), high.div_ceil(CODE_STRIDE));
        while first < last {
            let block = first.midpoint(last);
            if self.indexed_code(block)? < code {
                first = block + 1;
                low = block * CODE_STRIDE + 1;
            } else {
                last = block;
                high = block * CODE_STRIDE;
            }
        }
        while low < high {
            let middle = low.midpoint(high);
            if morton::encode(self.point(middle)?.g) < code {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        Ok(low)
    }

    /// Reads the code of the first point of a block of 4096. [F-12]
    fn indexed_code(&self, block: u64) -> Result<u64, FormatError> {
        let file = self.octree.file();
        let codes = file.section("codes", CODE_BYTES as u32)?;
        let bytes = file.read(codes, block * CODE_BYTES, CODE_BYTES)?;
        let broken = |_| codes.broken(block * CODE_BYTES, "is cut short");
        Ok(u64::from_le_bytes(bytes.try_into().map_err(broken)?))
    }

    /// Names a point that is not where its code belongs.
    fn unsorted(&self, index: u64) -> FormatError {
        let record_bytes = self.octree.schema().record_bytes();
        match self.octree.file().section("points", record_bytes as u32) {
            Err(error) => error,
            Ok(section) => {
                section.broken(index * record_bytes as u64, "points are not in Morton order")
            }
        }
    }
}

fn side_grid(level: u8) -> u32 {
    2 << (morton::MAX_LEVEL - level)
}

/// Gives the box of all places that points of a cell can have.
fn box_of(first_code: u64, level: u8) -> Box3 {
    let min = morton::decode(first_code).map(|v| v as i32);
    Box3 { min, max: min.map(|v| v + side_grid(level) as i32 - 1) }
}
