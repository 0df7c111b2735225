//! Morton codes: 21 bits an axis interleaved into a `u64`, x in the lowest bit.
//!
//! The code of a grid point is that of its coordinates without their lowest bit ([D-1]), so the
//! cell at level L holds exactly the codes that share their upper 3·L bits of 63.

use crate::grid::GridPoint;

/// The deepest level of a cell: one Morton code each.
pub const MAX_LEVEL: u8 = 21;

/// Interleaves a grid point's coordinates (without their lowest bit) into its Morton code.
#[inline(always)]
pub fn encode(g: GridPoint) -> u64 {
    spread(g[0] >> 1) | spread(g[1] >> 1) << 1 | spread(g[2] >> 1) << 2
}

/// Gives the lowest corner, in grid steps, of the cell of one Morton code.
#[inline]
pub fn decode(code: u64) -> GridPoint {
    [gather(code) << 1, gather(code >> 1) << 1, gather(code >> 2) << 1]
}

/// Gives the half-open range of Morton codes under the cell of `level` that holds `code`.
#[inline]
pub fn cell_range(code: u64, level: u8) -> std::ops::Range<u64> {
    let shift = 3 * u32::from(MAX_LEVEL - level);
    let first = code >> shift << shift;
    first..first + (1u64 << shift)
}

/// Gives the octant (0…7, x lowest) that the cell of `level` ≥ 1 holding `code` is of its parent.
#[inline(always)]
pub fn octant(code: u64, level: u8) -> u8 {
    (code >> (3 * u32::from(MAX_LEVEL - level)) & 7) as u8
}

/// Spreads the low 21 bits of `v` so that two zero bits follow each.
#[inline(always)]
fn spread(v: u32) -> u64 {
    let mut x = u64::from(v) & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// Undoes [`spread`].
#[inline(always)]
fn gather(v: u64) -> u32 {
    let mut x = v & 0x1249_2492_4924_9249;
    x = (x | x >> 2) & 0x10c3_0c30_c30c_30c3;
    x = (x | x >> 4) & 0x100f_00f0_0f00_f00f;
    x = (x | x >> 8) & 0x001f_0000_ff00_00ff;
    x = (x | x >> 16) & 0x001f_0000_0000_ffff;
    ((x | x >> 32) & 0x1f_ffff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn decode_undoes_encode(g in prop::array::uniform3(0u32..1 << 22)) {
            prop_assert_eq!(decode(encode(g)), g.map(|v| v & !1));
        }

        #[test]
        fn a_cell_range_holds_exactly_its_cell(
            a in prop::array::uniform3(0u32..1 << 22),
            b in prop::array::uniform3(0u32..1 << 22),
            level in 0u8..=21,
        ) {
            let same_cell = (0..3).all(|i| a[i] >> (22 - level) == b[i] >> (22 - level));
            prop_assert_eq!(cell_range(encode(a), level).contains(&encode(b)), same_cell);
        }
    }

    #[test]
    fn x_is_the_lowest_bit() {
        assert_eq!(encode([2, 0, 0]), 1);
        assert_eq!(encode([0, 2, 0]), 2);
        assert_eq!(encode([0, 0, 2]), 4);
        assert_eq!(encode([(1 << 22) - 1; 3]), (1 << 63) - 1);
        assert_eq!(octant(encode([1 << 21, 0, 1 << 21]), 1), 5);
    }
}
