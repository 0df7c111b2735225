//! A map as its reader sees it: a view of the bytes of a whole file. Section 5 of FORMAT.md.

use pvmap_geometry::disc::Profile;
use pvmap_geometry::{Box3, Rect, morton};

use crate::bytes::FieldReader;
use crate::config::{MapConfig, profile_of};
use crate::container::{Closing, Container, FRACTIONS, Kind, RECTS, Section, Written, close};
use crate::error::FormatError;
use crate::fraction::Fraction;
use crate::frame::{CrsKind, FrameRecord};
use crate::pairs::{PairSections, Pairs};
use crate::records::{MapSummary, NO_PARENT, Node, Record, Split, Surfel};
use crate::tree::{Nodes, overhang};

/// The sections of every map in file order, without `sums`.
pub const SECTIONS: [&str; 8] =
    ["summary", "config", "nodes", "surfels", "links", "linkidx", "frame", "crs"];

/// The section behind them with profile `oriented`. [F-22]
pub const RECTS_SECTION: &str = RECTS.0;

/// The sections of a map with visible fractions, the first behind `links`, the second behind
/// `linkidx`. [F-24]
const FRACTION_SECTIONS: [&str; 2] = [FRACTIONS.0, "fracidx"];

/// Names the sections of a map in file order, without `sums`.
pub fn section_names(profile: Profile, has_fractions: bool) -> Vec<&'static str> {
    let with = |name| match name {
        "links" if has_fractions => vec![name, FRACTION_SECTIONS[0]],
        "linkidx" if has_fractions => vec![name, FRACTION_SECTIONS[1]],
        _ => vec![name],
    };
    let rects = (profile == Profile::Oriented).then_some(RECTS_SECTION);
    SECTIONS.into_iter().flat_map(with).chain(rects).collect()
}

/// The largest `config` a reader accepts.
const MAX_CONFIG_BYTES: u64 = 4096;

/// An open map. Opening reads the header, the table and a few small rows; nodes, surfels and
/// links are read, and their checksums checked, when they are asked for.
#[derive(Debug)]
pub struct MapView<'a> {
    file: Container<'a>,
    summary: MapSummary,
    frame: FrameRecord,
    nodes: Section,
    surfels: Section,
    links: PairSections,
    /// With profile `oriented`.
    rects: Option<Section>,
    /// With visible fractions.
    fractions: Option<PairSections>,
}

impl<'a> MapView<'a> {
    /// Opens the bytes of a whole file.
    ///
    /// # Errors
    /// Where they are not a map that can be read, or what opening reads is damaged.
    pub fn open(bytes: &'a [u8]) -> Result<MapView<'a>, FormatError> {
        let file = Container::open(bytes, Kind::Map)?;
        let summary: MapSummary = single(&file, "summary")?;
        let frame: FrameRecord = single(&file, "frame")?;
        let nodes = file.section("nodes", Node::BYTES as u32)?.clone();
        let surfels = file.section("surfels", Surfel::BYTES as u32)?.clone();
        let links = PairSections::of(&file, ["links", "linkidx"])?;
        let rects = match file.required() & RECTS.1 {
            0 => None,
            _ => Some(file.section(RECTS_SECTION, Rect::BYTES as u32)?.clone()),
        };
        let fractions = match file.required() & FRACTIONS.1 {
            0 => None,
            _ => Some(PairSections::of(&file, FRACTION_SECTIONS)?),
        };
        let counted = [(&nodes, summary.n_nodes), (&surfels, summary.n_surfels)];
        let cut = rects.iter().map(|rects| (rects, summary.n_surfels));
        for (section, expected) in counted.into_iter().chain(cut) {
            if section.n_records != u64::from(expected) {
                let found = section.n_records;
                return Err(section.broken(0, format!("{found} records, summary says {expected}")));
            }
        }
        Ok(MapView { file, summary, frame, nodes, surfels, links, rects, fractions })
    }

    /// Gives the file around the sections.
    pub fn file(&self) -> &Container<'a> {
        &self.file
    }

    /// Gives the counts.
    pub fn summary(&self) -> &MapSummary {
        &self.summary
    }

    /// Gives the way from world units to the grid.
    pub fn frame(&self) -> &FrameRecord {
        &self.frame
    }

    /// Gives the kind and the bytes of the coordinate reference system.
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn crs(&self) -> Result<(CrsKind, &'a [u8]), FormatError> {
        Ok((self.frame.crs_kind, self.file.read_all(self.file.section("crs", 0)?)?))
    }

