//! LAZ: the compression record, the chunk table and the chunks, each checked before the decoder
//! sees them.
//!
//! The decoder allocates what a layer's size says and panics on bytes that no encoder writes. So
//! every size is compared with the file first, each chunk is decoded through a window that ends
//! where the chunk ends, and a panic of the decoder becomes an error that names the point.

use std::cell::Cell;
use std::io::BufReader;
use std::ops::{Range, RangeInclusive};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use laz::laszip::{ChunkTable, LazItemRecordBuilder};
use laz::record::{
    LayeredPointRecordDecompressor, RecordDecompressor, SequentialPointRecordDecompressor,
};
use laz::{LazItem, LazVlr, LazVlrBuilder};
use pvmap_geometry::PointBatch;
use pvmap_store::InputFile;

use super::header::{Header, RECORD_BYTES};
use super::records::RecordLayout;
use crate::bytes::{BLOCK_BYTES, Window, take, u16_at, u32_at};
use crate::error::ScanError;
use crate::source::{PartReader, ReadOptions};

/// Bytes of the compression record before its items, and of an item.
const VLR_BYTES: usize = 34;
const ITEM_BYTES: usize = 6;

/// Bytes before the first chunk: where the chunk table is.
const POINTER_BYTES: u64 = 8;

/// Bytes of the chunk table before its coded entries: version and count.
const TABLE_HEAD_BYTES: u64 = 8;

/// Most bytes of the records that are coded together, but for very wide ones: of formats 6 and up
/// the coder holds them all. Other programs code 50 thousand together.
const CHUNK_BYTES: u32 = 4 << 20;
const LEAST_CHUNK_POINTS: u32 = 500;
const MOST_CHUNK_POINTS: u32 = 50_000;

/// What a coder has been seen to hold for each extra byte of formats 6 and up, and before.
const LAYER_CODER_BYTES: u64 = 20 << 10;
const BYTE_CODER_BYTES: u64 = 5 << 9;

/// The type of the item for wave packets of point formats 4 and 5.
const WAVE_PACKET_13: u16 = 9;

thread_local! {
    static IS_DECODING: Cell<bool> = const { Cell::new(false) };
}

/// Says whether this thread is inside a guarded decoder, whose panics become errors. A panic hook
/// asks this to stay silent about them.
pub fn is_decoding() -> bool {
    IS_DECODING.get()
}

/// Runs a third-party decoder; a panic is an error like any other.
fn guarded<T>(decode: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    IS_DECODING.set(true);
    let result = catch_unwind(AssertUnwindSafe(decode));
    IS_DECODING.set(false);
    result.unwrap_or_else(|_| Err("the compressed bytes make no sense".to_owned()))
}

/// Says how points of a format are compressed whose records have `record_bytes`.
pub(super) fn vlr_of(point_format: u8, record_bytes: u16) -> Result<LazVlr, String> {
    let n_extra = record_bytes - RECORD_BYTES[usize::from(point_format)];
    let items = LazItemRecordBuilder::default_for_point_format_id(point_format, n_extra);
    let vlr = LazVlrBuilder::new(items.map_err(|e| e.to_string())?)
        .with_fixed_chunk_size(chunk_points(record_bytes))
        .build();
    let mut bytes = Vec::new();
    vlr.write_to(&mut bytes).map_err(|e| e.to_string())?;
    // The crate calls its one coder of wave packets version 2; LASzip knows it as 1 and refuses 2.
    for item in bytes[VLR_BYTES..].chunks_exact_mut(ITEM_BYTES) {
        if u16_at(item, 0) == WAVE_PACKET_13 {
            item[4..6].copy_from_slice(&1u16.to_le_bytes());
        }
    }
    LazVlr::from_buffer(&bytes).map_err(|e| e.to_string())
}

/// Gives how many records of a size are coded together.
fn chunk_points(record_bytes: u16) -> u32 {
    (CHUNK_BYTES / u32::from(record_bytes)).clamp(LEAST_CHUNK_POINTS, MOST_CHUNK_POINTS)
}

