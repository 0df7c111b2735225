//! How figures grow, drawn: a panel a figure, double-logarithmic, a line a scene, as SVG.

use std::fmt::Write;

use super::growth::{Figure, Growth, of_scene, scenes};
use super::row::Row;

const WIDTH: f64 = 1120.0;
const HEAD: f64 = 84.0;
const PANEL_WIDTH: f64 = 560.0;
const PANEL_HEIGHT: f64 = 410.0;
/// Around the axes of a panel: left, right, above, below.
const MARGINS: [f64; 4] = [76.0, 24.0, 56.0, 56.0];
/// Blue, vermilion, green and purple, which also the colour-blind tell apart.
const COLORS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#aa4499"];

const STYLE: &str = "\
text { font-family: 'DejaVu Sans', Verdana, sans-serif; font-size: 12px; fill: #333 }
.title { font-size: 20px; font-weight: bold; fill: #111 }
.subtitle { fill: #666 }
.figure { font-size: 14px; font-weight: bold; fill: #111 }
.decade { stroke: #ccc } .between { stroke: #eee } .frame { stroke: #888; fill: none }
.fit { stroke-width: 1.2; stroke-dasharray: 5 4; opacity: 0.75 }
.measured { stroke-width: 2; fill: none }
";

/// Draws the figures of a table; what was not measured has no panel.
pub(crate) fn draw(rows: &[Row], subtitle: &str) -> String {
    let all: Vec<&Row> = rows.iter().collect();
    let measured: Vec<Figure> =
        Figure::ALL.into_iter().filter(|figure| !figure.points(&all).is_empty()).collect();
    let height = HEAD + PANEL_HEIGHT * measured.len().div_ceil(2) as f64;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH} {height}\">\n<style>{STYLE}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    text(&mut svg, [28.0, 38.0], "title", "start", "Visibility maps: growth with the leaves");
    text(&mut svg, [28.0, 60.0], "subtitle", "start", subtitle);
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
    grid(svg, [&x, &y], unit);
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
            mark(svg, [x.at(p.0), y.at(p.1)], color, i);
        }
        mark(svg, key_at, color, i);
        key_at[0] += key(svg, key_at, scene, growth.as_ref());
    }
}

/// An axis of powers of ten.
#[derive(Debug)]
struct Axis {
    low: f64,
    high: f64,
    /// Where it starts, and how far and in which direction it goes.
    place: [f64; 2],
}

impl Axis {
    /// Spans positive values, of which there are some, from one round number to another.
    fn over(values: impl Iterator<Item = f64> + Clone, place: [f64; 2]) -> Axis {
        let low = values.clone().fold(f64::INFINITY, f64::min) / 1.2;
        let high = values.fold(0.0, f64::max) * 1.2;
        let round = |v: f64| {
            let decade = 10f64.powf(v.log10().floor());
            [1.0, 2.0, 5.0, 10.0].map(|m| m * decade)
        };
        let below = round(low).into_iter().rfind(|&r| r <= low).unwrap_or(low);
        let above = round(high).into_iter().find(|&r| r >= high).unwrap_or(high);
        Axis { low: below, high: above, place }
    }

    fn at(&self, v: f64) -> f64 {
        self.place[0] + self.place[1] * (v / self.low).log10() / (self.high / self.low).log10()
    }

    /// Gives the multiples of powers of ten on it, each with what it is a multiple by.
    fn ticks(&self) -> Vec<(u32, f64)> {
        let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let all =
            (first..=last).flat_map(|e| (1..10).map(move |m| (m, f64::from(m) * 10f64.powi(e))));
        let slack = 1.0 + 1e-9;
        all.filter(|t| t.1 * slack >= self.low && t.1 <= self.high * slack).collect()
    }

    /// Says whether a multiple has a label: on a short axis not only the powers.
    fn is_labelled(&self, multiple: u32) -> bool {
        let decades = (self.high / self.low).log10();
        multiple == 1 || (decades < 2.5 && (multiple == 2 || multiple == 5))
    }
}

fn grid(svg: &mut String, [x, y]: [&Axis; 2], unit: &str) {
    let [x0, x1, y0, y1] = [x.at(x.low), x.at(x.high), y.at(y.low), y.at(y.high)];
    for (multiple, v) in x.ticks() {
        let (at, class) = (x.at(v), if multiple == 1 { "decade" } else { "between" });
        stroke(svg, class, [at, y0], [at, y1]);
        if x.is_labelled(multiple) {
            text(svg, [at, y0 + 18.0], "", "middle", &label(v, ""));
        }
    }
    for (multiple, v) in y.ticks() {
        let (at, class) = (y.at(v), if multiple == 1 { "decade" } else { "between" });
        stroke(svg, class, [x0, at], [x1, at]);
        if y.is_labelled(multiple) {
            text(svg, [x0 - 8.0, at + 4.0], "", "end", &label(v, unit));
        }
    }
    let (width, height) = (x1 - x0, y0 - y1);
    let _ = writeln!(
        svg,
        "<rect class=\"frame\" x=\"{x0:.1}\" y=\"{y1:.1}\" \
         width=\"{width:.1}\" height=\"{height:.1}\"/>"
    );
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

/// Draws a circle, a square, a triangle or a diamond.
fn mark(svg: &mut String, [x, y]: [f64; 2], color: &str, shape: usize) {
    let d = match shape % 4 {
        0 => "m-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z",
        1 => "m-4 -4h8v8h-8z",
        2 => "m0 -5.5l5 9h-10z",
        _ => "m0 -5.5l5.5 5.5l-5.5 5.5l-5.5 -5.5z",
    };
    let _ = writeln!(
        svg,
        "<path d=\"M{x:.1} {y:.1}{d}\" fill=\"{color}\" stroke=\"#fff\" stroke-width=\"1\"/>"
    );
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

fn stroke(svg: &mut String, class: &str, [x0, y0]: [f64; 2], [x1, y1]: [f64; 2]) {
    let _ = writeln!(svg, "<path class=\"{class}\" d=\"M{x0:.1} {y0:.1}L{x1:.1} {y1:.1}\"/>");
}

fn text(svg: &mut String, [x, y]: [f64; 2], class: &str, anchor: &str, content: &str) {
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" class=\"{class}\" \
         text-anchor=\"{anchor}\">{content}</text>"
    );
}

/// Writes a round number with its unit: 5 ms, 200, 10 k, 2 MB.
fn label(v: f64, unit: &str) -> String {
    let magnitudes =
        [(1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ")];
    // Powers of ten may be rounded down.
    let found = magnitudes.into_iter().find(|m| v * (1.0 + 1e-9) >= m.0);
    let (one, sign) = found.unwrap_or((1.0, ""));
    format!("{:.0} {sign}{unit}", v / one).trim_end().to_owned()
}
