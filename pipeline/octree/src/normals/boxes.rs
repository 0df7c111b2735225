//! Boxes in Morton order under boxes of eight: who is near a place, without looking at the rest.

use std::ops::ControlFlow;

use pvmap_geometry::Box3;

/// Children a node: boxes that are neighbours in Morton order are neighbours in space.
const FAN_OUT: usize = 8;

/// A tree over boxes given in Morton order; level 0 is the boxes, the last level has one node.
#[derive(Debug)]
pub(super) struct BoxTree {
    levels: Vec<Vec<Box3>>,
}

impl BoxTree {
    /// Builds the levels over `leaves`.
    pub(super) fn new(leaves: Vec<Box3>) -> BoxTree {
        let mut levels = vec![leaves];
        while let Some(below) = levels.last().filter(|l| l.len() > 1) {
            let joined = |group: &[Box3]| group.iter().fold(Box3::EMPTY, |a, b| a.join(b));
            let above = below.chunks(FAN_OUT).map(joined).collect();
            levels.push(above);
        }
        BoxTree { levels }
    }

    /// Gives the boxes it was built over.
    pub(super) fn leaves(&self) -> &[Box3] {
        &self.levels[0]
    }

    /// Calls `visit` for every leaf at most √`r2` from `target`, in order, until it breaks.
    pub(super) fn within<B>(
        &self,
        target: &Box3,
        r2: u64,
        visit: &mut impl FnMut(usize) -> ControlFlow<B>,
    ) -> ControlFlow<B> {
        self.descend(self.levels.len(), 0, target, r2, visit)
    }

    /// Does [`BoxTree::within`] below one node, given by the level of its children plus one.
    fn descend<B>(
        &self,
        level: usize,
        node: usize,
        target: &Box3,
        r2: u64,
        visit: &mut impl FnMut(usize) -> ControlFlow<B>,
    ) -> ControlFlow<B> {
        let Some(level) = level.checked_sub(1) else {
            return visit(node);
        };
        let boxes = &self.levels[level];
        let first = node * FAN_OUT;
        for (i, b) in boxes[first..boxes.len().min(first + FAN_OUT)].iter().enumerate() {
            if gap2(b, target) <= r2 {
                self.descend(level, first + i, target, r2, visit)?;
            }
        }
        ControlFlow::Continue(())
    }

    /// Calls `visit` for every leaf that may matter to `place`, near ones early.
    ///
    /// `visit` gives the squared distance beyond which leaves no longer matter, which may shrink
    /// from call to call; `bound2` is the first.
    ///
    /// # Errors
    /// Whatever `visit` fails with, at once.
    pub(super) fn nearest<E>(
        &self,
        place: [i32; 3],
        bound2: u64,
        visit: &mut impl FnMut(usize) -> Result<u64, E>,
    ) -> Result<(), E> {
        let mut bound2 = bound2;
        self.approach(self.levels.len(), 0, place, &mut bound2, visit)
    }

    /// Does [`BoxTree::nearest`] below one node.
    fn approach<E>(
        &self,
        level: usize,
        node: usize,
        place: [i32; 3],
        bound2: &mut u64,
        visit: &mut impl FnMut(usize) -> Result<u64, E>,
    ) -> Result<(), E> {
        let Some(level) = level.checked_sub(1) else {
            *bound2 = visit(node)?;
            return Ok(());
        };
        let boxes = &self.levels[level];
        let first = node * FAN_OUT;
        let mut order = [(u64::MAX, 0usize); FAN_OUT];
        let children = &boxes[first..boxes.len().min(first + FAN_OUT)];
        for (slot, (i, b)) in order.iter_mut().zip(children.iter().enumerate()) {
            *slot = (b.distance2(place), first + i);
        }
        let order = &mut order[..children.len()];
        order.sort_unstable();
        for &(d2, child) in order.iter() {
            if d2 <= *bound2 {
                self.approach(level, child, place, bound2, visit)?;
            }
        }
        Ok(())
    }
}

/// Gives the squared distance between two boxes, 0 where they meet.
#[inline]
fn gap2(a: &Box3, b: &Box3) -> u64 {
    (0..3)
        .map(|i| {
            let gap = (a.min[i] - b.max[i]).max(b.min[i] - a.max[i]).max(0);
            u64::from(gap.unsigned_abs()) * u64::from(gap.unsigned_abs())
        })
        .sum()
}

/// Gives how many of the sorted `codes` the largest cell holds that starts with the first of them,
/// does not hold `before` (the code ahead of them) and has at most `max` points.
///
/// A cell here is what shares any number of leading bits, so that it may be halved: cells are
/// then half full at the least where points are even. The answer exceeds `max` only where so many
/// share one code. `codes` is not empty; whoever has more than `max` of them shows `max` + 1.
pub(super) fn cell_len(codes: &[u64], before: Option<u64>, max: usize) -> usize {
    let first = codes[0];
    let shift = [before, codes.get(max).copied()]
        .into_iter()
        .flatten()
        .map(|outside| (outside ^ first).checked_ilog2().unwrap_or(0))
        .min()
        .unwrap_or(63);
    codes.partition_point(|c| c >> shift == first >> shift)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_tree_finds_what_a_list_finds(
            corners in prop::collection::vec(prop::array::uniform3(0i32..1000), 0..200),
            place in prop::array::uniform3(0i32..1000),
            r2 in 0u64..200_000,
        ) {
            let around = |&c: &[i32; 3]| Box3::at(c).join(&Box3::at(c.map(|v| v + v % 50)));
            let boxes: Vec<_> = corners.iter().map(around).collect();
            let is_near = |b: &Box3| b.distance2(place) <= r2;
            let expected: Vec<_> = (0..boxes.len()).filter(|&i| is_near(&boxes[i])).collect();
            let tree = BoxTree::new(boxes);
            let mut found = Vec::new();
            let _: ControlFlow<()> = tree.within(&Box3::at(place), r2, &mut |i| {
                found.push(i);
                ControlFlow::Continue(())
            });
            prop_assert_eq!(&found, &expected);
            found.clear();
            let visited: Result<(), ()> = tree.nearest(place, r2, &mut |i| {
                found.push(i);
                Ok(r2)
            });
            found.sort_unstable();
            prop_assert_eq!((visited, found), (Ok(()), expected));
        }

        #[test]
        fn cells_cover_the_codes_and_share_no_code(
            mut codes in prop::collection::vec(0u64..5000, 1..400),
            max in 1usize..40,
        ) {
            codes.sort_unstable();
            let (mut at, mut before) = (0, None);
            while at < codes.len() {
                let len = cell_len(&codes[at..], before, max);
                prop_assert!(len > 0 && before < Some(codes[at]));
                prop_assert!(len <= max || codes[at] == codes[at + len - 1]);
                before = Some(codes[at + len - 1]);
                at += len;
            }
            prop_assert_eq!(at, codes.len());
        }
    }
}
