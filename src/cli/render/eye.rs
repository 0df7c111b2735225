//! What the place of `--visible-from` sees.

use pvmap::query::exact::{Exact, ExactOptions, PointSet};
use pvmap::query::{Map, Place, QueryError, Snap, SurfelSet};
use pvmap::render::held_bytes;
use pvmap::vmap::OctreeView;
use pvmap::{Error, Watch, memory};

use super::Args;
use crate::cli::Context;

/// A place and what it sees.
pub(super) struct Eye {
    pub(super) place: [f64; 3],
    /// World units from it to the surfel that answers for it.
    pub(super) distance: f64,
    pub(super) sees: Sees,
}

/// What a place sees, by those that are drawn.
pub(super) enum Sees {
    Surfels(SurfelSet),
    Points(PointSet),
}

/// What is looked at.
#[derive(Clone, Copy)]
pub(super) struct Scan<'s, 'a> {
    pub(super) map: &'s Map<'a>,
    pub(super) octree: Option<&'s OctreeView<'s>>,
    /// Whether the octree's points are drawn and not the map's surfels.
    pub(super) draws_points: bool,
}

/// Asks the map, or with `--exact` the points; says which surfel answers for the place.
pub(super) fn look(
    args: &Args,
    position: [f64; 3],
    scan: Scan<'_, '_>,
    context: &Context,
    fail: impl Fn(QueryError) -> Error,
) -> Result<Eye, Error> {
    let Scan { map, octree, draws_points } = scan;
    let place = Place { position, normal: args.normal.map(|n| n.map(|v| v as f32)) };
    let snap = args.snap.map_or(Snap::FourHalfSpacings, Snap::Within);
    let at = map.locate(&place, snap).map_err(&fail)?;
    let n_surfels = map.view().summary().n_surfels;
    let sees = match octree.filter(|_| args.exact) {
        None => Sees::Surfels(map.visible_from(&at).map_err(&fail)?.surfels),
        Some(octree) => {
            let exact = Exact::new(octree, options_of(args, map).map_err(&fail)?);
            // On an edge the point must be of the surface whose surfel answers.
            let normal = map.view().surfel(at.surfel).map_err(|e| fail(e.into()))?.normal;
            let normal = (normal != [0; 3]).then_some(normal.map(f32::from));
            let eye = exact.nearest(&Place { position, normal }).map_err(&fail)?.point;
            let watch = &context.progress;
            let tell = |n| {
                watch.advance(n);
                !watch.is_stopped()
            };
            if draws_points {
                let n_points = octree.summary().n_points;
                let held_bytes = PointSet::held_bytes(n_points) + held_bytes(args.size);
                memory::require("the picture and which points are seen", held_bytes, args.memory)?;
                watch.stage("exact", Some(n_points), "points");
                Sees::Points(exact.points_visible_from(&eye, &tell).map_err(&fail)?)
            } else {
                watch.stage("exact", Some(n_surfels.into()), "surfels");
                Sees::Surfels(exact.visible_from(map, &eye, &at, &tell).map_err(&fail)?)
            }
        }
    };
    let n_points = map.view().summary().n_points;
    let seen = match &sees {
        Sees::Surfels(seen) => format!("it sees {} of {n_surfels} surfels", seen.len()),
        Sees::Points(seen) => {
            format!("its nearest point sees {} of {n_points} points", seen.len())
        }
    };
    context.progress.note(&format!(
        "surfel {} answers for the place of --visible-from, {:.3e} away; {seen}",
        at.surfel, at.distance,
    ));
    Ok(Eye { place: position, distance: at.distance, sees })
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
