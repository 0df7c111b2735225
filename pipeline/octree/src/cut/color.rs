//! Colours: from the sRGB values a scan stores to linear light.

use std::sync::LazyLock;

use pvmap_vmap::OctreeView;
use pvmap_vmap::bytes::FieldReader;

/// Steps of Newton's method for a fifth root of 0.008…1 from 1: the tenth already changes nothing.
const NEWTON_STEPS: usize = 12;

/// Linear light, full scale 65535, of every sRGB value of that scale.
static LINEAR: LazyLock<Box<Table>> = LazyLock::new(|| {
    let mut table = Box::new([0; 1 << 16]);
    (0..=u16::MAX).zip(table.iter_mut()).for_each(|(srgb, light)| *light = linear(srgb));
    table
});

type Table = [u16; 1 << 16];

/// Reads the colour of point records.
pub(super) struct Colors {
    /// Where in a record.
    at: usize,
    /// Where the source's number is; there is one source without.
    source_at: Option<usize>,
    /// Bits used by each source, 0 without colour.
    depths: Vec<u32>,
    linear: &'static Table,
}

impl Colors {
    /// Prepares for the records of an octree; `None` where they have no colour.
    pub(super) fn of(octree: &OctreeView<'_>) -> Option<Colors> {
        Some(Colors {
            at: octree.schema().column("color")?.offset,
            source_at: octree.schema().column("source").map(|c| c.offset),
            depths: octree.sources().iter().map(|s| s.color_depth).collect(),
            linear: &LINEAR,
        })
    }

    /// Gives a record's colour in linear light; `None` where its source has none.
    #[inline]
    pub(super) fn linear(&self, record: &[u8]) -> Option<[u16; 3]> {
        let source = self.source_at.map_or(0, |at| FieldReader::new(&record[at..]).u32());
        let mut fields = FieldReader::new(&record[self.at..]);
        let stored = [fields.u16(), fields.u16(), fields.u16()];
        // 257 · v is v repeated: the same share of full scale.
        let wide = match self.depths.get(source as usize)? {
            0 => return None,
            8 => stored.map(|v| v.min(255) * 257),
            _ => stored,
        };
        Some(wide.map(|v| self.linear[usize::from(v)]))
    }
}

/// Turns an sRGB value of full scale 65535 into linear light of the same scale, rounded.
///
/// Only + - × ÷, so that every machine gets the same: x^2.4 is x² times the fifth root of x².
///
/// Source: IEC 61966-2-1.
pub fn linear(srgb: u16) -> u16 {
    let c = f64::from(srgb) / 65535.0;
    let light = if c <= 0.04045 {
        c / 12.92
    } else {
        let x = (c + 0.055) / 1.055;
        x * x * fifth_root(x * x)
    };
    (light * 65535.0 + 0.5) as u16
}

/// Gives the fifth root of 0.008…1.
fn fifth_root(v: f64) -> f64 {
    (0..NEWTON_STEPS).fold(1.0, |y, _| {
        let y2 = y * y;
        (4.0 * y + v / (y2 * y2)) / 5.0
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_light_follows_the_srgb_curve() {
        for v in 0..=u16::MAX {
            let c = f64::from(v) / 65535.0;
            let light = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
            assert!((f64::from(linear(v)) - light * 65535.0).abs() < 0.5 + 1e-6, "{v}");
        }
        assert_eq!([0, 257, 128 * 257, 65535].map(linear), [0, 20, 14146, 65535]);
    }

    #[test]
    fn more_newton_steps_change_nothing() {
        for v in [0.0077, 0.01, 0.1, 0.5, 1.0] {
            let root = fifth_root(v);
            let next = (4.0 * root + v / (root * root * root * root)) / 5.0;
            assert!((next - root).abs() <= 2e-16, "{v}");
        }
    }
}
