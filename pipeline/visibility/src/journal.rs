//! What a build has done so far, on disk, for the run that takes it up.
//!
//! The work folder `OUT.build` is no artifact: its layout may change from one version to the next,
//! which then refuses it. It holds
//!
//! | name | what |
//! |---|---|
//! | `lock` | held by the build at work, by flock; its text says who that is |
//! | `plan` | `PVPLAN01`, a [`SavedPlan`] as bincode 2 writes it, XXH3-64 of both |
//! | `journal` | a [`Log`]: `PVJRNL01`, XXH3-64 of the file `plan`, [`Record`]s as bincode 2 |
//! | `links-N` | sorted runs of the links that the tasks of one record found ([`SavedRuns`]) |
//! | `map.part` | the map until it is whole |
//!
//! A *commit* writes the links of finished tasks to a file (`links-N.part`, fsync, rename, fsync of
//! the folder) and then one record that names the file and the tasks (fdatasync). So a record says
//! what is durably there, and a file without a record is nobody's: it is removed. Which tasks go
//! into which commit depends on threads, memory and time; the map does not, as each task finds the
//! same links whenever it is decided, and all links are merged in their order at the end.
//!
//! A build that ends before its first commit leaves nothing; most short ones never make any.

use std::path::PathBuf;

use bincode::{Decode, Encode};
use pvmap_store::runs::saved::SavedRuns;
use pvmap_store::runs::{Pair, Runs};
use pvmap_store::work::PART;
use pvmap_store::{Log, StoreError, Watch, WorkFolder};
use xxhash_rust::xxh3::xxh3_64;

use crate::error::VisibilityError;
use crate::pairs::Status;
use crate::tasks::Plans;

const PLAN: &str = "plan";
const JOURNAL: &str = "journal";
/// The map until it is whole.
pub const MAP: &str = "map.part";
const LINKS: &str = "links-";

const PLAN_START: &[u8; 8] = b"PVPLAN01";
const JOURNAL_START: &[u8; 8] = b"PVJRNL01";
/// No plan is longer: some numbers and the text of a configuration.
const MAX_PLAN_BYTES: u64 = 1 << 16;
/// What decoding may take, whatever lengths the bytes name.
const DECODE_BYTES: usize = 64 << 20;

/// Says whether a build gives this name to a file of its work folder.
pub fn is_work_file(name: &str) -> bool {
    let whole = name.strip_suffix(PART).unwrap_or(name);
    let of_links = whole.strip_prefix(LINKS).is_some_and(|n| n.parse::<u64>().is_ok());
    name == MAP || [PLAN, JOURNAL].contains(&whole) || of_links
}

/// What a build was begun with. Another build takes it up only if all of it is the same.
#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub struct SavedPlan {
    /// The program's version: another may cut tasks differently.
    pub tool: String,
    /// Digest of the octree.
    pub digest: u128,
    /// The canonical configuration, with a digest of the interaction list if there is one.
    pub config: String,
    /// Nodes of the tree.
    pub n_nodes: u64,
    /// Its surfels.
    pub n_surfels: u64,
    /// Leaf pairs a task may have: chosen once, by the memory there was then.
    pub target: u64,
    /// Tasks.
    pub n_tasks: u64,
    /// Digest of the tasks.
    pub tasks_digest: u64,
}

impl SavedPlan {
    /// Names the first field in which two builds differ, as it was and as it is.
    fn difference(&self, now: &SavedPlan) -> Option<(String, String, String)> {
        let of = |name: &str, before: String, now: String| {
            (before != now).then(|| (name.to_owned(), before, now))
        };
        let digests = (format!("{:032x}", self.digest), format!("{:032x}", now.digest));
        of("version of pvmap", self.tool.clone(), now.tool.clone())
            .or_else(|| difference_of_configs(&self.config, &now.config))
            .or_else(|| of("octree", digests.0, digests.1))
            .or_else(|| of("number of nodes", self.n_nodes.to_string(), now.n_nodes.to_string()))
            .or_else(|| {
                of("number of surfels", self.n_surfels.to_string(), now.n_surfels.to_string())
            })
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = [&PLAN_START[..], &encoded(self)].concat();
        bytes.extend(xxh3_64(&bytes).to_le_bytes());
        bytes
    }

