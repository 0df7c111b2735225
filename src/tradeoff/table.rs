//! Rows as text for people and as CSV for programs.

use std::fmt::Write as _;
use std::io::Write;

use super::pareto::{Choice, Wish, choose, front};
use super::{Built, Clock, Judge, Outcome, Row, Setting, Share, Subject};

// The names of the columns of a setting.
macro_rules! setting_columns {
    () => {
        "setting,mode,tree,profile,spacing,max_level,leaf_capacity,max_spread,opening_angle,\
         min_form_factor,min_exchange,fractions"
    };
}
pub(super) use setting_columns;

/// The names of the columns of the CSV.
pub const CSV_HEADER: &str = concat!(
    setting_columns!(),
    ",outcome,build_seconds,visibility_seconds,cpu_seconds,\
     peak_rss_anon_bytes,leaves,links,map_bytes,query_seconds,judge,facing_pairs,wrongly_visible,\
     wrongly_visible_low,wrongly_visible_high,wrongly_invisible,wrongly_invisible_low,\
     wrongly_invisible_high,error,error_low,error_high,squared_error,on_front"
);

/// Writes the rows as CSV: shares 0…1 with the ends of their 95 % intervals, seconds, bytes. What
/// was not built has empty cells.
///
/// # Errors
/// Where `out` fails.
pub fn write_csv(
    out: &mut dyn Write,
    rows: &[Row],
    subject: &Subject,
) -> Result<(), std::io::Error> {
    writeln!(out, "{CSV_HEADER}")?;
    let mut writer = csv::Writer::from_writer(out);
    for (row, on_front) in rows.iter().zip(front(rows)) {
        writer.write_record(cells(row, subject, on_front))?;
    }
    writer.flush()
}

/// Gives the cells of a row.
pub(super) fn cells(row: &Row, subject: &Subject, on_front: bool) -> Vec<String> {
    let mut cells = setting_cells(&row.setting);
    cells.push(outcome_word(&row.outcome).to_owned());
    match row.built() {
        Some(built) => cells.extend(cells_of(built, subject.judge)),
        None => cells.extend(std::iter::repeat_n(String::new(), N_BUILT_CELLS)),
    }
    cells.push(on_front.to_string());
    cells
}

/// Gives the cells of a setting.
pub(super) fn setting_cells(setting: &Setting) -> Vec<String> {
    vec![
        setting.name.clone(),
        setting.mode(),
        setting.tree().to_owned(),
        setting.profile().to_owned(),
        setting.spacing().to_owned(),
        setting.config.max_level.to_string(),
        setting.config.leaf_capacity.to_string(),
        setting.config.max_spread.to_string(),
        setting.config.approximation.opening_angle.to_string(),
        setting.config.approximation.min_form_factor.to_string(),
        setting.config.approximation.min_exchange.to_string(),
        setting.config.fractions.to_string(),
    ]
}

/// Cells between the outcome and the last.
const N_BUILT_CELLS: usize = 20;

fn cells_of(built: &Built, judge: Judge) -> Vec<String> {
    let mut cells = vec![
        format!("{:.3}", built.build_seconds),
        format!("{:.3}", built.visibility_seconds),
        format!("{:.2}", built.cpu_seconds),
        built.peak_bytes.to_string(),
        built.n_leaves.to_string(),
        built.n_links.to_string(),
        built.map_bytes.to_string(),
        format!("{:.9}", built.query_seconds()),
        judge.word().to_owned(),
        built.tally.n_pairs.to_string(),
    ];
    for share in [built.false_visible(), built.false_invisible(), built.error()] {
        let [low, high] = share.interval();
        cells.extend([share.value(), low, high].map(|v| format!("{v:.7}")));
    }
    cells.push(format!("{:.7}", built.tally.squared_error()));
    cells
}

/// Gives the word for what became of a setting.
pub fn outcome_word(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Built(_) => "built",
        Outcome::Stopped(_) => "stopped",
        Outcome::NotBegun(_) => "not begun",
        Outcome::Same(_) => "same",
        Outcome::Refused(_) => "refused",
    }
}

