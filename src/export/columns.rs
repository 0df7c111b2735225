//! What the columns of the scans become in an output, and what is said where that is less.

use std::path::Path;

use pvmap_geometry::Intensity;
use pvmap_octree::OctreeError;
use pvmap_octree::by_source::Seen;
use pvmap_scan::{ColorRange, Crs, FieldKind, ScalarField};
use pvmap_store::Watch;
use pvmap_vmap::frame::CrsKind;
use pvmap_vmap::schema::{COLUMN_NAMES, ColumnType};
use pvmap_vmap::{FormatError, OctreeView, Source};

use super::fields::PointField;
use super::output::Kind;
use crate::Error;

/// A GPS time beyond this is none of a week; less than that it is none since 1980.
const WEEK_SECONDS: f64 = 604_800.0;
/// The largest class beside GeoTIFF keys.
const MAX_LEGACY_CLASS: u8 = 31;
/// How a source tells its GPS times: seconds of a week, or since 1980.
const OF_WEEK: u32 = 1;
const SINCE_1980: u32 = 2;

/// What becomes of the colours of a source.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Brightness {
    /// They stay what they are.
    Same,
    /// 8 bits become 16: v repeated is the same share of full scale.
    Repeated,
    /// 16 bits become 8.
    Halved,
}

impl Brightness {
    /// Changes a channel.
    pub(super) fn of(self, channel: u16) -> u16 {
        match self {
            Brightness::Same => channel,
            Brightness::Repeated => channel.saturating_mul(257),
            Brightness::Halved => channel >> 8,
        }
    }
}

/// Says what full brightness is in the output, if there are colours, and what becomes of those of
/// each source.
///
/// A PLY has 8 bits: programs read `ushort` as if it were `uchar`. Colours of 8 bits stay what they
/// are in a LAS where all are of 8 bits and from LAS, which cannot say which they are: it is done
/// as the scans did.
pub(super) fn colors(octree: &OctreeView<'_>, kind: Kind) -> (Option<ColorRange>, Vec<Brightness>) {
    let sources = octree.sources();
    if octree.schema().column("color").is_none() {
        return (None, vec![Brightness::Same; sources.len()]);
    }
    let of_ply = |s: &Source| s.format == 3;
    let mut colored = sources.iter().filter(|s| s.color_depth > 0);
    let stays = colored.all(|s| s.color_depth == 8 && !of_ply(s));
    let brightness = |s: &Source| match (kind, s.color_depth) {
        (Kind::Ply, 16) => Brightness::Halved,
        (Kind::Las | Kind::Laz, 8) if !stays => Brightness::Repeated,
        _ => Brightness::Same,
    };
    let range = if kind == Kind::Ply { ColorRange::Eight } else { ColorRange::Sixteen };
    (Some(range), sources.iter().map(brightness).collect())
}

/// The intensities that become 0 and 65535, where they are no whole numbers of that range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scaling {
    low: f64,
    high: f64,
}

impl Scaling {
    /// Looks whether the intensities of an octree need it in a LAS.
    pub(super) fn of(octree: &OctreeView<'_>, seen: Seen, kind: Kind) -> Option<Scaling> {
        let is_real =
            octree.schema().column("intensity").is_some_and(|c| c.kind == ColumnType::F32);
        let fractions = seen.intensity.filter(|_| is_real && kind != Kind::Ply)?;
        let (least, most) = (f64::from(fractions.least), f64::from(fractions.most));
        let fits = fractions.are_whole && least >= 0.0 && most <= 65535.0;
        // Fractions of 1 stay fractions of full scale.
        let (low, high) = (least.min(0.0), if most <= 1.0 { 1.0 } else { most });
        (!fits).then_some(Scaling { low, high })
    }

    /// The field that keeps what they were.
    pub(super) fn field() -> ScalarField {
        ScalarField {
            name: "intensity_f32".to_owned(),
            description: "intensity as scanned".to_owned(),
            kind: FieldKind::F32,
        }
    }

    /// Scales a column; gives it, and what it was.
    pub(super) fn split(self, intensity: &Intensity) -> (Intensity, Vec<f64>) {
        let was: Vec<f64> = match intensity {
            Intensity::U16(v) => v.iter().map(|&v| f64::from(v)).collect(),
            Intensity::F32(v) => v.iter().map(|&v| f64::from(v)).collect(),
        };
        let share = |v: &f64| (v - self.low) / (self.high - self.low);
        // `as` keeps the ends and turns NaN into 0.
        let scaled = was.iter().map(|v| (share(v) * 65535.0).round() as u16).collect();
        (Intensity::U16(scaled), was)
    }
}

/// Gives the coordinate reference system in the form that the file can have, if it can.
pub(super) fn crs(octree: &OctreeView<'_>, kind: Kind, seen: Seen) -> Result<Option<Crs>, Error> {
    let (form, bytes) = octree.crs().map_err(OctreeError::from)?;
    Ok(match form {
        _ if kind == Kind::Ply => None,
        CrsKind::None => None,
        CrsKind::Wkt => Some(Crs::Wkt(bytes.to_vec())),
        // Their point formats have no room for more classes.
        CrsKind::GeoTiff => Crs::of_geotiff(bytes).filter(|_| seen.class_max <= MAX_LEGACY_CLASS),
    })
}

