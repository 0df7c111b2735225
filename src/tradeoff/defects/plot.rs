//! Error against each defect, as SVG: a panel a kind, a line a setting.

use std::fmt::Write;

use super::{Case, DefectKind};
use crate::svg::{Axis, COLORS, begin, escaped, grid, mark, stroke, text};
use crate::tradeoff::plot::{START, plain};
use crate::tradeoff::{Built, Row};

/// Two panels beside each other.
const N_COLUMNS: usize = 2;
const WIDTH: f64 = 960.0;
/// Above all panels, and below.
const ABOVE: f64 = 108.0;
const BELOW: f64 = 34.0;
/// The place of a panel, and what of it is left, right, above and below the axes.
const PANEL: [f64; 2] = [456.0, 262.0];
const MARGINS: [f64; 4] = [64.0, 14.0, 32.0, 36.0];
/// About the width of a letter.
const LETTER: f64 = 6.9;

const STYLE: &str = "\
<style>.interval { stroke-width: 1.4; opacity: 0.55 } .course { stroke-width: 1.6; fill: none } \
.plain { stroke-width: 1.2; stroke-dasharray: 5 4; fill: none }</style>
";

/// A setting on one scan.
struct Spot<'a> {
    value: f64,
    built: &'a Built,
}

/// Draws the cases. What was not built is told below; of an error of 0 the mark lies on the axis.
pub fn draw(cases: &[Case]) -> String {
    let kinds: Vec<DefectKind> =
        DefectKind::ALL.into_iter().filter(|&kind| cases.iter().any(|c| is_of(c, kind))).collect();
    let names = names(cases);
    let height = ABOVE + BELOW + PANEL[1] * kinds.len().div_ceil(N_COLUMNS) as f64;
    let about = cases.first().map(|case| &case.subject);
    let title = about.map_or_else(String::new, |s| escaped(&s.name)) + ": what defects cost";
    let subtitle = about.map_or_else(String::new, |s| {
        format!(
            "{} points as it is; wrong of the pairs that face each other, with 95 % intervals; {}",
            s.n_points,
            s.judge.words()
        )
    });
    let mut svg = format!("{START}\n{}{STYLE}", begin([WIDTH, height], &title, &subtitle));
    key(&mut svg, &names);
    for (i, kind) in kinds.iter().enumerate() {
        let [column, row] = [i % N_COLUMNS, i / N_COLUMNS].map(|v| v as f64);
        panel(&mut svg, cases, &names, *kind, [20.0 + column * PANEL[0], ABOVE + row * PANEL[1]]);
    }
    text(&mut svg, [28.0, height - 12.0], "subtitle", "start", &escaped(&below(cases)));
    svg.push_str("</svg>\n");
    svg
}

fn is_of(case: &Case, kind: DefectKind) -> bool {
    case.defect.is_some_and(|defect| defect.kind == kind)
}

/// Lists the settings in the order of their first rows.
fn names(cases: &[Case]) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for row in cases.iter().flat_map(|case| &case.rows) {
        if !found.contains(&row.setting.name.as_str()) {
            found.push(&row.setting.name);
        }
    }
    found
}

fn below(cases: &[Case]) -> String {
    let unbuilt = |case: &Case, row: &Row| match row.built() {
        Some(_) => None,
        None => Some(format!("{}, {}: not built", case.name(), row.setting.name)),
    };
    let told = cases.iter().flat_map(|case| case.rows.iter().filter_map(|r| unbuilt(case, r)));
    told.collect::<Vec<_>>().join("; ")
}

/// Gives what a setting gave on the scans of a kind, and on the scan as it is.
fn spots<'a>(cases: &'a [Case], name: &str, kind: DefectKind) -> (Vec<Spot<'a>>, Option<Spot<'a>>) {
    let spot = |case: &'a Case, value: f64| {
        let row = case.rows.iter().find(|row| row.setting.name == name)?;
        Some(Spot { value, built: row.built()? })
    };
    let of_kind = cases.iter().filter(|case| is_of(case, kind));
    let mut found: Vec<Spot<'a>> =
        of_kind.filter_map(|case| spot(case, case.defect?.value)).collect();
    let plain = cases.iter().find(|case| case.defect.is_none());
    let plain = plain.and_then(|case| spot(case, kind.plain_value(case.subject.n_points)));
    let dashed = match plain {
        // Where the scan as it is has a value that an axis of powers has, it is one of them.
        Some(spot) if spot.value > 0.0 => {
            found.push(spot);
            None
        }
        plain => plain,
    };
    found.sort_by(|a, b| a.value.total_cmp(&b.value));
    (found, dashed)
}

