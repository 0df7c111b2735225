//! Where each column of a batch goes in a point record, and how positions become Morton keys.

use pvmap_geometry::block::BLOCK_POINTS;
use pvmap_geometry::{Frame, GridBlock, Intensity, PointBatch, Positions};
use pvmap_vmap::frame::CrsKind;
use pvmap_vmap::records::Source;
use pvmap_vmap::schema::{COLUMN_NAMES, ColumnType, Schema};

use super::records::SLACK_BYTES;
use crate::OctreeError;

/// How far from whole two offsets may be, in lattice steps, and still share a lattice: their
/// difference divided by the scale is rounded twice, which is far below a millionth of a step.
const WHOLE_STEP: f64 = 1e-6;

/// What the ingest must know of a source before its first batch.
#[derive(Debug, Clone)]
pub struct SourcePlan {
    /// Its file name, without folders.
    pub name: Vec<u8>,
    /// 1 LAS, 2 LAZ, 3 PLY.
    pub format: u32,
    /// How it stores positions.
    pub positions: PositionPlan,
    /// Records its header declares.
    pub n_declared: u64,
    /// Whether batches bring colours, and of what depth.
    pub color: ColorPlan,
    /// What intensities batches bring: `U16`, `F32` or none.
    pub intensity: Option<ColumnType>,
    /// Whether batches bring classes.
    pub has_class: bool,
    /// Whether batches bring GPS times.
    pub has_gps_time: bool,
    /// Whether those count since 1980, instead of a week; none where the source does not say.
    pub is_gps_time_since_1980: Option<bool>,
    /// Whether batches bring normals.
    pub has_normal: bool,
    /// Its coordinate reference system.
    pub crs: Option<(CrsKind, Vec<u8>)>,
}

/// What is known of the colours of a source before it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorPlan {
    /// It has none.
    Absent,
    /// 0…255.
    Eight,
    /// 0…65535.
    Sixteen,
    /// 16-bit fields that may hold 8-bit values: the largest one decides.
    Either,
}

impl ColorPlan {
    /// Gives the bits used, once the largest value is known. Fields that nobody filled are no
    /// colour: a scan is never black all over.
    pub(crate) fn depth(self, color_max: u16) -> u32 {
        match self {
            _ if color_max == 0 => 0,
            ColorPlan::Absent => 0,
            ColorPlan::Eight => 8,
            ColorPlan::Either if color_max <= 255 => 8,
            ColorPlan::Sixteen | ColorPlan::Either => 16,
        }
    }
}

/// How a source stores positions, and its bounds if it knows them.
#[derive(Debug, Clone, PartialEq)]
pub enum PositionPlan {
    /// Lattice steps: world = X · scale + offset.
    Lattice {
        /// World units a step.
        scale: [f64; 3],
        /// World coordinate of step 0.
        offset: [f64; 3],
        /// Least and greatest X as the header has them.
        bounds: Option<([i64; 3], [i64; 3])>,
    },
    /// f32 world coordinates.
    Single(Option<([f64; 3], [f64; 3])>),
    /// f64 world coordinates.
    Double(Option<([f64; 3], [f64; 3])>),
}

/// The bounds of points, on a lattice or in world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Bounds {
    Lattice([i64; 3], [i64; 3]),
    World([f64; 3], [f64; 3]),
}

impl Bounds {
    pub(crate) fn join(self, other: Bounds) -> Bounds {
        match (self, other) {
            (Bounds::Lattice(a, b), Bounds::Lattice(c, d)) => {
                Bounds::Lattice(pairwise(a, c, i64::min), pairwise(b, d, i64::max))
            }
            (Bounds::World(a, b), Bounds::World(c, d)) => {
                Bounds::World(pairwise(a, c, f64::min), pairwise(b, d, f64::max))
            }
            _ => unreachable!("one ingest has one kind of bounds"),
        }
    }
}

fn pairwise<T: Copy>(a: [T; 3], b: [T; 3], f: fn(T, T) -> T) -> [T; 3] {
    [0, 1, 2].map(|i| f(a[i], b[i]))
}

/// The record of one ingest: its columns, and what it takes to place its sources on one grid.
#[derive(Debug)]
pub(crate) struct Layout {
    pub(crate) schema: Schema,
    pub(crate) sources: Vec<Source>,
    /// The lattice all sources share, if they do.
    lattice: Option<([f64; 3], [f64; 3])>,
}

