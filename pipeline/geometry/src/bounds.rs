//! Axis-aligned boxes with integer corners, both ends included.

/// A closed box in grid steps; corners are signed because patch boxes may leave the cube.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Box3 {
    /// The lowest corner.
    pub min: [i32; 3],
    /// The highest corner, ≥ `min` on every axis unless the box is empty.
    pub max: [i32; 3],
}

impl Box3 {
    /// The box of nothing: joining anything to it gives that thing.
    pub const EMPTY: Box3 = Box3 { min: [i32::MAX; 3], max: [i32::MIN; 3] };

    /// Boxes a single place.
    #[inline]
    pub fn at(p: [i32; 3]) -> Box3 {
        Box3 { min: p, max: p }
    }

    /// Says whether the box holds no place.
    #[inline]
    pub fn is_empty(&self) -> bool {
        (0..3).any(|i| self.min[i] > self.max[i])
    }

    /// Gives the smallest box around both.
    #[inline]
    pub fn join(&self, other: &Box3) -> Box3 {
        Box3 {
            min: [0, 1, 2].map(|i| self.min[i].min(other.min[i])),
            max: [0, 1, 2].map(|i| self.max[i].max(other.max[i])),
        }
    }

    /// Gives what both boxes hold; it may be empty.
    #[inline]
    pub fn meet(&self, other: &Box3) -> Box3 {
        Box3 {
            min: [0, 1, 2].map(|i| self.min[i].max(other.min[i])),
            max: [0, 1, 2].map(|i| self.max[i].min(other.max[i])),
        }
    }

    /// Gives the box grown by `by` steps on every side.
    #[inline]
    pub fn grown(&self, by: i32) -> Box3 {
        Box3 { min: self.min.map(|v| v - by), max: self.max.map(|v| v + by) }
    }

    /// Gives the squared distance from a place to the box, 0 inside.
    pub fn distance2(&self, p: [i32; 3]) -> u64 {
        (0..3)
            .map(|i| {
                let low = i64::from(self.min[i]) - i64::from(p[i]);
                let high = i64::from(p[i]) - i64::from(self.max[i]);
                let d = low.max(high).max(0) as u64;
                d * d
            })
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joining_and_meeting() {
        let a = Box3 { min: [0, 0, 0], max: [4, 4, 4] };
        let b = Box3 { min: [3, -2, 5], max: [9, 1, 6] };
        assert_eq!(a.join(&b), Box3 { min: [0, -2, 0], max: [9, 4, 6] });
        assert!(a.meet(&b).is_empty());
        assert_eq!(Box3::EMPTY.join(&a), a);
        assert_eq!(a.distance2([7, 4, -4]), 25);
        assert_eq!(a.distance2([2, 2, 2]), 0);
    }
}
