//! What a map says of a point, by the surfel it belongs to.

use pvmap_query::{Located, Map, Place, QueryError, Snap};
use pvmap_scan::{FieldKind, ScalarField};
use pvmap_store::Watch;
use pvmap_vmap::FormatError;

use super::seen::{Bits, Wanted, look};

/// A number that a map gives every point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PointField {
    /// 1 where the point's surfel sees that of a place in world units, or is it; else 0.
    VisibleFrom([f64; 3]),
    /// How many other surfels the point's surfel sees.
    SeesCount,
    /// The point's surfel.
    Leaf,
    /// The level of its cell.
    Level,
    /// The bin of its normal, -1 in a plain tree.
    Bin,
}

impl PointField {
    /// Finds the surfel of its place, if it has one.
    pub(super) fn locate(&self, map: &Map<'_>, snap: Snap) -> Result<Option<Located>, QueryError> {
        match *self {
            PointField::VisibleFrom(position) => {
                map.locate(&Place { position, normal: None }, snap).map(Some)
            }
            _ => Ok(None),
        }
    }

    fn name(&self) -> &'static str {
        match self {
            PointField::VisibleFrom(_) => "visible_from",
            PointField::SeesCount => "sees_count",
            PointField::Leaf => "leaf",
            PointField::Level => "level",
            PointField::Bin => "bin",
        }
    }

    fn description(&self) -> String {
        match self {
            PointField::VisibleFrom([x, y, z]) => format!("1 if seen from {x},{y},{z}"),
            PointField::SeesCount => "other surfels its surfel sees".to_owned(),
            PointField::Leaf => "its surfel".to_owned(),
            PointField::Level => "level of its surfel's cell".to_owned(),
            PointField::Bin => "bin of its surfel's normal".to_owned(),
        }
    }

    fn kind(&self) -> FieldKind {
        match self {
            PointField::VisibleFrom(_) | PointField::Level => FieldKind::U8,
            PointField::SeesCount | PointField::Leaf => FieldKind::U32,
            PointField::Bin => FieldKind::I8,
        }
    }
}

/// Names the fields: the second of a kind ends in _2, and so on.
pub(super) fn columns(fields: &[PointField]) -> Vec<ScalarField> {
    let named = |(i, field): (usize, &PointField)| {
        let n_before = fields[..i].iter().filter(|f| f.name() == field.name()).count();
        let name = match n_before {
            0 => field.name().to_owned(),
            n => format!("{}_{}", field.name(), n + 1),
        };
        ScalarField { name, description: field.description(), kind: field.kind() }
    };
    fields.iter().enumerate().map(named).collect()
}

/// Gives the bytes that the values of fields hold in memory.
pub(super) fn held_bytes(fields: &[PointField], n_surfels: u32) -> u64 {
    let n = u64::from(n_surfels);
    let of = |field: &PointField| match field {
        PointField::VisibleFrom(_) => n / 8,
        PointField::SeesCount => 4 * n,
        _ => 0,
    };
    fields.iter().map(of).sum()
}

/// The values of fields for any surfel.
pub(super) struct Values<'m, 'a> {
    map: &'m Map<'a>,
    each: Vec<Value>,
}

enum Value {
    Seen(Bits),
    Count(Vec<u32>),
    Leaf,
    Level,
    Bin,
}

impl<'m, 'a> Values<'m, 'a> {
    /// Prepares the values of fields; `located` has the surfels of their places.
    pub(super) fn of(
        fields: &[PointField],
        located: &[Option<Located>],
        map: &'m Map<'a>,
        watch: &dyn Watch,
    ) -> Result<Values<'m, 'a>, QueryError> {
        let eyes: Vec<Located> = located.iter().flatten().copied().collect();
        let counts = fields.iter().filter(|f| matches!(f, PointField::SeesCount)).count();
        let seen = look(map, &Wanted { eyes: &eyes, counts: counts > 0 }, watch)?;
        let (mut eyes, counts) = (seen.by_eye.into_iter(), seen.counts);
        let value = |field: &PointField| match field {
            PointField::VisibleFrom(_) => eyes.next().map_or(Value::Leaf, Value::Seen),
            PointField::SeesCount => Value::Count(counts.clone()),
            PointField::Leaf => Value::Leaf,
            PointField::Level => Value::Level,
            PointField::Bin => Value::Bin,
        };
        Ok(Values { map, each: fields.iter().map(value).collect() })
    }

    /// Gives the values of points, a column a field, by their surfels.
    ///
    /// # Errors
    /// Where a surfel cannot be read.
    pub(super) fn columns(&self, surfels: &[u32]) -> Result<Vec<Vec<f64>>, FormatError> {
        let view = self.map.view();
        let column = |value: &Value| -> Result<Vec<f64>, FormatError> {
            let each = surfels.iter();
            match value {
                Value::Seen(bits) => Ok(each.map(|&s| f64::from(bits.has(s))).collect()),
                // A surfel of no row cannot be: its id is that of a leaf of the tree.
                Value::Count(counts) => Ok(each
                    .map(|&s| counts.get(s as usize).copied().map_or(0.0, f64::from))
                    .collect()),
                Value::Leaf => Ok(each.map(|&s| f64::from(s)).collect()),
                Value::Level => each.map(|&s| Ok(f64::from(view.surfel(s)?.level))).collect(),
                Value::Bin => each.map(|&s| Ok(f64::from(view.surfel(s)?.bin))).collect(),
            }
        };
        self.each.iter().map(column).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_of_one_kind_have_names_of_their_own() {
        let eye = |x| PointField::VisibleFrom([x, 2.0, -0.5]);
        let fields = [eye(1.0), PointField::SeesCount, eye(3.0), eye(4.0), PointField::SeesCount];
        let columns = columns(&fields);
        let names: Vec<&str> = columns.iter().map(|c| c.name.as_str()).collect();
        let expected =
            ["visible_from", "sees_count", "visible_from_2", "visible_from_3", "sees_count_2"];
        assert_eq!(names, expected);
        assert_eq!(columns[0].description, "1 if seen from 1,2,-0.5");
        assert_eq!(held_bytes(&fields, 800), 3 * 100 + 2 * 3200);
    }
}
