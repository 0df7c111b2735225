//! Which rows no other beats, and which of them to take.

use std::fmt;
use std::str::FromStr;

use super::Row;

/// What a row is judged by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figures {
    /// Seconds.
    pub seconds: f64,
    /// Its error.
    pub error: f64,
    /// What the error is at the most: the upper end of its 95 % interval, if it has one.
    pub most: f64,
}

/// Says of each row whether no other is at least as quick and as accurate, and better in one of
/// the two. What was not built is on no front.
pub fn front(rows: &[Row]) -> Vec<bool> {
    front_of(&figures(rows))
}

/// Does the same for figures; rows that have none are on no front.
pub fn front_of(figures: &[Option<Figures>]) -> Vec<bool> {
    let beats = |a: &Figures, b: &Figures| {
        let is_other = (a.seconds, a.error) != (b.seconds, b.error);
        is_other && a.seconds <= b.seconds && a.error <= b.error
    };
    let is_beaten = |of: &Figures| figures.iter().flatten().any(|other| beats(other, of));
    figures.iter().map(|figure| figure.is_some_and(|f| !is_beaten(&f))).collect()
}

fn figures(rows: &[Row]) -> Vec<Option<Figures>> {
    let of_row = |row: &Row| {
        let built = row.built()?;
        let (error, [_, most]) = (built.error().value(), built.error().interval());
        Some(Figures { seconds: built.seconds, error, most })
    };
    rows.iter().map(of_row).collect()
}

/// What somebody wants of a setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Wish {
    /// A share of facing pairs that may be wrong, or of light: the quickest such setting.
    Error(f64),
    /// Seconds that a build, or a map and its light, may take: the most accurate such setting.
    Time(f64),
}

impl FromStr for Wish {
    type Err = String;

    /// Reads `error=0.5%`, `error=0.005`, `time=30s`, `time=2min`, `time=1h`.
    fn from_str(text: &str) -> Result<Wish, String> {
        let fail = || format!("{text:?} is no wish; write for example error=0.5% or time=30s");
        let (key, value) = text.split_once('=').ok_or_else(fail)?;
        let read = |number: &str, factor: f64| {
            let number: f64 = number.trim().parse().map_err(|_| fail())?;
            if number >= 0.0 && number.is_finite() { Ok(number * factor) } else { Err(fail()) }
        };
        let with = |units: &[(&str, f64)]| {
            let found = units.iter().find_map(|(unit, f)| Some((value.strip_suffix(unit)?, *f)));
            let (number, factor) = found.unwrap_or((value, 1.0));
            read(number, factor)
        };
        match key.trim() {
            "error" => match with(&[("%", 0.01)])? {
                share if share <= 1.0 => Ok(Wish::Error(share)),
                _ => Err(fail()),
            },
            "time" => {
                let units = [("min", 60.0), ("ms", 0.001), ("s", 1.0), ("m", 60.0), ("h", 3600.0)];
                Ok(Wish::Time(with(&units)?))
            }
            _ => Err(fail()),
        }
    }
}

impl fmt::Display for Wish {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            // Digits that a product with 0.01 adds say nothing.
            Wish::Error(e) => write!(f, "error ≤ {} %", (e * 1e8).round() / 1e6),
            Wish::Time(t) => write!(f, "time ≤ {t} s"),
        }
    }
}

/// The row that comes nearest to a wish.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Choice {
    /// Which row.
    pub row: usize,
    /// Whether it is what was wished.
    pub is_met: bool,
}

/// Chooses a row: of those whose error is within the wish, at the upper end of its 95 % interval,
/// the quickest; or of those that are quick enough the most accurate. Where there is none, the row
/// whose upper end is least, or the quickest. Nothing where nothing was built.
pub fn choose(rows: &[Row], wish: Wish) -> Option<Choice> {
    choose_of(&figures(rows), wish)
}

/// Does the same by figures, among the rows that have some.
pub fn choose_of(figures: &[Option<Figures>], wish: Wish) -> Option<Choice> {
    let found = figures.iter().enumerate().filter_map(|(row, f)| Some((row, (*f)?)));
    let all: Vec<(usize, Figures)> = found.collect();
    let quickest = |f: &Figures| [f.seconds, f.error];
    let (met, nearest) = match wish {
        Wish::Error(e) => (
            least(all.iter().filter(|(_, f)| f.most <= e), quickest),
            least(all.iter(), |f| [f.most, f.seconds]),
        ),
        Wish::Time(t) => (
            least(all.iter().filter(|(_, f)| f.seconds <= t), |f| [f.error, f.seconds]),
            least(all.iter(), quickest),
        ),
    };
    let row = met.or(nearest)?;
    Some(Choice { row, is_met: met.is_some() })
}

