//! A small sound octree and map, all that can be asked of them, and what must be true of the
//! answers of damaged ones.
#![allow(dead_code, unreachable_pub, reason = "every test file uses a part of this")]

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use fastrand::Rng;
use pvmap::query::{FractionAnswer, Located, Map, PairAnswer, Place, QueryError, Snap};
use pvmap::vmap::frame::FrameRecord;
use pvmap::vmap::links::LinkLists;
use pvmap::vmap::tree::{Nodes, RoutingKey};
use pvmap::vmap::{FormatError, MapSummary, MapView, Node, OctreeView, Surfel};
use pvmap::{BuildConfig, Error, Limits, Quiet};

use crate::common::{LIMITS, build_with, ingest_with, room_cloud};

/// Bytes under one checksum.
pub const BLOCK: usize = 65_536;
/// Sections of each artifact, `sums` among them.
pub const N_MAP_SECTIONS: usize = 11;
pub const N_OCTREE_SECTIONS: usize = 10;

/// A sound octree and a sound map of it, each at most 64 KiB.
pub struct Sound {
    pub octree: Vec<u8>,
    pub map: Vec<u8>,
    pub answers: Vec<Answer>,
}

pub static SOUND: LazyLock<Sound> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let (octree, map) = artifacts(folder.path(), 900, &small_config());
    assert!(octree.len() <= BLOCK && map.len() <= BLOCK, "{} {}", octree.len(), map.len());
    let answers = ask(&map).into_iter().map(Result::unwrap).collect();
    Sound { octree, map, answers }
});

pub fn small_config() -> BuildConfig {
    BuildConfig { max_level: 5, leaf_capacity: 8, fractions: true, ..BuildConfig::default() }
}

/// Makes an octree of the furnished room and a map.
pub fn artifacts(folder: &Path, n_points: u64, config: &BuildConfig) -> (Vec<u8>, Vec<u8>) {
    let scan = folder.join("room.las");
    room_cloud(n_points).write_las(&scan, 0.0001, [0.0; 3]);
    let octree = ingest_with(&[scan], folder, &LIMITS, |_| {});
    let map = build_with(&octree, config, &LIMITS);
    (std::fs::read(octree.join("points.pvo")).unwrap(), map)
}

/// One thing a map says.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    Head(MapSummary, FrameRecord),
    Text(String),
    Node(Node),
    Surfel(Surfel),
    Links(LinkLists),
    Place(Result<Located, String>),
    Pair(PairAnswer),
    Fraction(FractionAnswer),
}

/// What a map answers to all that the small sound map can be asked, in one order; only an error
/// of opening makes it short.
pub fn ask(bytes: &[u8]) -> Vec<Result<Answer, QueryError>> {
    let map = match Map::open(bytes) {
        Ok(map) => map,
        Err(error) => return vec![Err(error)],
    };
    let view = map.view();
    let mut answers = vec![Ok(Answer::Head(*view.summary(), *view.frame()))];
    answers.push(view.config().map(|text| Answer::Text(text.to_owned())).map_err(Into::into));
    answers.push(view.crs().map(|crs| Answer::Text(format!("{crs:?}"))).map_err(Into::into));
    answers.extend((0..view.n_nodes()).map(|id| Ok(Answer::Node(view.node(id)?))));
    answers.extend((0..view.summary().n_surfels).map(|id| Ok(Answer::Surfel(view.surfel(id)?))));
    for pairs in [Some(view.links()), view.fractions()].into_iter().flatten() {
        answers.extend((0..pairs.n_blocks()).map(|i| Ok(Answer::Links(pairs.lists(i)?))));
    }
    let located: Vec<_> = places().map(|p| map.locate(&p, Snap::Within(1.0))).collect();
    answers.extend(located.iter().cloned().map(|found| match found {
        Err(QueryError::Format(e)) => Err(e.into()),
        found => Ok(Answer::Place(found.map_err(|e| e.to_string()))),
    }));
    for (i, a) in located.iter().enumerate() {
        for b in &located[i..] {
            let (Ok(a), Ok(b)) = (a, b) else { continue };
            answers.push(map.pair(a, b).map(Answer::Pair));
            answers.push(map.pair_fraction(a, b).map(Answer::Fraction));
        }
    }
    answers
}

