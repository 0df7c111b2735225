//! The stage as a whole: a tree in, a map file out.

use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_store::memory::require;
use pvmap_store::output::folder_of;
use pvmap_store::runs::{Pair, Runs};
use pvmap_store::sections::Section;
use pvmap_store::{SectionFile, StoreError, Watch};
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::frame::FrameRecord;
use pvmap_vmap::links::LinkEncoder;
use pvmap_vmap::map::{SECTIONS, close_map, config_text};
use pvmap_vmap::records::{LinkBlock, Record};
use pvmap_vmap::{MapSummary, Node, Shape, Surfel, Tree};
use rayon::prelude::*;

use crate::bounds;
use crate::candidates::{self, Family};
use crate::error::VisibilityError;
use crate::interaction::{self, checked_pairs, sibling_pairs};
use crate::kernel::Counts;
use crate::pairs::{Decider, Scene, Status};
use crate::sheets::Sheets;
use crate::tasks::{Plan, PlanLimits, n_leaf_pairs};

/// What decides the content of a map, and what does not.
#[derive(Debug, Clone)]
pub struct BuildOptions {
    /// Deepest level of a cell, 1…21.
    pub max_level: u8,
    /// Most points of a leaf above the deepest level; 0 makes a full tree.
    pub leaf_capacity: u64,
    /// Which tree.
    pub shape: Shape,
    /// How discs block.
    pub profile: Profile,
    /// Pairs to start from instead of all siblings. [V-5]
    pub interaction: Option<Vec<Pair>>,
    /// Most anonymous memory to hold, less 16 MiB and 2 MiB a thread. [D-9]
    pub memory_bytes: u64,
    /// The map to make.
    pub output: PathBuf,
}

/// What a map says of the scan it was made from.
#[derive(Debug, Clone, Copy)]
pub struct MapInput<'a> {
    /// Nodes and surfels, cut as the options say.
    pub tree: &'a Tree,
    /// From world units to the grid.
    pub frame: &'a FrameRecord,
    /// The bytes of the CRS.
    pub crs: &'a [u8],
    /// Digest of the octree.
    pub digest: u128,
}

/// What a build did.
#[derive(Debug, Clone, PartialEq)]
pub struct BuildReport {
    /// The counts of the map.
    pub summary: MapSummary,
    /// Bytes of the finished file.
    pub output_bytes: u64,
    /// Bytes of its link section.
    pub link_bytes: u64,
    /// Bytes written to temporary files.
    pub temporary_bytes: u64,
    /// Chunk tasks.
    pub n_tasks: u64,
    /// What the leaf kernel did.
    pub counts: Counts,
}

/// Decides all pairs and writes the map. Runs on the current rayon pool.
///
/// The bytes are those that [V-1]…[V-5] define, whatever the threads and the memory.
///
/// # Errors
/// Where the interaction list breaks a rule, the disk fails, the budget cannot hold the surfels
/// and the plan, or the run is asked to stop; `output` is then what it was before.
pub fn build(
    input: &MapInput<'_>,
    options: &BuildOptions,
    watch: &dyn Watch,
) -> Result<BuildReport, VisibilityError> {
    let tree = input.tree;
    // First of all, so that an output that cannot be made costs no work.
    let file = SectionFile::create(&options.output, head_bytes(SECTIONS.len()))?;
    let fixed = fixed_bytes(tree, options.interaction.as_deref());
    let least = rayon::current_num_threads() as u64 * LEAST_THREAD_BYTES;
    require("the surfels and nodes of this tree", fixed + least, options.memory_bytes)?;
    let starts = match &options.interaction {
        Some(given) => checked_pairs(tree, given)?,
        None => sibling_pairs(tree),
    };
    let profile = options.profile;
    let discs: Vec<Disc> =
        (0..tree.surfels.len() as u32).into_par_iter().map(|s| tree.disc(s, profile)).collect();
    let bounds = bounds::of_tree(tree, &discs, profile);
    let sheets = Sheets::new(tree, &discs, &bounds);
    let families = candidates::families(tree, &bounds, &sheets);
    let (discs, bounds, families, sheets) = (&discs, &bounds, &families, &sheets);
    let scene = Scene { tree, discs, bounds, families, sheets, profile };
    let shares = Shares::of(options.memory_bytes - fixed);
    let plan = Plan::new(&scene, &starts, &shares.plan)?;
    let links = LinkSink::new(options, &shares);
    let counts = decide(&scene, &starts, &plan, &links, watch)?;
    let interaction = options.interaction.as_ref().map(|_| starts.as_slice());
    write(file, input, options, interaction, links, watch).map(|report| BuildReport {
        n_tasks: plan.tasks.len() as u64,
        counts,
        ..report
    })
}

