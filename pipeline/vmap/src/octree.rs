//! An octree as its reader sees it: a view of the bytes of `points.pvo`. Section 4 of FORMAT.md.

use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Frame, GridBlock, GridPoint};

use crate::bytes::{FieldReader, FieldWriter};
use crate::container::{Closing, Container, Kind, Section, Written, close};
use crate::error::FormatError;
use crate::frame::{CrsKind, FrameRecord};
use crate::map::{record, single};
use crate::records::{OctreeSummary, Record, Source};
use crate::schema::{COLUMN_BYTES, COLUMN_NAMES, ColumnType, Schema};
use crate::tree::RoutingKey;

/// The sections of an octree in file order, without `sums`.
pub const SECTIONS: [&str; 9] =
    ["summary", "columns", "sources", "names", "points", "normals", "codes", "frame", "crs"];
/// The file inside `NAME.octree/`.
pub const FILE_NAME: &str = "points.pvo";
/// Points from one entry of section `codes` to the next. [F-12]
pub const CODE_STRIDE: u64 = 4096;
/// Bytes of a row of section `normals`.
pub const NORMAL_BYTES: usize = 8;

/// How the positions of a point record become grid positions.
#[derive(Debug, Clone)]
pub struct Placement {
    frame: Frame,
    kind: ColumnType,
    source_at: Option<usize>,
    sources: Vec<Source>,
}

impl Placement {
    /// Joins a schema with the frame and the sources of its positions.
    pub fn new(schema: &Schema, frame: Frame, sources: &[Source]) -> Placement {
        Placement {
            frame,
            kind: schema.columns()[0].kind,
            source_at: schema.column("source").map(|c| c.offset),
            sources: sources.to_vec(),
        }
    }

    /// Gives the frame.
    pub fn frame(&self) -> &Frame {
        &self.frame
    }

    #[inline(always)]
    fn source(&self, record: &[u8]) -> Option<&Source> {
        let i = self.source_at.map_or(0, |at| FieldReader::new(&record[at..]).u32());
        self.sources.get(i as usize)
    }

    /// Gives the position of a record on the common lattice; `None` where it names no source.
    #[inline(always)]
    pub fn lattice(&self, record: &[u8]) -> Option<[i64; 3]> {
        let mut r = FieldReader::new(record);
        let [x, y, z] = r.three(FieldReader::i32);
        let shift = self.source(record)?.shift;
        // Saturating: a damaged file can name any shift.
        Some([
            i64::from(x).saturating_add(shift[0]),
            i64::from(y).saturating_add(shift[1]),
            i64::from(z).saturating_add(shift[2]),
        ])
    }

    /// Gives the world position of a record; `None` where it names no source.
    #[inline(always)]
    pub fn world(&self, record: &[u8]) -> Option<[f64; 3]> {
        let mut r = FieldReader::new(record);
        match self.kind {
            ColumnType::F32x3 => Some(r.three(FieldReader::f32).map(f64::from)),
            ColumnType::F64x3 => Some(r.three(FieldReader::f64)),
            _ => {
                let source = self.source(record)?;
                let x = r.three(FieldReader::i32);
                Some([0, 1, 2].map(|i| f64::from(x[i]) * source.scale[i] + source.offset[i]))
            }
        }
    }

    /// Gives the grid position of a record; `None` where it names no source.
    #[inline]
    pub fn grid(&self, record: &[u8]) -> Option<GridPoint> {
        match self.frame {
            Frame::Lattice { .. } => Some(self.frame.grid_of_lattice(self.lattice(record)?)),
            Frame::World { .. } => Some(self.frame.grid_of_world(self.world(record)?)),
        }
    }

    /// Places the records of a block, `record_bytes` each, on the grid; `None` where one names no
    /// source.
    pub fn place(&self, records: &[u8], record_bytes: usize, block: &mut GridBlock) -> Option<()> {
        let records = records.chunks_exact(record_bytes).enumerate();
        match &self.frame {
            frame @ Frame::Lattice { .. } => {
                for (i, record) in records {
                    block.set_lattice(i, frame, self.lattice(record)?);
                }
            }
            frame @ Frame::World { .. } => {
                for (i, record) in records {
                    block.set_world(i, frame, self.world(record)?);
                }
            }
        }
        block.place(&self.frame);
        Some(())
    }
}

