//! Drawings as SVG text: axes of powers of ten, grids, marks, lines and letters.

use std::fmt::Write;

/// Blue, vermilion, green and purple, which also the colour-blind tell apart.
pub const COLORS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#aa4499"];

/// The height of a line of letters, and about the width of one letter.
pub const LETTER: [f64; 2] = [14.0, 6.9];

const STYLE: &str = "\
text { font-family: 'DejaVu Sans', Verdana, sans-serif; font-size: 12px; fill: #333 }
.title { font-size: 20px; font-weight: bold; fill: #111 }
.subtitle { fill: #666 }
.figure { font-size: 14px; font-weight: bold; fill: #111 }
.decade { stroke: #ccc } .between { stroke: #eee } .frame { stroke: #888; fill: none }
.fit { stroke-width: 1.2; stroke-dasharray: 5 4; opacity: 0.75 }
.measured { stroke-width: 2; fill: none }
";

/// Begins a drawing of a width and height with a title; `</svg>` ends it.
pub fn begin([width, height]: [f64; 2], title: &str, subtitle: &str) -> String {
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\">\n<style>{STYLE}</style>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    text(&mut svg, [28.0, 38.0], "title", "start", title);
    text(&mut svg, [28.0, 60.0], "subtitle", "start", subtitle);
    svg
}

/// An axis of powers of ten.
#[derive(Debug)]
pub struct Axis {
    low: f64,
    high: f64,
    /// Where it starts, and how far and in which direction it goes.
    place: [f64; 2],
}

impl Axis {
    /// Spans positive values, of which there are some, from one round number to another.
    pub fn over(values: impl Iterator<Item = f64> + Clone, place: [f64; 2]) -> Axis {
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

    /// Gives where a value lies; what is below the axis, such as 0, lies at its beginning.
    pub fn at(&self, v: f64) -> f64 {
        let v = v.max(self.low);
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

/// Draws the lines of two axes and writes at them what `labels` make of their values.
pub fn grid(svg: &mut String, [x, y]: [&Axis; 2], labels: [&dyn Fn(f64) -> String; 2]) {
    let [x0, x1, y0, y1] = [x.at(x.low), x.at(x.high), y.at(y.low), y.at(y.high)];
    for (multiple, v) in x.ticks() {
        let (at, class) = (x.at(v), if multiple == 1 { "decade" } else { "between" });
        stroke(svg, class, [at, y0], [at, y1]);
        if x.is_labelled(multiple) {
            text(svg, [at, y0 + 18.0], "", "middle", &labels[0](v));
        }
    }
    for (multiple, v) in y.ticks() {
        let (at, class) = (y.at(v), if multiple == 1 { "decade" } else { "between" });
        stroke(svg, class, [x0, at], [x1, at]);
        if y.is_labelled(multiple) {
            text(svg, [x0 - 8.0, at + 4.0], "", "end", &labels[1](v));
        }
    }
    let (width, height) = (x1 - x0, y0 - y1);
    let _ = writeln!(
        svg,
        "<rect class=\"frame\" x=\"{x0:.1}\" y=\"{y1:.1}\" \
         width=\"{width:.1}\" height=\"{height:.1}\"/>"
    );
}

/// Draws a circle, a square, a triangle or a diamond, full or hollow.
pub fn mark(svg: &mut String, [x, y]: [f64; 2], color: &str, shape: usize, is_full: bool) {
    let d = match shape % 4 {
        0 => "m-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z",
        1 => "m-4 -4h8v8h-8z",
        2 => "m0 -5.5l5 9h-10z",
        _ => "m0 -5.5l5.5 5.5l-5.5 5.5l-5.5 -5.5z",
    };
    let (fill, stroke, width) = if is_full { (color, "#fff", 1.0) } else { ("#fff", color, 1.6) };
    let _ = writeln!(
        svg,
        "<path d=\"M{x:.1} {y:.1}{d}\" fill=\"{fill}\" stroke=\"{stroke}\" \
         stroke-width=\"{width}\"/>"
    );
}

/// Draws a line of a class.
pub fn stroke(svg: &mut String, class: &str, [x0, y0]: [f64; 2], [x1, y1]: [f64; 2]) {
    let _ = writeln!(svg, "<path class=\"{class}\" d=\"M{x0:.1} {y0:.1}L{x1:.1} {y1:.1}\"/>");
}

/// Writes letters, or elements within a text, of a class; the anchor is start, middle or end.
pub fn text(svg: &mut String, [x, y]: [f64; 2], class: &str, anchor: &str, content: &str) {
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" class=\"{class}\" \
         text-anchor=\"{anchor}\">{content}</text>"
    );
}

/// Writes a round number with its unit: 5 ms, 200, 10 k, 2 MB.
pub fn label(v: f64, unit: &str) -> String {
    let magnitudes =
        [(1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ")];
    // Powers of ten may be rounded down.
    let found = magnitudes.into_iter().find(|m| v * (1.0 + 1e-9) >= m.0);
    let (one, sign) = found.unwrap_or((1.0, ""));
    format!("{:.0} {sign}{unit}", v / one).trim_end().to_owned()
}

/// Makes letters of any text, such as the name of a file: XML knows no control characters.
pub fn escaped(text: &str) -> String {
    let mut found = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => found.push_str("&amp;"),
            '<' => found.push_str("&lt;"),
            '>' => found.push_str("&gt;"),
            '"' => found.push_str("&quot;"),
            c if c.is_control() => found.push('\u{fffd}'),
            '\u{fffe}'..='\u{ffff}' => found.push('\u{fffd}'),
            c => found.push(c),
        }
    }
    found
}

/// Draws a front as steps, of class `front`: what lies above them is beaten. Gives the areas that
/// they take: lowest and highest x and y.
pub fn steps(svg: &mut String, mut places: Vec<[f64; 2]>) -> Vec<[f64; 4]> {
    places.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let Some(first) = places.first() else { return Vec::new() };
    let mut path = format!("M{:.1} {:.1}", first[0], first[1]);
    let mut taken = Vec::new();
    for pair in places.windows(2) {
        let [[x0, y0], [x1, y1]] = [pair[0], pair[1]];
        let _ = write!(path, "H{x1:.1}V{y1:.1}");
        taken.extend([[x0, y0 - 1.0, x1, y0 + 1.0], [x1 - 1.0, y0, x1 + 1.0, y1]]);
    }
    let _ = writeln!(svg, "<path class=\"front\" d=\"{path}\"/>");
    taken
}

/// Gives the area that a mark takes.
pub fn around([x, y]: [f64; 2]) -> [f64; 4] {
    [x - 6.0, y - 6.0, x + 6.0, y + 6.0]
}

/// Writes a name beside its mark, within `bounds` and where nothing is `taken`; farther off with a
/// line to it, of class `leader`. Takes its own area.
pub fn name(
    svg: &mut String,
    name: &str,
    [x, y]: [f64; 2],
    bounds: [f64; 4],
    taken: &mut Vec<[f64; 4]>,
) {
    let width = LETTER[1] * name.chars().count() as f64;
    // Beside the mark, a little above or below it, then farther and farther off.
    let rises = (0..40).map(|i| 7.0 * f64::from(i));
    let places = rises.flat_map(|rise| {
        [(true, -rise), (true, rise), (false, -rise), (false, rise)]
            .map(|(is_right, off)| (is_right, [x, y + off]))
    });
    let box_of = |(is_right, [x, y]): (bool, [f64; 2])| {
        let begin = if is_right { x + 11.0 } else { x - 11.0 - width };
        [begin, y - 7.0, begin + width, y + 7.0]
    };
    let meets =
        |a: &[f64; 4], b: &[f64; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
    let is_free = |area: &[f64; 4]| {
        area[0] > bounds[0]
            && area[1] > bounds[1]
            && area[2] < bounds[2]
            && area[3] < bounds[3]
            && !taken.iter().any(|other| meets(area, other))
    };
    let mut places = places.map(|place| (place, box_of(place)));
    let beside = (true, [x, y]);
    let ((is_right, [at_x, at_y]), area) =
        places.find(|(_, area)| is_free(area)).unwrap_or((beside, box_of(beside)));
    let (edge, anchor) = if is_right { (at_x + 11.0, "start") } else { (at_x - 11.0, "end") };
    if (at_y - y).abs() > 1.5 * LETTER[0] {
        stroke(svg, "leader", [x, y], [edge, at_y]);
    }
    text(svg, [edge, at_y + 4.0], "", anchor, &escaped(name));
    taken.push(area);
}

/// Gives about the width of letters.
pub fn width_of(letters: &str) -> f64 {
    LETTER[1] * letters.chars().count() as f64
}
