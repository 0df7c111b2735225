//! `pvmap info`: what is in an artifact.

mod light;
mod quality;
mod wide;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::geometry::Frame;
use pvmap::query::{Map, QueryError};
use pvmap::vmap::container::kind_of;
use pvmap::vmap::frame::{CrsKind, FrameRecord};
use pvmap::vmap::{FormatError, Kind, LightView, MapView, OctreeView};
use pvmap::{Error, Watch};
use serde_json::{Value, json};

use super::build::fewer_links;
use super::{Context, Outcome, map_file, mib, one_line, parse_some, print_json};

/// Show what is in an octree, a map or a light file
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Lengths and places are in the scan's units. Only the head of the file is read, however large it
is, and of a map the surfels; pvmap verify checks the rest. Of a light file it says how exact it is
asked to be and is, where the flux of each channel went, which effects were and were not computed,
and what shines; flux is in the unit of the lights.

Of a map it names, where there are any, the surfels that are suspiciously wide: with a radius of
more than 20 times the side of a square that as many points cover at the median spacing. Such a
disc is of a few stray points and hides what is behind it. pvmap build --max-spread N, with N
lower, cuts those of at least 4 points that stand in clumps far from each other.

With --quality an octree is asked what its points are like, at a sample of them, each with the 16
points that normals are estimated from:
  spacing              how far away the nearest point in another place is: 5, 50 and 95 of 100
                       points have at most this
  unevenness           the last of these over the first: 1 on a grid, 8 at random on a surface
  coincident percent   points in whose place there is another
  thickness            how far points are from the plane through their neighbours: the median of the
                       root of the mean square. Noise, and with large spacing curves and edges
  rim percent          points whose neighbors, seen in that plane, leave an angle of more than 120°
                       without any: the rims of holes and of what was scanned, a point each spacing.
                       None on a closed surface that is sampled evenly; some 6 where its points lie
                       at random
  turned percent       of the points whose side is known those that face away from most of their
                       neighbours; many where faces of a wall are nearer than the spacing
  angles percent       between the normals of the file and those planes, whatever the side; where
                       the median is above 45° the normals are not those of the points, and a
                       warning says so

Examples:
  pvmap info grotto.octree
  pvmap info grotto.octree --quality
  pvmap info grotto.vmap --json
  pvmap info grotto.light")]
