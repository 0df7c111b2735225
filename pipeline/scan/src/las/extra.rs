//! Descriptors of extra bytes: what stands behind the fields of a point format, in which order.

use super::records::{DESCRIPTOR_BYTES, kind_bytes};
use crate::error::escaped;

/// Gives the bytes of what a descriptor describes; none where its type is unknown.
pub(crate) fn described_bytes(descriptor: &[u8]) -> Option<usize> {
    // Kind 0 is a run of `options` unnamed bytes; 11…30 were pairs and triples of 1…10.
    match descriptor[2] {
        0 => Some(usize::from(descriptor[3])),
        kind @ 1..=10 => Some(kind_bytes(kind)),
        kind @ 11..=30 => Some(kind_bytes((kind - 1) % 10 + 1) * if kind <= 20 { 2 } else { 3 }),
        _ => None,
    }
}

/// Gives the name of what a descriptor describes.
pub(crate) fn name_of(descriptor: &[u8]) -> &[u8] {
    descriptor[4..36].split(|&b| b == 0).next().unwrap_or_default()
}

/// Gives the names of all that descriptors describe.
pub(crate) fn names(descriptors: &[u8]) -> Vec<String> {
    let each = descriptors.chunks_exact(DESCRIPTOR_BYTES).map(name_of);
    each.map(|name| String::from_utf8_lossy(name).into_owned()).collect()
}

/// Makes descriptors of exactly `n_extra` bytes: those there are, as far as they fit, and unnamed
/// bytes behind them, so that what is appended has its place.
pub(crate) fn descriptors(was: &[u8], n_extra: usize, warnings: &mut Vec<String>) -> Vec<u8> {
    let (mut all, mut n) = (Vec::new(), 0);
    for descriptor in was.chunks_exact(DESCRIPTOR_BYTES) {
        match described_bytes(descriptor).filter(|bytes| n + bytes <= n_extra) {
            Some(bytes) => n += bytes,
            None => {
                let name = escaped(name_of(descriptor), 32);
                warnings.push(format!(
                    "extra bytes from \"{name}\" on: the bytes are kept, not what they are said \
                     to be, which does not fit the records"
                ));
                break;
            }
        }
        all.extend_from_slice(descriptor);
    }
    let mut n_unnamed = 0;
    while n < n_extra {
        let bytes = (n_extra - n).min(usize::from(u8::MAX));
        n_unnamed += 1;
        let mut descriptor = [0; DESCRIPTOR_BYTES];
        descriptor[3] = bytes as u8;
        let name = format!("unnamed_{n_unnamed}");
        descriptor[4..4 + name.len()].copy_from_slice(name.as_bytes());
        all.extend_from_slice(&descriptor);
        n += bytes;
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_of_all_extra_bytes_and_no_more() {
        let of = |kind: u8, options: u8, name: &str| {
            let mut d = [0; DESCRIPTOR_BYTES];
            (d[2], d[3]) = (kind, options);
            d[4..4 + name.len()].copy_from_slice(name.as_bytes());
            d
        };
        let was = [of(3, 0, "echo"), of(0, 5, "five"), of(21, 0, "three")].concat();
        for (n_extra, expected, n_warnings) in [
            (10, vec!["echo", "five", "three"], 0),
            (9, vec!["echo", "five", "unnamed_1"], 1),
            (300, vec!["echo", "five", "three", "unnamed_1", "unnamed_2"], 0),
        ] {
            let mut warnings = Vec::new();
            let all = descriptors(&was, n_extra, &mut warnings);
            assert_eq!(names(&all), expected);
            assert_eq!(warnings.len(), n_warnings);
            let bytes = all.chunks_exact(DESCRIPTOR_BYTES).map(|d| described_bytes(d).unwrap());
            assert_eq!(bytes.sum::<usize>(), n_extra);
        }
        assert!(descriptors(&[], 0, &mut Vec::new()).is_empty());
        let mut warnings = Vec::new();
        assert_eq!(names(&descriptors(&of(99, 0, "odd"), 3, &mut warnings)), ["unnamed_1"]);
        assert_eq!(warnings.len(), 1);
    }
}