    /// Gives the canonical text of the keys that decided the content. [F-14]
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn config(&self) -> Result<&'a str, FormatError> {
        let section = self.file.section("config", 0)?;
        if section.len_bytes > MAX_CONFIG_BYTES {
            return Err(section.broken(0, "longer than a configuration can be"));
        }
        let text = std::str::from_utf8(self.file.read_all(section)?);
        text.map_err(|_| section.broken(0, "not UTF-8"))
    }

    /// Reads a surfel, `id` < `n_surfels`.
    ///
    /// # Errors
    /// Where there is none of that id or its block is damaged.
    pub fn surfel(&self, id: u32) -> Result<Surfel, FormatError> {
        record(&self.file, &self.surfels, id.into())
    }

    /// Reads what a surfel is cut to, `id` < `n_surfels`; none where the profile is not `oriented`.
    ///
    /// # Errors
    /// Where there is none of that id or its block is damaged.
    pub fn rect(&self, id: u32) -> Result<Option<Rect>, FormatError> {
        self.rects.as_ref().map(|rects| record(&self.file, rects, id.into())).transpose()
    }

    /// Gives the profile that the map was made with.
    ///
    /// # Errors
    /// Where the configuration is damaged, names none, or one that the file does not say.
    pub fn profile(&self) -> Result<Profile, FormatError> {
        let broken = |what| Ok(self.file.section("config", 0)?.broken(0, what));
        match profile_of(self.config()?) {
            None => broken("names no profile").and_then(Err),
            Some(profile) if (profile == Profile::Oriented) != self.rects.is_some() => {
                broken("names a profile that has rectangles, or the file has some").and_then(Err)
            }
            Some(profile) => Ok(profile),
        }
    }

    /// Gives the links. [F-17]
    pub fn links(&self) -> Pairs<'_, 'a> {
        Pairs::new(&self.file, &self.links)
    }

    /// Gives the pairs with visible fractions, as [`Fraction`] reads them; none where the map has
    /// none. [F-24]
    pub fn fractions(&self) -> Option<Pairs<'_, 'a>> {
        self.fractions.as_ref().map(|sections| Pairs::new(&self.file, sections))
    }

    /// Reads the parent of a node, and nothing else of its record; [`NO_PARENT`] of the root.
    ///
    /// # Errors
    /// Where there is no such node, its block is damaged or its parent does not come before it.
    #[inline]
    pub fn parent(&self, id: u32) -> Result<u32, FormatError> {
        let at = u64::from(id) * Node::BYTES as u64 + Node::PARENT_AT;
        let parent = FieldReader::new(self.file.read(&self.nodes, at, 4)?).u32();
        self.check_parent(id, parent)?;
        Ok(parent)
    }

    /// Checks that all nodes but the root have a parent, and before them.
    #[inline]
    fn check_parent(&self, id: u32, parent: u32) -> Result<(), FormatError> {
        let fits = if id == 0 { parent == NO_PARENT } else { parent < id };
        if fits {
            return Ok(());
        }
        let what = format!("node {id} has an impossible parent");
        Err(self.nodes.broken(u64::from(id) * Node::BYTES as u64, what))
    }

    /// Checks every byte and every rule of FORMAT.md.
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify(&self) -> Result<(), FormatError> {
        self.verify_telling(&mut |_| ())
    }

    /// Does what [`Self::verify`] does; `tell` gets the number of bytes gone through, again and
    /// again, in all about [`Self::verify_bytes`].
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify_telling(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        self.file.verify(tell)?;
        self.crs()?;
        self.verify_config()?;
        self.verify_tree()?;
        self.verify_links(tell)?;
        self.verify_fractions(tell)
    }

    /// Counts the bytes that verifying goes through: the whole file, then links and visible
    /// fractions again.
    pub fn verify_bytes(&self) -> u64 {
        let of_fractions = self.fractions().map_or(0, |fractions| fractions.len_bytes());
        self.file.len_bytes() + self.links().len_bytes() + of_fractions
    }

    fn verify_config(&self) -> Result<(), FormatError> {
        let text = self.config()?;
        let broken = |what| Ok(self.file.section("config", 0)?.broken(0, what));
        match MapConfig::of_text(text) {
            None => broken("not the keys of a map in their canonical form").and_then(Err)?,
            Some(config) if config.has_fractions() != self.fractions.is_some() => {
                broken("names visible fractions, or the file has some").and_then(Err)?;
            }
            Some(_) => {}
        }
        self.profile()?;
        Ok(())
    }

    fn verify_tree(&self) -> Result<(), FormatError> {
        let mut n_surfels = 0;
        // The nodes above the one at hand, the root first.
        let mut path: Vec<Above> = Vec::new();
        for id in 0..self.summary.n_nodes {
            let node = self.node(id)?;
            self.close_ended(&mut path, id, n_surfels)?;
            let bad = |what| Err(self.nodes.broken(u64::from(id) * Node::BYTES as u64, what));
            let fits = match path.last_mut() {
                Some(above) => above.admits(id, &node),
                None => id == 0 && is_root(&node, self.summary.n_nodes),
            };
            if !fits {
                return bad("no child its parent can have here");
            }
            if node.first_surfel != n_surfels {
                return bad("the surfels of the subtree are not those of its leaves");
            }
            if node.is_leaf() {
                let patch = self.verify_leaf(id, &node)?;
                if let Some(above) = path.last_mut() {
                    above.around = above.around.join(&patch);
                }
                n_surfels += 1;
            } else {
                path.push(Above { id, node, n_points: 0, next_slot: 0, around: Box3::EMPTY });
            }
        }
        self.close_ended(&mut path, self.summary.n_nodes, n_surfels)?;
        if n_surfels != self.summary.n_surfels {
            return Err(self.surfels.broken(0, format!("{n_surfels} leaves in the tree")));
        }
        Ok(())
    }

    /// Checks and drops the nodes whose subtrees end before `id`.
    fn close_ended(
        &self,
        path: &mut Vec<Above>,
        id: u32,
        n_surfels: u32,
    ) -> Result<(), FormatError> {
        while let Some(above) = path.pop_if(|above| above.node.end <= id) {
            let Above { id: parent, node, n_points, around, .. } = above;
            let at = u64::from(parent) * Node::BYTES as u64;
            if (node.end, node.n_points, node.end_surfel) != (id, n_points, n_surfels) {
                return Err(self.nodes.broken(at, "the children do not add up to the node"));
            }
            self.verify_overhang(parent, &node, &around)?;
            if let Some(above) = path.last_mut() {
                above.around = above.around.join(&around);
            }
        }
        Ok(())
    }

    /// Checks how far the patch boxes under a node, all in `around`, leave its cell.
    fn verify_overhang(&self, id: u32, node: &Node, around: &Box3) -> Result<(), FormatError> {
        if node.overhang != overhang(&node.cell(), around) {
            let at = u64::from(id) * Node::BYTES as u64;
            return Err(self.nodes.broken(at, "not the overhang of its leaves"));
        }
        Ok(())
    }

    /// Checks a leaf and gives its patch box.
    fn verify_leaf(&self, id: u32, node: &Node) -> Result<Box3, FormatError> {
        let surfel = self.surfel(node.first_surfel)?;
        let same = surfel.node == id
            && node.end == id + 1
            && node.end_surfel == node.first_surfel + 1
            && (surfel.n_points, surfel.first_code) == (node.n_points, node.first_code)
            && (surfel.level, surfel.bin) == (node.level, node.bin);
        if !same {
            let at = u64::from(node.first_surfel) * Surfel::BYTES as u64;
            return Err(self.surfels.broken(at, format!("differs from its leaf, node {id}")));
        }
        self.verify_overhang(id, node, &surfel.patch)?;
        let rect = self.rect(node.first_surfel)?;
        if let (Some(rect), Some(rects)) = (rect, &self.rects)
            && (rect == Rect::NONE) != (surfel.normal == [0; 3])
        {
            let at = u64::from(node.first_surfel) * Rect::BYTES as u64;
            return Err(rects.broken(at, "a rectangle without a plane, or a plane without one"));
        }
        Ok(surfel.patch)
    }

    fn verify_links(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        let mut n_pairs = 0u128;
        // The links of a node stand together: it is read once.
        let mut near: Option<(u32, Node)> = None;
        let n_leaves = |node: &Node| u128::from(node.end_surfel - node.first_surfel);
        let each = |a: u32, b: u32| {
            if b >= self.summary.n_nodes {
                return Ok(Some(format!("a link to node {b} of no tree")));
            }
            let from = match near {
                Some((id, from)) if id == a => from,
                _ => near.insert((a, self.node(a)?)).1,
            };
            n_pairs += n_leaves(&from) * n_leaves(&self.node(b)?);
            let is_below = b < from.end;
            Ok(is_below.then(|| "a link between a node and one below it".to_owned()))
        };
        self.links().verify(self.summary.n_links, each, tell)?;
        if n_pairs != self.summary.n_visible_pairs {
            let section = self.file.section("links", 0)?;
            return Err(section.broken(0, "links do not cover the stated visible pairs"));
        }
        Ok(())
    }

    fn verify_fractions(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        let Some(fractions) = self.fractions() else { return Ok(()) };
        let config = MapConfig::of_text(self.config()?);
        let of_leaves = config.is_some_and(|c| c.opening_angle == 0.0 && c.min_exchange == 0.0);
        let mut before = None;
        let each = |a: u32, numbers: u32| {
            let fault = match Fraction::of_pair((a, numbers)) {
                None => Some("more free segments than were tried"),
                Some(Fraction { b, .. }) if b >= self.summary.n_nodes => Some("a node of no tree"),
                Some(Fraction { b, .. }) if b < self.node(a)?.end => {
                    Some("a pair of a node and one below it")
                }
                Some(Fraction { b, .. }) if before.replace((a, b)) == Some((a, b)) => {
                    Some("a pair that has two visible fractions")
                }
                Some(Fraction { b, .. })
                    if of_leaves && !(self.node(a)?.is_leaf() && self.node(b)?.is_leaf()) =>
                {
                    Some("a visible fraction of nodes that are no leaves")
                }
                Some(_) => None,
            };
            Ok(fault.map(str::to_owned))
        };
        fractions.verify(self.summary.n_fractions, each, tell)
    }
}

