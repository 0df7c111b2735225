//! What `--exact` needs wherever it stands: the octree, and how near occluders have to be. [V-7]

use std::num::NonZero;
use std::path::{Path, PathBuf};

use pvmap::query::exact::ExactOptions;
use pvmap::query::{Map, QueryError};
use pvmap::vmap::OctreeView;
use pvmap::{Error, Mapped};

use super::map_file;

/// How near occluders have to be, and how many.
#[derive(Debug, clap::Args)]
pub(super) struct Nearness {
    /// With --exact: how near the line points are that hide something
    /// [default: twice the usual half spacing of the points]
    #[arg(long, value_name = "DIST", requires = "exact", verbatim_doc_comment)]
    delta: Option<f64>,
    /// With --exact: how many such points it takes
    /// [default: 2]
    #[arg(long, value_name = "N", requires = "exact", verbatim_doc_comment)]
    k: Option<NonZero<u32>>,
}

impl Nearness {
    /// Makes options of what was given and of what is usual in a map.
    pub(super) fn options(&self, map: &Map<'_>) -> Result<ExactOptions, QueryError> {
        let usual = ExactOptions::usual(map)?;
        let k = self.k.unwrap_or(usual.k());
        match self.delta {
            None => Ok(ExactOptions::new(usual.delta_grid(), k)),
            Some(delta) => ExactOptions::in_units_of(&map.view().frame().frame, delta, k),
        }
    }
}

/// Whether points are asked, and which.
#[derive(Debug, clap::Args)]
pub(super) struct PointsArgs {
    /// Ask the points of the octree beside the surfels of the map
    #[arg(long)]
    pub(super) exact: bool,
    /// With --exact: the octree the map was built from
    /// [default: the map's name with .octree]
    #[arg(long, value_name = "NAME.octree", requires = "exact", verbatim_doc_comment)]
    octree: Option<PathBuf>,
    #[command(flatten)]
    pub(super) nearness: Nearness,
}

impl PointsArgs {
    /// Maps the octree that was named, or that whose name is the map's.
    pub(super) fn open(&self, map: &Path) -> Result<Points, Error> {
        let beside = map.with_extension("octree");
        Points::open(self.octree.as_deref().unwrap_or(&beside))
    }
}

/// The points of an octree that can be asked beside a map.
#[derive(Debug)]
pub(super) struct Points {
    path: PathBuf,
    bytes: Mapped,
}

impl Points {
    /// Maps an octree.
    pub(super) fn open(octree: &Path) -> Result<Points, Error> {
        let (path, bytes) = map_file(octree)?;
        Ok(Points { path, bytes })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn view(&self) -> Result<OctreeView<'_>, Error> {
        OctreeView::open(&self.bytes).map_err(|e| Error::artifact(&self.path, e))
    }

    /// Says which file an error is about.
    pub(super) fn named(&self, map: &Path, e: QueryError) -> Error {
        match e {
            QueryError::Octree(e) => Error::artifact(&self.path, e),
            QueryError::OtherOctree => Error::Data(format!(
                "{}: was not built from the points of {}; give the octree it was built from",
                map.display(),
                self.path.display()
            )),
            e => Error::of_query(map, e),
        }
    }
}
