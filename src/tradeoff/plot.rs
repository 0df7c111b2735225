//! Error against seconds, as SVG: a mark a setting, with its interval, its name and the front.

use std::fmt::Write;
use std::path::Path;

use super::pareto::{Wish, choose, front};
use super::table::recommendation;
use super::{Built, Clock, Outcome, Row, Subject};
use crate::svg::{
    Axis, COLORS, LETTER, around, begin, escaped, grid, mark, name, steps, stroke, text, width_of,
};

/// What a drawing begins with: by it a file is known as one.
pub const START: &str = "<!-- pvmap tradeoff -->";

const WIDTH: f64 = 960.0;
const HEIGHT: f64 = 640.0;
/// Around the axes: left, right, above, below.
const MARGINS: [f64; 4] = [76.0, 28.0, 96.0, 72.0];
/// The height of a line below the axes.
const LINE: f64 = 20.0;

/// Classes of what is drawn of a sweep.
pub(super) const STYLE: &str = "\
<style>.interval { stroke-width: 1.4; opacity: 0.55 } .front { stroke: #555; stroke-width: 1.2; \
stroke-dasharray: 2 3; fill: none } .wish { stroke: #b00; stroke-width: 1; stroke-dasharray: 7 4 } \
.chosen { stroke: #b00; stroke-width: 1.6; fill: none } .leader { stroke: #bbb }</style>
";

/// Draws the rows. What was not built is told below; of an error of 0 the mark lies on the axis.
pub fn draw(rows: &[Row], subject: &Subject, wish: Option<Wish>) -> String {
    // Where the scan lies is nothing to a reader of the drawing.
    let scan = Path::new(&subject.name).file_name().map(|name| name.to_string_lossy());
    let scan = scan.as_deref().unwrap_or(&subject.name);
    let title = format!("{}: what accuracy costs", escaped(scan));
    let subtitle = format!(
        "{} points; wrong of {} pairs that face each other, with 95 % intervals; {}",
        subject.n_points,
        subject.n_facing,
        subject.judge.words()
    );
    let (groups, below) = (groups(rows), below(rows, wish));
    let lines = lines_of(WIDTH, groups.iter().map(|group| 34.0 + width_of(group)));
    let n_lines = lines.last().map_or(0, |place| place.0 + 1) + below.len();
    let height = HEIGHT + LINE * n_lines as f64;
    let mut svg = format!("{START}\n{}{STYLE}", begin([WIDTH, height], &title, &subtitle));
    let spots = spots(rows);
    if !spots.is_empty() {
        panel(&mut svg, rows, &spots, subject.clock, wish);
    }
    for (i, (group, (line, x))) in groups.iter().zip(&lines).enumerate() {
        let at = [34.0 + x, HEIGHT + LINE * *line as f64];
        mark(&mut svg, at, color_of(i), i, true);
        text(&mut svg, [at[0] + 10.0, at[1] + 4.0], "", "start", group);
    }
    for (line, told) in below.iter().rev().enumerate() {
        let at = [28.0, height - 14.0 - LINE * line as f64];
        text(&mut svg, at, "subtitle", "start", &escaped(told));
    }
    svg.push_str("</svg>\n");
    svg
}

/// A setting that was built, and what is drawn of it.
struct Spot<'a> {
    row: usize,
    name: &'a str,
    built: &'a Built,
    group: usize,
    is_front: bool,
}

/// Gives what rows of a colour and shape have in common.
fn group_of(row: &Row) -> String {
    let setting = &row.setting;
    let plain = format!("{} tree, {} profile", setting.tree(), setting.profile());
    if setting.mode() == "exact" { plain } else { format!("{plain}, {}", setting.mode()) }
}

/// Gives the groups in the order of their first rows.
fn groups(rows: &[Row]) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for group in rows.iter().filter(|r| r.built().is_some()).map(group_of) {
        if !found.contains(&group) {
            found.push(group);
        }
    }
    found
}

fn spots(rows: &[Row]) -> Vec<Spot<'_>> {
    let groups = groups(rows);
    let spot = |((row, r), is_front): ((usize, &'_ Row), bool)| {
        let group = groups.iter().position(|g| *g == group_of(r)).unwrap_or(0);
        (row, group, is_front)
    };
    let found = rows.iter().enumerate().zip(front(rows)).map(spot);
    found
        .filter_map(|(row, group, is_front)| {
            let name = &rows[row].setting.name;
            Some(Spot { row, name, built: rows[row].built()?, group, is_front })
        })
        .collect()
}

/// Gives the color of a group; with its shape it is its own up to sixteen groups.
fn color_of(group: usize) -> &'static str {
    COLORS[(group + group / COLORS.len()) % COLORS.len()]
}

/// Sets things of these widths one after the other, in lines within a drawing so wide: the line of
/// each, and where it begins there.
pub(super) fn lines_of(most_width: f64, widths: impl Iterator<Item = f64>) -> Vec<(usize, f64)> {
    let mut next = (0, 0.0);
    let place = |width: f64| {
        if next.1 + width > most_width - 34.0 && next.1 > 0.0 {
            next = (next.0 + 1, 0.0);
        }
        let here = next;
        next.1 += width;
        here
    };
    widths.map(place).collect()
}

