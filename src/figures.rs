//! Numbers as people read them.

/// Numbers from here on are told with an exponent, and so are those below the other.
const LARGE: f64 = 1e9;
const SMALL: f64 = 1e-4;

/// Writes a number in so many digits, above 0, however large or small it is.
pub fn in_digits(value: f64, n_digits: usize) -> String {
    let places = n_digits.saturating_sub(1);
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    if !(SMALL..LARGE).contains(&value.abs()) {
        return format!("{value:.places$e}");
    }
    // Between a ten-thousandth and 1e9; `as` keeps that.
    let before = value.abs().log10().floor() as i32;
    let places = (places as i32 - before).max(0) as usize;
    format!("{value:.places$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_any_size_have_so_many_digits() {
        let cases = [
            (14.18, 4, "14.18"),
            (14.18, 7, "14.18000"),
            (0.000_123_456, 2, "0.00012"),
            (5.998_690_605_547_59e12, 7, "5.998691e12"),
            (1.234_567_89e-12, 7, "1.234568e-12"),
            (-3.0, 1, "-3"),
            (123_456.0, 2, "123456"),
            (0.0, 7, "0"),
        ];
        for (value, n_digits, expected) in cases {
            assert_eq!(in_digits(value, n_digits), expected);
        }
    }
}
