//! What `info --quality` tells of the points of an octree.

use pvmap::query::quality::{CLASS_DEG, NormalQuality, Quality};
use pvmap::vmap::OctreeSummary;
use serde_json::{Value, json};

use super::{Field, Fields, one, with_text};

/// What each class of angles is called, from 0° up.
const CLASSES: [&str; 6] = ["to_15", "to_30", "to_45", "to_60", "to_75", "to_90"];
const _: () = assert!(CLASS_DEG == 15);

/// Describes a sample; lengths are in the scan's units, shares in percent.
pub(super) fn fields(quality: &Quality, summary: &OctreeSummary) -> Fields {
    let n = quality.n_sampled;
    let sampled = format!("{n} of {} points", summary.n_points);
    let spacing = quality.spacing.map_or_else(none, |s| {
        let text = format!("{} {} {} scan units", short(s[0]), short(s[1]), short(s[2]));
        with_text(json!({ "p5": s[0], "p50": s[1], "p95": s[2] }), text + " (5, 50, 95 %)")
    });
    let part = quality.thickness_of_spacing();
    let thickness =
        quality.thickness.map_or_else(none, |t| with_text(t, format!("{} scan units", short(t))));
    let mut fields = vec![
        ("sampled", with_text(n, sampled)),
        ("spacing", spacing),
        ("unevenness", quality.unevenness().map_or_else(none, |r| with_text(r, short(r)))),
        ("coincident_percent", percent(quality.n_coincident, n)),
        ("thickness", thickness),
        ("thickness_of_spacing", part.map_or_else(none, |p| with_text(p, format!("{p:.3}")))),
    ];
    fields.push(("rim_percent", percent(quality.n_rim, quality.n_inside_or_rim)));
    fields.extend(normals(&quality.normals, summary));
    fields
}

fn normals(normals: &NormalQuality, s: &OctreeSummary) -> Fields {
    let n_none = s.n_points - (s.n_normals_file + s.n_normals_estimated).min(s.n_points);
    let mut fields = vec![
        ("without_normal_percent", percent(n_none, s.n_points)),
        ("turned_percent", percent(normals.n_turned, normals.n_oriented)),
    ];
    if let Some(median) = normals.median_deg {
        let classes = CLASSES.into_iter().zip(normals.angles);
        let classes = classes.map(|(class, n)| (class, percent(n, normals.n_angles())));
        let median = ("median", with_text(median, format!("{median:.1}°")));
        fields
            .push(("angles_percent", Field::Group([median].into_iter().chain(classes).collect())));
        fields.push(("contradicts_points", one(normals.contradict_points())));
    }
    fields
}

fn none() -> Field {
    Field::One(Value::Null, Some("none".to_owned()))
}

/// Tells a share of which `k` of `n` were seen.
fn percent(k: u64, n: u64) -> Field {
    if n == 0 {
        return none();
    }
    let share = 100.0 * k as f64 / n as f64;
    with_text(share, format!("{share:.2}"))
}

/// Writes a length with four digits that count.
pub(super) fn short(v: f64) -> String {
    // What was written in digits is a number.
    format!("{v:.3e}").parse::<f64>().unwrap_or(v).to_string()
}
