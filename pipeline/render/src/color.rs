//! Colours: linear light inside, sRGB outside.

use std::sync::LazyLock;

/// Red, green and blue in linear light, 0…1.
pub type Rgb = [f32; 3];

/// What an eye sees. Source: the paper's Figures 7 and 8.
pub const VIOLET: [u8; 3] = [150, 60, 225];

/// The bins +x, -x, +y, -y, +z, -z and without a normal, in sRGB: a hue an axis, the negative
/// side darker.
pub const BINS: [[u8; 3]; 7] = [
    [229, 104, 88],
    [150, 47, 45],
    [112, 190, 98],
    [38, 115, 57],
    [106, 152, 233],
    [44, 78, 165],
    [150, 150, 150],
];

/// From few to many, in sRGB: in Oklab the lightness rises evenly from 0.28 to 0.90 while the hue
/// turns from 310° to 103°, at a chroma of 0.16 or what sRGB can show.
const RAMP: [[u8; 3]; 9] = [
    [61, 4, 89],
    [57, 36, 139],
    [4, 76, 166],
    [4, 112, 152],
    [6, 142, 155],
    [5, 172, 152],
    [65, 201, 126],
    [165, 216, 96],
    [242, 226, 82],
];

/// Linear light of every sRGB value of eight bits.
static LINEAR: LazyLock<[f32; 256]> =
    LazyLock::new(|| std::array::from_fn(|v| linear_of(v as f64 / 255.0) as f32));

/// Steps of linear light that [`ENCODED`] tells apart: near black an sRGB value is 5 of them.
const N_STEPS: usize = 1 << 14;

/// sRGB of linear light, by step.
static ENCODED: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let mut value = 0u8;
    let next = |value: u8| linear_of((f64::from(value) + 0.5) / 255.0);
    let encode = |step: usize| {
        while value < 255 && step as f64 / N_STEPS as f64 >= next(value) {
            value += 1;
        }
        value
    };
    (0..=N_STEPS).map(encode).collect()
});

/// Source: IEC 61966-2-1.
fn linear_of(c: f64) -> f64 {
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

/// Gives the linear light of an sRGB colour.
pub fn srgb(color: [u8; 3]) -> Rgb {
    color.map(|v| LINEAR[usize::from(v)])
}

/// Linear light of the upper end of every sRGB value of sixteen bits: from there on it is the next.
static WIDE_ENDS: LazyLock<Vec<f32>> = LazyLock::new(|| {
    (0..u16::MAX).map(|v| linear_of((f64::from(v) + 0.5) / 65535.0) as f32).collect()
});

/// Gives the linear light of an sRGB colour of sixteen bits.
pub fn linear(color: [u16; 3]) -> Rgb {
    color.map(|v| linear_of(f64::from(v) / 65535.0) as f32)
}

/// Gives the sRGB colour, of sixteen bits, of linear light.
pub fn encode_wide(color: Rgb) -> [u16; 3] {
    // There are 65535 ends; NaN is beyond none of them.
    color.map(|v| WIDE_ENDS.partition_point(|&end| end <= v) as u16)
}

/// Gives the sRGB colour of linear light.
pub fn encode(color: Rgb) -> [u8; 3] {
    // `as` saturates, NaN becomes 0.
    color.map(|v| ENCODED[((v * N_STEPS as f32 + 0.5) as usize).min(N_STEPS)])
}

/// Gives what has no colour its grey.
pub fn gray() -> Rgb {
    srgb([205; 3])
}

/// Gives the colour of a share of a range, 0…1, perceptually even.
pub fn ramp(share: f32) -> Rgb {
    let at = share.clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
    let low = (at as usize).min(RAMP.len() - 2);
    let t = at - low as f32;
    let mixed = [0, 1, 2].map(|i| {
        let (a, b) = (f32::from(RAMP[low][i]), f32::from(RAMP[low + 1][i]));
        (a + (b - a) * t).round() as u8
    });
    srgb(mixed)
}

/// Gives the colour of a normal of length 1; grey where there is none.
pub(crate) fn of_normal(n: [f32; 3]) -> Rgb {
    if n == [0.0; 3] {
        return gray();
    }
    srgb(n.map(|v| (127.5 + 127.5 * v).round() as u8))
}

/// Gives the colour of a bin.
pub(crate) fn of_bin(bin: i8) -> Rgb {
    // A tree without bins has -1 everywhere.
    srgb(usize::try_from(bin).ok().and_then(|bin| BINS.get(bin)).copied().unwrap_or(BINS[6]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_srgb_value_survives_linear_light() {
        for v in 0..=255 {
            assert_eq!(encode(srgb([v; 3])), [v; 3]);
        }
        assert_eq!(encode([-1.0, 2.0, f32::NAN]), [0, 255, 0]);
    }

    #[test]
    fn every_srgb_value_of_sixteen_bits_survives_linear_light() {
        for v in 0..=u16::MAX {
            assert_eq!(encode_wide(linear([v; 3])), [v; 3]);
        }
        assert_eq!(encode_wide([-1.0, 2.0, f32::NAN]), [0, u16::MAX, 0]);
        assert_eq!(encode_wide(srgb([255, 1, 128])), [65535, 257, 128 * 257]);
    }

    #[test]
    fn the_ramp_gets_brighter_all_the_way() {
        let brightness = |i: i32| {
            let [r, g, b] = ramp(i as f32 / 100.0);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        for i in 0..100 {
            assert!(brightness(i) < brightness(i + 1) + 2e-3, "{i}");
        }
        assert!(brightness(0) < 0.03 && brightness(100) > 0.7);
    }
}
