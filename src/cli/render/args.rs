//! What `pvmap render` is told.

use std::num::NonZero;
use std::path::PathBuf;

use clap::ValueEnum;
use pvmap::Exposure;
use pvmap::render::{Side, Size};

use crate::cli::{parse_exposure, parse_point, threads_parser};

/// Make a picture of a map or an octree
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Surfels of a map are drawn as patches, points of an octree as discs; of a map with --octree the
points are drawn, coloured by what the map says of their surfels. Places and lengths are in the
scan's units. Without --camera the whole scan is in the picture, seen from the side that --view
names: corner is from the front, above and a little to the right. Faces that are known to be turned
away are left out, so that one looks into a closed room from outside; --cull none draws them, too.
What was chosen is said as a --camera that can be refined.

With --visible-from all is violet that the surfel at that place sees. --exact asks the points
what they see of the one nearest to that place: each point of the octree, or without --octree of
every surfel the one nearest to its middle. That takes a tenth of a millisecond each and knows thin
limbs from the larger discs that stand for them.

With --light the colours are the radiosity that pvmap light found: of a surfel, or of a point of
--octree, which has the light of its place and the scan's own colour for a texture. --exposure N
multiplies it; with auto 95 % of the area that does not shine by itself stay below 0.8 of white, and
what that came to is said, so that the next picture can have the same. What mirrors or lets light
through shows what is seen in it: rays are followed from the eye, up to six surfaces far, to what
scatters light; --no-mirrors leaves that out.

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
  pvmap render grotto.vmap --light grotto.light -o lit.png
  pvmap render grotto.vmap --octree grotto.octree --light grotto.light --exposure 0.4 -o lit.png
  pvmap render grotto.vmap --visible-from 1.5,2,0.3 -o seen.png
  pvmap render grotto.vmap --octree grotto.octree --visible-from 1.5,2,0.3 --exact -o seen.png")]
