//! Chunk tasks: the pairs at which the recursion is cut into pieces of work. A task is a pure
//! function of the tree and the configuration; what is above the tasks is put together from their
//! statuses afterwards.

use pvmap_store::runs::Pair;

use crate::bounds::{self, Facing};
use crate::pairs::{Gathered, Scene, Status};

/// A plan has at most about so many tasks for each pair it starts from or for the whole: enough
/// that the last task of the slowest thread is short.
const TASKS: u64 = 4096;
/// A task decides at least so many leaf pairs; below that its overhead shows.
const MIN_TASK_PAIRS: u64 = 4096;

/// A pair of the plan.
#[derive(Debug, Clone)]
struct Planned {
    a: u32,
    b: u32,
    /// What decides it.
    by: By,
}

#[derive(Debug, Clone)]
enum By {
    /// It is a task.
    Task(usize),
    /// Its children, which stand in the plan at these places, all after it.
    Children(Vec<usize>),
    /// Nobody faces anybody.
    Facing,
}

/// All pairs above the tasks, parents before children, and the tasks.
#[derive(Debug)]
pub struct Plan {
    planned: Vec<Planned>,
    roots: Vec<usize>,
    /// The node pairs to decide.
    pub tasks: Vec<Pair>,
}

impl Plan {
    /// Cuts the recursion from `starts` into tasks of about equal numbers of leaf pairs.
    pub fn new(scene: &Scene<'_>, starts: &[Pair]) -> Plan {
        let total: u64 = starts.iter().map(|&(a, b)| n_leaf_pairs(scene, a, b)).sum();
        let target = (total / TASKS).max(MIN_TASK_PAIRS);
        let mut plan = Plan { planned: Vec::new(), roots: Vec::new(), tasks: Vec::new() };
        for &(a, b) in starts {
            let root = plan.cut(scene, a, b, target);
            plan.roots.push(root);
        }
        plan
    }

    /// Plans a pair; recurses at most 24 deep.
    fn cut(&mut self, scene: &Scene<'_>, a: u32, b: u32, target: u64) -> usize {
        let at = self.planned.len();
        self.planned.push(Planned { a, b, by: By::Facing });
        let (bound_a, bound_b) = (&scene.bounds[a as usize], &scene.bounds[b as usize]);
        if bounds::facing(bound_a, bound_b) == Facing::Never {
            return at;
        }
        self.planned[at].by = if n_leaf_pairs(scene, a, b) <= target {
            self.tasks.push((a, b));
            By::Task(self.tasks.len() - 1)
        } else {
            let kids_b: Vec<u32> = scene.tree.kids(b).collect();
            let pairs = scene.tree.kids(a).flat_map(|x| kids_b.iter().map(move |&y| (x, y)));
            By::Children(pairs.map(|(x, y)| self.cut(scene, x, y, target)).collect())
        };
        at
    }

    /// Puts the statuses of the tasks together; links above the tasks go to `links`.
    pub fn combine(&self, task_statuses: &[Status], links: &mut Vec<Pair>) {
        let mut statuses = vec![Status::Invisible; self.planned.len()];
        for (at, planned) in self.planned.iter().enumerate().rev() {
            statuses[at] = match &planned.by {
                By::Facing => Status::Invisible,
                By::Task(task) => task_statuses[*task],
                By::Children(children) => {
                    let mut gathered = Gathered::new(links);
                    for &child in children {
                        let pair = &self.planned[child];
                        gathered.note(pair.a, pair.b, statuses[child], links);
                    }
                    gathered.settle(links)
                }
            };
        }
        for &root in &self.roots {
            let Planned { a, b, .. } = self.planned[root];
            if statuses[root] == Status::Visible {
                links.push((a.min(b), a.max(b)));
            }
        }
    }
}

/// Counts the leaf pairs under a node pair.
pub fn n_leaf_pairs(scene: &Scene<'_>, a: u32, b: u32) -> u64 {
    let n = |id: u32| {
        let node = &scene.tree.nodes[id as usize];
        u64::from(node.end_surfel - node.first_surfel)
    };
    n(a) * n(b)
}
