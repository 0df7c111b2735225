//! `pvmap render`: a picture of a map or an octree.

use std::io::{self, BufWriter, IsTerminal};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::geometry::Frame;
use pvmap::query::Map;
use pvmap::render::{
    Camera, Clipped, ColorBy, Glossy, MAX_SIDE_PX, MapSplats, OctreeSplats, Paint, Picture,
    RenderError, Seen, Source, Style, Values, held_bytes, render, render_glossy,
};
use pvmap::vmap::container::kind_of;
use pvmap::vmap::octree::FILE_NAME;
use pvmap::vmap::{Kind, MapView, OctreeView};
use pvmap::{Error, Limits, StoreError, TableFile, Watch, memory, require_pair};

use self::args::{ColorName, Cull};
use self::eye::{Scan, Sees};
use super::exact::Points;
use super::{Context, Outcome, map_file, refuse_input};

mod args;
mod camera;
mod eye;
mod light;
mod values;

pub(super) use self::args::Args;

/// The dot at the eye. Source: the paper's Figure 7.
const MARK: [u8; 3] = [0, 225, 235];

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let limits = Limits { threads: args.threads, memory_bytes: args.memory };
    limits.run(|| make(args, context))??;
    Ok(ExitCode::SUCCESS)
}

fn make(args: &Args, context: &Context) -> Result<(), Error> {
    refuse_input(&args.output, &inputs(args))?;
    if pvmap::is_stdout(&args.output) && io::stdout().is_terminal() {
        let message = "a picture is not for a terminal; give -o OUT.png or send it on".to_owned();
        return Err(Error::Usage(message));
    }
    check(args)?;
    let (path, bytes) = map_file(&args.file)?;
    // Before anything that takes time: can it be written?
    let output = TableFile::create(&args.output)?;
    let picture = match kind_of(&bytes) {
        Some(Kind::Octree) => of_octree(args, &path, &bytes, context)?,
        _ => of_map(args, &path, &bytes, context)?,
    };
    let mut out = BufWriter::new(output);
    picture.write_png(&mut out).map_err(|e| named(&args.output, &args.output, e))?;
    let fail = |e: io::IntoInnerError<_>| StoreError::io(&args.output, "write", e.into_error());
    Ok(out.into_inner().map_err(fail)?.commit()?)
}

/// Refuses what does not go together, and a picture that does not fit in memory.
fn check(args: &Args) -> Result<(), Error> {
    let refuse = |message: &str| Err(Error::Usage(message.to_owned()));
    if (args.color_by == ColorName::Scalar) != args.scalar.is_some() {
        return refuse("--color-by scalar and --scalar FILE.csv:NAME go together");
    }
    let is_number =
        matches!(args.color_by, ColorName::Level | ColorName::SeesCount | ColorName::Scalar);
    if args.range.is_some() && !is_number {
        return refuse("--range is for numbers: --color-by level, sees-count or scalar");
    }
    // A side that is too long is refused with the camera.
    if args.size.width_px.max(args.size.height_px) <= MAX_SIDE_PX {
        memory::require("the picture (--size)", held_bytes(args.size), args.memory)?;
    }
    Ok(())
}

/// Lists the files that are read; an octree is the one in its folder.
fn inputs(args: &Args) -> Vec<PathBuf> {
    let beside = args.file.with_extension("octree");
    let octree = args.octree.clone().or(args.exact.then_some(beside));
    let table = args.scalar.iter().map(|(file, _)| file.clone());
    let tables = table.chain(args.light.clone());
    let named = std::iter::once(args.file.clone()).chain(octree).chain(tables);
    named.map(|path| if path.is_dir() { path.join(FILE_NAME) } else { path }).collect()
}

fn of_octree(args: &Args, path: &Path, bytes: &[u8], context: &Context) -> Result<Picture, Error> {
    let view = OctreeView::open(bytes).map_err(|e| Error::artifact(path, e))?;
    let only_map = |what: &str| {
        Error::Usage(format!("{what} needs surfels: give a .vmap, as pvmap build makes it"))
    };
    let color_by = match args.color_by {
        ColorName::Rgb => ColorBy::Rgb,
        ColorName::Normal => ColorBy::Normal,
        ColorName::Bin => ColorBy::Bin,
        ColorName::Level => return Err(only_map("--color-by level")),
        ColorName::SeesCount => return Err(only_map("--color-by sees-count")),
        ColorName::Scalar => return Err(only_map("--color-by scalar")),
    };
    if args.octree.is_some() {
        return Err(only_map("--octree"));
    }
    if args.light.is_some() {
        return Err(only_map("--light"));
    }
    if args.visible_from.is_some() {
        return Err(only_map("--visible-from"));
    }
    let fail = |e| named(path, path, e);
    let paint = Paint::new(color_by, None);
    let splats = OctreeSplats::new(&view, None, paint, args.radius).map_err(fail)?;
    let frame = &view.frame().frame;
    let splats = clipped(args, Box::new(splats), frame);
    let seen_from = camera::view_of(args, &*splats, frame).map_err(fail)?;
    let camera = Camera::new(&seen_from, args.size, frame).map_err(fail)?;
    let picture = draw(args, &*splats, &camera, (args.memory, context)).map_err(fail)?;
    camera::tell(args, &seen_from, context);
    Ok(picture)
}

