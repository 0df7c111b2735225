//! What surfels see.

use std::ops::Range;

use pvmap_query::{Located, Map, QueryError};
use pvmap_store::Watch;

/// A set of surfels, a bit each.
pub(super) struct Bits(Vec<u64>);

impl Bits {
    fn none(n_surfels: u32) -> Bits {
        Bits(vec![0; n_surfels.div_ceil(64) as usize])
    }

    fn add(&mut self, surfels: Range<u32>) {
        for surfel in surfels {
            if let Some(word) = self.0.get_mut(surfel as usize / 64) {
                *word |= 1 << (surfel % 64);
            }
        }
    }

    /// Says whether it has a surfel.
    pub(super) fn has(&self, surfel: u32) -> bool {
        self.0.get(surfel as usize / 64).is_some_and(|word| word >> (surfel % 64) & 1 == 1)
    }
}

/// What is asked.
pub(super) struct Wanted<'a> {
    /// Places whose visible surfels are asked for.
    pub(super) eyes: &'a [Located],
    /// Whether it is asked how many others each surfel sees.
    pub(super) counts: bool,
}

/// What was found.
pub(super) struct Found {
    /// For each eye what it sees, its own surfel included. [V-6]
    pub(super) by_eye: Vec<Bits>,
    /// How many others each surfel sees; empty where that was not asked.
    pub(super) counts: Vec<u32>,
}

/// Asks the map.
pub(super) fn look(
    map: &Map<'_>,
    wanted: &Wanted<'_>,
    watch: &dyn Watch,
) -> Result<Found, QueryError> {
    let n_surfels = map.view().summary().n_surfels;
    if !wanted.eyes.is_empty() {
        watch.stage("links", None, "links");
    }
    let of_eye = |eye: &Located| {
        let mut bits = Bits::none(n_surfels);
        let seen = map.visible_from(eye)?.surfels;
        seen.ranges().iter().for_each(|range| bits.add(range.clone()));
        Ok::<_, QueryError>(bits)
    };
    Ok(Found {
        by_eye: wanted.eyes.iter().map(of_eye).collect::<Result<_, _>>()?,
        counts: if wanted.counts { crate::sees_counts(map, watch)? } else { Vec::new() },
    })
}
