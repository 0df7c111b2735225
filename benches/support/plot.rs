//! How figures grow, drawn: a panel a figure, double-logarithmic, a line a scene, as SVG.

use std::fmt::Write;

use pvmap::svg::{Axis, COLORS, begin, grid, label, mark, text};

use super::growth::{Figure, of_scene, scenes};
use super::power::Growth;
use super::row::Row;

const WIDTH: f64 = 1120.0;
const HEAD: f64 = 84.0;
const PANEL_WIDTH: f64 = 560.0;
const PANEL_HEIGHT: f64 = 410.0;
/// Around the axes of a panel: left, right, above, below.
const MARGINS: [f64; 4] = [76.0, 24.0, 56.0, 56.0];

/// Draws the figures of a table; what was not measured has no panel.
pub(crate) fn draw(rows: &[Row], subtitle: &str) -> String {
    let all: Vec<&Row> = rows.iter().collect();
    let measured: Vec<Figure> =
        Figure::ALL.into_iter().filter(|figure| !figure.points(&all).is_empty()).collect();
    let height = HEAD + PANEL_HEIGHT * measured.len().div_ceil(2) as f64;
    let mut svg = begin([WIDTH, height], "Visibility maps: growth with the leaves", subtitle);
    for (i, figure) in measured.into_iter().enumerate() {
        let corner = [PANEL_WIDTH * (i % 2) as f64, HEAD + PANEL_HEIGHT * (i / 2) as f64];
        panel(&mut svg, corner, figure, rows);
    }
    svg.push_str("</svg>\n");
    svg
}

/// What stands over a panel, and its unit.
fn caption(figure: Figure) -> (&'static str, &'static str) {
    match figure {
        Figure::Seconds => ("Time of the visibility stage", "s"),
        Figure::Instructions => ("Instructions of the whole build", ""),
        Figure::Links => ("Links, each pair once", ""),
        Figure::Memory => ("Peak of anonymous memory", "B"),
    }
}

fn panel(svg: &mut String, corner: [f64; 2], figure: Figure, rows: &[Row]) {
    let all: Vec<&Row> = rows.iter().collect();
    let points = figure.points(&all);
    let (name, unit) = caption(figure);
    let [left, right, above, below] = MARGINS;
    let [begin, top] = [corner[0] + left, corner[1] + above];
    let [width, height] = [PANEL_WIDTH - left - right, PANEL_HEIGHT - above - below];
    let x = Axis::over(points.iter().map(|p| p.0), [begin, width]);
    let y = Axis::over(points.iter().map(|p| p.1), [top + height, -height]);
    text(svg, [begin, top - 34.0], "figure", "start", name);
    text(svg, [begin + width, top + height + 38.0], "subtitle", "end", "leaves N");
    grid(svg, [&x, &y], [&|v| label(v, ""), &|v| label(v, unit)]);
    let mut key_at = [begin + 6.0, top - 14.0];
    for (i, scene) in scenes(rows).into_iter().enumerate() {
        let color = COLORS[i % COLORS.len()];
        let points = figure.points(&of_scene(rows, scene));
        if points.is_empty() {
            continue;
        }
        let growth = Growth::fit(&points);
        line(svg, [&x, &y], &points, growth.as_ref(), color);
        for p in &points {
            mark(svg, [x.at(p.0), y.at(p.1)], color, i, true);
        }
        mark(svg, key_at, color, i, true);
        key_at[0] += key(svg, key_at, scene, growth.as_ref());
    }
}

/// Draws a line through what was measured, and the fit as a dashed line.
fn line(
    svg: &mut String,
    [x, y]: [&Axis; 2],
    points: &[(f64, f64)],
    growth: Option<&Growth>,
    color: &str,
) {
    if let (Some(growth), [first, .., last]) = (growth, points) {
        let [[x0, y0], [x1, y1]] = [first, last]
            .map(|p| [x.at(p.0), y.at(growth.at(p.0))].map(|v| (v * 10.0).round() / 10.0));
        let _ =
            writeln!(svg, "<path class=\"fit\" stroke=\"{color}\" d=\"M{x0} {y0}L{x1} {y1}\"/>");
    }
    let place = |p: &(f64, f64)| format!("{:.1},{:.1}", x.at(p.0), y.at(p.1));
    let path: Vec<String> = points.iter().map(place).collect();
    let path = path.join(" ");
    let _ = writeln!(svg, "<polyline class=\"measured\" stroke=\"{color}\" points=\"{path}\"/>");
}

/// Writes a scene's name and how its figure grows beside its mark; gives the width of it all.
fn key(svg: &mut String, [x, y]: [f64; 2], scene: &str, growth: Option<&Growth>) -> f64 {
    let power = growth.map_or(String::new(), |Growth { exponent, .. }| {
        format!("<tspan dx=\"5\">N</tspan><tspan dy=\"-5\" font-size=\"10\">{exponent:.2}</tspan>")
    });
    text(svg, [x + 10.0, y + 4.0], "", "start", &format!("{scene}{power}"));
    // About as wide as the letters are.
    6.6 * scene.chars().count() as f64 + if power.is_empty() { 36.0 } else { 76.0 }
}
