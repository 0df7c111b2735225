//! Estimation against an O(n²) oracle: same neighbours, same normals, for any memory and threads.

use super::*;
use pvmap_geometry::morton;
use pvmap_geometry::normal::canonical_binned;
use pvmap_geometry::plane::Moments;
use pvmap_store::Quiet;

/// A cloud in memory, sorted by Morton code.
struct Cloud(Vec<KnownPoint>);

impl SortedPoints for Cloud {
    fn len(&self) -> u64 {
        self.0.len() as u64
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<KnownPoint>) -> Result<(), StoreError> {
        out.clear();
        out.extend_from_slice(&self.0[range.start as usize..range.end as usize]);
        Ok(())
    }
}

/// A small generator of reproducible numbers (a multiplicative congruence modulo 2^64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: u32) -> u32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (((self.0 >> 33) * u64::from(n)) >> 31) as u32
    }

    fn shuffle<T>(&mut self, v: &mut [T]) {
        for i in (1..v.len()).rev() {
            v.swap(i, self.below(i as u32 + 1) as usize);
        }
    }
}

fn cloud(places: impl IntoIterator<Item = GridPoint>) -> Cloud {
    with_normals(places.into_iter().map(|g| KnownPoint { g, normal: None }).collect())
}

/// Sorts by code; the order within a code is that of the input.
fn with_normals(mut points: Vec<KnownPoint>) -> Cloud {
    points.sort_by_key(|p| morton::encode(p.g));
    Cloud(points)
}

fn run(cloud: &Cloud, wanted: Wanted, memory: u64) -> (Vec<Estimate>, Counts) {
    let mut all = Vec::new();
    let counts = estimate(cloud, wanted, memory, &Quiet, |first, part| {
        assert_eq!(first, all.len() as u64, "ranges follow each other");
        all.extend_from_slice(part);
        Ok(())
    })
    .expect("nothing to fail in memory");
    assert_eq!(all.len(), cloud.0.len());
    let n_points = counts.n_kept + counts.n_estimated + counts.n_none;
    assert_eq!(n_points, cloud.len(), "every point is counted once");
    (all, counts)
}

/// The definition, word for word.
fn oracle(cloud: &Cloud, wanted: Wanted) -> Vec<Estimate> {
    let mut order = Vec::new();
    let estimate = |p: &KnownPoint| {
        if let Some(normal) = p.normal.filter(|_| wanted == Wanted::Missing) {
            return Estimate { normal, sign: Sign::Known };
        }
        let offset = |q: &KnownPoint| [0, 1, 2].map(|i| i64::from(q.g[i]) - i64::from(p.g[i]));
        order.clear();
        order.extend(cloud.0.iter().map(|q| (offset(q).map(|d| d * d).iter().sum::<i64>(), q.g)));
        order.sort_unstable();
        order.truncate(K);
        let mut moments = Moments::default();
        for (_, g) in &order {
            moments.add(offset(&KnownPoint { g: *g, normal: None }), 1);
        }
        let Some(n) = moments.normal().map(canonical_binned) else {
            return Estimate::default();
        };
        let mut balance = 0;
        if wanted == Wanted::Missing {
            for q in cloud.0.iter().filter(|q| order.iter().any(|(_, g)| *g == q.g)) {
                let v = q.normal.unwrap_or([0; 3]);
                balance += (0..3).map(|i| i64::from(n[i]) * i64::from(v[i])).sum::<i64>().signum();
            }
        }
        match balance {
            0 => Estimate { normal: n, sign: Sign::Unknown },
            1.. => Estimate { normal: n, sign: Sign::Known },
            _ => Estimate { normal: n.map(|c| -c), sign: Sign::Known },
        }
    };
    cloud.0.iter().map(estimate).collect()
}

