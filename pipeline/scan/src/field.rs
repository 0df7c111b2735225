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
}

impl FieldKind {
    /// Gives the bytes of a value.
    pub(crate) fn n_bytes(self) -> usize {
        match self {
            FieldKind::U8 | FieldKind::I8 => 1,
            FieldKind::U32 | FieldKind::F32 => 4,
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
    /// What it says, in ASCII on one line; LAS keeps the first 31 characters.
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

/// Says what is wrong with the values of fields for a batch of `n_points`, if anything.
pub(crate) fn mismatch(
    fields: &[ScalarField],
    values: &[Vec<f64>],
    n_points: usize,
) -> Option<String> {
    let fits = values.len() == fields.len() && values.iter().all(|v| v.len() == n_points);
    (!fits).then(|| format!("values of {} fields do not fit {n_points} points", values.len()))
}
