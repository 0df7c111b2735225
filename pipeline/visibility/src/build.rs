//! The stage as a whole: a tree in, a map file out.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use pvmap_geometry::disc::{Disc, Profile};
use pvmap_geometry::{Box3, Rect};
use pvmap_store::memory::require_disk;
use pvmap_store::runs::{Pair, Runs};
use pvmap_store::{StoreError, Table, Watch, WorkFolder};
use pvmap_vmap::fraction::MAX_NODES;
use pvmap_vmap::frame::FrameRecord;
use pvmap_vmap::{MapConfig, MapSummary, Shape, Spacing, Tree};
use rayon::prelude::*;

use crate::bounds::{self, Bounds};
use crate::candidates::{self, Family};
use crate::error::VisibilityError;
use crate::exchange::Exchange;
use crate::fractions::{MARK, Tries};
use crate::interaction::{GIVEN_BYTES, checked_pairs};
use crate::journal::{self, Begun, Journal, SavedPlan};
use crate::kernel::Counts;
use crate::layers::{Approximation, Layer, layers};
use crate::pairs::{Decider, Scene};
use crate::shares::{MAX_LINKS_ABOVE, Shares};
use crate::sheets::Sheets;
use crate::sink::{Found, Sink, Taken};
use crate::tasks::{Plans, n_leaf_pairs, target_of};
use crate::write::{WrittenMap, least_output_bytes, write};

/// What decides the content of a map, and what does not.
#[derive(Debug, Clone)]
pub struct BuildOptions {
    /// Deepest level of a cell, 1…21.
    pub max_level: u8,
    /// Most points of a leaf above the deepest level; 0 makes a full tree.
    pub leaf_capacity: u64,
    /// How many times the area that its points cover a leaf may stretch over; 0 asks for nothing.
    pub max_spread: u16,
    /// Which tree.
    pub shape: Shape,
    /// How discs block.
    pub profile: Profile,
    /// Where the half spacings come from.
    pub spacing: Spacing,
    /// Pairs to start from instead of all siblings. [V-5]
    pub interaction: Option<Vec<Pair>>,
    /// What may be left out or seen coarsely. [D-6]
    pub approximation: Approximation,
    /// Whether leaf pairs half in shadow get visible fractions. [F-24]
    pub fractions: bool,
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
    let given = options.interaction.as_deref();
    let given_bytes = given.map_or(0, |given| given.len() * GIVEN_BYTES) as u64;
    let mut shares = Shares::new(&[tree], given_bytes, options.memory_bytes)?;
    let starts = match given {
        Some(given) => checked_pairs(tree, given)?,
        // The root with itself: all siblings under it.
        None => tree.nodes.first().map(|_| (0, 0)).into_iter().collect(),
    };
    let config = config_of(options, options.interaction.as_ref().map(|_| starts.as_slice()));
    let (approximation, memory_bytes) = (&options.approximation, options.memory_bytes);
    let most = if config.has_fractions() { MAX_NODES } else { MARK };
    if tree.nodes.len() > most as usize {
        return Err(VisibilityError::ManyNodes { n_nodes: tree.nodes.len() as u64, most });
    }
    let mut saved = plan_of(input, &config);
    let layers = if approximation.is_layered() {
        layers(tree, &starts, approximation, options.spacing, memory_bytes, watch)?
    } else {
        vec![Layer::all(tree, starts)]
    };
    if approximation.is_layered() || config.has_fractions() {
        let trees: Vec<&Tree> = layers.iter().map(|layer| &*layer.tree).collect();
        let lists_bytes = layers.iter().map(Layer::lists_bytes).sum::<u64>();
        let outlines_bytes = match approximation.min_exchange > 0.0 {
            true => trees.iter().map(|tree| Exchange::bytes(tree)).sum::<u64>(),
            false => 0,
        };
        let held_bytes = given_bytes + lists_bytes + outlines_bytes;
        shares = Shares::new(&trees, held_bytes, memory_bytes)?;
    }
    let full_links = shares.plan.task_links as usize;
    if options.fractions {
        // A task may find a link and a fraction for each of its leaf pairs.
        shares.plan.task_links /= 2;
    }
    if options.restart {
        work.clear(|_| true)?;
    }
    let begun = Begun::find(&mut work, &saved, watch)?;
    require_disk(work.path(), least_output_bytes(input, &config) + shares.mapped_bytes)?;
    let n_nodes: usize = layers.iter().map(|layer| layer.tree.nodes.len()).sum();
    watch.stage("prepare", Some(n_nodes as u64), "nodes");
    let folder = work.path().to_path_buf();
    let folder = Some(folder.as_path()).filter(|_| shares.mapped_bytes > 0);
    let ground = |layer: &Layer<'_>| {
        let sheets_bytes = shares.sheets_bytes / layers.len() as u64;
        Ground::new(layer, options, sheets_bytes, folder, watch)
    };
    let grounds: Vec<Ground> = layers.iter().map(ground).collect::<Result<_, _>>()?;
    let both = layers.iter().zip(&grounds);
    let scenes: Vec<Scene<'_>> = both.map(|(layer, ground)| ground.scene(layer, options)).collect();
    let n_pairs_of = |layer: &Layer<'_>| {
        layer.starts.iter().map(|&pair| n_leaf_pairs(&layer.tree, pair)).sum::<u64>()
    };
    let n_pairs = layers.iter().map(n_pairs_of).sum();
    saved.target = match &begun {
        Some(begun) => shares.require_tasks(begun.target())?,
        None => target_of(n_pairs, &shares.plan),
    };
    let plans = Plans::new(&scenes, &layers, saved.target, &shares.plan)?;
    let mut runs = Runs::new(work.path(), shares.runs_bytes);
    let mut statuses = vec![None; plans.n_tasks()];
    let done = |task: u32, status| statuses[task as usize] = Some(status);
    let journal = Journal::new(work, saved, &plans, begun, &mut runs, watch, done)?;
    let n_tasks_resumed = statuses.iter().flatten().count() as u64;
    let sink = Sink::new(runs, statuses, journal, full_links, options.checkpoint);
    let counts = decide(&scenes, &layers, n_pairs, &plans, &sink, watch)?;
    let Taken { mut runs, statuses, journal, .. } = sink.into_taken();
    let mut above = plans.combine(&layers, &statuses).peekable();
    while above.peek().is_some() {
        let mut links: Vec<Pair> = above.by_ref().take(MAX_LINKS_ABOVE).collect();
        links.sort_unstable();
        runs.push(&links)?;
    }
    drop(above);
    let n_tasks = plans.n_tasks() as u64;
    let stopped = journal.stopped(n_tasks);
    let written = write(input, &config, runs, journal, watch).map_err(|e| match e {
        VisibilityError::Store(StoreError::Interrupted) => stopped,
        e => e,
    })?;
    let WrittenMap { summary, output_bytes, link_bytes, temporary_bytes } = written;
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

