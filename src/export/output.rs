//! The file that points go to: its kind by its name, its lattice and its columns by the octree.

use std::path::{Path, PathBuf};

use pvmap_geometry::{Frame, PointBatch, Positions};
use pvmap_octree::OctreeError;
use pvmap_octree::by_source::Seen;
use pvmap_scan::{
    ColorRange, Crs, LasContent, LasOptions, LasWriter, PlyColumns, PlyExtras, PlyWriter,
    ScalarField,
};
use pvmap_store::{AtomicFile, ClosedFile, Watch};
use pvmap_vmap::frame::CrsKind;
use pvmap_vmap::schema::ColumnType;
use pvmap_vmap::{OctreeView, Source};

use super::begin::{LAS_SOFTWARE, Made, PLY_COMMENT, begin_file};
use crate::Error;

/// Steps that a lattice of our own has along the cube's side at the most: 30 bits of the 32.
const MOST_STEPS: f64 = 1e9;
/// A GPS time beyond this is none of a week; less than that it is none since 1980.
const WEEK_SECONDS: f64 = 604_800.0;
/// The largest class beside GeoTIFF keys.
const MAX_LEGACY_CLASS: u8 = 31;
/// Bytes of a point: of LAS without fields at the most, and of a column of three.
const LAS_POINT_BYTES: u64 = 36 + 12;
const PLY_POINT_BYTES: u64 = 24 + 12 + 6 + 4 + 1 + 8;
const FIELD_BYTES: u64 = 4;

/// What kind of file is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Las,
    Laz,
    Ply,
}

/// An output for points that was begun and has none yet.
#[derive(Debug)]
pub struct PointsFile {
    file: AtomicFile,
    kind: Kind,
}

impl PointsFile {
    /// Begins an output; the ending of its name says of which kind.
    ///
    /// # Errors
    /// Where it has another ending or cannot be begun, or a file has that name that no export
    /// made, unless `overwrite`.
    pub fn begin(path: &Path, overwrite: bool) -> Result<PointsFile, Error> {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        let kind = match ending.to_str() {
            Some("las") => Kind::Las,
            Some("laz") => Kind::Laz,
            Some("ply") => Kind::Ply,
            _ => {
                let path = path.display();
                let message = format!("{path}: points are written as .las, .laz or .ply");
                return Err(Error::Usage(message));
            }
        };
        let made = if kind == Kind::Ply { Made::Ply } else { Made::Las };
        Ok(PointsFile { file: begin_file(path, made, overwrite)?, kind })
    }

    /// Gives the name it has until it is published.
    pub(super) fn temp_path(&self) -> &Path {
        self.file.temp_path()
    }

    /// Gives the bytes that the file will have, about.
    pub(super) fn estimate_bytes(&self, octree: &OctreeView<'_>, fields: &[ScalarField]) -> u64 {
        let fields_bytes = fields.len() as u64 * FIELD_BYTES;
        let each = match self.kind {
            Kind::Las => LAS_POINT_BYTES + fields_bytes,
            // Scans shrink to a fifth or less; colours and noise do not.
            Kind::Laz => (LAS_POINT_BYTES + fields_bytes) / 3,
            Kind::Ply => PLY_POINT_BYTES + fields_bytes,
        };
        octree.summary().n_points.saturating_mul(each)
    }

    /// Starts the file.
    pub(super) fn start(
        self,
        octree: &OctreeView<'_>,
        fields: &[ScalarField],
        seen: Seen,
        watch: &dyn Watch,
    ) -> Result<Writer, Error> {
        let path = self.file.path().to_path_buf();
        let (color, color_factors) = self.colors(octree);
        let has = |name| octree.schema().column(name).is_some();
        let sources = octree.sources().to_vec();
        let (sink, lattice) = if self.kind == Kind::Ply {
            let columns = PlyColumns {
                double: octree.schema().columns()[0].kind != ColumnType::F32x3,
                normal: has("normal"),
                color,
                intensity: has("intensity"),
                classification: has("class"),
                gps_time: has("gps_time"),
            };
            let n_points = octree.summary().n_points;
            let comments = vec![PLY_COMMENT.to_owned()];
            let extras = PlyExtras { comments, fields: fields.to_vec() };
            let ply = PlyWriter::create_in(self.file, n_points, columns, &extras)?;
            (Sink::Ply(ply), None)
        } else {
            let lattice = Lattice::of(octree, watch);
            let options = LasOptions {
                compressed: self.kind == Kind::Laz,
                scale: lattice.scale,
                offset: lattice.offset,
                normals: has("normal"),
            };
            let content = LasContent {
                color: color.is_some(),
                gps_time: has("gps_time"),
                is_standard_gps_time: seen
                    .gps_time
                    .is_some_and(|(least, most)| least < 0.0 || most > WEEK_SECONDS),
                crs: crs(octree, seen, watch)?,
                fields: fields.to_vec(),
                software: LAS_SOFTWARE,
            };
            let las = LasWriter::create_in(self.file, options, &content)?;
            (Sink::Las(Box::new(las)), Some(lattice))
        };
        Ok(Writer { sink, lattice, color_factors, sources, path })
    }