pub(super) struct Args {
    /// A .vmap or .light file or an .octree folder
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Look at points of the octree, too: spacing, noise and normals
    #[arg(long)]
    quality: bool,
    /// With --quality: how many points
    #[arg(
        long,
        default_value = "20k",
        value_parser = parse_some,
        value_name = "N",
        requires = "quality"
    )]
    sample: u64,
    /// As one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let (path, bytes) = map_file(&args.file)?;
    let named = |e| Error::artifact(&path, e);
    let fields = match kind_of(&bytes) {
        Some(Kind::Octree) => {
            let view = OctreeView::open(&bytes).map_err(named)?;
            let mut fields = octree(&view, bytes.len()).map_err(named)?;
            if args.quality {
                fields.push(("quality", Field::Group(look(args, &view, context)?)));
            }
            fields
        }
        Some(Kind::Light) => {
            if args.quality {
                return Err(no_quality(&args.file, "light").into());
            }
            let view = LightView::open(&bytes).map_err(named)?;
            light::fields(&view, bytes.len()).map_err(named)?
        }
        _ => {
            let of_map = |e| Error::of_query(&path, e);
            let asked = Map::open(&bytes).map_err(of_map)?;
            let mut fields = map(asked.view(), bytes.len()).map_err(named)?;
            if args.quality {
                return Err(no_quality(&args.file, "a map").into());
            }
            match wide::field(&asked, &context.progress) {
                Ok(found) => fields.extend(found),
                // What the head says holds all the same.
                Err(e @ QueryError::Format(_)) => context.progress.warn(&of_map(e).to_string()),
                Err(e) => return Err(of_map(e).into()),
            }
            context.progress.take_stages();
            fields
        }
    };
    if args.json {
        print_json(&object(&fields))?;
    } else {
        print(&fields, 0, &mut io::stdout().lock())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Refuses to look at the points of what has none.
fn no_quality(path: &Path, what: &str) -> Error {
    let message = format!("is {what}, and --quality is about points; give the octree");
    Error::Usage(format!("{}: {message}", path.display()))
}

/// Measures a sample of points, and warns where normals are not theirs.
fn look(args: &Args, view: &OctreeView<'_>, context: &Context) -> Result<Fields, Error> {
    let quality = pvmap::quality(view, args.sample, &context.progress)
        .map_err(|e| Error::of_octree(&args.file, e))?;
    context.progress.take_stages();
    if let Some(warning) = pvmap::contradiction(&args.file, &quality) {
        context.progress.warn(&warning);
    }
    Ok(quality::fields(&quality, view.summary()))
}

/// What is known, in the order in which it is told.
type Fields = Vec<(&'static str, Field)>;

enum Field {
    /// A value as JSON, and as text where that differs.
    One(Value, Option<String>),
    Group(Fields),
    List(Vec<Fields>),
    /// Lines of a text, those below the key as they are.
    Lines(Vec<String>),
}

fn one(value: impl Into<Value>) -> Field {
    Field::One(value.into(), None)
}

fn with_text(value: impl Into<Value>, text: String) -> Field {
    Field::One(value.into(), Some(text))
}

fn octree(view: &OctreeView<'_>, n_bytes: usize) -> Result<Fields, FormatError> {
    let s = view.summary();
    let columns: Vec<&str> = view.schema().columns().iter().map(|c| c.name).collect();
    let mut sources = Vec::new();
    for source in view.sources() {
        sources.push(vec![
            ("name", one(view.source_name(source)?)),
            ("format", one(word(source.format, &["", "LAS", "LAZ", "PLY"]))),
            ("points", one(source.n_stored)),
            ("invalid", one(source.n_invalid)),
            ("color_bits", one(source.color_depth)),
        ]);
    }
    let n_none = s.n_points - (s.n_normals_file + s.n_normals_estimated).min(s.n_points);
    let orientation = word(s.orientation, &["nothing", "sensor", "up"]);
    let normals = vec![
        ("asked", one(word(s.normals, &["auto", "file", "estimate", "none"]))),
        ("from_file", one(s.n_normals_file)),
        ("estimated", one(s.n_normals_estimated)),
        ("none", one(n_none)),
        ("oriented", one(s.n_oriented)),
        ("estimated_oriented_by", one(orientation)),
    ];
    Ok(vec![
        ("kind", one("octree")),
        ("format", one(version(view.file().version()))),
        ("bytes", size(n_bytes)),
        ("points", one(s.n_points)),
        ("records_read", one(s.n_read)),
        ("records_invalid", one(s.n_invalid)),
        ("records_missing", one(s.n_missing)),
        ("records_beyond_the_header", one(s.n_beyond)),
        ("sources", Field::List(sources)),
        ("columns", with_text(columns.clone(), columns.join(" "))),
        ("normals", Field::Group(normals)),
        ("frame", frame(view.frame(), view.crs()?)),
        ("digest", one(format!("{:032x}", s.digest))),
    ])
}

fn map(view: &MapView<'_>, n_bytes: usize) -> Result<Fields, FormatError> {
    let s = view.summary();
    let n = u64::from(s.n_surfels);
    let n_pairs = n * n.saturating_sub(1) / 2;
    let fewer = fewer_links(s.n_links, s.n_surfels);
    let config = view.config()?.trim_end();
    let fractions = view.fractions().map(|_| ("visible_fractions", one(s.n_fractions)));
    let before = vec![
        ("kind", one("map")),
        ("format", one(version(view.file().version()))),
        ("bytes", size(n_bytes)),
        ("points", one(s.n_points)),
        ("surfels", one(s.n_surfels)),
        ("nodes", one(s.n_nodes)),
        ("leaf_pairs", one(n_pairs)),
        ("visible_pairs", one(s.n_visible_pairs as u64)),
        ("links", one(s.n_links)),
        ("fewer_links_percent", with_text(fewer, format!("{fewer:.2}"))),
    ];
    let behind = [
        ("config", with_text(config, config.replace('\n', ", "))),
        ("frame", frame(view.frame(), view.crs()?)),
        ("digest", one(format!("{:032x}", s.digest))),
    ];
    Ok(before.into_iter().chain(fractions).chain(behind).collect())
}

fn size(n_bytes: usize) -> Field {
    with_text(n_bytes, format!("{n_bytes} ({})", mib(n_bytes as u64)))
}

/// Gives the word for a code whose range the reader has checked.
fn word(code: u32, words: &[&'static str]) -> &'static str {
    words.get(code as usize).copied().unwrap_or_default()
}

fn version((major, minor): (u16, u16)) -> String {
    format!("{major}.{minor}")
}

/// Where the scan lies; all lengths are in the units of its coordinates.
fn frame(record: &FrameRecord, (kind, crs): (CrsKind, &[u8])) -> Field {
    let coordinates = match record.frame {
        Frame::Lattice { .. } => "lattice",
        Frame::World { .. } => "world",
    };
    let origin = record.frame.world_of_real([0.0; 3]);
    let [x, y, z] = origin;
    let (extent, step) = (record.frame.extent(), record.frame.unit());
    let crs = match kind {
        CrsKind::None => Field::One(Value::Null, Some("none".to_owned())),
        CrsKind::Wkt => one(String::from_utf8_lossy(crs).trim_end_matches('\0')),
        CrsKind::GeoTiff => one(format!("GeoTIFF keys, {} bytes", crs.len())),
    };
    Field::Group(vec![
        ("coordinates", one(coordinates)),
        ("origin", with_text(json!(origin), format!("{x},{y},{z}"))),
        ("extent", with_text(extent, format!("{extent} scan units"))),
        ("grid_step", with_text(step, format!("{step:.3e} scan units"))),
        ("crs", crs),
    ])
}

fn object(fields: &Fields) -> Value {
    let value = |field: &Field| match field {
        Field::One(value, _) => value.clone(),
        Field::Group(fields) => object(fields),
        Field::List(items) => items.iter().map(object).collect(),
        Field::Lines(lines) => json!(lines),
    };
    fields.iter().map(|(key, field)| ((*key).to_owned(), value(field))).collect()
}

/// Columns of keys, wide enough for the longest.
const KEY_WIDTH: usize = 26;

/// Prints aligned lines, inner ones indented.
fn print(fields: &Fields, depth: usize, out: &mut impl Write) -> io::Result<()> {
    let (indent, width) = (2 * depth, KEY_WIDTH - 2 * depth);
    for (key, field) in fields {
        let key = key.replace('_', " ");
        match field {
            Field::One(value, text) => {
                let text = match (text, value) {
                    (Some(text), _) => text.clone(),
                    (None, Value::String(text)) => text.clone(),
                    (None, value) => value.to_string(),
                };
                writeln!(out, "{:indent$}{key:width$}{}", "", one_line(&text))?;
            }
            Field::Group(fields) => {
                writeln!(out, "{:indent$}{key}", "")?;
                print(fields, depth + 1, out)?;
            }
            Field::Lines(lines) => {
                writeln!(out, "{:indent$}{key}", "")?;
                for line in lines {
                    writeln!(out, "{:indent$}  {}", "", one_line(line))?;
                }
            }
            Field::List(items) => {
                for item in items {
                    writeln!(out, "{:indent$}{key}", "")?;
                    print(item, depth + 1, out)?;
                }
            }
        }
    }
    Ok(())
}