/// Gives the memory that coding records as LAZ holds.
pub(super) fn coder_bytes(point_format: u8, record_bytes: u16) -> u64 {
    // What is coded together grows by doubling.
    let chunk_bytes = 2 * u64::from(chunk_points(record_bytes)) * u64::from(record_bytes);
    held_bytes(point_format, record_bytes, chunk_bytes)
}

/// Gives the memory of a coder, or a decoder, that has a chunk at hand.
fn held_bytes(point_format: u8, record_bytes: u16, chunk_bytes: u64) -> u64 {
    let n_extra = u64::from(record_bytes - RECORD_BYTES[usize::from(point_format)]);
    if point_format < 6 {
        return n_extra * BYTE_CODER_BYTES;
    }
    n_extra * LAYER_CODER_BYTES + chunk_bytes
}

/// How the points of a LAZ file are cut and coded.
#[derive(Debug)]
pub(crate) struct Laz {
    items: Vec<LazItem>,
    /// Point formats 6…10 keep each field in a layer of its own; this is how many there are.
    n_layers: Option<usize>,
    chunks: Vec<Chunk>,
    /// A file without a usable chunk table is one long chunk, in which coding starts afresh after
    /// so many points.
    restart_every: Option<u64>,
    /// How many points there are, as far as the chunk table tells.
    n_points: RangeInclusive<u64>,
}

/// Points that are coded together.
#[derive(Debug, Clone, Copy)]
struct Chunk {
    first_record: u64,
    end_record: u64,
    at: u64,
    end: u64,
}

/// What the compression record says.
struct Scheme {
    items: Vec<LazItem>,
    n_layers: Option<usize>,
    is_chunked: bool,
    /// Points of a chunk; none where chunks differ.
    chunk_points: Option<u64>,
}

impl Laz {
    /// Reads and checks the compression record and the chunk table of a file with points.
    pub(crate) fn open(
        file: &InputFile,
        header: &Header,
        vlr: Option<&[u8]>,
        is_lenient: bool,
    ) -> Result<Laz, ScanError> {
        let fail = |place: &str, problem| ScanError::header(file.path(), place, problem);
        let vlr = vlr.ok_or_else(|| {
            fail("LAZ header", "the points are marked compressed, but no VLR says how".to_owned())
        })?;
        let scheme = Scheme::read(vlr, header).map_err(|p| fail("LAZ compression VLR", p))?;
        if !scheme.is_chunked {
            return Ok(Laz::in_one_chunk(scheme, header, header.points_offset, None));
        }
        match find_chunks(file, header, &scheme) {
            Ok((chunks, n_points)) => {
                let Scheme { items, n_layers, .. } = scheme;
                Ok(Laz { items, n_layers, chunks, restart_every: None, n_points })
            }
            Err(_) if is_lenient && scheme.chunk_points.is_some() => {
                let every = scheme.chunk_points;
                let at = header.points_offset + POINTER_BYTES;
                Ok(Laz::in_one_chunk(scheme, header, at, every))
            }
            Err(problem) => Err(fail("LAZ chunk table", problem)),
        }
    }

    /// Takes all points for one chunk that ends where the points end.
    fn in_one_chunk(scheme: Scheme, header: &Header, at: u64, restart_every: Option<u64>) -> Laz {
        let n = header.n_points;
        let chunk = Chunk { first_record: 0, end_record: n, at, end: header.points_end };
        let Scheme { items, n_layers, .. } = scheme;
        Laz { items, n_layers, chunks: vec![chunk], restart_every, n_points: n..=n }
    }

    /// Gives the least and the greatest number of points that the chunk table allows.
    pub(crate) fn n_points(&self) -> RangeInclusive<u64> {
        self.n_points.clone()
    }