/// Finds the row with the least first figure; of equals the second decides, then their order.
fn least<'a>(
    rows: impl Iterator<Item = &'a (usize, Figures)>,
    key: impl Fn(&Figures) -> [f64; 2],
) -> Option<usize> {
    let by = |(_, a): &&(usize, Figures), (_, b): &&(usize, Figures)| {
        let (a, b) = (key(a), key(b));
        a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1]))
    };
    rows.min_by(by).map(|found| found.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accuracy::Tally;
    use crate::config::RawConfig;
    use crate::tradeoff::{Built, Outcome, Sweep};

    /// Rows of so many seconds and wrong answers of 10 000; the last was stopped.
    fn rows(figures: &[(f64, u64)]) -> Vec<Row> {
        let sweep = Sweep::around("depth8", &RawConfig::default()).unwrap();
        let row = |outcome| Row { setting: sweep.settings[0].clone(), cut: None, outcome };
        let built = |&(seconds, n_wrong): &(f64, u64)| {
            let tally = Tally { n_pairs: 10_000, n_false_visible: n_wrong, ..Tally::default() };
            row(Outcome::Built(Built { seconds, tally, ..Built::default() }))
        };
        figures.iter().map(built).chain([row(Outcome::Stopped(1.0))]).collect()
    }

    #[test]
    fn nothing_beats_what_is_on_the_front() {
        let rows = rows(&[(1.0, 90), (2.0, 90), (2.0, 30), (3.0, 40), (4.0, 10), (4.0, 10)]);
        assert_eq!(front(&rows), [true, false, true, false, true, true, false]);
        assert_eq!(front(&rows[6..]), [false]);
    }

    #[test]
    fn the_quickest_that_is_surely_accurate_enough() {
        // 0.3 % of 10 000 is at most 0.43 % by the interval, 0.4 % at most 0.54 %.
        let rows = rows(&[(9.0, 10), (1.0, 40), (2.0, 30), (3.0, 30)]);
        let choice = |wish: &str| choose(&rows, wish.parse().unwrap()).unwrap();
        assert_eq!(choice("error=0.5%"), Choice { row: 2, is_met: true });
        assert_eq!(choice("error=0.6%"), Choice { row: 1, is_met: true });
        assert_eq!(choice("error=0.43%"), Choice { row: 2, is_met: true });
        assert_eq!(choice("error=0.4%"), Choice { row: 0, is_met: true });
        assert_eq!(choice("error=0.0001"), Choice { row: 0, is_met: false }, "comes nearest");
        assert_eq!(choice("error=0"), Choice { row: 0, is_met: false });
    }

    #[test]
    fn the_most_accurate_that_is_quick_enough() {
        let rows = rows(&[(9.0, 10), (1.0, 40), (2.0, 30), (3.0, 30)]);
        let choice = |wish: &str| choose(&rows, wish.parse().unwrap()).unwrap();
        assert_eq!(choice("time=1min"), Choice { row: 0, is_met: true });
        assert_eq!(choice("time=9"), Choice { row: 0, is_met: true });
        assert_eq!(choice("time=8.9s"), Choice { row: 2, is_met: true }, "the quicker of equals");
        assert_eq!(choice("time=1000ms"), Choice { row: 1, is_met: true });
        assert_eq!(choice("time=0.5s"), Choice { row: 1, is_met: false }, "the quickest");
        assert_eq!(choose(&rows[4..], Wish::Time(1.0)), None);
    }

    #[test]
    fn wishes_are_read_and_told() {
        for (text, wish, told) in [
            ("error=0.5%", Wish::Error(0.005), "error ≤ 0.5 %"),
            ("error=0.07%", Wish::Error(0.0007), "error ≤ 0.07 %"),
            ("error=0.01", Wish::Error(0.01), "error ≤ 1 %"),
            ("time=30s", Wish::Time(30.0), "time ≤ 30 s"),
            ("time=1.5h", Wish::Time(5400.0), "time ≤ 5400 s"),
        ] {
            let read: Wish = text.parse().unwrap();
            let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
            assert!(match (read, wish) {
                (Wish::Error(a), Wish::Error(b)) | (Wish::Time(a), Wish::Time(b)) => near(a, b),
                _ => false,
            });
            assert_eq!(read.to_string(), told);
        }
        for bad in [
            "",
            "error",
            "error=",
            "error=-1%",
            "error=101%",
            "time=soon",
            "speed=3",
            "time=nan",
            "error=inf",
        ] {
            assert!(bad.parse::<Wish>().is_err(), "{bad}");
        }
    }
}
