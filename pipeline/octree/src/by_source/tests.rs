//! Every batch that went into an octree comes out of it as it was, in order, with its numbers.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use fastrand::Rng;
use pvmap_geometry::normal::quantise;
use pvmap_geometry::{Intensity, PointBatch, Positions};
use pvmap_store::{Mapped, Quiet};
use pvmap_vmap::OctreeView;
use pvmap_vmap::octree::FILE_NAME;
use pvmap_vmap::schema::ColumnType;

use super::*;
use crate::ingest::{
    Account, ColorPlan, Ingest, IngestOptions, NormalsFrom, Orientation, PositionPlan, SourcePlan,
};

/// Takes batches of two sources in; records of the second have gaps.
fn octree_of(folder: &Path, batches: &[PointBatch], n_dropped: u64) -> PathBuf {
    octree_of_with(folder, batches, n_dropped, NormalsFrom::None)
}

fn octree_of_with(
    folder: &Path,
    batches: &[PointBatch],
    n_dropped: u64,
    normals: NormalsFrom,
) -> PathBuf {
    let output = folder.join("a.octree");
    let options = IngestOptions {
        output: output.clone(),
        overwrite: true,
        memory_bytes: 64 << 20,
        normals,
        orientation: Orientation::Unknown,
    };
    let plan = |source: u32| SourcePlan {
        name: format!("{source}.las").into_bytes(),
        format: 1,
        positions: PositionPlan::Lattice { scale: [0.5; 3], offset: [0.0; 3], bounds: None },
        n_declared: 1 << 20,
        color: ColorPlan::Sixteen,
        intensity: Some(ColumnType::U16),
        has_class: true,
        has_gps_time: true,
        is_gps_time_since_1980: Some(true),
        has_normal: true,
        crs: None,
    };
    let job = Ingest::new(options, vec![plan(0), plan(1)], &[], &Quiet).unwrap();
    let mut worker = job.worker();
    batches.iter().for_each(|batch| worker.push(batch).unwrap());
    worker.finish().unwrap();
    let account = |source: u32| Account {
        n_read: batches.iter().filter(|b| b.source == source).map(|b| b.len() as u64).sum(),
        n_invalid: if source == 1 { n_dropped } else { 0 },
        ..Account::default()
    };
    job.finish(&[account(0), account(1)]).unwrap();
    output.join(FILE_NAME)
}

fn random_batch(rng: &mut Rng, source: u32, records: Vec<u64>) -> PointBatch {
    let n = records.len();
    PointBatch {
        source,
        positions: Positions::Lattice(rng.three(n, |r| r.i32(-50..50))),
        color: Some(rng.three(n, |r| r.u16(..))),
        intensity: Some(Intensity::U16((0..n).map(|_| rng.u16(..)).collect())),
        classification: Some((0..n).map(|_| rng.u8(..40)).collect()),
        gps_time: Some((0..n).map(|_| 1e6 * rng.f64()).collect()),
        normal: Some(rng.three(n, |r| r.f32())),
        records,
    }
}

trait Three {
    fn three<T>(&mut self, n: usize, next: impl Fn(&mut Rng) -> T) -> Vec<[T; 3]>;
}

impl Three for Rng {
    fn three<T>(&mut self, n: usize, next: impl Fn(&mut Rng) -> T) -> Vec<[T; 3]> {
        (0..n).map(|_| [next(self), next(self), next(self)]).collect()
    }
}

/// Says what two lists of batches hold, however they are cut.
fn joined(batches: &[PointBatch]) -> Vec<String> {
    let one = |b: &PointBatch, i: usize| {
        let (Positions::Lattice(p), Some(Intensity::U16(v))) = (&b.positions, &b.intensity) else {
            panic!("columns of another type: {b:?}")
        };
        let column = (b.color.as_ref().unwrap()[i], b.classification.as_ref().unwrap()[i]);
        let rest = (b.gps_time.as_ref().unwrap()[i], b.normal.as_ref().unwrap()[i]);
        format!("{} {} {:?} {} {column:?} {rest:?}", b.source, b.records[i], p[i], v[i])
    };
    batches.iter().flat_map(|b| (0..b.len()).map(move |i| one(b, i))).collect()
}

