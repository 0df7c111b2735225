//! The fixed rows of octrees and maps, as FORMAT.md lays them out.

use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Box3, Rect, morton};

use crate::bytes::{FieldReader, FieldWriter};
use crate::schema::COLUMN_NAMES;

/// The parent of the root.
pub const NO_PARENT: u32 = u32::MAX;

/// A row of one size.
pub trait Record: Sized {
    /// Its size.
    const BYTES: usize;

    /// Writes it into exactly [`Record::BYTES`] zeroed bytes.
    fn write(&self, w: &mut FieldWriter<'_>);

    /// Reads it; `None` where a field has a value that FORMAT.md does not allow.
    fn read(r: &mut FieldReader<'_>) -> Option<Self>;

    /// Gives its bytes.
    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = vec![0; Self::BYTES];
        self.write(&mut FieldWriter::new(&mut bytes));
        bytes
    }

    /// Reads it from its bytes, reserved ones included.
    #[inline]
    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let mut r = FieldReader::new(bytes);
        let record = Self::read(&mut r)?;
        r.rest_is_zero().then_some(record)
    }
}

/// What the children of a node are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// None: a leaf.
    Leaf,
    /// Octants of its cell.
    Octants,
    /// Sign quadrants of the points' normals, in the same cell.
    Quadrants,
    /// Bins of the points' normals: the root of a `binned` tree.
    Bins,
}

/// A node. [F-15]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Node {
    /// Its parent, [`NO_PARENT`] at the root.
    pub parent: u32,
    /// One past the last node of its subtree.
    pub end: u32,
    /// The first surfel of its subtree.
    pub first_surfel: u32,
    /// One past the last surfel of its subtree.
    pub end_surfel: u32,
    /// Points in its subtree.
    pub n_points: u64,
    /// Least Morton code of its cell.
    pub first_code: u64,
    /// Level of its cell.
    pub level: u8,
    /// Its bin, -1…6.
    pub bin: i8,
    /// What its children are.
    pub split: Split,
    /// Which child of its parent it is.
    pub slot: u8,
    /// Grid steps by which the patch boxes of its subtree leave its cell at the most.
    pub overhang: u32,
}

impl Node {
    /// Where in its record the parent stands.
    pub(crate) const PARENT_AT: u64 = 0;

    /// Gives its cell as the closed cube [g0, g0 + side].
    #[inline]
    pub fn cell(&self) -> Box3 {
        cell(self.first_code, self.level)
    }

    /// Gives a box that holds the patch boxes of its subtree.
    #[inline]
    pub fn reach(&self) -> Box3 {
        // Below 2^23, as every record says.
        self.cell().grown(self.overhang as i32)
    }

    /// Says whether it is a leaf.
    #[inline(always)]
    pub fn is_leaf(&self) -> bool {
        self.split == Split::Leaf
    }
}

/// Gives a cell as the closed cube [g0, g0 + side].
fn cell(first_code: u64, level: u8) -> Box3 {
    let min = morton::decode(first_code).map(|v| v as i32);
    let side = 1 << (22 - level);
    Box3 { min, max: min.map(|v| v + side) }
}

impl Record for Node {
    const BYTES: usize = 40;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u32(self.parent);
        w.u32(self.end);
        w.u32(self.first_surfel);
        w.u32(self.end_surfel);
        w.u64(self.n_points);
        w.u64(self.first_code);
        w.u8(self.level);
        w.i8(self.bin);
        w.u8(self.split as u8);
        w.u8(self.slot);
        w.u32(self.overhang);
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<Node> {
        let node = Node {
            parent: r.u32(),
            end: r.u32(),
            first_surfel: r.u32(),
            end_surfel: r.u32(),
            n_points: r.u64(),
            first_code: r.u64(),
            level: r.u8(),
            bin: r.i8(),
            split: match r.u8() {
                0 => Split::Leaf,
                1 => Split::Octants,
                2 => Split::Quadrants,
                3 => Split::Bins,
                _ => return None,
            },
            slot: r.u8(),
            overhang: r.u32(),
        };
        let has_place = node.level <= 21 && node.first_code < 1 << 63;
        (has_place && (-1..=6).contains(&node.bin) && node.overhang < 1 << 23).then_some(node)
    }
}

