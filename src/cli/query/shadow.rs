//! `pvmap query MAP shadow`: does a light reach a place?

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::query::{Light, LightSource, Located, Place, QueryError, ShadowAnswer, Sight};
use pvmap::rows::RowBlock;
use pvmap::{Error, class_points};
use serde_json::{Value, json};

use super::batch::{self, Batch, Columns, RowError, numbers_if_any};
use super::pairs::PlaceColumns;
use super::{Asked, Outcome, map_file, parse_distance, parse_point, place, snap_of};

/// Does a light reach a place: lit, penumbra, umbra?
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A light is a place (a lamp on a surface if one is near, else one in the air that shines everywhere;
--air puts it in the air in any case), the points in a box, or the points of a class. In the
penumbra a share of those points is seen.

Input columns of --rows, by name in a header row, in any order, among others that are not read:
  x y z                         the place, in the scan's units
  nx ny nz                      optional: normals that say which surface it is on
  lx ly lz                      optional: a light for each row, instead of that of the options

Output columns:
  light                         lit, penumbra or umbra, empty where there is no answer
  share                         the share of the light that reaches the place, 0 to 1
  surfel distance               the surfel that the place lies on, and how far from it
  blocker                       a surfel in the way of a light in the air
  lamp                          the surfel that the light is on; empty for one in the air
  error                         why there is no answer

Examples:
  pvmap query grotto.vmap shadow 1,2,3 --light 0,0,9
  pvmap query grotto.vmap shadow 1,2,3 --light-box 0,0,8,1,1,9
  pvmap query street.vmap shadow --rows rows.csv --class 17 --octree street.octree")]
pub(super) struct Args {
    /// The place, in the scan's units
    #[arg(value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    #[arg(required_unless_present = "rows")]
    place: Option<[f64; 3]>,
    /// The light is at this place
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    light: Option<[f64; 3]>,
    /// The light is in the air even if a surface is near
    #[arg(long, conflicts_with_all = ["light_box", "class"])]
    air: bool,
    /// The light is the points of surfels centred in a box: x0,y0,z0,x1,y1,z1
    #[arg(long, value_parser = parse_box, allow_hyphen_values = true, conflicts_with = "light")]
    #[arg(value_name = "BOX")]
    light_box: Option<[[f64; 3]; 2]>,
    /// The light is all points of this class
    #[arg(long, value_name = "N", requires = "octree", conflicts_with_all = ["light", "light_box"])]
    class: Option<u8>,
    /// The octree that the map was built from, where the classes are
    #[arg(long, value_name = "NAME.octree")]
    octree: Option<PathBuf>,
    /// Normal of the surface that the place is on
    #[arg(long, value_parser = parse_point, allow_hyphen_values = true, value_name = "X,Y,Z")]
    normal: Option<[f64; 3]>,
    /// How far from a surface a place may be, in the scan's units
    /// [default: twice the spacing of the points there]
    #[arg(long, value_parser = parse_distance, allow_hyphen_values = true, value_name = "DIST")]
    #[arg(verbatim_doc_comment)]
    snap: Option<f64>,
    /// Answer the rows of a CSV file, or of standard input for -
    #[arg(long, value_name = "ROWS.csv", conflicts_with_all = ["place", "normal"])]
    rows: Option<PathBuf>,
    /// Answer as one JSON object, or one a line
    #[arg(long)]
    json: bool,
}

/// Reads `x0,y0,z0,x1,y1,z1`.
fn parse_box(text: &str) -> Result<[[f64; 3]; 2], String> {
    let refuse = || format!("{text:?} is not six numbers; write x0,y0,z0,x1,y1,z1");
    let cut = text.match_indices(',').nth(2).ok_or_else(refuse)?.0;
    let corner = |text| parse_point(text).map_err(|_| refuse());
    let corners = [corner(&text[..cut])?, corner(&text[cut + 1..])?];
    let rises = (0..3).all(|i| corners[0][i] <= corners[1][i]);
    rises.then_some(corners).ok_or_else(|| format!("{text:?}: the lowest corner comes first"))
}

pub(super) fn run(asked: &Asked<'_, '_>, args: &Args) -> Outcome {
    let lamp = Lamp::of(asked, args)?;
    let position = match (args.place, &args.rows) {
        (_, Some(rows)) => return table(asked, args, rows, lamp),
        (Some(position), None) => position,
        _ => return Err(Error::Usage("give a place, or --rows".to_owned()).into()),
    };
    let Some(lamp) = lamp else { return Err(Error::Usage(NO_LIGHT.to_owned()).into()) };
    let shaded = shade(asked, args, &place(position, args.normal), &lamp);
    let shaded = asked.named(shaded)?;
    if args.json {
        asked.print_json(as_json(&shaded))?;
        return Ok(ExitCode::SUCCESS);
    }
    let Shaded { at, lamp: on, found } = shaded;
    let mut out = io::stdout().lock();
    writeln!(out, "{}", word(&found))?;
    writeln!(out, "  share     {} of the light", found.reaches.share())?;
    writeln!(out, "  surfel    {}, {} away", at.surfel, at.distance)?;
    if let Some(blocker) = found.blocker {
        writeln!(out, "  blocker   surfel {blocker}")?;
    }
    match (&lamp, on) {
        (_, Some(on)) => writeln!(out, "  lamp      on surfel {}", on.surfel)?,
        (Lamp::Place(_), None) => writeln!(out, "  lamp      in the air")?,
        _ => {}
    }
    if on.is_none() && found.n_surfels > 0 {
        writeln!(out, "  light     {} points in {} surfels", found.n_points, found.n_surfels)?;
    }
    Ok(ExitCode::SUCCESS)
}

