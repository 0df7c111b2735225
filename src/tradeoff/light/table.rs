//! Lights as text for people and as CSV for programs.

use std::fmt::Write as _;
use std::io::Write;

use super::{LightSubject, Lit, LitRow, choose, front};
use crate::tradeoff::Clock;
use crate::tradeoff::pareto::{Choice, Wish};
use crate::tradeoff::table::{mib, setting_cells, setting_columns};

/// The names of the columns of the CSV.
pub const CSV_HEADER: &str = concat!(
    setting_columns!(),
    ",light,outcome,build_seconds,build_cpu_seconds,build_peak_rss_anon_bytes,leaves,links,\
     map_bytes,light_seconds,light_cpu_seconds,light_peak_rss_anon_bytes,order,iterations,\
     operator_error,judge,judged,left_out,mean_error,bias,largest_error,on_front"
);

/// Writes the rows as CSV: the setting, the way, shares, seconds, bytes. What is not lit has empty
/// cells.
///
/// # Errors
/// Where `out` fails.
pub fn write_csv(
    out: &mut dyn Write,
    rows: &[LitRow],
    subject: &LightSubject,
) -> Result<(), std::io::Error> {
    writeln!(out, "{CSV_HEADER}")?;
    let mut writer = csv::Writer::from_writer(out);
    for (row, on_front) in rows.iter().zip(front(rows)) {
        let mut cells = setting_cells(&row.setting);
        cells.push(row.way.map(|way| way.name()).unwrap_or_default());
        cells.push(row.outcome.word().to_owned());
        match row.lit() {
            Some(lit) => cells.extend(cells_of(lit, subject)),
            None => cells.extend(std::iter::repeat_n(String::new(), N_LIT_CELLS)),
        }
        cells.push(on_front.to_string());
        writer.write_record(cells)?;
    }
    writer.flush()
}

/// Cells between the outcome and the last.
const N_LIT_CELLS: usize = 18;

fn cells_of(lit: &Lit, subject: &LightSubject) -> [String; N_LIT_CELLS] {
    let Lit { map, off, .. } = lit;
    let share = |v: f64| format!("{v:.9}");
    [
        format!("{:.3}", map.build_seconds),
        format!("{:.2}", map.cpu_seconds),
        map.peak_bytes.to_string(),
        map.n_leaves.to_string(),
        map.n_links.to_string(),
        map.map_bytes.to_string(),
        format!("{:.3}", lit.light_seconds),
        format!("{:.2}", lit.cpu_seconds),
        lit.peak_bytes.to_string(),
        lit.order.to_string(),
        lit.iterations.to_string(),
        format!("{:.3e}", lit.operator_error),
        subject.judge.word().to_owned(),
        off.n.to_string(),
        off.n_left_out.to_string(),
        share(off.mean),
        share(off.bias),
        share(off.largest),
    ]
}

/// Writes the rows as a table: a line of what it is about, a line a light with a star on those that
/// no other beats, and last what is recommended.
pub fn text(rows: &[LitRow], subject: &LightSubject, wish: Option<Wish>) -> String {
    let LightSubject { name, n_points, lights, judge, clock } = subject;
    let judge = judge.words();
    let mut text = format!("{name}, {n_points} points, lit by {lights}\n{judge}\n\n");
    let settings = rows.iter().map(|r| r.setting.name.chars().count()).max().unwrap_or(0).max(7);
    let mut head = |cells: [&str; 14]| {
        let [setting, way, map, light, both, memory, leaves, links, order, rounds, ..] = cells;
        let [.., mean, bias, largest, out] = cells;
        let _ = writeln!(
            text,
            "  {setting:<settings$} {way:<12} {map:>8} {light:>8} {both:>8} {memory:>10} \
             {leaves:>8} {links:>10} {order:>6} {rounds:>6} {mean:>8} {bias:>8} {largest:>8} \
             {out:>9}"
        );
    };
    head([
        "setting", "light", "map", "light", "both", "memory", "leaves", "links", "order", "rounds",
        "error", "bias", "largest", "left out",
    ]);
    let seconds = match clock {
        Clock::Wall => "s",
        Clock::Processor => "CPU s",
    };
    head(["", "", seconds, seconds, seconds, "", "", "", "", "", "%", "%", "%", ""]);
    for (row, on_front) in rows.iter().zip(front(rows)) {
        let star = if on_front { '*' } else { ' ' };
        let way = row.way.map(|way| way.name()).unwrap_or_default();
        let _ = write!(text, "{star} {:<settings$} {way:<12} ", row.setting.name);
        match row.lit() {
            Some(lit) => text += &figures(lit),
            None => text += &row.outcome.why_not().unwrap_or_default(),
        }
        text.push('\n');
    }
    if rows.iter().any(|row| row.lit().is_some()) {
        text += "\n* no other takes as little, map and light together, and is as near\n";
    }
    text += &recommendation(rows, wish);
    text.push('\n');
    text
}

fn figures(lit: &Lit) -> String {
    let Lit { map, off, .. } = lit;
    let order = if lit.order == 0 { "-".to_owned() } else { lit.order.to_string() };
    let [mean, bias, largest] = [off.mean, off.bias, off.largest].map(percent);
    format!(
        "{:>8.2} {:>8.2} {:>8.2} {:>10} {:>8} {:>10} {order:>6} {:>6} {mean:>8} {bias:>8} \
         {largest:>8} {:>9}",
        map.seconds,
        lit.seconds,
        lit.both_seconds(),
        mib(lit.peak_bytes),
        map.n_leaves,
        map.n_links,
        lit.iterations,
        off.n_left_out
    )
}

/// Writes a share in per cent: 12.35, 0.86, and what is small 0.0123.
pub fn percent(share: f64) -> String {
    let value = 100.0 * share;
    let digits = if value == 0.0 || value.abs() >= 0.1 { 2 } else { 4 };
    format!("{value:.digits$}")
}

/// Says which setting and way to take, in a line.
pub fn recommendation(rows: &[LitRow], wish: Option<Wish>) -> String {
    let Some(wish) = wish else {
        return "say what you want for a recommendation: --want error=1% or --want time=30s"
            .to_owned();
    };
    match choose(rows, wish) {
        None => format!("nothing to recommend for {wish}: nothing was lit"),
        Some(choice) => told(&rows[choice.row], wish, choice),
    }
}

fn told(row: &LitRow, wish: Wish, choice: Choice) -> String {
    let (name, Some(lit)) = (row.name(), row.lit()) else { return String::new() };
    let error = format!("error {} %", percent(lit.off.mean));
    let time = format!("{:.2} s for map and light", lit.both_seconds());
    match (wish, choice.is_met) {
        (Wish::Error(_), true) => format!("recommended for {wish}: {name}: {time}; {error}"),
        (Wish::Time(_), true) => format!("recommended for {wish}: {name}: {error}; {time}"),
        (Wish::Error(_), false) => {
            format!("no light is within {wish}; {name} comes nearest: {error}; {time}")
        }
        (Wish::Time(_), false) => {
            format!("no light is within {wish}; {name} comes nearest: {time}; {error}")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_shares_keep_their_digits() {
        for (share, told) in [
            (0.123_51, "12.35"),
            (-0.00861, "-0.86"),
            (1.23e-4, "0.0123"),
            (0.0, "0.00"),
            (1.0, "100.00"),
        ] {
            assert_eq!(percent(share), told);
        }
    }
}
