//! The map file of a build: written from the tree and the sorted links once all are decided.

use pvmap_geometry::Rect;
use pvmap_geometry::disc::Profile;
use pvmap_store::runs::Runs;
use pvmap_store::sections::Section;
use pvmap_store::{SectionFile, StoreError, Watch};
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::frame::FrameRecord;
use pvmap_vmap::links::LinkEncoder;
use pvmap_vmap::map::{RECTS_SECTION, SECTIONS, close_map};
use pvmap_vmap::records::{LinkBlock, Record};
use pvmap_vmap::{MapSummary, Node, Surfel, Tree};

use crate::build::MapInput;
use crate::error::VisibilityError;
use crate::journal::{self, Journal};

/// What a map has at the least: how many links there will be nobody knows before (F21).
pub(crate) fn least_output_bytes(input: &MapInput<'_>, profile: Profile) -> u64 {
    let Tree { nodes, surfels, rects } = input.tree;
    let records = nodes.len() * Node::BYTES + surfels.len() * Surfel::BYTES;
    head_bytes(n_sections(profile)) + (records + rects.len() * Rect::BYTES) as u64
}

/// Counts the sections: with rectangles there is one more, even where no surfel has one. [F-22]
fn n_sections(profile: Profile) -> usize {
    SECTIONS.len() + usize::from(profile == Profile::Oriented)
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
    (config, profile): (&str, Profile),
    runs: Runs,
    journal: Journal,
    watch: &dyn Watch,
) -> Result<WrittenMap, VisibilityError> {
    let tree = input.tree;
    let head_bytes = head_bytes(n_sections(profile));
    let mut file = SectionFile::create_in(journal.work(), journal::MAP, head_bytes)?;
    // The summary is known last but stands first: its room is taken now.
    let room = file.whole(&[0; MapSummary::BYTES])?;
    let config = file.whole(config.as_bytes())?;
    let nodes = write_records(&mut file, &tree.nodes)?;
    let surfels = write_records(&mut file, &tree.surfels)?;
    let written = write_links(&mut file, tree, runs, watch)?;
    let index = write_records(&mut file, &written.index)?;
    let frame = file.whole(&input.frame.to_bytes())?;
    let crs = file.whole(input.crs)?;
    let summary = MapSummary {
        n_points: tree.nodes.first().map_or(0, |root| root.n_points),
        n_nodes: tree.nodes.len() as u32,
        n_surfels: tree.surfels.len() as u32,
        n_links: written.n_links,
        n_visible_pairs: written.n_visible_pairs,
        digest: input.digest,
    };
    let room = file.rewrite(&room, &summary.to_bytes())?;
    let (link_bytes, temporary_bytes) = (written.section.len_bytes, written.temporary_bytes);
    let rects = match profile {
        Profile::Oriented => Some(write_records(&mut file, &tree.rects)?),
        Profile::Patch | Profile::Paper => None,
    };
    let sections = [room, config, nodes, surfels, written.section, index, frame, crs];
    let sections: Vec<Section> = sections.into_iter().chain(rects).collect();
    let sizes = [
        MapSummary::BYTES,
        0,
        Node::BYTES,
        Surfel::BYTES,
        0,
        LinkBlock::BYTES,
        FrameRecord::BYTES,
        0,
        Rect::BYTES,
    ];
    let names = SECTIONS.into_iter().chain([RECTS_SECTION]);
    sections.iter().try_for_each(|section| file.check(section))?;
    let table: Vec<Written> = sections
        .into_iter()
        .zip(names.zip(sizes))
        .map(|(Section { offset_bytes, len_bytes, sums }, (name, size))| Written {
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

/// The link section and what was learned while it was written.
struct WrittenLinks {
    section: Section,
    index: Vec<LinkBlock>,
    n_links: u64,
    n_visible_pairs: u128,
    temporary_bytes: u64,
}

fn write_links(
    file: &mut SectionFile,
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
    let mut section = file.stream();
    let mut encoder = LinkEncoder::new().map_err(VisibilityError::Compress)?;
    let mut index: Vec<LinkBlock> = Vec::new();
    let (mut n_links, mut n_visible_pairs) = (0, 0u128);
    let n_leaves = |id: u32| {
        let node = &tree.nodes[id as usize];
        u128::from(node.end_surfel - node.first_surfel)
    };
    runs.merge(|(a, b)| {
        n_links += 1;
        n_visible_pairs += n_leaves(a) * n_leaves(b);
        if let Some((block, frame)) = encoder.push((a, b)).map_err(VisibilityError::Compress)? {
            watch.check()?;
            watch.advance(block.n_links.into());
            section.append(&frame)?;
            index.push(block);
        }
        Ok::<_, VisibilityError>(())
    })?;
    if let Some((block, frame)) = encoder.finish().map_err(VisibilityError::Compress)? {
        watch.advance(block.n_links.into());
        section.append(&frame)?;
        index.push(block);
    }
    let section = section.finish()?;
    Ok(WrittenLinks { section, index, n_links, n_visible_pairs, temporary_bytes })
}
