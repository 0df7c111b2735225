//! `pvmap export`: the content of a map as tables, as discs, and on the user's own points.

mod points;
mod tables;

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pvmap::vmap::octree::FILE_NAME;
use pvmap::{AtomicFile, Error, Exposure, Made, PointField, PointsFile, begin_file, folder_of};

use super::{Context, Outcome, parse_exposure, refuse_input, threads_parser};

/// Write what a map says onto the points of its scans, or its surfels, nodes and links
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Points (--points, with the octree that the map was built from): all points of all scans in one
file, in the order of the scans as they were given to pvmap ingest and of the records in them,
each with its coordinates, colour, intensity, class, GPS time and normal where the scans have
them, and with the new fields. Steps of a LAS stay the whole numbers they were; coordinates of a
PLY, or of scans on different lattices, are rounded to steps in a LAS, not in a PLY. Intensities
that are no whole numbers of 16 bits are scaled in a LAS, and intensity_f32 has what they were. A
PLY has colours of 8 bits. What else is less than in the scans is said in warnings.

Not in an octree, and so not in such an export: of LAS the returns, scan angles, flags, user data,
point source id, scanner channel, near infrared, wave packets and extra bytes other than normals,
and of the file its id, GUID, dates and all records but its coordinate reference system; of PLY all
other properties and elements, comments, and the types of colours and intensities. In a LAS every
point is a single return. To keep all that there is:

One scan with all that it has (--points and --scan FILE): the file is read again, record by record,
and written again as it is, with the new fields behind what each record has: LAS and LAZ as either
of them, PLY as PLY. FILE is one of the scans of the octree, found by how many records it has and,
if several have as many, by its name and its first point; export the others one by one. A record
that is not where the octree has it ends the export: FILE is another scan then, or was changed. A
record that pvmap ingest dropped stays, with new fields of 0. Of a file that pvmap ingest --lenient
took the part that is there is written, but of a PLY that was cut short nothing, nor of a LAZ that
is broken before its end.

Kept are of LAS the header with ids, dates, counts and bounds, all records before and behind the
points, wave packets, extra bytes, and bytes that no record is about; of PLY its form, text or
binary, all properties and elements, lists, and comments. Changed are the generating software of a
LAS, which is pvmap export, how a LAZ is cut, and descriptors of extra bytes, which stand in one
record with those of the new fields; counts and bounds of a file that was cut short are those of
the points that are there. Left out are the index of a COPC, whose records keep their order, bytes
behind the points of a LAZ before LAS 1.4 that its header does not name, and of a text PLY blank
lines among the vertices and blanks behind them.

A LAZ of wide records takes memory: about 20 KiB for each extra byte of point formats 6 and up, a
tenth of that before. PDAL reads extra bytes before LAS 1.4 with --readers.las.use_eb_vlr=true
alone, and no point formats 4, 5, 9 and 10.

Fields:
  visible-from=X,Y,Z   visible_from: 1 where the surfel of a point sees that of the place, or is
                       it, else 0; X,Y,Z,NX,NY,NZ gives the normal of the surface it is on, too
  lit=X,Y,Z            lit: 1 where light from the place reaches the surfel of a point, else 0; the
                       place is a lamp or scanner in the air, or on a surface if one is near
  sees-count           sees_count: how many other surfels its surfel sees
  leaf                 leaf: its surfel, as in the tables
  level                level: of the surfel's cell; the whole cube has 0
  bin                  bin: of the surfel's normal, 0 to 5 for +x -x +y -y +z -z, 6 without one,
                       -1 in a plain tree
  normal               nx, ny, nz: the normal that the map was made by, estimated ones too, 0
                       without one; normal_x, ... where the scans have normals, which are nx, ...
  record               record: which record of its scan the point is, from 0
  source               source: which scan it is of, from 0
  radiosity            radiosity_red, _green, _blue, or radiosity in grey light: with --light the
                       light that leaves the point, flux an area in the unit of the lights. Times
                       --exposure it becomes the point's colour, too; with --scan colours stay.
                       with auto 95 % of the area that does not shine by itself stay below 0.8 of
                       white, and what that came to is said
  irradiance           irradiance_red, ... likewise: the light that arrives at the point
  sky-view             sky_view: with --light the share of open sky above its surfel, weighted with
                       the cosine: 1 on an open plain, 0.5 at the foot of a high wall
