//! LAS and LAZ out: version 1.4, through the `las` crate.

use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use las::point::Format;
use las::{Builder, GpsTimeType, PointDataBuilder, Transform, Vector, Version, Vlr, Writer};
use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_store::{AtomicFile, ClosedFile, StoreError};

use crate::error::ScanError;
use crate::field::{self, FieldKind, ScalarField};
use crate::source::{Crs, StoredBounds};

/// The largest class of the formats before 6, which share its byte with flags.
const MAX_LEGACY_CLASS: u8 = 31;

/// Bytes of a record of the longest format written: place, intensity, class, gps time and colour.
const MAX_RECORD_BYTES: usize = 36;

/// The longest name or description of a field in extra bytes: a zero is behind it.
const MAX_TEXT_BYTES: usize = 31;

/// The longest payload of a plain record; longer ones stand behind the points.
pub(super) const MAX_VLR_BYTES: usize = 65_535;

/// Bytes of the header of LAS 1.4, and before the payload of a plain and of an extended record.
const HEADER_BYTES: u64 = 375;
const VLR_HEADER_BYTES: u64 = 54;
const EVLR_HEADER_BYTES: u64 = 60;

/// Where the header has its bounds: max and min, an axis at a time.
pub(super) const BOUNDS_OFFSET: usize = 179;

/// The `las` crate works through a batch three times; a few thousand records stay in the cache.
const BLOCK_POINTS: usize = 4096;

/// How to write a LAS file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LasOptions {
    /// LAZ instead of LAS.
    pub compressed: bool,
    /// World units per lattice step.
    pub scale: [f64; 3],
    /// World coordinate of lattice step 0.
    pub offset: [f64; 3],
    /// Whether each point carries a normal: three f32 extra bytes named nx, ny, nz.
    pub normals: bool,
}

/// What the points of a LAS file have beside place, intensity, class and normal.
#[derive(Debug, Clone, PartialEq)]
pub struct LasContent {
    /// Whether there is colour.
    pub color: bool,
    /// Whether there is GPS time; without a GeoTIFF reference system its room is there anyway.
    pub gps_time: bool,
    /// Whether GPS times are those since 1980 less 1e9 seconds, instead of seconds of a week.
    pub is_standard_gps_time: bool,
    /// Where on earth. GeoTIFF keys want a point format before 6, whose classes end at 31.
    pub crs: Option<Crs>,
    /// Numbers in extra bytes, behind the normal.
    pub fields: Vec<ScalarField>,
    /// What made the file: up to 31 ASCII characters of the header.
    pub software: &'static str,
}

impl Default for LasContent {
    fn default() -> LasContent {
        LasContent {
            color: true,
            gps_time: true,
            is_standard_gps_time: false,
            crs: None,
            fields: Vec::new(),
            software: "pvmap",
        }
    }
}

impl LasContent {
    fn layout(&self) -> Layout {
        match (&self.crs, self.gps_time, self.color) {
            (Some(Crs::GeoTiff { .. }), gps, color) => Layout {
                point_format: u8::from(gps) + 2 * u8::from(color),
                gps_at: gps.then_some(20),
                color_at: color.then_some(if gps { 28 } else { 20 }),
            },
            (_, _, color) => Layout {
                point_format: if color { 7 } else { 6 },
                gps_at: Some(22),
                color_at: color.then_some(30),
            },
        }
    }
}

/// Where the columns lie in the records of a point format.
#[derive(Debug, Clone, Copy)]
struct Layout {
    point_format: u8,
    gps_at: Option<usize>,
    color_at: Option<usize>,
}

impl Layout {
    fn is_legacy(&self) -> bool {
        self.point_format < 6
    }

    /// Gives the bytes of a record without what is behind the columns of its format.
    fn record_bytes(&self) -> usize {
        let after_gps = self.gps_at.map_or(20, |at| at + 8);
        self.color_at.map_or(after_gps, |at| at + 6)
    }
}

