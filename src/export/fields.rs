//! What a map says of a point, by the surfel it belongs to.

use std::sync::Arc;

use pvmap_geometry::PointBatch;
use pvmap_geometry::normal::Normal;
use pvmap_query::{Located, Map, Place, QueryError, Snap};
use pvmap_scan::{FieldKind, ScalarField};
use pvmap_store::Watch;
use pvmap_vmap::MapSummary;
use pvmap_vmap::schema::{ColumnType, Schema};

use super::light::{LitPoints, PointLight};
use super::output::Kind;
use super::seen::{Bits, lit_by, seen_from};
use crate::Error;

/// A number, or a few, that an export gives every point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PointField {
    /// 1 where the point's surfel sees that of a place, or is it; else 0.
    VisibleFrom(Place),
    /// 1 where light from a place in world units reaches the point's surfel; else 0. The place is
    /// on a surface if one is near, else in the air.
    Lit([f64; 3]),
    /// How many other surfels the point's surfel sees.
    SeesCount,
    /// The point's surfel.
    Leaf,
    /// The level of its cell.
    Level,
    /// The bin of its normal, -1 in a plain tree.
    Bin,
    /// The normal by which the map was made, three numbers; 0 without one.
    Normal,
    /// Which record of its source it is, from 0.
    Record,
    /// Which source it is of, from 0.
    Source,
    /// The light that leaves the point, by a light file: red, green and blue, or one number in grey
    /// light. The colour of the point becomes it, too.
    Radiosity,
    /// The light that arrives at the point, likewise.
    Irradiance,
    /// The share of open sky above the point's surfel, by a light file.
    SkyView,
}

impl PointField {
    /// Says whether it needs a light file.
    pub(super) fn is_of_light(&self) -> bool {
        self.needs_places() || *self == PointField::SkyView
    }

    /// Says whether it has light of a point's own place.
    pub(super) fn needs_places(&self) -> bool {
        matches!(self, PointField::Radiosity | PointField::Irradiance)
    }

    /// Says whether it needs the normals of points.
    pub(super) fn needs_normals(&self) -> bool {
        self.needs_places() || *self == PointField::Normal
    }

    /// Gives the word that asks for it, of one of light.
    pub(super) fn word(&self) -> String {
        self.title().0.replace('_', "-")
    }

    /// Names it, and says what it is.
    fn title(&self) -> (&'static str, String) {
        let (name, words) = match self {
            PointField::VisibleFrom(Place { position: [x, y, z], normal }) => {
                let side = normal.map_or(String::new(), |[x, y, z]| format!(",{x},{y},{z}"));
                return ("visible_from", format!("1 if seen from {x},{y},{z}{side}"));
            }
            PointField::Lit([x, y, z]) => return ("lit", format!("1 if lit from {x},{y},{z}")),
            PointField::SeesCount => ("sees_count", "other surfels its surfel sees"),
            PointField::Leaf => ("leaf", "its surfel"),
            PointField::Level => ("level", "level of its surfel's cell"),
            PointField::Bin => ("bin", "bin of its surfel's normal"),
            PointField::Normal => ("normal", "normal in the map"),
            PointField::Record => ("record", "its number in its scan"),
            PointField::Source => ("source", "number of its scan"),
            PointField::Radiosity => ("radiosity", "light leaving, flux an area"),
            PointField::Irradiance => ("irradiance", "light arriving, flux an area"),
            PointField::SkyView => ("sky_view", "share of open sky, 0 to 1"),
        };
        (name, words.to_owned())
    }

    fn kind(&self, schema: &Schema) -> FieldKind {
        match self {
            PointField::VisibleFrom(_) | PointField::Lit(_) | PointField::Level => FieldKind::U8,
            PointField::SeesCount | PointField::Leaf | PointField::Source => FieldKind::U32,
            PointField::Bin => FieldKind::I8,
            PointField::Normal
            | PointField::Radiosity
            | PointField::Irradiance
            | PointField::SkyView => FieldKind::F32,
            PointField::Record => match schema.column("record").map(|c| c.kind) {
                // Exact to 2^53, far more than there are.
                Some(ColumnType::U64) => FieldKind::F64,
                _ => FieldKind::U32,
            },
        }
    }