    fn of_bytes(bytes: &[u8]) -> Option<SavedPlan> {
        let (rest, sum) = bytes.split_last_chunk::<8>()?;
        let is_whole = xxh3_64(rest) == u64::from_le_bytes(*sum);
        decoded(rest.strip_prefix(PLAN_START)?).filter(|_| is_whole)
    }
}

/// Says whether a plan was written by a version that writes them in another way.
fn is_of_other_format(bytes: &[u8]) -> bool {
    const NAME: &[u8] = b"PVPLAN";
    bytes.len() > PLAN_START.len() && bytes.starts_with(NAME) && !bytes.starts_with(&PLAN_START[..])
}

/// Names the first key in which two configurations differ.
fn difference_of_configs(before: &str, now: &str) -> Option<(String, String, String)> {
    let value = |text: &str, key: &str| {
        let line = text.lines().find(|l| l.split(" = ").next() == Some(key));
        line.map_or("none", |l| l.split_once(" = ").map_or("", |(_, v)| v)).to_owned()
    };
    let mut keys = [before, now].into_iter().flat_map(str::lines).filter_map(|line| {
        let key = line.split(" = ").next()?;
        (value(before, key) != value(now, key)).then_some(key)
    });
    keys.next().map(|key| (key.to_owned(), value(before, key), value(now, key)))
}

/// What the journal is made of.
#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub enum Record {
    /// Tasks that are done.
    Tasks(Commit),
    /// The map is whole and durable; it is given its name next.
    Assembled,
}

/// Tasks that are done, and the file with their links.
#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub struct Commit {
    /// None where they found none.
    pub file: Option<LinksFile>,
    /// Their places in the plan, and their statuses.
    pub tasks: Vec<(u32, u8)>,
}

/// A file of runs, as the journal remembers it.
#[derive(Debug, Clone, PartialEq, Eq, Encode, Decode)]
pub struct LinksFile {
    /// N of `links-N`.
    pub number: u64,
    /// Its length.
    pub n_bytes: u64,
    /// Its CRC-32.
    pub crc: u32,
    /// Bytes and pairs of each run.
    pub runs: Vec<(u64, u64)>,
}

/// A build that is under way: its work folder and what is written there.
#[derive(Debug)]
pub struct Journal {
    work: WorkFolder,
    plan: SavedPlan,
    /// None until the first commit.
    log: Option<Log>,
    /// The number of the next file of links.
    next_file: u64,
}

/// A build that was begun earlier.
#[derive(Debug)]
pub struct Begun {
    plan: SavedPlan,
    records: Vec<Record>,
    log: Log,
}

impl Begun {
    /// Looks for a build to take up; what is of no use is removed.
    ///
    /// # Errors
    /// Where there is one but it differs from `now` (whose tasks are not known yet), or the disk
    /// fails.
    pub fn find(
        work: &mut WorkFolder,
        now: &SavedPlan,
        watch: &dyn Watch,
    ) -> Result<Option<Begun>, VisibilityError> {
        let begun = Begun::read(work, watch)?;
        work.keep(begun.is_some());
        match &begun {
            None => work.clear(|_| true)?,
            Some(begun) => begun.require(begun.plan.difference(now), work)?,
        }
        Ok(begun)
    }