/// Writes points to a LAS or LAZ file that appears under its name when it is whole.
///
/// Bounds and counts in the header are those of the points; no date, so the same points give the
/// same bytes.
pub struct LasWriter {
    writer: Writer<Sink>,
    options: LasOptions,
    fields: Vec<ScalarField>,
    layout: Layout,
    format: Format,
    transforms: Vector<Transform>,
    /// The least and the greatest step along each axis.
    min: [i32; 3],
    max: [i32; 3],
    failure: Failure,
    path: PathBuf,
}

impl LasWriter {
    /// Starts a file of point format 7: place, intensity, class, gps time and colour.
    ///
    /// # Errors
    /// Where it cannot be created, or scale and offset make no lattice.
    pub fn create(path: &Path, options: LasOptions) -> Result<LasWriter, ScanError> {
        LasWriter::create_with(path, options, &LasContent::default())
    }

    /// Starts a file whose points have what `content` says.
    ///
    /// # Errors
    /// Those of [`LasWriter::create`], and where a field has a name that cannot be written.
    pub fn create_with(
        path: &Path,
        options: LasOptions,
        content: &LasContent,
    ) -> Result<LasWriter, ScanError> {
        LasWriter::create_in(AtomicFile::create(path)?, options, content)
    }

    /// Begins the points of a file that was started, which have what `content` says.
    ///
    /// # Errors
    /// Where scale and offset make no lattice, a field has a name that cannot be written, or the
    /// disk fails.
    pub fn create_in(
        file: AtomicFile,
        options: LasOptions,
        content: &LasContent,
    ) -> Result<LasWriter, ScanError> {
        let path = file.path().to_path_buf();
        let fail = |e: las::Error| write_error(&path, e.to_string());
        let is_sound = options.scale.iter().all(|s| s.is_normal() && *s > 0.0)
            && options.offset.iter().all(|o| o.is_finite());
        if !is_sound {
            return Err(write_error(&path, "scale must be > 0 and offset finite".to_owned()));
        }
        if let Some(problem) = content.fields.iter().find_map(ScalarField::problem) {
            return Err(write_error(&path, problem));
        }
        let layout = content.layout();
        let builder = builder(&options, content).map_err(fail)?;
        let format = builder.point_format;
        let header = builder.into_header().map_err(fail)?;
        let failure = Failure::default();
        let out = BufWriter::with_capacity(1 << 20, file);
        let sink = Sink { out, failure: failure.clone() };
        let writer = Writer::new(sink, header).map_err(fail)?;
        let transforms = transforms(&options);
        Ok(LasWriter {
            writer,
            options,
            fields: content.fields.clone(),
            layout,
            format,
            transforms,
            min: [i32::MAX; 3],
            max: [i32::MIN; 3],
            failure,
            path,
        })
    }

    /// Gives the bytes of such a file where it is not compressed.
    ///
    /// # Errors
    /// Where there can be no such file.
    pub fn file_bytes(
        options: LasOptions,
        content: &LasContent,
        n_points: u64,
    ) -> Result<u64, ScanError> {
        let builder = builder(&LasOptions { compressed: false, ..options }, content)
            .map_err(|e| write_error(Path::new("LAS"), e.to_string()))?;
        let plain = builder.vlrs.iter().map(|v| VLR_HEADER_BYTES + v.data.len() as u64);
        let extended = builder.evlrs.iter().map(|v| EVLR_HEADER_BYTES + v.data.len() as u64);
        let head_bytes = HEADER_BYTES + plain.chain(extended).sum::<u64>();
        let record_bytes = u64::from(builder.point_format.len());
        Ok(n_points.saturating_mul(record_bytes).saturating_add(head_bytes))
    }

    /// Appends a batch: places (a lattice batch as it is), colour, intensity, class, gps time and,
    /// if asked for, normals; what the batch lacks is 0.
    ///
    /// # Errors
    /// Where a coordinate does not fit the lattice, or the disk fails.
    pub fn write(&mut self, batch: &PointBatch) -> Result<(), ScanError> {
        self.write_with(batch, &[])
    }

