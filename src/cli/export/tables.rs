//! The content of a map as tables.

use std::io::{BufWriter, Write};
use std::path::Path;

use pvmap::vmap::tree::Nodes;
use pvmap::vmap::{FormatError, MapView};
use pvmap::{Error, StoreError, TableFile, Watch};

use super::super::map_file;
use super::{Args, is_discs};

const SURFEL_HEADER: &str = "surfel,cx,cy,cz,nx,ny,nz,r2,cell_x,cell_y,cell_z,cell_level,\
min_x,min_y,min_z,max_x,max_y,max_z,n_points,two_sided";

/// Writes the tables that are asked for.
pub(super) fn run(args: &Args, watch: &dyn Watch) -> Result<(), Error> {
    let table = args.surfels.as_ref().filter(|s| !is_discs(s));
    if table.is_none() && args.nodes.is_none() && args.links.is_none() {
        return Ok(());
    }
    let (path, bytes) = map_file(&args.map)?;
    let named = |e: FormatError| Error::artifact(&path, e);
    let view = MapView::open(&bytes).map_err(named)?;
    if let Some(output) = table {
        write(output, SURFEL_HEADER, |out| surfels(&view, &path, out, watch))?;
    }
    if let Some(output) = &args.nodes {
        write(output, "node,parent,level,bin,surfel", |out| nodes(&view, &path, out, watch))?;
    }
    if let Some(output) = &args.links {
        write(output, "node_a,node_b", |out| links(&view, &path, out, watch))?;
    }
    Ok(())
}

type Out = BufWriter<TableFile>;

/// Writes a table; a file appears whole or not at all.
fn write(
    path: &Path,
    header: &str,
    rows: impl FnOnce(&mut Out) -> Result<(), Error>,
) -> Result<(), Error> {
    let fail = |e| Error::Store(StoreError::io(path, "write", e));
    let mut out = BufWriter::with_capacity(1 << 20, TableFile::create(path)?);
    writeln!(out, "{header}").map_err(fail)?;
    rows(&mut out)?;
    let file = out.into_inner().map_err(|e| fail(e.into_error()))?;
    Ok(file.commit()?)
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
    for block in 0..view.n_link_blocks() {
        watch.check()?;
        let lists = view.link_lists(block).map_err(|e| Error::artifact(path, e))?;
        watch.advance(lists.len() as u64);
        for (a, b) in lists.iter() {
            writeln!(out, "{a},{b}").map_err(|e| StoreError::io(path, "write a table of", e))?;
        }
    }
    Ok(())
}