    /// Gives the names of its numbers.
    fn names(&self, schema: &Schema, is_grey: bool) -> Vec<&'static str> {
        match (self, schema.column("normal")) {
            // As scans name theirs, if they have none.
            (PointField::Normal, None) => vec!["nx", "ny", "nz"],
            (PointField::Normal, Some(_)) => vec!["normal_x", "normal_y", "normal_z"],
            (PointField::Radiosity, _) if !is_grey => {
                vec!["radiosity_red", "radiosity_green", "radiosity_blue"]
            }
            (PointField::Irradiance, _) if !is_grey => {
                vec!["irradiance_red", "irradiance_green", "irradiance_blue"]
            }
            _ => vec![self.title().0],
        }
    }

    /// Counts its numbers.
    fn n_numbers(&self, is_grey: bool) -> usize {
        let is_of_three = match self {
            PointField::Normal => true,
            _ => self.needs_places() && !is_grey,
        };
        if is_of_three { 3 } else { 1 }
    }
}

/// Names the numbers of fields: those of the second of a kind end in _2, and so on, and so do those
/// whose names are `taken`, in letters of any case. Grey light is one number.
pub(super) fn columns(
    fields: &[PointField],
    (schema, is_grey): (&Schema, bool),
    taken: &[String],
) -> Vec<ScalarField> {
    let mut columns: Vec<ScalarField> = Vec::new();
    for field in fields {
        let (_, description) = field.title();
        let names = field.names(schema, is_grey);
        let is_free = |name: &String| {
            !taken.iter().any(|t| t.eq_ignore_ascii_case(name))
                && !columns.iter().any(|c| c.name == *name)
        };
        // Of one field all or none; there are fewer names than numbers.
        let ending = |n: u32| if n > 1 { format!("_{n}") } else { String::new() };
        let named = |n| names.iter().map(|name| format!("{name}{}", ending(n))).collect::<Vec<_>>();
        let free = (1..).map(named).find(|names| names.iter().all(is_free));
        for name in free.unwrap_or_default() {
            let (description, kind) = (description.clone(), field.kind(schema));
            columns.push(ScalarField { name, description, kind });
        }
    }
    columns
}

/// Gives the bytes that the values of fields hold in memory, and counting them.
pub(super) fn held_bytes(fields: &[PointField], summary: &MapSummary) -> u64 {
    let n = u64::from(summary.n_surfels);
    let has = |wanted: PointField| u64::from(fields.contains(&wanted));
    let of_place = |f: &&PointField| matches!(f, PointField::VisibleFrom(_) | PointField::Lit(_));
    let n_places = fields.iter().filter(of_place).count() as u64;
    let each = 4 * has(PointField::SeesCount) + has(PointField::Level) + has(PointField::Bin);
    // What is seen is counted by two words a node.
    let counting = 8 * has(PointField::SeesCount) * u64::from(summary.n_nodes);
    let light = PointLight::held_bytes(fields, summary.n_surfels);
    n_places * n.div_ceil(8) + each * n + counting + light
}

/// What answers for the place of a field.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaceAnswer {
    /// The field's name.
    pub name: String,
    /// Its surfel and how far from it the place is, in world units; none in the air.
    pub surfel: Option<(u32, f64)>,
}

/// The values of fields for any surfel. It needs the map no more.
pub(super) struct Values {
    each: Vec<Value>,
    counts: Vec<u32>,
    levels: Vec<u8>,
    bins: Vec<i8>,
    /// What gives points their colours, and the first column of the light that does.
    shown: Option<(Arc<PointLight>, usize)>,
}

/// A field that is ready, or has its place found.
enum Value {
    Bits(Bits),
    Count,
    Leaf,
    Level,
    Bin,
    Normal,
    Record,
    Source,
    Radiosity(Arc<PointLight>),
    Irradiance(Arc<PointLight>),
    SkyView(Arc<PointLight>),
}

/// A field whose place, if it has one, is found.
enum Found {
    Eye(Located),
    Lamp([f64; 3]),
    Other(Value),
}

