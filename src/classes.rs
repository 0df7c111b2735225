//! The classes of the points under the surfels of a map: maps hold none, so the octree is asked.

use std::collections::HashMap;
use std::path::Path;

use pvmap_geometry::morton;
use pvmap_query::Map;
use pvmap_store::Watch;
use pvmap_vmap::octree::{CODE_STRIDE, Point};
use pvmap_vmap::{FormatError, MapView, OctreeView, Router};

use crate::Error;

/// An octree whose points have classes, and a map of it.
struct Classes<'a> {
    map: &'a MapView<'a>,
    map_path: &'a Path,
    octree: OctreeView<'a>,
    octree_path: &'a Path,
    /// Where the class is in a record.
    at: usize,
}

impl<'a> Classes<'a> {
    fn open(
        (map, map_path): (&'a MapView<'a>, &'a Path),
        (octree, octree_path): (&'a [u8], &'a Path),
    ) -> Result<Classes<'a>, Error> {
        let octree = OctreeView::open(octree).map_err(|e| Error::artifact(octree_path, e))?;
        let refuse = |what: &str| Err(Error::Data(format!("{}: {what}", octree_path.display())));
        if octree.summary().digest != map.summary().digest {
            return refuse(&format!("{} was built from another octree", map_path.display()));
        }
        let Some(column) = octree.schema().column("class") else {
            return refuse("its points have no classes");
        };
        let at = column.offset;
        Ok(Classes { map, map_path, octree, octree_path, at })
    }

    /// Hands out the points with their classes, in the order of the octree.
    fn each(
        &self,
        watch: &dyn Watch,
        mut take: impl FnMut(&Point<'_>, u8) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let of_octree = |e: FormatError| Error::artifact(self.octree_path, e);
        let n_points = self.octree.summary().n_points;
        let mut first = 0;
        while first < n_points {
            watch.check()?;
            let n = CODE_STRIDE.min(n_points - first);
            for point in self.octree.points(first, n).map_err(of_octree)?.iter() {
                let point = point.map_err(of_octree)?;
                // A record has all its columns.
                let class = point.record.get(self.at).copied().unwrap_or_default();
                take(&point, class)?;
            }
            watch.advance(n);
            first += n;
        }
        Ok(())
    }

    /// Gives the surfel that stands for a point.
    fn surfel_of(
        &self,
        router: &mut Router<'_, MapView<'_>>,
        point: &Point<'_>,
    ) -> Result<u32, Error> {
        let found = router.surfel_of(&point.key).map_err(|e| self.of_map(e))?;
        // A damaged leaf can name any surfel.
        let found = found.filter(|&surfel| surfel < self.map.summary().n_surfels);
        let what = format!("a point has no leaf in {}", self.map_path.display());
        found.ok_or_else(|| Error::Data(format!("{}: {what}", self.octree_path.display())))
    }

    fn of_map(&self, e: FormatError) -> Error {
        Error::artifact(self.map_path, e)
    }
}

/// Counts the points of a class that each surfel of a map stands for: surfels that have some,
/// rising, for [`pvmap_query::Light::Points`].
///
/// `octree` are the bytes of the octree that the map was built from; all its points are gone
/// through once. Paths are those of messages.
///
/// # Errors
/// Where the octree is another one, has no classes or no point of this one, or a file is damaged.
pub fn class_points(
    map: &Map<'_>,
    map_path: &Path,
    octree: &[u8],
    octree_path: &Path,
    class: u8,
) -> Result<Vec<(u32, u64)>, Error> {
    let view = map.view();
    let all = Classes::open((view, map_path), (octree, octree_path))?;
    let mut counts = vec![0u64; view.summary().n_surfels as usize];
    let mut router = Router::new(view);
    all.each(&pvmap_store::Quiet, |point, found| {
        if found == class {
            counts[all.surfel_of(&mut router, point)? as usize] += 1;
        }
        Ok(())
    })?;
    let lamps: Vec<(u32, u64)> = (0..).zip(counts).filter(|&(_, n)| n > 0).collect();
    if lamps.is_empty() {
        let octree = octree_path.display();
        return Err(Error::Data(format!("{octree}: no point has class {class}")));
    }
    Ok(lamps)
}

/// Open leaves beyond which those that are complete are closed. At most 28 can be open at a time:
/// seven bins with four quadrants each share a place.
const MANY_OPEN: usize = 64;

/// Points by class, 256 counts, of a leaf that may get more, and where its cell ends.
struct Open {
    counts: Box<[u64]>,
    end_code: u64,
}

impl Open {
    /// Gives the class that most have, the lowest of several.
    fn majority(&self) -> u8 {
        let all = (0..=u8::MAX).rev().zip(self.counts.iter().rev());
        // Of equals the last counts.
        all.max_by_key(|(_, n)| **n).map_or(0, |(class, _)| class)
    }
}

/// Gives the class that most points of each surfel have, the lowest of several.
///
/// `octree` are the bytes of the octree that the map was built from; all its points are gone
/// through once, and nothing but a byte a surfel is held. Paths are those of messages.
///
/// # Errors
/// Where the octree is another one or has no classes, a file is damaged or the run is asked to
/// stop.
pub fn majority_classes(
    map: &MapView<'_>,
    map_path: &Path,
    octree: &[u8],
    octree_path: &Path,
    watch: &dyn Watch,
) -> Result<Vec<u8>, Error> {
    let all = Classes::open((map, map_path), (octree, octree_path))?;
    watch.stage("classes", Some(all.octree.summary().n_points), "points");
    let mut majority = vec![0; map.summary().n_surfels as usize];
    let mut close = |surfel: u32, open: &Open| majority[surfel as usize] = open.majority();
    let mut open = HashMap::<u32, Open>::new();
    let mut router = Router::new(map);
    all.each(watch, |point, class| {
        let surfel = all.surfel_of(&mut router, point)?;
        if !open.contains_key(&surfel) {
            // Points come by Morton code: what ends before this one is complete.
            let code = morton::encode(point.key.g);
            if open.len() >= MANY_OPEN {
                open.retain(|&surfel, leaf| {
                    let stays = leaf.end_code > code;
                    if !stays {
                        close(surfel, leaf);
                    }
                    stays
                });
            }
            let leaf = map.surfel(surfel).map_err(|e| all.of_map(e))?;
            let end_code = morton::cell_range(leaf.first_code, leaf.level).end;
            open.insert(surfel, Open { counts: vec![0; 256].into(), end_code });
        }
        if let Some(leaf) = open.get_mut(&surfel) {
            leaf.counts[usize::from(class)] += 1;
        }
        Ok(())
    })?;
    open.iter().for_each(|(&surfel, leaf)| close(surfel, leaf));
    Ok(majority)
}
