//! What the place of `--visible-from` sees.

use pvmap::query::exact::{Exact, ExactOptions};
use pvmap::query::{Map, Place, QueryError, Snap, SurfelSet};
use pvmap::vmap::OctreeView;
use pvmap::{Error, Watch};

use super::Args;
use crate::cli::Context;

/// A place and what it sees.
pub(super) struct Eye {
    pub(super) place: [f64; 3],
    /// World units from it to the surfel that answers for it.
    pub(super) distance: f64,
    pub(super) seen: SurfelSet,
}

/// Asks the map, or with `--exact` the points; says which surfel answers for the place.
pub(super) fn look(
    args: &Args,
    position: [f64; 3],
    map: &Map<'_>,
    octree: Option<&OctreeView<'_>>,
    context: &Context,
    fail: impl Fn(QueryError) -> Error,
) -> Result<Eye, Error> {
    let place = Place { position, normal: args.normal.map(|n| n.map(|v| v as f32)) };
    let snap = args.snap.map_or(Snap::FourHalfSpacings, Snap::Within);
    let at = map.locate(&place, snap).map_err(&fail)?;
    let seen = match octree.filter(|_| args.exact) {
        None => map.visible_from(&at).map_err(&fail)?.surfels,
        Some(octree) => {
            let n_surfels = map.view().summary().n_surfels;
            let watch = &context.progress;
            watch.stage("points", Some(n_surfels.into()), "surfels");
            let exact = Exact::new(octree, options_of(args, map).map_err(&fail)?);
            // On an edge the point must be of the surface whose surfel answers.
            let normal = map.view().surfel(at.surfel).map_err(|e| fail(e.into()))?.normal;
            let normal = (normal != [0; 3]).then_some(normal.map(f32::from));
            let eye = exact.nearest(&Place { position, normal }).map_err(&fail)?.point;
            let tell = |n| {
                watch.advance(n);
                !watch.is_stopped()
            };
            exact.visible_from(map, &eye, &at, &tell).map_err(&fail)?
        }
    };
    context.progress.note(&format!(
        "surfel {} answers for the place of --visible-from, {:.3e} away; it sees {} of {} surfels",
        at.surfel,
        at.distance,
        seen.len(),
        map.view().summary().n_surfels
    ));
    Ok(Eye { place: position, distance: at.distance, seen })
}

/// Takes Δ and K as given, or what leaves no specks: of points that lie at random π Δ²/(2h)² are
/// within Δ of a place, 3.1 for what a pair is asked with, so that 13 % of a shadow cast by one
/// surface would miss the second occluder. Four half spacings have 12.6; fewer than 5 are 0.5 %,
/// of two surfaces behind each other none, and on a rim half of them are as many.
fn options_of(args: &Args, map: &Map<'_>) -> Result<ExactOptions, QueryError> {
    match args.delta {
        Some(delta) => ExactOptions::in_units_of(&map.view().frame().frame, delta, args.k),
        None => {
            let usual = ExactOptions::usual(map)?;
            Ok(ExactOptions::new(usual.delta_grid().saturating_mul(2), args.k))
        }
    }
}