/// Small clouds of every awkward kind.
fn clouds(dice: &mut Dice) -> Vec<(&'static str, Vec<GridPoint>)> {
    let mut place = |n: usize, f: &mut dyn FnMut(&mut Dice) -> GridPoint| -> Vec<GridPoint> {
        (0..n).map(|_| f(dice)).collect()
    };
    let surface = |d: &mut Dice| {
        let [x, y] = [d.below(1 << 22), d.below(1 << 22)];
        [x, y, (1 << 20) + (x >> 3) + d.below(2000)]
    };
    let lattice = |n: u32, step: u32, from: u32| {
        (0..n * n * n)
            .map(move |i| [i % n, i / n % n, i / n / n].map(|v| from + v * step))
            .collect()
    };
    let mut all = vec![
        ("surface", place(3000, &mut { surface })),
        ("volume", place(3000, &mut |d| [0; 3].map(|_| d.below(1 << 22)))),
        ("few places", place(3000, &mut |d| [0; 3].map(|_| 2000 + d.below(7)))),
        ("two a place", place(3000, &mut |d| [0; 3].map(|_| d.below(12) * 300_000))),
        ("17 points", place(17, &mut { surface })),
        ("5 points", place(5, &mut { surface })),
        ("2 points", place(2, &mut { surface })),
        ("lattice", lattice(13, 8, 1 << 20)),
        ("wide lattice", lattice(13, 300_001, 5)),
        ("line", (0..2000).map(|i| [i * 3, i * 5, i * 7]).collect()),
        ("axis", (0..2000).map(|i| [77, i * 2, 4_194_303]).collect()),
        ("nothing", Vec::new()),
        ("one point", vec![[5, 6, 7]]),
    ];
    let mut heap = place(800, &mut { surface });
    heap.extend([[100, 200, 300]; 2000]);
    heap.extend(place(400, &mut |d| [100, 200, 300].map(|v| v + d.below(3))));
    all.push(("heap", heap));
    let mut outlier = place(2000, &mut |d| [d.below(5), d.below(5), d.below(2)]);
    outlier.push([4_194_303; 3]);
    all.push(("outlier", outlier));
    let mut cluster = place(1500, &mut |d| [0; 3].map(|_| 3_000_000 + d.below(200)));
    cluster.extend(place(300, &mut |d| [0; 3].map(|_| d.below(1 << 22))));
    all.push(("cluster", cluster));
    let steps = (0..20 * 40).map(|i| [i % 40, i / 40 % 5, 0].map(|v: u32| (1 << (i / 40)) + v));
    all.push(("stairs", steps.collect()));
    all
}

/// Gives some of the points a rough normal.
fn some_normals(places: &[GridPoint], dice: &mut Dice) -> Vec<KnownPoint> {
    let normal = |d: &mut Dice| {
        let direction = [0; 3].map(|_| d.below(2001) as f32 - 1000.0);
        if d.below(3) == 0 { None } else { pvmap_geometry::normal::quantise(direction) }
    };
    places.iter().map(|&g| KnownPoint { g, normal: normal(dice) }).collect()
}

#[test]
fn d5_any_memory_gives_what_the_definition_says() {
    let dice = &mut Dice(1);
    let mut n_widened = 0;
    for (name, places) in clouds(dice) {
        let cloud = with_normals(some_normals(&places, dice));
        for wanted in [Wanted::All, Wanted::Missing] {
            let expected = oracle(&cloud, wanted);
            for memory in [24 << 10, 32 << 10, 48 << 10, 100 << 10, 1 << 30] {
                let (found, counts) = run(&cloud, wanted, memory);
                n_widened += counts.n_widened;
                assert!(memory < 1 << 30 || counts.n_widened == 0, "{name}: all is in one tile");
                for (i, (f, e)) in found.iter().zip(&expected).enumerate() {
                    assert_eq!(f, e, "{name}, {wanted:?}, {memory} B, point {i} {:?}", cloud.0[i]);
                }
            }
        }
    }
    assert!(n_widened > 1000, "the small budgets must send searches out of their tiles");
}

#[test]
fn d8_threads_change_nothing() {
    let dice = &mut Dice(2);
    for (name, places) in clouds(dice) {
        let cloud = with_normals(some_normals(&places, dice));
        let expected = run(&cloud, Wanted::Missing, 30 << 10);
        for threads in [1, 2, 3, 8] {
            let pool =
                rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            let found = pool.install(|| run(&cloud, Wanted::Missing, 30 << 10));
            assert_eq!(found, expected, "{name}, {threads} threads");
        }
    }
}

#[test]
fn d2_the_order_within_a_code_changes_nothing() {
    let dice = &mut Dice(3);
    for (name, places) in clouds(dice) {
        let mut points = some_normals(&places, dice);
        let mut answers = Vec::new();
        for memory in [30 << 10, 1 << 30] {
            for _ in 0..2 {
                dice.shuffle(&mut points);
                let cloud = with_normals(points.clone());
                let found = run(&cloud, Wanted::Missing, memory).0;
                let key =
                    |(p, e): (&KnownPoint, &Estimate)| (p.g, p.normal, e.normal, e.sign as u8);
                let mut rows: Vec<_> = cloud.0.iter().zip(&found).map(key).collect();
                rows.sort_unstable();
                answers.push(rows);
            }
        }
        assert!(answers.windows(2).all(|w| w[0] == w[1]), "{name}");
    }
}

