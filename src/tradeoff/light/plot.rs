//! How far light is off against what it costs, as SVG: once by the light alone, for who has a map,
//! once with the map.

use std::fmt::Write;
use std::path::Path;

use super::table::{percent, recommendation};
use super::{LightJudge, LightSubject, Lit, LitOutcome, LitRow, Way, choose, figures};
use crate::svg::{
    Axis, COLORS, around, begin, escaped, grid, label, mark, name, steps, stroke, text, width_of,
};
use crate::tradeoff::pareto::{Wish, front_of};
use crate::tradeoff::plot::{START, STYLE, lines_of, plain, wrapped};
use crate::tradeoff::{Clock, Outcome, Setting};

const WIDTH: f64 = 1120.0;
/// Above all that is told below the panels.
const HEIGHT: f64 = 604.0;
const PANEL_WIDTH: f64 = 560.0;
/// Around the axes of a panel: left, right, above, below.
const MARGINS: [f64; 4] = [76.0, 24.0, 116.0, 68.0];
/// The height of a line below the panels.
const LINE: f64 = 22.0;
/// Marks nearer than that to a named one have no name of their own.
const APART: f64 = 8.0;
/// What is no error of any, in per cent: where all are 0 an axis needs a value.
const LEAST_PERCENT: f64 = 0.01;

/// What a panel shows: its caption by the clock, and the seconds.
struct Panel<'a> {
    caption: String,
    seconds: fn(&Lit) -> f64,
    /// Seconds that were wished for.
    wished: Option<f64>,
    rows: &'a [LitRow],
    groups: &'a [String],
}

/// Draws the rows: a mark a light, full where no other takes as little and is as near. What is not
/// lit is told below; of an error of 0 the mark lies on the axis.
pub fn draw(rows: &[LitRow], subject: &LightSubject, wish: Option<Wish>) -> String {
    let judge = match &subject.judge {
        LightJudge::Places { file, n } => LightJudge::Places { file: file_name(file), n: *n },
        LightJudge::Reference => LightJudge::Reference,
    };
    let title = format!("{}: what light costs", escaped(&file_name(&subject.name)));
    let subtitle = format!(
        "{} points, lit by {}; {}; full: no other takes as little and is as near",
        label(subject.n_points as f64, ""),
        escaped(&file_name(&subject.lights)),
        escaped(&judge.words())
    );
    let groups = groups(rows);
    let places = lines_of(WIDTH, groups.iter().map(|group| 34.0 + width_of(group)));
    let n_group_lines = places.last().map_or(0, |place| place.0 + 1);
    let below = below(rows, wish);
    let height = HEIGHT + LINE * (n_group_lines + 1 + below.len()) as f64;
    let mut svg = format!("{START}\n{}{STYLE}", begin([WIDTH, height], &title, &subtitle));
    let whose = match subject.clock {
        Clock::Wall => "seconds",
        Clock::Processor => "processor seconds, all threads together,",
    };
    if rows.iter().any(|row| row.lit().is_some()) {
        let time = match wish {
            Some(Wish::Time(t)) => Some(t),
            _ => None,
        };
        let (rows, groups) = (rows, &groups[..]);
        let caption = |of: &str| format!("{whose} of {of}");
        let alone = caption("the light");
        let seconds: fn(&Lit) -> f64 = |lit| lit.seconds;
        panel(&mut svg, 0.0, &Panel { caption: alone, seconds, wished: None, rows, groups }, wish);
        let (caption, seconds) = (caption("map and light"), Lit::both_seconds as fn(&Lit) -> f64);
        let both = Panel { caption, seconds, wished: time, rows, groups };
        panel(&mut svg, PANEL_WIDTH, &both, wish);
    }
    for (i, (group, (line, x))) in groups.iter().zip(&places).enumerate() {
        entry(&mut svg, [34.0 + x, HEIGHT + LINE * *line as f64], color_of(i), 0, group);
    }
    let mut at = [34.0, HEIGHT + LINE * n_group_lines as f64];
    for (shape, way) in WAYS.into_iter().enumerate() {
        at[0] += entry(&mut svg, at, "#555", shape, way);
    }
    for (line, told) in below.iter().rev().enumerate() {
        let at = [28.0, height - 14.0 - LINE * line as f64];
        text(&mut svg, at, "subtitle", "start", &escaped(told));
    }
    svg.push_str("</svg>\n");
    svg
}

