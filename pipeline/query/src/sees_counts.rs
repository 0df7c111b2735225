//! How many surfels each surfel sees.

use std::sync::atomic::{AtomicU32, Ordering};

use pvmap_vmap::tree::Nodes;
use rayon::prelude::*;

use crate::error::QueryError;
use crate::map::Map;
use crate::part::far_node;

impl Map<'_> {
    /// Counts for every surfel the others that it sees; place i is surfel i.
    ///
    /// One pass over all links: four bytes of memory a surfel, eight a node. A link (A, B) adds the
    /// number of B's surfels to each of A's, which are a range, and the other way round. What is
    /// noted is only where a range begins and ends; sums over those are the counts. After each of
    /// the [`n_blocks`](pvmap_vmap::Pairs::n_blocks) frames `goes_on` is asked, from
    /// any thread of the current rayon pool, whether to go on.
    ///
    /// # Errors
    /// Where the map is damaged, or `goes_on` said no.
    pub fn sees_counts(&self, goes_on: &(dyn Fn() -> bool + Sync)) -> Result<Vec<u32>, QueryError> {
        let n_surfels = self.view().summary().n_surfels as usize;
        let span = |id| self.view().node(id).map(|node| (node.first_surfel, node.end_surfel));
        let spans: Vec<(u32, u32)> =
            (0..self.view().n_nodes()).into_par_iter().map(span).collect::<Result<_, _>>()?;
        // Modulo 2^32: what a surfel sees is less, so sums come out right.
        let steps: Vec<AtomicU32> = (0..=n_surfels).map(|_| AtomicU32::new(0)).collect();
        let add = |(first, end): (u32, u32), n: u32| {
            steps[first as usize].fetch_add(n, Ordering::Relaxed);
            steps[end as usize].fetch_sub(n, Ordering::Relaxed);
        };
        let list = |a: u32, partners: &[u32]| -> Result<(), QueryError> {
            let near = self.view().node(a)?;
            let from = (near.first_surfel, near.end_surfel);
            let mut n_far = 0u32;
            for &b in partners {
                let to = match spans.get(b as usize) {
                    Some(&to) if from.1 <= to.0 => to,
                    // Refused, with the place in the file.
                    _ => far_node(self, &near, b).map(|far| (far.first_surfel, far.end_surfel))?,
                };
                add(to, from.1 - from.0);
                n_far = n_far.wrapping_add(to.1 - to.0);
            }
            add(from, n_far);
            Ok(())
        };
        (0..self.view().links().n_blocks()).into_par_iter().try_for_each(|i| {
            self.view()
                .links()
                .lists(i)?
                .lists()
                .try_for_each(|(a, partners)| list(a, partners))?;
            if goes_on() { Ok(()) } else { Err(QueryError::Stopped) }
        })?;
        let mut sum = 0u32;
        let count = |step: AtomicU32| {
            sum = sum.wrapping_add(step.into_inner());
            sum
        };
        Ok(steps.into_iter().take(n_surfels).map(count).collect())
    }
}