    fn read(work: &WorkFolder, watch: &dyn Watch) -> Result<Option<Begun>, VisibilityError> {
        let Some(bytes) = work.read(PLAN, MAX_PLAN_BYTES)? else { return Ok(None) };
        let Some(plan) = SavedPlan::of_bytes(&bytes) else {
            if is_of_other_format(&bytes) {
                let (folder, field) = (work.path().to_path_buf(), "format of the plan".to_owned());
                let [before, now] = [&bytes[..PLAN_START.len()], &PLAN_START[..]]
                    .map(|start| start.escape_ascii().to_string());
                return Err(VisibilityError::Differs { folder, field, before, now });
            }
            let folder = work.path().display();
            watch.warn(&format!("{folder}: its plan is damaged; the build starts anew"));
            return Ok(None);
        };
        let mut records = Vec::new();
        let log = Log::open(&work.file(JOURNAL), &head_of(&plan), |payload| {
            let record = decoded(payload).filter(|record| is_of(record, &plan));
            let is_good = record.is_some();
            records.extend(record);
            is_good
        })?;
        if let Some(n) = log.as_ref().map(Log::n_dropped_bytes).filter(|&n| n > 0) {
            let journal = work.file(JOURNAL);
            watch.warn(&format!(
                "{}: broken in its last {n} bytes; the tasks noted there are decided again",
                journal.display()
            ));
        }
        // The map got its name, and what is left was not removed any more.
        let is_finished = records.last() == Some(&Record::Assembled)
            && !work.file(MAP).exists()
            && work.target().exists();
        let is_of_use = !records.is_empty() && !is_finished;
        Ok(log.filter(|_| is_of_use).map(|log| Begun { plan, records, log }))
    }

    /// Gives the leaf pairs a task may have.
    pub fn target(&self) -> u64 {
        self.plan.target
    }

    fn require(
        &self,
        difference: Option<(String, String, String)>,
        work: &WorkFolder,
    ) -> Result<(), VisibilityError> {
        let Some((field, before, now)) = difference else { return Ok(()) };
        Err(VisibilityError::Differs { folder: work.path().to_path_buf(), field, before, now })
    }
}

impl Journal {
    /// Starts the journal of a build with these tasks, or goes on with one that was begun: its
    /// links go to `runs`, its tasks to `done`.
    ///
    /// # Errors
    /// Where the build that was begun has other tasks, or the disk fails.
    pub fn new(
        work: WorkFolder,
        mut plan: SavedPlan,
        plans: &Plans,
        begun: Option<Begun>,
        runs: &mut Runs,
        watch: &dyn Watch,
        mut done: impl FnMut(u32, Status),
    ) -> Result<Journal, VisibilityError> {
        (plan.n_tasks, plan.tasks_digest) = (plans.n_tasks() as u64, plans.digest());
        let mut journal = Journal { work, plan, log: None, next_file: 0 };
        let Some(begun) = begun else { return Ok(journal) };
        let of_tasks = |p: &SavedPlan| format!("{} tasks, digest {:x}", p.n_tasks, p.tasks_digest);
        let (before, now) = (of_tasks(&begun.plan), of_tasks(&journal.plan));
        let difference = (before != now).then(|| ("plan".to_owned(), before, now));
        begun.require(difference, &journal.work)?;
        let n_records = begun.records.len();
        let mut good = Vec::new();
        for record in begun.records {
            let Record::Tasks(commit) = record else { continue };
            if journal.take_up(&commit, runs, watch) {
                commit
                    .tasks
                    .iter()
                    .for_each(|&(i, s)| status_of(s).into_iter().for_each(|s| done(i, s)));
                good.push(commit);
            }
        }
        let files: Vec<u64> =
            good.iter().filter_map(|c| c.file.as_ref()).map(|f| f.number).collect();
        journal.next_file = files.iter().max().map_or(0, |n| n + 1);
        let is_named = |name: &str| files.iter().any(|&n| name == name_of(n));
        journal.work.clear(|name| name != PLAN && name != JOURNAL && !is_named(name))?;
        journal.log =
            if good.len() == n_records { Some(begun.log) } else { journal.rewrite(good)? };
        Ok(journal)
    }

    /// Takes up the links of a commit; false where they are not what they were.
    fn take_up(&self, commit: &Commit, runs: &mut Runs, watch: &dyn Watch) -> bool {
        let Some(file) = &commit.file else { return true };
        let LinksFile { n_bytes, crc, runs: saved, .. } = file.clone();
        let path = self.work.file(&name_of(file.number));
        let is_good = runs.load(&path, &SavedRuns { n_bytes, crc, runs: saved });
        if !is_good {
            let n_tasks = commit.tasks.len();
            watch.warn(&format!(
                "{}: damaged or gone; the {n_tasks} tasks in it are decided again",
                path.display()
            ));
        }
        is_good
    }

