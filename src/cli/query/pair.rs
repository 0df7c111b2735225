//! `pvmap query MAP pair`: do two places see each other?

use std::io::{self, Write};
use std::process::ExitCode;

use pvmap::Error;
use pvmap::query::exact::{Exact, Verdict};
use pvmap::query::{Located, PairAnswer, Place};
use serde_json::{Value, json};

use super::{Asked, Outcome, commas, fraction, parse_distance, parse_point, place, segment};
use crate::cli::exact::PointsArgs;

/// Do two places see each other? Exit 0 for yes, 1 for no
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A place is answered for by the surfel (the disc that stands for some points) nearest to it. Where
two surfaces meet, at an edge or in a thin wall, a normal says which of them is meant; it need
not have length 1.

Answer:
  yes or no
  surfels   which surfels the places lie on
  distances how far from them, in the scan's units
  link      the two nodes that settle it, where the answer is yes
  settles   how many points lie in each of them: all of these see each other
  crowd     which surfels those are, the first and the last id of each node
  cells     where each node's cell is, lowest and highest corner, in the scan's units

With --segment the answer is that of the segment between the places themselves: no if a surfel
blocks it or one of the places looks away (by the normal given with it, where that is within 30° of
its surfel's). The map's own answer, about the surfels' centres, is told beside it. Take it where
single answers count: at silhouettes and in half shadow it is right more often, it needs no octree,
and it takes some microseconds more. Where a link of eight surfels or more on both sides holds for
the places, that settles it.
  leaves    whether the surfels say the same
  segment   what settles it: the link, or a surfel that blocks

With --fraction, of a map that was built with --fractions or --min-exchange, it is told how much the
two surfels see of each other: 0 to 1, in sixteenths. The answer stays that of their centres.
  fraction  the share, and between which nodes sixteen segments were tried, if they were

With --exact the answer is that of the scan's points nearest to the two places: no if so many
others have tangent planes that cross the line between them so near to themselves, away from both
ends. A point of known side does not count that noise put above an end, no farther than that: it
looks as the end does, and the line comes from behind it. What the surfels say is told beside it.
  leaves    whether the surfels say the same
  occluders points found in the way, of which the search ends with the last that it takes

Examples:
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6 --normal1 0,0,1 --snap 0.2 --json
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6 --segment
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6 --fraction
  pvmap query grotto.vmap pair 1.5,2,0.3 -4,5,6 --exact --delta 0.02 --k 2")]
pub(super) struct Args {
    /// One place, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X1,Y1,Z1")]
    a: [f64; 3],
    /// The other
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X2,Y2,Z2")]
    b: [f64; 3],
    /// Normal of the surface that the first place is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal1: Option<[f64; 3]>,
    /// Normal of the surface that the other is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal2: Option<[f64; 3]>,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_parser = parse_distance, allow_hyphen_values = true, value_name = "DIST")]
    #[arg(verbatim_doc_comment)]
    snap: Option<f64>,
    /// Ask the segment between the places instead of that between the
    /// centres of their surfels: right more often, and slower
    #[arg(long, conflicts_with = "exact", verbatim_doc_comment)]
    segment: bool,
    /// Tell how much the surfels see of each other, too, where the map was
    /// built with --fractions or --min-exchange
    #[arg(long, conflicts_with_all = ["exact", "segment"], verbatim_doc_comment)]
    fraction: bool,
    #[command(flatten)]
    points: PointsArgs,
    /// Answer as one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    if args.fraction {
        fraction::require(asked)?;
    }
    let places = [place(args.a, args.normal1), place(args.b, args.normal2)];
    let a = asked.locate(&places[0], args.snap)?;
    let b = asked.locate(&places[1], args.snap)?;
    let answer = asked.named(asked.map.pair(&a, &b))?;
    let exact = if args.points.exact { Some(ask_points(asked, args, &places)?) } else { None };
    let segment = match args.segment {
        true => {
            let spot = |place: &Place, at| asked.named(asked.map.spot(place, at));
            let ends = [spot(&places[0], a)?, spot(&places[1], b)?];
            Some(asked.named(asked.map.pair_by_segment(&ends[0], &ends[1]))?)
        }
        false => None,
    };
    let fraction = match args.fraction {
        true => Some(asked.named(asked.map.pair_fraction(&a, &b))?),
        false => None,
    };
    let of_segment = segment.as_ref().map(|answer| answer.visible);
    let of_points = exact.as_ref().map(|verdict| verdict.visible);
    let visible = of_points.or(of_segment).unwrap_or(answer.visible);
    let cells = match &answer.link {
        Some(link) => Some([
            asked.named(asked.map.cell_of(link.nodes.0))?,
            asked.named(asked.map.cell_of(link.nodes.1))?,
        ]),
        None => None,
    };
    if args.json {
        let mut object = as_json(&a, &b, &answer);
        if let Some(cells) = cells {
            object["link"]["cells"] = json!(cells);
        }
        if let Some(verdict) = &exact {
            object["leaves"] = json!(answer.visible);
            object["visible"] = json!(visible);
            object["exact"] = json!({
                "visible": verdict.visible,
                "occluders": verdict.occluders.len(),
                "points_read": verdict.work.n_points,
            });
        }
        if let Some(segment) = &segment {
            segment::add_to(&mut object, segment);
        }
        if let Some(fraction) = &fraction {
            fraction::add_to(&mut object, fraction);
        }
        asked.print_json(object)?;
    } else {
        let mut out = io::stdout().lock();
        writeln!(out, "{}", if visible { "yes" } else { "no" })?;
        if exact.is_some() || segment.is_some() {
            let said = if answer.visible { "yes" } else { "no" };
            writeln!(out, "  leaves    say {said}")?;
        }
        if let Some(verdict) = &exact {
            writeln!(out, "  occluders {}", verdict.occluders.len())?;
        }
        if let Some(segment) = &segment {
            writeln!(out, "  segment   {}", segment::words(segment.settled_by))?;
        }
        if let Some(fraction) = &fraction {
            fraction::write(&mut out, fraction)?;
        }
        write_leaves(&mut out, [&a, &b], &answer)?;
        for (i, [low, high]) in cells.into_iter().flatten().enumerate() {
            let title = ["cells", ""][i];
            writeln!(out, "  {title:9} {} to {}", commas(low), commas(high))?;
        }
    }
    Ok(ExitCode::from(u8::from(!visible)))
}