impl Layout {
    /// Chooses the columns that some source brings, at the precision the sources need.
    pub(crate) fn new(plans: &[SourcePlan]) -> Layout {
        let lattices: Option<Vec<_>> = plans
            .iter()
            .map(|p| match p.positions {
                PositionPlan::Lattice { scale, offset, .. } => Some((scale, offset)),
                _ => None,
            })
            .collect();
        let shifts = lattices.as_deref().and_then(shared_lattice);
        let single = plans.iter().all(|p| matches!(p.positions, PositionPlan::Single(_)));
        let position = match (&lattices, single) {
            (Some(_), _) if !plans.is_empty() => ColumnType::I32x3,
            (_, true) => ColumnType::F32x3,
            _ => ColumnType::F64x3,
        };
        let wide = plans.iter().any(|p| p.n_declared > u64::from(u32::MAX));
        let float = plans.iter().any(|p| p.intensity == Some(ColumnType::F32));
        let mut columns = vec![
            ("position", position),
            ("record", if wide { ColumnType::U64 } else { ColumnType::U32 }),
        ];
        let mut column = |wanted: bool, name, kind| {
            if wanted {
                columns.push((name, kind));
            }
        };
        column(plans.len() > 1, "source", ColumnType::U32);
        column(plans.iter().any(|p| p.has_normal), "normal", ColumnType::F32x3);
        column(plans.iter().any(|p| p.color != ColorPlan::Absent), "color", ColumnType::U16x3);
        let intensity = if float { ColumnType::F32 } else { ColumnType::U16 };
        column(plans.iter().any(|p| p.intensity.is_some()), "intensity", intensity);
        column(plans.iter().any(|p| p.has_class), "class", ColumnType::U8);
        column(plans.iter().any(|p| p.has_gps_time), "gps_time", ColumnType::F64);
        let lattice = shifts.as_ref().and(lattices).and_then(|l| l.first().copied());
        Layout {
            schema: Schema::new(&columns),
            sources: sources_of(plans, shifts.as_deref()),
            lattice,
        }
    }

    /// Joins the bounds the headers declare; `None` if one does not.
    pub(crate) fn declared_bounds(&self, plans: &[SourcePlan]) -> Option<Bounds> {
        let each = plans.iter().zip(&self.sources).map(|(plan, source)| match plan.positions {
            PositionPlan::Lattice { bounds, .. } => {
                bounds.map(|(min, max)| self.place_lattice(source, min, max))
            }
            PositionPlan::Single(b) | PositionPlan::Double(b) => {
                b.map(|(min, max)| Bounds::World(min, max))
            }
        });
        each.collect::<Option<Vec<_>>>()?.into_iter().reduce(Bounds::join)
    }

    /// Gives the frame of points with these bounds; of none, that of a single point.
    pub(crate) fn frame(&self, bounds: Option<Bounds>) -> Frame {
        match (bounds, self.lattice) {
            (Some(Bounds::Lattice(min, max)), Some((scale, offset))) => {
                Frame::of_lattice(scale, offset, min, max)
            }
            (None, Some((scale, offset))) => Frame::of_lattice(scale, offset, [0; 3], [0; 3]),
            (Some(Bounds::World(min, max)), _) => Frame::of_world(min, max),
            (_, None) => Frame::of_world([0.0; 3], [0.0; 3]),
        }
    }

    fn place_lattice(&self, source: &Source, min: [i64; 3], max: [i64; 3]) -> Bounds {
        let world =
            |x: [i64; 3]| [0, 1, 2].map(|i| x[i] as f64 * source.scale[i] + source.offset[i]);
        match self.lattice {
            Some(_) => Bounds::Lattice(
                pairwise(min, source.shift, |a, b| a + b),
                pairwise(max, source.shift, |a, b| a + b),
            ),
            None => Bounds::World(world(min), world(max)),
        }
    }

    /// Gives the bounds of a batch, on the common lattice or in world units; `None` if it is empty.
    pub(crate) fn bounds_of(&self, batch: &PointBatch) -> Option<Bounds> {
        let (min, max) = batch.positions.bounds()?;
        Some(match batch.positions {
            Positions::Lattice(_) => {
                let source = &self.sources[batch.source as usize];
                self.place_lattice(source, min.map(|v| v as i64), max.map(|v| v as i64))
            }
            _ => Bounds::World(min, max),
        })
    }

    /// Computes the Morton code of every point of a batch, in a frame that may only be a guess.
    pub(crate) fn codes_of(&self, frame: &Frame, batch: &PointBatch, codes: &mut Vec<u64>) {
        codes.clear();
        let source = &self.sources[batch.source as usize];
        match (&batch.positions, frame) {
            (Positions::Lattice(v), Frame::Lattice { .. }) => {
                let [a, b, c] = source.shift;
                let on_lattice =
                    |x: [i32; 3]| [i64::from(x[0]) + a, i64::from(x[1]) + b, i64::from(x[2]) + c];
                place(v, frame, codes, |block, i, x| block.set_lattice(i, frame, on_lattice(x)));
            }
            (Positions::Lattice(v), Frame::World { .. }) => {
                place(v, frame, codes, |block, i, x| {
                    block.set_world(i, frame, world_of(source, x));
                });
            }
            (Positions::Single(v), _) => {
                place(v, frame, codes, |block, i, x| block.set_world(i, frame, x.map(f64::from)));
            }
            (Positions::Double(v), _) => {
                place(v, frame, codes, |block, i, x| block.set_world(i, frame, x));
            }
        }
    }

