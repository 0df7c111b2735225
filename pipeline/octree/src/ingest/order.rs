//! The order of the records of one bucket, found without moving them.

/// Finds the order of points by (Morton code, ordinal): `order` gets their indices.
///
/// What is sorted is one u64 a point, the upper bits of its code above its index: half the bytes
/// of (code, index), and the comparison of whole numbers needs no branch. Points whose codes
/// differ below these bits, a handful unless they coincide, are sorted again by what they are.
pub(crate) fn order(codes: &[u64], ordinal: impl Fn(usize) -> u64, order: &mut Vec<u64>) {
    order.clear();
    let index_bits = usize::BITS - codes.len().leading_zeros();
    let least = codes.iter().copied().min().unwrap_or(0);
    let span = codes.iter().copied().max().unwrap_or(0) - least;
    let dropped_bits = (64 - span.leading_zeros() + index_bits).saturating_sub(64);
    let prefix = |code: u64| (code - least) >> dropped_bits << index_bits;
    order.extend(codes.iter().zip(0u64..).map(|(&code, i)| prefix(code) | i));
    order.sort_unstable();
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
        fn the_order_is_that_of_codes_then_ordinals(
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