/// Sets what is told in lines within a drawing so wide.
pub(super) fn wrapped(most_width: f64, told: Vec<String>) -> Vec<String> {
    let widths = told.iter().map(|told| width_of(told) + 2.0 * LETTER[1]);
    let places = lines_of(most_width, widths);
    let mut lines: Vec<String> = Vec::new();
    for (told, (line, _)) in told.into_iter().zip(places) {
        match lines.get_mut(line) {
            Some(before) => *before += &format!("; {told}"),
            None => lines.push(told),
        }
    }
    lines
}

/// Says what was not built, and what is recommended, in lines.
fn below(rows: &[Row], wish: Option<Wish>) -> Vec<String> {
    let told = rows.iter().filter_map(|row| {
        let why = match &row.outcome {
            // The whole reason is long.
            Outcome::Refused(_) => "not built".to_owned(),
            outcome => outcome.why_not()?,
        };
        Some(format!("{}: {why}", row.setting.name))
    });
    let mut lines = wrapped(WIDTH, told.collect());
    lines.extend(wish.map(|wish| recommendation(rows, Some(wish))));
    lines
}

fn panel(svg: &mut String, rows: &[Row], spots: &[Spot<'_>], clock: Clock, wish: Option<Wish>) {
    let [left, right, above, below] = MARGINS;
    let [width, height] = [WIDTH - left - right, HEIGHT - above - below];
    let seconds = spots.iter().map(|s| s.built.seconds.max(1e-3));
    let errors = spots.iter().flat_map(|s| {
        let error = s.built.error();
        [error.value(), error.interval()[0], error.interval()[1]]
    });
    let wished = |is_time: bool| match wish {
        Some(Wish::Time(t)) if is_time => Some(t),
        Some(Wish::Error(e)) if !is_time => Some(e),
        _ => None,
    };
    let xs = seconds.chain(wished(true)).filter(|&v| v > 0.0);
    let ys = errors.chain(wished(false)).map(|v| 100.0 * v).filter(|&v| v > 0.0);
    let x = Axis::over(xs, [left, width]);
    let y = Axis::over(ys, [above + height, -height]);
    let seconds_of = |v: f64| format!("{} s", plain(v));
    let percent_of = |v: f64| format!("{} %", plain(v));
    grid(svg, [&x, &y], [&seconds_of, &percent_of]);
    let seconds = match clock {
        Clock::Wall => "seconds of the build",
        Clock::Processor => "processor seconds of the build, all threads together",
    };
    text(svg, [left + width, HEIGHT - 36.0], "subtitle", "end", seconds);
    text(svg, [left - 48.0, above - 14.0], "subtitle", "start", "pairs answered wrongly");
    let place =
        |built: &Built| [x.at(built.seconds.max(1e-3)), y.at(100.0 * built.error().value())];
    let chosen = wish.and_then(|wish| choose(rows, wish)).map(|choice| choice.row);
    let mut taken: Vec<[f64; 4]> = spots.iter().map(|s| around(place(s.built))).collect();
    taken.extend(spots.iter().map(|s| {
        let ([x, _], [low, high]) = (place(s.built), s.built.error().interval());
        [x - 1.0, y.at(100.0 * high), x + 1.0, y.at(100.0 * low)]
    }));
    if let Some(at) = wished(true).map(|t| x.at(t)) {
        stroke(svg, "wish", [at, above], [at, above + height]);
        taken.push([at - 1.0, above, at + 1.0, above + height]);
    }
    if let Some(at) = wished(false).map(|e| y.at(100.0 * e)) {
        stroke(svg, "wish", [left, at], [left + width, at]);
        taken.push([left, at - 1.0, left + width, at + 1.0]);
    }
    let front = spots.iter().filter(|s| s.is_front).map(|s| place(s.built)).collect();
    taken.extend(steps(svg, front));
    for spot in spots {
        let at = place(spot.built);
        let interval = spot.built.error().interval().map(|v| y.at(100.0 * v));
        one(svg, spot, at, interval);
        if chosen == Some(spot.row) {
            let [x, y] = at;
            let _ = writeln!(svg, "<circle class=\"chosen\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\"/>");
        }
    }
    let bounds = [left, above, left + width, above + height];
    // The front is named first, where there is room.
    for is_front in [true, false] {
        for spot in spots.iter().filter(|s| s.is_front == is_front) {
            name(svg, spot.name, place(spot.built), bounds, &mut taken);
        }
    }
    text(svg, [WIDTH - 28.0, above - 10.0], "subtitle", "end", "full: no setting beats it");
}

/// Draws a setting: its interval, its mark, and what is told where a pointer rests on it.
fn one(svg: &mut String, spot: &Spot<'_>, at: [f64; 2], [low, high]: [f64; 2]) {
    let color = color_of(spot.group);
    let built = spot.built;
    let _ = writeln!(
        svg,
        "<g class=\"setting\"><title>{}: {:.2} s, error {:.3} %, {} leaves, {} links</title>",
        escaped(spot.name),
        built.seconds,
        100.0 * built.error().value(),
        built.n_leaves,
        built.n_links
    );
    let _ = writeln!(
        svg,
        "<path class=\"interval\" stroke=\"{color}\" d=\"M{x:.1} {low:.1}L{x:.1} {high:.1}\"/>",
        x = at[0]
    );
    mark(svg, at, color, spot.group, spot.is_front);
    svg.push_str("</g>\n");
}

/// Writes a round number without needless zeros: 0.05, 2, 100.
pub(super) fn plain(v: f64) -> String {
    let rounded = format!("{v:.6}");
    rounded.trim_end_matches('0').trim_end_matches('.').to_owned()
}