/// A row of section `normals`. [F-10]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PointNormal {
    /// Length 2^14, or zero without one.
    pub normal: Normal,
    /// Whether its side is known.
    pub oriented: bool,
    /// Whether it came from the point's source.
    pub from_source: bool,
}

impl PointNormal {
    /// Gives the flags of [F-10].
    #[inline]
    pub fn flags(&self) -> u16 {
        u16::from(self.normal != [0; 3])
            | u16::from(self.oriented) << 1
            | u16::from(self.from_source) << 2
    }

    /// Gives its bytes.
    #[inline]
    pub fn to_bytes(&self) -> [u8; NORMAL_BYTES] {
        let mut bytes = [0; NORMAL_BYTES];
        let mut w = FieldWriter::new(&mut bytes);
        w.three(self.normal, FieldWriter::i16);
        w.u16(self.flags());
        bytes
    }

    /// Reads it; `None` where the flags and the normal contradict each other.
    #[inline]
    pub fn from_bytes(bytes: &[u8]) -> Option<PointNormal> {
        let mut r = FieldReader::new(bytes);
        let normal = r.three(FieldReader::i16);
        let flags = r.u16();
        let found = PointNormal { normal, oriented: flags & 2 != 0, from_source: flags & 4 != 0 };
        let short = normal.iter().all(|v| v.unsigned_abs() <= 1 << 14);
        (short && found.flags() == flags).then_some(found)
    }
}

/// Gives the share of one point in the order-free digest: XXH3-128 of its 20 bytes. [F-11]
///
/// Written out for that one length and from numbers: bytes that are stored in small pieces and
/// loaded in large ones cost three times the hash.
///
/// Source: the XXH3 specification, 128 bits, inputs of 17 to 32 bytes, no seed.
#[inline]
pub fn digest_of(key: &RoutingKey) -> u128 {
    const PRIME_1: u64 = 0x9e37_79b1_85eb_ca87;
    const PRIME_2: u64 = 0xc2b2_ae3d_27d4_eb4f;
    const PRIME_4: u64 = 0x85eb_ca77_c2b2_ae63;
    const N_BYTES: u64 = 20;
    let join = |low: u32, high: u32| u64::from(low) | u64::from(high) << 32;
    let fold = |a: u64, b: u64| {
        let product = u128::from(a) * u128::from(b);
        product as u64 ^ (product >> 64) as u64
    };
    let mix = |h: u64| {
        let h = (h ^ h >> 37).wrapping_mul(0x1656_6791_9e37_79f9);
        h ^ h >> 32
    };
    let [x, y, z] = key.g;
    let [a, b, c] = key.normal.map(|v| u32::from(v as u16));
    let flags = u32::from(key.normal != [0; 3]) | u32::from(key.oriented) << 1;
    let (ab, c_flags) = (a | b << 16, c | flags << 16);
    // The first 16 bytes and the last 16.
    let (first, last) = ([join(x, y), join(z, ab)], [join(y, z), join(ab, c_flags)]);
    // The words are those of the default secret.
    let low = fold(first[0] ^ 0xbe4b_a423_396c_feb8, first[1] ^ 0x1cad_21f7_2c81_017c);
    let low = N_BYTES.wrapping_mul(PRIME_1).wrapping_add(low) ^ last[0].wrapping_add(last[1]);
    let high = fold(last[0] ^ 0xdb97_9083_e96d_d4de, last[1] ^ 0x1f67_b3b7_a4a4_4072);
    let high = high ^ first[0].wrapping_add(first[1]);
    let sum = low.wrapping_add(high);
    let product = low
        .wrapping_mul(PRIME_1)
        .wrapping_add(high.wrapping_mul(PRIME_4))
        .wrapping_add(N_BYTES.wrapping_mul(PRIME_2));
    u128::from(mix(sum)) | u128::from(mix(product).wrapping_neg()) << 64
}

/// An open octree.
#[derive(Debug)]
pub struct OctreeView<'a> {
    file: Container<'a>,
    summary: OctreeSummary,
    frame: FrameRecord,
    schema: Schema,
    placement: Placement,
    points: Section,
    normals: Section,
    codes: Section,
}

