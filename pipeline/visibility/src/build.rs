//! The stage as a whole: a tree in, a map file out.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use pvmap_geometry::Box3;
use pvmap_geometry::disc::{Disc, Profile};
use pvmap_store::memory::{require, require_disk};
use pvmap_store::runs::{Pair, Runs};
use pvmap_store::sections::Section;
use pvmap_store::{SectionFile, StoreError, Table, Watch, WorkFolder};
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::frame::FrameRecord;
use pvmap_vmap::links::LinkEncoder;
use pvmap_vmap::map::{SECTIONS, close_map, config_text};
use pvmap_vmap::records::{LinkBlock, Record};
use pvmap_vmap::tree::disc_of;
use pvmap_vmap::{MapSummary, Node, Shape, Surfel, Tree};
use rayon::prelude::*;

use crate::bounds::{self, Bounds};
use crate::candidates::{self, Family};
use crate::error::VisibilityError;
use crate::interaction::{self, checked_pairs};
use crate::journal::{self, Begun, Journal, SavedPlan};
use crate::kernel::Counts;
use crate::pairs::{Decider, Scene};
use crate::sheets::Sheets;
use crate::sink::{Found, Kept, Sink};
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
    /// How long at most, about, finished tasks may wait for their commit.
    pub checkpoint: Duration,
    /// Discards what an earlier build left instead of going on with it.
    pub restart: bool,
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
    /// Those of them that an earlier run had done.
    pub n_tasks_resumed: u64,
    /// What the leaf kernel did.
    pub counts: Counts,
}

/// Makes and locks the folder in which a map is built.
///
/// # Errors
/// Where the map could not be made under this name, or another build is at it.
pub fn open_work(output: &Path) -> Result<WorkFolder, StoreError> {
    WorkFolder::open(output, journal::is_work_file)
}

/// Decides all pairs and writes the map. Runs on the current rayon pool.
///
/// The bytes are those that [V-1]…[V-5] define, whatever the threads and the memory, and however
/// often the build was killed and run again: what an earlier run committed to `work` is not decided
/// again. [D-8], [D-9]
///
/// # Errors
/// Where the interaction list breaks a rule, the disk fails, the budget cannot hold the surfels
/// and the plan, the run is asked to stop, or `work` holds another build; the output is then what
/// it was before.
pub fn build(
    input: &MapInput<'_>,
    options: &BuildOptions,
    mut work: WorkFolder,
    watch: &dyn Watch,
) -> Result<BuildReport, VisibilityError> {
    let tree = input.tree;
    let (given, memory_bytes) = (options.interaction.as_deref(), options.memory_bytes);
    let tables_bytes = tables_bytes(tree);
    let are_mapped = fixed_bytes(tree, given) + tables_bytes > memory_bytes / 2;
    let fixed = fixed_bytes(tree, given) + if are_mapped { 0 } else { tables_bytes };
    let least = rayon::current_num_threads() as u64 * LEAST_THREAD_BYTES;
    require("the surfels and nodes of this tree", fixed + least, memory_bytes)?;
    let starts = match &options.interaction {
        Some(given) => checked_pairs(tree, given)?,
        // The root with itself: all siblings under it.
        None => tree.nodes.first().map(|_| (0, 0)).into_iter().collect(),
    };
    let config = config_of(options, options.interaction.as_ref().map(|_| starts.as_slice()));
    let mut saved = plan_of(input, &config);
    if options.restart {
        work.clear(|_| true)?;
    }
    let begun = Begun::find(&mut work, &saved, watch)?;
    let files_bytes = if are_mapped { tables_bytes } else { 0 };
    require_disk(work.path(), least_output_bytes(input) + files_bytes)?;
    let shares = Shares::of(memory_bytes - fixed);
    let folder = work.path().to_path_buf();
    let folder = Some(folder.as_path()).filter(|_| are_mapped);
    let ground = Ground::new(tree, options.profile, shares.sheets_bytes, folder)?;
    let scene = ground.scene(tree, options.profile);
    let plan = match &begun {
        Some(begun) => {
            let target = shares.require_tasks(begun.target())?;
            Plan::with_target(&scene, &starts, target, &shares.plan)?
        }
        None => Plan::new(&scene, &starts, &shares.plan)?,
    };
    saved.target = plan.target;
    let mut runs = Runs::new(work.path(), shares.runs_bytes);
    let mut statuses = vec![None; plan.tasks.len()];
    let done = |task: u32, status| statuses[task as usize] = Some(status);
    let journal = Journal::new(work, saved, &plan, begun, &mut runs, watch, done)?;
    let n_tasks_resumed = statuses.iter().flatten().count() as u64;
    let full_links = shares.plan.task_links as usize;
    let sink = Sink::new(runs, statuses, journal, full_links, options.checkpoint);
    let counts = decide(&scene, &starts, &plan, &sink, watch)?;
    let mut kept = sink.into_kept();
    let mut above = plan.combine(&kept.statuses).peekable();
    while above.peek().is_some() {
        let mut links: Vec<Pair> = above.by_ref().take(MAX_LINKS_ABOVE).collect();
        links.sort_unstable();
        kept.runs.push(&links)?;
    }
    drop(above);
    let stopped = kept.journal.stopped(plan.tasks.len() as u64);
    let report = write(input, &config, kept, watch).map_err(|e| match e {
        VisibilityError::Store(StoreError::Interrupted) => stopped,
        e => e,
    })?;
    Ok(BuildReport { n_tasks: plan.tasks.len() as u64, n_tasks_resumed, counts, ..report })
}

