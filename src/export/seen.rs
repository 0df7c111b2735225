//! What surfels see, gathered in one pass over all links.

use std::ops::Range;

use pvmap_query::{Located, Map};
use pvmap_store::Watch;
use pvmap_vmap::Node;
use pvmap_vmap::tree::Nodes;

use super::Failure;

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

/// Reads all links, if anything is asked for.
pub(super) fn look(
    map: &Map<'_>,
    wanted: &Wanted<'_>,
    watch: &dyn Watch,
) -> Result<Found, Failure> {
    let view = map.view();
    let n_surfels = view.summary().n_surfels;
    let mut by_eye: Vec<Bits> = wanted.eyes.iter().map(|_| Bits::none(n_surfels)).collect();
    for (bits, eye) in by_eye.iter_mut().zip(wanted.eyes) {
        bits.add(eye.surfel..eye.surfel + 1);
    }
    let mut sums = Sums(vec![0; if wanted.counts { n_surfels as usize + 1 } else { 0 }]);
    if wanted.eyes.is_empty() && !wanted.counts {
        return Ok(Found { by_eye, counts: Vec::new() });
    }
    watch.stage("links", Some(view.summary().n_links), "links");
    // The links of a node stand together: it is read once.
    let mut near: Option<(u32, Node)> = None;
    for block in 0..view.n_link_blocks() {
        watch.check()?;
        let lists = view.link_lists(block)?;
        for (a, b) in lists.iter() {
            let first = match near {
                Some((id, node)) if id == a => node,
                _ => view.node(a)?,
            };
            near = Some((a, first));
            let second = view.node(b)?;
            for (bits, eye) in by_eye.iter_mut().zip(wanted.eyes) {
                if (a..first.end).contains(&eye.node) {
                    bits.add(surfels_of(&second));
                } else if (b..second.end).contains(&eye.node) {
                    bits.add(surfels_of(&first));
                }
            }
            sums.add(surfels_of(&first), surfels_of(&second).len() as u32);
            sums.add(surfels_of(&second), surfels_of(&first).len() as u32);
        }
        watch.advance(lists.len() as u64);
    }
    Ok(Found { by_eye, counts: sums.done() })
}

fn surfels_of(node: &Node) -> Range<u32> {
    node.first_surfel..node.end_surfel
}

/// Numbers that whole ranges are added to, as differences. They wrap on the way; a sum is below
/// 2^32, as it counts surfels.
struct Sums(Vec<u32>);

impl Sums {
    fn add(&mut self, range: Range<u32>, n: u32) {
        if range.end as usize >= self.0.len() {
            return;
        }
        let [start, end] = [range.start, range.end].map(|i| i as usize);
        self.0[start] = self.0[start].wrapping_add(n);
        self.0[end] = self.0[end].wrapping_sub(n);
    }

    fn done(mut self) -> Vec<u32> {
        let mut sum = 0u32;
        for n in &mut self.0 {
            sum = sum.wrapping_add(*n);
            *n = sum;
        }
        self.0
    }
}
