//! `pvmap render`: a picture of a map or an octree.

use std::io::{self, BufWriter, IsTerminal};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::ValueEnum;
use pvmap::geometry::Frame;
use pvmap::query::{Map, Place, QueryError, Snap, SurfelSet};
use pvmap::render::{
    Camera, ColorBy, Lens, MapSplats, OctreeSplats, Picture, RenderError, Side, Size, Source,
    Style, Values, View, bounds, render,
};
use pvmap::vmap::container::kind_of;
use pvmap::vmap::{Kind, OctreeView};
use pvmap::{Error, StoreError, TableFile, Watch};

use super::{Context, Outcome, map_file, parse_point, refuse_input};

mod values;

/// Make a picture of a map or an octree
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Surfels of a map are drawn as patches, points of an octree as discs. Places and lengths are in the
scan's units. Without --camera the whole scan is in the picture, seen from the side that --view
names: corner is from the front, above and a little to the right. Faces that are known to be turned
away are left out, so that one looks into a closed room from outside; --cull none draws them, too.

Colours:
  rgb          the scan's, grey where it has none
  normal       x, y and z of the normal as red, green and blue
  level        the level of a surfel's cell
  bin          the direction the surface faces: a hue an axis, the negative side darker
  sees-count   how many surfels a surfel sees
  scalar       the numbers of --scalar
Where numbers are coloured, a bar at the lower left shows the ends of the range, dark to bright.

Examples:
  pvmap render grotto.vmap -o grotto.png
  pvmap render grotto.octree --view top --ortho -o plan.png
  pvmap render grotto.vmap --camera 1,2,1.7,4,6,1.5 --fov 60 --size 1280x720 -o inside.png
  pvmap render grotto.vmap --visible-from 1.5,2,0.3 -o seen.png")]
