//! Routing many points that come in Morton order: most go where one a little before them went.

use std::ops::Range;

use pvmap_geometry::morton;

use crate::tree::{Nodes, RoutingKey, route};

/// Bins, times the quadrants of each: keys alike in both and in one leaf's cell share the leaf.
const N_SLOTS: usize = 7 * 4;

/// Does what [`route`] does, and remembers the last leaf of every direction.
#[derive(Debug)]
pub struct Router<'n, N> {
    nodes: &'n N,
    /// The Morton codes of the leaf's cell, and its first surfel.
    last: [(Range<u64>, u32); N_SLOTS],
}

impl<'n, N: Nodes> Router<'n, N> {
    /// Starts without memories.
    pub fn new(nodes: &'n N) -> Router<'n, N> {
        Router { nodes, last: std::array::from_fn(|_| (0..0, 0)) }
    }

    /// Gives the surfel of the leaf that a point is routed to; none where it has no leaf.
    ///
    /// # Errors
    /// Those of reading a node.
    pub fn surfel_of(&mut self, key: &RoutingKey) -> Result<Option<u32>, N::Error> {
        let bin = key.bin();
        let quadrant = if bin < 6 { key.quadrant(bin) } else { 0 };
        let slot = usize::from(bin) * 4 + usize::from(quadrant);
        let code = morton::encode(key.g);
        if let Some((codes, surfel)) = self.last.get(slot)
            && codes.contains(&code)
        {
            return Ok(Some(*surfel));
        }
        let Some(id) = route(self.nodes, key)? else { return Ok(None) };
        let leaf = self.nodes.node(id)?;
        if let Some(last) = self.last.get_mut(slot) {
            *last = (morton::cell_range(leaf.first_code, leaf.level), leaf.first_surfel);
        }
        Ok(Some(leaf.first_surfel))
    }
}