/// Writes the rows as a table: a line of what it is about, a line a setting with a star on those
/// that no other beats, and last what is recommended.
pub fn text(rows: &[Row], subject: &Subject, wish: Option<Wish>) -> String {
    let mut text = subject_line(subject) + "\n\n";
    let width = rows.iter().map(|r| r.setting.name.chars().count()).max().unwrap_or(0).max(7);
    let mut head = |cells: [&str; 10]| {
        let [setting, seconds, memory, leaves, links, map, query, visible, invisible, both] = cells;
        let _ = writeln!(
            text,
            "  {setting:<width$} {seconds:>8} {memory:>10} {leaves:>8} {links:>10} {map:>10} \
             {query:>6}  {visible:<18} {invisible:<18} {both}"
        );
    };
    let [visible, invisible, both] = ["wrongly visible", "wrongly invisible", "error, both"];
    let seconds = match subject.clock {
        Clock::Wall => "seconds",
        Clock::Processor => "CPU s",
    };
    head([
        "setting", seconds, "memory", "leaves", "links", "map", "query", visible, invisible, both,
    ]);
    let percent = "% (95 %)";
    head(["", "", "", "", "", "", "µs", percent, percent, percent]);
    for (row, on_front) in rows.iter().zip(front(rows)) {
        let star = if on_front { '*' } else { ' ' };
        let _ = write!(text, "{star} {:<width$} ", row.setting.name);
        match row.built() {
            Some(built) => text += &figures(built),
            None => text += &row.outcome.why_not().unwrap_or_default(),
        }
        text.push('\n');
    }
    if rows.iter().any(|r| r.built().is_some()) {
        text += "\n* no other setting is as quick and as accurate\n";
    }
    text += &recommendation(rows, wish);
    text.push('\n');
    text
}

fn subject_line(subject: &Subject) -> String {
    let Subject { name, n_points, seed, n_drawn, n_left_out, n_facing, .. } = subject;
    let mut line = format!(
        "{name}, {n_points} points: {n_drawn} pairs drawn (seed {seed}), {n_facing} face each \
         other, {:.1} % of these see each other\n{}",
        100.0 * subject.n_visible as f64 / (*n_facing).max(1) as f64,
        subject.judge.words()
    );
    if *n_left_out > 0 {
        let _ = write!(line, "; {n_left_out} pairs left out, on none of its surfaces");
    }
    line
}

fn figures(built: &Built) -> String {
    format!(
        "{:>8.2} {:>10} {:>8} {:>10} {:>10} {:>6.2}  {:<18} {:<18} {}",
        built.seconds,
        mib(built.peak_bytes),
        built.n_leaves,
        built.n_links,
        mib(built.map_bytes),
        1e6 * built.query_seconds(),
        percent(built.false_visible()),
        percent(built.false_invisible()),
        percent(built.error())
    )
}

/// Writes a size: 12.3 MiB.
pub(super) fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / (1 << 20) as f64)
}

/// Writes a share with its interval, in per cent: 0.31 (0.27 – 0.36).
pub(super) fn percent(share: Share) -> String {
    let [low, high] = share.interval().map(|v| 100.0 * v);
    format!("{:.2} ({low:.2} – {high:.2})", 100.0 * share.value())
}

/// Says which setting to take, in a line.
pub fn recommendation(rows: &[Row], wish: Option<Wish>) -> String {
    let Some(wish) = wish else {
        return "say what you want for a recommendation: --want error=0.5% or --want time=30s"
            .to_owned();
    };
    match choose(rows, wish) {
        None => format!("nothing to recommend for {wish}: no setting was built"),
        Some(choice) => told(rows, wish, choice),
    }
}

fn told(rows: &[Row], wish: Wish, choice: Choice) -> String {
    let row = &rows[choice.row];
    let name = &row.setting.name;
    let Some(built) = row.built() else { return String::new() };
    let error = built.error();
    let share = format!(
        "error {:.2} %, at most {:.2} % (95 %)",
        100.0 * error.value(),
        100.0 * error.interval()[1]
    );
    let time = format!("{:.2} s", built.seconds);
    match (wish, choice.is_met) {
        (Wish::Error(_), true) => format!("recommended for {wish}: {name}, {time}; {share}"),
        (Wish::Time(_), true) => format!("recommended for {wish}: {name}, {share}; {time}"),
        (Wish::Error(_), false) => {
            format!("no setting is surely within {wish}; {name} comes nearest: {share}; {time}")
        }
        (Wish::Time(_), false) => {
            format!("no setting is within {wish}; {name} comes nearest: {time}; {share}")
        }
    }
}