    /// Appends a batch and the values of its fields, a column each.
    ///
    /// # Errors
    /// Those of [`LasWriter::write`], and where the values are not one a field and point.
    pub fn write_with(&mut self, batch: &PointBatch, values: &[Vec<f64>]) -> Result<(), ScanError> {
        if let Some(problem) = field::mismatch(&self.fields, values, batch.len()) {
            return Err(write_error(&self.path, problem));
        }
        for start in (0..batch.len()).step_by(BLOCK_POINTS) {
            let block = start..batch.len().min(start + BLOCK_POINTS);
            let mut raw = Vec::with_capacity(block.len() * usize::from(self.format.len()));
            for i in block {
                self.encode(batch, i, &mut raw)?;
                self.fields.iter().zip(values).for_each(|(f, v)| f.kind.put(v[i], &mut raw));
            }
            let points = PointDataBuilder::new()
                .with_format(self.format)
                .with_transforms(self.transforms)
                .build_from_bytes(raw)
                .map_err(|e| write_error(&self.path, e.to_string()))?;
            self.writer
                .write_points(&points)
                .map_err(|e| write_error(&self.path, e.to_string()))?;
        }
        self.failure.check(&self.path)
    }

    /// Completes the file and gives it its name.
    ///
    /// # Errors
    /// Where the disk fails; then nothing is left behind.
    pub fn finish(self) -> Result<(), ScanError> {
        Ok(self.close()?.publish(false)?)
    }

    /// Completes the file, which has yet to get its name.
    ///
    /// # Errors
    /// Those of [`LasWriter::finish`].
    pub fn close(self) -> Result<ClosedFile, ScanError> {
        let [min, max] = [self.min, self.max].map(|steps| steps.map(f64::from));
        let LasOptions { scale, offset, .. } = self.options;
        let bounds = bounds(StoredBounds { min, max }, scale, offset);
        let fail = |problem: String| write_error(&self.path, problem);
        let sink = self.writer.into_inner().map_err(|e| fail(e.to_string()))?;
        self.failure.check(&self.path)?;
        let file = sink
            .out
            .into_inner()
            .map_err(|e| StoreError::io(&self.path, "write", e.into_error()))?;
        file.write_at(&bounds, BOUNDS_OFFSET as u64)?;
        Ok(file.close()?)
    }

    /// Appends the record of point `i`.
    fn encode(&mut self, batch: &PointBatch, i: usize, raw: &mut Vec<u8>) -> Result<(), ScanError> {
        let place = self.place(batch, i)?;
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(place[axis]);
            self.max[axis] = self.max[axis].max(place[axis]);
        }
        let mut record = [0; MAX_RECORD_BYTES];
        for (slot, step) in record[..12].chunks_exact_mut(4).zip(place) {
            slot.copy_from_slice(&step.to_le_bytes());
        }
        let intensity = match &batch.intensity {
            Some(Intensity::U16(v)) => v[i],
            // `as` keeps the ends and turns NaN into 0.
            Some(Intensity::F32(v)) => v[i].round() as u16,
            None => 0,
        };
        record[12..14].copy_from_slice(&intensity.to_le_bytes());
        let class = batch.classification.as_ref().map_or(0, |v| v[i]);
        // The only return of its pulse, in three bits or in four.
        if self.layout.is_legacy() {
            if class > MAX_LEGACY_CLASS {
                let problem = format!("class {class} has no room in a file with GeoTIFF keys");
                return Err(write_error(&self.path, problem));
            }
            (record[14], record[15]) = (0x09, class);
        } else {
            (record[14], record[16]) = (0x11, class);
        }
        if let Some(at) = self.layout.gps_at {
            let gps_time = batch.gps_time.as_ref().map_or(0.0, |v| v[i]);
            record[at..at + 8].copy_from_slice(&gps_time.to_le_bytes());
        }
        if let Some(at) = self.layout.color_at {
            let color = batch.color.as_ref().map_or([0; 3], |v| v[i]);
            for (slot, channel) in record[at..at + 6].chunks_exact_mut(2).zip(color) {
                slot.copy_from_slice(&channel.to_le_bytes());
            }
        }
        raw.extend_from_slice(&record[..self.layout.record_bytes()]);
        if self.options.normals {
            let normal = batch.normal.as_ref().map_or([0.0; 3], |v| v[i]);
            for component in normal {
                raw.extend_from_slice(&component.to_le_bytes());
            }
        }
        Ok(())
    }

    /// Gives the lattice step of point `i`.
    fn place(&self, batch: &PointBatch, i: usize) -> Result<[i32; 3], ScanError> {
        let world = match &batch.positions {
            Positions::Lattice(v) => return Ok(v[i]),
            Positions::Single(v) => v[i].map(f64::from),
            Positions::Double(v) => v[i],
        };
        let mut place = [0; 3];
        for axis in 0..3 {
            let step =
                ((world[axis] - self.options.offset[axis]) / self.options.scale[axis]).round();
            if !(step >= f64::from(i32::MIN) && step <= f64::from(i32::MAX)) {
                return Err(write_error(
                    &self.path,
                    format!(
                        "{} of point {} does not fit the lattice; choose another offset or a \
                         larger scale",
                        world[axis], batch.records[i]
                    ),
                ));
            }
            place[axis] = step as i32;
        }
        Ok(place)
    }
}