#[test]
fn a_plane_and_a_sphere_have_the_normals_of_their_equations() {
    let dice = &mut Dice(4);
    // 3x + 4y + 12z = const, to a grid step.
    let plane = (0..20_000).map(|_| {
        let [x, y] = [dice.below(1 << 20), dice.below(1 << 20)];
        [x, y, (1 << 21) - (3 * x + 4 * y) / 12]
    });
    for e in run(&cloud(plane.collect::<Vec<_>>()), Wanted::All, 1 << 20).0 {
        assert!(degrees(e.normal, [3.0, 4.0, 12.0]) < 0.1, "{:?}", e.normal);
        assert_eq!(e.sign, Sign::Unknown);
    }
    let middle = 2_000_000.0;
    let sphere = (0..150_000).map(|_| {
        loop {
            let v = [0; 3].map(|_| f64::from(dice.below(1 << 20)) / f64::from(1 << 19) - 1.0);
            let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
            if (0.1..1.0).contains(&length) {
                break v.map(|c| (c / length * 1_900_000.0 + middle) as u32);
            }
        }
    });
    let sphere = cloud(sphere.collect::<Vec<_>>());
    let found = run(&sphere, Wanted::All, 2 << 20).0;
    let off =
        |(p, e): (&KnownPoint, &Estimate)| degrees(e.normal, p.g.map(|v| f64::from(v) - middle));
    let mut off: Vec<f64> = sphere.0.iter().zip(&found).map(off).collect();
    off.sort_unstable_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.2 && off[off.len() - 1] < 1.0, "{:?}", off.last());
}

/// Gives the angle between two directions without sign.
fn degrees(n: Normal, m: [f64; 3]) -> f64 {
    let n = n.map(f64::from);
    let cross = [1, 2, 0].map(|i| {
        let j = (i + 1) % 3;
        n[i] * m[j] - n[j] * m[i]
    });
    let length = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
    (length(cross) / (length(n) * length(m))).asin().to_degrees()
}

#[test]
fn n25_collinear_points_have_no_normal_and_one_step_aside_gives_one() {
    let line: Vec<GridPoint> = (0..16).map(|i| [i * 262_143, i * 200_001, i * 99_999]).collect();
    let (found, counts) = run(&cloud(line.clone()), Wanted::All, 1 << 20);
    assert_eq!(found, vec![Estimate::default(); 16]);
    assert_eq!((counts.n_none, counts.n_estimated), (16, 0));
    // The same whichever way the cube is turned: the rank is that of integers.
    for axes in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
        for mirrors in 0..8 {
            let turn = |g: &GridPoint| {
                let own = |i: usize| (g[axes[i]], mirrors >> i & 1 == 1);
                [0, 1, 2].map(|i| match own(i) {
                    (v, true) => (1 << 22) - 1 - v,
                    (v, false) => v,
                })
            };
            let turned: Vec<GridPoint> = line.iter().map(turn).collect();
            assert_eq!(run(&cloud(turned), Wanted::All, 1 << 20).1.n_none, 16);
        }
    }
    let mut bent = line;
    bent[15][2] += 1;
    let found = run(&cloud(bent), Wanted::All, 1 << 20).0;
    assert!(found.iter().all(|e| e.normal != [0; 3]));
}

#[test]
fn missing_normals_take_the_side_of_the_majority() {
    // A floor whose middle point has no normal.
    let floor = |votes: &dyn Fn(u32) -> Option<Normal>| {
        let point = |i: u32| KnownPoint {
            g: [i % 4 * 100, i / 4 * 100, 7],
            normal: if i == 5 { None } else { votes(i) },
        };
        let cloud = with_normals((0..16).map(point).collect());
        let (found, counts) = run(&cloud, Wanted::Missing, 1 << 20);
        assert_eq!(counts.n_kept + counts.n_estimated, 16);
        let at = cloud.0.iter().position(|p| p.g == [100, 100, 7]).expect("it is there");
        (found[at], counts.n_signed)
    };
    let (up, down): (Normal, Normal) = ([0, 0, 1 << 14], [9830, 0, -13107]);
    let known = |normal| (Estimate { normal, sign: Sign::Known }, 1);
    assert_eq!(floor(&|_| Some(up)), known(up));
    assert_eq!(floor(&|_| Some(down)), known([0, 0, -(1 << 14)]));
    assert_eq!(floor(&|i| Some(if i < 9 { up } else { down })), known(up));
    // Seven and seven, and one across: a tie.
    let tie = |i: u32| match i {
        0 => Some([1 << 14, 0, 0]),
        i => Some(if i < 9 { up } else { down }),
    };
    assert_eq!(floor(&tie), (Estimate { normal: up, sign: Sign::Unknown }, 0));
    assert_eq!(floor(&|_| None).0, Estimate { normal: up, sign: Sign::Unknown });
}

