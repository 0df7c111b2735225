//! The order of the records of one bucket, found without moving them.

/// Points a drawer of the first step.
const DRAWER_POINTS: usize = 4;

/// Finds the order of points by (Morton code, ordinal): `order` gets their indices.
///
/// What is sorted is one u64 a point, the upper bits of its code above its index: half the bytes
/// of (code, index), and the comparison of whole numbers needs no branch. They are dealt into
/// drawers by their uppermost bits first, so that what is left to sort are short runs. Points
/// whose codes differ below these bits, a handful unless they coincide, are sorted again by what
/// they are.
pub(crate) fn order(codes: &[u64], ordinal: impl Fn(usize) -> u64, order: &mut Vec<u64>) {
    let index_bits = usize::BITS - codes.len().leading_zeros();
    let least = codes.iter().copied().min().unwrap_or(0);
    let span = codes.iter().copied().max().unwrap_or(0) - least;
    let span_bits = 64 - span.leading_zeros();
    let dropped_bits = (span_bits + index_bits).saturating_sub(64);
    let drawer_bits = (codes.len() / DRAWER_POINTS + 1).ilog2().min(span_bits);
    let drawer = |code: u64| ((code - least) >> (span_bits - drawer_bits)) as usize;
    let mut ends = vec![0u32; (1 << drawer_bits) + 1];
    codes.iter().for_each(|&code| ends[drawer(code) + 1] += 1);
    for i in 1..ends.len() {
        ends[i] += ends[i - 1];
    }
    order.resize(codes.len(), 0);
    for (i, &code) in codes.iter().enumerate() {
        let end = &mut ends[drawer(code)];
        order[*end as usize] = (code - least) >> dropped_bits << index_bits | i as u64;
        *end += 1;
    }
    let mut start = 0;
    for &end in &ends[..1 << drawer_bits] {
        order[start..end as usize].sort_unstable();
        start = end as usize;
    }
    let index_mask = (1 << index_bits) - 1;
    for alike in order.chunk_by_mut(|a, b| a >> index_bits == b >> index_bits) {
        for entry in &mut *alike {
            *entry &= index_mask;
        }
        if alike.len() > 1 {
            alike.sort_unstable_by_key(|&i| (codes[i as usize], ordinal(i as usize)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn d3_the_order_is_that_of_codes_then_ordinals(
            codes in prop::collection::vec(
                prop_oneof![0u64..1 << 63, 0u64..8, Just(1 << 62), (1u64 << 62)..(1 << 62) + 99],
                0..300,
            ),
            salt in any::<u64>(),
        ) {
            let ordinal = |i: usize| (i as u64 + 1).wrapping_mul(salt | 1);
            let mut found = vec![7];
            order(&codes, ordinal, &mut found);
            let mut expected: Vec<u64> = (0..codes.len() as u64).collect();
            expected.sort_by_key(|&i| (codes[i as usize], ordinal(i as usize)));
            prop_assert_eq!(found, expected);
        }
    }
}