fn panel(svg: &mut String, cases: &[Case], names: &[&str], kind: DefectKind, at: [f64; 2]) {
    let [left, right, above, below] = MARGINS;
    let [width, height] = [PANEL[0] - left - right, PANEL[1] - above - below];
    let values = cases.iter().filter_map(|case| match case.defect {
        Some(defect) => (defect.kind == kind).then_some(defect.value),
        None => Some(kind.plain_value(case.subject.n_points)),
    });
    // One scale for all panels.
    let built = || cases.iter().flat_map(|case| case.rows.iter().filter_map(Row::built));
    let errors = built().flat_map(|b| {
        let error = b.error();
        [error.value(), error.interval()[0], error.interval()[1]].map(|v| 100.0 * v)
    });
    if built().next().is_none() {
        return;
    }
    let x = Axis::over(values.filter(|&v| v > 0.0), [at[0] + left, width]);
    let y = Axis::over(errors.filter(|&v| v > 0.0), [at[1] + above + height, -height]);
    let percent_of = |v: f64| format!("{} %", plain(v));
    grid(svg, [&x, &y], [&|v| kind.label(v), &percent_of]);
    text(svg, [at[0] + left, at[1] + above - 9.0], "", "start", kind.words());
    let height_of = |built: &Built| y.at(100.0 * built.error().value());
    for (i, name) in names.iter().enumerate() {
        let color = COLORS[i % COLORS.len()];
        let (spots, dashed) = spots(cases, name, kind);
        if let Some(dashed) = dashed {
            let at_y = height_of(dashed.built);
            let ends = [[at[0] + left, at_y], [at[0] + left + width, at_y]];
            let _ = writeln!(svg, "<g stroke=\"{color}\">");
            stroke(svg, "plain", ends[0], ends[1]);
            svg.push_str("</g>\n");
        }
        course(svg, color, spots.iter().map(|s| [x.at(s.value), height_of(s.built)]));
        for spot in &spots {
            let interval = spot.built.error().interval().map(|v| y.at(100.0 * v));
            one(svg, (name, i), kind, spot, [x.at(spot.value), height_of(spot.built)], interval);
        }
    }
}

fn course(svg: &mut String, color: &str, places: impl Iterator<Item = [f64; 2]>) {
    let mut path = String::new();
    for [x, y] in places {
        let _ = write!(path, "{}{x:.1} {y:.1}", if path.is_empty() { 'M' } else { 'L' });
    }
    if !path.is_empty() {
        let _ = writeln!(svg, "<path class=\"course\" stroke=\"{color}\" d=\"{path}\"/>");
    }
}

/// Draws a setting on a scan: its interval, its mark, and what is told where a pointer rests on it.
fn one(
    svg: &mut String,
    (name, i): (&str, usize),
    kind: DefectKind,
    spot: &Spot<'_>,
    at: [f64; 2],
    [low, high]: [f64; 2],
) {
    let color = COLORS[i % COLORS.len()];
    let _ = writeln!(
        svg,
        "<g class=\"scan\"><title>{}, {} {}: error {:.3} %, {:.2} s</title>",
        escaped(name),
        kind.word(),
        kind.label(spot.value),
        100.0 * spot.built.error().value(),
        spot.built.seconds
    );
    let _ = writeln!(
        svg,
        "<path class=\"interval\" stroke=\"{color}\" d=\"M{x:.1} {low:.1}L{x:.1} {high:.1}\"/>",
        x = at[0]
    );
    mark(svg, at, color, i, true);
    svg.push_str("</g>\n");
}

/// Writes what the marks mean.
fn key(svg: &mut String, names: &[&str]) {
    let mut at = [34.0, 86.0];
    for (i, name) in names.iter().enumerate() {
        mark(svg, at, COLORS[i % COLORS.len()], i, true);
        text(svg, [at[0] + 10.0, at[1] + 4.0], "", "start", &escaped(name));
        at[0] += 34.0 + LETTER * name.chars().count() as f64;
    }
    text(svg, [WIDTH - 28.0, at[1] + 4.0], "subtitle", "end", "dashed: the scan as it is");
}
