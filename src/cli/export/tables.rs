//! The content of a map as tables.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use pvmap::vmap::MapView;
use pvmap::vmap::tree::Nodes;
use pvmap::{ClosedFile, Error, StoreError, TableFile, Watch};

use super::super::map_file;
use super::{Args, is_discs};

const SURFEL_HEADER: &str = "surfel,cx,cy,cz,nx,ny,nz,r2,cell_x,cell_y,cell_z,cell_level,\
min_x,min_y,min_z,max_x,max_y,max_z,n_points,two_sided";

const NODE_HEADER: &str = "node,parent,level,bin,surfel";
const LINK_HEADER: &str = "node_a,node_b";

/// A table that was begun.
pub(super) struct Table {
    file: TableFile,
    header: &'static str,
    rows: Rows,
}

/// Writes the rows of a table of the map of this name.
type Rows = fn(&MapView<'_>, &Path, &mut Out, &dyn Watch) -> Result<(), Error>;
type Out = BufWriter<TableFile>;

/// Begins the tables that are asked for.
pub(super) fn begin(args: &Args) -> Result<Vec<Table>, Error> {
    let discs = args.surfels.as_ref().is_some_and(|s| is_discs(s));
    let surfels = args.surfels.as_ref().filter(|_| !discs);
    let wanted: [(_, _, Rows); 3] = [
        (surfels, SURFEL_HEADER, self::surfels),
        (args.nodes.as_ref(), NODE_HEADER, nodes),
        (args.links.as_ref(), LINK_HEADER, links),
    ];
    let begin = |(path, header, rows): (Option<&PathBuf>, _, _)| {
        let file = pvmap::begin_table(path?, header, args.overwrite);
        Some(file.map(|file| Table { file, header, rows }))
    };
    wanted.into_iter().filter_map(begin).collect()
}

/// Writes tables that were begun; gives those that are files and have yet to get their names.
pub(super) fn run(
    map: &Path,
    tables: Vec<Table>,
    watch: &dyn Watch,
) -> Result<Vec<ClosedFile>, Error> {
    if tables.is_empty() {
        return Ok(Vec::new());
    }
    let (path, bytes) = map_file(map)?;
    let view = MapView::open(&bytes).map_err(|e| Error::artifact(&path, e))?;
    let mut files = Vec::new();
    for table in tables {
        files.extend(write(table, &view, &path, watch)?);
    }
    Ok(files)
}

fn write(
    table: Table,
    view: &MapView<'_>,
    map: &Path,
    watch: &dyn Watch,
) -> Result<Option<ClosedFile>, Error> {
    let path = table.file.path().to_path_buf();
    let fail = |e| Error::Store(StoreError::io(&path, "write", e));
    let mut out = BufWriter::with_capacity(1 << 20, table.file);
    writeln!(out, "{}", table.header).map_err(fail)?;
    (table.rows)(view, map, &mut out, watch)?;
    let file = out.into_inner().map_err(|e| fail(e.into_error()))?;
    Ok(file.close()?)
}

fn surfels(view: &MapView<'_>, path: &Path, out: &mut Out, watch: &dyn Watch) -> Result<(), Error> {
    let n_surfels = view.summary().n_surfels;
    watch.stage("surfels", Some(n_surfels.into()), "rows");
    for id in 0..n_surfels {
        watch.check()?;
        watch.advance(1);
        let s = view.surfel(id).map_err(|e| Error::artifact(path, e))?;
        let [cx, cy, cz] = s.centroid;
        let [nx, ny, nz] = s.normal;
        let [x, y, z] = s.cell().min;
        let ([x0, y0, z0], [x1, y1, z1]) = (s.patch.min, s.patch.max);
        writeln!(
            out,
            "{id},{cx},{cy},{cz},{nx},{ny},{nz},{},\
             {x},{y},{z},{},{x0},{y0},{z0},{x1},{y1},{z1},{},{}",
            s.radius2,
            s.level,
            s.n_points,
            u8::from(s.two_sided)
        )
        .map_err(|e| StoreError::io(path, "write a table of", e))?;
    }
    Ok(())
}

fn nodes(view: &MapView<'_>, path: &Path, out: &mut Out, watch: &dyn Watch) -> Result<(), Error> {
    let n_nodes = view.summary().n_nodes;
    watch.stage("nodes", Some(n_nodes.into()), "rows");
    for id in 0..n_nodes {
        watch.check()?;
        watch.advance(1);
        let node = view.node(id).map_err(|e| Error::artifact(path, e))?;
        let parent = if id == 0 { -1 } else { i64::from(node.parent) };
        let surfel = if node.is_leaf() { i64::from(node.first_surfel) } else { -1 };
        writeln!(out, "{id},{parent},{},{},{surfel}", node.level, node.bin)
            .map_err(|e| StoreError::io(path, "write a table of", e))?;
    }
    Ok(())
}

fn links(view: &MapView<'_>, path: &Path, out: &mut Out, watch: &dyn Watch) -> Result<(), Error> {
    watch.stage("links", Some(view.summary().n_links), "rows");
    for block in 0..view.links().n_blocks() {
        watch.check()?;
        let lists = view.links().lists(block).map_err(|e| Error::artifact(path, e))?;
        watch.advance(lists.len() as u64);
        for (a, b) in lists.iter() {
            writeln!(out, "{a},{b}").map_err(|e| StoreError::io(path, "write a table of", e))?;
        }
    }
    Ok(())
}