/// Gives the name of a file: where it lies is nothing to a reader of the drawing.
fn file_name(path: &str) -> String {
    let name = Path::new(path).file_name().map(|name| name.to_string_lossy().into_owned());
    name.unwrap_or_else(|| path.to_owned())
}

const WAYS: [&str; 3] = ["multipoles of an order (p)", "an error asked for", "pair by pair"];

/// Says which shape a light has: by what was asked for.
fn shape_of(way: Way) -> usize {
    match way {
        Way::Order(_) => 0,
        Way::Error(_) => 1,
        Way::Direct => 2,
    }
}

/// Gives the colour of a group; beyond seven they come again.
fn color_of(group: usize) -> &'static str {
    // Amber, sky blue and black are told apart from the others, too. Source: Okabe and Ito.
    let more = ["#e69f00", "#56b4e9", "#222222"];
    let n = COLORS.len() + more.len();
    let all = COLORS.iter().chain(&more);
    all.copied().nth(group % n).unwrap_or(COLORS[0])
}

/// Gives what settings of a colour have in common: all but the depth, and how much is approximate.
fn group_of(setting: &Setting) -> String {
    let leaves = match setting.config.leaf_capacity {
        0 => "leaves at the deepest level".to_owned(),
        n => format!("{n} points a leaf"),
    };
    let plain = Setting::plain();
    let others = [
        (setting.tree() != plain.tree(), format!("{} tree", setting.tree())),
        (setting.profile() != plain.profile(), format!("{} profile", setting.profile())),
        (setting.spacing() != plain.spacing(), format!("spacing {}", setting.spacing())),
        (
            setting.config.max_spread != plain.config.max_spread,
            format!("spread {}", setting.config.max_spread),
        ),
        (setting.mode() != plain.mode(), setting.mode()),
    ];
    let others = others.into_iter().filter(|(is_other, _)| *is_other).map(|(_, words)| words);
    std::iter::once(leaves).chain(others).collect::<Vec<_>>().join(", ")
}

/// Gives the groups in the order of their first rows.
fn groups(rows: &[LitRow]) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for group in rows.iter().filter(|row| row.lit().is_some()).map(|row| group_of(&row.setting)) {
        if !found.contains(&group) {
            found.push(group);
        }
    }
    found
}

/// Says what was not lit, and what is recommended, in lines.
fn below(rows: &[LitRow], wish: Option<Wish>) -> Vec<String> {
    let told = rows.iter().filter_map(|row| {
        let why = match &row.outcome {
            // The whole reason is long.
            LitOutcome::Refused(_) => "not lit".to_owned(),
            LitOutcome::NoMap(Outcome::Refused(_)) => "map not built".to_owned(),
            LitOutcome::NoReference(_) => "no reference".to_owned(),
            outcome => outcome.why_not()?,
        };
        Some(format!("{}: {why}", row.name()))
    });
    let mut lines = wrapped(WIDTH, told.collect());
    lines.extend(wish.map(|wish| recommendation(rows, Some(wish))));
    lines
}

