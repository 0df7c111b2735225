//! The leaf-pair test against exact rational arithmetic: [V-1]…[V-3] written out as the text says
//! them, with fractions, on random and on adversarial cases.

use fastrand::Rng;
use num_bigint::BigInt;
use num_rational::Ratio;
use pvmap_geometry::bounds::Box3;
use pvmap_geometry::disc::{Disc, Profile, blocks, faces_both};

type Q = Ratio<BigInt>;

fn q(v: i128) -> Q {
    Q::from_integer(BigInt::from(v))
}

fn dot(a: &[Q; 3], b: &[Q; 3]) -> Q {
    &a[0] * &b[0] + &a[1] * &b[1] + &a[2] * &b[2]
}

fn vector(v: [i32; 3]) -> [Q; 3] {
    v.map(|c| q(c.into()))
}

fn minus(a: &[Q; 3], b: &[Q; 3]) -> [Q; 3] {
    [0, 1, 2].map(|i| &a[i] - &b[i])
}

/// [V-2] as printed.
fn blocks_by_fractions(profile: Profile, a: &Disc, b: &Disc, k: &Disc) -> bool {
    let (ca, cb, ck) = (vector(a.centroid), vector(b.centroid), vector(k.centroid));
    let d = minus(&cb, &ca);
    let n = k.normal.map(|c| q(c.into()));
    let (s, h) = (dot(&n, &d), dot(&n, &minus(&ck, &ca)));
    if s == q(0) {
        return false;
    }
    let t = h / s;
    if t <= q(0) || t >= q(1) {
        return false;
    }
    let x = [0, 1, 2].map(|i| &ca[i] + &t * &d[i]);
    let within = |v: &[Q; 3]| dot(v, v);
    let on_disc = within(&minus(&x, &ck)) <= q(k.radius2.into());
    let (low, high) = (vector(k.limit.min), vector(k.limit.max));
    on_disc
        && match profile {
            Profile::Paper => clip(&ca, &d, &low, &high),
            Profile::Patch => {
                (0..3).all(|i| low[i] <= x[i] && x[i] <= high[i])
                    && within(&minus(&x, &ca)) > q(a.radius2.into())
                    && within(&minus(&x, &cb)) > q(b.radius2.into())
            }
        }
}

/// Does a + t·d, 0 ≤ t ≤ 1, meet the closed box? By clipping the parameter interval.
fn clip(a: &[Q; 3], d: &[Q; 3], low: &[Q; 3], high: &[Q; 3]) -> bool {
    let (mut first, mut last) = (q(0), q(1));
    for i in 0..3 {
        if d[i] == q(0) {
            if a[i] < low[i] || a[i] > high[i] {
                return false;
            }
            continue;
        }
        let (mut near, mut far) = ((&low[i] - &a[i]) / &d[i], (&high[i] - &a[i]) / &d[i]);
        if near > far {
            std::mem::swap(&mut near, &mut far);
        }
        first = first.max(near);
        last = last.min(far);
    }
    first <= last
}

fn faces_by_fractions(a: &Disc, b: &Disc) -> bool {
    let d = minus(&vector(b.centroid), &vector(a.centroid));
    let looks = |k: &Disc, sign: i128| {
        let n = k.normal.map(|c| q(c.into()));
        let s = dot(&n, &d) * q(sign);
        k.normal == [0; 3] || s > q(0) || (k.two_sided && s != q(0))
    };
    d != vector([0; 3]) && looks(a, 1) && looks(b, -1)
}

fn random_disc(rng: &mut Rng, size: i32) -> Disc {
    let centroid = [0; 3].map(|_| rng.i32(0..size));
    let normal = [0; 3].map(|_| rng.i32(-16384..=16384));
    let normal = pvmap_geometry::normal::rescale(normal.map(i64::from));
    let r = rng.u64(0..=size as u64 / 4);
    let h = rng.i32(1..=1 + size / 8);
    let limit = Box3::at(centroid).grown(h);
    Disc { centroid, normal, two_sided: rng.bool(), radius2: r * r, limit }
}