fn transforms(options: &LasOptions) -> Vector<Transform> {
    let [x, y, z] =
        [0, 1, 2].map(|i| Transform { scale: options.scale[i], offset: options.offset[i] });
    Vector { x, y, z }
}

/// Encodes the bounds of points, in steps, for a header. The crate's own may be a step too wide: it
/// goes through world units and rounds outward.
pub(super) fn bounds(steps: StoredBounds, scale: [f64; 3], offset: [f64; 3]) -> Vec<u8> {
    let is_empty = steps.min[0] > steps.max[0];
    let world = |i: usize, step: f64| if is_empty { 0.0 } else { step * scale[i] + offset[i] };
    (0..3)
        .flat_map(|i| [world(i, steps.max[i]), world(i, steps.min[i])])
        .flat_map(f64::to_le_bytes)
        .collect()
}

fn write_error(path: &Path, problem: String) -> ScanError {
    ScanError::Write { path: path.to_path_buf(), problem }
}

/// Says what the header holds.
fn builder(options: &LasOptions, content: &LasContent) -> Result<Builder, las::Error> {
    let normal = ["nx", "ny", "nz"].map(|name| ScalarField {
        name: name.to_owned(),
        description: String::new(),
        kind: FieldKind::F32,
    });
    let normal = normal.into_iter().filter(|_| options.normals);
    let extra: Vec<ScalarField> = normal.chain(content.fields.iter().cloned()).collect();
    let mut format = Format::new(content.layout().point_format)?;
    format.is_compressed = options.compressed;
    // A record has room for 8 thousand of the widest; nobody asks for so many.
    format.extra_bytes = extra.iter().map(|f| f.kind.n_bytes() as u16).sum();
    let mut builder = Builder::default();
    builder.version = Version::new(1, 4);
    builder.generating_software = content.software.to_owned();
    builder.transforms = transforms(options);
    if content.is_standard_gps_time {
        builder.gps_time_type = GpsTimeType::Standard;
    }
    if !extra.is_empty() {
        let data = extra.iter().flat_map(descriptor).collect();
        builder.vlrs.push(vlr("LASF_Spec", 4, "extra bytes", data));
    }
    let records = crs_records(content.crs.as_ref()).into_iter().chain(whole_texts(&extra));
    for record in records {
        let is_long = record.data.len() > MAX_VLR_BYTES;
        (if is_long { &mut builder.evlrs } else { &mut builder.vlrs }).push(record);
    }
    builder.point_format = format;
    Ok(builder)
}

