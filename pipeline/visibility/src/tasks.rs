//! Chunk tasks: the pairs at which the recursion is cut into pieces of work. A task is a pure
//! function of the tree and the configuration; what is above the tasks is put together from their
//! statuses afterwards.
//!
//! A pair of a node with itself stands for all pairs of siblings under it, so that small subtrees
//! are a task each and the pairs to start from need no list.

use pvmap_store::StoreError;
use pvmap_store::memory::require;
use pvmap_store::runs::Pair;
use pvmap_vmap::Tree;

use crate::bounds::Facing;
use crate::layers::Layer;
use crate::pairs::{Scene, Status};

/// A task has at most one part in so many of all leaf pairs, so that the last task of the slowest
/// thread is short.
const TASKS: u64 = 4096;
/// A pair of at most so many leaf pairs is not cut further: the overhead of tasks would show.
const MIN_TASK_PAIRS: u64 = 4096;
/// A task has at most so many leaf pairs, unless it is tried by a sample: some 0.1 s, between two
/// looks at whether to stop.
const MAX_TASK_PAIRS: u64 = 1 << 20;

/// All siblings under a node are one task where they have at most so many leaf pairs: those of 16
/// leaves. Each for itself they would be two tasks for each leaf of the tree.
const MAX_SIBLINGS_PAIRS: u64 = 128;

/// Bytes for each planned pair: itself, a task, its place in the list of what is still to do, and
/// the statuses of both.
const PLANNED_BYTES: usize =
    size_of::<Planned>() + size_of::<Pair>() + size_of::<u32>() + 2 * size_of::<Status>();

/// A pair of the plan.
#[derive(Debug, Clone, Copy)]
struct Planned {
    pair: Pair,
    /// What decides it.
    by: By,
    /// One past the last of its descendants, which follow it in the plan.
    end: u32,
}

#[derive(Debug, Clone, Copy)]
enum By {
    /// It is the next task.
    Task,
    /// Its children.
    Children,
    /// Nobody faces anybody.
    Facing,
}

/// What a plan must keep to.
#[derive(Debug, Clone, Copy)]
pub struct PlanLimits {
    /// Most leaf pairs of a task: it finds a link for each at the most, and a visible fraction
    /// where these are asked for.
    pub task_links: u64,
    /// Memory for the plan and what comes of it.
    pub memory_bytes: u64,
}

/// All pairs above the tasks, parents before children, and the tasks.
#[derive(Debug)]
pub struct Plan {
    planned: Vec<Planned>,
    /// The node pairs to decide, in the order of the plan.
    pub tasks: Vec<Pair>,
}

impl Plan {
    /// Cuts the recursion from `starts` into tasks: the highest pairs that are small enough, of at
    /// most `target` leaf pairs.
    ///
    /// # Errors
    /// Where the plan needs more memory than it may take.
    pub fn new(
        scene: &Scene<'_>,
        starts: &[Pair],
        target: u64,
        memory_bytes: u64,
    ) -> Result<Plan, StoreError> {
        // Counted first, so that the plan has no spare room and is never there twice.
        let n_planned: usize = starts.iter().map(|&pair| count(scene, pair, target)).sum();
        let need_bytes = (n_planned * PLANNED_BYTES) as u64;
        // Places in a plan are u32.
        let have_bytes = memory_bytes.min(u64::from(u32::MAX) * PLANNED_BYTES as u64);
        require("the plan of a build", need_bytes, have_bytes)?;
        let (planned, tasks) = (Vec::with_capacity(n_planned), Vec::with_capacity(n_planned));
        let mut plan = Plan { planned, tasks };
        starts.iter().for_each(|&pair| plan.cut(scene, pair, target));
        Ok(plan)
    }

