//! Pairs of nodes with the visible fraction between them, and how they are numbers. [F-24]

/// Segments that are tried between two nodes.
pub const SEGMENTS: u8 = 16;

/// The most nodes of a map with visible fractions.
pub const MAX_NODES: u32 = 1 << (u32::BITS - K_BITS);

/// Bits that k takes: 0…16.
const K_BITS: u32 = 5;

/// Two nodes, a < b, between which so many of sixteen segments are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Fraction {
    /// The lower node.
    pub a: u32,
    /// The higher node, below [`MAX_NODES`].
    pub b: u32,
    /// Free segments, 0…16.
    pub n_free: u8,
}

impl Fraction {
    /// Gives the pair of numbers that stands for it: (a, 32·b + k).
    pub fn to_pair(self) -> (u32, u32) {
        (self.a, self.b << K_BITS | u32::from(self.n_free))
    }

    /// Reads a pair of numbers; none where there are more than sixteen free segments.
    pub fn of_pair((a, numbers): (u32, u32)) -> Option<Fraction> {
        let (b, n_free) = (numbers >> K_BITS, (numbers & ((1 << K_BITS) - 1)) as u8);
        (n_free <= SEGMENTS).then_some(Fraction { a, b, n_free })
    }

    /// Gives the least number that can stand for a node b.
    pub fn first_of(b: u32) -> u32 {
        b.saturating_mul(1 << K_BITS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn format24_partials_come_back() {
        for (a, b, n_free) in [(0, 1, 0), (3, 7, 16), (MAX_NODES - 2, MAX_NODES - 1, 9)] {
            let fraction = Fraction { a, b, n_free };
            assert_eq!(Fraction::of_pair(fraction.to_pair()), Some(fraction));
            assert!(fraction.to_pair().1 >= Fraction::first_of(b));
        }
        assert_eq!(Fraction::of_pair((0, 32 + 17)), None);
    }
}