/// Describes a field of the extra bytes: no options. Source: LAS 1.4 specification, table 24.
pub(crate) fn descriptor(field: &ScalarField) -> [u8; 192] {
    let mut descriptor = [0; 192];
    descriptor[2] = match field.kind {
        FieldKind::U8 => 1,
        FieldKind::I8 => 2,
        FieldKind::U32 => 5,
        FieldKind::F32 => 9,
        FieldKind::F64 => 10,
    };
    // 32 bytes each, and a zero at the end for readers that want one.
    for (at, text) in [(4, &field.name), (160, &field.description)] {
        let text = cut(text);
        descriptor[at..at + text.len()].copy_from_slice(text.as_bytes());
    }
    descriptor
}

/// Gives as much of an ASCII text as a descriptor has room for, ending between words or numbers.
fn cut(text: &str) -> &str {
    match text.get(..MAX_TEXT_BYTES + 1) {
        None => text,
        Some(start) => &text[..start.rfind([',', ' ']).unwrap_or(MAX_TEXT_BYTES)],
    }
}

/// Writes the fields with their whole descriptions, where one has no room in its descriptor.
pub(crate) fn whole_texts(fields: &[ScalarField]) -> Option<Vlr> {
    let is_long = |f: &ScalarField| f.description.len() > MAX_TEXT_BYTES;
    let line = |f: &ScalarField| format!("{}: {}\n", f.name, f.description);
    let text: String = fields.iter().map(line).collect();
    fields.iter().any(is_long).then(|| vlr("pvmap", 1, "extra bytes in full", text.into_bytes()))
}

/// Gives the records of a coordinate reference system.
fn crs_records(crs: Option<&Crs>) -> Vec<Vlr> {
    let projection = |id, description, data| vlr("LASF_Projection", id, description, data);
    match crs {
        None => Vec::new(),
        Some(Crs::Wkt(text)) => {
            // A C string: its end is a zero.
            let data = [text.as_slice(), &[0]].concat();
            vec![projection(2112, "WKT", data)]
        }
        Some(Crs::GeoTiff { keys, doubles, texts }) => {
            let mut records = vec![projection(34735, "GeoTIFF keys", keys.clone())];
            if !doubles.is_empty() {
                records.push(projection(34736, "GeoTIFF doubles", doubles.clone()));
            }
            if !texts.is_empty() {
                records.push(projection(34737, "GeoTIFF texts", texts.clone()));
            }
            records
        }
    }
}

fn vlr(user_id: &str, record_id: u16, description: &str, data: Vec<u8>) -> Vlr {
    Vlr { user_id: user_id.to_owned(), record_id, description: description.to_owned(), data }
}

/// The first failure of the disk, shared with whoever has to report it.
#[derive(Debug, Clone, Default)]
struct Failure(Arc<Mutex<Option<io::Error>>>);

impl Failure {
    /// Turns the failure, if there was one, into an error; what comes after it counts for nothing.
    fn check(&self, path: &Path) -> Result<(), ScanError> {
        let failure = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match failure.as_ref() {
            Some(e) => Err(StoreError::io(path, "write", e.kind().into()).into()),
            None => Ok(()),
        }
    }

    /// Says whether there was one.
    fn is_set(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// Keeps a failure and gives `value` instead.
    fn swallow<T>(&self, result: io::Result<T>, value: T) -> io::Result<T> {
        Ok(result.unwrap_or_else(|e| {
            *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(e);
            value
        }))
    }
}

/// Where the `las` crate writes to. Its writer completes the file even when dropped, and panics if
/// that fails: so a failure is remembered here, and everything after it goes nowhere.
struct Sink {
    out: BufWriter<AtomicFile>,
    failure: Failure,
}

impl Write for Sink {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        if self.failure.is_set() {
            return Ok(buf.len());
        }
        let result = self.out.write(buf);
        self.failure.swallow(result, buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.failure.is_set() {
            return Ok(());
        }
        let result = self.out.flush();
        self.failure.swallow(result, ())
    }
}

impl Seek for Sink {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        if self.failure.is_set() {
            return Ok(0);
        }
        let result = self.out.seek(to);
        self.failure.swallow(result, 0)
    }
}