fn of_map(args: &Args, path: &Path, bytes: &[u8], context: &Context) -> Result<Picture, Error> {
    let map = Map::open(bytes).map_err(|e| Error::of_query(path, e))?;
    let view = map.view();
    let points = points_of(args)?;
    let octree = points.as_ref().map(Points::view).transpose()?;
    let octree_path = points.as_ref().map_or(path, Points::path);
    if let Some(octree) = &octree {
        require_pair(path, view, octree_path, octree)?;
    }
    let drawn = octree.as_ref().filter(|_| args.octree.is_some());
    let fail = |e| named(path, octree_path, e);
    // Before anything that takes time: is there such a camera?
    let plain = Paint::new(ColorBy::Rgb, None);
    let plain = splats_of(args, view, drawn, plain).map_err(fail)?;
    let frame = &view.frame().frame;
    let seen_from = camera::view_of(args, &*plain, frame).map_err(fail)?;
    let camera = Camera::new(&seen_from, args.size, frame).map_err(fail)?;
    let color_by = colors_of(args, &map, path, context)?;
    let of_eye = |e| match &points {
        Some(points) => points.named(path, e),
        None => Error::of_query(path, e),
    };
    let scan = Scan { map: &map, octree: octree.as_ref(), draws_points: drawn.is_some() };
    let look = |place| eye::look(args, place, scan, context, of_eye);
    let eye = args.visible_from.map(look).transpose()?;
    let (of_surfel, of_point);
    let seen = match eye.as_ref().map(|eye| &eye.sees) {
        Some(Sees::Surfels(seen)) => {
            of_surfel = |id| seen.contains(id);
            Some(Seen::Surfels(&of_surfel))
        }
        Some(Sees::Points(seen)) => {
            of_point = |index| seen.contains(index);
            Some(Seen::Points(&of_point))
        }
        None => None,
    };
    let light = light::of(args, view, path)?;
    let lighting = light.as_ref().map(light::Light::lighting);
    let solid = Map::open(bytes).map_err(|e| Error::of_query(path, e))?.solid();
    let mirrors =
        light.as_ref().map(|light| light.mirrors(args, &solid, context)).transpose()?.flatten();
    let is_glossy = mirrors.as_ref().map(|mirrors| |surfel| mirrors.is_glossy(surfel));
    let paint = Paint::new(color_by, seen);
    let paint = lighting.iter().fold(paint, |paint, light| paint.lit(light));
    let paint = is_glossy.iter().fold(paint, |paint, of| paint.glossy_where(of));
    let ends = paint.values().map(|values| (values.min, values.max));
    let splats = splats_of(args, view, drawn, paint).map_err(fail)?;
    let lit_bytes = light.as_ref().map_or(0, |_| light::lit_bytes(view, mirrors.is_some()));
    // There is as much: light and mirrors were asked for before they were read.
    let spare = (args.memory.saturating_sub(lit_bytes), context);
    let mut picture = match (&light, &mirrors) {
        (Some(light), Some(mirrors)) => {
            let drawn = draw_glossy(args, &*splats, &camera, spare).map_err(fail)?;
            light.look((path, mirrors), &camera, drawn, context)?
        }
        _ => draw(args, &*splats, &camera, spare).map_err(fail)?,
    };
    if let Some(eye) = &eye
        && !picture.mark(&camera, eye.place, eye.distance, MARK)
    {
        context.progress.note("the place that --visible-from names is not in the picture");
    }
    if let Some((min, max)) = ends {
        picture.legend(min, max);
    }
    camera::tell(args, &seen_from, context);
    if let Some(light) = &light {
        light.tell(args, context);
    }
    Ok(picture)
}