/// Says whether GPS times are those since 1980: as the scans say, else by their values.
pub(super) fn is_since_1980(octree: &OctreeView<'_>, seen: Seen) -> bool {
    let known = octree.sources().iter().map(|s| s.gps_time).find(|&t| t != 0);
    let range = seen.gps_time;
    known.map_or(range.is_some_and(|(least, most)| least < 0.0 || most > WEEK_SECONDS), |first| {
        first == SINCE_1980
    })
}

/// Tells all that an output keeps less of than the scans have, a line each.
pub(super) fn warn_of_losses(
    octree: &OctreeView<'_>,
    (path, kind): (&Path, Kind),
    seen: Seen,
    fields: &[PointField],
    watch: &dyn Watch,
) -> Result<(), Error> {
    let warn = |what: String| watch.warn(&format!("{}: {what}", path.display()));
    let is_lit = fields.contains(&PointField::Radiosity);
    if !is_lit && colors(octree, kind).1.contains(&Brightness::Halved) {
        warn("colours of 16 bits are cut to 8, as PLY has them; a .las or .laz keeps 16".into());
    }
    if let Some(Scaling { low, high }) = Scaling::of(octree, seen, kind) {
        warn(format!(
            "intensities are no whole numbers up to 65535, as LAS has them: {low} to {high} are \
             scaled to 0 to 65535, and intensity_f32 has what they were; a .ply keeps them"
        ));
    }
    warn_of_crs(octree, kind, seen, &warn)?;
    let times = |wanted: u32| octree.sources().iter().any(|s| s.gps_time == wanted);
    if kind != Kind::Ply && times(OF_WEEK) && times(SINCE_1980) {
        let said = if is_since_1980(octree, seen) { "since 1980" } else { "of a week" };
        warn(format!(
            "some scans tell GPS times in seconds of a week, others since 1980: the file says that \
             all are {said}, as the first does; export those of a kind by themselves"
        ));
    }
    for (i, column) in COLUMN_NAMES.into_iter().enumerate().skip(3) {
        // What a source has is not known of those that were taken in by an older version.
        let lacks = |s: &Source| s.columns != 0 && s.columns >> i & 1 == 0 && s.n_stored > 0;
        let lacking = names(octree, lacks)?;
        let is_kept = octree.schema().column(column).is_some() && !(is_lit && column == "color");
        if is_kept && !lacking.is_empty() {
            let word = column.replace('_', " ");
            warn(format!("no {word} in {}: it is 0 there", lacking.join(", ")));
        }
    }
    if !fields.contains(&PointField::Record) {
        warn_of_gaps(octree, &warn)?;
    }
    Ok(())
}

fn warn_of_crs(
    octree: &OctreeView<'_>,
    kind: Kind,
    seen: Seen,
    warn: &dyn Fn(String),
) -> Result<(), Error> {
    let (form, bytes) = octree.crs().map_err(OctreeError::from)?;
    if form == CrsKind::None || crs(octree, kind, seen)?.is_some() {
        return Ok(());
    }
    let left_out = "the coordinate reference system is left out";
    if kind == Kind::Ply {
        warn(format!("{left_out}: a PLY has no place for it; a .las or .laz keeps it"));
    } else if Crs::of_geotiff(bytes).is_some() {
        warn(format!(
            "{left_out}: it is in GeoTIFF keys, which stand beside classes up to 31 only, and \
             there are some up to {}; give the file its system again in the program that opens it, \
             or write it as WKT into the scans before pvmap ingest",
            seen.class_max
        ));
    } else {
        warn(format!("{left_out}: its GeoTIFF keys are broken; pvmap info names the scan's own"));
    }
    Ok(())
}

/// Names some of the sources.
fn names(octree: &OctreeView<'_>, of: impl Fn(&Source) -> bool) -> Result<Vec<String>, Error> {
    let some = octree.sources().iter().filter(|s| of(s));
    let named: Result<_, FormatError> = some.map(|s| octree.source_name(s)).collect();
    Ok(named.map_err(OctreeError::from)?)
}

/// Tells of records without a row.
fn warn_of_gaps(octree: &OctreeView<'_>, warn: &dyn Fn(String)) -> Result<(), Error> {
    let has_gaps = |s: &Source| s.n_invalid > 0;
    let sources = octree.sources().iter().filter(|s| has_gaps(s));
    let advice = "row n of this file is not record n of the scan; --field record has the numbers";
    for (source, name) in sources.zip(names(octree, has_gaps)?) {
        let n = source.n_invalid;
        warn(format!("{n} records of {name} have no place and are left out: {advice}"));
    }
    let n_missing = octree.summary().n_missing;
    if n_missing > 0 {
        warn(format!("{n_missing} records that the scans' headers declare were cut off: {advice}"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intensities_of_any_range_fill_16_bits() {
        let values = |v: &[f32]| Intensity::F32(v.to_vec());
        let unit = Scaling { low: 0.0, high: 1.0 };
        let (scaled, was) = unit.split(&values(&[0.0, 0.5, 1.0, f32::NAN]));
        assert_eq!(scaled, Intensity::U16(vec![0, 32768, 65535, 0]));
        assert!(was[1] == 0.5 && was[3].is_nan());
        let (scaled, _) = Scaling { low: -30.0, high: 3.0 }.split(&values(&[-30.0, 3.0]));
        assert_eq!(scaled, Intensity::U16(vec![0, 65535]));
    }

    #[test]
    fn white_stays_white() {
        assert_eq!(Brightness::Repeated.of(255), 65535);
        assert_eq!(Brightness::Halved.of(65535), 255);
        assert_eq!(Brightness::Same.of(7), 7);
    }
}
