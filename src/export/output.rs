//! The file that points go to: its kind by its name, its lattice and its columns by the octree.

use std::path::{Path, PathBuf};

use pvmap_geometry::{PointBatch, Positions};
use pvmap_octree::by_source::{Intensities, Seen};
use pvmap_scan::{
    ColorRange, LasContent, LasOptions, LasWriter, PlyColumns, PlyExtras, PlyWriter, ScalarField,
};
use pvmap_store::{AtomicFile, ClosedFile, StoreError, Watch, memory};
use pvmap_vmap::schema::ColumnType;
use pvmap_vmap::{OctreeView, Source};

use super::begin::{LAS_SOFTWARE, Made, PLY_COMMENT, begin_file};
use super::columns::{self, Brightness, Scaling};
use super::fields::PointField;
use super::lattice::{Lattice, shift_all, world};
use crate::Error;

/// A LAZ has been seen to be so much smaller than its LAS, at the best.
const MOST_COMPRESSION: u64 = 16;

/// What kind of file is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Las,
    Laz,
    Ply,
}

/// An output for points that was begun and has none yet.
#[derive(Debug)]
pub struct PointsFile {
    file: AtomicFile,
    kind: Kind,
    /// Whether points have the colours of light and not those of the scans.
    is_lit: bool,
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
        Ok(PointsFile { file: begin_file(path, made, overwrite)?, kind, is_lit: false })
    }

    /// Gives points colours of light, whether the scans have colours or not.
    pub(super) fn colored_by_light(&mut self) {
        self.is_lit = true;
    }

    /// Gives the name it has until it is published.
    pub(super) fn temp_path(&self) -> &Path {
        self.file.temp_path()
    }

    /// Gives the file that was begun, and its kind.
    pub(super) fn into_parts(self) -> (AtomicFile, Kind) {
        (self.file, self.kind)
    }

    /// Gives its kind.
    pub(super) fn kind(&self) -> Kind {
        self.kind
    }

    /// Gives the name it will have.
    pub(super) fn path(&self) -> &Path {
        self.file.path()
    }

    /// Refuses an output of `full` bytes without compression for which the disk has no room beside
    /// `temporary_bytes`. How far points can be compressed nobody knows before: of a LAZ that may
    /// not fit it warns. (F21)
    pub(super) fn require_disk(
        &self,
        full: u64,
        temporary_bytes: u64,
        watch: &dyn Watch,
    ) -> Result<(), Error> {
        let (beside, path) = (self.file.temp_path(), self.file.path());
        let is_laz = self.kind == Kind::Laz;
        let (sure, most) = (if is_laz { full / MOST_COMPRESSION } else { full }, full);
        let is_short = |free: u64| free < most.saturating_add(temporary_bytes);
        if is_laz && memory::free_disk_bytes(beside).is_some_and(is_short) {
            let (shown, mib) = (path.display(), (most >> 20) + 1);
            watch.warn(&format!(
                "{shown}: the disk may be too small for it: without compression it has {mib} MiB"
            ));
        }
        let enough = memory::require_disk(beside, sure.saturating_add(temporary_bytes));
        Ok(enough.map_err(|e| match e {
            StoreError::TooLittleDisk { need_bytes, have_bytes, .. } => {
                StoreError::TooLittleDisk { path: path.to_path_buf(), need_bytes, have_bytes }
            }
            e => e,
        })?)
    }

    /// Gives the bytes of the file without compression, as far as they are known before the points
    /// are looked at: the most there can be.
    pub(super) fn file_bytes(
        &self,
        octree: &OctreeView<'_>,
        fields: &[ScalarField],
    ) -> Result<u64, Error> {
        let n_points = octree.summary().n_points;
        if self.kind == Kind::Ply {
            let (columns, extras) = (self.ply_columns(octree), ply_extras(fields));
            return Ok(PlyWriter::file_bytes(n_points, columns, &extras));
        }
        let any = Intensities { least: 0.0, most: 0.5, are_whole: false };
        let file_bytes = |class_max: u8| {
            let seen = Seen { class_max, gps_time: None, intensity: Some(any) };
            let (options, content) = self.las(octree, fields, seen)?;
            Ok::<_, Error>(LasWriter::file_bytes(options, &content, n_points)?)
        };
        Ok(file_bytes(0)?.max(file_bytes(u8::MAX)?))
    }

    /// Starts the points.
    pub(super) fn start(
        self,
        octree: &OctreeView<'_>,
        fields: (&[PointField], &[ScalarField]),
        seen: Seen,
        watch: &dyn Watch,
    ) -> Result<Writer, Error> {
        let path = self.file.path().to_path_buf();
        columns::warn_of_losses(octree, (&path, self.kind), seen, fields.0, watch)?;
        let (_, brightness) = columns::colors(octree, self.kind);
        let scaling = Scaling::of(octree, seen, self.kind);
        let sources = octree.sources().to_vec();
        let (sink, lattice) = if self.kind == Kind::Ply {
            let (columns, extras) = (self.ply_columns(octree), ply_extras(fields.1));
            let n_points = octree.summary().n_points;
            (Sink::Ply(PlyWriter::create_in(self.file, n_points, columns, &extras)?), None)
        } else {
            let lattice = Lattice::of(octree);
            if lattice.shifts.is_none() {
                let ([x, y, z], path) = (lattice.scale, path.display());
                watch.warn(&format!(
                    "{path}: coordinates are rounded to whole steps of {x},{y},{z}, as LAS has \
                     them; a .ply keeps them as they are"
                ));
            }
            let (options, content) = self.las(octree, fields.1, seen)?;
            let las = LasWriter::create_in(self.file, options, &content)?;
            (Sink::Las(Box::new(las)), Some(lattice))
        };
        Ok(Writer { sink, lattice, brightness, scaling, sources, path })
    }

    fn ply_columns(&self, octree: &OctreeView<'_>) -> PlyColumns {
        let has = |name| octree.schema().column(name).is_some();
        PlyColumns {
            double: octree.schema().columns()[0].kind != ColumnType::F32x3,
            normal: has("normal"),
            color: match self.is_lit {
                true => Some(ColorRange::Eight),
                false => columns::colors(octree, self.kind).0,
            },
            intensity: has("intensity"),
            classification: has("class"),
            gps_time: has("gps_time"),
        }
    }

    fn las(
        &self,
        octree: &OctreeView<'_>,
        fields: &[ScalarField],
        seen: Seen,
    ) -> Result<(LasOptions, LasContent), Error> {
        let has = |name| octree.schema().column(name).is_some();
        let lattice = Lattice::of(octree);
        let options = LasOptions {
            compressed: self.kind == Kind::Laz,
            scale: lattice.scale,
            offset: lattice.offset,
            normals: has("normal"),
        };
        let was = Scaling::of(octree, seen, self.kind).map(|_| Scaling::field());
        let content = LasContent {
            color: self.is_lit || has("color"),
            gps_time: has("gps_time"),
            is_standard_gps_time: columns::is_since_1980(octree, seen),
            crs: columns::crs(octree, self.kind, seen)?,
            fields: was.into_iter().chain(fields.iter().cloned()).collect(),
            software: LAS_SOFTWARE,
        };
        Ok((options, content))
    }
}

