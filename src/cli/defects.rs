//! What can be wrong with a generated scan, as it is asked for.

use pvmap::scene::Defects;

/// Of a scan so much may be missing.
const MOST_MISSING: f64 = 0.95;
/// No length is as long, metres.
const MOST_LENGTH_M: f64 = 1e6;
/// No density differs more.
const MOST_RATIO: f64 = 1e6;

/// What is wrong with a scan.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(super) struct DefectArgs {
    /// Moves points off their surfaces, along the normal: a standard
    /// deviation, 0.5mm, 1cm, 0.003 (metres)
    #[arg(
        long,
        default_value = "0",
        hide_default_value = true,
        value_parser = parse_length,
        value_name = "D",
        verbatim_doc_comment
    )]
    noise: f64,
    /// As many points, but R times denser at the least x than at the
    /// greatest
    #[arg(
        long,
        default_value = "1",
        hide_default_value = true,
        value_parser = parse_ratio,
        value_name = "R",
        verbatim_doc_comment
    )]
    uneven: f64,
    /// Takes away this share of the points, in balls of a 25th of the
    /// extent: 5%, 0.05
    #[arg(
        long,
        default_value = "0",
        hide_default_value = true,
        value_parser = parse_missing,
        value_name = "SHARE",
        verbatim_doc_comment
    )]
    holes: f64,
    /// Leaves this share of the points without a normal: (0, 0, 0)
    #[arg(
        long,
        default_value = "0",
        hide_default_value = true,
        value_parser = parse_share,
        value_name = "SHARE"
    )]
    no_normals: f64,
    /// Gives the normals of this share of the points the wrong sign
    #[arg(
        long,
        default_value = "0",
        hide_default_value = true,
        value_parser = parse_share,
        value_name = "SHARE"
    )]
    flip_normals: f64,
}

impl DefectArgs {
    pub(super) fn defects(&self) -> Defects {
        Defects {
            noise_m: self.noise,
            unevenness: self.uneven,
            missing: self.holes,
            without_normal: self.no_normals,
            flipped: self.flip_normals,
        }
    }
}

/// Reads a length with its unit, or in metres.
pub(super) fn parse_length(text: &str) -> Result<f64, String> {
    let units = [("mm", 1e3), ("cm", 1e2), ("m", 1.0)];
    let found = units.iter().find_map(|(unit, by)| Some((text.strip_suffix(unit)?, *by)));
    let (number, by) = found.unwrap_or((text, 1.0));
    let length = number.trim().parse::<f64>().ok().map(|v| v / by);
    length.filter(|v| (0.0..=MOST_LENGTH_M).contains(v)).ok_or_else(|| {
        format!("{text:?} is no length of 0 to {MOST_LENGTH_M} m; write for example 3mm")
    })
}

pub(super) fn parse_ratio(text: &str) -> Result<f64, String> {
    let ratio = text.parse().ok().filter(|v| (1.0..=MOST_RATIO).contains(v));
    ratio.ok_or_else(|| {
        format!("{text:?} is no ratio of densities, 1 to {MOST_RATIO}; write for example 16")
    })
}

/// Reads a share, 5% or 0.05.
pub(super) fn parse_share(text: &str) -> Result<f64, String> {
    let (number, by) = text.strip_suffix('%').map_or((text, 1.0), |number| (number, 100.0));
    let share = number.trim().parse::<f64>().ok().map(|v| v / by);
    let share = share.filter(|v| (0.0..=1.0).contains(v));
    share.ok_or_else(|| format!("{text:?} is no share of 0 to 100 %; write for example 5%"))
}

pub(super) fn parse_missing(text: &str) -> Result<f64, String> {
    match parse_share(text)? {
        share if share > MOST_MISSING => {
            Err(format!("at most {} % may be missing", MOST_MISSING * 100.0))
        }
        share => Ok(share),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_and_shares_have_units() {
        let near = |found: Result<f64, String>, v: f64| (found.unwrap() - v).abs() < 1e-12;
        for (text, metres) in
            [("3mm", 0.003), ("1cm", 0.01), ("0.5m", 0.5), ("0.02", 0.02), ("0", 0.0)]
        {
            assert!(near(parse_length(text), metres), "{text}");
        }
        for (text, share) in [("5%", 0.05), ("0.05", 0.05), ("100%", 1.0), ("0", 0.0)] {
            assert!(near(parse_share(text), share), "{text}");
        }
        for bad in ["", "mm", "-1mm", "1 mile", "nan", "inf", "1e300", "1000001m", "1.1e9mm"] {
            assert!(parse_length(bad).unwrap_err().contains("0 to 1000000 m"), "{bad}");
        }
        for bad in ["", "%", "101%", "-5%", "nan%", "7", "1e300"] {
            assert!(parse_share(bad).unwrap_err().contains("0 to 100 %"), "{bad}");
        }
        for bad in ["", "0.5", "nan", "1e300"] {
            assert!(parse_ratio(bad).unwrap_err().contains("1 to 1000000"), "{bad}");
        }
        assert!(parse_ratio("16") == Ok(16.0));
        assert!(parse_missing("96%").is_err() && near(parse_missing("30%"), 0.3));
    }
}