    /// Writes the journal anew, without what is not true any more.
    fn rewrite(&self, good: Vec<Commit>) -> Result<Option<Log>, StoreError> {
        let part = self.work.file(&format!("{JOURNAL}{PART}"));
        let mut log = Log::create(&part, &head_of(&self.plan))?;
        for commit in good {
            log.append(&encoded(&Record::Tasks(commit)))?;
        }
        let path = self.work.file(JOURNAL);
        std::fs::rename(&part, &path).map_err(|e| StoreError::own(&path, "rename", e))?;
        self.work.sync()?;
        Log::open(&path, &head_of(&self.plan), |_| true)
    }

    /// Makes durable that tasks are done, with all links that are held and `more`; `tasks` is empty
    /// then.
    ///
    /// # Errors
    /// Where the disk fails or is full.
    pub fn commit(
        &mut self,
        runs: &mut Runs,
        more: &[Pair],
        tasks: &mut Vec<(u32, Status)>,
    ) -> Result<(), StoreError> {
        if tasks.is_empty() {
            assert!(more.is_empty(), "links belong to tasks");
            return Ok(());
        }
        let number = self.next_file;
        let saved = runs.save(&self.work.file(&name_of(number)), more)?;
        let log = match &mut self.log {
            Some(log) => log,
            log => {
                self.work.sync_name()?;
                self.work.write(PLAN, &self.plan.to_bytes())?;
                log.insert(Log::create(&self.work.file(JOURNAL), &head_of(&self.plan))?)
            }
        };
        self.work.sync()?;
        let file = saved.map(|SavedRuns { n_bytes, crc, runs }| {
            self.next_file += 1;
            LinksFile { number, n_bytes, crc, runs }
        });
        let tasks_done = tasks.iter().map(|&(i, status)| (i, code_of(status))).collect();
        log.append(&encoded(&Record::Tasks(Commit { file, tasks: tasks_done })))?;
        self.work.keep(true);
        tasks.clear();
        Ok(())
    }

    /// Says whether anything was committed.
    pub fn is_begun(&self) -> bool {
        self.log.is_some()
    }

    /// Gives the work folder.
    pub fn work(&self) -> &WorkFolder {
        &self.work
    }

    /// Gives the error of a run that was asked to stop.
    pub fn stopped(&self, n_done: u64) -> VisibilityError {
        if !self.is_begun() {
            return StoreError::Interrupted.into();
        }
        let folder: PathBuf = self.work.path().to_path_buf();
        VisibilityError::Stopped { folder, n_done, n_tasks: self.plan.n_tasks }
    }

    /// Notes that the map is whole, before `publish` gives it its name; then nothing is left to do.
    ///
    /// # Errors
    /// Where the disk or `publish` fails.
    pub fn finish(
        mut self,
        publish: impl FnOnce() -> Result<(), StoreError>,
    ) -> Result<(), StoreError> {
        if let Some(log) = &mut self.log {
            // Its name first: without it the record would say that it was published.
            self.work.sync()?;
            log.append(&encoded(&Record::Assembled))?;
        }
        publish()?;
        self.work.keep(false);
        Ok(())
    }
}

fn name_of(number: u64) -> String {
    format!("{LINKS}{number:05}")
}

/// What a journal begins with: it belongs to one plan.
fn head_of(plan: &SavedPlan) -> Vec<u8> {
    [&JOURNAL_START[..], &xxh3_64(&plan.to_bytes()).to_le_bytes()].concat()
}

/// Says whether a record speaks of tasks that a plan has.
fn is_of(record: &Record, plan: &SavedPlan) -> bool {
    let Record::Tasks(commit) = record else { return true };
    commit.tasks.iter().all(|&(i, s)| u64::from(i) < plan.n_tasks && status_of(s).is_some())
}

fn code_of(status: Status) -> u8 {
    match status {
        Status::Visible => 0,
        Status::Invisible => 1,
        Status::Partial => 2,
    }
}