    /// Says what full brightness is in the output, if there are colours, and by what those of each
    /// source are multiplied for it.
    ///
    /// Colours of 8 bits stay what they are where all are of 8 bits and the file can say so: a PLY
    /// by its type; a LAS does not, so it is done as the scans did, if they were LAS.
    fn colors(&self, octree: &OctreeView<'_>) -> (Option<ColorRange>, Vec<u16>) {
        let sources = octree.sources();
        let colored = || sources.iter().filter(|s| s.color_depth > 0);
        if octree.schema().column("color").is_none() {
            return (None, vec![1; sources.len()]);
        }
        let of_ply = |s: &Source| s.format == 3;
        let stay = colored().all(|s| s.color_depth == 8 && (self.kind == Kind::Ply || !of_ply(s)));
        // 257 · v is v repeated: the same share of full scale.
        let factor = |s: &Source| if s.color_depth == 8 && !stay { 257 } else { 1 };
        let range = if stay { ColorRange::Eight } else { ColorRange::Sixteen };
        (Some(range), sources.iter().map(factor).collect())
    }
}

/// Gives the coordinate reference system in the form that the file can have.
fn crs(octree: &OctreeView<'_>, seen: Seen, watch: &dyn Watch) -> Result<Option<Crs>, Error> {
    let (kind, bytes) = octree.crs().map_err(OctreeError::from)?;
    match kind {
        CrsKind::None => Ok(None),
        CrsKind::Wkt => Ok(Some(Crs::Wkt(bytes.to_vec()))),
        CrsKind::GeoTiff => {
            // Their point formats have no room for more.
            let keys = Crs::of_geotiff(bytes).filter(|_| seen.class_max <= MAX_LEGACY_CLASS);
            if keys.is_none() {
                watch.warn("the coordinate reference system cannot be written: it is left out");
            }
            Ok(keys)
        }
    }
}

/// A lattice for all points, and the way of each source onto it.
#[derive(Debug, Clone, PartialEq)]
struct Lattice {
    scale: [f64; 3],
    offset: [f64; 3],
    /// By source: output X = stored X + this; none where coordinates are rounded to steps.
    shifts: Option<Vec<[i64; 3]>>,
}

impl Lattice {
    /// Takes the lattice of the scans where they have one, else makes one fine enough.
    fn of(octree: &OctreeView<'_>, watch: &dyn Watch) -> Lattice {
        let sources = octree.sources();
        match octree.frame().frame {
            Frame::Lattice { scale, offset, min, extent } => {
                let base = [0, 1, 2].map(|i| match sources.len() {
                    0 | 1 => 0,
                    _ => base(min[i], extent / scale[i]),
                });
                let shift = |s: &Source| [0, 1, 2].map(|i| s.shift[i].saturating_sub(base[i]));
                Lattice {
                    scale,
                    offset: [0, 1, 2].map(|i| offset[i] + base[i] as f64 * scale[i]),
                    shifts: Some(sources.iter().map(shift).collect()),
                }
            }
            Frame::World { min, extent } => {
                let lattice = Lattice::of_lattices(sources, min, extent);
                let lattice = lattice.unwrap_or_else(|| Lattice::decimal(min, extent));
                let [x, y, z] = lattice.scale;
                watch.warn(&format!(
                    "coordinates are rounded to whole steps of {x},{y},{z}, as LAS has them; \
                     a .ply keeps them as they are"
                ));
                lattice
            }
        }
    }

    /// Takes the finest steps of scans that all have a lattice; none where the points do not fit.
    fn of_lattices(sources: &[Source], min: [f64; 3], extent: f64) -> Option<Lattice> {
        let first = sources.first().filter(|_| sources.iter().all(|s| s.format != 3))?;
        let scale = [0, 1, 2].map(|i| sources.iter().map(|s| s.scale[i]).fold(f64::MAX, f64::min));
        let fits = (0..3).all(|i| {
            let steps = |x: f64| (x - first.offset[i]) / scale[i];
            steps(min[i]) >= -2e9 && steps(min[i] + extent) <= 2e9
        });
        fits.then_some(Lattice { scale, offset: first.offset, shifts: None })
    }

