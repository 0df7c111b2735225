//! The map file of a build: written from the tree and the sorted links once all are decided.

use pvmap_geometry::Rect;
use pvmap_geometry::disc::Profile;
use pvmap_store::runs::{Pair, Runs};
use pvmap_store::sections::{Section, SectionWriter};
use pvmap_store::{SectionFile, StoreError, Watch};
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::frame::FrameRecord;
use pvmap_vmap::links::LinkEncoder;
use pvmap_vmap::map::{close_map, section_names};
use pvmap_vmap::records::{LinkBlock, Record};
use pvmap_vmap::{MapConfig, MapSummary, Node, Surfel, Tree};

use crate::build::MapInput;
use crate::error::VisibilityError;
use crate::fractions;
use crate::journal::{self, Journal};

/// What a map has at the least: how many links there will be nobody knows before (F21).
pub(crate) fn least_output_bytes(input: &MapInput<'_>, config: &MapConfig) -> u64 {
    let Tree { nodes, surfels, rects } = input.tree;
    let records = nodes.len() * Node::BYTES + surfels.len() * Surfel::BYTES;
    let n_sections = section_names(config.profile, config.has_fractions()).len();
    head_bytes(n_sections) + (records + rects.len() * Rect::BYTES) as u64
}

/// What was written.
#[derive(Debug)]
pub(crate) struct WrittenMap {
    pub(crate) summary: MapSummary,
    pub(crate) output_bytes: u64,
    /// Of the link section.
    pub(crate) link_bytes: u64,
    /// Of temporary files.
    pub(crate) temporary_bytes: u64,
}

/// Writes the map from the tree and the spilled links, and gives it its name.
pub(crate) fn write(
    input: &MapInput<'_>,
    config: &MapConfig,
    runs: Runs,
    journal: Journal,
    watch: &dyn Watch,
) -> Result<WrittenMap, VisibilityError> {
    let tree = input.tree;
    let names = section_names(config.profile, config.has_fractions());
    let mut file = SectionFile::create_in(journal.work(), journal::MAP, head_bytes(names.len()))?;
    // The summary is known last but stands first: its room is taken now.
    let room = file.whole(&[0; MapSummary::BYTES])?;
    let config_section = file.whole(config.to_text().as_bytes())?;
    let nodes = write_records(&mut file, &tree.nodes)?;
    let surfels = write_records(&mut file, &tree.surfels)?;
    let written = write_links(&mut file, config, tree, runs, watch)?;
    let WrittenLinks { links, fractions, n_visible_pairs, temporary_bytes } = written;
    let link_bytes = links.section.len_bytes;
    let index = write_records(&mut file, &links.index)?;
    let fraction_index = match &fractions {
        Some(fractions) => Some(write_records(&mut file, &fractions.index)?),
        None => None,
    };
    let frame = file.whole(&input.frame.to_bytes())?;
    let crs = file.whole(input.crs)?;
    let summary = MapSummary {
        n_points: tree.nodes.first().map_or(0, |root| root.n_points),
        n_nodes: tree.nodes.len() as u32,
        n_surfels: tree.surfels.len() as u32,
        n_links: links.n_pairs,
        n_visible_pairs,
        digest: input.digest,
        n_fractions: fractions.as_ref().map_or(0, |fractions| fractions.n_pairs),
    };
    let room = file.rewrite(&room, &summary.to_bytes())?;
    let rects = match config.profile {
        Profile::Oriented => Some(write_records(&mut file, &tree.rects)?),
        Profile::Patch | Profile::Paper => None,
    };
    let before = [
        (room, MapSummary::BYTES),
        (config_section, 0),
        (nodes, Node::BYTES),
        (surfels, Surfel::BYTES),
        (links.section, 0),
    ];
    let behind = [(frame, FrameRecord::BYTES), (crs, 0)];
    let sections: Vec<(Section, usize)> = before
        .into_iter()
        .chain(fractions.map(|fractions| (fractions.section, 0)))
        .chain([(index, LinkBlock::BYTES)])
        .chain(fraction_index.map(|index| (index, LinkBlock::BYTES)))
        .chain(behind)
        .chain(rects.map(|rects| (rects, Rect::BYTES)))
        .collect();
    sections.iter().try_for_each(|(section, _)| file.check(section))?;
    let table: Vec<Written> = sections
        .into_iter()
        .zip(names)
        .map(|((Section { offset_bytes, len_bytes, sums }, size), name)| Written {
            name,
            offset_bytes,
            len_bytes,
            record_bytes: size as u32,
            sums,
        })
        .collect();
    let closing = close_map(&table);
    let output_bytes = closing.sums_offset_bytes + closing.sums.len() as u64;
    watch.check()?;
    let file = file.close(&closing.head, &closing.sums, closing.sums_offset_bytes)?;
    journal.finish(|| file.publish(true))?;
    Ok(WrittenMap { summary, output_bytes, link_bytes, temporary_bytes })
}