#[test]
fn a_budget_that_is_far_too_small_is_refused() {
    let dice = &mut Dice(5);
    let cloud = cloud((0..5000).map(|_| [0; 3].map(|_| dice.below(1 << 22))).collect::<Vec<_>>());
    let refused = estimate(&cloud, Wanted::All, 4 << 10, &Quiet, |_, _| Ok(()));
    assert!(matches!(refused, Err(StoreError::Budget { have_bytes: 4096, .. })), "{refused:?}");
}

#[test]
fn a_wish_to_stop_and_a_failing_sink_end_it() {
    struct Stopped;
    impl Watch for Stopped {
        fn stage(&self, _: &'static str, _: Option<u64>, _: &'static str) {}
        fn advance(&self, _: u64) {}
        fn warn(&self, _: &str) {}
        fn is_stopped(&self) -> bool {
            true
        }
    }
    let cloud = cloud([[1, 2, 3]; 50]);
    for memory in [1 << 10, 1 << 20] {
        let stopped = estimate(&cloud, Wanted::All, memory, &Stopped, |_, _| Ok(()));
        assert!(matches!(stopped, Err(StoreError::Interrupted)));
        let full = |_, _: &[Estimate]| Err(StoreError::Interrupted);
        assert!(estimate(&cloud, Wanted::All, memory, &Quiet, full).is_err());
    }
}

#[test]
fn progress_adds_up_to_the_points() {
    #[derive(Default)]
    struct Heard(std::sync::atomic::AtomicU64);
    impl Watch for Heard {
        fn stage(&self, _: &'static str, _: Option<u64>, _: &'static str) {}
        fn advance(&self, n: u64) {
            self.0.fetch_add(n, std::sync::atomic::Ordering::Relaxed);
        }
        fn warn(&self, _: &str) {}
        fn is_stopped(&self) -> bool {
            false
        }
    }
    let dice = &mut Dice(6);
    for (name, places) in clouds(dice) {
        let cloud = with_normals(some_normals(&places, dice));
        for (wanted, memory) in [(Wanted::All, 30 << 10), (Wanted::Missing, 1 << 30)] {
            let heard = Heard::default();
            estimate(&cloud, wanted, memory, &heard, |_, _| Ok(())).expect("nothing to fail");
            assert_eq!(heard.0.into_inner(), cloud.len(), "{name}");
        }
    }
}

/// Run with `cargo test --release -p pvmap-octree normals -- --ignored --nocapture`.
#[test]
#[ignore = "takes seconds; prints a rate"]
fn speed_on_a_noisy_room() {
    let dice = &mut Dice(7);
    // Walls, floor and ceiling of 20 x 16 x 6 m with 3 mm of noise, as seen from the middle.
    let size = [4_194_303.0, 3_355_442.0, 1_258_290.0];
    let mut ray = || loop {
        let v = [0; 3].map(|_| f64::from(dice.below(1 << 20)) / f64::from(1 << 19) - 1.0);
        let far = (0..3).map(|i| size[i] / 2.0 / v[i].abs()).fold(f64::MAX, f64::min);
        if (0.01..1.0).contains(&v.iter().map(|c| c * c).sum::<f64>()) {
            let noise = 1.0 - f64::from(dice.below(1200)) / 4e6;
            break [0, 1, 2].map(|i| (size[i] / 2.0 + v[i] * far * noise) as u32);
        }
    };
    let room = cloud((0..5_000_000).map(|_| ray()).collect::<Vec<_>>());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    for memory_mib in [1024, 64] {
        let start = std::time::Instant::now();
        let nothing = |_, _: &[Estimate]| Ok(());
        let counts = pool
            .install(|| estimate(&room, Wanted::All, memory_mib << 20, &Quiet, nothing))
            .expect("nothing to fail in memory");
        let rate = 5.0 / start.elapsed().as_secs_f64();
        eprintln!("5 M points, {memory_mib} MiB, 2 threads: {rate:.2} M points/s, {counts:?}");
        assert!(counts.n_none < 10);
    }
}
