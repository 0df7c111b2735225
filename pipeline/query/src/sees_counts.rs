//! How many surfels each surfel sees.

use std::sync::atomic::{AtomicU32, Ordering};

use pvmap_vmap::tree::Nodes;
use pvmap_vmap::{FormatError, Node};
use rayon::prelude::*;

use crate::error::QueryError;
use crate::map::Map;
use crate::part::far_node;

impl Map<'_> {
    /// Counts for every surfel the others that it sees; place i is surfel i.
    ///
    /// One pass over all links, four bytes of memory a surfel. A link (A, B) adds the number of
    /// B's surfels to each of A's, which are a range, and the other way round. What is noted is
    /// only where a range begins and ends; sums over those are the counts. Threads are those of
    /// the current rayon pool.
    ///
    /// # Errors
    /// Where the map is damaged.
    pub fn sees_counts(&self) -> Result<Vec<u32>, QueryError> {
        let n_surfels = self.view().summary().n_surfels as usize;
        // Modulo 2^32: what a surfel sees is less, so sums come out right.
        let steps: Vec<AtomicU32> = (0..=n_surfels).map(|_| AtomicU32::new(0)).collect();
        let add = |side: &Node, n: u32| {
            steps[side.first_surfel as usize].fetch_add(n, Ordering::Relaxed);
            steps[side.end_surfel as usize].fetch_sub(n, Ordering::Relaxed);
        };
        let n_under = |node: &Node| node.end_surfel - node.first_surfel;
        let frame = |i: u64| -> Result<(), FormatError> {
            // The links of a node stand together: it is read once.
            let mut near: Option<(u32, Node)> = None;
            for (a, b) in self.view().link_lists(i)?.iter() {
                let from = match near {
                    Some((id, node)) if id == a => node,
                    _ => self.view().node(a)?,
                };
                near = Some((a, from));
                let to = far_node(self, &from, b)?;
                add(&from, n_under(&to));
                add(&to, n_under(&from));
            }
            Ok(())
        };
        (0..self.view().n_link_blocks()).into_par_iter().try_for_each(frame)?;
        let mut sum = 0u32;
        let count = |step: AtomicU32| {
            sum = sum.wrapping_add(step.into_inner());
            sum
        };
        Ok(steps.into_iter().take(n_surfels).map(count).collect())
    }
}
