//! The map that is asked, and the checked way to its nodes and surfels.

use std::sync::OnceLock;

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_geometry::{Box3, grid, morton};
use pvmap_vmap::records::Record;
use pvmap_vmap::tree::{self, Nodes};
use pvmap_vmap::{FormatError, MapView, Node, Split, Surfel};

use crate::discs::Discs;
use crate::error::QueryError;
use crate::frames::LinkFrames;
use crate::kept::Kept;
use crate::locate::Located;

/// The most nodes on the way from the root to a leaf: the root, its bin, levels 1…21, a quadrant.
pub(crate) const MAX_PATH: usize = 24;

/// A squared radius that holds every patch box, and keeps products of 2^80 with it within i128.
const WHOLE2: u64 = 1 << 46;

/// The last grid coordinate.
const LAST_STEP: i32 = grid::GRID_MAX as i32;

/// An open map that answers questions, from many threads at once if need be.
#[derive(Debug)]
pub struct Map<'a> {
    view: MapView<'a>,
    profile: Profile,
    is_slanted: bool,
    is_coarse: bool,
    is_solid: bool,
    pub(crate) frames: LinkFrames,
    pub(crate) fraction_frames: LinkFrames,
    pub(crate) kept: OnceLock<Kept>,
    pub(crate) discs: OnceLock<Discs>,
}

impl<'a> Map<'a> {
    /// Opens the bytes of a whole map file, reading its header, table and a few small rows.
    ///
    /// # Errors
    /// Where the bytes are not those of a map that can be read.
    pub fn open(bytes: &'a [u8]) -> Result<Map<'a>, QueryError> {
        let view = MapView::open(bytes)?;
        let config = view.config()?;
        let profile = view.profile()?;
        let has_key = |key| config.lines().any(|line| line.split(" = ").next() == Some(key));
        let has_fractions = view.fractions().is_some();
        if (has_key("fractions") || has_key("min_exchange")) != has_fractions {
            let what = "names visible fractions, or the file has some";
            return Err(view.file().section("config", 0)?.broken(0, what).into());
        }
        let is_slanted = has_key("opening_angle") || has_key("interaction_pairs");
        Ok(Map {
            view,
            profile,
            is_slanted,
            is_coarse: has_key("opening_angle") || has_key("min_exchange"),
            is_solid: false,
            frames: LinkFrames::default(),
            fraction_frames: if has_fractions {
                LinkFrames::default()
            } else {
                LinkFrames::within(0)
            },
            kept: OnceLock::new(),
            discs: OnceLock::new(),
        })
    }

    /// Does what [`Map::open`] does, for a map that keeps decoded links in so many bytes at the
    /// most.
    ///
    /// # Errors
    /// Those of [`Map::open`].
    pub fn open_within(bytes: &'a [u8], cache_bytes: u64) -> Result<Map<'a>, QueryError> {
        let (frames, fraction_frames) = (LinkFrames::within(cache_bytes), LinkFrames::within(0));
        Ok(Map { frames, fraction_frames, ..Map::open(bytes)? })
    }

    /// Takes surfaces as closed where they block rays and lights in the air: patches reach to the
    /// ends of their boxes, as if [V-2] (i) were not, for the discs of neighbours leave some 6 % of
    /// a wall open; and [V-2] (iii) spares only what has an end's own normal, give or take 60°,
    /// for past an edge one looks out otherwise. What surfels see of each other stays as the map
    /// has it.
    pub fn solid(self) -> Map<'a> {
        Map { is_solid: true, ..self }
    }

    /// Gives the file behind the answers.
    pub fn view(&self) -> &MapView<'a> {
        &self.view
    }

    /// Gives the profile the map was built with. [V-2]
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// Says whether links may join nodes that are not equally far below two siblings: the build
    /// started from given pairs [V-5], or did not open some nodes that are no leaves.
    pub(crate) fn is_slanted(&self) -> bool {
        self.is_slanted
    }

    /// Says whether surfaces are taken as closed.
    pub(crate) fn is_solid(&self) -> bool {
        self.is_solid
    }

    /// Says whether a link may cover leaves that do not face each other: nodes that are no leaves
    /// stood for them.
    pub(crate) fn is_coarse(&self) -> bool {
        self.is_coarse
    }

    /// Gives the cell of a node in world units, lowest and highest corner.
    ///
    /// # Errors
    /// Where there is no such node or its block is damaged.
    pub fn cell_of(&self, node: u32) -> Result<[[f64; 3]; 2], QueryError> {
        let cell = self.view.node(node)?.cell();
        let frame = &self.view.frame().frame;
        // The last cells end one step beyond the cube.
        let corner = |g: [i32; 3]| frame.world_of_real(g.map(|v| f64::from(v.min(LAST_STEP))));
        Ok([corner(cell.min), corner(cell.max)])
    }

    /// Counts the link frames decoded so far: what questions have read of the links.
    pub fn n_frames_decoded(&self) -> u64 {
        self.frames.n_decoded()
    }

    /// Reads the root, checking that it is the whole cube; none in a map without points.
    pub(crate) fn root(&self) -> Result<Option<Node>, FormatError> {
        if self.view.n_nodes() == 0 {
            return Ok(None);
        }
        let root = self.view.node(0)?;
        let whole = (root.level, root.first_code) == (0, 0);
        whole.then_some(Some(root)).ok_or_else(|| self.broken_node(0, "is not the whole cube"))
    }