/// Puts `k` where the verdict hangs on one unit: on the rim, at an end, in the segment's plane.
fn adversarial(rng: &mut Rng) -> (Disc, Disc, Disc) {
    let size = 1 << rng.u32(3..22);
    let (mut a, mut b, mut k) =
        (random_disc(rng, size), random_disc(rng, size), random_disc(rng, size));
    let axis = rng.usize(0..3);
    match rng.u32(0..6) {
        // A segment along an axis through a disc across it, at the rim to the step.
        0 => {
            let (p, w) = (a.centroid, rng.i32(0..=size / 4));
            b.centroid = p;
            b.centroid[axis] = (p[axis] + rng.i32(2..=size)).min((1 << 22) - 1);
            k.centroid = p;
            k.centroid[axis] = (p[axis] + b.centroid[axis]) / 2;
            k.centroid[(axis + 1) % 3] = (p[(axis + 1) % 3] + w).min((1 << 22) - 1);
            k.normal = [0; 3];
            k.normal[axis] = 16384;
            let w = (k.centroid[(axis + 1) % 3] - p[(axis + 1) % 3]) as i64;
            k.radius2 = (w * w + rng.i64(-1..=1)).max(0) as u64;
            k.limit = Box3::at(k.centroid).grown(w as i32 + rng.i32(-1..=1).max(0));
        }
        // The plane passes through an end.
        1 => k.centroid = a.centroid,
        2 => k.centroid = b.centroid,
        // The plane is parallel to the segment, or holds it.
        3 => {
            b.centroid[axis] = a.centroid[axis];
            k.normal = [0; 3];
            k.normal[axis] = 16384;
            if rng.bool() {
                k.centroid[axis] = a.centroid[axis];
            }
        }
        // The crossing lies at the edge of an end's own disc, or of the limit box.
        4 => {
            let d2: i64 = (0..3).map(|i| i64::from(b.centroid[i] - a.centroid[i]).pow(2)).sum();
            k.centroid = [0, 1, 2].map(|i| (a.centroid[i] + b.centroid[i]).div_euclid(2));
            a.radius2 = (d2 / 4 + rng.i64(-2..=2)).max(0) as u64;
            k.limit = Box3::at(k.centroid).grown(rng.i32(0..=1));
            k.radius2 = rng.u64(0..=3);
        }
        // Everything in one corner: many ties.
        _ => {
            for disc in [&mut a, &mut b, &mut k] {
                *disc = random_disc(rng, 4);
                disc.normal = [0; 3].map(|_| rng.i16(-1..=1) * 16384);
            }
        }
    }
    (a, b, k)
}

fn check(a: &Disc, b: &Disc, k: &Disc) {
    for profile in [Profile::Paper, Profile::Patch] {
        let got = blocks(profile, a, b, k);
        assert_eq!(got, blocks_by_fractions(profile, a, b, k), "{profile:?} {a:?} {b:?} {k:?}");
        assert_eq!(got, blocks(profile, b, a, k), "asymmetric {profile:?} {a:?} {b:?} {k:?}");
    }
    assert_eq!(faces_both(a, b), faces_by_fractions(a, b), "{a:?} {b:?}");
    assert_eq!(faces_both(a, b), faces_both(b, a), "{a:?} {b:?}");
}

/// The figure is 10^6 random and 10^5 adversarial cases; a plain run does a tenth.
fn cases(full: usize) -> usize {
    if std::env::var_os("PVMAP_SLOW_TESTS").is_some() { full } else { full / 10 }
}

#[test]
fn v2_random_cases_agree_with_fractions() {
    let mut rng = Rng::with_seed(2007);
    let mut n_blocked = 0;
    for _ in 0..cases(1_000_000) {
        let size = 1 << rng.u32(2..22);
        let [a, b, k] = [0; 3].map(|_| random_disc(&mut rng, size));
        check(&a, &b, &k);
        n_blocked += usize::from(blocks(Profile::Paper, &a, &b, &k));
    }
    assert!(n_blocked > cases(1_000_000) / 100, "the cases hardly ever block: {n_blocked}");
}

#[test]
fn v2_adversarial_cases_agree_with_fractions() {
    let mut rng = Rng::with_seed(2007);
    for _ in 0..cases(100_000) {
        let (a, b, k) = adversarial(&mut rng);
        check(&a, &b, &k);
    }
}
