//! What loops over lanes share. A lane loop runs over arrays of fixed length and has no branches,
//! so that the compiler can use what the processor has.

/// What rounds a radius or a length in f32 outward: by sixteen roundings of 2^-24.
pub(crate) const OUTWARD: f32 = 1.0 + 1.0 / (1u32 << 20) as f32;

/// What makes up for the roundings of a comparison of products in f32: for 64 of them.
pub(crate) const WIDER: f32 = 1.0 + 1.0 / (1u32 << 18) as f32;

/// Walks the bits of a mask, lowest first.
pub(crate) fn bits(mut mask: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let k = mask.trailing_zeros() as usize;
        mask &= mask.wrapping_sub(1);
        (k < 64).then_some(k)
    })
}

/// Gives all bits set for true.
#[inline(always)]
pub(crate) fn all_bits(flag: bool) -> u64 {
    if flag { u64::MAX } else { 0 }
}

/// Packs eight lanes of all bits or none into a mask, the first lowest.
#[inline(always)]
pub(crate) fn mask_of(lanes: &[u64; 8]) -> u64 {
    let mut mask = 0;
    for (k, lane) in lanes.iter().enumerate() {
        mask |= lane & (1 << k);
    }
    mask
}

/// Unites sixteen lanes of bits.
#[inline(always)]
pub(crate) fn union_of(lanes: &[u32; 16]) -> u32 {
    // By halves: a chain of sixteen the compiler takes lane by lane.
    let (mut eight, mut four) = ([0; 8], [0; 4]);
    for k in 0..8 {
        eight[k] = lanes[k] | lanes[k + 8];
    }
    for k in 0..4 {
        four[k] = eight[k] | eight[k + 4];
    }
    four[0] | four[1] | four[2] | four[3]
}

#[inline(always)]
pub(crate) fn dot(u: [f64; 3], v: [f64; 3]) -> f64 {
    u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
}

#[inline(always)]
pub(crate) fn dot32(u: [f32; 3], v: [f32; 3]) -> f32 {
    u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
}

#[inline(always)]
pub(crate) fn greater<T: PartialOrd>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

#[inline(always)]
pub(crate) fn less<T: PartialOrd>(a: T, b: T) -> T {
    if a < b { a } else { b }
}