pub(super) struct Args {
    /// A .vmap file or an .octree folder
    #[arg(value_name = "NAME.vmap|NAME.octree")]
    file: PathBuf,
    /// The PNG to write, or replace; - for standard output
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,
    /// Where the eye is and what it looks at: x,y,z,x,y,z
    #[arg(
        long,
        value_parser = parse_camera,
        allow_hyphen_values = true,
        conflicts_with = "view",
        value_name = "EYE,TARGET"
    )]
    camera: Option<[[f64; 3]; 2]>,
    /// Or the whole scan from a side: corner, front, back, left, right,
    /// top or bottom [default: corner]
    #[arg(
        long,
        value_enum,
        default_value = "corner",
        value_name = "SIDE",
        hide_default_value = true,
        hide_possible_values = true,
        verbatim_doc_comment
    )]
    view: ViewFrom,
    /// What is up
    #[arg(
        long,
        value_parser = parse_point,
        allow_hyphen_values = true,
        default_value = "0,0,1",
        value_name = "X,Y,Z"
    )]
    up: [f64; 3],
    /// Angle of view from lower to upper edge, degrees
    #[arg(long, default_value_t = 40.0, conflicts_with = "ortho", value_name = "DEG")]
    fov: f64,
    /// No perspective; WIDTH in the scan's units [default: what fits]
    #[arg(
        long,
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "0",
        value_name = "WIDTH",
        value_parser = parse_width
    )]
    ortho: Option<f64>,
    /// Pixels of the picture
    #[arg(long, value_parser = parse_size, default_value = "1920x1080", value_name = "WxH")]
    size: Size,
    /// What colours mean, see below
    #[arg(
        long,
        value_enum,
        default_value = "rgb",
        value_name = "WHAT",
        hide_possible_values = true
    )]
    color_by: ColorName,
    /// Numbers to colour by: a column of a CSV file, a row a surfel in
    /// the order of their ids, or with a column surfel in any order
    #[arg(long, value_parser = parse_scalar, value_name = "CSV:COLUMN", verbatim_doc_comment)]
    scalar: Option<(PathBuf, String)>,
    /// Paint violet what this place sees, and mark it
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    visible_from: Option<[f64; 3]>,
    /// Faces to leave out: back (turned away) or none
    #[arg(
        long,
        value_enum,
        default_value = "back",
        value_name = "WHICH",
        hide_possible_values = true
    )]
    cull: Cull,
    /// A lamp at the camera: how much darker is what it grazes, 0 to 1
    /// [default: 0.7 where surfaces are grey, else 0.3]
    #[arg(long, value_parser = parse_share, value_name = "SHARE", verbatim_doc_comment)]
    shade: Option<f32>,
    /// Patches and discs so many times as large
    #[arg(long, value_parser = parse_scale, default_value = "1", value_name = "FACTOR")]
    radius: f32,
    /// What is behind everything: RRGGBB in hex
    #[arg(long, value_parser = parse_color, default_value = "ffffff", value_name = "COLOR")]
    background: [u8; 3],
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ViewFrom {
    Corner,
    Front,
    Back,
    Left,
    Right,
    Top,
    Bottom,
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
enum ColorName {
    Rgb,
    Normal,
    Level,
    Bin,
    SeesCount,
    Scalar,
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
enum Cull {
    Back,
    None,
}

/// The dot at the eye. Source: the paper's Figure 7.
const MARK: [u8; 3] = [0, 225, 235];

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    make(args, context)?;
    Ok(ExitCode::SUCCESS)
}

fn make(args: &Args, context: &Context) -> Result<(), Error> {
    let table = args.scalar.iter().map(|(file, _)| file.clone());
    let inputs: Vec<PathBuf> = std::iter::once(args.file.clone()).chain(table).collect();
    refuse_input(&args.output, &inputs)?;
    if pvmap::is_stdout(&args.output) && io::stdout().is_terminal() {
        let message = "a picture is not for a terminal; give -o OUT.png or send it on".to_owned();
        return Err(Error::Usage(message));
    }
    if (args.color_by == ColorName::Scalar) != args.scalar.is_some() {
        let message = "--color-by scalar and --scalar FILE.csv:NAME go together".to_owned();
        return Err(Error::Usage(message));
    }
    let (path, bytes) = map_file(&args.file)?;
    // Before anything that takes time: can it be written?
    let output = TableFile::create(&args.output)?;
    let picture = match kind_of(&bytes) {
        Some(Kind::Octree) => of_octree(args, &path, &bytes, context)?,
        _ => of_map(args, &path, &bytes, context)?,
    };
    let mut out = BufWriter::new(output);
    picture.write_png(&mut out).map_err(|e| named(&args.output, e))?;
    let fail = |e: io::IntoInnerError<_>| StoreError::io(&args.output, "write", e.into_error());
    Ok(out.into_inner().map_err(fail)?.commit()?)
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
    if args.visible_from.is_some() {
        return Err(only_map("--visible-from"));
    }
    let is_gray = args.color_by == ColorName::Rgb && view.schema().column("color").is_none();
    let splats = OctreeSplats::new(&view, color_by, args.radius).map_err(|e| named(path, e))?;
    let camera = camera_of(args, &splats, &view.frame().frame).map_err(|e| named(path, e))?;
    draw(args, &splats, &camera, is_gray, context).map_err(|e| named(path, e))
}

fn of_map(args: &Args, path: &Path, bytes: &[u8], context: &Context) -> Result<Picture, Error> {
    let map = Map::open(bytes).map_err(|e| Error::of_query(path, e))?;
    let view = map.view();
    let fail = |e| named(path, e);
    // Before anything that takes time: is there such a camera?
    let plain = MapSplats::new(view, ColorBy::Rgb, None, args.radius).map_err(fail)?;
    let camera = camera_of(args, &plain, &view.frame().frame).map_err(fail)?;
    let color_by = colors_of(args, &map, path, context)?;
    let ends = match &color_by {
        ColorBy::Values(values) => Some((values.min, values.max)),
        _ => None,
    };
    let seen = match args.visible_from {
        Some(eye) => Some(seen_from(&map, eye).map_err(|e| Error::of_query(path, e))?),
        None => None,
    };
    let is_seen = |id: u32| seen.as_ref().is_some_and(|seen| seen.contains(id));
    let splats = MapSplats::new(view, color_by, Some(&is_seen), args.radius).map_err(fail)?;
    let is_gray = args.color_by == ColorName::Rgb && splats.is_gray().map_err(fail)?;
    let mut picture = draw(args, &splats, &camera, is_gray, context).map_err(fail)?;
    if let Some(eye) = args.visible_from
        && !picture.mark(&camera, eye, MARK)
    {
        context.progress.note("the place that --visible-from names is not in the picture");
    }
    if let Some((min, max)) = ends {
        picture.legend(min, max);
    }
    Ok(picture)
}

fn colors_of(args: &Args, map: &Map<'_>, path: &Path, context: &Context) -> Result<ColorBy, Error> {
    let view = map.view();
    Ok(match args.color_by {
        ColorName::Rgb => ColorBy::Rgb,
        ColorName::Normal => ColorBy::Normal,
        ColorName::Bin => ColorBy::Bin,
        ColorName::Level => ColorBy::Values(values::levels(view, path)?),
        ColorName::SeesCount => {
            let counts =
                pvmap::sees_counts(map, &context.progress).map_err(|e| Error::of_query(path, e))?;
            ColorBy::Values(Values::new(counts.into_iter().map(|n| n as f32).collect()))
        }
        ColorName::Scalar => {
            let (file, column) = args.scalar.as_ref().expect("checked before the map was opened");
            ColorBy::Values(values::scalars(file, column, view.summary().n_surfels)?)
        }
    })
}

/// Finds what a place sees.
fn seen_from(map: &Map<'_>, eye: [f64; 3]) -> Result<SurfelSet, QueryError> {
    let at = map.locate(&Place { position: eye, normal: None }, Snap::default())?;
    Ok(map.visible_from(&at)?.surfels)
}

fn draw(
    args: &Args,
    splats: &dyn Source,
    camera: &Camera,
    is_gray: bool,
    context: &Context,
) -> Result<Picture, RenderError> {
    let style = Style {
        background: args.background,
        cull_back: args.cull == Cull::Back,
        shade: args.shade.unwrap_or(if is_gray { 0.7 } else { 0.3 }),
    };
    let watch = &context.progress;
    watch.stage("render", Some(2 * splats.n_splats()), "splats");
    let mut tell = |n| {
        watch.advance(n);
        !watch.is_stopped()
    };
    let picture = render(splats, camera, &style, &mut tell)?;
    watch.take_stages();
    Ok(picture)
}

fn camera_of(args: &Args, splats: &dyn Source, frame: &Frame) -> Result<Camera, RenderError> {
    Camera::new(&view_of(args, splats, frame)?, args.size, frame)
}

/// Finds where to look from.
fn view_of(args: &Args, splats: &dyn Source, frame: &Frame) -> Result<View, RenderError> {
    let lens = match args.ortho {
        Some(width) => Lens::Orthographic { width },
        None => Lens::Perspective { fov_deg: args.fov },
    };
    let fits = args.ortho == Some(0.0);
    if let Some([eye, target]) = args.camera
        && !fits
    {
        return Ok(View { eye, target, up: args.up, lens });
    }
    let side = match args.view {
        ViewFrom::Corner => Side::Corner,
        ViewFrom::Front => Side::Front,
        ViewFrom::Back => Side::Back,
        ViewFrom::Left => Side::Left,
        ViewFrom::Right => Side::Right,
        ViewFrom::Top => Side::Top,
        ViewFrom::Bottom => Side::Bottom,
    };
    let around = bounds(splats)?.unwrap_or([[0.0; 3], [1.0; 3]]);
    let whole = View::of_box(around, side, args.up, lens, args.size, frame)?;
    Ok(match args.camera {
        Some([eye, target]) => View { eye, target, up: args.up, lens: whole.lens },
        None => whole,
    })
}

/// Says which file an error is about, where it is about one.
fn named(path: &Path, e: RenderError) -> Error {
    match e {
        RenderError::Format(e) => Error::artifact(path, e),
        RenderError::Write(e) => StoreError::io(path, "write", e).into(),
        RenderError::Stopped => StoreError::Interrupted.into(),
        e => Error::Usage(e.to_string()),
    }
}

/// Reads `x,y,z,tx,ty,tz`.
fn parse_camera(text: &str) -> Result<[[f64; 3]; 2], String> {
    let refuse = || format!("{text:?} is not six numbers; write x,y,z,tx,ty,tz");
    let (at, _) = text.match_indices(',').nth(2).ok_or_else(refuse)?;
    match (parse_point(&text[..at]), parse_point(&text[at + 1..])) {
        (Ok(eye), Ok(target)) => Ok([eye, target]),
        _ => Err(refuse()),
    }
}

/// Reads `1920x1080`.
fn parse_size(text: &str) -> Result<Size, String> {
    let sides = text.split_once('x').map(|(w, h)| (w.parse::<u32>(), h.parse::<u32>()));
    match sides {
        Some((Ok(width_px), Ok(height_px))) => Ok(Size { width_px, height_px }),
        _ => Err(format!("{text:?} is not a size; write for example 1280x720")),
    }
}

/// Reads a width; 0 stands for what fits.
fn parse_width(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v >= 0.0 => Ok(v),
        _ => Err("write a width of more than 0, in the scan's units".to_owned()),
    }
}

/// Reads a share, 0 to 1.
fn parse_share(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(v) if (0.0..=1.0).contains(&v) => Ok(v),
        _ => Err("write a number from 0 to 1".to_owned()),
    }
}

/// Reads a factor.
fn parse_scale(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(v) if (0.001..=1000.0).contains(&v) => Ok(v),
        _ => Err("write a number from 0.001 to 1000".to_owned()),
    }
}

/// Reads `rrggbb`.
fn parse_color(text: &str) -> Result<[u8; 3], String> {
    let digits = text.trim_start_matches('#');
    let value = u32::from_str_radix(digits, 16).ok().filter(|_| digits.len() == 6);
    let value = value.ok_or_else(|| format!("{text:?} is no colour; write RRGGBB in hex"))?;
    let [_, r, g, b] = value.to_be_bytes();
    Ok([r, g, b])
}

/// Reads `FILE.csv:NAME`.
fn parse_scalar(text: &str) -> Result<(PathBuf, String), String> {
    match text.rsplit_once(':') {
        Some((file, name)) if !file.is_empty() && !name.is_empty() => {
            Ok((PathBuf::from(file), name.to_owned()))
        }
        _ => Err(format!("{text:?} names no column; write FILE.csv:NAME")),
    }
}