/// What pairs are decided from besides the tree.
struct Ground {
    discs: Table<Disc>,
    bounds: Table<Bounds>,
    sheets: Sheets,
    families: Table<Family>,
    /// Where pairs of little exchange are tried by a sample.
    exchange: Option<Exchange>,
}

impl Ground {
    /// Makes it; its tables in files of `folder` where one is given.
    fn new(
        layer: &Layer<'_>,
        options: &BuildOptions,
        sheets_bytes: u64,
        folder: Option<&Path>,
        watch: &dyn Watch,
    ) -> Result<Ground, StoreError> {
        let (tree, profile) = (&*layer.tree, layer.profile(options.profile));
        let nothing = Disc {
            centroid: [0; 3],
            normal: [0; 3],
            two_sided: false,
            radius2: 0,
            limit: Box3::EMPTY,
            rect: Rect::NONE,
        };
        let mut discs = Table::new(tree.surfels.len(), nothing, folder)?;
        let all = discs.par_iter_mut().enumerate();
        all.for_each(|(id, disc)| *disc = tree.disc(id as u32, profile));
        let bounds = bounds::of_tree(tree, &discs, profile, options.fractions, folder)?;
        let sheets = Sheets::new(tree, &discs, &bounds, sheets_bytes, watch)?;
        let families = candidates::families(tree, &bounds, &sheets, folder)?;
        let least = options.approximation.min_exchange;
        let exchange = (least > 0.0).then(|| Exchange::new(tree, options.spacing, least));
        watch.advance(tree.nodes.len() as u64);
        Ok(Ground { discs, bounds, sheets, families, exchange })
    }

    fn scene<'a>(&'a self, layer: &'a Layer<'_>, options: &BuildOptions) -> Scene<'a> {
        let Ground { discs, bounds, sheets, families, exchange } = self;
        let (tree, profile) = (&*layer.tree, layer.profile(options.profile));
        let tries = Tries { fractions: options.fractions, exchange: exchange.as_ref() };
        Scene { tree, discs, bounds, families, sheets, profile, tries }
    }
}

