//! Descriptors of extra bytes: what stands behind the fields of a point format, in which order.

use super::records::{DESCRIPTOR_BYTES, kind_bytes};
use super::vlr::VlrName;
use crate::error::escaped;

/// Bits of a descriptor's options that say it has a scale and an offset.
pub(crate) const HAS_SCALE: u8 = 8;
pub(crate) const HAS_OFFSET: u8 = 16;

/// What a file says of the bytes behind the fields of its records.
#[derive(Debug, Default)]
pub(crate) struct Described {
    /// Descriptors of 192 bytes, those of all records that have some.
    pub(crate) descriptors: Vec<u8>,
    /// What the first of those records is called.
    pub(crate) name: Option<VlrName>,
}

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
    let taken = names(was);
    let mut free = (1u32..).map(|i| format!("unnamed_{i}")).filter(|name| !taken.contains(name));
    while n < n_extra {
        let bytes = run_bytes(n_extra - n);
        let mut descriptor = [0; DESCRIPTOR_BYTES];
        descriptor[3] = bytes;
        let name = free.next().unwrap_or_default();
        descriptor[4..4 + name.len()].copy_from_slice(name.as_bytes());
        all.extend_from_slice(&descriptor);
        n += usize::from(bytes);
    }
    all
}

/// Gives how many of `n_left` > 0 bytes one descriptor without a type is for. Their number stands
/// where others have options, and laspy takes its bits for those, too.
fn run_bytes(n_left: usize) -> u8 {
    let most = u8::try_from(n_left).unwrap_or(u8::MAX);
    let is_plain = |n: &u8| n & (HAS_SCALE | HAS_OFFSET) == 0;
    (1..=most).rev().find(is_plain).unwrap_or(1)
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
            (248, vec!["echo", "five", "three", "unnamed_1", "unnamed_2"], 0),
            // 8 is the bit of a scale.
            (18, vec!["echo", "five", "three", "unnamed_1", "unnamed_2"], 0),
        ] {
            let mut warnings = Vec::new();
            let all = descriptors(&was, n_extra, &mut warnings);
            assert_eq!(names(&all), expected);
            assert_eq!(warnings.len(), n_warnings);
            let bytes = all.chunks_exact(DESCRIPTOR_BYTES).map(|d| described_bytes(d).unwrap());
            assert_eq!(bytes.sum::<usize>(), n_extra);
        }
        assert!(descriptors(&[], 0, &mut Vec::new()).is_empty());
        for n_extra in 1..700 {
            let all = descriptors(&of(0, 1, "unnamed_2"), n_extra, &mut Vec::new());
            let mut found = names(&all);
            let runs = all.chunks_exact(DESCRIPTOR_BYTES).map(|d| usize::from(d[3]));
            assert!(runs.clone().all(|n| n > 0 && n & 0x18 == 0), "{n_extra}");
            assert_eq!(runs.sum::<usize>(), n_extra);
            found.sort();
            found.dedup();
            assert_eq!(found.len(), all.len() / DESCRIPTOR_BYTES, "{n_extra}: names of their own");
        }
        let mut warnings = Vec::new();
        assert_eq!(names(&descriptors(&of(99, 0, "odd"), 3, &mut warnings)), ["unnamed_1"]);
        assert_eq!(warnings.len(), 1);
    }
}
