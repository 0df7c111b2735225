//! What `info` tells of surfels that are far wider than what their points cover.

use pvmap::Watch;
use pvmap::query::{LEAST_CUT, Map, QueryError, WIDE_TIMES, WideSurfels};
use pvmap::vmap::{MapConfig, Surfel};
use serde_json::json;

use super::quality::short;
use super::{Field, with_text};

/// A spread that cuts strays and hardly anything else, and the least that spares even samples.
const SPREADS: [u16; 2] = [10, 3];

/// Names them in a line, if there are any.
///
/// # Errors
/// Where the map is damaged or the run is asked to stop.
pub(super) fn field(
    map: &Map<'_>,
    watch: &dyn Watch,
) -> Result<Option<(&'static str, Field)>, QueryError> {
    let Some(found) = pvmap::wide_surfels(map, watch)? else { return Ok(None) };
    let surfel = map.view().surfel(found.widest)?;
    let max_spread = MapConfig::of_text(map.view().config()?).map_or(0, |c| c.max_spread);
    let cure = cure(&found, max_spread);
    Ok(Some(("wide_surfels", told(map, &found, &surfel, cure))))
}

/// Gives the greatest spread that may cut some of them; none where no spread does.
fn cure(found: &WideSurfels, max_spread: u16) -> Option<u16> {
    let is_lower = |spread: &u16| max_spread == 0 || *spread < max_spread;
    SPREADS.into_iter().find(is_lower).filter(|_| found.n_uncut < found.n)
}

fn told(map: &Map<'_>, found: &WideSurfels, surfel: &Surfel, cure: Option<u16>) -> Field {
    let frame = &map.view().frame().frame;
    let WideSurfels { n, n_uncut, widest } = *found;
    let radius = (surfel.radius2 as f64).sqrt() * frame.unit();
    let at = frame.world_of(surfel.centroid);
    // A thousandth of the radius, so that the place can be asked about; a radius is above 0.
    let digits = (2.0 - radius.log10().floor()).clamp(0.0, 12.0) as usize;
    let (n_points, [x, y, z]) = (surfel.n_points, at.map(|v| format!("{v:.digits$}")));
    let few = match n_uncut {
        0 => String::new(),
        few => format!(", {few} of fewer than {LEAST_CUT} points"),
    };
    let advice = match cure {
        Some(spread) => format!("build --max-spread {spread} may cut them"),
        None if n_uncut == n => "no --max-spread cuts them: stray points of the scan".to_owned(),
        None => "--max-spread is as low as helps".to_owned(),
    };
    let text = format!(
        "{n} over {WIDE_TIMES} times as wide as their points cover{few}; widest: surfel {widest}, \
         radius {} scan units, {n_points} points, at {x},{y},{z}; {advice}",
        short(radius)
    );
    let worst = json!({ "surfel": widest, "radius": radius, "points": n_points, "at": at });
    let value = json!({
        "surfels": n,
        "of_fewer_than_4_points": n_uncut,
        "widest": worst,
        "max_spread_to_try": cure,
    });
    with_text(value, text)
}