A field of a kind that was given before, or of a name that the records of --scan have, is named
visible_from_2, then visible_from_3, ...
LAS has fields as extra bytes. PLY has them as properties of a vertex, without --scan behind x y z
nx ny nz red green blue intensity classification gps_time, of which those stand that the scans have.

A file that is there is replaced only if pvmap export made it, or with --overwrite: a scan never is
otherwise. All outputs are begun before any work, and get their names together when all is done.

Points that --memory does not hold wait in a nameless temporary file beside the output; how much
is said before, and the disk must have it.

Surfels as .ply: discs in the scan's units, x y z nx ny nz red green blue radius n_points level
bin surfel. What follows is about the tables.

All numbers are integers. Places and lengths are in grid steps (pvmap info shows how long one is
and where they begin), normals have length 16384; ids count from 0, in the order of the rows.
A table goes to a file that appears whole, to a FIFO, or to standard output for - .

Columns:
  surfels   surfel, centroid cx cy cz, normal nx ny nz, squared radius r2, its cell's least corner
            cell_x cell_y cell_z and cell_level, its patch box min_x ... max_z, n_points, two_sided
  nodes     node, parent (-1 at the root), level, bin (-1 to 6), surfel (-1 unless a leaf)
  links     node_a, node_b: all surfels below the one see all below the other

Examples:
  pvmap export grotto.vmap --points seen.laz --field visible-from=1,2,3
  pvmap export grotto.vmap --octree site.octree --points all.ply --field sees-count --field leaf
  pvmap export grotto.vmap --scan grotto.laz --points seen.laz --field visible-from=1,2,3
  pvmap export grotto.vmap --light grotto.light --points lit.laz --field radiosity
  pvmap export grotto.vmap --surfels discs.ply
  pvmap export grotto.vmap --surfels S.csv --nodes N.csv --links L.csv
  pvmap export grotto.vmap --links - | head")]
pub(super) struct Args {
    /// The map, as pvmap build makes it
    #[arg(value_name = "NAME.vmap")]
    map: PathBuf,
    /// The octree that the map was built from, where the points are
    /// [default: the map's name with .octree]
    #[arg(long, value_name = "NAME.octree", requires = "points", verbatim_doc_comment)]
    octree: Option<PathBuf>,
    /// Where the points go: a .las, .laz or .ply [default: nowhere]
    #[arg(long, value_name = "LAS|LAZ|PLY")]
    points: Option<PathBuf>,
    /// A scan file of the octree: --points is this file with all that it
    /// has and the new fields, as below [default: points of the octree]
    #[arg(long, value_name = "FILE", requires = "points", verbatim_doc_comment)]
    scan: Option<PathBuf>,
    /// What each point gets beside what it has, as below; repeatable
    #[arg(
        long = "field",
        value_name = "FIELD",
        requires = "points",
        value_parser = points::parse_field
    )]
    fields: Vec<PointField>,
    /// The light of the map, as pvmap light makes it, for the fields
    /// radiosity, irradiance and sky-view
    #[arg(long, requires = "points", value_name = "NAME.light", verbatim_doc_comment)]
    light: Option<PathBuf>,
    /// With radiosity: what it is multiplied with to be linear light of
    /// colours, where 1 is white, or auto
    #[arg(
        long,
        default_value = "auto",
        requires = "light",
        value_parser = parse_exposure,
        value_name = "N",
        verbatim_doc_comment
    )]
    exposure: Exposure,
    /// Replace files of those names whatever they are
    #[arg(long)]
    overwrite: bool,
    /// How far from a surface the place of a field may be, in the
    /// scan's units [default: twice the spacing of the points there]
    #[arg(long, value_name = "DIST", requires = "points", verbatim_doc_comment)]
    snap: Option<f64>,
    /// Most memory that --points holds, at least 64MiB
    #[arg(long, default_value = "1GiB", value_parser = pvmap::parse_memory, value_name = "SIZE")]
    memory: u64,
    /// Threads of --points; 0 takes as many as the machine has
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = threads_parser())]
    threads: usize,
    /// Where the surfels go: a table, or discs if it ends in .ply
    /// [default: nowhere]
    #[arg(long, value_name = "S.csv|S.ply", verbatim_doc_comment)]
    surfels: Option<PathBuf>,
    /// Where the table of nodes goes [default: nowhere]
    #[arg(long, value_name = "N.csv")]
    nodes: Option<PathBuf>,
    /// Where the table of links goes [default: nowhere]
    #[arg(long, value_name = "L.csv")]
    links: Option<PathBuf>,
}