/// Places on the walls of the room, and one in the middle of the air.
fn places() -> impl Iterator<Item = Place> {
    let mut rng = Rng::with_seed(1);
    (0..8).map(move |i| {
        let mut position = [0; 3].map(|_| 0.1 + 5.3 * rng.f64());
        if i > 0 {
            position[i % 3] = if i % 2 == 0 { 0.01 } else { 5.49 };
        }
        Place { position, normal: (i % 4 == 1).then_some([0.0, 0.0, 1.0]) }
    })
}

/// Demands that each answer is that of the sound map, or an error that names the damage.
pub fn check_answers(bytes: &[u8], what: &str) {
    let found = ask(bytes);
    let is_error = |a: &Result<Answer, QueryError>| matches!(a, Err(QueryError::Format(_)));
    if found.len() != SOUND.answers.len() {
        // Pairs of places that were not found are not asked.
        assert!(found.iter().any(is_error), "{what}: fewer answers, no error");
    }
    // Up to the pairs every answer has its place in the list.
    let n_pairs = SOUND.answers.iter().filter(|a| matches!(a, Answer::Pair(_))).count();
    let aligned = if found.len() == SOUND.answers.len() { 0 } else { n_pairs };
    for (found, sound) in found.iter().zip(&SOUND.answers[..SOUND.answers.len() - aligned]) {
        assert!(is_error(found) || found.as_ref() == Ok(sound), "{what}: {found:?}, not {sound:?}");
    }
}

pub fn verify_map(bytes: &[u8]) -> Result<(), FormatError> {
    MapView::open(bytes)?.verify()
}

pub fn verify_octree(bytes: &[u8]) -> Result<(), FormatError> {
    OctreeView::open(bytes)?.verify()
}

pub fn exit_code(error: FormatError) -> u8 {
    Error::artifact(Path::new("a.vmap"), error).exit_code()
}

/// Everything a build takes from an octree.
pub type Points = (Vec<(RoutingKey, Vec<u8>)>, FrameRecord, String);

pub fn points_of(bytes: &[u8]) -> Result<Points, FormatError> {
    let view = OctreeView::open(bytes)?;
    let points = view.points(0, view.summary().n_points)?;
    let rows = points.iter().map(|p| p.map(|p| (p.key, p.record.to_vec())));
    Ok((rows.collect::<Result<_, _>>()?, *view.frame(), format!("{:?}", view.crs()?)))
}

/// An octree folder of any bytes, and the map it would become.
pub struct Folder {
    octree: PathBuf,
    map: PathBuf,
    _folder: tempfile::TempDir,
}

impl Folder {
    pub fn new() -> Folder {
        let folder = tempfile::tempdir().unwrap();
        let (octree, map) = (folder.path().join("a.octree"), folder.path().join("a.vmap"));
        std::fs::create_dir(&octree).unwrap();
        Folder { octree, map, _folder: folder }
    }

    /// Builds a map of an octree of these bytes; after an error there is none.
    pub fn build(&self, octree: &[u8]) -> Result<Vec<u8>, Error> {
        std::fs::write(self.octree.join("points.pvo"), octree).unwrap();
        let limits = Limits { threads: 1, memory_bytes: 64 << 20 };
        let built = pvmap::build(&self.octree, &self.map, &small_config(), &limits, &Quiet);
        assert_eq!(built.is_ok(), self.map.exists());
        built?;
        let map = std::fs::read(&self.map).unwrap();
        std::fs::remove_file(&self.map).unwrap();
        Ok(map)
    }
}