pub(in crate::cli) struct Args {
    /// A .vmap file or an .octree folder
    #[arg(value_name = "NAME.vmap|NAME.octree")]
    pub(super) file: PathBuf,
    /// Draw the points of the octree that the map was built from
    #[arg(long, value_name = "NAME.octree")]
    pub(super) octree: Option<PathBuf>,
    /// The PNG to write, or replace; - for standard output
    #[arg(short, long, value_name = "OUT.png")]
    pub(super) output: PathBuf,
    /// Where the eye is and what it looks at: x,y,z,x,y,z
    #[arg(
        long,
        value_parser = parse_six,
        allow_hyphen_values = true,
        conflicts_with = "view",
        value_name = "EYE,TARGET"
    )]
    pub(super) camera: Option<[[f64; 3]; 2]>,
    /// Or the whole scan from a side: corner, front, back, left, right,
    /// top or bottom [default: corner]
    #[arg(
        long,
        value_parser = parse_side,
        default_value = "corner",
        value_name = "SIDE",
        hide_default_value = true,
        verbatim_doc_comment
    )]
    pub(super) view: Side,
    /// What is up
    #[arg(
        long,
        value_parser = parse_point,
        allow_hyphen_values = true,
        default_value = "0,0,1",
        value_name = "X,Y,Z"
    )]
    pub(super) up: [f64; 3],
    /// Angle of view from lower to upper edge, degrees
    #[arg(long, default_value_t = 40.0, conflicts_with = "ortho", value_name = "DEG")]
    pub(super) fov: f64,
    /// No perspective; WIDTH in the scan's units [default: what fits]
    #[arg(
        long,
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "0",
        value_name = "WIDTH",
        value_parser = parse_width
    )]
    pub(super) ortho: Option<f64>,
    /// Pixels of the picture
    #[arg(long, value_parser = parse_size, default_value = "1920x1080", value_name = "WxH")]
    pub(super) size: Size,
    /// What colours mean, see below
    #[arg(
        long,
        value_enum,
        default_value = "rgb",
        value_name = "WHAT",
        hide_possible_values = true
    )]
    pub(super) color_by: ColorName,
    /// Numbers to colour by: a column of a CSV file, a row a surfel in
    /// the order of their ids, or with a column surfel in any order
    #[arg(long, value_parser = parse_scalar, value_name = "CSV:COLUMN", verbatim_doc_comment)]
    pub(super) scalar: Option<(PathBuf, String)>,
    /// Numbers that the darkest and the brightest colour stand for
    /// [default: the least and the greatest]
    #[arg(
        long,
        value_parser = parse_range,
        allow_hyphen_values = true,
        value_name = "MIN,MAX",
        verbatim_doc_comment
    )]
    pub(super) range: Option<[f32; 2]>,
    /// Show the light that pvmap light found for this map
    #[arg(long, conflicts_with = "color_by", value_name = "NAME.light")]
    pub(super) light: Option<PathBuf>,
    /// With --light: what radiosity is multiplied with to be linear light
    /// of the picture, where 1 is white, or auto
    #[arg(
        long,
        default_value = "auto",
        requires = "light",
        value_parser = parse_exposure,
        value_name = "N",
        verbatim_doc_comment
    )]
    pub(super) exposure: Exposure,
    /// With --light: without what is seen in mirrors and through lenses
    #[arg(long, requires = "light")]
    pub(super) no_mirrors: bool,
    /// Only what lies between two corners: x,y,z,x,y,z
    #[arg(long, value_parser = parse_six, allow_hyphen_values = true, value_name = "CORNERS")]
    pub(super) clip: Option<[[f64; 3]; 2]>,
    /// Paint violet what this place sees, and mark it
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    pub(super) visible_from: Option<[f64; 3]>,
    /// Normal of the surface that the place of --visible-from is on
    #[arg(
        long,
        value_parser = parse_point,
        allow_hyphen_values = true,
        requires = "visible_from",
        value_name = "X,Y,Z"
    )]
    pub(super) normal: Option<[f64; 3]>,
    /// How far from a surface that place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, requires = "visible_from", value_name = "DIST", verbatim_doc_comment)]
    pub(super) snap: Option<f64>,
    /// Ask the points what the place sees: those of --octree, or of the
    /// octree with the map's name
    #[arg(long, requires = "visible_from", verbatim_doc_comment)]
    pub(super) exact: bool,
    /// With --exact: how near the line points are that hide something
    /// [default: four times the usual half spacing of the points]
    #[arg(long, value_name = "DIST", requires = "exact", verbatim_doc_comment)]
    pub(super) delta: Option<f64>,
    /// With --exact: how many such points it takes
    #[arg(long, value_name = "N", requires = "exact", default_value = "5")]
    pub(super) k: NonZero<u32>,
    /// Faces to leave out: back (turned away) or none
    #[arg(
        long,
        value_enum,
        default_value = "back",
        value_name = "WHICH",
        hide_possible_values = true
    )]
    pub(super) cull: Cull,
    /// A lamp at the camera: how much darker is what it grazes, 0 to 1
    /// [default: 0.7 where surfaces are grey, 0 with --light, else 0.3]
    #[arg(long, value_parser = parse_share, value_name = "SHARE", verbatim_doc_comment)]
    pub(super) shade: Option<f32>,
    /// Patches and discs so many times as large
    #[arg(long, value_parser = parse_scale, default_value = "1", value_name = "FACTOR")]
    pub(super) radius: f32,
    /// What is behind everything: RRGGBB in hex
    #[arg(long, value_parser = parse_color, default_value = "ffffff", value_name = "COLOR")]
    pub(super) background: [u8; 3],
    /// Most memory to hold, at least 64MiB; a picture takes about 50 bytes
    /// a pixel
    #[arg(
        long,
        default_value = "1GiB",
        value_parser = pvmap::parse_memory,
        value_name = "SIZE",
        verbatim_doc_comment
    )]
    pub(super) memory: u64,
    /// Threads; 0 takes as many as the machine has
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = threads_parser())]
    pub(super) threads: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
pub(super) enum ColorName {
    Rgb,
    Normal,
    Level,
    Bin,
    SeesCount,
    Scalar,
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
pub(super) enum Cull {
    Back,
    None,
}

/// Reads `MIN,MAX`.
fn parse_range(text: &str) -> Result<[f32; 2], String> {
    let ends = text.split_once(',').map(|(a, b)| (a.trim().parse(), b.trim().parse()));
    match ends {
        Some((Ok(min), Ok(max))) if min < max && f32::is_finite(min) && f32::is_finite(max) => {
            Ok([min, max])
        }
        _ => Err(format!("{text:?} is no range; write MIN,MAX, the lesser first")),
    }
}

/// Reads `x,y,z,x,y,z`.
fn parse_six(text: &str) -> Result<[[f64; 3]; 2], String> {
    let refuse = || format!("{text:?} is not six numbers; write x,y,z,x,y,z");
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

/// Reads a side to look from.
fn parse_side(text: &str) -> Result<Side, String> {
    Ok(match text {
        "corner" => Side::Corner,
        "front" => Side::Front,
        "back" => Side::Back,
        "left" => Side::Left,
        "right" => Side::Right,
        "top" => Side::Top,
        "bottom" => Side::Bottom,
        _ => return Err("write corner, front, back, left, right, top or bottom".to_owned()),
    })
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
