//! What surfels see.

use pvmap_query::{Located, Map, QueryError, SurfelSet};
use pvmap_store::Watch;

/// Surfels of a word of bits.
const WORD_SURFELS: u32 = u64::BITS;

/// A set of surfels, a bit each.
pub(super) struct Bits(Vec<u64>);

impl Bits {
    /// Says whether it has a surfel.
    pub(super) fn has(&self, surfel: u32) -> bool {
        let word = self.0.get((surfel / WORD_SURFELS) as usize);
        word.is_some_and(|word| word >> (surfel % WORD_SURFELS) & 1 == 1)
    }
}

/// Finds what an eye sees, its own surfel included. [V-6]
pub(super) fn seen_from(
    map: &Map<'_>,
    eye: &Located,
    watch: &dyn Watch,
) -> Result<Bits, QueryError> {
    watch.stage("links", None, "links");
    Ok(bits_of(map, &map.visible_from(eye)?.surfels))
}

/// Finds what a lamp in the air reaches.
pub(super) fn lit_by(map: &Map<'_>, lamp: [f64; 3], watch: &dyn Watch) -> Result<Bits, QueryError> {
    Ok(bits_of(map, &crate::visible_from_air(map, lamp, watch)?.surfels))
}

fn bits_of(map: &Map<'_>, set: &SurfelSet) -> Bits {
    let n_words = map.view().summary().n_surfels.div_ceil(WORD_SURFELS);
    let mut words = vec![0u64; n_words as usize];
    for surfel in set.ids() {
        if let Some(word) = words.get_mut((surfel / WORD_SURFELS) as usize) {
            *word |= 1 << (surfel % WORD_SURFELS);
        }
    }
    Bits(words)
}