    /// Packs a batch into records, one after another, and [`SLACK_BYTES`] behind them.
    ///
    /// # Errors
    /// Where a column has another type or length than its source promised.
    pub(crate) fn pack(&self, batch: &PointBatch, out: &mut Vec<u8>) -> Result<(), OctreeError> {
        let stride = self.schema.record_bytes();
        let n_bytes = batch.len() * stride;
        out.resize(n_bytes + SLACK_BYTES, 0);
        let out = &mut out[..n_bytes];
        for column in self.schema.columns() {
            let mut rows = Rows { out, stride, at: column.offset };
            let filled = match column.name {
                "position" => self.pack_positions(column.kind, batch, &mut rows),
                "record" if column.kind == ColumnType::U32 => {
                    rows.fill(&batch.records, |&r| (r as u32).to_le_bytes())
                }
                "record" => rows.fill(&batch.records, |r| r.to_le_bytes()),
                "source" => rows.fill(&batch.records, |_| batch.source.to_le_bytes()),
                "normal" => rows.fill_some(batch.normal.as_deref(), f32x3),
                "color" => rows.fill_some(batch.color.as_deref(), |c| {
                    let mut bytes = [0; 6];
                    bytes
                        .chunks_exact_mut(2)
                        .zip(c)
                        .for_each(|(b, v)| b.copy_from_slice(&v.to_le_bytes()));
                    bytes
                }),
                "intensity" => match (&batch.intensity, column.kind) {
                    (None, kind) => rows.fill_zero(kind.n_bytes()),
                    (Some(Intensity::U16(v)), ColumnType::U16) => rows.fill(v, |x| x.to_le_bytes()),
                    (Some(Intensity::U16(v)), _) => rows.fill(v, |&x| f32::from(x).to_le_bytes()),
                    (Some(Intensity::F32(v)), ColumnType::F32) => rows.fill(v, |x| x.to_le_bytes()),
                    _ => false,
                },
                "class" => rows.fill_some(batch.classification.as_deref(), |&c| [c]),
                _ => rows.fill_some(batch.gps_time.as_deref(), |t| t.to_le_bytes()),
            };
            if !filled {
                return Err(OctreeError::Columns { source_index: batch.source });
            }
        }
        Ok(())
    }

    fn pack_positions(&self, kind: ColumnType, batch: &PointBatch, rows: &mut Rows<'_>) -> bool {
        let source = &self.sources[batch.source as usize];
        match (&batch.positions, kind) {
            (Positions::Lattice(v), ColumnType::I32x3) => rows.fill(v, |x| {
                let mut bytes = [0; 12];
                bytes
                    .chunks_exact_mut(4)
                    .zip(x)
                    .for_each(|(b, v)| b.copy_from_slice(&v.to_le_bytes()));
                bytes
            }),
            (Positions::Single(v), ColumnType::F32x3) => rows.fill(v, f32x3),
            (Positions::Double(v), ColumnType::F64x3) => rows.fill(v, |x| f64x3(*x)),
            (Positions::Single(v), ColumnType::F64x3) => rows.fill(v, |x| f64x3(x.map(f64::from))),
            (Positions::Lattice(v), ColumnType::F64x3) => {
                rows.fill(v, |x| f64x3(world_of(source, *x)))
            }
            _ => false,
        }
    }

    /// Gives a record's place in the input: source, then record number. Points of one Morton code
    /// are ordered by it.
    #[inline]
    pub(crate) fn ordinal(&self, record: &[u8]) -> u64 {
        let at = self.schema.columns()[0].kind.n_bytes();
        let wide = self.schema.columns()[1].kind == ColumnType::U64;
        let number = if wide { u64_at(record, at) } else { u64::from(u32_at(record, at)) };
        let source = match self.sources.len() {
            0 | 1 => 0,
            _ => u64::from(u32_at(record, at + if wide { 8 } else { 4 })),
        };
        source << 40 | number
    }
}

/// Appends the Morton codes of points, a block at a time.
#[inline(always)]
fn place<T: Copy>(
    points: &[T],
    frame: &Frame,
    codes: &mut Vec<u64>,
    set: impl Fn(&mut GridBlock, usize, T),
) {
    let mut block = GridBlock::default();
    for some in points.chunks(BLOCK_POINTS) {
        some.iter().enumerate().for_each(|(i, &x)| set(&mut block, i, x));
        block.place(frame);
        codes.extend_from_slice(&block.codes()[..some.len()]);
    }
}