impl<'a> OctreeView<'a> {
    /// Opens the bytes of a whole file.
    ///
    /// # Errors
    /// Where they are not an octree that can be read, or what opening reads is damaged.
    pub fn open(bytes: &'a [u8]) -> Result<OctreeView<'a>, FormatError> {
        let file = Container::open(bytes, Kind::Octree)?;
        let summary: OctreeSummary = single(&file, "summary")?;
        let frame: FrameRecord = single(&file, "frame")?;
        let columns = file.section("columns", COLUMN_BYTES as u32)?;
        if columns.n_records > COLUMN_NAMES.len() as u64 {
            return Err(columns.broken(0, "more columns than there are names"));
        }
        let schema = Schema::from_bytes(file.read_all(columns)?)
            .ok_or_else(|| columns.broken(0, "not a layout of known columns"))?;
        let rows = file.section("sources", Source::BYTES as u32)?;
        let sources: Vec<Source> =
            (0..rows.n_records).map(|i| record(&file, rows, i)).collect::<Result<_, _>>()?;
        let points = file.section("points", schema.record_bytes() as u32)?.clone();
        let normals = file.section("normals", NORMAL_BYTES as u32)?.clone();
        let codes = file.section("codes", 8)?.clone();
        let n = summary.n_points;
        let stored: u128 = sources.iter().map(|s| u128::from(s.n_stored)).sum();
        let counts = points.n_records == n
            && (normals.n_records == n || normals.n_records == 0)
            && codes.n_records == n.div_ceil(CODE_STRIDE)
            && stored == u128::from(n);
        if !counts {
            return Err(points.broken(0, format!("summary says {n} points, sections differ")));
        }
        let placement = Placement::new(&schema, frame.frame, &sources);
        let lattice = matches!(frame.frame, Frame::Lattice { .. });
        if lattice && schema.columns()[0].kind != ColumnType::I32x3 {
            return Err(columns.broken(0, "a lattice frame with real positions"));
        }
        Ok(OctreeView { file, summary, frame, schema, placement, points, normals, codes })
    }

    /// Gives the file around the sections.
    pub fn file(&self) -> &Container<'a> {
        &self.file
    }

    /// Gives the counts.
    pub fn summary(&self) -> &OctreeSummary {
        &self.summary
    }

    /// Gives the way from world units to the grid.
    pub fn frame(&self) -> &FrameRecord {
        &self.frame
    }

    /// Gives the kind and the bytes of the coordinate reference system.
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn crs(&self) -> Result<(CrsKind, &'a [u8]), FormatError> {
        Ok((self.frame.crs_kind, self.file.read_all(self.file.section("crs", 0)?)?))
    }

    /// Gives the layout of the point records.
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// Gives the sources in the order the user named them.
    pub fn sources(&self) -> &[Source] {
        &self.placement.sources
    }

    /// Gives the file name of a source.
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn source_name(&self, source: &Source) -> Result<String, FormatError> {
        let names = self.file.section("names", 0)?;
        let bytes = self.file.read(names, source.name.0, source.name.1.into())?;
        Ok(String::from_utf8_lossy(bytes).into_owned())
    }

    /// Says whether section `normals` has rows.
    pub fn has_normals(&self) -> bool {
        self.normals.n_records > 0
    }