/// What pairs are decided from besides the tree.
struct Ground {
    discs: Table<Disc>,
    bounds: Table<Bounds>,
    sheets: Sheets,
    families: Table<Family>,
}

impl Ground {
    /// Makes it; its tables in files of `folder` where one is given.
    fn new(
        tree: &Tree,
        profile: Profile,
        sheets_bytes: u64,
        folder: Option<&Path>,
    ) -> Result<Ground, StoreError> {
        let nothing = Disc {
            centroid: [0; 3],
            normal: [0; 3],
            two_sided: false,
            radius2: 0,
            limit: Box3::EMPTY,
        };
        let mut discs = Table::new(tree.surfels.len(), nothing, folder)?;
        let all = discs.par_iter_mut().zip(&tree.surfels);
        all.for_each(|(disc, surfel)| *disc = disc_of(surfel, profile));
        let bounds = bounds::of_tree(tree, &discs, profile, folder)?;
        let sheets = Sheets::new(tree, &discs, &bounds, sheets_bytes);
        let families = candidates::families(tree, &bounds, &sheets, folder)?;
        Ok(Ground { discs, bounds, sheets, families })
    }

    fn scene<'a>(&'a self, tree: &'a Tree, profile: Profile) -> Scene<'a> {
        let Ground { discs, bounds, sheets, families } = self;
        Scene { tree, discs, bounds, families, sheets, profile }
    }
}