/// One column of a buffer of records.
struct Rows<'a> {
    out: &'a mut [u8],
    stride: usize,
    at: usize,
}

impl Rows<'_> {
    /// Fills the column; `false` where the values are not one a record.
    #[inline(always)]
    fn fill<T, const N: usize>(&mut self, values: &[T], bytes: impl Fn(&T) -> [u8; N]) -> bool {
        let at = self.at;
        for (row, value) in self.out.chunks_exact_mut(self.stride).zip(values) {
            row[at..at + N].copy_from_slice(&bytes(value));
        }
        self.out.len() == values.len() * self.stride
    }

    /// Fills the column if the batch has it, otherwise with zeroes.
    #[inline(always)]
    fn fill_some<T, const N: usize>(
        &mut self,
        values: Option<&[T]>,
        bytes: impl Fn(&T) -> [u8; N],
    ) -> bool {
        match values {
            Some(values) => self.fill(values, bytes),
            None => self.fill_zero(N),
        }
    }

    fn fill_zero(&mut self, n_bytes: usize) -> bool {
        let at = self.at;
        self.out.chunks_exact_mut(self.stride).for_each(|row| row[at..at + n_bytes].fill(0));
        true
    }
}

#[inline(always)]
fn f32x3(x: &[f32; 3]) -> [u8; 12] {
    let mut bytes = [0; 12];
    bytes.chunks_exact_mut(4).zip(x).for_each(|(b, v)| b.copy_from_slice(&v.to_le_bytes()));
    bytes
}

#[inline(always)]
fn f64x3(x: [f64; 3]) -> [u8; 24] {
    let mut bytes = [0; 24];
    bytes.chunks_exact_mut(8).zip(x).for_each(|(b, v)| b.copy_from_slice(&v.to_le_bytes()));
    bytes
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

/// The world position of a lattice point of a source: the two operations of the LAS standard.
#[inline(always)]
fn world_of(source: &Source, x: [i32; 3]) -> [f64; 3] {
    let along = |i: usize| f64::from(x[i]) * source.scale[i] + source.offset[i];
    [along(0), along(1), along(2)]
}

/// Gives each source's shift onto the lattice of the first, if all share one. [D-1]
fn shared_lattice(lattices: &[([f64; 3], [f64; 3])]) -> Option<Vec<[i64; 3]>> {
    let &(scale, offset) = lattices.first()?;
    lattices
        .iter()
        .map(|(s, o)| {
            let steps = [0, 1, 2].map(|i| (o[i] - offset[i]) / scale[i]);
            let whole = steps.map(f64::round);
            // Beyond 2^52 a step is not a whole number of anything any more.
            let shared = *s == scale
                && (0..3)
                    .all(|i| (steps[i] - whole[i]).abs() <= WHOLE_STEP && whole[i].abs() < 4e15);
            shared.then(|| whole.map(|v| v as i64))
        })
        .collect()
}

fn sources_of(plans: &[SourcePlan], shifts: Option<&[[i64; 3]]>) -> Vec<Source> {
    let mut name_offset = 0;
    plans
        .iter()
        .enumerate()
        .map(|(i, plan)| {
            let (scale, offset) = match plan.positions {
                PositionPlan::Lattice { scale, offset, .. } => (scale, offset),
                _ => ([1.0; 3], [0.0; 3]),
            };
            let name = (name_offset, plan.name.len() as u32);
            name_offset += plan.name.len() as u64;
            Source {
                name,
                format: plan.format,
                n_stored: 0,
                n_invalid: 0,
                scale,
                offset,
                shift: shifts.map_or([0; 3], |s| s[i]),
                color_depth: 0,
                gps_time: match plan.is_gps_time_since_1980 {
                    Some(since_1980) if plan.has_gps_time => 1 + u32::from(since_1980),
                    _ => 0,
                },
                columns: columns_of(plan),
            }
        })
        .collect()
}

/// Says which columns a source brings. [F-13]
fn columns_of(plan: &SourcePlan) -> u32 {
    let has = |name: &str| match name {
        "normal" => plan.has_normal,
        "color" => plan.color != ColorPlan::Absent,
        "intensity" => plan.intensity.is_some(),
        "class" => plan.has_class,
        "gps_time" => plan.has_gps_time,
        // Its place, its number and its own are every point's.
        _ => true,
    };
    let bit = |(i, name): (usize, &&str)| u32::from(has(name)) << i;
    COLUMN_NAMES.iter().enumerate().map(bit).sum()
}