/// Decides all tasks and what stands above them.
fn decide(
    scene: &Scene<'_>,
    starts: &[Pair],
    plan: &Plan,
    links: &LinkSink,
    watch: &dyn Watch,
) -> Result<Counts, VisibilityError> {
    let pairs = |list: &[Pair]| list.iter().map(|&(a, b)| n_leaf_pairs(scene, a, b)).sum::<u64>();
    let total = pairs(starts);
    watch.stage("visibility", Some(total), "pairs");
    // What the plan settled by facing needs no task.
    watch.advance(total - pairs(&plan.tasks));
    let deciders: Mutex<Vec<(Decider<'_>, Vec<Pair>)>> = Mutex::default();
    let idle = || deciders.lock().unwrap_or_else(PoisonError::into_inner);
    let statuses: Vec<Status> = plan
        .tasks
        .par_iter()
        // Each task can be stolen: rayon's own pieces of a list last minutes where tasks do.
        .with_max_len(1)
        .map(|&(a, b)| {
            watch.check()?;
            let taken = idle().pop();
            let (mut decider, mut found) =
                taken.unwrap_or_else(|| (Decider::new(*scene), Vec::new()));
            let status = decider.decide(a, b, &mut found);
            links.put_when_full(&mut found)?;
            idle().push((decider, found));
            watch.advance(n_leaf_pairs(scene, a, b));
            Ok(status)
        })
        .collect::<Result<_, StoreError>>()?;
    let mut counts = Counts::default();
    for (decider, mut found) in deciders.into_inner().unwrap_or_else(PoisonError::into_inner) {
        counts.add(&decider.counts());
        links.put(&mut found)?;
    }
    let mut above = Vec::new();
    plan.combine(&statuses, &mut above);
    links.put(&mut above)?;
    Ok(counts)
}

/// How the memory is shared that the tree leaves: a quarter is for the plan, half for the buffers
/// of links, an eighth for finished runs of them; the rest is for deciders, merging and writing.
#[derive(Debug, Clone, Copy)]
struct Shares {
    plan: PlanLimits,
    runs_bytes: u64,
}

/// What each thread needs at the least.
const LEAST_THREAD_BYTES: u64 = 1 << 20;

/// A link in a buffer is there twice while the buffer grows.
const BUFFER_COST_BYTES: u64 = 2 * size_of::<Pair>() as u64;

impl Shares {
    fn of(spare_bytes: u64) -> Shares {
        let n_threads = rayon::current_num_threads() as u64;
        let buffer_links = spare_bytes / 2 / n_threads / BUFFER_COST_BYTES;
        // Half of a buffer may be full before a task that fills the other half.
        let plan = PlanLimits { task_links: buffer_links / 2, memory_bytes: spare_bytes / 4 };
        Shares { plan, runs_bytes: spare_bytes / 8 }
    }
}

/// Where links go until they are written: sorted runs, in memory or on disk.
#[derive(Debug)]
struct LinkSink {
    runs: Mutex<Runs>,
    /// Links a thread keeps before it sorts them and puts them away.
    full_links: usize,
}

impl LinkSink {
    fn new(options: &BuildOptions, shares: &Shares) -> LinkSink {
        let runs = Runs::new(folder_of(&options.output), shares.runs_bytes);
        LinkSink { runs: Mutex::new(runs), full_links: shares.plan.task_links as usize }
    }

    fn put_when_full(&self, links: &mut Vec<Pair>) -> Result<(), StoreError> {
        if links.len() >= self.full_links { self.put(links) } else { Ok(()) }
    }

    fn put(&self, links: &mut Vec<Pair>) -> Result<(), StoreError> {
        links.sort_unstable();
        self.runs.lock().unwrap_or_else(PoisonError::into_inner).push(links)?;
        links.clear();
        Ok(())
    }
}

/// What a build holds besides its links and their plan.
fn fixed_bytes(tree: &Tree, given: Option<&[Pair]>) -> u64 {
    let a_node = size_of::<Node>() + size_of::<bounds::Bounds>();
    let n_inner = tree.nodes.len().saturating_sub(tree.surfels.len());
    let a_leaf = size_of::<Surfel>() + size_of::<Disc>() + size_of::<bounds::Bounds>();
    let starts = match given {
        Some(given) => given.len() * interaction::GIVEN_BYTES,
        None => interaction::n_sibling_pairs(tree) * size_of::<Pair>(),
    };
    let families = n_inner * size_of::<Family>();
    (tree.nodes.len() * a_node + families + tree.surfels.len() * a_leaf + starts) as u64
}

/// Writes the map from the tree and the spilled links.
fn write(
    mut file: SectionFile,
    input: &MapInput<'_>,
    options: &BuildOptions,
    interaction: Option<&[Pair]>,
    links: LinkSink,
    watch: &dyn Watch,
) -> Result<BuildReport, VisibilityError> {
    let tree = input.tree;
    // The summary is known last but stands first: its room is taken now.
    let room = file.whole(&[0; MapSummary::BYTES])?;
    let config = file.whole(config_of(options, interaction).as_bytes())?;
    let nodes = write_records(&mut file, &tree.nodes)?;
    let surfels = write_records(&mut file, &tree.surfels)?;
    let runs = links.runs.into_inner().unwrap_or_else(PoisonError::into_inner);
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
    let sections = [room, config, nodes, surfels, written.section, index, frame, crs];
    let sizes = [
        MapSummary::BYTES,
        0,
        Node::BYTES,
        Surfel::BYTES,
        0,
        LinkBlock::BYTES,
        FrameRecord::BYTES,
        0,
    ];
    let table: Vec<Written> = sections
        .into_iter()
        .zip(SECTIONS.into_iter().zip(sizes))
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
    file.finish(&closing.head, &closing.sums, closing.sums_offset_bytes)?;
    let (n_tasks, counts) = (0, Counts::default());
    Ok(BuildReport { summary, output_bytes, link_bytes, temporary_bytes, n_tasks, counts })
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

/// The canonical text of the keys that decide content. [F-14]
fn config_of(options: &BuildOptions, interaction: Option<&[Pair]>) -> String {
    let pairs = interaction.map(|pairs| {
        let rows: Vec<u8> =
            pairs.iter().flat_map(|&(a, b)| [a.to_le_bytes(), b.to_le_bytes()].concat()).collect();
        (pairs.len() as u32, xxhash_rust::xxh3::xxh3_128(&rows))
    });
    let BuildOptions { max_level, leaf_capacity, shape, profile, .. } = *options;
    config_text(max_level, leaf_capacity, shape, profile, pairs)
}