/// A node that is open while its subtree is checked.
struct Above {
    id: u32,
    node: Node,
    /// Points of the children so far.
    n_points: u64,
    /// The least slot the next child can have.
    next_slot: u8,
    /// The patch boxes of the leaves so far.
    around: Box3,
}

impl Above {
    /// Takes a node as the next child, if it can be one.
    fn admits(&mut self, id: u32, child: &Node) -> bool {
        let node = &self.node;
        let same_cell = (child.level, child.first_code) == (node.level, node.first_code);
        let fits = match node.split {
            Split::Leaf => false,
            Split::Bins => same_cell && i16::from(child.bin) == i16::from(child.slot),
            Split::Quadrants => same_cell && child.bin == node.bin && child.is_leaf(),
            Split::Octants => {
                let level = node.level + 1;
                level <= morton::MAX_LEVEL
                    && (child.level, child.bin) == (level, node.bin)
                    && morton::cell_range(child.first_code, level).start == child.first_code
                    && morton::cell_range(child.first_code, node.level).start == node.first_code
                    && morton::octant(child.first_code, level) == child.slot
            }
        };
        let in_order = self.next_slot <= child.slot && child.slot < node.split.n_slots();
        let inside = child.parent == self.id && id < node.end && child.end <= node.end;
        self.next_slot = child.slot.saturating_add(1);
        let sum = self.n_points.checked_add(child.n_points);
        self.n_points = sum.unwrap_or(u64::MAX);
        fits && in_order && inside && sum.is_some()
    }
}

