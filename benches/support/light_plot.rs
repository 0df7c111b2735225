//! How near light is to a path tracer's against what it costs, as SVG: once by the light alone,
//! once with the map, where a map is lit once.

use pvmap::svg::{Axis, COLORS, around, begin, grid, label, mark, name, steps, text, width_of};

use super::light_cost::Cost;

const WIDTH: f64 = 1120.0;
const HEIGHT: f64 = 640.0;
const PANEL_WIDTH: f64 = 560.0;
/// Around the axes of a panel: left, right, above, below.
const MARGINS: [f64; 4] = [76.0, 24.0, 116.0, 104.0];

/// Marks nearer than that to a named one have no name of their own.
const APART: f64 = 8.0;

const STYLE: &str = "\
<style>.front { stroke: #555; stroke-width: 1.2; stroke-dasharray: 2 3; fill: none } \
.leader { stroke: #bbb }</style>
";

/// Draws the rows: a mark a light, full where no other takes as little and is as near.
pub(crate) fn draw(rows: &[Cost]) -> String {
    let n_points = rows.first().map_or(0, |row| row.points);
    let subtitle = format!(
        "furnished Cornell room, {} points, albedo 0.7; mean of 256 places of floor and walls \
         against a path tracer; full: none takes as little and is as near",
        label(n_points as f64, "")
    );
    let mut svg = begin([WIDTH, HEIGHT], "What light costs", &subtitle) + STYLE;
    panel(&mut svg, 0.0, "processor seconds of the light", rows, |row| row.light_seconds);
    panel(&mut svg, PANEL_WIDTH, "processor seconds of map and light", rows, Cost::seconds);
    let mut at = [MARGINS[0], HEIGHT - 44.0];
    for (i, group) in GROUPS.into_iter().enumerate() {
        at[0] += entry(&mut svg, at, COLORS[i], 0, group);
    }
    at = [MARGINS[0], HEIGHT - 20.0];
    for (shape, way) in WAYS.into_iter().enumerate() {
        at[0] += entry(&mut svg, at, "#555", shape, way);
    }
    let names = "L: deepest level, c: most points a leaf";
    text(&mut svg, [at[0], at[1] + 4.0], "subtitle", "start", names);
    svg.push_str("</svg>\n");
    svg
}

const GROUPS: [&str; 4] =
    ["200 points a leaf", "50 points a leaf", "25 points a leaf", "50, far pairs left coarse"];
const WAYS: [&str; 3] = ["grids of an order, p1 to p5", "an error asked for", "pair by pair"];

/// Says which colour a map has: by its capacity.
fn color_of(row: &Cost) -> &'static str {
    let is_exact = row.map.starts_with('L');
    COLORS[match row.leaf_capacity {
        _ if !is_exact => 3,
        200 => 0,
        50 => 1,
        _ => 2,
    }]
}

/// Says which shape a light has: by what was asked for.
fn shape_of(row: &Cost) -> usize {
    match row.light.as_str() {
        "direct" => 2,
        light if light.starts_with('p') => 0,
        _ => 1,
    }
}

fn panel(
    svg: &mut String,
    begin: f64,
    caption: &str,
    rows: &[Cost],
    seconds: impl Fn(&Cost) -> f64,
) {
    let [left, right, above, below] = MARGINS;
    let [x0, width, height] = [begin + left, PANEL_WIDTH - left - right, HEIGHT - above - below];
    // No quicker than a tick of the clock.
    let seconds = |row: &Cost| seconds(row).max(0.01);
    let x = Axis::over(rows.iter().map(&seconds), [x0, width]);
    let y = Axis::over(rows.iter().map(|r| 100.0 * r.mean_error), [above + height, -height]);
    grid(svg, [&x, &y], [&|v| label(v, "s"), &|v| format!("{v} %")]);
    text(svg, [x0 + width, above + height + 38.0], "subtitle", "end", caption);
    text(svg, [x0 - 48.0, above - 14.0], "subtitle", "start", "mean error of irradiance");
    let place = |row: &Cost| [x.at(seconds(row)), y.at(100.0 * row.mean_error)];
    let is_beaten = |row: &Cost| {
        rows.iter().any(|other| {
            let (a, b) = ([seconds(other), other.mean_error], [seconds(row), row.mean_error]);
            a != b && a[0] <= b[0] && a[1] <= b[1]
        })
    };
    let (behind, front): (Vec<&Cost>, Vec<&Cost>) = rows.iter().partition(|row| is_beaten(row));
    let mut taken: Vec<[f64; 4]> = rows.iter().map(|row| around(place(row))).collect();
    taken.extend(steps(svg, front.iter().map(|row| place(row)).collect()));
    for (rows, is_front) in [(&behind, false), (&front, true)] {
        for row in rows {
            mark(svg, place(row), color_of(row), shape_of(row), is_front);
        }
    }
    let bounds = [x0, above, x0 + width, above + height];
    let mut named: Vec<[f64; 2]> = Vec::new();
    for row in front {
        let [x, y] = place(row);
        // Marks that lie on one another have one name.
        if named.iter().all(|at| (at[0] - x).abs().max((at[1] - y).abs()) > APART) {
            name(svg, &format!("{} {}", row.map, row.light), [x, y], bounds, &mut taken);
            named.push([x, y]);
        }
    }
}

/// Writes an entry of the key; gives its width.
fn entry(svg: &mut String, [x, y]: [f64; 2], color: &str, shape: usize, words: &str) -> f64 {
    mark(svg, [x, y], color, shape, true);
    text(svg, [x + 10.0, y + 4.0], "", "start", words);
    34.0 + width_of(words)
}