/// An oriented disc that stands for a leaf. [F-16]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Surfel {
    /// Mean point, grid steps.
    pub centroid: [u32; 3],
    /// Normal of length 2^14, or zero.
    pub normal: Normal,
    /// Whether both faces count.
    pub two_sided: bool,
    /// Half the spacing of the leaf's points, grid steps.
    pub half_spacing: u32,
    /// Squared radius as the profile uses it, grid steps².
    pub radius2: u64,
    /// Points in the leaf.
    pub n_points: u64,
    /// Least Morton code of the leaf's cell.
    pub first_code: u64,
    /// The points' box grown by the half spacing.
    pub patch: Box3,
    /// Mean colour in linear light, full scale 65535.
    pub color: Option<[u16; 3]>,
    /// Level of the leaf's cell.
    pub level: u8,
    /// Bin of the leaf, -1…6.
    pub bin: i8,
    /// The leaf's node.
    pub node: u32,
}

impl Surfel {
    /// Gives the closed cube of the leaf's cell, [g0, g0 + side].
    pub fn cell(&self) -> Box3 {
        cell(self.first_code, self.level)
    }
}

const TWO_SIDED: u16 = 1;
const HAS_COLOR: u16 = 2;

impl Record for Surfel {
    const BYTES: usize = 88;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.three(self.centroid, FieldWriter::u32);
        w.three(self.normal, FieldWriter::i16);
        let has_color = if self.color.is_some() { HAS_COLOR } else { 0 };
        w.u16(if self.two_sided { TWO_SIDED } else { 0 } | has_color);
        w.u32(self.half_spacing);
        w.u64(self.radius2);
        w.u64(self.n_points);
        w.u64(self.first_code);
        w.three(self.patch.min, FieldWriter::i32);
        w.three(self.patch.max, FieldWriter::i32);
        w.three(self.color.unwrap_or_default(), FieldWriter::u16);
        w.u8(self.level);
        w.i8(self.bin);
        w.u32(self.node);
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<Surfel> {
        let centroid = r.three(FieldReader::u32);
        let normal = r.three(FieldReader::i16);
        let flags = r.u16();
        let surfel = Surfel {
            centroid,
            normal,
            two_sided: flags & TWO_SIDED != 0,
            half_spacing: r.u32(),
            radius2: r.u64(),
            n_points: r.u64(),
            first_code: r.u64(),
            patch: Box3 { min: r.three(FieldReader::i32), max: r.three(FieldReader::i32) },
            color: {
                let color = r.three(FieldReader::u16);
                (flags & HAS_COLOR != 0).then_some(color)
            },
            level: r.u8(),
            bin: r.i8(),
            node: r.u32(),
        };
        let legal = flags & !(TWO_SIDED | HAS_COLOR) == 0
            && surfel.level <= 21
            && surfel.centroid.iter().all(|&c| c < 1 << 22)
            && surfel.normal.iter().all(|n| n.unsigned_abs() <= 1 << 14)
            && surfel.radius2 < 1 << 48
            && surfel.half_spacing < 1 << 23
            && surfel.first_code < 1 << 63
            && (0..3).all(|i| {
                let (min, max) = (surfel.patch.min[i], surfel.patch.max[i]);
                -(1 << 24) < min && min <= max && max < 1 << 24
            });
        legal.then_some(surfel)
    }
}

/// A row of `rects`. [F-22]
impl Record for Rect {
    const BYTES: usize = 28;

