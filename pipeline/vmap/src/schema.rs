//! The columns of an octree's point records: which there are, of which type, and where. [F-9]

use crate::bytes::{FieldReader, FieldWriter};

/// What a column holds. [F-9]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ColumnType {
    /// Three i32.
    I32x3 = 1,
    /// Three f32.
    F32x3 = 2,
    /// Three f64.
    F64x3 = 3,
    /// One u32.
    U32 = 4,
    /// One u64.
    U64 = 5,
    /// Three u16.
    U16x3 = 6,
    /// One u16.
    U16 = 7,
    /// One f32.
    F32 = 8,
    /// One u8.
    U8 = 9,
    /// One f64.
    F64 = 10,
}

impl ColumnType {
    const ALL: [ColumnType; 10] = [
        ColumnType::I32x3,
        ColumnType::F32x3,
        ColumnType::F64x3,
        ColumnType::U32,
        ColumnType::U64,
        ColumnType::U16x3,
        ColumnType::U16,
        ColumnType::F32,
        ColumnType::U8,
        ColumnType::F64,
    ];

    /// Gives its size.
    pub fn n_bytes(self) -> usize {
        match self {
            ColumnType::F64x3 => 24,
            ColumnType::I32x3 | ColumnType::F32x3 => 12,
            ColumnType::U64 | ColumnType::F64 => 8,
            ColumnType::U16x3 => 6,
            ColumnType::U32 | ColumnType::F32 => 4,
            ColumnType::U16 => 2,
            ColumnType::U8 => 1,
        }
    }
}

/// The columns a point record can have, in record order.
pub const COLUMN_NAMES: [&str; 8] =
    ["position", "record", "source", "normal", "color", "intensity", "class", "gps_time"];

/// One column of a point record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Column {
    /// One of [`COLUMN_NAMES`].
    pub name: &'static str,
    /// What it holds.
    pub kind: ColumnType,
    /// Where in the record.
    pub offset: usize,
}

/// Which columns a point record has and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Schema {
    columns: Vec<Column>,
    record_bytes: usize,
}

/// Bytes of a row of section `columns`.
pub const COLUMN_BYTES: usize = 32;

impl Schema {
    /// Lays out columns one after another without padding, in the order of [`COLUMN_NAMES`].
    /// The first is `position`, the second `record`.
    pub fn new(kinds: &[(&'static str, ColumnType)]) -> Schema {
        let mut record_bytes = 0;
        let columns = kinds
            .iter()
            .map(|&(name, kind)| {
                let column = Column { name, kind, offset: record_bytes };
                record_bytes += kind.n_bytes();
                column
            })
            .collect();
        Schema { columns, record_bytes }
    }

    /// Gives the size of a record.
    pub fn record_bytes(&self) -> usize {
        self.record_bytes
    }

    /// Gives the columns in record order.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Finds a column.
    pub fn column(&self, name: &str) -> Option<Column> {
        self.columns.iter().copied().find(|c| c.name == name)
    }

    /// Gives the rows of section `columns`.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.columns.len() * COLUMN_BYTES];
        for (row, c) in bytes.chunks_exact_mut(COLUMN_BYTES).zip(&self.columns) {
            row[..c.name.len()].copy_from_slice(c.name.as_bytes());
            let mut w = FieldWriter::new(&mut row[16..]);
            w.u32(c.kind as u32);
            w.u32(c.offset as u32);
        }
        bytes
    }

    /// Reads the rows of section `columns`; `None` where they are not a layout of [`Schema::new`].
    pub fn from_bytes(bytes: &[u8]) -> Option<Schema> {
        let kinds: Option<Vec<_>> = bytes
            .chunks_exact(COLUMN_BYTES)
            .map(|row| {
                let name = COLUMN_NAMES.into_iter().find(|n| {
                    row[..16].strip_prefix(n.as_bytes()).is_some_and(|r| r.iter().all(|&b| b == 0))
                })?;
                let kind = FieldReader::new(&row[16..]).u32();
                Some((name, ColumnType::ALL.into_iter().find(|&k| k as u32 == kind)?))
            })
            .collect();
        let schema = Schema::new(&kinds?);
        let legal = schema.columns.iter().all(|c| kinds_of(c.name).contains(&c.kind));
        let starts =
            schema.columns.first()?.name == "position" && schema.columns.get(1)?.name == "record";
        (legal && starts && schema.to_bytes() == bytes).then_some(schema)
    }
}

/// Gives the types a column may have. [F-9]
fn kinds_of(name: &str) -> &'static [ColumnType] {
    match name {
        "position" => &[ColumnType::I32x3, ColumnType::F32x3, ColumnType::F64x3],
        "record" => &[ColumnType::U32, ColumnType::U64],
        "source" => &[ColumnType::U32],
        "normal" => &[ColumnType::F32x3],
        "color" => &[ColumnType::U16x3],
        "intensity" => &[ColumnType::U16, ColumnType::F32],
        "class" => &[ColumnType::U8],
        "gps_time" => &[ColumnType::F64],
        _ => &[],
    }
}