    /// Gives the memory that decoding the records of a file holds.
    pub(super) fn decoder_bytes(&self, header: &Header) -> u64 {
        let of = |c: &Chunk| match self.restart_every {
            Some(n) => (c.end - c.at).min(n * u64::from(header.record_bytes)),
            None => c.end - c.at,
        };
        let chunk_bytes = self.chunks.iter().map(of).max().unwrap_or(0);
        held_bytes(header.point_format, header.record_bytes, chunk_bytes)
    }

    /// Gives the start of the chunk that begins nearest to `record`.
    pub(crate) fn cut_near(&self, record: u64) -> u64 {
        let next = self.chunks.partition_point(|c| c.first_record <= record);
        let chunk = self.chunks[next - 1];
        let is_past_middle = record - chunk.first_record > chunk.end_record.saturating_sub(record);
        match self.chunks.get(next) {
            Some(following) if is_past_middle => following.first_record,
            _ => chunk.first_record,
        }
    }

    /// Reads a range of records.
    pub(crate) fn reader<'a>(
        &'a self,
        file: &'a InputFile,
        layout: &'a RecordLayout,
        source: u32,
        left: Range<u64>,
        options: ReadOptions,
    ) -> LazReader<'a> {
        let is_lenient = options.lenient;
        LazReader {
            laz: self,
            file,
            layout,
            source,
            left,
            is_lenient,
            open: None,
            raw: Vec::new(),
            stopped: None,
        }
    }
}

impl Scheme {
    /// Reads the compression record. Its items must be those of the point format, so that they
    /// fill a record exactly.
    fn read(vlr: &[u8], header: &Header) -> Result<Scheme, String> {
        let n_items = if vlr.len() < VLR_BYTES { 0 } else { usize::from(u16_at(vlr, 32)) };
        if n_items == 0 || n_items > 8 || vlr.len() < VLR_BYTES + n_items * ITEM_BYTES {
            return Err(format!("{n_items} items in {} bytes, expected 1 to 8", vlr.len()));
        }
        let (compressor, coder, chunk_points) = (u16_at(vlr, 0), u16_at(vlr, 2), u32_at(vlr, 12));
        let is_layered = header.point_format >= 6;
        let expected = if is_layered { 3..=3 } else { 1..=2 };
        if !expected.contains(&compressor) {
            let format = header.point_format;
            return Err(format!("compressor {compressor} does not go with point format {format}"));
        }
        if coder != 0 {
            return Err(format!("coder {coder} is unknown, expected 0"));
        }
        let found: Vec<(u16, u16)> = (0..n_items)
            .map(|i| VLR_BYTES + i * ITEM_BYTES)
            .map(|at| (u16_at(vlr, at), u16_at(vlr, at + 2)))
            .collect();
        let expected = items_of(header);
        if found != expected {
            return Err(format!(
                "items {found:?} (type, bytes) do not make up a record of point format {} with {} \
                 bytes, expected {expected:?}",
                header.point_format, header.record_bytes
            ));
        }
        for i in 0..n_items {
            let version = u16_at(vlr, VLR_BYTES + i * ITEM_BYTES + 4);
            let expected = if is_layered { 3..=4 } else { 1..=2 };
            if !expected.contains(&version) {
                return Err(format!("item {i} has version {version}, expected {expected:?}"));
            }
        }
        let items = LazVlr::from_buffer(vlr).map_err(|e| e.to_string())?.items().clone();
        Ok(Scheme {
            n_layers: is_layered.then(|| n_layers(&found)),
            items,
            is_chunked: compressor != 1,
            chunk_points: (1..u32::MAX).contains(&chunk_points).then_some(chunk_points.into()),
        })
    }
}