/// Writes fixed records without holding all their bytes.
fn write_records<R: Record>(file: &mut SectionFile, records: &[R]) -> Result<Section, StoreError> {
    let mut section = file.stream();
    for record in records {
        section.append(&record.to_bytes())?;
    }
    section.finish()
}

/// The sections of links and of visible fractions, and what was learned while they were written.
struct WrittenLinks {
    links: WrittenPairs,
    /// Where the map has fractions.
    fractions: Option<WrittenPairs>,
    n_visible_pairs: u128,
    temporary_bytes: u64,
}

/// A section of pairs, and its index.
struct WrittenPairs {
    section: Section,
    index: Vec<LinkBlock>,
    n_pairs: u64,
}

fn write_links(
    file: &mut SectionFile,
    config: &MapConfig,
    tree: &Tree,
    mut runs: Runs,
    watch: &dyn Watch,
) -> Result<WrittenLinks, VisibilityError> {
    let n_to_narrow = runs.n_pairs_to_narrow();
    if n_to_narrow > 0 {
        watch.stage("merge", Some(n_to_narrow), "links");
        runs.narrow(|n| {
            watch.advance(n);
            Ok::<_, VisibilityError>(watch.check()?)
        })?;
    }
    let temporary_bytes = runs.spilled_bytes();
    watch.stage("links", Some(runs.n_pairs()), "links");
    let mut n_visible_pairs = 0u128;
    let n_leaves = |id: u32| {
        let node = &tree.nodes[id as usize];
        u128::from(node.end_surfel - node.first_surfel)
    };
    let mut writer = PairWriter::new(file.stream(), watch)?;
    let mut links = None;
    runs.merge(|pair| match fractions::unmarked(pair) {
        None => {
            n_visible_pairs += n_leaves(pair.0) * n_leaves(pair.1);
            writer.push(pair)
        }
        Some(fraction) => {
            // These come behind all links.
            if links.is_none() {
                links = Some(writer.start_next()?);
            }
            writer.push(fraction.to_pair())
        }
    })?;
    if links.is_none() && config.has_fractions() {
        links = Some(writer.start_next()?);
    }
    let last = writer.start_next()?;
    let (links, fractions) = match links {
        Some(links) => (links, Some(last)),
        None => (last, None),
    };
    Ok(WrittenLinks { links, fractions, n_visible_pairs, temporary_bytes })
}

/// Writes sections of pairs, one behind the other.
struct PairWriter<'f, 'w> {
    section: SectionWriter<'f>,
    encoder: LinkEncoder,
    index: Vec<LinkBlock>,
    n_pairs: u64,
    watch: &'w dyn Watch,
}

impl<'f, 'w> PairWriter<'f, 'w> {
    fn new(
        section: SectionWriter<'f>,
        watch: &'w dyn Watch,
    ) -> Result<PairWriter<'f, 'w>, VisibilityError> {
        let encoder = LinkEncoder::new().map_err(VisibilityError::Compress)?;
        Ok(PairWriter { section, encoder, index: Vec::new(), n_pairs: 0, watch })
    }

    fn push(&mut self, pair: Pair) -> Result<(), VisibilityError> {
        self.n_pairs += 1;
        let frame = self.encoder.push(pair).map_err(VisibilityError::Compress)?;
        self.put(frame)
    }

    /// Ends the section and starts the next.
    fn start_next(&mut self) -> Result<WrittenPairs, VisibilityError> {
        let encoder = LinkEncoder::new().map_err(VisibilityError::Compress)?;
        let ended = std::mem::replace(&mut self.encoder, encoder);
        let frame = ended.finish().map_err(VisibilityError::Compress)?;
        self.put(frame)?;
        Ok(WrittenPairs {
            section: self.section.start_next()?,
            index: std::mem::take(&mut self.index),
            n_pairs: std::mem::take(&mut self.n_pairs),
        })
    }

    fn put(&mut self, frame: Option<(LinkBlock, Vec<u8>)>) -> Result<(), VisibilityError> {
        let Some((block, frame)) = frame else { return Ok(()) };
        self.watch.check()?;
        self.watch.advance(block.n_links.into());
        self.section.append(&frame)?;
        self.index.push(block);
        Ok(())
    }
}