/// Decides all tasks that are not done.
fn decide(
    scene: &Scene<'_>,
    starts: &[Pair],
    plan: &Plan,
    sink: &Sink,
    watch: &dyn Watch,
) -> Result<Counts, VisibilityError> {
    let pairs_of = |list: &mut dyn Iterator<Item = &Pair>| {
        list.map(|&(a, b)| n_leaf_pairs(scene, a, b)).sum::<u64>()
    };
    let total = pairs_of(&mut starts.iter());
    let n_tasks = plan.tasks.len() as u64;
    let (open, n_links_before) = {
        let kept = sink.lock();
        let is_open = |&i: &u32| kept.statuses[i as usize].is_none();
        let mut open = Vec::with_capacity(plan.tasks.len());
        open.extend((0..plan.tasks.len() as u32).filter(is_open));
        (open, kept.runs.n_pairs())
    };
    let n_resumed = n_tasks - open.len() as u64;
    if n_resumed > 0 {
        watch.note(&format!("resuming: {n_resumed} of {n_tasks} tasks are done"));
    }
    watch.stage("visibility", Some(total), "pairs");
    // What the plan settled by facing needs no task, and what is done needs none any more.
    watch.advance(total - pairs_of(&mut open.iter().map(|&i| &plan.tasks[i as usize])));
    watch.tasks(n_resumed, n_tasks, n_links_before);
    let (n_done, n_links) = (AtomicU64::new(n_resumed), AtomicU64::new(n_links_before));
    let deciders: Mutex<Vec<Decider<'_>>> = Mutex::default();
    let buffers: Mutex<Vec<Found>> = Mutex::default();
    // Each task can be stolen: rayon's own pieces of a list last minutes where tasks do.
    let outcome = open.par_iter().with_max_len(1).try_for_each(|&task| {
        watch.check()?;
        let spare = locked(&buffers).pop();
        let mut found = spare.unwrap_or_else(|| sink.new_buffer());
        let n_before = found.links.len();
        // Caught here, so that the others stop and what is done is kept (F12).
        let decided = catch_unwind(AssertUnwindSafe(|| {
            let mut decider = locked(&deciders).pop().unwrap_or_else(|| Decider::new(*scene));
            let (a, b) = plan.tasks[task as usize];
            let status = decider.decide(a, b, &mut found.links);
            locked(&deciders).push(decider);
            let n_new = (found.links.len() - n_before) as u64;
            let n_links = n_links.fetch_add(n_new, Ordering::Relaxed) + n_new;
            watch.advance(n_leaf_pairs(scene, a, b));
            watch.tasks(n_done.fetch_add(1, Ordering::Relaxed) + 1, n_tasks, n_links);
            status
        }));
        let taken = match decided {
            Ok(status) => {
                found.tasks.push((task, status));
                sink.take_when_due(&mut found).map_err(VisibilityError::from)
            }
            Err(panic) => {
                found.links.truncate(n_before);
                Err(VisibilityError::Panicked(message_of(panic.as_ref())))
            }
        };
        locked(&buffers).push(found);
        taken
    });
    let buffers = buffers.into_inner().unwrap_or_else(PoisonError::into_inner);
    settle(outcome, buffers, sink)?;
    let mut counts = Counts::default();
    let deciders = deciders.into_inner().unwrap_or_else(PoisonError::into_inner);
    deciders.iter().for_each(|decider| counts.add(&decider.counts()));
    Ok(counts)
}

/// Takes what is left in the buffers when the deciding is over, for whatever reason.
fn settle(
    outcome: Result<(), VisibilityError>,
    mut buffers: Vec<Found>,
    sink: &Sink,
) -> Result<(), VisibilityError> {
    if let Some(e) = sink.failure() {
        return Err(e.into());
    }
    let is_kept = match &outcome {
        Ok(()) => sink.lock().journal.is_begun(),
        // What failed was the disk.
        Err(VisibilityError::Store(e)) => matches!(e, StoreError::Interrupted),
        Err(_) => true,
    };
    let mut settled = Ok(());
    if outcome.is_ok() || is_kept {
        settled = buffers.iter_mut().try_for_each(|found| sink.take(found));
    }
    if is_kept {
        // A build that wrote anything keeps all of it: merging can be interrupted too.
        settled = settled.and_then(|()| sink.commit_all());
    }
    if let Some(e) = sink.failure() {
        return Err(e.into());
    }
    settled?;
    match outcome {
        Err(VisibilityError::Store(StoreError::Interrupted)) => {
            let kept = sink.lock();
            Err(kept.journal.stopped(kept.statuses.iter().flatten().count() as u64))
        }
        outcome => outcome,
    }
}

fn locked<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn message_of(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("a task panicked").to_owned()
}

/// Says what a build is, by which a later one knows whether to go on with it.
fn plan_of(input: &MapInput<'_>, config: &str) -> SavedPlan {
    SavedPlan {
        tool: env!("CARGO_PKG_VERSION").to_owned(),
        digest: input.digest,
        config: config.to_owned(),
        n_nodes: input.tree.nodes.len() as u64,
        n_surfels: input.tree.surfels.len() as u64,
        target: 0,
        n_tasks: 0,
        tasks_digest: 0,
    }
}

/// What a map has at the least: how many links there will be nobody knows before (F21).
fn least_output_bytes(input: &MapInput<'_>) -> u64 {
    let (nodes, surfels) = (input.tree.nodes.len(), input.tree.surfels.len());
    head_bytes(SECTIONS.len()) + (nodes * Node::BYTES + surfels * Surfel::BYTES) as u64
}