/// Gives the items (type, bytes) that a record of the file's point format is made of.
fn items_of(header: &Header) -> Vec<(u16, u16)> {
    let mut items: Vec<(u16, u16)> = match header.point_format {
        0 => vec![(6, 20)],
        1 => vec![(6, 20), (7, 8)],
        2 => vec![(6, 20), (8, 6)],
        3 => vec![(6, 20), (7, 8), (8, 6)],
        4 => vec![(6, 20), (7, 8), (9, 29)],
        5 => vec![(6, 20), (7, 8), (8, 6), (9, 29)],
        6 => vec![(10, 30)],
        7 => vec![(10, 30), (11, 6)],
        8 => vec![(10, 30), (12, 8)],
        9 => vec![(10, 30), (13, 29)],
        _ => vec![(10, 30), (12, 8), (13, 29)],
    };
    let n_extra = header.record_bytes - items.iter().map(|i| i.1).sum::<u16>();
    if n_extra > 0 {
        items.push((if header.point_format < 6 { 0 } else { 14 }, n_extra));
    }
    items
}

/// Counts the layers of items (type, bytes) of point formats 6…10.
fn n_layers(items: &[(u16, u16)]) -> usize {
    let of = |&(kind, bytes): &(u16, u16)| match kind {
        10 => 9,
        12 => 2,
        14 => usize::from(bytes),
        _ => 1,
    };
    items.iter().map(of).sum()
}

/// Reads the chunk table: the chunks, and how many points they can hold at least and at most.
fn find_chunks(
    file: &InputFile,
    header: &Header,
    scheme: &Scheme,
) -> Result<(Vec<Chunk>, RangeInclusive<u64>), String> {
    let data = header.points_offset + POINTER_BYTES;
    let table_at = find_table(file, header)?;
    let mut head = [0; TABLE_HEAD_BYTES as usize];
    file.read_exact_at(&mut head, table_at).map_err(|e| e.to_string())?;
    let (version, n_chunks) = (u32_at(&head, 0), u64::from(u32_at(&head, 4)));
    // A chunk begins with a whole record, so there is a limit to how many fit.
    let most = (table_at - data) / u64::from(header.record_bytes);
    if version != 0 || n_chunks > most || n_chunks == 0 {
        return Err(format!("version {version}, {n_chunks} chunks, expected 0 and 1 to {most}"));
    }
    let is_variable = scheme.chunk_points.is_none();
    let table = guarded(|| {
        let mut stream = BufReader::new(Window::new(file, table_at, file.len_bytes()));
        ChunkTable::read(&mut stream, is_variable).map_err(|e| e.to_string())
    })?;
    let mut chunks = Vec::with_capacity(table.len());
    let (mut record, mut at) = (0u64, data);
    for (i, entry) in table.as_ref().iter().enumerate() {
        let end = at.saturating_add(entry.byte_count);
        let n = scheme.chunk_points.unwrap_or(entry.point_count);
        let end_record = record.saturating_add(n);
        if end > table_at || n > u64::from(u32::MAX) {
            return Err(format!("chunk {i} has {n} points in bytes {at} to {end} of {table_at}"));
        }
        if n > 0 && record < header.n_points {
            let end_record = end_record.min(header.n_points);
            chunks.push(Chunk { first_record: record, end_record, at, end });
        }
        (record, at) = (end_record, end);
    }
    if chunks.is_empty() {
        return Err("all chunks are empty".to_owned());
    }
    // Chunks of fixed size are full but for the last.
    let least = scheme.chunk_points.map_or(record, |n| record - n + 1);
    Ok((chunks, least..=record))
}

/// Finds where the chunk table begins: the pointer before the first chunk, or, where a writer
/// could not go back to fill that in, the last eight bytes of the file.
fn find_table(file: &InputFile, header: &Header) -> Result<u64, String> {
    let n = file.len_bytes();
    let data = header.points_offset + POINTER_BYTES;
    if n < data + TABLE_HEAD_BYTES {
        return Err(format!("the file ends at byte {n}, before the first chunk"));
    }
    let pointer = |at: u64| -> Result<i64, String> {
        let mut bytes = [0; POINTER_BYTES as usize];
        file.read_exact_at(&mut bytes, at).map_err(|e| e.to_string())?;
        Ok(i64::from_le_bytes(take(&bytes, 0)))
    };
    let mut table_at = pointer(header.points_offset)?;
    if table_at == -1 {
        table_at = pointer(n - POINTER_BYTES)?;
    }
    match u64::try_from(table_at) {
        Ok(at) if at >= data && at <= n - TABLE_HEAD_BYTES => Ok(at),
        _ => Err(format!("it should begin at byte {table_at}, expected {data} to {n}")),
    }
}