#[test]
fn points_come_back_in_the_order_of_their_sources_whatever_the_memory_and_threads() {
    let rng = &mut Rng::with_seed(7);
    let folder = tempfile::tempdir().unwrap();
    let n = 60_000;
    // Every tenth record of the second source was dropped.
    let some: Vec<u64> = (0..n / 3).filter(|r| r % 10 != 4).collect();
    let n_dropped = n / 3 - some.len() as u64;
    let batches = [random_batch(rng, 0, (0..n).collect()), random_batch(rng, 1, some)];
    let points = octree_of(folder.path(), &batches, n_dropped);
    let mapped = Mapped::open(&points).unwrap();
    let octree = OctreeView::open(&mapped).unwrap();
    let classes = batches.iter().flat_map(|b| b.classification.iter().flatten());
    let class_max = *classes.max().unwrap();
    for (n_threads, memory_bytes) in [(1, 1 << 30), (3, 1 << 30), (1, 1 << 12), (3, 1 << 14)] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        pool.install(|| {
            let n_tagged = AtomicU64::new(0);
            // The number of a point is its place, so that a mix-up shows.
            let tag = || {
                |p: &Point<'_>| {
                    n_tagged.fetch_add(1, Ordering::Relaxed);
                    Ok::<_, OctreeError>(p.key.g[0])
                }
            };
            let all = BySource::gather(
                &octree,
                (Which::All, With::Normals),
                (folder.path(), memory_bytes),
                tag,
                &Quiet,
            )
            .unwrap();
            assert_eq!(n_tagged.into_inner(), octree.summary().n_points);
            assert_eq!(all.seen().class_max, class_max);
            assert_eq!(all.spilled_bytes() > 0, memory_bytes < 1 << 20);
            let (mut found, frame) = (Vec::new(), octree.frame().frame);
            all.each(|batch, tags| {
                let Positions::Lattice(places) = &batch.positions else { panic!("no lattice") };
                assert_eq!(tags.normals.len(), batch.len());
                for (place, tag) in places.iter().zip(&tags.numbers) {
                    assert_eq!(frame.grid_of_lattice(place.map(i64::from))[0], *tag);
                }
                found.push(batch.clone());
                Ok::<_, OctreeError>(())
            })
            .unwrap();
            assert!(joined(&found) == joined(&batches), "{n_threads} threads, {memory_bytes}");
        });
    }
    drop(mapped);
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(left.len(), 1, "only the octree: {left:?}");
}

#[test]
fn points_of_one_source_come_without_the_others() {
    let rng = &mut Rng::with_seed(9);
    let folder = tempfile::tempdir().unwrap();
    let some: Vec<u64> = (0..20_000).filter(|r| r % 10 != 4).collect();
    let batches = [random_batch(rng, 0, (0..30_000).collect()), random_batch(rng, 1, some)];
    let points = octree_of(folder.path(), &batches, 2000);
    let mapped = Mapped::open(&points).unwrap();
    let octree = OctreeView::open(&mapped).unwrap();
    let tag = || |_: &Point<'_>| Ok::<_, OctreeError>(0);
    for memory_bytes in [1 << 30, 1 << 14] {
        for source in 0..3 {
            let place = (folder.path(), memory_bytes);
            let which = (Which::Of(source), With::Numbers);
            assert_eq!(
                temporary_bytes(&octree, which, memory_bytes) > 0,
                memory_bytes < 1 << 20 && source < 2
            );
            let all = BySource::gather(&octree, which, place, tag, &Quiet).unwrap();
            let mut found = Vec::new();
            all.each(|batch, _| {
                found.push(batch.clone());
                Ok::<_, OctreeError>(())
            })
            .unwrap();
            let expected = batches.get(source as usize).map_or(&[][..], std::slice::from_ref);
            assert!(joined(&found) == joined(expected), "{source}, {memory_bytes}");
        }
    }
}