    /// Walks the children of a node in slot order, checking what FORMAT.md says of them.
    ///
    /// Each node is child of one node only and sits at the depth its level allows, so that a walk
    /// from the root of any file meets each node at most once, at most [`MAX_PATH`] deep.
    pub(crate) fn children(
        &self,
        id: u32,
        node: Node,
    ) -> impl Iterator<Item = Result<(u32, Node), FormatError>> + '_ {
        let mut next = id + 1;
        let mut least_slot = 0;
        std::iter::from_fn(move || {
            if node.is_leaf() || next >= node.end {
                return None;
            }
            let child_id = next;
            let child = self.view.node(child_id).and_then(|child| {
                let fits = child.parent == id
                    && child.end <= node.end
                    && (least_slot..node.split.n_slots()).contains(&child.slot)
                    && is_cell_below(&node, &child);
                let what = "is no child of the node before it";
                fits.then_some(child).ok_or_else(|| self.broken_node(child_id, what))
            });
            // Past a broken child nothing is known: its error ends the walk.
            next = child.as_ref().map_or(node.end, |child| child.end);
            least_slot = child.as_ref().map_or(0, |child| child.slot + 1);
            Some(child.map(|child| (child_id, child)))
        })
    }

    /// Checks that a located place is of this map.
    #[inline]
    pub(crate) fn check_leaf(&self, place: &Located) -> Result<(), FormatError> {
        let is_leaf = match self.kept() {
            Some(kept) => kept.leaves.node_of(place.surfel) == Some(place.node),
            None => {
                let leaf = self.view.node(place.node)?;
                leaf.is_leaf() && leaf.first_surfel == place.surfel
            }
        };
        let what = "is not the leaf of that surfel";
        is_leaf.then_some(()).ok_or_else(|| self.broken_node(place.node, what))
    }

    /// Reads the leaf and the surfel of a located place, checking that they are of this map.
    pub(crate) fn leaf_of(&self, place: &Located) -> Result<(Node, Surfel), FormatError> {
        self.check_leaf(place)?;
        let leaf = self.view.node(place.node)?;
        Ok((leaf, self.surfel_of(place.node, &leaf)?))
    }

    /// Reads the surfel of a leaf, checking that it is the leaf's.
    pub(crate) fn surfel_of(&self, id: u32, leaf: &Node) -> Result<Surfel, FormatError> {
        let surfel = self.surfel(leaf.first_surfel)?;
        let same =
            surfel.node == id && (surfel.first_code, surfel.level) == (leaf.first_code, leaf.level);
        same.then_some(surfel).ok_or_else(|| self.broken_node(id, "is not the leaf of its surfel"))
    }

    /// Reads a surfel, checking that its points lie in its cell.
    pub(crate) fn surfel(&self, id: u32) -> Result<Surfel, FormatError> {
        let surfel = self.view.surfel(id)?;
        // A spacing is at most half the cube's side; both together keep the boxes within i32.
        let sane = surfel.half_spacing < 1 << 22 && !surfel.patch.is_empty();
        let fits = sane && {
            let (points, cell) = (points_box(&surfel), surfel.cell());
            // A place on the far side of the closed cell is in the next.
            let inside =
                (0..3).all(|i| cell.min[i] <= points.min[i] && points.max[i] < cell.max[i]);
            !points.is_empty() && inside
        };
        let what = "has points outside its cell";
        fits.then_some(surfel).ok_or_else(|| broken(&self.view, "surfels", Surfel::BYTES, id, what))
    }

    /// Gives a surfel's disc as the map's profile sees it.
    pub(crate) fn disc_of(&self, id: u32, surfel: &Surfel) -> Result<Disc, FormatError> {
        Ok(tree::disc_of(surfel, self.view.rect(id)?.as_ref(), self.profile))
    }

    /// Gives a surfel's disc as it blocks rays and segments that are no pair's.
    pub(crate) fn blocking_disc(&self, id: u32, surfel: &Surfel) -> Result<Disc, FormatError> {
        let disc = self.disc_of(id, surfel)?;
        Ok(if self.is_solid { Disc { radius2: WHOLE2, ..disc } } else { disc })
    }

    /// Names a broken rule of a node.
    pub(crate) fn broken_node(&self, id: u32, what: &str) -> FormatError {
        broken(&self.view, "nodes", Node::BYTES, id, what)
    }
}

/// Gives the box of a leaf's points: the patch box without its margin.
pub(crate) fn points_box(surfel: &Surfel) -> Box3 {
    surfel.patch.grown(-(surfel.half_spacing as i32))
}

/// Decides whether a child may be where it is, by its parent's split.
fn is_cell_below(node: &Node, child: &Node) -> bool {
    let same_cell = (child.level, child.first_code) == (node.level, node.first_code);
    match node.split {
        Split::Leaf => false,
        Split::Octants => {
            node.level < morton::MAX_LEVEL
                && child.level == node.level + 1
                && morton::cell_range(node.first_code, node.level).contains(&child.first_code)
                && child.split != Split::Bins
        }
        Split::Quadrants => same_cell && child.is_leaf(),
        Split::Bins => same_cell && child.split != Split::Bins,
    }
}

/// Names a broken rule of record `id` of a section.
fn broken(
    view: &MapView<'_>,
    section: &str,
    record_bytes: usize,
    id: u32,
    what: &str,
) -> FormatError {
    let at_bytes = u64::from(id) * record_bytes as u64;
    match view.file().section(section, record_bytes as u32) {
        Ok(found) => found.broken(at_bytes, format!("record {id} {what}")),
        Err(missing) => missing,
    }
}
