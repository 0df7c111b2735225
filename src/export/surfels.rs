//! The surfels of a map as discs, for programs that show point clouds.

use std::path::Path;

use pvmap_geometry::grid::GRID_MAX;
use pvmap_geometry::normal::Normal;
use pvmap_geometry::{Frame, PointBatch, Positions};
use pvmap_scan::{ColorRange, FieldKind, PlyColumns, PlyExtras, PlyWriter, ScalarField};
use pvmap_store::{AtomicFile, ClosedFile, Mapped, Watch};
use pvmap_vmap::{MapView, Surfel};

use super::begin::{Made, PLY_COMMENT, begin_file};
use crate::Error;

/// Surfels written at a time.
const BATCH_SURFELS: u32 = 1 << 14;

/// Writes the surfels of a map as a PLY of discs in scan units: x y z, nx ny nz, red green blue if
/// any has a colour, radius, n_points, level, bin and surfel. A file that no export made is
/// replaced only by `overwrite`.
///
/// # Errors
/// Where the map is damaged, the file cannot be written or the run is asked to stop.
pub fn export_surfels(
    map: &Path,
    output: &Path,
    overwrite: bool,
    watch: &dyn Watch,
) -> Result<(), Error> {
    Ok(write_surfels(map, begin_file(output, Made::Ply, overwrite)?, watch)?.publish(false)?)
}

/// Does what [`export_surfels`] does in a file that was begun and gets its name later.
///
/// # Errors
/// Those of [`export_surfels`].
pub fn write_surfels(
    map: &Path,
    output: AtomicFile,
    watch: &dyn Watch,
) -> Result<ClosedFile, Error> {
    let bytes = Mapped::open(map)?;
    let damaged = |e| Error::artifact(map, e);
    let view = MapView::open(&bytes).map_err(damaged)?;
    let n_surfels = view.summary().n_surfels;
    watch.stage("surfels", Some(n_surfels.into()), "rows");
    let mut has_color = false;
    for id in 0..n_surfels {
        has_color = has_color || view.surfel(id).map_err(damaged)?.color.is_some();
    }
    let columns = PlyColumns {
        double: true,
        normal: true,
        color: has_color.then_some(ColorRange::Eight),
        ..PlyColumns::default()
    };
    let comments = vec![PLY_COMMENT.to_owned()];
    let extras = PlyExtras { comments, fields: fields().to_vec() };
    let mut ply = PlyWriter::create_in(output, n_surfels.into(), columns, &extras)?;
    for first in (0..n_surfels).step_by(BATCH_SURFELS as usize) {
        watch.check()?;
        let ids = first..n_surfels.min(first.saturating_add(BATCH_SURFELS));
        let surfels = ids.clone().map(|id| view.surfel(id)).collect::<Result<Vec<_>, _>>();
        let surfels = surfels.map_err(damaged)?;
        let (batch, values) = discs(&view.frame().frame, ids.start, &surfels);
        ply.write_with(&batch, &values)?;
        watch.advance(surfels.len() as u64);
    }
    Ok(ply.close()?)
}

/// What a disc has beside place, normal and colour.
fn fields() -> [ScalarField; 5] {
    let field = |name: &str, description: &str, kind| ScalarField {
        name: name.to_owned(),
        description: description.to_owned(),
        kind,
    };
    [
        field("radius", "of the disc, in scan units", FieldKind::F32),
        field("n_points", "points that the surfel stands for", FieldKind::U32),
        field("level", "of its cell", FieldKind::U8),
        field("bin", "of its normal, -1 in a plain tree", FieldKind::I8),
        field("surfel", "its id in the map", FieldKind::U32),
    ]
}

/// Gives surfels as points, and the values of their fields.
fn discs(frame: &Frame, first: u32, surfels: &[Surfel]) -> (PointBatch, Vec<Vec<f64>>) {
    let ids = (first..).take(surfels.len());
    let values = |of: fn(&Surfel) -> f64| surfels.iter().map(of).collect::<Vec<f64>>();
    let unit = frame.unit();
    let radius = |s: &Surfel| (s.radius2 as f64).sqrt() * unit;
    let batch = PointBatch {
        source: 0,
        records: ids.clone().map(u64::from).collect(),
        positions: Positions::Double(
            surfels.iter().map(|s| frame.world_of(s.centroid.map(|v| v.min(GRID_MAX)))).collect(),
        ),
        color: Some(surfels.iter().map(|s| s.color.map_or([0; 3], |c| c.map(srgb))).collect()),
        intensity: None,
        classification: None,
        gps_time: None,
        normal: Some(surfels.iter().map(|s| direction(s.normal)).collect()),
    };
    let values = vec![
        surfels.iter().map(radius).collect(),
        values(|s| s.n_points as f64),
        values(|s| f64::from(s.level)),
        values(|s| f64::from(s.bin)),
        ids.map(f64::from).collect(),
    ];
    (batch, values)
}

/// Gives a normal of length 1, or zero.
fn direction(normal: Normal) -> [f32; 3] {
    let n = normal.map(f32::from);
    let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
    if length > 0.0 { n.map(|v| v / length) } else { n }
}

/// Turns linear light of full scale 65535 into sRGB of full scale 255. Source: IEC 61966-2-1.
fn srgb(light: u16) -> u16 {
    let c = f64::from(light) / 65535.0;
    let v = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    (255.0 * v).round() as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_becomes_the_colour_it_was() {
        assert_eq!([0, 65535].map(srgb), [0, 255]);
        // Half of full scale in sRGB is a fifth of the light.
        assert_eq!(srgb((0.2158605 * 65535.0) as u16), 128);
    }
}