/// Gives the octree that was named, or that whose name is the map's.
fn octree_of(args: &Args) -> PathBuf {
    args.octree.clone().unwrap_or_else(|| args.map.with_extension("octree"))
}

/// Says whether two outputs, which need not be there, have one place.
fn same_place(a: &Path, b: &Path) -> bool {
    let place =
        |path: &Path| (folder_of(path).canonicalize().ok(), path.file_name().map(OsStr::to_owned));
    place(a) == place(b)
}

/// Says whether an output of surfels is one of discs.
fn is_discs(surfels: &Path) -> bool {
    surfels.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"))
}

pub(super) fn run(args: &Args, context: &Context) -> Outcome {
    let outputs: Vec<&PathBuf> =
        [&args.points, &args.surfels, &args.nodes, &args.links].into_iter().flatten().collect();
    if outputs.is_empty() {
        let message = "nothing to write: give --points, --surfels, --nodes or --links".to_owned();
        return Err(Error::Usage(message).into());
    }
    let mut inputs = vec![args.map.clone()];
    if args.points.is_some() {
        inputs.push(octree_of(args).join(FILE_NAME));
    }
    inputs.extend(args.scan.clone());
    inputs.extend(args.light.clone());
    for (i, output) in outputs.iter().enumerate() {
        refuse_input(output, &inputs)?;
        if outputs[..i].iter().any(|other| same_place(other, output)) {
            let message = format!("{}: two tables cannot go to one place", output.display());
            return Err(Error::Usage(message).into());
        }
    }
    // All of them before any work, and their names when all is done.
    let begun = Begun::of(args)?;
    let mut files = Vec::new();
    let mut done = None;
    if let Some(output) = begun.points {
        let (exported, file) = points::run(args, octree_of(args), output, context)?;
        done = Some(exported);
        files.push(file);
    }
    let stages = context.progress.take_stages();
    if let Some(discs) = begun.discs {
        files.push(pvmap::write_surfels(&args.map, discs, &context.progress)?);
    }
    files.extend(tables::run(&args.map, begun.tables, &context.progress)?);
    files.into_iter().try_for_each(|file| file.publish(false))?;
    match done {
        Some(done) => Ok(points::report(args, &done, &stages)?),
        None => Ok(ExitCode::SUCCESS),
    }
}

/// All outputs, begun.
struct Begun {
    points: Option<PointsFile>,
    discs: Option<AtomicFile>,
    tables: Vec<tables::Table>,
}

impl Begun {
    fn of(args: &Args) -> Result<Begun, Error> {
        let points = args.points.as_ref();
        let points = points.map(|path| PointsFile::begin(path, args.overwrite)).transpose()?;
        let discs = args.surfels.as_ref().filter(|s| is_discs(s));
        let discs = discs.map(|path| begin_file(path, Made::Ply, args.overwrite)).transpose()?;
        Ok(Begun { points, discs, tables: tables::begin(args)? })
    }
}
