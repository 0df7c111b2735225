//! What `info` tells of a light file.

use pvmap::vmap::{FormatError, LightView};

use super::{Field, Fields, one, size, version, with_text};

/// Names of channels, where there are three.
const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// Tells all that stands in its head, and its texts.
///
/// # Errors
/// Where a text is damaged.
pub(super) fn fields(view: &LightView<'_>, n_bytes: usize) -> Result<Fields, FormatError> {
    let s = view.summary();
    let is_grey = s.n_channels == 1;
    let channels = if is_grey { "1 (all light)" } else { "3 (red, green, blue)" };
    let order = if s.order == 0 { "0 (pair by pair)".to_owned() } else { s.order.to_string() };
    let balance = if is_grey {
        Field::Group(flux(&s.balance[0]))
    } else {
        let channels = CHANNELS.into_iter().zip(&s.balance);
        Field::Group(channels.map(|(name, flows)| (name, Field::Group(flux(flows)))).collect())
    };
    Ok(vec![
        ("kind", one("light")),
        ("format", one(version(view.file().version()))),
        ("bytes", size(n_bytes)),
        ("map", one(format!("{:032x}", s.map))),
        ("surfels", one(s.n_surfels)),
        ("channels", with_text(s.n_channels, channels.to_owned())),
        ("order", with_text(s.order, order)),
        ("iterations", one(s.iterations)),
        ("error_target", one(s.error_target)),
        ("operator_error", one(s.operator_error)),
        ("row_error", one(s.row_error)),
        ("residual", one(s.residual)),
        ("exposure", one(s.exposure)),
        ("gloss", yes_or_no(view.has_gloss())),
        ("sky_view", yes_or_no(view.has_sky())),
        ("flux", balance),
        ("plan", lines(view.plan()?)),
        ("lights", lines(view.lights()?)),
    ])
}

fn yes_or_no(is: bool) -> Field {
    with_text(is, if is { "yes" } else { "no" }.to_owned())
}

/// Where the flux of a channel went.
fn flux(&[emitted, absorbed, escaped, clipped]: &[f64; 4]) -> Fields {
    vec![
        ("emitted", one(emitted)),
        ("absorbed", one(absorbed)),
        ("escaped", one(escaped)),
        ("cut_off", one(clipped)),
    ]
}

/// A text of several lines: as JSON a list of them.
fn lines(text: &str) -> Field {
    Field::Lines(text.lines().map(str::to_owned).collect())
}