type Input<'a> = BufReader<Window<'a>>;
type Decoder<'a> = Box<dyn RecordDecompressor<Input<'a>> + 'a>;

/// Reads a range of compressed records.
pub(crate) struct LazReader<'a> {
    laz: &'a Laz,
    file: &'a InputFile,
    layout: &'a RecordLayout,
    source: u32,
    left: Range<u64>,
    is_lenient: bool,
    open: Option<OpenChunk<'a>>,
    raw: Vec<u8>,
    /// Why a lenient read ended too early.
    stopped: Option<String>,
}

/// A chunk that is being decoded.
struct OpenChunk<'a> {
    decoder: Decoder<'a>,
    /// The record that comes next, and the one before which coding ends or starts afresh.
    next: u64,
    end: u64,
}

impl PartReader for LazReader<'_> {
    fn next(&mut self, n: usize) -> Result<Option<PointBatch>, ScanError> {
        if self.left.is_empty() {
            return Ok(None);
        }
        let n = (n as u64).min(self.left.end - self.left.start);
        let batch_end = self.left.start + n;
        let layout = self.layout;
        let mut batch = layout.empty_batch(self.source, n as usize);
        while self.left.start < batch_end {
            let first = self.left.start;
            let raw = self.block(batch_end)?;
            layout.append(raw, first, &mut batch);
            if self.left.end == first {
                break;
            }
        }
        Ok(Some(batch))
    }
}