fn status_of(code: u8) -> Option<Status> {
    [Status::Visible, Status::Invisible, Status::Partial].get(usize::from(code)).copied()
}

fn encoded<T: Encode>(value: &T) -> Vec<u8> {
    let bytes = bincode::encode_to_vec(value, bincode::config::standard());
    bytes.expect("numbers, texts and lists of them can be written to memory")
}

fn decoded<T: Decode<()>>(bytes: &[u8]) -> Option<T> {
    let config = bincode::config::standard().with_limit::<DECODE_BYTES>();
    let (value, n_read) = bincode::decode_from_slice(bytes, config).ok()?;
    (n_read == bytes.len()).then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan() -> SavedPlan {
        SavedPlan {
            tool: "1.2.3".to_owned(),
            digest: 1 << 100,
            config: "max_level = 8\nleaf_capacity = 50\n".to_owned(),
            n_nodes: 700,
            n_surfels: 500,
            target: 4096,
            n_tasks: 20,
            tasks_digest: 77,
        }
    }

    #[test]
    fn f05_a_plan_is_whole_or_none() {
        let bytes = plan().to_bytes();
        assert_eq!(SavedPlan::of_bytes(&bytes), Some(plan()));
        for n_bytes in 0..bytes.len() {
            assert_eq!(SavedPlan::of_bytes(&bytes[..n_bytes]), None);
        }
        for bit in 0..bytes.len() * 8 {
            let mut bad = bytes.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(SavedPlan::of_bytes(&bad), None, "bit {bit}");
        }
    }

    #[test]
    fn f15_the_field_that_differs_is_named() {
        let of = |change: fn(&mut SavedPlan)| {
            let mut now = plan();
            change(&mut now);
            plan().difference(&now).map(|(field, before, now)| format!("{field}: {before}, {now}"))
        };
        assert_eq!(of(|_| {}), None);
        // What memory and threads decide is no difference.
        assert_eq!(of(|p| p.target = 1), None);
        for (said, change) in [
            ("version of pvmap: 1.2.3, 1.2.4", (|p| p.tool = "1.2.4".into()) as fn(&mut SavedPlan)),
            ("max_level: 8, 9", |p| p.config = "max_level = 9\nleaf_capacity = 50\n".into()),
            ("leaf_capacity: 50, none", |p| p.config = "max_level = 8\n".into()),
            ("interaction_pairs: none, \"1:ab\"", |p| {
                p.config += "interaction_pairs = \"1:ab\"\n";
            }),
            ("number of nodes: 700, 701", |p| p.n_nodes += 1),
            ("number of surfels: 500, 501", |p| p.n_surfels += 1),
        ] {
            assert_eq!(of(change).as_deref(), Some(said));
        }
        assert!(of(|p| p.digest = 0).is_some_and(|said| said.starts_with("octree: 0000001")));
    }

    #[test]
    fn names_of_a_work_folder() {
        for name in ["plan", "plan.part", "journal", "journal.part", "links-00012", "map.part"] {
            assert!(is_work_file(name), "{name}");
        }
        assert!(is_work_file(&name_of(7)) && is_work_file("links-123456.part"));
        for name in ["map", "links-", "links-x", "thesis", "plan.part.part", ""] {
            assert!(!is_work_file(name), "{name}");
        }
    }

    #[test]
    fn records_that_lie_take_no_memory() {
        let record = Record::Tasks(Commit { file: None, tasks: vec![(3, 1), (19, 2)] });
        let bytes = encoded(&record);
        assert_eq!(decoded::<Record>(&bytes), Some(record.clone()));
        assert!(is_of(&record, &plan()));
        for tasks in [vec![(20, 0)], vec![(3, 3)]] {
            assert!(!is_of(&Record::Tasks(Commit { file: None, tasks }), &plan()));
        }
        assert_eq!(decoded::<Record>(&[&bytes[..], &[0]].concat()), None, "something follows");
        // A list of 2^60 tasks.
        let mut lie = vec![0, 0, 253];
        lie.extend((1u64 << 60).to_le_bytes());
        assert_eq!(decoded::<Record>(&lie), None);
    }
}
