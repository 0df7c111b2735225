//! The nightly benchmark fits and judges as it says: known growth comes out, equal tables pass,
//! doctored ones fail with a line that says why.

#![allow(clippy::unwrap_used)] // A panic is how a test fails.

#[path = "../benches/support"]
mod support {
    pub(crate) mod compare;
    pub(crate) mod growth;
    pub(crate) mod plot;
    pub(crate) mod power;
    pub(crate) mod row;
    pub(crate) mod table;
}

use support::compare::regressions;
use support::growth::Figure;
use support::power::Growth;
use support::row::Row;
use support::{plot, table};

/// Four builds whose seconds grow with exponent 1.5, instructions and links with 1.2 and 1.0, and
/// memory not at all.
fn rows(scene: &str) -> Vec<Row> {
    let row = |leaves: u64| {
        let grown = |exponent: f64| (leaves as f64).powf(exponent);
        Row {
            scene: scene.to_owned(),
            size: leaves / 1000 * 1000,
            points: 20 * leaves,
            leaves,
            leaf_pairs: leaves * (leaves - 1) / 2,
            links: 3 * leaves,
            map_bytes: 100 * leaves,
            visibility_seconds: 1e-6 * grown(1.5),
            build_seconds: 1e-5 * grown(1.5),
            peak_rss_anon_bytes: 1 << 20,
            temporary_bytes: 0,
            tests: 1000,
            exact: 16,
            instructions: (leaves < 20_000).then(|| (1e5 * grown(1.2)) as u64),
        }
    };
    [1_200, 3_100, 9_800, 31_000].map(row).to_vec()
}

fn exponent(figure: Figure, rows: &[Row]) -> f64 {
    let all: Vec<&Row> = rows.iter().collect();
    Growth::fit(&figure.points(&all)).unwrap().exponent
}

#[test]
fn powers_are_found_again() {
    let rows = rows("cave");
    for (figure, expected) in Figure::ALL.into_iter().zip([1.5, 1.2, 1.0, 0.0]) {
        assert!((exponent(figure, &rows) - expected).abs() < 1e-4, "{figure:?}");
    }
    let fit = Growth::fit(&[(10.0, 5.0), (1000.0, 500.0)]).unwrap();
    assert!((fit.factor - 0.5).abs() < 1e-12 && (fit.at(100.0) - 50.0).abs() < 1e-9);
}

#[test]
fn growth_needs_two_sizes() {
    for points in [&[][..], &[(7.0, 1.0)], &[(7.0, 1.0), (7.0, 2.0)]] {
        assert_eq!(Growth::fit(points), None);
    }
}

#[test]
fn a_table_comes_back_from_its_file_and_is_no_worse_than_itself() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rows.csv");
    let rows = [rows("empty"), rows("cave")].concat();
    table::write(&path, &rows).unwrap();
    let read = table::read(&path).unwrap();
    assert_eq!(read, rows);
    assert_eq!(read[0].exact_share(), 0.016);
    assert_eq!(regressions(&rows, &read), [""; 0]);
    std::fs::write(&path, "scene,size\nempty,many\n").unwrap();
    let message = table::read(&path).unwrap_err().to_string();
    assert!(message.contains("rows.csv"), "{message}");
}

#[test]
fn sixteen_per_cent_more_instructions_are_a_finding_fourteen_are_not() {
    let now = rows("packed");
    for (factor, n_findings) in [(1.14, 0), (1.16, 1)] {
        let mut before = now.clone();
        before[1].instructions = now[1].instructions.map(|n| (n as f64 / factor) as u64);
        let findings = regressions(&now, &before);
        assert_eq!(findings.len(), n_findings, "{findings:?}");
        let is_named = |f: &String| f.contains("packed at 3000") && f.contains("16.0 % more");
        assert!(findings.iter().all(is_named), "{findings:?}");
    }
}

#[test]
fn a_steeper_growth_is_a_finding_a_gentler_one_is_not() {
    let now = rows("furnished");
    for (by, n_findings) in [(-0.3, 0), (0.12, 0), (0.14, 1)] {
        let mut before = now.clone();
        for row in &mut before {
            let less = (row.leaves as f64).powf(-by);
            row.links = (row.links as f64 * less) as u64;
            // Seconds differ from run to run and are not judged.
            row.visibility_seconds *= less * less;
        }
        let findings = regressions(&now, &before);
        assert_eq!(findings.len(), n_findings, "{by}: {findings:?}");
        let expected = "furnished: links grow with exponent 1.000, before 0.860";
        assert!(findings.iter().all(|f| f == expected), "{findings:?}");
    }
}

#[test]
fn an_exponent_near_zero_has_some_room() {
    let now = rows("empty");
    for (by, n_findings) in [(0.04, 0), (0.06, 1)] {
        let mut before = now.clone();
        for row in &mut before {
            let less = (row.leaves as f64).powf(-by);
            row.peak_rss_anon_bytes = (row.peak_rss_anon_bytes as f64 * less) as u64;
        }
        assert_eq!(regressions(&now, &before).len(), n_findings);
    }
}

#[test]
fn rows_and_counts_that_are_missing_are_named_new_ones_are_welcome() {
    let before = [rows("empty"), rows("cave")].concat();
    let mut now = before.clone();
    now.remove(6);
    now[0].instructions = None;
    let findings = regressions(&now, &before);
    assert_eq!(findings.len(), 2, "{findings:?}");
    assert!(findings[0].starts_with("empty at 1000: instructions"), "{findings:?}");
    assert!(findings[1].starts_with("cave at 9000: in the earlier"), "{findings:?}");
    assert_eq!(regressions(&before, &rows("cave")), [""; 0]);
}

#[test]
fn the_plot_has_a_panel_a_figure_and_no_number_that_is_none() {
    let mut rows = [rows("empty"), rows("cave")].concat();
    let svg = plot::draw(&rows, "as measured");
    assert_eq!(svg.matches("leaves N").count(), 4);
    assert!(svg.contains(">N</tspan>") && svg.ends_with("</svg>\n"));
    for row in &mut rows {
        row.instructions = None;
    }
    let fewer = plot::draw(&rows, "as measured");
    assert_eq!(fewer.matches("leaves N").count(), 3);
    let one = plot::draw(&rows[..1], "as measured");
    for svg in [svg, fewer, one, plot::draw(&[], "")] {
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
