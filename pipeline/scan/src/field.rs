//! Numbers that a writer adds to each point: computed, not scanned.

/// The type a field is stored as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldKind {
    /// One u8.
    U8,
    /// One i8.
    I8,
    /// One u32.
    U32,
    /// One f32.
    F32,
    /// One f64.
    F64,
}

impl FieldKind {
    /// Gives the bytes of a value.
    pub(crate) fn n_bytes(self) -> usize {
        match self {
            FieldKind::U8 | FieldKind::I8 => 1,
            FieldKind::U32 | FieldKind::F32 => 4,
            FieldKind::F64 => 8,
        }
    }

    /// Appends a value, little-endian. What does not fit becomes the nearest that does.
    #[inline]
    pub(crate) fn put(self, value: f64, out: &mut Vec<u8>) {
        // `as` keeps the ends and turns NaN into 0.
        match self {
            FieldKind::U8 => out.push(value as u8),
            FieldKind::I8 => out.extend_from_slice(&(value as i8).to_le_bytes()),
            FieldKind::U32 => out.extend_from_slice(&(value as u32).to_le_bytes()),
            FieldKind::F32 => out.extend_from_slice(&(value as f32).to_le_bytes()),
            FieldKind::F64 => out.extend_from_slice(&value.to_le_bytes()),
        }
    }
}

/// A number that each point of an output has beside the columns of its batch.
///
/// Its values come as f64, in which those of all kinds are exact.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScalarField {
    /// Its name: letters, digits and underscores; LAS takes 31 of them.
    pub name: String,
    /// What it says, in ASCII on one line. LAS has 31 characters for it: where that is less, it is
    /// cut at a comma or a space there, and stands whole in a record of user id "pvmap".
    pub description: String,
    /// How it is stored.
    pub kind: FieldKind,
}

impl ScalarField {
    /// Says what is wrong with a name, if anything.
    pub(crate) fn problem(&self) -> Option<String> {
        let is_plain = self.name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
        let is_fine = is_plain && (1..=31).contains(&self.name.len());
        let is_line = self.description.bytes().all(|b| b.is_ascii() && !b.is_ascii_control());
        (!is_fine || !is_line).then(|| format!("{:?} is no field that can be written", self.name))
    }
}

/// Gives the bytes that fields take of a record.
pub(crate) fn n_bytes(fields: &[ScalarField]) -> usize {
    fields.iter().map(|f| f.kind.n_bytes()).sum()
}

/// Says what is wrong with the values of fields for a batch of `n_points`, if anything.
pub(crate) fn mismatch(
    fields: &[ScalarField],
    values: &[Vec<f64>],
    n_points: usize,
) -> Option<String> {
    let fits = values.len() == fields.len() && values.iter().all(|v| v.len() == n_points);
    (!fits).then(|| format!("values of {} fields do not fit {n_points} points", values.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_that_do_not_fit_become_the_nearest_that_do() {
        for (kind, value, bytes) in [
            (FieldKind::U8, 300.0, vec![255]),
            (FieldKind::I8, -1.0, vec![255]),
            (FieldKind::I8, -1e9, vec![128]),
            (FieldKind::U32, 4_294_967_295.0, vec![255; 4]),
            (FieldKind::U32, f64::NAN, vec![0; 4]),
            (FieldKind::F32, 0.5, 0.5f32.to_le_bytes().to_vec()),
            (FieldKind::F64, 0.1, 0.1f64.to_le_bytes().to_vec()),
        ] {
            let mut out = Vec::new();
            kind.put(value, &mut out);
            assert_eq!(out, bytes);
            assert_eq!(out.len(), kind.n_bytes());
        }
    }

    #[test]
    fn names_that_would_break_a_header_are_refused() {
        let field = |name: &str, description: &str| ScalarField {
            name: name.to_owned(),
            description: description.to_owned(),
            kind: FieldKind::U8,
        };
        assert_eq!(field("visible_from_2", "1 if seen from -1,2,3").problem(), None);
        let long = "a".repeat(32);
        for (name, description) in
            [("", ""), ("two words", ""), ("a\nb", ""), (&long, ""), ("a", "b\nend_header")]
        {
            assert!(field(name, description).problem().is_some(), "{name:?}");
        }
        let fields = [field("a", "")];
        assert_eq!(mismatch(&fields, &[vec![1.0, 2.0]], 2), None);
        assert!(mismatch(&fields, &[], 2).is_some());
        assert!(mismatch(&fields, &[vec![1.0]], 2).is_some());
    }
}