const NO_LIGHT: &str = "no light; give --light, --light-box or --class";

/// What the options, or a row, say of the light.
enum Lamp {
    Place([f64; 3]),
    Source(LightSource),
}

impl Lamp {
    fn of(asked: &Asked<'_, '_>, args: &Args) -> Result<Option<Lamp>, Error> {
        let of_class = |class, octree: &Path| {
            let (path, bytes) = map_file(octree)?;
            let points = class_points(asked.map, asked.path, &bytes, &path, class)?;
            asked.named(asked.map.light_source(&Light::Points(&points)))
        };
        match (args.light, args.light_box, args.class, &args.octree) {
            (Some(place), ..) => Ok(Some(Lamp::Place(place))),
            (_, Some([low, high]), ..) => {
                let source = asked.named(asked.map.light_source(&Light::Box(low, high)))?;
                Ok(Some(Lamp::Source(source)))
            }
            (_, _, Some(class), Some(octree)) => Ok(Some(Lamp::Source(of_class(class, octree)?))),
            _ => Ok(None),
        }
    }
}

/// How much of a light reaches a place.
struct Shaded {
    at: Located,
    /// The surfel that the light is on.
    lamp: Option<Located>,
    found: ShadowAnswer,
}

fn shade(
    asked: &Asked<'_, '_>,
    args: &Args,
    at: &Place,
    lamp: &Lamp,
) -> Result<Shaded, QueryError> {
    let snap = snap_of(args.snap);
    let at = asked.map.locate(at, snap)?;
    let on = match lamp {
        Lamp::Place(position) if !args.air => {
            asked.map.surface_at(&place(*position, None), snap)?
        }
        _ => None,
    };
    let light = match (lamp, &on) {
        (_, Some(on)) => Light::Surfel(on),
        (Lamp::Place(position), None) => Light::Air(*position),
        (Lamp::Source(source), None) => Light::Source(source),
    };
    let found = asked.map.shadow(&at, &light)?;
    Ok(Shaded { at, lamp: on, found })
}

fn word(found: &ShadowAnswer) -> &'static str {
    match found.reaches {
        Sight::All => "lit",
        Sight::Part(_) => "penumbra",
        Sight::None => "umbra",
    }
}

fn as_json(Shaded { at, lamp, found }: &Shaded) -> Value {
    json!({
        "light": word(found),
        "share": found.reaches.share(),
        "surfel": at.surfel,
        "distance": at.distance,
        "blocker": found.blocker,
        "lamp": lamp.map(|lamp| lamp.surfel),
        "light_surfels": found.n_surfels,
        "light_points": found.n_points,
        "links": found.n_links,
    })
}

fn table(asked: &Asked<'_, '_>, args: &Args, rows: &Path, lamp: Option<Lamp>) -> Outcome {
    let expected = "x,y,z, nx,ny,nz to choose sides, and lx,ly,lz for a light each";
    let (rows, (places, lights)) = batch::open(rows, |header| {
        let places = PlaceColumns::find(header, ["x", "y", "z"], ["nx", "ny", "nz"], expected)?;
        Ok((places, header.all_or_none(["lx", "ly", "lz"], expected)?))
    })?;
    batch::answer(rows, &Shadows { asked, args, lamp, places, lights }, args.json, asked.progress)
}

struct Shadows<'q, 'm, 'a> {
    asked: &'q Asked<'m, 'a>,
    args: &'q Args,
    lamp: Option<Lamp>,
    places: PlaceColumns,
    lights: Option<Columns<3>>,
}

impl Batch for Shadows<'_, '_, '_> {
    type Answer = Shaded;

    const HEADER: &'static str = "light,share,surfel,distance,blocker,lamp,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Shaded, RowError>> {
        batch::each(rows, |row| {
            let at = self.places.read(row)?;
            let own = numbers_if_any(row, &self.lights)?.map(Lamp::Place);
            let lamp = own.as_ref().or(self.lamp.as_ref()).ok_or_else(|| NO_LIGHT.to_owned())?;
            self.asked.of_row(shade(self.asked, self.args, &at, lamp))
        })
    }

    fn write(&self, Shaded { at, lamp, found }: &Shaded, out: &mut Vec<u8>) -> io::Result<()> {
        let (word, share) = (word(found), found.reaches.share());
        write!(out, "{word},{share},{},{},", at.surfel, at.distance)?;
        for surfel in [found.blocker, lamp.map(|lamp| lamp.surfel)] {
            match surfel {
                Some(surfel) => write!(out, "{surfel},")?,
                None => write!(out, ",")?,
            }
        }
        Ok(())
    }

    fn object(&self, shaded: &Shaded) -> Value {
        as_json(shaded)
    }
}