/// Decides all tasks that are not done.
fn decide(
    scenes: &[Scene<'_>],
    layers: &[Layer<'_>],
    n_pairs: u64,
    plans: &Plans,
    sink: &Sink,
    watch: &dyn Watch,
) -> Result<Counts, VisibilityError> {
    let n_tasks = plans.n_tasks() as u64;
    let (open, n_links_before) = {
        let taken = sink.lock();
        let is_open = |&i: &u32| taken.statuses[i as usize].is_none();
        let mut open = Vec::with_capacity(plans.n_tasks());
        open.extend((0..n_tasks as u32).filter(is_open));
        (open, taken.runs.n_pairs())
    };
    let n_resumed = n_tasks - open.len() as u64;
    if n_resumed > 0 {
        watch.note(&format!("resuming: {n_resumed} of {n_tasks} tasks are done"));
    }
    let n_pairs_of = |task: u32| {
        let (layer, pair) = plans.task(task);
        n_leaf_pairs(scenes[layer].tree, pair)
    };
    watch.stage("visibility", Some(n_pairs), "pairs");
    // What the plan settled by facing needs no task, and what is done needs none any more.
    watch.advance(n_pairs - open.iter().map(|&task| n_pairs_of(task)).sum::<u64>());
    watch.tasks(n_resumed, n_tasks, n_links_before);
    let (n_done, n_links) = (AtomicU64::new(n_resumed), AtomicU64::new(n_links_before));
    let new_worker = || Worker {
        deciders: scenes.iter().map(|&scene| Decider::new(scene)).collect(),
        found: sink.new_buffer(),
    };
    let workers: Vec<Mutex<Worker<'_>>> =
        (0..rayon::current_num_threads()).map(|_| Mutex::new(new_worker())).collect();
    // Each task can be stolen: rayon's own pieces of a list last minutes where tasks do.
    let outcome = open.par_iter().with_max_len(1).try_for_each(|&task| {
        watch.check()?;
        // Outside a pool one thread does it all. No two threads have the same worker, so nobody
        // waits for it.
        let thread = rayon::current_thread_index().unwrap_or(0);
        let mut worker = workers[thread].lock().unwrap_or_else(PoisonError::into_inner);
        let Worker { deciders, found } = &mut *worker;
        let n_before = found.links.len();
        let (layer, (a, b)) = plans.task(task);
        let decider = &mut deciders[layer];
        // Caught here, so that the others stop and what is done is kept (F12).
        let decided = catch_unwind(AssertUnwindSafe(|| {
            let status = decider.decide(a, b, &mut found.links);
            layers[layer].make_whole(&mut found.links[n_before..]);
            let n_new = (found.links.len() - n_before) as u64;
            let n_links = n_links.fetch_add(n_new, Ordering::Relaxed) + n_new;
            watch.advance(n_pairs_of(task));
            watch.tasks(n_done.fetch_add(1, Ordering::Relaxed) + 1, n_tasks, n_links);
            status
        }));
        match decided {
            Ok(status) => {
                found.tasks.push((task, status));
                Ok(sink.take_when_due(found)?)
            }
            Err(panic) => {
                found.links.truncate(n_before);
                *decider = Decider::new(scenes[layer]);
                Err(VisibilityError::Panicked(message_of(panic.as_ref())))
            }
        }
    });
    let mut counts = Counts::default();
    let mut buffers = Vec::with_capacity(workers.len());
    for worker in workers {
        let Worker { deciders, found } =
            worker.into_inner().unwrap_or_else(PoisonError::into_inner);
        deciders.iter().for_each(|decider| counts.add(&decider.counts()));
        buffers.push(found);
    }
    settle(outcome, buffers, sink)?;
    Ok(counts)
}

/// What a thread of the pool decides with, and what it found; no two share a line of a cache.
#[repr(align(128))]
struct Worker<'a> {
    deciders: Vec<Decider<'a>>,
    found: Found,
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
        // Where memory is plenty they are long, and sorting them takes its time.
        buffers.par_iter_mut().for_each(|found| found.links.sort_unstable());
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
            let taken = sink.lock();
            Err(taken.journal.stopped(taken.statuses.iter().flatten().count() as u64))
        }
        outcome => outcome,
    }
}

fn message_of(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    text.unwrap_or("a task panicked").to_owned()
}

/// Says what a build is, by which a later one knows whether to go on with it.
fn plan_of(input: &MapInput<'_>, config: &MapConfig) -> SavedPlan {
    SavedPlan {
        tool: env!("CARGO_PKG_VERSION").to_owned(),
        digest: input.digest,
        config: config.to_text(),
        n_nodes: input.tree.nodes.len() as u64,
        n_surfels: input.tree.surfels.len() as u64,
        target: 0,
        n_tasks: 0,
        tasks_digest: 0,
    }
}

/// The keys that decide content. [F-14]
fn config_of(options: &BuildOptions, interaction: Option<&[Pair]>) -> MapConfig {
    let interaction_pairs = interaction.map(|pairs| {
        let rows: Vec<u8> =
            pairs.iter().flat_map(|&(a, b)| [a.to_le_bytes(), b.to_le_bytes()].concat()).collect();
        (pairs.len() as u32, xxhash_rust::xxh3::xxh3_128(&rows))
    });
    let BuildOptions { max_level, leaf_capacity, max_spread, shape, profile, spacing, .. } =
        *options;
    let Approximation { opening_angle, min_form_factor, min_exchange } = options.approximation;
    MapConfig {
        max_level,
        leaf_capacity,
        max_spread,
        shape,
        profile,
        spacing,
        interaction_pairs,
        opening_angle,
        min_form_factor,
        min_exchange,
        fractions: options.fractions,
    }
}