    fn write(&self, w: &mut FieldWriter<'_>) {
        for i in 0..2 {
            w.three(self.axes[i], FieldWriter::i16);
        }
        for i in 0..2 {
            w.i32(self.low[i]);
            w.i32(self.high[i]);
        }
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<Rect> {
        let axes = [r.three(FieldReader::i16), r.three(FieldReader::i16)];
        let [u, v] = [[r.i32(), r.i32()], [r.i32(), r.i32()]];
        let rect = Rect { axes, low: [u[0], v[0]], high: [u[1], v[1]] };
        let is_none = axes.contains(&[0; 3]);
        let legal = axes.iter().flatten().all(|n| n.unsigned_abs() <= 1 << 14)
            && (0..2).all(|i| {
                let (low, high) = (rect.low[i], rect.high[i]);
                -(1 << 25) < low && low < 0 && 0 < high && high < 1 << 25
            });
        (if is_none { rect == Rect::NONE } else { legal }).then_some(rect)
    }
}

/// Counts of a map. Section 5 of FORMAT.md.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MapSummary {
    /// Points of the octree.
    pub n_points: u64,
    /// Nodes of the tree.
    pub n_nodes: u32,
    /// Its leaves.
    pub n_surfels: u32,
    /// Links, each pair once.
    pub n_links: u64,
    /// Leaf pairs a < b that see each other.
    pub n_visible_pairs: u128,
    /// Order-free digest of the octree's points.
    pub digest: u128,
    /// Pairs with a visible fraction of their own. [F-24]
    pub n_fractions: u64,
}

impl Record for MapSummary {
    const BYTES: usize = 128;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u64(self.n_points);
        w.u32(self.n_nodes);
        w.u32(self.n_surfels);
        w.u64(self.n_links);
        w.u128(self.n_visible_pairs);
        w.u128(self.digest);
        w.u64(self.n_fractions);
    }

    fn read(r: &mut FieldReader<'_>) -> Option<MapSummary> {
        Some(MapSummary {
            n_points: r.u64(),
            n_nodes: r.u32(),
            n_surfels: r.u32(),
            n_links: r.u64(),
            n_visible_pairs: r.u128(),
            digest: r.u128(),
            n_fractions: r.u64(),
        })
    }
}

/// One frame of the link section. [F-19]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkBlock {
    /// Its first link.
    pub first: (u32, u32),
    /// Its last link.
    pub last: (u32, u32),
    /// Place in `links`.
    pub offset_bytes: u64,
    /// Compressed length.
    pub len_bytes: u32,
    /// Decompressed length.
    pub content_bytes: u32,
    /// Links in it.
    pub n_links: u32,
    /// CRC-32 of the compressed bytes.
    pub crc: u32,
}

impl LinkBlock {
    /// Where in its record the first link stands.
    pub(crate) const FIRST_AT: u64 = 0;
    /// Where in its record the last link stands.
    pub(crate) const LAST_AT: u64 = 8;
}

impl Record for LinkBlock {
    const BYTES: usize = 40;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u32(self.first.0);
        w.u32(self.first.1);
        w.u32(self.last.0);
        w.u32(self.last.1);
        w.u64(self.offset_bytes);
        w.u32(self.len_bytes);
        w.u32(self.content_bytes);
        w.u32(self.n_links);
        w.u32(self.crc);
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<LinkBlock> {
        Some(LinkBlock {
            first: (r.u32(), r.u32()),
            last: (r.u32(), r.u32()),
            offset_bytes: r.u64(),
            len_bytes: r.u32(),
            content_bytes: r.u32(),
            n_links: r.u32(),
            crc: r.u32(),
        })
    }
}