/// How the memory is shared that the tree leaves: a quarter is for the plan, three eighths for the
/// buffers of links, an eighth for finished runs of them, an eighth and what the buffers cannot use
/// for sheets; the rest is for deciders, merging and writing.
#[derive(Debug, Clone, Copy)]
struct Shares {
    plan: PlanLimits,
    runs_bytes: u64,
    sheets_bytes: u64,
}

/// Links above the tasks that are sorted at once: so many take 512 KiB.
const MAX_LINKS_ABOVE: usize = 1 << 16;

/// What each thread needs at the least.
const LEAST_THREAD_BYTES: u64 = 1 << 20;

/// A buffer gets all its room at once, which costs nothing until it is used.
const BUFFER_COST_BYTES: u64 = size_of::<Pair>() as u64;

/// More links than so many, 64 MiB, are not sorted at once.
const MAX_BUFFER_LINKS: u64 = 1 << 23;

impl Shares {
    fn of(spare_bytes: u64) -> Shares {
        let n_threads = rayon::current_num_threads() as u64;
        let have_links = spare_bytes / 8 * 3 / n_threads / BUFFER_COST_BYTES;
        let buffer_links = have_links.min(MAX_BUFFER_LINKS);
        let unused_bytes = (have_links - buffer_links) * n_threads * BUFFER_COST_BYTES;
        // Half of a buffer may be full before a task that fills the other half.
        let plan = PlanLimits { task_links: buffer_links / 2, memory_bytes: spare_bytes / 4 };
        Shares { plan, runs_bytes: spare_bytes / 8, sheets_bytes: spare_bytes / 8 + unused_bytes }
    }

    /// Makes sure that the buffers hold what tasks of at most so many leaf pairs may find.
    fn require_tasks(&self, target: u64) -> Result<u64, StoreError> {
        let need_links = 2 * target * rayon::current_num_threads() as u64;
        let have_links = self.plan.task_links.max(1) * 2 * rayon::current_num_threads() as u64;
        let bytes = |n_links: u64| 2 * BUFFER_COST_BYTES * n_links;
        require("the tasks of the build to go on with", bytes(need_links), bytes(have_links))?;
        Ok(target)
    }
}

/// What a build holds besides its tables, sheets, links and their plan.
fn fixed_bytes(tree: &Tree, given: Option<&[Pair]>) -> u64 {
    let n_inner = tree.nodes.len().saturating_sub(tree.surfels.len());
    let starts = given.map_or(0, |given| given.len() * interaction::GIVEN_BYTES);
    let of_surfels = tree.surfels.len() * size_of::<Surfel>();
    let of_nodes = tree.nodes.len() * size_of::<Node>() + n_inner * Sheets::A_FAMILY_BYTES;
    (of_nodes + of_surfels + starts) as u64
}

/// What the tables of a build take: more than half of its memory together with the above, and they
/// go to files.
fn tables_bytes(tree: &Tree) -> u64 {
    let n_inner = tree.nodes.len().saturating_sub(tree.surfels.len());
    // Families are found by a number for each node.
    let of_nodes = tree.nodes.len() * (size_of::<Bounds>() + size_of::<u32>());
    (of_nodes + n_inner * size_of::<Family>() + tree.surfels.len() * size_of::<Disc>()) as u64
}

/// Writes the map from the tree and the spilled links.
fn write(
    input: &MapInput<'_>,
    config: &str,
    kept: Kept,
    watch: &dyn Watch,
) -> Result<BuildReport, VisibilityError> {
    let tree = input.tree;
    let Kept { runs, journal, .. } = kept;
    let head_bytes = head_bytes(SECTIONS.len());
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
    sections.iter().try_for_each(|section| file.check(section))?;
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
    let file = file.close(&closing.head, &closing.sums, closing.sums_offset_bytes)?;
    journal.finish(|| file.publish(true))?;
    let (n_tasks, n_tasks_resumed, counts) = (0, 0, Counts::default());
    Ok(BuildReport {
        summary,
        output_bytes,
        link_bytes,
        temporary_bytes,
        n_tasks,
        n_tasks_resumed,
        counts,
    })
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