/// Writes the surfels of the places and the link between them.
fn write_leaves(
    out: &mut impl Write,
    [a, b]: [&Located; 2],
    answer: &PairAnswer,
) -> io::Result<()> {
    writeln!(out, "  surfels   {} and {}", a.surfel, b.surfel)?;
    writeln!(out, "  distances {} and {}", a.distance, b.distance)?;
    match &answer.link {
        Some(link) => {
            let ((na, nb), (pa, pb)) = (link.nodes, link.n_points);
            writeln!(out, "  link      nodes {na} and {nb}")?;
            writeln!(out, "  settles   {pa} points on one side, {pb} on the other")?;
            let ((a, b), (c, d)) = link.surfels;
            writeln!(out, "  crowd     surfels {a} to {} and {c} to {}", b - 1, d - 1)
        }
        None if answer.visible => writeln!(out, "  link      none: both lie on one surfel"),
        None => Ok(()),
    }
}

/// Asks the points of the octree. [V-7]
fn ask_points(asked: &Asked<'_, '_>, args: &Args, places: &[Place; 2]) -> Result<Verdict, Error> {
    let points = args.points.open(asked.path)?;
    let view = points.view()?;
    let ask = || {
        let exact = Exact::new(&view, args.points.nearness.options(asked.map)?);
        exact.require_map(asked.map)?;
        exact.pair(&exact.nearest(&places[0])?.point, &exact.nearest(&places[1])?.point)
    };
    ask().map_err(|e| points.named(asked.path, e))
}

/// Gives an answer with the places it is about.
pub(super) fn as_json(a: &Located, b: &Located, answer: &PairAnswer) -> Value {
    let link = answer.link.as_ref().map(|link| {
        json!({
            "nodes": [link.nodes.0, link.nodes.1],
            "points": [link.n_points.0, link.n_points.1],
            // The first and the last: as text says it.
            "surfels": [
                [link.surfels.0.0, link.surfels.0.1 - 1],
                [link.surfels.1.0, link.surfels.1.1 - 1],
            ],
        })
    });
    json!({
        "visible": answer.visible,
        "surfel1": a.surfel,
        "surfel2": b.surfel,
        "distance1": a.distance,
        "distance2": b.distance,
        "link": link,
    })
}