    /// Plans a pair; recurses at most 24 deep.
    fn cut(&mut self, scene: &Scene<'_>, pair: Pair, target: u64) {
        let at = self.planned.len();
        let by = decided_by(scene, pair, target);
        self.planned.push(Planned { pair, by, end: at as u32 + 1 });
        match by {
            By::Facing => {}
            By::Task => self.tasks.push(pair),
            By::Children => {
                child_pairs(scene, pair).for_each(|child| self.cut(scene, child, target));
                self.planned[at].end = self.planned.len() as u32;
            }
        }
    }

    /// Puts the statuses of the tasks together and lists the links above and of the tasks, in no
    /// order.
    ///
    /// # Panics
    /// Where a task has no status.
    pub fn combine(&self, task_statuses: &[Option<Status>]) -> impl Iterator<Item = Pair> + '_ {
        let mut statuses = vec![Status::Invisible; self.planned.len()];
        let mut task_statuses = task_statuses.iter().rev();
        for (at, planned) in self.planned.iter().enumerate().rev() {
            statuses[at] = match planned.by {
                By::Facing => Status::Invisible,
                By::Task => {
                    let next = task_statuses.next().copied().flatten();
                    next.expect("a status for each task: all of them are done")
                }
                By::Children => self.status_of(at, &statuses),
            };
        }
        let mut at = 0;
        std::iter::from_fn(move || {
            loop {
                let planned = self.planned.get(at)?;
                if statuses[at] == Status::Visible {
                    // Nothing below a link is one.
                    at = planned.end as usize;
                    let (a, b) = planned.pair;
                    return Some((a.min(b), a.max(b)));
                }
                at += 1;
            }
        })
    }

    /// Gives the status of a pair from those of its child pairs; siblings under a node are no pair
    /// and have none.
    fn status_of(&self, at: usize, statuses: &[Status]) -> Status {
        let Planned { pair: (a, b), end, .. } = self.planned[at];
        let next = move |at: usize| Some(at).filter(|&at| at < end as usize);
        let children =
            std::iter::successors(next(at + 1), |&at| next(self.planned[at].end as usize));
        let mut n_of = [0usize; 3];
        children.for_each(|child| n_of[statuses[child] as usize] += 1);
        let [n_visible, n_invisible, n_partial] = n_of;
        if a == b || n_visible + n_partial == 0 {
            Status::Invisible
        } else if n_invisible + n_partial == 0 {
            Status::Visible
        } else {
            Status::Partial
        }
    }
}

/// Gives how many leaf pairs a task has at most where there are so many.
pub fn target_of(n_leaf_pairs: u64, limits: &PlanLimits) -> u64 {
    let most = MAX_TASK_PAIRS.min(limits.task_links).max(1);
    (n_leaf_pairs / TASKS).max(MIN_TASK_PAIRS).min(most)
}

/// The plans of a build, one for each of its layers ([`crate::layers`]), and their tasks, numbered
/// through.
#[derive(Debug)]
pub struct Plans {
    plans: Vec<Plan>,
    /// One past the last task of each plan.
    ends: Vec<u32>,
}

