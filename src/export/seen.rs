//! What surfels see.

use pvmap_query::{Light, Located, Map, QueryError, Sight};
use pvmap_store::Watch;
use rayon::prelude::*;

use crate::Error;

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
    let n_words = map.view().summary().n_surfels.div_ceil(WORD_SURFELS);
    let mut words = vec![0u64; n_words as usize];
    for surfel in map.visible_from(eye)?.surfels.ids() {
        if let Some(word) = words.get_mut((surfel / WORD_SURFELS) as usize) {
            *word |= 1 << (surfel % WORD_SURFELS);
        }
    }
    Ok(Bits(words))
}

/// Finds what a light reaches, surfel by surfel, on all threads.
pub(super) fn lit_by(map: &Map<'_>, light: &Light<'_>, watch: &dyn Watch) -> Result<Bits, Error> {
    let n_surfels = map.view().summary().n_surfels;
    watch.stage("light", Some(n_surfels.into()), "surfels");
    let is_lit = |surfel: u32| -> Result<bool, QueryError> {
        let node = map.view().surfel(surfel)?.node;
        let place = Located { surfel, node, distance: 0.0 };
        Ok(map.shadow(&place, light)?.reaches == Sight::All)
    };
    let word = |first: u32| -> Result<u64, Error> {
        watch.check()?;
        let mut word = 0;
        for surfel in first..n_surfels.min(first + WORD_SURFELS) {
            word |= u64::from(is_lit(surfel)?) << (surfel - first);
        }
        watch.advance(u64::from(n_surfels.min(first + WORD_SURFELS) - first));
        Ok(word)
    };
    let firsts = (0..n_surfels.div_ceil(WORD_SURFELS)).into_par_iter().map(|i| i * WORD_SURFELS);
    Ok(Bits(firsts.map(word).collect::<Result<_, _>>()?))
}