/// Opens the points that are to be drawn or asked.
fn points_of(args: &Args) -> Result<Option<Points>, Error> {
    match &args.octree {
        Some(octree) => Points::open(octree).map(Some),
        None if args.exact => Points::open(&args.file.with_extension("octree")).map(Some),
        None => Ok(None),
    }
}

/// Gives what is drawn: points where there are some, else surfels.
fn splats_of<'a>(
    args: &Args,
    view: &'a MapView<'a>,
    points: Option<&'a OctreeView<'a>>,
    paint: Paint<'a>,
) -> Result<Box<dyn Source + 'a>, RenderError> {
    let splats: Box<dyn Source + 'a> = match points {
        Some(points) => Box::new(OctreeSplats::new(points, Some(view), paint, args.radius)?),
        None => Box::new(MapSplats::new(view, paint, args.radius)?),
    };
    Ok(clipped(args, splats, &view.frame().frame))
}

fn clipped<'a>(args: &Args, splats: Box<dyn Source + 'a>, frame: &Frame) -> Box<dyn Source + 'a> {
    match args.clip {
        Some(corners) => Box::new(Clipped::new(splats, corners, frame)),
        None => splats,
    }
}

fn colors_of(args: &Args, map: &Map<'_>, path: &Path, context: &Context) -> Result<ColorBy, Error> {
    let view = map.view();
    let mut values = match args.color_by {
        ColorName::Rgb => return Ok(ColorBy::Rgb),
        ColorName::Normal => return Ok(ColorBy::Normal),
        ColorName::Bin => return Ok(ColorBy::Bin),
        ColorName::Level => values::levels(view, path)?,
        ColorName::SeesCount => {
            let counts =
                pvmap::sees_counts(map, &context.progress).map_err(|e| Error::of_query(path, e))?;
            Values::new(counts.into_iter().map(|n| n as f32).collect())
        }
        ColorName::Scalar => {
            let (file, column) = args.scalar.as_ref().expect("checked before the map was opened");
            let n_surfels = view.summary().n_surfels;
            let (values, n_without) = values::scalars(file, column, n_surfels)?;
            if n_without > 0 {
                context.progress.note(&format!(
                    "{n_without} of {n_surfels} surfels have no number in {}: they are grey",
                    file.display()
                ));
            }
            values
        }
    };
    if let Some([min, max]) = args.range {
        (values.min, values.max) = (min, max);
    }
    Ok(ColorBy::Values(values))
}

fn draw(
    args: &Args,
    splats: &dyn Source,
    camera: &Camera,
    (memory_bytes, context): (u64, &Context),
) -> Result<Picture, RenderError> {
    let style = style_of(args, splats)?;
    telling(context, 2 * splats.n_splats(), |tell| {
        render(splats, camera, &style, memory_bytes, tell)
    })
}

fn draw_glossy(
    args: &Args,
    splats: &dyn Source,
    camera: &Camera,
    (memory_bytes, context): (u64, &Context),
) -> Result<(Picture, Vec<Glossy>), RenderError> {
    let style = style_of(args, splats)?;
    telling(context, 3 * splats.n_splats(), |tell| {
        render_glossy(splats, camera, &style, memory_bytes, tell)
    })
}

/// Draws as a stage of so many splats gone through.
fn telling<T>(context: &Context, n: u64, draw: impl FnOnce(Tell<'_>) -> T) -> T {
    let watch = &context.progress;
    watch.stage("render", Some(n), "splats");
    let drawn = draw(&mut |n| {
        watch.advance(n);
        !watch.is_stopped()
    });
    watch.take_stages();
    drawn
}

/// Gets splats gone through, says whether to go on.
type Tell<'a> = &'a mut dyn FnMut(u64) -> bool;

fn style_of(args: &Args, splats: &dyn Source) -> Result<Style, RenderError> {
    let usual = match args.light {
        // Light is what shades.
        Some(_) => 0.0,
        None if splats.is_gray()? => 0.7,
        None => 0.3,
    };
    Ok(Style {
        background: args.background,
        cull_back: args.cull == Cull::Back,
        shade: args.shade.unwrap_or(usual),
    })
}

/// Says which file an error is about, where it is about one: the map, or what is drawn.
fn named(map: &Path, drawn: &Path, e: RenderError) -> Error {
    match e {
        RenderError::Format(e) => Error::artifact(drawn, e),
        RenderError::Map(e) => Error::artifact(map, e),
        e @ RenderError::NoLeaf => Error::Data(format!("{}: {e}", map.display())),
        RenderError::Write(e) => StoreError::io(drawn, "write", e).into(),
        RenderError::Stopped => StoreError::Interrupted.into(),
        e => Error::Usage(e.to_string()),
    }
}