/// Counts of an ingest. Section 4 of FORMAT.md.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct OctreeSummary {
    /// Points stored.
    pub n_points: u64,
    /// Records read.
    pub n_read: u64,
    /// Records dropped because a coordinate was not finite.
    pub n_invalid: u64,
    /// Records that headers declare and cut files do not hold.
    pub n_missing: u64,
    /// Records that files hold beyond their headers' counts, not read.
    pub n_beyond: u64,
    /// Points whose normal came from their source.
    pub n_normals_file: u64,
    /// Points whose normal was estimated.
    pub n_normals_estimated: u64,
    /// Points whose normal has a known side.
    pub n_oriented: u64,
    /// Order-free digest of the points. [F-11]
    pub digest: u128,
    /// What was asked of the normals: 0 auto, 1 file, 2 estimate, 3 none.
    pub normals: u32,
    /// How they were oriented: 0 not at all, 1 sensor, 2 up.
    pub orientation: u32,
}

impl Record for OctreeSummary {
    const BYTES: usize = 128;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u64(self.n_points);
        w.u64(self.n_read);
        w.u64(self.n_invalid);
        w.u64(self.n_normals_file);
        w.u64(self.n_normals_estimated);
        w.u64(self.n_oriented);
        w.u128(self.digest);
        w.u32(self.normals);
        w.u32(self.orientation);
        w.u64(self.n_missing);
        w.u64(self.n_beyond);
    }

    fn read(r: &mut FieldReader<'_>) -> Option<OctreeSummary> {
        let summary = OctreeSummary {
            n_points: r.u64(),
            n_read: r.u64(),
            n_invalid: r.u64(),
            n_normals_file: r.u64(),
            n_normals_estimated: r.u64(),
            n_oriented: r.u64(),
            digest: r.u128(),
            normals: r.u32(),
            orientation: r.u32(),
            n_missing: r.u64(),
            n_beyond: r.u64(),
        };
        // [F-8]: every record is either stored or counted with a reason.
        let sum = summary.n_points.checked_add(summary.n_invalid)?;
        (sum == summary.n_read && summary.normals <= 3 && summary.orientation <= 2)
            .then_some(summary)
    }
}

/// A scan that went into an octree. [F-13]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Source {
    /// Its file name, as a range of section `names`.
    pub name: (u64, u32),
    /// 1 LAS, 2 LAZ, 3 PLY.
    pub format: u32,
    /// Points stored.
    pub n_stored: u64,
    /// Records dropped.
    pub n_invalid: u64,
    /// World units a lattice step.
    pub scale: [f64; 3],
    /// World coordinate of lattice step 0.
    pub offset: [f64; 3],
    /// Common lattice X = stored X + shift.
    pub shift: [i64; 3],
    /// 0 no colour, 8 or 16 bits used.
    pub color_depth: u32,
    /// 0 none or unknown, 1 seconds of a week, 2 seconds since 1980.
    pub gps_time: u32,
    /// Bit i: it has the i-th of the columns that there can be; 0 where that was not noted.
    pub columns: u32,
}

impl Record for Source {
    const BYTES: usize = 192;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u64(self.name.0);
        w.u32(self.name.1);
        w.u32(self.format);
        w.u64(self.n_stored);
        w.u64(self.n_invalid);
        w.three(self.scale, FieldWriter::f64);
        w.three(self.offset, FieldWriter::f64);
        w.three(self.shift, FieldWriter::i64);
        w.u32(self.color_depth);
        w.u32(self.gps_time);
        w.u32(self.columns);
    }

    fn read(r: &mut FieldReader<'_>) -> Option<Source> {
        let source = Source {
            name: (r.u64(), r.u32()),
            format: r.u32(),
            n_stored: r.u64(),
            n_invalid: r.u64(),
            scale: r.three(FieldReader::f64),
            offset: r.three(FieldReader::f64),
            shift: r.three(FieldReader::i64),
            color_depth: r.u32(),
            gps_time: r.u32(),
            columns: r.u32(),
        };
        let known = source.gps_time <= 2 && source.columns >> COLUMN_NAMES.len() == 0;
        let finite = source.scale.iter().chain(&source.offset).all(|v| v.is_finite());
        (known
            && finite
            && (1..=3).contains(&source.format)
            && matches!(source.color_depth, 0 | 8 | 16))
        .then_some(source)
    }
}