impl Found {
    fn of(
        field: &PointField,
        light: Option<&Arc<PointLight>>,
        (map, snap): (&Map<'_>, Snap),
    ) -> Result<Found, Error> {
        // It was read for this field.
        let of_light = |value: fn(Arc<PointLight>) -> Value| match light {
            Some(light) => Ok(Found::Other(value(light.clone()))),
            None => Err(PointLight::lacks(field)),
        };
        Ok(match *field {
            PointField::VisibleFrom(place) => Found::Eye(map.locate(&place, snap)?),
            PointField::Lit(position) => {
                match map.surface_at(&Place { position, normal: None }, snap)? {
                    Some(located) => Found::Eye(located),
                    None => Found::Lamp(position),
                }
            }
            PointField::SeesCount => Found::Other(Value::Count),
            PointField::Leaf => Found::Other(Value::Leaf),
            PointField::Level => Found::Other(Value::Level),
            PointField::Bin => Found::Other(Value::Bin),
            PointField::Normal => Found::Other(Value::Normal),
            PointField::Record => Found::Other(Value::Record),
            PointField::Source => Found::Other(Value::Source),
            PointField::Radiosity => of_light(Value::Radiosity)?,
            PointField::Irradiance => of_light(Value::Irradiance)?,
            PointField::SkyView => of_light(Value::SkyView)?,
        })
    }

    /// Says who answers for the place, if there is one.
    fn answer(&self) -> Option<Option<(u32, f64)>> {
        match self {
            Found::Eye(located) => Some(Some((located.surfel, located.distance))),
            Found::Lamp(_) => Some(None),
            Found::Other(_) => None,
        }
    }
}

impl Values {
    /// Finds the places of fields, then asks the map for the values. `columns` are those of the
    /// fields; `light` is there where a field needs it.
    ///
    /// # Errors
    /// Where a place has no surfel, the map is damaged or the run is asked to stop.
    pub(super) fn of(
        (fields, columns): (&[PointField], &[ScalarField]),
        light: Option<Arc<PointLight>>,
        (map, snap): (&Map<'_>, Snap),
        watch: &dyn Watch,
    ) -> Result<(Values, Vec<PlaceAnswer>), Error> {
        let found = fields.iter().map(|f| Found::of(f, light.as_ref(), (map, snap)));
        let found: Vec<Found> = found.collect::<Result<_, _>>()?;
        let mut answers = Vec::new();
        let mut columns = columns.iter();
        let is_grey = light.as_ref().is_some_and(|light| light.is_grey());
        for (field, found) in fields.iter().zip(&found) {
            let column = columns.next();
            columns.by_ref().take(field.n_numbers(is_grey) - 1).for_each(drop);
            if let (Some(column), Some(surfel)) = (column, found.answer()) {
                answers.push(PlaceAnswer { name: column.name.clone(), surfel });
            }
        }
        let has = |wanted: PointField| fields.contains(&wanted);
        let mut each = Vec::new();
        for found in found {
            each.push(match found {
                Found::Eye(located) => Value::Bits(seen_from(map, &located, watch)?),
                Found::Lamp(position) => Value::Bits(lit_by(map, position, watch)?),
                Found::Other(value) => value,
            });
        }
        let counts =
            if has(PointField::SeesCount) { crate::sees_counts(map, watch)? } else { Vec::new() };
        let view = map.view();
        let rows = |wanted| if has(wanted) { 0..view.summary().n_surfels } else { 0..0 };
        let levels = rows(PointField::Level).map(|s| Ok(view.surfel(s)?.level));
        let bins = rows(PointField::Bin).map(|s| Ok(view.surfel(s)?.bin));
        let levels = levels.collect::<Result<_, QueryError>>()?;
        let bins = bins.collect::<Result<_, QueryError>>()?;
        let shown_at = fields.iter().position(|f| *f == PointField::Radiosity);
        let n_before = |at: usize| fields[..at].iter().map(|f| f.n_numbers(is_grey)).sum();
        let shown = light.zip(shown_at.map(n_before));
        Ok((Values { each, counts, levels, bins, shown }, answers))
    }

    /// Gives the values of points, a column a number, by their surfels and normals.
    pub(super) fn columns(
        &self,
        batch: &PointBatch,
        surfels: &[u32],
        normals: &[Normal],
    ) -> Vec<Vec<f64>> {
        // A surfel of no row cannot be: its id is that of a leaf of the tree.
        fn by_row<T: Copy + Into<f64>>(rows: &[T], surfels: &[u32]) -> Vec<f64> {
            let value = |&s: &u32| rows.get(s as usize).copied().map_or(0.0, Into::into);
            surfels.iter().map(value).collect()
        }
        let points = LitPoints { batch, surfels, normals };
        let mut columns = Vec::new();
        for value in &self.each {
            let column = match value {
                Value::Bits(bits) => surfels.iter().map(|&s| f64::from(bits.has(s))).collect(),
                Value::Count => by_row(&self.counts, surfels),
                Value::Leaf => surfels.iter().map(|&s| f64::from(s)).collect(),
                Value::Level => by_row(&self.levels, surfels),
                Value::Bin => by_row(&self.bins, surfels),
                Value::Record => batch.records.iter().map(|&r| r as f64).collect(),
                Value::Source => vec![f64::from(batch.source); batch.len()],
                Value::Normal => {
                    let along = |axis: usize| normals.iter().map(|n| unit(n)[axis]).collect();
                    columns.extend([0, 1, 2].map(along));
                    continue;
                }
                Value::Radiosity(light) => {
                    columns.extend(light.columns(&light.radiosity(&points)));
                    continue;
                }
                Value::Irradiance(light) => {
                    columns.extend(light.columns(&light.irradiance(&points)));
                    continue;
                }
                Value::SkyView(light) => by_row(light.sky(), surfels),
            };
            columns.push(column);
        }
        columns
    }

    /// Gives the colours of a file that points have by their columns: those of the light that
    /// leaves them, where there is such a field.
    pub(super) fn colors(&self, columns: &[Vec<f64>], kind: Kind) -> Option<Vec<[u16; 3]>> {
        let (light, at) = self.shown.as_ref()?;
        Some(light.colors(&columns[*at..], kind))
    }
}

/// Gives a normal of length 1, or zero.
pub(super) fn unit(normal: &Normal) -> [f64; 3] {
    let n = normal.map(f64::from);
    let length = n.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 { n.map(|v| v / length) } else { n }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fields_are_fits_the_descriptors_of_a_las() {
        // LAS 1.4, table 24: 32 bytes, the last one zero.
        for field in [
            PointField::SeesCount,
            PointField::Leaf,
            PointField::Level,
            PointField::Bin,
            PointField::Normal,
            PointField::Record,
            PointField::Source,
            PointField::Radiosity,
            PointField::Irradiance,
            PointField::SkyView,
        ] {
            assert!(field.title().1.len() < 32, "{field:?}");
        }
    }

    #[test]
    fn fields_of_one_kind_have_names_of_their_own() {
        let eye = |x, normal| PointField::VisibleFrom(Place { position: [x, 2.0, -0.5], normal });
        let fields = [
            eye(1.0, None),
            PointField::SeesCount,
            eye(3.0, Some([0.0, 0.0, 1.0])),
            PointField::Normal,
            eye(4.0, None),
            PointField::SeesCount,
            PointField::Lit([0.0; 3]),
        ];
        let schema = Schema::new(&[("position", ColumnType::I32x3), ("record", ColumnType::U32)]);
        let found = columns(&fields, (&schema, false), &[]);
        let names: Vec<&str> = found.iter().map(|c| c.name.as_str()).collect();
        let expected = [
            "visible_from",
            "sees_count",
            "visible_from_2",
            "nx",
            "ny",
            "nz",
            "visible_from_3",
            "sees_count_2",
            "lit",
        ];
        assert_eq!(names, expected);
        assert_eq!(found[0].description, "1 if seen from 1,2,-0.5");
        assert_eq!(found[2].description, "1 if seen from 3,2,-0.5,0,0,1");
        let summary = MapSummary { n_nodes: 1100, n_surfels: 800, ..MapSummary::default() };
        // Four places, and the counts with the nodes they are made by.
        assert_eq!(held_bytes(&fields, &summary), 4 * 100 + 3200 + 8800);
        let taken = ["Visible_From", "visible_from_3", "ny"].map(str::to_owned);
        let found = columns(&fields[2..5], (&schema, false), &taken);
        let names: Vec<&str> = found.iter().map(|c| c.name.as_str()).collect();
        let expected = ["visible_from_2", "nx_2", "ny_2", "nz_2", "visible_from_4"];
        assert_eq!(names, expected);
        let with_normals = Schema::new(&[
            ("position", ColumnType::I32x3),
            ("record", ColumnType::U64),
            ("normal", ColumnType::F32x3),
        ]);
        let found = columns(&[PointField::Normal, PointField::Record], (&with_normals, true), &[]);
        assert_eq!(found[0].name, "normal_x");
        assert_eq!(found[3].kind, FieldKind::F64);
    }
}