/// Says whether a node can be the root of a tree of so many nodes.
fn is_root(node: &Node, n_nodes: u32) -> bool {
    let cell = (node.level, node.first_code, node.slot) == (0, 0, 0);
    cell && node.bin == -1 && node.end == n_nodes && node.parent == NO_PARENT
}

impl Nodes for MapView<'_> {
    type Error = FormatError;

    fn n_nodes(&self) -> u32 {
        self.summary.n_nodes
    }

    #[inline]
    fn node(&self, id: u32) -> Result<Node, FormatError> {
        let node: Node = record(&self.file, &self.nodes, id.into())?;
        let surfels =
            node.first_surfel < node.end_surfel && node.end_surfel <= self.summary.n_surfels;
        let leaf = node.is_leaf() == (node.end == id.saturating_add(1));
        if node.end <= id || node.end > self.summary.n_nodes || !surfels || !leaf {
            let what = format!("node {id} has an impossible subtree");
            return Err(self.nodes.broken(u64::from(id) * Node::BYTES as u64, what));
        }
        self.check_parent(id, node.parent)?;
        Ok(node)
    }
}

/// Reads a record of a section.
#[inline]
pub(crate) fn record<R: Record>(
    file: &Container<'_>,
    section: &Section,
    i: u64,
) -> Result<R, FormatError> {
    let at = i.saturating_mul(R::BYTES as u64);
    let bytes = file.read(section, at, R::BYTES as u64)?;
    R::from_bytes(bytes)
        .ok_or_else(|| section.broken(at, format!("record {i} has an impossible value")))
}

/// Reads the only record of a section.
pub(crate) fn single<R: Record>(file: &Container<'_>, name: &str) -> Result<R, FormatError> {
    let section = file.section(name, R::BYTES as u32)?;
    if section.n_records != 1 {
        return Err(section.broken(0, format!("{} records, not one", section.n_records)));
    }
    record(file, section, 0)
}

/// Makes what closes a map, from its sections in the order of [`section_names`].
pub fn close_map(sections: &[Written]) -> Closing {
    let mut names = section_names(Profile::Oriented, true).into_iter();
    let are_in_order = sections.iter().all(|section| names.any(|name| name == section.name));
    debug_assert!(are_in_order && sections.len() >= SECTIONS.len(), "sections in file order");
    close(Kind::Map, sections)
}

impl Split {
    /// Says how many children a node of this split can have.
    pub fn n_slots(self) -> u8 {
        match self {
            Split::Leaf => 0,
            Split::Octants => 8,
            Split::Quadrants => 4,
            Split::Bins => 7,
        }
    }
}