    /// Reads a range of points: record bytes, and normal rows where there are any.
    ///
    /// # Errors
    /// Where the range leaves the points or a block is damaged.
    pub fn points(&self, first: u64, n: u64) -> Result<Points<'_>, FormatError> {
        let stride = self.schema.record_bytes() as u64;
        let at = first.saturating_mul(stride);
        let records = self.file.read(&self.points, at, n.saturating_mul(stride))?;
        let row = NORMAL_BYTES as u64;
        let normals = match self.has_normals() {
            true => {
                self.file.read(&self.normals, first.saturating_mul(row), n.saturating_mul(row))?
            }
            false => &[],
        };
        Ok(Points { view: self, first, records, normals })
    }

    /// Checks every byte and every rule of FORMAT.md, order and digest of the points included.
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify(&self) -> Result<(), FormatError> {
        self.verify_telling(&mut |_| ())
    }

    /// Counts the bytes that verifying goes through: the whole file, then the points again.
    pub fn verify_bytes(&self) -> u64 {
        self.file.len_bytes() + self.points.len_bytes
    }

    /// Does what [`Self::verify`] does; `tell` gets the number of bytes gone through, again and
    /// again, in all about [`Self::verify_bytes`].
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify_telling(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        self.file.verify(tell)?;
        self.crs()?;
        let names = self.file.section("names", 0)?;
        for source in self.sources() {
            self.file.read(names, source.name.0, source.name.1.into())?;
        }
        let codes = self.file.read_all(&self.codes)?;
        let (mut before, mut digest, mut first) = (0, 0u128, 0);
        while first < self.summary.n_points {
            let n = CODE_STRIDE.min(self.summary.n_points - first);
            let at = first * self.schema.record_bytes() as u64;
            let indexed = FieldReader::new(&codes[(first / CODE_STRIDE * 8) as usize..]).u64();
            for (i, point) in self.points(first, n)?.iter().enumerate() {
                let key = point?.key;
                let code = pvmap_geometry::morton::encode(key.g);
                if code < before || (i == 0 && code != indexed) {
                    return Err(self.points.broken(at, "points are not in Morton order"));
                }
                before = code;
                digest = digest.wrapping_add(digest_of(&key));
            }
            first += n;
            tell(n * self.schema.record_bytes() as u64);
        }
        if digest != self.summary.digest {
            return Err(self.points.broken(0, "the points are not those of the digest"));
        }
        Ok(())
    }
}

/// A range of points of an open octree.
#[derive(Debug, Clone, Copy)]
pub struct Points<'a> {
    view: &'a OctreeView<'a>,
    first: u64,
    records: &'a [u8],
    normals: &'a [u8],
}

/// One point of an octree.
#[derive(Debug, Clone, Copy)]
pub struct Point<'a> {
    /// What routes it.
    pub key: RoutingKey,
    /// Whether its normal came from its source.
    pub normal_from_source: bool,
    /// Its record, laid out by the schema.
    pub record: &'a [u8],
}

impl<'a> Points<'a> {
    /// Walks the points in order.
    pub fn iter(&self) -> impl Iterator<Item = Result<Point<'a>, FormatError>> + use<'a> {
        let Points { view, first, records, normals } = *self;
        let stride = view.schema.record_bytes();
        records.chunks_exact(stride).enumerate().map(move |(i, record)| {
            let broken = |section: &Section, size: usize, what: &str| {
                section.broken((first + i as u64) * size as u64, what)
            };
            let g = view.placement.grid(record);
            let g = g.ok_or_else(|| broken(&view.points, stride, "a point of no source"))?;
            let normal = match normals.get(i * NORMAL_BYTES..(i + 1) * NORMAL_BYTES) {
                None => PointNormal::default(),
                Some(row) => PointNormal::from_bytes(row)
                    .ok_or_else(|| broken(&view.normals, NORMAL_BYTES, "an impossible normal"))?,
            };
            let key = RoutingKey { g, normal: normal.normal, oriented: normal.oriented };
            Ok(Point { key, normal_from_source: normal.from_source, record })
        })
    }
}

/// Makes what closes an octree, from its sections in the order of [`SECTIONS`].
pub fn close_octree(sections: &[Written]) -> Closing {
    debug_assert!(sections.iter().map(|s| s.name).eq(SECTIONS), "sections in file order");
    close(Kind::Octree, sections)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn format11_the_digest_is_xxh3_of_20_bytes(
            g in prop::array::uniform3(any::<u32>()),
            normal in prop::array::uniform3(any::<i16>()),
            oriented in any::<bool>(),
        ) {
            let mut bytes = [0; 20];
            let mut w = FieldWriter::new(&mut bytes);
            w.three(g, FieldWriter::u32);
            w.three(normal, FieldWriter::i16);
            w.u16(u16::from(normal != [0; 3]) | u16::from(oriented) << 1);
            let expected = xxhash_rust::xxh3::xxh3_128(&bytes);
            prop_assert_eq!(digest_of(&RoutingKey { g, normal, oriented }), expected);
        }
    }
}
