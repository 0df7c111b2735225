//! Is it worse than last time? Instruction counts and growth exponents against an earlier table.

use super::growth::{Figure, of_scene, scenes};
use super::power::Growth;
use super::row::Row;

/// What a figure may grow by before it is a finding: 15 %.
const TOLERANCE: f64 = 1.15;
/// What an exponent may rise by in any case: of one near 0, such as that of the links of an empty
/// room, 15 % are nothing.
const LEAST_RISE: f64 = 0.05;

/// What is the same from run to run. The exponents of seconds are not: on a busy machine those of
/// one build differ by a quarter, and the instructions stand for them.
const STEADY: [Figure; 3] = [Figure::Instructions, Figure::Links, Figure::Memory];

/// Compares a table with an earlier one; gives a line a finding, none if all is as well as before.
///
/// Exponents are fitted anew, to the inputs that both tables have.
pub(crate) fn regressions(new: &[Row], old: &[Row]) -> Vec<String> {
    let mut findings = Vec::new();
    let mut both = Vec::new();
    for before in old {
        match new.iter().find(|row| row.is_of_input_of(before)) {
            None => findings.push(format!("{}: in the earlier result, not in this", before.name())),
            Some(now) => {
                findings.extend(more_instructions(now, before));
                both.push((now.clone(), before.clone()));
            }
        }
    }
    let (new, old): (Vec<Row>, Vec<Row>) = both.into_iter().unzip();
    for scene in scenes(&old) {
        for figure in STEADY {
            findings.extend(steeper(figure, scene, &new, &old));
        }
    }
    findings
}

fn more_instructions(now: &Row, before: &Row) -> Option<String> {
    let name = now.name();
    match (now.instructions, before.instructions) {
        (_, None) => None,
        (None, Some(_)) => {
            Some(format!("{name}: instructions counted in the earlier result, not in this"))
        }
        (Some(n), Some(m)) if n as f64 > TOLERANCE * m as f64 => {
            let more = 100.0 * (n as f64 / m as f64 - 1.0);
            Some(format!("{name}: {n} instructions, {more:.1} % more than {m}"))
        }
        _ => None,
    }
}

/// Compares exponents over the rows that have the figure in both tables, which are in one order.
fn steeper(figure: Figure, scene: &str, new: &[Row], old: &[Row]) -> Option<String> {
    let (new, old) = (of_scene(new, scene), of_scene(old, scene));
    let pairs = new.into_iter().zip(old);
    let (new, old): (Vec<&Row>, Vec<&Row>) =
        pairs.filter(|(n, o)| figure.of(n).is_some() && figure.of(o).is_some()).unzip();
    let exponent = |rows: &[&Row]| Growth::fit(&figure.points(rows)).map(|g| g.exponent);
    let (now, before) = (exponent(&new)?, exponent(&old)?);
    let limit = (TOLERANCE * before).max(before + LEAST_RISE);
    (now > limit).then(|| {
        format!("{scene}: {} grow with exponent {now:.3}, before {before:.3}", figure.name())
    })
}
