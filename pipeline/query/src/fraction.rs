//! How much of each other the leaves of two places see. Source: FORMAT.md [F-24].

use pvmap_vmap::Fraction;
use pvmap_vmap::fraction::SEGMENTS;

use crate::error::QueryError;
use crate::frames::Lookup;
use crate::locate::Located;
use crate::map::Map;
use crate::pair::PairAnswer;

/// How much two leaves see of each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FractionAnswer {
    /// Free segments, 0 to 16, of the sixteen that were tried or would be.
    pub n_free: u8,
    /// The nodes between which they were tried, seen from the two places in the order they were
    /// given; none where the links say all of it.
    pub tried: Option<(u32, u32)>,
    /// What [`Map::pair`] says.
    pub by_leaves: PairAnswer,
}

impl FractionAnswer {
    /// Gives the visible fraction, 0 to 1.
    pub fn fraction(&self) -> f64 {
        f64::from(self.n_free) / f64::from(SEGMENTS)
    }
}

impl Map<'_> {
    /// Says whether the map was built with visible fractions.
    pub fn has_fractions(&self) -> bool {
        self.view().fractions().is_some()
    }

    /// Gives how much the leaves of two located places see of each other; without visible fractions
    /// in the map all or nothing.
    ///
    /// # Errors
    /// Those of [`Map::pair`].
    pub fn pair_fraction(&self, a: &Located, b: &Located) -> Result<FractionAnswer, QueryError> {
        self.fraction_with(&mut Lookup::new(self), a, b)
    }

    /// Does what [`Map::pair_fraction`] does; the lookup may have the right frames at hand.
    pub(crate) fn fraction_with(
        &self,
        lookup: &mut Lookup<'_, '_>,
        a: &Located,
        b: &Located,
    ) -> Result<FractionAnswer, QueryError> {
        let by_leaves = self.pair_with(lookup, a, b)?;
        let links_say = if by_leaves.visible { SEGMENTS } else { 0 };
        Ok(match self.tried(lookup, a, b)? {
            None => FractionAnswer { n_free: links_say, tried: None, by_leaves },
            Some(Fraction { a: x, b: y, n_free }) => {
                let tried = Some(if a.node < b.node { (x, y) } else { (y, x) });
                FractionAnswer { n_free, tried, by_leaves }
            }
        })
    }

    /// Finds the nodes over two leaves that have a visible fraction.
    pub(crate) fn tried(
        &self,
        lookup: &mut Lookup<'_, '_>,
        a: &Located,
        b: &Located,
    ) -> Result<Option<Fraction>, QueryError> {
        if !self.has_fractions() || a.node == b.node {
            return Ok(None);
        }
        if !self.is_coarse() {
            return Ok(lookup.fraction((a.node.min(b.node), a.node.max(b.node)))?);
        }
        for (x, y) in self.links_over(lookup, a, b)?.iter() {
            if let Some(found) = lookup.fraction((x, y))? {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }
}