fn panel(svg: &mut String, begin: f64, of: &Panel<'_>, wish: Option<Wish>) {
    let [left, right, above, below] = MARGINS;
    let [x0, width, height] = [begin + left, PANEL_WIDTH - left - right, HEIGHT - above - below];
    let lights: Vec<(usize, &LitRow, Way, &Lit)> = of
        .rows
        .iter()
        .enumerate()
        .filter_map(|(i, row)| Some((i, row, row.way?, row.lit()?)))
        .collect();
    // No quicker than a tick of the clock.
    let seconds = |lit: &Lit| (of.seconds)(lit).max(0.01);
    let wished_error = match wish {
        Some(Wish::Error(e)) => Some(100.0 * e),
        _ => None,
    };
    let xs = lights.iter().map(|l| seconds(l.3)).chain(of.wished).filter(|&v| v > 0.0);
    let errors = lights.iter().map(|l| 100.0 * l.3.off.mean).chain(wished_error);
    let errors: Vec<f64> = errors.filter(|&v| v > 0.0).collect();
    let errors = if errors.is_empty() { vec![LEAST_PERCENT] } else { errors };
    let x = Axis::over(xs, [x0, width]);
    let y = Axis::over(errors.iter().copied(), [above + height, -height]);
    grid(svg, [&x, &y], [&|v| label(v, "s"), &|v| format!("{} %", plain(v))]);
    text(svg, [x0 + width, above + height + 38.0], "subtitle", "end", &of.caption);
    text(svg, [x0 - 48.0, above - 14.0], "subtitle", "start", "mean error of irradiance");
    let place = |lit: &Lit| [x.at(seconds(lit)), y.at(100.0 * lit.off.mean)];
    let mut taken: Vec<[f64; 4]> = lights.iter().map(|l| around(place(l.3))).collect();
    // Names may cross it: beside it there may be no room for them.
    if let Some(at) = of.wished.map(|t| x.at(t)) {
        stroke(svg, "wish", [at, above], [at, above + height]);
    }
    if let Some(at) = wished_error.map(|e| y.at(e)) {
        stroke(svg, "wish", [x0, at], [x0 + width, at]);
        taken.push([x0, at - 1.0, x0 + width, at + 1.0]);
    }
    let is_front = front_of(&figures(of.rows, |lit| (of.seconds)(lit)));
    let front: Vec<_> = lights.iter().filter(|l| is_front[l.0]).collect();
    taken.extend(steps(svg, front.iter().map(|l| place(l.3)).collect()));
    // What is on the front lies on top.
    for wants_front in [false, true] {
        for &(i, row, way, lit) in lights.iter().filter(|l| is_front[l.0] == wants_front) {
            let group = of.groups.iter().position(|g| *g == group_of(&row.setting)).unwrap_or(0);
            let _ = writeln!(svg, "<g class=\"light\"><title>{}</title>", told(row, lit));
            mark(svg, place(lit), color_of(group), shape_of(way), is_front[i]);
            svg.push_str("</g>\n");
        }
    }
    // What is recommended is so by the seconds of both.
    let chosen = wish.filter(|_| begin > 0.0).and_then(|wish| choose(of.rows, wish));
    if let Some(lit) = chosen.and_then(|choice| of.rows[choice.row].lit()) {
        let [x, y] = place(lit);
        let _ = writeln!(svg, "<circle class=\"chosen\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\"/>");
    }
    let bounds = [x0, above, x0 + width, above + height];
    let mut named: Vec<[f64; 2]> = Vec::new();
    for (_, row, way, lit) in front {
        let [x, y] = place(lit);
        // Marks that lie on one another have one name.
        if named.iter().all(|at| (at[0] - x).abs().max((at[1] - y).abs()) > APART) {
            let words = format!("{}, {}", row.setting.name, short(*way));
            name(svg, &words, [x, y], bounds, &mut taken);
            named.push([x, y]);
        }
    }
}

/// Gives what a way is called beside its mark, whose shape says the rest: "p3", "1 %".
fn short(way: Way) -> String {
    match way {
        Way::Order(p) => format!("p{p}"),
        Way::Direct => "direct".to_owned(),
        Way::Error(_) => way.name().replace("error ", ""),
    }
}

/// Says what a mark is, where a pointer rests on it.
fn told(row: &LitRow, lit: &Lit) -> String {
    format!(
        "{}: light {:.2} s, map {:.2} s, error {} %, at the most {} %",
        escaped(&row.name()),
        lit.seconds,
        lit.map.seconds,
        percent(lit.off.mean),
        percent(lit.off.largest)
    )
}

/// Writes an entry of the key; gives its width.
fn entry(svg: &mut String, [x, y]: [f64; 2], color: &str, shape: usize, words: &str) -> f64 {
    mark(svg, [x, y], color, shape, true);
    text(svg, [x + 10.0, y + 4.0], "", "start", words);
    34.0 + width_of(words)
}
