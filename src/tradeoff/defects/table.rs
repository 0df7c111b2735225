//! Scans and their settings as text for people and as CSV for programs.

use std::fmt::Write as _;
use std::io::Write;
use std::sync::LazyLock;

use super::Case;
use crate::tradeoff::Clock;
use crate::tradeoff::pareto::front;
use crate::tradeoff::table::{CSV_HEADER as SETTINGS_HEADER, cells, percent};

/// The names of the columns of the CSV.
pub static CSV_HEADER: LazyLock<String> =
    LazyLock::new(|| format!("scan,defect,value,points,visible_pairs,{SETTINGS_HEADER}"));

/// Writes the rows as CSV: the scan, its defect (a word and metres, points, times or a share),
/// points and facing pairs that see each other, then what
/// [`write_csv`](crate::tradeoff::table::write_csv) writes. What is on the front is so among the
/// settings of one scan.
///
/// # Errors
/// Where `out` fails.
pub fn write_csv(out: &mut dyn Write, cases: &[Case]) -> Result<(), std::io::Error> {
    writeln!(out, "{}", *CSV_HEADER)?;
    let mut writer = csv::Writer::from_writer(out);
    for case in cases {
        let (word, value) = case
            .defect
            .map_or(("", String::new()), |defect| (defect.kind.word(), defect.value.to_string()));
        for (row, on_front) in case.rows.iter().zip(front(&case.rows)) {
            let mut line = vec![
                case.name(),
                word.to_owned(),
                value.clone(),
                case.subject.n_points.to_string(),
                case.subject.n_visible.to_string(),
            ];
            line.extend(cells(row, &case.subject, on_front));
            writer.write_record(&line)?;
        }
    }
    writer.flush()
}

/// Writes the rows as a table: a line of what it is about, then a line a scan and setting.
pub fn text(cases: &[Case]) -> String {
    let Some(first) = cases.first() else { return String::new() };
    let subject = &first.subject;
    let mut text = format!(
        "{}, {} points as it is: {} pairs drawn of each scan (seed {})\n{}, each point where it \
         was before the defect\n\n",
        subject.name,
        subject.n_points,
        subject.n_drawn,
        subject.seed,
        subject.judge.words()
    );
    let width = |least: usize, names: &mut dyn Iterator<Item = String>| {
        names.map(|name| name.chars().count()).max().unwrap_or(0).max(least)
    };
    let scans = width(4, &mut cases.iter().map(Case::name));
    let rows = || cases.iter().flat_map(|case| &case.rows);
    let settings = width(7, &mut rows().map(|row| row.setting.name.clone()));
    let seconds = match subject.clock {
        Clock::Wall => "seconds",
        Clock::Processor => "CPU s",
    };
    let _ = writeln!(
        text,
        "{:<scans$} {:<settings$} {:>9} {seconds:>8} {:>8} {:>10}  {:<18} {:<18} error, both",
        "scan", "setting", "points", "leaves", "links", "wrongly visible", "wrongly invisible"
    );
    let (blank, of) = ("", "% (95 %)");
    let _ = writeln!(
        text,
        "{blank:<scans$} {blank:<settings$} {blank:>9} {blank:>8} {blank:>8} {blank:>10}  \
         {of:<18} {of:<18} {of}"
    );
    for case in cases {
        for row in &case.rows {
            let (name, setting) = (case.name(), &row.setting.name);
            let n_points = case.subject.n_points;
            let _ = write!(text, "{name:<scans$} {setting:<settings$} {n_points:>9} ");
            match row.built() {
                Some(built) => {
                    let _ = write!(
                        text,
                        "{:>8.2} {:>8} {:>10}  {:<18} {:<18} {}",
                        built.seconds,
                        built.n_leaves,
                        built.n_links,
                        percent(built.false_visible()),
                        percent(built.false_invisible()),
                        percent(built.error())
                    );
                }
                None => text += &row.outcome.why_not().unwrap_or_default(),
            }
            text.push('\n');
        }
    }
    text
}