#[test]
fn normals_of_the_octree_come_with_the_points() {
    let rng = &mut Rng::with_seed(8);
    let folder = tempfile::tempdir().unwrap();
    let batches = [random_batch(rng, 0, (0..30_000).collect())];
    let points = octree_of_with(folder.path(), &batches, 0, NormalsFrom::File);
    let mapped = Mapped::open(&points).unwrap();
    let octree = OctreeView::open(&mapped).unwrap();
    let tag = || |_: &Point<'_>| Ok::<_, OctreeError>(0);
    let place = (folder.path(), 1 << 14);
    let all = BySource::gather(&octree, (Which::All, With::Normals), place, tag, &Quiet).unwrap();
    let mut found = Vec::new();
    all.each(|_, tags| {
        found.extend(tags.normals.iter().copied());
        Ok::<_, OctreeError>(())
    })
    .unwrap();
    let normals = batches[0].normal.iter().flatten();
    assert!(normals.map(|&n| quantise(n).unwrap()).eq(found));
}

#[test]
fn buffers_stay_large_and_what_extents_take_is_counted() {
    let mib = 1 << 20;
    for (memory_bytes, n_points) in
        [(64 * mib, 1 << 24), (1024 * mib, 1 << 32), (64 * mib, 1 << 33)]
    {
        for n_threads in [1, 2, 16] {
            let shares = Shares {
                hold_bytes: memory_bytes * 45 / 100,
                buffer_bytes: memory_bytes / 10,
                extent_bytes: memory_bytes / 20,
                bucket_points: 1 << 17,
                record_bytes: 36,
                row_bytes: 40,
            };
            let plan = Plan::new(n_points, n_points, n_threads, &shares);
            assert!(plan.n_buckets >= 2 && plan.buffer_bytes >= LEAST_BUFFER_BYTES, "{plan:?}");
            let buffers_bytes = plan.n_buckets * n_threads as u64 * plan.buffer_bytes;
            assert!(buffers_bytes <= shares.buffer_bytes || plan.n_buckets == 2, "{plan:?}");
            let n_extents = n_points * shares.row_bytes / plan.buffer_bytes;
            let listed_bytes = n_extents * EXTENT_BYTES;
            assert!(listed_bytes <= shares.extent_bytes + plan.beyond_bytes, "{plan:?}");
        }
    }
}

#[test]
fn an_error_of_the_visitor_ends_it() {
    let rng = &mut Rng::with_seed(9);
    let folder = tempfile::tempdir().unwrap();
    let batches = [random_batch(rng, 0, (0..50_000).collect())];
    let points = octree_of(folder.path(), &batches, 0);
    let mapped = Mapped::open(&points).unwrap();
    let octree = OctreeView::open(&mapped).unwrap();
    for n_threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        pool.install(|| {
            let tag = || |_: &Point<'_>| Ok::<_, OctreeError>(0);
            let all = BySource::gather(
                &octree,
                (Which::All, With::Numbers),
                (folder.path(), 1 << 16),
                tag,
                &Quiet,
            )
            .unwrap();
            let mut n_calls = 0;
            let ended = all.each(|_, _| {
                n_calls += 1;
                Err(OctreeError::TooManyNodes)
            });
            assert!(matches!(ended, Err(OctreeError::TooManyNodes)) && n_calls == 1);
        });
    }
}

#[test]
fn two_points_of_one_record_are_an_error() {
    let rng = &mut Rng::with_seed(11);
    let folder = tempfile::tempdir().unwrap();
    let twice = [random_batch(rng, 0, vec![0, 1, 2]), random_batch(rng, 0, vec![2])];
    let beyond = [random_batch(rng, 0, vec![0, 1, 3])];
    // So many that they would be no bucket that is read at once.
    let forged = [random_batch(rng, 0, vec![7; 40_000])];
    for (batches, memory_bytes, word) in [
        (&twice[..], 1 << 20, "two points"),
        (&beyond, 1 << 20, "does not have"),
        (&forged, 1 << 14, "two points"),
    ] {
        let points = octree_of(folder.path(), batches, 0);
        let mapped = Mapped::open(&points).unwrap();
        let octree = OctreeView::open(&mapped).unwrap();
        let tag = || |_: &Point<'_>| Ok::<_, OctreeError>(0);
        let ended = BySource::gather(
            &octree,
            (Which::All, With::Numbers),
            (folder.path(), memory_bytes),
            tag,
            &Quiet,
        )
        .and_then(|all| all.each(|_, _| Ok::<_, OctreeError>(())));
        assert!(ended.unwrap_err().to_string().contains(word));
    }
}