impl Plans {
    /// Plans the pairs of each layer, see [`Plan::new`].
    ///
    /// # Errors
    /// Where the plans need more memory than they may take, or more tasks than have a number.
    pub fn new(
        scenes: &[Scene<'_>],
        layers: &[Layer<'_>],
        target: u64,
        limits: &PlanLimits,
    ) -> Result<Plans, StoreError> {
        // Tasks have u32 numbers, through all plans; a plan has as many pairs or more.
        Plans::of_at_most(u32::MAX, scenes, layers, target, limits)
    }

    /// Plans at most so many pairs in all.
    pub(crate) fn of_at_most(
        n_planned: u32,
        scenes: &[Scene<'_>],
        layers: &[Layer<'_>],
        target: u64,
        limits: &PlanLimits,
    ) -> Result<Plans, StoreError> {
        let mut plans = Plans { plans: Vec::new(), ends: Vec::new() };
        let mut left_bytes = limits.memory_bytes.min(u64::from(n_planned) * PLANNED_BYTES as u64);
        for (scene, layer) in scenes.iter().zip(layers) {
            let plan = Plan::new(scene, &layer.starts, target, left_bytes)?;
            left_bytes -= (plan.planned.len() * PLANNED_BYTES) as u64;
            plans.ends.push((plans.n_tasks() + plan.tasks.len()) as u32);
            plans.plans.push(plan);
        }
        Ok(plans)
    }

    /// Counts the tasks.
    pub fn n_tasks(&self) -> usize {
        self.ends.last().map_or(0, |&end| end as usize)
    }

    /// Gives a task: its layer, and the pair to decide there.
    pub fn task(&self, task: u32) -> (usize, Pair) {
        let layer = self.ends.partition_point(|&end| end <= task);
        let first = layer.checked_sub(1).map_or(0, |before| self.ends[before]);
        (layer, self.plans[layer].tasks[(task - first) as usize])
    }

    /// Gives a digest of the tasks, by which a resumed build knows that they are the same.
    pub fn digest(&self) -> u64 {
        let mut hasher = xxhash_rust::xxh3::Xxh3::new();
        for &(a, b) in self.plans.iter().flat_map(|plan| &plan.tasks) {
            hasher.update(&a.to_le_bytes());
            hasher.update(&b.to_le_bytes());
        }
        hasher.digest()
    }

    /// Puts the statuses of the tasks together and lists the links above and of the tasks, in no
    /// order, as pairs of the whole tree.
    ///
    /// # Panics
    /// Where a task has no status.
    pub fn combine(
        &self,
        layers: &[Layer<'_>],
        statuses: &[Option<Status>],
    ) -> impl Iterator<Item = Pair> {
        let mut rest = statuses;
        self.plans.iter().zip(layers).flat_map(move |(plan, layer)| {
            let of_plan;
            (of_plan, rest) = rest.split_at(plan.tasks.len());
            plan.combine(of_plan).map(|pair| layer.whole(pair))
        })
    }
}

/// Says how a plan with tasks of at most `target` leaf pairs decides a pair.
fn decided_by(scene: &Scene<'_>, (a, b): Pair, target: u64) -> By {
    let most = if a == b { target.min(MAX_SIBLINGS_PAIRS) } else { target };
    if a != b && scene.facing(a, b) == Facing::Never {
        By::Facing
    } else if n_leaf_pairs(scene.tree, (a, b)) <= most || (a != b && scene.is_tried(a, b)) {
        By::Task
    } else {
        By::Children
    }
}

/// Counts what a pair takes in a plan; recurses at most 24 deep.
fn count(scene: &Scene<'_>, pair: Pair, target: u64) -> usize {
    match decided_by(scene, pair, target) {
        By::Facing | By::Task => 1,
        By::Children => {
            1 + child_pairs(scene, pair).map(|child| count(scene, child, target)).sum::<usize>()
        }
    }
}

/// Lists kids(A)×kids(B), [V-4]; of siblings under a node the children's pairs and what is under
/// the children.
fn child_pairs<'a>(scene: &Scene<'a>, (a, b): Pair) -> impl Iterator<Item = Pair> + use<'a> {
    let tree = scene.tree;
    let all = tree.kids(a).flat_map(move |x| tree.kids(b).map(move |y| (x, y)));
    let is_inner = move |id: u32| !tree.nodes[id as usize].is_leaf();
    all.filter(move |&(x, y)| a != b || x < y || (x == y && is_inner(x)))
}

/// Counts the leaf pairs under a node pair, or of a node with itself those of siblings under it.
pub fn n_leaf_pairs(tree: &Tree, (a, b): Pair) -> u64 {
    let n = |id: u32| {
        let node = &tree.nodes[id as usize];
        u64::from(node.end_surfel - node.first_surfel)
    };
    if a == b { n(a) * n(a).saturating_sub(1) / 2 } else { n(a) * n(b) }
}