fn ply_extras(fields: &[ScalarField]) -> PlyExtras {
    PlyExtras { comments: vec![PLY_COMMENT.to_owned()], fields: fields.to_vec() }
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
    /// What becomes of the colours of each source.
    brightness: Vec<Brightness>,
    /// What becomes of intensities, where they do not stay.
    scaling: Option<Scaling>,
    sources: Vec<Source>,
    path: PathBuf,
}

impl Writer {
    /// Appends points of one source, the values of their fields, and the colours that they have
    /// instead of their own.
    pub(super) fn write(
        &mut self,
        batch: &PointBatch,
        mut values: Vec<Vec<f64>>,
        colors: Option<Vec<[u16; 3]>>,
    ) -> Result<(), Error> {
        let source = &self.sources[batch.source as usize];
        let brightness = self.brightness[batch.source as usize];
        let mut batch = batch.clone();
        for channel in batch.color.iter_mut().flatten().flatten() {
            *channel = brightness.of(*channel);
        }
        if colors.is_some() {
            batch.color = colors;
        }
        if let (Some(scaling), Some(intensity)) = (self.scaling, &batch.intensity) {
            let (scaled, was) = scaling.split(intensity);
            batch.intensity = Some(scaled);
            values.insert(0, was);
        }
        if let Positions::Lattice(steps) = &mut batch.positions {
            let shifts = self.lattice.as_ref().and_then(|l| l.shifts.as_ref());
            match shifts.map(|s| s[batch.source as usize]) {
                Some([0, 0, 0]) => {}
                Some(shift) => shift_all(steps, shift).ok_or_else(|| self.too_far())?,
                None => {
                    batch.positions = Positions::Double(world(steps, source.scale, source.offset))
                }
            }
        }
        match &mut self.sink {
            Sink::Las(las) => las.write_with(&batch, &values)?,
            Sink::Ply(ply) => ply.write_with(&batch, &values)?,
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