impl<'a> LazReader<'a> {
    fn path(&self) -> &'a Path {
        self.file.path()
    }

    /// Gives some of the next records as they are, at most up to record `limit`. Where a cut file
    /// ends and the read is lenient, nothing is left behind them.
    pub(crate) fn block(&mut self, limit: u64) -> Result<&[u8], ScanError> {
        let first = self.left.start;
        if let Err((n_good, problem)) = self.decode_block(limit) {
            // A lenient read takes what a cut file has, not what a broken disk gives.
            if !self.is_lenient || self.file.failure().is_some() {
                return Err(ScanError::record(self.path(), first + n_good, problem));
            }
            self.raw.truncate(n_good as usize * self.layout.record_bytes);
            self.left.end = first;
            self.stopped = Some(problem);
        }
        Ok(&self.raw)
    }

    /// Says why a lenient read ended before the last record, if it did.
    pub(crate) fn stopped(&self) -> Option<&str> {
        self.stopped.as_deref()
    }

    /// Gives the records that are still to come.
    pub(crate) fn left(&self) -> Range<u64> {
        self.left.clone()
    }

    /// Decodes some records from `left.start` on into `raw`, at most up to `limit`.
    ///
    /// Fails with how many of them are good.
    fn decode_block(&mut self, limit: u64) -> Result<(), (u64, String)> {
        let first = self.left.start;
        let record_bytes = self.layout.record_bytes;
        let block = (BLOCK_BYTES / record_bytes).max(1) as u64;
        let mut chunk = match self.open.take() {
            Some(chunk) => self.follow(chunk),
            None => self.open_at(first),
        }
        .map_err(|problem| (0, problem))?;
        // A range may begin inside a chunk: what is before it is decoded and forgotten.
        while chunk.next < first {
            let k = block.min(first - chunk.next).min(chunk.end - chunk.next);
            self.raw.resize(k as usize * record_bytes, 0);
            decode(&mut chunk.decoder, &mut self.raw, record_bytes).map_err(|(_, p)| (0, p))?;
            chunk.next += k;
            chunk = self.follow(chunk).map_err(|problem| (0, problem))?;
        }
        let k = block.min(limit - first).min(chunk.end - first);
        self.raw.resize(k as usize * record_bytes, 0);
        decode(&mut chunk.decoder, &mut self.raw, record_bytes)?;
        chunk.next += k;
        self.left.start += k;
        self.open = Some(chunk);
        Ok(())
    }

    /// Opens the chunk that holds `record`.
    fn open_at(&self, record: u64) -> Result<OpenChunk<'a>, String> {
        let i = self.laz.chunks.partition_point(|c| c.end_record <= record);
        let chunk = self.laz.chunks[i];
        let input = BufReader::new(Window::new(self.file, chunk.at, chunk.end));
        let restart = self.laz.restart_every.map_or(u64::MAX, |n| chunk.first_record + n);
        let end = chunk.end_record.min(restart);
        self.check_layers(chunk.at, chunk.end, end - chunk.first_record)?;
        Ok(OpenChunk { decoder: self.laz.decoder(input)?, next: chunk.first_record, end })
    }

    /// Gives the chunk that comes next, where `chunk` is at its end.
    fn follow(&self, chunk: OpenChunk<'a>) -> Result<OpenChunk<'a>, String> {
        if chunk.next < chunk.end {
            return Ok(chunk);
        }
        let Some(every) = self.laz.restart_every else {
            return self.open_at(chunk.next);
        };
        let (next, whole) = (chunk.next, self.laz.chunks[0]);
        let mut input = chunk.decoder.box_into_inner();
        let at = std::io::Seek::stream_position(&mut input).map_err(|e| e.to_string())?;
        let end = whole.end_record.min(next + every);
        self.check_layers(at, whole.end, end - next)?;
        Ok(OpenChunk { decoder: self.laz.decoder(input)?, next, end })
    }

    /// Makes sure that the layers of a chunk fit into its bytes before the decoder allocates
    /// them, and that the chunk has as many points as the table says.
    fn check_layers(&self, at: u64, end: u64, n_points: u64) -> Result<(), String> {
        let Some(n_layers) = self.laz.n_layers else {
            return Ok(());
        };
        // First record, count, sizes of the layers, layers.
        let n_head = 4 + 4 * n_layers;
        let head_at = at + self.layout.record_bytes as u64;
        let layers_at = head_at + n_head as u64;
        if layers_at > end {
            return Err(format!("its chunk ends at byte {end}, within its header"));
        }
        let mut head = vec![0; n_head];
        self.file.read_exact_at(&mut head, head_at).map_err(|e| e.to_string())?;
        let n_present = u64::from(u32_at(&head, 0));
        let n_bytes: u64 = (1..=n_layers).map(|i| u64::from(u32_at(&head, 4 * i))).sum();
        if n_bytes > end - layers_at {
            return Err(format!("its chunk needs {n_bytes} bytes and has {}", end - layers_at));
        }
        if n_present < n_points {
            return Err(format!("its chunk holds {n_present} points, expected {n_points}"));
        }
        Ok(())
    }
}

impl Laz {
    /// Makes a decoder at the start of a chunk.
    fn decoder<'a>(&self, input: Input<'a>) -> Result<Decoder<'a>, String> {
        let mut decoder: Decoder<'a> = match self.n_layers {
            Some(_) => Box::new(LayeredPointRecordDecompressor::new(input)),
            None => Box::new(SequentialPointRecordDecompressor::new(input)),
        };
        decoder.set_fields_from(&self.items).map_err(|e| e.to_string())?;
        Ok(decoder)
    }
}

/// Fills `raw` with records; fails with how many are good.
fn decode(
    decoder: &mut Decoder<'_>,
    raw: &mut [u8],
    record_bytes: usize,
) -> Result<(), (u64, String)> {
    let mut n_good = 0;
    guarded(|| {
        for row in raw.chunks_exact_mut(record_bytes) {
            decoder.decompress_next(row).map_err(|e| format!("its bytes end too early ({e})"))?;
            n_good += 1;
        }
        Ok(())
    })
    .map_err(|problem| (n_good, problem))
}