    /// Makes one of the finest decimal steps that the points fit in.
    fn decimal(min: [f64; 3], extent: f64) -> Lattice {
        // Of a single point any step will do; f64 ends long before 1e-15 of a kilometre.
        let n_decimals = match extent {
            e if e > 0.0 => (MOST_STEPS / e).log10().floor().clamp(-300.0, 15.0),
            _ => 6.0,
        };
        let scale = match n_decimals as i32 {
            // 1/1000 is nearer to 0.001 than any product of tenths.
            n if n >= 0 => 1.0 / 10f64.powi(n),
            n => 10f64.powi(-n),
        };
        Lattice { scale: [scale; 3], offset: min.map(f64::floor), shifts: None }
    }
}

/// Gives the step that becomes 0: 0 itself where all steps fit i32 then, else the middle.
fn base(min: i64, n_steps: f64) -> i64 {
    let max = min.saturating_add(n_steps.ceil() as i64);
    let fits = min >= i64::from(i32::MIN) && max <= i64::from(i32::MAX);
    if fits { 0 } else { min.saturating_add((n_steps / 2.0) as i64) }
}

enum Sink {
    Las(Box<LasWriter>),
    Ply(PlyWriter),
}

/// A file that takes points.
pub(super) struct Writer {
    sink: Sink,
    /// Where places go; none where they stay world coordinates.
    lattice: Option<Lattice>,
    color_factors: Vec<u16>,
    sources: Vec<Source>,
    path: PathBuf,
}

impl Writer {
    /// Appends points of one source and the values of their fields.
    pub(super) fn write(&mut self, batch: &PointBatch, values: &[Vec<f64>]) -> Result<(), Error> {
        let source = &self.sources[batch.source as usize];
        let factor = self.color_factors[batch.source as usize];
        let mut batch = batch.clone();
        for channel in batch.color.iter_mut().flatten().flatten() {
            *channel = channel.saturating_mul(factor);
        }
        if let Positions::Lattice(steps) = &mut batch.positions {
            let shifts = self.lattice.as_ref().and_then(|l| l.shifts.as_ref());
            match shifts.map(|s| s[batch.source as usize]) {
                Some([0, 0, 0]) => {}
                Some(shift) => shift_all(steps, shift).ok_or_else(|| self.too_far())?,
                None => batch.positions = Positions::Double(world(steps, source)),
            }
        }
        match &mut self.sink {
            Sink::Las(las) => las.write_with(&batch, values)?,
            Sink::Ply(ply) => ply.write_with(&batch, values)?,
        }
        Ok(())
    }

    /// Completes the file, which has yet to get its name.
    pub(super) fn close(self) -> Result<ClosedFile, Error> {
        match self.sink {
            Sink::Las(las) => Ok(las.close()?),
            Sink::Ply(ply) => Ok(ply.close()?),
        }
    }

    fn too_far(&self) -> Error {
        let path = self.path.display();
        Error::Data(format!("{path}: the scans are too far apart for one LAS file; write a .ply"))
    }
}

fn shift_all(steps: &mut [[i32; 3]], shift: [i64; 3]) -> Option<()> {
    for place in steps {
        for i in 0..3 {
            place[i] = i32::try_from(i64::from(place[i]).checked_add(shift[i])?).ok()?;
        }
    }
    Some(())
}

/// Gives world coordinates by the two operations of the LAS standard.
fn world(steps: &[[i32; 3]], source: &Source) -> Vec<[f64; 3]> {
    let along = |x: &[i32; 3], i: usize| f64::from(x[i]) * source.scale[i] + source.offset[i];
    steps.iter().map(|x| [along(x, 0), along(x, 1), along(x, 2)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lattice_of_our_own_has_decimal_steps_that_fit() {
        for (extent, scale) in
            [(10.0, 1e-8), (9.99, 1e-8), (0.3, 1e-9), (5e5, 1e-3), (3e10, 100.0), (0.0, 1e-6)]
        {
            let found = Lattice::decimal([-3.5, 7.0, 0.1], extent);
            assert!((found.scale[0] / scale - 1.0).abs() < 1e-12, "{extent}: {:?}", found.scale);
            assert_eq!(found.offset, [-4.0, 7.0, 0.0]);
        }
        assert_eq!(Lattice::decimal([0.0; 3], 5e5).scale, [0.001; 3]);
    }

    #[test]
    fn steps_that_leave_i32_are_counted_from_the_middle() {
        assert_eq!(base(-5, 1e6), 0);
        assert_eq!(base(i64::from(i32::MAX) - 10, 20.0), i64::from(i32::MAX));
        assert_eq!(base(-(1 << 40), 4e9), -(1 << 40) + 2_000_000_000);
        let mut steps = vec![[i32::MAX, 0, 5]];
        assert_eq!(shift_all(&mut steps, [1, 0, 0]), None);
        assert_eq!(shift_all(&mut steps, [-1, 7, 0]), Some(()));
        assert_eq!(steps, [[i32::MAX - 1, 7, 5]]);
    }
}
